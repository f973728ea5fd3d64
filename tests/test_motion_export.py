"""The files for other programs, read back by those: OpenSim (where pyopensim is installed), bvhio, c3d and ezc3d.

What is read is compared with the body's joints by SciPy's rotations, which know nothing of ours.
"""

import dataclasses
import importlib
import math
from pathlib import Path
from types import ModuleType

import bvhio
import c3d
import ezc3d
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchpose import c3d_file
from torchpose.body.angle import ANATOMICAL_NAMES, LIMB_ANGLE_NAMES, anatomical_angles, limb_angles
from torchpose.body.model import BodyConfig, BodyModel, JointKind
from torchpose.bvh import write_bvh
from torchpose.c3d_file import write_c3d
from torchpose.cli import infer_main
from torchpose.export import JOINT_NAMES, PoseSequence, read_poses_csv
from torchpose.motion_export import ExportConfig, ExportFormat, export_motion
from torchpose.opensim import COORDINATES, MARKERS, PELVIS, to_opensim, write_mot, write_trc
from torchpose.trajectory_filter import FilterKind, filter_sequence

RATE = 20.0
SIDES = ("left", "right")


@pytest.fixture(scope="module", params=[JointKind.anatomical, JointKind.swing], ids=lambda kind: kind.value)
def body(request: pytest.FixtureRequest) -> BodyModel:
    return in_double(request.param)


def in_double(kind: JointKind) -> BodyModel:
    torch.set_default_dtype(torch.float64)
    try:
        return BodyModel(BodyConfig(joint=kind))
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.fixture(scope="module")
def size(body: BodyModel) -> torch.Tensor:
    """Somebody whose every length is another share of the body file's."""
    return torch.linspace(0.85, 1.15, len(body.size_names), dtype=torch.float64)[None]


def moving(body: BodyModel, size: torch.Tensor, time: int = 24, gone: tuple[int, ...] = ()) -> PoseSequence:
    """All joints from limit to limit, out of step, while the person turns twice on the spot and walks."""
    t = torch.arange(time, dtype=torch.float64)[:, None] / time
    phase = torch.arange(18.0, dtype=torch.float64) * 1.3
    low, high = body.low[6:], body.high[6:]
    joints = (low + high) / 2 + 0.45 * (high - low) * torch.sin(2 * math.pi * t + phase)
    root = torch.cat(
        [t, 0.1 * t, 3 + t, 4 * math.pi * t - 3, 0.4 * torch.sin(9 * t), 0.3 * torch.cos(7 * t)], 1
    )
    root[:, 3] = torch.remainder(root[:, 3] + math.pi, 2 * math.pi) - math.pi
    pose = torch.cat([root, joints], 1)
    posed = body(pose, size)
    stale = list(gone)
    return PoseSequence(
        frame=torch.arange(time) + 7,
        time_s=(torch.arange(time).double() + 7) / RATE,
        status=tuple("lost" if row in gone else "tracked" for row in range(time)),
        point_to_model=torch.full((time,), 0.01, dtype=torch.float64),
        joints=posed.joints.index_fill(0, torch.tensor(stale, dtype=torch.int64), 9.0),
        angle_names=ANATOMICAL_NAMES,
        angles=anatomical_angles(body, posed),
        angle_sd=torch.full((time, 21), 0.1, dtype=torch.float64),
        limb_angle_names=LIMB_ANGLE_NAMES,
        limb_angles=limb_angles(posed.joints),
        pose=pose,
    )


def rows_of(sequence: PoseSequence, rows: list[int] | slice) -> PoseSequence:
    fields = {
        name: tuple(np.array(value)[rows].tolist()) if name == "status" else value[rows]
        for name, value in vars(sequence).items()
        if name not in ("angle_names", "limb_angle_names") and value is not None
    }
    return dataclasses.replace(sequence, **fields)


def read_mot(path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """The header's `key=value` lines and the columns, by what OpenSim's guide says of the format."""
    head, _, text = path.read_text().partition("endheader\n")
    assert head.splitlines()[0] == "Coordinates"
    keys = dict(line.split("=", 1) for line in head.splitlines() if "=" in line)
    names, *rows = (line.split("\t") for line in text.splitlines())
    table = np.array(rows, dtype=float).reshape(len(rows), len(names))
    assert int(keys["nRows"]), int(keys["nColumns"]) == table.shape
    return keys, dict(zip(names, table.T, strict=True))


def turn(axes: str, *degrees: np.ndarray) -> Rotation:
    """One turn after the other about the moved axes of OpenSim's frame; a small letter turns the other way."""
    angles = np.stack([v if a.isupper() else -v for a, v in zip(axes, degrees, strict=True)], -1)
    return Rotation.from_euler(axes.upper(), angles, degrees=True)


class TestMot:
    def test_opensims_joints_put_the_limbs_where_ours_are(
        self, body: BodyModel, size: torch.Tensor, tmp_path: Path
    ) -> None:
        """Axes of Rajagopal2016.osim: z, x, y of pelvis, hip and shoulder, x and y mirrored on the left; knee and
        elbow about z, positive bent; the pelvis's origin 5.6 cm in front of the hips and 7.8 cm above."""
        sequence = moving(body, size)
        write_mot(tmp_path / "poses.mot", sequence)
        keys, read = read_mot(tmp_path / "poses.mot")
        assert keys["inDegrees"] == "yes"
        assert list(read) == ["time", *PELVIS, *(theirs for _, theirs, _ in COORDINATES)]
        points = dict(zip(JOINT_NAMES, to_opensim(sequence.joints).unbind(1), strict=True))

        def along(start: str, end: str) -> np.ndarray:
            return torch.nn.functional.normalize(points[end] - points[start], dim=-1).numpy()

        np.testing.assert_allclose(read["time"], sequence.time_s, atol=1e-6)
        pelvis = turn("ZXY", read["pelvis_tilt"], read["pelvis_list"], read["pelvis_rotation"])
        origin = np.stack([read[f"pelvis_t{axis}"] for axis in "xyz"], -1)
        np.testing.assert_allclose(
            origin + pelvis.apply([-0.056276, -0.07849, 0]), points["pelvis"], atol=1e-5
        )
        np.testing.assert_allclose(pelvis.apply([0, 1, 0]), along("pelvis", "neck"), atol=1e-5)
        np.testing.assert_allclose(pelvis.apply([0, 0, 1]), along("hip_left", "hip_right"), atol=1e-5)
        down = [0, -1, 0]
        for side in SIDES:
            axes, s = ("ZXY" if side == "right" else "Zxy"), side[0]
            thigh = pelvis * turn(
                axes, *(read[f"hip_{motion}_{s}"] for motion in ("flexion", "adduction", "rotation"))
            )
            shank = thigh * turn("z", read[f"knee_angle_{s}"])
            arm = pelvis * turn(axes, *(read[f"arm_{motion}_{s}"] for motion in ("flex", "add", "rot")))
            forearm = arm * turn("Z", read[f"elbow_flex_{s}"])
            for limb, start, end in (
                (thigh, "hip", "knee"),
                (shank, "knee", "ankle"),
                (arm, "shoulder", "elbow"),
                (forearm, "elbow", "wrist"),
            ):
                np.testing.assert_allclose(
                    limb.apply(down), along(f"{start}_{side}", f"{end}_{side}"), atol=1e-5
                )

    def test_angles_run_on_within_a_stretch(
        self, body: BodyModel, size: torch.Tensor, tmp_path: Path
    ) -> None:
        sequence = moving(body, size, 200)
        upright = sequence.angles.clone()
        upright[:, :5] = 0
        upright[:, 2] = torch.remainder(torch.linspace(0, 9, 200).double() + math.pi, 2 * math.pi) - math.pi
        write_mot(tmp_path / "poses.mot", dataclasses.replace(sequence, angles=upright))
        turned = read_mot(tmp_path / "poses.mot")[1]["pelvis_rotation"]
        np.testing.assert_allclose(turned, -np.rad2deg(np.linspace(0, 9, 200)), atol=1e-5)

    def test_a_limb_that_is_a_little_overstretched_is_not_turned_round(
        self, body: BodyModel, size: torch.Tensor, tmp_path: Path
    ) -> None:
        sequence = moving(body, size, 4)
        angles = sequence.angles.clone()
        columns = [ANATOMICAL_NAMES.index(name) for name in ("knee_flexion_left", "hip_rotation_left")]
        angles[:, columns] = torch.tensor([[4.0, 170], [4, -175], [4, 20], [40, 170]]).deg2rad().double()
        write_mot(tmp_path / "poses.mot", dataclasses.replace(sequence, angles=angles))
        read = read_mot(tmp_path / "poses.mot")[1]
        np.testing.assert_allclose(read["knee_angle_l"], [-4, -4, 4, 40], atol=1e-5)
        np.testing.assert_allclose(read["hip_rotation_l"], [-10, 5, 20, 170], atol=1e-5)

    def test_frames_without_a_pose_have_no_row(
        self, body: BodyModel, size: torch.Tensor, tmp_path: Path
    ) -> None:
        write_mot(tmp_path / "poses.mot", moving(body, size, gone=(0, 5, 6)))
        read = read_mot(tmp_path / "poses.mot")[1]
        rows = [row for row in range(24) if row not in (0, 5, 6)]
        np.testing.assert_allclose(read["time"], (np.array(rows) + 7) / RATE, atol=1e-6)
        assert all(np.isfinite(column).all() for column in read.values())

    def test_every_anatomical_angle_must_be_there(
        self, body: BodyModel, size: torch.Tensor, tmp_path: Path
    ) -> None:
        sequence = moving(body, size)
        less = dataclasses.replace(
            sequence,
            angle_names=ANATOMICAL_NAMES[1:],
            angles=sequence.angles[:, 1:],
            angle_sd=sequence.angle_sd[:, 1:],
        )
        with pytest.raises(ValueError, match=r"angle_names must have all .*trunk_flexion is missing"):
            write_mot(tmp_path / "poses.mot", less)


class TestTrc:
    def test_reads_back(self, body: BodyModel, size: torch.Tensor, tmp_path: Path) -> None:
        sequence = moving(body, size, gone=(5,))
        write_trc(tmp_path / "poses.trc", sequence)
        lines = [line.split("\t") for line in (tmp_path / "poses.trc").read_text().splitlines()]
        assert lines[0] == ["PathFileType", "4", "(X/Y/Z)", "poses.trc"]
        head = dict(zip(lines[1], lines[2], strict=True))
        assert (head["DataRate"], head["NumFrames"], head["NumMarkers"], head["Units"]) == (
            *("20", "24", "15", "mm"),
        )
        assert [name for name in lines[3][2:] if name] == [MARKERS[joint] for joint in JOINT_NAMES]
        assert lines[4][2:5] == ["X1", "Y1", "Z1"]
        assert lines[5] == [""]
        table = np.array(lines[6:], dtype=float)
        np.testing.assert_array_equal(table[:, 0], sequence.frame)
        np.testing.assert_allclose(table[:, 1], sequence.time_s, atol=1e-6)
        # x forward of a person who faces the camera, y up, z right: the camera's -z, -y and -x.
        expected = -1000 * sequence.joints.numpy()[..., ::-1].reshape(24, 45)
        rows = np.arange(24) != 5
        np.testing.assert_allclose(table[rows, 2:], expected[rows], atol=6e-4)
        assert np.isnan(table[5, 2:]).all()

    def test_the_axes_are_right_handed(self) -> None:
        assert torch.linalg.det(to_opensim(torch.eye(3))) == pytest.approx(1)


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
        return rows_of(moving(body, size, gone=(5,)), [row for row in range(24) if row not in (8, 9)])

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


@pytest.mark.filterwarnings("ignore")
class TestOpenSim:
    """By OpenSim's own readers: `pip install pyopensim`, 130 MB, and so no part of `make test`."""

    @pytest.fixture
    def common(self) -> ModuleType:
        return readers("pyopensim.common", "TimeSeriesTable")

    def test_coordinates(
        self, common: ModuleType, body: BodyModel, size: torch.Tensor, tmp_path: Path
    ) -> None:
        path = tmp_path / "poses.mot"
        write_mot(path, moving(body, size, gone=(5,)))
        table = readers("pyopensim.simulation", "TableProcessor").TableProcessor(str(path)).process()
        names, read = list(table.getColumnLabels()), read_mot(path)[1]
        assert table.getTableMetaDataAsString("inDegrees") == "yes"
        assert names == list(read)[1:]
        assert list(table.getIndependentColumn()) == pytest.approx(read["time"])
        for row in (0, 10, 22):
            values = [table.getRowAtIndex(row)[column] for column in range(len(names))]
            assert values == pytest.approx([read[name][row] for name in names])
        assert common.Storage(str(path)).isInDegrees()

    def test_markers(self, common: ModuleType, body: BodyModel, size: torch.Tensor, tmp_path: Path) -> None:
        path, sequence = tmp_path / "poses.trc", moving(body, size, gone=(5, 23))
        write_trc(path, sequence)
        table = common.TimeSeriesTableVec3(str(path))
        assert list(table.getColumnLabels()) == [MARKERS[joint] for joint in JOINT_NAMES]
        assert table.getTableMetaDataAsString("Units") == "mm"
        assert float(table.getTableMetaDataAsString("DataRate")) == RATE
        expected = 1000 * to_opensim(sequence.joints).numpy()
        for row in range(24):
            line = table.getRowAtIndex(row)
            points = np.array([[line[marker][axis] for axis in range(3)] for marker in range(15)])
            if row in (5, 23):
                assert np.isnan(points).all()
            else:
                np.testing.assert_allclose(points, expected[row], atol=6e-4)


def readers(module: str, name: str) -> ModuleType:
    """A part of pyopensim; the test is skipped where it, or a library below it, is not installed."""
    try:
        part = importlib.import_module(module)
    except ImportError:
        pytest.skip("pyopensim is not installed; pip install pyopensim, and OpenBLAS for its libraries")
    if not hasattr(part, name):
        pytest.skip("pyopensim cannot load its libraries; they need libopenblas.so.0")
    return part


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

    def test_nothing_is_asked_for(self, body: BodyModel, size: torch.Tensor, tmp_path: Path) -> None:
        assert export_motion(tmp_path, "", moving(body, size), body, size, ExportConfig(formats=())) == {}
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("time", [1, 2])
    def test_a_recording_of_a_frame_or_two(
        self, time: int, body: BodyModel, size: torch.Tensor, tmp_path: Path
    ) -> None:
        for kind in FilterKind:
            config = ExportConfig(formats=tuple(ExportFormat), filter=kind)
            export_motion(tmp_path, kind.value, moving(body, size, time), body, size, config)
            nobody = moving(body, size, time).of_nobody()
            export_motion(tmp_path, kind.value, nobody, body, size, config)

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

    def test_c3d_without_its_extra_is_said_before_anything_runs(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.setattr(c3d_file, "find_spec", lambda name: None)
        assert infer_main([f"output={tmp_path / 'out'}", "export.formats=[bvh,c3d]"]) == 2
        assert "pip install 'torchpose[c3d]'" in capsys.readouterr().err
        assert not (tmp_path / "out").exists()
