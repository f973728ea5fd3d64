"""What a body hides of itself: a part that lies behind another one at a point's pixel cannot have given the point.

Left-camera frame, metres.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body.model import PosedBody


@dataclass(frozen=True)
class OcclusionConfig:
    penalty: float = 5.0  # nats against a part that another one hides; 0 switches the term off
    margin: float = 0.02  # m behind the other one's surface, from which it counts
    ramp: float = 0.03  # m more, at which it counts in full: bodies are not quite ellipsoids

    def __post_init__(self) -> None:
        if self.penalty < 0 or self.margin < 0 or not self.ramp > 0:
            raise ValueError(f"penalty >= 0, margin >= 0 and ramp > 0 must hold, got {self}")


def depth_behind(posed: PosedBody, points: Float[Tensor, "batch num 3"]) -> Float[Tensor, "batch parts num"]:
    """How far each part lies behind the nearest other part along the points' rays, m, negative where before it.

    A part lies where the ray enters it, or where a ray that misses it comes nearest (in the stretched space in which
    it is the unit ball). Where the ray meets no other part it is minus infinity.
    """
    # Padding lies in the camera, where no ray begins: any will do.
    depth = torch.where(points[..., 2:] > 0, points[..., 2:], 1.0)
    ray = torch.cat([points[..., :2] / depth, torch.ones_like(depth)], -1)
    camera = -(posed.centers[:, :, None] @ posed.frames) / posed.radii[:, :, None]  # (B, K, 1, 3)
    way = (ray[:, None] @ posed.frames) / posed.radii[:, :, None]
    # |camera + s way|^2 = 1
    a = (way * way).sum(-1)
    b = (way * camera).sum(-1)
    root = b * b - a * ((camera * camera).sum(-1) - 1)
    enters = (-b - root.clamp_min(0).sqrt()) / a
    front = torch.where(root > 0, enters, torch.inf)
    two = front.topk(2, 1, largest=False)
    parts = torch.arange(front.shape[1], device=front.device)[:, None]
    other = torch.where(two.indices[:, :1] == parts, two.values[:, 1:], two.values[:, :1])
    return enters - other


def occlusion_potential(
    posed: PosedBody, points: Float[Tensor, "batch num 3"], config: OcclusionConfig
) -> Float[Tensor, "batch num parts"]:
    """Log-potentials of the parts: minus the penalty where they are hidden, 0 where they are not."""
    behind = depth_behind(posed, points) - config.margin
    return -config.penalty * (behind / config.ramp).clamp(0, 1).mT
