"""The files for other programs, read back by those: bvhio, c3d and ezc3d; and which of them are written."""

import dataclasses
import math
from pathlib import Path

import bvhio
import c3d
import ezc3d
import numpy as np
import pytest
import torch
from moving_body import RATE, body_fixture, moving, size_fixture

from torchpose import c3d_file
from torchpose.body.model import BodyModel
from torchpose.bvh import write_bvh
from torchpose.c3d_file import write_c3d
from torchpose.cli import infer_main
from torchpose.export import JOINT_NAMES, PoseSequence, read_poses_csv
from torchpose.motion_export import ExportConfig, ExportFormat, export_motion
from torchpose.opensim import MARKERS, to_opensim
from torchpose.session import summary_table
from torchpose.trajectory_filter import FilterKind, filter_sequence

body, size = body_fixture(), size_fixture()


class TestBvh:
    def test_every_joint_is_where_ours_is(self, body: BodyModel, size: torch.Tensor, tmp_path: Path) -> None:
        sequence = moving(body, size)
        held = write_bvh(tmp_path / "poses.bvh", sequence, body, size)
        assert torch.equal(held.frame, sequence.frame)
        file = bvhio.readAsBvh(str(tmp_path / "poses.bvh"))
        assert (file.FrameCount, file.FrameTime) == (24, pytest.approx(1 / RATE))
        root = bvhio.readAsHierarchy(str(tmp_path / "poses.bvh"))
        for row in range(24):
            root.loadPose(row)
            read = {joint.Name: np.array(joint.PositionWorld) for joint, _, _ in root.layout()}
            assert set(JOINT_NAMES) <= set(read)
            # x left of a person who faces the camera, y up, z towards the camera, in cm.
            placed = np.stack([read[joint] for joint in JOINT_NAMES]) * [0.01, -0.01, -0.01]
            np.testing.assert_allclose(placed, sequence.joints[row], atol=2e-5)

    def test_limbs_are_as_long_as_the_person_s(
        self, body: BodyModel, size: torch.Tensor, tmp_path: Path
    ) -> None:
        write_bvh(tmp_path / "poses.bvh", moving(body, size, 2), body, size)
        root = bvhio.readAsBvh(str(tmp_path / "poses.bvh")).Root
        offsets = {joint.Name: np.linalg.norm(joint.Offset) for joint, _, _ in root.layout()}
        share = dict(zip(body.size_names, size[0].tolist(), strict=True))
        for joint, length, metres in (
            ("elbow_left", "upper_arm", 0.278),
            ("knee_right", "thigh", 0.404),
            ("wrist_right", "forearm", 0.271),
            ("hip_left", "hip_width", 0.1),
        ):
            assert offsets[joint] == pytest.approx(100 * metres * share[length], abs=1e-4)

    def test_angles_go_on_smoothly(self, body: BodyModel, size: torch.Tensor, tmp_path: Path) -> None:
        """No Euler angle jumps where the joint does not: programs draw curves between the frames."""
        sequence = moving(body, size, 600)
        write_bvh(tmp_path / "poses.bvh", sequence, body, size)
        frames = np.loadtxt((tmp_path / "poses.bvh").read_text().partition("Frame Time")[2].splitlines()[1:])
        root_turns = frames[:, 3:6]
        assert np.abs(np.diff(root_turns, axis=0)).max() < 10

    def test_the_longest_stretch_with_short_gaps_bridged(
        self, body: BodyModel, size: torch.Tensor, tmp_path: Path
    ) -> None:
        sequence = moving(body, size, 60, gone=(3, *range(20, 30), 40))
        held = write_bvh(tmp_path / "poses.bvh", sequence, body, size, gap=0.1)
        assert held.frame.tolist() == list(range(30 + 7, 60 + 7))
        file = bvhio.readAsBvh(str(tmp_path / "poses.bvh"))
        assert file.FrameCount == 30
        root = bvhio.readAsHierarchy(str(tmp_path / "poses.bvh"))
        root.loadPose(10)  # frame 40, between its neighbours' poses
        assert sequence.pose is not None
        change = sequence.pose[41] - sequence.pose[39]
        change[3:6] = torch.remainder(change[3:6] + math.pi, 2 * math.pi) - math.pi
        middle = body(sequence.pose[39:40] + change / 2, size).joints[0]
        read = {joint.Name: np.array(joint.PositionWorld) for joint, _, _ in root.layout()}
        placed = np.stack([read[joint] for joint in JOINT_NAMES]) * [0.01, -0.01, -0.01]
        np.testing.assert_allclose(placed, middle, atol=2e-5)
        alone = write_bvh(tmp_path / "poses.bvh", sequence, body, size, gap=0.0)
        assert alone.frame.tolist() == list(range(41 + 7, 60 + 7))

    def test_one_frame_and_none(self, body: BodyModel, size: torch.Tensor, tmp_path: Path) -> None:
        sequence = moving(body, size, 3, gone=(0, 2))
        assert len(write_bvh(tmp_path / "one.bvh", sequence, body, size)) == 1
        assert bvhio.readAsBvh(str(tmp_path / "one.bvh")).FrameCount == 1
        assert len(write_bvh(tmp_path / "none.bvh", sequence.of_nobody(), body, size)) == 0
        assert "Frames: 0\n" in (tmp_path / "none.bvh").read_text()

    def test_the_body_s_pose_must_be_there(self, body: BodyModel, size: torch.Tensor, tmp_path: Path) -> None:
        with pytest.raises(
            ValueError, match=r"must have the body's pose for a BVH file, got None; read poses.npz"
        ):
            write_bvh(tmp_path / "a.bvh", dataclasses.replace(moving(body, size), pose=None), body, size)


class TestC3d:
    @pytest.fixture
    def sequence(self, body: BodyModel, size: torch.Tensor) -> PoseSequence:
        """Frame 5 is lost, frames 8 and 9 were dropped."""
        return moving(body, size, gone=(5,))[torch.tensor([row for row in range(24) if row not in (8, 9)])]

    @pytest.mark.filterwarnings("ignore:No analog data")  # there is none
    def test_reads_back_by_another_library(self, sequence: PoseSequence, tmp_path: Path) -> None:
        write_c3d(tmp_path / "poses.c3d", sequence)
        with (tmp_path / "poses.c3d").open("rb") as file:
            reader = c3d.Reader(file)
            assert reader.point_rate == RATE
            assert [label.strip() for label in reader.point_labels] == [MARKERS[j] for j in JOINT_NAMES]
            assert reader.get_string("POINT:UNITS").strip() == "mm"
            frames = [points.copy() for _, points, _ in reader.read_frames()]
        assert len(frames) == 24
        expected = -1000 * sequence.joints.numpy()[..., ::-1]
        rows = [row for row in range(24) if row not in (8, 9)]
        for row, joints in zip(rows, expected, strict=True):
            if row != 5:
                np.testing.assert_allclose(frames[row][:, :3], joints, atol=1e-3)
                assert (frames[row][:, 3] >= 0).all()
        for row in (5, 8, 9):
            assert (frames[row][:, 3] == -1).all()
            assert (frames[row][:, :3] == 0).all()

    def test_ezc3d_reads_no_number_where_there_is_none(self, sequence: PoseSequence, tmp_path: Path) -> None:
        write_c3d(tmp_path / "poses.c3d", sequence)
        file = ezc3d.c3d(str(tmp_path / "poses.c3d"))
        missing = np.isin(np.arange(24), (5, 8, 9))
        assert (file["data"]["meta_points"]["residuals"][0] < 0).all(0).tolist() == missing.tolist()
        assert file["parameters"]["POINT"]["Y_SCREEN"]["value"] == ["+Y"]


class TestExport:
    def test_what_is_asked_for_and_what_is_left_out(
        self, body: BodyModel, size: torch.Tensor, tmp_path: Path
    ) -> None:
        sequence = moving(body, size, 40, gone=tuple(range(20, 30)))
        notes = export_motion(
            tmp_path,
            "_2",
            sequence,
            body,
            size,
            ExportConfig(formats=tuple(ExportFormat), filter=FilterKind.rts),
        )
        assert notes == {"poses_2.bvh": {"first_frame": 7, "frames": 20, "left_out": 10}}
        names = {path.name for path in tmp_path.iterdir()}
        assert names == {
            *("poses_2.mot", "poses_2.trc", "poses_2.bvh", "poses_2.c3d", "poses_2_filtered.csv"),
        }
        filtered = filter_sequence(sequence, FilterKind.rts)
        table = read_poses_csv(tmp_path / "poses_2_filtered.csv")
        torch.testing.assert_close(table.joints, filtered.joints, atol=1e-6, rtol=0, equal_nan=True)
        trc = np.loadtxt(tmp_path / "poses_2.trc", skiprows=6)
        np.testing.assert_allclose(
            trc[:, 2:5], 1000 * to_opensim(filtered.joints[:, 0]), atol=6e-4, equal_nan=True
        )

    def test_the_summary_says_that_poses_are_outside(self, tmp_path: Path) -> None:
        summary = {
            "frames": 40,
            "status": {"tracked": 30, "lost": 10},
            "answered": 0.75,
            "point_to_model_m": {"mean": 0.01},
            "bvh": {
                "poses.bvh": {"first_frame": 7, "frames": 20, "left_out": 10},
                "poses_2.bvh": {"first_frame": 0, "frames": 40, "left_out": 0},
            },
        }
        rest = {
            "seconds": 1.0,
            "seconds_per_frame": 0.5,
            "cpu_ms_per_frame": {},
            "problems": [],
            "others": [],
        }
        files = {"files": ["poses.bvh", "poses.csv", "poses_2.bvh"]}
        lines = summary_table(summary | rest | files, tmp_path, 200).splitlines()
        assert (
            "poses.bvh         holds the longest stretch of poses, 20 frames from 7 on; 10 poses are outside"
            in lines
        )
        assert not any(line.startswith("poses_2.bvh") for line in lines)

    def test_nothing_is_asked_for(self, body: BodyModel, size: torch.Tensor, tmp_path: Path) -> None:
        assert export_motion(tmp_path, "", moving(body, size), body, size, ExportConfig(formats=())) == {}
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("time", [1, 2])
    def test_a_recording_of_a_frame_or_two(
        self, time: int, body: BodyModel, size: torch.Tensor, tmp_path: Path
    ) -> None:
        for kind in FilterKind:
            config = ExportConfig(formats=tuple(ExportFormat), filter=kind)
            for frames, sequence in (
                (time, moving(body, size, time)),
                (0, moving(body, size, time).of_nobody()),
            ):
                notes = export_motion(tmp_path, kind.value, sequence, body, size, config)
                path = tmp_path / f"poses{kind.value}"
                assert notes[f"{path.name}.bvh"]["frames"] == frames
                assert f"nRows={frames}\n" in path.with_suffix(".mot").read_text()
                markers = np.array(
                    [line.split("\t") for line in path.with_suffix(".trc").read_text().splitlines()[6:]]
                )
                assert markers.shape == (time, 47)
                assert np.isfinite(markers[:, 2:].astype(float)).all() == (frames > 0)
                assert path.with_suffix(".c3d").stat().st_size > 0

    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"formats": (ExportFormat.mot, ExportFormat.mot)}, "formats must be different, got mot, mot"),
            ({"cutoff": 0.0}, r"cutoff must be positive, got 0.0 Hz"),
            ({"speed_cutoff": math.nan}, "speed_cutoff must be positive, got nan"),
            ({"beta": -1.0}, "beta must not be negative, got -1.0"),
            ({"gap": -0.1}, "gap must not be negative"),
            ({"order": 3}, "order must be even and at least 2"),
        ],
    )
    def test_bad_settings(self, settings: dict, message: str) -> None:
        with pytest.raises(ValueError, match=message):
            ExportConfig(**settings)

    def test_a_cutoff_that_the_camera_cannot_see(self) -> None:
        config = ExportConfig(filter=FilterKind.butterworth, cutoff=6.0)
        config.check_rate(20.0)
        ExportConfig(filter=FilterKind.rts, cutoff=6.0).check_rate(10.0)
        with pytest.raises(ValueError, match=r"export.cutoff must be below half of the 10 frames a second"):
            config.check_rate(10.0)

    def test_a_camera_that_dropped_frames_costs_the_filter_and_not_the_run(
        self, body: BodyModel, size: torch.Tensor, tmp_path: Path
    ) -> None:
        sequence = moving(body, size)[::2]
        config = ExportConfig(formats=(ExportFormat.mot,), filter=FilterKind.butterworth)
        with pytest.warns(
            UserWarning, match=r"below half of the 10 frames a second .* poses_3 is not filtered"
        ):
            export_motion(tmp_path, "_3", sequence, body, size, config)
        assert {path.name for path in tmp_path.iterdir()} == {"poses_3.mot"}

    def test_c3d_without_its_extra_is_said_before_anything_runs(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.setattr(c3d_file, "find_spec", lambda name: None)
        assert infer_main([f"output={tmp_path / 'out'}", "export.formats=[bvh,c3d]"]) == 2
        assert "pip install 'torchpose[c3d]'" in capsys.readouterr().err
        assert not (tmp_path / "out").exists()
