"""The yaw of whoever walks, against the body that faces so, and what it costs to face another way."""

import math

import pytest
import torch
from torch.testing import assert_close

from torchpose.body.model import BodyModel
from torchpose.registration.walk import WalkConfig, backwards_cost, walking_yaw, yaw_of_way


@pytest.fixture(scope="module")
def body():
    return BodyModel()


@pytest.mark.parametrize("heading", [0.0, 1.5, -2.4, 3.1])
def test_the_way_somebody_goes_is_where_a_body_of_that_yaw_faces(body, heading):
    """Out of the body's chest, by the model, and along the path, by its own making, are one direction."""
    time_s = torch.tensor([0.0, 0.1, 0.2, 0.35, 0.4, 0.5, 0.7, 0.8, 0.9, 1.0, 1.1], dtype=torch.float64)
    pose = torch.cat([torch.tensor([[0.0, 0.0, 3.0, heading, 0.0, 0.0]]), body.rest[None]], 1)
    hips, knee = (body.joint_names.index(name) for name in ("hip_left", "hip_right"))
    across = (body(pose).joints[0, hips] - body(pose).joints[0, knee]).double()  # to the left
    ahead = torch.tensor([across[2], 0.0, -across[0]])  # a quarter turn to the right of it
    place = 0.9 * time_s[:, None].float() * torch.nn.functional.normalize(ahead.float(), dim=0)
    found = walking_yaw(time_s, place)
    assert torch.isfinite(found).all()
    assert_close(found.sin(), torch.full_like(found, math.sin(heading)), atol=1e-4, rtol=0)
    assert_close(found.cos(), torch.full_like(found, math.cos(heading)), atol=1e-4, rtol=0)
    assert walking_yaw(time_s, place / 2).isnan().all()  # 0.45 m/s is no walk


def test_a_way_is_told_by_what_is_near_in_time_alone():
    time_s = 0.1 * torch.arange(21, dtype=torch.float64)
    x = torch.where(time_s < 1, time_s, 2 - time_s).float()  # there and back
    place = torch.stack([x, 0 * x, 0 * x], 1)
    found = walking_yaw(time_s, place)
    assert_close(found[:7], torch.full((7,), -torch.pi / 2))
    assert_close(found[14:], torch.full((7,), torch.pi / 2))
    assert found[10].isnan()
    assert walking_yaw(time_s[:4], place[:4]).isnan().all()  # 0.3 s tell nothing
    assert walking_yaw(time_s[:1], place[:1]).isnan().all()


def test_a_batch_of_ways_is_each_alone():
    elapsed, way = (
        torch.tensor([1.0, 1.0, 0.3, 2.0]),
        torch.tensor([[0.0, -0.8], [0.3, 0.2], [1.0, 0.0], [1.2, 0.0]]),
    )
    found = yaw_of_way(elapsed, way)
    assert found.isnan().tolist() == [False, True, True, False]  # too slow, too short
    assert_close(found[[0, 3]], torch.tensor([0.0, -math.pi / 2]))
    for one, time, gone in zip(found, elapsed, way, strict=True):
        assert_close(yaw_of_way(time, gone), one, equal_nan=True)


def test_backwards_costs_all_aside_half_and_ahead_nothing():
    config, way = WalkConfig(backwards_penalty=8.0), 0.7
    yaw = way + torch.tensor([0.0, math.pi / 2, -math.pi / 2, math.pi, 2 * math.pi])
    assert_close(backwards_cost(yaw, way, config), torch.tensor([0.0, 4.0, 4.0, 8.0, 0.0]), atol=1e-5, rtol=0)
    assert not backwards_cost(yaw, way, WalkConfig(backwards_penalty=0.0)).any()


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"span": 0.0}, "span must be positive, got 0.0"),
        ({"speed": -0.5}, "speed must be positive, got -0.5"),
        ({"backwards_penalty": -1.0}, "backwards_penalty must not be negative, got -1.0 nats"),
    ],
)
def test_bad_settings_are_told(setting, message):
    with pytest.raises(ValueError, match=message):
        WalkConfig(**setting)
