"""The parts' colours: against numpy's histogram with shares written out, and what learning must not take in."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from kornia.color import lab_to_rgb
from skimage.color import rgb2lab
from synthetic_cloud import see, standing
from torch.testing import assert_close

from torchpose.body.model import BodyModel
from torchpose.registration.colour import ColourConfig, ColourLikelihood
from torchpose.registration.likelihood import Evidence
from torchpose.vision.colour_histogram import BINS, HIGH, LOW, colour_bins

NAMES = ("torso", "hand_left", "hand_right", "shank_left", "shank_right")


@pytest.fixture(scope="module")
def view():
    body = BodyModel()
    return see(body, standing(body), num=300)


def evidence_of(view, images):
    return Evidence(images, view.silhouette, view.cloud, view.no_face())


@pytest.fixture
def noisy(view):
    return evidence_of(view, torch.rand(1, 3, *view.silhouette.shape[1:]))


def random_belief(view, labels=6):
    return torch.rand(1, labels, view.cloud.mask.shape[1]).softmax(1)


def surface(view, distance=0.01):
    return torch.full(view.cloud.mask.shape, distance)


def point_shares(evidence):
    """Point by point: bins and shares of the mean colour of 3 x 3 pixels, in CIELAB by another library."""
    H, W = evidence.images.shape[2:]
    image = evidence.images[0].permute(1, 2, 0).double().numpy()
    rows = []
    for u, v in evidence.cloud.pixels[0].round().int().tolist():
        near = [
            image[min(max(v + b, 0), H - 1), min(max(u + a, 0), W - 1)]
            for a, b in itertools.product((-1, 0, 1), repeat=2)
        ]
        lab = rgb2lab(np.mean(near, 0)[None, None])[0, 0]
        at = [
            min(max((x - low) / (high - low), 0), 1) * (n - 1)
            for x, low, high, n in zip(lab, LOW, HIGH, BINS, strict=True)
        ]
        first = [min(int(x), n - 2) for x, n in zip(at, BINS, strict=True)]
        for step in itertools.product((0, 1), repeat=3):
            share = math.prod(x - f if s else 1 - (x - f) for x, f, s in zip(at, first, step, strict=True))
            rows.append([*(f + s for f, s in zip(first, step, strict=True)), share])
    return np.array(rows).reshape(-1, 8, 4)


def test_counts_are_a_histogram_with_shares(view, noisy):
    model = ColourLikelihood(NAMES)
    belief, distance = random_belief(view), torch.rand(view.cloud.mask.shape) * 0.08
    model.learn(noisy, belief, distance)
    shares = point_shares(noisy)
    sure = (distance < model.config.near) & view.cloud.mask
    assert 20 < sure.sum() < view.cloud.mask.sum() - 20  # far points are among them
    weight = (belief * sure[:, None])[0].double().numpy()
    own = dict(zip(NAMES, weight, strict=False))
    for name, counts in zip(NAMES, model.counts, strict=True):
        other = name.replace("left", "#").replace("right", "left").replace("#", "right")
        each = (own[name] + own[other])[:, None] * shares[..., 3]
        table, _ = np.histogramdd(
            shares[..., :3].reshape(-1, 3), [np.arange(n + 1) - 0.5 for n in BINS], weights=each.flatten()
        )
        assert_close(counts.double(), torch.from_numpy(table.flatten()), rtol=1e-3, atol=1e-3)
    assert_close(
        model.counts.sum().double(), torch.tensor(2 * weight[: len(NAMES)].sum()), rtol=1e-5, atol=1e-3
    )


def test_the_potential_is_the_log_ratio_written_out(view, noisy):
    config = ColourConfig(strength=0.7, floor=0.1, trust=25.0)
    model = ColourLikelihood(NAMES, config)
    model.learn(noisy, random_belief(view), surface(view))
    model.learn(noisy, random_belief(view), surface(view))
    other = evidence_of(view, torch.rand_like(noisy.images))
    got, shares = model(other)[0], point_shares(other)
    counts = model.counts.double().view(-1, *BINS).numpy()
    person = counts.sum(0) / counts.sum()
    for k, own in enumerate(counts):
        trust = own.sum() / (own.sum() + 25.0)
        part = trust * own / own.sum() + (1 - trust) * person
        ratio = (0.9 * part + 0.1 * person + 1e-5) / (person + 1e-5)
        i, j, m = shares[..., :3].astype(int).transpose(2, 0, 1)
        want = torch.from_numpy(0.7 * np.log((ratio[i, j, m] * shares[..., 3]).sum(1)))
        assert_close(got[:, k].double(), torch.where(view.cloud.mask[0], want, 0.0), rtol=1e-3, atol=1e-3)


def test_without_learned_colours_nothing_is_said(view, noisy):
    model = ColourLikelihood(NAMES)
    assert model(noisy).abs().max() < 1e-6
    model.learn(noisy, random_belief(view), surface(view))
    assert model(noisy).any()
    model.forget()
    assert model(noisy).abs().max() < 1e-6


def test_left_and_right_share_their_colours(view, noisy):
    model = ColourLikelihood(NAMES)
    belief = torch.zeros(1, 6, view.cloud.mask.shape[1])
    belief[:, 1] = 1.0  # all of the left hand
    model.learn(noisy, belief, surface(view))
    assert torch.equal(model.counts[1], model.counts[2])
    assert model.counts[1].any()
    assert not model.counts[[0, 3, 4]].any()
    potential = model(noisy)
    assert torch.equal(potential[..., 1], potential[..., 2])
    assert torch.equal(potential[..., 3], potential[..., 4])


def halves(view, left, right):
    """A picture whose left half has one colour and its right half another, and which points lie where."""
    H, W = view.silhouette.shape[1:]
    image = torch.tensor(left)[None, :, None, None].repeat(1, 1, H, W)
    split = int(view.cloud.pixels[0, view.cloud.mask[0], 0].median())
    image[..., split:] = torch.tensor(right)[:, None, None]
    u = view.cloud.pixels[0, :, 0]
    return (
        evidence_of(view, image),
        view.cloud.mask[0] & (u < split - 2),
        view.cloud.mask[0] & (u > split + 2),
    )


def test_a_patch_of_its_own_colour_is_given_to_its_part(view):
    evidence, left, right = halves(view, (0.8, 0.1, 0.1), (0.1, 0.2, 0.7))
    model = ColourLikelihood(NAMES)
    belief = torch.zeros(1, 6, len(left))
    belief[0, 0, left], belief[0, 1, right] = 1.0, 1.0
    for _ in range(5):
        model.learn(evidence, belief, surface(view))
    potential = model(evidence)[0]
    assert (potential[left].argmax(1) == 0).all()
    hands = potential[right]
    assert torch.equal(hands[:, 1], hands.amax(1))
    assert (potential[left, 0] > 0.5).all()
    assert (potential[left, 1] < -1).all()
    assert potential[:, 3:].abs().max() < 1e-6  # a part that was never seen has the person's colours


def test_a_uniform_picture_says_nothing(view):
    H, W = view.silhouette.shape[1:]
    evidence = evidence_of(view, torch.full((1, 3, H, W), 0.4))
    model = ColourLikelihood(NAMES)
    model.learn(evidence, random_belief(view), surface(view))
    assert model(evidence).abs().max() < 1e-4


def test_the_potential_never_falls_below_the_floor_and_reaches_it(view):
    """The floor is reached by a colour that is all of one part's and none of another's, which is well known."""
    config = ColourConfig(floor=0.05, strength=2.0, trust=1e-3)
    evidence, left, right = halves(view, (0.9, 0.9, 0.1), (0.1, 0.4, 0.2))
    model = ColourLikelihood(NAMES, config)
    belief = torch.zeros(1, 6, len(left))
    belief[0, 0, left], belief[0, 1, right] = 1.0, 1.0
    model.learn(evidence, belief, surface(view))
    floor = 2.0 * math.log(0.05)
    assert_close(model(evidence)[0, left, 1], torch.full((int(left.sum()),), floor), rtol=0, atol=0.02)
    assert model(evidence).min() >= floor - 1e-4
    # A colour that nobody has says nothing.
    strange = evidence_of(
        view, torch.ones_like(evidence.images) * torch.tensor([0.9, 0.1, 0.9])[:, None, None]
    )
    assert model(strange).abs().max() < 1e-4


def test_padding_and_points_far_from_the_surface_teach_nothing(view, noisy):
    belief, distance = random_belief(view), surface(view)
    far = torch.arange(distance.shape[1]) % 3 == 0
    padded = ~view.cloud.mask[0]
    assert padded.any()
    want, got = ColourLikelihood(NAMES), ColourLikelihood(NAMES)
    want.learn(noisy, belief * ~(far | padded), distance)
    got.learn(noisy, belief, torch.where(far, got.config.near, distance))
    assert torch.equal(got.counts, want.counts)
    assert not got(noisy)[0, padded].any()
    everything = view.cloud.mask & (distance < got.config.near) & ~far
    assert_close(got.counts.sum(), 2 * (belief[:, :5] * everything[:, None]).sum(), rtol=1e-4, atol=0)


def test_what_was_learned_fades(view, noisy):
    model = ColourLikelihood(NAMES, ColourConfig(memory=4.0))
    belief = random_belief(view)
    model.learn(noisy, belief, surface(view))
    once = model.counts.clone()
    model.learn(noisy, torch.zeros_like(belief), surface(view))
    assert_close(model.counts, 0.75 * once)
    model.learn(noisy, belief, surface(view))
    assert_close(model.counts, (0.75**2 + 1) * once)


@pytest.mark.parametrize("strength", [0.0, 0.5])
def test_strength_is_a_power(view, noisy, strength):
    one, weak = ColourLikelihood(NAMES), ColourLikelihood(NAMES, ColourConfig(strength=strength))
    for model in (one, weak):
        torch.manual_seed(1)
        model.learn(noisy, random_belief(view), surface(view))
    assert_close(weak(noisy), strength * one(noisy))


def test_a_batch_is_its_frames_one_by_one(view, noisy):
    names = view.cloud.__dataclass_fields__
    cloud = replace(
        view.cloud,
        **{n: getattr(view.cloud, n).repeat(3, *[1] * (getattr(view.cloud, n).ndim - 1)) for n in names},
    )
    cloud = replace(cloud, mask=cloud.mask & (torch.rand(cloud.mask.shape) < 0.8))
    images = torch.rand(3, 3, *view.silhouette.shape[1:])
    belief, distance = torch.rand(3, 6, 300).softmax(1), torch.rand(3, 300) * 0.08
    whole = ColourLikelihood(NAMES)
    batch = Evidence(images, view.silhouette.repeat(3, 1, 1), cloud, view.no_face())
    single = [
        evidence_of(
            replace(view, cloud=replace(cloud, **{n: getattr(cloud, n)[i : i + 1] for n in names})),
            images[i : i + 1],
        )
        for i in range(3)
    ]
    whole.learn(batch, belief, distance)
    sum_of = torch.zeros_like(whole.counts)
    for i, evidence in enumerate(single):
        one = ColourLikelihood(NAMES)
        one.learn(evidence, belief[i : i + 1], distance[i : i + 1])
        sum_of += one.counts
    assert_close(whole.counts, sum_of, rtol=1e-5, atol=1e-4)
    assert_close(whole(batch), torch.cat([whole(evidence) for evidence in single]))


def test_precision_follows_the_module(view, noisy):
    narrow, wide = ColourLikelihood(NAMES), ColourLikelihood(NAMES).double()
    belief = random_belief(view)
    cloud = replace(view.cloud, points=view.cloud.points.double(), pixels=view.cloud.pixels.double())
    double = Evidence(noisy.images.double(), view.silhouette, cloud, view.no_face())
    narrow.learn(noisy, belief, surface(view))
    wide.learn(double, belief.double(), surface(view).double())
    assert wide.counts.dtype == wide(double).dtype == torch.float64
    assert_close(narrow(noisy).double(), wide(double), rtol=0, atol=2e-3)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_the_device_follows_the_module(view, noisy):
    here, there = ColourLikelihood(NAMES), ColourLikelihood(NAMES).cuda()
    belief = random_belief(view)
    cloud = replace(view.cloud, **{n: getattr(view.cloud, n).cuda() for n in view.cloud.__dataclass_fields__})
    moved = Evidence(noisy.images.cuda(), view.silhouette.cuda(), cloud, view.no_face())
    here.learn(noisy, belief, surface(view))
    there.learn(moved, belief.cuda(), surface(view).cuda())
    assert_close(there(moved).cpu(), here(noisy), rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    "lab", [(0.0, 0.0, 0.0), (100.0, 0.0, 0.0), (60.0, 90.0, 60.0), (30.0, 60.0, -100.0)]
)
def test_black_white_and_vivid_colours_have_a_bin(view, lab):
    """Colours on and beyond the edge of what the bins span lie in the outermost."""
    rgb = lab_to_rgb(torch.tensor(lab)[None, :, None, None])[0, :, 0, 0].clamp(0, 1)
    H, W = view.silhouette.shape[1:]
    evidence = evidence_of(view, rgb[None, :, None, None].expand(1, 3, H, W).contiguous())
    place, share = colour_bins(rgb.expand(1, 300, 3))
    assert place.min() >= 0
    assert place.max() < math.prod(BINS)
    assert share.min() >= 0
    assert_close(share.sum(-1), torch.ones(1, 300))
    assert_close(point_shares(evidence)[..., 3].max(1), share[0].amax(1).double().numpy(), rtol=0, atol=2e-3)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"strength": -1.0}, "strength must not be negative, got -1.0; 0 switches"),
        ({"strength": math.nan}, "strength must not be negative, got nan"),
        ({"floor": 0.0}, "floor must be a share between 0 and 1, got 0.0"),
        ({"floor": 1.0}, "floor must be a share between 0 and 1, got 1.0"),
        ({"near": 0.0}, "near must be positive, got 0.0"),
        ({"trust": -2.0}, "trust must be positive, got -2.0"),
        ({"memory": 0.5}, "memory must be at least 1 frame, got 0.5"),
    ],
)
def test_bad_settings_are_told(setting, message):
    with pytest.raises(ValueError, match=message):
        ColourConfig(**setting)
