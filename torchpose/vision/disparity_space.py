"""Disparity space over a region of the left image: how its cells are numbered, and the similarity of each.

A cell (x_left, d, y) claims that the left pixel (x_left, y) and the right pixel (x_left - d, y) show one
point.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

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
        rows, columns = mask.any(2).any(0).nonzero()[:, 0], mask.any(1).any(0).nonzero()[:, 0]
        top, left = int(rows[0]), int(columns[0])
        height, width = int(rows[-1]) + 1 - top, int(columns[-1]) + 1 - left
        return cls(mask.shape[0], top, left, height, width, least, greatest - least + 1)

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
    planes = [_Correlation(left, right, mask, space, window, noise) for window in windows]
    volume = left.new_full((space.batch, space.height + 2, space.layers, space.columns), -1)
    for layer in range(1, space.disparities + 1):
        total = planes[0].plane(layer)
        for correlation in planes[1:]:
            total += correlation.plane(layer)
        torch.div(total, len(planes), out=volume[:, 1:-1, layer, REACH:-REACH])
    return volume.flatten()


class _Correlation:
    """Modified normalised cross-correlation of one window size: c = 2 cov / (v_left + v_right).

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
        window: int,
        noise: float,
    ) -> None:
        margin = window // 2
        height, width = space.height + 2 * margin, space.width + 2 * margin
        first = space.left - (space.least + space.disparities - 1)  # column that the greatest disparity sees
        self.window, self.space = window, space
        self.left = crop_beyond(left, space.top - margin, space.left - margin, height, width)
        self.right = crop_beyond(
            right, space.top - margin, first - margin, height, width + space.disparities - 1
        )
        self.left_sum, left_variance = self._moments(self.left, noise)
        self.right_sum, right_variance = self._moments(self.right, noise)
        # An infinite variance makes the similarity 0: off the mask and off the right image.
        column = first + torch.arange(right_variance.shape[-1], device=mask.device)
        self.left_variance = left_variance.where(mask, torch.inf)
        self.right_variance = right_variance.where((column >= 0) & (column < right.shape[-1]), torch.inf)

    def _moments(
        self, image: Float[Tensor, "batch h_wide w_wide"], noise: float
    ) -> tuple[Float[Tensor, "batch h w"], Float[Tensor, "batch h w"]]:
        """s = sum / sqrt(a), and half of v = (sum of squares) - s^2, of the windows of area a."""
        total = box_sum(image, self.window) / self.window
        variance = box_sum(image.square(), self.window) - total.square()
        return total, 0.5 * variance.clamp(min=0) + 0.5 * (self.window * noise) ** 2

    def plane(self, layer: int) -> Float[Tensor, "batch h w"]:
        """Similarities at one layer, 1 to `disparities`."""
        start = self.space.disparities - layer
        centres = slice(start, start + self.space.width)
        covariance = box_sum(self.left * self.right[..., start : start + self.left.shape[-1]], self.window)
        covariance.addcmul_(self.left_sum, self.right_sum[..., centres], value=-1)
        return covariance.div_(self.left_variance + self.right_variance[..., centres])


def box_sum(images: Float[Tensor, "batch h w"], window: int) -> Float[Tensor, "batch h_valid w_valid"]:
    """Sums over the whole windows inside the images, by doubling: ten times as fast as pooling."""
    for dim in (-2, -1):
        size = images.shape[dim] - window + 1
        total, span = images, 1
        while 2 * span <= window:
            length = total.shape[dim] - span
            total = total.narrow(dim, 0, length) + total.narrow(dim, span, length)
            span *= 2
        for offset in range(span, window):
            total = total.narrow(dim, 0, size) + images.narrow(dim, offset, size)
        images = total
    return images


def crop_beyond(
    images: Float[Tensor, "batch height width"], top: int, left: int, height: int, width: int
) -> Float[Tensor, "batch h w"]:
    """A part of the images that may reach beyond their edges, where the edge repeats."""
    before = (max(0, -left), max(0, -top))
    after = (max(0, left + width - images.shape[2]), max(0, top + height - images.shape[1]))
    padded = F.pad(images[:, None], (before[0], after[0], before[1], after[1]), mode="replicate")[:, 0]
    top, left = top + before[1], left + before[0]
    return padded[:, top : top + height, left : left + width].contiguous()
