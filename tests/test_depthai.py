"""DepthAI calibrations against points projected through each camera, and against DepthAI's own rectification."""

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from torchpose.calibration import read_calibration
from torchpose.recording import open_recording

SIZE = (640, 400)
POSES = {
    0: ([0.02, -0.01, 0.03], [0, 0, 0]),
    1: ([-0.01, 0.03, 0.01], [4, 0.2, -0.1]),
    2: ([0.01, 0.01, -0.02], [-3.5, 0.1, 0.2]),
}


def motion(socket: int) -> np.ndarray:
    """From the world's frame to a camera's, cm."""
    rotation, translation = POSES[socket]
    matrix = np.eye(4)
    matrix[:3, :3] = cv2.Rodrigues(np.array(rotation, float))[0]
    matrix[:3, 3] = translation
    return matrix


def intrinsics(socket: int) -> np.ndarray:
    return np.array([[400.0 + socket, 0, 318.2 + socket], [0, 402.0 + socket, 201.7 - socket], [0, 0, 1]])


def calibration(chain: dict[int, int]) -> dict[str, Any]:
    """As DepthAI writes it; `chain` says which socket each one's extrinsics lead to."""
    cameras = []
    for socket, target in chain.items():
        step = motion(target) @ np.linalg.inv(motion(socket)) if target in POSES else np.zeros((4, 4))
        extrinsics = {
            "rotationMatrix": step[:3, :3].tolist(),
            "translation": dict(zip("xyz", step[:3, 3].tolist(), strict=True)),
            "toCameraSocket": target,
        }
        camera = {
            "cameraType": 0,
            "distortionCoeff": [0.001 * (k + socket) for k in range(14)],
            "extrinsics": extrinsics,
            "intrinsicMatrix": intrinsics(socket).tolist(),
            "width": SIZE[0],
            "height": SIZE[1],
        }
        cameras.append([socket, camera])
    return {"cameraData": cameras, "version": 6}


def save(folder: Path, values: Any) -> Path:
    path = folder / "calib.json"
    path.write_text(values if isinstance(values, str) else json.dumps(values))
    return path


CHAINS = {
    "left to right": {1: 2, 2: -1},
    "left to right to colour": {0: -1, 1: 2, 2: 0},
    "right to left": {2: 1, 1: -1},
    "both to colour": {0: -1, 1: 0, 2: 0},
}


@pytest.mark.parametrize("chain", CHAINS.values(), ids=CHAINS)
def test_points_lie_where_the_chain_of_extrinsics_puts_them(tmp_path: Path, chain: dict[int, int]):
    raw = read_calibration(save(tmp_path, calibration(chain)), frame_rate=30.0).raw
    points = np.random.default_rng(0).uniform([-50, -50, 200, 1], [50, 50, 400, 1], (20, 4)).T
    points[3] = 1
    left, right = (0.01 * (motion(socket) @ points)[:3] for socket in (1, 2))  # m
    np.testing.assert_allclose(raw.R @ left + raw.T[:, None], right, atol=1e-12)
    np.testing.assert_array_equal(raw.K1, intrinsics(1))
    np.testing.assert_array_equal(raw.K2, intrinsics(2))
    np.testing.assert_allclose(raw.D2, 0.001 * np.arange(2, 16))
    assert (raw.image_size, raw.frame_rate) == (SIZE, 30.0)


@pytest.mark.parametrize("size", [(1280, 800), (320, 200), (427, 267)])
def test_intrinsics_follow_the_size_of_the_images(tmp_path: Path, size: tuple[int, int]):
    """A pixel of the image at its own size, moved as resizing moves it: its edges, not its centre, scale."""
    raw = read_calibration(save(tmp_path, calibration({1: 2, 2: -1})), size, 30.0).raw
    rays = np.random.default_rng(0).uniform(-0.4, 0.4, (3, 30))
    rays[2] = 1
    for matrix, socket in ((raw.K1, 1), (raw.K2, 2)):
        pixels = (intrinsics(socket) @ rays)[:2]
        factor = np.array([[size[0] / SIZE[0]], [size[1] / SIZE[1]]])
        np.testing.assert_allclose((matrix @ rays)[:2], (pixels + 0.5) * factor - 0.5, atol=1e-9)
    assert raw.image_size == size
    assert (raw.camera.width, raw.camera.height) == size


@pytest.mark.parametrize("videos", [1, 2])
def test_videos_of_another_size_open_with_the_scaled_calibration_at_their_own_rate(
    tmp_path: Path, videos: int
):
    """One side-by-side video, or two, of half the calibration's size."""
    size, paths = (SIZE[0] // 2 * (3 - videos), SIZE[1] // 2), []
    for k in range(videos):
        paths.append(tmp_path / f"{k}.avi")
        writer = cv2.VideoWriter(str(paths[k]), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 12.5, size)
        for level in range(3):
            writer.write(np.full((size[1], size[0], 3), 40 * level, np.uint8))
        writer.release()
    recording = open_recording(*paths, calibration=save(tmp_path, calibration({1: 2, 2: -1})))
    camera = recording.camera
    assert (camera.width, camera.height, camera.frame_rate) == (SIZE[0] // 2, SIZE[1] // 2, 12.5)
    assert recording[1].left.shape == recording[1].right.shape == (3, SIZE[1] // 2, SIZE[0] // 2)
    assert recording[2].time_s == 2 / 12.5


def test_other_sockets_and_a_frame_rate_of_its_own(tmp_path: Path):
    values = calibration({0: 2, 2: -1})
    values |= {"stereoRectificationData": {"leftCameraSocket": 2, "rightCameraSocket": 0}, "frame_rate": 12}
    with pytest.raises(ValueError, match="exchange the cameras"):
        read_calibration(save(tmp_path, values))
    values["stereoRectificationData"] = {"leftCameraSocket": 0, "rightCameraSocket": 2}
    raw = read_calibration(save(tmp_path, values), frame_rate=30.0).raw
    np.testing.assert_array_equal(raw.K1, intrinsics(0))
    assert raw.frame_rate == 12


def change(where: str, value: object) -> Callable[[dict[str, Any]], None]:
    def spoil(values: dict[str, Any]) -> None:
        camera = values["cameraData"][0][1]
        *keys, last = where.split(".")
        for key in keys:
            camera = camera[key]
        if value is None:
            del camera[last]
        else:
            camera[last] = value

    return spoil


@pytest.mark.parametrize(
    ("spoil", "size", "message"),
    [
        (
            lambda values: values["cameraData"].pop(0),
            None,
            r"left camera must be one of .* socket 1 and the sockets \[2\]",
        ),
        (
            change("cameraType", 1),
            None,
            "the left camera must be a perspective one .* got cameraType 1; a fisheye",
        ),
        (change("width", 1280), None, "must have one size, got 1280 x 400 and 640 x 400; read"),
        (
            change("intrinsicMatrix", None),
            None,
            "must have cameraData with .* KeyError.'intrinsicMatrix'. amiss",
        ),
        (change("extrinsics.translation", 3), None, "got TypeError.* amiss; write it anew by DepthAI"),
        (
            change("extrinsics.translation", {"x": -900, "y": 0, "z": 0}),
            None,
            "the translation must be in m, .* got 9; divide",
        ),
        (
            change("extrinsics.toCameraSocket", -1),
            None,
            "must lead to one socket, got 1 from the left and 2 from",
        ),
        (lambda values: change("extrinsics.toCameraSocket", 1)(values), None, "got a ring at 1; calibrate"),
        (change("intrinsicMatrix", [[0, 0, 0]] * 3), None, "K1 must be a 3 x 3 camera matrix"),
        (
            lambda values: None,
            (640, 480),
            "the shape of the calibration's 640 x 400, got 640 x 480; record without",
        ),
    ],
)
def test_what_is_no_stereo_calibration(
    tmp_path: Path, spoil: Callable[[dict[str, Any]], object], size: tuple[int, int] | None, message: str
):
    values = copy.deepcopy(calibration({1: 2, 2: -1}))
    spoil(values)
    with pytest.raises(ValueError, match=message) as error:
        read_calibration(save(tmp_path, values), size, 30.0)
    assert "calib.json: " in str(error.value)
    assert "\n" not in str(error.value)


def test_what_is_no_json_and_what_has_no_frame_rate(tmp_path: Path):
    for text, message in (
        ('{"cameraData": [', "must be JSON, but Expecting value"),
        ("[1, 2]", "must be lines of `key: value`, got list"),
        (json.dumps(calibration({1: 2, 2: -1})), "frame_rate is missing .*DepthAI knows none"),
    ):
        with pytest.raises(ValueError, match=message):
            read_calibration(save(tmp_path, text))


def grey(image: torch.Tensor) -> np.ndarray:
    return cv2.cvtColor((image.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8), cv2.COLOR_RGB2GRAY)


def test_the_shared_rig_as_shipped(shared_data: Path):
    """Rectified as by DepthAI itself; corresponding points on the same row to about a pixel, the floor at 2.7 m."""
    folder = shared_data / "oakd_overhead"
    recording = open_recording(folder, calibration=folder / "calib.json")
    assert len(recording) == 627
    assert recording.camera.frame_rate == 30
    assert recording.camera.baseline == pytest.approx(0.0738, abs=1e-4)
    own = json.loads((folder / "calib.json").read_text())["stereoRectificationData"]
    raw = recording.calibration.raw
    for rotation, side in zip(raw._rectification, ("Left", "Right"), strict=False):
        np.testing.assert_allclose(rotation, own[f"rectifiedRotation{side}"], atol=1e-6)
    frame = recording[200]
    left, right = grey(frame.left), grey(frame.right)
    points = cv2.goodFeaturesToTrack(left, 1500, 0.005, 8)
    there, found, _ = cv2.calcOpticalFlowPyrLK(left, right, points, None, maxLevel=5)
    back, again, _ = cv2.calcOpticalFlowPyrLK(right, left, there, None, maxLevel=5)
    sure = (found & again)[:, 0].astype(bool) & (np.abs(points - back).max((1, 2)) < 0.5)
    shift = (points - there)[sure, 0]
    shift = shift[(shift[:, 0] > 20) & (shift[:, 0] < 200)]
    assert len(shift) > 300
    assert np.median(np.abs(shift[:, 1])) < 1.5  # px; 9.6 before rectification
    depth = recording.camera.depth(torch.tensor(shift[:, 0]))
    assert 2.5 < float(depth.median()) < 3.0
