"""Angles of poses made by hand, in degrees as a person would read them off, and their spread by sampling."""

import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchpose.body.angle import ANATOMICAL_NAMES, LIMB_ANGLE_NAMES, anatomical_angles, angle_sd, limb_angles
from torchpose.body.model import BodyConfig, BodyModel, JointKind
from torchpose.geometry import exp_rotation

F64 = torch.float64
UP, DOWN = (0.0, -1.0, 0.0), (0.0, 1.0, 0.0)
FORWARD, BACKWARD = (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)
LEFT, RIGHT = (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)
SIDES = ("left", "right")
MIRROR = torch.tensor([-1.0, 1.0, 1.0], dtype=F64)

Direction = tuple[float, float, float]


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return in_double(JointKind.swing)


def in_double(kind: JointKind) -> BodyModel:
    """With constants in double precision."""
    torch.set_default_dtype(F64)
    try:
        return BodyModel(BodyConfig(joint=kind))
    finally:
        torch.set_default_dtype(torch.float32)


def slanted(one: Direction, other: Direction, degrees: float) -> Direction:
    """From one direction by so many degrees towards another, at a right angle to it."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    x, y, z = (cos * a + sin * b for a, b in zip(one, other, strict=True))
    return x, y, z


def pose(body: BodyModel, root: dict[str, float] | None = None, **limbs: Direction) -> Tensor:
    """An upright person with hanging arms who faces the camera from 3 m, but for the root's angles (degrees) and the
    limbs that are given (directions in the torso's frame)."""
    upright = {name: UP if name == "head" else DOWN for name in body.body_names[1:]} | limbs
    directions = torch.tensor([[upright[name] for name in body.body_names[1:]]], dtype=F64)
    angles = [[math.radians((root or {}).get(name, 0.0)) for name in ("yaw", "pitch", "roll")]]
    place = torch.tensor([[0.0, 0.0, 3.0]], dtype=F64)
    return body.pose_from_directions(place, torch.tensor(angles, dtype=F64), directions)


def read(body: BodyModel, of: Tensor) -> dict[str, float]:
    """The anatomical angles by name, degrees."""
    angles = anatomical_angles(body, body(of))
    assert angles.shape == (1, 21)
    return dict(zip(ANATOMICAL_NAMES, angles[0].rad2deg().tolist(), strict=True))


# What a person would say of the pose: {root angles}, {limbs}, {angles that are not 0}.
Case = tuple[dict[str, float], dict[str, Direction], dict[str, float]]
POSES: dict[str, Case] = {
    "upright": ({}, {}, {}),
    "bows": ({"pitch": 30}, {}, {"trunk_flexion": 30}),
    "leans back": ({"pitch": -20}, {}, {"trunk_flexion": -20}),
    "bends to the left": ({"roll": 25}, {}, {"trunk_lateral_bending": -25}),
    "turns to the right": ({"yaw": 40}, {}, {"trunk_rotation": 40}),
    "turns and bows": ({"yaw": -70, "pitch": 35}, {}, {"trunk_rotation": -70, "trunk_flexion": 35}),
    "nods": ({}, {"head": slanted(UP, FORWARD, 20)}, {"neck_flexion": 20}),
    "looks up": ({}, {"head": slanted(UP, BACKWARD, 20)}, {"neck_flexion": -20}),
    "head to the right shoulder": ({}, {"head": slanted(UP, RIGHT, 30)}, {"neck_lateral_bending": 30}),
    "straight right arm backward": (
        {},
        {"upper_arm_right": slanted(DOWN, BACKWARD, 30), "forearm_right": slanted(DOWN, BACKWARD, 30)},
        {"shoulder_flexion_right": -30},
    ),
    "right arm to the side": (
        {},
        {"upper_arm_right": slanted(DOWN, RIGHT, 60), "forearm_right": slanted(DOWN, RIGHT, 60)},
        {"shoulder_abduction_right": 60},
    ),
    "left arm across the body": (
        {},
        {"upper_arm_left": slanted(DOWN, RIGHT, 20), "forearm_left": slanted(DOWN, RIGHT, 20)},
        {"shoulder_abduction_left": -20},
    ),
    "left elbow bent forward": (
        {},
        {"forearm_left": slanted(DOWN, FORWARD, 100)},
        {"elbow_flexion_left": 100},
    ),
    "left hand on the belly": (
        {},
        {"forearm_left": RIGHT},
        {"elbow_flexion_left": 90, "shoulder_rotation_left": 90},
    ),
    "right hand outward": (
        {},
        {"forearm_right": slanted(FORWARD, RIGHT, 50)},
        {"elbow_flexion_right": 90, "shoulder_rotation_right": -50},
    ),
    "left thigh lifted, shank hanging": (
        {},
        {"thigh_left": FORWARD, "shank_left": DOWN},
        {"hip_flexion_left": 90, "knee_flexion_left": 90},
    ),
    "right heel lifted behind": (
        {},
        {"shank_right": slanted(DOWN, BACKWARD, 70)},
        {"knee_flexion_right": 70},
    ),
    "right leg spread": (
        {},
        {"thigh_right": slanted(DOWN, RIGHT, 35), "shank_right": slanted(DOWN, RIGHT, 35)},
        {"hip_abduction_right": 35},
    ),
    "right foot outward behind": (
        {},
        {"shank_right": slanted(BACKWARD, RIGHT, 30)},
        {"knee_flexion_right": 90, "hip_rotation_right": 30},
    ),
    "legs crossed, sitting": (
        {},
        {"thigh_left": FORWARD, "shank_left": slanted(DOWN, RIGHT, 40)},
        {"hip_flexion_left": 90, "knee_flexion_left": 90, "hip_rotation_left": -40},
    ),
    "left arm up, elbow bent back over the head": (
        {},
        {"upper_arm_left": UP, "forearm_left": BACKWARD},
        {"shoulder_flexion_left": 180, "elbow_flexion_left": 90},
    ),
    "left arm to the side, hand forward": (
        {},
        {"upper_arm_left": slanted(DOWN, LEFT, 80), "forearm_left": FORWARD},
        {"shoulder_abduction_left": 80, "elbow_flexion_left": 90},
    ),
}


class TestAnatomicalAngles:
    def test_names(self) -> None:
        assert len(set(ANATOMICAL_NAMES)) == len(ANATOMICAL_NAMES) == 21
        for name in ("shoulder", "hip"):
            for motion in ("flexion", "abduction", "rotation"):
                assert {f"{name}_{motion}_{side}" for side in SIDES} <= set(ANATOMICAL_NAMES)

    @pytest.mark.parametrize("name", POSES)
    def test_poses_by_hand(self, body: BodyModel, name: str) -> None:
        root, limbs, expected = POSES[name]
        angles = read(body, pose(body, root, **limbs))
        bent = {f"shoulder_rotation_{s}": f"elbow_flexion_{s}" for s in SIDES}
        bent |= {f"hip_rotation_{s}": f"knee_flexion_{s}" for s in SIDES}
        for motion, degrees in angles.items():
            if motion in bent and bent[motion] not in expected:
                continue  # a straight elbow or knee leaves the rotation above it undefined
            turn = (degrees - expected.get(motion, 0) + 180) % 360 - 180  # 180 is -180
            assert turn == pytest.approx(0, abs=1e-4), motion

    @pytest.mark.parametrize(
        ("flexion", "abduction", "rotation"), [(50, 30, 20), (-30, 60, -40), (120, 10, 70)]
    )
    @pytest.mark.parametrize("bend", [15, 90, 140])
    def test_a_ball_joint_is_three_turns_in_a_row(
        self, body: BodyModel, flexion: float, abduction: float, rotation: float, bend: float
    ) -> None:
        """The limbs are turned by matrices: flexion about the left-right axis, abduction about the front-back axis that
        it has turned, rotation about the limb, then the hinge below."""
        x, y, z = torch.eye(3, dtype=F64)

        def turn(axis: Tensor, degrees: float) -> Tensor:
            return exp_rotation(axis * math.radians(degrees))

        # The left side. Forward lifts (0, 1, 0) to -z: against the right hand about x; outward is to +x: about -z;
        # inward turns what points forward (-z) to the right (-x): about y.
        R = turn(-x, flexion) @ turn(-z, abduction) @ turn(y, rotation)
        upper, elbow, knee = R @ y, R @ turn(-x, bend) @ y, R @ turn(x, bend) @ y
        limbs = {
            "upper_arm_left": upper,
            "forearm_left": elbow,
            "thigh_left": upper,
            "shank_left": knee,
        }
        limbs |= {
            name.replace("left", "right"): direction * MIRROR for name, direction in list(limbs.items())
        }
        angles = read(body, pose(body, None, **{k: tuple(v.tolist()) for k, v in limbs.items()}))
        for side in SIDES:
            for joint, below in (("shoulder", "elbow"), ("hip", "knee")):
                found = [angles[f"{joint}_{m}_{side}"] for m in ("flexion", "abduction", "rotation")]
                assert found == pytest.approx([flexion, abduction, rotation], abs=1e-4)
                assert angles[f"{below}_flexion_{side}"] == pytest.approx(bend, abs=1e-4)

    def test_straight_out_to_the_side_is_exact(self, body: BodyModel) -> None:
        """The pole of the hinge pair: flexion is undefined there, abduction is not."""
        out = {"upper_arm_left": LEFT, "forearm_left": LEFT, "upper_arm_right": RIGHT, "forearm_right": RIGHT}
        angles = read(body, pose(body, None, **out))
        for side in SIDES:
            assert angles[f"shoulder_abduction_{side}"] == pytest.approx(90, abs=1e-5)

    def test_mirror_swaps_the_columns(self, body: BodyModel) -> None:
        of = torch.randn(6, 24, dtype=F64) * 0.7

        def other(names: tuple[str, ...]) -> list[int]:
            swap = {"left": "right", "right": "left"}
            return [names.index("_".join(swap.get(word, word) for word in name.split("_"))) for name in names]

        mirrored = of[:, other(body.parameter_names)]
        for name in ("torso_x", "torso_yaw", "torso_roll", "head_2"):
            mirrored[:, body.parameter_names.index(name)] *= -1
        expected = anatomical_angles(body, body(of))[:, other(ANATOMICAL_NAMES)]
        for name in ("trunk_lateral_bending", "trunk_rotation", "neck_lateral_bending"):
            expected[:, ANATOMICAL_NAMES.index(name)] *= -1
        assert_close(anatomical_angles(body, body(mirrored)), expected, atol=1e-10, rtol=0)
        limb = limb_angles(body(of).joints)[:, other(LIMB_ANGLE_NAMES)]
        assert_close(limb_angles(body(mirrored).joints), limb, atol=1e-10, rtol=0)

    def test_neither_place_nor_sizes_nor_parameters_matter(self, body: BodyModel) -> None:
        """The same directions in revolute parameters are the same angles."""
        revolute = in_double(JointKind.revolute)
        low, high = revolute.low[6:], revolute.high[6:]
        joints = low + torch.rand(20, 18, dtype=F64) * (high - low)
        of = torch.cat([torch.randn(20, 6, dtype=F64), joints], 1)
        directions = revolute.limb_directions(revolute(of))
        swing = body.pose_from_directions(of[:, :3] + 5, of[:, 3:6], directions)
        size = body.default_size(20) * (0.7 + 0.6 * torch.rand(20, len(body.size_names), dtype=F64))
        found = anatomical_angles(body, body(swing, size))
        assert_close(found, anatomical_angles(revolute, revolute(of)), atol=1e-8, rtol=0)

    def test_batch_equals_one_by_one(self, body: BodyModel) -> None:
        of = torch.randn(5, 24, dtype=F64)
        alone = torch.cat([anatomical_angles(body, body(row[None])) for row in of])
        assert_close(anatomical_angles(body, body(of)), alone, atol=1e-13, rtol=0)

    def test_gradient(self, body: BodyModel) -> None:
        of = (0.5 * torch.randn(1, 24, dtype=F64)).requires_grad_()
        assert torch.autograd.gradcheck(lambda x: anatomical_angles(body, body(x)), of, fast_mode=True)

    @pytest.mark.parametrize("name", ["upright", "left arm up, elbow bent back over the head"])
    def test_gradient_of_limb_angles_is_finite_at_aligned_limbs(self, body: BodyModel, name: str) -> None:
        root, limbs, _ = POSES[name]
        of = pose(body, root, **limbs).requires_grad_()
        limb_angles(body(of).joints).sum().backward()
        assert of.grad is not None
        assert of.grad.isfinite().all()


class TestLimbAngles:
    def angle(self, one: Tensor, other: Tensor) -> float:
        return math.degrees(math.acos(one @ other / one.norm() / other.norm()))

    def test_names(self) -> None:
        """The contract's, in the order of its sentence with left before right."""
        joints = ("elbow", "knee", "shoulder", "hip")
        assert tuple(f"{joint}_{side}_limb" for joint in joints for side in SIDES) == LIMB_ANGLE_NAMES

    def test_definition(self, body: BodyModel) -> None:
        """DESIGN.md's, joint by joint, on a random body."""
        joints = body(torch.randn(1, 24, dtype=F64)).joints
        at = dict(zip(body.joint_names, joints[0], strict=True))
        found = dict(zip(LIMB_ANGLE_NAMES, limb_angles(joints)[0].rad2deg().tolist(), strict=True))
        shoulders = (at["shoulder_left"] + at["shoulder_right"]) / 2
        hips = (at["hip_left"] + at["hip_right"]) / 2
        trunk = hips - shoulders  # downward
        for side in SIDES:
            upper_arm = at[f"elbow_{side}"] - at[f"shoulder_{side}"]
            forearm = at[f"wrist_{side}"] - at[f"elbow_{side}"]
            thigh = at[f"knee_{side}"] - at[f"hip_{side}"]
            shank = at[f"ankle_{side}"] - at[f"knee_{side}"]
            assert found[f"elbow_{side}_limb"] == pytest.approx(self.angle(upper_arm, forearm))
            assert found[f"knee_{side}_limb"] == pytest.approx(self.angle(thigh, shank))
            assert found[f"shoulder_{side}_limb"] == pytest.approx(self.angle(upper_arm, trunk))
            assert found[f"hip_{side}_limb"] == pytest.approx(self.angle(thigh, trunk))

    @pytest.mark.parametrize(
        ("limbs", "expected"),
        [
            ({}, {}),
            ({"forearm_left": FORWARD}, {"elbow_left_limb": 90}),
            ({"upper_arm_right": RIGHT, "forearm_right": RIGHT}, {"shoulder_right_limb": 90}),
            ({"upper_arm_right": UP, "forearm_right": UP}, {"shoulder_right_limb": 180}),
            (
                {"thigh_left": FORWARD, "shank_left": DOWN},
                {"hip_left_limb": 90, "knee_left_limb": 90},
            ),
        ],
    )
    def test_by_hand(self, body: BodyModel, limbs: dict[str, Direction], expected: dict[str, float]) -> None:
        found = limb_angles(body(pose(body, {"yaw": 30}, **limbs)).joints)[0].rad2deg().tolist()
        for name, degrees in zip(LIMB_ANGLE_NAMES, found, strict=True):
            # The body file's shoulders stand above its hips up to a degree or two.
            assert degrees == pytest.approx(expected.get(name, 0), abs=3), name

    def test_any_batch_axes(self, body: BodyModel) -> None:
        joints = body(torch.randn(6, 24, dtype=F64)).joints
        folded = limb_angles(joints.unflatten(0, (2, 3)))
        assert_close(folded.flatten(0, 1), limb_angles(joints), atol=1e-14, rtol=0)
        assert_close(limb_angles(joints[0]), limb_angles(joints)[0], atol=1e-14, rtol=0)


class TestAngleSd:
    # Everything bent, and nothing near a pole.
    BENT = {  # noqa: RUF012
        "head": slanted(UP, FORWARD, 15),
        "upper_arm_left": slanted(DOWN, FORWARD, 40),
        "forearm_left": slanted(FORWARD, RIGHT, 30),
        "upper_arm_right": slanted(DOWN, RIGHT, 40),
        "forearm_right": FORWARD,
        "thigh_left": slanted(DOWN, FORWARD, 60),
        "shank_left": slanted(DOWN, BACKWARD, 10),
        "thigh_right": slanted(DOWN, RIGHT, 20),
        "shank_right": slanted(DOWN, BACKWARD, 70),
    }

    def test_equals_sampling(self, body: BodyModel) -> None:
        of = pose(body, {"yaw": 20, "pitch": 10}, **self.BENT)
        mix = torch.randn(24, 24, dtype=F64)
        covariance = 1e-6 * mix @ mix.T  # 0.3 degrees or so, and correlated
        sd = angle_sd(body, of, covariance[None], body.default_size(1))
        draws = of + torch.randn(20_000, 24, dtype=F64) @ torch.linalg.cholesky(covariance).T
        sampled = anatomical_angles(body, body(draws)).std(dim=0)
        # Ours come from 256 draws, in pairs and evenly spread.
        assert_close(sd[0], sampled, rtol=0.15, atol=0)

    def test_a_straight_elbow_does_not_tell_the_shoulders_rotation(self, body: BodyModel) -> None:
        covariance = (0.05**2 * torch.eye(24, dtype=F64))[None]
        size = body.default_size(1)

        def rotation(bend: float) -> float:
            of = pose(
                body, None, **self.BENT | {"forearm_left": slanted(slanted(DOWN, FORWARD, 40), LEFT, bend)}
            )
            sd = dict(zip(ANATOMICAL_NAMES, angle_sd(body, of, covariance, size)[0].tolist(), strict=True))
            assert sd["shoulder_flexion_left"] < 0.1  # the upper arm itself is as well known as ever
            return sd["shoulder_rotation_left"]

        at = [rotation(bend) for bend in (90, 30, 10, 5, 0)]
        assert at == sorted(at)
        assert at[0] < 0.1
        assert at[3] > 0.4
        assert at[-1] > 1.2  # next to nothing known

    def test_all_are_finite_in_the_zero_pose(self, body: BodyModel) -> None:
        sd = angle_sd(
            body, torch.zeros(1, 24, dtype=F64), torch.eye(24, dtype=F64)[None], body.default_size(1)
        )
        assert ((sd >= 0) & (sd <= math.pi)).all()

    def test_an_unknown_pose_is_unknown(self, body: BodyModel) -> None:
        of = pose(body, None, **self.BENT)
        covariance = torch.full(
            (1, 24, 24), torch.inf, dtype=F64
        )  # as the registration says when it cannot tell
        assert_close(
            angle_sd(body, of, covariance, body.default_size(1)),
            torch.full((1, 21), math.pi / 3**0.5, dtype=F64),
        )

    def test_batch_equals_one_by_one(self, body: BodyModel) -> None:
        of = torch.cat([pose(body, {"yaw": yaw}, **self.BENT) for yaw in (0, 30)])
        covariance = torch.stack([scale * torch.eye(24, dtype=F64) for scale in (1e-4, 4e-4)])
        both = angle_sd(body, of, covariance, body.default_size(1))
        assert_close(both[1] / both[0], torch.full((21,), 2.0, dtype=F64), atol=2e-3, rtol=0)
        alone = angle_sd(body, of[1:], covariance[1:], body.default_size(1))
        assert_close(both[1:], alone, atol=1e-14, rtol=0)
