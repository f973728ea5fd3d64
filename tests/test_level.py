"""Motions on the floor: what a level camera would have seen, whatever the pitch and roll of the one that did.

The tilted camera and its poses are made by SciPy's rotations; the level camera's are the body's own.
"""

import dataclasses
import math
from pathlib import Path

import bvhio
import numpy as np
import pytest
import torch
from moving_body import body_fixture, moving, size_fixture
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

import torchpose as tp
from torchpose import level as module
from torchpose.body.angle import TRUNK_NAMES, anatomical_angles, limb_angles, trunk_angles, trunk_turn
from torchpose.body.model import BodyModel
from torchpose.cli import load_config
from torchpose.export import JOINT_NAMES, PoseSequence
from torchpose.level import level_sequence, rotation_to_floor
from torchpose.motion_export import ExportConfig, ExportFormat, export_motion
from torchpose.opensim import PELVIS, to_opensim, write_mot
from torchpose.resampling import resample
from torchpose.session import _floor_entry
from torchpose.trajectory_filter import FilterKind
from torchpose.vision.camera import StereoCamera
from torchpose.vision.floor import Floor, find_floor

# Degrees by which the camera looks down and leans, and m of it over the floor.
CAMERAS = [(0, 0, 0.8), (14, 0, 1.2), (0, 12, 1.0), (30, 5, 1.6), (-9, -20, 0.5), (25, 25, 2.0)]
TRUNK = slice(0, 3)  # of the anatomical angles


body, size = body_fixture(), size_fixture()


def axes_of(pitch: float, roll: float) -> np.ndarray:
    """Columns: right, down and viewing direction of a camera, in the frame of the level one that looks as it does."""
    return Rotation.from_euler("XZ", [-pitch, roll], degrees=True).as_matrix()


def floor_of(pitch: float, roll: float, height: float) -> Floor:
    return Floor(
        torch.tensor(axes_of(pitch, roll).T @ [0.0, -1.0, 0.0]), torch.tensor(height, dtype=torch.float64)
    )


def of_pose(body: BodyModel, size: torch.Tensor, pose: torch.Tensor, like: PoseSequence) -> PoseSequence:
    """A sequence of these poses, with the body's joints and angles; frames without a pose are those of `like`."""
    posed = body(pose, size)
    there = torch.tensor(like.answered)
    sequence = dataclasses.replace(
        like,
        pose=pose,
        joints=posed.joints,
        angles=anatomical_angles(body, posed),
        limb_angles=limb_angles(posed.joints),
    )
    blank = {
        name: getattr(sequence, name).masked_fill(
            ~there.view(-1, *[1] * (getattr(sequence, name).ndim - 1)), torch.nan
        )
        for name in ("pose", "joints", "angles", "limb_angles", "angle_sd")
    }
    return dataclasses.replace(sequence, **blank)


def seen_by(
    pitch: float, roll: float, height: float, body: BodyModel, size: torch.Tensor, level: PoseSequence
) -> tuple[PoseSequence, PoseSequence]:
    """What a tilted camera makes of a level camera's motion, and that motion with the floor at 0."""
    axes, pose = axes_of(pitch, roll), level.pose.numpy()
    turns = axes.T @ Rotation.from_euler("YXZ", pose[:, 3:6]).as_matrix()
    root = Rotation.from_matrix(turns).as_euler("YXZ")
    tilted = torch.from_numpy(np.hstack([pose[:, :3] @ axes, root, pose[:, 6:]]))
    standing = level.pose.clone()
    standing[:, 1] -= height
    return of_pose(body, size, tilted, level), of_pose(body, size, standing, level)


def same_angles(one: torch.Tensor, other: torch.Tensor, atol: float = 1e-9) -> None:
    gap = torch.remainder(one - other + torch.pi, 2 * torch.pi) - torch.pi
    assert_close(
        gap, torch.zeros_like(gap).masked_fill(other.isnan(), torch.nan), atol=atol, rtol=0, equal_nan=True
    )


@pytest.mark.parametrize("camera", CAMERAS)
class TestAnyCamera:
    def test_what_the_level_camera_sees(
        self, camera: tuple[float, float, float], body: BodyModel, size: torch.Tensor
    ) -> None:
        seen, wanted = seen_by(*camera, body, size, moving(body, size))
        found = level_sequence(seen, floor_of(*camera))
        assert_close(found.joints, wanted.joints, atol=1e-9, rtol=0)
        same_angles(found.angles, wanted.angles)
        same_angles(found.pose[:, 3:6], wanted.pose[:, 3:6])
        assert_close(found.pose[:, :3], wanted.pose[:, :3], atol=1e-9, rtol=0)
        posed = body(found.pose, size)
        assert_close(posed.joints, found.joints, atol=1e-9, rtol=0)
        same_angles(anatomical_angles(body, posed), found.angles)
        for same in ("frame", "time_s", "limb_angles", "point_to_model"):
            assert getattr(found, same) is getattr(seen, same)
        assert torch.equal(found.angles[:, 3:], seen.angles[:, 3:])
        assert torch.equal(found.pose[:, 6:], seen.pose[:, 6:])

    def test_heights_and_distances_stay(
        self, camera: tuple[float, float, float], body: BodyModel, size: torch.Tensor
    ) -> None:
        seen, _ = seen_by(*camera, body, size, moving(body, size))
        floor = floor_of(*camera)
        found = level_sequence(seen, floor).joints
        assert_close(-found[..., 1], floor.above(seen.joints), atol=1e-12, rtol=0)
        assert_close(torch.cdist(found, found), torch.cdist(seen.joints, seen.joints), atol=1e-9, rtol=0)

    def test_the_camera_s_own_place_and_view(self, camera: tuple[float, float, float]) -> None:
        """Straight above the origin; what lies ahead is straight ahead on the floor; and the frame is right-handed."""
        floor = floor_of(*camera)
        R = rotation_to_floor(floor)
        assert_close(R, torch.tensor(axes_of(*camera[:2])), atol=1e-12, rtol=0)
        assert_close(torch.linalg.det(R), torch.ones((), dtype=torch.float64), atol=1e-12, rtol=0)
        assert float(R[0, 2]) == pytest.approx(0, abs=1e-15)
        assert float(R[2, 2]) > 0

    def test_opensim_s_pelvis_is_the_level_camera_s(
        self, camera: tuple[float, float, float], body: BodyModel, size: torch.Tensor, tmp_path: Path
    ) -> None:
        seen, wanted = seen_by(*camera, body, size, moving(body, size, 40, gone=(7, 8)))
        tables = []
        for sequence in (level_sequence(seen, floor_of(*camera)), wanted):
            write_mot(tmp_path / "a.mot", sequence)
            names, *rows = (tmp_path / "a.mot").read_text().partition("endheader\n")[2].splitlines()
            assert tuple(names.split("\t")[1:7]) == PELVIS
            tables.append(np.array([row.split("\t") for row in rows], dtype=float))
        np.testing.assert_allclose(*tables, atol=2e-5)
        assert len(tables[0]) == 38

    def test_bvh_reads_back(
        self, camera: tuple[float, float, float], body: BodyModel, size: torch.Tensor, tmp_path: Path
    ) -> None:
        seen, wanted = seen_by(*camera, body, size, moving(body, size, 6))
        tp.write_bvh(tmp_path / "a.bvh", level_sequence(seen, floor_of(*camera)), body, size)
        root = bvhio.readAsHierarchy(str(tmp_path / "a.bvh"))
        for row in range(6):
            root.loadPose(row)
            read = {joint.Name: np.array(joint.PositionWorld) for joint, _, _ in root.layout()}
            placed = np.stack([read[joint] for joint in JOINT_NAMES]) * [0.01, -0.01, -0.01]
            np.testing.assert_allclose(placed, wanted.joints[row], atol=2e-5)


def upright(body: BodyModel, size: torch.Tensor, time: int = 30) -> PoseSequence:
    """Somebody who stands and turns on the spot in front of a level camera 1.2 m over the floor, ankles 8 cm up."""
    sequence = moving(body, size, time)
    pose = torch.zeros_like(sequence.pose)
    pose[:, 2], pose[:, 3] = 3.0, torch.linspace(-0.6, 0.6, time)
    pose[:, 1] = 1.2 - 0.08 - body(pose, size).joints[:, -2:, 1].amax(1)
    return of_pose(body, size, pose, sequence)


class TestUpright:
    def test_nobody_leans_because_the_camera_does(
        self, body: BodyModel, size: torch.Tensor, tmp_path: Path
    ) -> None:
        seen, _ = seen_by(14, 6, 1.2, body, size, upright(body, size))
        assert seen.angles[:, :2].abs().amax(1).min() > math.radians(10)
        found = level_sequence(seen, floor_of(14, 6, 1.2))
        assert_close(found.angles[:, :2], torch.zeros(30, 2).double(), atol=1e-9, rtol=0)
        assert_close(found.angles[:, 2], torch.linspace(-0.6, 0.6, 30).double(), atol=1e-6, rtol=0)
        above = to_opensim(found.joints)[..., 1]
        assert_close(above[:, -2:].amin(1), torch.full((30,), 0.08, dtype=torch.float64), atol=1e-9, rtol=0)
        assert (above[:, JOINT_NAMES.index("head")] > 1.2).all()

    def test_a_level_camera_only_shifts(self, body: BodyModel, size: torch.Tensor) -> None:
        seen = upright(body, size)
        found = level_sequence(seen, floor_of(0, 0, 1.2))
        assert torch.equal(found.joints, seen.joints - torch.tensor([0, 1.2, 0], dtype=torch.float64))
        assert_close(found.angles, seen.angles, atol=1e-12, rtol=0)
        assert_close(found.pose[:, 3:], seen.pose[:, 3:], atol=1e-12, rtol=0)

    def test_whoever_touches_the_floor_bends_on(self, body: BodyModel, size: torch.Tensor) -> None:
        """Past 90 degrees the root's angles go on, and what lies between two frames is between them."""
        like = moving(body, size, 40)
        pose = torch.zeros_like(like.pose)
        pose[:, 2], pose[:, 4] = 3.0, torch.linspace(0.9, 2.2, 40)
        axes = axes_of(14, 0)
        seen = pose.clone()
        seen[:, :3], seen[:, 4] = pose[:, :3] @ torch.tensor(axes), pose[:, 4] + math.radians(14)
        tilted = of_pose(body, size, seen, like)
        found = level_sequence(tilted, floor_of(14, 0, 1.2))
        assert_close(found.pose[:, 4], pose[:, 4], atol=1e-9, rtol=0)
        finer = resample(found, 40.0, gap=0.1)
        assert_close(finer.pose[1::2, 4], (pose[1:, 4] + pose[:-1, 4]) / 2, atol=1e-9, rtol=0)
        assert_close(body(finer.pose, size).joints[::2], found.joints, atol=1e-9, rtol=0)

    def test_of_two_roots_of_one_turn_the_pose_s_own_is_kept(
        self, body: BodyModel, size: torch.Tensor
    ) -> None:
        """Whoever is turned and bent sideways, too: both triples of angles stand for the same body."""
        level = upright(body, size)
        level.pose[:, 4:6] = torch.tensor([1.0, 0.3])
        near, wanted = seen_by(14, 6, 1.2, body, size, level)
        yaw, pitch, roll = near.pose[:, 3:6].unbind(1)
        far = torch.cat(
            [near.pose[:, :3], torch.stack([yaw, -pitch, roll], 1) + torch.pi, near.pose[:, 6:]], 1
        )
        assert_close(body(far, size).joints, near.joints, atol=1e-9, rtol=0)
        for pose, beyond in ((near.pose, False), (far, True)):
            found = level_sequence(dataclasses.replace(near, pose=pose), floor_of(14, 6, 1.2)).pose
            assert ((found[:, 4] > torch.pi / 2) == beyond).all()
            assert_close(body(found, size).joints, wanted.joints, atol=1e-9, rtol=0)


class TestSequence:
    def test_frames_without_a_pose_have_none(self, body: BodyModel, size: torch.Tensor) -> None:
        motion = moving(body, size, gone=(3, 9))
        seen, wanted = seen_by(20, 10, 1.1, body, size, motion)
        assert seen.joints[3].isnan().all()
        copy = dataclasses.replace(
            seen, **{n: getattr(seen, n).clone() for n in ("joints", "angles", "pose")}
        )
        found = level_sequence(seen, floor_of(20, 10, 1.1))
        for name in ("joints", "angles", "pose"):
            rows = getattr(found, name).flatten(1).isnan()
            assert rows[[3, 9]].all()
            assert rows.any(1).sum() == 2
            assert_close(
                getattr(seen, name), getattr(copy, name), atol=0, rtol=0, equal_nan=True
            )  # untouched
        assert found.answered == wanted.answered == tuple(row not in (3, 9) for row in range(24))
        assert_close(found.joints, wanted.joints, atol=1e-9, rtol=0, equal_nan=True)

    def test_spreads_that_another_frame_has_not(self, body: BodyModel, size: torch.Tensor) -> None:
        covariance = torch.eye(24, dtype=torch.float64).expand(24, 24, 24)
        seen = dataclasses.replace(moving(body, size), pose_covariance=covariance)
        found = level_sequence(seen, floor_of(10, 0, 1))
        assert found.pose_covariance is None
        assert found.angle_sd[:, TRUNK].isnan().all()
        assert torch.equal(found.angle_sd[:, 3:], seen.angle_sd[:, 3:])
        assert (seen.angle_sd == 0.1).all()

    def test_single_precision(self, body: BodyModel, size: torch.Tensor) -> None:
        seen, wanted = seen_by(14, 5, 1.2, body, size, moving(body, size))
        floor = floor_of(14, 5, 1.2)
        names = ("joints", "angles", "angle_sd", "pose", "limb_angles", "point_to_model")
        few = dataclasses.replace(seen, **{name: getattr(seen, name).float() for name in names})
        found = level_sequence(few, Floor(floor.normal.float(), floor.height.float()))
        assert {getattr(found, name).dtype for name in names} == {torch.float32}
        assert_close(found.joints, wanted.joints.float(), atol=3e-6, rtol=0)
        same_angles(found.angles, wanted.angles.float(), 1e-5)
        exact = level_sequence(seen, Floor(floor.normal.float(), floor.height.float()))
        assert_close(
            torch.cdist(exact.joints, exact.joints), torch.cdist(seen.joints, seen.joints), atol=1e-12, rtol=0
        )

    def test_all_at_once_is_each_alone(
        self, body: BodyModel, size: torch.Tensor, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        seen, _ = seen_by(14, 5, 1.2, body, size, moving(body, size))
        floor = floor_of(14, 5, 1.2)
        whole = level_sequence(seen, floor)
        monkeypatch.setattr(module, "_CHUNK", 5)
        for other in (
            [level_sequence(seen, floor)],
            [level_sequence(seen[k : k + 1], floor) for k in range(24)],
        ):
            for name in ("joints", "angles", "pose"):
                assert_close(torch.cat([getattr(one, name) for one in other]), getattr(whole, name))

    def test_a_table_s_sequence_and_none(self, body: BodyModel, size: torch.Tensor) -> None:
        """poses.csv has no pose of the body; a recording without frames has nothing."""
        seen, wanted = seen_by(14, 5, 1.2, body, size, moving(body, size))
        found = level_sequence(dataclasses.replace(seen, pose=None), floor_of(14, 5, 1.2))
        assert found.pose is None
        assert_close(found.joints, wanted.joints, atol=1e-9, rtol=0)
        same_angles(found.angles, wanted.angles)
        assert len(level_sequence(seen[:0], floor_of(14, 5, 1.2))) == 0

    def test_bad_input(self, body: BodyModel, size: torch.Tensor) -> None:
        seen = moving(body, size)
        for down in ([0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [math.nan] * 3):
            with pytest.raises(ValueError, match=r"floor.normal must point up, .*; turn it round"):
                level_sequence(seen, Floor(torch.tensor(down), torch.tensor(1.0)))
        keep = [i for i, name in enumerate(seen.angle_names) if name != "trunk_rotation"]
        less = dataclasses.replace(
            seen,
            angle_names=tuple(seen.angle_names[i] for i in keep),
            angles=seen.angles[:, keep],
            angle_sd=seen.angle_sd[:, keep],
        )
        with pytest.raises(
            ValueError, match=r"angle_names must have the trunk's angles .* trunk_rotation is missing"
        ):
            level_sequence(less, floor_of(0, 0, 1))


def test_the_trunk_s_turn_and_its_angles_are_inverse():
    generator = torch.Generator().manual_seed(4)
    R = torch.from_numpy(Rotation.random(50, random_state=4).as_matrix())
    angles = trunk_angles(R)
    assert_close(trunk_turn(angles), R, atol=1e-12, rtol=0)
    flexion, bending, rotation = angles.T.numpy()
    other = Rotation.from_euler("YXZ", np.stack([rotation, flexion, -bending], 1)).as_matrix()
    assert_close(torch.from_numpy(other), R, atol=1e-12, rtol=0)
    assert tp.ANATOMICAL_NAMES[TRUNK] == TRUNK_NAMES
    some = (torch.rand(50, 3, generator=generator, dtype=torch.float64) - 0.5) * 3
    assert_close(trunk_angles(trunk_turn(some)), some, atol=1e-12, rtol=0)


class TestFiles:
    CAMERA = StereoCamera(160, 120, 150.0, 80.3, 59.6, None, 30.0)

    def drawn_floor(self, pitch: float, roll: float, height: float) -> Floor:
        """As it is found in the depth of a floor and a wall."""
        v, u = torch.meshgrid(torch.arange(120), torch.arange(160), indexing="ij")
        ray = self.CAMERA.back_project(torch.stack([u, v], -1).double(), torch.ones(120, 160).double())
        down = ray @ torch.tensor(axes_of(pitch, roll)[1])
        depth = torch.where(down > 0, height / down, torch.inf).clamp_max(5.0)
        floor = find_floor(depth, self.CAMERA)
        assert floor is not None
        return floor

    def test_feet_stand_on_the_floor(self, body: BodyModel, size: torch.Tensor, tmp_path: Path) -> None:
        """From the depth of a drawn scene to the files; the table stays in the camera's frame."""
        seen, wanted = seen_by(14, 5, 1.2, body, size, upright(body, size))
        config = ExportConfig(formats=tuple(ExportFormat), filter=FilterKind.rts)
        folders = {}
        for name, settings, floor in (
            ("level", config, self.drawn_floor(14, 5, 1.2)),
            ("none", config, None),
            ("off", dataclasses.replace(config, level=False), self.drawn_floor(14, 5, 1.2)),
        ):
            folders[name] = tmp_path / name
            folders[name].mkdir()
            export_motion(folders[name], "", seen, body, size, settings, floor)
        contents = {
            name: {path.suffix: path.read_bytes() for path in sorted(folder.iterdir())}
            for name, folder in folders.items()
        }
        assert contents["off"] == contents["none"]
        assert contents["level"][".csv"] == contents["none"][".csv"]
        for kind in config.formats:
            assert contents["level"][f".{kind.value}"] != contents["none"][f".{kind.value}"]

        trc = np.loadtxt(folders["level"] / "poses.trc", skiprows=6)[:, 2:].reshape(-1, 15, 3)
        assert np.abs(trc[:, -2:, 1].min(1) - 80).max() < 20  # mm
        assert np.abs(trc - 1000 * to_opensim(wanted.joints).numpy()).max() < 30
        names, *rows = (folders["level"] / "poses.mot").read_text().partition("endheader\n")[2].splitlines()
        column = dict(
            zip(names.split("\t"), np.array([r.split("\t") for r in rows], dtype=float).T, strict=True)
        )
        assert np.abs(column["pelvis_tilt"]).max() < 0.5
        assert np.abs(column["pelvis_list"]).max() < 0.5
        # The model's pelvis has its origin 7.8 cm over the hips.
        hips = -wanted.joints[:, 0, 1].numpy()
        np.testing.assert_allclose(column["pelvis_ty"], hips + 0.0785, atol=0.02)
        bvh = bvhio.readAsHierarchy(str(folders["level"] / "poses.bvh"))
        bvh.loadPose(10)
        ankles = [joint.PositionWorld.y for joint, _, _ in bvh.layout() if joint.Name.startswith("ankle")]
        assert min(ankles) == pytest.approx(8, abs=2)  # cm

    def test_the_setting(self) -> None:
        assert ExportConfig().level
        assert not load_config("infer", ["export.level=false"]).export.level


def test_what_the_summary_says_of_the_floor():
    assert _floor_entry(None) is None
    entry = _floor_entry(floor_of(14, 0, 1.2))
    assert entry == {
        "normal": pytest.approx([0, -math.cos(math.radians(14)), -math.sin(math.radians(14))]),
        "height_m": 1.2,
        "tilt_deg": pytest.approx(14),
    }
    rounded = Floor(torch.tensor([0.0, -1.0000001, 0.0]), torch.tensor(1.0))
    assert _floor_entry(rounded)["tilt_deg"] == 0
