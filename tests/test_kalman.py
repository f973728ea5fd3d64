"""Kalman filter, extended filter and smoother: filterpy, and exact conditioning of the joint Gaussian."""

import math

import filterpy.kalman
import numpy as np
import pytest
import torch
from scipy.stats import chi2, multivariate_normal
from torch.testing import assert_close

from torchpose.tracking.kalman import (
    Gaussian,
    kalman_filter,
    kalman_predict,
    kalman_smoother,
    kalman_update,
)

N, M, T = 4, 3, 6  # states, measured components, moments


def positive(*shape, generator):
    half = torch.randn(*shape[:-1], shape[-1] + 1, generator=generator, dtype=torch.float64)
    return half @ half.mT / shape[-1] + 0.1 * torch.eye(shape[-1], dtype=torch.float64)


def system(seed, batch=()):
    """Start, measurements, and one transition a step: nothing is stationary, nothing diagonal."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*batch, *shape, generator=generator, dtype=torch.float64)

    start = Gaussian(normal(N), positive(*batch, N, N, generator=generator))
    noises = (
        positive(*batch, T - 1, N, N, generator=generator),
        positive(*batch, T, M, M, generator=generator),
    )
    return start, normal(T, M), 0.5 * normal(T - 1, N, N), noises[0], normal(M, N), noises[1]


def conditioned(start, values, move, move_noise, model, noise):
    """Mean and covariance of every moment's state given the finite values up to each moment, and given all;
    and log p of the values: the whole joint Gaussian, conditioned. The definition, and the oracle."""
    mean, cover = [start.mean], torch.zeros(T * N, T * N, dtype=torch.float64)
    cover[:N, :N] = start.covariance
    for t in range(1, T):
        mean.append(move[t - 1] @ mean[-1])
        now, past = slice(t * N, (t + 1) * N), slice(0, t * N)
        last = slice((t - 1) * N, t * N)
        cover[now, past] = move[t - 1] @ cover[last, past]
        cover[past, now] = cover[now, past].mT
        cover[now, now] = move[t - 1] @ cover[last, last] @ move[t - 1].mT + move_noise[t - 1]
    mean = torch.cat(mean)
    sight, spread = torch.block_diag(*[model] * T), torch.block_diag(*noise)
    flat = values.flatten()

    def given(upto):
        seen = (~flat.isnan()) & (torch.arange(T * M) < upto * M)
        rows, y = sight[seen], flat[seen]
        inner = rows @ cover @ rows.mT + spread[seen][:, seen]
        gain = torch.linalg.solve(inner, rows @ cover).mT
        density = (
            multivariate_normal((rows @ mean).numpy(), inner.numpy()).logpdf(y.numpy()) if len(y) else 0.0
        )
        return mean + gain @ (y - rows @ mean), cover - gain @ rows @ cover, float(density)

    def moment(answer, t):
        return answer[0][t * N : (t + 1) * N], answer[1][t * N : (t + 1) * N, t * N : (t + 1) * N]

    past = [given(t + 1) for t in range(T)]
    filtered = [moment(past[t], t) for t in range(T)]
    smoothed = [moment(past[-1], t) for t in range(T)]
    return (
        Gaussian(*(torch.stack(x) for x in zip(*filtered, strict=True))),
        Gaussian(*(torch.stack(x) for x in zip(*smoothed, strict=True))),
        torch.tensor([given(t + 1)[2] - given(t)[2] for t in range(T)], dtype=torch.float64),
    )


def agree(ours, theirs):
    assert_close(ours.mean, theirs.mean)
    assert_close(ours.covariance, theirs.covariance)


@pytest.mark.parametrize("missing", ["none", "single components", "whole moments", "all"])
def test_filter_and_smoother_are_exact_conditioning(missing):
    start, values, move, move_noise, model, noise = system(3)
    if missing == "single components":
        values[torch.rand(T, M) < 0.4] = torch.nan
    elif missing == "whole moments":
        values[[0, 2, 3]] = torch.nan
    elif missing == "all":
        values[:] = torch.nan
    found = kalman_filter(start, values, move, move_noise, model, noise)
    smoothed = kalman_smoother(found.filtered, found.predicted.mean, move, move_noise)
    filtered, whole, log_likelihood = conditioned(start, values, move, move_noise, model, noise)
    agree(found.filtered, filtered)
    agree(smoothed, whole)
    assert_close(found.log_likelihood, log_likelihood)
    assert torch.equal(found.used, ~values.isnan())
    assert not found.rejected.any()


def test_filter_and_smoother_are_filterpys():
    start, values, move, move_noise, model, noise = system(4)
    theirs = filterpy.kalman.KalmanFilter(dim_x=N, dim_z=M)
    theirs.x, theirs.P, theirs.H = start.mean[:, None].numpy(), start.covariance.numpy(), model.numpy()
    means, covers, likelihoods = [], [], []
    for t in range(T):
        if t > 0:
            theirs.predict(F=move[t - 1].numpy(), Q=move_noise[t - 1].numpy())
        theirs.update(values[t, :, None].numpy(), R=noise[t].numpy())
        means.append(theirs.x[:, 0].copy())
        covers.append(theirs.P.copy())
        likelihoods.append(theirs.log_likelihood)
    found = kalman_filter(start, values, move, move_noise, model, noise)
    agree(found.filtered, Gaussian(*(torch.from_numpy(np.stack(x)) for x in (means, covers))))
    assert_close(found.log_likelihood, torch.tensor(likelihoods, dtype=torch.float64))
    # filterpy counts the step into the moment t from t - 1 as its t-th.
    steps = [np.concatenate([np.eye(N)[None], x.numpy()]) for x in (move, move_noise)]
    mean, cover, _, _ = theirs.rts_smoother(np.stack(means)[..., None], np.stack(covers), *steps)
    smoothed = kalman_smoother(found.filtered, found.predicted.mean, move, move_noise)
    agree(smoothed, Gaussian(torch.from_numpy(mean[..., 0]), torch.from_numpy(cover)))


def radar(mean):
    """Distance and direction of a point in the plane, and the Jacobian."""
    x, y = mean[..., 0], mean[..., 1]
    reach = torch.hypot(x, y)
    zero = torch.zeros_like(x)
    rows = [
        torch.stack([x / reach, y / reach, zero, zero], -1),
        torch.stack([-y / reach**2, x / reach**2, zero, zero], -1),
    ]
    return torch.stack([reach, torch.atan2(y, x)], -1), torch.stack(rows, -2)


def test_extended_filter_is_filterpys():
    generator = torch.Generator().manual_seed(5)
    theirs = filterpy.kalman.ExtendedKalmanFilter(dim_x=4, dim_z=2)
    belief = Gaussian(torch.tensor([3.0, 1.0, 0.2, -0.1]).double(), positive(4, 4, generator=generator))
    noise = positive(2, 2, generator=generator) * 0.01
    spread = positive(4, 4, generator=generator) * 0.1
    move = torch.eye(4).double()
    move[0, 2] = move[1, 3] = 0.1
    theirs.x, theirs.P = belief.mean.numpy()[:, None], belief.covariance.numpy()
    theirs.F, theirs.Q, theirs.R = move.numpy(), spread.numpy(), noise.numpy()
    for _ in range(5):
        value = torch.tensor([3.2, 0.3]).double() + 0.05 * torch.randn(2, generator=generator).double()
        theirs.predict()
        theirs.update(
            value.numpy()[:, None],
            HJacobian=lambda x: radar(torch.from_numpy(x[:, 0]))[1].numpy(),
            Hx=lambda x: radar(torch.from_numpy(x[:, 0]))[0].numpy()[:, None],
        )
        belief = kalman_update(kalman_predict(belief, move, spread), value, radar, noise).belief
        agree(belief, Gaussian(torch.from_numpy(theirs.x[:, 0]), torch.from_numpy(theirs.P)))


def test_the_linear_filter_is_a_special_case_of_the_extended_one():
    start, values, move, move_noise, model, noise = system(6)
    other = Gaussian(start.mean, start.covariance)
    by_matrix = kalman_predict(start, move[0], move_noise[0])
    by_function = kalman_predict(other, lambda x: (move[0] @ x, move[0]), move_noise[0])
    agree(by_function, by_matrix)
    one = kalman_update(by_matrix, values[0], model, noise[0])
    two = kalman_update(by_matrix, values[0], lambda x: (model @ x, model), noise[0])
    agree(one.belief, two.belief)


def test_a_batch_is_its_rows_and_broadcasts():
    start, values, move, move_noise, model, noise = system(7, (2, 3))
    values[0, 1, 2] = torch.nan
    found = kalman_filter(start, values, move, move_noise, model, noise)
    smoothed = kalman_smoother(found.filtered, found.predicted.mean, move, move_noise)
    for i, j in np.ndindex(2, 3):
        one = [x[i, j] for x in (values, move, move_noise, model, noise)]
        alone = kalman_filter(Gaussian(start.mean[i, j], start.covariance[i, j]), *one)
        agree(Gaussian(found.filtered.mean[i, j], found.filtered.covariance[i, j]), alone.filtered)
        assert_close(found.log_likelihood[i, j], alone.log_likelihood)
        own = kalman_smoother(alone.filtered, alone.predicted.mean, move[i, j], move_noise[i, j])
        agree(Gaussian(smoothed.mean[i, j], smoothed.covariance[i, j]), own)
    # One belief and many measurements: the likelihood of each pair.
    pairs = kalman_update(
        Gaussian(start.mean[:, :, None], start.covariance[:, :, None]),
        values[0, 0],
        model[0, 0],
        noise[0, 0],
    )
    assert pairs.log_likelihood.shape == (2, 3, T)
    alone = kalman_update(
        Gaussian(start.mean[1, 2], start.covariance[1, 2]), values[0, 0, 4], model[0, 0], noise[0, 0, 4]
    )
    assert_close(pairs.log_likelihood[1, 2, 4], alone.log_likelihood)
    assert_close(pairs.belief.covariance[1, 2, 4], alone.belief.covariance)


def test_gates_are_chi_square_by_block_and_say_what_they_rejected():
    """A 3-D block just inside and just outside of the quantile, beside a block that is always right."""
    belief = Gaussian(torch.zeros(4).double(), torch.diag(torch.tensor([1.0, 2.0, 3.0, 4.0])).double())
    noise, model = 0.5 * torch.eye(4).double(), torch.eye(4).double()
    scale = torch.tensor([1.5, 2.5, 3.5, 4.5]).double().sqrt()
    for missing in (0, 1):
        quantile = chi2(3 - missing).ppf(0.99)
        direction = torch.tensor([0.0 if missing else 2.0, -1.0, 1.0, 0.0]).double()
        for factor, passes in ((0.999, True), (1.001, False)):
            value = factor * math.sqrt(quantile) * direction / direction.norm() * scale
            value[0] = torch.nan if missing else value[0]
            found = kalman_update(belief, value, model, noise, gate=0.01, blocks=(3, 1))
            there = [not missing, True, True]
            assert found.used.tolist() == [t and passes for t in there] + [True]
            assert found.rejected.tolist() == [t and not passes for t in there] + [False]
            assert_close(found.deviation[0].item(), factor**2 * quantile)
            assert kalman_update(belief, value, model, noise).used.tolist() == [*there, True]
            if not passes:  # as if it had not been there
                kept = value.clone()
                kept[:3] = torch.nan
                agree(found.belief, kalman_update(belief, kept, model, noise).belief)
                seen = ~value.isnan()
                density = multivariate_normal(np.zeros(int(seen.sum())), np.diag(scale[seen].square()))
                assert_close(found.log_likelihood.item(), float(density.logpdf(value[seen])))


def test_gates_reject_as_often_as_they_say():
    generator = torch.Generator().manual_seed(8)
    cover, noise = positive(N, N, generator=generator), positive(M, M, generator=generator)
    model = torch.randn(M, N, generator=generator, dtype=torch.float64)
    factor = torch.linalg.cholesky(model @ cover @ model.mT + noise)
    values = torch.randn(20_000, M, generator=generator, dtype=torch.float64) @ factor.mT
    belief = Gaussian(torch.zeros(N).double(), cover)
    share = kalman_update(belief, values, model, noise, gate=0.05).rejected.all(1).double().mean()
    assert 0.045 < share < 0.055  # three standard deviations of 20,000 draws


def test_steps_of_no_time_change_nothing():
    start, *_ = system(9)
    still, none = torch.eye(N).double(), torch.zeros(N, N).double()
    agree(kalman_predict(start, still, none), start)
    values = torch.full((3, M), torch.nan).double()
    values[1] = 0.5
    steps = still.expand(2, N, N), none.expand(2, N, N)
    model, noise = torch.eye(M, N).double(), 0.1 * torch.eye(M).double().expand(3, M, M)
    found = kalman_filter(start, values, *steps, model, noise)
    smoothed = kalman_smoother(found.filtered, found.predicted.mean, *steps)
    for t in range(3):  # three looks at one state
        agree(
            Gaussian(smoothed.mean[t], smoothed.covariance[t]),
            Gaussian(found.filtered.mean[1], found.filtered.covariance[1]),
        )


def test_float32_stays_positive_definite_through_hundreds_of_precise_measurements():
    """Position known to 1 mm after a start of 10 m: the plain form (I - K H) P goes negative here."""
    move = torch.tensor([[1.0, 0.01], [0.0, 1.0]])
    spread = 1e-6 * torch.tensor([[1e-6 / 3, 1e-4 / 2], [1e-4 / 2, 1e-2]])
    belief = Gaussian(torch.zeros(2), 100 * torch.eye(2))
    exact = Gaussian(belief.mean.double(), belief.covariance.double())
    model, noise = torch.tensor([[1.0, 0.0]]), torch.tensor([[1e-6]])
    for step in range(300):
        value = torch.tensor([0.01 * step])
        belief = kalman_update(kalman_predict(belief, move, spread), value, model, noise).belief
        exact = kalman_update(
            kalman_predict(exact, move.double(), spread.double()),
            value.double(),
            model.double(),
            noise.double(),
        ).belief
        assert torch.linalg.eigvalsh(belief.covariance.double()).min() > 0
    assert_close(belief.covariance.double(), exact.covariance, rtol=1e-2, atol=1e-12)


def test_a_bad_row_is_said_and_leaves_the_others_alone():
    start, values, _, _, model, noise = system(10, (3,))
    mean = start.mean.clone()
    mean[1] = torch.nan
    cover, spread = start.covariance.clone(), noise[:, 0].clone()
    cover[2], spread[2] = 0.0, 0.0  # known exactly and measured exactly
    found = kalman_update(Gaussian(mean, cover), values[:, 0], model, spread)
    alone = kalman_update(Gaussian(start.mean[0], start.covariance[0]), values[0, 0], model[0], noise[0, 0])
    agree(Gaussian(found.belief.mean[0], found.belief.covariance[0]), alone.belief)
    assert_close(found.belief.mean[1:], mean[1:], equal_nan=True)
    assert found.rejected.all(1).tolist() == [False, True, True]
    assert found.log_likelihood[1:].tolist() == [-math.inf, -math.inf]


def test_gradients_are_finite_differences():
    start, values, move, move_noise, model, noise = system(11)
    values, noise, move, move_noise = values[:3], noise[:3], move[:2], move_noise[:2]
    values[1, 0] = torch.nan

    def answer(mean, cover, seen, move):
        cover = cover @ cover.mT + torch.eye(N).double()
        seen = torch.where(values.isnan(), torch.nan, seen)
        found = kalman_filter(Gaussian(mean, cover), seen, move, move_noise, model, noise)
        smoothed = kalman_smoother(found.filtered, found.predicted.mean, move, move_noise)
        return found.log_likelihood, smoothed.mean, smoothed.covariance

    inputs = [x.clone().requires_grad_() for x in (start.mean, start.covariance, values.nan_to_num(), move)]
    assert torch.autograd.gradcheck(answer, inputs)


def test_bad_input_is_said():
    start, values, move, move_noise, model, noise = system(12)
    with pytest.raises(
        ValueError, match=r"blocks must be positive and add up to the 3 components, got \(2, 2\)"
    ):
        kalman_update(start, values[0], model, noise[0], blocks=(2, 2))
    with pytest.raises(ValueError, match=r"gate must be a chance in \[0, 1\), got 7.8"):
        kalman_update(start, values[0], model, noise[0], gate=7.8)
    with pytest.raises(ValueError, match="must have 4 columns, one a state, got 3"):
        kalman_update(start, values[0], model[:, :3], noise[0])
    with pytest.raises(ValueError, match="must give 3 components like the measurement, got 2"):
        kalman_update(start, values[0], model[:2], noise[0])
    with pytest.raises(ValueError, match="got 6 measurements, 4 transitions and 5 of their noises"):
        kalman_filter(start, values, move[1:], move_noise, model, noise)
    found = kalman_filter(start, values, move, move_noise, model, noise)
    with pytest.raises(ValueError, match="must be 5 steps between 6 moments, got 4 transitions and 5 noises"):
        kalman_smoother(found.filtered, found.predicted.mean, move[1:], move_noise)
