"""The articulated body against pytorch-kinematics, matrix exponentials, autograd and its mirror image."""

import math
from dataclasses import fields
from pathlib import Path

import pytest
import scipy.linalg
import torch
import yaml
from torch import Tensor
from torch.testing import assert_close

from torchpose.body.model import BodyConfig, BodyModel, JointKind, PosedBody, ellipsoid_matrix, frame_along
from torchpose.body.skeleton import HUMAN
from torchpose.geometry import exp_rotation, hat

F64 = torch.float64
MIRROR = torch.tensor([-1.0, 1.0, 1.0], dtype=F64)
KINDS = (JointKind.swing, JointKind.revolute)


@pytest.fixture(scope="module")
def models() -> dict[JointKind, BodyModel]:
    """Both kinds with constants in double precision."""
    torch.set_default_dtype(F64)
    try:
        return {kind: BodyModel(BodyConfig(joint=kind)) for kind in KINDS}
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.fixture(params=KINDS, ids=lambda kind: kind.value)
def body(request: pytest.FixtureRequest, models: dict[JointKind, BodyModel]) -> BodyModel:
    return models[request.param]


@pytest.fixture
def swing(models: dict[JointKind, BodyModel]) -> BodyModel:
    return models[JointKind.swing]


@pytest.fixture
def revolute(models: dict[JointKind, BodyModel]) -> BodyModel:
    return models[JointKind.revolute]


def random_pose(body: BodyModel, batch: int) -> Tensor:
    """Anywhere within half a turn of everything: more than a person can do."""
    return torch.randn(batch, body.num_parameters, dtype=F64)


def random_size(body: BodyModel, batch: int) -> Tensor:
    return 0.8 + 0.4 * torch.rand(batch, len(body.size_names), dtype=F64)


def tensors(posed: PosedBody) -> dict[str, Tensor]:
    return {field.name: getattr(posed, field.name) for field in fields(posed)}


def on_surface(posed: PosedBody, num: int) -> tuple[Tensor, Tensor]:
    """Random points of every ellipsoid: in its frame and in the camera's."""
    ball = torch.nn.functional.normalize(torch.randn(1, posed.radii.shape[1], num, 3, dtype=F64), dim=-1)
    local = ball * posed.radii[:, :, None]
    return local, local @ posed.frames.mT + posed.centers[:, :, None]


class TestForward:
    def test_revolute_equals_pytorch_kinematics(self, revolute: BodyModel) -> None:
        """All ten bodies. The library is asked link by link; it knows nothing of our tables."""
        # Made in single precision, as the chain is, whose constants are then rounded alike.
        single = BodyModel(BodyConfig(joint=JointKind.revolute)).double()
        pose = random_pose(single, 20)
        posed = single(pose)
        chain = single.skeleton.chain().to(dtype=F64)
        transforms = chain.forward_kinematics(pose)
        for i, name in enumerate(single.body_names):
            matrix = transforms[name].get_matrix()
            assert_close(posed.rotations[:, i], matrix[:, :3, :3], atol=1e-10, rtol=0)
            assert_close(posed.origins[:, i], matrix[:, :3, 3], atol=1e-10, rtol=0)
        # And constants in double precision are the same up to single precision's rounding.
        assert_close(revolute(pose).origins, posed.origins, atol=1e-6, rtol=0)

    def test_swing_equals_matrix_exponentials_by_hand(self, swing: BodyModel) -> None:
        """Torso, left upper arm, left forearm: each turn as expm of a skew matrix, from the file's numbers."""
        pose = random_pose(swing, 1)
        posed = swing(pose)
        p = dict(zip(swing.parameter_names, pose[0].tolist(), strict=True))

        def turn(vector: Tensor) -> Tensor:
            return torch.from_numpy(scipy.linalg.expm(hat(vector).numpy()))

        x, y, z = torch.eye(3, dtype=F64)
        R = turn(y * p["torso_yaw"]) @ turn(x * p["torso_pitch"]) @ turn(z * p["torso_roll"])
        t = torch.tensor([p["torso_x"], p["torso_y"], p["torso_z"]], dtype=F64)
        assert_close(posed.rotations[0, 0], R, atol=1e-12, rtol=0)
        assert_close(posed.origins[0, 0], t, atol=1e-12, rtol=0)
        for name in ("upper_arm_left", "forearm_left"):
            part = next(b for b in swing.skeleton.bodies if b.name == name)
            one, two, center, limb = (
                torch.tensor(v, dtype=F64) for v in (*part.swing.axes, part.swing.center, part.limb)
            )
            t = t + R @ torch.tensor(part.origin.default(), dtype=F64)
            swung = turn(one * p[f"{name}_1"] + two * p[f"{name}_2"])
            # At zero the limb lies along the centre, brought there by the smallest turn.
            axis = torch.linalg.cross(limb, center)
            angle = math.atan2(axis.norm().item(), (limb @ center).item())
            R = R @ swung @ turn(torch.nn.functional.normalize(axis, dim=0) * angle)
            i = swing.body_names.index(name)
            assert_close(posed.rotations[0, i], R, atol=1e-12, rtol=0)
            assert_close(posed.origins[0, i], t, atol=1e-12, rtol=0)

    def test_upright_person_faces_the_camera(self, revolute: BodyModel) -> None:
        """All revolutes at zero: arms hang, left is +x, up is -y, the toes point to the camera."""
        pose = torch.zeros(1, 24, dtype=F64)
        pose[0, 2] = 3
        posed = revolute(pose)
        joint = dict(zip(revolute.joint_names, posed.joints[0], strict=True))
        above = ["ankle_left", "knee_left", "hip_left", "wrist_left", "elbow_left", "shoulder_left", "head"]
        height = [-joint[name][1].item() for name in above]
        assert height[:3] == sorted(height[:3])
        assert height[3:] == sorted(height[3:])
        assert joint["shoulder_left"][0] > 0 > joint["shoulder_right"][0]
        assert_close(joint["pelvis"], pose[0, :3])
        foot = posed.centers[0, revolute.segment_names.index("foot_left")]
        assert foot[2] < joint["ankle_left"][2] < 3.05
        # From the crown to the soles it is as tall as the file says, within the hair and the shoes.
        R, reach = posed.frames[0], posed.radii[0]
        extent = ((R[:, 1] * reach) ** 2).sum(-1).sqrt()  # half height of each ellipsoid
        tall = (posed.centers[0, :, 1] + extent).max() - (posed.centers[0, :, 1] - extent).min()
        assert tall.item() == pytest.approx(revolute.height, abs=0.1)

    def test_names_are_the_contracts(self, body: BodyModel) -> None:
        sides = ("left", "right")
        limbs = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        assert body.joint_names == ("pelvis", "neck", "head", *(f"{j}_{s}" for j in limbs for s in sides))
        assert (body.num_parameters, body.num_parts) == (24, 14)
        assert body.parameter_names[:6] == tuple(
            f"torso_{name}" for name in ("x", "y", "z", "yaw", "pitch", "roll")
        )

    def test_joints_are_the_ends_of_limbs(self, body: BodyModel) -> None:
        """A joint is where its body hangs: its distance to the parent's joint does not depend on the pose."""
        posed = body(random_pose(body, 5))
        joint = dict(zip(body.joint_names, posed.joints.unbind(1), strict=True))
        for name, at in (
            ("shoulder", "upper_arm"),
            ("elbow", "forearm"),
            ("hip", "thigh"),
            ("knee", "shank"),
        ):
            for side in ("left", "right"):
                origin = posed.origins[:, body.body_names.index(f"{at}_{side}")]
                assert_close(joint[f"{name}_{side}"], origin, atol=1e-12, rtol=0)
        assert_close(joint["neck"], posed.origins[:, 1], atol=1e-12, rtol=0)
        for one, other in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle")):
            length = (joint[f"{one}_left"] - joint[f"{other}_left"]).norm(dim=-1)
            assert_close(length, length[:1].expand(5), atol=1e-12, rtol=0)
            assert 0.2 < length[0] < 0.5

    def test_frames_are_rotations_with_the_long_axis_last(self, body: BodyModel) -> None:
        posed = body(random_pose(body, 3))
        eye = torch.eye(3, dtype=F64)
        assert_close(posed.frames @ posed.frames.mT, eye.expand(3, 14, 3, 3), atol=1e-12, rtol=0)
        assert_close(torch.linalg.det(posed.frames), torch.ones(3, 14, dtype=F64), atol=1e-12, rtol=0)
        axes = torch.tensor([segment.axis for segment in body.skeleton.segments], dtype=F64)
        expected = (posed.rotations[:, list(body.segment_bodies)] @ axes[:, :, None])[..., 0]
        assert_close(posed.frames[..., 2], expected, atol=1e-12, rtol=0)
        assert (posed.radii[..., :2] <= posed.radii[..., 2:]).all()

    def test_batch_equals_one_by_one(self, body: BodyModel) -> None:
        pose, size = random_pose(body, 4), random_size(body, 4)
        together = tensors(body(pose, size))
        for row in range(4):
            alone = tensors(body(pose[row : row + 1], size[row : row + 1]))
            for name, value in alone.items():
                assert_close(together[name][row : row + 1], value, atol=1e-14, rtol=0, msg=name)

    def test_one_size_serves_a_batch(self, body: BodyModel) -> None:
        pose, size = random_pose(body, 3), random_size(body, 1)
        one, many = tensors(body(pose, size)), tensors(body(pose, size.expand(3, -1)))
        for name in one:
            assert torch.equal(one[name], many[name]), name
        default = tensors(body(pose))
        for name, value in tensors(body(pose, body.default_size(3))).items():
            assert_close(default[name], value, atol=1e-15, rtol=0)

    @pytest.mark.parametrize("dtype", [torch.float32, F64])
    def test_to_dtype(self, dtype: torch.dtype) -> None:
        model = BodyModel().to(dtype)
        posed = model(torch.zeros(2, 24, dtype=dtype))
        assert {value.dtype for value in tensors(posed).values()} == {dtype}
        assert model.rest.dtype == dtype
        assert model.moves.dtype == torch.bool
        assert not list(model.parameters())
        assert not model.state_dict()  # everything is in the body file


class TestSizes:
    def test_geometry_is_linear_in_the_sizes(self, body: BodyModel) -> None:
        pose, one, other = random_pose(body, 3), random_size(body, 3), random_size(body, 3)
        pose[:, :3] = 0  # the root's place is no size
        for name in ("origins", "centers", "joints", "radii"):
            summed = getattr(body(pose, 2 * one + 0.5 * other), name)
            parts = 2 * getattr(body(pose, one), name) + 0.5 * getattr(body(pose, other), name)
            assert_close(summed, parts, atol=1e-13, rtol=0)

    def test_a_size_scales_its_own_part_alone(self, body: BodyModel) -> None:
        pose = random_pose(body, 1)
        size = body.default_size(1)
        size[:, body.size_names.index("forearm")] = 1.5
        plain, longer = body(pose), body(pose, size)
        arm = body.joint_names.index("elbow_left"), body.joint_names.index("wrist_left")
        length = [(p.joints[:, arm[0]] - p.joints[:, arm[1]]).norm().item() for p in (plain, longer)]
        assert length[1] == pytest.approx(1.5 * length[0])
        still = [i for i, name in enumerate(body.joint_names) if "wrist" not in name]
        assert_close(plain.joints[:, still], longer.joints[:, still])

    def test_size_of_height(self, body: BodyModel) -> None:
        size = body.size_of_height(body.height * 0.9)
        assert_close(size, torch.full((1, len(body.size_names)), 0.9, dtype=F64))


class TestMoves:
    def test_equals_a_brute_force_perturbation(self, body: BodyModel) -> None:
        pose = random_pose(body, 1)
        nudged = pose + 0.3 * torch.eye(24, dtype=F64)
        before, after = body(pose), body(nudged)
        moved = (after.rotations - before.rotations).abs().flatten(2).amax(2) > 1e-9
        moved |= (after.origins - before.origins).abs().amax(2) > 1e-9
        assert torch.equal(moved.mT, body.moves)
        parts = (after.centers - before.centers).norm(dim=2) > 1e-9
        assert torch.equal(parts.mT, body.part_moves)


class TestJacobian:
    def test_equals_autograd_and_finite_differences(self, body: BodyModel) -> None:
        pose, size = random_pose(body, 2), random_size(body, 2)
        posed = body(pose, size)
        local, points = on_surface(posed, 3)
        local = local.expand(2, -1, -1, -1)

        def placed(x: Tensor) -> Tensor:
            at = body(x, size)
            return local @ at.frames.mT + at.centers[:, :, None]

        points = placed(pose)
        J = body.jacobian(posed, points)
        assert J.shape == (2, 14, 3, 3, 24)
        autograd = torch.stack(
            [torch.func.jvp(placed, (pose,), (e.expand(2, -1),))[1] for e in torch.eye(24, dtype=F64)], -1
        )
        assert_close(J, autograd, atol=1e-12, rtol=0)
        h = 1e-6
        for k in range(24):
            step = h * torch.eye(24, dtype=F64)[k]
            slope = (placed(pose + step) - placed(pose - step)) / (2 * h)
            assert_close(J[..., k], slope, atol=1e-8, rtol=0)

    def test_at_the_straight_body(self, body: BodyModel) -> None:
        """Zero is where a swing's axes come from a series."""
        pose = torch.zeros(1, 24, dtype=F64)
        posed = body(pose)
        points = posed.centers[:, :, None] + 0.1
        local = (points - posed.centers[:, :, None]) @ posed.frames

        def placed(x: Tensor) -> Tensor:
            at = body(x)
            return local @ at.frames.mT + at.centers[:, :, None]

        autograd = torch.func.jacrev(placed)(pose)[..., 0, :]
        assert_close(body.jacobian(posed, points), autograd, atol=1e-12, rtol=0)

    @pytest.mark.parametrize("start", ["zero", "random"])
    def test_gradients_in_pose_and_size(self, body: BodyModel, start: str) -> None:
        pose = random_pose(body, 1) if start == "random" else torch.zeros(1, 24, dtype=F64)

        def summary(x: Tensor, size: Tensor) -> Tensor:
            posed = body(x, size)
            return torch.cat([posed.centers.flatten(), posed.frames[0, ::5].flatten(), posed.radii.flatten()])

        inputs = (pose.requires_grad_(), random_size(body, 1).requires_grad_())
        assert torch.autograd.gradcheck(summary, inputs, fast_mode=True)


class TestPoseFromDirections:
    def test_swing_reaches_any_direction(self, swing: BodyModel) -> None:
        wanted = torch.nn.functional.normalize(torch.randn(100, 9, 3, dtype=F64), dim=-1)
        translation, angles = torch.randn(2, 100, 3, dtype=F64)
        pose = swing.pose_from_directions(translation, angles, wanted)
        assert_close(pose[:, :6], torch.cat([translation, angles], 1), atol=0, rtol=0)
        assert_close(swing.limb_directions(swing(pose)), wanted, atol=1e-12, rtol=0)

    def test_both_kinds_reach_what_revolutes_reach(self, body: BodyModel, revolute: BodyModel) -> None:
        limits = [limit[6:].expand(100, -1) for limit in (revolute.low, revolute.high)]
        joints = limits[0] + torch.rand(100, 18, dtype=F64) * (limits[1] - limits[0])
        pose = torch.cat([torch.randn(100, 6, dtype=F64), joints], 1)
        wanted = revolute.limb_directions(revolute(pose))
        found = body.pose_from_directions(pose[:, :3], pose[:, 3:6], wanted)
        # A limb that goes on straight within 1.4 mrad is taken for straight.
        assert_close(body.limb_directions(body(found)), wanted, atol=2e-3, rtol=0)

    def test_revolute_stays_within_its_limits_where_it_can(self, revolute: BodyModel) -> None:
        low, high = revolute.low[6:], revolute.high[6:]
        joints = low + torch.rand(100, 18, dtype=F64) * (high - low)
        pose = torch.cat([torch.zeros(100, 6, dtype=F64), joints], 1)
        directions = revolute.limb_directions(revolute(pose))
        # Of a joint's two solutions one is within. A child hangs from the parent as it was turned, so only the
        # limbs on the torso must be the ones that were drawn.
        found = revolute.pose_from_directions(pose[:, :3], pose[:, 3:6], directions)[:, 6:]
        first = [2 * i + k for i, parent in enumerate(revolute.parents) if parent == 0 for k in (0, 1)]
        inside = (found >= low - 1e-9) & (found <= high + 1e-9)
        assert inside[:, first].all()

    def test_nearest_where_a_revolute_does_not_reach(self, revolute: BodyModel) -> None:
        """No neighbouring pose beats it. (On the torso: a parent's change moves a child's target.)"""
        wanted = torch.nn.functional.normalize(torch.randn(50, 9, 3, dtype=F64), dim=-1)
        zero = torch.zeros(50, 3, dtype=F64)
        pose = revolute.pose_from_directions(zero, zero, wanted)
        reached = (revolute.limb_directions(revolute(pose)) * wanted).sum(-1)
        for k in range(18):
            if revolute.parents[k // 2] != 0:
                continue
            for step in (-1e-3, 1e-3):
                nudged = pose.clone()
                nudged[:, 6 + k] += step
                there = (revolute.limb_directions(revolute(nudged)) * wanted).sum(-1)[:, k // 2]
                assert (there <= reached[:, k // 2] + 1e-12).all()

    def test_named_directions(self, body: BodyModel) -> None:
        """Hanging is +y, forward is -z, to the subject's left is +x; the head points up."""
        forward, left, down, up = ((0, 0, -1), (1, 0, 0), (0, 1, 0), (0, -1, 0))
        wanted = torch.tensor([[up, forward, forward, left, down, down, down, down, down]], dtype=F64)
        zero = torch.zeros(1, 3, dtype=F64)
        # The right arm goes to the left, across the body, and hangs from the elbow: all within reach.
        posed = body(body.pose_from_directions(zero, zero, wanted))
        joint = dict(zip(body.joint_names, posed.joints[0], strict=True))
        ahead = joint["wrist_left"] - joint["shoulder_left"]
        assert_close(ahead / ahead.norm(), wanted[0, 1], atol=1e-10, rtol=0)
        if body.config.joint is JointKind.swing:
            across = joint["elbow_right"] - joint["shoulder_right"]
            assert_close(across / across.norm(), wanted[0, 3], atol=1e-10, rtol=0)
        hanging = joint["ankle_left"] - joint["hip_left"]
        assert_close(hanging[0], torch.tensor(0.0, dtype=F64), atol=1e-10, rtol=0)
        assert hanging[1] > 0.7

    def test_rest_pose_is_the_files(self, body: BodyModel) -> None:
        pose = torch.cat([torch.zeros(6, dtype=F64), body.rest])[None]
        directions = body.limb_directions(body(pose))[0]
        rotations = body(pose).rotations[0]
        for i, part in enumerate(body.skeleton.bodies):
            wanted = rotations[part.parent] @ torch.tensor(
                part.rest, dtype=F64
            )  # stated in the parent's frame
            assert_close(directions[i], wanted, atol=1e-6, rtol=0)


class TestMirror:
    def test_mirrored_pose_is_the_mirrored_body(self, body: BodyModel) -> None:
        pose, size = random_pose(body, 5), random_size(body, 1)

        def other(names: tuple[str, ...]) -> list[int]:
            swap = {"left": "right", "right": "left"}
            return [names.index("_".join(swap.get(word, word) for word in name.split("_"))) for name in names]

        mirrored = pose[:, other(body.parameter_names)]
        for name in ("torso_x", "torso_yaw", "torso_roll", "head_2"):
            mirrored[:, body.parameter_names.index(name)] *= -1
        one, two = body(pose, size), body(mirrored, size)
        assert_close(two.joints, one.joints[:, other(body.joint_names)] * MIRROR, atol=1e-12, rtol=0)
        assert_close(two.centers, one.centers[:, other(body.segment_names)] * MIRROR, atol=1e-12, rtol=0)
        long = one.frames[:, other(body.segment_names), :, 2] * MIRROR
        assert_close(two.frames[..., 2], long, atol=1e-12, rtol=0)
        flipped = MIRROR[:, None] * one.rotations[:, other(body.body_names)] * MIRROR
        assert_close(two.rotations, flipped, atol=1e-12, rtol=0)


class TestFrameAlong:
    def test_columns(self) -> None:
        axis = torch.nn.functional.normalize(torch.randn(50, 3, dtype=F64), dim=-1)
        frame = frame_along(axis)
        assert_close(frame @ frame.mT, torch.eye(3, dtype=F64).expand(50, 3, 3), atol=1e-12, rtol=0)
        assert_close(torch.linalg.det(frame), torch.ones(50, dtype=F64), atol=1e-12, rtol=0)
        assert torch.equal(frame[..., 2], axis)
        # The first lies in the plane of the axis and x (of y, where the axis is nearly x), on its side.
        reference = torch.where(
            axis[:, :1].abs() > 0.9, torch.eye(3, dtype=F64)[1], torch.eye(3, dtype=F64)[0]
        )
        assert_close((frame[..., 1] * reference).sum(-1), torch.zeros(50, dtype=F64), atol=1e-12, rtol=0)
        assert ((frame[..., 0] * reference).sum(-1) > 0).all()

    def test_of_a_trunk_and_a_foot(self) -> None:
        """Up: width, then depth. To the front: width, then height."""
        x, y, z = torch.eye(3, dtype=F64)
        assert_close(frame_along(-y), torch.stack([x, z, -y], -1))
        assert_close(frame_along(-z), torch.stack([x, -y, -z], -1))
        assert_close(frame_along(x), torch.stack([y, z, x], -1))


class TestEllipsoidMatrix:
    def test_is_two_on_the_surface(self, body: BodyModel) -> None:
        posed = body(random_pose(body, 3), random_size(body, 3))
        local, _ = on_surface(posed, 20)
        A = ellipsoid_matrix(posed)
        for scale, value in (
            (1.0, 2.0),
            (0.0, 1.0),
            (3.0, 10.0),
        ):  # q = scale^2 - 1, so X^T A X = scale^2 + 1
            points = scale * local @ posed.frames.mT + posed.centers[:, :, None]
            X = torch.cat([points, torch.ones_like(points[..., :1])], -1)
            form = (X @ A * X).sum(-1)
            assert_close(form, torch.full_like(form, value), atol=1e-9, rtol=0)
        assert_close(A, A.mT, atol=1e-9, rtol=0)


class TestTwoRadii:
    def test_stand_along_the_first_axes_and_mirror(self, tmp_path: Path) -> None:
        """A flat hand on both sides, of a slanted arm: the mirrored body is the same set of points."""
        data = yaml.safe_load(HUMAN.read_text())
        data["segments"]["hand"] |= {"radius": {"forearm_girth": [0.05, 0.02]}, "axis": [-0.4, 1, 0.3]}
        file = tmp_path / "flat.yaml"
        file.write_text(yaml.safe_dump(data, sort_keys=False))
        body = BodyModel(BodyConfig(str(file))).double()
        posed = body(torch.zeros(1, 24, dtype=F64), 1.25 * body.default_size(1))
        left, right = (body.segment_names.index(f"hand_{side}") for side in ("left", "right"))
        expected = 1.25 * torch.tensor(
            [0.05, 0.02, data["segments"]["hand"]["half_length"]["forearm"]], dtype=F64
        )
        assert_close(posed.radii[0, left], expected, atol=1e-8, rtol=0)
        assert torch.equal(posed.radii[0, left], posed.radii[0, right])
        mirror = torch.diag(torch.tensor([-1.0, 1, 1, 1], dtype=F64))
        A = ellipsoid_matrix(posed)[0]
        # Constants are rounded to single precision.
        assert_close(mirror @ A[left] @ mirror, A[right], atol=1e-4, rtol=1e-6)
        assert (posed.frames[0, left, 0, 0]).item() > 0.5

    def test_a_long_axis_stays_the_longest(self) -> None:
        body = BodyModel().double()
        size = body.default_size(1)
        size[:, body.num_lengths :] = 9.0
        radii = body(torch.zeros(1, 24, dtype=F64), size).radii
        assert torch.equal(radii[..., 2], radii.amax(-1))
        assert (radii[..., 2] == radii[..., :2].amax(-1)).any()


class TestOwnBodyFile:
    def test_a_longer_arm(self, tmp_path: Path, swing: BodyModel) -> None:
        data = yaml.safe_load(HUMAN.read_text())
        for number in range(3):
            data["bodies"]["forearm"]["origin"]["upper_arm"][number] *= 2
        file = tmp_path / "long.yaml"
        file.write_text(yaml.safe_dump(data, sort_keys=False))
        longer = BodyModel(BodyConfig(path=str(file))).double()
        pose = random_pose(swing, 1)

        def arm(body: BodyModel) -> float:
            joints = body(pose).joints[0]
            shoulder, elbow = (body.joint_names.index(f"{name}_left") for name in ("shoulder", "elbow"))
            return (joints[shoulder] - joints[elbow]).norm().item()

        assert arm(longer) == pytest.approx(2 * arm(swing), rel=1e-6)

    def test_a_missing_file_is_told(self) -> None:
        with pytest.raises(ValueError, match=r"the body file must exist, got .*nobody\.yaml"):
            BodyModel(BodyConfig(path="nobody.yaml"))


class TestPrecision:
    def test_double_precision_constants(self, swing: BodyModel) -> None:
        """Rotations that are only rounded to single precision would not be rotations in double."""
        eye = torch.eye(3, dtype=F64)
        assert_close(swing.align @ swing.align.mT, eye.expand(9, 3, 3), atol=1e-14, rtol=0)
        zero = torch.zeros(1, 3, dtype=F64)
        assert_close(exp_rotation(zero)[0], eye)
