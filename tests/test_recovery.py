"""The benchmark of recovery: wrong poses are as wrong as stated, and what is counted is right."""

import json
import math
from pathlib import Path

import pytest
import torch
from torch import nn

import benchmarks.recovery as recovery
from benchmarks.recovery import Bench, Trial, is_right, main, plain, tally, turn_all, turn_limbs
from benchmarks.simulated import Take, simulate
from torchpose.body.model import BodyModel
from torchpose.cli import load_config
from torchpose.pipeline import FramePose
from torchpose.recording import Frame
from torchpose.registration.vem import Registration, RegistrationConfig
from torchpose.synthesis.motion import random_stream
from torchpose.tracking.tracker import TrackStatus

BODY = BodyModel()
JOINT = {name: i for i, name in enumerate(BODY.joint_names)}
CONFIG = load_config("infer", ["pose.size.rounds=0"])


@pytest.fixture(scope="module")
def take() -> Take:
    return simulate("free", 0, 6)


def in_parent(pose: torch.Tensor) -> dict[str, torch.Tensor]:
    """Each limb's unit direction in its parent body's frame, from where the joints are."""
    posed = BODY(pose)
    at = {name: posed.joints[:, i] for name, i in JOINT.items()}
    rotation = dict(zip(BODY.body_names, posed.rotations.unbind(1), strict=True))
    limbs = {}
    for side in ("left", "right"):
        for upper, lower, joints in (
            ("upper_arm", "forearm", ("shoulder", "elbow", "wrist")),
            ("thigh", "shank", ("hip", "knee", "ankle")),
        ):
            first, middle, last = (at[f"{joint}_{side}"] for joint in joints)
            limbs[f"{upper}_{side}"] = rotation["torso"].mT @ (middle - first)[..., None]
            limbs[f"{lower}_{side}"] = rotation[f"{upper}_{side}"].mT @ (last - middle)[..., None]
    return {name: nn.functional.normalize(limb[..., 0], dim=-1) for name, limb in limbs.items()}


@pytest.mark.parametrize("degrees", [15.0, 45.0, math.degrees(0.9)])
def test_every_limb_is_turned_by_the_angle_against_its_parent(take: Take, degrees: float):
    angle = math.radians(degrees)
    turned = turn_limbs(BODY, take.pose, angle, random_stream("turn"))
    assert torch.equal(turned[:, :6], take.pose[:, :6])
    assert (turned[:, 6:] >= BODY.low[6:]).all()
    assert (turned[:, 6:] <= BODY.high[6:]).all()
    before, after = in_parent(take.pose), in_parent(turned)
    for name, limb in before.items():
        found = (limb * after[name]).sum(-1).clamp(-1, 1).acos()
        torch.testing.assert_close(found, torch.full_like(found, angle), atol=2e-3, rtol=0, msg=name)
    # Directions are drawn anew for every joint and pose.
    ways = torch.stack([after[name] - before[name] for name in before]).flatten(0, 1)
    assert nn.functional.normalize(ways.mean(0), dim=0).isfinite().all()
    # Hinges do not reach to every side.
    assert ways.mean(0).norm() < 0.6 * ways.norm(dim=-1).mean()


def test_a_joint_at_its_stop_is_turned_away_from_it():
    straight = torch.cat([torch.zeros(8, 6), BODY.rest.expand(8, -1)], 1)
    knees = [i for i, name in enumerate(BODY.parameter_names) if name.startswith("shank")]
    straight[:, knees] = torch.maximum(torch.zeros(8, len(knees)), BODY.low[knees])
    turned = turn_limbs(BODY, straight, math.radians(45), random_stream("stop"))
    before, after = in_parent(straight), in_parent(turned)
    for side in ("left", "right"):
        found = (before[f"shank_{side}"] * after[f"shank_{side}"]).sum(-1).acos()
        torch.testing.assert_close(found, torch.full_like(found, math.pi / 4), atol=2e-3, rtol=0)
        assert (after[f"shank_{side}"][:, 2] > -math.sin(math.radians(8.1))).all()  # knees bend backward


def test_the_root_is_turned_and_shifted_in_proportion(take: Take):
    for degrees in (15.0, 45.0):
        off = (
            turn_all(BODY, take.pose, math.radians(degrees), random_stream("root"))[:, :6] - take.pose[:, :6]
        )
        expected = torch.full((len(off),), math.radians(degrees))
        torch.testing.assert_close(off[:, :3].norm(dim=1), 0.2 * expected)
        torch.testing.assert_close(off[:, 3:].norm(dim=1), 0.5 * expected)


def test_a_pose_is_right_by_mean_distance_and_by_each_limb(take: Take):
    truth = take.joints[:1]
    assert is_right(truth, truth).tolist() == [True]
    assert is_right(truth + torch.tensor([0.079, 0.0, 0.0]), truth).tolist() == [True]
    assert is_right(truth + torch.tensor([0.0, 0.081, 0.0]), truth).tolist() == [False]
    assert is_right(truth * torch.nan, truth).tolist() == [False]
    for degrees, right in ((29.0, True), (31.0, False)):
        bent = truth.clone()
        elbow, wrist = (JOINT[f"{name}_left"] for name in ("elbow", "wrist"))
        arm = nn.functional.normalize(bent[0, wrist] - bent[0, elbow], dim=0)
        aside = nn.functional.normalize(torch.linalg.cross(arm, torch.tensor([0.3, 0.5, 0.8])), dim=0)
        angle = math.radians(degrees)
        bent[0, wrist] = bent[0, elbow] + 0.25 * (math.cos(angle) * arm + math.sin(angle) * aside)
        assert is_right(bent, truth).tolist() == [right]


def test_plain_em_has_none_of_the_corrections_and_all_else():
    config = plain(RegistrationConfig())
    assert (config.visible, config.robust_sd, config.rim.weight, config.fitting.limit_sd) == (False, 0, 0, 0)
    assert config.rounds == RegistrationConfig().rounds
    assert config.labelling == RegistrationConfig().labelling
    assert config.rim.sd == RegistrationConfig().rim.sd


class Knows(nn.Module):
    """Stands in for starter and registrar: it answers with a pose of its own."""

    def __init__(self, pose: torch.Tensor, misfit: float):
        super().__init__()
        self.pose, self.misfit = pose, misfit

    def forward(self, *_: object) -> Registration:
        P = self.pose.shape[1]
        return Registration(
            pose=self.pose,
            covariance=torch.eye(P)[None],
            belief=torch.zeros(1, 15, 1),
            distance=torch.zeros(1, 1),
            point_to_model=torch.zeros(1),
            misfit=torch.full((1,), self.misfit),
            score=torch.full((1,), 1000 * self.misfit),
            bound=torch.zeros(1, 1),
            status=torch.zeros(1, dtype=torch.long),
        )


def test_a_perfect_registration_recovers_all_and_a_wrong_one_is_counted(take: Take):
    bench = Bench(take, CONFIG)
    bench.model.size = take.size
    wrong = turn_all(BODY, take.pose[2:3], math.radians(45), random_stream("wrong"))
    rows = {
        "right": bench.registrations("right", Knows(take.pose[2:3], 0.01), wrong, [2]),
        "right, doubted": bench.registrations("right", Knows(take.pose[2:3], 10.0), wrong, [2]),
        "wrong": bench.registrations("wrong", Knows(wrong, 0.01), wrong, [2]),
        "wrong, known": bench.registrations("wrong", Knows(wrong, 10.0), wrong, [2]),
    }
    told = {
        name: tuple(tally(trials)[key] for key in ("at_once", "recovered", "known", "alarms"))
        for name, trials in rows.items()
    }
    nan = pytest.approx(math.nan, nan_ok=True)
    assert told["right"] == (1, 1, nan, 0)
    assert told["right, doubted"] == (1, 1, nan, 1)
    assert told["wrong"] == (0, 0, 0, nan)
    assert told["wrong, known"] == (0, 0, 1, nan)
    # The starter is asked with the face and without it.
    bench.model.tracker.starter = Knows(take.pose[2:3], 0.01)
    assert bench.starts("face", False, [2])[0].right == (True,)
    assert bench.starts("no face", True, [2])[0].right == (True,)


def test_the_tracker_is_followed_until_its_pose_is_right(take: Take):
    bench = Bench(take, CONFIG)
    trials = bench.tracked("15 degrees, tracker", take.pose[1:2], [2])
    assert len(trials) == 1
    assert trials[0].right == (True,)
    assert trials[0].status in (("tracked",), ("recovered",))


def test_a_tracker_that_is_lost_at_first_gets_more_frames(take: Take, monkeypatch: pytest.MonkeyPatch):
    bench = Bench(take, CONFIG)
    bench.model.size = take.size
    away = take.pose + torch.tensor([0.3] + 23 * [0.0])
    answers = {
        1: (TrackStatus.tracked, Knows(away[1:2], 0.01)),
        2: (TrackStatus.lost, None),
        3: (TrackStatus.recovered, Knows(take.pose[3:4], 0.01)),
    }

    def follow(frame: Frame) -> FramePose:
        status, fit = answers[frame.index]
        return FramePose(frame.index, frame.time_s, status, None if fit is None else fit(), None)

    monkeypatch.setattr(bench.model, "follow", follow)
    (trial,) = bench.tracked("45 degrees, tracker", take.pose[1:2], [1])
    assert trial.right == (False, False, True)
    assert trial.doubted == (False, True, True)
    assert trial.status == ("tracked", "lost", "recovered")
    figures = tally([trial])
    assert (figures["at_once"], figures["recovered"], figures["frames"], figures["known"]) == (0, 1, 3, 0.5)


def test_another_body_takes_the_same_pose(take: Take):
    bench = Bench(take, load_config("infer", ["pose.size.rounds=0", "pose.body.joint=revolute"]))
    own = bench.own(take.pose)
    assert (own[:, 6:] - take.pose[:, 6:]).abs().max() > 0.1  # other parameters
    joints = bench.model.body(own, take.size).joints
    assert (joints - take.joints).norm(
        dim=-1
    ).max() < 0.02  # a hinge may stop before the direction is reached


def test_shares_and_frames_are_counted():
    lost = Trial("25 degrees, tracker", (False, False), (True, False), ("lost", "tracked"))
    late = Trial(
        "25 degrees, tracker", (False, False, True), (True, True, True), ("lost",) * 2 + ("recovered",)
    )
    once = Trial("25 degrees, tracker", (True,), (False,), ("tracked",))
    figures = tally([lost, late, once])
    assert figures["trials"] == 3
    assert figures["at_once"] == pytest.approx(1 / 3)
    assert figures["recovered"] == pytest.approx(2 / 3)
    assert figures["frames"] == 2  # 3 and 1
    assert figures["known"] == pytest.approx(3 / 4)
    assert math.isnan(figures["alarms"])  # to be found anew is no alarm after a loss
    quiet = [Trial("undisturbed", (True,), (flag,)) for flag in (False, False, False, True)]
    assert tally(quiet)["alarms"] == 0.25
    assert math.isnan(tally(quiet)["known"])
    never = tally([Trial("15 degrees, plain EM", (False,), (False,))])
    assert math.isnan(never["frames"])
    assert never["recovered"] == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "flying"], "--only must be part of one of arms"),
        (["--starts", "0"], "--starts must be at least 1, got 0"),
    ],
)
def test_bad_arguments_are_refused(arguments: list[str], message: str, capsys):
    with pytest.raises(SystemExit):
        main(arguments)
    assert message in capsys.readouterr().err


def test_the_benchmark_runs_and_writes_its_figures(tmp_path: Path, capsys, monkeypatch):
    for name, value in {"FRAMES": 5, "KICKED": 2, "PATIENCE": 2, "ANGLES": (15.0,)}.items():
        monkeypatch.setattr(recovery, name, value)
    file = tmp_path / "figures.json"
    small = [
        "pose.size.rounds=0",
        "eyes.sampling.num_points=150",
        "pose.start.points=100",
        "pose.start.rounds=1",
    ]
    main(["--starts", "1", "--only", "knee", "--json", str(file), *small])
    printed = capsys.readouterr().out
    written = json.loads(file.read_text())
    kinds = ("plain EM", "registrar", "tracker")
    rows = ["nothing known, face", "nothing known, no face", *(f"15 degrees, {kind}" for kind in kinds)]
    assert list(written["table"]) == [*rows, "kick of 0.9 rad, tracker", "undisturbed"]
    for row, figures in written["table"].items():
        assert row in printed
        assert figures["trials"] == 1
        assert 0 <= figures["at_once"] <= figures["recovered"] <= 1
