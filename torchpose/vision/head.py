"""Where the head is when no face is seen: the silhouette's round end at a head's distance from the trunk (T. 4.3.1).

An oval of a head's size that the person fills, with nothing of the person around its crown: off the silhouette, or on a
surface further away or nearer. So a raised hand is too thin, a shoulder is not alone, and a bent person's head is found
before the trunk. Left-camera frame, metres.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from torchpose.vision.camera import StereoCamera

REACH = 1.2  # m, to either side of the person's middle and twice that downwards: where heads are looked for
ABOVE = 0.12  # m, above the silhouette's top
RINGS = (0.5, 0.95)  # of the head's radii, on which it must be filled
SAMPLES = 16  # on each ring
LYING = 0.05  # of the score, that a head tilted by 90 degrees must make good
OPEN = 0.55  # of the ring around the head, that must be free: the rest is the neck's


@dataclass(frozen=True)
class HeadConfig:
    """Settings of `find_head`."""

    width: float = 0.16  # m
    height: float = 0.23  # m
    gap: float = 0.045  # m around the crown, where nothing of the person may be
    jump: float = 0.14  # m, in depth, from which a surface is another one
    tilts: tuple[float, ...] = (-80.0, -40.0, 0.0, 40.0, 80.0)  # degrees in the image, 0 = upright
    trunk_distance: float = 0.55  # m, from the trunk's middle
    trunk_sd: float = 0.18  # m
    trunk_weight: float = 0.12  # of the score, at one standard deviation off that
    upright_weight: float = 0.2  # of the score, for lying level with the trunk instead of above it
    expected_weight: float = 0.1  # of the score, at one standard deviation off the expected place
    least_score: float = 0.5  # 1 for a filled oval with nothing around
    cell: float = 0.02  # m, in which places are tried
    inset: float = 0.07  # m, from the middle of the surface seen to the head's centre
    sd: float = 0.025  # m, of each coordinate, of a head of score 1
    sd_rise: float = 0.15  # m more at score 0

    def __post_init__(self) -> None:
        for name in ("width", "height", "gap", "jump", "trunk_distance", "trunk_sd", "cell", "sd"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)} m")
        if not self.tilts:
            raise ValueError("tilts needs at least one angle, in degrees, got none; 0 is upright")


@dataclass(frozen=True)
class Heads:
    """At most one head a frame."""

    position: Float[Tensor, "batch 3"]  # m, its centre; NaN where none is found
    sd: Float[Tensor, " batch"]  # m, of each coordinate; NaN where none
    score: Float[Tensor, " batch"]  # how well its shape fits, up to 1; -inf where nobody is
    found: Bool[Tensor, " batch"]


def find_head(
    depth: Float[Tensor, "batch height width"],
    silhouette: Bool[Tensor, "batch mask_height mask_width"],
    trunk: Float[Tensor, "batch 3"],
    camera: StereoCamera,
    config: HeadConfig = HeadConfig(),
    expected: Float[Tensor, "batch 3"] | None = None,
    expected_sd: Float[Tensor, " batch"] | None = None,
) -> Heads:
    """The person's head by its shape, one person an item of the batch.

    Args:
        depth: m, NaN where unknown.
        trunk: m, middle of the trunk, such as `find_trunk` gives; NaN where it is not known, and more is taken for a
            head.
        expected: m, where the head is believed to be, such as the filter's prediction; NaN where nothing is known.
        expected_sd: m, of each coordinate of that.

    Raises:
        ValueError: shapes differ from one another or from the camera's image.
    """
    if depth.shape != silhouette.shape or depth.shape[1:] != (camera.height, camera.width):
        raise ValueError(
            f"depth and silhouette must both be (B, {camera.height}, {camera.width}), the camera's image, "
            f"got {tuple(depth.shape)} and {tuple(silhouette.shape)}"
        )
    batch = len(depth)
    seen = silhouette & (depth > 0)
    middle = depth.where(seen, torch.nan).flatten(1).nanmedian(1).values
    distance = torch.where(trunk[:, 2] > 0, trunk[:, 2], middle)
    someone = distance > 0
    metre = camera.focal_length / torch.where(someone, distance, 1.0)  # px
    place, rows, columns = _raster(silhouette, metre, config.cell)
    on_image = (rows >= 0) & (rows < camera.height) & (columns >= 0) & (columns < camera.width)
    index = rows.clamp(0, camera.height - 1) * camera.width + columns.clamp(0, camera.width - 1)
    person = silhouette.flatten(1).gather(1, index.flatten(1)).view(index.shape) & on_image
    z = depth.flatten(1).gather(1, index.flatten(1)).view(index.shape)
    known = person & (z > 0)
    z = torch.where(known, z, 0.0)
    # A place's own depth: the mean over a hand's width of the person around it.
    span = 2 * round(0.04 / config.cell) + 1
    mean = [F.avg_pool2d(x[:, None].to(z), span, 1, span // 2)[:, 0] for x in (z, known)]
    own = mean[0] / mean[1].clamp_min(1e-3)
    own = torch.where(mean[1] > 0.25, own, torch.nan)

    best = _shape_score(z, known, person, own, on_image, config)
    surface = camera.back_project(place, own)  # (B, rows, columns, 3)
    apart = surface - trunk[:, None, None]
    length = apart.norm(dim=-1)
    far = ((length - config.trunk_distance) / config.trunk_sd).square()
    level = 0.5 * (1 + apart[..., 1] / length.clamp_min(1e-6))  # 0 above the trunk, 1 below
    score = (
        best - config.trunk_weight * far.nan_to_num(1.0) - 2 * config.upright_weight * level.nan_to_num(0.5)
    )
    score = torch.where(own.isnan(), -torch.inf, score)
    preferred = score
    if expected is not None:
        sd = torch.full_like(distance, config.trunk_sd) if expected_sd is None else expected_sd
        centres = surface * (1 + config.inset / surface.norm(dim=-1, keepdim=True))
        off = (centres - expected[:, None, None]).norm(dim=-1) / sd[:, None, None]
        # Beyond three standard deviations a head is as unexpected as anywhere.
        preferred = score - config.expected_weight * off.clamp_max(3).square().nan_to_num(0.0)
    at = preferred.flatten(1).argmax(1)
    value = score.flatten(1).gather(1, at[:, None])[:, 0]
    shape = best.flatten(1).gather(1, at[:, None])[:, 0]
    found = someone & (value >= config.least_score)

    # The middle of the surface around there, then inwards along the ray.
    centre = surface.flatten(1, 2).gather(1, at[:, None, None].expand(-1, -1, 3))
    points = camera.back_project(place, torch.where(known, z, torch.nan)).flatten(1, 2)
    half = 0.55 * math.hypot(config.width, config.height) / math.sqrt(2)
    near = ((points - centre)[..., :2].norm(dim=-1) < half) & ((points - centre)[..., 2].abs() < config.jump)
    surface_middle = torch.where(near[..., None], points, torch.nan).nanmean(1)
    ray = surface_middle / surface_middle.norm(dim=-1, keepdim=True)
    position = torch.where(found[:, None], surface_middle + config.inset * ray, torch.nan)
    spread = config.sd + config.sd_rise * (1 - shape).clamp(0, 1)
    return Heads(
        position,
        spread.where(found, torch.nan),
        torch.where(someone, value, -torch.inf).expand(batch),
        found,
    )


def _raster(
    silhouette: Bool[Tensor, "batch height width"], metre: Float[Tensor, " batch"], cell: float
) -> tuple[Tensor, Tensor, Tensor]:
    """A grid of cells over each person: pixels (B, R, C, 2), and the rows and columns (B, R, C) of these."""
    width = silhouette.shape[2]
    top = silhouette.any(2).int().argmax(1)  # the first, 0 where nobody is
    weight = silhouette.sum(1).to(metre)
    line = torch.arange(width, device=metre.device, dtype=metre.dtype)
    middle = (weight * line).sum(1) / weight.sum(1).clamp_min(1)
    step = metre * cell
    side, down = round(2 * REACH / cell), round((2 * REACH + ABOVE) / cell)
    v = (top - metre * ABOVE)[:, None] + step[:, None] * torch.arange(down, device=metre.device)
    u = (middle - metre * REACH)[:, None] + step[:, None] * torch.arange(side, device=metre.device)
    rows = v.round().long()[:, :, None].expand(-1, -1, side)
    columns = u.round().long()[:, None].expand(-1, down, -1)
    return torch.stack([columns, rows], -1).to(metre), rows, columns


def _oval(config: HeadConfig, turn: float) -> list[tuple[int, int]]:
    """Steps (rows, columns) of cells from a head's centre to places within it."""
    angles = [2 * math.pi * k / SAMPLES for k in range(SAMPLES)]
    return [
        _step(config, turn, angle, ring * config.width / 2, ring * config.height / 2)
        for ring in RINGS
        for angle in angles
    ]


def _crown(config: HeadConfig, turn: float) -> list[tuple[int, int]]:
    """Steps to places around it, but for the neck's side."""
    count = 2 * SAMPLES
    angles = [math.pi * OPEN * (2 * k / (count - 1) - 1) for k in range(count)]
    return [
        _step(config, turn, angle, config.width / 2 + config.gap, config.height / 2 + config.gap)
        for angle in angles
    ]


def _step(config: HeadConfig, turn: float, angle: float, across: float, along: float) -> tuple[int, int]:
    """The cell at an angle from the crown on an oval."""
    x, y = across * math.sin(angle), -along * math.cos(angle)
    x, y = x * math.cos(turn) - y * math.sin(turn), x * math.sin(turn) + y * math.cos(turn)
    return round(y / config.cell), round(x / config.cell)


def _shape_score(
    z: Float[Tensor, "batch rows columns"],
    known: Bool[Tensor, "batch rows columns"],
    person: Bool[Tensor, "batch rows columns"],
    own: Float[Tensor, "batch rows columns"],
    on_image: Bool[Tensor, "batch rows columns"],
    config: HeadConfig,
) -> Float[Tensor, "batch rows columns"]:
    """How much a head centred at each cell would be filled, less how much of the person is around its crown.

    The best over the tilts; -inf where the cell is not the person's. What is off the image may be the person's.
    """
    outline = torch.where(
        person, torch.where(known, z, torch.nan), torch.where(on_image, torch.inf, -torch.inf)
    )
    ovals = [_oval(config, math.radians(tilt)) for tilt in config.tilts]
    crowns = [_crown(config, math.radians(tilt)) for tilt in config.tilts]
    steps = torch.tensor([oval + crown for oval, crown in zip(ovals, crowns, strict=True)], device=z.device)
    border = int(steps.abs().max())
    outline = F.pad(outline, (border,) * 4, value=torch.inf)
    stride = outline.shape[2]
    frame, row, column = (~own.isnan()).nonzero(as_tuple=True)
    centre = own[frame, row, column][:, None, None]
    home = (frame * outline.shape[1] + row + border) * stride + column + border
    around = outline.flatten()[
        home[:, None, None] + steps[..., 0] * stride + steps[..., 1]
    ]  # (cells, tilts, steps)
    same = ~((around - centre).abs() > config.jump)  # an unknown depth is no jump
    inside = len(ovals[0])
    filled = same[..., :inside].to(z).mean(-1)
    beside = (same | (around == -torch.inf))[..., inside:].to(z).mean(-1)
    # A head that lies is seen more seldom than one that is upright.
    seldom = LYING * (1 - steps.new_tensor(config.tilts).to(z).deg2rad().cos())
    best = (filled - beside - seldom).amax(1)
    return torch.full_like(z, -torch.inf).index_put((frame, row, column), best)
