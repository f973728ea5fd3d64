"""Rows that are moved together, against the right image as it was before it was spoilt, and OpenCV's remap."""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from texture_pair import DISPARITY, HEIGHT, SEEN_BY_NOBODY, WIDTH, image, pair, spoiled, texture
from torch import Tensor

from torchpose.recording import open_recording
from torchpose.vision import alignment
from torchpose.vision.alignment import Alignment, RowModel, align_rows, measure_alignment
from torchpose.vision.growing_seeds import GrowingSeeds


def misaligned(
    dy: float = 0.0,
    roll: float = 0.0,
    scale: float = 0.0,
    yaw: float = 0.0,
    size: tuple[int, int] = (360, 480),
) -> tuple[Tensor, Tensor, Tensor]:
    """Left and right image of a plane, and the right one by a camera that is spoilt: by turning and enlarging what it
    shows about its middle (clockwise, radians), then moving it down by dy + yaw x y, px, x and y in half widths.
    """
    v, u = np.mgrid[: size[0], : size[1]].astype(np.float64)
    middle_u, middle_v = (size[1] - 1) / 2, (size[0] - 1) / 2
    x, y = u - middle_u, v - middle_v
    y_before = y - dy - yaw * x * y / (size[1] / 2) ** 2
    c, s = math.cos(roll) / (1 + scale), math.sin(roll) / (1 + scale)
    before = middle_u + c * x + s * y_before, middle_v - s * x + c * y_before
    left, right, spoilt = (
        image(texture(*place)).clone()
        for place in ((u, v), (u + DISPARITY, v), (before[0] + DISPARITY, before[1]))
    )
    return left, right, spoilt


MISALIGNED: dict[str, tuple[dict[str, float], int]] = {  # and how many of the five terms tell it
    "shift": ({"dy": 0.7}, 1),
    "up": ({"dy": -3.2}, 1),
    "roll": ({"roll": math.radians(0.3)}, 2),
    "scale": ({"scale": 0.004}, 3),
    "smaller": ({"dy": 0.6, "scale": -0.006}, 3),
    "mixture": ({"dy": -0.7, "roll": math.radians(-0.3), "scale": 0.004}, 3),
    "yaw": ({"dy": 0.3, "yaw": 1.5}, 4),
}


@pytest.mark.parametrize("case", MISALIGNED)
def test_a_spoilt_right_image_becomes_what_it_was(case: str):
    spoils, terms = MISALIGNED[case]
    left, right, spoilt = misaligned(**spoils)
    found = measure_alignment(spoiled(left), spoiled(spoilt, gain=0.95))
    assert found.model is not None
    assert all(found.model.coefficients[:terms][-1:])
    assert not any(found.model.coefficients[terms:])
    corrected = align_rows(spoilt, found)
    assert measure_alignment(left, corrected).typical < 0.15
    inside = (slice(None), slice(None), slice(8, -8), slice(8, -8))
    # Columns, too: but for yaw, whose columns no row tells. Between 8 and 60 px of texture 0.1 px is about 0.005.
    assert (corrected - right)[inside].abs().mean() < 0.006
    assert (corrected - right)[inside].abs().mean() < 0.3 * (spoilt - right)[inside].abs().mean()


@pytest.mark.parametrize("case", ["shift", "roll", "mixture"])
def test_the_disparity_of_a_corrected_pair_is_that_of_the_unspoilt(case: str):
    left, right, spoilt = misaligned(**MISALIGNED[case][0], size=(240, 320))
    corrected = align_rows(spoilt, measure_alignment(left, spoilt))
    matcher = GrowingSeeds()
    found, expected = (matcher(left, other, disparity_range=(10, 32)).values for other in (corrected, right))
    both = found.isfinite() & expected.isfinite()
    assert both.sum() > 0.97 * expected.isfinite().sum()
    assert (found - expected)[both].abs().median() < 0.1


@pytest.mark.parametrize("dy", [0.0, 0.2, -0.2])
def test_rows_within_a_quarter_pixel_are_left_alone(dy: float):
    for _ in range(4):
        left, right = pair(dy)
        right = spoiled(right, noise=0.04)
        found = measure_alignment(spoiled(left, noise=0.04), right)
        assert found.model is None
        assert align_rows(right, found) is right
    left, right = pair(0.3)
    assert measure_alignment(left, right).model is not None


def test_rows_that_agree_on_nothing_are_left_alone():
    """Each tile of the right image lies at a height of its own, and the whole 4 px lower."""
    left, _ = pair()
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    heights = np.random.default_rng(1).uniform(-8, 16, (6, 8)).repeat(40, 0).repeat(40, 1)
    found = measure_alignment(left, image(texture(u + DISPARITY, v - heights)))
    assert found.spread > 2
    assert abs(found.dy) > 1
    assert found.model is None


@pytest.mark.parametrize("scene", SEEN_BY_NOBODY)
def test_nothing_is_moved_by_too_few_matches(scene: str):
    left, right = SEEN_BY_NOBODY[scene]()
    assert align_rows(right, measure_alignment(left, right)) is right


def test_where_no_match_lies_the_correction_stays_what_it_is_at_the_last():
    """A room whose right half is bare: a line through the rest would move the bare end by 1.9 px."""
    left, _, spoilt = misaligned(roll=0.008)
    left[..., 240:], spoilt[..., 240:] = 0.5, 0.5
    model = measure_alignment(left, spoilt).model
    assert model is not None
    assert 235 < model.box[1] < 240 + 0.1 * 480
    pixels = torch.tensor([[model.box[1], 150.0], [479.0, 150.0], [100.0, 150.0]])
    rows = (model.place(pixels) - pixels)[:, 1]
    assert rows[0] == pytest.approx(rows[1])
    assert rows[1] < 0.008 * 50
    assert rows[2] == pytest.approx(0.008 * (100 - 239.5), abs=0.15)


def row_model(u: np.ndarray, v: np.ndarray, rows: np.ndarray) -> RowModel | None:
    """Of matches at a right column and a left row, and how much lower they lie in the right image."""
    return alignment._row_model(np.stack([u + 20, v, u, v + rows], 1), 640, 480)


def test_places_are_the_right_image_s_columns_and_the_left_s_rows():
    rng = np.random.default_rng(0)
    u, v = rng.uniform(20, 580, 300), rng.uniform(20, 460, 300)
    rows = 9 + 12 * (u - 319.5) / 320 - 60 * (v - 239.5) / 320
    model = row_model(u, v, rows)
    assert model is not None
    assert model.coefficients == pytest.approx((9, 12, -60, 0, 0), abs=1e-6)


def test_errors_that_a_tile_of_the_image_has_in_common_are_not_fitted():
    """20 matches in each of 30 tiles share the tile's error: they tell no more than 30 matches, and no bend."""
    rng = np.random.default_rng(0)
    sizes = []
    for _ in range(12):
        tile = rng.permutation(80)[:30].repeat(20)
        u, v = (
            ((tile % 10) + rng.uniform(0.05, 0.9, 600)) * 64 - 20,
            (tile // 10 + rng.uniform(0, 1, 600)) * 60,
        )
        rows = 1 + 0.5 * rng.standard_normal(80)[tile] + 0.05 * rng.standard_normal(600)
        model = row_model(u, v, rows)
        assert model is not None
        sizes.append(np.count_nonzero(model.coefficients))
    assert np.mean(sizes) < 2


def test_a_bend_is_not_carried_into_corners_without_matches():
    """Along a diagonal of the image columns and rows bend alike; what the other corners do, no match tells."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-0.7, 0.7, 200)
    y = x + rng.uniform(-0.02, 0.02, 200)
    rows = 0.5 + 4 * x * y + 0.3 * rng.standard_normal(200)
    model = row_model(x * 320 + 319.5, y * 320 + 239.5, rows)
    assert model is not None
    assert not any(model.coefficients[2:])
    for sign in (-1, 1):
        corner = torch.tensor([319.5 + sign * 220, 239.5 - sign * 220])
        assert (model.place(corner) - corner).abs().max() < rows.max()


def test_a_few_matches_carry_no_bend():
    """Where the errors of matches could bend the image by more than 0.3 px, fewer terms are taken."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        u, v = rng.uniform(40, 600, 24), rng.uniform(40, 440, 24)
        x, y = (u - 319.5) / 320, (v - 239.5) / 320
        rows = 2 + 3 * x * y + 0.8 * rng.standard_normal(24)
        few = row_model(u, v, rows)
        assert few is not None
        assert not any(few.coefficients[2:])
    many = [np.tile(value, 40) for value in (u, v, x * y)]
    rows = 2 + 3 * many[2] + 0.8 * rng.standard_normal(960)
    model = row_model(many[0], many[1], rows)
    assert model is not None
    assert model.coefficients[3] == pytest.approx(3, abs=0.3)


MODEL = RowModel((0.5, -1.2, 0.8, 0.4, -0.6), 60, 40, (5.0, 50.0, 4.0, 34.0))
BY_MODEL = Alignment(0.1, 0.12, 0.1, 200, 0.0, 0.0, 1e-4, 1e-4, MODEL)


def test_the_place_of_a_pixel_is_the_polynomials():
    for u, v, u_in, v_in in ((20, 30, 20, 30), (57, 30, 50, 30), (2, 38, 5, 34), (30, 1, 30, 4)):
        x, y = (u_in - 29.5) / 30, (v_in - 19.5) / 30
        rows = 0.5 - 1.2 * x + 0.8 * y + 0.4 * x * y - 0.6 * y**2
        expected = torch.tensor([u + 0.8 * x + 1.2 * y, v + rows], dtype=torch.float64)
        torch.testing.assert_close(MODEL.place(torch.tensor([u, v], dtype=torch.float64)), expected)


def test_images_are_sampled_where_the_model_says():
    """Against OpenCV's cubic remap, whose kernel is the same; to 1/32 px, for that is how it rounds places."""
    v, u = np.mgrid[:40, :60].astype(np.float64)
    picture = image(texture(2 * u, 2 * v)).double()
    places = MODEL.place(torch.from_numpy(np.stack([u, v], -1))).numpy().astype(np.float32)
    expected = cv2.remap(
        picture[0, 0].numpy().astype(np.float32),
        places,
        None,
        cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REPLICATE,
    )
    found = align_rows(picture, BY_MODEL)[0, 1].numpy()
    assert np.abs(found - expected.clip(0, 1)).max() < 0.012
    assert np.abs(picture[0, 1].numpy() - expected).max() > 0.1


@pytest.mark.parametrize(
    ("dtype", "atol"), [(torch.float64, 1e-5), (torch.float32, 0.0), (torch.float16, 2e-3)]
)
def test_a_batch_is_its_images_one_by_one_in_any_float_dtype(dtype: torch.dtype, atol: float):
    images = torch.rand(3, 2, 40, 60)
    expected = torch.cat([align_rows(one[None], BY_MODEL) for one in images])
    found = align_rows(images.to(dtype), BY_MODEL)
    assert found.dtype == dtype
    torch.testing.assert_close(found.float(), expected, atol=atol, rtol=0)
    assert found.min() >= 0
    assert found.max() <= 1


def test_gradients_flow_through_the_images():
    small = replace(BY_MODEL, model=replace(MODEL, width=9, height=7, box=(0.0, 8.0, 0.0, 6.0)))
    images = (0.4 + 0.2 * torch.rand(1, 1, 7, 9, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda images: align_rows(images, small), images)


def test_images_of_another_size_than_measured_are_refused():
    with pytest.raises(ValueError, match="have the size that was measured, 60 x 40, got 60 x 41; measure"):
        align_rows(torch.rand(1, 3, 41, 60), BY_MODEL)


def test_a_real_rig_is_corrected_for_frames_that_were_not_measured(shared_data: Path):
    """An OAK-D whose own calibration leaves its rows a pixel apart."""
    folder = shared_data / "oakd_overhead"
    recording = open_recording(folder / "left.mp4", folder / "right.mp4", folder / "calib.json")
    frames = [recording[position] for position in (40, 60, 80, 100)]
    left, right = (torch.stack([getattr(frame, side) for frame in frames]) for side in ("left", "right"))
    found = measure_alignment(left[:2], right[:2])
    assert measure_alignment(left[2:], right[2:]).typical > 0.9
    assert measure_alignment(left[2:], align_rows(right[2:], found)).typical < 0.3
