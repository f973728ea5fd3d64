"""Chains of frames: linear algebra against dense matrices, estimates against filterpy and exact conditioning."""

from dataclasses import replace

import filterpy.kalman
import numpy as np
import pytest
import torch
from torch.testing import assert_close

from torchpose.tracking.chain import Chain, fit_chain, solve_chain

P = 3  # unknowns of a frame


def chain_matrix(blocks, beside):
    """The whole block tridiagonal matrix."""
    T, P = blocks.shape[:2]
    whole = torch.block_diag(*blocks)
    for t in range(T - 1):
        here, there = slice(t * P, (t + 1) * P), slice((t + 1) * P, (t + 2) * P)
        whole[here, there] = whole[there, here] = beside[t].diag()
    return whole


def own_blocks(matrix, P):
    return torch.stack([matrix[i : i + P, i : i + P] for i in range(0, len(matrix), P)])


def random_precisions(T, P, generator, rank=None):
    half = torch.randn(T, P, rank or P + 1, generator=generator, dtype=torch.float64)
    return half @ half.mT


@pytest.mark.parametrize("T", [1, 2, 7])
def test_a_chain_is_solved_as_its_dense_matrix(T):
    generator = torch.Generator().manual_seed(T)
    beside = torch.randn(T - 1, P, generator=generator, dtype=torch.float64)
    around = torch.nn.functional.pad(beside.abs(), (0, 0, 1, 1))
    blocks = random_precisions(T, P, generator) + (around[:-1] + around[1:]).diag_embed()
    right = torch.randn(T, P, generator=generator, dtype=torch.float64)
    whole = chain_matrix(blocks, beside)
    assert torch.linalg.eigvalsh(whole).min() > 0
    x, covariance, left = solve_chain(blocks, beside, right)
    assert_close(x, torch.linalg.solve(whole, right.flatten()).view(T, P))
    several = torch.randn(T, P, 5, generator=generator, dtype=torch.float64)
    columns = solve_chain(blocks, beside, several)[0]
    assert_close(columns, torch.linalg.solve(whole, several.flatten(0, 1)).view(T, P, 5))
    assert_close(covariance, own_blocks(torch.linalg.inv(whole), P))
    for t in range(T):  # the Schur complement: the precision once the frames before are integrated out
        upto = torch.linalg.inv(whole[: (t + 1) * P, : (t + 1) * P])
        assert_close(left[t], torch.linalg.inv(upto[-P:, -P:]))


@pytest.mark.parametrize("linked", [True, False])
def test_gradient_and_blocks_of_a_chain_are_its_loss_derivatives(linked):
    generator = torch.Generator().manual_seed(0)
    pull = torch.rand(3, P, generator=generator, dtype=torch.float64) + 0.5
    link = random_precisions(1, P, generator)[0] * linked
    chain = Chain(pull, torch.randn(P, generator=generator, dtype=torch.float64), link)
    pose = torch.randn(4, P, generator=generator, dtype=torch.float64)
    gradient = torch.autograd.functional.jacobian(chain.loss, pose)
    hessian = torch.autograd.functional.hessian(chain.loss, pose).reshape(4 * P, 4 * P)
    assert_close(chain.gradient(pose), gradient)
    assert_close(chain_matrix(chain.blocks(), -pull), hessian)


def linear(precision, mean):
    """Equations of frames that each measure their pose: 0.5 (x - mean)' precision (x - mean)."""

    def equations(pose):
        gap = pose - mean
        force = (precision @ gap[..., None])[..., 0]
        return 0.5 * (gap * force).sum(1), force, precision

    return equations


def fitted(precision, mean, chain, start=None):
    """Enough steps that a linear problem is solved to rounding."""
    return fit_chain(
        linear(precision, mean), torch.zeros_like(mean) if start is None else start, chain, steps=12
    )


def test_a_linear_chain_is_the_kalman_filter_and_the_smoother_of_rauch_tung_and_striebel():
    """Against filterpy, with observations of rank 2, so that no frame alone knows its pose."""
    T, generator = 7, torch.Generator().manual_seed(3)
    H = torch.randn(T, 2, P, generator=generator, dtype=torch.float64)
    z = 0.3 * torch.randn(T, 2, generator=generator, dtype=torch.float64)
    noise = torch.tensor([0.2, 0.5], dtype=torch.float64)  # variances
    Q = torch.rand(T - 1, P, generator=generator, dtype=torch.float64) * 0.2 + 0.05
    mean = (torch.linalg.pinv(H) @ z[..., None])[..., 0]  # H x = z: the same quadratic in x
    precision = H.mT @ (H / noise[:, None])
    first, spread = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64), random_precisions(1, P, generator)[0]
    chain = Chain(1 / Q, first, torch.linalg.inv(spread))
    pose, covariance, filtered = fitted(precision, mean, chain)

    kalman = filterpy.kalman.KalmanFilter(dim_x=P, dim_z=2)
    kalman.x, kalman.P, kalman.F, kalman.R = (
        first.numpy()[:, None],
        spread.numpy(),
        np.eye(P),
        noise.diag().numpy(),
    )
    xs, Ps = [], []
    for t in range(T):
        if t > 0:
            kalman.predict(Q=Q[t - 1].diag().numpy())
        kalman.update(z[t].numpy()[:, None], H=H[t].numpy())
        xs.append(kalman.x.copy())
        Ps.append(kalman.P.copy())
    # filterpy's smoother takes Qs[k + 1] of the step from k to k + 1.
    Qs = [np.zeros((P, P))] + [q.diag().numpy() for q in Q]
    smooth, smooth_P, _, _ = kalman.rts_smoother(np.array(xs), np.array(Ps), [np.eye(P)] * T, Qs)
    assert_close(pose, torch.from_numpy(smooth[..., 0]), rtol=0, atol=2e-5)  # FLOOR is a precision of 1e-6
    assert_close(covariance, torch.from_numpy(smooth_P), rtol=0, atol=2e-5)
    assert_close(torch.linalg.inv(filtered), torch.from_numpy(np.array(Ps)), rtol=0, atol=2e-5)


def test_a_linear_chain_is_exact_conditioning_of_one_big_gaussian():
    """Prior covariance of a random walk written entry by entry, conditioned on all measurements at once."""
    T, generator = 5, torch.Generator().manual_seed(4)
    steps = torch.rand(T - 1, P, generator=generator, dtype=torch.float64) + 0.1  # variances
    start_sd = 0.7
    prior = torch.zeros(T, P, T, P, dtype=torch.float64)
    for t in range(T):
        for s in range(T):
            for p in range(P):
                prior[t, p, s, p] = start_sd**2 + steps[: min(t, s), p].sum()
    prior = prior.reshape(T * P, T * P)
    noise = random_precisions(T, P, generator)
    mean = 0.4 * torch.randn(T, P, generator=generator, dtype=torch.float64)
    gain = prior @ torch.linalg.inv(prior + torch.block_diag(*torch.linalg.inv(noise)))
    link = torch.eye(P, dtype=torch.float64) / start_sd**2
    pose, covariance, _ = fitted(noise, mean, Chain(1 / steps, torch.zeros(P, dtype=torch.float64), link))
    assert_close(pose.flatten(), gain @ mean.flatten(), rtol=0, atol=1e-5)
    assert_close(covariance, own_blocks(prior - gain @ prior, P), rtol=0, atol=1e-5)


def test_unseen_frames_lie_between_their_neighbours_and_less_surely_the_farther_these_are():
    """A Brownian bridge: over n steps of variance q, after k of them, the variance is q k (n - k) / n."""
    T, q = 9, 0.04
    precision = torch.zeros(T, P, P, dtype=torch.float64)
    precision[[0, -1]] = 1e8 * torch.eye(P, dtype=torch.float64)
    mean = torch.zeros(T, P, dtype=torch.float64)
    mean[-1] = torch.tensor([0.4, -0.2, 0.0])
    chain = Chain(
        torch.full((T - 1, P), 1 / q, dtype=torch.float64), mean[0], torch.zeros(P, P, dtype=torch.float64)
    )
    pose, covariance, _ = fitted(precision, mean, chain)
    k = torch.arange(T, dtype=torch.float64)
    assert_close(pose, k[:, None] / (T - 1) * mean[-1], rtol=0, atol=1e-5)
    bridge = q * k * (T - 1 - k) / (T - 1)
    assert_close(covariance, bridge[:, None, None] * torch.eye(P, dtype=torch.float64), rtol=0, atol=1e-5)
    # Beyond the last frame that saw it, a pose stays, and its variance grows by q a step.
    precision[-1] = 0
    pose, covariance, _ = fitted(precision, mean, chain)
    assert_close(pose, torch.zeros_like(pose), rtol=0, atol=1e-5)
    assert_close(covariance[:, 0, 0], q * k, rtol=0, atol=1e-5)


def random_problem(T, generator, pull=20.0):
    """Frames that measure their poses, of rank 2, tied to each other."""
    precision = 10 * random_precisions(T, P, generator, rank=2)
    mean = 0.3 * torch.randn(T, P, generator=generator, dtype=torch.float64)
    nothing = torch.zeros(P, P, dtype=torch.float64)
    return precision, mean, Chain(torch.full((T - 1, P), pull, dtype=torch.float64), mean[0] * 0, nothing)


def message_chain(chain, frame, pose, filtered):
    """The chain of the frames after one, from the message that this one sends on."""
    link = torch.linalg.inv(torch.linalg.inv(filtered[frame]) + torch.linalg.inv(chain.pull[frame].diag()))
    return Chain(chain.pull[frame + 1 :], pose[frame], link)


def test_stretches_are_the_whole_where_the_later_frames_say_nothing():
    precision, mean, chain = random_problem(8, torch.Generator().manual_seed(5))
    precision[4:] = 0
    whole, whole_covariance, _ = fitted(precision, mean, chain)
    head, _, filtered = fitted(precision[:4], mean[:4], replace(chain, pull=chain.pull[:3]))
    tail, covariance, _ = fitted(precision[4:], mean[4:], message_chain(chain, 3, head, filtered))
    assert_close(torch.cat([head, tail]), whole, rtol=0, atol=1e-4)
    assert_close(covariance, whole_covariance[4:], rtol=1e-4, atol=1e-4)


def test_stretches_that_hear_of_coming_frames_are_near_the_whole():
    """Frames 0 to 9 with 6 more in view, then 10 to 19: the six are heard twice, which stays within a pose's doubt."""
    for seed in range(5):
        precision, mean, chain = random_problem(20, torch.Generator().manual_seed(seed))
        whole, whole_covariance, _ = fitted(precision, mean, chain)
        head, covariance, filtered = fitted(precision[:16], mean[:16], replace(chain, pull=chain.pull[:15]))
        tail, later, _ = fitted(precision[10:], mean[10:], message_chain(chain, 9, head, filtered))
        sd = whole_covariance.diagonal(dim1=1, dim2=2).sqrt()
        # What the first stretch does not see is more than six frames off.
        assert ((head[:10] - whole[:10]).abs() / sd[:10]).max() < 0.15
        assert ((tail - whole[10:]).abs() / sd[10:]).max() < 0.35
        assert ((tail[4:] - whole[14:]).abs() / sd[14:]).max() < 0.05
        # Covariances depend on no mean, and the message's precision has heard of no coming frame: exact.
        assert_close(later, whole_covariance[10:], rtol=0, atol=1e-5)
        assert_close(covariance[:10], whole_covariance[:10], rtol=0.05, atol=1e-4)


def test_a_frame_that_is_not_finite_says_nothing():
    precision, mean, chain = random_problem(5, torch.Generator().manual_seed(6))
    spoiled = mean.clone()
    spoiled[2] = torch.nan
    silent = precision.clone()
    silent[2] = 0
    for got, want in zip(
        fitted(precision, spoiled, chain, mean * 0), fitted(silent, mean, chain), strict=True
    ):
        assert_close(got, want)


def test_a_step_that_ends_in_nothing_is_not_taken():
    """Where the equations break down on the way, the pose stays where they hold, and no frame wins by breaking."""

    def equations(pose):
        loss = torch.where(pose[:, 0].abs() < 0.1, (pose - 1).square().sum(1), torch.nan)
        return 0.5 * loss, pose - 1, torch.eye(P, dtype=pose.dtype).expand(len(pose), P, P)

    start = torch.zeros(2, P, dtype=torch.float64)
    chain = Chain(torch.ones(1, P, dtype=torch.float64), start[0], torch.zeros(P, P, dtype=torch.float64))
    pose, covariance, _ = fit_chain(equations, start, chain, 3)
    assert (pose[:, 0].abs() < 0.1).all()
    assert pose.isfinite().all()
    assert covariance.isfinite().all()
