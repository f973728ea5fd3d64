"""The depth of drawn people without any images, and what a stereo matcher would make of it.

Left-camera frame (x right, y down, z forward), metres; pixels (u, v); disparities in px. Only the window about each
person is cast, and what is within the mask spoiled, so a frame costs some 50 ms of one core.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.body.model import PosedBody
from torchpose.body.superquadric import DisplayModel
from torchpose.synthesis.box import Box, Boxes
from torchpose.synthesis.render import PosedShapes, cast
from torchpose.vision.camera import StereoCamera


@dataclass(frozen=True)
class Scene:
    """What stands about people: a floor, a wall and furniture."""

    floor: float = 1.0  # m below the camera
    wall: float = 5.5  # m before it
    furniture: tuple[Box, ...] = ()

    def depth(self, camera: StereoCamera, like: Tensor) -> Float[Tensor, "height width"]:
        """Exact depth of the empty scene, m."""
        v, u = (torch.arange(n, device=like.device, dtype=like.dtype) for n in (camera.height, camera.width))
        # Rays meet the floor below the horizon alone.
        below = ((v - camera.cy) / camera.focal_length).clamp_min(self.floor / self.wall / 2)
        empty = (self.floor / below).clamp_max(self.wall)[:, None].expand(-1, camera.width)
        if not self.furniture:
            return empty
        rays = camera.back_project(torch.cartesian_prod(v, u).flip(-1), like.new_ones(len(v) * len(u)))
        near = Boxes(self.furniture).to(like)(torch.zeros_like(rays), rays).distance
        return torch.minimum(empty, near.view_as(empty))


@dataclass(frozen=True)
class CastPeople:
    """What one frame's rays through the pixels' centres meet."""

    depth: Float[Tensor, "height width"]  # m, of people and of what is beyond
    people: Int[Tensor, "height width"]  # 0 the scene, k + 1 the k-th of the people
    parts: Int[Tensor, "height width"]  # of that one's shapes; -1 in the scene


def cast_people(
    people: Sequence[PosedShapes], camera: StereoCamera, beyond: Float[Tensor, "height width"]
) -> CastPeople:
    """Cast one ray a pixel at each of the people before a scene with the depth `beyond`; the nearest is seen."""
    v, u = (torch.arange(n).to(beyond) for n in (camera.height, camera.width))
    depth = beyond.clone()
    whose = torch.zeros_like(depth, dtype=torch.long)
    parts = torch.full_like(whose, -1)
    for k, shapes in enumerate(people):
        rows, columns = shapes.window(camera)
        pixels = torch.cartesian_prod(v[rows], u[columns]).flip(-1)
        hits = cast(shapes, camera.back_project(pixels, torch.ones_like(pixels[:, 0])))
        here = depth[rows, columns]
        part, reach = hits.part.view_as(here), hits.depth.view_as(here)
        seen = (part >= 0) & (reach < here)
        whose[rows, columns] = torch.where(seen, k + 1, whose[rows, columns])
        parts[rows, columns] = torch.where(seen, part, parts[rows, columns])
        here.copy_(torch.where(seen, reach, here))
    return CastPeople(depth, whose, parts)


@dataclass(frozen=True)
class DepthFrames:
    """Exact depth at the pixels' centres."""

    depth: Float[Tensor, "batch height width"]  # m, of people and scene
    labels: Int[Tensor, "batch height width"]  # 0 the scene, k + 1 segment k
    people: Int[Tensor, "batch height width"]  # 0 the scene, k + 1 the k-th of the people

    @property
    def mask(self) -> Bool[Tensor, "batch height width"]:
        """Where anybody is."""
        return self.labels > 0


@torch.no_grad()
def cast_depth(
    display: DisplayModel | Sequence[DisplayModel],
    posed: PosedBody | Sequence[PosedBody],
    camera: StereoCamera,
    scene: Scene = Scene(),
) -> DepthFrames:
    """Cast one ray a pixel at the person in each of the poses, or at several people, each in poses of their own.

    Raises ValueError unless there are as many displays as poses.
    """
    displays = (display,) if isinstance(display, DisplayModel) else tuple(display)
    bodies = (posed,) if isinstance(posed, PosedBody) else tuple(posed)
    if not displays or len(displays) != len(bodies):
        raise ValueError(
            f"there must be a pose for each of the people, got {len(displays)} people and {len(bodies)} "
            "poses; give as many"
        )
    empty = scene.depth(camera, bodies[0].origins)
    moved = [one(body) for one, body in zip(displays, bodies, strict=True)]
    frames = []
    for i in range(len(bodies[0].origins)):
        shapes = [
            PosedShapes(one.shapes, parts.rotations[i], parts.origins[i])
            for one, parts in zip(displays, moved, strict=True)
        ]
        found = cast_people(shapes, camera, empty)
        labels = torch.zeros_like(found.parts)
        for k, one in enumerate(displays):
            labels = torch.where(found.people == k + 1, one.segments[found.parts] + 1, labels)
        frames.append((found.depth, labels, found.people))
    return DepthFrames(*(torch.stack(column) for column in zip(*frames, strict=True)))


@dataclass(frozen=True)
class MatcherNoise:
    """How the disparity and the silhouette of a stereo matcher differ from the truth.

    `spread` is the standard deviation (px) of the Gaussian that a white field is smoothed with: what is `spread`
    apart is alike, and errors come in patches about as large as the windows of a matcher.
    """

    independent: float = 0.20  # px, standard deviation of each pixel's own error
    correlated: float = 0.25  # px, of the error that neighbours share
    # px, spread of that error: GCS on the rendered people has correlations of 0.67, 0.32 and 0.06 at 2, 4 and 8 px
    correlation: float = 2.0
    quantum: float = 0.25  # px, to which disparities are rounded; 0 leaves them
    fattening: int = 2  # px by which what is near grows over what is far
    outliers: float = 0.01  # share of pixels with any disparity at all
    dropouts: float = 0.02  # share of pixels without a disparity
    patch: float = 2.0  # px, spread of the fields that say where outliers and dropouts are
    ragged: float = 1.5  # px, standard deviation of the silhouette's rim
    rim: float = 4.0  # px, spread along which it wanders
    nearest: float = 1.2  # m, outliers lie between here
    farthest: float = 8.0  # m, and here

    def __post_init__(self) -> None:
        for name in ("independent", "correlated", "quantum", "fattening", "ragged"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}; give px")
        for name in ("outliers", "dropouts"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} must be a share in [0, 1), got {getattr(self, name)}")
        for name in ("correlation", "patch", "rim"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}; give px")
        if not 0 < self.nearest < self.farthest:
            raise ValueError(
                f"0 < nearest < farthest must hold, in m, got {self.nearest} and {self.farthest}"
            )


@dataclass(frozen=True)
class MatchedFrame:
    """One frame as if it had been matched and cut out."""

    disparity: Float[Tensor, "height width"]  # px, NaN where there is none
    silhouette: Bool[Tensor, "height width"]


def spoil(
    depth: Float[Tensor, "height width"],
    mask: Bool[Tensor, "height width"],
    camera: StereoCamera,
    generator: torch.Generator,
    noise: MatcherNoise = MatcherNoise(),
) -> MatchedFrame:
    """Disparity and silhouette of a frame, from its exact depth (m) and the person's exact mask, with errors.

    The generator decides every error. Raises ValueError where nobody is in the mask.
    """
    rows, columns = (mask.any(axis).nonzero()[:, 0] for axis in (1, 0))
    if len(rows) == 0:
        raise ValueError("the mask must hold a person, got an empty one; place the person before the camera")
    # The window reaches as far as the silhouette may.
    margin = math.ceil(4 * noise.ragged) + noise.fattening + 1
    window = tuple(
        slice(max(int(found[0]) - margin, 0), int(found[-1]) + margin + 1) for found in (rows, columns)
    )
    matched, silhouette, person = camera.disparity(depth), mask.clone(), mask[window]
    exact = matched[window]
    shape = (person.shape[0], person.shape[1])

    def smooth(spread: float) -> Tensor:
        return smooth_field(shape, spread, generator).to(exact)

    square = np.ones(2 * (2 * noise.fattening + 1,), np.uint8)
    near = torch.from_numpy(cv2.dilate(exact.cpu().numpy(), square)).to(exact)
    own = torch.randn(shape, generator=generator).to(exact)
    found = near + noise.independent * own + noise.correlated * smooth(noise.correlation)
    if noise.quantum > 0:
        found = (found / noise.quantum).round() * noise.quantum
    far, close = camera.disparity(exact.new_tensor([noise.farthest, noise.nearest])).tolist()
    anywhere = far + (close - far) * torch.rand(shape, generator=generator).to(exact)
    found = torch.where(smooth(noise.patch) > _upper_quantile(noise.outliers), anywhere, found)
    found = torch.where(smooth(noise.patch) > _upper_quantile(noise.dropouts), torch.nan, found)
    matched[window] = found
    silhouette[window] = _depth_inside(person).to(exact) + noise.ragged * smooth(noise.rim) > 0
    return MatchedFrame(matched, silhouette)


def smooth_field(
    shape: tuple[int, int], spread: float, generator: torch.Generator
) -> Float[Tensor, "height width"]:
    """A random field of mean 0 and deviation 1 everywhere: white noise smoothed by a Gaussian of `spread` px."""
    radius = math.ceil(3 * spread)
    steps = torch.arange(-radius, radius + 1, dtype=torch.get_default_dtype())
    kernel = torch.exp(-0.5 * (steps / spread) ** 2)
    kernel = kernel / kernel.norm()  # keeps the deviation of independent numbers
    white = torch.randn(shape[0] + 2 * radius, shape[1] + 2 * radius, generator=generator).numpy()
    whole = torch.from_numpy(cv2.sepFilter2D(white, -1, kernel.numpy(), kernel.numpy()))
    return whole[radius : radius + shape[0], radius : radius + shape[1]]


def _upper_quantile(share: float) -> float:
    """What a standard normal number exceeds with this probability."""
    return math.sqrt(2) * float(torch.erfinv(torch.tensor(1 - 2 * share, dtype=torch.float64)))


def _depth_inside(mask: Bool[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """Distance (px) of each pixel to the mask's rim, positive inside."""
    inside = mask.cpu().numpy().astype(np.uint8)
    distance = [cv2.distanceTransform(side, cv2.DIST_L2, cv2.DIST_MASK_5) for side in (inside, 1 - inside)]
    # The rim lies half way between a pixel within and one without.
    signed = np.where(inside > 0, distance[0] - 0.5, 0.5 - distance[1])
    return torch.from_numpy(signed).to(mask.device, torch.get_default_dtype())
