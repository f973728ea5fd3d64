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

    def potential(self, behind: Float[Tensor, "batch parts num"]) -> Float[Tensor, "batch parts num"]:
        """Log-potentials of parts that lie so far behind others, m."""
        return -self.penalty * ((behind - self.margin) / self.ramp).clamp(0, 1)


def depth_behind(posed: PosedBody, points: Float[Tensor, "batch num 3"]) -> Float[Tensor, "batch parts num"]:
    """How far each part lies behind the nearest other part along the points' rays, m, negative where before it.

    A part lies where the ray enters it, or where a ray that misses it comes nearest (in the stretched space in which
    it is the unit ball). Where the ray meets no other part it is minus infinity.
    """
    return behind(*entries(posed, points))


def behind(
    enters: Float[Tensor, "batch parts num"], front: Float[Tensor, "batch parts num"]
) -> Float[Tensor, "batch parts num"]:
    """`depth_behind` from the `entries`."""
    # By least values alone: `topk` and `min` with indices take ten times as long.
    first = front.amin(1, keepdim=True)
    is_first = front == first
    second = torch.where(is_first, torch.inf, front).amin(1, keepdim=True)
    second = torch.where(is_first.sum(1, keepdim=True) > 1, first, second)
    return enters - torch.where(is_first, second, first)


def entries(
    posed: PosedBody, points: Float[Tensor, "batch num 3"]
) -> tuple[Float[Tensor, "batch parts num"], Float[Tensor, "batch parts num"]]:
    """Where the points' rays enter each part, or come nearest, m of depth; and that, infinite where they miss it."""
    # Padding lies in the camera, where no ray begins: any will do.
    depth = torch.where(points[..., 2:] > 0, points[..., 2:], 1.0)
    ray = torch.cat([points[..., :2] / depth, torch.ones_like(depth)], -1)
    unit = posed.frames.mT / posed.radii[..., None]  # to the space in which each part is the unit ball
    camera = -(unit @ posed.centers[..., None])[..., 0]  # (B, K, 3)
    way = (unit.flatten(1, 2) @ ray.mT).unflatten(
        1, unit.shape[1:3]
    )  # (B, K, 3, N): coordinates before points
    # |camera + s way|^2 = 1
    a = way.square().sum(2)
    b = (way * camera[..., None]).sum(2)
    root = b * b - a * (camera.square().sum(-1, keepdim=True) - 1)
    enters = (-b - root.clamp_min(0).sqrt()) / a
    return enters, torch.where(root > 0, enters, torch.inf)


def occlusion_potential(
    posed: PosedBody, points: Float[Tensor, "batch num 3"], config: OcclusionConfig
) -> Float[Tensor, "batch num parts"]:
    """Log-potentials of the parts: minus the penalty where they are hidden, 0 where they are not."""
    return config.potential(depth_behind(posed, points)).mT
