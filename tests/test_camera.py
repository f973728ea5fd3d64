"""Pinhole geometry against hand-worked numbers, and rectification against a ray-traced raw pair."""

import cv2
import numpy as np
import pytest
import torch
from torch.testing import assert_close

from torchpose.vision.camera import DISTORTION_LENGTHS, RawStereo, StereoCamera

CAMERA = StereoCamera(width=640, height=480, focal_length=720.0, cx=318.3, cy=241.7, baseline=0.12)

DISTORTIONS = {
    4: [-0.2, 0.05, 1e-3, -5e-4],
    5: [-0.2, 0.05, 1e-3, -5e-4, 0.01],
    8: [0.3, -0.1, 1e-3, -5e-4, 0.02, 0.45, -0.05, 0.01],
    12: [-0.2, 0.05, 1e-3, -5e-4, 0.01, 0.0, 0.0, 0.0, 1e-3, -1e-3, 2e-3, 1e-3],
    14: [-0.2, 0.05, 1e-3, -5e-4, 0.01, 0.0, 0.0, 0.0, 1e-3, -1e-3, 2e-3, 1e-3, 0.01, -0.015],
}


def raw_stereo(coefficients: int = 5, **changes: object) -> RawStereo:
    """A pair with unequal lenses, a right camera turned by some degrees and 4 mm low."""
    settings: dict[str, object] = {
        "K1": np.array([[310.0, 0, 163.0], [0, 308.0, 118.0], [0, 0, 1]]),
        "D1": np.array([DISTORTIONS[coefficients]]),
        "K2": np.array([[318.0, 0, 157.0], [0, 319.0, 124.0], [0, 0, 1]]),
        "D2": np.array([DISTORTIONS[coefficients]]) * 0.9,
        "R": cv2.Rodrigues(np.array([0.02, -0.03, 0.03]))[0],
        "T": np.array([[-0.12], [0.004], [0.003]]),
        "image_size": (320, 240),
    }
    return RawStereo(**(settings | changes))  # type: ignore[arg-type]


def test_projects_a_point_worked_by_hand() -> None:
    points = torch.tensor([[0.5, -0.25, 2.0], [0.0, 0.0, 4.0]], dtype=torch.float64)
    expected = torch.tensor([[498.3, 151.7], [318.3, 241.7]], dtype=torch.float64)
    assert_close(CAMERA.project(points), expected)
    assert CAMERA.project(torch.tensor([0.1, 0.2, 0.0])).isnan().all()
    assert CAMERA.project(torch.tensor([0.1, 0.2, -1.0])).isnan().all()


def test_back_projection_undoes_projection_on_any_batch() -> None:
    points = torch.randn(2, 5, 3, dtype=torch.float64) + torch.tensor([0.0, 0.0, 6.0])
    assert_close(CAMERA.back_project(CAMERA.project(points), points[..., 2]), points)


def test_disparity_and_depth() -> None:
    depth = torch.tensor([3.6, 1.8, torch.nan, 0.0, -2.0], dtype=torch.float64)
    expected = torch.tensor([24.0, 48.0, torch.nan, torch.nan, torch.nan], dtype=torch.float64)
    assert_close(CAMERA.disparity(depth), expected, equal_nan=True)
    disparity = torch.tensor([24.0, torch.nan, 0.0, -1.0])
    assert_close(
        CAMERA.depth(disparity), torch.tensor([3.6, torch.nan, torch.nan, torch.nan]), equal_nan=True
    )


def test_the_disparity_is_the_difference_of_columns() -> None:
    point = torch.tensor([0.3, 0.1, 2.5], dtype=torch.float64)
    left = CAMERA.project(point)
    right = CAMERA.project(point - torch.tensor([0.12, 0.0, 0.0]))
    assert_close(left[1], right[1])
    assert_close(left[0] - right[0], CAMERA.disparity(point[2]))


def test_scaled_camera_sees_what_a_resized_image_shows() -> None:
    """A ramp image holds each pixel's own u: OpenCV's resize says where a pixel went."""
    ramp = np.arange(640, dtype=np.float64)[None].repeat(480, 0)
    half = cv2.resize(ramp, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    small = CAMERA.scaled(0.5)
    assert (small.width, small.height, small.baseline) == (320, 240, 0.12)
    point = torch.tensor([0.2, 0.3, 3.0], dtype=torch.float64)
    u_small = small.project(point)[0].item()
    u_of_small_pixels = np.interp(u_small, np.arange(320), half[0])
    assert u_of_small_pixels == pytest.approx(CAMERA.project(point)[0].item(), abs=1e-9)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 0}, "width must be at least 1 px, got 0"),
        ({"focal_length": 0.0}, "focal_length must be a positive number of px, got 0.0"),
        ({"focal_length": float("nan")}, "focal_length must be a positive number of px, got nan"),
        ({"baseline": -0.1}, "baseline must be a positive number of m, got -0.1"),
        ({"frame_rate": 0.0}, "frame_rate must be a positive number of Hz, got 0.0"),
        ({"cx": 640.0}, "cx must lie inside the image, 0 to 639 px, got 640.0"),
        ({"cy": -3.0}, "cy must lie inside the image, 0 to 479 px, got -3.0"),
        ({"cy": float("nan")}, "cy must lie inside the image"),
    ],
)
def test_senseless_cameras_are_refused(changes: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        StereoCamera(
            **({"width": 640, "height": 480, "focal_length": 720.0, "cx": 320.0, "cy": 240.0} | changes)
        )


def test_a_depth_camera_has_no_disparity() -> None:
    camera = StereoCamera(width=640, height=480, focal_length=720.0, cx=320.0, cy=240.0)
    with pytest.raises(ValueError, match="this camera has none"):
        camera.depth(torch.ones(3))
    with pytest.raises(ValueError, match="factor must be positive, got 0"):
        camera.scaled(0.0)


@pytest.mark.parametrize("coefficients", DISTORTION_LENGTHS)
def test_rectified_points_share_their_row_and_give_their_depth(coefficients: int) -> None:
    """World points, projected by OpenCV into each raw image, found again through the maps."""
    raw = raw_stereo(coefficients)
    generator = np.random.default_rng(0)
    points = generator.uniform([-0.7, -0.5, 1.5], [0.7, 0.5, 4.0], (200, 3))
    origin = np.zeros(3)
    in_left = cv2.projectPoints(points, origin, origin, raw.K1, raw.D1)[0][:, 0]
    in_right = cv2.projectPoints(points, cv2.Rodrigues(raw.R)[0], raw.T, raw.K2, raw.D2)[0][:, 0]
    rectified = []
    directly = raw.rectify_pixels(in_left, in_right)
    for pixels, lookup in zip((in_left, in_right), raw.rectify_maps(), strict=True):
        # The nearest entry of the map, refined by its two neighbours: the inverse of the map, by search.
        found = np.abs(lookup[None] - pixels[:, None, None]).sum(-1).reshape(len(pixels), -1).argmin(1)
        rows, columns = np.unravel_index(found, lookup.shape[:2])
        rows, columns = rows.clip(1, 238), columns.clip(1, 318)
        across = (lookup[rows, columns + 1] - lookup[rows, columns - 1]) / 2
        along = (lookup[rows + 1, columns] - lookup[rows - 1, columns]) / 2
        step = np.linalg.solve(
            np.stack([across, along], -1).astype(float), (pixels - lookup[rows, columns])[..., None]
        )
        rectified.append(np.stack([columns, rows], -1) + step[..., 0])
    inside = np.all([((p > 2) & (p < (317, 237))).all(1) for p in rectified], axis=0)
    assert inside.sum() > 100
    for found, searched in zip(directly, rectified, strict=True):
        assert np.abs(found - searched)[inside].max() < 0.02  # px
    left, right = rectified[0][inside], rectified[1][inside]
    assert np.abs(left[:, 1] - right[:, 1]).max() < 0.1  # px
    # The rectified left camera is turned, so compare distances from its centre, not depths.
    depth = raw.camera.depth(torch.from_numpy(left[:, 0] - right[:, 0]))
    distance = raw.camera.back_project(torch.from_numpy(left), depth).norm(dim=-1)
    assert_close(distance, torch.from_numpy(np.linalg.norm(points[inside], axis=1)), atol=0.0, rtol=0.01)
    assert raw.camera.baseline == pytest.approx(np.linalg.norm(raw.T))


def smooth_texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """An aperiodic pattern of the plane, in [0, 1], with waves of 0.25 m and more."""
    waves = [(11, 3, 0.3), (-5, 13, 1.1), (18, 10, 2.0), (6, -17, 0.7), (24, -4, 1.9)]
    return 0.5 + sum(np.sin(a * x + b * y + c) for a, b, c in waves) / 10


def ray_traced(raw: RawStereo) -> tuple[torch.Tensor, torch.Tensor]:
    """Raw images (1, 3, 240, 320) of a textured plane, 2.5 m before the left camera and slanted."""
    normal, offset = np.array([0.2, -0.1, 1.0]), 2.5
    grid = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), -1).reshape(-1, 1, 2)
    images = []
    views = ((raw.K1, raw.D1, np.eye(3), np.zeros(3)), (raw.K2, raw.D2, raw.R, raw.T))
    for matrix, distortion, rotation, translation in views:
        ray = np.c_[cv2.undistortPoints(grid, matrix, distortion)[:, 0], np.ones(len(grid))] @ rotation
        centre = -rotation.T @ translation
        point = centre + ray * ((offset - normal @ centre) / (ray @ normal))[:, None]
        value = smooth_texture(point[:, 0], point[:, 1]).reshape(240, 320)
        images.append(torch.from_numpy(value).expand(1, 3, -1, -1))
    return images[0], images[1]


def vertical_shift(left: torch.Tensor, right: torch.Tensor) -> float:
    """Median row offset of OpenCV's optical flow between two images, px."""
    grey = [(image[0, 0].numpy() * 255).astype(np.uint8) for image in (left, right)]
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(*grey, None)
    return float(np.median(np.abs(flow[20:-20, 60:-20, 1])))


def test_rectified_images_are_row_aligned() -> None:
    raw = raw_stereo(5)
    left, right = ray_traced(raw)
    rectified_left, rectified_right, camera = raw.rectify(left, right)
    assert vertical_shift(left, right) > 2.0
    assert vertical_shift(rectified_left, rectified_right) < 0.2
    assert camera == raw.camera
    assert rectified_left.dtype == torch.float64


def test_resampling_agrees_with_opencv() -> None:
    raw = raw_stereo(5)
    left, right = ray_traced(raw)
    rectified, _, _ = raw.rectify(left, right)
    lookup = raw.rectify_maps()[0]
    # OpenCV rounds positions to 1/32 px, hence the tolerance.
    expected = cv2.remap(left[0, 0].numpy(), lookup, None, cv2.INTER_LINEAR)
    assert_close(rectified[0, 0, 2:-2, 2:-2], torch.from_numpy(expected)[2:-2, 2:-2], atol=6e-3, rtol=0.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"D1": np.zeros(6)}, "D1 must have 4, 5, 8, 12 or 14 coefficients, got 6"),
        ({"K2": np.eye(2)}, "K2 must be a 3 x 3 camera matrix"),
        ({"K1": np.diag([-1.0, 1.0, 1.0])}, "K1 must be a 3 x 3 camera matrix"),
        ({"R": np.diag([1.0, 1.0, -1.0])}, "R must be a 3 x 3 rotation"),
        ({"T": np.array([0.12, 0.0, 0.0])}, "exchange the cameras if the first number is positive"),
        ({"T": np.array([-0.01, 0.12, 0.0])}, "mainly along -x"),
        ({"T": np.array([-0.12, np.nan, 0.0])}, "T must be finite"),
        ({"image_size": (0, 240)}, "image_size must be a width and a height"),
    ],
)
def test_senseless_calibrations_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        raw_stereo(**changes)


def test_images_of_another_size_are_refused() -> None:
    image = torch.zeros(1, 3, 240, 320)
    with pytest.raises(
        ValueError, match="right image must have the calibration's size 320 x 240, got 300 x 240"
    ):
        raw_stereo().rectify(image, image[..., :300])
