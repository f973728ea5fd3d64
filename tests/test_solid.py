"""Limbs that run through trunk or head, against dense surfaces, finite differences and single bodies."""

from dataclasses import replace

import pytest
import torch
from synthetic_cloud import RELAXED, see, standing
from torch.testing import assert_close

from torchpose.body.model import BodyModel
from torchpose.registration.fitting import PosePrior
from torchpose.registration.limb_score import LimbScore
from torchpose.registration.limb_search import LimbSearch
from torchpose.registration.occlusion import OcclusionConfig
from torchpose.registration.solid import SolidConfig, parts_of, solid_residual, solid_rows
from torchpose.registration.vem import Registrar, RegistrationConfig
from torchpose.synthesis.company import CompanyRecording
from torchpose.synthesis.database import synthetic_camera
from torchpose.synthesis.scenario import behind_counter, crossing

BODY = BodyModel().double()
SIZE = BODY.default_size(1)
LIMBS, CORE = Registrar(BODY).limb_parts, Registrar(BODY).core_parts
CONFIG = SolidConfig()


def folded(yaw: float = 0.0) -> torch.Tensor:
    """Standing with the left forearm through the trunk."""
    rows = RELAXED.clone().double()
    rows[BODY.body_names[1:].index("upper_arm_left")] = torch.tensor([-0.2, 1.0, 0.1])
    rows[BODY.body_names[1:].index("forearm_left")] = torch.tensor([-1.0, -0.3, 0.1])
    return standing(BODY, rows, yaw=yaw)


def inside(posed) -> torch.Tensor:
    middles = posed.centers[:, LIMBS]
    return solid_residual(parts_of(posed, CORE), middles, CONFIG)


def test_limbs_and_core_share_the_body():
    kinds = ("upper_arm", "forearm", "hand", "thigh", "shank", "foot")
    names = {f"{kind}_{side}" for kind in kinds for side in ("left", "right")}
    assert {BODY.segment_names[k] for k in LIMBS.tolist()} == names
    assert {BODY.segment_names[k] for k in CORE.tolist()} == {"torso", "head"}
    posed = BODY(standing(BODY), SIZE)
    for name in ("centers", "frames", "radii"):
        assert torch.equal(getattr(parts_of(posed, CORE), name), getattr(posed, name)[:, CORE])


@pytest.mark.parametrize("scenario", [crossing, behind_counter], ids=["crossing", "behind a counter"])
def test_true_poses_cost_next_to_nothing(scenario):
    for seed in range(10):
        for posed in CompanyRecording(scenario(seed), synthetic_camera(480, 360, 10.0)).posed(0, 200):
            assert 0.5 * inside(posed).square().sum((1, 2)).max() < 0.1  # nats


def test_depths_are_those_to_the_nearest_of_many_points_of_the_surface():
    torch.manual_seed(0)
    posed = parts_of(BODY(standing(BODY, yaw=0.3), SIZE), CORE)
    ball = torch.nn.functional.normalize(torch.randn(200_000, 3, dtype=torch.float64), dim=1)
    inner = 0.9 * torch.rand(30, 1, dtype=torch.float64) * ball[:30]
    for k in range(2):
        frame, radii, center = posed.frames[0, k], posed.radii[0, k], posed.centers[0, k]
        surface, points = (ball * radii) @ frame.T + center, (inner * radii) @ frame.T + center
        away = (points + 2 * (ball[:30] * radii) @ frame.T)[:5]
        depth = torch.cdist(points, surface).amin(1)
        found = solid_residual(posed, torch.cat([points, away])[None], CONFIG)[0, k]
        expected = (depth - CONFIG.margin).clamp_min(0) / CONFIG.sd
        assert (expected > 1).any()
        # A tenth of a sigma: one Newton step, and a surface of points.
        assert_close(found[:30], expected, atol=0.1, rtol=0)
        assert (found[30:] == 0).all()


def test_rows_are_the_residuals_and_push_the_shortest_way_out():
    posed = BODY(folded(), SIZE)
    rows, residual = solid_rows(posed, LIMBS, CORE, CONFIG), inside(posed)
    assert (residual[0, 0] > 3).sum() == 1  # the forearm's middle, in the trunk
    assert_close(rows.residual(posed), residual.flatten(1))
    # Half their squares fall along each middle's way as finite differences say.
    force = (rows.residual(posed)[..., None] * rows.direction).unflatten(1, residual.shape[1:]).sum(1)
    core, middles = parts_of(posed, CORE), posed.centers[:, LIMBS]
    for axis in range(3):
        step = 1e-5 * torch.eye(3, dtype=torch.float64)[axis]
        loss = [solid_residual(core, middles + s * step, CONFIG).square().sum(1) for s in (1, -1)]
        assert_close((loss[0] - loss[1]) / 4e-5, -force[..., axis], atol=1, rtol=0.02)


def test_several_bodies_are_judged_as_each_alone():
    pose = torch.cat([folded(), standing(BODY), folded(0.5)])
    size = 1 + 0.05 * torch.randn(3, len(BODY.size_names), dtype=torch.float64)
    whole, rows = inside(BODY(pose, size)), solid_rows(BODY(pose, size), LIMBS, CORE, CONFIG)
    assert (whole.flatten(1).amax(1) > 1).tolist() == [True, False, True]
    for b in range(3):
        one = BODY(pose[b : b + 1], size[b : b + 1])
        assert_close(whole[b], inside(one)[0])
        assert_close(rows.direction[b], solid_rows(one, LIMBS, CORE, CONFIG).direction[0])


def test_a_pose_costs_half_the_squares_and_a_fit_comes_out():
    """Nothing is seen of the arm: only the term can move it."""
    body, pose = BodyModel(), folded().float()
    observation = see(body, standing(body), num=200).observation()
    energy = 0.5 * float(inside(BODY(pose.double(), SIZE)).square().sum())
    assert energy > 5
    size, found = body.default_size(1), {}
    for name, solid in (("on", CONFIG), ("off", SolidConfig(sd=0.0))):
        registrar = Registrar(body, RegistrationConfig(solid=solid, rest_sd=0.0))
        start = registrar(observation, pose, size, rounds=1)
        judged = registrar.evaluate(
            observation, pose, size, PosePrior(pose, torch.zeros_like(pose)), start.bound, start.status
        )
        fitted = registrar(observation, pose, size, rounds=8, sigma_first=0.03)
        found[name] = (
            float(judged.score),
            0.5 * float(inside(BODY(fitted.pose.double(), SIZE)).square().sum()),
        )
    assert found["on"][0] - found["off"][0] == pytest.approx(energy, rel=0.05)
    assert found["on"][1] < 0.05 * energy
    assert found["off"][1] > 0.5 * energy


def test_searches_leave_the_trunk():
    """Places that are scored, one by one and by `LimbScore`, cost what the whole body with them costs more."""
    body, pose = BodyModel(), standing(BodyModel())
    observation, size = see(body, pose, num=200).observation(), body.default_size(1)
    arm = folded().float()
    totals = []
    for solid in (CONFIG, SolidConfig(sd=0.0)):
        config = RegistrationConfig(solid=solid, occlusion=OcclusionConfig(penalty=0.0))
        config = replace(config, labelling=replace(config.labelling, sweeps=0, potts=0.0))
        search = LimbSearch(body, Registrar(body, config))
        place = arm[:, search.limbs[0]]
        places = pose[:, search.limbs][:, :, None].clone()
        places[:, 0, 0] = place
        rest = search._rest_of_body(observation, pose, size)
        score = LimbScore(search)
        known, zero = score.know(observation, pose, size), torch.zeros(1).long()
        totals.append(
            torch.stack(
                [
                    -search._score(observation, pose, places, size, rest, exact=True)[0, 0, 0],
                    -search.score_pairs(observation, pose, places, size)[0, 0, 0, 0],
                    score(known, zero, zero, place, 1.0)[0],
                ]
            )
        )
    whole = pose.clone()
    whole[:, search.limbs[0]] = place
    energy = 0.5 * inside(BODY(whole.double(), SIZE)).square().sum().float()
    assert energy > 5
    assert_close(totals[0] - totals[1], energy.expand(3), atol=0.05, rtol=0.01)


@pytest.mark.parametrize("setting", [{"sd": -0.1}, {"margin": -0.1}])
def test_bad_settings_are_told(setting):
    with pytest.raises(ValueError, match=r"sd and margin must not be negative, got"):
        SolidConfig(**setting)
