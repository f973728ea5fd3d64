"""The match at the scene's own disparity: a known shift, a shadow, a person; similarity against a plain loop."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from torchpose.vision.scene_match import SceneMatch, SceneMatchConfig, scene_similarity

SIZE = (40, 70)


def pair(disparity, size=SIZE):
    """A textured scene at a whole disparity (px), seen by both cameras: left(u) = right(u - d)."""
    wall = torch.rand(size[0], size[1] + disparity, dtype=torch.float64)
    return wall[:, : size[1]], wall[:, disparity:]


def similarity_by_loop(left, right, disparity, radius, noise):
    """2 cov / (v_left + v_right) of each window, pixel by pixel with NumPy; the edge pixels are repeated."""
    height, width = left.shape
    warped, known = np.zeros((height, width)), np.zeros((height, width), bool)
    for y in range(height):
        for x in range(width):
            column = x - disparity[y, x]
            known[y, x] = np.isfinite(column) and 0 <= column <= width - 1
            if known[y, x]:
                warped[y, x] = np.interp(column, np.arange(width), right[y])
    expected = np.full((height, width), np.nan)
    for y in range(height):
        for x in range(width):
            rows = np.clip(np.arange(y - radius, y + radius + 1), 0, height - 1)
            columns = np.clip(np.arange(x - radius, x + radius + 1), 0, width - 1)
            inside = known[np.ix_(rows, columns)]
            if not known[y, x] or inside.mean() < 0.5:
                continue
            a, b = left[np.ix_(rows, columns)][inside], warped[np.ix_(rows, columns)][inside]
            covariance = ((a - a.mean()) * (b - b.mean())).mean()
            expected[y, x] = 2 * covariance / (a.var() + b.var() + 2 * noise**2)
    return expected


@pytest.mark.parametrize("radius", [1, 3])
def test_similarity_is_the_definition_s_at_fractional_and_unknown_disparities(radius):
    left, right = torch.rand(2, *SIZE, dtype=torch.float64)
    disparity = 8 * torch.rand(SIZE, dtype=torch.float64)
    disparity[5:20, 30:50] = torch.nan
    disparity[30:, :20] = -3.5  # farther than infinity, but the rows are only pictures here
    found = scene_similarity(left[None], right[None], disparity, radius, 0.02)[0]
    expected = similarity_by_loop(left.numpy(), right.numpy(), disparity.numpy(), radius, 0.02)
    assert_close(found, torch.from_numpy(expected), equal_nan=True)


def test_rows_and_columns_are_not_swapped():
    """A scene that slopes down the rows only, of another height than width."""
    disparity = torch.arange(SIZE[0], dtype=torch.float64)[:, None].expand(SIZE) / 5
    right = torch.rand(SIZE, dtype=torch.float64)
    columns = (torch.arange(SIZE[1]) - disparity).clamp_min(0)
    before = columns.long().clamp_max(SIZE[1] - 2)
    left = torch.lerp(right.gather(1, before), right.gather(1, before + 1), columns - before)
    found = scene_similarity(left[None], right[None], disparity, noise=1e-4)[0]
    assert found[:, 12:].min() > 0.999
    assert found[:, 0][1:].isnan().all()  # the right image ends there


def test_a_shadow_matches_where_the_scene_does_and_a_person_does_not():
    left, right = pair(6)
    model = SceneMatch(left, right, torch.full(SIZE, 6.0, dtype=torch.float64))
    shadow, person = (slice(5, 20), slice(20, 40)), (slice(22, 38), slice(20, 40))
    images = [left.clone(), right.clone()]
    images[0][shadow] *= 0.5
    images[1][:, : SIZE[1] - 6][shadow[0], 14:34] *= 0.5  # the same place on the wall
    texture = torch.rand(16, 20, dtype=torch.float64)
    images[0][person] = texture
    images[1][person[0], 5:25] = texture  # nearer: at disparity 15
    noisy = [(image + 0.005 * torch.randn_like(image))[None] for image in images]
    log_odds = model(noisy[0], noisy[1])[0]
    assert log_odds[7:18, 22:38].max() < -1.5
    inner = log_odds[25:35, 23:37]
    assert inner.max() <= 0
    assert (inner > -0.5).double().mean() > 0.9
    assert (log_odds <= 0).all()
    assert (log_odds[:, :3] == 0).all()  # the right image does not reach there


def test_log_odds_of_a_window_are_the_two_densities_ratio():
    """At the empty pair itself: similarity c0 everywhere, so the ratio is that of N(c0; 0, s) and N(0; 0, s0)."""
    left, right = pair(4)
    config = SceneMatchConfig(weight=1.0)
    model = SceneMatch(left, right, torch.full(SIZE, 4.0, dtype=torch.float64), config)
    c0 = model.similarity[20, 40]
    normal = torch.distributions.Normal(
        torch.zeros(2).double(), torch.stack([torch.tensor(0.4), 0.08 + 0.5 * (1 - c0)])
    )
    density = 0.98 * normal.log_prob(torch.stack([c0, torch.tensor(0.0)]).double()).exp() + 0.01
    found = model(left[None], right[None])[0, 20, 40]
    assert_close(
        found, torch.log(density[0] / density[1]), atol=0.01, rtol=0
    )  # the best of nine such windows


def test_flat_and_unknown_scenes_say_nothing_and_the_mask_bounds_it():
    left, right = pair(5)
    left[:20], right[:20] = 0.5, 0.5
    left, right = left + 0.01 * torch.randn(SIZE), right + 0.01 * torch.randn(SIZE)
    disparity = torch.full(SIZE, 5.0, dtype=torch.float64)
    disparity[30:, 30:] = torch.nan
    model = SceneMatch(left, right, disparity)
    batch = torch.stack([left, left.flip(0)]), torch.stack([right, right.flip(0)])
    whole = model(*batch)
    assert (whole[0, 3:16] > -0.5).all()
    assert (whole[0, 34:, 34:] == 0).all()
    mask = torch.zeros(2, *SIZE, dtype=torch.bool)
    mask[0, 22:30, 20:50] = True
    mask[1, 2:9, 60:] = True
    assert_close(model(*batch, mask), torch.where(mask, whole, 0))
    for k in range(2):
        assert_close(
            model(batch[0][k : k + 1], batch[1][k : k + 1], mask[k : k + 1])[0], model(*batch, mask)[k]
        )
    assert (model(*batch, torch.zeros_like(mask)) == 0).all()


def test_what_was_hidden_in_the_empty_pair_says_nothing():
    left, right = pair(5)
    left[10:20, 20:40] = torch.nan
    right[25:35, 20:40] = torch.nan
    log_odds = SceneMatch(left, right, torch.full(SIZE, 5.0, dtype=torch.float64))(
        *[x[None] for x in pair(5)]
    )[0]
    assert log_odds.isfinite().all()
    assert (log_odds[12:18, 22:38] == 0).all()
    assert (log_odds[27:33, 27:43] == 0).all()


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: SceneMatch(torch.rand(4, 5), torch.rand(4, 5), torch.rand(5, 4)), "one size"),
        (lambda: SceneMatch(*torch.rand(3, 9, 9))(torch.rand(1, 9, 8), torch.rand(1, 9, 8)), "scene's size"),
        (lambda: SceneMatchConfig(radius=0), "radius"),
        (lambda: SceneMatchConfig(spread=0.0), "spread"),
        (lambda: SceneMatchConfig(weight=-1.0), "weight"),
        (lambda: SceneMatchConfig(outliers=1.0), "outliers"),
    ],
)
def test_bad_input_is_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()
