"""How far apart rows are, against textures that are functions of the place, and what is told of it."""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from texture_pair import DISPARITY, HEIGHT, SEEN_BY_NOBODY, WIDTH, image, pair, spoiled, texture

from torchpose.vision import alignment
from torchpose.vision.alignment import (
    MIN_MATCHES,
    Alignment,
    alignment_warning,
    correction_warning,
    measure_alignment,
)

GOOD = Alignment(0.1, 0.12, 0.1, 200, 0.0, 0.0, 1e-4, 1e-4)
NOTHING = Alignment(math.nan, math.nan, math.nan, 3, math.nan, math.nan, math.nan, math.nan)


@pytest.mark.parametrize("dy", [0.0, 0.25, -0.5, 1.0, -2.0, 5.0, 11.0])
def test_a_known_shift_is_measured_through_noise_and_gain(dy: float):
    left, right = pair(dy)
    found = measure_alignment(spoiled(left), spoiled(right, gain=0.95))
    assert found.dy == pytest.approx(dy, abs=0.05)
    assert found.typical == pytest.approx(abs(dy), abs=0.06)
    assert found.matches > 100
    assert found.error < 0.02
    assert abs(found.roll) < 5e-4
    assert abs(found.scale) < 5e-4


@pytest.mark.parametrize(("roll", "scale"), [(0.01, 0.0), (-0.02, 0.0), (0.0, 0.012), (0.008, -0.01)])
def test_roll_and_scale_are_measured_where_the_median_shift_is_nothing(roll: float, scale: float):
    left, right = pair(roll=roll, scale=scale)
    found = measure_alignment(left, right)
    assert found.roll == pytest.approx(roll, abs=5e-4)
    assert found.scale == pytest.approx(scale, abs=5e-4)
    assert abs(found.dy) < 0.3
    # The median over where corners are sought in both images: 16 to 35 px from the border, by the pyramid's level.
    v, u = np.mgrid[25 : HEIGHT - 25, 45 : WIDTH - 25]
    rows = roll * (u - (WIDTH - 1) / 2) + scale * (v - (HEIGHT - 1) / 2)
    assert found.typical == pytest.approx(np.median(np.abs(rows)), rel=0.2)


@pytest.mark.parametrize("turn", ["pitch", "yaw"])
def test_a_turn_that_bends_rows_is_no_scatter(turn: str):
    """dy = 4 px x y / (half width)^2, or y^2: the spread is that of the matching alone, and the slopes are none."""
    left, _ = pair()
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    u = u + DISPARITY
    x, y = (u - (WIDTH - 1) / 2) / 160, (v - (HEIGHT - 1) / 2) / 160
    found = measure_alignment(left, image(texture(u, v - 4 * y * (x if turn == "yaw" else y))))
    assert found.spread < 0.15
    assert 0.4 < found.typical < 1.2
    assert abs(found.roll) < 1.5e-3
    assert abs(found.scale) < 1.5e-3


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_any_float_dtype_and_one_channel(dtype: torch.dtype):
    left, right = (spoiled(images, noise=0) for images in pair(1.5))
    expected = measure_alignment(left, right)
    found = measure_alignment(left[:, :1].to(dtype), right[:, :1].to(dtype))
    assert found.dy == pytest.approx(expected.dy, abs=0.01)


def test_who_moved_between_the_exposures_does_not_count():
    left, right = pair(0.6)
    _, moved = pair(6.6)
    right = right.clone()
    right[..., 40:, 110:210] = moved[..., 40:, 110:210]  # a quarter of the image
    found = measure_alignment(left, right)
    assert found.dy == pytest.approx(0.6, abs=0.05)
    assert abs(found.roll) < 2e-3


def test_frames_are_pooled_and_a_place_counts_once():
    left, right = pair(1.0)
    grey = torch.full_like(left, 0.5)
    halves = []
    for half in (slice(40, 80), slice(120, 160)):  # rows of one strip, of which a few corners have a match
        halves.append([grey.clone(), grey.clone()])
        halves[-1][0][..., half, 60:140] = left[..., half, 60:140]
        halves[-1][1][..., half, 60:140] = right[..., half, 60:140]
    alone = [measure_alignment(*half).matches for half in halves]
    assert 0 < min(alone) <= max(alone) < MIN_MATCHES
    assert all(math.isnan(measure_alignment(*half).dy) for half in halves)
    pooled = [torch.cat(images) for images in zip(*halves, strict=True)]
    assert measure_alignment(*pooled).matches == sum(alone) > max(alone)
    twice = [torch.cat([images, images]) for images in (left, right)]
    assert measure_alignment(*twice) == measure_alignment(left, right)


def test_the_standard_errors_are_those_of_repeated_measurements():
    left, right = pair(1.0)
    found = [measure_alignment(spoiled(left, noise=0.06), spoiled(right, noise=0.06)) for _ in range(25)]
    for value, error in (("dy", "error"), ("roll", "roll_error"), ("scale", "scale_error")):
        scatter = np.std([getattr(one, value) for one in found])
        assert 0.8 < scatter / np.mean([getattr(one, error) for one in found]) < 2, value


def test_matches_that_do_not_return_or_have_a_rival_are_few_among_noise():
    """Of the matches of a noisy pair, nearly all are right: what else was found is turned away one by one."""
    left, right = pair(1.0)
    matches = np.concatenate(
        [
            alignment._match(
                *alignment._grey(torch.cat([spoiled(left, noise=0.25), spoiled(right, noise=0.25)]))
            )
            for _ in range(8)
        ]
    )
    wrong = np.abs(matches[:, 3] - matches[:, 1] - 1) > 2
    assert len(matches) > 400
    assert wrong.mean() < 0.004


@pytest.mark.parametrize("scene", SEEN_BY_NOBODY)
def test_nothing_is_guessed_from_too_little(scene: str):
    left, right = SEEN_BY_NOBODY[scene]()
    found = measure_alignment(left, right)
    assert found.matches < MIN_MATCHES
    assert all(
        math.isnan(x) for x in (found.dy, found.typical, found.spread, found.roll, found.scale, found.error)
    )
    assert alignment_warning(found) is None


def test_images_of_different_shapes_are_refused():
    with pytest.raises(
        ValueError, match=r"must be of one shape, got \(1, 3, 240, 320\) and \(1, 3, 240, 310\)"
    ):
        measure_alignment(torch.zeros(1, 3, 240, 320), torch.zeros(1, 3, 240, 310))


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (GOOD, None),
        (NOTHING, None),
        (replace(GOOD, dy=0.49, typical=0.5), None),
        (replace(GOOD, dy=0.7, typical=0.71), ["are 0.71 px apart", "(the right image lies 0.70 px lower)"]),
        (replace(GOOD, dy=-3.0, typical=3.0), ["are 3.00 px apart", "(the right image lies 3.00 px higher)"]),
        (
            replace(GOOD, dy=0.0, typical=1.2, roll=math.radians(0.5)),
            ["are 1.20 px apart", "(the right image is turned clockwise by 0.50 degrees)"],
        ),
        (
            replace(GOOD, dy=0.8, typical=1.2, roll=-0.01, scale=-0.012),
            [
                "(the right image lies 0.80 px lower, is turned anticlockwise by 0.57 degrees, is smaller by 1.20 %)"
            ],
        ),
        (replace(GOOD, dy=0.0, typical=1.2, scale=0.012), ["(the right image is larger by 1.20 %)"]),
        # A slope that is small, or no larger than its own error, is named as no cause.
        (
            replace(GOOD, dy=0.0, typical=0.6, roll=0.0019, scale=0.01, scale_error=0.003),
            ["px apart (at most"],
        ),
        (replace(GOOD, spread=2.4), ["200 points matched", "scatter by 2.4 px", "at the same moment"]),
    ],
)
def test_the_warning_names_the_number_the_cause_and_what_to_do(found: Alignment, words: list[str] | None):
    message = alignment_warning(found)
    if words is None:
        assert message is None
        return
    assert message is not None
    assert all(
        word in message for word in [*words, "calibrate again (python -m torchpose.vision.calibrate --help)"]
    )
    assert ("(the right image" in message) == any("(the right image" in word for word in words)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        (1.052, 0.113, "were 1.05 px apart and are now 0.11 px: the right images are moved"),
        (3.2, 0.61, "were 3.20 px apart and are now 0.61 px, which spoils matches and depth: the"),
        (0.8, None, "were 0.80 px apart and are corrected, but too few points tell how well: the"),
    ],
)
def test_a_correction_is_told_with_both_numbers(before: float, after: float | None, words: str):
    sentence = correction_warning(before, after)
    assert words in sentence
    assert "depth is as right as the calibration; calibrate again (python -m" in sentence


def read(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.float32) / 255


@pytest.mark.parametrize(
    "pairs",
    [
        "stereo_truth/cones",
        "stereo_truth/teddy",
        "stereo_truth/motorcycle",
        *(
            f"people/{name}_m2"
            for name in ("elbow_horizontal", "knee_lifts", "punch", "shoulder_raising", "walking")
        ),
    ],
)
def test_real_and_rendered_pairs_moved_by_a_known_amount(shared_data: Path, pairs: str):
    """Cubic resampling moves the right image; pairs are right to 0.1 px as they come, says their truth."""
    folder = shared_data / pairs
    if folder.parent.name == "people":
        files = [[folder / side / f"{frame:06d}.jpg" for side in ("left", "right")] for frame in (3, 28, 53)]
    else:
        files = [[folder / "left.png", folder / "right.png"]]
    lefts, rights = ([read(file) for file in side] for side in zip(*files, strict=True))
    left = spoiled(torch.cat([image(grey) for grey in lefts]))
    for dy in (0.0, 0.25, 2.0):
        move = np.array([[1, 0, 0], [0, 1, dy]], np.float32)
        size = lefts[0].shape[::-1]
        moved = [cv2.warpAffine(grey, move, size, flags=cv2.INTER_CUBIC) for grey in rights]
        found = measure_alignment(left, spoiled(torch.cat([image(grey) for grey in moved]), gain=1.05))
        assert found.dy == pytest.approx(dy, abs=0.1), dy
        assert (alignment_warning(found) is None) == (dy < 0.5)
