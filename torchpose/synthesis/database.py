"""Synthetic recordings with exact truth, and the plan of a database of activities whose test people never
train.

Left-camera frame (x right, y down, z forward); metres, radians, seconds. A recording is rendered frame by
frame as it is asked for; the same names give the same bytes, in any order.
"""

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.atomic import replacing
from torchpose.body.model import BodyModel
from torchpose.body.superquadric import Person, draw_person
from torchpose.synthesis.motion import ACTIVITIES, MOTIONS, MotionConfig, perform, random_stream
from torchpose.synthesis.render import RenderConfig, StereoFrames, StereoRenderer
from torchpose.vision.camera import StereoCamera


@dataclass(frozen=True)
class SynthesisConfig:
    """How people move and how they are recorded."""

    motion: MotionConfig = field(default_factory=MotionConfig)
    render: RenderConfig = field(default_factory=RenderConfig)


def synthetic_camera(width: int = 640, height: int = 480, frame_rate: float = 20.0) -> StereoCamera:
    """A stereo camera whose view holds a tall person with raised arms at 3.3 m; the principal point is not
    the middle.
    """
    return StereoCamera(
        width=width,
        height=height,
        focal_length=0.9375 * width,
        cx=0.4985 * width - 0.5,
        cy=0.504 * height - 0.5,
        baseline=0.12,
        frame_rate=frame_rate,
    )


class SyntheticRecording:
    """A person's performance before a stereo camera: images on demand, and the truth."""

    def __init__(
        self,
        body: BodyModel,
        person: Person,
        camera: StereoCamera,
        pose: Float[Tensor, "time parameters"],
        config: RenderConfig,
        name: str,
    ):
        self.camera = camera
        self.person = person
        self.pose = pose
        self.size: Float[Tensor, "1 sizes"] = person.size(body)
        self.name = name
        self._body, self._config = body, config
        with torch.no_grad():
            self.joints: Float[Tensor, "time joints 3"] = body(pose, self.size).joints  # m

    def __len__(self) -> int:
        return len(self.pose)

    def __iter__(self) -> Iterator[StereoFrames]:
        """The frames one by one, each a batch of one."""
        return (self.frames(i, i + 1) for i in range(len(self)))

    @cached_property
    def _renderer(self) -> StereoRenderer:
        return StereoRenderer(self.camera, self._body, self.person, self._config, self.name)

    @torch.no_grad()
    def frames(self, start: int = 0, stop: int | None = None) -> StereoFrames:
        """Images, depth and labels of the frames from `start` to before `stop` (None: all), as one batch."""
        stop = len(self) if stop is None else stop
        if not 0 <= start < stop <= len(self):
            raise ValueError(f"frames must be a range within 0 to {len(self)}, got {start} to {stop}")
        return self._renderer(self._body(self.pose[start:stop], self.size), first_frame=start)

    def background(
        self, count: int = 2
    ) -> tuple[Float[Tensor, "count 3 height width"], Float[Tensor, "count 3 height width"]]:
        """Left and right images of the empty room."""
        return self._renderer.background(count)

    def write_truth(self, folder: str | Path) -> Path:
        """Write `truth/` into a recording's folder: truth.npz, and per frame the depth (uint16, mm) and the
        labels.

        truth.npz holds joints_cam (T, 15, 3) m, joints_uv px, joint_names, pose (T, 24), size (S) and
        part_names, of which the label images are indices (0: the room). It is written last and appears whole.
        """
        truth = Path(folder) / "truth"
        truth.mkdir(parents=True, exist_ok=True)
        for i, frame in enumerate(self):
            depth = (frame.depth[0] * 1000).round().clamp(0, 65535).cpu().numpy().astype(np.uint16)
            labels = frame.labels[0].cpu().numpy().astype(np.uint8)
            for kind, image in (("depth", depth), ("label", labels)):
                with replacing(truth / f"{i:06d}_{kind}.png") as partial:
                    if not cv2.imwrite(str(partial), image):
                        raise OSError(f"could not write {partial}")
        with replacing(truth / "truth.npz") as partial:
            np.savez_compressed(
                partial,
                joints_cam=self.joints.cpu().numpy(),
                joints_uv=self.camera.project(self.joints).cpu().numpy(),
                joint_names=np.array(self._body.joint_names),
                pose=self.pose.cpu().numpy(),
                size=self.size[0].cpu().numpy(),
                part_names=np.array(("background", *self._body.segment_names)),
            )
        return truth


def make_recording(
    motion: str,
    person: int | Person = 0,
    take: int = 0,
    frames: int = 30,
    camera: StereoCamera | None = None,
    config: SynthesisConfig | None = None,
    body: BodyModel | None = None,
) -> SyntheticRecording:
    """A take of a motion (one of `motion.MOTIONS`) by a person, given by seed or in full, before a camera.

    `camera` defaults to `synthetic_camera()`, whose frame rate sets the times; a person stands in a room of
    their own. Raises ValueError for an unknown motion or no frames.
    """
    if frames < 1:
        raise ValueError(f"a recording must have at least one frame, got {frames}")
    camera, config, body = camera or synthetic_camera(), config or SynthesisConfig(), body or BodyModel()
    look, seed = (person, person.pattern) if isinstance(person, Person) else (draw_person(person), person)
    room = config.render.room
    moving = replace(config.motion, floor=room.camera_height)
    times = torch.arange(frames) / camera.frame_rate
    with torch.no_grad():
        pose = perform(body, look.size(body), motion, times, camera, seed, take, moving)
    render = replace(config.render, room=replace(room, seed=room.seed + seed))
    return SyntheticRecording(body, look, camera, pose, render, f"{motion} by {seed}, take {take}")


def make_demo(seed: int = 0, frames: int = 30) -> SyntheticRecording:
    """What `python infer.py` runs without a recording: both hands up and down, then a step; 2.5 s at 640 x
    480.
    """
    return make_recording("demo", Person(pattern=seed), seed, frames, synthetic_camera(frame_rate=12.0))


@dataclass(frozen=True)
class DatabaseConfig:
    """A database of activities (T. 5.3, which has 15 training and 40 test sequences of each)."""

    activities: tuple[str, ...] = ACTIVITIES
    train_subjects: int = 3
    test_subjects: int = 2
    train_sequences: int = 3  # of each activity, dealt to the subjects in turn
    test_sequences: int = 2
    frames: tuple[int, int] = (28, 40)  # least and most of a sequence
    frame_rate: float = 10.0  # Hz
    width: int = 320  # px
    height: int = 240  # px
    noise: tuple[float, float] = (
        0.6,
        1.8,
    )  # range of the factor on the sensor's noise, drawn for each sequence
    seed: int = 0
    synthesis: SynthesisConfig = field(default_factory=SynthesisConfig)

    def __post_init__(self) -> None:
        unknown = [name for name in self.activities if name not in MOTIONS]
        if unknown or not self.activities:
            raise ValueError(f"activities must be some of {', '.join(MOTIONS)}, got {unknown or 'none'}")
        for name in ("train_subjects", "test_subjects", "train_sequences", "test_sequences"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("frames", "noise"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise ValueError(f"{name} must be a positive range, low to high, got {low} to {high}")


@dataclass(frozen=True)
class PlannedClip:
    """One sequence of the database, not yet rendered."""

    activity: str
    subject: int  # the person's seed; training and test people differ
    take: int
    split: str  # train or test
    frames: int
    noise: float  # factor on the sensor's noise

    def record(self, config: DatabaseConfig, body: BodyModel | None = None) -> SyntheticRecording:
        """The recording itself; the same for the same settings."""
        sensor = config.synthesis.render.sensor
        sensor = replace(
            sensor, read_noise=self.noise * sensor.read_noise, shot_noise=self.noise * sensor.shot_noise
        )
        synthesis = replace(config.synthesis, render=replace(config.synthesis.render, sensor=sensor))
        camera = synthetic_camera(config.width, config.height, config.frame_rate)
        return make_recording(self.activity, self.subject, self.take, self.frames, camera, synthesis, body)

    def key(self, config: DatabaseConfig, *settings: str) -> str:
        """A name for what is computed from this clip: it changes with whatever the clip's images depend on,
        and with `settings` (the package's version, the pipeline's settings), and with nothing else.
        """
        camera = (config.width, config.height, config.frame_rate)
        content = [dataclasses.asdict(self), dataclasses.asdict(config.synthesis), camera, settings]
        digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]
        return f"{self.activity}-{self.subject}-{self.take}-{digest}"


def plan_database(config: DatabaseConfig = DatabaseConfig()) -> list[PlannedClip]:
    """The clips of a database: for each activity the training sequences, then the test sequences.

    Length and noise are drawn alike for every activity, so neither tells one. The clips of a larger plan
    include those of a smaller one with the same subjects and seed.
    """
    people = config.train_subjects + config.test_subjects
    draw = random_stream("people", config.seed)
    pool = torch.randperm(1 << 16, generator=draw)[:people].tolist()
    splits = (
        ("train", pool[: config.train_subjects], config.train_sequences),
        ("test", pool[config.train_subjects :], config.test_sequences),
    )
    return [
        _plan_clip(config, activity, subjects[i % len(subjects)], i // len(subjects), split)
        for activity in config.activities
        for split, subjects, sequences in splits
        for i in range(sequences)
    ]


def _plan_clip(config: DatabaseConfig, activity: str, subject: int, take: int, split: str) -> PlannedClip:
    stream = random_stream("clip", config.seed, activity, subject, take)
    low, high = config.frames
    frames = int(torch.randint(low, high + 1, (), generator=stream))
    quiet, loud = config.noise
    noise = quiet + (loud - quiet) * torch.rand((), generator=stream).item()
    return PlannedClip(activity, subject, take, split, frames, noise)
