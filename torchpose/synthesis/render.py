"""Stereo pairs of drawn people in a room, ray-cast in torch, with true depth and part labels.

The world is the left camera's frame (x right, y down, z forward; metres). All surfaces are Lambertian: the two
views differ by geometry, gain and noise alone.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from torchpose.body.model import BodyModel, PosedBody
from torchpose.body.superquadric import Person, Superquadric, bounding_box, intersect, normals
from torchpose.synthesis.actor import Actor
from torchpose.synthesis.box import Box
from torchpose.synthesis.motion import random_stream
from torchpose.synthesis.room import Room, RoomConfig, edge_pixels, subpixels
from torchpose.vision.camera import StereoCamera


@dataclass(frozen=True)
class SensorConfig:
    read_noise: float = 0.004  # standard deviation on black, 1 = white
    shot_noise: float = 0.010  # standard deviation on white; it grows with the root of the brightness
    gain_difference: float = 0.02  # the right camera's gain above the left's
    offset_difference: float = 0.004  # the right camera's offset above the left's

    def __post_init__(self) -> None:
        if self.read_noise < 0 or self.shot_noise < 0:
            raise ValueError(f"noise must be at least 0, got {self.read_noise} and {self.shot_noise}")


@dataclass(frozen=True)
class RenderConfig:
    room: RoomConfig = field(default_factory=RoomConfig)
    sensor: SensorConfig = SensorConfig()
    samples: int = 2  # rays along each side of a pixel that lies on an edge
    shadow_map: int = 160  # px, of the person seen from the lamp

    def __post_init__(self) -> None:
        if self.samples < 1 or self.shadow_map < 8:
            raise ValueError(
                f"samples must be at least 1 and shadow_map 8, got {self.samples} and {self.shadow_map}"
            )


@dataclass(frozen=True)
class StereoFrames:
    """Rendered frames. Images are multiples of 1/255, as if read from PNG files; the rest is of the left
    pixels' centres.
    """

    left: Float[Tensor, "batch 3 height width"]  # RGB in [0, 1]
    right: Float[Tensor, "batch 3 height width"]
    depth: Float[Tensor, "batch height width"]  # m, of room and people
    labels: Int[Tensor, "batch height width"]  # 0 the room, k + 1 segment k
    people: Int[Tensor, "batch height width"]  # 0 the room, k + 1 the k-th of the people

    @property
    def mask(self) -> Bool[Tensor, "batch height width"]:
        """Where anybody is."""
        return self.labels > 0


@dataclass(frozen=True)
class PosedShapes:
    """One person's super-quadrics at one moment, in the frame of one eye."""

    shapes: Superquadric
    rotations: Float[Tensor, "shapes 3 3"]  # R_eye_part
    origins: Float[Tensor, "shapes 3"]  # m

    def bounds(self) -> Float[Tensor, "shapes 4"]:
        """Least and greatest (x/z, y/z) of each part, from its box; everything for one that reaches behind
        the eye.
        """
        corners = self.origins[:, None] + bounding_box(self.shapes) @ self.rotations.mT
        x, y, z = corners.unbind(-1)
        slopes = torch.stack((x / z, y / z), -1)
        low, high = slopes.amin(1), slopes.amax(1)
        behind = (z <= 0).any(1, keepdim=True)
        return torch.cat((low.masked_fill(behind, -math.inf), high.masked_fill(behind, math.inf)), -1)

    def window(self, camera: StereoCamera) -> tuple[slice, slice]:
        """Rows and columns of the image that hold all parts, with a pixel's margin."""
        bounds = self.bounds()
        low = bounds[:, :2].amin(0) * camera.focal_length
        high = bounds[:, 2:].amax(0) * camera.focal_length

        def cut(first: Tensor, last: Tensor, center: float, size: int) -> slice:
            begin = int((first + center).floor().clamp(0, size)) - 1
            return slice(max(begin, 0), int((last + center).ceil().clamp(-2, size - 1)) + 2)

        return cut(low[1], high[1], camera.cy, camera.height), cut(low[0], high[0], camera.cx, camera.width)

    def seen_from(self, eye: Float[Tensor, "3"], turn: Float[Tensor, "3 3"] | None = None) -> "PosedShapes":
        """The same from another eye, whose axes are the columns of `turn` (None: the same axes)."""
        origins = self.origins - eye
        if turn is None:
            return PosedShapes(self.shapes, self.rotations, origins)
        return PosedShapes(self.shapes, turn.mT @ self.rotations, origins @ turn)

    def on_parts(
        self, points: Float[Tensor, "num 3"], part: Int[Tensor, " num"]
    ) -> tuple[Float[Tensor, "num 3"], Float[Tensor, "num 3"]]:
        """Points (m, from the eye) on the surfaces of parts, in the parts' frames, and the normals there."""
        shapes, rotation = self.shapes[part], self.rotations[part]
        local = ((points - self.origins[part])[..., None] * rotation).sum(-2)  # R^T (p - o)
        return local, (rotation * normals(local, shapes)[:, None]).sum(-1)


@dataclass(frozen=True)
class Hits:
    """What rays meet of the person."""

    depth: Float[Tensor, " num"]  # m, inf where nothing
    part: Int[Tensor, " num"]  # -1 where nothing


def cast(posed: PosedShapes, rays: Float[Tensor, "num 3"]) -> Hits:
    """The nearest part on each ray from the eye (z = 1). Only the rays in a part's bounds are tried on it."""
    bounds = posed.bounds()
    x, y = rays[:, :1], rays[:, 1:2]
    low_x, low_y, high_x, high_y = bounds.T
    inside = (x >= low_x) & (x <= high_x) & (y >= low_y) & (y <= high_y)
    ray, part = inside.nonzero(as_tuple=True)
    to_part = posed.rotations.mT
    start = -(to_part @ posed.origins[..., None])[..., 0]
    direction = (to_part[part] * rays[ray][:, None]).sum(-1)
    depth = intersect(start[part], direction, posed.shapes[part], steps=12)
    nearest = torch.full_like(rays[:, 0], math.inf).scatter_reduce(0, ray, depth, "amin")
    first = torch.isfinite(depth) & (depth == nearest[ray])
    winner = torch.full_like(ray.new_empty(len(rays)), len(bounds)).scatter_reduce(
        0, ray[first], part[first], "amin"
    )
    return Hits(nearest, torch.where(torch.isfinite(nearest), winner, -1))


class _Shadow:
    """The person's shadow: a map of what the lamp sees, in the plane of its slopes x/z, y/z."""

    def __init__(self, posed: PosedShapes, size: int):
        bounds = posed.bounds()
        low, high = bounds[:, :2].amin(0).clamp_min(-3), bounds[:, 2:].amax(0).clamp_max(3)
        self.middle, self.half = (low + high) / 2, 0.6 * (high - low)  # a margin for the blur
        steps = (torch.arange(size, device=low.device, dtype=low.dtype) + 0.5) * (2 / size) - 1
        slopes = self.middle + torch.cartesian_prod(steps, steps).flip(-1) * self.half
        hits = cast(posed, F.pad(slopes, (0, 1), value=1.0))
        self.depth = hits.depth.reshape(1, 1, size, size)
        mask = torch.isfinite(self.depth).to(low)
        self.mask = F.avg_pool2d(F.avg_pool2d(mask, 5, 1, 2), 3, 1, 1)
        self.near = -F.max_pool2d(-self.depth, 9, 1, 4)  # as far as the blurred mask reaches

    def on_room(
        self, slopes: Float[Tensor, "height width 2"], distance: Float[Tensor, "height width"]
    ) -> Float[Tensor, "height width"]:
        """Share of the lamp that the person hides, softly, from the room `distance` m along the lamp's axis."""
        grid = ((slopes - self.middle) / self.half)[None]
        hidden = F.grid_sample(self.mask, grid, align_corners=False)[0, 0]
        near = F.grid_sample(self.near.clamp_max(1e3), grid, mode="nearest", align_corners=False)[0, 0]
        # The floor under a foot is as far as the foot; what stands before the person is nearer by far more.
        return torch.where(near < distance + 0.15, hidden, 0)

    def on_people(self, points: Float[Tensor, "num 3"]) -> Float[Tensor, " num"]:
        """Share of the lamp that the person's parts hide from points of people (m, in the lamp's frame)."""
        slopes = (points[:, :2] / points[:, 2:] - self.middle) / self.half
        pixel = 2 / self.depth.shape[-1]
        corners = slopes.new_tensor([[-0.7, -0.7], [0.7, -0.7], [-0.7, 0.7], [0.7, 0.7], [0.0, 0.0]]) * pixel
        grid = (slopes[None] + corners[:, None])[None]
        nearest = F.grid_sample(self.depth.clamp_max(1e3), grid, mode="nearest", align_corners=False)[0, 0]
        # 4 cm: less than the thickness of a limb, more than a map's pixel is off on a slanted surface.
        return ((nearest > 0) & (nearest < points[:, 2] - 0.04)).to(slopes).mean(0)


class StereoRenderer(nn.Module):
    """Renders people in one room for one stereo camera.

    The room is cast when the renderer is made, then each frame costs the people and the noise. The noise of
    frame i comes from a random stream of its own, named after `seed` and i, so frames may be rendered in any
    order and grouping. `furniture` stands in the room beside its own. Raises ValueError for a camera without
    a baseline, and for nobody.
    """

    eyes: Tensor
    ambient: Tensor
    direct: Tensor
    depths: Tensor
    slopes: Tensor
    from_lamp: Tensor
    lamp: Tensor
    light: Tensor

    def __init__(
        self,
        camera: StereoCamera,
        body: BodyModel,
        people: Person | Sequence[Person],
        config: RenderConfig = RenderConfig(),
        seed: int | str = 0,
        furniture: Sequence[Box] = (),
    ):
        super().__init__()
        if camera.baseline is None:
            raise ValueError(
                "a stereo renderer needs a camera with a baseline, got none; set `baseline` in m"
            )
        people = (people,) if isinstance(people, Person) else tuple(people)
        if not people:
            raise ValueError("a renderer needs at least one person, got none; give one who stays outside")
        self.camera, self.config, self.seed = camera, config, seed
        self.actors = nn.ModuleList([Actor(body, person) for person in people])
        self._constant("eyes", torch.tensor([[0.0, 0, 0], [camera.baseline, 0, 0]]))
        self._constant("light", torch.tensor(config.room.light))
        self._constant("lamp", _looking_at(self.light, self.light.new_tensor([0, 0.1, 3.1])))
        self._see_room(Room(config.room, random_stream("room", config.room.seed), furniture))

    @property
    def people(self) -> list[Actor]:
        """Who is drawn, in the order of the poses."""
        return [actor for actor in self.actors if isinstance(actor, Actor)]

    def _constant(self, name: str, value: Tensor) -> None:
        self.register_buffer(name, value, persistent=False)

    @torch.no_grad()
    def _see_room(self, room: Room) -> None:
        views = [room.view(self.camera, eye, self.config.samples) for eye in self.eyes]
        for name in ("ambient", "direct"):
            self._constant(name, torch.stack([getattr(view, name) for view in views]))
        self._constant("depths", torch.stack([view.depth for view in views]))
        pixels = self._pixels(slice(None), slice(None)).expand(2, -1, -1)
        points = self.eyes[:, None] + self.camera.back_project(pixels, self.depths.flatten(1))
        x, y, z = ((points - self.light) @ self.lamp).unbind(-1)
        slopes = torch.stack((x, y), -1) / z.clamp_min(1e-3)[..., None]
        self._constant("slopes", slopes.reshape(*self.depths.shape, 2))
        self._constant("from_lamp", z.reshape(self.depths.shape))

    @torch.no_grad()
    def background(
        self, count: int = 1
    ) -> tuple[Float[Tensor, "count 3 height width"], Float[Tensor, "count 3 height width"]]:
        """Pairs of the empty room, each with noise of its own."""
        left, right = (
            torch.stack(
                [self._sense(self.ambient[eye] + self.direct[eye], eye, "room", k) for k in range(count)]
            )
            for eye in (0, 1)
        )
        return left, right

    @torch.no_grad()
    def forward(self, posed: PosedBody | Sequence[PosedBody], first_frame: int = 0) -> StereoFrames:
        """Render the people posed, one for each; row i is frame `first_frame + i`, which decides its noise."""
        each = (posed,) if isinstance(posed, PosedBody) else tuple(posed)
        if len(each) != len(self.people):
            raise ValueError(
                f"there must be a pose for each of {len(self.people)} people, got {len(each)}; pose all"
            )
        parts = [actor.display(one) for actor, one in zip(self.people, each, strict=True)]
        frames = []
        for i in range(len(parts[0].origins)):
            scenes = [
                PosedShapes(actor.display.shapes, part.rotations[i], part.origins[i])
                for actor, part in zip(self.people, parts, strict=True)
            ]
            shadows = [
                _Shadow(scene.seen_from(self.light, self.lamp), self.config.shadow_map) for scene in scenes
            ]
            views = [self._draw(scenes, shadows, eye) for eye in (0, 1)]
            noisy = [
                self._sense(image, eye, "frame", first_frame + i) for eye, (image, *_) in enumerate(views)
            ]
            frames.append((*noisy, *views[0][1:]))
        return StereoFrames(*(torch.stack(column) for column in zip(*frames, strict=True)))

    def _draw(
        self, scenes: Sequence[PosedShapes], shadows: Sequence[_Shadow], eye: int
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """One view without noise: RGB (3, H, W), depth (H, W), labels (H, W) and whose they are (H, W)."""
        lit = [1 - shadow.on_room(self.slopes[eye], self.from_lamp[eye]) for shadow in shadows]
        image = self.ambient[eye] + self.direct[eye] * math.prod(lit[1:], start=lit[0])
        depth = self.depths[eye].clone()
        labels = torch.zeros_like(depth, dtype=torch.long)
        people = torch.zeros_like(labels)
        # The farthest first: the rim of whoever is nearer blends with what is behind it.
        order = sorted(range(len(scenes)), key=lambda k: -float(scenes[k].origins[:, 2].mean()))
        for k in order:
            posed = scenes[k].seen_from(self.eyes[eye])
            rows, columns = posed.window(self.camera)
            pixels, patch, beyond = self._pixels(rows, columns), image[:, rows, columns], depth[rows, columns]
            size = beyond.shape
            hits, seen = self._see(k, posed, shadows, eye, pixels, beyond.flatten(), patch.flatten(1).T)
            part = hits.part.reshape(size)
            if self.config.samples > 1:
                edges = edge_pixels(part).flatten().nonzero()[:, 0]
                around = pixels[edges][:, None] + subpixels(self.config.samples, pixels)
                count = around.shape[1]
                _, fine = self._see(
                    k,
                    posed,
                    shadows,
                    eye,
                    around.flatten(0, 1),
                    beyond.flatten()[edges].repeat_interleave(count),
                    patch.flatten(1).T[edges].repeat_interleave(count, 0),
                )
                seen[edges] = fine.unflatten(0, (len(edges), count)).mean(1)
            patch.copy_(seen.T.reshape(3, *size))
            found = part >= 0
            beyond.copy_(torch.where(found, hits.depth.reshape(size), beyond))
            segments = self.people[k].display.segments[part] + 1
            labels[rows, columns] = torch.where(found, segments, labels[rows, columns])
            people[rows, columns] = torch.where(found, k + 1, people[rows, columns])
        return image, depth, labels, people

    def _pixels(self, rows: slice, columns: slice) -> Float[Tensor, "num 2"]:
        """Centres (u, v) of the pixels of a window, row by row."""
        v, u = (torch.arange(size).to(self.eyes) for size in (self.camera.height, self.camera.width))
        return torch.cartesian_prod(v[rows], u[columns]).flip(-1)

    def _see(
        self,
        index: int,
        posed: PosedShapes,
        shadows: Sequence[_Shadow],
        eye: int,
        pixels: Float[Tensor, "num 2"],
        beyond: Float[Tensor, " num"],
        colour_beyond: Float[Tensor, "num 3"],
    ) -> tuple[Hits, Float[Tensor, "num 3"]]:
        """What is seen at pixels: the person where it is nearer than what is drawn already, else that."""
        rays = self.camera.back_project(pixels, torch.ones_like(beyond))
        hits = cast(posed, rays)
        person = hits.depth < beyond
        hits = Hits(hits.depth, torch.where(person, hits.part, -1))
        points = rays[person] * hits.depth[person][:, None]
        colour = colour_beyond.clone()
        colour[person] = self._shade(index, posed, shadows, eye, points, hits.part[person])
        return hits, colour

    def _shade(
        self,
        index: int,
        posed: PosedShapes,
        shadows: Sequence[_Shadow],
        eye: int,
        points: Float[Tensor, "num 3"],
        part: Int[Tensor, " num"],
    ) -> Float[Tensor, "num 3"]:
        """RGB of points (m, from the eye) on the parts of a person."""
        actor = self.people[index]
        local, normal = posed.on_parts(points, part)
        albedo = actor.paint(local, part, points[:, 2] / self.camera.focal_length)
        toward = self.light - (points + self.eyes[eye])
        lamp = (F.normalize(toward, dim=-1) * normal).sum(-1).clamp_min(0)
        for shadow in shadows:
            lamp = lamp * (1 - shadow.on_people(-toward @ self.lamp))
        # Light from everywhere is a little stronger from above and from the front, which gives the shaded
        # side its relief.
        around = 0.8 - 0.15 * normal[:, 1] - 0.2 * normal[:, 2]
        room = self.config.room
        return albedo * (room.ambient * around + room.direct * lamp)[:, None]

    def _sense(
        self, image: Float[Tensor, "3 height width"], eye: int, *names: int | str
    ) -> Float[Tensor, "3 height width"]:
        """What the sensor of an eye makes of an image: gain, offset, noise and 8 bits."""
        sensor = self.config.sensor
        image = image * (1 + sensor.gain_difference * eye) + sensor.offset_difference * eye
        noise = torch.randn(image.shape, generator=random_stream("noise", self.seed, eye, *names)).to(image)
        variance = sensor.read_noise**2 + sensor.shot_noise**2 * image.clamp(0, 1)
        return ((image + noise * variance.sqrt()).clamp(0, 1) * 255).round() / 255


def _looking_at(eye: Float[Tensor, "3"], target: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """R_world_eye of an eye whose z points at the target, its x level: `(p - eye) @ R` is p in its frame."""
    z = F.normalize(target - eye, dim=0)
    x = F.normalize(torch.linalg.cross(z.new_tensor([0, 1, 0]), z), dim=0)
    return torch.stack((x, torch.linalg.cross(z, x), z), -1)
