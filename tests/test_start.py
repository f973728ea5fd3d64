"""Cold starts: bodies that are seen exactly are found from nothing, and what the search tries."""

import math
from dataclasses import replace

import pytest
import torch
from synthetic_cloud import RELAXED, see, standing, together
from torch.testing import assert_close

from torchpose.body.model import BodyModel
from torchpose.registration.fitting import PosePrior
from torchpose.registration.start import StartConfig, Starter, other_side, pelvis_position, turned_by
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
GUARD = {
    "upper_arm_left": (0.2, 0.9, -0.4),
    "forearm_left": (-0.2, -0.8, -0.7),
    "upper_arm_right": (-0.2, 0.9, -0.4),
    "forearm_right": (0.2, -0.8, -0.7),
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


@pytest.mark.parametrize("changes", [WAVE, UP], ids=["waving", "arm up"])
def test_a_limb_that_is_elsewhere_is_found_by_a_refresh(body, starter, changes):
    """Tracking still has the arms hanging."""
    pose = standing(body, limbs(body, **changes), x=0.1)
    seen = see(body, pose, noise=0.005, generator=torch.Generator().manual_seed(0)).observation()
    size = body.default_size(1)
    stuck = Registrar(body)(seen, standing(body, x=0.1), size)
    found = starter.refresh(seen, stuck.pose, size)
    assert (body(found.pose).joints - body(pose).joints).norm(dim=-1).mean() < 0.03
    assert found.pose.shape == (1, 24)
    assert found.score < stuck.score + 1


@pytest.mark.parametrize("cold", [True, False])
def test_the_last_fits_begin_as_near_as_the_starts_are(body, starter, monkeypatch, cold):
    """From a cold start as any registration does; a refresh does not unsettle what is all but right."""
    seen, size, begun = see(body, standing(body), num=100), body.default_size(1), []
    fit = starter.registrar.forward

    def remembered(observation, start, size, prior, rounds, sigma_first, covariance):
        begun.append((rounds, sigma_first))
        return fit(observation, start, size, prior, rounds, sigma_first, covariance)

    monkeypatch.setattr(starter.registrar, "forward", remembered)
    if cold:
        monkeypatch.setattr(starter, "config", replace(starter.config, refreshes=0))
        starter(seen.observation(), seen.no_face(), size)
    else:
        starter.refresh(seen.observation(), standing(body), size)
    rounds = starter.config.final_rounds
    assert begun == [(rounds, None if cold else starter.config.refresh_sigma)]


def test_frames_refreshed_together_have_the_answers_of_each_alone(body, starter):
    """Of different points, silhouettes, sizes and priors."""
    poses = [standing(body, limbs(body, **WAVE), x=-0.4), standing(body, x=0.4, yaw=0.4)]
    sizes = torch.cat([body.size_of_height(1.65), body.size_of_height(1.85)])
    views = [see(body, pose, size[None], num=200) for pose, size in zip(poses, sizes, strict=True)]
    start = torch.cat([standing(body, x=-0.38), standing(body, x=0.42, yaw=0.4)])
    prior = PosePrior(start, torch.tensor([[1.0], [20.0]]).expand(2, 24))
    both = starter.refresh(together(views), start, sizes, prior)
    for k in range(2):
        row = slice(k, k + 1)
        own = PosePrior(start[row], prior.precision[row])
        alone = starter.refresh(views[k].observation(), start[row], sizes[row], own)
        for name in ("pose", "covariance", "score", "misfit", "distance"):
            assert_close(getattr(both, name)[row], getattr(alone, name), rtol=1e-3, atol=1e-4)


def test_a_refresh_weighs_its_answers_with_the_prior(body, starter):
    """Of a loose prior nothing is felt, a sure one is not left."""
    pose = standing(body, limbs(body, **WAVE))
    seen = see(body, pose, num=200).observation()
    size = body.default_size(1)
    free = starter.refresh(seen, standing(body), size)
    mean = standing(body) + 0.02
    loose = starter.refresh(seen, standing(body), size, PosePrior(mean, torch.full((1, 24), 1e-6)))
    assert_close(loose.pose, free.pose, rtol=0, atol=2e-3)
    sure = starter.refresh(seen, standing(body), size, PosePrior(mean, torch.full((1, 24), 1e9)))
    assert_close(sure.pose, mean, rtol=0, atol=1e-2)
    # The score is that of the joint density: no answer may beat it by leaving the prior unpaid.
    gap = 0.5 * 1e3 * (free.pose - mean).square().sum()
    paid = starter.registrar.evaluate(
        seen, free.pose, size, PosePrior(mean, torch.full((1, 24), 1e3)), free.bound, free.status
    )
    silent = starter.registrar.evaluate(
        seen, free.pose, size, PosePrior(mean, torch.zeros(1, 24)), free.bound, free.status
    )
    assert_close(paid.score - silent.score, gap[None], rtol=0.02, atol=0.5)


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
def test_the_pelvis_is_guessed_within_an_eighth_of_a_metre(body, face):
    for x, z in ((0.0, 3.0), (0.5, 4.0), (-0.3, 2.8)):
        pose = standing(body, x=x, z=z)
        view = see(body, pose)
        faces = face_of(body, pose, view) if face else view.no_face()
        guess = pelvis_position(view.cloud, faces, body.default_size(1), body)
        assert (guess - pose[:, :3]).norm() < 0.125


def arms(body, side):
    return [i for i, name in enumerate(body.parameter_names) if f"arm_{side}" in name]


def test_exchanged_limbs_are_all_pairs_of_the_best(body, starter):
    """All of them, where as many are asked for."""
    view = see(body, standing(body)).observation()
    poses = standing(body).repeat(10, 1)
    poses[:, 6:] += torch.arange(10)[:, None] * 0.2
    score = torch.tensor([9.0, 3, 8, 1, 7, 2, 6, 4, 5, 0])
    every = Starter(body, replace(starter.config, combined=128), RegistrationConfig())
    (combined,), new = every._exchange(view, poses[None], score[None], body.default_size(1), None)
    assert combined.shape == (128, 24)
    # The best start itself comes twice, and is not taken.
    itself = (combined == poses[9]).all(1)
    assert itself.sum() == 2
    assert torch.equal(~itself, new[0])
    best = [round(0.2 * i, 4) for i in (9, 3, 5, 1, 7, 8, 6, 4)]
    for kind, other in (("forearm", "upper_arm"), ("shank", "thigh")):
        left = body.parameter_names.index(f"{kind}_left_1")
        right = body.parameter_names.index(f"{other}_right_2")
        both = combined[:, [left, right]] - poses[0, [left, right]]
        pairs = {(round(a, 4), round(b, 4)) for a, b in both.tolist()}
        assert pairs == {(a, b) for a in best for b in best}
    moved = (combined != poses[9]).any(0)
    assert not moved[:8].any()  # root and head
    both = arms(body, "left") + arms(body, "right")
    armed, legged = ((combined[:, own] != poses[9, own]).any(1) for own in (both, slice(16, 24)))
    assert not (armed & legged).any()


def test_of_the_combinations_the_likeliest_are_taken(body, starter):
    """Arms to the sides are seen. No start has both, the best one has none."""
    truth = standing(body, limbs(body, **T_POSE))
    view = see(body, truth).observation()
    poses = truth.repeat(5, 1)
    for start, side in ((0, "left"), (0, "right"), (1, "left"), (2, "right"), (3, "left"), (3, "right")):
        poses[start, arms(body, side)] = standing(body)[0, arms(body, side)] + 0.1 * start
    poses[4, arms(body, "left") + arms(body, "right")] += 0.5
    few = Starter(body, replace(starter.config, combined=1), RegistrationConfig())
    score = torch.arange(5.0)[None]
    (combined,), new = few._exchange(view, poses[None], score, body.default_size(1), None)
    assert new.all()
    assert_close(combined, truth)
    # A prior that is sure of a hanging left arm is heard.
    precision = torch.zeros_like(truth)
    precision[:, arms(body, "left")] = 1e6
    prior = PosePrior(standing(body), precision)
    (combined,), _ = few._exchange(view, poses[None], score, body.default_size(1), prior)
    assert_close(combined[:, arms(body, "left")], standing(body)[:, arms(body, "left")])


def test_limbs_that_hardly_differ_from_those_of_better_starts_are_not_exchanged_again(body, starter):
    """Of left arms at 0, 0.05, 0.15 and 0.02, that of the best start, one other is left; of equal right arms none."""
    poses = standing(body).repeat(2, 4, 1)
    left = arms(body, "left")
    poses[0, :, left] += torch.tensor([0.0, 0.05, 0.15, 0.02])[:, None]
    score = torch.tensor([3.0, 1.0, 2.0, 0.0]).expand(2, 4)
    view = see(body, standing(body)).observation().take(torch.tensor([0, 0]))
    some = Starter(body, replace(starter.config, apart=0.05), RegistrationConfig())
    combined, new = some._exchange(view, poses, score, body.default_size(1), None)
    moved = combined[0, new[0]][:, left] - standing(body)[:, left]
    assert_close(moved, torch.full((1, len(left)), 0.15))
    assert not new[1].any()  # the other frame's starts are all alike
    every = Starter(body, replace(starter.config, apart=0.0), RegistrationConfig())
    assert every._exchange(view, poses, score, body.default_size(1), None)[1].sum() == 2 * 30


def test_a_pose_turned_away_must_fit_better(body, starter):
    view = see(body, standing(body))
    both = torch.cat([standing(body), standing(body, yaw=torch.pi)])
    found = Registrar(body, RegistrationConfig(rounds=1))(view.observation(), both, body.default_size(1))
    even = replace(found, pose=both, score=torch.tensor([20.0, 20.0]), misfit=torch.tensor([0.01, 0.5]))
    score = starter.score(even)
    assert_close(score, torch.tensor([20.0, 20.0 + starter.config.back_penalty]))
    assert starter.score(replace(even, score=torch.tensor([torch.nan, 20.0]))).argmin() == 1


def test_a_registration_gives_one_of_its_rows(body):
    view = see(body, standing(body), num=80)
    starts = torch.cat([standing(body), standing(body, yaw=0.3)])
    both = Registrar(body)(view.observation(), starts, body.default_size(1))
    one = both.take(torch.tensor([1]))
    assert torch.equal(one.pose, both.pose[1:])
    assert torch.equal(one.bound, both.bound[:, 1:])
    assert torch.equal(one.belief, both.belief[1:])


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"points": 0}, "points must be at least 1, got 0"),
        ({"finalists": 0}, "finalists must be at least 1, got 0"),
        (
            {"finalists_apart": -0.1},
            "finalists_apart must not be negative, got -0.1 rad; 0 takes the best of all",
        ),
        ({"yaws": ()}, "yaws, face_yaws and walking_yaws need at least one angle each"),
    ],
)
def test_bad_settings_are_told(setting, message):
    with pytest.raises(ValueError, match=message):
        StartConfig(**setting)


def test_somebody_walking_starts_the_way_he_goes(body, starter):
    view = see(body, standing(body, yaw=1.2), num=100)
    starts = starter.hypotheses(view.observation(), view.no_face(), body.default_size(1), walking=1.2)
    off = torch.remainder(starts[:, 3] - 1.2 + torch.pi, 2 * torch.pi) - torch.pi
    assert {round(math.degrees(float(yaw))) for yaw in off} <= {-35, 0, 35, 180, -180}
    assert (off.abs() < 0.1).sum() > 4


def test_going_backwards_must_fit_better(body, starter):
    """By the cosine: nothing for the way somebody walks, all of the penalty for the other."""
    pose = standing(body).repeat(3, 1)
    pose[:, 3] = torch.tensor([0.5, 0.5 + torch.pi / 2, 0.5 + torch.pi])
    view = see(body, standing(body), num=60)
    found = starter.registrar(view.observation(), standing(body).repeat(3, 1), body.default_size(1))
    found = replace(found, pose=pose)
    costs = starter.score(found, walking=0.5) - starter.score(found)
    penalty = starter.config.walk.backwards_penalty
    assert_close(costs, torch.tensor([0.0, penalty / 2, penalty]), atol=1e-4, rtol=0)


def offsets(body, pose):
    """From joint to joint along each limb, m, by name."""
    joints = dict(zip(body.joint_names, body(pose).joints[0], strict=True))
    chain = {
        "upper_arm": ("shoulder", "elbow"),
        "forearm": ("elbow", "wrist"),
        "thigh": ("hip", "knee"),
        "shank": ("knee", "ankle"),
    }
    return {
        f"{limb}_{side}": joints[f"{last}_{side}"] - joints[f"{first}_{side}"]
        for limb, (first, last) in chain.items()
        for side in ("left", "right")
    }


def test_the_other_side_of_each_limb_is_its_namesake(body):
    names = body.body_names[1:]
    found = {name: names[k] for name, k in zip(names, other_side(body), strict=True)}
    assert found == {
        "head": "head",
        **{f"{limb}_left": f"{limb}_right" for limb in ("upper_arm", "forearm", "thigh", "shank")},
        **{f"{limb}_right": f"{limb}_left" for limb in ("upper_arm", "forearm", "thigh", "shank")},
    }


@pytest.mark.parametrize("yaw", [0.5, -1.2])
def test_who_turns_a_little_takes_the_limbs_along(body, yaw):
    """Every joint goes round the vertical through the hips: x' = x cos + z sin, z' = z cos - x sin."""
    pose = standing(body, limbs(body, **WAVE), yaw=0.3, x=0.4)
    found = turned_by(body, pose, torch.tensor([yaw]), body.default_size(1))
    before, after = (body(one).joints[0] - one[0, :3] for one in (pose, found))
    x, y, z = before.unbind(1)
    c, s = math.cos(yaw), math.sin(yaw)
    assert_close(after, torch.stack([c * x + s * z, y, c * z - s * x], 1), atol=1e-5, rtol=0)


@pytest.mark.parametrize("yaw", [math.pi, -2.6])
def test_who_faces_the_other_way_has_the_limbs_where_they_were_as_those_of_the_other_side(body, yaw):
    pose = standing(body, limbs(body, **T_POSE), yaw=0.2)
    found = turned_by(body, pose, torch.tensor([yaw]), body.default_size(1))
    assert_close(found[0, 3], pose[0, 3] + yaw)
    before, after = offsets(body, pose), offsets(body, found)
    for name in ("upper_arm", "forearm"):  # the knee of a relaxed leg does not bend the other way
        assert_close(after[f"{name}_left"], before[f"{name}_right"], atol=2e-3, rtol=0)
        assert_close(after[f"{name}_right"], before[f"{name}_left"], atol=2e-3, rtol=0)


def test_several_are_turned_as_each_alone(body):
    poses = torch.cat([standing(body, limbs(body, **WAVE)), standing(body, limbs(body, **UP), yaw=1.0)])
    yaw, size = torch.tensor([0.4, 3.0]), body.default_size(1)
    both = turned_by(body, poses, yaw, size)
    for k in (0, 1):
        assert_close(both[k : k + 1], turned_by(body, poses[k : k + 1], yaw[k : k + 1], size))


def test_the_best_few_that_differ_are_those_taken_one_after_another(body):
    starter = Starter(body, StartConfig(finalists=3, finalists_apart=0.2), RegistrationConfig())
    generator = torch.Generator().manual_seed(0)
    rank = torch.rand(5, 9, generator=generator)
    rank[3, 2:] = torch.inf  # two poses alone have a score,
    rank[4] = torch.inf  # and in the last frame none
    pose = torch.zeros(5, 9, 24)
    pose[..., 6:] = 0.3 * torch.randint(3, (5, 9, 18), generator=generator) * (torch.arange(18) == 7)
    pose[..., :3] = torch.randn(5, 9, 3, generator=generator)  # the place tells none apart,
    pose[..., 3] = 2 * torch.pi * torch.randint(-1, 2, (5, 9), generator=generator)  # and no whole turn,
    pose[1, ::2, 3] += torch.pi  # but the way that somebody faces
    best, there = starter._different(rank, pose)
    for b in range(4):
        taken = []
        for k in rank[b].argsort().tolist():
            turns = [(pose[b, k, 3:] - pose[b, j, 3:]) / (2 * torch.pi) for j in taken]
            new = all(bool((turn - turn.round()).abs().max() >= 0.2 / (2 * torch.pi)) for turn in turns)
            if new and rank[b, k] < torch.inf and len(taken) < 3:
                taken.append(k)
        assert best[b, there[b]].tolist() == taken
    assert there[4].tolist() == [True, False, False]


def test_finalists_are_different_poses(body, starter, monkeypatch):
    """What the labels of few points rank first is not the same place four times."""
    fitted, fit = [], Starter._fit

    def watched(registrar, observation, frame, starts, size, prior, rounds, sigma=None, covariance=False):
        if covariance:
            fitted.append(starts)
        return fit(registrar, observation, frame, starts, size, prior, rounds, sigma, covariance)

    monkeypatch.setattr(Starter, "_fit", staticmethod(watched))
    pose = standing(body, limbs(body, **WAVE))
    starter.refresh(see(body, pose, num=200).observation(), standing(body), body.default_size(1))
    (finalists,) = fitted
    gaps = (finalists[:, None, 3:] - finalists[:, 3:]).abs().amax(2)
    assert 1 < len(finalists) <= starter.config.finalists
    assert (gaps + torch.eye(len(gaps)) >= starter.config.finalists_apart).all()


@pytest.mark.parametrize(
    ("arms", "yaw"),
    [(GUARD, 0.0), (T_POSE, 0.8), (GUARD, 1.4)],
    ids=["guard", "arms out", "guard in profile"],
)
def test_a_trunk_that_leans_with_both_arms_in_wrong_places_is_put_right(body, starter, arms, yaw):
    """By 17 degrees to the side and 11 forwards, where no limb alone has a better place; searched by limbs alone the
    worst joint is 16 to 65 cm off."""
    true = standing(body, limbs(body, **arms), yaw=yaw)
    start = standing(body, yaw=yaw)
    start[:, 4:6] += torch.tensor([0.2, 0.3])
    found = starter.refresh(see(body, true, num=250).observation(), start, body.default_size(1))
    assert (body(found.pose).joints - body(true).joints).norm(dim=-1).max() < 0.03
