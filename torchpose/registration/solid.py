"""Bodies are solid: no limb runs through trunk or head, however well it would explain their points there.

Left-camera frame, metres.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.body.ellipsoid import FEW_STEPS, FootPoint, foot_point
from torchpose.body.model import BodyModel, PosedBody
from torchpose.registration.fitting import Rows


@dataclass(frozen=True)
class SolidConfig:
    sd: float = (
        0.01  # m that a limb's middle lies too deep, which cost as much as one sigma; 0 switches it off
    )
    margin: float = 0.015  # m below the surface, from which that is: of synthetic people none lies deeper

    def __post_init__(self) -> None:
        if self.sd < 0 or self.margin < 0:
            raise ValueError(f"sd and margin must not be negative, got {self}; sd=0 switches the term off")


def limb_roots(body: BodyModel) -> list[int]:
    """The first body of each limb, numbered from 1: one on the root that others hang from."""
    return [k for k, parent in enumerate(body.parents, 1) if parent == 0 and k in body.parents]


def limb_parts(body: BodyModel) -> Int[Tensor, " own"]:
    """The parts of all limbs: what their first joints move."""
    first = [6 + 2 * (k - 1) for k in limb_roots(body)]
    return body.part_moves[:, first].any(1).nonzero()[:, 0]


def core_of(posed: PosedBody, limbs: Int[Tensor, " own"]) -> PosedBody:
    """Trunk and head: the ellipsoids that are of no limb."""
    every = torch.ones(posed.centers.shape[1], dtype=torch.bool, device=limbs.device)
    core = every.index_fill(0, limbs, False)
    return replace(posed, **{name: getattr(posed, name)[:, core] for name in ("centers", "frames", "radii")})


def solid_residual(
    core: PosedBody, middles: Float[Tensor, "batch middles 3"], config: SolidConfig
) -> Float[Tensor, "batch core middles"]:
    """How far middles of limbs lie too deep below each surface, no unit."""
    return _too_deep(foot_point(core, middles, False, FEW_STEPS), config)


def solid_rows(posed: PosedBody, limbs: Int[Tensor, " own"], config: SolidConfig) -> Rows:
    """Rows of these residuals: each middle is drawn out by the shortest way; empty ones where it is not too deep."""
    core = core_of(posed, limbs)
    foot = foot_point(core, posed.centers[:, limbs], False, FEW_STEPS)
    normal = (core.frames[:, :, None] @ foot.normal[..., None])[..., 0]
    surface = (core.frames[:, :, None] @ foot.local[..., None])[..., 0] + core.centers[:, :, None]
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
