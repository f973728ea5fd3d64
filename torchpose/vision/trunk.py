"""Where the trunk is: mean shift on the cloud, weighted by the person's colours (T. 4.3.1).

Left-camera frame, metres.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.vision.mean_shift import MeanShiftConfig, mean_shift


@dataclass(frozen=True)
class TrunkConfig:
    """Settings of `find_trunk`."""

    # Wide enough that arms before the chest and thighs are no place of their own.
    shift: MeanShiftConfig = field(default_factory=lambda: MeanShiftConfig(bandwidth=0.25))
    inset: float = 0.10  # m, from the middle of the surface seen to the trunk's
    sd: float = 0.06  # m, of each coordinate, of a trunk that is wholly seen
    least_points: float = 20.0  # weight within reach, below which nobody is there

    def __post_init__(self) -> None:
        if not self.sd > 0:
            raise ValueError(f"sd must be positive, got {self.sd} m")


@dataclass(frozen=True)
class Trunk:
    """The trunk's middle."""

    position: Float[Tensor, "batch 3"]  # m; NaN where nobody is found
    sd: Float[Tensor, " batch"]  # m, of each coordinate; NaN where none
    found: Bool[Tensor, " batch"]


def find_trunk(
    points: Float[Tensor, "batch num 3"],
    weights: Float[Tensor, "batch num"] | Bool[Tensor, "batch num"],
    config: TrunkConfig = TrunkConfig(),
    expected: Float[Tensor, "batch 3"] | None = None,
) -> Trunk:
    """The densest place of a person's points: the trunk is the broadest of what is seen.

    Args:
        points: m, on a regular grid of pixels, one person an item of the batch.
        weights: 0 on padding; a mask, or the back-projection of the person's colours at the points.
        expected: m, where the climb begins, such as the filter's prediction, so that in a crowd's cloud the own trunk
            is found; NaN, or nobody near it: at the points' weighted middle.
    """
    weights = weights.to(points)
    there = (weights > 0)[..., None]
    # The middle of each coordinate: half of the weight lies below it.
    order = torch.where(there, points, torch.inf).sort(dim=1)
    ranked = weights[..., None].expand_as(points).gather(1, order.indices).cumsum(1)
    half = torch.searchsorted(ranked.mT.contiguous(), 0.5 * ranked[:, -1:].mT.contiguous())
    start = order.values.gather(1, half.mT.clamp_max(points.shape[1] - 1))  # (B, 1, 3)
    mode = mean_shift(points, weights, start, config.shift)
    place, weight = mode.position[:, 0], mode.weight[:, 0]
    if expected is not None:
        # The surface is nearer than the trunk's middle that is expected.
        begin = expected - config.inset * expected / expected.norm(dim=-1, keepdim=True)
        own = mean_shift(points, weights, begin[:, None], config.shift)
        near = own.weight[:, 0] >= config.least_points
        place = torch.where(near[:, None], own.position[:, 0], place)
        weight = torch.where(near, own.weight[:, 0], weight)
    found = weight >= config.least_points
    ray = place / place.norm(dim=-1, keepdim=True)
    position = torch.where(found[:, None], place + config.inset * ray, torch.nan)
    return Trunk(position, torch.where(found, config.sd, torch.nan).to(points), found)
