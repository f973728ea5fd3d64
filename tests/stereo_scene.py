"""Stereo pairs whose disparity is known in closed form, and what their matching is judged by.

A scene is its left and right image (1, 3, height, width) in [0, 1] and its disparity (px) at the left pixels. Nothing
of torchpose is used.
"""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

Texture = Callable[[Tensor, Tensor], Tensor]
Scene = tuple[Tensor, Tensor, Tensor]


def texture(seed: int, waves: int = 60) -> Texture:
    """A pattern (grey, 0 to 1) that can be looked up between pixels: no wave is shorter than 4 px."""
    generator = torch.Generator().manual_seed(seed)
    frequency = (torch.rand(waves, 2, generator=generator, dtype=torch.float64) * 2 - 1) * torch.pi / 2
    phase = torch.rand(waves, generator=generator, dtype=torch.float64) * 2 * torch.pi

    def grey(u: Tensor, v: Tensor) -> Tensor:
        angle = u[..., None] * frequency[:, 0] + v[..., None] * frequency[:, 1] + phase
        return (0.5 + 0.15 * angle.sin().sum(-1) / waves**0.5 * 1.5).clamp(0, 1)

    return grey


def grid(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Column and row of each pixel."""
    v, u = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    return u, v


def rgb(grey: Tensor) -> Tensor:
    return grey.expand(1, 3, *grey.shape).clone()


def plane(
    height: int,
    width: int,
    at: float,
    per_column: float = 0.0,
    per_row: float = 0.0,
    seed: int = 1,
    lower: float = 0.0,
) -> Scene:
    """A plane of disparity at + per_column u + per_row v at the left pixels; the right image hangs `lower` px."""
    u, v = grid(height, width)
    pattern = texture(seed)
    # x_right = x_left - d(x_left), solved for the x_left that a right pixel shows.
    right = pattern((u + at + per_row * (v - lower)) / (1 - per_column), v - lower)
    return rgb(pattern(u, v)), rgb(right), at + per_column * u + per_row * v


def step(height: int = 48, width: int = 96, near: int = 12, far: int = 4) -> Scene:
    """A square before a wall; the disparity is NaN where only one camera sees the point."""
    u, v = grid(height, width)
    top, bottom, first, last = height // 4, 3 * height // 4, width // 3, 2 * width // 3
    wall, square = texture(2), texture(3)

    def inside(column: Tensor) -> Tensor:
        return (v >= top) & (v < bottom) & (column >= first) & (column < last)

    left = torch.where(inside(u), square(u, v), wall(u, v))
    right = torch.where(inside(u + near), square(u + near, v), wall(u + far, v))
    truth = torch.where(inside(u), float(near), float(far)).double()
    hidden = ~inside(u) & inside(u - far + near)
    return rgb(left), rgb(right), truth.where(~hidden & (u >= far), torch.nan)


def sphere(height: int = 72, width: int = 110) -> Scene:
    """A ball of 0.4 m before a wall, 1.6 to 2.9 m away, by rays; NaN where only the left camera sees the point."""
    focal_length, baseline, radius, wall = 120.0, 0.2, 0.4, 2.9
    middle = torch.tensor([0.15, 0.0, 2.0], dtype=torch.float64)
    u, v = grid(height, width)
    rays = torch.stack([u - (width - 1) / 2, v - (height - 1) / 2, torch.full_like(u, focal_length)], -1)
    rays = rays / focal_length  # of depth 1

    def seen_from(camera: Tensor, rays: Tensor) -> Tensor:
        """Depth of the first point on each ray."""
        along = (rays * (middle - camera)).sum(-1)
        length = rays.square().sum(-1)
        root = along**2 - length * ((middle - camera).square().sum() - radius**2)
        return torch.where(root > 0, (along - root.clamp_min(0).sqrt()) / length, wall)

    def grey(points: Tensor) -> Tensor:
        """The pattern, in pixels as large as they look at the ball's middle, on all that is seen."""
        scale = focal_length / middle[2]
        on_wall = points[..., 2] > wall - 1e-9
        ball, back = (texture(seed)(points[..., 0] * scale, points[..., 1] * scale) for seed in (5, 6))
        return torch.where(on_wall, back, ball)

    left, right = torch.zeros(3, dtype=torch.float64), torch.tensor([baseline, 0, 0], dtype=torch.float64)
    depth = seen_from(left, rays)
    points = rays * depth[..., None]
    images = rgb(grey(points)), rgb(grey(right + rays * seen_from(right, rays)[..., None]))
    to_right = (points - right) / points[..., 2:]
    both = (seen_from(right, to_right) - points[..., 2]).abs() < 1e-9
    disparity = focal_length * baseline / depth
    return *images, disparity.where(both & (u - disparity >= 0), torch.nan)


def density_and_error(values: Tensor, truth: Tensor, border: int = 0) -> tuple[float, Tensor]:
    """Share of the known pixels that are answered, and the errors of those (px)."""
    inside = torch.zeros_like(truth, dtype=torch.bool)
    inside[border : truth.shape[0] - border, border : truth.shape[1] - border] = True
    error = (values - truth).abs()[inside & ~truth.isnan()]
    return (~error.isnan()).double().mean().item(), error[~error.isnan()]


def correlation(
    left: np.ndarray, right: np.ndarray, y: int, x_left: int, x_right: int, noise: float
) -> float:
    """Modified normalised cross-correlation of two 5 x 5 patches, by its definition, in images padded by 2 px."""
    a, b = left[y : y + 5, x_left : x_left + 5], right[y : y + 5, x_right : x_right + 5]
    covariance = ((a - a.mean()) * (b - b.mean())).sum()
    return float(2 * covariance / (25 * (a.var() + b.var() + 2 * noise**2)))


def read(path: Path) -> Tensor:
    """An image file as (1, 3, height, width) in [0, 1]."""
    image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
    return torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255


def read_truth(folder: Path) -> Tensor:
    """The disparity of a scene of `stereo_truth`, NaN where unknown."""
    return torch.from_numpy(np.load(folder / "disparity.npz")["disparity"])
