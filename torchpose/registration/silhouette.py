"""The silhouette as a measurement of the pose: no part of the body shows where the background is seen.

Left-camera frame, metres; pixels (u, v).
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.body.ellipsoid import outline
from torchpose.body.model import PosedBody
from torchpose.registration.fitting import Rows
from torchpose.vision.camera import StereoCamera

MARGIN = 1.0  # px beside the mask that are its edge's own width


@dataclass(frozen=True)
class RimConfig:
    weight: float = 1.0  # of the whole term against the points; 0 switches it off
    sd: float = 0.02  # m, by which a rim may stand out of the mask
    last_rounds: int = 2  # in which it takes part: far from the answer it draws limbs over others
    rim_points: int = 12  # per part
    reach: float = 0.25  # m, no stronger pull than from here: a mask without a limb must not tear one off

    def __post_init__(self) -> None:
        if self.weight < 0 or not self.sd > 0 or self.rim_points < 3 or not self.reach > 0:
            raise ValueError(f"weight >= 0, sd > 0, rim_points >= 3 and reach > 0 must hold, got {self}")
        if self.last_rounds < 1:
            raise ValueError(
                f"last_rounds must be at least 1, got {self.last_rounds}; weight=0 switches it off"
            )


def nearest_inside(mask: Bool[Tensor, "batch height width"]) -> Float[Tensor, "batch height width 2"]:
    """The nearest pixel (u, v) of the mask to each pixel; each pixel itself where a mask is empty.

    OpenCV's labels: the pixel they name is at most 4 % further than the nearest. (kornia's distance transform
    is up to 49 px off.)
    """
    H, W = mask.shape[1:]
    steps = torch.stack(torch.meshgrid(torch.arange(W), torch.arange(H), indexing="xy"), -1)
    grid = steps.numpy().astype(np.float32)
    nearest = []
    for inside in mask.cpu().numpy():
        if not inside.any():
            nearest.append(grid)
            continue
        _, label = cv2.distanceTransformWithLabels(
            (~inside).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        source = np.zeros((label.max() + 1, 2), grid.dtype)
        source[label[inside]] = grid[inside]
        nearest.append(source.take(label, axis=0))
    return torch.from_numpy(np.stack(nearest)).to(mask.device, torch.get_default_dtype())


def silhouette_rows(
    posed: PosedBody,
    nearest: Float[Tensor, "masks height width 2"],
    camera: StereoCamera,
    config: RimConfig,
    frame: Int[Tensor, " batch"] | None = None,
) -> Rows:
    """A row for each rim point of each part: where it projects beside the mask, the mask's edge draws it.

    `nearest` comes from `nearest_inside`. Points outside the image or within a pixel of the mask give empty
    rows, and the others are drawn to that pixel's distance, so that a row begins at zero: with a jump there, an
    identical frame moved the joints by 8 mm every time. `frame` is the mask of each body; None: its own, or the one.
    """
    B, K = posed.centers.shape[:2]
    points = outline(posed, config.rim_points)
    local = (points - posed.centers[:, :, None]) @ posed.frames
    part = torch.arange(K, device=points.device).repeat_interleave(config.rim_points).expand(B, -1)
    target, direction = _edge(points.flatten(1, 2), nearest, camera, config, frame)
    return Rows(part, local.flatten(1, 2), target, direction)


def silhouette_residual(
    posed: PosedBody,
    nearest: Float[Tensor, "masks height width 2"],
    camera: StereoCamera,
    config: RimConfig,
    frame: Int[Tensor, " batch"] | None = None,
) -> Float[Tensor, "batch rims"]:
    """The residuals of the `silhouette_rows`, no unit, for those who need no more: twice as fast."""
    points = outline(posed, config.rim_points).flatten(1, 2)
    _, _, length, outside, depth = _beside(points, nearest, camera, frame)
    metres = (length - MARGIN) * depth / camera.focal_length
    # A row's target is drawn to by just so far as the rim stands out.
    return -(config.weight**0.5 / config.sd) * (outside * metres.clamp_max(config.reach))


def _edge(
    points: Float[Tensor, "batch rims 3"],
    nearest: Float[Tensor, "masks height width 2"],
    camera: StereoCamera,
    config: RimConfig,
    frame: Int[Tensor, " batch"] | None,
) -> tuple[Float[Tensor, "batch rims 3"], Float[Tensor, "batch rims 3"]]:
    """Where the mask's edge draws each rim point, m, and the direction along which that counts, 1/m."""
    goal, unit, length, outside, depth = _beside(points, nearest, camera, frame)
    # Along the ray the rim may move freely: the direction is that of the image plane, across the ray.
    across = torch.cat([unit, -(unit * points[..., :2]).sum(-1, keepdim=True) / depth[..., None]], -1)
    metres = (length - MARGIN) * depth / camera.focal_length
    pull = (config.reach / metres.clamp_min(config.reach)) * (config.weight**0.5 / config.sd)
    target = camera.back_project(goal + MARGIN * unit, depth)
    return target, across * (outside * pull)[..., None]


def _beside(
    points: Float[Tensor, "batch rims 3"],
    nearest: Float[Tensor, "masks height width 2"],
    camera: StereoCamera,
    frame: Int[Tensor, " batch"] | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Of each rim point the mask's nearest pixel, the way from there, 1, how far it is, px, if beyond the mask's edge,
    and its depth, m."""
    B = len(points)
    depth = points[..., 2].clamp_min(0.1)
    H, W = nearest.shape[1:3]
    # Each coordinate for itself: far faster than pairs of them.
    place = camera.project(torch.cat([points[..., :2], depth[..., None]], -1)).unbind(-1)
    last = (W - 1, H - 1)
    seen = torch.stack([(x > 0) & (x < most) for x, most in zip(place, last, strict=True)]).all(0)
    # Rows that are not finite stay so, by `place`; their index must still be one.
    index = [
        x.detach().nan_to_num().round().clamp(0, most).long() for x, most in zip(place, last, strict=True)
    ]
    if frame is None:
        frame = torch.arange(B, device=points.device) if len(nearest) > 1 else index[0].new_zeros(B)
    goal = nearest.flatten(0, 2)[(frame[:, None] * H + index[1]) * W + index[0]].to(points)
    # From whole pixel to whole pixel: what rounding leaves of the rest must not turn the way.
    way = [x - goal[..., i] for i, x in enumerate(index)]
    far = (way[0].square() + way[1].square()).sqrt().clamp_min(1.0)
    unit = [x / far for x in way]
    length = (place[0] - goal[..., 0]) * unit[0] + (place[1] - goal[..., 1]) * unit[1]
    return goal, torch.stack(unit, -1), length, seen & (length > MARGIN), depth


def overhang(
    posed: PosedBody, nearest: Float[Tensor, "#batch height width 2"], camera: StereoCamera, config: RimConfig
) -> Float[Tensor, " batch"]:
    """How far the body's rims stand out of the mask, m: mean over the rim points, each at most `reach`."""
    return overhang_of(silhouette_residual(posed, nearest, camera, config), config)


def overhang_of(residual: Float[Tensor, "batch rims"], config: RimConfig) -> Float[Tensor, " batch"]:
    """`overhang` from the residuals of the `silhouette_rows`, if they are at hand."""
    metres = residual.abs() * config.sd / max(config.weight, 1e-12) ** 0.5
    return metres.clamp_max(config.reach).mean(1)
