"""Recordings against files that OpenCV writes here, and every kind of bad input by its message."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from calibration_file import calibrate, raw_stereo, raw_values, stereo_values, without
from torch.testing import assert_close

from torchpose.recording import (
    Backgrounds,
    Frame,
    Recording,
    UnreadableFrame,
    open_recording,
    readable_frames,
    spread_positions,
    write_recording,
)
from torchpose.vision.camera import StereoCamera

WIDTH, HEIGHT = 24, 16
STEREO = stereo_values(WIDTH, HEIGHT, 10.0, 20.0)
DEPTH = without(STEREO, "baseline") | {"depth_unit": 0.0005}

random = np.random.default_rng(0)


def colour_pixels() -> np.ndarray:
    return random.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def save(path: Path, rgb: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), rgb[..., ::-1] if rgb.ndim == 3 else rgb)


@pytest.fixture
def stereo(tmp_path: Path) -> Path:
    """Frames 3, 4 and 10, one background."""
    calibrate(tmp_path / "calibration.yaml", STEREO)
    for side in ("left", "right"):
        for number in (3, 4, 10):
            save(tmp_path / side / f"{number:06d}.png", colour_pixels())
        save(tmp_path / "background" / f"{side}_0.png", colour_pixels())
    return tmp_path


@pytest.fixture
def depth(tmp_path: Path) -> Path:
    calibrate(tmp_path / "calibration.yaml", DEPTH)
    for number in range(2):
        save(tmp_path / "depth" / f"{number:06d}.png", random.integers(1, 2**16, (HEIGHT, WIDTH), np.uint16))
    return tmp_path


def to_tensor(rgb: np.ndarray) -> torch.Tensor:
    return torch.tensor(rgb / 255, dtype=torch.float32).permute(2, 0, 1)


def test_stereo_frames_are_rgb_in_order_of_their_numbers(stereo: Path):
    pixels = colour_pixels()
    save(stereo / "left" / "000004.png", pixels)
    (stereo / "left" / "Thumbs.db").write_text("not an image")
    recording = open_recording(stereo)
    assert isinstance(recording, Recording)
    assert len(recording) == 3
    assert recording.indices == (3, 4, 10)
    assert [frame.index for frame in recording] == [3, 4, 10]
    assert [frame.time_s for frame in recording] == [0.3, 0.4, 1.0]
    assert recording.camera == StereoCamera(WIDTH, HEIGHT, 20.0, 11.5, 7.25, 0.12, 10.0)
    frame = recording[1]
    assert frame.left is not None
    assert frame.right is not None
    assert frame.depth is None
    assert frame.left.dtype == torch.float32
    assert_close(frame.left, to_tensor(pixels), atol=1e-7, rtol=0)
    assert not torch.equal(frame.left, frame.right)
    assert recording[-1].index == 10
    with pytest.raises(IndexError):
        recording[3]


def test_frames_come_in_the_order_of_their_numbers_however_these_are_written(tmp_path: Path):
    calibrate(tmp_path / "calibration.yaml", STEREO)
    for side in ("left", "right"):
        for name in ("9.png", "10.png", "0007.JPG"):
            save(tmp_path / side / name, colour_pixels())
    assert [frame.index for frame in open_recording(tmp_path)] == [7, 9, 10]


def test_frames_are_read_when_they_are_asked_for(stereo: Path):
    recording = open_recording(str(stereo))
    pixels = colour_pixels()
    save(stereo / "right" / "000010.png", pixels)
    assert_close(recording[2].right, to_tensor(pixels), atol=1e-7, rtol=0)


def test_backgrounds_pair_up_and_are_optional(stereo: Path):
    pixels = [colour_pixels() for _ in range(2)]
    for k, number in enumerate((2, 11)):  # by number, not by name
        for side in ("left", "right"):
            save(stereo / "background" / f"{side}_{number}.png", pixels[k])
    background = open_recording(stereo).background()
    assert background.left is not None
    assert background.left.shape == background.right.shape == (3, 3, HEIGHT, WIDTH)
    assert_close(background.left[1:], torch.stack([to_tensor(image) for image in pixels]), atol=1e-7, rtol=0)
    (stereo / "background" / "right_2.png").unlink()
    with pytest.raises(ValueError, match=r"every left_K .* got left \[0, 2, 11\] and right \[0, 11\]; add"):
        open_recording(stereo).background()
    for path in (stereo / "background").iterdir():
        path.unlink()
    assert open_recording(stereo).background() == Backgrounds()


@pytest.mark.parametrize("unreadable", ["empty", "text", "cut JPEG", "cut PNG", "small", "folder"])
def test_a_bad_frame_in_the_middle_says_so_and_leaves_the_others(stereo: Path, unreadable: str):
    path = stereo / "right" / "000004.png"
    if unreadable in ("cut JPEG", "cut PNG"):
        _, data = cv2.imencode(".jpg" if unreadable == "cut JPEG" else ".png", colour_pixels())
        path.write_bytes(data.tobytes()[: len(data) * 3 // 4])
    elif unreadable == "small":
        save(path, colour_pixels()[:, :-1])
    elif unreadable == "folder":
        path.unlink()
        path.mkdir()
    else:
        path.write_text("" if unreadable == "empty" else "not an image")
    recording = open_recording(stereo)
    with pytest.raises(UnreadableFrame, match=r"frame 4 cannot be read: .*000004.png must ") as error:
        recording[1]
    assert (error.value.index, error.value.time_s) == (4, 0.4)
    assert [recording[position].index for position in (0, 2)] == [3, 10]


@pytest.mark.parametrize(
    ("length", "count", "positions"),
    [
        (10, 4, [0, 3, 6, 9]),
        (100, 3, [0, 50, 99]),  # halves go to the even number
        (5, 5, [0, 1, 2, 3, 4]),
        (3, 6, [0, 1, 2]),
        (7, 1, [0]),
        (1, 3, [0]),
        (0, 3, []),
    ],
)
def test_positions_are_spread_from_end_to_end(length: int, count: int, positions: list[int]):
    assert spread_positions(length, count) == positions


def test_frames_that_cannot_be_read_are_passed_over(stereo: Path):
    (stereo / "left" / "000004.png").write_text("not an image")
    assert [frame.index for frame in readable_frames(open_recording(stereo), [2, 1, 0])] == [10, 3]


def test_the_first_image_may_be_bad_but_not_all(stereo: Path):
    (stereo / "left" / "000003.png").write_text("not an image")
    assert len(open_recording(stereo)) == 3
    for path in (stereo / "left").iterdir():
        path.write_text("not an image")
    with pytest.raises(ValueError, match=r"left must have an image that can be read, got none: .*000003"):
        open_recording(stereo)


def test_orientation_tags_do_not_turn_an_image(stereo: Path):
    _, data = cv2.imencode(".jpg", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    tag = bytes.fromhex("4578696600004d4d002a00000008000101120003000000010006000000000000")  # quarter turn
    jpeg = data.tobytes()
    exif = b"\xff\xe1" + (len(tag) + 2).to_bytes(2, "big") + tag
    (stereo / "left" / "000004.png").write_bytes(jpeg[:2] + exif + jpeg[2:])
    assert open_recording(stereo)[1].left.shape == (3, HEIGHT, WIDTH)


def test_depth_is_in_metres_and_nan_where_there_is_no_reading(depth: Path):
    steps = random.integers(1, 2**16, (HEIGHT, WIDTH), np.uint16)
    steps[3, 5] = 0
    save(depth / "depth" / "000001.png", steps)
    recording = open_recording(depth)
    assert recording.camera.baseline is None
    assert recording[0].left is None
    expected = torch.tensor(steps * 0.0005, dtype=torch.float32)
    expected[3, 5] = torch.nan
    assert_close(recording[1].depth, expected, equal_nan=True)
    assert recording.background() == Backgrounds()
    save(depth / "background" / "depth_0.png", steps)
    assert_close(recording.background().depth, expected[None], equal_nan=True)


def test_a_depth_camera_may_have_colour(depth: Path):
    pixels = colour_pixels()
    for number in range(2):
        save(depth / "colour" / f"{number:06d}.png", pixels)
    frame = open_recording(depth)[1]
    assert_close(frame.left, to_tensor(pixels), atol=1e-7, rtol=0)
    assert frame.depth is not None
    (depth / "colour" / "000000.png").unlink()
    with pytest.raises(ValueError, match=r"every image in depth/ .* frame 0 only in depth/"):
        open_recording(depth)


def test_a_depth_image_must_be_uint16(depth: Path):
    save(depth / "depth" / "000001.png", colour_pixels())
    with pytest.raises(UnreadableFrame, match=r"one channel of uint16, got uint8 of shape \(16, 24, 3\)"):
        open_recording(depth)[1]


def test_raw_pairs_are_rectified_on_reading(stereo: Path):
    values = raw_values(WIDTH, HEIGHT, 15.0, 20.0)
    calibrate(stereo / "calibration.yaml", values)
    left, right = colour_pixels(), colour_pixels()
    save(stereo / "left" / "000004.png", left)
    save(stereo / "right" / "000004.png", right)
    save(stereo / "background" / "left_0.png", left)
    save(stereo / "background" / "right_0.png", right)
    recording = open_recording(stereo)
    expected_left, expected_right, camera = raw_stereo(values).rectify(
        to_tensor(left)[None], to_tensor(right)[None]
    )
    assert recording.camera == camera
    frame = recording[1]
    assert_close(frame.left, expected_left[0])
    assert_close(frame.right, expected_right[0])
    assert frame.time_s == 4 / 15
    background = recording.background()
    assert_close(background.left, expected_left)
    assert_close(background.right, expected_right)


def remove(path: Path) -> None:
    for file in path.iterdir():
        file.unlink()
    path.rmdir()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda folder: remove(folder / "right"),
            r"must have a folder right/, but .* does not exist; add it",
        ),
        (
            lambda folder: [f.unlink() for f in (folder / "left").iterdir()],
            "000000.png, got none; name them so",
        ),
        (
            lambda folder: (folder / "right" / "000004.png").unlink(),
            "left/ must have its partner in right/, got 3 and 2 images in .*frame 4 only in left/; add",
        ),
        (
            lambda folder: save(folder / "left" / "000004.jpg", colour_pixels()),
            "must stand for one image, got 000004.jpg and 000004.png",
        ),
        (
            lambda folder: calibrate(folder / "calibration.yaml", STEREO | {"image_size": [30, 16]}),
            "must have the calibration's size 30 x 16, got 24 x 16; calibrate",
        ),
        (
            lambda folder: save(folder / "right" / "000003.png", colour_pixels()[1:]),
            "right/000003.png must have the calibration's size 24 x 16, got 24 x 15",
        ),
        (lambda folder: (folder / "calibration.yaml").unlink(), "must have this file, and it does not exist"),
        (lambda folder: calibrate(folder / "calibration.yaml", DEPTH), "must have a folder depth/"),
    ],
)
def test_a_folder_that_is_no_recording(stereo: Path, spoil: Callable[[Path], object], message: str):
    spoil(stereo)
    with pytest.raises(ValueError, match=message) as error:
        open_recording(stereo)
    assert not isinstance(error.value, UnreadableFrame)
    assert "\n" not in str(error.value)


def test_what_is_no_folder(tmp_path: Path):
    with pytest.raises(
        ValueError, match=r"a folder or a video, but .*nowhere does not exist; check the path"
    ):
        open_recording(tmp_path / "nowhere")
    (tmp_path / "video.mp4").touch()
    with pytest.raises(ValueError, match=r"must come with its calibration, got none for .*video.mp4; give"):
        open_recording(tmp_path / "video.mp4")
    calibrate(tmp_path / "calibration.yaml", STEREO)
    with pytest.raises(ValueError, match=r"video.mp4 must be a video that OpenCV can read"):
        open_recording(tmp_path / "video.mp4", calibration=tmp_path / "calibration.yaml")


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_written_stereo_recording_reads_back(tmp_path: Path, suffix: str):
    camera = StereoCamera(WIDTH, HEIGHT, 20.0, 11.123456789012345, 7.25, 0.12, 29.97)
    smooth = torch.linspace(0, 1, WIDTH).expand(3, HEIGHT, WIDTH)  # a JPEG keeps what is smooth
    shade = torch.tensor([0.2, 0.5, 1.0])[:, None, None]
    frames = [Frame(7 * i, 0.0, smooth * shade / (i + 1), smooth.flip(-1) * shade) for i in range(3)]
    background = Backgrounds(smooth[None] * shade, smooth[None] / 2)
    assert write_recording(tmp_path / "new", camera, iter(frames), background, suffix) == tmp_path / "new"
    recording = open_recording(tmp_path / "new")
    assert recording.camera == camera
    assert recording.indices == (0, 7, 14)
    atol = 0.5 / 255 + 1e-6 if suffix == ".png" else 0.05
    for read, frame in zip(recording, frames, strict=True):
        assert_close(read.left, frame.left, atol=atol, rtol=0)
        assert_close(read.right, frame.right, atol=atol, rtol=0)
    assert_close(recording.background().left, background.left, atol=atol, rtol=0)
    assert_close(recording.background().right, background.right, atol=atol, rtol=0)


def test_a_written_depth_recording_reads_back(tmp_path: Path):
    camera = StereoCamera(WIDTH, HEIGHT, 20.0, 11.5, 7.25, None, 10.0)
    depth = torch.rand(HEIGHT, WIDTH) * 5 + 0.5
    depth[0] = torch.nan
    far = depth.clone()
    far[1] = 70.0  # m, beyond 16 bits of millimetres
    colour = torch.rand(3, HEIGHT, WIDTH)
    write_recording(tmp_path, camera, [Frame(0, 0.0, colour, depth=far)], Backgrounds(depth=depth[None]))
    recording = open_recording(tmp_path)
    assert recording.camera == camera
    assert_close(recording[0].left, colour, atol=0.5 / 255 + 1e-6, rtol=0)
    assert_close(recording.background().depth[0], depth, atol=0.000501, rtol=0, equal_nan=True)
    assert recording[0].depth[1].isnan().all()
    assert_close(recording[0].depth[2:], depth[2:], atol=0.000501, rtol=0)


def test_an_interrupted_writer_leaves_no_calibration_and_no_half_file(tmp_path: Path):
    def frames():
        yield Frame(0, 0.0, torch.rand(3, HEIGHT, WIDTH), torch.rand(3, HEIGHT, WIDTH))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_recording(tmp_path, StereoCamera(WIDTH, HEIGHT, 20.0, 11.5, 7.25, 0.12), frames())
    names = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.*"))
    assert names == ["left/000000.png", "right/000000.png"]


def test_what_cannot_be_written(tmp_path: Path):
    camera = StereoCamera(WIDTH, HEIGHT, 20.0, 11.5, 7.25, 0.12)
    image = torch.rand(3, HEIGHT, WIDTH)
    with pytest.raises(ValueError, match=r"suffix must be .png or .jpg, got '.bmp'"):
        write_recording(tmp_path, camera, [], suffix=".bmp")
    with pytest.raises(ValueError, match="at least one frame, got none"):
        write_recording(tmp_path, camera, [])
    with pytest.raises(ValueError, match="frame 2 must have a right image for this camera, got None"):
        write_recording(tmp_path, camera, [Frame(2, 0.1, image)])


def test_recordings_by_others(shared_data: Path):
    recording = open_recording(shared_data / "people" / "walking_m2")
    assert len(recording) == 60
    assert recording[59].time_s == 2.95
    assert recording[0].left.shape == (3, 480, 640)
    assert recording.background().left.shape == (2, 3, 480, 640)
    recording = open_recording(shared_data / "realsense_rehab")
    assert len(recording) == 300
    depth = recording[150].depth
    assert depth.shape == (240, 424)
    assert 0.5 < depth[~depth.isnan()].median() < 10
