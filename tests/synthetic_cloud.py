"""What a camera would see of a posed body: surface points on a grid of pixels, by casting rays at ellipsoids.

Nothing of torchpose's own distances, sampling or rendering is used, only where the ellipsoids are.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.body.model import BodyModel, PosedBody
from torchpose.registration.silhouette import nearest_inside
from torchpose.registration.vem import Observation
from torchpose.vision.camera import StereoCamera
from torchpose.vision.faces import Faces
from torchpose.vision.points import PointCloud

CAMERA = StereoCamera(width=320, height=240, focal_length=320.0, cx=161.0, cy=117.0, baseline=0.12)
# Limbs of a relaxed person in the torso's frame: head, left arm, right arm, left leg, right leg.
RELAXED = torch.tensor(
    [
        *[[0.0, -1.0, -0.1]],
        *[[0.35, 1.0, -0.1], [0.2, 1.0, -0.4]],
        *[[-0.45, 1.0, 0.1], [-0.2, 1.0, -0.3]],
        *[[0.15, 1.0, -0.1], [0.1, 1.0, 0.1]],
        *[[-0.2, 1.0, -0.2], [-0.05, 1.0, 0.1]],
    ]
)


@dataclass(frozen=True)
class View:
    """One frame: the points with the parts that they truly lie on, the mask and the depth."""

    cloud: PointCloud
    part: Int[Tensor, "1 num"]  # -1 on padding
    silhouette: Bool[Tensor, "1 height width"]
    depth: Float[Tensor, "1 height width"]  # m, NaN beside the body
    camera: StereoCamera = CAMERA

    def observation(self, num_parts: int = 14) -> Observation:
        potential = self.cloud.points.new_zeros(*self.cloud.mask.shape, num_parts)
        return Observation(self.cloud, potential, nearest_inside(self.silhouette), self.camera)

    def no_face(self) -> Faces:
        nan = torch.full((1, 4), torch.nan)
        nothing = torch.zeros_like(self.silhouette)
        return Faces(nan, torch.zeros(1, dtype=torch.bool), nothing, nan[:, :3])


def standing(
    body: BodyModel, directions: Tensor = RELAXED, yaw: float = 0.0, x: float = 0.0, z: float = 3.0
) -> Tensor:
    """The pose (1, P) with the given limb directions (any length), the hips at (x, 0, z)."""
    directions = torch.nn.functional.normalize(directions.to(body.axes), dim=-1)
    root = torch.tensor([[yaw, 0.0, 0.0]]).to(body.axes)
    return body.pose_from_directions(torch.tensor([[x, 0.0, z]]).to(body.axes), root, directions[None])


def cast(
    posed: PosedBody, rays: Float[Tensor, "rays 3"]
) -> tuple[Float[Tensor, " rays"], Int[Tensor, " rays"]]:
    """How far along each ray from the camera the body is, in rays, inf where it is missed, and which part.

    In the frame of an ellipsoid scaled to the unit ball, |o + t d|^2 = 1 is a quadratic equation.
    """
    extent = posed.radii[0][:, None]
    start = -(posed.centers[0][:, None] @ posed.frames[0]) / extent
    d = (rays @ posed.frames[0]) / extent  # (K, rays, 3)
    dd, sd, ss = (d * d).sum(-1), (start * d).sum(-1), (start * start).sum(-1) - 1
    root = sd**2 - dd * ss
    t = torch.where(root > 0, (-sd - root.clamp_min(0).sqrt()) / dd, torch.inf)
    return t.min(0)


def see(
    body: BodyModel,
    pose: Tensor,
    size: Tensor | None = None,
    num: int = 300,
    noise: float = 0.0,
    generator: torch.Generator | None = None,
    camera: StereoCamera = CAMERA,
) -> View:
    """A view of one pose (1, P) with at most `num` points; their depths are off by `noise` (sd, m)."""
    posed = body(pose, size)
    u, v = torch.meshgrid(torch.arange(camera.width), torch.arange(camera.height), indexing="xy")
    pixels = torch.stack([u, v], -1).flatten(0, 1).to(pose)
    rays = torch.stack(
        [(pixels[:, 0] - camera.cx) / camera.focal_length, (pixels[:, 1] - camera.cy) / camera.focal_length],
        -1,
    )
    rays = torch.cat([rays, torch.ones_like(rays[:, :1])], -1)
    depth, part = cast(posed, rays)
    hit = depth.isfinite()
    step = next(s for s in range(1, camera.width) if (hit & on_nodes(pixels, s)).sum() <= num)
    index = (hit & on_nodes(pixels, step)).nonzero()[:, 0]
    z = depth[index] + noise * torch.randn(len(index), generator=generator).to(depth)
    cloud = PointCloud(
        points=padded(rays[index] * z[:, None], num, 0.0),
        pixels=padded(pixels[index], num, 0.0),
        grid=padded((pixels[index] // step).long().flip(-1), num, -1),
        mask=(torch.arange(num) < len(index))[None],
        neighbours=grid_neighbours((pixels[index] // step).long(), num),
    )
    shape = (1, camera.height, camera.width)
    depth = torch.where(hit, depth, torch.nan).view(shape)
    return View(cloud, padded(part[index], num, -1), hit.view(shape), depth, camera)


def on_nodes(pixels: Tensor, step: int) -> Tensor:
    return (pixels % step == step // 2).all(-1)


def padded(values: Tensor, num: int, fill: float) -> Tensor:
    full = values.new_full((1, num, *values.shape[1:]), fill)
    full[0, : len(values)] = values
    return full


def grid_neighbours(grid: Int[Tensor, "count 2"], num: int, radius: float = 2.0) -> Int[Tensor, "1 num 12"]:
    """By comparing all pairs; `num` where there is none."""
    gap = (grid[:, None] - grid).square().sum(-1)
    near = torch.where((gap <= radius**2) & (gap > 0), torch.arange(len(grid)), num)
    return padded(torch.nn.functional.pad(near, (0, 12), value=num).sort(1).values[:, :12], num, num)


def together(views: list[View]) -> Observation:
    """Several views as one batch."""
    each = [view.observation() for view in views]
    names = PointCloud.__dataclass_fields__
    cloud = PointCloud(*(torch.cat([getattr(o.cloud, name) for o in each]) for name in names))
    return Observation(
        cloud, torch.cat([o.potential for o in each]), torch.cat([o.nearest for o in each]), each[0].camera
    )


def mirrored(view: View) -> View:
    """The view of the mirrored scene: x changes its sign. The camera's axis must be in the image's middle."""
    cloud, width = view.cloud, view.camera.width
    flip = torch.tensor([-1.0, 1.0, 1.0]).to(cloud.points)
    pixels = torch.stack([width - 1 - cloud.pixels[..., 0], cloud.pixels[..., 1]], -1)
    pixels = torch.where(cloud.mask[..., None], pixels, 0)
    return replace(
        view,
        cloud=replace(cloud, points=cloud.points * flip, pixels=pixels),
        silhouette=view.silhouette.flip(-1),
        depth=view.depth.flip(-1),
    )
