"""The body file: what it expands to, its mirror image, and every complaint about a bad one."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from torchpose.body.skeleton import HUMAN, Hinges, Skeleton, load_skeleton

SIDES = ("left", "right")
# The contract of DESIGN.md, in its order.
BODIES = (
    "torso",
    "head",
    *(f"{limb}_{side}" for side in SIDES for limb in ("upper_arm", "forearm")),
    *(f"{limb}_{side}" for side in SIDES for limb in ("thigh", "shank")),
)
SEGMENTS = (
    "torso",
    "head",
    *(f"{limb}_{side}" for side in SIDES for limb in ("upper_arm", "forearm", "hand")),
    *(f"{limb}_{side}" for side in SIDES for limb in ("thigh", "shank", "foot")),
)
JOINTS = (
    "pelvis",
    "neck",
    "head",
    *(
        f"{joint}_{side}"
        for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        for side in SIDES
    ),
)
MIRROR = np.diag([-1.0, 1.0, 1.0])

Body = dict[str, Any]
Change = Callable[[Body], Any]


@pytest.fixture(scope="module")
def human() -> Skeleton:
    return load_skeleton()


def write(path: Path, change: Change | None = None) -> Path:
    """human.yaml with a change, in a file of its own."""
    data = yaml.safe_load(HUMAN.read_text())
    if change is not None:
        change(data)
    file = path / "body.yaml"
    file.write_text(yaml.safe_dump(data, sort_keys=False))
    return file


class TestHuman:
    def test_names_and_their_order(self, human: Skeleton) -> None:
        assert human.body_names == BODIES
        assert tuple(segment.name for segment in human.segments) == SEGMENTS
        assert tuple(joint.name for joint in human.joints) == JOINTS

    def test_parameters(self, human: Skeleton) -> None:
        names = human.parameter_names
        assert names[:6] == ("torso_x", "torso_y", "torso_z", "torso_yaw", "torso_pitch", "torso_roll")
        assert names[6:] == tuple(f"{body}_{k}" for body in BODIES[1:] for k in (1, 2))

    def test_tree(self, human: Skeleton) -> None:
        parents = {body.name: human.body_names[body.parent] for body in human.bodies}
        expected = {"head": "torso"}
        for side in SIDES:
            for upper, lower in (("upper_arm", "forearm"), ("thigh", "shank")):
                expected |= {f"{upper}_{side}": "torso", f"{lower}_{side}": f"{upper}_{side}"}
        assert parents == expected

    def test_segments_and_joints_stand_on_their_bodies(self, human: Skeleton) -> None:
        on = {segment.name: human.body_names[segment.body] for segment in human.segments}
        carrier = {"hand": "forearm", "foot": "shank"}
        for name in SEGMENTS:
            limb, _, side = name.rpartition("_") if name.endswith(SIDES) else (name, "", "")
            assert on[name] == carrier.get(limb, limb) + ("_" + side if side else "")
        on = {joint.name: human.body_names[joint.body] for joint in human.joints}
        for side in SIDES:
            for joint, body in (("shoulder", "upper_arm"), ("elbow", "forearm"), ("wrist", "forearm")):
                assert on[f"{joint}_{side}"] == f"{body}_{side}"
            for joint, body in (("hip", "thigh"), ("knee", "shank"), ("ankle", "shank")):
                assert on[f"{joint}_{side}"] == f"{body}_{side}"

    def test_is_a_person(self, human: Skeleton) -> None:
        """Left is +x, up is -y: arms hang from shoulders on their own side, knees are below the hips."""
        origin = {body.name: np.array(body.origin.default()) for body in human.bodies}
        assert origin["upper_arm_left"][0] > 0 > origin["upper_arm_right"][0]
        assert origin["thigh_left"][0] > 0 > origin["thigh_right"][0]
        assert origin["head"][1] < origin["upper_arm_left"][1] < origin["thigh_left"][1]
        assert origin["forearm_left"][1] > 0
        assert origin["shank_left"][1] > 0
        for segment in human.segments:
            assert (
                0
                < min(segment.radius[1])
                <= max(segment.radius[1])
                <= segment.half_length[1]
                < human.height / 2
            )

    def test_axes_and_directions_are_unit_vectors(self, human: Skeleton) -> None:
        for body in human.bodies:
            for hinges in (body.swing, body.revolute):
                axes = np.array(hinges.axes)
                np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-12)
            np.testing.assert_allclose(np.linalg.norm([body.limb, body.rest], axis=1), 1)
            # A swing turns the limb, so both of its axes lie across the limb at zero.
            np.testing.assert_allclose(np.array(body.swing.axes) @ body.swing.center, 0, atol=1e-12)

    def test_right_side_is_the_mirror_image(self, human: Skeleton) -> None:
        bodies = {body.name: body for body in human.bodies}
        for name in ("upper_arm", "forearm", "thigh", "shank"):
            left, right = bodies[f"{name}_left"], bodies[f"{name}_right"]
            np.testing.assert_allclose(right.origin.default(), MIRROR @ left.origin.default(), atol=1e-15)
            np.testing.assert_allclose(right.limb, MIRROR @ left.limb)
            np.testing.assert_allclose(right.rest, MIRROR @ left.rest)
            assert right.swing.center is not None
            np.testing.assert_allclose(right.swing.center, MIRROR @ left.swing.center)
            for one, other in ((left.swing, right.swing), (left.revolute, right.revolute)):
                assert one.limits == other.limits
                self.assert_mirrored_turns(one, other)
        for things, vectors in (
            (human.segments, ("center",)),
            (human.joints, ("at",)),
        ):
            by_name: dict[str, Any] = {thing.name: thing for thing in things}  # type: ignore[attr-defined]
            for name in by_name:
                if name.endswith("_left"):
                    left, right = by_name[name], by_name[name.replace("_left", "_right")]
                    for vector in vectors:
                        one, other = getattr(left, vector).default(), getattr(right, vector).default()
                        np.testing.assert_allclose(other, MIRROR @ one, atol=1e-15)
        for segment in human.segments:
            if segment.name.endswith("_left"):
                twin = next(s for s in human.segments if s.name == segment.name.replace("_left", "_right"))
                np.testing.assert_allclose(twin.axis, MIRROR @ segment.axis)
                assert (twin.radius, twin.half_length) == (segment.radius, segment.half_length)

    @staticmethod
    def assert_mirrored_turns(left: Hinges, right: Hinges) -> None:
        """Equal angles turn both sides into each other's mirror image: M R_left M = R_right."""
        for one, other in zip(left.axes, right.axes, strict=True):
            R_left, R_right = (
                Rotation.from_rotvec(0.7 * np.array(axis)).as_matrix() for axis in (one, other)
            )
            np.testing.assert_allclose(R_right, MIRROR @ R_left @ MIRROR, atol=1e-12)

    def test_limits_are_in_radians_and_hold_the_rest(self, human: Skeleton) -> None:
        data = yaml.safe_load(HUMAN.read_text())["bodies"]
        for body in human.bodies:
            entry = data[body.name.removesuffix("_left").removesuffix("_right")]
            for kind in ("swing", "revolute"):
                expected = np.radians(entry[kind]["limits"])
                np.testing.assert_allclose(getattr(body, kind).limits, expected)
                assert (np.abs(expected) <= math.pi).all()


class TestOtherFiles:
    def test_an_unchanged_copy_is_the_same(self, tmp_path: Path, human: Skeleton) -> None:
        assert load_skeleton(write(tmp_path)) == human
        assert load_skeleton(str(write(tmp_path))) == human

    def test_a_change_arrives(self, tmp_path: Path, human: Skeleton) -> None:
        def longer(data: Body) -> None:
            data["bodies"]["forearm"]["origin"] = {"upper_arm": [0.01, 0.4, 0.02]}

        bodies = {body.name: body for body in load_skeleton(write(tmp_path, longer)).bodies}
        assert bodies["forearm_left"].origin.default() == (0.01, 0.4, 0.02)
        assert bodies["forearm_right"].origin.default() == (-0.01, 0.4, 0.02)

    def test_slants_are_mirrored(self, tmp_path: Path) -> None:
        """Segments, limbs and rests of the built-in person lie in planes that the mirror keeps; others need not."""

        def slanted(data: Body) -> None:
            data["segments"]["foot"]["axis"] = [0.6, 0.0, -0.8]
            data["bodies"]["shank"] |= {"limb": [0.6, 0.8, 0.0], "rest": [0.8, 0.6, 0.0]}

        skeleton = load_skeleton(write(tmp_path, slanted))
        axis = {segment.name: segment.axis for segment in skeleton.segments}
        assert axis["foot_left"] == pytest.approx((0.6, 0, -0.8))
        assert axis["foot_right"] == pytest.approx((-0.6, 0, -0.8))
        shank = next(body for body in skeleton.bodies if body.name == "shank_right")
        assert shank.limb == pytest.approx((-0.6, 0.8, 0))
        assert shank.rest == pytest.approx((-0.8, 0.6, 0))

    def test_a_vector_of_several_sizes_adds_up(self, tmp_path: Path) -> None:
        def both(data: Body) -> None:
            data["bodies"]["head"]["origin"] = {"trunk": [0, -0.5, 0.125], "neck": [0, -0.25, 0]}

        head = load_skeleton(write(tmp_path, both)).bodies[0]
        assert head.origin.default() == (0, -0.75, 0.125)

    def test_one_radius_or_two(self, tmp_path: Path) -> None:
        def flat(data: Body) -> None:
            data["segments"]["foot"]["radius"] = {"shank_girth": 0.05}
            data["segments"]["torso"]["radius"] = {"trunk_girth": [0.2, 0.1]}

        radius = {segment.name: segment.radius for segment in load_skeleton(write(tmp_path, flat)).segments}
        assert radius["foot_left"] == radius["foot_right"] == ("shank_girth", (0.05, 0.05))
        assert radius["torso"] == ("trunk_girth", (0.2, 0.1))

    def test_swing_axes_are_straightened_to_their_center(self, tmp_path: Path) -> None:
        def skew(data: Body) -> None:
            data["bodies"]["head"]["swing"] |= {"center": [0, -2, 0], "axes": [[1, 5, 0], [1, 0, 1]]}

        swing = load_skeleton(write(tmp_path, skew)).bodies[0].swing
        np.testing.assert_allclose(swing.axes, [[1, 0, 0], [0, 0, 1]], atol=1e-12)


def drop(*keys: str) -> Change:
    def change(data: Body) -> None:
        for key in keys[:-1]:
            data = data[key]
        del data[keys[-1]]

    return change


def put(value: object, *keys: str) -> Change:
    def change(data: Body) -> None:
        for key in keys[:-1]:
            data = data[key]
        data[keys[-1]] = value

    return change


HALF = {"upper_arm": 0.01}
REVOLUTE = {"axes": [[1, 0, 0], [1, 1, 0]], "limits": [[-1, 1], [-1, 1]]}
COMPLAINTS: list[tuple[Change, str]] = [
    (drop("lengths"), "needs the keys of human.yaml; wrong or missing here: 'lengths'"),
    (drop("height"), "wrong or missing here: 'height'"),
    (drop("bodies"), "wrong or missing here: 'bodies'"),
    (drop("bodies", "head", "limb"), "body head needs the key 'limb'"),
    (drop("bodies", "forearm", "swing", "center"), "body forearm needs the key 'center'"),
    (drop("bodies", "forearm", "revolute", "limits"), "body forearm needs the key 'limits'"),
    (drop("bodies", "forearm", "parent"), "wrong or missing here: 'parent'"),
    (drop("segments", "hand", "axis"), "segment hand needs the key 'axis'"),
    (drop("joints", "wrist", "at"), "joint wrist needs the key 'at'"),
    (put("tall", "height"), "could not convert string to float: 'tall'"),
    (put(-1.7, "height"), "height must be positive, in metres, got -1.7"),
    (put(float("nan"), "height"), "height must be positive, in metres, got nan"),
    (put(["trunk", "trunk"], "lengths"), "sizes must have different names"),
    (put("somewhere", "bodies", "torso"), "string indices must be integers"),
    (put("torso", "bodies", "torso", "parent"), "exactly one body must have `parent: null`, got \\[\\]"),
    (
        put(None, "bodies", "head", "parent"),
        "exactly one body must have `parent: null`, got \\['torso', 'head'\\]",
    ),
    (put("tail", "bodies", "forearm", "parent"), "hang from 'torso', these do not: \\['forearm'\\]"),
    (put("shank", "bodies", "thigh", "parent"), "hang from 'torso', these do not: \\['shank', 'thigh'\\]"),
    (
        put({"tail": [0, 1, 0]}, "bodies", "head", "origin"),
        "body head: a vector must be given per length, .* got .'tail'",
    ),
    (
        put({"head_girth": [0, 1, 0]}, "bodies", "head", "origin"),
        "body head: a vector must be given per length",
    ),
    (put([0, 1, 0], "bodies", "head", "origin"), "body head: a vector must be given per length"),
    (
        put({"trunk": [0, 1]}, "bodies", "head", "origin"),
        "body head: a vector must have 3 numbers, got \\[0, 1\\]",
    ),
    (
        put({"trunk": [0, 1, "x"]}, "joints", "neck", "at"),
        "joint neck: could not convert string to float: 'x'",
    ),
    (put({"trunk": [0, float("inf"), 0]}, "bodies", "head", "origin"), "body head: a vector must be finite"),
    (put([0, 0, 0], "bodies", "head", "limb"), "body head: a direction must not be zero"),
    (
        put([[0, 1, 0], [0, 0, 1]], "bodies", "head", "swing", "axes"),
        "body head: a direction must not be zero",
    ),
    (put([[1, 0, 0]], "bodies", "head", "swing", "axes"), "body head: not enough values to unpack"),
    (put(REVOLUTE, "bodies", "head", "revolute"), "body head: the two axes must be at a right angle"),
    (
        put([[30, -30], [-1, 1]], "bodies", "shank", "swing", "limits"),
        "body shank: limits must be .lower, upper.",
    ),
    (
        put([[-1, 1], [5, 5]], "bodies", "shank", "revolute", "limits"),
        "body shank: limits must be .lower, upper.",
    ),
    (put([[-1, 1]], "bodies", "shank", "revolute", "limits"), "body shank: not enough values to unpack"),
    (
        put(HALF, "segments", "upper_arm", "half_length"),
        "segment upper_arm: half_length must be at least the radius",
    ),
    (
        put({"forearm": 0.05}, "segments", "hand", "radius"),
        "segment hand: one of \\['trunk_girth', .* must come with",
    ),
    (put({"forearm_girth": -0.1}, "segments", "hand", "radius"), "segment hand: .* positive value in metres"),
    (
        put({"forearm_girth": 0.1, "head_girth": 1}, "segments", "hand", "radius"),
        "segment hand: .* must come with",
    ),
    (
        put({"forearm_girth": []}, "segments", "hand", "radius"),
        "segment hand: .* positive value in metres, got .*\\[\\]",
    ),
    (
        put({"forearm_girth": [0.04, 0]}, "segments", "hand", "radius"),
        "segment hand: .* positive value in metres, got .*\\[0.04, 0\\]",
    ),
    (
        put({"forearm_girth": [0.04, 0.03, 0.02]}, "segments", "hand", "radius"),
        "segment hand: radius must be one number or two, across the long axis, got .*0.02",
    ),
    (
        put({"forearm_girth": [0.04, 0.4]}, "segments", "hand", "radius"),
        "segment hand: half_length must be at least the radius",
    ),
    (
        put({"forearm": [0.1, 0.1]}, "segments", "hand", "half_length"),
        "segment hand: half_length must be one number",
    ),
    (put(0.04, "segments", "hand", "radius"), "segment hand: one of .* must come with .* got 0.04"),
    (
        put("paw", "segments", "hand", "body"),
        "segment hand: it must stand on a body of the same side, .*paw_left",
    ),
    (
        drop("segments", "hand", "sided"),
        "segment hand: it must stand on a body of the same side, .*'forearm'",
    ),
    (
        put(True, "joints", "pelvis", "sided"),
        "joint pelvis: it must stand on a body of the same side, .*torso_left",
    ),
]


class TestComplaints:
    @pytest.mark.parametrize(("change", "message"), COMPLAINTS, ids=[message for _, message in COMPLAINTS])
    def test_names_the_file_and_the_entry(self, tmp_path: Path, change: Change, message: str) -> None:
        file = write(tmp_path, change)
        with pytest.raises(ValueError, match=message) as caught:
            load_skeleton(file)
        assert str(caught.value).startswith(f"{file}: ")

    @pytest.mark.parametrize("text", ["", "- a list", "just words", "bodies: [unclosed"])
    def test_no_body_file_at_all(self, tmp_path: Path, text: str) -> None:
        file = tmp_path / "body.yaml"
        file.write_text(text)
        with pytest.raises(ValueError, match=r"a body file needs the keys of human\.yaml"):
            load_skeleton(file)

    def test_missing_file(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match=r"must exist, got .*nobody\.yaml; leave `body\.path` empty"):
            load_skeleton(tmp_path / "nobody.yaml")

    def test_a_folder_is_no_file(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match="the body file must exist"):
            load_skeleton(tmp_path)
