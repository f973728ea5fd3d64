"""Bodies are solid: no limb runs through trunk or head, however well it would explain their points there.

Left-camera frame, metres.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.body.ellipsoid import FEW_STEPS, FootPoint, foot_point, to_camera
from torchpose.body.model import PosedBody
from torchpose.registration.fitting import Rows


@dataclass(frozen=True)
class SolidConfig:
    sd: float = (
        0.01  # m that a limb's middle lies too deep, which cost as much as one sigma; 0 switches it off
    )
    margin: float = 0.015  # m below the surface, from which that is: true poses lie 1.8 cm deep at most

    def __post_init__(self) -> None:
        if self.sd < 0 or self.margin < 0:
            raise ValueError(f"sd and margin must not be negative, got {self}; sd=0 switches the term off")


def parts_of(posed: PosedBody, parts: Int[Tensor, " some"]) -> PosedBody:
    """Some ellipsoids of bodies."""
    return replace(posed, **{name: getattr(posed, name)[:, parts] for name in ("centers", "frames", "radii")})


def solid_residual(
    trunk: PosedBody, middles: Float[Tensor, "batch middles 3"], config: SolidConfig
) -> Float[Tensor, "batch core middles"]:
    """How far middles of limbs lie too deep below the surfaces of trunk and head, no unit."""
    return _too_deep(foot_point(trunk, middles, False, FEW_STEPS), config)


def solid_rows(
    posed: PosedBody, limbs: Int[Tensor, " own"], core: Int[Tensor, " others"], config: SolidConfig
) -> Rows:
    """Rows of these residuals: each middle is drawn out by the shortest way; empty ones where it is not too deep.

    Args:
        limbs: the parts of all limbs.
        core: all others, trunk and head.
    """
    trunk = parts_of(posed, core)
    foot = foot_point(trunk, posed.centers[:, limbs], False, FEW_STEPS)
    normal, surface = foot.normal @ trunk.frames.mT, to_camera(trunk, foot.local)
    inside = (_too_deep(foot, config) > 0)[..., None]
    part = limbs.expand(*normal.shape[:2], -1)
    return Rows(
        part.flatten(1),
        torch.zeros_like(normal).flatten(1, 2),
        (surface - config.margin * normal).flatten(1, 2),
        (normal * inside / config.sd).flatten(1, 2),
    )


def _too_deep(foot: FootPoint, config: SolidConfig) -> Tensor:
    depth = -(foot.residual * foot.normal).sum(-1)
    return (depth - config.margin).clamp_min(0) / config.sd
