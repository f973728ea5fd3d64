"""How people move: possible, continuous, on the floor, in view, and as the activity's name says."""

import functools
import math

import pytest
import torch
from torch import Tensor

from torchpose.body.model import BodyModel, PosedBody
from torchpose.body.superquadric import draw_person
from torchpose.synthesis.motion import ACTIVITIES, MOTIONS, MotionConfig, lowest, perform, random_stream
from torchpose.vision.camera import StereoCamera

BODY = BodyModel()
CAMERA = StereoCamera(640, 480, 600.0, 318.3, 241.7, 0.12)
JOINT = {name: i for i, name in enumerate(BODY.joint_names)}
TAKES = [(0, 0), (3, 1), (7, 2)]  # person, take


def moved(
    motion: str, person: int = 0, take: int = 0, times: Tensor | None = None
) -> tuple[Tensor, PosedBody]:
    size = draw_person(person).size(BODY)
    times = torch.arange(100) / 20 if times is None else times
    pose = perform(BODY, size, motion, times, CAMERA, person, take)
    return pose, BODY(pose, size)


@functools.cache
def take_of(motion: str, person: int = 0, take: int = 0) -> PosedBody:
    """Five seconds of a motion at 20 frames a second, computed once for all tests."""
    return moved(motion, person, take)[1]


def path(posed: PosedBody, name: str) -> Tensor:
    """A joint's positions relative to the pelvis, in the trunk's frame: what it does, not where the person
    is.
    """
    offset = posed.joints[:, JOINT[name]] - posed.joints[:, JOINT["pelvis"]]
    return (posed.rotations[:, 0].mT @ offset[..., None])[..., 0]


def spread(posed: PosedBody, name: str) -> float:
    """How far the joint gets from where it mostly is, m."""
    track = path(posed, name)
    return (track - track.median(0).values).norm(dim=-1).max().item()


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize(("person", "take"), TAKES)
def test_every_motion_is_possible_continuous_on_the_floor_and_in_view(motion, person, take):
    pose, posed = moved(motion, person, take)
    assert torch.isfinite(pose).all()
    # Strictly within: nothing was cut off at a joint's stop.
    assert (pose[:, 6:] > BODY.low[6:] - 1e-5).all()
    assert (pose[:, 6:] < BODY.high[6:] + 1e-5).all()
    _, fine = moved(motion, person, take, torch.arange(200) / 100)
    assert fine.joints.diff(dim=0).norm(dim=-1).max() * 100 < 8  # m/s; a jump would be far above
    soles = lowest(BODY, posed)
    assert (soles.amax(1) - MotionConfig().floor).abs().max() < 0.005
    feet_and_hands = posed.centers + posed.radii[..., 2:] * posed.frames[..., 2]
    pixels = CAMERA.project(torch.cat((posed.joints, feet_and_hands), 1))
    assert (pixels >= 0).all()
    assert (pixels <= torch.tensor([639, 479])).all()
    heading = torch.atan2(-posed.rotations[:, 0, 2, 0], posed.rotations[:, 0, 0, 0]).mean()
    assert heading.abs() < MotionConfig().heading + 0.1


@pytest.mark.parametrize("person", [0, 3, 7])
def test_limbs_move_as_the_activity_is_called(person):
    reach = {
        motion: {
            name: spread(take_of(motion, person), name)
            for name in ("wrist_left", "wrist_right", "knee_left", "knee_right")
        }
        for motion in ACTIVITIES
    }
    for side, other in (("left", "right"), ("right", "left")):
        hand, leg = reach[f"{side}_hand"], reach[f"{side}_leg"]
        assert hand[f"wrist_{side}"] > 0.45
        assert hand[f"wrist_{other}"] < 0.15
        assert leg[f"knee_{side}"] > 0.2
        assert leg[f"knee_{other}"] < 0.1
        assert leg["wrist_left"] < 0.25
        for motion in ("both_hands", "boxing"):
            assert reach[motion][f"wrist_{side}"] > (0.45 if motion == "both_hands" else 0.15)
            assert reach[motion][f"knee_{side}"] < 0.2
        for motion in ("walking", "sitting"):
            assert reach[motion][f"knee_{side}"] > 0.1


def correlation(first: Tensor, second: Tensor) -> float:
    return torch.corrcoef(torch.stack((first, second)))[0, 1].item()


@pytest.mark.parametrize(("person", "take"), TAKES)
def test_sides_go_together_or_by_turns(person, take):
    def ahead(motion: str, joint: str) -> Tensor:
        return -path(take_of(motion, person, take), joint)[:, 2]

    def height(motion: str, joint: str) -> Tensor:
        return -path(take_of(motion, person, take), joint)[:, 1]

    assert correlation(height("both_hands", "wrist_left"), height("both_hands", "wrist_right")) > 0.8
    assert correlation(ahead("boxing", "wrist_left"), ahead("boxing", "wrist_right")) < -0.5
    assert correlation(ahead("walking", "knee_left"), ahead("walking", "knee_right")) < -0.7
    assert correlation(ahead("walking", "wrist_left"), ahead("walking", "knee_right")) > 0.5


@pytest.mark.parametrize(("person", "take"), TAKES)
def test_only_sitting_lowers_the_pelvis(person, take):
    drop = {}
    for motion in ACTIVITIES:
        height = take_of(motion, person, take).joints[:, JOINT["pelvis"], 1]
        drop[motion] = (height.max() - height.min()).item()
    assert drop.pop("sitting") > 0.25
    assert max(drop.values()) < 0.12


@pytest.mark.parametrize(
    ("motion", "slide"), [("left_hand", 0.03), ("boxing", 0.03), ("right_leg", 0.01), ("sitting", 0.08)]
)
def test_a_standing_foot_keeps_its_place(motion, slide):
    ankle = take_of(motion, 3).joints[:, JOINT["ankle_left"]][:, ::2]
    assert (ankle - ankle[0]).norm(dim=-1).max() < slide


def test_the_demonstration_shows_both_hands_and_a_step():
    _, posed = moved("demo", times=torch.arange(30) / 12)
    head = posed.joints[:, JOINT["head"], 1]
    for side in ("left", "right"):
        above = head - posed.joints[:, JOINT[f"wrist_{side}"], 1]
        assert above.max() > 0.2
        assert above[0] < -0.4
        assert above[-1] < -0.4
    step = posed.joints[:, JOINT["ankle_right"], 2] - posed.joints[:, JOINT["ankle_left"], 2]
    assert step[:12].abs().max() < 0.1
    assert step[-1] > 0.2


def test_a_motion_is_a_function_of_time():
    whole, _ = moved("free", 2, 3)
    some, _ = moved("free", 2, 3, torch.arange(100)[30:70] / 20)
    torch.testing.assert_close(some, whole[30:70])


@pytest.mark.parametrize("motion", MOTIONS)
def test_takes_differ_and_repeat_exactly(motion):
    first, again, other = moved(motion, 1, 0)[0], moved(motion, 1, 0)[0], moved(motion, 1, 1)[0]
    assert torch.equal(first, again)
    assert (first - other).abs().max() > 0.01


def test_streams_have_their_own_numbers():
    def numbers(*names: int | str) -> list[float]:
        return torch.rand(3, generator=random_stream(*names)).tolist()

    assert numbers("a", 1) == numbers("a", 1)
    assert numbers("a", 1) != numbers("a", 2)
    assert numbers("a", 12) != numbers("a1", 2)


def test_a_tall_person_stands_further_off():
    near = moved("sitting", 0)[0]
    config = MotionConfig(distance=(1.0, 1.2))
    size = draw_person(0).size(BODY)
    pose = perform(BODY, size, "both_hands", torch.arange(40) / 20, CAMERA, config=config)
    tips = BODY(pose, size)
    hands = tips.centers + tips.radii[..., 2:] * tips.frames[..., 2]
    assert pose[:, 2].min() > 2.0  # 1.2 m would cut off feet and hands
    assert (CAMERA.project(hands)[..., 1] >= 0).all()
    assert near[:, 2].min() > 2.4


def test_wrong_names_and_ranges_are_refused():
    with pytest.raises(ValueError, match=r"the motion must be one of left_hand, .*, got 'jumping'"):
        moved("jumping")
    with pytest.raises(ValueError, match="period must be a positive range, low to high"):
        MotionConfig(period=(3.0, 2.0))
    assert math.isclose(MotionConfig().heading, math.radians(35), abs_tol=0.01)
