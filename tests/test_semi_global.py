"""Semi-global matching in bytes against plain loops in wide integers: census, costs, paths, and who wins."""

import itertools

import numpy as np
import pytest
import torch
from stereo_scene import plane
from torch import Tensor
from torch.testing import assert_close

from torchpose.vision.disparity import MatchingTask
from torchpose.vision.semi_global import (
    SemiGlobal,
    SemiGlobalConfig,
    aggregate,
    census,
    count_bits,
    large_steps,
    matching_cost,
    sum_paths,
    winners,
)

Radius = tuple[int, int]
NOISE = 0.25  # of the census: neighbours of `few_greys` differ by multiples of 0.2


def config_of(radius: Radius) -> SemiGlobalConfig:
    """Any window, without room for steps."""
    return SemiGlobalConfig(radius=radius, noise=NOISE, small_step=0, large_step=0, least_step=0)


def census_by_loop(grey: np.ndarray, y: int, x: int, radius: Radius) -> list[bool]:
    """Whether each neighbour of a pixel, row by row, is brighter by the noise; beyond the image its edge repeats."""
    height, width = grey.shape
    return [
        bool(grey[min(max(y + dy, 0), height - 1), min(max(x + dx, 0), width - 1)] > grey[y, x] + NOISE)
        for dy in range(-radius[0], radius[0] + 1)
        for dx in range(-radius[1], radius[1] + 1)
        if (dy, dx) != (0, 0)
    ]


def few_greys(*shape: int) -> Tensor:
    """So that neighbours are often equal, which is not brighter."""
    return torch.randint(0, 6, shape).double() / 5


@pytest.mark.parametrize("radius", [(2, 2), (1, 1), (0, 1), (3, 1), (1, 4), (3, 3)])
def test_a_census_says_which_neighbours_are_brighter(radius: Radius) -> None:
    grey = few_greys(2, 11, 13)
    planes = census(grey, config_of(radius))
    bits = (2 * radius[0] + 1) * (2 * radius[1] + 1) - 1
    assert planes.shape == (-(-bits // 8), 2, 11 - 2 * radius[0], 13 - 2 * radius[1])
    for item, y, x in itertools.product(range(2), range(planes.shape[2]), range(planes.shape[3])):
        expected = census_by_loop(grey[item].numpy(), y + radius[0], x + radius[1], radius)
        number = sum(int(byte) << 8 * place for place, byte in enumerate(planes[:, item, y, x]))
        assert [bool(number >> bit & 1) for bit in range(bits)] == expected
        assert number >> bits == 0


def test_the_bits_of_every_byte_are_counted() -> None:
    values = torch.arange(256, dtype=torch.uint8)[torch.randperm(256)].view(4, 2, 32)
    counted = values.clone()
    count_bits(counted, torch.full_like(counted, 255))
    assert counted.flatten().tolist() == [value.bit_count() for value in values.flatten().tolist()]


@pytest.mark.parametrize("radius", [(2, 2), (1, 3)])
@pytest.mark.parametrize(
    ("box", "least", "greatest"),
    [
        ((slice(0, 9), slice(0, 17)), 0, 6),
        ((slice(2, 5), slice(3, 10)), 2, 2),
        ((slice(8, 9), slice(0, 17)), -4, 3),
        ((slice(1, 9), slice(16, 17)), -9, -6),
        ((slice(0, 1), slice(0, 1)), 5, 30),
    ],
)
def test_a_cost_is_the_bits_that_differ(
    radius: Radius, box: tuple[slice, slice], least: int, greatest: int
) -> None:
    """All of them where the right image ends, none off the mask, and edges repeat: images 9 x 17 px, odd boxes."""
    left, right = few_greys(2, 9, 17), few_greys(2, 9, 17)
    rows, columns = box
    mask = torch.rand(2, 9, 17) < 0.8
    region = mask[:, rows, columns]
    task = MatchingTask(left, right, mask, None, least, greatest)
    cost = matching_cost(task, rows, columns, config_of(radius))
    assert cost.shape == (region.shape[1], 2, greatest - least + 1, region.shape[2])
    bits = (2 * radius[0] + 1) * (2 * radius[1] + 1) - 1
    expected = np.zeros(cost.shape, dtype=np.uint8)
    for item, y, x in region.nonzero().tolist():
        ours = census_by_loop(left[item].numpy(), rows.start + y, columns.start + x, radius)
        for layer in range(cost.shape[2]):
            other = columns.start + x - least - layer
            inside = 0 <= other < 17
            theirs = census_by_loop(right[item].numpy(), rows.start + y, other, radius) if inside else []
            expected[y, item, layer, x] = sum(np.not_equal(ours, theirs)) if inside else bits
    assert_close(cost, torch.from_numpy(expected))


def path_by_loop(costs: np.ndarray, limits: np.ndarray, small: int) -> np.ndarray:
    """Hirschmuller's recursion (13) along one path, costs (length, disparities) and P2 between its pixels."""
    paths = np.zeros_like(costs)
    paths[0] = costs[0]
    for p in range(1, len(costs)):
        least = paths[p - 1].min()
        for d in range(costs.shape[1]):
            ways = [paths[p - 1, d], least + limits[p - 1]]
            if d > 0:
                ways.append(paths[p - 1, d - 1] + small)
            if d + 1 < costs.shape[1]:
                ways.append(paths[p - 1, d + 1] + small)
            paths[p, d] = costs[p, d] + min(ways) - least
    return paths


def both_ways(costs: np.ndarray, limits: np.ndarray, small: int) -> np.ndarray:
    return path_by_loop(costs, limits, small) + path_by_loop(costs[::-1], limits[::-1], small)[::-1]


@pytest.mark.parametrize("layers", [1, 2, 3, 9])
@pytest.mark.parametrize("length", [1, 2, 12])
@pytest.mark.parametrize("small", [0, 5, 20])
def test_paths_are_the_recursion_in_wide_integers(length: int, layers: int, small: int) -> None:
    costs = torch.randint(0, 25, (length, 2, layers, 5), dtype=torch.uint8)
    limits = torch.randint(small, 39, (length - 1, 2, 5), dtype=torch.uint8)
    totals = torch.full_like(costs, 77)
    before = costs.clone()
    sum_paths(costs.unbind(0), limits.unbind(0), small, totals.unbind(0))
    for item, line in itertools.product(range(2), range(5)):
        own, steps = (
            costs[:, item, :, line].numpy().astype(np.int64),
            limits[:, item, line].numpy().astype(np.int64),
        )
        assert totals[:, item, :, line].tolist() == both_ways(own, steps, small).tolist()
    assert_close(costs, before)


def p2_by_loop(one: float, other: float, config: SemiGlobalConfig) -> int:
    step = config.large_step / (1 + abs(one - other) / config.edge)
    return max(config.least_step, round(step))


@pytest.mark.parametrize("dim", [1, 2])
def test_large_steps_fall_at_edges(dim: int) -> None:
    config = SemiGlobalConfig()
    grey = torch.rand(2, 7, 10, dtype=torch.float64)
    grey[0, 3] = 0.5
    steps = large_steps(grey, dim, config)
    assert steps.shape == ((2, 6, 10) if dim == 1 else (2, 7, 9))
    for item, y, x in itertools.product(range(2), *map(range, steps.shape[1:])):
        beside = grey[item, y + 1, x] if dim == 1 else grey[item, y, x + 1]
        assert steps[item, y, x] == p2_by_loop(grey[item, y, x].item(), beside.item(), config)
    flat = large_steps(torch.full((1, 3, 3), 0.3), dim, config)
    assert (flat == config.large_step).all()
    assert (large_steps(grey, dim, SemiGlobalConfig(edge=float("inf"))) == config.large_step).all()


BOUNDS = {
    "default": SemiGlobalConfig(),
    "the greatest steps": SemiGlobalConfig(small_step=39, large_step=39, least_step=39),
    "the greatest census": SemiGlobalConfig(radius=(3, 3), small_step=15, large_step=15, least_step=15),
    "no steps": SemiGlobalConfig(small_step=0, large_step=0, least_step=0),
}


@pytest.mark.parametrize("config", BOUNDS.values(), ids=BOUNDS)
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (8, 1), (7, 10)])
@pytest.mark.parametrize("layers", [1, 2, 3, 11])
def test_four_paths_are_summed_without_overflow(config: SemiGlobalConfig, size: Radius, layers: int) -> None:
    """Random costs, of which most are none at all or the greatest there are."""
    height, width = size
    cost = torch.randint(-config.bits, 2 * config.bits, (height, 2, layers, width)).clamp(0, config.bits)
    grey = few_greys(2, height, width)
    expected = np.zeros(cost.shape, dtype=np.int64)
    for item in range(2):
        own, image = cost[:, item].numpy(), grey[item].numpy()
        for x in range(width):
            limits = [p2_by_loop(*image[y : y + 2, x], config) for y in range(height - 1)]
            expected[:, item, :, x] += both_ways(own[:, :, x], np.array(limits), config.small_step)
        for y in range(height):
            limits = [p2_by_loop(*image[y, x : x + 2], config) for x in range(width - 1)]
            expected[y, item] += both_ways(own[y].T, np.array(limits), config.small_step).T
    assert expected.max() <= 255
    total = aggregate(cost.to(torch.uint8), grey, config)
    assert_close(total.long(), torch.from_numpy(expected))


def test_the_greatest_sum_fits_into_a_byte() -> None:
    """A pixel of the greatest cost where every path's last pixel prefers another disparity by far."""
    config = SemiGlobalConfig()
    cost = torch.full((41, 1, 30, 41), 24, dtype=torch.uint8)
    cost[:, :, 0] = 0
    cost[20, :, :, 20] = 24
    total = aggregate(cost, torch.full((1, 41, 41), 0.5), config)
    assert total.max() == total[20, 0, 29, 20] == 4 * (24 + config.large_step)


def winner_by_loop(
    total: np.ndarray, region: np.ndarray, reach: tuple[int, int], consistency: int
) -> tuple[np.ndarray, np.ndarray]:
    """Of one row (layers, width): layers to a fraction and margins."""
    layers, width = total.shape
    found, margin = np.full(width, np.nan), np.zeros(width)
    for x in np.flatnonzero(region):
        best = int(total[:, x].argmin())
        column = x - best
        seers = [
            (total[d, column + d], d) for d in range(layers) if 0 <= column + d < width and region[column + d]
        ]
        sure = -reach[0] <= column <= reach[1] and abs(min(seers)[1] - best) <= consistency
        here = float(total[best, x])
        rest = [float(total[d, x]) for d in range(layers) if abs(d - best) > 1]
        second = min(rest, default=255.0)
        margin[x] = max(0.0, second - here) / (second + 24)
        if sure:
            shift = 0.0
            if 0 < best < layers - 1:
                below, above = float(total[best - 1, x]), float(total[best + 1, x])
                # Two lines of one slope, the steeper side's, through the three sums.
                slope = max(below, above) - here
                shift = 0.5 * (below - above) / slope if slope > 0 else 0.0
            found[x] = best + shift
    return found, margin


@pytest.mark.parametrize("layers", [1, 2, 3, 12])
@pytest.mark.parametrize("consistency", [0, 1, 3])
@pytest.mark.parametrize("greatest", [3, 252])
def test_the_winner_is_the_least_that_the_right_image_agrees_with(
    layers: int, consistency: int, greatest: int
) -> None:
    total = torch.randint(0, greatest + 1, (4, 2, layers, 15), dtype=torch.uint8)
    region = torch.rand(2, 4, 15) < 0.8
    for reach in ((3, 9), (-2, 20), (20, 14)):
        found, margin = winners(total.clone(), region, reach, SemiGlobalConfig(consistency=consistency))
        for item, y in itertools.product(range(2), range(4)):
            sums, inside = total[y, item].numpy().astype(np.int64), region[item, y].numpy()
            layer, share = winner_by_loop(sums, inside, reach, consistency)
            assert_close(found[item, y].double(), torch.from_numpy(layer), equal_nan=True, atol=1e-5, rtol=0)
            sure = ~np.isnan(layer)
            assert_close(margin[item, y].double()[sure], torch.from_numpy(share[sure]), atol=1e-5, rtol=0)


def test_a_hundred_and_twenty_eight_disparities_are_numbered() -> None:
    total = torch.full((1, 1, 128, 200), 252, dtype=torch.uint8)
    columns = torch.arange(200)
    chosen = (columns * 37) % 128
    total[0, 0, chosen, columns] = 251
    found, margin = winners(
        total, torch.ones(1, 1, 200, dtype=torch.bool), (0, 199), SemiGlobalConfig(consistency=127)
    )
    seen = columns >= chosen
    assert_close(found[0, 0][seen], chosen[seen].float(), atol=0.5, rtol=0)
    assert found[0, 0][~seen].isnan().all()
    assert_close(margin, torch.full_like(margin, 1 / (252 + 24)))


def test_more_disparities_than_that_are_refused() -> None:
    left, right, _ = plane(20, 30, 3.0)
    with pytest.raises(
        ValueError, match="at most 128 disparities, got -20 to 108 px; raise the nearest depth"
    ):
        SemiGlobal()(left, right, disparity_range=(-20, 108))
    assert SemiGlobal()(left, right, disparity_range=(-20, 107)).values.shape == (1, 20, 30)


def test_pixels_off_the_mask_have_no_influence() -> None:
    """A hole's inside, out of reach of the windows of the pixels about it, may be anything."""
    left, right, _ = plane(60, 120, 8.0)
    left, right = (0.5 + (side - 0.5) / 20 + 0.005 * torch.randn_like(side) for side in (left, right))
    mask = torch.zeros(1, 60, 120, dtype=torch.bool)
    mask[0, 10:55, 40:90] = True
    mask[0, 20:45, 55:75] = False
    found = SemiGlobal()(left, right, mask, disparity_range=(0, 20))
    left[..., 24:41, 59:71] = torch.rand(17, 12, dtype=torch.float64)
    other = SemiGlobal()(left, right, mask, disparity_range=(0, 20))
    assert_close(other.values, found.values, equal_nan=True)
    assert_close(other.confidence, found.confidence)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"radius": (0, 0)}, r"radius must make windows of 2 to 64 px, got \(0, 0\); \(2, 2\) is 5 x 5"),
        ({"radius": (-1, 2)}, "radius must make windows of 2 to 64 px"),
        ({"radius": (4, 4)}, "radius must make windows of 2 to 64 px"),
        ({"small_step": -1}, "got -1, 16 and 39"),
        ({"small_step": 17}, "0 <= small_step <= least_step <= large_step must hold, got 17, 16 and 39"),
        ({"least_step": 40}, "got 12, 40 and 39"),
        ({"large_step": 40}, "large_step must be at most 39 beside 24 bits of census, .* got 40"),
        ({"radius": (3, 3)}, "large_step must be at most 15 beside 48 bits"),
        ({"noise": -0.1}, "noise must not be negative, got -0.1"),
        ({"edge": 0.0}, "edge must be positive, got 0.0; .inf makes P2 the same everywhere"),
        ({"edge": float("nan")}, "edge must be positive, got nan"),
        ({"consistency": -1}, "consistency must not be negative, got -1; 0 is the strictest"),
        ({"min_island": -1}, "min_island must not be negative"),
        ({"smoothing": -1}, "smoothing must not be negative"),
    ],
)
def test_senseless_settings_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SemiGlobalConfig(**changes)  # type: ignore[arg-type]
