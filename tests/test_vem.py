"""Registration of bodies that are seen exactly: poses, labels, uncertainty, batches, symmetry and the thesis's ways."""

from dataclasses import replace

import pytest
import torch
from synthetic_cloud import CAMERA, RELAXED, mirrored, padded, see, standing, together
from torch.testing import assert_close

from torchpose.body.ellipsoid import NEWTON_STEPS, foot_of_part, foot_point, outline, rough_distance
from torchpose.body.model import BodyConfig, BodyModel, JointKind
from torchpose.cli import load_config
from torchpose.least_squares import LMConfig, Status
from torchpose.registration import vem
from torchpose.registration.fitting import FittingConfig, JacobianKind, PosePrior
from torchpose.registration.geodesic import geodesic_bounds, geodesic_term
from torchpose.registration.labelling import LabellingConfig
from torchpose.registration.occlusion import OcclusionConfig, depth_behind
from torchpose.registration.silhouette import RimConfig
from torchpose.registration.size import stack_observations
from torchpose.registration.solid import SolidConfig
from torchpose.registration.vem import (
    Distance,
    Observation,
    Registrar,
    RegistrationConfig,
    is_finite,
)
from torchpose.vision.points import group_cells

DEGREES = torch.pi / 180
FROM_AFAR = RegistrationConfig(rounds=10, sigma_first=0.15)


@pytest.fixture(scope="module")
def scene():
    body = BodyModel()
    pose = standing(body, yaw=0.2)
    return body, pose, see(body, pose)


def off(pose, degrees, seed, metres=0.03):
    """Every joint parameter off by so many degrees, up or down, and the root by centimetres."""
    generator = torch.Generator().manual_seed(seed)
    kick = torch.zeros_like(pose)
    up = torch.randint(0, 2, (18,), generator=generator) * 2 - 1
    kick[:, 6:] = degrees * DEGREES * up.to(pose)
    kick[:, :3] = metres * torch.randn(3, generator=generator).to(pose)
    return pose + kick


def joint_errors(body, found, truth):
    """Distances of the 15 joints, m."""
    return (body(found.expand(len(found), -1)).joints - body(truth).joints).norm(dim=-1)


@pytest.mark.parametrize("degrees", [5, 15])
def test_poses_are_recovered_from_starts_off_in_every_joint(scene, degrees):
    body, pose, view = scene
    starts = torch.cat([off(pose, degrees, seed) for seed in range(8)])
    assert joint_errors(body, starts, pose).amax(1).min() > (0.05 if degrees == 5 else 0.15)
    found = Registrar(body, FROM_AFAR)(view.observation(), starts, body.default_size(1))
    error = joint_errors(body, found.pose, pose).amax(1)  # m, the worst joint of each start
    assert (error < 0.01).sum() >= 7
    assert error.max() < 0.03
    assert found.point_to_model.max() < 0.002
    assert found.misfit.max() < 0.003
    assert is_finite(found).all()


def test_other_poses_and_persons_are_recovered():
    """Random poses, sizes and places, seen with 5 mm of noise, from 10 degrees off: four of six to the centimetre."""
    body = BodyModel()
    errors = torch.stack([error_of_a_random_scene(body, seed) for seed in range(6)])
    assert (errors.mean(1) < 0.01).sum() >= 4
    assert (errors.mean(1) < 0.03).sum() >= 5
    assert errors.mean(1).max() < 0.06


def error_of_a_random_scene(body, seed):
    generator = torch.Generator().manual_seed(seed)
    pose = standing(
        body, yaw=float(torch.randn(1, generator=generator)) / 4, x=0.1 * seed, z=2.8 + 0.1 * seed
    )
    pose[:, 6:] += 0.2 * torch.randn(1, 18, generator=generator)
    size = 1 + 0.05 * torch.randn(1, len(body.size_names), generator=generator)
    view = see(body, pose, size, noise=0.005, generator=generator)
    found = Registrar(body, FROM_AFAR)(view.observation(), off(pose, 10, seed), size)
    return (body(found.pose, size).joints - body(pose, size).joints).norm(dim=-1)[0]


def test_the_truth_stays_and_its_labels_are_right(scene):
    body, pose, view = scene
    found = Registrar(body)(view.observation(), pose, body.default_size(1))
    assert joint_errors(body, found.pose, pose).max() < 0.012
    label = found.belief[0].argmax(0)
    seen = view.cloud.mask[0]
    assert (label == view.part[0])[seen].double().mean() > 0.9
    assert_close(found.belief.sum(1), view.cloud.mask.float())


def test_points_far_from_everything_have_no_part(scene):
    body, pose, view = scene
    points = view.cloud.points.clone()
    points[0, :20, 0] += 1.5
    observation = replace(view.observation(), cloud=replace(view.cloud, points=points))
    found = Registrar(body)(observation, pose, body.default_size(1))
    assert (found.belief[0, -1, :20] > 0.99).all()
    assert joint_errors(body, found.pose, pose).max() < 0.03


def test_distances_are_those_of_the_points(scene):
    body, pose, view = scene
    found = Registrar(body)(view.observation(), pose, body.default_size(1))
    distance = foot_point(body(found.pose), view.cloud.points).distance.amin(1) * view.cloud.mask
    assert_close(found.distance, distance)
    assert_close(found.point_to_model, (distance.sum() / view.cloud.mask.sum())[None])


def rim_energy(body, pose, observation, config):
    """Half the squares of the rims' ways out of the mask, one rim point after another."""
    total, focal = 0.0, observation.camera.focal_length
    H, W = observation.nearest.shape[1:3]
    for point in outline(body(pose), config.rim_points)[0].flatten(0, 1):
        pixel = observation.camera.project(point)
        u, v = (int(x) for x in pixel.round())
        if not (0 < pixel[0] < W - 1 and 0 < pixel[1] < H - 1):
            continue
        way = torch.tensor([u, v]).to(point) - observation.nearest[0, v, u]
        length = float((pixel - observation.nearest[0, v, u]) @ way / way.norm()) if way.any() else 0.0
        if length > 1:
            metres = min((length - 1) * float(point[2]) / focal, config.reach)
            total += 0.5 * config.weight * (metres / config.sd) ** 2
    return total


def label_distance(posed, points):
    """Exact for the two parts nearest to first order, to first order for the others; one point after another."""
    exact, rough = foot_point(posed, points).distance, rough_distance(posed, points)
    for b in range(len(rough)):
        for n in range(rough.shape[2]):
            two = rough[b, :, n].argsort()[:2]
            rough[b, two, n] = exact[b, two, n]
    return rough


def test_the_score_is_the_energy_of_points_hidden_parts_rims_prior_and_limits():
    """One by one, for poses that are ever further off; and it grows with them."""
    body = BodyModel().double()
    pose = standing(body, yaw=0.2)
    view = see(body, pose, num=120)
    alone = LabellingConfig(sweeps=0, potts=0.0)
    solid = SolidConfig(sd=0.0)
    config = RegistrationConfig(labelling=alone, rest_sd=0.0, effective_points=60.0, solid=solid)
    registrar, observation, size = Registrar(body, config), view.observation(), body.default_size(1)
    prior = PosePrior(pose + 0.01, torch.full_like(pose, 4.0))
    scores = []
    for degrees in (0, 3, 8, 20):
        there = off(pose, degrees, 1, metres=0.0)
        found = registrar.evaluate(observation, there, size, prior, torch.zeros(1, 1), torch.zeros(1).long())
        square = label_distance(body(there), view.cloud.points)[0].square() / (2 * config.sigma_last**2)
        behind = depth_behind(body(there), view.cloud.points)[0]
        each = -square - 5 * ((behind - 0.02) / 0.03).clamp(0, 1)
        points = 0.0
        for i in view.cloud.mask[0].nonzero()[:, 0].tolist():
            points -= float(torch.cat([each[:, i], torch.tensor([-4.5])]).double().logsumexp(0))
        points *= 60 / int(view.cloud.mask.sum())
        beyond = (there - body.high).clamp_min(0) + (body.low - there).clamp_min(0)
        rest = 2 * (there - prior.mean).square().sum() + 0.5 * (beyond / 0.05).square().sum()
        energy = points + rim_energy(body, there, observation, config.rim) + float(rest)
        assert float(found.score) == pytest.approx(energy, rel=1e-6)
        scores.append(energy)
    assert scores == sorted(scores)
    assert scores[-1] > scores[0] + 100


def test_gradients_through_the_whole_registration_are_finite(scene):
    """Points without a part have weight 0, whose root has no derivative."""
    body, pose, view = scene
    points = view.cloud.points.clone()
    points[0, :20, 0] += 1.5
    inputs = [points, view.observation().potential.clone(), body.default_size(1), pose.clone()]
    points, potential, size, mean = (x.requires_grad_() for x in inputs)
    observation = replace(view.observation(), cloud=replace(view.cloud, points=points), potential=potential)
    prior = PosePrior(mean, torch.full_like(pose, 2.0))
    found = Registrar(body)(observation, pose, size, prior)
    for name in ("pose", "covariance", "belief", "point_to_model", "misfit", "score", "bound"):
        value = getattr(found, name).sum()
        for gradient in torch.autograd.grad(value, (points, size, mean), retain_graph=True):
            assert gradient.isfinite().all()
            assert gradient.abs().max() > 0
    for gradient in torch.autograd.grad(found.score.sum(), (potential,)):
        assert gradient.isfinite().all()


@pytest.mark.parametrize("visible", [True, False])
def test_the_foot_on_one_part_is_that_of_all_parts(scene, visible):
    body, pose, view = scene
    starts = torch.cat([off(pose, 10, seed) for seed in range(3)])
    posed, points = body(starts), view.cloud.points.expand(3, -1, -1)
    part = torch.randint(body.num_parts, (3, 2, points.shape[1]))
    every = foot_point(posed, points, visible)
    own = foot_of_part(posed, part, points, visible, NEWTON_STEPS)
    few = foot_of_part(posed, part, points, visible)  # as registration takes it
    batch, point = torch.arange(3)[:, None, None], torch.arange(points.shape[1])
    for name in ("local", "normal", "residual", "hidden"):
        assert_close(getattr(own, name), getattr(every, name)[batch, part, point], rtol=0, atol=1e-5)
    assert_close(few.local, own.local, rtol=0, atol=5e-4)
    assert_close(few.distance, own.distance, rtol=0, atol=5e-5)


def test_a_batch_of_frames_equals_one_by_one():
    body = BodyModel().double()
    poses = [standing(body, yaw=yaw) for yaw in (-0.3, 0.0, 0.4)]
    views = [see(body, pose, num=150) for pose in poses]
    starts = torch.cat([off(pose, 4, seed) for seed, pose in enumerate(poses)])
    registrar, size = Registrar(body), body.default_size(1)
    prior = PosePrior(starts, torch.full_like(starts, 2.0))
    batch = registrar(together(views), starts, size, prior)
    for i, view in enumerate(views):
        alone = PosePrior(prior.mean[i : i + 1], prior.precision[i : i + 1])
        one = registrar(view.observation(), starts[i : i + 1], size, alone)
        for name in (
            "pose",
            "covariance",
            "belief",
            "distance",
            "point_to_model",
            "misfit",
            "score",
            "status",
        ):
            got, want = getattr(batch, name)[i : i + 1], getattr(one, name)
            assert_close(got, want, rtol=1e-6, atol=1e-8)
        assert_close(batch.bound[:, i : i + 1], one.bound)


def test_one_observation_serves_many_starts(scene):
    body, pose, view = scene
    starts = torch.cat([off(pose, 5, seed) for seed in range(3)])
    registrar, size = Registrar(body), body.default_size(1)
    cells = group_cells(view.cloud)
    observation = replace(
        view.observation(), geodesic=geodesic_term(cells, geodesic_bounds(body, size), outlier=True)
    )
    strong = RegistrationConfig(labelling=LabellingConfig(geodesic=0.04))
    for registrar in (Registrar(body), Registrar(body, strong)):
        batch = registrar(observation, starts, size)
        for i in range(3):
            one = registrar(observation, starts[i : i + 1], size)
            assert_close(batch.pose[i : i + 1], one.pose, rtol=0, atol=1e-3)


def test_broken_frames_leave_the_others_alone(scene):
    body, pose, view = scene
    observation = together([view, view, view])
    starts = torch.cat([off(pose, 4, seed) for seed in range(3)])
    registrar, size = Registrar(body), body.default_size(1)
    whole = registrar(observation, starts, size)
    points = observation.cloud.points.clone()
    points[1, 7] = torch.nan
    broken = replace(observation, cloud=replace(observation.cloud, points=points))
    found = registrar(broken, starts, size)
    others = [0, 2]
    assert torch.equal(found.pose[others], whole.pose[others])  # to the bit
    assert torch.equal(found.covariance[others], whole.covariance[others])
    assert is_finite(found).tolist() == [True, False, True]
    assert found.status[1] == Status.NON_FINITE
    assert torch.equal(found.pose[1], starts[1])

    lost = starts.clone()
    lost[1, 3] = torch.nan
    found = registrar(observation, lost, size)
    assert torch.equal(found.pose[others], whole.pose[others])
    assert is_finite(found).tolist() == [True, False, True]


def test_without_points_the_start_stays_where_the_priors_hold_it(scene):
    body, pose, view = scene
    cloud = replace(view.cloud, mask=torch.zeros_like(view.cloud.mask))
    config = RegistrationConfig(rest_sd=0.0, rim=RimConfig(weight=0.0))
    found = Registrar(body, config)(replace(view.observation(), cloud=cloud), pose, body.default_size(1))
    assert torch.equal(found.pose, pose)
    assert found.point_to_model == 0
    assert found.covariance.isinf().all()  # nothing is known


def test_the_covariance_is_one_and_shrinks_with_points(scene):
    body, pose, _ = scene
    variances = []
    for num in (40, 80, 140):  # below `effective_points`, beyond which points are worth no more
        view = see(body, pose, num=num)
        covariance = Registrar(body)(view.observation(), pose, body.default_size(1)).covariance[0]
        assert_close(covariance, covariance.mT, rtol=1e-4, atol=1e-7)
        assert (torch.linalg.eigvalsh(covariance.double()) > 0).all()
        variances.append(covariance.diagonal().log().mean())
    assert variances[0] > variances[1] + 0.2 > variances[2] + 0.4


def test_the_covariance_is_the_inverse_of_the_information_by_autograd(scene):
    body, pose, view = scene
    precise = replace(
        RegistrationConfig(), rim=RimConfig(weight=0.0), rest_sd=0.0, labelling=LabellingConfig(sweeps=0)
    )
    registrar, size = Registrar(body, precise), body.default_size(1)
    prior = PosePrior(pose, torch.full_like(pose, 3.0))
    found = registrar(view.observation(), pose, size, prior)
    posed = body(found.pose)
    foot = registrar.correspond(posed, view.observation())
    labelling = registrar.label(posed, foot, view.observation(), precise.sigma_last)
    rows, _ = registrar.rows(posed, foot, labelling, view.observation())

    def energy(p):
        """Minus the log-posterior of the pose where the correspondences stand, up to a constant."""
        gap = (rows.direction * (rows.target - rows.points(body(p[None])))).sum(-1)
        over = (p - body.high).clamp_min(0) - (body.low - p).clamp_min(0)
        limits = (over / precise.fitting.limit_sd).square().sum()
        return 0.5 * (gap.square().sum() + 3 * (p - prior.mean[0]).square().sum() + limits)

    hessian = torch.func.jacfwd(torch.func.jacrev(energy))(found.pose[0])
    # Gauss-Newton leaves out what is quadratic in the small residuals.
    sd, own = (m.diagonal().sqrt() for m in (torch.linalg.inv(hessian), found.covariance[0]))
    assert_close(own, sd, rtol=0.1, atol=0)


def test_noise_scatters_poses_as_the_covariance_says(scene):
    """20 draws of independent noise, every point its own measurement: scatter and covariance agree within 2."""
    body, pose, _ = scene
    config = RegistrationConfig(
        noise_sd=0.01,
        effective_points=1e9,
        tangential=0.0,
        robust_sd=0.0,
        rest_sd=0.0,
        rim=RimConfig(weight=0.0),
    )
    generator = torch.Generator().manual_seed(1)
    views = [see(body, pose, num=200, noise=0.01, generator=generator) for _ in range(20)]
    weak = PosePrior(pose.expand(20, -1), torch.full((20, 24), 1.0))
    found = Registrar(body, config)(together(views), pose.expand(20, -1), body.default_size(1), weak)
    scatter = found.pose.std(0)
    stated = found.covariance.diagonal(dim1=1, dim2=2).mean(0).sqrt()
    ratio = (scatter / stated).log().median().exp()
    assert 0.5 < ratio < 2.0


def test_the_mirrored_scene_has_the_mirrored_pose():
    """Equal parameters of left and right limbs are mirrored poses; yaw, roll, x and sideways bends change sign."""
    body = BodyModel().double()
    camera = replace(CAMERA, cx=(CAMERA.width - 1) / 2)
    pose = standing(body, yaw=0.2, x=0.15)
    view = see(body, pose, num=200, camera=camera)
    # Without the silhouette, of whose rims we take a few points that are not mirrored.
    registrar = Registrar(body, RegistrationConfig(rim=RimConfig(weight=0.0)))
    start = off(pose, 4, 0)
    found = registrar(view.observation(), start, body.default_size(1))
    other = registrar(mirrored(view).observation(), mirror_pose(body, start), body.default_size(1))
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    swap = [body.joint_names.index(swapped(name)) for name in body.joint_names]
    there, back = body(found.pose).joints, body(other.pose).joints[:, swap] * flip
    assert_close(back, there, rtol=0, atol=1e-5)
    assert_close(other.misfit, found.misfit, rtol=0, atol=1e-6)


def swapped(name):
    sides = {"left": "right", "right": "left"}
    return "_".join(sides.get(word, word) for word in name.split("_"))


def mirror_pose(body, pose):
    """The mirrored person's pose, through the limbs' directions."""
    flip = torch.tensor([-1.0, 1.0, 1.0]).to(pose)
    directions = body.limb_directions(body(pose)) * flip
    names = body.body_names[1:]
    directions = directions[:, [names.index(swapped(name)) for name in names]]
    sign = torch.tensor([-1.0, 1.0, -1.0]).to(pose)  # yaw, pitch, roll
    return body.pose_from_directions(pose[:, :3] * flip, pose[:, 3:6] * sign, directions)


THESIS = load_config("infer", ["registration=thesis"]).pose


def with_geodesics(body, view, outlier):
    bounds = geodesic_bounds(body, body.default_size(1))
    return replace(view.observation(), geodesic=geodesic_term(group_cells(view.cloud), bounds, outlier))


def test_the_thesis_as_written_runs_and_stays_near():
    body = BodyModel(THESIS.body)
    assert body.config.joint is JointKind.revolute
    pose = standing(body)
    view = see(body, pose)
    registrar = Registrar(body, THESIS.registration)
    found = registrar(with_geodesics(body, view, False), off(pose, 5, 0), body.default_size(1))
    assert found.belief.shape[1] == 14  # no outliers
    assert is_finite(found).all()
    assert joint_errors(body, found.pose, pose).mean() < 0.15


@pytest.mark.parametrize(
    "switch",
    [
        {"distance": Distance.algebraic},
        {"near": 1},
        {"near": 14},
        {"visible": False},
        {"outlier": 0.0},
        {"hard": False},
        {"tangential": 1.0},
        {"robust_sd": 0.0},
        {"rest_sd": 0.0},
        {"rim": RimConfig(weight=0.0)},
        {"labelling": LabellingConfig(sweeps=0, potts=0.0)},
        {"labelling": LabellingConfig(coloured=True)},
        {"labelling": LabellingConfig(geodesic=0.04)},
        {"fitting": FittingConfig(limit_sd=0.0, lm=LMConfig(max_steps=10))},
        {"fitting": FittingConfig(jacobian=JacobianKind.autograd)},
    ],
    ids=str,
)
def test_every_switch_still_finds_the_pose(scene, switch):
    """Each way of the thesis, or of ours, alone: from 4 degrees off the mean error shrinks below 4 cm."""
    body, pose, view = scene
    config = replace(RegistrationConfig(sigma_first=0.05), **switch)
    observation = with_geodesics(body, view, outlier=config.outlier > 0)
    start = off(pose, 4, 3)
    found = Registrar(body, config)(observation, start, body.default_size(1))
    assert joint_errors(body, found.pose, pose).mean() < 0.04
    assert found.bound.shape == (config.rounds, 1)
    assert found.bound.isfinite().all()


def test_sigma_falls_geometrically_and_silhouette_and_hidden_parts_come_last(scene):
    body, pose, view = scene

    class Watched(Registrar):
        def label(self, posed, foot, observation, sigma, occlude=True):
            sigmas.append(sigma)
            hidden.append(occlude)
            return super().label(posed, foot, observation, sigma, occlude)

        def rows(self, posed, foot, labelling, observation, rim=True):
            rims.append(rim)
            return super().rows(posed, foot, labelling, observation, rim)

    sigmas, rims, hidden = [], [], []
    config = RegistrationConfig(rounds=3, sigma_first=0.08, sigma_last=0.02, rim=RimConfig(last_rounds=1))
    Watched(body, config)(view.observation(), pose, body.default_size(1))
    assert sigmas == pytest.approx([0.08, 0.04, 0.02, 0.02])  # the last one is for the answer itself
    assert rims == [False, False, True, True]
    assert hidden == [False, True, True, True]
    sigmas, rims, hidden = [], [], []
    Watched(body, config)(view.observation(), pose, body.default_size(1), rounds=2, sigma_first=0.5)
    assert sigmas == pytest.approx([0.5, 0.02, 0.02])


def test_jacobians_agree_on_the_answer(scene):
    body, pose, view = scene
    start = off(pose, 4, 1)
    poses = [
        Registrar(body, RegistrationConfig(fitting=FittingConfig(jacobian=kind)))(
            view.observation(), start, body.default_size(1)
        ).pose
        for kind in JacobianKind
    ]
    assert_close(*poses, rtol=0, atol=1e-3)


def test_an_unseen_limb_is_drawn_to_rest_and_a_seen_one_is_not(scene):
    body, pose, view = scene
    arm = [i for i, name in enumerate(body.parameter_names) if "arm_left" in name]
    limb = [body.segment_names.index(f"{name}_left") for name in ("upper_arm", "forearm", "hand")]
    keep = view.cloud.mask[0] & ~torch.isin(view.part[0], torch.tensor(limb))
    cloud = replace(view.cloud, mask=keep[None], points=view.cloud.points * keep[None, :, None])
    config = RegistrationConfig(rim=RimConfig(weight=0.0), rounds=10)
    found = Registrar(body, config)(replace(view.observation(), cloud=cloud), pose, body.default_size(1))
    before = (pose[0, arm] - body.rest[torch.tensor(arm) - 6]).abs().sum()
    after = (found.pose[0, arm] - body.rest[torch.tensor(arm) - 6]).abs().sum()
    assert after < 0.6 * before
    sd = found.covariance[0].diagonal().sqrt()
    right = [i for i, name in enumerate(body.parameter_names) if "arm_right" in name]
    # But for the first of an elbow, the turn about the upper arm, which an almost straight one does not show.
    pairs = [(a, b) for a, b in zip(arm, right, strict=True) if body.parameter_names[a] != "forearm_left_1"]
    assert all(sd[a] > 2 * sd[b] for a, b in pairs)


def test_without_a_compiler_registration_goes_on_with_one_warning(scene, monkeypatch):
    body, pose, view = scene

    def missing(function):
        def fail(*_):
            raise RuntimeError("no g++ here\nand more")

        return fail

    monkeypatch.setattr(torch, "compile", missing)
    vem.compiling_works.cache_clear()
    config = RegistrationConfig(compile=True)
    told = r"compile=true needs a compiler, going on without: no g\+\+ here; install one, or leave compile=false$"
    with pytest.warns(UserWarning, match=told):
        registrar = Registrar(body, config)
    again = Registrar(body, config)  # no other warning
    vem.compiling_works.cache_clear()
    plain = Registrar(body)(view.observation(), pose, body.default_size(1))
    for compiled in (registrar, again):
        found = compiled(view.observation(), pose, body.default_size(1))
        assert torch.equal(found.pose, plain.pose)


def test_compiling_takes_the_stages_of_a_round(scene, monkeypatch):
    """The compiler's stand-in counts what it is given and what runs; real compiling takes minutes."""
    body, pose, view = scene
    given, run = [], []

    def counting(function):
        given.append(function.__name__)

        def counted(*arguments, **named):
            run.append(function.__name__)
            return function(*arguments, **named)

        return counted

    monkeypatch.setattr(vem, "compiling_works", lambda device: True)
    monkeypatch.setattr(torch, "compile", counting)
    registrar = Registrar(body, RegistrationConfig(compile=True))
    assert given == list(vem.STAGES)
    registrar(view.observation(), pose, body.default_size(1))
    rounds = RegistrationConfig().rounds
    assert [run.count(stage) for stage in vem.STAGES] == [rounds + 1] * 3 + [rounds]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"rounds": 0}, "rounds must be at least 1, got 0"),
        ({"near": 0}, "near must be at least 1, got 0"),
        ({"sigma_first": 0.0}, "sigma_first must be positive, got 0.0"),
        ({"robust_sd": -1.0}, "robust_sd must not be negative, got -1.0; 0 switches it off"),
    ],
)
def test_bad_settings_are_told(setting, message):
    with pytest.raises(ValueError, match=message.replace(".", r"\.")):
        RegistrationConfig(**setting)


def test_an_observation_expands_without_copying(scene):
    body, _, view = scene
    observation: Observation = with_geodesics(body, view, True).expand(5)
    assert observation.cloud.points.shape[0] == observation.geodesic.distance.shape[0] == 5
    assert observation.cloud.points.data_ptr() == view.cloud.points.data_ptr()
    assert padded(torch.ones(2), 3, 0.0).tolist() == [[1.0, 1.0, 0.0]]


def test_revolute_joints_register_too():
    body = BodyModel(BodyConfig(joint=JointKind.revolute))
    pose = standing(body)
    found = Registrar(body)(see(body, pose).observation(), off(pose, 4, 0), body.default_size(1))
    assert joint_errors(body, found.pose, pose).mean() < 0.03


def _noisy(body, pose, sd, seed):
    """A view whose depths are off by `sd` at 4.4 m, and what registration sees of it with and without knowing."""
    view = see(body, pose, num=400, noise=sd, generator=torch.Generator().manual_seed(seed))
    plain = view.observation()
    return plain, replace(plain, depth_noise=sd / 4.4**2)


def test_noise_along_rays_is_not_taken_for_shape():
    """Twelve centimetres, as of a matcher at 4.4 m: who knows of it is nearer to the truth, and fewer points stray."""
    body = BodyModel()
    errors, strays = [], []
    for seed in range(6):
        pose = standing(body, yaw=0.3 * seed - 0.9, z=4.4)
        registrar, size = Registrar(body), body.default_size(1)
        start = pose + 0.08 * torch.randn(pose.shape, generator=torch.Generator().manual_seed(seed))
        true = body(pose, size).joints
        for observation in _noisy(body, pose, 0.12, seed):
            found = registrar(observation, start, size, None, 12)
            errors.append(float((body(found.pose, size).joints - true).norm(dim=-1).mean()))
            strays.append(float(found.belief[0, -1].sum() / observation.cloud.mask.sum()))
    assert sum(errors[1::2]) < 0.9 * sum(errors[::2])
    assert all(knowing < plain for plain, knowing in zip(strays[::2], strays[1::2], strict=True))


def test_noise_below_the_settings_own_changes_nothing(scene):
    body = BodyModel()
    pose = standing(body)
    observation = see(body, pose).observation()
    registrar, size = Registrar(body), body.default_size(1)
    quiet = replace(observation, depth_noise=0.5 * registrar.config.ray_sd / 3.6**2)
    assert_close(
        registrar(quiet, pose, size).pose, registrar(observation, pose, size).pose, atol=1e-4, rtol=0
    )


def test_a_noisy_batch_equals_one_by_one():
    body = BodyModel()
    poses = [standing(body, yaw=yaw, z=z) for yaw, z in ((0.0, 3.9), (0.7, 4.6))]
    each = [_noisy(body, pose, 0.08, k)[1] for k, pose in enumerate(poses)]
    registrar, size = Registrar(body), body.default_size(1)
    both = registrar(stack_observations(each), torch.cat(poses), size)
    for k, (observation, pose) in enumerate(zip(each, poses, strict=True)):
        alone = registrar(observation, pose, size)
        assert_close(both.pose[k : k + 1], alone.pose, atol=1e-4, rtol=0)
        assert_close(both.misfit[k : k + 1], alone.misfit, atol=1e-4, rtol=0)


def test_near_limbs_are_told_from_far_ones_by_what_hides_what():
    """In profile, limbs exchanged and the body nearer by their gap: what would be hidden cannot have been seen.

    The points are cast at the true pose's ellipsoids; the margin is in nats of a frame.
    """
    body, directions = BodyModel(), RELAXED.clone()
    directions[5:7] = torch.tensor([[0.1, 1.0, -0.4], [0.1, 1.0, -0.2]])
    directions[7:9] = torch.tensor([[-0.1, 1.0, 0.2], [-0.1, 1.0, 0.5]])
    exchanged = directions[[0, 3, 4, 1, 2, 7, 8, 5, 6]]
    generator = torch.Generator().manual_seed(0)
    poses = torch.cat([standing(body, directions, yaw=1.57), standing(body, exchanged, yaw=1.57, z=2.8)])
    view = see(body, poses[:1], noise=0.06, generator=generator)
    noisy = replace(view.observation(), depth_noise=0.06 / 9)

    def margin(penalty, observation):
        config = RegistrationConfig(occlusion=OcclusionConfig(penalty=penalty))
        found = Registrar(body, config).evaluate(
            observation,
            poses,
            body.default_size(1),
            PosePrior(poses, torch.zeros_like(poses)),
            torch.zeros(1, 2),
            torch.zeros(2, dtype=torch.long),
            covariance=False,
        )
        return float(found.score[1] - found.score[0])

    assert margin(5.0, noisy) > margin(0.0, noisy) + 20
    assert margin(5.0, noisy) > 20
