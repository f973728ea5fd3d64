"""Exports against the contract, spelt out here, and read back by csv, json, numpy and OpenCV."""

import csv
import dataclasses
import json
import math
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch.testing import assert_close

from torchpose.body.angle import ANATOMICAL_NAMES, LIMB_ANGLE_NAMES
from torchpose.body.model import BodyModel
from torchpose.export import (
    JOINT_NAMES,
    PoseSequence,
    open_video,
    pose_columns,
    read_pose_sd,
    read_poses_csv,
    read_poses_npz,
    write_poses_csv,
    write_poses_npz,
    write_summary,
)
from torchpose.session import summary_table

STATUS = ("absent", "entering", "tracked", "partial", "recovered", "lost")


@pytest.fixture
def sequence() -> PoseSequence:
    """One frame of each status, at 20 Hz, with numbers everywhere, also where there must be none."""
    time = len(STATUS)
    return PoseSequence(
        frame=torch.arange(time) * 2 + 100,
        time_s=(torch.arange(time) * 2 + 100).double() / 20,
        status=STATUS,
        point_to_model=torch.rand(time).double(),
        joints=torch.randn(time, 15, 3).double(),
        angle_names=("elbow_flexion_left", "neck_flexion"),
        angles=torch.randn(time, 2).double(),
        angle_sd=torch.rand(time, 2).double(),
        limb_angle_names=("elbow_left_limb",),
        limb_angles=torch.rand(time, 1).double(),
        pose=torch.randn(time, 24).double(),
        pose_covariance=torch.randn(time, 24, 24).double(),
    )


def test_columns_are_those_of_the_contract():
    columns = pose_columns(ANATOMICAL_NAMES, LIMB_ANGLE_NAMES)
    assert columns[:8] == [
        *("frame", "time_s", "status", "point_to_model_m"),
        *("pelvis_x_m", "pelvis_y_m", "pelvis_z_m", "neck_x_m"),
    ]
    contract = (
        "pelvis neck head shoulder_left shoulder_right elbow_left elbow_right wrist_left wrist_right "
        "hip_left hip_right knee_left knee_right ankle_left ankle_right"
    )
    assert [column.removesuffix("_x_m") for column in columns[4:49:3]] == contract.split()
    assert columns[49:53] == [
        *("trunk_flexion_deg", "trunk_flexion_sd_deg"),
        *("trunk_lateral_bending_deg", "trunk_lateral_bending_sd_deg"),
    ]
    limbs = "elbow_left elbow_right knee_left knee_right shoulder_left shoulder_right hip_left hip_right"
    assert columns[-8:] == [f"{limb}_limb_deg" for limb in limbs.split()]
    assert len(columns) == 4 + 45 + 2 * len(ANATOMICAL_NAMES) + 8 == len(set(columns))


def test_joints_are_the_body_model_s():
    assert BodyModel().joint_names == JOINT_NAMES


def test_csv_has_the_numbers_in_their_units(tmp_path: Path, sequence: PoseSequence):
    path = tmp_path / "new" / "poses.csv"
    write_poses_csv(path, sequence)
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["frame"] for row in rows] == ["100", "102", "104", "106", "108", "110"]
    assert [row["status"] for row in rows] == list(STATUS)
    assert rows[1]["time_s"] == "5.100000"
    row = rows[3]
    assert float(row["point_to_model_m"]) == pytest.approx(sequence.point_to_model[3].item(), abs=1e-6)
    assert float(row["wrist_right_y_m"]) == pytest.approx(sequence.joints[3, 8, 1].item(), abs=1e-6)
    assert float(row["ankle_right_z_m"]) == pytest.approx(sequence.joints[3, 14, 2].item(), abs=1e-6)
    degrees = {
        "elbow_flexion_left_deg": sequence.angles[3, 0],
        "elbow_flexion_left_sd_deg": sequence.angle_sd[3, 0],
        "neck_flexion_deg": sequence.angles[3, 1],
        "neck_flexion_sd_deg": sequence.angle_sd[3, 1],
        "elbow_left_limb_deg": sequence.limb_angles[3, 0],
    }
    for name, radians in degrees.items():
        assert float(row[name]) == pytest.approx(math.degrees(radians.item()), abs=1e-4)
    assert [path.name for path in path.parent.iterdir()] == ["poses.csv"]


def test_frames_without_a_pose_have_empty_cells(tmp_path: Path, sequence: PoseSequence):
    path = tmp_path / "poses.csv"
    write_poses_csv(path, sequence)
    with path.open(newline="") as file:
        _, *rows = csv.reader(file)
    for row in rows:
        assert all(row[:3])
        assert set(map(bool, row[3:])) == {row[2] not in ("absent", "lost")}


def test_what_is_not_finite_is_an_empty_cell(tmp_path: Path, sequence: PoseSequence):
    sequence.joints[2, 4] = torch.tensor([math.nan, math.inf, -math.inf], dtype=torch.float64)
    write_poses_csv(tmp_path / "poses.csv", sequence)
    with (tmp_path / "poses.csv").open(newline="") as file:
        row = list(csv.DictReader(file))[2]
    assert [row[f"shoulder_right_{axis}_m"] for axis in "xyz"] == ["", "", ""]
    assert row["shoulder_left_x_m"]
    assert row["elbow_left_x_m"]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_csv_reads_back(tmp_path: Path, sequence: PoseSequence, dtype: torch.dtype):
    fields = {
        field.name: value.to(dtype)
        if isinstance(value, torch.Tensor) and value.is_floating_point()
        else value
        for field in dataclasses.fields(sequence)
        for value in [getattr(sequence, field.name)]
    }
    write_poses_csv(tmp_path / "poses.csv", PoseSequence(**fields))
    back = read_poses_csv(tmp_path / "poses.csv")
    clean = sequence.without_stale_numbers()
    assert (back.status, back.angle_names, back.limb_angle_names) == (
        clean.status,
        clean.angle_names,
        clean.limb_angle_names,
    )
    assert torch.equal(back.frame, clean.frame)
    for name in ("time_s", "point_to_model", "joints", "angles", "angle_sd", "limb_angles"):
        assert_close(getattr(back, name), getattr(clean, name), atol=1e-6, rtol=1e-6, equal_nan=True)
    assert back.pose is None


def test_an_empty_table_reads_back(tmp_path: Path, sequence: PoseSequence):
    nothing = {
        field.name: value[:0] if field.name not in ("angle_names", "limb_angle_names") else value
        for field in dataclasses.fields(sequence)
        for value in [getattr(sequence, field.name)]
    }
    write_poses_csv(tmp_path / "poses.csv", PoseSequence(**nothing))
    assert len(read_poses_csv(tmp_path / "poses.csv")) == 0


def test_no_table_of_poses(tmp_path: Path):
    (tmp_path / "poses.csv").write_text("frame,time_s\n1,0.1\n")
    with pytest.raises(ValueError, match=r"poses.csv must have the columns of poses.csv, got frame, time_s"):
        read_poses_csv(tmp_path / "poses.csv")


def test_npz_keeps_everything_in_full_precision(tmp_path: Path, sequence: PoseSequence):
    path = tmp_path / "poses.npz"
    write_poses_npz(path, sequence)
    back = read_poses_npz(path)
    clean = sequence.without_stale_numbers()
    for field in dataclasses.fields(sequence):
        value, expected = getattr(back, field.name), getattr(clean, field.name)
        if isinstance(expected, torch.Tensor):
            assert_close(value, expected, atol=0, rtol=0, equal_nan=True)
        else:
            assert value == expected
    with np.load(path) as arrays:  # as a user reads it, without pickle
        assert tuple(arrays["joint_names"]) == JOINT_NAMES
        assert arrays["pose_covariance"].shape == (6, 24, 24)
        assert np.isnan(arrays["pose"][[0, 5]]).all()
        np.testing.assert_array_equal(arrays["pose"][1:5], sequence.pose[1:5])
    write_poses_npz(path, dataclasses.replace(sequence, pose=None, pose_covariance=None))
    assert read_poses_npz(path).pose is None


@pytest.mark.parametrize(("frames", "rows"), [(slice(1, 4), [1, 2, 3]), (torch.tensor([4, 0]), [4, 0])])
def test_some_frames_of_a_sequence(sequence: PoseSequence, frames: slice | torch.Tensor, rows: list[int]):
    some = sequence[frames]
    for field in dataclasses.fields(sequence):
        value, whole = getattr(some, field.name), getattr(sequence, field.name)
        if isinstance(whole, torch.Tensor):
            assert torch.equal(value, torch.stack([whole[row] for row in rows]))
        elif field.name == "status":
            assert value == tuple(whole[row] for row in rows)
        else:
            assert value == whole


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"status": ("tracked",) * 5 + ("found",)}, "status must be one of absent, .*got 'found'"),
        ({"status": ("tracked",) * 5}, "status must have an entry for each of 6, got 5"),
        ({"angle_names": ("a",)}, "angle_names must have an entry for each of 2, got 1"),
        ({"limb_angle_names": ()}, "limb_angle_names must have an entry for each of 1, got 0"),
    ],
)
def test_a_sequence_must_fit_together(sequence: PoseSequence, change: dict, message: str):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(sequence, **change)


class Mode(Enum):
    FAST = 1


@dataclass(frozen=True)
class Settings:
    mode: Mode = Mode.FAST
    weights: tuple[float, ...] = (1.0, math.nan)


def test_summary_is_json_with_sorted_keys(tmp_path: Path):
    summary = {
        "seconds": math.inf,
        "settings": Settings(),
        "counts": {"lost": np.int64(3), "absent": torch.tensor(2)},
        "per_frame": torch.tensor([0.5, math.nan]),
        "path": Path("/tmp/ü"),
        "flag": True,
        "nothing": None,
    }
    write_summary(tmp_path / "summary.json", summary)
    text = (tmp_path / "summary.json").read_text(encoding="utf-8")
    assert "NaN" not in text
    back = json.loads(text)
    assert back == {
        "seconds": None,
        "settings": {"mode": "FAST", "weights": [1.0, None]},
        "counts": {"lost": 3, "absent": 2},
        "per_frame": [0.5, None],
        "path": "/tmp/ü",
        "flag": True,
        "nothing": None,
    }
    assert list(back) == sorted(back)
    assert list(back["counts"]) == ["absent", "lost"]


@pytest.mark.parametrize(("width", "height"), [(64, 48), (65, 47)])
def test_video_reads_back(tmp_path: Path, width: int, height: int):
    path = tmp_path / "overlay.mp4"
    colours = torch.eye(3)[[0, 1, 2, 2, 0]] * 0.8 + 0.1
    with open_video(path, width, height, 12.5) as video:
        for colour in colours:
            video.write(colour[:, None, None].expand(3, height, width))
        assert not path.exists()
    video = cv2.VideoCapture(str(path))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(12.5)
    images = []
    while (image := video.read()[1]) is not None:
        images.append(image[..., ::-1] / 255)
    assert len(images) == len(colours)
    for image, colour in zip(images, colours, strict=True):
        assert image.shape == (height + height % 2, width + width % 2, 3)
        np.testing.assert_allclose(image.mean((0, 1)), colour, atol=0.05)  # lossy, chroma above all
    assert [file.name for file in tmp_path.iterdir()] == ["overlay.mp4"]


def test_a_video_that_fails_leaves_nothing(tmp_path: Path):
    def fail() -> None:
        with open_video(tmp_path / "overlay.mp4", 64, 48, 20.0) as video:
            video.write(torch.zeros(3, 48, 64))
            video.write(torch.zeros(3, 48, 32))

    with pytest.raises(ValueError, match="images must have the video's size 64 x 48, got 32 x 48"):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_whoever_enters_without_a_pose_is_not_answered(sequence: PoseSequence) -> None:
    assert sequence.answered == (False, True, True, True, True, False)
    joints = sequence.joints.clone()
    joints[1], joints[3, 4, 0] = torch.nan, torch.nan
    assert dataclasses.replace(sequence, joints=joints).answered == (False, False, True, True, True, False)


def test_a_run_without_a_pose_has_no_misfit_to_tell() -> None:
    summary = {
        "frames": 2,
        "status": {"entering": 2},
        "answered": 0.0,
        "point_to_model_m": {"mean": math.nan},
    }
    rest = {"seconds": 1.0, "seconds_per_frame": 0.5, "cpu_ms_per_frame": {}, "problems": [], "others": []}
    rest |= {"files": ["poses.csv"]}
    assert "point to model    -\n" in summary_table(summary | rest, Path("out"), 80)


def test_covariances_may_come_in_pieces_and_be_read_as_deviations(tmp_path: Path) -> None:
    """One file whether they are in memory together or not; the deviations are the roots of the diagonal."""
    T, P = 2500, 4
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(T, P, P, generator=generator, dtype=torch.float64)
    covariance, empty = root @ root.mT, torch.zeros(T, 1, dtype=torch.float64)
    whole = PoseSequence(
        frame=torch.arange(T),
        time_s=torch.arange(T, dtype=torch.float64),
        status=("tracked", "absent") * (T // 2),
        point_to_model=empty[:, 0],
        joints=torch.randn(T, 15, 3, generator=generator, dtype=torch.float64),
        angle_names=("knee",),
        angles=empty,
        angle_sd=empty,
        limb_angle_names=("elbow",),
        limb_angles=empty,
        pose=root[:, 0],
        pose_covariance=covariance,
    )
    write_poses_npz(tmp_path / "whole.npz", whole)
    clean = whole.without_stale_numbers().pose_covariance
    pieces = iter(clean.split([1, 1499, 1000]))
    write_poses_npz(tmp_path / "pieces.npz", dataclasses.replace(whole, pose_covariance=None), pieces)
    with np.load(tmp_path / "whole.npz") as one, np.load(tmp_path / "pieces.npz") as other:
        assert set(one.files) == set(other.files)
        for name in one.files:
            np.testing.assert_array_equal(one[name], other[name])
    sd = read_pose_sd(tmp_path / "pieces.npz")
    torch.testing.assert_close(sd, clean.diagonal(dim1=1, dim2=2).sqrt(), equal_nan=True)
    assert read_poses_npz(tmp_path / "whole.npz", covariance=False).pose_covariance is None
    write_poses_npz(tmp_path / "none.npz", dataclasses.replace(whole, pose_covariance=None))
    assert read_pose_sd(tmp_path / "none.npz") is None
