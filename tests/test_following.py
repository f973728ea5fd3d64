"""The benchmark of following: its scorers on tracks made by hand, and the recordings it makes of given ones."""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
import torch
from torch import Tensor

from benchmarks.following import cost_figures, joint_sd, row, share, status_right
from benchmarks.identity import TruePerson, followers, meeting, read_people, score, tracked_joints
from benchmarks.leaving import EMPTY, turn_around
from torchpose.body.model import BodyModel
from torchpose.export import PoseSequence
from torchpose.recording import open_recording

T = 40


def line(start: tuple[float, ...], end: tuple[float, ...]) -> Tensor:
    """Fifteen joints about a point that moves from start to end."""
    share = torch.linspace(0, 1, T)[:, None]
    root = torch.tensor(start) + share * (torch.tensor(end) - torch.tensor(start))
    body = torch.randn(15, 3, generator=torch.Generator().manual_seed(1)) * 0.2
    return root[:, None] + body - body[:1]


def person(joints: Tensor) -> TruePerson:
    there = joints[:, 0, 0].abs() < 1.8
    seen = torch.where(there, 1000, 0)
    return TruePerson(
        joints, seen, seen, torch.zeros(T, dtype=torch.bool), torch.ones(T, 15, dtype=torch.bool)
    )


# Two who cross in the middle, one 0.8 m behind the other.
FIRST, SECOND = (
    person(line((-2.0, 0.0, 3.0), (2.0, 0.0, 3.0))),
    person(line((2.0, 0.0, 3.8), (-2.0, 0.0, 3.8))),
)


def track(joints: Tensor, answered: Tensor | None = None) -> PoseSequence:
    answered = torch.ones(T, dtype=torch.bool) if answered is None else answered
    nothing = torch.zeros(T, 0)
    return PoseSequence(
        torch.arange(T),
        torch.arange(T) / 10,
        tuple("tracked" if one else "absent" for one in answered),
        torch.zeros(T),
        joints.clone(),
        (),
        nothing,
        nothing,
        (),
        nothing,
    )


def test_people_meet_where_one_is_before_the_other():
    meets = meeting([FIRST, SECOND])
    # Seen from the camera they are at x/z and -x/3.8 * ...: 0.7 m aside in the middle third.
    x = torch.linspace(-2, 2, T)
    aside = (x / 3 + x / 3.8).abs() * 3.4
    there = x.abs() < 1.8
    assert torch.equal(meets, (aside < 0.7) & there)
    assert 4 < meets.sum() < 15


def test_good_tracks_keep_their_people_in_either_order_and_with_gaps():
    for tracks in ([FIRST, SECOND], [SECOND, FIRST]):
        found = score([track(one.joints) for one in tracks], [FIRST, SECOND])
        assert found.kept
        assert found.answered == (1, 1)
        assert found.angle_deg == pytest.approx((0, 0), abs=0.1)
    order = score([track(SECOND.joints), track(FIRST.joints)], [FIRST, SECOND])
    assert order.owners == ((1, 1), (0, 0))
    gaps = torch.arange(T) % 3 > 0
    found = score([track(FIRST.joints, gaps), track(SECOND.joints)], [FIRST, SECOND])
    assert found.kept
    assert found.answered[0] == pytest.approx(2 / 3, abs=0.05)


def test_tracks_that_swap_at_the_crossing_are_not_kept():
    half = (torch.arange(T) < T // 2)[:, None, None]
    swapped = [torch.where(half, FIRST.joints, SECOND.joints), torch.where(half, SECOND.joints, FIRST.joints)]
    found = score([track(one) for one in swapped], [FIRST, SECOND])
    assert not found.kept
    assert found.owners == ((0, 1), (1, 0))
    assert found.answered == (1, 1)  # somebody follows, though not the same


def test_a_person_never_found_or_found_anew_is_not_kept():
    one = score([track(FIRST.joints)], [FIRST, SECOND])
    assert not one.kept
    assert one.owners == ((0, 0), (-1, -1))
    assert one.answered == (1, 0)
    assert math.isnan(one.angle_deg[1])
    assert not score([], [FIRST, SECOND]).kept
    late = torch.arange(T) > T // 2
    anew = score(
        [track(FIRST.joints), track(SECOND.joints, ~late), track(SECOND.joints, late)], [FIRST, SECOND]
    )
    assert anew.owners == ((0, 0), (1, 2))
    assert not anew.kept


def test_two_tracks_on_one_person_are_one_follower_and_far_ones_are_none():
    off = FIRST.joints + torch.tensor([0.1, 0.0, 0.0])
    joints = [tracked_joints(track(one), T) for one in (off, FIRST.joints)]
    assert torch.equal(followers(joints, [FIRST, SECOND])[:10], torch.tensor([[1, -1]]).expand(10, 2))
    far = tracked_joints(track(FIRST.joints + torch.tensor([0.0, 0.0, -0.5])), T)
    assert (followers([far], [FIRST, SECOND])[:10] == -1).all()


def test_angles_are_off_where_they_are():
    bent = FIRST.joints.clone()
    bent[:, 7] = bent[:, 5] + (bent[:, 7] - bent[:, 5])[:, [1, 2, 0]]  # the left forearm points elsewhere
    upper, lower = FIRST.joints[0, 5] - FIRST.joints[0, 3], FIRST.joints[0, 7] - FIRST.joints[0, 5]
    turned = lower[[1, 2, 0]]

    def angle(a: Tensor, b: Tensor) -> float:
        return math.degrees(math.acos(float(a @ b / a.norm() / b.norm())))

    found = score([track(bent), track(SECOND.joints)], [FIRST, SECOND])
    expected = abs(angle(upper, turned) - angle(upper, lower)) / 8
    assert found.angle_deg[0] == pytest.approx(expected, abs=0.1)


def test_a_hidden_or_cut_person_is_not_in_clear_view():
    seen = FIRST.seen.clone()
    seen[:15].clamp_(max=700)
    cut = torch.zeros(T, dtype=torch.bool)
    cut[30:] = True
    hidden = replace(FIRST, seen=seen, cut=cut)
    assert hidden.clear.nonzero()[:, 0].tolist() == [i for i in range(15, 30) if FIRST.seen[i]]


def test_statuses_are_right_where_their_words_say_so():
    words = (
        *("absent", "tracked"),  # nobody there: the second is wrong
        *("entering", "tracked", "recovered"),  # whole
        *("lost", "partial"),  # whole: both wrong
        *("partial", "tracked", "lost"),  # cut: the first is right
        *("partial", "tracked"),  # hardly cut: both right
        *("lost", "absent"),  # a sliver, which does not count, and nobody
    )
    seen = torch.tensor([0, 0, *[100] * 5, *[80] * 3, 90, 90, 5, 0])
    border = torch.tensor([0, 0, *[0] * 5, *[30] * 3, 4, 4, 3, 0])
    found = track(FIRST.joints)
    found = replace(
        found,
        **{
            name: getattr(found, name)[: len(words)]
            for name in (
                "frame",
                "time_s",
                "point_to_model",
                "joints",
                "angles",
                "angle_sd",
                "limb_angles",
            )
        },
        status=words,
    )
    right, counted = status_right(found, seen, border)
    expected = [True, False, True, True, True, False, False, True, False, False, True, True, False, True]
    assert right.tolist() == expected
    assert counted.tolist() == [True] * 12 + [False, True]
    assert share(right[counted]) == pytest.approx(8 / 13)
    late = status_right(found, torch.tensor([100] * 14), torch.zeros(14))[0]
    assert late[2]  # entering is right at first
    assert not status_right(replace(found, status=("entering",) * 14), torch.tensor([100] * 14), border)[0][9]


def test_joint_deviations_are_those_of_the_linear_map():
    body = BodyModel()
    pose = torch.zeros(1, body.num_parameters)
    pose[:, 2], pose[:, 6:] = 3.0, body.rest
    covariance = torch.zeros(1, body.num_parameters, body.num_parameters)
    covariance[0, 0, 0], covariance[0, 3, 3] = 0.02**2, 0.01**2  # x, and yaw
    size = body.default_size(1)
    sd = joint_sd(body, pose, covariance, size)[0]
    joints = body(pose, size).joints[0]
    arm = joints - pose[0, :3]
    expected = torch.stack(
        (0.02**2 + (0.01 * arm[:, 2]) ** 2, 0 * arm[:, 0], (0.01 * arm[:, 0]) ** 2), 1
    ).sqrt()
    torch.testing.assert_close(sd, expected, rtol=0.2, atol=3e-4)


def test_two_peoples_cost_is_that_of_the_least_disturbed_runs():
    # Two people, the first alone, the second alone; the second turn is disturbed but for the second alone.
    turns = [
        [
            {"registration": 150.0, "stereo": 60.0, "export": 900.0},
            {"registration": 90.0, "stereo": 50.0, "export": 100.0},
            {"registration": 130.0, "stereo": 70.0},
        ],
        [
            {"registration": 250.0, "stereo": 20.0},
            {"registration": 140.0, "stereo": 51.0},
            {"registration": 110.0, "stereo": 50.0},
        ],
    ]
    found = cost_figures(turns)
    assert (found["registration_two_ms"], found["registration_one_ms"]) == (150.0, 100.0)
    assert (found["all_two_ms"], found["all_one_ms"]) == (210.0, 150.0)
    assert found["registration"] == pytest.approx(1.5)
    assert found["all"] == pytest.approx(1.4)
    assert math.isnan(cost_figures([[{"stereo": 1.0}] * 3])["registration"])  # nobody was found


def test_a_line_of_the_table_counts_identities_and_leaves_out_what_is_unknown():
    figures = [{"kept": 1.0, "angle_deg": 4.0}, {"kept": 0.0, "angle_deg": math.nan}]
    assert row("crossing", figures).startswith(
        "crossing        kept 1 of 2, angle_deg 4.0   (reach: kept all"
    )


def test_a_folder_without_truth_is_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="must hold person_1"):
        read_people(tmp_path)


@pytest.mark.slow
def test_the_turned_recording_is_empty_then_as_given_then_empty_again(shared_data: Path, tmp_path: Path):
    source = shared_data / "people" / "walking_m2"
    if not source.is_dir():
        pytest.skip(f"no folder {source}")
    known = turn_around(source, tmp_path)
    seen = torch.tensor(known["seen"])
    assert (seen[:EMPTY] == 0).all()
    assert (seen[-EMPTY:] == 0).all()
    assert (seen[EMPTY:-EMPTY] > 0).all()
    assert known["source"][EMPTY : EMPTY + 60] == list(range(60))
    recording, given = open_recording(tmp_path), open_recording(source)
    assert len(recording) == len(seen)
    first, empty = recording[EMPTY].left, given.background().left
    assert first is not None
    assert empty is not None
    assert (first - given[0].left).abs().mean() < 0.01  # JPEG once more
    # An empty frame departs from a background frame as much as the two of these from each other.
    bare = recording[3].left
    assert bare is not None
    apart = (empty[0] - empty[1]).std()
    # JPEG, once more, takes away some of the noise.
    assert 0.75 < float((bare - empty[0]).std() / apart) < 1.05
    # The way out: the truth's silhouette is where the picture is not the room.
    index = EMPTY + 60 + 20
    out = recording[index].left
    assert out is not None
    changed = ((out - empty.mean(0)).abs().amax(0) > 0.15).numpy().astype("uint8")
    changed = cv2.morphologyEx(changed, cv2.MORPH_OPEN, torch.ones(3, 3).byte().numpy())
    assert 0.6 < changed.sum() / int(seen[index]) < 1.1
