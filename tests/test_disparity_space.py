"""Disparity space: the numbers of its cells against an array's own, its similarities against their definition."""

import numpy as np
import pytest
import torch
from stereo_scene import correlation
from torch.nn import functional as F
from torch.testing import assert_close

from torchpose.vision.disparity_space import GROWTH, DisparitySpace, box_sums, crop_beyond, similarities


def test_similarities_are_their_definition() -> None:
    """Against patches cut from the images, at all kinds of places of a region inside a larger image."""
    left, right = (torch.rand(1, 24, 40, dtype=torch.float64) for _ in range(2))
    mask = torch.zeros(1, 24, 40, dtype=torch.bool)
    mask[0, 3:20, 5:30] = True
    space = DisparitySpace.around(mask, 2, 9)
    inside = space.crop(mask).clone()
    inside[0, 4, 7] = False
    volume = similarities(left, right, inside, space, (5,), 0.01).view(1, 19, 10, 29)
    padded = [np.pad(image[0].numpy(), 2, mode="edge") for image in (left, right)]
    for y, x, d in [(3, 5, 2), (19, 29, 9), (10, 12, 5), (3, 29, 2), (12, 9, 9), (18, 20, 7)]:
        expected = correlation(*padded, y, x, x - d, 0.01)
        assert volume[0, y - 3 + 1, d - 2 + 1, x - 5 + 2].item() == pytest.approx(expected, abs=1e-12)
    assert volume[0, 1, 8, 2] == 0  # x = 5, d = 9: the right image ends
    assert (volume[0, 5, 1:-1, 9] == 0).all()  # off the mask
    assert (volume[:, [0, -1]] == -1).all()
    assert (volume[:, :, [0, -1]] == -1).all()
    assert (volume[..., [0, 1, -2, -1]] == -1).all()


def test_similarities_end_where_the_right_image_ends() -> None:
    left, right = torch.rand(2, 1, 9, 12, dtype=torch.float64)
    mask = torch.ones(1, 9, 12, dtype=torch.bool)
    space = DisparitySpace.around(mask, -4, 6)
    volume = similarities(left, right, mask, space, (5,), 0.01).view(11, 13, 16)[1:-1, 1:-1, 2:-2]
    column = torch.arange(12) - torch.arange(-4, 7)[:, None]
    assert torch.equal(volume != 0, ((column >= 0) & (column < 12)).expand_as(volume))


@pytest.mark.parametrize("windows", [(3,), (5,), (9, 5), (5, 9), (3, 7, 13), (1, 11)])
def test_box_sums_are_pooling(windows: tuple[int, ...]) -> None:
    image = torch.rand(2, 20, 31, dtype=torch.float64)
    sums = box_sums(image, windows)
    for window, found in zip(windows, sums, strict=True):
        inner = (max(windows) - window) // 2
        centred = image[:, inner : 20 - inner, inner : 31 - inner]
        assert_close(found, F.avg_pool2d(centred[:, None], window, 1, divisor_override=1)[:, 0])


def test_steps_lead_to_the_papers_neighbours() -> None:
    space = DisparitySpace(2, 0, 0, 9, 11, 0, 8)
    shape = (2, 11, 10, 15)  # item, row, layer, column
    index = torch.arange(2 * 11 * 10 * 15).view(shape)
    start = index[1, 5, 4, 7]
    left = space.left_pixel(start)
    right = space.right_pixel(left, space.layer(start))
    steps = space.steps(start.device)
    for number, group in enumerate(GROWTH):
        for member, (dx_left, dx_right, dy) in enumerate(group):
            by_cell, by_left, by_right = steps[:, number, member]
            neighbour = index[1, 5 + dy, 4 + dx_left - dx_right, 7 + dx_left]
            assert start + by_cell == neighbour
            assert left + by_left == space.left_pixel(neighbour)
            assert right + by_right == space.right_pixel(left + by_left, space.layer(neighbour))
            assert space.cell(left + by_left, space.layer(neighbour)) == neighbour


def test_one_right_pixel_is_shared_by_the_cells_that_see_it() -> None:
    space = DisparitySpace(1, 0, 0, 4, 10, 0, 6)
    pixel = space.pixel(torch.tensor([17, 18, 20]))  # row 1, columns 7, 8, 10 - wraps to row 2, column 0
    right = space.right_pixel(pixel, torch.tensor([2, 3, 2]))
    assert right[0] == right[1]
    assert right[2] != right[0]


def test_the_space_is_the_box_about_all_masks() -> None:
    mask = torch.zeros(3, 30, 50, dtype=torch.bool)
    mask[0, 7:12, 20:31], mask[2, 10:25, 14] = True, True
    space = DisparitySpace.around(mask, -3, 4)
    assert space == DisparitySpace(3, 7, 14, 18, 17, -3, 8)
    images = torch.rand(3, 30, 50)
    assert_close(space.crop(images), images[:, 7:25, 14:31])
    padded = space.pad(space.crop(images), -2.0)
    assert len(padded) == space.left_pixels
    assert_close(space.unpad(padded), space.crop(images))
    assert (padded == -2).sum() == 3 * (20 * 21 - 18 * 17)
    index = torch.arange(3 * 18 * 17)
    assert_close(padded[space.pixel(index)], space.crop(images).flatten())


def test_every_cell_has_its_number() -> None:
    space = DisparitySpace(2, 5, 3, 4, 6, -2, 3)
    number = torch.arange(2 * 6 * 5 * 10).view(2, 6, 5, 10)  # item, row, layer, column, with the padding
    item, row, layer, column = (
        part.flatten() for part in torch.meshgrid(*map(torch.arange, number.shape), indexing="ij")
    )
    cell = number.flatten()
    pixel = (item * 6 + row) * 10 + column
    assert torch.equal(space.layer(cell), layer)
    assert torch.equal(space.left_pixel(cell), pixel)
    assert torch.equal(space.cell(pixel, layer), cell)
    # Two cells share a right pixel if and only if they have the item, the row and column - layer in common.
    right = space.right_pixel(pixel, layer)
    assert right.min() >= 0
    assert right.max() < space.right_pixels
    place = torch.stack([item, row, column - layer], 1)
    assert torch.equal(right[:, None] == right, (place[:, None] == place).all(2))


def test_a_growth_step_from_inside_stays_in_the_padding() -> None:
    space = DisparitySpace(1, 0, 0, 3, 5, 0, 4)
    pixels, layers = torch.meshgrid(space.pixel(torch.arange(15)), torch.arange(1, 5), indexing="ij")
    cell = space.cell(pixels, layers).flatten()
    row, layer, column = cell // 54, cell // 9 % 6, cell % 9
    for dx_left, dx_right, dy in (member for group in GROWTH for member in group):
        for place, change, size in ((row, dy, 5), (layer, dx_left - dx_right, 6), (column, dx_left, 9)):
            assert ((place + change >= 0) & (place + change < size)).all()


def test_the_similarity_of_two_windows_is_their_mean() -> None:
    left, right = (torch.rand(2, 20, 30, dtype=torch.float64) - 0.5 for _ in range(2))
    mask = torch.rand(2, 20, 30) < 0.9
    space = DisparitySpace.around(mask, -4, 3)
    three, five, both = (
        similarities(left, right, space.crop(mask), space, windows, 0.01) for windows in ((3,), (5,), (3, 5))
    )
    assert_close(both, (three + five) / 2)
    assert not torch.equal(three, five)


@pytest.mark.parametrize("gain", [1.0, 0.5, -1.0])
def test_a_change_of_contrast_lowers_the_similarity_and_noise_ends_it(gain: float) -> None:
    """2 a / (1 + a^2) for a gain of a and any offset; with noise far beyond the contrast, nothing is alike."""
    image = torch.rand(1, 12, 16, dtype=torch.float64) - 0.5
    mask = torch.ones(1, 12, 16, dtype=torch.bool)
    space = DisparitySpace.around(mask, 0, 0)

    def at_zero(noise: float) -> torch.Tensor:
        volume = similarities(image, gain * image + 0.1, mask, space, (5,), noise)
        return volume.view(1, 14, 3, 20)[:, 1:-1, 1, 2:-2]

    assert_close(at_zero(1e-9), torch.full_like(image, 2 * gain / (1 + gain**2)))
    assert at_zero(100.0).abs().max() < 1e-4


@pytest.mark.parametrize(
    ("top", "left", "height", "width"),
    [(2, 3, 4, 5), (-3, -2, 20, 30), (8, 12, 6, 9), (-9, -20, 3, 4), (30, 40, 2, 3)],
)
def test_beyond_an_image_its_edge_repeats(top: int, left: int, height: int, width: int) -> None:
    images = torch.rand(2, 10, 14)
    rows = torch.arange(top, top + height).clamp(0, 9)
    columns = torch.arange(left, left + width).clamp(0, 13)
    assert_close(crop_beyond(images, top, left, height, width), images[:, rows][:, :, columns])
