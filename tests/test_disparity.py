"""What the matchers share: islands against connected components by SciPy, smoothing against a plain double loop."""

import numpy as np
import pytest
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor
from torch.testing import assert_close

from torchpose.vision.disparity import bounding_box, bridge_gaps, smooth, without_islands


def random_disparity(*shape: int, spread: float = 3.0, dtype: torch.dtype = torch.float64) -> Tensor:
    """Rough surfaces in sixteenths of a px, what OpenCV counts in, some of them negative, a third unknown."""
    values = (spread * torch.randn(*shape, dtype=dtype) * 16).round() / 16
    return values.where(torch.rand(*shape) < 0.7, torch.nan)


def islands_by_scipy(disparity: np.ndarray, area: int) -> np.ndarray:
    """NaN where a component of pixels side by side, by |difference| <= 1, has fewer than `area` pixels."""
    number = np.arange(disparity.size).reshape(disparity.shape)
    ends = []
    for one, other in (
        ((slice(None), slice(1, None)), (slice(None), slice(-1))),
        (slice(1, None), slice(-1)),
    ):
        near = np.abs(disparity[one] - disparity[other]) <= 1
        ends.append((number[one][near], number[other][near]))
    first, second = (np.concatenate(side) for side in zip(*ends, strict=True))
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(disparity.size, disparity.size))
    label = connected_components(graph, directed=False)[1]
    size = np.bincount(label)[label].reshape(disparity.shape)
    return np.where(size >= area, disparity, np.nan)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("area", [2, 3, 7, 30])
@pytest.mark.parametrize("spread", [0.5, 1.0, 20.0])
def test_islands_are_the_small_connected_components(area: int, spread: float, dtype: torch.dtype) -> None:
    disparity = random_disparity(3, 23, 38, spread=spread, dtype=dtype)
    before = disparity.clone()
    expected = torch.stack([torch.from_numpy(islands_by_scipy(image.numpy(), area)) for image in disparity])
    assert_close(without_islands(disparity, area), expected, equal_nan=True)
    assert_close(disparity, before, equal_nan=True)


@pytest.mark.parametrize("shape", [(2, 1, 9), (2, 9, 1), (1, 1, 1)])
def test_islands_of_one_row_or_column(shape: tuple[int, int, int]) -> None:
    disparity = random_disparity(*shape, spread=0.4)
    expected = torch.stack([torch.from_numpy(islands_by_scipy(image.numpy(), 3)) for image in disparity])
    assert_close(without_islands(disparity, 3), expected, equal_nan=True)


@pytest.mark.parametrize("area", [0, 1])
def test_no_island_is_too_small_for_an_area_of_one_pixel(area: int) -> None:
    disparity = random_disparity(1, 8, 9)
    assert_close(without_islands(disparity, area), disparity, equal_nan=True)


def test_islands_of_a_view_with_other_strides() -> None:
    """As a matcher that has its rows first hands them over."""
    disparity = random_disparity(2, 12, 17, spread=1.0)
    rows_first = disparity.transpose(0, 1).contiguous().transpose(0, 1)
    assert_close(without_islands(rows_first, 5), without_islands(disparity, 5), equal_nan=True)
    wide = torch.nn.functional.pad(disparity, (2, 3, 1, 1))[:, 1:-1, 2:-3]
    assert_close(without_islands(wide, 5), without_islands(disparity, 5), equal_nan=True)


def test_a_slope_is_one_island_and_a_step_is_two() -> None:
    disparity = torch.full((1, 6, 8), torch.nan)
    disparity[0, 0:3, 0:4] = torch.tensor([2.0, 2.8, 3.5, 4.1])  # 12 px, a slope
    disparity[0, 3, 3] = 7.0  # beside it, but another depth
    disparity[0, 5, 5:8] = 5.0  # 3 px
    disparity[0, 4, 4] = 5.0  # touches nothing but by a corner
    expected = disparity.clone()
    expected[0, 3, 3] = expected[0, 5, 5:8] = expected[0, 4, 4] = torch.nan
    assert_close(without_islands(disparity, 4), expected, equal_nan=True)


def smoothed_by_loop(disparity: np.ndarray, radius: int) -> np.ndarray:
    height, width = disparity.shape
    result = np.full_like(disparity, np.nan)
    for y in range(height):
        for x in range(width):
            window = disparity[max(0, y - radius) : y + radius + 1, max(0, x - radius) : x + radius + 1]
            near = window[np.abs(window - disparity[y, x]) <= 1]
            if near.size:
                result[y, x] = near.mean()
    return result


@pytest.mark.parametrize("radius", [0, 1, 2, 3, 5])
@pytest.mark.parametrize("shape", [(2, 13, 9), (1, 2, 9), (1, 9, 2), (1, 1, 7), (1, 7, 1), (1, 1, 1)])
def test_smoothing_is_the_mean_of_the_near(shape: tuple[int, int, int], radius: int) -> None:
    disparity = random_disparity(*shape, spread=1.0) + 0.001 * torch.rand(shape, dtype=torch.float64)
    before = disparity.clone()
    expected = torch.stack([torch.from_numpy(smoothed_by_loop(image.numpy(), radius)) for image in disparity])
    assert_close(smooth(disparity, radius), expected, equal_nan=True)
    assert_close(disparity, before, equal_nan=True)


def test_smoothing_keeps_steps_holes_and_float32() -> None:
    disparity = torch.tensor([[4.0, 4.4, 4.2, 9.0, torch.nan, 9.4]]).expand(1, 5, 6)
    expected = torch.tensor([[4.2, 4.2, 4.2, 9.2, torch.nan, 9.2]]).expand(1, 5, 6)
    assert_close(smooth(disparity, 2), expected, equal_nan=True)


def bridged_by_numpy(disparity: np.ndarray, step: float) -> np.ndarray:
    """NaN where neither the row nor the column has a known pixel of the same surface to either side."""
    result = disparity.copy()
    for y, x in np.argwhere(np.isnan(disparity)):
        lines = []
        for line, at in ((disparity[y], x), (disparity[:, x], y)):
            known = np.flatnonzero(~np.isnan(line))
            before, after = known[known < at], known[known > at]
            if len(before) and len(after) and abs(line[before[-1]] - line[after[0]]) <= step:
                lines.append(np.interp(at, known, line[known]))
        if lines:
            result[y, x] = np.mean(lines)
    return result


@pytest.mark.parametrize("step", [0.5, 2.0, 20.0])
@pytest.mark.parametrize("unknown", [0.3, 0.8])
def test_gaps_are_bridged_along_rows_and_columns(unknown: float, step: float) -> None:
    rough = (5 + 2 * torch.randn(11, 17)).double()
    gappy = rough.where(torch.rand(11, 17) >= unknown, torch.nan)
    assert_close(
        bridge_gaps(gappy, step), torch.from_numpy(bridged_by_numpy(gappy.numpy(), step)), equal_nan=True
    )


def test_a_plane_is_bridged_exactly_and_a_step_is_not() -> None:
    y, x = torch.meshgrid(torch.arange(12.0), torch.arange(20.0), indexing="ij")
    floor = 9 + 0.04 * x - 0.03 * y
    hole = floor.clone()
    hole[3:9, 5:14] = torch.nan
    assert_close(bridge_gaps(hole), floor)
    step = torch.where(x < 10, 4.0, 12.0)
    step[:, 7:13] = torch.nan
    assert_close(bridge_gaps(step), step, equal_nan=True)
    nothing = torch.full((4, 6), torch.nan)
    assert bridge_gaps(nothing).isnan().all()


def test_a_bounding_box_holds_all_masks_and_touches_them() -> None:
    for _ in range(20):
        mask = torch.rand(3, 9, 14) < 0.02
        mask[1, 4, 6] = True
        rows, columns = bounding_box(mask)
        assert mask[:, rows, columns].sum() == mask.sum()
        inside = mask[:, rows, columns].any(0)
        assert inside[0].any()
        assert inside[-1].any()
        assert inside[:, 0].any()
        assert inside[:, -1].any()
