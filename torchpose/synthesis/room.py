"""A furnished room to see a person in: textures in space, boxes, one lamp, and what a camera sees of it.

The world is the left camera's frame (x right, y down, z forward; metres). The camera looks level from
`camera_height` above the floor. Surfaces are Lambertian and their textures stand in the world, so all views
agree but for geometry.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from torchpose.synthesis.box import Box, Boxes, Vector
from torchpose.vision.camera import StereoCamera

OCTAVES = (0.006, 0.011, 0.021, 0.041, 0.083, 0.17)  # m, lattice spacings of the textures
WEIGHTS = (1.7, 1.7, 1.6, 1.2, 0.8, 0.6)  # of the octaves
TABLE = 48  # lattice points along an edge of the table that the textures are read from
CHUNK = 1 << 13  # rays at a time: small enough for the processor's cache


@dataclass(frozen=True)
class RoomConfig:
    seed: int = 0  # which furniture, colours and textures
    camera_height: float = 1.1  # m above the floor
    depth: float = 4.9  # m, the back wall
    width: float = 5.6  # m, between the side walls, the camera in the middle
    height: float = 3.2  # m, of the ceiling
    light: tuple[float, float, float] = (-1.5, -1.6, 0.4)  # m, the lamp
    light_radius: float = 0.10  # m: how soft shadows are
    ambient: float = 0.50  # share of full brightness from everywhere
    direct: float = 0.60  # share from the lamp on a surface that faces it

    def __post_init__(self) -> None:
        for name in ("camera_height", "depth", "width", "height", "light_radius"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}; give metres")
        if self.camera_height >= self.height:
            raise ValueError(
                f"the camera must hang below the ceiling at {self.height} m, got {self.camera_height}"
            )


class SolidTexture(nn.Module):
    """Smooth noise in space, zero mean, about unit deviation, with octaves from 6 mm to 17 cm.

    Each octave reads one random periodic table in a rotated and shifted lattice of its own, so nothing
    visible repeats. Octaves finer than the pixel's footprint fade out: they would alias, and not alike in the
    two views.
    """

    table: Tensor
    turns: Tensor
    shifts: Tensor

    def __init__(self, generator: torch.Generator):
        super().__init__()
        table = torch.rand(3, TABLE, TABLE, TABLE, generator=generator) * 2 - 1
        turns = torch.linalg.qr(torch.randn(len(OCTAVES), 3, 3, generator=generator))[0]
        shifts = torch.rand(len(OCTAVES), 3, generator=generator) * TABLE
        self.register_buffer(
            "table", F.pad(table[None], (0, 1, 0, 1, 0, 1), mode="circular"), persistent=False
        )
        self.register_buffer("turns", turns, persistent=False)
        self.register_buffer("shifts", shifts, persistent=False)

    def octave(
        self, points: Float[Tensor, "num 3"], level: int, channels: int = 1
    ) -> Float[Tensor, "num channels"]:
        """One octave at points (m), each channel in [-1, 1]."""
        at = points @ self.turns[level] / OCTAVES[level] + self.shifts[level]
        cell = at.floor()
        part = at - cell
        at = cell.remainder(TABLE) + part * part * (3 - 2 * part)  # smoothstep hides the lattice's facets
        grid = (at * (2 / TABLE) - 1)[None, None, None]
        return F.grid_sample(self.table[:, :channels], grid, align_corners=True)[0, :, 0, 0].T

    def forward(
        self, points: Float[Tensor, "num 3"], footprint: Float[Tensor, " num"]
    ) -> Float[Tensor, " num"]:
        """All octaves at points (m) that are seen with a pixel of `footprint` metres."""
        total = torch.zeros_like(footprint)
        for level, (spacing, weight) in enumerate(zip(OCTAVES, WEIGHTS, strict=True)):
            fade = weight * (spacing / footprint - 1).clamp(0, 1)
            if bool((fade > 0).any()):
                total = total + fade * self.octave(points, level)[:, 0]
        return total


class Hits(NamedTuple):
    """What rays meet in the room."""

    distance: Float[Tensor, " num"]  # in units of the direction
    surface: Int[Tensor, " num"]  # 0 to 5: the shell's faces -x +x -y +y -z +z; from 6: the boxes
    normal: Float[Tensor, "num 3"]


@dataclass(frozen=True)
class RoomView:
    """The empty room as one camera sees it; brightness is `ambient + direct * (1 - shadow)`."""

    ambient: Float[Tensor, "3 height width"]
    direct: Float[Tensor, "3 height width"]
    depth: Float[Tensor, "height width"]  # m, at the pixels' centres


def furnish(config: RoomConfig, generator: torch.Generator) -> list[Box]:
    """Cabinets with books, pictures, a skirting board and a crate, left and right of where the person is."""

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * torch.rand((), generator=generator).item()

    def colour(low: float = 0.2, high: float = 0.75) -> Vector:
        return uniform(low, high), uniform(low, high), uniform(low, high)

    floor, back = config.camera_height, config.depth
    skirting = (config.width, 0.1, 0.04)
    boxes = [Box((0.0, floor - 0.05, back), skirting, (0.36, 0.30, 0.26), grain=(0.25, 1.0, 1.0))]
    for side in (-1, 1):
        width, tall, deep = uniform(0.7, 1.0), uniform(0.6, 1.0), uniform(0.4, 0.5)
        x, z = side * uniform(1.5, 1.75), back - deep / 2 - uniform(0.05, 0.25)
        shade = uniform(0.35, 0.6)
        wood = (shade, shade * 0.75, shade * 0.52)
        center = (x, floor - tall / 2, z)
        boxes.append(
            Box(center, (width, tall, deep), wood, uniform(-0.12, 0.12), 0.13, 0.02, (1.0, 0.2, 1.0))
        )
        along = x - width / 2 + 0.06
        while along < x + width / 2 - 0.14:
            thick, high = uniform(0.05, 0.14), uniform(0.14, 0.32)
            book = (along + thick / 2, floor - tall - high / 2, z + uniform(-0.06, 0.06))
            boxes.append(Box(book, (thick, high, uniform(0.14, 0.22)), colour(), 0.0, 0.12, 0.05))
            along += thick + uniform(0.005, 0.12)
        wide, high = uniform(0.45, 0.8), uniform(0.4, 0.65)
        picture = (side * uniform(0.8, 1.5), floor - uniform(1.65, 1.95), back)
        boxes.append(Box(picture, (wide + 0.05, high + 0.05, 0.05), colour(0.1, 0.35)))
        boxes.append(Box(picture, (wide, high, 0.06), colour(0.4, 0.7), 0.0, 0.15, 0.33))
    crate = uniform(0.3, 0.42)
    x = (-1 if uniform(0.0, 1.0) < 0.5 else 1) * uniform(1.35, 1.6)
    boxes.append(
        Box((x, floor - crate / 2, uniform(3.5, 3.9)), (crate,) * 3, colour(), uniform(0.0, 1.5), 0.15, 0.06)
    )
    return boxes


class Room(nn.Module):
    """A box seen from inside, with furniture. What stands in it and how it looks comes from the generator.

    `more` furniture is added to it, and changes nothing else.
    """

    low: Tensor
    high: Tensor
    colours: Tensor
    contrasts: Tensor
    chroma: Tensor
    grains: Tensor
    light: Tensor

    def __init__(self, config: RoomConfig, generator: torch.Generator, more: Sequence[Box] = ()):
        super().__init__()
        self.config = config
        boxes = [*furnish(config, generator), *more]
        self.furniture = Boxes(boxes)
        self.texture = SolidTexture(generator)
        side, floor = config.width / 2, config.camera_height
        tone = 0.62 + 0.10 * (torch.rand(3, generator=generator) - 0.5)
        shell = torch.tensor(
            [(0.62, 0.60, 0.57)] * 2 + [(0.75, 0.74, 0.72), (0.52, 0.38, 0.26)] + [(0.62, 0.60, 0.57)] * 2
        )
        shell[5] = tone
        along_planks = [(1.0, 1.0, 1.0)] * 3 + [(1.0, 1.0, 0.25)] + [(1.0, 1.0, 1.0)] * 2
        constants = {
            "low": torch.tensor([-side, floor - config.height, -1.0]),
            "high": torch.tensor([side, floor, config.depth]),
            "colours": torch.cat((shell, torch.tensor([box.colour for box in boxes]))),
            "contrasts": torch.tensor([0.085] * 6 + [box.contrast for box in boxes]),
            "chroma": torch.tensor([0.01] * 6 + [box.chroma for box in boxes]),
            "grains": torch.tensor(along_planks + [box.grain for box in boxes]),
            "light": torch.tensor(config.light),
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    def cast(self, origins: Float[Tensor, "num 3"], directions: Float[Tensor, "num 3"]) -> Hits:
        """The first surface on each ray from inside the room, exactly, by slabs."""
        safe = torch.where(directions.abs() < 1e-9, 1e-9, directions)
        walls = torch.where(safe > 0, (self.high - origins) / safe, (self.low - origins) / safe)
        distance, axis = walls.min(-1)
        sign = safe.gather(-1, axis[:, None])[:, 0].sign()
        normal = F.one_hot(axis, 3) * -sign[:, None]
        surface = 2 * axis + (sign > 0)
        near, box, outward = self.furniture(origins, directions)
        front = near < distance
        return Hits(
            torch.where(front, near, distance),
            torch.where(front, box + 6, surface),
            torch.where(front[:, None], outward, normal),
        )

    def brightness(
        self, points: Float[Tensor, "num 3"], normal: Float[Tensor, "num 3"]
    ) -> Float[Tensor, " num"]:
        """Light from the lamp on surfaces (1: facing it), with the furniture's soft shadows, 0 where it is
        behind.
        """
        toward = self.light - points
        facing = (F.normalize(toward, dim=-1) * normal).sum(-1).clamp_min(0)
        radius = self.config.light_radius
        seen = torch.zeros_like(facing)
        for dx, dz in ((-1, -1), (-1, 1), (1, -1), (1, 1)):  # corners of the lamp
            corner = self.light + self.light.new_tensor([dx * radius, 0, dz * radius])
            start = points + 1e-3 * normal
            seen = seen + ~self.furniture.between(start, corner - start)
        return facing * seen / 4

    def albedo(
        self, points: Float[Tensor, "num 3"], surface: Int[Tensor, " num"], footprint: Float[Tensor, " num"]
    ) -> Float[Tensor, "num 3"]:
        """RGB reflectance of points on the surfaces, seen with a pixel of `footprint` metres."""
        colour = self.colours[surface]
        drawn = points * self.grains[surface]
        noise = self.texture(drawn, footprint)[:, None]
        tint = self.texture.octave(drawn, len(OCTAVES) - 2, 3) + self.texture.octave(
            drawn, len(OCTAVES) - 1, 3
        )
        # The floor is of planks, 0.13 m x 1.1 m; the rows are shifted, and each plank has its own shade.
        row = (points[:, 0] / 0.13).floor()
        plank = torch.stack((row, ((points[:, 2] + 0.37 * row) / 1.1).floor(), torch.zeros_like(row)), -1)
        shade = 0.16 * self.texture.octave(plank * 0.61, 2)
        colour = torch.where((surface == 3)[:, None], colour * (1 + shade), colour)
        contrast, chroma = self.contrasts[surface][:, None], self.chroma[surface][:, None]
        return (colour * (1 + contrast * noise) + chroma * tint).clamp(0.02, 1)

    def view(self, camera: StereoCamera, eye: Float[Tensor, "3"], samples: int = 2) -> RoomView:
        """The room from `eye`, through the camera's pinhole; pixels on edges are averaged over samples x
        samples rays.
        """
        like = self.light
        rows = torch.arange(camera.height, device=like.device, dtype=like.dtype)
        columns = torch.arange(camera.width, device=like.device, dtype=like.dtype)
        pixels = torch.cartesian_prod(rows, columns).flip(-1)
        shades, depths, surfaces = self._shade(pixels, camera, eye)
        index = surfaces.reshape(camera.height, camera.width)
        edges = edge_pixels(index).flatten().nonzero()[:, 0]
        if samples > 1 and len(edges):
            around = (pixels[edges][:, None] + subpixels(samples, like)).flatten(0, 1)
            shades[edges] = self._shade(around, camera, eye)[0].unflatten(0, (len(edges), -1)).mean(1)
        ambient, direct = shades.T.reshape(2, 3, camera.height, camera.width)
        return RoomView(ambient, direct, depths.reshape(camera.height, camera.width))

    def _shade(
        self, pixels: Float[Tensor, "num 2"], camera: StereoCamera, eye: Float[Tensor, "3"]
    ) -> tuple[Float[Tensor, "num 6"], Float[Tensor, " num"], Int[Tensor, " num"]]:
        """Ambient and direct RGB, depth and surface at pixels."""
        shades, depths, surfaces = [], [], []
        for some in pixels.split(CHUNK):
            directions = camera.back_project(some, torch.ones_like(some[:, 0]))
            origins = eye.expand_as(directions)
            hits = self.cast(origins, directions)
            points = origins + hits.distance[:, None] * directions
            albedo = self.albedo(points, hits.surface, hits.distance / camera.focal_length)
            direct = self.config.direct * self.brightness(points, hits.normal)
            shades.append(torch.cat((self.config.ambient * albedo, direct[:, None] * albedo), -1))
            depths.append(hits.distance)
            surfaces.append(hits.surface)
        return torch.cat(shades), torch.cat(depths), torch.cat(surfaces)


def edge_pixels(index: Int[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """Pixels with another index above, below, left or right of them."""
    edges = torch.zeros_like(index, dtype=torch.bool)
    across, down = index[:, 1:] != index[:, :-1], index[1:] != index[:-1]
    edges[:, 1:] |= across
    edges[:, :-1] |= across
    edges[1:] |= down
    edges[:-1] |= down
    return edges


def subpixels(samples: int, like: Tensor) -> Float[Tensor, "count 2"]:
    """Offsets (px) of samples x samples rays spread evenly over a pixel."""
    steps = (torch.arange(samples, device=like.device, dtype=like.dtype) + 0.5) / samples - 0.5
    return torch.cartesian_prod(steps, steps)
