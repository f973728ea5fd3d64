"""Sums over a part's rows against the rows themselves: by definition, by autograd, in single precision, in a batch."""

from dataclasses import replace

import pytest
import torch
from test_fitting import JOINTS, ROW_FIELDS, body_of, random_pose, random_size, rows_of
from torch.testing import assert_close

from torchpose.registration import moment
from torchpose.registration.fitting import (
    FittingConfig,
    PosePrior,
    Rows,
    equations_by_moments,
    linearize_by_screws,
    pose_residual,
)
from torchpose.registration.moment import MomentEquations, sum_rows

each_kind = pytest.mark.parametrize("kind", JOINTS, ids=lambda kind: kind.name)


def residual_of(rows, posed):
    return (rows.direction * (rows.target - rows.points(posed))).sum(-1)


def sums_of(rows, posed):
    return sum_rows(rows.part, rows.local, rows.direction, residual_of(rows, posed), posed)


def scene(kind=JOINTS[0], batch=2, per_part=6, dtype=torch.float64):
    """A body, a pose far from where its rows have it, and rows 5 mm off with a standard deviation of 2 cm."""
    body = body_of(kind, dtype)
    truth, size = random_pose(body, batch), random_size(body)
    rows = rows_of(body, truth, size, per_part=per_part, noise=0.005)
    return body, truth, size, replace(rows, direction=rows.direction / 0.02)


def test_a_sum_is_that_of_every_rows_products():
    """By definition, row by row and part by part; the parts' rows come mixed, and part 3 has none."""
    body, truth, size, rows = scene()
    order = torch.randperm(rows.part.shape[1])
    rows = Rows(*(getattr(rows, name)[:, order] for name in ROW_FIELDS))
    rows = replace(rows, part=torch.where(rows.part == 3, 5, rows.part))
    posed = body(truth + 0.2, size)
    moments = sums_of(rows, posed)
    expected = torch.zeros(2, 14, 13, 13, dtype=torch.float64)
    for b in range(2):
        for i in range(rows.part.shape[1]):
            k, n, h = rows.part[b, i], rows.direction[b, i], torch.cat([rows.local[b, i], torch.ones(1)])
            gap = n @ (rows.target[b, i] - posed.frames[b, k] @ rows.local[b, i] - posed.centers[b, k])
            a = torch.cat([torch.outer(n, h).flatten(), gap[None]])
            expected[b, k] += torch.outer(a, a)
    assert_close(moments.matrix, expected, atol=1e-9, rtol=1e-12)
    assert (moments.matrix[:, 3] == 0).all()
    assert_close(moments.frames[..., :3], posed.frames)
    assert_close(moments.frames[..., 3] + moments.pivot, posed.centers)


@each_kind
def test_the_equations_are_those_of_the_rows_at_any_pose(kind):
    """Summed at one pose and asked for at another, against the rows' own Jacobian and against autograd's."""
    body, truth, size, rows = scene(kind)
    pose = truth + 0.5 * torch.randn_like(truth)
    whole = MomentEquations(sums_of(rows, body(truth - 0.3, size)), body.part_moves)(body(pose, size))
    nothing, config = PosePrior(pose, torch.zeros_like(pose)), FittingConfig(limit_sd=0.0)
    r, J = (x[:, : rows.part.shape[1]] for x in linearize_by_screws(body, size, rows, nothing, config)(pose))
    both = torch.cat([J, r[..., None]], 2)
    assert_close(whole, both.mT @ both, atol=1e-9 * float(whole.abs().max()), rtol=0)
    reference = torch.stack(
        [
            torch.func.jacrev(lambda x, b=b: residual_of(row(rows, b), body(x[None], size))[0])(pose[b])
            for b in range(len(pose))
        ]
    )
    assert_close(whole[:, :-1, :-1], reference.mT @ reference, atol=1e-9 * float(whole.abs().max()), rtol=0)


@each_kind
def test_a_shift_of_a_parts_points_drives_the_pose_as_autograd_says(kind):
    """J^T N against autograd's J and N, N by moving the points of each part in the part's own frame."""
    body, truth, size, rows = scene(kind)
    pose = truth + 0.3 * torch.randn_like(truth)
    equations = MomentEquations(sums_of(rows, body(truth - 0.3, size)), body.part_moves)
    found = equations.by_offset(body(pose, size))
    assert found.shape == (2, body.num_parameters, 3 * body.num_parts)
    for b in range(2):
        one = row(rows, b)

        def residual(x, shift, one=one):
            moved = replace(one, local=one.local + shift.view(-1, 3)[one.part])
            return residual_of(moved, body(x[None], size))[0]

        nothing = torch.zeros(3 * body.num_parts, dtype=torch.float64)
        J, N = torch.func.jacrev(residual, (0, 1))(pose[b], nothing)
        assert_close(found[b], J.mT @ N, atol=1e-9 * float(found.abs().max()), rtol=0)


def test_the_extent_of_rows_is_1_of_an_even_spread_and_less_of_a_piece():
    """From -1 to 1 the variance is 1/3; of a piece a quarter as long it is a sixteenth of that, wherever it lies."""
    body = body_of()
    pose, size = random_pose(body, 1), random_size(body)
    posed = body(pose, size)
    along = torch.linspace(-1, 1, 2001, dtype=torch.float64)
    places = torch.stack([along, along / 4, along / 4 - 0.7])
    local = torch.zeros(3, 2001, 3, dtype=torch.float64)
    local[..., 2] = places * posed.radii[0, [2, 6, 9], 2:]
    part = torch.tensor([2, 6, 9]).repeat_interleave(2001)[None]
    direction = 30 * torch.nn.functional.normalize(torch.randn(1, 6003, 3, dtype=torch.float64), dim=-1)
    rows = Rows(part, local.view(1, -1, 3), torch.zeros(1, 6003, 3, dtype=torch.float64), direction)
    extent = MomentEquations(sums_of(rows, posed), body.part_moves).extent(posed)[0]
    assert_close(extent[[2, 6, 9]], torch.tensor([1, 1 / 16, 1 / 16], dtype=torch.float64), rtol=3e-3, atol=0)
    assert (extent[[0, 1, 3, 4, 5, 7, 8, 10, 11, 12, 13]] == 0).all()


def test_the_reach_of_rows_is_1_where_all_of_a_part_shows_and_little_near_its_joint():
    """Mean squares of the distances from the joint along the part, weighed by the directions' squares, by hand."""
    body = body_of()
    pose, size = random_pose(body, 1), random_size(body)
    posed = body(pose, size)
    half = posed.radii[0, :, 2]
    joints = posed.origins[:, body.carriers[: body.num_parts]]
    start = ((joints - posed.centers)[0, :, None] @ posed.frames[0])[:, 0, 2]  # of each part's own axis
    away = half.double() * torch.sign(-start)  # which end is the far one
    places = torch.stack(
        [
            torch.linspace(-1, 1, 2001, dtype=torch.float64) * half[2],
            start[9] + torch.linspace(0, 0.3, 2001, dtype=torch.float64) * away[9],
            start[6] + torch.linspace(1, 2, 2001, dtype=torch.float64) * away[6],
        ]
    )
    local = torch.zeros(3, 2001, 3, dtype=torch.float64)
    local[..., 2] = places
    part = torch.tensor([2, 9, 6]).repeat_interleave(2001)[None]
    direction = torch.randn(1, 6003, 3, dtype=torch.float64)
    rows = Rows(part, local.view(1, -1, 3), torch.zeros(1, 6003, 3, dtype=torch.float64), direction)
    weight = direction[0].square().sum(1).view(3, -1)
    from_joint = (places - start[[2, 9, 6]][:, None]).square()
    mean = (weight * from_joint).sum(1) / weight.sum(1)
    expected = mean / (start[[2, 9, 6]].square() + half[[2, 9, 6]].square() / 3)
    reach = MomentEquations(sums_of(rows, posed), body.part_moves).reach(posed, joints)[0]
    assert_close(reach[[2, 9, 6]], expected.clamp_max(1), rtol=1e-9, atol=0)
    assert abs(float(reach[2]) - 1) < 0.05
    assert reach[9] < 0.1
    assert reach[6] == 1
    assert (reach[[0, 1, 3, 4, 5, 7, 8, 10, 11, 12, 13]] == 0).all()


@each_kind
def test_weights_of_parts_are_those_of_their_rows_squares(kind):
    body, truth, size, rows = scene(kind)
    posed = body(truth, size)
    weight = torch.rand(2, body.num_parts, dtype=torch.float64)
    found = MomentEquations(sums_of(rows, posed), body.part_moves).weighted(weight)(posed)
    scaled = replace(rows, direction=rows.direction * weight.gather(1, rows.part)[..., None].sqrt())
    expected = MomentEquations(sums_of(scaled, posed), body.part_moves)(posed)
    assert_close(found, expected, rtol=1e-9, atol=1e-9 * float(expected.abs().max()))


def row(rows, b):
    return Rows(*(getattr(rows, name)[b : b + 1] for name in ROW_FIELDS))


@each_kind
def test_loss_and_gradient_with_prior_and_limits_are_those_of_the_residuals(kind):
    body, truth, size, rows = scene(kind)
    pose = truth + 0.7 * torch.randn_like(truth)
    assert ((pose < body.low) | (pose > body.high)).any()
    precision = torch.rand_like(pose) * 30
    precision[:, 4] = 0
    prior, config = PosePrior(truth, precision), FittingConfig(limit_sd=0.2)
    equations = equations_by_moments(body, size, rows, prior, config, body(truth, size))
    loss, gradient, normal = equations(pose)
    residual = pose_residual(body, size, rows, prior, config)
    assert_close(loss, 0.5 * (residual(pose) ** 2).sum(1), atol=0, rtol=1e-11)
    assert_close(equations.loss(pose, body(pose, size)), loss, atol=0, rtol=1e-11)
    step = 1e-6 * torch.eye(24, dtype=pose.dtype)
    slope = torch.stack([(residual(pose + d) ** 2 - residual(pose - d) ** 2).sum(1) / 4e-6 for d in step], -1)
    assert_close(gradient, slope, atol=1e-7 * float(slope.abs().max()), rtol=0)
    _, J = linearize_by_screws(body, size, rows, prior, config)(pose)
    assert_close(normal, J.mT @ J, atol=1e-10 * float(normal.abs().max()), rtol=0)


@pytest.mark.parametrize("degrees", [0, 3, 20])
def test_single_precision(degrees):
    """Residuals of 5 mm, 3 m away, with the sums made so far off: exact there, and nearly so at the answer."""
    body, truth, size, rows = scene(per_part=60)
    start = truth + torch.deg2rad(torch.tensor(degrees)) * torch.randn_like(truth).sign()
    single = body_of(JOINTS[0], torch.float32)
    few = Rows(rows.part, rows.local.float(), rows.target.float(), rows.direction.float())
    sums = sums_of(few, single(start.float(), size.float()))
    for pose, loss_off, gradient_off in ((start, 3e-6, 5e-5), (truth, 1e-3, 2e-4)):
        exact = MomentEquations(sums_of(rows, body(start, size)), body.part_moves)(body(pose, size))
        ours = MomentEquations(sums, single.part_moves)(single(pose.float(), size.float())).double()
        assert_close(ours[:, -1, -1], exact[:, -1, -1], atol=0, rtol=loss_off)
        assert_close(ours[:, :-1, :-1], exact[:, :-1, :-1], atol=1e-6 * float(exact.abs().max()), rtol=0)
        # What rounding of the gradient is worth: sqrt of the diagonal times sqrt of the loss is its greatest.
        size_of = (exact.diagonal(dim1=1, dim2=2)[:, :-1] * exact[:, -1:, -1]).sqrt()
        assert ((ours - exact)[:, :-1, -1].abs() / size_of).max() < gradient_off


def test_a_loss_of_nothing_is_not_negative_in_single_precision():
    """Sums made 10 degrees off cancel at the answer of exact rows; rounding would take half of them below 0."""
    body = body_of(dtype=torch.float32)
    truth, size = random_pose(body, 32), body.default_size(1)
    rows = rows_of(body, truth, size)
    start = truth + 0.2 * torch.randn_like(truth)
    silent = PosePrior(truth, torch.zeros_like(truth))
    equations = equations_by_moments(body, size, rows, silent, FittingConfig(limit_sd=0.0), body(start, size))
    for loss in (equations(truth)[0], equations.loss(truth, body(truth, size))):
        assert (loss >= 0).all()
        assert (loss < 1e-5 * equations(start)[0]).all()


def test_a_batch_in_chunks_equals_one_by_one(monkeypatch):
    body, truth, size, rows = scene(batch=5)
    posed = body(truth + 0.1, size)
    whole = sums_of(rows, posed).matrix
    monkeypatch.setattr(moment, "CHUNK", 2 * rows.part.shape[1])
    assert_close(sums_of(rows, posed).matrix, whole, atol=1e-9, rtol=1e-12)
    for b in range(5):
        alone = sums_of(row(rows, b), body(truth[b : b + 1] + 0.1, size))
        assert_close(alone.matrix[0], whole[b], atol=1e-9, rtol=1e-12)


def test_points_with_three_directions_equal_as_many_rows():
    """Residuals, sums and equations; the points with three directions come first, then others."""
    body, truth, size, rows = scene(per_part=4)
    posed = body(truth + 0.1, size)
    T = 20
    parts = [getattr(rows, name) for name in ROW_FIELDS[:3]]
    threefold = [torch.cat([x[:, :T].repeat(1, 3, *[1] * (x.ndim - 2)), x[:, T:]], 1) for x in parts]
    direction = 50 * torch.randn(*threefold[0].shape, 3, dtype=torch.float64)
    plain, tripled = Rows(*threefold, direction), Rows(*threefold, direction, tripled=T)
    assert_close(tripled.residual(posed), plain.residual(posed), atol=1e-12, rtol=1e-12)
    assert_close(tripled.residual(posed), residual_of(plain, posed), atol=1e-12, rtol=1e-12)
    nothing = PosePrior(truth, torch.zeros_like(truth))
    sums = [
        equations_by_moments(body, size, r, nothing, FittingConfig(), posed).of_rows.moments.matrix
        for r in (plain, tripled)
    ]
    assert_close(sums[1], sums[0], atol=1e-7, rtol=1e-10)
    rest = Rows(*(getattr(rows, name)[:, :5] for name in ROW_FIELDS))
    both = Rows.cat(tripled, rest)
    assert both.tripled == T
    assert_close(both.residual(posed), torch.cat([plain.residual(posed), rest.residual(posed)], 1))


def test_a_broken_frame_stays_alone():
    body, truth, size, rows = scene(batch=3, dtype=torch.float32)
    posed = body(truth, size)
    target = rows.target.clone()
    target[1, 7] = torch.nan
    both = [
        MomentEquations(sums_of(r, posed), body.part_moves)(posed)
        for r in (rows, replace(rows, target=target))
    ]
    assert torch.equal(both[0][[0, 2]], both[1][[0, 2]])  # to the bit
    assert both[1][1, -1, -1].isnan()


def test_no_rows_say_nothing():
    body, truth, size, rows = scene()
    none = Rows(*(getattr(rows, name)[:, :0] for name in ROW_FIELDS))
    posed = body(truth, size)
    equations = MomentEquations(sums_of(none, posed), body.part_moves)
    assert (equations(posed) == 0).all()
    assert (equations.by_offset(posed) == 0).all()
    assert (equations.extent(posed) == 0).all()
    assert (equations.reach(posed, posed.centers) == 0).all()
