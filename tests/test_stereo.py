"""What holds for every stereo matcher: scenes of known disparity, the terms of a call, spoilt pairs, real images."""

from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from stereo_scene import density_and_error, grid, plane, read, read_truth, rgb, sphere, step
from torch import Tensor
from torch.nn import functional as F
from torch.testing import assert_close

from torchpose.vision.camera import StereoCamera
from torchpose.vision.disparity import Disparity
from torchpose.vision.growing_seeds import GrowingSeeds, GrowingSeedsConfig
from torchpose.vision.points import sample_grid
from torchpose.vision.semi_global import SemiGlobal, SemiGlobalConfig
from torchpose.vision.stereo import (
    MatcherKind,
    OpenCVConfig,
    OpenCVMatcher,
    StereoConfig,
    stereo_matcher,
)

# The first columns answered for 0 to 20 px: OpenCV leaves out the whole range, rounded up to 32 px.
FIRST = {MatcherKind.gcs: 14, MatcherKind.sgm: 14, MatcherKind.opencv: 32}
# Median error (px) between whole pixels, where the sub-pixel peak is biased: sums of bits know little of fractions.
BETWEEN = {MatcherKind.gcs: 0.05, MatcherKind.sgm: 0.2, MatcherKind.opencv: 0.25}

every_kind = pytest.mark.parametrize("kind", list(MatcherKind), ids=lambda kind: kind.value)


def matcher(kind: MatcherKind) -> "partial[Disparity]":
    return partial(stereo_matcher(StereoConfig(matcher=kind)), disparity_range=(0, 20))


@every_kind
@pytest.mark.parametrize("disparity", [7.0, 7.25, 7.5, 9.8])
def test_a_plane_facing_the_cameras(kind: MatcherKind, disparity: float) -> None:
    left, right, truth = plane(50, 80, disparity)
    found = matcher(kind)(left, right)
    first = FIRST[kind]
    density, error = density_and_error(found.values[0, :, first:], truth[:, first:], border=3)
    assert density > 0.99
    assert error.median() < (0.02 if disparity == 7 else BETWEEN[kind])
    assert error.max() < 0.5
    answered = ~found.values.isnan()
    assert found.confidence.min() == 0
    assert found.confidence.max() <= 1
    assert (found.confidence[~answered] == 0).all()
    assert (
        found.confidence[answered] > 0
    ).double().mean() > 0.999  # the margin of two equal sums is 0 as well


@every_kind
@pytest.mark.parametrize(("per_column", "per_row"), [(0.1, 0.0), (-0.1, 0.0), (0.0, 0.15), (0.05, -0.1)])
def test_a_slanted_plane_of_an_oblong_image(kind: MatcherKind, per_column: float, per_row: float) -> None:
    """Slopes along u and v differ and so do the sides: exchanging them anywhere cannot pass."""
    left, right, truth = plane(40, 96, 10.0, per_column, per_row)
    values = matcher(kind)(left, right).values[0]
    assert values.shape == (40, 96)
    u = grid(40, 96)[0]
    seen = truth.where((u - truth >= 2) & (u >= FIRST[kind]), torch.nan)
    density, error = density_and_error(values, seen, border=4)
    assert density > 0.97
    assert error.median() < 0.15
    assert (error > 1).double().mean() < 0.01


def near_the_edges(inside: Tensor, radius: int) -> Tensor:
    """Pixels within `radius` of the other kind."""

    def dilated(mask: Tensor) -> Tensor:
        return F.max_pool2d(mask.double()[None], 2 * radius + 1, 1, radius)[0] > 0

    return dilated(inside) & dilated(~inside)


@every_kind
def test_a_step_keeps_its_place_and_what_one_camera_sees_is_not_known(kind: MatcherKind) -> None:
    left, right, truth = step()
    values = matcher(kind)(left, right).values[0]
    u = grid(48, 96)[0]
    density, error = density_and_error(values, truth.where(u >= FIRST[kind], torch.nan), border=3)
    assert density > 0.94
    assert (error > 1).double().mean() < 0.04  # within half a window of the square's edges
    known = truth.isfinite() & values.isfinite() & ~near_the_edges(truth == 12, 3)
    assert ((values > 8) == (truth == 12))[known].all()
    hidden = truth.isnan() & (u >= 20)
    assert hidden.sum() == 24 * 8
    inner = hidden & ~near_the_edges(hidden, 2)
    assert values[inner].isnan().double().mean() > 0.9


@every_kind
def test_a_ball_before_a_wall(kind: MatcherKind) -> None:
    left, right, truth = sphere()
    assert (truth.nan_to_num(9).min(), truth[truth.isfinite()].max()) > (
        8,
        14,
    )  # the wall and the ball's nose
    seen = truth.where(grid(*truth.shape)[0] >= FIRST[kind], torch.nan)
    values = matcher(kind)(left, right).values[0]
    for where in (seen, seen.where(truth > 10, torch.nan)):  # all, and the ball without its rim
        density, error = density_and_error(values, where, border=3)
        assert density > 0.9
        assert error.median() < (0.1 if kind is MatcherKind.gcs else 0.2)
        assert (error > 1).double().mean() < 0.06


@every_kind
def test_where_there_is_no_texture(kind: MatcherKind) -> None:
    """Growing seeds say nothing there. The others may carry on what is beside, or take noise for a match: OpenCV's
    answers mean nothing, and semi-global matching answers all that is perfectly flat.
    """
    left, right, _ = plane(40, 90, 6.0)
    left[..., 45:], right[..., 39:] = 0.5, 0.5
    noise = torch.randn(2, *left.shape, dtype=torch.float64) * 0.2 / 255  # below the rounding of 8 bits
    for images in ((left, right), (left + noise[0], right + noise[1])):
        values = matcher(kind)(*images).values[0]
        textured = values[3:-3, FIRST[kind] : 40]
        assert textured.isfinite().double().mean() > 0.98
        assert (textured - 6).abs().nan_to_num().max() < 0.1
        if kind is MatcherKind.gcs:
            assert values[:, 55:].isnan().all()
    if kind is MatcherKind.gcs:
        assert matcher(kind)(torch.zeros_like(left), torch.zeros_like(left)).values.isnan().all()
    if kind is MatcherKind.sgm:
        assert (matcher(kind)(left, right).values[0, :, 55:] == 6).all()


@every_kind
def test_only_the_mask_is_matched_and_nothing_far_from_it_matters(kind: MatcherKind) -> None:
    left, right, truth = plane(60, 120, 8.0)
    mask = torch.zeros(1, 60, 120, dtype=torch.bool)
    mask[0, 20:45, 50:70] = True
    mask[0, 30:35, 55:60] = False
    found = matcher(kind)(left, right, mask)
    assert found.values[~mask].isnan().all()
    assert (found.confidence[~mask] == 0).all()
    assert found.values[mask].isfinite().double().mean() > 0.9
    assert (found.values - truth)[mask].abs().nan_to_num().max() < 0.5
    other_left, other_right = left.clone(), right.clone()
    for image, columns in ((other_left, slice(40, 80)), (other_right, slice(20, 80))):
        inside = torch.zeros(60, 120, dtype=torch.bool)
        inside[10:55, columns] = True
        image[..., ~inside] = 1 - image[..., ~inside]
    assert_close(matcher(kind)(other_left, other_right, mask).values, found.values, equal_nan=True)


@every_kind
@pytest.mark.parametrize(
    "corner", [(slice(0, 1), slice(0, 1)), (slice(39, 40), slice(0, 80)), (slice(0, 40), slice(79, 80))]
)
def test_a_mask_of_a_pixel_a_row_or_a_column(kind: MatcherKind, corner: tuple[slice, slice]) -> None:
    """What is smaller than an island is not known."""
    left, right, _ = plane(40, 80, 5.0)
    mask = torch.zeros(1, 40, 80, dtype=torch.bool)
    mask[0][corner] = True
    found = matcher(kind)(left, right, mask)
    assert found.values.isnan().all()
    assert found.values.shape == found.confidence.shape == (1, 40, 80)


@every_kind
@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (5, 7)])
def test_an_image_smaller_than_the_range(kind: MatcherKind, size: tuple[int, int]) -> None:
    image = torch.rand(1, 3, *size, dtype=torch.float64)
    assert matcher(kind)(image, image).values.isnan().all()


@every_kind
def test_an_empty_mask_gives_nothing(kind: MatcherKind) -> None:
    left, right, _ = plane(30, 40, 3.0)
    found = matcher(kind)(left, right, torch.zeros(1, 30, 40, dtype=torch.bool))
    assert found.values.isnan().all()
    assert (found.confidence == 0).all()


@every_kind
@pytest.mark.parametrize("masked", [False, True], ids=["whole", "masked"])
def test_a_batch_equals_its_frames_one_by_one(kind: MatcherKind, masked: bool) -> None:
    scenes = [plane(40, 80, 5.3, seed=4), plane(40, 80, 11.0, 0.05, seed=5), plane(40, 80, 8.0, seed=6)]
    left, right = (torch.cat([scene[side] for scene in scenes]) for side in (0, 1))
    left, right = ((side + 0.08 * torch.randn_like(side)).clamp(0, 1) for side in (left, right))
    mask = torch.full((3, 40, 80), not masked)
    if masked:  # and none in the last
        mask[0, 5:30, 32:66] = True
        mask[1, 10:38, 43:77] = True
    together = matcher(kind)(left, right, mask)
    for item in range(3):
        one = slice(item, item + 1)
        alone = matcher(kind)(left[one], right[one], mask[one])
        assert_close(together.values[one], alone.values, equal_nan=True)
        assert_close(together.confidence[one], alone.confidence)
    assert together.values[:2].isfinite().sum() > 1400


@every_kind
def test_the_range_of_a_call(kind: MatcherKind) -> None:
    left, right, _ = plane(40, 80, 15.0)
    for span in ((12, 18), (0, 40), (15, 15)):
        values = matcher(kind)(left, right, disparity_range=span).values[0]
        first = 16 if kind is not MatcherKind.opencv else span[0] + -(-(span[1] - span[0] + 1) // 16) * 16
        density, error = density_and_error(
            values[:, first:], torch.full_like(values, 15.0)[:, first:], border=3
        )
        assert density > 0.98
        assert error.median() < 0.05
        assert error.max() < 0.5
    outside = matcher(kind)(left, right, disparity_range=(0, 10)).values
    if kind is not MatcherKind.sgm:  # it takes smooth nonsense for a surface
        assert outside.isfinite().double().mean() < 0.05
    assert not (outside > 10.5).any()


@every_kind
def test_negative_disparities_are_ordinary(kind: MatcherKind) -> None:
    left, right, _ = plane(40, 80, 15.0)
    values = matcher(kind)(right, left, disparity_range=(-20, -10)).values[0]
    assert values[3:-3, 1:59].isfinite().double().mean() > 0.98
    error = (values[values.isfinite()] + 15).abs()
    assert error.median() < 0.05
    assert (error > 0.5).double().mean() < 0.02  # where the window meets the image's edge
    assert values[:, 70:].isnan().all()
    mask = torch.zeros(1, 40, 80, dtype=torch.bool)
    mask[0, :, 8:30] = True  # what it matches lies beside it
    values = matcher(kind)(right, left, mask, disparity_range=(-20, -10)).values[0]
    assert values[3:-3, 8:30].isfinite().double().mean() > 0.98


@every_kind
@pytest.mark.parametrize("span", [(70, 90), (79, 79), (100, 120), (-120, -100)])
def test_what_the_right_image_does_not_show_is_not_known(kind: MatcherKind, span: tuple[int, int]) -> None:
    left, right, _ = plane(40, 80, 15.0)
    values = matcher(kind)(left, right, disparity_range=span).values[0]
    column = grid(40, 80)[0] - values
    assert ((column > -0.6) & (column < 79.6))[values.isfinite()].all()
    assert values.isfinite().double().mean() < 0.1


@every_kind
def test_float32_is_as_good_as_float64(kind: MatcherKind) -> None:
    """A texture of one grey value about a bright mean: where sums of squares cancel, if anywhere."""
    left, right, _ = plane(40, 80, 6.3)
    left, right = 0.8 + (left - 0.5) / 40, 0.8 + (right - 0.5) / 40
    fine = matcher(kind)(left, right)
    coarse = matcher(kind)(left.float(), right.float())
    for found, dtype in ((fine, torch.float64), (coarse, torch.float32)):
        assert found.values.dtype == found.confidence.dtype == dtype
    both = fine.values.isfinite() & coarse.values.isfinite()
    assert both.sum() > 0.97 * fine.values.isfinite().sum() > 1000
    assert (fine.values - coarse.values)[both].abs().median() < 0.02
    assert (fine.values - coarse.values)[both].abs().max() < 0.5


@every_kind
def test_no_gradient_flows_and_the_images_stay(kind: MatcherKind) -> None:
    left, right, _ = plane(30, 60, 4.0)
    before = left.clone(), right.clone()
    found = matcher(kind)(left.requires_grad_(), right)
    assert not found.values.requires_grad
    assert not found.confidence.requires_grad
    assert torch.equal(left, before[0])
    assert torch.equal(right, before[1])


def noisy(image: Tensor) -> Tensor:
    return (image + 4 / 255 * torch.randn_like(image)).clamp(0, 1)


def blurred(image: Tensor) -> Tensor:
    return rgb(torch.from_numpy(cv2.GaussianBlur(image[0, 0].numpy(), (0, 0), 1.0)))


@every_kind
@pytest.mark.parametrize("harm", ["half a row lower", "noise", "5 % brighter", "blur"])
def test_a_spoilt_pair_is_only_a_little_worse(kind: MatcherKind, harm: str) -> None:
    """Where a slope runs across the rows, an error along them is one of disparity: 0.02 px for half a row."""
    left, right, truth = plane(60, 120, 9.0, 0.04, 0.03)
    seen = truth.where(grid(60, 120)[0] >= FIRST[kind] + 4, torch.nan)
    clean = density_and_error(matcher(kind)(left, right).values[0], seen, border=3)
    match harm:
        case "half a row lower":
            right = plane(60, 120, 9.0, 0.04, 0.03, lower=0.5)[1]
        case "noise":
            left, right = noisy(left), noisy(right)
        case "5 % brighter":
            right = (1.05 * right).clamp(0, 1)
        case "blur":
            left, right = blurred(left), blurred(right)
    density, error = density_and_error(matcher(kind)(left, right).values[0], seen, border=3)
    assert density > clean[0] - 0.02 > 0.97
    assert error.median() < clean[1].median() + 0.1
    assert (error > 0.5).double().mean() < 0.01


@every_kind
def test_what_is_not_known_gives_no_points(kind: MatcherKind) -> None:
    """From the matcher through the depth to the points: NaN stays NaN, and gives neither points nor numbers."""
    camera = StereoCamera(width=96, height=60, focal_length=90.0, cx=47.0, cy=28.0, baseline=0.2)
    left, right, _ = plane(60, 96, 9.0)
    left, right = left.expand(2, -1, -1, -1), right.expand(2, -1, -1, -1)
    mask = torch.zeros(2, 60, 96, dtype=torch.bool)
    mask[0, 8:52, 34:90] = True
    mask[0, 18:42, 50:74] = False  # and none in the second
    found = matcher(kind)(left, right, mask)
    depth = camera.depth(found.values)
    assert torch.equal(depth.isnan(), found.values.isnan())
    assert_close(depth[0][mask[0]].nanmedian(), torch.tensor(2.0).double(), atol=0.01, rtol=0)
    # All pixels are asked for: only what the matcher left out keeps them away.
    cloud = sample_grid(depth, torch.ones_like(mask), camera)
    assert cloud.points.isfinite().all()
    assert not cloud.mask[1].any()
    assert cloud.mask[0].sum() > 100
    u, v = cloud.pixels[0][cloud.mask[0]].unbind(-1)
    inside = (u > 30) & (u < 94) & (v > 4) & (v < 56) & ~((u > 53) & (u < 71) & (v > 21) & (v < 39))
    assert inside.all()
    assert_close(cloud.points[0][cloud.mask[0]][:, 2], torch.full_like(u, 2.0), atol=0.05, rtol=0)


@every_kind
def test_senseless_input_is_refused(kind: MatcherKind) -> None:
    image = torch.zeros(1, 3, 20, 30)
    with pytest.raises(ValueError, match=r"same shape, got \(1, 3, 20, 30\) and \(1, 3, 20, 28\); rectify"):
        matcher(kind)(image, image[..., :28])
    with pytest.raises(ValueError, match=r"same shape, got \(1, 3, 20, 30\) and \(2, 3, 20, 30\)"):
        matcher(kind)(image, image.expand(2, -1, -1, -1))
    with pytest.raises(
        ValueError, match=r"mask must have the left images' shape \(1, 20, 30\), got \(1, 30, 20\)"
    ):
        matcher(kind)(image, image, torch.ones(1, 30, 20, dtype=torch.bool))
    with pytest.raises(ValueError, match="seeds must have the left images' shape"):
        matcher(kind)(image, image, seeds=torch.zeros(2, 20, 30))
    with pytest.raises(ValueError, match="range must not be empty, got 9 to 3 px; give the least one first"):
        matcher(kind)(image, image, disparity_range=(9, 3))


@pytest.mark.parametrize("kind", [MatcherKind.sgm, MatcherKind.opencv], ids=lambda kind: kind.value)
def test_who_does_not_use_seeds_is_not_led_by_them(kind: MatcherKind) -> None:
    left, right, _ = plane(40, 80, 6.0)
    seeds = torch.full((1, 40, 80), 17.0, dtype=torch.float64)
    assert_close(
        matcher(kind)(left, right, seeds=seeds).values, matcher(kind)(left, right).values, equal_nan=True
    )


def test_a_configuration_names_its_matcher_and_gives_it_its_settings() -> None:
    settings = {
        "gcs": GrowingSeedsConfig(tau=0.7),
        "sgm": SemiGlobalConfig(smoothing=1),
        "opencv": OpenCVConfig(block_size=7),
    }
    classes = {"gcs": GrowingSeeds, "sgm": SemiGlobal, "opencv": OpenCVMatcher}
    for name, config in settings.items():
        chosen = stereo_matcher(StereoConfig(matcher=MatcherKind(name), **settings))  # type: ignore[arg-type]
        assert type(chosen) is classes[name]
        assert chosen.config == config
    assert isinstance(stereo_matcher(), GrowingSeeds)


def test_opencvs_matcher_is_opencvs() -> None:
    """On a pair so noisy that every setting matters."""
    left, right, _ = sphere()
    left, right = (rgb((side + 0.2 * torch.randn_like(side))[0, 0].clamp(0, 1)) for side in (left, right))
    settings = {
        "block_size": 7,
        "uniqueness_ratio": 5,
        "speckle_window": 30,
        "speckle_range": 1,
        "left_right": 2,
    }
    found = OpenCVMatcher(OpenCVConfig(**settings, smoothing=0))(left, right, disparity_range=(2, 25))
    theirs = cv2.StereoSGBM.create(2, 32, 7, 8 * 49, 32 * 49, 2, 0, 5, 30, 1, cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    expected = theirs.compute(eight_bits(left), eight_bits(right)) / 16
    expected = torch.from_numpy(np.where((expected >= 2) & (expected <= 25), expected, np.nan))
    assert_close(found.values[0], expected, equal_nan=True)
    assert torch.equal(found.confidence[0], expected.isfinite().double())
    for name, value in settings.items():
        other = OpenCVMatcher(OpenCVConfig(**settings | {name: 3 * value}, smoothing=0))
        values = other(left, right, disparity_range=(2, 25)).values[0]
        assert not values.nan_to_num(-1).equal(expected.nan_to_num(-1)), name


def eight_bits(image: Tensor) -> np.ndarray:
    return (image[0, 0] * 255).round().byte().numpy()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"block_size": 4}, "block_size must be odd, got 4; 5 is usual"),
        ({"block_size": 0}, "block_size must be odd, got 0; 5 is usual"),
        ({"smoothing": -1}, "smoothing must not be negative, got -1; 0 turns it off"),
    ],
)
def test_senseless_settings_of_opencvs_are_refused(changes: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        OpenCVConfig(**changes)


@pytest.mark.parametrize(("name", "least", "most"), [("cones", 0.75, 0.043), ("teddy", 0.68, 0.055)])
def test_growing_seeds_answer_more_at_the_errors_of_the_original(
    shared_data: Path, name: str, least: float, most: float
) -> None:
    """The sequential original: 0.724 of the pixels at 4.3 % off by more than 1 px, and 0.634 at 5.5 %."""
    folder = shared_data / "stereo_truth" / name
    network = GrowingSeeds(GrowingSeedsConfig(windows=(3, 5), tau=0.5, mu=0.05, fill=False))
    values = network(read(folder / "left.png"), read(folder / "right.png"), disparity_range=(0, 63)).values[0]
    density, error = density_and_error(values, read_truth(folder))
    assert density >= least
    assert (error > 1).double().mean() <= most


def test_semi_global_matching_of_all_pixels(shared_data: Path) -> None:
    """OpenCV's matcher with four paths: 18.8 % of the pixels have no answer or one off by more than 2 px."""
    folder = shared_data / "stereo_truth" / "motorcycle"
    values = SemiGlobal()(
        read(folder / "left.png"), read(folder / "right.png"), disparity_range=(0, 63)
    ).values[0]
    truth = read_truth(folder)
    right = (values - truth).abs() <= 2
    assert 1 - right[truth.isfinite()].double().mean() <= 0.14


@every_kind
def test_a_person_keeps_their_arms(shared_data: Path, kind: MatcherKind) -> None:
    """Bare arms held level: their texture runs along the rows, so a window alone cannot place them."""
    folder = shared_data / "people" / "elbow_horizontal_m2"
    depth, part = (
        cv2.imread(str(folder / f"truth/000020_{kind}.png"), cv2.IMREAD_UNCHANGED)
        for kind in ("depth", "label")
    )
    truth = torch.from_numpy(720 * 0.121 / (depth.clip(1) / 1000)).float()
    mask = torch.from_numpy(part > 0)
    left, right = read(folder / "left/000020.jpg"), read(folder / "right/000020.jpg")
    values = stereo_matcher(StereoConfig(matcher=kind))(
        left, right, mask[None], disparity_range=(8, 64)
    ).values[0]
    arms = torch.from_numpy(np.isin(part, (5, 6, 8, 9)))
    # Growing seeds fill in the arms; the others leave a sixth of them out, or are wrong on a tenth.
    on_arms = {MatcherKind.gcs: (0.9, 0.06), MatcherKind.sgm: (0.8, 0.06), MatcherKind.opencv: (0.9, 0.1)}[
        kind
    ]
    for where, (least, most) in ((mask, (0.95, 0.02)), (arms, on_arms)):
        density, error = density_and_error(values, truth.where(where, torch.nan))
        assert density > least
        assert (error > 1).double().mean() < most
        assert error.median() < 0.25
