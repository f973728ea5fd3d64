"""Live cameras: what they see is first written as a recording, then read like any other.

A frame's number is its time since the first one at the calibration's frame rate, rounded, so a frame that was dropped
is a gap in the numbers and times stay right to half a frame.
"""

import re
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import UInt8

from torchpose.calibration import Calibration, read_calibration, write_calibration
from torchpose.image_file import decode, encode
from torchpose.recording import BACKGROUND, CALIBRATION

_PREFIX = "camera:"
_FAILURES = 5  # grabs in a row that may fail before the camera is taken to be gone
_SIDES = ("left", "right")
_SIZE = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
_SUFFIX = ".jpg"  # a camera does not wait for PNG


@runtime_checkable
class CaptureDevice(Protocol):
    """What is needed of `cv2.VideoCapture`."""

    def grab(self) -> bool: ...

    def retrieve(self) -> tuple[bool, np.ndarray]: ...

    def get(self, propId: int) -> float: ...

    def set(self, propId: int, value: float) -> bool: ...

    def release(self) -> None: ...


@dataclass(frozen=True)
class Capture:
    """What was recorded."""

    folder: Path  # of the recording
    frames: int  # pairs that were written
    dropped: int  # pairs that are missing between them at the calibration's frame rate
    seconds: float  # from the first to the last frame
    interrupted: bool  # ended by the keyboard


def camera_numbers(recording: str) -> tuple[int, ...] | None:
    """Device numbers in `camera:0` or `camera:0+1`, left first; None where `recording` is no camera.

    Raises ValueError where it is neither.
    """
    if not recording.startswith(_PREFIX):
        return None
    match = re.fullmatch(r"(\d+)(?:\+(\d+))?", recording.removeprefix(_PREFIX))
    numbers = tuple(int(number) for number in match.groups() if number is not None) if match else ()
    if not numbers or len(set(numbers)) < len(numbers):
        raise ValueError(
            f"a live recording must be {_PREFIX}N, a side-by-side stereo camera, or {_PREFIX}N+M, two cameras, got "
            f"{recording}; count the cameras from 0"
        )
    return numbers


def open_cameras(numbers: Sequence[int]) -> list[cv2.VideoCapture]:
    """The devices; ValueError where this machine has no such camera, or another program has it."""
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # one sentence is enough
    try:
        devices = [cv2.VideoCapture(number) for number in numbers]
    finally:
        cv2.utils.logging.setLogLevel(level)
    for number, device in zip(numbers, devices, strict=True):
        if not device.isOpened():
            raise ValueError(
                f"{_PREFIX}{number} must be a camera of this machine, got none that can be opened; plug it in, close "
                "other programs that use it, or try another number"
            )
    return devices


def capture_recording(
    devices: Sequence[CaptureDevice],
    folder: str | Path,
    calibration: str | Path,
    max_frames: int,
    background: str | Path | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> Capture:
    """Record pairs from one side-by-side device or from two into a folder that `open_recording` reads.

    Two devices are grabbed one right after the other and then decoded. Images are written as they come, raw, as JPEG;
    the calibration comes last, so a folder that has one is complete. Time is the device's time stamp, or the clock's
    where it gives none. Ctrl-C ends the recording and keeps it.

    Args:
        devices: one, whose images hold left and right beside one another, or the left and the right one.
        folder: to be made; what is in it must not be lost, so it must be empty.
        calibration: file, see `read_calibration`.
        max_frames: pairs to record; a device that ends before ends the recording.
        background: folder with images of the empty scene, which are copied.
        clock: seconds.

    Raises ValueError where the folder is not empty, the calibration is none of a stereo pair, the devices do not have
    its size, or no image comes.
    """
    folder = Path(folder)
    require_empty(folder)
    known = prepare_cameras(devices, Path(calibration))
    rate = known.camera.frame_rate
    number, last, frames, interrupted = 0, -1, 0, False
    try:
        for number, _, pair in camera_pairs(devices, rate, clock):
            write_pair(folder, number, pair)
            last, frames = number, frames + 1
            if frames == max_frames:
                break
    except KeyboardInterrupt:
        for side in _SIDES if number > last else ():  # the pair that was being written
            _path(folder, side, number).unlink(missing_ok=True)
        if not frames:
            raise
        interrupted = True
    if not frames:
        raise ValueError(
            "a camera must give images, got none that can be decoded; try it in another program, or unplug it and "
            "plug it in again"
        )
    if background is not None:
        shutil.copytree(background, folder / BACKGROUND)
    write_calibration(folder / CALIBRATION, known)
    return Capture(folder, frames, last + 1 - frames, last / rate, interrupted)


def prepare_cameras(devices: Sequence[CaptureDevice], path: Path) -> Calibration:
    """The calibration, and the devices set to its size and frame rate; ValueError where they cannot be."""
    promised = devices[0].get(cv2.CAP_PROP_FPS)
    promised_rate = promised if promised > 0 else None  # DepthAI's calibrations have none
    calibration = read_calibration(path, frame_rate=promised_rate)
    if calibration.depth_unit is not None:
        raise ValueError(
            f"a live camera must be a stereo camera, got the calibration of a depth camera in {path}; write a depth "
            "camera's frames into a folder depth/ of 16 bit PNG, and run that"
        )
    single = len(devices) == 1
    for device in devices:
        device.set(cv2.CAP_PROP_FRAME_WIDTH, calibration.camera.width * (2 if single else 1))
        device.set(cv2.CAP_PROP_FRAME_HEIGHT, calibration.camera.height)
        device.set(cv2.CAP_PROP_FPS, calibration.camera.frame_rate)
    sizes = [tuple(int(device.get(name)) for name in _SIZE) for device in devices]
    eyes = {(width // 2 if single else width, height) for width, height in sizes}
    # A camera that does not have the size gives another one; a DepthAI calibration follows it.
    calibration = read_calibration(path, eyes.pop(), promised_rate)
    camera = calibration.camera
    if eyes or sizes[0] != (camera.width * (2 if single else 1), camera.height):
        wanted = f"{camera.width} x {camera.height}" + (" twice, side by side" if single else "")
        got = " and ".join(f"{width} x {height}" for width, height in sizes)
        raise ValueError(
            f"the camera must give the calibration's size, {wanted}, got {got}; calibrate it at a size that it has"
        )
    return calibration


def camera_pairs(
    devices: Sequence[CaptureDevice], rate: float, clock: Callable[[], float]
) -> Iterator[tuple[int, float, Sequence[np.ndarray]]]:
    """Number, time since the first, s, and left and right image, as OpenCV orders them, of each pair."""
    begin = started = 0.0
    last, failures = -1, 0
    while failures < _FAILURES:
        grabbed = [device.grab() for device in devices]  # decoding takes longer, so it comes after
        if not all(grabbed):
            failures += 1
            continue
        stamp, now = devices[0].get(cv2.CAP_PROP_POS_MSEC) / 1000, clock()
        if last < 0:
            begin, started = stamp, now
        time_s = stamp - begin if stamp > begin else now - started
        number = round(rate * time_s)
        if number <= last:  # the camera is faster than its calibration says
            continue
        there, images = zip(*(device.retrieve() for device in devices), strict=True)
        if not all(there):
            failures += 1
            continue
        last, failures = number, 0
        yield number, time_s, np.split(images[0], 2, axis=1) if len(images) == 1 else images


def write_pair(folder: Path, number: int, pair: Sequence[np.ndarray]) -> None:
    """Write left and right image, as OpenCV orders them, into a recording's folder."""
    for side, image in zip(_SIDES, pair, strict=True):
        encode(_path(folder, side, number), image)


def read_pair(folder: Path, number: int) -> list[UInt8[np.ndarray, "height width 3"]]:
    """Left and right image, as OpenCV orders them; ValueError where one cannot be read."""
    return [decode(_path(folder, side, number), cv2.IMREAD_COLOR) for side in _SIDES]


def require_empty(folder: Path) -> None:
    """Raise ValueError where there is something in the folder of a new recording."""
    if folder.exists() and any(folder.iterdir()):
        raise ValueError(
            f"the folder of a new recording must be empty, got {folder} with an earlier one; recording={folder} runs "
            "that, and fresh=true or another output records anew"
        )


def _path(folder: Path, side: str, number: int) -> Path:
    return folder / side / f"{number:06d}{_SUFFIX}"
