"""Synthetic recordings of people who come and go, pass one another and stand behind furniture, with exact truth.

Left-camera frame (x right, y down, z forward); metres, radians, seconds. A recording is made frame by frame as it is
asked for, rendered for a stereo camera or cast for a depth camera; the same names give the same bytes, in any order.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.body.model import BodyModel, PosedBody
from torchpose.body.superquadric import Person
from torchpose.synthesis.actor import Actor
from torchpose.synthesis.box import Box
from torchpose.synthesis.depth import CastPeople, MatcherNoise, cast_people, spoil
from torchpose.synthesis.motion import random_stream
from torchpose.synthesis.path import Path, walk
from torchpose.synthesis.render import PosedShapes, RenderConfig, StereoFrames, StereoRenderer
from torchpose.synthesis.room import Room, RoomView
from torchpose.vision.camera import StereoCamera

# Of a depth camera: it drops what it does not know instead of guessing.
DEPTH_NOISE = MatcherNoise(outliers=0.0)


@dataclass(frozen=True)
class Guest:
    """One of the people: looks, way, and manner (by seed)."""

    person: Person
    path: Path
    manner: int = 0


@dataclass(frozen=True)
class Company:
    """Who comes into which room, and for how long it is recorded."""

    name: str
    guests: tuple[Guest, ...]
    duration: float  # s
    furniture: tuple[Box, ...] = ()  # in the room beside its own, also in the frames of the empty room
    room: int = 0  # seed
    depth: float = 6.0  # m, of the room's back wall: people pass behind one another

    def __post_init__(self) -> None:
        if not self.guests or not self.duration > 0:
            raise ValueError(
                f"a company must have people and last some time, got {len(self.guests)} people and "
                f"{self.duration} s; give both"
            )


@dataclass(frozen=True)
class Presence:
    """What can be seen of one person in one frame's left image."""

    mask: Bool[Tensor, "height width"]  # where the person is seen
    whole: int  # px, that would be seen if nothing stood before the person
    cut: bool  # the image's border cuts the person off
    joints: Bool[Tensor, " joints"]  # whether the person is seen at the pixel of each joint


@dataclass(frozen=True)
class ColouredDepth:
    """A frame of a depth camera with a colour image on the same pixels."""

    colour: Float[Tensor, "3 height width"]  # RGB in [0, 1], multiples of 1/255
    depth: Float[Tensor, "height width"]  # m, NaN where there is no reading
    people: Int[Tensor, "height width"]  # 0 the room, k + 1 the k-th of the people; exact


class CompanyRecording:
    """A company before a camera: images on demand, and the truth of each person.

    With a baseline `frames` renders stereo pairs. `depth_frame` is for either: cast and painted without shadows and
    without a second view, about ten times as fast, with the errors of a stereo matcher of that baseline (0.12 m
    where there is none).
    """

    def __init__(
        self,
        company: Company,
        camera: StereoCamera,
        config: RenderConfig | None = None,
        body: BodyModel | None = None,
    ):
        config, body = config or RenderConfig(), body or BodyModel()
        room = replace(config.room, seed=config.room.seed + company.room, depth=company.depth)
        self.company, self.camera, self.body = company, camera, body
        self.config = replace(config, room=room)
        self.times = torch.arange(round(company.duration * camera.frame_rate)) / camera.frame_rate  # s
        self.sizes = tuple(guest.person.size(body) for guest in company.guests)  # (1, S) each
        with torch.no_grad():
            self.poses: tuple[Float[Tensor, "time parameters"], ...] = tuple(
                walk(body, size, guest.path, self.times, guest.manner, company.room, room.camera_height)
                for guest, size in zip(company.guests, self.sizes, strict=True)
            )
            self.joints = tuple(posed.joints for posed in self.posed(0, len(self)))  # (T, 15, 3) m

    def __len__(self) -> int:
        return len(self.times)

    def posed(self, start: int, stop: int) -> list[PosedBody]:
        """The people in the frames from `start` to before `stop`."""
        return [self.body(pose[start:stop], size) for pose, size in zip(self.poses, self.sizes, strict=True)]

    @cached_property
    def _renderer(self) -> StereoRenderer:
        people = [guest.person for guest in self.company.guests]
        company = self.company
        return StereoRenderer(self.camera, self.body, people, self.config, company.name, company.furniture)

    @cached_property
    def _actors(self) -> list[Actor]:
        return [Actor(self.body, guest.person) for guest in self.company.guests]

    @cached_property
    def _room(self) -> RoomView:
        """What the left camera sees of the empty room."""
        room = self.config.room
        stream = random_stream("room", room.seed)
        return Room(room, stream, self.company.furniture).view(self.camera, torch.zeros(3), 1)

    @torch.no_grad()
    def frames(self, start: int = 0, stop: int | None = None) -> StereoFrames:
        """Rendered images, depth and labels of the frames from `start` to before `stop` (None: all), as one batch."""
        stop = len(self) if stop is None else stop
        if not 0 <= start < stop <= len(self):
            raise ValueError(f"frames must be a range within 0 to {len(self)}, got {start} to {stop}")
        return self._renderer(self.posed(start, stop), first_frame=start)

    def background(
        self, count: int = 2
    ) -> tuple[Float[Tensor, "count 3 height width"], Float[Tensor, "count 3 height width"]]:
        """Left and right images of the empty room, with its furniture."""
        return self._renderer.background(count)

    def _shapes(self, index: int) -> list[PosedShapes]:
        shapes = []
        for actor, posed in zip(self._actors, self.posed(index, index + 1), strict=True):
            parts = actor.display(posed)
            shapes.append(PosedShapes(actor.display.shapes, parts.rotations[0], parts.origins[0]))
        return shapes

    @torch.no_grad()
    def presence(self, index: int) -> list[Presence]:
        """What can be seen of each person in a frame."""
        shapes = self._shapes(index)
        seen = cast_people(shapes, self.camera, self._room.depth).people
        nothing = torch.full_like(self._room.depth, torch.inf)
        found = []
        for k, one in enumerate(shapes):
            whole = cast_people([one], self.camera, nothing).people > 0
            mask = seen == k + 1
            rim = torch.cat([whole[0], whole[-1], whole[:, 0], whole[:, -1]])
            joints = self.camera.project(self.joints[k][index]).round().long()
            inside = ((joints >= 0) & (joints < joints.new_tensor([mask.shape[1], mask.shape[0]]))).all(1)
            u, v = joints[:, 0].clamp(0, mask.shape[1] - 1), joints[:, 1].clamp(0, mask.shape[0] - 1)
            ahead = self.joints[k][index, :, 2] > 0
            found.append(Presence(mask, int(whole.sum()), bool(rim.any()), inside & ahead & mask[v, u]))
        return found

    @torch.no_grad()
    def depth_frame(self, index: int, noise: MatcherNoise = DEPTH_NOISE) -> ColouredDepth:
        """A frame of a depth camera, with the errors of `noise`."""
        if not 0 <= index < len(self):
            raise ValueError(f"the frame must be one of 0 to {len(self) - 1}, got {index}")
        shapes = self._shapes(index)
        found = cast_people(shapes, self.camera, self._room.depth)
        image = self._room.ambient + self._room.direct
        for k, (actor, one) in enumerate(zip(self._actors, shapes, strict=True)):
            self._paint(image, actor, one, found, found.people == k + 1)
        return ColouredDepth(
            self._sense(image, "frame", index),
            self._read(found.depth, noise, "frame", index),
            found.people,
        )

    @torch.no_grad()
    def empty_depth(self, index: int, noise: MatcherNoise = DEPTH_NOISE) -> Float[Tensor, "height width"]:
        """A depth camera's frame of the empty room; `index` decides its noise."""
        return self._read(self._room.depth, noise, "empty", index)

    def _paint(
        self, image: Tensor, actor: Actor, shapes: PosedShapes, found: CastPeople, where: Tensor
    ) -> None:
        """Draw a person into a colour image, in the lamp's light but without shadows."""
        v, u = where.nonzero(as_tuple=True)
        depth = found.depth[v, u]
        points = self.camera.back_project(torch.stack((u, v), -1).to(depth), depth)
        local, normal = shapes.on_parts(points, found.parts[v, u])
        room = self.config.room
        toward = torch.nn.functional.normalize(points.new_tensor(room.light) - points, dim=-1)
        lamp = (toward * normal).sum(-1).clamp_min(0)
        light = room.ambient * (0.8 - 0.15 * normal[:, 1] - 0.2 * normal[:, 2]) + room.direct * lamp
        albedo = actor.paint(local, found.parts[v, u], depth / self.camera.focal_length)
        image[:, v, u] = (albedo * light[:, None]).T

    def _sense(self, image: Float[Tensor, "3 height width"], *names: int | str) -> Tensor:
        sensor = self.config.sensor
        noise = torch.randn(image.shape, generator=random_stream("colour", self.company.name, *names))
        variance = sensor.read_noise**2 + sensor.shot_noise**2 * image.clamp(0, 1)
        return ((image + noise.to(image) * variance.sqrt()).clamp(0, 1) * 255).round() / 255

    def _read(self, depth: Float[Tensor, "height width"], noise: MatcherNoise, *names: int | str) -> Tensor:
        camera = self.camera if self.camera.baseline else replace(self.camera, baseline=0.12)
        everywhere = torch.ones_like(depth, dtype=torch.bool)
        stream = random_stream("depth", self.company.name, *names)
        return camera.depth(spoil(depth, everywhere, camera, stream, noise).disparity)

    def __iter__(self) -> Iterator[StereoFrames]:
        """The rendered frames one by one, each a batch of one."""
        return (self.frames(i, i + 1) for i in range(len(self)))
