"""The M-step: Jacobians three ways, known poses from exact rows, limits, and broken problems in a batch."""

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from torchpose.body.model import BodyConfig, BodyModel, JointKind
from torchpose.least_squares import LMConfig, Status, linearize_by_autograd
from torchpose.registration.fitting import (
    FittingConfig,
    JacobianKind,
    PosePrior,
    Rows,
    fit_pose,
    linearize_by_screws,
    pose_residual,
)

JOINTS = list(JointKind)
ROW_FIELDS = ("part", "local", "target", "direction")
PATIENT = FittingConfig(lm=LMConfig(max_steps=60), limit_sd=0.0)


def body_of(kind=JointKind.swing, dtype=torch.float64):
    """A body whose constants, stored in single precision, are exact rotations and unit axes in `dtype`."""
    body = BodyModel(BodyConfig(joint=kind)).to(dtype)
    U, _, Vh = torch.linalg.svd(body.align)
    body.align, body.axes = U @ Vh, torch.nn.functional.normalize(body.axes, dim=-1)
    return body


def random_pose(body, batch=2, spread=0.5, generator=None):
    pose = spread * torch.randn(batch, body.num_parameters, generator=generator).to(body.axes)
    pose[:, 2] += 3.0
    return pose


def random_size(body):
    return 1 + 0.1 * torch.randn(1, len(body.size_names)).to(body.axes)


def rows_of(body, pose, size, per_part=6, noise=0.0):
    """Rows with unit directions at random points of every part, whose targets are where `pose` has them."""
    posed = body(pose, size)
    B, K = posed.centers.shape[:2]
    part = torch.arange(K).repeat_interleave(per_part).expand(B, -1)
    local = 0.1 * torch.randn(B, K * per_part, 3).to(pose)
    direction = torch.nn.functional.normalize(torch.randn(B, K * per_part, 3).to(pose), dim=-1)
    rows = Rows(part, local, torch.zeros_like(local), direction)
    target = rows.points(posed)
    return replace(rows, target=target + noise * torch.randn_like(target))


def no_prior(pose):
    return PosePrior(pose, torch.zeros_like(pose))


def largest(difference):
    return float(difference.abs().max())


@pytest.mark.parametrize("kind", JOINTS, ids=lambda kind: kind.name)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-10)], ids=str)
def test_the_closed_form_jacobian_is_autograds(kind, dtype, tolerance):
    body = body_of(kind, dtype)
    pose, size = random_pose(body, spread=1.0), random_size(body)  # many joints are beyond their limits
    assert ((pose < body.low) | (pose > body.high)).any()
    assert ((pose > body.low) & (pose < body.high))[:, 6:].any()
    rows = rows_of(body, random_pose(body), size)
    prior = PosePrior(torch.zeros_like(pose), torch.rand_like(pose) + 0.1)
    config = FittingConfig(limit_sd=0.5)
    r, J = linearize_by_screws(body, size, rows, prior, config)(pose)
    reference_r, reference_J = linearize_by_autograd(pose_residual(body, size, rows, prior, config))(pose)
    scale = reference_J.abs().max()
    assert largest(r - reference_r) < tolerance * scale
    assert largest(J - reference_J) < tolerance * scale
    assert r.shape == (2, 14 * 6 + 24 + 24)


@pytest.mark.parametrize("kind", JOINTS, ids=lambda kind: kind.name)
def test_the_closed_form_jacobian_is_that_of_finite_differences(kind):
    body = body_of(kind)
    pose, size = random_pose(body, spread=1.0), random_size(body)
    rows, prior = rows_of(body, random_pose(body), size), PosePrior(pose * 0, torch.ones_like(pose))
    config = FittingConfig(limit_sd=0.3)
    residual = pose_residual(body, size, rows, prior, config)
    step = 1e-6 * torch.eye(24, dtype=pose.dtype)
    slope = torch.stack([(residual(pose + d) - residual(pose - d)) / 2e-6 for d in step], -1)
    _, J = linearize_by_screws(body, size, rows, prior, config)(pose)
    assert largest(J - slope) < 1e-7


def test_residuals_by_hand():
    """A target 3 cm off counts 3 along a direction with 1 cm of standard deviation, and 0 across."""
    body = body_of()
    pose = random_pose(body, 1)
    rows = rows_of(body, pose, body.default_size(1), per_part=1)
    x = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    across = torch.tensor([0.0, 100.0, 0.0], dtype=torch.float64)
    direction = torch.where(torch.arange(14)[:, None] % 2 == 0, 100 * x, across)[None]
    rows = replace(rows, target=rows.target + 0.03 * x, direction=direction)
    prior = PosePrior(pose - 0.1, torch.full_like(pose, 25.0))
    low, high = pose.clone()[0], pose.clone()[0]
    low[6:], high[6:] = low[6:] - 1, high[6:] - 0.02  # rad beyond the upper limit
    low[:6], high[:6] = -torch.inf, torch.inf
    low[8], high[8] = pose[0, 8] + 0.04, pose[0, 8] + 1  # and one below the lower
    body.low, body.high = low, high
    residual = pose_residual(body, body.default_size(1), rows, prior, FittingConfig(limit_sd=0.01))(pose)[0]
    assert_close(residual[:14], torch.tensor([3.0, 0.0] * 7, dtype=torch.float64))
    assert_close(residual[14:38], torch.full((24,), 0.5, dtype=torch.float64))  # 5 x 0.1
    beyond = torch.full((24,), 2.0, dtype=torch.float64)
    beyond[:6], beyond[8] = 0, -4
    assert_close(residual[38:], beyond)


@pytest.mark.parametrize("jacobian", list(JacobianKind), ids=lambda kind: kind.name)
@pytest.mark.parametrize("kind", JOINTS, ids=lambda kind: kind.name)
def test_exact_rows_give_back_the_pose(kind, jacobian):
    body = body_of(kind)
    truth, size = random_pose(body, 2, 0.4), random_size(body)
    rows = rows_of(body, truth, size)
    start = truth + 0.2 * torch.randn_like(truth)  # 11 degrees in every joint
    config = replace(PATIENT, jacobian=jacobian, lm=LMConfig(max_steps=20))
    solution = fit_pose(body, start, size, rows, no_prior(start), config)
    assert largest(solution.value - truth) < 1e-6
    assert (solution.loss < 1e-12).all()


def test_a_prior_alone_gives_its_mean_and_weighs_by_its_precision():
    body = body_of()
    start, mean = random_pose(body), random_pose(body)
    rows = rows_of(body, start, body.default_size(1))
    silent = replace(rows, direction=torch.zeros_like(rows.direction))
    solution = fit_pose(body, start, body.default_size(1), silent, PosePrior(mean, mean * 0 + 4), PATIENT)
    assert largest(solution.value - mean) < 1e-6
    # A row for x at its target, 1 / sd^2 = 1, against a prior of precision 4 from 0.3 m away: 4 / 5 of it.
    one = Rows(
        torch.zeros(1, 1, dtype=torch.long),
        torch.zeros(1, 1, 3, dtype=torch.float64),
        body(start[:1]).centers[:, :1],
        torch.tensor([[[1.0, 0.0, 0.0]]], dtype=torch.float64),
    )
    precision = torch.full_like(start[:1], 1e9)
    precision[0, 0] = 4
    mean = start[:1].clone()
    mean[0, 0] += 0.3
    moved = fit_pose(body, start[:1], body.default_size(1), one, PosePrior(mean, precision), PATIENT)
    assert_close(moved.value[0, 0], start[0, 0] + 0.24)


@pytest.mark.parametrize("kind", JOINTS, ids=lambda kind: kind.name)
def test_a_pose_far_beyond_its_limits_comes_back(kind):
    body = body_of(kind)
    inside = ((body.low + body.high) / 2)[6:]
    start = torch.zeros(2, 24, dtype=torch.float64)
    start[:, 6:] = inside
    start[0, 6:] += 6.0
    start[1, 6:] -= 6.0
    rows = rows_of(body, start, body.default_size(1))
    silent = replace(rows, direction=torch.zeros_like(rows.direction))
    config = FittingConfig(lm=LMConfig(max_steps=60))
    value = fit_pose(body, start, body.default_size(1), silent, no_prior(start), config).value
    assert (value[:, 6:] < body.high[6:] + 1e-6).all()
    assert (value[:, 6:] > body.low[6:] - 1e-6).all()
    without = fit_pose(body, start, body.default_size(1), silent, no_prior(start), PATIENT).value
    assert torch.equal(without, start)


def test_within_the_limits_they_say_nothing():
    body = body_of()
    truth = torch.zeros(1, 24, dtype=torch.float64)
    truth[:, 6:] = ((body.low + body.high) / 2)[6:]
    rows = rows_of(body, truth, body.default_size(1), noise=0.01)
    both = [
        fit_pose(
            body, truth, body.default_size(1), rows, no_prior(truth), replace(PATIENT, limit_sd=sd)
        ).value
        for sd in (0.0, 0.05)
    ]
    assert torch.equal(*both)


@pytest.mark.parametrize("where", ["start", "target"])
def test_a_broken_row_of_the_batch_leaves_the_others_alone(where):
    body = body_of(dtype=torch.float32)
    truth, size = random_pose(body, 4, 0.4), body.default_size(1)
    rows = rows_of(body, truth, size, noise=0.01)
    start = truth + 0.1 * torch.randn_like(truth)
    config = FittingConfig(lm=LMConfig(max_steps=5))
    whole = fit_pose(body, start, size, rows, no_prior(truth), config)
    broken_start, target = start.clone(), rows.target.clone()
    if where == "start":
        broken_start[1, 9] = torch.nan
    else:
        target[1, 3] = torch.nan
    broken = fit_pose(body, broken_start, size, replace(rows, target=target), no_prior(truth), config)
    others = [0, 2, 3]
    assert torch.equal(broken.value[others], whole.value[others])  # to the bit
    assert broken.status[1] == Status.NON_FINITE
    assert (broken.status[others] != Status.NON_FINITE).all()
    assert_close(broken.value[1], broken_start[1], rtol=0, atol=0, equal_nan=True)


def test_a_batch_equals_one_by_one():
    body = body_of()
    truth, size = random_pose(body, 3, 0.4), body.default_size(1)
    rows, start = rows_of(body, truth, size, noise=0.01), truth + 0.1 * torch.randn_like(truth)
    prior = PosePrior(truth, torch.rand_like(truth))
    config = FittingConfig(lm=LMConfig(max_steps=8))
    batch = fit_pose(body, start, size, rows, prior, config).value
    for i in range(3):
        own = Rows(*(getattr(rows, name)[i : i + 1] for name in ROW_FIELDS))
        alone = PosePrior(prior.mean[i : i + 1], prior.precision[i : i + 1])
        assert_close(
            batch[i : i + 1],
            fit_pose(body, start[i : i + 1], size, own, alone, config).value,
            rtol=0,
            atol=1e-9,
        )


CONVERGED = LMConfig(max_steps=200, step_tolerance=1e-12, loss_tolerance=0.0)


def noisy_problem(batch=2):
    """Rows 3 cm off: the residuals' own curvature counts, so J^T J is not the Hessian. Some limits are broken."""
    body = body_of()
    truth, size = random_pose(body, batch, 0.4), random_size(body)
    rows = rows_of(body, truth, size, per_part=4, noise=0.03)
    rows = replace(rows, direction=20 * rows.direction)
    prior = PosePrior(truth + 0.05 * torch.randn_like(truth), 20 + 20 * torch.rand_like(truth))
    return body, truth + 0.05 * torch.randn_like(truth), size, rows, prior


def answer(body, start, config, part, *inputs):
    local, target, direction, size, mean, precision = inputs
    return fit_pose(
        body, start, size, Rows(part, local, target, direction), PosePrior(mean, precision), config
    )


def inputs_of(rows, size, prior):
    tensors = (rows.local, rows.target, rows.direction, size, prior.mean, prior.precision)
    return [x.detach().clone().requires_grad_() for x in tensors]


def test_the_answer_is_differentiable_in_all_that_it_rests_on():
    """gradcheck: central differences of whole fits, from the start to the minimum. The fit's own rounding, 1e-8 rad,
    is what limits them."""
    body, start, size, rows, prior = noisy_problem()
    config = FittingConfig(lm=CONVERGED, limit_sd=0.2)
    solution = fit_pose(body, start, size, rows, prior, config)
    assert ((solution.value < body.low) | (solution.value > body.high)).any()
    inputs = inputs_of(rows, size, prior)

    def value(*inputs):
        return answer(body, start, config, rows.part, *inputs).value

    assert torch.equal(value(*inputs), solution.value)
    assert torch.autograd.gradcheck(
        value, inputs, eps=3e-5, atol=2e-3, rtol=2e-3, fast_mode=True, nondet_tol=1e-12
    )
    # Each input alone, along a random direction.
    gradient = torch.autograd.grad(value(*inputs).sum(), inputs)
    for i, (x, slope) in enumerate(zip(inputs, gradient, strict=True)):
        way = torch.randn_like(x)
        both = []
        for h in (1e-4, -1e-4):  # a larger step meets the edge of a limit
            moved = [y.detach() + h * way if i == j else y.detach() for j, y in enumerate(inputs)]
            both.append(value(*moved).sum())
        assert float((both[0] - both[1]) / 2e-4) == pytest.approx(
            float((slope * way).sum()), rel=2e-3, abs=1e-4
        )


def test_no_gradient_asked_for_means_no_graph():
    body, start, size, rows, prior = noisy_problem()
    inputs = inputs_of(rows, size, prior)
    asked = answer(body, start, PATIENT, rows.part, *inputs)
    with torch.no_grad():
        silent = answer(body, start, PATIENT, rows.part, *inputs)
    assert asked.value.requires_grad
    assert not silent.value.requires_grad
    assert not fit_pose(body, start.requires_grad_(), size, rows, prior, PATIENT).value.grad_fn
    assert torch.equal(asked.value, silent.value)


def test_a_broken_row_has_no_gradient_and_leaves_the_others_theirs():
    body, start, size, rows, prior = noisy_problem(3)
    size = size.expand(3, -1)
    config = FittingConfig(lm=LMConfig(max_steps=3))  # out of steps
    whole = inputs_of(rows, size, prior)
    answer(body, start, config, rows.part, *whole).value.sum().backward()
    for index, entry in (
        (0, (1, 3, 0)),
        (1, (1, 3, 1)),
        (2, (1, 5, 2)),
        (3, (1, 4)),
        (4, (1, 9)),
        (5, (1, 9)),
    ):
        broken = inputs_of(rows, size, prior)
        with torch.no_grad():
            broken[index][entry] = torch.nan
        solution = answer(body, start, config, rows.part, *broken)
        assert solution.status.tolist() == [Status.MAX_STEPS, Status.NON_FINITE, Status.MAX_STEPS]
        solution.value.sum().backward()
        for mine, theirs in zip(broken, whole, strict=True):
            assert (mine.grad[1] == 0).all()
            assert mine.grad[[0, 2]].any()
            assert_close(mine.grad[[0, 2]], theirs.grad[[0, 2]], atol=1e-12, rtol=1e-9)


def test_a_prior_that_says_nothing_has_a_finite_gradient():
    """Precision 0, whose root has no derivative: some parameters' or all."""
    body, start, size, rows, prior = noisy_problem()
    for last in (6, 24):
        precision = prior.precision.clone()
        precision[:, :last] = 0
        inputs = inputs_of(rows, size, PosePrior(prior.mean, precision))
        config = FittingConfig(lm=CONVERGED)
        answer(body, start, config, rows.part, *inputs).value.sum().backward()
        assert all(x.grad.isfinite().all() for x in inputs)
        assert inputs[1].grad.any()
        assert (inputs[4].grad[:, :last] == 0).all()


def test_rows_join_in_order():
    body = body_of()
    pose = random_pose(body)
    first, second = rows_of(body, pose, body.default_size(1)), rows_of(body, pose, body.default_size(1), 2)
    joined = Rows.cat(first, second)
    assert torch.equal(joined.target[:, 84:], second.target)
    assert torch.equal(joined.part[:, :84], first.part)


def test_bad_settings_are_told():
    with pytest.raises(ValueError, match=r"limit_sd must not be negative, got -0\.1; 0 switches"):
        FittingConfig(limit_sd=-0.1)
