"""The way somebody walks, and so faces: where the trunk was a while ago tells it in profile, when nothing else does.

Left-camera frame, metres, radians and seconds; the yaw is that of a body that faces the way.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class WalkConfig:
    """When somebody walks, and what facing another way costs."""

    span: float = 0.8  # s over which the way is measured
    speed: float = 0.5  # m/s, from which somebody faces the way
    backwards_penalty: float = (
        15.0  # nats that a pose turned against the way must make good; 0: it says nothing
    )

    def __post_init__(self) -> None:
        for name in ("span", "speed"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if not self.backwards_penalty >= 0:
            raise ValueError(f"backwards_penalty must not be negative, got {self.backwards_penalty} nats")


def yaw_of_way(
    elapsed: Float[Tensor, "*batch"], way: Float[Tensor, "*batch 2"], config: WalkConfig = WalkConfig()
) -> Float[Tensor, "*batch"]:
    """Yaw of whoever went a way (x, z), m, in a time, s; NaN where that was too slow, or half the span is not over."""
    walks = (elapsed >= 0.5 * config.span - 1e-6) & (way.norm(dim=-1) >= config.speed * elapsed)
    return torch.where(walks, torch.atan2(-way[..., 0], -way[..., 1]), torch.nan)


def walking_yaw(
    time_s: Float[Tensor, " frames"], place: Float[Tensor, "frames 3"], config: WalkConfig = WalkConfig()
) -> Float[Tensor, " frames"]:
    """Yaw of the way that somebody goes within the span about each frame; NaN of whoever does not walk.

    `place` is of the trunk, m. Frames near the ends have but half of the span; with less it is NaN.
    """
    near = (time_s[:, None] - time_s).abs() <= config.span / 2 + 1e-6
    # Time rises: the first and the last one of a row are its ends.
    first = near.to(torch.uint8).argmax(1)
    last = len(time_s) - 1 - near.flip(1).to(torch.uint8).argmax(1)
    elapsed, way = (time_s[last] - time_s[first]).to(place), place[last] - place[first]
    return yaw_of_way(elapsed, way[:, [0, 2]], config)


def backwards_cost(
    yaw: Float[Tensor, " batch"], way: Float[Tensor, " batch"] | float, config: WalkConfig = WalkConfig()
) -> Float[Tensor, " batch"]:
    """What it costs to face `yaw` while walking with the yaw `way`, nats: nothing that way, all of it backwards."""
    return config.backwards_penalty * (1 - (yaw - way).cos()) / 2
