"""Cold starts: bodies that are seen exactly are found from nothing, and what the search tries."""

from dataclasses import replace

import pytest
import torch
from synthetic_cloud import RELAXED, see, standing
from torch.testing import assert_close

from torchpose.body.model import BodyModel
from torchpose.registration.start import ARMS, LEGS, StartConfig, Starter, pelvis_position, select
from torchpose.registration.vem import Registrar, RegistrationConfig
from torchpose.vision.faces import Faces

T_POSE = {
    "upper_arm_left": (1.0, 0.1, 0.0),
    "forearm_left": (1.0, 0.0, -0.1),
    "upper_arm_right": (-1.0, 0.1, 0.0),
    "forearm_right": (-1.0, 0.0, -0.1),
}
WAVE = {"upper_arm_left": (1.0, 0.1, 0.0), "forearm_left": (0.2, -1.0, -0.3)}
SIT = {
    "thigh_left": (0.2, 0.25, -1.0),
    "shank_left": (0.1, 1.0, 0.0),
    "thigh_right": (-0.2, 0.25, -1.0),
    "shank_right": (-0.1, 1.0, 0.0),
}
UP = {"upper_arm_right": (-0.4, -1.0, -0.1), "forearm_right": (-0.1, -1.0, -0.1)}


@pytest.fixture(scope="module")
def body():
    return BodyModel()


@pytest.fixture(scope="module")
def starter(body):
    return Starter(body, StartConfig(), RegistrationConfig())


def limbs(body, **directions):
    rows = RELAXED.clone()
    for name, direction in directions.items():
        rows[body.body_names[1:].index(name)] = torch.tensor(direction)
    return rows


def face_of(body, pose, view):
    """The face where the head truly is."""
    position = body(pose).centers[:, body.segment_names.index("head")] - torch.tensor([0.0, 0.0, 0.09])
    u, v = view.camera.project(position)[0].tolist()
    box = torch.tensor([[u - 8, v - 8, u + 8, v + 8]])
    return Faces(box, torch.tensor([True]), torch.zeros_like(view.silhouette), position)


@pytest.mark.parametrize(
    ("changes", "yaw", "face"),
    [
        ({}, 0.0, True),
        (T_POSE, 0.5, True),
        (WAVE, 0.0, True),
        (SIT, -0.9, True),
        (UP, 0.5, False),
        (T_POSE, torch.pi, False),
    ],
    ids=["relaxed", "T", "waving", "sitting", "arm up, no face", "T from behind"],
)
def test_a_body_is_found_from_nothing(body, starter, changes, yaw, face):
    pose = standing(body, limbs(body, **changes), yaw=yaw, x=0.1, z=3.2)
    view = see(body, pose, noise=0.005, generator=torch.Generator().manual_seed(0))
    faces = face_of(body, pose, view) if face else view.no_face()
    found = starter(view.observation(), faces, body.default_size(1))
    errors = (body(found.pose).joints - body(pose).joints).norm(dim=-1)
    assert errors.mean() < 0.03  # m; left for right or front for back would be over 0.1
    assert found.misfit < 0.02
    assert found.pose.shape == (1, 24)


def test_points_beside_the_body_and_few_points_do_not_break_it(body, starter):
    view = see(body, standing(body), num=60)
    found = starter(view.observation(), view.no_face(), body.default_size(1))
    assert found.pose.isfinite().all()


def test_variations_are_the_pose_and_one_limb_at_a_time_elsewhere(body, starter):
    pose = standing(body, yaw=0.3)
    varied = starter.variations(pose)
    assert varied.shape == (1 + 2 * len(ARMS) + 2 * len(LEGS), 24)
    assert_close(varied[:1], pose, rtol=0, atol=1e-5)
    assert_close(varied[:, :6], pose[:, :6].expand(len(varied), -1))
    before = body.limb_directions(body(pose))
    moved = (body.limb_directions(body(varied)) - before).norm(dim=-1) > 1e-3
    assert moved.sum(1).max() == 2  # upper and lower limb
    names = body.body_names[1:]
    for row in moved[1:]:
        limb = {
            name.removesuffix("_left").removesuffix("_right") for name, m in zip(names, row, strict=True) if m
        }
        side = {name.split("_")[-1] for name, m in zip(names, row, strict=True) if m}
        assert limb <= {"upper_arm", "forearm"} or limb <= {"thigh", "shank"}
        assert len(side) == 1


def test_variations_mirror_left_and_right(body, starter):
    pose = standing(body)
    directions = body.limb_directions(body(starter.variations(pose)))
    names = body.body_names[1:]
    left, right = directions[1 : 1 + len(ARMS)], directions[1 + len(ARMS) : 1 + 2 * len(ARMS)]
    flip = torch.tensor([-1.0, 1.0, 1.0])
    for limb in ("upper_arm", "forearm"):
        own = left[:, names.index(f"{limb}_left")]
        assert_close(own, right[:, names.index(f"{limb}_right")] * flip, rtol=0, atol=1e-5)
        want = torch.nn.functional.normalize(torch.tensor([arm[limb == "forearm"] for arm in ARMS]), dim=-1)
        assert_close(own, want, rtol=0, atol=1e-5)


def test_hypotheses_stand_at_the_person_in_every_heading(body, starter):
    pose = standing(body, x=0.4, z=3.5)
    view = see(body, pose)
    size = body.default_size(1)
    blind = starter.hypotheses(view.observation(), view.no_face(), size)
    assert set((blind[:, 3].rad2deg().round()).tolist()) == set(starter.config.yaws)
    seen = starter.hypotheses(view.observation(), face_of(body, pose, view), size)
    assert set((seen[:, 3].rad2deg().round()).tolist()) == set(starter.config.face_yaws)
    assert len(blind) == len(seen) / len(starter.config.face_yaws) * len(starter.config.yaws)
    for starts in (blind, seen):
        away = (starts[:, :3] - pose[:, :3]).norm(dim=-1)
        assert away.median() < 0.15  # m
        assert away.max() < 0.5  # whoever sits has the hips elsewhere


@pytest.mark.parametrize("face", [True, False])
def test_the_pelvis_is_guessed_within_a_decimetre(body, face):
    for x, z in ((0.0, 3.0), (0.5, 4.0), (-0.3, 2.8)):
        pose = standing(body, x=x, z=z)
        view = see(body, pose)
        faces = face_of(body, pose, view) if face else view.no_face()
        guess = pelvis_position(view.cloud, faces, body.default_size(1), body)
        assert (guess - pose[:, :3]).norm() < 0.1


def test_exchanged_limbs_are_all_pairs_of_the_best(body, starter):
    poses = standing(body).repeat(10, 1)
    poses[:, 6:] += torch.arange(10)[:, None] * 0.01
    misfit = torch.tensor([9.0, 3, 8, 1, 7, 2, 6, 4, 5, 0])
    combined = starter._exchange(poses, misfit, ("upper_arm", "forearm"))
    assert combined.shape == (64, 24)
    left = body.parameter_names.index("forearm_left_1")
    right = body.parameter_names.index("upper_arm_right_2")
    pairs = {
        (round(a, 4), round(b, 4)) for a, b in (combined[:, [left, right]] - poses[0, [left, right]]).tolist()
    }
    best = [round(0.01 * i, 4) for i in (9, 3, 5, 1, 7, 8, 6, 4)]
    assert pairs == {(a, b) for a in best for b in best}
    rest = [i for i, name in enumerate(body.parameter_names) if "arm" not in name]
    assert_close(combined[:, rest], poses[9, rest].expand(64, -1))


def test_a_pose_turned_away_must_fit_better(body, starter):
    view = see(body, standing(body))
    both = torch.cat([standing(body), standing(body, yaw=torch.pi)])
    found = Registrar(body, RegistrationConfig(rounds=1))(view.observation(), both, body.default_size(1))
    even = replace(found, pose=both, misfit=torch.tensor([0.010, 0.010]))
    score = starter._score(even)
    assert_close(score[1] - score[0], torch.tensor(starter.config.back_penalty))


def test_select_takes_one_row(body):
    view = see(body, standing(body), num=80)
    starts = torch.cat([standing(body), standing(body, yaw=0.3)])
    both = Registrar(body)(view.observation(), starts, body.default_size(1))
    one = select(both, torch.tensor(1))
    assert torch.equal(one.pose, both.pose[1:])
    assert torch.equal(one.bound, both.bound[:, 1:])
    assert torch.equal(one.belief, both.belief[1:])


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"points": 0}, "points must be at least 1, got 0"),
        ({"finalists": 0}, "finalists must be at least 1, got 0"),
        ({"yaws": ()}, "yaws and face_yaws need at least one angle each"),
    ],
)
def test_bad_settings_are_told(setting, message):
    with pytest.raises(ValueError, match=message):
        StartConfig(**setting)
