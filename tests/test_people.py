"""What is known of people beside their poses: the way they walk, how tall they are, where they come in."""

import math
from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from torchpose.body.model import BodyModel
from torchpose.eyes import Sight, View
from torchpose.follower import Follower
from torchpose.people import People, PeopleConfig, _at_border
from torchpose.pipeline import RIM, StereoToPose
from torchpose.tracking.location import sighting
from torchpose.vision.camera import StereoCamera
from torchpose.vision.faces import Faces
from torchpose.vision.floor import Floor
from torchpose.vision.points import PointCloud

CAMERA = StereoCamera(160, 120, 150.0, 80.0, 60.0, 0.12, 10.0)


@pytest.fixture(scope="module")
def people():
    return People(StereoToPose(CAMERA))


def walk(people, velocity, seconds=1.0, rate=10.0):
    """A first person who goes at a constant velocity (x, z), m/s, for some time."""
    follower = people.followers[0]
    follower.trail, places = follower.trail[:0], []
    for n in range(int(seconds * rate) + 1):
        t = n / rate
        places.append([t, velocity[0] * t, 3.0 + velocity[1] * t])
    follower.trail = follower.trail.new_tensor(places)
    trunk = torch.tensor([[velocity[0] * seconds, 0.0, 3.0 + velocity[1] * seconds]])
    follower.location = people.filter.begin(sighting(body=trunk), seconds).location
    return people._walking(follower, seconds)


@pytest.mark.parametrize("velocity", [(1.0, 0.0), (-1.2, 0.0), (0.0, -0.8), (0.5, 0.6)])
def test_whoever_walks_faces_the_way_he_goes(people, velocity):
    """A person whose pose has this yaw looks along the velocity: the front is -z of a body that does not turn."""
    yaw = walk(people, velocity)
    body = BodyModel()
    pose = torch.cat([torch.tensor([[0.0, 0.0, 3.0, yaw, 0.0, 0.0]]), body.rest[None]], 1)
    across = body(pose).joints[0]
    left, right = (across[body.joint_names.index(f"shoulder_{side}")] for side in ("left", "right"))
    # The left shoulder is on the left of the way: turning the way by a quarter to its left, seen from above.
    way = torch.tensor([velocity[0], 0.0, velocity[1]])
    leftward = torch.tensor([-velocity[1], 0.0, velocity[0]])
    aside = (left - right) / (left - right).norm()
    assert_close(float(aside @ leftward / leftward.norm()), 1.0, atol=0.02, rtol=0)
    assert abs(float(aside @ way)) < 0.1


def test_whoever_stands_or_just_came_faces_no_way(people):
    assert walk(people, (0.3, 0.0)) is None
    assert walk(people, (1.0, 0.0), seconds=0.3) is None
    follower = people.followers[0]
    assert walk(people, (1.0, 0.0)) is not None
    assert people._walking(follower, 1.0 + 2 * people.config.memory) is None


def test_the_height_is_the_second_tallest_of_upright_sights(people):
    model = people.model
    H = model.body.height
    assert model.height_of([]) == H
    assert model.height_of([0.6 * H, 0.7 * H]) == H  # sitting
    assert model.height_of([math.nan, 0.8 * H]) == 0.8 * H
    assert model.height_of([1.70, 0.7 * H]) == 1.70
    assert model.height_of([1.70, 1.72, 1.95]) == 1.72
    assert model.height_of([3.0, 3.0]) == 1.2 * H


def upright(crown, lowest, lean=0.0):
    """A sight of a column of points from a height over the floor to another, 1.1 m below a camera that looks down by
    `lean` rad."""
    height = torch.linspace(lowest, crown, 400)
    level = torch.stack([torch.full_like(height, 0.1), 1.1 - height, torch.full_like(height, 3.0)], -1)
    cos, sin = math.cos(lean), math.sin(lean)
    turn = torch.tensor([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])
    points = (level @ turn.mT)[None]
    n = points.shape[1]
    none = torch.zeros(1, n, dtype=torch.long)
    cloud = PointCloud(
        points,
        points[..., :2],
        none[..., None].expand(-1, -1, 2),
        none == 0,
        none[..., None].expand(-1, -1, 8),
    )
    picture = torch.zeros(1, 120, 160)
    nothing = torch.full((1, 4), torch.nan)
    faces = Faces(nothing, nothing[:, 0] > 0, picture > 0, nothing[:, :3])
    sight = Sight(picture[:, None].expand(-1, 3, -1, -1), picture, picture > 0, cloud, faces, True, False)
    return sight, Floor(torch.tensor([0.0, -cos, -sin]), torch.tensor(1.1))


@pytest.mark.parametrize("lean", [0.0, 0.3])
@pytest.mark.parametrize("lowest", [0.0, 0.25, 0.9])
def test_somebody_reaches_from_the_floor_to_the_crown(people, monkeypatch, lowest, lean):
    """However little of feet and legs is seen, and however the camera looks down."""
    sight, floor = upright(1.75, lowest, lean)
    monkeypatch.setattr(people.model.eyes, "floor", floor)
    assert_close(people.model.height_in(sight), 1.75 + RIM, atol=0.02, rtol=0)


def test_a_table_is_not_what_somebody_behind_it_stands_on(people, monkeypatch):
    sight, floor = upright(1.80, 0.0)
    monkeypatch.setattr(people.model.eyes, "floor", replace(floor, height=floor.height - 0.7))
    assert_close(people.model.height_in(sight), 1.80 + 2 * RIM, atol=0.04, rtol=0)


@pytest.mark.parametrize(
    ("rows", "columns", "with_floor", "without"),
    [
        (slice(20, 100), slice(60, 90), True, True),  # whole
        (slice(20, 120), slice(60, 90), True, False),  # cut below
        (slice(0, 100), slice(60, 90), False, False),  # cut above
        (slice(20, 100), slice(130, 160), False, False),  # coming in
    ],
)
def test_a_newcomer_is_measured_where_the_head_shows(people, monkeypatch, rows, columns, with_floor, without):
    whole, floor = upright(1.75, 0.0)
    mask = torch.zeros(1, 120, 160, dtype=torch.bool)
    mask[:, rows, columns] = True
    edges = mask[0, [0, -1]].any() | mask[0, :, [0, -1]].any()
    depth = torch.where(mask, 3.0, 5.0)
    sight = replace(whole, silhouette=mask, cut=bool(edges))
    view = View(sight.images, depth, mask, True)
    for known, measured in ((floor, with_floor), (None, without)):
        monkeypatch.setattr(people.model.eyes, "floor", known)
        follower = Follower(people.model, sized=False)
        people._measure_height(follower, sight, view)
        assert len(follower.heights) == measured


def test_without_a_floor_feet_may_be_missing(people, monkeypatch):
    monkeypatch.setattr(people.model.eyes, "floor", None)
    height = people.model.height_in
    assert_close(height(upright(1.80, 0.0)[0]), 1.80 + 2 * RIM, atol=0.04, rtol=0)
    assert height(upright(1.75, 0.2)[0]) == people.model.config.least_height
    assert height(upright(1.75, 0.9)[0]) < 1.0  # sits: this says nothing of the height


def test_the_sides_of_the_image_are_where_people_come_in():
    mask = torch.zeros(20, 30, dtype=torch.bool)
    mask[5:20, 10:15] = True
    assert not _at_border(mask)  # cut below: near the camera
    mask[6, 29] = True
    assert _at_border(mask)


def test_wrong_settings_are_told():
    with pytest.raises(ValueError, match="apart must be positive"):
        PeopleConfig(apart=0.0)
    assert math.isfinite(PeopleConfig().appearing)
