"""Limbs that are wrong over a stretch of frames are put where the points are."""

from dataclasses import replace

import pytest
import torch
from synthetic_cloud import see, standing, together
from torch.testing import assert_close

from torchpose.body.model import BodyModel
from torchpose.registration.vem import Registrar
from torchpose.tracking.limb_hypothesis import HypothesisConfig, LimbHypotheses, Table

T = 5


@pytest.fixture(scope="module")
def scene():
    """A body that stands still, and a chain of poses whose left arm is elsewhere."""
    body = BodyModel()
    pose = standing(body, yaw=0.2).expand(T, -1)
    model = LimbHypotheses(body, Registrar(body), HypothesisConfig(every=T, sweeps=3, reach=(1, 2)))
    wrong = pose.clone()
    own = model.search.limbs[0]
    low, high = body.low[own], body.high[own]
    wrong[:, own] = torch.where(pose[:, own] - low > high - pose[:, own], 0.8 * low, 0.8 * high)
    return body, model, pose, wrong, together([see(body, pose[t : t + 1]) for t in range(T)])


def run(model, observation, pose):
    pull = torch.full((T - 1, pose.shape[1]), 20.0)
    return model(observation, pose, model.body.default_size(1), pull, 0.02)


def fitted(model, observation, pose):
    """A place found is one from which the fit goes on."""
    return Registrar(model.body)(
        observation, pose, model.body.default_size(1), rounds=8, sigma_first=0.04
    ).pose


def worst_joint(body, found, truth):
    return (body(found).joints - body(truth).joints).norm(dim=-1).amax(1)


def test_a_run_of_wrong_frames_is_left_once_one_is_searched(scene):
    body, model, pose, wrong, observation = scene
    found, more = run(model, observation, wrong)
    assert worst_joint(body, wrong, pose).min() > 0.3
    assert worst_joint(body, fitted(model, observation, found), pose).max() < 0.06
    assert more.isfinite().all()
    assert_close(more, more.mT)


def test_poses_that_are_right_stay_and_are_sure(scene):
    _, model, pose, _, observation = scene
    found, more = run(model, observation, pose)
    own = model.search.limbs
    assert worst_joint(model.body, found, pose).max() < 0.06
    assert more.diagonal(dim1=1, dim2=2)[:, own].sqrt().median() < 0.1


def test_a_frame_that_is_not_a_number_harms_no_other(scene):
    body, model, pose, wrong, observation = scene
    points = observation.cloud.points.clone()
    points[0] = torch.nan
    found, more = run(model, replace(observation, cloud=replace(observation.cloud, points=points)), wrong)
    assert found.isfinite().all()
    assert more.isfinite().all()
    # It goes where its neighbours are, and does not hold them where it was.
    assert worst_joint(body, fitted(model, observation, found), pose).max() < 0.06
    without, _ = run(model, observation, wrong)
    assert_close(found, without, atol=0.2, rtol=0)


def test_the_best_of_a_table_differ_and_the_first_stays():
    place = torch.tensor([0.0, 1.0, 1.05, 2.0, 3.0])[:, None].expand(1, 1, 5, 4).contiguous()
    cost = torch.tensor([5.0, 2.0, 1.0, 3.0, torch.inf]).view(1, 1, 5)
    best = Table(place, cost).best(4, 0.2, 30.0)
    assert best.cost[0, 0].tolist() == [5.0, 1.0, 3.0, torch.inf]
    assert best.place[0, 0, :3, 0].tolist() == pytest.approx([0.0, 1.05, 2.0])
    chosen = Table(place, cost).first(torch.tensor([[3]]))
    assert chosen.cost[0, 0].tolist() == [3.0, 2.0, 1.0, 5.0, torch.inf]
    assert Table(place, cost + torch.tensor([0.0, 99, 99, 0, 0])).best(5, 0.2, 30.0).cost[0, 0, 1] == 3.0


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"sweeps": -1}, "sweeps must not be negative, got -1"),
        ({"every": 0}, "every must be positive, got 0"),
        ({"sigma": 0.0}, r"sigma must be positive, got 0\.0"),
        ({"reach": ()}, "reach needs at least one number of frames"),
    ],
)
def test_bad_settings_are_told(setting, message):
    with pytest.raises(ValueError, match=message):
        HypothesisConfig(**setting)
