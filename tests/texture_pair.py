"""Stereo pairs of a texture that is a function of the place, so that they are moved and turned without resampling."""

import math

import numpy as np
import torch
from torch import Tensor

HEIGHT, WIDTH = 240, 320
DISPARITY = 21.3  # px


def texture(u: np.ndarray, v: np.ndarray, seed: int = 0) -> np.ndarray:
    """Brightness in [0, 1] at any place: a sum of waves of 8 to 60 px in all directions."""
    generator = np.random.default_rng(seed)
    direction, phase = generator.uniform(0, 2 * math.pi, (2, 60))
    frequency = 2 * math.pi / generator.uniform(8, 60, 60)
    waves = np.cos(
        (np.cos(direction) * frequency) * u[..., None]
        + (np.sin(direction) * frequency) * v[..., None]
        + phase
    )
    return (0.5 + 0.2 * waves.sum(-1) / math.sqrt(30)).clip(0, 1)


def pair(dy: float = 0.0, roll: float = 0.0, scale: float = 0.0, seed: int = 0) -> tuple[Tensor, Tensor]:
    """A left image, and a right one whose points lie dy + roll (u - cu) + scale (v - cv) lower than the left's."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    left = texture(u, v, seed)
    u = u + DISPARITY  # the left column of what the right image shows there
    v = (v - dy - roll * (u - (WIDTH - 1) / 2) + scale * (HEIGHT - 1) / 2) / (1 + scale)
    return image(left), image(texture(u, v, seed))


def image(grey: np.ndarray) -> Tensor:
    return torch.from_numpy(grey).float().expand(1, 3, -1, -1)


def spoiled(images: Tensor, gain: float = 1.0, noise: float = 0.01) -> Tensor:
    """With a camera's gain, noise and 8 bits."""
    return ((images * gain + noise * torch.randn(images.shape)).clamp(0, 1) * 255).round() / 255


def board(dy: float) -> Tensor:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    squares = np.sin(math.pi * u / 12) * np.sin(math.pi * (v - dy) / 12)
    return image(0.5 + 0.4 * np.tanh(6 * squares))


SEEN_BY_NOBODY = {
    "a wall": lambda: (spoiled(torch.full((1, 3, HEIGHT, WIDTH), 0.5)),) * 2,
    "two walls": lambda: [spoiled(torch.full((1, 3, HEIGHT, WIDTH), 0.5)) for _ in range(2)],
    "darkness": lambda: (torch.zeros(1, 3, HEIGHT, WIDTH),) * 2,
    "a repeated pattern": lambda: (board(0), board(3)),
    "two scenes": lambda: (pair()[0], pair(seed=1)[1]),
    "no pixel": lambda: (torch.full((1, 3, HEIGHT, WIDTH), torch.nan),) * 2,
    "no frame": lambda: (torch.zeros(0, 3, HEIGHT, WIDTH),) * 2,
}
