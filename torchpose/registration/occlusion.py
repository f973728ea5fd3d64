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
    last_rounds: int = 2  # of a fit in which it counts: far from the answer limbs hide what they should not

    def __post_init__(self) -> None:
        if self.last_rounds < 1:
            raise ValueError(
                f"last_rounds must be at least 1, got {self.last_rounds}; penalty=0 switches it off"
            )
        if self.penalty < 0 or self.margin < 0 or not self.ramp > 0:
            raise ValueError(f"penalty >= 0, margin >= 0 and ramp > 0 must hold, got {self}")

    def potential(self, behind: Float[Tensor, "batch parts num"]) -> Float[Tensor, "batch parts num"]:
        """Log-potentials of parts that lie so far behind others, m: minus the penalty where hidden, 0 where not."""
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
    camera = unit @ posed.centers[..., None]  # where it stands there, beside the ball
    # |s way - camera|^2 = 1 for way = unit ray is a s^2 - 2 b s + c = 0: a, and b^2 - a c, are square forms of the ray,
    # so one product gives those of all pairs.
    way, toward = unit.mT @ unit, unit.mT @ camera
    c = camera.square().sum((2, 3)) - 1
    across = toward * toward.mT - c[..., None, None] * way
    x, y, one = ray.mT.unbind(1)
    squares = torch.stack([x * x, y * y, one, 2 * x * y, 2 * x, 2 * y], 1)  # (B, 6, N)
    forms = torch.cat([way, across], 1)
    forms = torch.cat([forms.diagonal(dim1=2, dim2=3), forms[..., [0, 0, 1], [1, 2, 2]]], 2)
    a, root = (forms @ squares).chunk(2, 1)
    b = toward[..., 0] @ ray.mT
    enters = (b - root.clamp_min(0).sqrt()) / a
    return enters, torch.where(root > 0, enters, torch.inf)
