"""The life of a track: by scripted registrations its statuses and memory, by synthetic views the whole of it."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from synthetic_cloud import RELAXED, see, standing
from torch.testing import assert_close

from torchpose.body.model import BodyModel
from torchpose.cli import load_config
from torchpose.least_squares import Status
from torchpose.registration.start import StartConfig, Starter
from torchpose.registration.vem import Registrar, Registration, RegistrationConfig
from torchpose.tracking.tracker import (
    ANSWERED,
    Sought,
    Tracker,
    TrackingConfig,
    TrackStatus,
    track_together,
)

CONFIG = TrackingConfig()
GOOD, BAD = 0.01, 1.0  # m of misfit


@pytest.fixture(scope="module")
def body():
    return BodyModel()


@pytest.fixture(scope="module")
def view(body):
    return see(body, standing(body), num=60)


def registration(pose, misfit=GOOD, stray=0.0, status=Status.CONVERGED, score=None):
    """Registrations of these poses, of whose 100 points a share is of no part."""
    B, P = pose.shape
    distance = torch.full((B, 100), 0.005)
    belief = torch.full((B, 15, 100), (1 - stray) / 14)
    belief[:, -1] = stray
    level = torch.full((B,), misfit)
    return Registration(
        pose,
        torch.eye(P).expand(B, P, P),
        belief,
        distance,
        distance.mean(1),
        level,
        1000 * level if score is None else torch.full((B,), score),
        torch.zeros(1, B),
        torch.full((B,), int(status)),
    )


class ScriptedRegistrar(Registrar):
    """Answers every start with `pose` (None: the start itself) and `misfit`, and remembers what it was asked."""

    def __init__(self, body):
        super().__init__(body)
        self.pose, self.misfit, self.stray, self.starts, self.prior = None, GOOD, 0.0, None, None

    def forward(self, observation, start, size, prior=None, rounds=None, sigma_first=None, covariance=True):
        self.starts, self.prior = start, prior
        pose = start if self.pose is None else self.pose.expand_as(start)
        return registration(pose, self.misfit, self.stray)


class ScriptedStarter(Starter):
    def __init__(self, body):
        super().__init__(body, StartConfig(), RegistrationConfig())
        self.pose, self.misfit, self.refreshed, self.status = None, GOOD, None, Status.CONVERGED
        self.calls, self.prior = [], None

    def forward(self, observation, faces, size, walking=None):
        self.calls.append("cold")
        return registration(self.pose, self.misfit, status=self.status)

    def refresh(self, observation, pose, size, prior=None, walking=None):
        self.calls.append("refresh")
        self.prior = prior
        return registration(pose, BAD) if self.refreshed is None else self.refreshed


@pytest.fixture
def scripted(body):
    registrar, starter = ScriptedRegistrar(body), ScriptedStarter(body)
    starter.pose = standing(body)
    return Tracker(body, CONFIG, registrar, starter), registrar, starter


@pytest.fixture
def step(body, view):
    def advance(tracker, time_s, present=True, cut=False):
        observation, faces = (view.observation(), view.no_face()) if present else (None, None)
        frame = tracker(time_s, observation, faces, body.default_size(1), cut)
        assert (frame.registration is not None) == (frame.status in ANSWERED)
        return frame

    return advance


def test_a_life(scripted, step):
    """Nobody, somebody unclear, tracked, lost, found anew, gone, back."""
    tracker, registrar, starter = scripted
    assert step(tracker, 0.0, present=False).status is TrackStatus.absent
    starter.misfit = BAD
    assert step(tracker, 0.05).status is TrackStatus.entering
    starter.misfit = GOOD
    later = 0.06 + CONFIG.retry  # a search in vain is not repeated at once
    assert step(tracker, later).status is TrackStatus.tracked
    assert step(tracker, later + 0.05).status is TrackStatus.tracked
    registrar.misfit = starter.misfit = BAD
    assert step(tracker, later + 0.1).status is TrackStatus.lost
    starter.misfit = GOOD
    assert step(tracker, later + 0.15).status is TrackStatus.recovered
    registrar.misfit = GOOD
    assert step(tracker, later + 0.2).status is TrackStatus.tracked
    assert step(tracker, later + 0.25, present=False).status is TrackStatus.absent
    assert step(tracker, later + 0.3).status is TrackStatus.tracked


def test_a_cold_start_in_vain_is_not_repeated_at_once(scripted, step):
    tracker, _, starter = scripted
    starter.misfit = BAD
    for time_s in (0.0, 0.4 * CONFIG.retry, 0.9 * CONFIG.retry, 1.1 * CONFIG.retry):
        assert step(tracker, time_s).status is TrackStatus.entering
    assert starter.calls == ["cold", "cold"]


def test_a_person_cut_by_the_border_is_partial(scripted, step):
    tracker, _, _ = scripted
    assert step(tracker, 0.0, cut=True).status is TrackStatus.partial
    assert step(tracker, 0.1, cut=True).status is TrackStatus.partial
    assert step(tracker, 0.2).status is TrackStatus.tracked


def test_the_next_frame_starts_from_the_prediction_and_from_the_last_pose(scripted, step, body):
    tracker, registrar, _ = scripted
    step(tracker, 0.0)
    first = standing(body)
    step(tracker, 0.1)
    assert_close(registrar.starts, first.expand(2, -1))  # no velocity yet
    registrar.pose = first + 0.02
    step(tracker, 0.2)  # moves by 0.02 in 0.1 s
    step(tracker, 0.5)  # 0.3 s later
    predicted = first + 0.02 + CONFIG.velocity * 0.2 * 0.3
    assert_close(registrar.starts, torch.cat([predicted, first + 0.02]))
    assert_close(registrar.prior.mean, predicted.expand(2, -1))
    sd = registrar.prior.precision.rsqrt()[0]
    assert_close(sd[:6], torch.full((6,), CONFIG.root_speed_sd * 0.3))
    assert_close(sd[6:], torch.full((18,), CONFIG.joint_speed_sd * 0.3))


def test_identical_times_do_not_divide_by_zero(scripted, step):
    tracker, registrar, _ = scripted
    for _ in range(3):
        frame = step(tracker, 1.0)
        assert frame.status is TrackStatus.tracked
    assert registrar.starts.isfinite().all()
    assert registrar.prior.precision.isfinite().all()


def test_after_a_recovery_there_is_no_velocity(scripted, step, body):
    """The way from the last pose to where the person was found anew is no motion."""
    tracker, registrar, starter = scripted
    step(tracker, 0.0)
    step(tracker, 0.05)
    registrar.misfit = BAD
    starter.pose = standing(body, x=1.0)
    assert step(tracker, 0.1).status is TrackStatus.recovered
    registrar.misfit = GOOD
    step(tracker, 0.15)
    assert_close(registrar.starts, starter.pose.expand(2, -1))


def test_joints_that_a_search_moved_far_have_no_velocity(scripted, step, body):
    """All others have theirs, and so has the root, however far it went."""
    tracker, registrar, starter = scripted
    step(tracker, 0.0)
    registrar.pose, registrar.stray = standing(body) + 0.02, 2 * CONFIG.stray_share
    found = standing(body) + 0.05
    elbow, hip = 9, 20
    found[0, [elbow, hip]] += torch.tensor([1.1 * CONFIG.jump, 0.8 * CONFIG.jump])
    found[0, 0] += 1.0
    starter.refreshed = registration(found, misfit=GOOD / 2)
    step(tracker, 0.1)
    assert starter.calls[-1] == "refresh"
    step(tracker, 0.2)
    velocity = (found - standing(body)) / 0.1
    velocity[0, elbow] = 0
    assert_close(registrar.starts[:1], found + CONFIG.velocity * 0.1 * velocity)


def test_predictions_stay_within_the_limits_of_joints(scripted, step, body):
    tracker, registrar, _ = scripted
    step(tracker, 0.0)
    knee = body.parameter_names.index("shank_left_2")
    registrar.pose = standing(body)
    registrar.pose[0, knee] = body.high[knee] - 0.1
    registrar.pose[0, :6] += 1.0
    step(tracker, 0.1)
    step(tracker, 0.2)
    moved = registrar.pose + CONFIG.velocity * (registrar.pose - standing(body))
    assert moved[0, knee] > body.high[knee] + 1
    moved[0, knee] = body.high[knee]
    assert_close(registrar.starts[:1], moved)


def test_a_lost_person_is_remembered_for_a_while_and_then_forgotten(scripted, step):
    tracker, registrar, starter = scripted
    step(tracker, 0.0)
    calls = len(starter.calls)
    assert step(tracker, CONFIG.memory - 0.1).status is TrackStatus.tracked
    assert starter.calls[calls:] == ["refresh"]  # followed, not searched for from nothing
    step(tracker, 2 * CONFIG.memory + 0.1)
    assert starter.calls[calls + 1 :] == ["cold"]
    registrar.misfit = starter.misfit = BAD
    assert step(tracker, 2 * CONFIG.memory + 0.2).status is TrackStatus.lost
    # Lost frames do not prolong the memory.
    assert step(tracker, 3 * CONFIG.memory + 0.3).status is TrackStatus.entering


def test_stray_points_have_the_limbs_sought(scripted, step, body):
    tracker, registrar, starter = scripted
    step(tracker, 0.0)
    registrar.stray = 2 * CONFIG.stray_share
    better = registration(standing(body) + 0.01, misfit=GOOD / 2)
    starter.refreshed = better
    frame = step(tracker, 0.1)
    assert starter.calls[-1] == "refresh"
    assert_close(frame.registration.score, better.score)
    starter.refreshed = registration(standing(body) + 0.01, misfit=2 * GOOD, stray=2 * CONFIG.stray_share)
    frame = step(tracker, 0.2)
    assert frame.registration.misfit == GOOD  # what does not fit better is not taken


def test_limbs_are_sought_again_and_again_though_nothing_seems_wrong(scripted, step):
    tracker, _, starter = scripted
    step(tracker, 0.0)
    step(tracker, 0.05)
    assert starter.calls == ["cold", "refresh"]
    gap = CONFIG.look_around
    for time_s, count in (
        (0.05 + 0.5 * gap, 1),
        (0.05 + 0.9 * gap, 1),
        (0.06 + gap, 2),
        (0.06 + 1.5 * gap, 2),
    ):
        step(tracker, time_s)
        assert starter.calls == ["cold"] + count * ["refresh"]


def test_an_answer_is_judged_by_its_score_not_by_its_misfit(scripted, step, body):
    tracker, registrar, starter = scripted
    step(tracker, 0.0)
    registrar.stray = 2 * CONFIG.stray_share
    worse = registration(standing(body) + 0.01, misfit=GOOD / 2, score=1000 * GOOD + 1)
    starter.refreshed = worse
    assert step(tracker, 0.1).registration.misfit == GOOD
    better = registration(standing(body) + 0.01, misfit=2 * GOOD, score=1000 * GOOD - 1)
    starter.refreshed = better
    assert_close(step(tracker, 0.1 + 2 * CONFIG.look_around).registration.score, better.score)
    starter.refreshed = replace(better, score=torch.tensor([torch.nan]))
    assert step(tracker, 0.1 + 4 * CONFIG.look_around).registration.misfit == GOOD


def test_limbs_are_sought_within_a_looser_prediction(scripted, step):
    tracker, registrar, starter = scripted
    step(tracker, 0.0)
    step(tracker, 0.1)
    assert_close(starter.prior.mean, registrar.prior.mean[:1])
    assert_close(starter.prior.precision.rsqrt(), CONFIG.search_slack * registrar.prior.precision[:1].rsqrt())


def test_points_that_stay_without_a_part_are_sought_for_once(scripted, step):
    """A bag: it strays after the search, too, and only half as much again is a reason for another one."""
    tracker, registrar, starter = scripted
    step(tracker, 0.0)
    times = iter(0.01 * i for i in range(1, 100))  # well within `look_around`
    step(tracker, next(times))
    assert starter.calls.count("refresh") == 1
    for stray, searches in ((0.1, 2), (0.1, 2), (0.14, 2), (0.16, 3), (0.2, 3), (0.01, 3), (0.1, 4)):
        registrar.stray = stray
        step(tracker, next(times))
        assert starter.calls.count("refresh") == searches, stray


def test_where_many_points_stray_after_the_limbs_were_sought_all_of_the_body_is(scripted, step, body):
    """Taken where it fits better; what strays on (a bag) is no reason for more, but half as much again is."""
    tracker, registrar, starter = scripted
    step(tracker, 0.0)
    registrar.stray = 0.9 * CONFIG.doubt
    step(tracker, 1.0)
    assert starter.calls == ["cold", "refresh"]
    registrar.stray, starter.misfit = 1.1 * CONFIG.doubt, 2 * GOOD
    assert step(tracker, 2.0).status is TrackStatus.tracked
    assert starter.calls == ["cold", "refresh", "refresh", "cold"]
    again = Tracker(body, CONFIG, registrar, starter)
    again.restore(tracker.state())
    for one in (tracker, again):
        starter.calls.clear()
        for time_s, stray, colds in (
            (3.0, 1.5, 0),
            (4.0, 1.8, 1),
            (4.1, 3.0, 1),
            (5.0, 3.0, 2),
            (6.0, 0.1, 2),
        ):
            registrar.stray = stray * CONFIG.doubt
            assert step(one, time_s).status is TrackStatus.tracked
            assert starter.calls.count("cold") == colds, (time_s, stray)
    starter.pose, starter.misfit = standing(body, x=0.5), GOOD / 2
    registrar.stray = 1.1 * CONFIG.doubt
    frame = step(tracker, 7.0)
    assert frame.status is TrackStatus.recovered
    assert_close(frame.registration.pose, starter.pose)
    step(tracker, 7.1)
    assert_close(registrar.starts, starter.pose.expand(2, -1))  # the jump is no velocity


def test_a_fit_that_is_not_acceptable_has_the_limbs_sought_before_a_cold_start(scripted, step, body):
    tracker, registrar, starter = scripted
    step(tracker, 0.0)
    step(tracker, 0.01)
    registrar.misfit = BAD
    starter.refreshed = registration(standing(body) + 0.01)
    assert step(tracker, 0.02).status is TrackStatus.tracked
    assert starter.calls == ["cold", "refresh", "refresh"]
    starter.refreshed = None
    assert step(tracker, 0.03).status is TrackStatus.recovered
    assert starter.calls[3:] == ["refresh", "cold"]


def test_of_prediction_and_last_pose_the_better_score_is_kept(scripted, step, body):
    tracker, registrar, _ = scripted
    step(tracker, 0.0)
    step(tracker, 0.01)
    for scores, best in (([2.0, 1.0], 1), ([1.0, 2.0], 0), ([torch.nan, 5.0], 1)):
        both = registration(torch.cat([standing(body), standing(body, x=0.01)]))
        both = replace(both, score=torch.tensor(scores), misfit=torch.tensor([0.02, 0.03]))
        registrar.forward = lambda *_, both=both: both
        frame = step(tracker, tracker.state()["time"].item() + 0.01)
        assert torch.equal(frame.registration.pose, both.pose[best : best + 1])


def test_an_answer_that_is_not_finite_is_none(scripted, step, body):
    tracker, _, starter = scripted
    starter.status = Status.NON_FINITE
    assert step(tracker, 0.0).status is TrackStatus.entering
    starter.status, starter.pose = Status.CONVERGED, torch.full((1, 24), torch.nan)
    assert step(tracker, 2 * CONFIG.retry).status is TrackStatus.entering


def test_forgetting_starts_over_and_begin_takes_a_known_pose(scripted, step, body):
    tracker, registrar, starter = scripted
    step(tracker, 0.0)
    tracker.forget()
    step(tracker, 0.1)
    assert starter.calls == ["cold", "cold"]
    tracker.begin(standing(body, x=0.3), 0.2)
    step(tracker, 0.25)
    assert starter.calls == ["cold", "cold", "refresh"]  # of a pose that was given no limb has been sought
    assert_close(registrar.starts, standing(body, x=0.3).expand(2, -1))


def test_a_restored_track_goes_on_as_if_never_stopped(scripted, step, body):
    tracker, registrar, starter = scripted
    step(tracker, 0.0)
    registrar.pose = standing(body) + 0.02
    step(tracker, 0.1)
    other = Tracker(body, CONFIG, registrar, starter)
    other.restore(tracker.state())
    step(tracker, 0.2)
    expected, calls = registrar.starts, list(starter.calls)
    step(other, 0.2)
    assert_close(registrar.starts, expected)
    assert starter.calls == calls  # limbs were sought a moment ago, which is remembered
    other.forget()
    assert other.state() == {}
    other.restore({})
    assert step(other, 0.3, present=False).status is TrackStatus.absent


def test_a_restored_search_in_vain_is_not_repeated_at_once(scripted, step, body):
    tracker, registrar, starter = scripted
    starter.misfit = BAD
    step(tracker, 0.0)
    other = Tracker(body, CONFIG, registrar, starter)
    other.restore(tracker.state())
    step(other, 0.5 * CONFIG.retry)
    assert starter.calls == ["cold"]
    step(other, 1.1 * CONFIG.retry)
    assert starter.calls == ["cold", "cold"]


def moving(body, t):
    """The left arm rises to the side by 100 degrees a second while the person steps sideways."""
    directions = RELAXED.clone()
    angle = torch.tensor(0.3 + 1.75 * t)
    aim = torch.stack([angle.sin(), angle.cos(), torch.tensor(-0.1)])
    directions[1], directions[2] = aim, aim
    return standing(body, directions, x=0.3 * t)


def test_a_moving_person_is_followed(body):
    """Synthetic views at 20 frames a second, from nothing, with one empty frame and one of two thirds of a second."""
    registration = RegistrationConfig()
    tracker = Tracker(body, CONFIG, Registrar(body, registration), Starter(body, StartConfig(), registration))
    size = body.default_size(1)
    statuses, errors = [], []
    for t in (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.9, 0.95):
        pose = moving(body, t)
        seen = see(body, pose, num=200, noise=0.003, generator=torch.Generator().manual_seed(0))
        there = t != 0.15
        frame = tracker(t, seen.observation() if there else None, seen.no_face() if there else None, size)
        statuses.append(frame.status)
        if frame.registration is not None:
            errors.append((body(frame.registration.pose).joints - body(pose).joints).norm(dim=-1))
    assert statuses[3] is TrackStatus.absent
    assert all(status in ANSWERED for i, status in enumerate(statuses) if i != 3)
    assert statuses[0] is TrackStatus.tracked
    assert torch.cat(errors).mean(1).max() < 0.04  # m, in the worst frame


def test_an_identical_frame_has_the_identical_pose(body):
    registration = RegistrationConfig()
    tracker = Tracker(body, CONFIG, Registrar(body, registration), Starter(body, StartConfig(), registration))
    seen = see(body, standing(body), num=200)
    frames = []
    tracker.begin(standing(body), 0.0)
    for i in range(1, 6):
        frame = tracker(0.05 * i, seen.observation(), seen.no_face(), body.default_size(1))
        frames.append(body(frame.registration.pose).joints)
    assert (frames[-1] - frames[-2]).norm(dim=-1).max() < 0.002  # m: it does not wander


@pytest.mark.parametrize("second", [0.0, 0.1])
def test_two_together_are_followed_as_each_alone(body, second):
    """One comes `second` s later than the other, so that limbs are sought for both at once, or for one at a time."""
    registration = RegistrationConfig()
    registrar, starter = Registrar(body, registration), Starter(body, StartConfig(), registration)
    sizes = [body.size_of_height(1.7), body.size_of_height(1.85)]

    def place(k, t):
        return moving(body, t) + torch.tensor([0.9 * k - 0.4] + 23 * [0.0])

    def seek(tracker, k, t):
        seen, there = see(body, place(k, t), sizes[k], num=150), t >= second * k
        observation, faces = (seen.observation(), seen.no_face()) if there else (None, None)
        return Sought(tracker, t, observation, faces, sizes[k], cut=k == 1)

    together = [Tracker(body, CONFIG, registrar, starter) for _ in range(2)]
    alone = [Tracker(body, CONFIG, registrar, starter) for _ in range(2)]
    for tracker, k in zip(together + alone, (0, 1, 0, 1), strict=True):
        tracker.begin(place(k, second * k), second * k - 0.1)
    for t in (0.0, 0.1, 0.2, 0.3):
        both = track_together([seek(tracker, k, t) for k, tracker in enumerate(together)])
        for k, tracker in enumerate(alone):
            (one,) = track_together([seek(tracker, k, t)])
            assert both[k].status is one.status
            assert (one.registration is None) == (t < second * k)
            if one.registration is not None:
                assert_close(both[k].registration.pose, one.registration.pose, rtol=0, atol=2e-3)


@pytest.mark.parametrize(("ago", "joins"), [(0.2, False), (0.3, True)])
def test_limbs_that_are_sought_soon_anyway_are_sought_with_somebody_elses(body, monkeypatch, ago, joins):
    """The first has looked around long ago, the second `ago` s before: of half a second."""
    registration = RegistrationConfig()
    registrar, starter = Registrar(body, registration), Starter(body, StartConfig(), registration)
    config = replace(CONFIG, look_around=0.5, stray_share=0.9)
    size, sought = body.size_of_height(1.7), []
    refresh = starter.refresh
    monkeypatch.setattr(starter, "refresh", lambda *given: sought.append(len(given[1])) or refresh(*given))
    trackers = [Tracker(body, config, registrar, starter) for _ in range(2)]
    for tracker, looked in zip(trackers, (-9.0, -ago), strict=True):
        tracker.begin(moving(body, 0.0), -0.1)
        tracker._looked = looked
    seen = see(body, moving(body, 0.0), size, num=150)
    track_together([Sought(one, 0.0, seen.observation(), seen.no_face(), size) for one in trackers])
    assert sought == [1 + joins]
    sought.clear()
    trackers[0]._looked = trackers[1]._looked = -0.3  # due for neither: none is sought
    track_together([Sought(one, 0.1, seen.observation(), seen.no_face(), size) for one in trackers])
    assert sought == []


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"velocity": 1.5}, "velocity must be between 0 and 1, got 1.5"),
        ({"memory": 0.0}, "memory must be positive, got 0.0"),
        ({"look_around": 0.0}, "look_around must be positive, got 0.0"),
        ({"search_slack": -1.0}, "search_slack must be positive, got -1.0"),
        ({"accept_misfit": -1.0}, "accept_misfit must be positive, got -1.0"),
        ({"aside": 0.0}, "aside must be positive, got 0.0"),
        ({"doubt": 0.0}, "doubt must be positive, got 0.0"),
        ({"jump": 0.0}, "jump must be positive, got 0.0"),
        ({"profile": 1.5}, "profile must be a sine between 0 and 1, got 1.5"),
    ],
)
def test_bad_settings_are_told(setting, message):
    with pytest.raises(ValueError, match=message.replace(".", r"\.")):
        replace(CONFIG, **setting)


def test_whoever_walks_backwards_is_doubted_and_turned_if_that_fits(body, scripted, view):
    """Tried once in `retry` seconds; taken where the score with the penalty says so; a face that is seen decides."""
    tracker, registrar, starter = scripted
    observation, faces, size = view.observation(), view.no_face(), body.default_size(1)
    back, ahead = standing(body, yaw=3.0), standing(body, yaw=-0.1)
    tracker.begin(back, 0.0)
    starter.pose, registrar.pose = ahead, back
    answer = tracker(0.05, observation, faces, size, walking=-0.1)
    assert answer.status is TrackStatus.recovered
    assert_close(answer.registration.pose, ahead)

    tracker.forget()
    tracker.begin(back, 0.0)
    starter.misfit = 0.05  # 40 nats worse, more than going backwards costs
    answers = [tracker(t, observation, faces, size, walking=-0.1) for t in (0.05, 0.1, 0.15)]
    assert all(answer.status is TrackStatus.tracked for answer in answers)
    assert starter.calls.count("cold") == 2  # one for each part of this test

    tracker.forget()
    tracker.begin(back, 0.0)
    starter.misfit = GOOD
    tracker(0.05, observation, faces, size, walking=2.8)
    assert starter.calls.count("cold") == 2


def along(body, pose):
    """From joint to joint along each limb of a pose, m: (arms and legs, left and right, upper and lower, 3)."""
    joints = dict(zip(body.joint_names, body(pose).joints[0], strict=True))
    chains = ("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle")
    rows = [
        [
            torch.stack([joints[f"{b}_{side}"] - joints[f"{a}_{side}"] for a, b in pairwise(c)])
            for side in ("left", "right")
        ]
        for c in chains
    ]
    return torch.stack([torch.stack(row) for row in rows])


def test_whoever_walks_otherwise_than_expected_is_also_sought_facing_the_way(body, scripted, view):
    """Every `retry` seconds instead of the last pose; by a right angle at the most only the yaw changes."""
    tracker, registrar, _ = scripted
    observation, faces, size = view.observation(), view.no_face(), body.default_size(1)
    pose = standing(body, yaw=0.2)
    tracker.begin(pose, 0.0)
    tracker(0.1, observation, faces, size, walking=1.3)
    turned = pose.clone()
    turned[0, 3] = 1.3
    assert_close(registrar.starts, torch.cat([pose, turned]))
    registrar.starts = None
    restored = Tracker(body, CONFIG, registrar, tracker.starter)
    restored.restore(tracker.state())
    for one in (tracker, restored):
        one(0.2, observation, faces, size, walking=1.3)
        assert_close(registrar.starts[1:], pose)
    tracker(0.4, observation, faces, size, walking=1.3)
    assert_close(registrar.starts[1, 3], turned[0, 3])
    tracker.forget()
    tracker.begin(pose, 0.0)
    tracker(0.1, observation, faces, size, walking=0.3)  # as good as the way
    assert_close(registrar.starts[1:], pose)


def test_in_profile_both_sides_are_also_sought_exchanged_where_the_points_are(body, scripted, view):
    """The limbs of one side point as the other's did, and the hips are as far off as the cloud, not as expected."""
    tracker, registrar, _ = scripted
    directions = RELAXED.clone()
    directions[5] = torch.tensor([0.1, 1.0, -0.3])
    pose = standing(body, directions, yaw=1.5, z=2.7)
    profile = see(body, standing(body, directions, yaw=1.5, z=3.0), num=200)
    tracker.begin(pose, 0.0)
    noisy = replace(profile.observation(), depth_noise=0.006)
    tracker(0.1, noisy, profile.no_face(), body.default_size(1), walking=1.5)
    first, second = registrar.starts.split(1)
    assert_close(first, pose)
    assert_close(along(body, second)[:, [1, 0]], along(body, pose), atol=2e-2, rtol=0)
    assert_close(second[:, [0, 1, 3, 4, 5]], pose[:, [0, 1, 3, 4, 5]])
    assert abs(float(second[0, 2]) - 3.0) < 0.12
    tracker.forget()
    tracker.begin(pose, 0.0)
    tracker(0.1, profile.observation(), profile.no_face(), body.default_size(1), walking=1.5)
    assert_close(registrar.starts[1:], pose)  # exact depths tell the sides apart


def test_crossed_legs_are_also_sought_uncrossed(body, scripted, view):
    tracker, registrar, _ = scripted
    directions = RELAXED.clone()
    directions[5:7] = torch.tensor([[-0.25, 1.0, -0.1], [-0.1, 1.0, 0.0]])  # the left leg over to the right
    directions[7:9] = torch.tensor([[0.25, 1.0, -0.1], [0.1, 1.0, 0.0]])
    crossed = standing(body, directions)
    names = body.joint_names
    ankles = [names.index(f"ankle_{side}") for side in ("left", "right")]
    left, right = body(crossed).joints[0, ankles, 0]
    assert left < right  # the left is at the image's right where they are not crossed
    tracker.begin(crossed, 0.0)
    tracker(0.1, view.observation(), view.no_face(), body.default_size(1))
    second = registrar.starts[1:]
    arms, legs = along(body, crossed)
    assert_close(along(body, second)[0], arms, atol=1e-4, rtol=0)
    assert_close(along(body, second)[1, :, 1], legs[[1, 0], 1], atol=2e-2, rtol=0)  # shanks
    before, after = (body(one).joints[0] for one in (crossed, second))
    knees = [names.index(f"knee_{side}") for side in ("left", "right")]
    assert_close(after[knees], before[knees[::-1]], atol=2e-2, rtol=0)
    assert_close(after[ankles], before[ankles[::-1]], atol=3e-2, rtol=0)
    assert_close(second[:, :6], crossed[:, :6])


def test_the_thesis_starts_where_the_last_frame_ended_and_nowhere_else(body, scripted, view):
    """Whatever legs are crossed, however noisy depths are, and whichever way somebody walks."""
    tracker, registrar, _ = scripted
    directions = RELAXED.clone()
    directions[5:7] = torch.tensor([[-0.25, 1.0, -0.1], [-0.1, 1.0, 0.0]])
    directions[7:9] = torch.tensor([[0.25, 1.0, -0.1], [0.1, 1.0, 0.0]])
    crossed = standing(body, directions)
    noisy = replace(view.observation(), depth_noise=0.01)
    tracker.config = load_config("infer", ["registration=thesis"]).pose.tracking
    for walking in (None, 1.5, 3.0):
        tracker.begin(crossed, 0.0)
        tracker(0.1, noisy, view.no_face(), body.default_size(1), walking=walking)
        assert_close(registrar.starts, crossed.expand(2, -1))
