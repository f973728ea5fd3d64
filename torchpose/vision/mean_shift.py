"""Mean shift: where weight is densest, near a start, in a cloud of points or on a back-projection (T. 4.3.1).

On an image the window is of whole pixels and moves as OpenCV's `meanShift` and `CamShift` do. Points are in metres.
"""

from dataclasses import dataclass
from enum import Enum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

MARGIN = 10  # px around the window found, in which CamShift looks for the object's shape
AROUND = 2  # px, by which its next window is wider than the object


class Kernel(Enum):
    """How a point's weight falls with its distance."""

    gaussian = "gaussian"
    flat = "flat"


@dataclass(frozen=True)
class MeanShiftConfig:
    """Settings of `mean_shift`."""

    bandwidth: float = 0.2  # m, standard deviation of the Gaussian kernel, radius of the flat one
    kernel: Kernel = Kernel.gaussian
    steps: int = 50  # at the most
    tolerance: float = 1e-4  # m; a shorter step is the last

    def __post_init__(self) -> None:
        for name in ("bandwidth", "tolerance"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)} m")
        if self.steps < 1:
            raise ValueError(f"steps must be at least 1, got {self.steps}")


@dataclass(frozen=True)
class Mode:
    """Where weight is densest."""

    position: Float[Tensor, "batch starts 3"]  # m; NaN where there is no weight within reach of the start
    weight: Float[Tensor, "batch starts"]  # sum of the weights times the kernel there
    converged: Bool[Tensor, "batch starts"]


@dataclass(frozen=True)
class Window:
    """A window on an image."""

    box: Int[Tensor, "batch 4"]  # px, left, top, width and height
    found: Bool[Tensor, " batch"]  # False: no weight in it, or it is off the image; the box has not moved on


@dataclass(frozen=True)
class Blob:
    """What CamShift finds; NaN where nothing."""

    window: Window  # to begin with in the next frame
    centre: Float[Tensor, "batch 2"]  # px, (u, v), of mass
    length: Float[Tensor, " batch"]  # px, four standard deviations along the long axis
    width: Float[Tensor, " batch"]  # px, across it
    angle: Float[Tensor, " batch"]  # rad, of the long axis from u towards v, in (-pi/2, pi/2]


def mean_shift(
    points: Float[Tensor, "batch num 3"],
    weights: Float[Tensor, "batch num"] | Bool[Tensor, "batch num"],
    start: Float[Tensor, "batch starts 3"],
    config: MeanShiftConfig = MeanShiftConfig(),
) -> Mode:
    """Climb from each start to the nearest mode of a cloud's density.

    Args:
        points: m; those of weight 0 may be anything, NaN too.
        weights: not negative; a mask counts every point once.
    """
    weights = weights.to(points)
    points = torch.where(weights[..., None] > 0, points, 0.0)
    position, moving = start, torch.ones_like(start[..., 0], dtype=torch.bool)
    total = torch.zeros_like(start[..., 0])
    for step in range(config.steps + 1):
        square = (position[:, :, None] - points[:, None]).square().sum(-1) / config.bandwidth**2
        share = (-0.5 * square).exp() if config.kernel is Kernel.gaussian else (square <= 1).to(points)
        share = share * weights[:, None]
        total = share.sum(-1)
        if step == config.steps or not bool(moving.any()):
            break
        target = share @ points / total.clamp_min(torch.finfo(total.dtype).tiny)[..., None]
        target = torch.where((total > 0)[..., None], target, torch.nan)
        moving = moving & ((target - position).norm(dim=-1) > config.tolerance)
        position = target
    there = position.isfinite().all(-1) & (total > 0)
    position = torch.where(there[..., None], position, torch.nan)
    return Mode(position, total.where(there, 0.0), there & ~moving)


def shift_window(
    image: Float[Tensor, "batch height width"], box: Int[Tensor, "batch 4"], steps: int = 100
) -> Window:
    """Move windows to where the image's weight is balanced in them, as OpenCV's `meanShift` does.

    A window that overlaps the border is cut to the image first and keeps that size. Other than OpenCV's, which goes on
    from the image's middle, one that lies off the image stays where it is.

    Args:
        image: not negative, such as a back-projection.
        box: px, left, top, width and height.

    Raises:
        ValueError: a width or height is not positive.
    """
    return _shift(_sums(image), box, steps)


def cam_shift(
    image: Float[Tensor, "batch height width"], box: Int[Tensor, "batch 4"], steps: int = 100
) -> Blob:
    """Mean shift, then the size and direction of what lies in the window, as OpenCV's `CamShift` does.

    Raises:
        ValueError: a width or height is not positive.
    """
    sums = _sums(image)
    height, width = image.shape[1:]
    size = torch.tensor([width, height], device=box.device)
    start = _shift(sums, box, steps)
    corner = (start.box[:, :2] - MARGIN).clamp_min(0)
    extent = torch.minimum(start.box[:, 2:] + 2 * MARGIN, size - corner)
    moments = _window_sums(sums, torch.cat([corner, extent], 1))
    mass = moments[:, 0]
    # OpenCV goes on if weight is in the wider window alone; off the image it has none.
    inside = (start.box[:, :2] < size).all(1) & (start.box[:, :2] + start.box[:, 2:] > 0).all(1)
    found = (mass > 0) & inside
    mean = moments[:, 1:3] / torch.where(found, mass, 1.0)[:, None]
    second = moments[:, 3:] / torch.where(found, mass, 1.0)[:, None]
    a = (second[:, 0] - mean[:, 0] ** 2).clamp_min(0)
    b = second[:, 1] - mean[:, 0] * mean[:, 1]
    c = (second[:, 2] - mean[:, 1] ** 2).clamp_min(0)
    angle = 0.5 * torch.atan2(2 * b, a - c)
    middle, half = 0.5 * (a + c), 0.5 * torch.hypot(2 * b, a - c)
    length, across = 4 * (middle + half).sqrt(), 4 * (middle - half).clamp_min(0).sqrt()
    cos, sin = angle.cos().abs(), angle.sin().abs()
    spans = [
        torch.maximum((length * cos).round(), (across * sin).round()),
        torch.maximum((length * sin).round(), (across * cos).round()),
    ]
    centre = mean.round().long()
    wanted = torch.stack(spans, 1).nan_to_num().long() + AROUND
    wanted = torch.minimum(wanted, 2 * (size - centre))
    corner = (centre - wanted // 2).clamp_min(0)
    after = torch.cat([corner, torch.minimum(wanted, size - corner)], 1)
    window = Window(torch.where(found[:, None], after, start.box), found)
    nan = torch.nan
    dtype = image.dtype
    return Blob(
        window,
        torch.where(found[:, None], mean, nan).to(dtype),
        *(x.where(found, nan).to(dtype) for x in (length, across, angle)),
    )


def _shift(
    sums: Float[Tensor, "batch moments rows columns"], box: Int[Tensor, "batch 4"], steps: int
) -> Window:
    if bool((box[:, 2:] < 1).any()):
        raise ValueError(
            f"windows must be at least 1 px wide and high, got {tuple(box[:, 2:].amin(0).tolist())}"
        )
    size = torch.tensor([sums.shape[3] - 1, sums.shape[2] - 1], device=box.device)
    corner = torch.minimum(box[:, :2].clamp_min(0), size)
    extent = (torch.minimum(box[:, :2] + box[:, 2:], size) - corner).clamp_min(0)
    inside = (extent > 0).all(1)
    for _ in range(steps):
        moments = _window_sums(sums, torch.cat([corner, extent], 1))
        mass = moments[:, :1]
        middle = moments[:, 1:3] / torch.where(mass > 0, mass, 1.0)
        # The middle of the pixels' centres is half a pixel before that of their edges; OpenCV compares the two.
        move = (middle - corner - 0.5 * extent).round().long()
        target = torch.minimum((corner + move).clamp_min(0), size - extent)
        target = torch.where(mass > 0, target, corner)
        if torch.equal(target, corner):
            break
        corner = target
    found = inside & (_window_sums(sums, torch.cat([corner, extent], 1))[:, 0] > 0)
    return Window(torch.where(inside[:, None], torch.cat([corner, extent], 1), box), found)


def _sums(image: Float[Tensor, "batch height width"]) -> Float[Tensor, "batch moments rows columns"]:
    """Sums of w, w u, w v, w u^2, w u v and w v^2 over all pixels above and left of each corner, in float64."""
    weight = image.double()
    v = torch.arange(image.shape[1], device=image.device, dtype=torch.float64)[:, None]
    u = torch.arange(image.shape[2], device=image.device, dtype=torch.float64)
    planes = torch.stack([weight * x for x in (1.0, u, v, u * u, u * v, v * v)], 1)
    return F.pad(planes.cumsum(2).cumsum(3), (1, 0, 1, 0))


def _window_sums(
    sums: Float[Tensor, "batch moments rows columns"], box: Int[Tensor, "batch 4"]
) -> Float[Tensor, "batch moments"]:
    """Moments of windows that lie on the image."""
    left, top, width, height = box.unbind(1)
    row = torch.arange(len(box), device=box.device)

    def at(y: Tensor, x: Tensor) -> Tensor:
        y, x = y.clamp(0, sums.shape[2] - 1), x.clamp(0, sums.shape[3] - 1)
        return sums[row, :, y, x]

    bottom, right = top + height, left + width
    return at(bottom, right) - at(top, right) - at(bottom, left) + at(top, left)
