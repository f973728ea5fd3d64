"""Growing Correspondence Seeds against a plain sequential queue, and its parts against their definitions.

What holds for every matcher is in test_stereo.py.
"""

import heapq
from functools import partial

import numpy as np
import pytest
import torch
from stereo_scene import correlation, density_and_error, plane, step
from torch import Tensor
from torch.testing import assert_close

from torchpose.vision.disparity import Disparity
from torchpose.vision.disparity_space import GROWTH, DisparitySpace, similarities
from torchpose.vision.growing_seeds import (
    GrowingSeeds,
    GrowingSeedsConfig,
    best_rival,
    confident_matches,
    corner_seeds,
    fill,
    given_seeds,
    grow,
)

PAPER = {"windows": (5,), "min_island": 0, "fill": False, "smoothing": 0}
GIVEN_ALONE = {"seed_similarity": 1 - 1e-9}  # neither corners nor pixels without a seed begin anything


def matcher(**changes: object) -> "partial[Disparity]":
    return partial(GrowingSeeds(GrowingSeedsConfig(**changes)), disparity_range=(0, 20))  # type: ignore[arg-type]


@pytest.mark.parametrize("disparity", [7.0, 7.5, 9.8])
def test_the_papers_method_on_a_plane(disparity: float) -> None:
    left, right, truth = plane(50, 80, disparity)
    found = matcher(**PAPER)(left, right)
    density, error = density_and_error(found.values[0, :, 12:], truth[:, 12:], border=3)
    assert density > 0.99
    assert error.median() < 0.05  # px; a parabola through correlations is off by so much between pixels
    assert error.max() < 0.5
    assert found.confidence[found.values.isfinite()].min() >= 0.6


def test_the_papers_method_on_a_step() -> None:
    left, right, truth = step()
    density, error = density_and_error(matcher(**PAPER)(left, right).values[0], truth, border=3)
    assert density > 0.85
    assert (error > 1).double().mean() < 0.04  # within half a window of the square's edges


def test_a_batch_with_seeds_equals_its_frames_one_by_one() -> None:
    scenes = [plane(40, 70, 5.3, seed=4), plane(40, 70, 11.0, 0.05, seed=5), plane(40, 70, 8.0, seed=6)]
    left, right = (torch.cat([scene[side] for scene in scenes]) for side in (0, 1))
    mask = torch.zeros(3, 40, 70, dtype=torch.bool)
    mask[0, 5:30, 20:60] = True
    mask[1, 10:38, 30:66] = True  # and none in the last
    seeds = torch.where(torch.rand(3, 40, 70, dtype=torch.float64) < 0.02, 8.0, torch.nan).double()
    together = matcher(min_island=20)(left, right, mask, seeds)
    for item in range(3):
        one = slice(item, item + 1)
        alone = matcher(min_island=20)(left[one], right[one], mask[one], seeds[one])
        assert_close(together.values[one], alone.values, equal_nan=True)
        assert_close(together.confidence[one], alone.confidence)
    assert together.values[:2].isfinite().sum() > 1000


def test_all_grows_from_a_few_seeds_and_nothing_from_none() -> None:
    left, right, truth = plane(50, 80, 10.0, 0.05)
    without = matcher(**GIVEN_ALONE)
    assert without(left, right).values.isnan().all()
    seeds = torch.full((1, 50, 80), torch.nan, dtype=torch.float64)
    seeds[0, 25, 40] = truth[25, 40]
    density, error = density_and_error(without(left, right, seeds=seeds).values[0, :, 16:], truth[:, 16:], 3)
    assert density > 0.95
    assert (error > 1).double().mean() < 0.01
    wrong = torch.full_like(
        seeds, 18.0
    )  # seeds are proposals: what is alike by chance leads nowhere or to the truth
    _, error = density_and_error(without(left, right, seeds=wrong).values[0, :, 16:], truth[:, 16:], 3)
    assert (error > 1).double().mean() < 0.02


def test_the_last_frames_disparities_are_good_seeds() -> None:
    left, right, truth = step()
    first = matcher()(left, right)
    again = matcher()(left, right, seeds=first.values)
    assert again.values.isfinite().sum() >= first.values.isfinite().sum()
    both = again.values.isfinite() & first.values.isfinite()
    assert ((again.values - first.values)[both].abs() < 0.01).double().mean() > 0.99
    # A part that no corner reaches is found through the seeds.
    mask = torch.zeros(1, *truth.shape, dtype=torch.bool)
    mask[0, 13:35, 33:63] = True
    seeded = matcher(**GIVEN_ALONE)(left, right, mask, seeds=first.values)
    assert seeded.values[mask].isfinite().double().mean() > 0.95


# The oracle: the paper's queue, one cell at a time, in plain numpy.


def sequential_queue(
    left: np.ndarray,
    right: np.ndarray,
    seeds: list[tuple[int, int, int]],
    disparities: int,
    config: GrowingSeedsConfig,
) -> np.ndarray:
    """Integer disparity at each left pixel, NaN where none, by steps 3 to 6 of GCS; seeds are (y, x, d)."""
    height, width = left.shape
    padded = np.pad(left, 2, mode="edge"), np.pad(right, 2, mode="edge")
    cache: dict[tuple[int, int, int], float] = {}

    def similarity(cell: tuple[int, int, int]) -> float:
        x_left, x_right, y = cell
        inside = 0 <= x_left < width and 0 <= x_right < width and 0 <= y < height
        if not inside or not 0 <= x_left - x_right < disparities:
            return -1.0
        if cell not in cache:
            cache[cell] = correlation(*padded, y, x_left, x_right, config.noise)
        return cache[cell]

    best_left = np.full((width, height), -1.0)
    best_right = np.full((width, height), -1.0)
    accepted: set[tuple[int, int, int]] = set()
    queue: list[tuple[float, tuple[int, int, int]]] = []

    def accept(cell: tuple[int, int, int]) -> None:
        x_left, x_right, y = cell
        value = similarity(cell)
        best_left[x_left, y] = max(best_left[x_left, y], value)
        best_right[x_right, y] = max(best_right[x_right, y], value)
        accepted.add(cell)
        heapq.heappush(queue, (-value, cell))

    for y, x, d in seeds:
        if similarity((x, x - d, y)) >= config.tau:
            accept((x, x - d, y))
    while queue:
        _, (x_left, x_right, y) = heapq.heappop(queue)
        for group in GROWTH:
            around = [(x_left + a, x_right + b, y + c) for a, b, c in group]
            cell = max(around, key=similarity)
            value = similarity(cell)
            if value < config.tau or cell in accepted:
                continue
            if value + config.mu >= min(best_left[cell[0], cell[2]], best_right[cell[1], cell[2]]):
                accept(cell)

    result = np.full((height, width), np.nan)
    for y in range(height):
        rest = {cell for cell in accepted if cell[2] == y}

        def competes(one: tuple[int, int, int], other: tuple[int, int, int]) -> bool:
            shared = one[0] == other[0] or one[1] == other[1]
            return shared and abs((one[0] - one[1]) - (other[0] - other[1])) > config.tolerance

        progress = True
        while progress:
            progress = False
            for cell in sorted(rest, key=similarity, reverse=True):
                rivals = [similarity(other) for other in rest if competes(cell, other)]
                if similarity(cell) >= max(rivals, default=-1.0) + config.beta:
                    result[y, cell[0]] = cell[0] - cell[1]
                    rest = {o for o in rest if o[0] != cell[0] and not competes(cell, o)}
                    progress = True
                    break
    return result


@pytest.mark.parametrize(("tolerance", "share"), [(0, 0.03), (1, 0.03), (1, 0.7)])
def test_the_wave_front_agrees_with_the_sequential_queue(tolerance: int, share: float) -> None:
    """Also where seeds lie so close that most of them are left out of the first wave's growth."""
    left, right, truth = step(30, 60, near=9, far=3)
    noise = torch.randn(2, 1, 1, 30, 60, dtype=torch.float64) * 0.03
    left, right = left + noise[0], right + noise[1]
    seeds = torch.full((1, 30, 60), torch.nan, dtype=torch.float64)
    places = torch.rand(30, 60) < share
    seeds[0][places] = truth[places]
    network = matcher(**(PAPER | GIVEN_ALONE | {"tolerance": tolerance, "seed_shift": 0}))
    ours = network(left, right, seeds=seeds, disparity_range=(0, 12)).values[0].round().numpy()
    points = [(y, x, int(seeds[0, y, x])) for y, x in (~seeds[0].isnan()).nonzero().tolist()]
    grey = [image[0, 0].numpy() for image in (left, right)]
    queue = sequential_queue(*grey, points, 13, network.func.config)
    either = np.isfinite(ours) | np.isfinite(queue)
    assert either.sum() > 900
    # Sub-pixel peaks may round to the next disparity.
    agree = np.abs(ours - queue) <= 1
    assert agree[either].mean() > 0.95
    assert (np.abs(ours - queue)[either & agree] == 0).mean() > 0.97


# The parts.


def region(height: int, width: int, disparities: int) -> DisparitySpace:
    return DisparitySpace(1, 0, 0, height, width, 0, disparities)


def test_growth_stops_where_it_is_told() -> None:
    space = region(12, 30, 5)
    everywhere = torch.full((14, 7, 34), -1.0)
    everywhere[1:-1, 1:-1, 2:-2] = 0.7 + 0.09 * torch.rand(12, 5, 30)  # alike within mu
    everywhere[:, :, 20:22] = 0.5  # less than tau, and broader than a step
    seeds = torch.tensor([(5 * 7 + 3) * 34 + 8])
    full = grow(everywhere.flatten(), seeds, space, GrowingSeedsConfig())
    assert len(full) == len(full.unique())
    assert (everywhere.flatten()[full] >= 0.6).all()
    assert (full % 34 < 20).all()
    few = grow(everywhere.flatten(), seeds, space, GrowingSeedsConfig(max_candidates=1))
    assert 0 < len(few) < 0.75 * len(full)
    one = grow(everywhere.flatten(), seeds, space, GrowingSeedsConfig(max_waves=1))
    assert one.tolist() == seeds.tolist()
    # A better match at a pixel keeps worse ones out, by mu.
    ridge = everywhere.clone()
    ridge[1:-1, 3, 2:-2] = 0.95
    on_ridge = grow(ridge.flatten(), seeds, space, GrowingSeedsConfig())
    assert (space.layer(on_ridge) == 3).double().mean() > 0.9
    assert (space.layer(full) == 3).double().mean() < 0.5


def volume_of(space: DisparitySpace, cells: dict[tuple[int, int, int], float]) -> Tensor:
    """Similarities 0 but at the cells (row, layer, column), counted with the padding."""
    volume = torch.zeros(space.height + 2, space.layers, space.columns)
    for place, value in cells.items():
        volume[place] = value
    return volume.flatten()


def cell_at(space: DisparitySpace, row: int, layer: int, column: int) -> int:
    return (row * space.layers + layer) * space.columns + column


@pytest.mark.parametrize("shift", [0, 2])
def test_known_disparities_and_the_pixels_without_become_seeds(shift: int) -> None:
    """Against a loop over the pixels: the best layer near what was known, else the best of all at every fourth."""
    space = DisparitySpace(2, 10, 20, 6, 8, 5, 9)
    volume = torch.full((2, 8, 11, 12), -1.0)
    volume[:, 1:-1, 1:-1, 2:-2] = torch.rand(2, 6, 9, 8)
    seeds = torch.where(
        torch.rand(2, 6, 8) < 0.5, 3 + 12 * torch.rand(2, 6, 8), torch.nan
    )  # 5 to 13 is in range
    seeds[0, 0, 0], seeds[1, 5, 7], seeds[0, 5, 5] = 5.4, 13.0, torch.inf
    mask = torch.rand(2, 6, 8) < 0.8
    mask[0, 0, 0] = mask[1, 5, 7] = True
    config = GrowingSeedsConfig(seed_shift=shift, tau=0.5, seed_similarity=0.7)
    expected, known = [], 0
    for item, row, column in mask.nonzero().tolist():
        layers = volume[item, row + 1, 1:-1, column + 2]
        disparity = seeds[item, row, column].item()
        place = round(disparity) - 5 if np.isfinite(disparity) else -1
        first, last = max(0, place - shift), min(8, place + shift)
        if 0 <= place <= 8 and layers[first : last + 1].max() >= 0.5:
            layer = first + int(layers[first : last + 1].argmax())
            known += 1
        elif row % 2 == 0 and column % 2 == 0 and layers.max() >= 0.7:
            layer = int(layers.argmax())
        else:
            continue
        expected.append((((item * 8 + row + 1) * 11 + layer + 1) * 12) + column + 2)
    assert 5 < known < len(expected) - 5
    assert sorted(given_seeds(volume.flatten(), seeds, mask, space, config).tolist()) == sorted(expected)


def test_a_seed_among_seeds_proposes_nothing_but_one_at_a_rim_does() -> None:
    space = region(13, 20, 5)
    volume = volume_of(
        space, {(5, 2, 11): 0.9}
    )  # what a seed at row 5, column 10, layer 3 offers to its right
    at = torch.tensor([cell_at(space, row, 3, column) for row in range(1, 10) for column in range(6, 15)])
    offered, beside = cell_at(space, 5, 2, 11), cell_at(space, 5, 3, 9)
    volume[at] = 0.7
    config = GrowingSeedsConfig(max_waves=2)
    assert offered not in grow(volume, at, space, config).tolist()
    assert offered in grow(volume, at[at != beside], space, config).tolist()


def test_corners_inside_the_mask_seed_where_they_match() -> None:
    scenes = [plane(50, 80, 7.0, seed=seed) for seed in (1, 2)]
    left, right = (torch.cat([scene[side] for scene in scenes])[:, 0] for side in (0, 1))
    mask = torch.zeros(2, 50, 80, dtype=torch.bool)
    mask[0, 5:45, 20:70], mask[1, 10:35, 15:50] = True, True
    space = DisparitySpace.around(mask, 0, 12)
    inside = space.crop(mask)
    volume = similarities(left - 0.5, right - 0.5, inside, space, (5,), 0.001)

    def seeds(**changes: float) -> list[list[int]]:
        """The seeds of each item, as pixels."""
        cells = corner_seeds(volume, left, inside, space, GrowingSeedsConfig(**changes))  # type: ignore[arg-type]
        if not changes.get(
            "weakest_corners"
        ):  # all have the disparity of their plane, the few that repeat aside
            assert (space.layer(cells) == 8).double().mean() > 0.95
        pixels = space.left_pixel(cells)
        assert space.pad(inside, False)[pixels].all()
        return [pixels[pixels // (space.left_pixels // 2) == item].tolist() for item in range(2)]

    every = seeds(weakest_corners=0.0, seed_similarity=1e-6)
    half = seeds(weakest_corners=0.5, seed_similarity=1e-6)
    for all_corners, kept in zip(every, half, strict=True):
        assert len(all_corners) > 15
        assert set(kept) < set(all_corners)
        assert len(kept) == len(all_corners) - len(all_corners) // 2
    good = seeds(weakest_corners=0.0, seed_similarity=0.95)
    assert all(0 < len(some) <= len(corners) for some, corners in zip(good, every, strict=True))
    # An item's own weakest go, however strong the other's are.
    left[1] = 0.5 + 0.2 * (left[1] - 0.5)
    assert seeds(weakest_corners=0.5, seed_similarity=1e-6)[0] == half[0]


@pytest.mark.parametrize(("value", "accepted"), [(0.85, True), (0.75, False)])
def test_a_cell_grows_if_it_is_not_much_worse_than_the_best_at_both_its_pixels(
    value: float, accepted: bool
) -> None:
    space = region(12, 30, 9)
    above, at_left, at_right, offered = (4, 5, 12), (5, 3, 12), (5, 2, 9), (5, 5, 12)
    volume = volume_of(space, {above: 0.9, at_left: 0.9, at_right: 0.9, offered: value})
    cells = {place: cell_at(space, *place) for place in (above, at_left, at_right, offered)}

    def grown(*seeds: tuple[int, int, int]) -> list[int]:
        return grow(
            volume, torch.tensor([cells[seed] for seed in seeds]), space, GrowingSeedsConfig()
        ).tolist()

    assert (cells[offered] in grown(above, at_left, at_right)) == accepted
    assert cells[offered] in grown(above, at_left)  # one of the pixels has nothing better


@pytest.mark.parametrize("shared", ["left", "right"])
@pytest.mark.parametrize(("rival", "wins"), [(0.75, False), (0.65, True)])
def test_a_match_beats_its_rivals_by_a_margin(shared: str, rival: float, wins: bool) -> None:
    space = region(5, 30, 9)
    best = (2, 3, 15)
    other = (2, 7, 15) if shared == "left" else (2, 7, 19)
    volume = volume_of(space, {best: 0.8, other: rival})
    cells = torch.tensor([cell_at(space, *best), cell_at(space, *other)])
    layers, similarity = confident_matches(volume, cells, space, GrowingSeedsConfig())
    assert layers.isfinite().sum() == int(wins)
    if wins:
        pixel = 2 * space.columns + 15
        assert_close(layers[pixel], torch.tensor(3.0))
        assert_close(similarity[pixel], torch.tensor(0.8))


def test_filling_takes_no_right_pixel_from_another() -> None:
    space = region(3, 20, 9)
    volume = torch.full((5, 11, 24), 0.8).flatten()
    layers = torch.full((1, 3, 20), torch.nan)
    layers[0, :, 15:] = 6.0
    layers[0, 1, 8] = 2.0  # its right pixel is that of column 12 at layer 6
    mask = torch.ones(1, 3, 20, dtype=torch.bool)
    mask[0, :, :11] = False
    known = space.pad(layers, torch.nan)
    config = GrowingSeedsConfig(fill_smoothness=10.0)  # keep to the neighbours' mean
    filled = space.unpad(fill(volume, known, torch.zeros_like(known), mask, space, config)[0])[0]
    assert filled[1, 12].isnan()
    assert filled[:, 11:].isnan().sum() == 1
    assert (filled[0, 11:] == 6.0).all()


def test_the_best_rival_is_far_enough() -> None:
    pixel = torch.tensor([0, 0, 0, 1, 1, 2])
    layer = torch.tensor([3, 4, 9, 2, 3, 5])
    value = torch.tensor([0.9, 0.8, 0.7, 0.6, 0.9, 0.5])
    expected = torch.tensor([0.7, 0.7, 0.9, -1.0, -1.0, -1.0])
    assert_close(best_rival(pixel, layer, value, 3, tolerance=1), expected)
    expected = torch.tensor([0.8, 0.9, 0.9, 0.9, 0.6, -1.0])
    assert_close(best_rival(pixel, layer, value, 3, tolerance=0), expected)


def test_holes_are_filled_from_their_rims_where_it_is_similar() -> None:
    space = region(10, 16, 9)
    volume = torch.full((12, 11, 20), -1.0)
    volume[1:-1, 1:-1, 2:-2] = 0.6  # everything is as good as anything: the texture tells nothing
    volume[1:-1, 1:-1, 2:6] = 0.1  # but the first 4 columns are another matter
    layers = torch.full((1, 10, 16), torch.nan)
    layers[0, :, 8:] = 4.0
    layers[0, 3:7, 10:14] = torch.nan
    mask = torch.ones(1, 10, 16, dtype=torch.bool)
    mask[0, 4, 11] = False
    known = space.pad(layers, torch.nan)
    confidence = torch.where(known.isnan(), 0.0, 0.9)
    filled, similarity = fill(volume.flatten(), known, confidence, mask, space, GrowingSeedsConfig())
    filled, similarity = space.unpad(filled)[0], space.unpad(similarity)[0]
    assert filled[4, 11].isnan()
    filled[4, 11] = 4.0
    assert (filled[:, 4:] == 4.0).all()
    assert filled[:, :4].isnan().all()
    assert_close(similarity[5, 12], torch.tensor(0.3))
    assert_close(similarity[5, 15], torch.tensor(0.9))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"windows": (5, 4)}, r"windows must be odd sides of at least 3 px, got \(5, 4\)"),
        ({"windows": ()}, "windows must be odd sides"),
        ({"noise": 0.0}, "noise must be positive, got 0"),
        ({"tau": 1.2}, "tau must lie between 0 and 1, got 1.2"),
        ({"fill_levels": (0.9, 0.0)}, "fill_levels must lie between 0 and 1"),
        ({"weakest_corners": 1.0}, r"weakest_corners must be in \[0, 1\), got 1.0"),
        ({"beta": -0.1}, "beta must not be negative, got -0.1"),
        ({"max_candidates": 0}, "max_candidates must be at least 1, got 0"),
    ],
)
def test_senseless_settings_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GrowingSeedsConfig(**changes)  # type: ignore[arg-type]
