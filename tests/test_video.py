"""Videos against OpenCV's own sequential decoding of lossless files that are written here, and damaged on purpose."""

import struct
import warnings
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from calibration_file import calibrate, raw_stereo, raw_values, stereo_values, without
from torch.testing import assert_close

from torchpose.recording import Backgrounds, Recording, UnreadableFrame, VideoRecording, open_recording
from torchpose.video import VideoFile
from torchpose.vision.camera import RawStereo, StereoCamera

WIDTH, HEIGHT, RATE, LENGTH = 48, 32, 12.5, 60
STEREO = stereo_values(WIDTH, HEIGHT, RATE)


def moving_images(count: int = LENGTH, width: int = WIDTH, height: int = HEIGHT, seed: int = 0) -> np.ndarray:
    """(count, H, W, 3) RGB bytes, each image unlike the others."""
    random = np.random.default_rng(seed)
    images = np.repeat(random.integers(0, 256, (1, height, width, 3), np.uint8), count, axis=0)
    for number, image in enumerate(images):
        image[:8, :8] = 4 * number
        image[10:20, number % width] = random.integers(0, 256, 3)
    return images


def write_video(path: Path, images: np.ndarray, codec: str = "FFV1", rate: float = RATE) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    size = (images.shape[2], images.shape[1])
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), rate, size)
    assert writer.isOpened()
    for image in images:
        writer.write(np.ascontiguousarray(image[..., ::-1]))
    writer.release()
    return path


def decoded(path: Path) -> list[np.ndarray]:
    """All frames in order, by OpenCV alone."""
    capture, images = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG), []
    while True:
        there, image = capture.read()
        if not there:
            return images
        images.append(image[..., ::-1])


def packets(path: Path) -> list[tuple[int, int]]:
    """Where each packet lies in the file: offset and length, in the order of the file."""
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    capture.set(cv2.CAP_PROP_FORMAT, -1)
    data, places, at = path.read_bytes(), [], 0
    while True:
        there, packet = capture.read()
        if not there:
            return places
        at = data.index(packet.tobytes(), at)
        places.append((at, packet.size))


def wipe(path: Path, numbers: list[int]) -> None:
    """Fill these packets with zeros."""
    data = bytearray(path.read_bytes())
    places = packets(path)
    for number in numbers:
        offset, length = places[number]
        data[offset : offset + length] = bytes(length)
    path.write_bytes(data)


@pytest.fixture(scope="module")
def lossless(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    images = moving_images()
    return write_video(tmp_path_factory.mktemp("video") / "lossless.mkv", images), images


@pytest.mark.parametrize(
    ("codec", "suffix"),
    [
        ("FFV1", "mkv"),
        ("FFV1", "avi"),
        ("mp4v", "mp4"),
        ("mp4v", "mov"),
        ("MJPG", "avi"),
        ("VP80", "webm"),
        ("MPG2", "mpg"),  # packets without time stamps
    ],
)
def test_any_frame_is_the_one_that_decoding_in_order_gives(tmp_path: Path, codec: str, suffix: str):
    rate = 25.0 if codec == "MPG2" else RATE
    path = write_video(tmp_path / f"video.{suffix}", moving_images(), codec, rate)
    expected = decoded(path)
    video = VideoFile(path)
    assert len(video) == len(expected) == LENGTH
    assert (video.width, video.height) == (WIDTH, HEIGHT)
    assert video.frame_rate == rate
    order = [*range(LENGTH), *np.random.default_rng(1).integers(0, LENGTH, 40).tolist(), 59, 0, 0, 58, 1]
    for number in order:
        assert np.array_equal(video.read(number), expected[number]), number


def test_a_lossless_video_gives_the_images_that_were_written(lossless: tuple[Path, np.ndarray]):
    video = VideoFile(lossless[0])
    assert all(np.array_equal(video.read(number), image) for number, image in enumerate(lossless[1]))
    with pytest.raises(IndexError, match="has the frames 0 to 59, got 60"):
        video.read(60)


def test_reading_in_order_decodes_each_frame_once_and_never_seeks(
    lossless: tuple[Path, np.ndarray], monkeypatch: pytest.MonkeyPatch
):
    video = VideoFile(lossless[0])
    video.read(0)
    grabbed = []
    grab = VideoFile._grab
    monkeypatch.setattr(VideoFile, "_grab", lambda self: grabbed.append(1) or grab(self))
    monkeypatch.setattr(VideoFile, "_seek", lambda *_: pytest.fail("sought"))
    for number in [0, 0, *range(1, LENGTH), LENGTH - 1]:
        video.read(number)
    assert len(grabbed) == LENGTH - 1


def test_uneven_time_stamps_do_not_confuse_the_numbers(tmp_path: Path):
    """The packets of one video, written into another with the stamps of a camera that skips."""
    source = write_video(tmp_path / "even.avi", moving_images(), "MJPG")
    data, path = source.read_bytes(), tmp_path / "uneven.mkv"
    writer = cv2.VideoWriter(
        str(path),
        cv2.CAP_FFMPEG,
        cv2.VideoWriter.fourcc(*"MJPG"),
        RATE,
        (WIDTH, HEIGHT),
        [cv2.VIDEOWRITER_PROP_RAW_VIDEO, 1],
    )
    time = 0
    for offset, length in packets(source):
        writer.set(cv2.VIDEOWRITER_PROP_PTS, time)
        writer.write(np.frombuffer(data[offset : offset + length], np.uint8)[None])
        time += int(np.random.default_rng(time).integers(1, 8))
    writer.release()
    expected, video = decoded(source), VideoFile(path)
    assert len(video) == LENGTH
    assert video.frame_rate < RATE / 2
    for number in [*range(LENGTH), *np.random.default_rng(2).integers(0, LENGTH, 60).tolist()]:
        assert np.array_equal(video.read(number), expected[number]), number


def test_a_file_that_was_cut_off_has_the_frames_that_are_left(tmp_path: Path):
    """The header still promises all of them."""
    path = write_video(tmp_path / "cut.avi", moving_images())
    offset, length = packets(path)[37]
    path.write_bytes(path.read_bytes()[: offset + length // 2])
    assert cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT) == LENGTH
    video = VideoFile(path)
    assert len(video) == 37
    assert np.array_equal(video.read(36), moving_images()[36])


@pytest.mark.parametrize("promised", [3, 600])
def test_a_header_that_lies_about_the_length(tmp_path: Path, promised: int):
    path = write_video(tmp_path / "video.avi", moving_images())
    data = bytearray(path.read_bytes())
    for name, offset in ((b"avih", 8 + 16), (b"strh", 8 + 32)):  # total frames; length of the stream
        struct.pack_into("<I", data, data.index(name) + offset, promised)
    path.write_bytes(data)
    video = VideoFile(path)
    assert len(video) == LENGTH
    assert [np.array_equal(video.read(number), moving_images()[number]) for number in (59, 2, 40)] == [
        True
    ] * 3


@pytest.mark.parametrize(
    ("damaged", "length"), [([20], 60), ([0, 1], 60), ([30, 31, 32], 60), ([58, 59], 58), ([5, 57, 59], 59)]
)
def test_a_damaged_frame_leaves_its_number_empty_and_shifts_no_other(
    tmp_path: Path, damaged: list[int], length: int
):
    path = write_video(tmp_path / "video.avi", moving_images(), "MJPG")
    expected = decoded(path)
    wipe(path, damaged)
    video = VideoFile(path)
    assert len(video) == length
    for number in [*range(length), *np.random.default_rng(1).integers(0, length, 30).tolist()]:
        if number in damaged:
            with pytest.raises(ValueError, match=rf"a frame {number} that can be decoded, got damaged data"):
                video.read(number)
        else:
            assert np.array_equal(video.read(number), expected[number]), number


def test_what_is_no_video(tmp_path: Path):
    with pytest.raises(ValueError, match=r"must be a file, but .*none.avi is none; check the path"):
        VideoFile(tmp_path / "none.avi")
    (tmp_path / "text.mp4").write_text("not a video")
    with pytest.raises(ValueError, match=r"text.mp4 must be a video that OpenCV can read"):
        VideoFile(tmp_path / "text.mp4")
    path = write_video(tmp_path / "video.avi", moving_images(), "MJPG")
    wipe(path, list(range(LENGTH)))
    with pytest.raises(ValueError, match="a frame that can be decoded, got none in 60 packets"):
        VideoFile(path)


@pytest.fixture
def pair(tmp_path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Left and right images, and a calibration of them."""
    calibrate(tmp_path / "calibration.yaml", STEREO)
    return moving_images(20, seed=1), moving_images(20, seed=2)


def check_frames(recording: VideoRecording, left: np.ndarray, right: np.ndarray) -> None:
    assert isinstance(recording, Recording)
    assert len(recording) == len(left)
    assert recording.camera == StereoCamera(WIDTH, HEIGHT, 40.0, 23.5, 15.25, 0.12, RATE)
    for k in [*range(len(left)), -1, 4]:
        frame = recording[k]
        assert frame.index == k % len(left)
        assert frame.time_s == frame.index / RATE
        assert frame.depth is None
        assert_close(frame.left, to_tensor(left[k]), atol=1e-7, rtol=0)
        assert_close(frame.right, to_tensor(right[k]), atol=1e-7, rtol=0)
    assert [frame.index for frame in recording] == list(range(len(left)))
    with pytest.raises(IndexError):
        recording[len(left)]


def to_tensor(rgb: np.ndarray) -> torch.Tensor:
    return torch.tensor(rgb / 255, dtype=torch.float32).permute(2, 0, 1)


def test_a_side_by_side_video_is_a_recording(tmp_path: Path, pair: tuple[np.ndarray, np.ndarray]):
    path = write_video(tmp_path / "both.mkv", np.concatenate(pair, axis=2))
    check_frames(open_recording(path, calibration=tmp_path / "calibration.yaml"), *pair)


def test_two_videos_are_a_recording(tmp_path: Path, pair: tuple[np.ndarray, np.ndarray]):
    left, right = write_video(tmp_path / "a.mkv", pair[0]), write_video(tmp_path / "b.avi", pair[1])
    check_frames(open_recording(left, right, str(tmp_path / "calibration.yaml")), *pair)


def test_a_folder_may_hold_two_videos(tmp_path: Path, pair: tuple[np.ndarray, np.ndarray]):
    write_video(tmp_path / "left.mkv", pair[0])
    with pytest.raises(
        ValueError, match=r"a left.\* and a right.\* video, got only .*left.mkv; add the other"
    ):
        open_recording(tmp_path)
    write_video(tmp_path / "right.avi", pair[1])
    check_frames(open_recording(tmp_path), *pair)
    elsewhere = (tmp_path / "calibration.yaml").rename(tmp_path / "other.yaml")
    check_frames(open_recording(tmp_path, calibration=elsewhere), *pair)
    with pytest.raises(
        ValueError, match=r"right must be a video beside a left one, got .* beside the folder"
    ):
        open_recording(tmp_path, right=tmp_path / "right.avi")
    write_video(tmp_path / "right.mp4", pair[1], "mp4v")
    with pytest.raises(ValueError, match=r"must have one video or one folder, got right.avi and right.mp4"):
        open_recording(tmp_path)
    (tmp_path / "right.mp4").unlink()
    (tmp_path / "right").mkdir()
    with pytest.raises(ValueError, match=r"must have one video or one folder, got right.avi and right in"):
        open_recording(tmp_path)


def test_raw_videos_are_rectified_frame_by_frame_when_they_are_read(
    tmp_path: Path, pair: tuple[np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
):
    path = write_video(tmp_path / "both.mkv", np.concatenate(pair, axis=2))
    count, rectify = [], RawStereo.rectify
    monkeypatch.setattr(RawStereo, "rectify", lambda *images: count.append(1) or rectify(*images))
    values = raw_values(WIDTH, HEIGHT, RATE)
    recording = open_recording(path, calibration=calibrate(tmp_path / "raw.yaml", values))
    assert not count
    frame = recording[7]
    assert len(count) == 1
    left, right, camera = rectify(raw_stereo(values), *(to_tensor(images[7])[None] for images in pair))
    assert recording.camera == camera
    assert_close(frame.left, left[0])
    assert_close(frame.right, right[0])


def test_background_frames_may_come_from_any_folder(tmp_path: Path, pair: tuple[np.ndarray, np.ndarray]):
    path = write_video(tmp_path / "both.mkv", np.concatenate(pair, axis=2))
    calibration, scene = tmp_path / "calibration.yaml", tmp_path / "empty"
    scene.mkdir()
    for side, images in zip(("left", "right"), pair, strict=True):
        for k in range(2):
            cv2.imwrite(str(scene / f"{side}_{k}.png"), images[k][..., ::-1])
    assert open_recording(path, calibration=calibration).background() == Backgrounds()
    background = open_recording(path, calibration=calibration, background=scene).background()
    assert_close(background.left, torch.stack([to_tensor(image) for image in pair[0][:2]]), atol=1e-7, rtol=0)
    assert_close(
        background.right, torch.stack([to_tensor(image) for image in pair[1][:2]]), atol=1e-7, rtol=0
    )
    for side, images in zip(("left", "right"), pair, strict=True):
        write_video(tmp_path / f"{side}.mkv", images)
    assert open_recording(tmp_path).background() == Backgrounds()
    assert_close(open_recording(tmp_path, background=scene).background().left, background.left)
    scene.rename(tmp_path / "background")
    assert_close(open_recording(tmp_path).background().left, background.left)
    with pytest.raises(
        ValueError, match=r"must be a folder with left_K and right_K images, got .*empty; check"
    ):
        open_recording(tmp_path, background=scene)


def test_a_damaged_frame_of_either_video_says_so_and_leaves_the_others(
    tmp_path: Path, pair: tuple[np.ndarray, np.ndarray]
):
    left = write_video(tmp_path / "left.avi", pair[0], "MJPG")
    right = write_video(tmp_path / "right.avi", pair[1], "MJPG")
    expected = decoded(right)
    wipe(right, [6])
    recording = open_recording(left, right, tmp_path / "calibration.yaml")
    assert len(recording) == 20
    with pytest.raises(
        UnreadableFrame, match=r"frame 6 cannot be read: .*right.avi must have a frame 6"
    ) as error:
        recording[6]
    assert (error.value.index, error.value.time_s) == (6, 6 / RATE)
    assert_close(recording[7].right, to_tensor(expected[7]), atol=1e-7, rtol=0)


def test_videos_that_end_a_little_apart_are_cut_to_the_shorter(
    tmp_path: Path, pair: tuple[np.ndarray, np.ndarray]
):
    left, right = write_video(tmp_path / "a.mkv", pair[0]), write_video(tmp_path / "b.mkv", pair[1][:17])
    with pytest.warns(UserWarning, match=r"of 20 and 17 frames in .* the last 3 have no partner"):
        recording = open_recording(left, right, tmp_path / "calibration.yaml")
    check_frames(recording, pair[0][:17], pair[1][:17])


@pytest.mark.parametrize(("rate", "warned"), [(12.4, False), (12.7, True), (30.0, True)])
def test_a_calibration_of_another_frame_rate_is_warned_of(tmp_path: Path, rate: float, warned: bool):
    path = write_video(tmp_path / "both.mkv", moving_images(20, 2 * WIDTH))
    calibration = calibrate(tmp_path / "calibration.yaml", STEREO | {"frame_rate": rate})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        recording = open_recording(path, calibration=calibration)
    assert recording[3].time_s == 3 / rate
    messages = [str(warning.message) for warning in caught]
    text = f"has 12.5 frames a second and the calibration says {rate:g}: times are by the calibration"
    assert [text in message for message in messages] == [True] * warned


def test_the_shared_rig_s_videos(shared_data: Path):
    """Random access to H.264 with reordered frames, against decoding in order."""
    path = shared_data / "oakd_overhead" / "right.mp4"
    video, capture = VideoFile(path), cv2.VideoCapture(str(path))
    assert len(video) == 627
    assert video.frame_rate == 30
    wanted = sorted(np.random.default_rng(0).integers(0, 300, 12).tolist())
    expected = {}
    for number in range(wanted[-1] + 1):
        capture.grab()
        if number in wanted:
            expected[number] = capture.retrieve()[1][..., ::-1]
    for number in np.random.default_rng(1).permutation(wanted).tolist():
        assert np.array_equal(video.read(number), expected[number]), number


def side_by_side(folder: Path, **changes: object) -> Callable[[], VideoRecording]:
    path = write_video(folder / "both.mkv", moving_images(20, 2 * WIDTH))
    calibration = calibrate(folder / "calibration.yaml", STEREO | changes)
    return lambda: open_recording(path, calibration=calibration)


def test_videos_that_do_not_fit(tmp_path: Path):
    with pytest.raises(
        ValueError,
        match=r"both.mkv must have twice the calibration's width, 80 x 32, got 96 x 32; .*right=FILE",
    ):
        side_by_side(tmp_path, image_size=[40, HEIGHT])()
    depth = without(STEREO, "baseline") | {"depth_unit": 0.001}
    with pytest.raises(ValueError, match="must be of a stereo pair, got the calibration of a depth camera"):
        open_recording(tmp_path / "both.mkv", calibration=calibrate(tmp_path / "calibration.yaml", depth))
    calibrate(tmp_path / "calibration.yaml", STEREO)
    left = write_video(tmp_path / "a.mkv", moving_images(20))
    for images, rate, message in (
        (
            moving_images(20),
            15.0,
            "must have one frame rate, got 12.5 and 15 Hz in .*a.mkv and .*b.mkv; record",
        ),
        (
            moving_images(40),
            RATE,
            "must have the same frames, got 20 and 40 in .*a.mkv and .*b.mkv; cut both",
        ),
        (moving_images(20, WIDTH + 2), RATE, "b.mkv must have the calibration's size, 48 x 32, got 50 x 32"),
    ):
        right = write_video(tmp_path / "b.mkv", images, rate=rate)
        with pytest.raises(ValueError, match=message):
            open_recording(left, right, tmp_path / "calibration.yaml")
