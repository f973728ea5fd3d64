"""The mean field against enumeration, its fixed point and its bound; the geodesic term by a double loop."""

import itertools
from dataclasses import replace

import pytest
import torch
from synthetic_cloud import grid_neighbours
from torch.testing import assert_close

from torchpose.registration.geodesic import GeodesicBounds, geodesic_term
from torchpose.registration.labelling import (
    COLOURS,
    GeodesicTerm,
    LabellingConfig,
    _geodesic_field,
    label_bound,
    mean_field,
    neighbour_sum,
)
from torchpose.vision.points import Cells

LONG = 60  # sweeps, after which a field stands


def random_grid(num, rows=7, columns=7, radius=2.0, padding=3):
    """Points on some nodes of a grid, as `sample_grid` gives them: grid, mask and neighbours, batch 1."""
    nodes = torch.randperm(rows * columns)[:num].sort().values
    grid = torch.stack([nodes // columns, nodes % columns], 1)
    total = num + padding
    full = torch.full((1, total, 2), -1)
    full[0, :num] = grid
    return full, torch.arange(total)[None] < num, grid_neighbours(grid, total, radius)


def random_case(num=25, labels=5, spread=1.5, **kwargs):
    grid, mask, near = random_grid(num, **kwargs)
    return spread * torch.randn(1, labels, mask.shape[1], dtype=torch.float64), near, mask, grid


def log_joint(potential, near, count, potts):
    """The definition: f and gamma for each pair of equal neighbours, of every labelling of `count` points."""
    labels = potential.shape[1]
    labellings = torch.tensor(list(itertools.product(range(labels), repeat=count)))
    total = potential[0].T[torch.arange(count), labellings].sum(1)
    for i in range(count):
        for j in near[0, i].tolist():
            if i < j < count:
                total = total + potts * (labellings[:, i] == labellings[:, j])
    return labellings, total


def test_without_neighbours_it_is_the_softmax():
    potential, near, mask, _ = random_case()
    belief = mean_field(potential, near, mask, LabellingConfig(potts=0.0)).belief
    assert_close(belief[:, :, mask[0]], potential.softmax(1)[:, :, mask[0]])
    alone = torch.full_like(near, mask.shape[1])
    belief = mean_field(potential, alone, mask, LabellingConfig(potts=0.7)).belief
    assert_close(belief[:, :, mask[0]], potential.softmax(1)[:, :, mask[0]])


@pytest.mark.parametrize("coloured", [False, True])
def test_the_bound_is_below_the_evidence_of_all_labellings(coloured):
    for _ in range(4):
        potential, near, mask, grid = random_case(num=6, labels=3, rows=3, columns=3, padding=2)
        _, joint = log_joint(potential, near, 6, 0.5)
        config = LabellingConfig(sweeps=LONG, potts=0.5, coloured=coloured)
        bound = mean_field(potential, near, mask, config, grid, history=True).bound
        assert (bound < joint.logsumexp(0)).all()
        assert bound[-1] > joint.logsumexp(0) - 0.5  # nats: not just any number below it


def test_without_neighbours_the_bound_is_the_evidence():
    potential, near, mask, _ = random_case(num=6, labels=3, rows=3, columns=3)
    _, joint = log_joint(potential, near, 6, 0.0)
    bound = mean_field(potential, near, mask, LabellingConfig(sweeps=1, potts=0.0)).bound
    assert_close(bound[-1, 0], joint.logsumexp(0))


def test_the_bound_is_the_expectation_over_all_labellings():
    """E_q[log p(V, D)] - E_q[log q] (C.8), with q(V) the product of any beliefs."""
    potential, near, _, _ = random_case(num=5, labels=3, rows=2, columns=4, padding=0)
    belief = torch.randn_like(potential).softmax(1)
    labellings, joint = log_joint(potential, near, 5, 0.8)
    log_q = belief[0].T[torch.arange(5), labellings].log().sum(1)
    assert_close(label_bound(potential, belief, near, 0.8)[0], (log_q.exp() * (joint - log_q)).sum())


@pytest.mark.parametrize("potts", [0.3, 1.0])
def test_it_ends_where_the_mean_field_equations_hold(potts):
    potential, near, mask, grid = random_case()
    config = LabellingConfig(sweeps=LONG, potts=potts, coloured=True)
    belief = mean_field(potential, near, mask, config, grid).belief
    for i in range(int(mask.sum())):
        field = potential[0, :, i].clone()
        for j in near[0, i].tolist():
            if j < mask.shape[1]:
                field += potts * belief[0, :, j]
        assert_close(belief[0, :, i], field.softmax(0), rtol=0, atol=1e-9)


def test_beliefs_come_near_the_true_marginals():
    """With weak coupling the mean field is right to second order in gamma."""
    potential, near, mask, grid = random_case(num=6, labels=3, rows=3, columns=3, padding=0)
    errors = []
    for potts in (0.2, 0.1):
        labellings, joint = log_joint(potential, near, 6, potts)
        p = joint.softmax(0)
        marginal = torch.stack([(p[:, None] * (labellings == v)).sum(0) for v in range(3)])
        config = LabellingConfig(sweeps=LONG, potts=potts, coloured=True)
        errors.append((mean_field(potential, near, mask, config, grid).belief[0] - marginal).abs().max())
    assert errors[1] < 0.4 * errors[0] < 0.01


@pytest.mark.parametrize("potts", [0.5, 2.0])
@pytest.mark.parametrize("labels", [2, 15])
def test_with_colours_the_bound_never_falls(potts, labels):
    cases = [random_case(num=35, labels=labels, spread=0.5) for _ in range(10)]
    potential, near, mask, grid = (torch.cat(parts) for parts in zip(*cases, strict=True))
    config = LabellingConfig(sweeps=15, potts=potts, coloured=True)
    bound = mean_field(potential, near, mask, config, grid, history=True).bound
    assert bound.shape == (16, 10)
    assert (bound.diff(dim=0) >= -1e-9).all()
    assert (bound[-1] > bound[0]).all()


def test_without_colours_it_can_fall():
    """Why there are colours: neighbours that are updated at once swap labels for ever."""
    near, mask = torch.tensor([[[1], [0]]]), torch.ones(1, 2, dtype=torch.bool)
    potential = torch.tensor([[[0.1, 0.0], [0.0, 0.1]]], dtype=torch.float64)
    grid = torch.tensor([[[0, 0], [0, 1]]])
    config = LabellingConfig(sweeps=9, potts=6.0)
    assert (mean_field(potential, near, mask, config, history=True).bound.diff(dim=0) < -1e-3).any()
    coloured = replace(config, coloured=True)
    assert (mean_field(potential, near, mask, coloured, grid, history=True).bound.diff(dim=0) >= -1e-9).all()


@pytest.mark.parametrize("sweeps", [0, 1, 3])
@pytest.mark.parametrize("potts", [0.0, 0.5])
def test_the_bound_is_the_last_of_the_history_and_that_of_the_beliefs(sweeps, potts):
    potential, near, mask, _ = random_case()
    config = LabellingConfig(sweeps=sweeps, potts=potts)
    alone, all_of_them = (mean_field(potential, near, mask, config, history=h) for h in (False, True))
    assert alone.bound.shape == (1, 1)
    assert all_of_them.bound.shape == (sweeps + 1, 1)
    assert torch.equal(alone.belief, all_of_them.belief)
    assert torch.equal(alone.bound[-1], all_of_them.bound[-1])
    assert_close(alone.bound[-1], label_bound(potential, alone.belief, near, potts))


def test_points_of_one_colour_are_never_neighbours():
    grid, mask, near = random_grid(100, rows=10, columns=10, padding=0)
    colour = (grid[0, :, 0] + 2 * grid[0, :, 1]) % COLOURS
    assert set(colour.tolist()) == set(range(COLOURS))
    for i in range(100):
        own = [j for j in near[0, i].tolist() if j < mask.shape[1]]
        assert 5 <= len(own) <= 12
        assert (colour[own] != colour[i]).all()


def test_a_coloured_sweep_is_one_update_after_another():
    potential, near, mask, grid = random_case()
    config = LabellingConfig(sweeps=1, potts=0.9, coloured=True)
    belief = potential.softmax(1) * mask[:, None]
    for colour in range(COLOURS):
        for i in range(int(mask.sum())):
            if (grid[0, i, 0] + 2 * grid[0, i, 1]) % COLOURS == colour:
                beside = [j for j in near[0, i].tolist() if j < mask.shape[1]]
                field = potential[0, :, i] + 0.9 * belief[0][:, beside].sum(1)
                belief[0, :, i] = field.softmax(0)
    assert_close(mean_field(potential, near, mask, config, grid).belief, belief)


def test_neighbour_sum_is_a_loop():
    _, _, near_a = random_grid(25)
    _, _, near_b = random_grid(25)
    near = torch.cat([near_a, near_b])
    belief = torch.rand(2, 4, near.shape[1], dtype=torch.float64, requires_grad=True)
    total = torch.zeros_like(belief)
    for b, i in itertools.product(range(2), range(near.shape[1])):
        for j in near[b, i].tolist():
            if j < near.shape[1]:
                total[b, :, i] = total[b, :, i] + belief[b, :, j]
    summed = neighbour_sum(belief, near)
    assert_close(summed, total)
    weights = torch.rand_like(total)
    (slope,) = torch.autograd.grad((summed * weights).sum(), belief)
    assert_close(slope, torch.autograd.grad((total * weights).sum(), belief)[0])


def test_padding_has_no_belief_and_no_influence():
    potential, near, mask, grid = random_case()
    config = LabellingConfig(sweeps=4, potts=1.0)
    first = mean_field(potential, near, mask, config, grid)
    assert (first.belief[:, :, ~mask[0]] == 0).all()
    assert_close(first.belief.sum(1), mask.double())
    other = potential.masked_fill(~mask[:, None], 50.0)
    second = mean_field(other, near, mask, config, grid)
    assert torch.equal(first.belief, second.belief)
    assert torch.equal(first.bound, second.bound)


def test_an_impossible_label_stays_so_and_the_bound_finite():
    potential, near, mask, grid = random_case()
    potential[0, 1] = -torch.inf
    labelling = mean_field(potential, near, mask, LabellingConfig(coloured=True), grid)
    assert (labelling.belief[0, 1] == 0).all()
    assert labelling.bound.isfinite().all()


def test_a_batch_equals_one_by_one():
    cases = [random_case() for _ in range(3)]
    config = LabellingConfig(sweeps=3, coloured=True)
    potential, near, mask, grid = (torch.cat(parts) for parts in zip(*cases, strict=True))
    cells = [random_cells(mask.shape[1]) for _ in cases]
    bounds = random_bounds(5)
    together = Cells(*(torch.cat([getattr(c, name) for c in cells]) for name in Cells.__dataclass_fields__))
    config = replace(config, geodesic=0.04)
    term = geodesic_term(together, bounds, outlier=False)
    batch = mean_field(potential, near, mask, config, grid, term)
    for i, (case, cell) in enumerate(zip(cases, cells, strict=True)):
        one = mean_field(*case[:3], config, case[3], geodesic_term(cell, bounds, outlier=False))
        assert_close(batch.belief[i : i + 1], one.belief)
        assert_close(batch.bound[:, i : i + 1], one.bound)


def random_cells(num, count=8, padding=2):
    index = torch.randint(0, count, (1, num))
    index[0, -3:] = -1
    centres = torch.rand(1, count + padding, 3, dtype=torch.float64)
    distances = (centres[:, :, None] - centres[:, None]).norm(dim=-1)
    distances[:, :2, 2:] = distances[:, 2:, :2] = torch.inf  # two pieces
    distances[:, count:] = distances[:, :, count:] = torch.inf
    return Cells(index, centres, (torch.arange(count + padding) < count)[None], distances)


def random_bounds(parts):
    shortest = 0.5 * torch.rand(parts, parts, dtype=torch.float64)
    shortest = torch.minimum(shortest, shortest.T)
    most = torch.rand(parts, dtype=torch.float64).softmax(0)
    return GeodesicBounds(shortest, shortest + 0.3, most)


@pytest.mark.parametrize("outlier", [False, True])
def test_the_geodesic_field_is_equation_3_12(outlier):
    parts, num = 4, 20
    labels = parts + outlier
    cells, bounds = random_cells(num), random_bounds(parts)
    belief = torch.rand(1, labels, num, dtype=torch.float64).softmax(1) * (cells.index >= 0)[:, None]
    expected = torch.zeros(1, labels, num, dtype=torch.float64)
    tally = {"below": 0, "above": 0}
    for i, v in itertools.product(range(num), range(labels)):
        own = int(cells.index[0, i])
        for j in range(cells.mask.shape[1]):
            members = cells.index[0] == j
            if own < 0 or not members.any():
                continue
            w = int(belief[0][:, members].mean(1).argmax())
            distance = cells.distances[0, own, j]
            if v == parts or w == parts or distance == torch.inf:
                continue  # "no part" may be anywhere, and what is not connected was not measured
            alpha = 0.04 / bounds.most[w]  # 0.04 M_c / M_w
            if distance < bounds.shortest[v, w] or distance > bounds.longest[v, w]:
                expected[0, v, i] -= alpha
                tally["below" if distance < bounds.shortest[v, w] else "above"] += 1
    assert min(tally.values()) > 20
    assert_close(_geodesic_field(belief, geodesic_term(cells, bounds, outlier), 0.04), expected)


def test_the_geodesic_term_moves_a_label_that_is_too_far_away():
    """A lone point, almost as likely either part, lies 1 m of body away from three of the first part.

    It is too far from their cell to be the first part, and too near its own cell, which is of the second.
    """
    index = torch.tensor([[0, 0, 0, 1]])
    distance = torch.tensor([[[0.0, 1.0], [1.0, 0.0]]], dtype=torch.float64)
    table = torch.tensor([[0.0, 0.4], [0.4, 0.0]], dtype=torch.float64)
    longest = torch.tensor([[0.7, 1.5], [1.5, 0.3]], dtype=torch.float64)
    term = GeodesicTerm(index, distance, table, longest, torch.tensor([0.5, 0.5], dtype=torch.float64))
    potential = torch.tensor([[[2.0, 2.0, 2.0, 0.0], [0.0, 0.0, 0.0, 0.01]]], dtype=torch.float64)
    near, mask = torch.full((1, 4, 1), 4), torch.ones(1, 4, dtype=torch.bool)
    belief = mean_field(potential, near, mask, LabellingConfig(potts=0.0, geodesic=0.5), None, term).belief
    assert_close(belief[0, 0, 3], torch.sigmoid(torch.tensor(-2 * 0.5 / 0.5 - 0.01, dtype=torch.float64)))
    without = mean_field(potential, near, mask, LabellingConfig(potts=0.0), None, term).belief
    assert_close(without[0, 0, 3], torch.sigmoid(torch.tensor(-0.01, dtype=torch.float64)))


@pytest.mark.parametrize(("setting", "value"), [("sweeps", -1), ("potts", -1.0), ("geodesic", -1.0)])
def test_bad_settings_are_told(setting, value):
    with pytest.raises(ValueError, match=f"{setting}.* must not be negative, got"):
        LabellingConfig(**{setting: value})


def test_colours_need_the_grid():
    potential, near, mask, _ = random_case()
    with pytest.raises(ValueError, match="need the points' grid positions, got grid=None"):
        mean_field(potential, near, mask, LabellingConfig(coloured=True))
