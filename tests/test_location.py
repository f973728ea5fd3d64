"""Following head and body: filterpy's extended filter, dense least squares, simulated walks, and hard measurements."""

from dataclasses import replace

import filterpy.common
import filterpy.kalman
import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from torch.testing import assert_close

from torchpose.tracking.location import (
    Location,
    LocationConfig,
    LocationFilter,
    nowhere,
    sighting,
)

OPEN = LocationConfig(gate=0.0)  # believes everything
NOTHING = torch.full((1, 3), torch.nan, dtype=torch.float64)


def places(*rows):
    return torch.tensor(rows, dtype=torch.float64)


def walk(time, generator, speed=(0.8, 0.0, -0.5), noise=0.04):
    """True head and body of somebody walking, (T, 3) both, and noisy measurements of them."""
    body = places([0.2, 0.1, 3.0]) + time[:, None] * places(list(speed))
    body = body + 0.03 * torch.stack([(8 * time).sin(), (9 * time).cos(), 0 * time], -1)
    head = body + places([0.05, -0.54, -0.08])
    seen = [x + noise * torch.randn(x.shape, generator=generator, dtype=torch.float64) for x in (head, body)]
    return head, body, *seen


def rows(head, body):
    """A sequence of one person as (1, T) sightings."""
    return sighting(head[None], body[None])


def distance_model(x):
    return np.linalg.norm(x[:3] - x[3:6])[None, None]


def distance_jacobian(x):
    direction = (x[:3] - x[3:6])[:, 0] / np.linalg.norm(x[:3] - x[3:6])
    return np.concatenate([direction, -direction, np.zeros(6)])[None]


@pytest.mark.parametrize("together", [0.0, 0.7])
def test_it_is_filterpys_extended_filter(together):
    """With gaps, in uneven time; the three measurements one after another, the distance last."""
    config = replace(OPEN, together=together)
    ours, generator = LocationFilter(config), torch.Generator().manual_seed(1)
    time = torch.tensor([0.0, 0.05, 0.1, 0.3, 0.31, 0.8, 0.85]).double()
    _, _, head, body = walk(time, generator)
    head[2], body[3], head[5], body[5] = [torch.nan] * 4
    location = ours.begin(sighting(head[:1], body[:1]), time[:1]).location
    theirs = filterpy.kalman.ExtendedKalmanFilter(dim_x=12, dim_z=1)
    theirs.x, theirs.P = location.mean[0].numpy()[:, None], location.covariance[0].numpy()
    rate = config.speed**2 / config.change_time
    for t in range(1, len(time)):
        step = float(time[t] - time[t - 1])
        single = rate * filterpy.common.Q_continuous_white_noise(2, step, 1.0)  # of place and velocity
        theirs.Q = np.kron(np.kron(single, [[1, together], [together, 1]]), np.eye(3))
        theirs.F = np.eye(12) + step * np.eye(12, k=6)
        theirs.predict()
        seen = [(head[t], slice(0, 3), config.head_sd), (body[t], slice(3, 6), config.body_sd)]
        seen = [
            (z.numpy()[:, None], np.eye(12)[own], sd**2 * np.eye(3))
            for z, own, sd in seen
            if z.isfinite().all()
        ]
        for value, matrix, noise in seen:
            theirs.update(value, lambda x, m=matrix: m, lambda x, m=matrix: m @ x, R=noise)
        if seen:
            value = np.array([[config.distance]])
            theirs.update(value, distance_jacobian, distance_model, R=config.distance_sd**2 * np.eye(1))
        location = ours.step(location, sighting(head[t : t + 1], body[t : t + 1]), time[t : t + 1]).location
        assert_close(location.mean[0], torch.from_numpy(theirs.x[:, 0]))
        assert_close(location.covariance[0], torch.from_numpy(theirs.P))


def test_smoothing_is_least_squares_over_the_whole_recording():
    """Without (4.15) all is linear: the mode of the joint density, by one dense system in places and velocities."""
    config = replace(OPEN, distance_sd=1e6)
    ours, generator = LocationFilter(config), torch.Generator().manual_seed(2)
    time = torch.tensor([0.0, 0.1, 0.15, 0.4, 0.4, 0.7]).double()
    _, _, head, body = walk(time, generator)
    head[1], body[3], head[5], body[5] = [torch.nan] * 4
    head[4] += 1.0  # at the time of the one before: the same frame again, not counted
    steps, smoothed = ours.smooth(rows(head, body), time)
    first = ours.begin(sighting(head[:1], body[:1]), time[:1]).location
    T = len(time)
    precision, pull = torch.zeros(T * 12, T * 12).double(), torch.zeros(T * 12).double()
    precision[:12, :12] = torch.linalg.inv(first.covariance[0])
    pull[:12] = precision[:12, :12] @ first.mean[0]
    for t in (1, 2, 3, 5):
        # Those at one time are one state.
        before, now = (slice(12 * k, 12 * k + 12) for k in (t - 1 if t != 5 else 3, t))
        move, noise = ours.transition((time[t] - time[t - 1])[None])
        lever = torch.zeros(12, T * 12).double()
        lever[:, now], lever[:, before] = torch.eye(12).double(), -move[0]
        precision += lever.mT @ torch.linalg.solve(noise[0], lever)
        for place, sd, at in ((head[t], config.head_sd, 0), (body[t], config.body_sd, 3)):
            if place.isfinite().all():
                own = slice(12 * t + at, 12 * t + at + 3)
                precision[own, own] += torch.eye(3).double() / sd**2
                pull[own] += place / sd**2
    kept = torch.cat([torch.arange(12 * k, 12 * k + 12) for k in (0, 1, 2, 3, 5)])
    cover = torch.linalg.inv(precision[kept][:, kept])
    mean = (cover @ pull[kept]).view(5, 12)
    for place, t in enumerate((0, 1, 2, 3, 5)):
        own = slice(12 * place, 12 * place + 12)
        assert_close(smoothed.mean[0, t], mean[place], atol=1e-6, rtol=1e-6)
        assert_close(smoothed.covariance[0, t], cover[own, own], atol=1e-7, rtol=1e-5)
    assert_close(smoothed.mean[0, 4], smoothed.mean[0, 3])
    assert_close(smoothed.covariance[0, 4], smoothed.covariance[0, 3])
    assert steps.head_used[0].tolist() == [True, False, True, True, False, False]
    assert_close(steps.location.mean[0, -1], smoothed.mean[0, -1])


def test_a_step_does_not_depend_on_how_it_is_cut_into_frames():
    ours = LocationFilter()
    start = ours.begin(sighting(places([0, -0.4, 3]), places([0, 0.2, 3])), 10.0).location
    whole = ours.predict(start, 10.7)
    for time in (10.0, 10.013, 10.3, 10.3, 10.7):
        start = ours.predict(start, time)
    assert_close(start.mean, whole.mean)
    assert_close(start.covariance, whole.covariance)


def test_the_same_frame_again_is_not_counted():
    ours = LocationFilter()
    seen = sighting(places([0, -0.4, 3]), places([0, 0.2, 3]))
    start = ours.step(nowhere(seen.head), seen, 1.7e9).location
    again = ours.step(start, replace(seen, head=seen.head + 1), 1.7e9)
    assert torch.equal(again.location.mean, start.mean)
    assert torch.equal(again.location.covariance, start.covariance)
    assert not (again.head_used | again.head_rejected | again.body_used).any()
    later = ours.step(start, seen, 1.7e9 + 0.05)  # two identical pictures, each with its own time
    assert later.head_used.all()
    assert_close(later.location.mean[:, :6], start.mean[:, :6], atol=0.02, rtol=0)


@pytest.mark.parametrize("rate", ["even", "changing", "with gaps"])
def test_a_walk_is_followed_better_than_it_is_measured_and_its_covariance_is_true(rate):
    generator = torch.Generator().manual_seed(3)
    steps = torch.full((80,), 0.05).double()
    if rate == "changing":
        steps[30:] = 0.02
    elif rate == "with gaps":
        steps[::7] = 0.25
    time = steps.cumsum(0)
    config = LocationConfig(head_sd=0.04, body_sd=0.04)
    head, body, seen_head, seen_body = walk(time, generator)
    found, smoothed = LocationFilter(config).smooth(rows(seen_head, seen_body), time)
    measured = (seen_body - body).norm(dim=-1)[10:].mean()
    filtered = (found.location.body.mean[0] - body).norm(dim=-1)[10:].mean()
    whole = (smoothed.body.mean[0] - body).norm(dim=-1)[10:].mean()
    assert filtered < 0.95 * measured
    assert whole < 0.75 * measured
    for location in (found.location, smoothed):
        for part, truth in ((location.head, head), (location.body, body)):
            sd = part.covariance[0].diagonal(dim1=-2, dim2=-1).sqrt()
            within = ((part.mean[0] - truth).abs() < 2 * sd)[10:].double().mean()
            assert within > 0.9
    assert not (found.head_rejected | found.body_rejected).any()


def test_a_face_on_the_wall_and_a_body_elsewhere_are_rejected():
    generator = torch.Generator().manual_seed(4)
    time = 0.05 * torch.arange(50).double()
    head, body, seen_head, seen_body = walk(time, generator)
    clean, _ = LocationFilter().smooth(rows(seen_head, seen_body), time)
    seen_head[20:30] = places([1.5, -0.5, 4.0])
    seen_body[40:45] = places([-1.0, 0.3, 3.5])
    found, smoothed = LocationFilter().smooth(rows(seen_head, seen_body), time)
    assert found.head_rejected[0, 20:30].all()
    assert found.body_rejected[0, 40:45].all()
    assert int(found.head_rejected.sum()) == 10
    assert int(found.body_rejected.sum()) == 5
    for location in (found.location, smoothed):
        assert (location.body.mean[0] - body).norm(
            dim=-1
        ).max() < 0.25  # a quarter of a second goes on blindly
        assert (location.head.mean[0] - head).norm(dim=-1)[5:].max() < 0.25
    assert_close(found.location.mean[:, :20], clean.location.mean[:, :20])


def test_of_a_head_and_a_body_that_cannot_be_one_persons_the_less_expected_goes():
    """After a second unseen the gates are wide: each alone would pass."""
    ours = LocationFilter()
    seen = sighting(places([0, -0.45, 3], [0, -0.45, 3]), places([0, 0.1, 3], [0, 0.1, 3]))
    start = ours.begin(seen, 0.0).location
    head, body = places([1.3, -0.45, 3], [0.1, -0.45, 3]), places([0.1, 0.1, 3], [-1.3, 0.1, 3])
    alone = ours.update(ours.predict(start, 1.0), sighting(head=head))
    assert alone.head_used.all()
    both = ours.step(start, sighting(head, body), 1.0)
    assert both.head_used.tolist() == [False, True]
    assert both.head_rejected.tolist() == [True, False]
    assert both.body_used.tolist() == [True, False]
    assert both.body_rejected.tolist() == [False, True]


def test_whoever_jumps_is_found_again():
    """A real jump is rejected at first; the covariance grows until it is believed."""
    ours, time = LocationFilter(), 0.05 * torch.arange(60).double()
    head = places([0, -0.45, 3]).repeat(60, 1)
    head[20:] += places([1.2, 0, 0.5])
    body = head + places([0, 0.55, 0])
    found, _ = ours.smooth(rows(head, body), time)
    assert found.head_rejected[0, 20]
    assert_close(found.location.head.mean[0, -1], head[-1], atol=0.05, rtol=0)


def test_beginning_with_a_body_alone_a_head_alone_both_and_none():
    ours = LocationFilter()
    head = torch.cat([NOTHING, places([0.3, -0.5, 3]), places([0.3, -0.5, 3]), NOTHING, places([2, -0.5, 3])])
    body = torch.cat([places([0.3, 0.1, 3]), NOTHING, places([0.3, 0.1, 3]), NOTHING, places([0.3, 0.1, 3])])
    found = ours.step(nowhere(head), sighting(head, body), 5.0)
    location = found.location
    assert location.known.tolist() == [True, True, True, False, True]
    assert found.head_rejected.tolist() == [False, False, False, False, True]  # two metres away from its body
    assert_close(location.head.mean[0], places([0.3, 0.1 - 0.55, 3])[0], atol=1e-9, rtol=0)
    assert_close(location.body.mean[1], places([0.3, -0.5 + 0.55, 3])[0], atol=1e-9, rtol=0)
    assert_close(location.head.mean[2], head[2], atol=0.02, rtol=0)
    assert_close(location.body.mean[2], body[2], atol=0.05, rtol=0)
    assert_close(location.mean[4], location.mean[0])
    sd = location.head.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert (sd[2] < 0.05).all()
    # Unseen: as far off the place above the body as `upright_sd` says, but for the distance.
    assert_close(sd[0, 0].item(), 0.26, atol=0.02, rtol=0)
    assert sd[0, 1] < 0.12
    assert location.mean[3].isnan().all()
    nobody = ours.step(location, sighting(head, body), 5.1).location
    assert nobody.known.tolist() == [True, True, True, False, True]
    late = torch.cat([NOTHING] * 3 + [places([1, -0.4, 2])] + [NOTHING])
    begun = ours.step(nobody, sighting(late, torch.full_like(late, torch.nan)), 5.2)
    assert begun.location.known.all()
    assert begun.head_used.tolist() == [False, False, False, True, False]


def test_unseen_for_a_while_the_doubt_grows_and_the_head_goes_with_the_body():
    ours, time = LocationFilter(), 0.05 * torch.arange(45).double()
    generator = torch.Generator().manual_seed(5)
    head, _, seen_head, seen_body = walk(time, generator, speed=(1.5, 0.0, 0.0))
    seen_head[15:] = torch.nan  # turns away
    found, _ = ours.smooth(rows(seen_head, seen_body), time)
    error = (found.location.head.mean[0] - head).norm(dim=-1)
    assert error[15:].max() < 0.5
    apart, _ = LocationFilter(LocationConfig(together=0.0)).smooth(rows(seen_head, seen_body), time)
    assert error[25:].mean() < 0.6 * (apart.location.head.mean[0] - head).norm(dim=-1)[25:].mean()
    sd = found.location.head.covariance[0].diagonal(dim1=-2, dim2=-1).sqrt()
    assert (sd[44] > 2 * sd[14]).any()
    seen_body[15:] = torch.nan
    blind, _ = ours.smooth(rows(seen_head, seen_body), time)
    spread = blind.location.body.covariance[0].diagonal(dim1=-2, dim2=-1).sqrt()[15:, 0]
    assert (spread.diff() > 0).all()
    a = ours.config.speed**2 / ours.config.change_time
    assert spread[-1] > (a * 1.5**3 / 3) ** 0.5


def test_pairs_of_persons_and_sightings_have_their_likelihood():
    ours = LocationFilter()
    head = places([0, -0.45, 3], [1, -0.4, 2.5])
    body = head + places([0.05, 0.55, 0])
    location = ours.predict(ours.begin(sighting(head, body), 0.0).location, 0.1)
    other = torch.cat([head.flip(0) + 0.02, NOTHING, head[:1]])
    trunk = torch.cat([body.flip(0), body[:1] - 0.03, NOTHING])
    table = ours.log_likelihood(location, sighting(other, trunk, body_sd=torch.full((4,), 0.1).double()))
    assert table.shape == (2, 4)
    for person in range(2):
        for k in range(4):
            value = torch.cat([other[k], trunk[k]])
            there = value.isfinite()
            noise = torch.tensor([0.04] * 3 + [0.1] * 3).double().square().diag()
            cover = (location.covariance[person, :6, :6] + noise)[there][:, there]
            exact = multivariate_normal(location.mean[person, :6][there].numpy(), cover.numpy())
            assert_close(table[person, k].item(), float(exact.logpdf(value[there].numpy())))
    assert table[0, 1] > table[1, 1] + 10
    assert table[1, 0] > table[0, 0] + 10


def test_the_pelvis_lies_on_from_the_body_with_its_doubt():
    ours = LocationFilter(LocationConfig(pelvis_share=0.4, pelvis_sd=0.03))
    seen = sighting(places([0, -0.45, 3], [0.3, 0.0, 2.7]), places([0, 0.1, 3], [0, 0.2, 3]))
    location = ours.predict(ours.begin(seen, 0.0).location, 0.3)
    pelvis = ours.pelvis(location)
    expected = location.body.mean + 0.4 * (location.body.mean - location.head.mean)
    assert_close(pelvis.mean, expected)
    draws = multivariate_normal(location.mean[1].numpy(), location.covariance[1].numpy(), seed=0).rvs(200_000)
    spread = np.cov((1.4 * draws[:, 3:6] - 0.4 * draws[:, :3]).T) + 0.03**2 * np.eye(3)
    assert_close(pelvis.covariance[1], torch.from_numpy(spread), rtol=0.02, atol=4e-3)


def test_a_batch_is_its_rows():
    ours, generator = LocationFilter(), torch.Generator().manual_seed(6)
    time = 0.1 * torch.arange(12).double()
    walks = [walk(time, generator, speed=(s, 0, 0.2)) for s in (0.5, -1.0, 2.0)]
    head, body = (torch.stack([w[i] for w in walks]) for i in (2, 3))
    head[0, 3:6], body[1, :4], head[1, :4], head[2, 7] = [torch.nan] * 4
    head[2, 8] += 2
    found, smoothed = ours.smooth(sighting(head, body), time)
    for row in range(3):
        alone, whole = ours.smooth(sighting(head[row], body[row]), time)
        for together, single in ((found.location, alone.location), (smoothed, whole)):
            assert_close(together.mean[row], single.mean, equal_nan=True)
            assert_close(together.covariance[row], single.covariance, equal_nan=True)
        assert torch.equal(found.head_rejected[row], alone.head_rejected)
    assert smoothed.known[1].tolist() == [False] * 4 + [True] * 8
    assert smoothed.mean[1, :4].isnan().all()
    assert found.head_rejected[2, 8]


def test_float32_agrees_and_a_state_goes_on():
    ours, generator = LocationFilter(), torch.Generator().manual_seed(7)
    time = 1.7e9 + 0.05 * torch.arange(20).double()
    _, _, head, body = walk(time - 1.7e9, generator)
    exact, _ = ours.smooth(rows(head, body), time)
    rough, whole = ours.smooth(rows(head.float(), body.float()), time)
    assert rough.location.mean.dtype == torch.float32
    assert_close(rough.location.mean.double(), exact.location.mean, atol=1e-3, rtol=1e-3)
    assert torch.linalg.eigvalsh(whole.covariance.double()).min() > 0
    location = nowhere(head[:1])
    for t in range(20):
        location = Location.restore(location.state())
        location = ours.step(location, sighting(head[t : t + 1], body[t : t + 1]), time[t : t + 1]).location
    assert_close(location.mean, exact.location.mean[:, -1])


def test_bad_input_is_said():
    ours = LocationFilter()
    seen = sighting(places([0, -0.45, 3]), places([0, 0.1, 3]))
    location = ours.begin(seen, 2.0).location
    with pytest.raises(
        ValueError, match=r"must not run backwards, got 1.9 s after 2.0 s; put the frames in order"
    ):
        ours.step(location, seen, 1.9)
    with pytest.raises(ValueError, match="needs a head or a body, got neither"):
        sighting()
    for name, value, text in (
        ("speed", 0.0, "speed must be positive, got 0.0"),
        ("distance_sd", float("nan"), "distance_sd must be positive, got nan"),
        ("together", 1.0, r"together must be a correlation in \[0, 1\), got 1.0"),
        ("gate", 1.0, r"gate must be a chance in \[0, 1\), got 1.0"),
        ("pelvis_sd", -0.1, "pelvis_sd must not be negative, got -0.1"),
    ):
        with pytest.raises(ValueError, match=text):
            LocationConfig(**{name: value})
