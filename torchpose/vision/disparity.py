"""What every stereo matcher takes and gives: rectified pairs in, disparity with its confidence out.

Disparity d = x_left - x_right in px at the pixels of the left image; NaN where the pair does not tell.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from kornia.color import rgb_to_grayscale
from torch import Tensor, nn

Grey = Float[Tensor, "batch height width"]


@dataclass(frozen=True)
class Disparity:
    """What a matcher found, at the pixels of the left image."""

    values: Float[Tensor, "batch height width"]  # px; NaN where not certain
    confidence: Float[Tensor, "batch height width"]  # in [0, 1], 0 where NaN; its scale is the matcher's own


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
        if not mask.any():
            return Disparity(torch.full_like(grey, torch.nan), torch.zeros_like(grey))
        return self.match(grey, rgb_to_grayscale(right)[:, 0], mask, seeds, least, greatest)

    def match(
        self,
        left: Grey,
        right: Grey,
        mask: Bool[Tensor, "batch height width"],
        seeds: Grey | None,
        least: int,
        greatest: int,
    ) -> Disparity:
        """Disparities `least` to `greatest` of grey pairs at the mask's pixels, of which there is one at least."""
        raise NotImplementedError


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
