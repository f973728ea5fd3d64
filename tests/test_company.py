"""Several people and furniture: who hides whom, against single people; the truth; paths against their own words."""

import functools
import math
from dataclasses import replace
from pathlib import Path as File

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from torchpose.body.model import BodyModel
from torchpose.body.superquadric import DisplayModel, Person, draw_person
from torchpose.recording import open_recording
from torchpose.rendered import write_company
from torchpose.synthesis.box import Box, Boxes
from torchpose.synthesis.company import Company, CompanyRecording, Guest
from torchpose.synthesis.depth import Scene, cast_depth
from torchpose.synthesis.motion import lowest
from torchpose.synthesis.path import Path, walk
from torchpose.synthesis.render import RenderConfig, SensorConfig, StereoRenderer
from torchpose.synthesis.scenario import CROSSINGS, behind_counter, crossing, visit
from torchpose.vision.camera import StereoCamera

BODY = BodyModel()
SMALL = StereoCamera(160, 120, 150.0, 79.3, 59.7, 0.12, 10.0)
TINY = StereoCamera(80, 60, 75.0, 39.4, 29.6, 0.12, 5.0)
QUIET = RenderConfig(sensor=SensorConfig(0.0, 0.0, 0.0, 0.0))
ACROSS = Path((0.0, 4.0), ((-2.0, 3.1), (2.0, 3.1)))
BACK = Path((0.0, 4.0), ((2.0, 3.9), (-2.0, 3.9)))
TABLE = Box((0.3, 0.65, 2.6), (1.2, 0.9, 0.3), (0.5, 0.4, 0.3), 0.2)
PEOPLE = (draw_person(3), draw_person(8))


def company(*guests: int, furniture: tuple[Box, ...] = ()) -> CompanyRecording:
    """The first of the people, the second, or both, on their ways."""
    all_of = (Guest(PEOPLE[0], ACROSS, 1), Guest(PEOPLE[1], BACK, 2))
    return CompanyRecording(
        Company("test", tuple(all_of[k] for k in guests), 4.0, furniture), SMALL, QUIET, BODY
    )


@functools.cache
def rendered(*guests: int, table: bool = False):
    return company(*guests, furniture=(TABLE,) if table else ()).frames(19, 22)


def test_where_people_cross_the_nearer_one_is_seen_as_a_test_of_depths_of_single_pictures_says():
    both, first, second = rendered(0, 1), rendered(0), rendered(1)
    one, other = first.mask, second.mask
    assert (one & other).flatten(1).sum(1).max() > 150  # they do cross
    wins = one & (~other | (first.depth < second.depth))
    expected = torch.where(wins, 1, torch.where(other, 2, 0))
    assert torch.equal(both.people, expected)
    assert torch.equal(both.depth, torch.minimum(first.depth, second.depth))
    labels = torch.where(wins, first.labels, second.labels)
    assert torch.equal(both.labels, labels)


def test_each_one_looks_as_alone_but_for_shadows_and_rims():
    both, first = rendered(0, 1), rendered(0)
    inner = -torch.nn.functional.max_pool2d(-(both.people == 1).float(), 3, 1, 1) > 0
    gap = (both.left - first.left).abs().amax(1)[inner]
    # The other one may take a little of the lamp's light, and gives none.
    assert gap.quantile(0.9) == 0
    assert (both.left - first.left).amax(1)[inner].max() <= 0


def test_the_truth_of_each_is_that_of_a_recording_alone():
    both = company(0, 1)
    for k in (0, 1):
        alone = company(k)
        assert torch.equal(both.poses[k], alone.poses[0])
        assert torch.equal(both.joints[k], alone.joints[0])
        assert torch.equal(both.sizes[k], alone.sizes[0])
    # And it is the drawn body's: the ankles' pixels are the person's.
    seen = both.presence(20)[0]
    assert seen.joints.all()


def test_masks_are_disjoint_and_are_the_renderer_s():
    recording, frames = company(0, 1), rendered(0, 1)
    for row, index in enumerate(range(19, 22)):
        one, other = recording.presence(index)
        assert not (one.mask & other.mask).any()
        for k, found in enumerate((one, other)):
            # The room's pictures are one in cast and rendered, so the masks are.
            assert torch.equal(found.mask, frames.people[row] == k + 1)
        assert one.whole >= int(one.mask.sum())
        alone = cast_depth(
            DisplayModel(BODY, PEOPLE[1]), recording.posed(index, index + 1)[1], SMALL, Scene(9.0, 20.0)
        )
        assert other.whole == int(alone.mask.sum())


def test_furniture_hides_what_lies_behind_it_and_stands_in_the_empty_room():
    free, behind = rendered(0, 1), rendered(0, 1, table=True)
    v, u = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    rays = SMALL.back_project(torch.stack((u, v), -1).flatten(0, 1), torch.ones(120 * 160))
    # Marching along the rays: the first step inside of the turned box.
    steps = torch.linspace(2.2, 3.1, 600)
    c, s = math.cos(TABLE.turn), math.sin(TABLE.turn)
    turn = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])  # R_world_box
    way, start = rays @ turn, torch.tensor(TABLE.center) @ turn
    inside = torch.stack(
        [(way[:, None, k] * steps - start[k]).abs() < TABLE.size[k] / 2 for k in range(3)]
    ).all(0)
    reach = torch.where(inside.any(1), steps[inside.float().argmax(1)], math.inf).view(120, 160)
    hit = reach.isfinite()
    assert hit.sum() > 1500
    sure = (reach - free.depth).abs() > 0.03
    rim = torch.nn.functional.max_pool2d(hit.float()[None], 3, 1, 1)[0] > 0
    rim = rim & ~(-torch.nn.functional.max_pool2d(-hit.float()[None], 3, 1, 1)[0] > 0)
    sure = sure & ~rim
    expected = torch.where(hit & (reach < free.depth), 0, free.people)
    assert torch.equal(behind.people[sure], expected[sure])
    assert ((free.people > 0) & (behind.people == 0)).sum() > 300
    torch.testing.assert_close(
        behind.depth[sure & hit], reach.expand_as(free.depth)[sure & hit], atol=2e-3, rtol=0
    )
    # The background has the table, too, and a camera of depth sees the same.
    recording = company(0, 1, furniture=(TABLE,))
    empty = recording.background(1)[0][0]
    bare = (behind.people[0] == 0) & hit & ~rim
    darker = (empty - behind.left[0]).amax(0)[bare]
    assert darker.min() >= 0
    assert (
        darker == 0
    ).float().mean() > 0.8  # people before it would cast shadows on it, but they are behind
    read = recording.depth_frame(20)
    assert torch.equal(read.people, behind.people[1])


def test_nobody_casts_a_shadow_on_what_stands_between_them_and_the_lamp():
    recording = company(0, furniture=(TABLE,))
    frames, (left, _) = recording.frames(25, 29), recording.background(1)
    free = company(0).background(1)[0][0]
    table = (free - left[0]).abs().amax(0) > 0.02  # and its own shadow, behind it
    v, u = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    points = SMALL.back_project(torch.stack((u, v), -1).expand(4, -1, -1, -1), frames.depth)
    near = table & (points[..., 2] < 2.7) & (points[..., 1] < 1.0)
    near &= ~(torch.nn.functional.max_pool2d(frames.mask.float(), 3, 1, 1) > 0)
    darker = (left - frames.left).amax(1)
    assert near.flatten(1).sum(1).min() > 800
    assert darker[near].max() < 1e-6
    assert (darker > 0.05).flatten(1).sum(1).min() > 100  # on the floor there is one


def test_casts_of_several_people_are_the_renderer_s():
    recording = company(0, 1)
    displays = [DisplayModel(BODY, person) for person in PEOPLE]
    posed = recording.posed(20, 21)
    scene = Scene(1.1, 6.0, (TABLE,))
    both = cast_depth(displays, posed, SMALL, scene)
    single = [cast_depth(display, one, SMALL, scene) for display, one in zip(displays, posed, strict=True)]
    depths = torch.stack([one.depth for one in single])
    assert torch.equal(both.depth, depths.amin(0))
    assert torch.equal(both.people > 0, (single[0].mask | single[1].mask))
    with pytest.raises(ValueError, match="a pose for each of the people, got 2 people and 1 poses"):
        cast_depth(displays, posed[:1], SMALL)


def test_seeds_repeat_and_frames_do_not_depend_on_what_was_asked_before():
    one, other = CompanyRecording(crossing(4), TINY), CompanyRecording(crossing(4), TINY)
    one.depth_frame(3)
    first, again = one.depth_frame(20), other.depth_frame(20)
    assert torch.equal(first.colour, again.colour)
    assert torch.equal(first.depth.nan_to_num(), again.depth.nan_to_num())
    assert torch.equal(one.frames(20, 21).right, other.frames(19, 21).right[1:])
    elsewhere = CompanyRecording(crossing(5), TINY)
    assert not torch.equal(one.joints[0][:20], elsewhere.joints[0][:20])
    assert not torch.equal(one.empty_depth(0).nan_to_num(), one.empty_depth(1).nan_to_num())


@pytest.mark.parametrize("seed", range(3))
def test_who_crosses_is_away_first_hides_the_other_and_is_unlike_it(seed: int):
    recording = CompanyRecording(crossing(seed), TINY)
    presence = [recording.presence(i) for i in range(len(recording))]  # every 0.2 s
    for k in (0, 1):
        assert all(not found[k].mask.any() for found in presence[:5])
        whole = [i for i, found in enumerate(presence) if found[k].whole and not found[k].cut]
        assert len(whole) > 6
    share = [int(f[k].mask.sum()) / f[k].whole for k in (0, 1) for f in presence if f[k].whole > 50]
    assert min(share) < 0.6
    people = [guest.person for guest in recording.company.guests]
    assert abs(people[0].height - people[1].height) > 0.08
    # Nobody walks through anybody.
    gap = (recording.joints[0][:, 0] - recording.joints[1][:, 0])[:, [0, 2]].norm(dim=1)
    assert gap.min() > 0.45


def test_crossings_are_of_the_kind_asked_for():
    assert {crossing(seed).name.split()[0] for seed in range(3)} == set(CROSSINGS)
    with pytest.raises(ValueError, match="kind must be one of opposite"):
        crossing(0, "dancing")


@pytest.mark.parametrize("seed", range(2))
def test_a_counter_hides_the_legs_alone_for_two_seconds(seed: int):
    recording = CompanyRecording(behind_counter(seed), TINY)
    seen = torch.stack([recording.presence(i)[0].joints for i in range(len(recording))])
    names = list(BODY.joint_names)
    legs = [names.index(f"{joint}_{side}") for joint in ("knee", "ankle") for side in ("left", "right")]
    arms = [names.index(f"{joint}_{side}") for joint in ("shoulder", "elbow") for side in ("left", "right")]
    hidden = ~seen[:, legs].any(1) & seen[:, arms].all(1)
    assert hidden.sum() >= 10  # of 0.2 s
    assert seen.all(1).sum() >= 6


def moved(path: Path, frames: int = 120, rate: float = 20.0) -> tuple[Tensor, Tensor]:
    size = PEOPLE[0].size(BODY)
    pose = walk(BODY, size, path, torch.arange(frames) / rate, 3, 1)
    return pose, BODY(pose, size).joints


def test_who_walks_is_where_the_path_says_looks_ahead_and_hardly_slides():
    pose, _ = moved(ACROSS, 80)
    t = torch.arange(80) / 20
    torch.testing.assert_close(pose[:, 0], -2.0 + t, atol=1e-3, rtol=0)
    torch.testing.assert_close(pose[:, 2], torch.full_like(t, 3.1), atol=1e-3, rtol=0)
    size = PEOPLE[0].size(BODY)
    posed = BODY(pose, size)
    assert (lowest(BODY, posed).amax(1) - 1.1).abs().max() < 0.01
    front = -posed.rotations[:, 0, :, 2]
    assert front[:, 0].min() > 0.9
    assert (pose[:, 6:] > BODY.low[6:]).all()
    assert (pose[:, 6:] < BODY.high[6:]).all()
    # The ankle that bears goes at a fraction of the pace; both at it would be gliding.
    speed = posed.joints[:, 13:15].diff(dim=0)[..., 0].abs() * 20
    assert speed.amin(1).mean() < 0.35
    assert speed.amax(1).mean() > 1.2


def test_who_stands_faces_the_camera_and_who_sits_is_low_with_the_feet_in_place():
    path = Path((0.0,), ((0.4, 3.5),), seated=((1.0, 5.0),))
    pose, joints = moved(path)
    posed = BODY(pose, PEOPLE[0].size(BODY))
    assert (-posed.rotations[:, 0, 2, 2]).max() < -0.97
    hips, feet = joints[:, 0], joints[:, 13:15].mean(1)
    assert hips[60, 1] - hips[10, 1] > 0.3
    assert (feet[:, [0, 2]] - feet[0, [0, 2]]).norm(dim=1).max() < 0.15
    assert hips[60, 2] - hips[10, 2] > 0.2
    assert joints.diff(dim=0).norm(dim=-1).max() * 20 < 4  # m/s: no jumps


def test_poses_do_not_depend_on_which_times_are_asked_for():
    path, size = Path((0.3, 2.0, 2.8), ((-1.0, 3.0), (0.5, 3.4), (1.0, 3.0))), PEOPLE[0].size(BODY)
    times = torch.arange(50) / 10
    whole = walk(BODY, size, path, times, 2)
    part = walk(BODY, size, path, times[30:], 2)
    torch.testing.assert_close(part, whole[30:], atol=1e-4, rtol=0)


def test_written_companies_are_read_as_recordings(tmp_path: File):
    recording = CompanyRecording(replace(visit(1), duration=0.3), SMALL)
    for stereo in (True, False):
        folder = write_company(tmp_path / str(stereo), recording, stereo)
        read = open_recording(folder)
        assert len(read) == len(recording) == 3
        frame = read[1]
        if stereo:
            torch.testing.assert_close(frame.left, recording.frames(1, 2).left[0])
            assert read.background().left is not None
        else:
            exact = recording.depth_frame(1)
            assert frame.depth is not None
            torch.testing.assert_close(frame.depth, exact.depth, atol=6e-4, rtol=0, equal_nan=True)
            torch.testing.assert_close(frame.left, exact.colour)
            assert read.background().depth is not None
        truth = np.load(folder / "truth" / "person_1.npz")
        np.testing.assert_array_equal(truth["joints_cam"], recording.joints[0])
        assert truth["joints_seen"].shape == (3, 15)
        assert truth["seen"].tolist() == [0, 0, 0]
        image = cv2.imread(str(folder / "truth" / "000002_people.png"), cv2.IMREAD_UNCHANGED)
        assert image.shape == (120, 160)
        assert image.max() == 0


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Path((0.0, 1.0), ((0.0, 3.0),)), "a time for each spot, got 2 times and 1 spots"),
        (lambda: Path((1.0, 1.0), ((0.0, 3.0), (1.0, 3.0))), "times of a path must ascend"),
        (lambda: Path((0.0,), ((0.0, 3.0),), seated=((1.0, 2.0),)), "must last 1.8 s, got 1 to 2"),
        (lambda: Company("x", (), 3.0), "must have people and last some time"),
        (lambda: Box((0.0, 0.0, 3.0), (1.0, 0.0, 1.0), (0.5, 0.5, 0.5)), "positive sizes"),
        (lambda: Boxes(()), "at least one box"),
        (lambda: StereoRenderer(SMALL, BODY, ()), "at least one person"),
        (lambda: StereoRenderer(SMALL, BODY, Person())(company(0, 1).posed(0, 1)), "each of 1 people, got 2"),
        (lambda: company(0).frames(3, 99), "a range within 0 to 40"),
        (lambda: company(0).depth_frame(40), "one of 0 to 39, got 40"),
    ],
)
def test_senseless_settings_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
