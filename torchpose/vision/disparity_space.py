"""Disparity space over a region of the left image: how its cells are numbered, and the similarity of each.

A cell (x_left, d, y) claims that the left pixel (x_left, y) and the right pixel (x_left - d, y) show one
point.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from torchpose.vision.disparity import bounding_box

# GCS, step 4: the neighbours (dx_left, dx_right, dy) of a cell, in four sets of which each offers its best.
GROWTH = (
    ((-1, -1, 0), (-2, -1, 0), (-1, -2, 0)),
    ((1, 1, 0), (2, 1, 0), (1, 2, 0)),
    ((0, 0, -1), (-1, 0, -1), (1, 0, -1), (0, -1, -1), (0, 1, -1)),
    ((0, 0, 1), (-1, 0, 1), (1, 0, 1), (0, -1, 1), (0, 1, 1)),
)
REACH = 2  # columns that a growth step can cross


@dataclass(frozen=True)
class DisparitySpace:
    """Numbering of the cells by (item, row, layer, column), with padding that no growth step can leave.

    Layer 1 is the least disparity. A cell, its left pixel and its right pixel are one number each, and a
    growth step adds a constant to all three. A map holds one value per left pixel, padding included, and is
    flat.
    """

    batch: int
    top: int  # first row of the region
    left: int  # first column
    height: int
    width: int
    least: int  # px, disparity of layer 1
    disparities: int

    @classmethod
    def around(cls, mask: Bool[Tensor, "batch height width"], least: int, greatest: int) -> "DisparitySpace":
        """The space over the bounding box of all the masks."""
        rows, columns = bounding_box(mask)
        height, width = rows.stop - rows.start, columns.stop - columns.start
        return cls(mask.shape[0], rows.start, columns.start, height, width, least, greatest - least + 1)

    @property
    def layers(self) -> int:
        return self.disparities + 2

    @property
    def columns(self) -> int:
        return self.width + 2 * REACH

    @property
    def right_columns(self) -> int:
        return self.columns + self.layers - 1

    @property
    def left_pixels(self) -> int:
        return self.batch * (self.height + 2) * self.columns

    @property
    def right_pixels(self) -> int:
        return self.batch * (self.height + 2) * self.right_columns

    def crop(self, images: Tensor) -> Tensor:
        """The region of images (batch, height, width) of full size, as a view."""
        return images[:, self.top : self.top + self.height, self.left : self.left + self.width]

    def pad(
        self, region: Float[Tensor, "batch h w"] | Bool[Tensor, "batch h w"], value: float | bool
    ) -> Tensor:
        """The map of a region."""
        return F.pad(region, (REACH, REACH, 1, 1), value=value).flatten()

    def unpad(self, values: Float[Tensor, " pixels"]) -> Float[Tensor, "batch h w"]:
        """The region of a map, as a view."""
        return values.view(self.batch, -1, self.columns)[:, 1:-1, REACH:-REACH]

    def pixel(self, index: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
        """Left pixels of flat indices into the region."""
        item, rest = index // (self.height * self.width), index % (self.height * self.width)
        row, column = rest // self.width, rest % self.width
        return (item * (self.height + 2) + row + 1) * self.columns + column + REACH

    def cell(self, pixel: Int[Tensor, "*n"], layer: Int[Tensor, "*n"]) -> Int[Tensor, "*n"]:
        # Of a row's cells come `layers` times as many before it; divisions are slow, and one will do.
        return pixel + (pixel // self.columns * (self.layers - 1) + layer) * self.columns

    def layer(self, cell: Int[Tensor, "*n"]) -> Int[Tensor, "*n"]:
        return cell // self.columns % self.layers

    def left_pixel(self, cell: Int[Tensor, "*n"]) -> Int[Tensor, "*n"]:
        return cell // (self.columns * self.layers) * self.columns + cell % self.columns

    def right_pixel(self, pixel: Int[Tensor, "*n"], layer: Int[Tensor, "*n"]) -> Int[Tensor, "*n"]:
        """The right pixel that a left pixel means at a layer."""
        return pixel + pixel // self.columns * (self.layers - 1) - layer + self.layers - 1

    def steps(self, device: torch.device) -> Int[Tensor, "3 sets members"]:
        """What a step adds to a cell, to its left and to its right pixel; short sets repeat a member."""
        members = max(map(len, GROWTH))
        table = [[*group, *group[:1] * (members - len(group))] for group in GROWTH]
        dx_left, dx_right, dy = torch.tensor(table, device=device).unbind(-1)
        return torch.stack(
            [
                (dy * self.layers + dx_left - dx_right) * self.columns + dx_left,
                dy * self.columns + dx_left,
                dy * self.right_columns + dx_right,
            ]
        )


def similarities(
    left: Float[Tensor, "batch height width"],
    right: Float[Tensor, "batch height width"],
    mask: Bool[Tensor, "batch h w"],
    space: DisparitySpace,
    windows: tuple[int, ...],
    noise: float,
) -> Float[Tensor, " cells"]:
    """Similarity of each cell, the mean of MNCC over the windows; -1 in the padding, 0 off the mask.

    Grey images about 0 (their squares are summed), `mask` of the region, odd `windows` in px.
    """
    correlation = _Correlation(left, right, mask, space, windows, noise)
    volume = left.new_full((space.batch, space.height + 2, space.layers, space.columns), -1)
    for layer in range(1, space.disparities + 1):
        volume[:, 1:-1, layer, REACH:-REACH] = correlation.plane(layer)
    return volume.flatten()


class _Correlation:
    """Modified normalised cross-correlation c = 2 cov / (v_left + v_right), the mean over some window sizes.

    By box sums of a whole plane of the region at a time, so a cell costs the same whatever the window.
    `noise`, a grey value's standard deviation, is added to the variances, lest what is flat but for noise
    should match.
    """

    def __init__(
        self,
        left: Float[Tensor, "batch height width"],
        right: Float[Tensor, "batch height width"],
        mask: Bool[Tensor, "batch h w"],
        space: DisparitySpace,
        windows: tuple[int, ...],
        noise: float,
    ) -> None:
        margin = max(windows) // 2
        height, width = space.height + 2 * margin, space.width + 2 * margin
        first = space.left - (space.least + space.disparities - 1)  # column that the greatest disparity sees
        self.windows, self.noise, self.space = windows, noise, space
        self.left = crop_beyond(left, space.top - margin, space.left - margin, height, width)
        self.right = crop_beyond(
            right, space.top - margin, first - margin, height, width + space.disparities - 1
        )
        self.left_sums, left_variances = self._moments(self.left)
        self.right_sums, right_variances = self._moments(self.right)
        # An infinite variance makes the similarity 0: off the mask and off the right image.
        column = first + torch.arange(right_variances[0].shape[-1], device=mask.device)
        inside = (column >= 0) & (column < right.shape[-1])
        self.left_variances = [variance.where(mask, torch.inf) for variance in left_variances]
        self.right_variances = [variance.where(inside, torch.inf) for variance in right_variances]

    def _moments(
        self, image: Float[Tensor, "batch h_wide w_wide"]
    ) -> tuple[list[Float[Tensor, "batch h w"]], list[Float[Tensor, "batch h w"]]]:
        """For each size, s = sum / sqrt(a), and half of v = (sum of squares) - s^2, of the windows of area a.

        The latter times the number of sizes, so that the correlations add up to their mean.
        """
        totals = [
            total / side for total, side in zip(box_sums(image, self.windows), self.windows, strict=True)
        ]
        squares = box_sums(image.square(), self.windows)
        scale = 0.5 * len(self.windows)
        variances = [
            scale * ((square - total.square()).clamp_(min=0) + (side * self.noise) ** 2)
            for square, total, side in zip(squares, totals, self.windows, strict=True)
        ]
        return totals, variances

    def plane(self, layer: int) -> Float[Tensor, "batch h w"]:
        """Similarities at one layer, 1 to `disparities`."""
        start = self.space.disparities - layer
        centres = slice(start, start + self.space.width)
        products = self.left * self.right[..., start : start + self.left.shape[-1]]
        correlations = []
        for index, covariance in enumerate(box_sums(products, self.windows)):
            covariance.addcmul_(self.left_sums[index], self.right_sums[index][..., centres], value=-1)
            spread = self.left_variances[index] + self.right_variances[index][..., centres]
            correlations.append(covariance.div_(spread))
        for other in correlations[1:]:
            correlations[0] += other
        return correlations[0]


def box_sums(
    images: Float[Tensor, "batch h w"], windows: tuple[int, ...]
) -> list[Float[Tensor, "batch h_valid w_valid"]]:
    """Sums over windows of each odd size, about the centres of the whole windows of the largest inside the images.

    By doubling, ten times as fast as pooling; the sizes share their sums along the rows.
    """
    widest = max(windows)
    height, width = images.shape[1] - widest + 1, images.shape[2] - widest + 1
    along = _doubled(images, 2, widest)
    sums = []
    for window in windows:
        before = (widest - window) // 2
        rows = _window_sum(along, 2, window, before, width).narrow(1, before, height + window - 1)
        sums.append(_window_sum(_doubled(rows, 1, window), 1, window, 0, height))
    return sums


def _doubled(images: Tensor, dim: int, window: int) -> list[Tensor]:
    """Sums over 1, 2, 4, ... pixels from each on along an axis, as far as they fit into the window."""
    sums, span = [images], 1
    while 2 * span <= window:
        length = sums[-1].shape[dim] - span
        sums.append(sums[-1].narrow(dim, 0, length) + sums[-1].narrow(dim, span, length))
        span *= 2
    return sums


def _window_sum(doubled: list[Tensor], dim: int, window: int, start: int, size: int) -> Tensor:
    """Sums over `window` pixels from `start` on: one span for each one of the window's binary digits."""
    parts = []
    for digit in reversed(range(len(doubled))):
        if window >> digit & 1:
            parts.append(doubled[digit].narrow(dim, start, size))
            start += 1 << digit
    if len(parts) == 1:
        return parts[0].clone()
    total = parts[0] + parts[1]
    for part in parts[2:]:
        total += part
    return total


def crop_beyond(
    images: Float[Tensor, "batch height width"], top: int, left: int, height: int, width: int
) -> Float[Tensor, "batch h w"]:
    """A part of the images that may reach beyond their edges, where the edge repeats."""
    before = (max(0, -left), max(0, -top))
    after = (max(0, left + width - images.shape[2]), max(0, top + height - images.shape[1]))
    padded = F.pad(images[:, None], (before[0], after[0], before[1], after[1]), mode="replicate")[:, 0]
    top, left = top + before[1], left + before[0]
    return padded[:, top : top + height, left : left + width].contiguous()
