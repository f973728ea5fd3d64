"""Live cameras, by devices that are made up here and by a video file in the place of one."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from calibration_file import calibrate, raw_values, stereo_values, without

from torchpose.calibration import read_calibration
from torchpose.capture import camera_numbers, capture_recording
from torchpose.recording import open_recording

WIDTH, HEIGHT, RATE = 40, 24, 10.0
STEREO = stereo_values(WIDTH, HEIGHT, RATE)


class FakeDevice:
    """Shows the number of each grab as a grey level, at the times given, s; -1 stands for a failed grab.

    `log` is shared by devices, to see who did what when. A real device's clock does not start at 0.
    """

    def __init__(
        self,
        times: list[float],
        width: int = 2 * WIDTH,
        height: int = HEIGHT,
        stamped: bool = True,
        log: list[str] | None = None,
        undecodable: tuple[int, ...] = (),
        rate: float = RATE,
    ) -> None:
        self.times, self.size, self.stamped = times, (width, height), stamped
        self.log = [] if log is None else log
        self.undecodable, self.rate, self.at = undecodable, rate, -1

    @property
    def time(self) -> float:
        return self.times[min(max(self.at, 0), len(self.times) - 1)]

    def grab(self) -> bool:
        self.at += 1
        self.log.append("grab")
        if self.at >= len(self.times):
            return False
        if self.times[self.at] == np.inf:
            raise KeyboardInterrupt
        return self.times[self.at] >= 0

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        self.log.append("retrieve")
        if self.at in self.undecodable:
            return False, None
        image = np.full((self.size[1], self.size[0], 3), 10 + 5 * self.at, np.uint8)
        image[:, self.size[0] // 2 :] += 3  # the right half is a little brighter
        return True, image

    def get(self, name: int) -> float:
        if name == cv2.CAP_PROP_POS_MSEC:
            return 1000 * (500 + self.time) if self.stamped else 0.0
        return {
            cv2.CAP_PROP_FRAME_WIDTH: self.size[0],
            cv2.CAP_PROP_FRAME_HEIGHT: self.size[1],
            cv2.CAP_PROP_FPS: self.rate,
        }[name]

    def set(self, name: int, value: float) -> bool:
        self.log.append(f"set {value:g}")
        return True

    def release(self) -> None:
        self.log.append("release")


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    return calibrate(tmp_path / "rig.yaml", STEREO)


def levels(folder: Path) -> dict[int, tuple[int, int]]:
    """Grey levels of left and right image by frame number."""
    return {
        frame.index: tuple(round(float(image.mean()) * 255) for image in (frame.left, frame.right))
        for frame in open_recording(folder)
    }


def test_what_is_captured_is_a_recording(tmp_path: Path, rig: Path):
    device = FakeDevice([0.1 * k for k in range(20)])
    capture = capture_recording([device], tmp_path / "new", rig, 5)
    assert (capture.folder, capture.frames, capture.dropped) == (tmp_path / "new", 5, 0)
    assert (capture.seconds, capture.interrupted) == (0.4, False)
    assert levels(tmp_path / "new") == {k: (10 + 5 * k, 13 + 5 * k) for k in range(5)}
    assert open_recording(tmp_path / "new").camera == read_calibration(rig).camera
    assert device.log[:3] == ["set 80", "set 24", "set 10"]
    assert [frame.time_s for frame in open_recording(tmp_path / "new")] == [k / RATE for k in range(5)]


@pytest.mark.parametrize("stamped", [True, False], ids=["the device's time", "the clock's"])
def test_dropped_frames_are_gaps_in_the_numbers(tmp_path: Path, rig: Path, stamped: bool):
    """By the device's time stamps, or where it has none by the clock; jitter does not matter."""
    times = [3.0, 3.11, 3.19, 3.52, 3.6, 3.98]
    device = FakeDevice(times, stamped=stamped)
    capture = capture_recording([device], tmp_path / "new", rig, 100, clock=lambda: device.time)
    assert list(levels(tmp_path / "new")) == [0, 1, 2, 5, 6, 10]
    assert (capture.frames, capture.dropped, capture.seconds) == (6, 5, 1.0)
    assert [frame.time_s for frame in open_recording(tmp_path / "new")] == [0, 0.1, 0.2, 0.5, 0.6, 1.0]


def test_a_camera_faster_than_its_calibration_gives_each_number_once(tmp_path: Path, rig: Path):
    capture_recording([FakeDevice([k / 30 for k in range(30)])], tmp_path / "new", rig, 100)
    found = levels(tmp_path / "new")
    assert list(found) == list(range(11))
    assert [(left - 10) // 5 for left, _ in found.values()] == [
        0,
        *range(2, 30, 3),
    ]  # the first of each three


def test_two_devices_are_grabbed_together_and_then_decoded(tmp_path: Path, rig: Path):
    log: list[str] = []
    times = [0.1 * k for k in range(4)]
    left, right = FakeDevice(times, WIDTH, log=log), FakeDevice([-1, *times], WIDTH, log=log)
    capture = capture_recording([left, right], tmp_path / "new", rig, 100)
    steps = [step for step in log if step in ("grab", "retrieve")]
    assert steps[:6] == ["grab", "grab", "grab", "grab", "retrieve", "retrieve"]  # the first right one failed
    assert capture.frames == 3
    assert log[0] == "set 40"
    assert {number: round(pair[0] - pair[1]) for number, pair in levels(tmp_path / "new").items()} == {
        0: 0,
        1: 0,
        2: 0,
    }


def test_what_fails_now_and_then_is_left_out_and_what_fails_for_good_ends_it(tmp_path: Path, rig: Path):
    times = [0.0, -1, 0.2, 0.3, 0.4, -1, -1, -1, -1, 0.9, *[-1.0] * 5, 1.5]
    capture = capture_recording([FakeDevice(times, undecodable=(3,))], tmp_path / "new", rig, 100)
    assert list(levels(tmp_path / "new")) == [0, 2, 4, 9]
    assert (capture.frames, capture.dropped) == (4, 6)


def test_ctrl_c_ends_the_capture_and_keeps_it(tmp_path: Path, rig: Path, monkeypatch: pytest.MonkeyPatch):
    capture = capture_recording([FakeDevice([0, 0.1, 0.2, np.inf])], tmp_path / "a", rig, 100)
    assert (capture.frames, capture.interrupted) == (3, True)
    assert list(levels(tmp_path / "a")) == [0, 1, 2]
    with pytest.raises(KeyboardInterrupt):  # with nothing to keep
        capture_recording([FakeDevice([np.inf])], tmp_path / "b", rig, 100)
    assert not (tmp_path / "b").exists()
    # Between the left and the right image of a pair: the single one goes.
    from torchpose import capture as module

    encode = module.encode

    def interrupted(path: Path, pixels: np.ndarray) -> None:
        if path.parts[-2:] == ("right", "000002.jpg"):
            raise KeyboardInterrupt
        encode(path, pixels)

    monkeypatch.setattr(module, "encode", interrupted)
    capture = capture_recording([FakeDevice([0, 0.1, 0.2, 0.3])], tmp_path / "c", rig, 100)
    assert (capture.frames, capture.interrupted) == (2, True)
    assert list(levels(tmp_path / "c")) == [0, 1]


def test_raw_images_are_kept_raw_with_their_calibration_and_the_empty_scene_comes_along(tmp_path: Path):
    rig = calibrate(tmp_path / "raw.yaml", raw_values(WIDTH, HEIGHT, RATE))
    scene = tmp_path / "empty"
    scene.mkdir()
    for side in ("left", "right"):
        cv2.imwrite(str(scene / f"{side}_0.png"), np.full((HEIGHT, WIDTH, 3), 100, np.uint8))
    capture_recording([FakeDevice([0, 0.1])], tmp_path / "new", rig, 2, scene)
    image = cv2.imread(str(tmp_path / "new" / "right" / "000001.jpg"))
    assert abs(image.astype(int) - 18).max() <= 1  # to the corners: nothing was rectified
    written, given = open_recording(tmp_path / "new").calibration.raw, read_calibration(rig).raw
    for key in ("K1", "D1", "K2", "D2", "R", "T", "image_size", "frame_rate"):
        np.testing.assert_array_equal(getattr(written, key), getattr(given, key))
    assert open_recording(tmp_path / "new").background().left.shape == (1, 3, HEIGHT, WIDTH)


def test_a_video_file_may_stand_in_for_a_device(tmp_path: Path, rig: Path):
    """Its own frame rate is half of the calibration's: every other number is a gap."""
    path = tmp_path / "device.avi"
    writer = cv2.VideoWriter(
        str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), 5, (2 * WIDTH, HEIGHT)
    )
    for k in range(6):
        writer.write(np.full((HEIGHT, 2 * WIDTH, 3), 20 * k, np.uint8))
    writer.release()
    capture = capture_recording([cv2.VideoCapture(str(path))], tmp_path / "new", rig, 100)
    assert (capture.frames, capture.dropped) == (6, 5)
    assert levels(tmp_path / "new") == {2 * k: (20 * k, 20 * k) for k in range(6)}


@pytest.mark.parametrize(
    ("calibration", "devices", "message"),
    [
        (STEREO, lambda: [FakeDevice([])], "a camera must give images, got none that can be decoded"),
        (STEREO, lambda: [FakeDevice([0.0] * 9, undecodable=tuple(range(9)))], "must give images, got none"),
        (
            STEREO,
            lambda: [FakeDevice([0], WIDTH)],
            "must give the calibration's size, 40 x 24 twice, side by side, got 40 x 24; calibrate",
        ),
        (
            STEREO,
            lambda: [FakeDevice([0], WIDTH), FakeDevice([0], WIDTH, 30)],
            "must give the calibration's size, 40 x 24, got 40 x 24 and 40 x 30; calibrate it at a size",
        ),
        (
            without(STEREO, "baseline") | {"depth_unit": 0.001},
            lambda: [FakeDevice([0])],
            "a live camera must be a stereo camera, got the calibration of a depth camera in .*rig.yaml; write",
        ),
    ],
)
def test_what_cannot_be_captured_leaves_nothing(
    tmp_path: Path, rig: Path, calibration: dict, devices: Callable[[], list[FakeDevice]], message: str
):
    calibrate(rig, calibration)
    with pytest.raises(ValueError, match=message):
        capture_recording(devices(), tmp_path / "new", rig, 10)
    assert not (tmp_path / "new").exists()


def test_an_earlier_recording_is_not_lost(tmp_path: Path, rig: Path):
    (tmp_path / "new").mkdir()
    capture_recording([FakeDevice([0])], tmp_path / "new", rig, 1)
    with pytest.raises(
        ValueError, match=r"must be empty, got .*new with an earlier one; recording=.*new runs that"
    ):
        capture_recording([FakeDevice([0])], tmp_path / "new", rig, 1)
    assert len(open_recording(tmp_path / "new")) == 1


@pytest.mark.parametrize(
    ("recording", "numbers"),
    [("camera:0", (0,)), ("camera:2+0", (2, 0)), ("my/camera:0", None), ("a.mp4", None)],
)
def test_names_of_cameras(recording: str, numbers: tuple[int, ...] | None):
    assert camera_numbers(recording) == numbers


@pytest.mark.parametrize("recording", ["camera:", "camera:a", "camera:0+0", "camera:0+1+2", "camera:-1"])
def test_what_names_no_camera(recording: str):
    with pytest.raises(ValueError, match=r"must be camera:N, .* or camera:N\+M, two cameras, got camera:"):
        camera_numbers(recording)
