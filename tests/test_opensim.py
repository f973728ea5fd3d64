"""Files for OpenSim: coordinates that move its joints to where ours are, and markers; OpenSim itself reads both.

SciPy's rotations about the axes of Rajagopal2016.osim are the oracle, and OpenSim itself where pyopensim is installed.
"""

import dataclasses
import importlib
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from moving_body import RATE, body_fixture, moving, size_fixture
from scipy.spatial.transform import Rotation

from torchpose.body.angle import ANATOMICAL_NAMES
from torchpose.body.model import BodyModel
from torchpose.export import JOINT_NAMES
from torchpose.opensim import COORDINATES, MARKERS, PELVIS, to_opensim, write_mot, write_trc

SIDES = ("left", "right")


body, size = body_fixture(), size_fixture()


def read_mot(path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """The header's `key=value` lines and the columns, by what OpenSim's guide says of the format."""
    head, _, text = path.read_text().partition("endheader\n")
    assert head.splitlines()[0] == "Coordinates"
    keys = dict(line.split("=", 1) for line in head.splitlines() if "=" in line)
    names, *rows = (line.split("\t") for line in text.splitlines())
    table = np.array(rows, dtype=float).reshape(len(rows), len(names))
    assert (int(keys["nRows"]), int(keys["nColumns"])) == table.shape
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
        assert set(lines[11][2:]) == {"NaN"}  # as programs other than Python spell it

    def test_the_axes_are_right_handed(self) -> None:
        assert torch.linalg.det(to_opensim(torch.eye(3))) == pytest.approx(1)


def readers(module: str, name: str) -> ModuleType:
    """A part of pyopensim; the test is skipped where it, or a library below it, is not installed."""
    try:
        part = importlib.import_module(module)
    except ImportError:
        pytest.skip("pyopensim is not installed; pip install pyopensim, and OpenBLAS for its libraries")
    if not hasattr(part, name):
        pytest.skip("pyopensim cannot load its libraries; they need libopenblas.so.0")
    return part


@pytest.mark.filterwarnings("ignore")
class TestOpenSim:
    """By OpenSim's own readers: `pip install pyopensim`, 130 MB, and so no part of `make test`."""

    @pytest.fixture(autouse=True)
    def elsewhere(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """OpenSim leaves a log in the current folder."""
        monkeypatch.chdir(tmp_path)

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

    def test_opensims_own_joints_put_the_limbs_where_ours_are(
        self, body: BodyModel, size: torch.Tensor, tmp_path: Path
    ) -> None:
        """A model of Rajagopal2016.osim's joints, built and moved by OpenSim."""
        path, sequence = tmp_path / "poses.mot", moving(body, size)
        write_mot(path, sequence)
        simulation = readers("pyopensim.simulation", "TableProcessor")
        model = rajagopal_joints(simulation)
        state, coordinates = model.initSystem(), model.getCoordinateSet()
        table = simulation.TableProcessor(str(path)).process()
        names = list(table.getColumnLabels())
        points = dict(zip(JOINT_NAMES, to_opensim(sequence.joints).unbind(1), strict=True))
        assert sum(map(coordinates.contains, names)) == coordinates.getSize() == 22
        for row in range(0, 24, 3):
            for column, name in enumerate(names):
                if coordinates.contains(name):
                    value = table.getRowAtIndex(row)[column]
                    metres = name in PELVIS[3:]
                    coordinates.get(name).setValue(state, value if metres else math.radians(value), False)
            model.realizePosition(state)
            for limb, start, end in LIMBS:
                R = model.getBodySet().get(limb).getTransformInGround(state).R()
                down = [-R.get(axis, 1) for axis in range(3)]
                along = torch.nn.functional.normalize(points[end][row] - points[start][row], dim=-1)
                np.testing.assert_allclose(down, along, atol=1e-5)
            hips = [model.getBodySet().get(f"femur_{s}").getPositionInGround(state) for s in "rl"]
            middle = [(hips[0][axis] + hips[1][axis]) / 2 for axis in range(3)]
            np.testing.assert_allclose(middle, points["pelvis"][row], atol=1e-5)


LIMBS = tuple(
    (f"{bone}_{side[0]}", f"{start}_{side}", f"{end}_{side}")
    for side in SIDES
    for bone, start, end in (
        ("femur", "hip", "knee"),
        ("tibia", "knee", "ankle"),
        ("humerus", "shoulder", "elbow"),
        ("ulna", "elbow", "wrist"),
    )
)


def rajagopal_joints(simulation: ModuleType) -> Any:
    """Pelvis, thighs, shanks, arms: names, axes and hip centres of the model, the rest at round numbers."""
    common, simbody = readers("pyopensim.common", "ArrayStr"), readers("pyopensim.simbody", "Vec3")
    model, kept = simulation.Model(), []  # OpenSim takes over what it is given; Python must not free it
    Z, down = (0, 0, 1), (0, 0, -1)

    def vector(values: Any) -> Any:
        return simbody.Vec3(*map(float, values))

    def add(name: str, parent: Any, place: tuple, *axes: tuple[str, tuple]) -> Any:
        body = simulation.Body(name, 1.0, vector((0, 0, 0)), simbody.Inertia(1.0, 1.0, 1.0))
        motion = simulation.SpatialTransform()
        if len(axes) == 1:
            motion.updTransformAxis(1).setAxis(vector((1, 0, 0)))
            motion.updTransformAxis(2).setAxis(vector((0, 1, 0)))
        for number, (coordinate, axis) in enumerate(axes):
            part, line, array = (
                motion.updTransformAxis(number),
                common.LinearFunction(1.0, 0.0),
                common.ArrayStr(),
            )
            array.append(coordinate)
            line.this.disown()
            part.setCoordinateNames(array)
            part.setAxis(vector(axis))
            part.setFunction(line)
            kept.append((part, line, array))
        body.this.disown()
        model.addBody(body)
        origin = vector((0, 0, 0))
        joint = simulation.CustomJoint(
            f"to_{name}", parent, vector(place), origin, body, origin, origin, motion
        )
        joint.this.disown()
        model.addJoint(joint)
        kept.append((motion, joint))
        return body

    slides = zip(PELVIS[3:], ((1, 0, 0), (0, 1, 0), (0, 0, 1)), strict=True)
    turns = zip(PELVIS[:3], (Z, (1, 0, 0), (0, 1, 0)), strict=True)
    pelvis = add("pelvis", model.getGround(), (0, 0, 0), *turns, *slides)
    for s, sign in (("r", 1), ("l", -1)):
        ball = (Z, (sign, 0, 0), (0, sign, 0))
        hip = zip((f"hip_{motion}_{s}" for motion in ("flexion", "adduction", "rotation")), ball, strict=True)
        arm = zip((f"arm_{motion}_{s}" for motion in ("flex", "add", "rot")), ball, strict=True)
        femur = add(f"femur_{s}", pelvis, (-0.056276, -0.07849, sign * 0.07726), *hip)
        add(f"tibia_{s}", femur, (0, -0.4, 0), (f"knee_angle_{s}", down))
        humerus = add(f"humerus_{s}", pelvis, (0, 0.5, sign * 0.17), *arm)
        add(f"ulna_{s}", humerus, (0, -0.28, 0), (f"elbow_flex_{s}", Z))
    model.finalizeConnections()
    return model
