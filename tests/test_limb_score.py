"""Limbs judged alone against `Registrar.evaluate`, which judges every part of every pose."""

from dataclasses import replace

import pytest
import torch
from synthetic_cloud import see, standing, together
from torch.testing import assert_close

from torchpose.body.model import BodyModel
from torchpose.registration.fitting import PosePrior
from torchpose.registration.labelling import LabellingConfig
from torchpose.registration.limb_score import LimbScore
from torchpose.registration.limb_search import LimbSearch
from torchpose.registration.occlusion import OcclusionConfig
from torchpose.registration.silhouette import RimConfig
from torchpose.registration.vem import Distance, Registrar, RegistrationConfig

ALONE = RegistrationConfig(labelling=LabellingConfig(sweeps=0, potts=0.0))
F, R = 3, 60


@pytest.fixture(scope="module")
def scene():
    """Three frames of bodies that stand otherwise than their poses say, with potentials of their appearance."""
    body = BodyModel().double()
    generator = torch.Generator().manual_seed(3)
    true = torch.cat([standing(body, yaw=yaw, x=0.2 * yaw) for yaw in (0.2, -0.6, 1.0)])
    size = body.default_size(F) * torch.tensor([0.95, 1.0, 1.05])[:, None]
    views = [see(body, true[f : f + 1], size[f : f + 1], num=n) for f, n in enumerate((200, 200, 200))]
    observation = together(views)
    observation = replace(
        observation,
        cloud=replace(observation.cloud, points=observation.cloud.points.double()),
        potential=torch.randn(observation.potential.shape, generator=generator).double(),
    )
    pose = true + 0.05 * torch.randn(true.shape, generator=generator).double()
    frame = torch.randint(F, (R,), generator=generator)
    limb = torch.randint(4, (R,), generator=generator)
    return body, observation, pose, size, frame, limb, torch.rand(R, 1, generator=generator).double()


def full(registrar, observation, pose, size, share):
    """Minus the log-density by the registrar, with a share of the pull to rest."""
    body = registrar.body
    nothing = PosePrior(pose, torch.zeros_like(pose))
    bound = pose.new_zeros(1, len(pose))
    found = registrar.evaluate(observation, pose, size, nothing, bound, bound[0].long(), covariance=False)
    best = found.belief.max(1)
    on = (best.indices < body.num_parts) & (best.values > 0)
    support = torch.stack([((best.indices == k) & on).sum(1) for k in range(body.num_parts)], 1).to(pose)
    rest = registrar.with_rest(nothing, support)
    return found.score - (1 - share) * 0.5 * (rest.precision * (pose - rest.mean) ** 2).sum(1)


@pytest.mark.parametrize("reach", [0.1, 1.0], ids=["places beside", "places anywhere"])
@pytest.mark.parametrize(
    ("setting", "noise", "penalty"),
    [
        ({}, 0.0, 5.0),
        ({}, 0.02, 5.0),
        ({"near": 1}, 0.0, 0.0),
        ({"near": 14, "outlier": 0.0}, 0.0, 5.0),
        ({"visible": False, "rest_sd": 0.0, "rim": RimConfig(weight=0.0)}, 0.0, 5.0),
    ],
    ids=["default", "noisy depths", "one near part", "all parts near", "terms off"],
)
def test_limbs_alone_have_the_score_of_whole_poses(scene, setting, noise, penalty, reach):
    body, observation, pose, size, frame, limb, way = scene
    observation = replace(observation, depth_noise=noise)
    registrar = Registrar(body, replace(ALONE, occlusion=OcclusionConfig(penalty=penalty), **setting))
    search = LimbSearch(body, registrar)
    score = LimbScore(search)
    assert score.serves(registrar)
    own = search.limbs[limb]
    place = torch.lerp(pose[frame].gather(1, own), search.places[limb, torch.arange(R)], reach * way)
    quick = score(score.know(observation, pose, size), frame, limb, place, 0.3)
    moved = pose[frame].scatter(1, own, place)
    slow = full(registrar, observation.share(frame), moved, size[frame], 0.3)
    assert_close(quick, slow, rtol=1e-9, atol=1e-7)


def test_a_frame_of_no_numbers_has_none_and_harms_no_other(scene):
    body, observation, pose, size, frame, limb, _ = scene
    registrar = Registrar(body, ALONE)
    search = LimbSearch(body, registrar)
    score = LimbScore(search)
    points = observation.cloud.points.clone()
    points[1] = torch.nan
    broken = replace(observation, cloud=replace(observation.cloud, points=points))
    place = search.places[limb, torch.arange(R)]
    sound, other = (score(score.know(o, pose, size), frame, limb, place, 0.3) for o in (observation, broken))
    assert other[frame == 1].isnan().all()
    assert_close(other[frame != 1], sound[frame != 1])


def test_the_half_has_the_points_beside_the_limb(scene):
    body, observation, pose, size, frame, limb, _ = scene
    score = LimbScore(LimbSearch(body, Registrar(body, ALONE)))
    rows = observation.share(frame)
    half = score.nearer_half(rows, pose[frame], size[frame], limb)
    centers = body(pose[frame], size[frame]).centers
    for r in range(R):
        mine = rows.cloud.points[r, rows.cloud.mask[r]]
        kept = half.cloud.points[r, half.cloud.mask[r]]
        assert len(kept) == (len(mine) + 1) // 2
        own = centers[r, score.parts[limb[r]]]
        beside = (mine[:, None] - own).norm(dim=-1).amin(1) < 0.05
        assert set(map(tuple, mine[beside].tolist())) <= set(map(tuple, kept.tolist()))
        at = (half.cloud.points[r][:, None] == rows.cloud.points[r]).all(2).int().argmax(1)
        assert_close(half.potential[r], rows.potential[r, at])


@pytest.mark.parametrize(
    "setting",
    [
        {"hard": False},
        {"distance": Distance.algebraic},
        {"labelling": LabellingConfig(sweeps=1, potts=0.0)},
    ],
)
def test_other_labels_are_left_to_the_registrar(setting):
    assert not LimbScore.serves(Registrar(BodyModel(), replace(ALONE, **setting)))
