"""What every stereo matcher takes and gives: rectified pairs in, disparity with its confidence out.

Disparity d = x_left - x_right in px at the pixels of the left image; NaN where the pair does not tell.
"""

from dataclasses import dataclass

import cv2
import torch
from jaxtyping import Bool, Float, Int
from kornia.color import rgb_to_grayscale
from torch import Tensor, nn

Grey = Float[Tensor, "batch height width"]


@dataclass(frozen=True)
class Disparity:
    """What a matcher found, at the pixels of the left image."""

    values: Float[Tensor, "batch height width"]  # px; NaN where not certain
    confidence: Float[Tensor, "batch height width"]  # in [0, 1], 0 where NaN; its scale is the matcher's own


@dataclass(frozen=True)
class MatchingTask:
    """What there is to match, checked and complete: grey pairs, and at least one pixel of their masks."""

    left: Grey
    right: Grey
    mask: Bool[Tensor, "batch height width"]  # left pixels to match
    seeds: Grey | None  # px, known beforehand; NaN for none
    least: int  # px, the disparities to search
    greatest: int

    def unanswered(self) -> Disparity:
        """No disparity anywhere, to be filled in."""
        return Disparity(torch.full_like(self.left, torch.nan), torch.zeros_like(self.left))


class StereoMatcher(nn.Module):
    """The interface of the matchers, and the checks that they share; a matcher fills in `match`."""

    @torch.no_grad()
    def forward(
        self,
        left: Float[Tensor, "batch 3 height width"],
        right: Float[Tensor, "batch_right 3 height_right width_right"],
        mask: Bool[Tensor, "batch_mask height_mask width_mask"] | None = None,
        seeds: Float[Tensor, "batch_seeds height_seeds width_seeds"] | None = None,
        disparity_range: tuple[int, int] = (0, 96),
    ) -> Disparity:
        """Match rectified pairs, each by itself. No gradient flows.

        Args:
            left, right: RGB in [0, 1].
            mask: left pixels to match, all if None. Their bounding box bounds the cost.
            seeds: disparities (px) known beforehand at left pixels, such as the last frame's; NaN for none.
            disparity_range: (least, greatest) px, inclusive.

        Raises ValueError where sizes differ or the range is empty.
        """
        least, greatest = disparity_range
        if least > greatest:
            raise ValueError(
                f"the disparity range must not be empty, got {least} to {greatest} px; give the least one first"
            )
        _check_sizes(left, right, mask, seeds)
        grey = rgb_to_grayscale(left)[:, 0]
        if mask is None:
            mask = torch.ones_like(grey, dtype=torch.bool)
        task = MatchingTask(grey, rgb_to_grayscale(right)[:, 0], mask, seeds, least, greatest)
        return self.match(task) if mask.any() else task.unanswered()

    def match(self, task: MatchingTask) -> Disparity:
        """The disparities of a task."""
        raise NotImplementedError


def bounding_box(mask: Bool[Tensor, "batch height width"]) -> tuple[slice, slice]:
    """Rows and columns that hold all of the masks' pixels, of which there is one at least."""
    held = mask.view(torch.uint8).amax(0)  # the greatest byte is found fifty times as fast as any True
    rows, columns = held.amax(1).nonzero()[:, 0], held.amax(0).nonzero()[:, 0]
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def without_islands(disparity: Grey, area: int) -> Grey:
    """NaN where fewer than `area` pixels hang together, by steps to a side of at most 1 px. By OpenCV, on the CPU."""
    if area <= 1:
        return disparity
    none, fraction = -32768, 16  # OpenCV's fixed point
    steps = (disparity * fraction).round().nan_to_num(none).to(torch.int16).cpu().numpy()
    for image in steps:
        cv2.filterSpeckles(image, none, area - 1, fraction)
    return disparity.where(torch.from_numpy(steps != none).to(disparity.device), torch.nan)


def smooth(disparity: Grey, radius: int) -> Grey:
    """Mean of the neighbours in a square whose disparity is within 1 px of the pixel's own; NaN stays NaN."""
    if radius == 0:
        return disparity
    total, count = torch.zeros_like(disparity), torch.ones_like(disparity)
    height, width = disparity.shape[1:]
    down, across = min(radius, height - 1), min(radius, width - 1)
    # Who is near whom goes both ways, so half of the square will do.
    for row in range(down + 1):
        for column in range(-across if row else 1, across + 1):
            one = (slice(None), slice(row, None), slice(max(0, column), width + min(0, column)))
            other = (slice(None), slice(None, height - row), slice(max(0, -column), width - max(0, column)))
            difference = disparity[one] - disparity[other]
            near = (difference.abs() <= 1).to(difference)  # 0 for NaN
            count[one] += near
            count[other] += near
            difference.nan_to_num_().mul_(near)
            total[one] -= difference
            total[other] += difference
    return disparity + total / count


def bridge_gaps(disparity: Float[Tensor, "height width"], step: float = 1.0) -> Float[Tensor, "height width"]:
    """Where a scene's disparity (px) is unknown, a straight line between its neighbours, if they are of one surface.

    The nearest known pixels to either side of a row, and of a column, belong together if they differ by at most
    `step` px; a pixel between two such pairs takes the mean of both lines. Other gaps stay NaN: depth may end there.
    """
    lines = torch.stack([_bridged(disparity, step), _bridged(disparity.t(), step).t()])
    return disparity.where(~disparity.isnan(), lines.nanmean(0))


def nearest_known(
    known: Bool[Tensor, "lines size"],
) -> tuple[Int[Tensor, "lines size"], Int[Tensor, "lines size"]]:
    """Columns of the known pixels next to each on the left and on the right, its own where it is known.

    -1 and `size` where there is none.
    """
    size = known.shape[1]
    place = torch.arange(size, device=known.device).expand_as(known)
    before = place.where(known, -1).cummax(1).values
    return before, place.where(known, size).flip(1).cummin(1).values.flip(1)


def _bridged(disparity: Float[Tensor, "lines size"], step: float) -> Float[Tensor, "lines size"]:
    """The lines between the known pixels of each row; NaN where none spans the pixel."""
    size = disparity.shape[1]
    before, after = nearest_known(~disparity.isnan())
    first, last = disparity.gather(1, before.clamp_min(0)), disparity.gather(1, after.clamp_max(size - 1))
    place = torch.arange(size, device=disparity.device)
    share = (place - before) / (after - before).clamp_min(1)
    joined = (before >= 0) & (after < size) & ((first - last).abs() <= step)
    return torch.lerp(first, last, share.to(disparity)).where(joined, torch.nan)


def _check_sizes(left: Tensor, right: Tensor, mask: Tensor | None, seeds: Tensor | None) -> None:
    if left.shape != right.shape:
        raise ValueError(
            f"left and right must have the same shape, got {tuple(left.shape)} and {tuple(right.shape)}; "
            "rectify both to one size"
        )
    size = (left.shape[0], *left.shape[2:])
    for name, image in (("mask", mask), ("seeds", seeds)):
        if image is not None and image.shape != size:
            raise ValueError(
                f"{name} must have the left images' shape {size}, got {tuple(image.shape)}; resize it"
            )
