"""The mean field against enumeration and a plain loop, and which part of the foreground is the person."""

import itertools
import math

import pytest
import torch
from torch.testing import assert_close

from torchpose.vision.silhouette import SilhouetteConfig, mean_field, person_silhouette

SIZE = (90, 120)
CONFIG = SilhouetteConfig()


def rectangle(top, left, height, width, size=SIZE):
    mask = torch.zeros(size, dtype=torch.bool)
    mask[top : top + height, left : left + width] = True
    return mask


def seen(*parts):
    """Log-odds of which these parts are the foreground, and no depth."""
    log_odds = torch.full((1, *SIZE), -6.0)
    for part in parts:
        log_odds[0, part] = 4.0
    return log_odds, torch.full_like(log_odds, torch.nan)


def same(mask, truth):
    """Whether two masks agree but for the four corners, which the coupling rounds."""
    return int((mask != truth).sum()) <= 4


def couplings(guide, coupling, contrast):
    """w_pq of all pairs of pixels, 0 of those that are no neighbours: the definition, pixel by pixel."""
    height, width = guide.shape
    weight = torch.zeros(height * width, height * width, dtype=guide.dtype)
    for p, q in itertools.product(itertools.product(range(height), range(width)), repeat=2):
        down, right = abs(p[0] - q[0]), abs(p[1] - q[1])
        if p != q and max(down, right) == 1:
            w = (
                coupling
                * math.exp(-((guide[p] - guide[q]) ** 2) / (2 * contrast**2))
                / math.hypot(down, right)
            )
            weight[p[0] * width + p[1], q[0] * width + q[1]] = w
    return weight


@pytest.mark.parametrize("sweeps", [0, 1, 6])
def test_mean_field_is_the_definition_s_sweep(sweeps):
    log_odds, guide = torch.randn(5, 7, dtype=torch.float64), torch.rand(5, 7, dtype=torch.float64)
    weight = couplings(guide, 1.3, 0.3)
    field = log_odds.flatten()
    for _ in range(sweeps):
        field = log_odds.flatten() + weight @ torch.tanh(field / 2)
    assert_close(mean_field(log_odds[None], guide[None], 1.3, 0.3, sweeps)[0].flatten(), field)


def test_mean_field_comes_near_the_marginals_by_enumeration():
    """All 512 labellings of 3 x 3 pixels; the coupling is weak, where the approximation holds to its second order."""
    log_odds, guide = torch.randn(3, 3, dtype=torch.float64), torch.rand(3, 3, dtype=torch.float64)
    weight = couplings(guide, 0.3, 0.5)
    labels = torch.tensor(list(itertools.product((-1.0, 1.0), repeat=9)), dtype=torch.float64)
    # Each pair once: w x_p x_q / 2.
    energy = labels @ log_odds.flatten() / 2 + 0.25 * torch.einsum("ni,ij,nj->n", labels, weight, labels)
    marginal = (energy.softmax(0)[:, None] * (labels > 0)).sum(0)
    found = mean_field(log_odds[None], guide[None], 0.3, 0.5, 50)[0].flatten().sigmoid()
    assert_close(found, marginal, atol=0.03, rtol=0)
    assert (found - marginal).abs().max() < 0.4 * (log_odds.flatten().sigmoid() - marginal).abs().max()


def test_mean_field_has_the_gradient_of_finite_differences():
    log_odds, guide = torch.randn(1, 3, 4, dtype=torch.float64), torch.rand(1, 3, 4, dtype=torch.float64)
    log_odds.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: mean_field(x, guide, 1.0, 0.3, 3), log_odds)


def test_the_silhouette_follows_an_edge_of_the_image():
    """Four columns beside the person say nothing; to which side they belong, the guide tells."""
    person, doubtful = rectangle(20, 30, 50, 40), rectangle(20, 70, 50, 4)
    log_odds, depth = seen(person)
    log_odds[0, doubtful] = 0.0
    for edge, whole in ((70, person), (74, person | doubtful)):
        guide = torch.zeros(1, *SIZE)
        guide[0, 20:70, 30:edge] = 0.8
        found = person_silhouette(log_odds, depth, guide=guide)
        assert torch.equal(found.mask[0], whole)
        assert ((found.probability[0] > 0.5) == whole).all()


def test_probability_is_between_none_and_one_and_zero_far_from_anybody():
    log_odds, depth = seen(rectangle(20, 30, 50, 40))
    found = person_silhouette(log_odds, depth)
    assert found.probability.shape == log_odds.shape
    assert found.probability[0, 40, 50] > 0.99
    assert (found.probability[0, :, 100:] == 0).all()
    empty = person_silhouette(*seen())
    assert not empty.mask.any()
    assert (empty.probability < 0.05).all()


def test_the_person_is_kept_while_another_blob_outgrows_them():
    """Two blobs that cross in size: the one of the last frame stays, and without one the largest."""
    previous = None
    for frame in range(6):
        person, other = rectangle(10, 10 + frame, 60, 24 - 2 * frame), rectangle(10, 70, 60, 14 + 4 * frame)
        log_odds, depth = seen(person, other)
        kept = person_silhouette(log_odds, depth, CONFIG, previous=previous)
        assert same(kept.mask[0], person)
        largest = person_silhouette(log_odds, depth, CONFIG).mask[0]
        assert same(largest, person if person.sum() > other.sum() else other)
        previous = kept.mask
    assert int(person.sum()) < int(other.sum())


def test_after_an_absence_the_largest_part_counts():
    small, large = rectangle(20, 10, 40, 20), rectangle(20, 60, 40, 40)
    log_odds, depth = seen(small, large)
    for previous in (torch.zeros(1, *SIZE, dtype=torch.bool), rectangle(70, 0, 15, 50)[None]):
        assert same(person_silhouette(log_odds, depth, previous=previous).mask[0], large)
    gone = person_silhouette(*seen(large), previous=small[None])  # nobody where the last one was
    assert same(gone.mask[0], large)


def test_a_speck_where_the_person_was_is_not_the_person():
    person, speck = rectangle(20, 60, 40, 40), rectangle(30, 20, 8, 8)
    log_odds, depth = seen(person, speck)
    assert same(person_silhouette(log_odds, depth, previous=speck[None]).mask[0], person)


def test_a_batch_is_one_by_one_with_guides_and_last_masks():
    parts = [rectangle(10, 10 + 30 * k, 50, 20) for k in range(3)]
    log_odds = torch.cat([seen(*parts[: k + 1])[0] for k in range(3)])
    log_odds = log_odds + torch.randn_like(log_odds)
    depth = torch.full_like(log_odds, 2.0) + 0.01 * torch.randn_like(log_odds)
    guide, previous = torch.rand(3, *SIZE), torch.stack([parts[0], parts[1], parts[0]])
    background = torch.full(SIZE, 3.0)
    together = person_silhouette(log_odds, depth, CONFIG, background, guide=guide, previous=previous)
    for k in range(3):
        one = slice(k, k + 1)
        alone = person_silhouette(
            log_odds[one], depth[one], CONFIG, background, guide=guide[one], previous=previous[one]
        )
        assert torch.equal(together.mask[one], alone.mask)
        assert_close(together.probability[one], alone.probability)


@pytest.mark.parametrize("name", ["guide", "previous"])
def test_bad_sizes_are_named(name):
    log_odds, depth = seen()
    wrong = torch.zeros(1, SIZE[1], SIZE[0], dtype=torch.bool if name == "previous" else torch.float32)
    with pytest.raises(ValueError, match=f"{name} must have log_odds' shape"):
        person_silhouette(log_odds, depth, **{name: wrong})


@pytest.mark.parametrize("name", ["coupling", "sweeps", "contrast"])
def test_bad_settings_are_named(name):
    with pytest.raises(ValueError, match=name):
        SilhouetteConfig(**{name: -1 if name == "sweeps" else -1.0})
