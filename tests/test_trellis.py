"""The trellis against enumeration of all sequences."""

from itertools import product

import pytest
import torch
from torch.testing import assert_close

from torchpose.tracking.trellis import best_sequence, spread, step_cost, weights

T, L, H, P = 5, 2, 3, 2


@pytest.fixture
def problem():
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    return 3 * draw(T, L, H), 2 * draw(T, L, H, P), 5 * draw(T - 1, L, P)


def sequences(cost, place, pull, chain):
    """All sequences of a chain and their costs, one by one."""
    T, _, H = cost.shape
    out = []
    for path in product(range(H), repeat=T):
        total = sum(float(cost[t, chain, h]) for t, h in enumerate(path))
        for t in range(T - 1):
            gap = place[t, chain, path[t]] - place[t + 1, chain, path[t + 1]]
            total += 0.5 * float((pull[t, chain] * gap * gap).sum())
        out.append((path, total))
    return out


@pytest.mark.parametrize("empty", [False, True])
def test_sequence_and_weights_are_those_of_enumeration(problem, empty):
    cost, place, pull = problem
    if empty:
        cost[1, :, 2] = cost[3, 0, 1] = torch.inf
    step = step_cost(place, pull)
    best, weight = best_sequence(cost, step), weights(cost, step)
    for chain in range(L):
        every = sequences(cost, place, pull, chain)
        assert tuple(best[:, chain].tolist()) == min(every, key=lambda pair: pair[1])[0]
        density = torch.tensor([-total for _, total in every], dtype=torch.float64).softmax(0)
        expected = torch.zeros(T, H, dtype=torch.float64)
        for (path, _), share in zip(every, density, strict=True):
            for t, h in enumerate(path):
                expected[t, h] += share
        assert_close(weight[:, chain], expected)


def test_spread_is_the_second_moment_of_enumeration(problem):
    cost, place, pull = problem
    weight = weights(cost, step_cost(place, pull))
    about = place[:, :, 0]
    more = spread(place, weight, about)
    for chain in range(L):
        every = sequences(cost, place, pull, chain)
        density = torch.tensor([-total for _, total in every], dtype=torch.float64).softmax(0)
        for t in range(T):
            gaps = torch.stack([place[t, chain, path[t]] - about[t, chain] for path, _ in every])
            assert_close(more[t, chain], (density[:, None] * gaps).mT @ gaps)


def test_a_sure_answer_has_no_spread_and_empty_places_do_not_count(problem):
    cost, place, pull = problem
    cost[..., 1:] = torch.inf
    place[..., 1:, :] = 1e30
    weight = weights(cost, step_cost(place, pull))
    assert not spread(place, weight, place[:, :, 0]).any()


def test_one_frame_alone_takes_its_cheapest(problem):
    cost, place, pull = (x[:1] for x in problem)
    step = step_cost(place, pull[:0])
    assert_close(best_sequence(cost, step), cost.argmin(2))
    assert_close(weights(cost, step), (-cost).softmax(2))


def test_a_run_of_wrong_frames_is_left_as_a_whole():
    """Each frame alone is tied to its wrong neighbours by far more than it gains; all together are not."""
    frames = 12
    place = torch.tensor([0.0, 1.2]).expand(frames, 1, 2)[..., None]
    cost = torch.zeros(frames, 1, 2)
    cost[..., 1] = -6.0  # nats
    step = step_cost(place, torch.full((frames - 1, 1, 1), 20.0))
    assert step.max() > 2 * 6
    assert (best_sequence(cost, step) == 1).all()
    weight = weights(cost, step)
    assert (weight[..., 1] > 0.99).all()
    seen = torch.full((frames, 1, 2), 0.0)
    seen[7, 0, 1] = -6.0  # one frame sees it and the others say nothing: all follow
    assert (best_sequence(seen, step) == 1).all()


def test_chains_are_independent_and_dtypes_stay(problem):
    cost, place, pull = (x.float() for x in problem)
    step = step_cost(place, pull)
    both = weights(cost, step)
    assert both.dtype == torch.float32
    for k in range(L):
        one = slice(k, k + 1)
        assert_close(weights(cost[:, one], step[:, one]), both[:, one])
        assert_close(best_sequence(cost[:, one], step[:, one]), best_sequence(cost, step)[:, one])
