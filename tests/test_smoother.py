"""The smoother: its covariances against fits to shifted points and drift, its habits by views."""

import math
from dataclasses import replace

import pytest
import torch
from synthetic_cloud import RELAXED, see, standing, together
from test_chain import random_precisions
from test_fitting import body_of, random_pose, random_size, rows_of
from torch.testing import assert_close

from torchpose.body.model import BodyModel
from torchpose.least_squares import Status
from torchpose.registration.fitting import FittingConfig, PosePrior, equations_by_moments
from torchpose.registration.silhouette import RimConfig
from torchpose.registration.start import turned_by
from torchpose.registration.vem import Registrar, Registration, RegistrationConfig
from torchpose.registration.walk import WalkConfig, walking_yaw
from torchpose.tracking.chain import Chain, fit_chain
from torchpose.tracking.limb_hypothesis import HypothesisConfig
from torchpose.tracking.smoother import Message, Smoother, SmoothingConfig, _unwound


@pytest.fixture(scope="module")
def body():
    return BodyModel()


@pytest.mark.parametrize("sds", [(0.02, 0.0), (0.0, 0.05), (0.01, 0.03)])
def test_what_a_parts_points_have_in_common_misleads_all_frames_as_fits_to_shifted_points_do(sds):
    """Every part's points shifted in all frames along each of its axes, and the chain fitted anew."""
    torch.manual_seed(2)
    body = body_of()
    T, tiny = 3, 1e-5
    truth = random_pose(body, 1, spread=0.3).expand(T, -1)  # no tension: the equations are linear near here
    size = random_size(body)
    rows = rows_of(body, truth, size, per_part=6)
    rows = replace(
        rows, direction=rows.direction / 0.02 * (rows.part != 10)[..., None]
    )  # one that is not seen
    rest = PosePrior(truth, torch.full_like(truth, 0.3))
    chain = Chain(
        torch.full((T - 1, body.num_parameters), 40.0, dtype=torch.float64),
        truth[0],
        torch.eye(body.num_parameters, dtype=torch.float64),
    )

    def equations_of(some):
        return equations_by_moments(body, size, some, rest, FittingConfig(limit_sd=0.0), body(truth, size))

    before, expected, _ = fit_chain(equations_of(rows), truth, chain, 8)
    for k in range(body.num_parts):
        for axis, sd in enumerate((sds[0], sds[0], sds[1])):
            shift = torch.zeros(body.num_parts, 3, dtype=torch.float64)
            shift[k, axis] = tiny
            moved = replace(rows, local=rows.local + shift[rows.part])
            way = (fit_chain(equations_of(moved), before, chain, 8)[0] - before) * sd / tiny
            expected = expected + way[:, :, None] * way[:, None]
    smoother = Smoother(body, Registrar(body), SmoothingConfig(offset_sd=sds[0], slide_sd=sds[1], piece=1.0))
    found = smoother._covariance(equations_of(rows), before, size, chain)
    assert_close(found, expected, rtol=1e-3, atol=1e-6)


def test_a_limb_of_which_only_the_top_shows_turns_by_more_than_one_that_shows_in_full(body, scene):
    """With the legs hidden but for 3 cm below the hips, a shift of 3 cm is worth 0.2 rad and more of the thigh."""
    pose, observation, registrar, _ = scene
    pose, observation = pose[:2], observation.take(torch.tensor([0, 1]))
    hips = body(pose).joints[:, 9:11, 1].mean(1)[:, None]
    shown = observation.cloud.mask & (observation.cloud.points[..., 1] < hips + 0.03)
    sds = []
    for mask in (observation.cloud.mask, shown):
        seen = replace(observation, cloud=replace(observation.cloud, mask=mask))
        found = registrar(seen, pose, body.default_size(1))
        each = []
        for offset in (0.0, 0.03):
            config = SmoothingConfig(
                rest_time=2.0,  # longer than the frames: rest hardly holds the limbs
                offset_sd=offset,
                slide_sd=0.0,
                piece=1.0,
                hypotheses=HypothesisConfig(sweeps=0),
            )
            smooth = Smoother(body, registrar, config)(seen, times(2), found, body.default_size(1))
            each.append(smooth.registration.covariance[0].diagonal())
        sds.append((each[1] - each[0]).clamp_min(0).sqrt())
    raised = [body.parameter_names.index(f"thigh_{side}_1") for side in ("left", "right")]
    assert (sds[1][raised] > 0.2).all()
    assert (sds[1][raised] > 2 * sds[0][raised]).all()


def test_points_near_a_joint_alone_say_little_of_the_limb(body, scene):
    """With the legs hidden but for their tops, against equations in which every point counts."""
    pose, observation, _, _ = scene
    below = observation.cloud.points[..., 1] - body(pose).joints[:, 9:11, 1].mean(1)[:, None]
    cloud = replace(observation.cloud, mask=observation.cloud.mask & (below < 0.1))
    observation, size = replace(observation, cloud=cloud), body.default_size(1)
    registrar = Registrar(body, RegistrationConfig(rim=RimConfig(weight=0.0)))  # points alone
    smoother, posed = Smoother(body, registrar), body(pose, size)
    found = smoother._equations(observation, pose, size, times(6)).of_rows(posed)
    foot = registrar.correspond(posed, observation)
    labelling = registrar.label(posed, foot, observation, registrar.config.sigma_last)
    rows, _ = registrar.rows(posed, foot, labelling, observation)
    nothing = PosePrior(pose, torch.zeros_like(pose))
    whole = equations_by_moments(body, size, rows, nothing, registrar.config.fitting, posed).of_rows(posed)
    found, whole = (x[:, :-1, :-1].diagonal(dim1=1, dim2=2).mean(0) for x in (found, whole))
    thigh = [i for i, name in enumerate(body.parameter_names) if name.startswith("thigh")]
    assert (whole[thigh] > 1).all()
    assert (found[thigh] < 0.01 * whole[thigh]).all()
    assert (found[:6] > 0.4 * whole[:6]).all()
    assert (found[arm(body)] > 0.3 * whole[arm(body)]).all()


@pytest.mark.parametrize("turns", [(), (3,), (1, 4)])
@pytest.mark.parametrize("before", [None, 5.9, -7.0])
def test_angles_are_unwound_over_two_pi(turns, before):
    truth = torch.linspace(2.5, 5.0, 6, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0.1, -1.0])
    wrapped = torch.atan2(truth.sin(), truth.cos())
    for t in turns:
        wrapped[t] = wrapped[t] + 2 * torch.pi
    message = None
    if before is not None:
        message = Message(0.0, torch.full((24,), before, dtype=torch.float64), torch.eye(24))
    got = _unwound(wrapped, message)
    assert (got.diff(dim=0).abs() < 0.6).all()  # as the truth, whose steps are half a radian
    assert_close(got.sin(), truth.sin())
    assert_close(got.cos(), truth.cos())
    assert_close(got.diff(dim=0), truth.diff(dim=0))
    near = wrapped[0] if before is None else torch.full((3,), before, dtype=torch.float64)
    assert ((got[0] - near).abs() <= torch.pi).all()


# With a body.

DT = 0.1


def walk(body, T, angles=None):
    """The left arm rises to the side a little from frame to frame."""
    poses = []
    for t in range(T):
        directions = RELAXED.clone()
        angle = torch.tensor(0.5 + 0.05 * t if angles is None else angles[t])
        directions[1] = directions[2] = torch.stack([angle.sin(), angle.cos(), torch.tensor(-0.1)])
        poses.append(standing(body, directions, x=0.01 * t))
    return torch.cat(poses)


def times(T):
    return DT * torch.arange(T, dtype=torch.float64)


@pytest.fixture(scope="module")
def scene(body):
    """Six frames, and their registrations from a little off."""
    pose = walk(body, 6)
    generator = torch.Generator().manual_seed(0)
    views = [see(body, row[None], num=200, noise=0.003, generator=generator) for row in pose]
    observation, registrar = together(views), Registrar(body)
    return pose, observation, registrar, registrar(observation, pose + 0.02, body.default_size(1))


def arm(body):
    return [
        i
        for i, name in enumerate(body.parameter_names)
        if name.startswith(("upper_arm_left", "forearm_left"))
    ]


def miss(body, found, pose):
    """Mean distance of the joints, m."""
    return (body(found.pose).joints - body(pose).joints).norm(dim=-1).mean(1)


def test_a_limb_lost_in_one_frame_is_recovered_from_a_neighbour(body, scene):
    pose, observation, registrar, found = scene
    names = arm(body)
    lost = found.pose.clone()
    lost[2, names] = walk(body, 1, [2.8])[0, names]  # raised
    lost = registrar.evaluate(
        observation, lost, body.default_size(1), PosePrior(lost, lost * 0), found.bound, found.status
    )
    assert miss(body, lost, pose)[2] > 0.08
    smooth = Smoother(body, registrar)(observation, times(6), lost, body.default_size(1)).registration
    assert miss(body, smooth, pose).max() < 0.03
    # Without other places of the limbs the smoother does not leave the wrong one.
    config = SmoothingConfig(hypotheses=HypothesisConfig(sweeps=0))
    kept = Smoother(body, registrar, config)(observation, times(6), lost, body.default_size(1)).registration
    assert miss(body, kept, pose)[2] > 2 * miss(body, smooth, pose)[2]


def test_a_frame_without_points_has_its_neighbours_pose_and_greater_doubt(body, scene):
    pose, observation, registrar, found = scene
    registrar = Registrar(body, RegistrationConfig(rim=RimConfig(weight=0.0)))
    mask = observation.cloud.mask.clone()
    mask[2:4] = False
    blind = replace(observation, cloud=replace(observation.cloud, mask=mask))
    # One place for each limb: several add what a bridge between two frames does not know.
    nowhere = HypothesisConfig(sweeps=0)
    alone = SmoothingConfig(rest_time=2.0, hypotheses=nowhere, offset_sd=0.0, slide_sd=0.0)
    smoother = Smoother(body, registrar, alone)
    size = body.default_size(1)
    seen = smoother(observation, times(6), found, size).registration
    smooth = smoother(blind, times(6), found, size).registration
    assert miss(body, smooth, pose)[2:4].max() < 0.03
    sd = smooth.covariance.diagonal(dim1=1, dim2=2).sqrt()
    assert (sd[2:4] > seen.covariance.diagonal(dim1=1, dim2=2).sqrt()[2:4]).all()
    # Between two seen frames at most that of the bridge over the gap and of the surer end together.
    rate = torch.full((24,), smoother.config.joint_drift)
    rate[:6] = smoother.config.root_drift
    for t, near, far in ((2, 1, 4), (3, 4, 1)):
        bridge = rate**2 * DT * abs(t - near) * abs(far - t) / abs(far - near)
        ends = torch.maximum(sd[near], sd[far]) ** 2
        assert (sd[t] ** 2 <= bridge + ends).all()


def test_a_row_that_is_not_finite_is_filled_and_told(body, scene):
    pose, observation, registrar, found = scene
    broken = found.pose.clone()
    broken[3] = torch.nan
    spoiled = replace(found, pose=broken)
    smooth = Smoother(body, registrar)(observation, times(6), spoiled, body.default_size(1)).registration
    assert smooth.pose.isfinite().all()
    assert smooth.covariance.isfinite().all()
    assert miss(body, smooth, pose).max() < 0.03
    assert (smooth.status == int(Status.NON_FINITE)).tolist() == [False] * 3 + [True] + [False] * 2
    points = observation.cloud.points.clone()
    points[3, :, 2] = torch.nan
    unclear = replace(observation, cloud=replace(observation.cloud, points=points))
    smooth = Smoother(body, registrar)(unclear, times(6), spoiled, body.default_size(1)).registration
    assert smooth.pose.isfinite().all()
    assert miss(body, smooth, pose)[[0, 1, 2, 4, 5]].max() < 0.03
    assert miss(body, smooth, pose)[3] < 0.06


def test_a_turn_of_two_pi_between_frames_is_none(body, scene):
    _, observation, registrar, found = scene
    size = body.default_size(1)
    smoother = Smoother(body, registrar, SmoothingConfig())
    turned = found.pose.clone()
    turned[2::2, 3] += 2 * torch.pi
    straight = smoother(observation, times(6), found, size).registration
    smooth = smoother(observation, times(6), replace(found, pose=turned), size).registration
    assert_close(smooth.pose, straight.pose, rtol=0, atol=1e-4)


def test_one_frame_alone_keeps_its_pose(body, scene):
    pose, observation, _, _ = scene
    registrar = Registrar(body, RegistrationConfig(tangential=0.0))
    one = observation.take(torch.tensor([1]))
    found = registrar(one, pose[1:2], body.default_size(1))
    config = SmoothingConfig(rounds=12, offset_sd=0.0, slide_sd=0.0)
    smooth = Smoother(body, registrar, config)(one, times(1), found, body.default_size(1))
    assert miss(body, smooth.registration, pose[1:2]).max() < 0.02
    # Feet and labels are renewed in between, which moves weights a little.
    sds = [
        x.diagonal(dim1=1, dim2=2).sqrt()
        for x in (torch.linalg.inv(smooth.filtered), smooth.registration.covariance)
    ]
    assert_close(*sds, rtol=0.1, atol=0)


@pytest.mark.parametrize("rest_time", [0.5, 2.0])
def test_an_unseen_limb_comes_to_rest_as_drift_and_rest_say(body, scene, rest_time):
    """Against the continuous process: x'' = x / l^2, and the variance that drift and pull balance, drift^2 l / 2."""
    pose, observation, _, found = scene
    drift, rest_sd, dt, T = 0.7, 0.4, 0.04, 141
    long = rest_sd * rest_time**0.5 / drift
    registrar = Registrar(body, RegistrationConfig(rim=RimConfig(weight=0.0), rest_sd=rest_sd))
    cloud = replace(observation.cloud, mask=torch.zeros_like(observation.cloud.mask))
    every = torch.zeros(T, dtype=torch.long)
    blind = replace(observation, cloud=cloud).share(every)
    begin = torch.cat([pose[0, :6], body.rest])
    bent = begin.clone()
    joint = body.parameter_names.index("forearm_left_2")
    bent[joint] += 0.2
    config = SmoothingConfig(joint_drift=drift, rest_time=rest_time, hypotheses=HypothesisConfig(sweeps=0))
    smooth = Smoother(body, registrar, config)(
        blind,
        dt * torch.arange(1, T + 1, dtype=torch.float64),
        replace(found.take(every), pose=begin.expand(T, -1)),
        body.default_size(1),
        Message(0.0, bent, 1e8 * torch.eye(24).to(bent)),
    ).registration
    seconds = dt * torch.arange(1, T + 1, dtype=torch.float64)
    gone = seconds < 3 * long
    expected = (0.2 * (-seconds / long).exp()).to(begin)
    assert_close((smooth.pose[:, joint] - begin[joint])[gone], expected[gone], rtol=0.02, atol=0.002)
    last = smooth.covariance[T // 2 : T // 2 + 10, joint, joint]
    assert_close(last, torch.full_like(last, drift**2 * long / 2), rtol=0.02, atol=0)


def test_a_message_holds_the_first_frame_and_survives_its_state(body, scene):
    """A sure message outweighs the frame; one from long ago, or of precision 0, hardly counts."""
    pose, observation, registrar, found = scene
    size = body.default_size(1)
    told = Message(-1e-3, pose[0] + 0.05, 1e8 * torch.eye(24))
    still = SmoothingConfig(joint_drift=1e-3, root_drift=1e-3)
    held = Smoother(body, registrar, still)(
        observation, times(6), found, size, Message.from_state(told.state())
    ).registration.pose
    assert (held[0] - told.pose).abs().max() < 0.01
    smoother = Smoother(body, registrar, SmoothingConfig())
    free = smoother(observation, times(6), found, size).registration.pose
    long_ago = smoother(observation, times(6), found, size, replace(told, time_s=-1e6)).registration.pose
    assert_close(long_ago, free, rtol=0, atol=1e-3)
    silent = replace(told, precision=torch.zeros(24, 24))
    assert_close(smoother(observation, times(6), found, size, silent).registration.pose, free)


def test_the_link_to_a_message_is_its_precision_after_the_drift(body):
    config = SmoothingConfig(joint_drift=2.0, root_drift=0.3)
    generator = torch.Generator().manual_seed(0)
    P = random_precisions(1, 24, generator)[0]
    pose = torch.zeros(2, 24, dtype=torch.float64)
    chain = Smoother(body, Registrar(body), config)._chain(
        torch.tensor([1.0, 1.5], dtype=torch.float64), pose, Message(0.6, pose[0], P)
    )
    variance = torch.tensor([0.09] * 6 + [4.0] * 18, dtype=torch.float64)
    assert_close(chain.pull[0], 1 / (0.5 * variance))
    assert_close(chain.link, torch.linalg.inv(torch.linalg.inv(P) + (0.4 * variance).diag()))


def test_a_batch_of_sizes_is_one_for_each_frame(body, scene):
    _, observation, registrar, found = scene
    smoother = Smoother(body, registrar, SmoothingConfig(rounds=1))
    one = smoother(observation, times(6), found, body.default_size(1)).registration
    many = smoother(observation, times(6), found, body.default_size(6)).registration
    assert_close(many.pose, one.pose, rtol=0, atol=1e-4)


def test_no_rounds_leave_the_poses_and_tell_nothing(body, scene):
    _, observation, registrar, found = scene
    smoother = Smoother(body, registrar, SmoothingConfig(rounds=0))
    smooth = smoother(observation, times(6), found, body.default_size(1))
    assert torch.equal(smooth.registration.pose, found.pose)
    assert torch.equal(smooth.registration.covariance, found.covariance)
    assert not smooth.filtered.any()


@pytest.mark.parametrize("labelled", [True, False])
def test_the_truth_lies_within_two_sd(body, labelled):
    """Random poses of a chain, points of known noise: of 24 parameters in all frames 90 to 99 % within 2 sd.

    With the true labels told 95.7 % are; with labels found at a sigma near the noise 92.9 %. At a sigma of 2 cm it is
    60 % (noise 2 mm): beside the joints labels are wrong by more than the noise.
    """
    noise, T = 0.002, 4
    config = SmoothingConfig(rounds=6, joint_drift=0.3, root_drift=0.2, offset_sd=0.0, slide_sd=0.0)
    registrar = Registrar(
        body,
        RegistrationConfig(
            noise_sd=noise,
            robust_sd=0.0,
            rest_sd=0.0,
            tangential=0.0,
            effective_points=1e6,
            rim=RimConfig(weight=0.0),
            sigma_first=0.03,
            sigma_last=3 * noise,
            fitting=FittingConfig(limit_sd=0.0),
        ),
    )
    rate = torch.full((24,), config.joint_drift)
    rate[:6] = config.root_drift
    generator, off = torch.Generator().manual_seed(1), []
    for _ in range(6):
        steps = torch.randn(T - 1, 24, generator=generator) * rate * math.sqrt(DT)
        pose = standing(body) + torch.cat([torch.zeros(1, 24), steps.cumsum(0)])
        views = [see(body, row[None], num=300) for row in pose]
        observation = together(views)
        # `see` moves points along rays alone; the rows assume noise in all directions.
        shape = observation.cloud.points.shape
        points = observation.cloud.points + noise * torch.randn(shape, generator=generator)
        observation = replace(observation, cloud=replace(observation.cloud, points=points))
        if labelled:
            part = torch.cat([view.part for view in views]).clamp_min(0)
            told = torch.full_like(observation.potential, -100.0).scatter(2, part[..., None], 0.0)
            observation = replace(observation, potential=told)
        found = registrar(observation, pose + 0.01, body.default_size(1))
        smooth = Smoother(body, registrar, config)(observation, times(T), found, body.default_size(1))
        sd = smooth.registration.covariance.diagonal(dim1=1, dim2=2).sqrt()
        off.append((smooth.registration.pose - pose) / sd)
    assert 0.90 < (torch.cat(off).abs() < 2).float().mean() < 0.99


def test_taken_rows_are_the_frames_one_by_one_and_put_back(scene):
    _, observation, _, found = scene
    index = torch.tensor([4, 1, 1])
    some = observation.take(index)
    for row, i in enumerate(index):
        assert torch.equal(some.cloud.points[row], observation.cloud.points[i])
        assert torch.equal(some.cloud.neighbours[row], observation.cloud.neighbours[i])
        assert torch.equal(some.nearest[row], observation.nearest[i])
    shared = replace(observation, nearest=observation.nearest[:1])
    assert torch.equal(shared.take(index).nearest, observation.nearest[:1])
    index = torch.tensor([4, 1])
    part = found.take(index)
    changed = found.put(index, replace(part, pose=part.pose + 1, misfit=part.misfit + 1))
    rest = [0, 2, 3, 5]
    for name in Registration.__dataclass_fields__:
        if name != "bound":
            assert torch.equal(getattr(changed, name)[rest], getattr(found, name)[rest])
    assert torch.equal(changed.pose[index], found.pose[index] + 1)
    assert torch.equal(changed.misfit[index], found.misfit[index] + 1)
    assert torch.equal(changed.bound[0], found.bound[-1])


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"rounds": -1}, "rounds must not be negative and steps at least 1, got"),
        ({"steps": 0}, "rounds must not be negative and steps at least 1, got"),
        ({"ahead": 50}, "0 <= ahead < stretch must hold, in frames, got 50 and 50"),
        ({"ahead": -1}, "0 <= ahead < stretch must hold, in frames, got -1 and 50"),
        ({"joint_drift": 0.0}, "joint_drift must be positive, got 0.0"),
        ({"rest_time": math.nan}, "rest_time must be positive, got nan"),
        ({"piece": 0.5}, "piece must be at least 1, got 0.5"),
        ({"offset_sd": -0.01}, "offset_sd must not be negative, got -0.01; 0 switches it off"),
        ({"slide_sd": -0.02}, "slide_sd must not be negative, got -0.02; 0 switches it off"),
    ],
)
def test_bad_settings_are_told(setting, message):
    with pytest.raises(ValueError, match=message.replace(".", r"\.")):
        SmoothingConfig(**setting)


@pytest.mark.parametrize("time_s", [[0.0, 0.1], [0.0, 0.2, 0.1, 0.3, 0.4, 0.5]])
def test_bad_times_are_told(body, scene, time_s):
    _, observation, registrar, found = scene
    with pytest.raises(ValueError, match="one time for each of the 6 frames, rising"):
        Smoother(body, registrar)(
            observation, torch.tensor(time_s, dtype=torch.float64), found, body.default_size(1)
        )


def test_who_was_taken_for_walking_backwards_is_turned_to_the_way(body):
    """Seen exactly; three frames of a walk begin turned round, with the limbs where they are."""
    time_s, T = times(9), 9
    directions = RELAXED.clone()
    directions[5] = torch.tensor([0.1, 1.0, -0.4])
    truth = torch.cat([standing(body, directions, yaw=-1.4, x=0.1 * t - 0.4) for t in range(T)])
    views = [see(body, row[None], num=150) for row in truth]
    observation, registrar, size = together(views), Registrar(body), body.default_size(1)
    start = truth.clone()
    wrong = [0, 4, 5]
    start[wrong] = turned_by(body, truth[wrong], torch.full((3,), 2.8), size)
    tracked = registrar(observation, start, size)
    assert ((tracked.pose[wrong, 3] - truth[wrong, 3]).cos() < 0).all()
    found = Smoother(body, registrar)(observation, time_s, tracked, size).registration
    assert ((found.pose[:, 3] - truth[:, 3]).cos() > 0.9).all()
    off = SmoothingConfig(walk=WalkConfig(backwards_penalty=0.0))
    kept = Smoother(body, registrar, off)(observation, time_s, tracked, size).registration
    assert ((kept.pose[wrong, 3] - truth[wrong, 3]).cos() < 0.9).any()


def test_who_walks_backwards_is_seen_by_the_elbows(body):
    """Forearms to the front: turned to the way they would be bent the wrong way round, which costs more."""
    time_s, T = times(9), 9
    directions = RELAXED.clone()
    directions[[2, 4]] = torch.tensor([0.0, 0.1, -1.0])
    truth = torch.cat([standing(body, directions, yaw=1.75, x=0.1 * t - 0.4) for t in range(T)])
    observation = together([see(body, row[None], num=150) for row in truth])
    registrar, size = Registrar(body), body.default_size(1)
    tracked = registrar(observation, truth, size)
    way = walking_yaw(time_s, tracked.pose[:, :3])
    assert ((way - truth[:, 3]).cos() < -0.9).all()
    found = Smoother(body, registrar)(observation, time_s, tracked, size).registration
    assert ((found.pose[:, 3] - truth[:, 3]).cos() > 0.9).all()
