"""Limbs that were put elsewhere are found again, on bodies that are seen exactly."""

from dataclasses import replace

import pytest
import torch
from synthetic_cloud import CAMERA, mirrored, see, standing, together
from torch.testing import assert_close

from torchpose.body.ellipsoid import rough_distance
from torchpose.body.model import BodyModel
from torchpose.registration.limb_search import LimbSearch, LimbSearchConfig
from torchpose.registration.silhouette import RimConfig, silhouette_residual
from torchpose.registration.vem import Registrar, RegistrationConfig


@pytest.fixture(scope="module")
def scene():
    body = BodyModel()
    registrar = Registrar(body)
    pose = standing(body, yaw=0.2)
    return body, registrar, LimbSearch(body, registrar), pose, see(body, pose).observation()


def worst_joint(body, found, truth):
    return (body(found).joints - body(truth).joints).norm(dim=-1).amax(1)


def test_arms_and_legs_are_searched_with_their_own_parts(scene):
    body, _, search, _, _ = scene
    names = [{body.parameter_names[i] for i in limb} for limb in search.limbs.tolist()]
    arm, leg = ("upper_arm", "forearm", "hand"), ("thigh", "shank", "foot")
    expected = [{f"{part}_{side}" for part in limb} for limb in (arm, leg) for side in ("left", "right")]
    assert [{body.segment_names[k] for k in own.nonzero()[:, 0]} for own in search.own] == expected
    assert len(set.union(*names)) == 16
    assert (search.places >= body.low[search.limbs][:, None]).all()
    assert (search.places <= body.high[search.limbs][:, None]).all()


@pytest.mark.parametrize("limb", range(4), ids=["left arm", "right arm", "left leg", "right leg"])
def test_a_limb_that_was_put_elsewhere_is_found_again(scene, limb):
    """Of the places found, the one that fits best ends within 5 cm in every joint."""
    body, registrar, search, pose, observation = scene
    own, size = search.limbs[limb], body.default_size(1)
    moved = pose.clone()
    # As far from where it is as its limits allow.
    low, high = body.low[own], body.high[own]
    moved[0, own] = torch.where(pose[0, own] - low > high - pose[0, own], low, high)
    assert worst_joint(body, moved, pose) > 0.4
    (found,) = search(observation, moved, size)
    assert found.shape == (4, 3, body.num_parameters)
    fitted = registrar(observation, found[limb], size, rounds=10, sigma_first=0.15)
    best = fitted.pose[fitted.score.argmin()][None]
    assert worst_joint(body, best, pose) < 0.05
    others = torch.ones(body.num_parameters, dtype=torch.bool)
    others[own] = False
    assert (found[limb][:, others] == moved[:, others]).all()


def test_every_limb_is_sought_alone(scene):
    body, _, search, pose, observation = scene
    (found,) = search(observation, pose, body.default_size(1))
    for limb, own in enumerate(search.limbs):
        changed = (found[limb] != pose).any(0).nonzero()[:, 0]
        assert set(changed.tolist()) <= set(own.tolist())
        rows = (search.places[limb][:, None] == found[limb][None, :, own]).all(2).any(0)
        assert rows.all()  # each is one of the places


def test_the_mirrored_scene_has_the_mirrored_limbs():
    """Equal parameters of left and right limbs are mirrored poses. Without rims, whose points are not mirrored."""
    body = BodyModel().double()
    camera = replace(CAMERA, cx=(CAMERA.width - 1) / 2)
    pose = standing(body)
    view = see(body, pose, num=200, camera=camera)
    search = LimbSearch(body, Registrar(body, RegistrationConfig(rim=RimConfig(weight=0.0))))
    size = body.default_size(1)
    other_pose = pose.clone()
    other_pose[:, 0] *= -1  # it faces the camera: the rest is its own mirror image but for the limbs
    left, right = search.limbs[[0, 2]], search.limbs[[1, 3]]
    other_pose[:, left], other_pose[:, right] = pose[:, right], pose[:, left]
    (found,) = search(view.observation(), pose, size)
    (other,) = search(mirrored(view).observation(), other_pose, size)
    for a, b in ((0, 1), (1, 0), (2, 3), (3, 2)):
        assert_close(other[b][:, search.limbs[b]], found[a][:, search.limbs[a]])


def test_frames_searched_together_have_the_places_of_each_alone(scene):
    body, _, search, pose, _ = scene
    poses = torch.cat([pose, standing(body, x=0.3, yaw=-0.3), standing(body, z=3.5)])
    sizes = torch.cat([body.size_of_height(height) for height in (1.6, 1.75, 1.9)])
    views = [see(body, p[None], s[None]) for p, s in zip(poses, sizes, strict=True)]
    found = search(together(views), poses, sizes)
    for k, view in enumerate(views):
        assert_close(found[k : k + 1], search(view.observation(), poses[k : k + 1], sizes[k : k + 1]))


def test_points_that_are_not_numbers_still_give_places(scene):
    body, _, search, pose, observation = scene
    points = torch.full_like(observation.cloud.points, torch.nan)
    broken = replace(observation, cloud=replace(observation.cloud, points=points))
    found = search(broken, pose, body.default_size(1))
    assert found.shape == (1, 4, 3, body.num_parameters)
    assert found.isfinite().all()


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"best": 0}, "1 <= best <= shortlist <= candidates must hold, got .*best=0"),
        ({"shortlist": 600}, "1 <= best <= shortlist <= candidates must hold, got .*shortlist=600"),
        ({"sigma": 0.0}, "sigma must be positive, in m, got 0.0"),
    ],
)
def test_bad_settings_are_told(setting, message):
    with pytest.raises(ValueError, match=message):
        LimbSearchConfig(**setting)


def test_half_of_the_points_weigh_as_much_as_all(scene):
    """Of points that stand twice every other one says what all say, to first order nearly what is exact."""
    body, _, _, pose, _ = scene
    observation, size = see(body, pose, num=200).observation(), body.default_size(1)
    alone = LimbSearch(body, Registrar(body, RegistrationConfig(rim=RimConfig(weight=0.0))))
    rest = alone._rest_of_body(observation, pose, size)
    places = alone.places[None]
    exact = alone._score(observation, pose, places, size, rest, exact=True)
    twice = torch.arange(observation.cloud.mask.shape[1]).repeat_interleave(2)
    cloud = observation.cloud
    doubled = replace(
        observation,
        cloud=replace(
            cloud,
            points=cloud.points[:, twice],
            pixels=cloud.pixels[:, twice],
            grid=cloud.grid[:, twice],
            mask=cloud.mask[:, twice],
            neighbours=cloud.neighbours[:, twice],
        ),
        potential=observation.potential[:, twice],
    )
    rough = alone._score(doubled, pose, places, size, rest[..., twice], exact=False)
    x, y = (score - score.mean(2, keepdim=True) for score in (exact, rough))
    slope = (x * y).sum(2) / x.square().sum(2)
    assert ((slope > 0.8) & (slope < 1.25)).all()
    assert ((x * y).sum(2) / (x.norm(dim=2) * y.norm(dim=2)) > 0.95).all()


@pytest.mark.parametrize("noise", [0.0, 0.006], ids=["exact", "noisy along rays"])
@pytest.mark.parametrize("outlier", [3.0, 0.0])
def test_a_pair_of_limbs_is_judged_as_the_whole_body_with_them(noise, outlier):
    """Beside every part's distance at each point, with rims, in a frame of two."""
    torch.manual_seed(0)
    body = BodyModel().double()
    # Without "no part" points far from all parts would lie more than the 80 nats below that are told apart.
    sigma = 0.03 if outlier > 0 else 0.15
    config = RegistrationConfig(outlier=outlier, sigma_last=sigma, rim=RimConfig(weight=1.0))
    search = LimbSearch(body, Registrar(body, config))
    truth = torch.cat([standing(body, yaw=0.2), standing(body, yaw=-0.4, x=0.3)])
    view = together([see(body, pose[None]) for pose in truth])
    view = replace(view, depth_noise=noise, potential=torch.randn_like(view.potential))
    size = 1 + 0.05 * torch.randn(2, len(body.size_names), dtype=torch.float64)
    places = truth[:, search.limbs][:, :, None] + 0.2 * torch.randn(2, 4, 3, 4, dtype=torch.float64)
    found = search.score_pairs(view, truth, places, size)
    assert found.shape == (2, 2, 3, 3)

    def log_density(frame, moved):
        one, posed = view.take(torch.tensor([frame])), body(moved[None], size[frame : frame + 1])
        far = rough_distance(search.registrar.pressed(posed, one)[0], one.cloud.points)[0]
        labels = one.potential[0].T - far**2 / (2 * config.sigma_last**2)
        if outlier > 0:
            labels = torch.cat([labels, torch.full_like(labels[:1], -(outlier**2) / 2)])
        there = one.cloud.mask[0]
        weight = min(1.0, config.effective_points / int(there.sum()))
        rims = silhouette_residual(posed, one.nearest, one.camera, config.rim)
        return weight * labels.logsumexp(0)[there].sum() - 0.5 * (rims**2).sum()

    assert search.pairs.tolist() == [[0, 1], [2, 3]]
    for frame in range(2):
        for pair, limbs in enumerate(search.pairs.tolist()):
            whole = torch.zeros(3, 3, dtype=torch.float64)
            for i in range(3):
                for j in range(3):
                    moved = truth[frame].clone()
                    for limb, place in zip(limbs, (i, j), strict=True):
                        moved[search.limbs[limb]] = places[frame, limb, place]
                    whole[i, j] = log_density(frame, moved)
            assert whole.std() > 1
            ours = found[frame, pair]
            # Silhouettes are in single precision.
            assert_close(ours - ours[0, 0], whole - whole[0, 0], atol=1e-4, rtol=0)
