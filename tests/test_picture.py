"""What a run draws: each frame's own image, points and depth, whoever is in it, at whatever position."""

from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from torchpose import picture
from torchpose.overlay import overlays
from torchpose.parts import LabelledPoints, Parts, PersonParts
from torchpose.picture import draw_pictures, plain_image
from torchpose.pipeline import FramePose, StereoToPose
from torchpose.recording import Backgrounds, Frame, UnreadableFrame
from torchpose.report import Report
from torchpose.tracking.tracker import TrackStatus
from torchpose.vision.camera import StereoCamera

CAMERA = StereoCamera(64, 48, 60.0, 32.0, 24.0, 0.1, 10.0)
LENGTHS = (3, 2)  # frames of each part
COUNT, BROKEN = sum(LENGTHS), 3


class Shades:
    """Frames whose grey tells their position; one cannot be read."""

    camera = CAMERA

    def __len__(self) -> int:
        return COUNT

    def __getitem__(self, position: int, /) -> Frame:
        if position == BROKEN:
            raise UnreadableFrame("gone", position, position / 10)
        image = torch.full((3, CAMERA.height, CAMERA.width), 0.2 + 0.1 * position)
        return Frame(position, position / 10, image, image)

    def background(self) -> Backgrounds:
        return Backgrounds()


class Kept(Report):
    """Remembers what it is given."""

    def __init__(self, *args: object) -> None:
        super().__init__(*args)
        self.images: dict[int, torch.Tensor] = {}
        self.points: dict[tuple[int, int], int] = {}

    def add_image(self, position: int, image: torch.Tensor) -> None:
        self.images[position] = image

    def add_points(self, person: int, position: int, points: torch.Tensor, labels: torch.Tensor) -> None:
        assert len(points) == len(labels)
        self.points[person, position] = len(points)


class Log:
    """In place of Rerun's: what was logged, by frame."""

    def __init__(self) -> None:
        self.frame, self.depths, self.people = -1, dict[int, list[int]](), dict[tuple[int, int], int]()

    def at(self, frame: int, time_s: float) -> None:
        assert time_s == pytest.approx(frame / 10)
        self.frame = frame

    def add_angles(self, person: int, poses: object) -> None: ...

    def add_image(self, image: torch.Tensor) -> None: ...

    def add_depth(self, png: np.ndarray) -> None:
        self.depths[self.frame] = png.tolist()

    def add_person(
        self, person: int, status: str, pose: object, points: torch.Tensor, labels: object
    ) -> None:
        self.people[person, self.frame] = len(points)


@pytest.fixture(scope="module")
def model() -> StereoToPose:
    return StereoToPose(CAMERA)


@pytest.fixture
def people(tmp_path: Path, model: StereoToPose) -> list[tuple[StereoToPose, PersonParts]]:
    """Two people without poses, whose points are as many as the frame's position, and ten times that."""
    parts, start = Parts(tmp_path / "parts"), 0
    parts.begin("key")
    for length in LENGTHS:
        frames = range(start, start + length)
        poses = model.sequence([FramePose(i, i / 10, TrackStatus.lost, None, None) for i in frames])
        points = [
            [LabelledPoints(torch.full((k * i, 3), 2.0), torch.zeros(k * i).long()) for i in frames]
            for k in (1, 10)
        ]
        start += length
        depths = [np.arange(i + 1, dtype=np.uint8) for i in frames]
        parts.save(start, [poses, poses], points, [model.state(), model.state()], depths)
    return [(model, parts.person(0)), (model, parts.person(1))]


def test_each_frame_gets_what_is_its_own(people, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    log = Log()

    @contextmanager
    def opened(*_: object):
        yield log

    monkeypatch.setattr(picture, "open_rerun_log", opened)
    monkeypatch.setattr(picture, "_DRAWN", 2)  # stretches that end inside of a part, and across two
    model = people[0][0]
    report = Kept("run", model.body, [model.size, model.size], COUNT)
    draw_pictures(tmp_path, Shades(), people, report, viz=True)
    corner = {i: round(float(image[0, -1, -1]), 2) for i, image in report.images.items()}
    assert corner == {0: 0.2, 1: 0.3, 2: 0.4, BROKEN: 0.0, 4: 0.6}
    assert report.points == {(k, i): (1, 10)[k] * i for k in (0, 1) for i in range(COUNT)}
    assert log.people == report.points
    assert log.depths == {i: list(range(i + 1)) for i in range(COUNT)}
    assert (tmp_path / "overlay.mp4").stat().st_size > 0


def test_depth_that_nobody_kept_is_none(people, model: StereoToPose):
    parts = people[0][1].parts
    poses = model.sequence([FramePose(5, 0.5, TrackStatus.lost, None, None)])
    parts.save(COUNT + 1, [poses], [[LabelledPoints.none()]], [model.state()])
    assert len(parts.depth(COUNT)) == 0


def test_an_unreadable_frame_is_black(model: StereoToPose):
    assert_close(plain_image(Shades(), BROKEN, (48, 64)), torch.zeros(3, 48, 64))
    assert plain_image(Shades(), 1, (48, 64)).unique().tolist() == pytest.approx([0.3])


def test_several_people_have_rows_and_numbers_and_one_alone_has_none(model: StereoToPose):
    lost = model.sequence([FramePose(0, 0.0, TrackStatus.lost, None, None)] * 2)
    pose = torch.cat([torch.tensor([0.0, 0, 3, 0, 0, 0]), model.body.rest])[None].to(lost.angles)
    angles = torch.full_like(lost.angles, 0.5)
    sequence = replace(
        lost,
        status=("lost", "tracked"),
        pose=torch.cat([pose * torch.nan, pose]),
        angles=angles,
        angle_sd=torch.where(torch.tensor([n == "knee_flexion_left" for n in lost.angle_names]), 1.0, 0.1)
        + 0 * angles,
    )
    points = [LabelledPoints.none()] * 2
    first, second = overlays(model, sequence, points, 1)
    assert (first.status, first.row, first.outlines) == ("2 lost", 1, None)
    assert (second.status, second.row, second.name) == ("2 tracked", 1, "2")
    # 57 degrees of standard deviation say nothing: that knee has no number.
    assert dict(second.marks) == {"elbow_left": "29", "elbow_right": "29", "knee_right": "29"}
    alone = overlays(model, sequence, points)[1]
    assert (alone.status, alone.row, alone.name) == ("tracked", 0, "")
