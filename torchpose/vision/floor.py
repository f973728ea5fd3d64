"""The floor on which people stand: a plane in the depth of the empty scene. Left-camera frame, metres.

A camera that stands on its tripod sees the floor below the horizon, however little else: many triples of readings are
tried at once (Fischler and Bolles 1981), those are kept whose plane is level enough and has nothing below it, and the
best are fitted to all readings near them.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.vision.camera import StereoCamera

KEPT = 16  # best planes that are fitted
FITS = 6  # rounds of a fit
SEED = 0


@dataclass(frozen=True)
class FloorConfig:
    """Settings of `find_floor`."""

    tilt: float = 40.0  # degrees by which the camera may look down, up or lean
    lowest: float = 0.3  # m of the camera over its floor
    farthest: float = 10.0  # m
    roughness: float = 0.015  # m, standard deviation of the floor itself
    noise: float = 2.0  # times a reading's own standard deviation, that it may be off besides
    least_share: float = 0.04  # of the readings that must lie on the floor, less those below it
    points: int = 2048  # readings by which planes are judged
    trials: int = 4096  # triples

    def __post_init__(self) -> None:
        for name in ("lowest", "farthest", "roughness", "points", "trials"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if not 0 < self.tilt < 90:
            raise ValueError(f"tilt must be between 0 and 90 degrees, got {self.tilt}")
        if not self.noise >= 0:
            raise ValueError(f"noise must not be negative, got {self.noise}")
        if not 0 < self.least_share < 1:
            raise ValueError(f"least_share must be a share in (0, 1), got {self.least_share}")


@dataclass(frozen=True)
class Floor:
    """A plane: the points X with normal . X + height = 0."""

    normal: Float[Tensor, "3"]  # unit, up
    height: Float[Tensor, ""]  # m, of the camera over it

    def above(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Heights of points over the floor, m."""
        return points @ self.normal.to(points) + self.height.to(points)

    def pixels_above(self, camera: StereoCamera, depth: float) -> Bool[Tensor, "height width"]:
        """Pixels whose points at this depth, m, are not below the floor."""
        v, u = (
            torch.arange(size).to(self.normal) - middle
            for size, middle in ((camera.height, camera.cy), (camera.width, camera.cx))
        )
        over = (v[:, None] * self.normal[1] + u * self.normal[0]) / camera.focal_length + self.normal[2]
        return depth * over + self.height >= 0


def find_floor(
    depth: Float[Tensor, "height width"],
    camera: StereoCamera,
    depth_noise: float = 0.0,
    config: FloorConfig = FloorConfig(),
) -> Floor | None:
    """The floor of an empty scene; None where none is seen. The same scene has the same floor every time.

    Args:
        depth: m, NaN where unknown.
        depth_noise: 1/m, a reading's standard deviation along its ray over its squared depth.

    Raises ValueError where the depth has not the camera's size.
    """
    if depth.shape != (camera.height, camera.width):
        raise ValueError(
            f"depth must have the camera's size {(camera.height, camera.width)}, got {tuple(depth.shape)}"
        )
    v, u = ((depth > 0) & (depth < config.farthest)).nonzero(as_tuple=True)
    below = (v > camera.cy).nonzero()[:, 0]
    if min(len(below), len(v)) < 3:
        return None
    seen = camera.back_project(torch.stack([u, v], -1).to(depth), depth[v, u])
    source = torch.Generator().manual_seed(SEED)  # on the CPU: the same draws on any device
    some = seen[torch.randint(len(v), (config.points,), generator=source).to(v)]
    triple = seen[below[torch.randint(len(below), (config.trials, 3), generator=source).to(v)]]
    across = torch.linalg.cross(triple[:, 1] - triple[:, 0], triple[:, 2] - triple[:, 0])
    plane = _upward(torch.nn.functional.normalize(across, dim=1), triple[:, 0])
    weight, score = _judged(plane, some, depth_noise, config)
    best = score.topk(min(KEPT, len(score))).indices
    plane, weight = plane[best], weight[best]
    for _ in range(FITS):
        total = weight.sum(1, keepdim=True).clamp_min(torch.finfo(weight.dtype).tiny)
        middle = weight @ some / total
        off = some - middle[:, None]
        spread = (weight[..., None] * off).mT @ off
        plane = _upward(torch.linalg.eigh(spread).eigenvectors[..., 0], middle)
        weight, score = _judged(plane, some, depth_noise, config)
    most, which = score.max(0)
    if not float(most) >= config.least_share * len(some):
        return None
    return Floor(plane[which, :3], plane[which, 3])


def _upward(normal: Float[Tensor, "planes 3"], place: Float[Tensor, "planes 3"]) -> Float[Tensor, "planes 4"]:
    """Planes (normal, height) through places, seen from above: y points down."""
    normal = torch.where(normal[:, 1:2] > 0, -normal, normal)
    return torch.cat([normal, -(normal * place).sum(1, keepdim=True)], 1)


def _judged(
    plane: Float[Tensor, "planes 4"], some: Float[Tensor, "num 3"], depth_noise: float, config: FloorConfig
) -> tuple[Float[Tensor, "planes num"], Float[Tensor, " planes"]]:
    """Weights of the readings on each plane, and how many lie on it, less those below; -inf if it cannot be a floor."""
    normal, height = plane[:, :3], plane[:, 3]
    over = normal @ some.mT + height[:, None]
    # Of an error along the ray a plane that is seen at a grazing angle hears little.
    steep = (normal @ torch.nn.functional.normalize(some, dim=1).mT).abs()
    sd = config.roughness + config.noise * depth_noise * some[:, 2].square() * steep
    weight = (1 - (over / (2 * sd)).square()).clamp_min(0)
    score = weight.sum(1) - (over < -3 * sd).sum(1)
    level = (-normal[:, 1] > math.cos(math.radians(config.tilt))) & (height > config.lowest)
    return weight, torch.where(level & score.isfinite(), score, -torch.inf)
