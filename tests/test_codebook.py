"""k-means against scikit-learn from the same start, by hand, and through its degenerate cases."""

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.cluster import KMeans
from torch.testing import assert_close

from torchpose.activity.codebook import (
    Codebook,
    CodebookConfig,
    CodebookStart,
    kmeans,
    kmeans_plus_plus,
    lbg,
    nearest,
)

HAND_MADE = torch.tensor([[0.0, 0.0], [0.0, 1.0], [10.0, 0.0], [10.0, 3.0]], dtype=torch.float64)


def blobs(count, features, per_blob=40, spread=0.1):
    centers = 4 * torch.randn(count, features, dtype=torch.float64)
    return (centers[:, None] + spread * torch.randn(count, per_blob, features, dtype=torch.float64)).flatten(
        0, 1
    )


def test_a_hand_made_example():
    fitted = kmeans(HAND_MADE, HAND_MADE[[0, 2]])
    assert_close(fitted.centers, torch.tensor([[0.0, 0.5], [10.0, 1.5]], dtype=torch.float64))
    assert fitted.symbols.tolist() == [0, 0, 1, 1]
    assert_close(fitted.inertia, torch.tensor(5.0, dtype=torch.float64))  # 2 x 0.5^2 + 2 x 1.5^2
    assert fitted.converged
    assert fitted.iterations == 2


def test_nearest_is_the_least_of_all_differences():
    points, centers = torch.randn(3, 50, 7, dtype=torch.float64), torch.randn(9, 7, dtype=torch.float64)
    differences = (points[:, :, None] - centers).square().sum(-1)
    assert torch.equal(nearest(points, centers), differences.argmin(-1))


@pytest.mark.parametrize(("size", "features"), [(1, 3), (5, 2), (16, 10)])
def test_same_as_scikit_learn_from_the_same_start(size, features):
    points = torch.randn(400, features, dtype=torch.float64)
    start = points[:size]
    oracle = KMeans(size, init=start.numpy(), n_init=1, tol=0, max_iter=300, algorithm="lloyd").fit(
        points.numpy()
    )
    fitted = kmeans(points, start, iterations=300)
    assert fitted.converged
    assert_close(fitted.inertia, torch.tensor(oracle.inertia_, dtype=torch.float64), rtol=0, atol=1e-6)
    assert_close(fitted.centers, torch.from_numpy(oracle.cluster_centers_), rtol=0, atol=1e-9)
    assert fitted.symbols.tolist() == oracle.labels_.tolist()


def test_empty_clusters_are_filled_as_in_scikit_learn():
    points = blobs(4, 3)
    start = points[:4].clone()
    start[1:] += 1000  # three centres that no point is nearest to
    oracle = KMeans(4, init=start.numpy(), n_init=1, tol=0, algorithm="lloyd").fit(points.numpy())
    fitted = kmeans(points, start)
    assert fitted.symbols.bincount(minlength=4).min() > 0
    assert_close(fitted.inertia, torch.tensor(oracle.inertia_, dtype=torch.float64), rtol=0, atol=1e-6)


def test_more_centres_than_different_points_ends():
    points = torch.ones(6, 2).repeat_interleave(1, 0)
    points[3:] = 2
    fitted = kmeans(points, torch.tensor([[1.0, 1.0], [1.0, 1.0], [2.0, 2.0], [5.0, 5.0]]))
    assert fitted.converged
    assert fitted.inertia == 0


@settings(max_examples=25)
@given(st.integers(1, 8), st.integers(0, 10_000))
def test_more_rounds_never_raise_the_inertia(size, seed):
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(60, 3, generator=generator, dtype=torch.float64)
    start = kmeans_plus_plus(points, size, generator)
    inertia = [float(kmeans(points, start, iterations=rounds).inertia) for rounds in range(6)]
    assert all(after <= before + 1e-9 for before, after in itertools.pairwise(inertia))


def test_plus_plus_starts_in_every_blob_and_lowers_the_inertia():
    points = blobs(12, 5)
    start = kmeans_plus_plus(points, 12, torch.Generator().manual_seed(0))
    assert len(set((nearest(start, points) // 40).tolist())) == 12  # one point of each blob
    drawn = points[torch.randperm(len(points))[:12]]
    assert kmeans(points, start).inertia < kmeans(points, drawn).inertia


def test_plus_plus_draws_in_proportion_to_the_squared_distance():
    """With two points left, at distances 1 and 3, a candidate is the far one in 9 of 10 draws."""
    points = torch.tensor([[0.0], [1.0], [3.0]], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    second = [kmeans_plus_plus(points, 2, generator).squeeze(1).tolist() for _ in range(600)]
    from_zero = [pair[1] for pair in second if pair[0] == 0]
    # Two candidates: the far point unless both are the near one, as it leaves the lower inertia.
    expected, deviation = 0.99, math.sqrt(0.99 * 0.01 / len(from_zero))
    assert abs(sum(value == 3 for value in from_zero) / len(from_zero) - expected) < 4 * deviation


@pytest.mark.parametrize("size", [1, 4, 6, 11])
def test_lbg_reaches_any_size_and_is_as_good_as_the_best_of_random_starts(size):
    points = blobs(6, 4)
    fitted = lbg(points, size, CodebookConfig(size=size, start=CodebookStart.lbg))
    assert len(fitted.centers) == size
    assert fitted.symbols.bincount(minlength=size).min() > 0
    oracle = KMeans(size, n_init=10, random_state=0).fit(points.numpy())
    assert fitted.inertia < 1.25 * oracle.inertia_


@pytest.mark.parametrize("start", list(CodebookStart))
def test_the_codebook_standardises_and_passes_lost_frames_by(start):
    """At `standardization` 1 the features' units do not matter."""
    scale = torch.tensor([1.0, 1000.0, 1.0], dtype=torch.float64)
    points = torch.cat([blobs(4, 2) * scale[:2], torch.full((160, 1), 7.0, dtype=torch.float64)], dim=1)
    with_gaps = torch.cat([points, torch.tensor([[torch.nan, 0.0, 7.0]], dtype=torch.float64)])
    codebook = Codebook(CodebookConfig(size=4, start=start, standardization=1.0))
    fitted = codebook.fit(with_gaps)
    assert_close(codebook.mean, points.mean(0))
    assert_close(codebook.scale[:2], points[:, :2].std(0, unbiased=False))
    assert codebook.scale[2] > 1  # a constant feature is not blown up
    symbols = codebook(with_gaps)
    assert symbols[-1] == -1
    assert torch.equal(symbols[:-1], fitted.symbols)
    assert torch.equal(symbols[:-1].view(4, 40), symbols[:-1:40, None].expand(4, 40))  # one symbol a blob
    assert len(set(symbols.tolist())) == 5
    other_unit = Codebook(CodebookConfig(size=4, start=start, standardization=1.0))
    other_unit.fit(with_gaps / scale)
    assert torch.equal(other_unit(with_gaps / scale), symbols)


def test_without_standardising_large_features_decide():
    points = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 100.0], [1.0, 100.0]])
    codebook = Codebook(CodebookConfig(size=2, standardization=0.0))
    codebook.fit(points)
    symbols = codebook(points).tolist()
    assert symbols[0] == symbols[1] != symbols[2] == symbols[3]
    assert codebook.scale[0] == codebook.scale[1]


def test_half_way_the_ratio_of_the_scales_is_the_root_of_the_deviations_ratio():
    points = torch.randn(100, 2, dtype=torch.float64) * torch.tensor([1.0, 9.0])
    codebook = Codebook(CodebookConfig(size=2))
    codebook.fit(points)
    deviation = points.std(0, unbiased=False)
    assert_close(codebook.scale[1] / codebook.scale[0], (deviation[1] / deviation[0]).sqrt())
    # In all, the scaled points vary about as much as standardised ones, so the tolerance means the same.
    assert 0.3 < ((points / codebook.scale).var(0).mean()) < 3


def test_features_that_never_change_make_one_symbol():
    codebook = Codebook(CodebookConfig(size=2))
    fitted = codebook.fit(torch.full((5, 3), 0.1))
    assert fitted.inertia == 0
    assert (codebook(torch.full((4, 3), 0.1)) == codebook(torch.full((3,), 0.1))).all()


def test_batches_are_encoded_one_by_one_and_seeds_repeat():
    points = torch.randn(3, 70, 4)
    codebook = Codebook(CodebookConfig(size=8))
    codebook.fit(points.flatten(0, 1), torch.Generator().manual_seed(5))
    assert torch.equal(codebook(points), torch.stack([codebook(row) for row in points]))
    again = Codebook(CodebookConfig(size=8))
    again.fit(points.flatten(0, 1), torch.Generator().manual_seed(5))
    assert torch.equal(again.centers, codebook.centers)
    one_try = Codebook(CodebookConfig(size=8, restarts=1))
    assert (
        one_try.fit(points.flatten(0, 1), torch.Generator().manual_seed(5)).inertia
        >= codebook.fit(points.flatten(0, 1), torch.Generator().manual_seed(5)).inertia
    )


def test_bad_input_is_named():
    with pytest.raises(ValueError, match=r"codebook of 64 symbols needs .* got 9; lower codebook.size"):
        Codebook().fit(torch.cat([torch.randn(9, 2), torch.full((80, 2), torch.nan)]))
    with pytest.raises(ValueError, match="made for 0 features a frame, got 2; call fit first"):
        Codebook()(torch.randn(5, 2))
    with pytest.raises(ValueError, match="must be at least 1, got 0, 3 and 100"):
        CodebookConfig(size=0)
    with pytest.raises(ValueError, match="standardization of the codebook must be from 0 to 1, got 2"):
        CodebookConfig(standardization=2.0)
    with pytest.raises(ValueError, match="tolerance of the codebook must not be negative"):
        CodebookConfig(tolerance=-1.0)
