"""Recordings: folders of stereo pairs or of depth frames, read lazily and checked before anything starts.

Images are RGB, float32 in [0, 1], (3, H, W); depth is in metres, (H, W), NaN where there is no reading. All
are on the CPU and rectified; depth belongs to the left camera, whose frame is x right, y down, z forward.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
import torch
import yaml
from jaxtyping import Float
from torch import Tensor

from torchpose.atomic import replacing
from torchpose.calibration import Calibration, read_calibration
from torchpose.vision.camera import StereoCamera

CALIBRATION = "calibration.yaml"
_WRITTEN_DEPTH_UNIT = 0.001  # m
_JPEG_QUALITY = 95
_FRAME_NAME = r"(\d+)\.(?:jpg|jpeg|png)"


@dataclass(frozen=True)
class Frame:
    """What the cameras saw at one moment; a field is None where the recording has no such camera."""

    index: int  # the number in the files' names; numbers may have gaps
    time_s: float  # s, index / frame rate
    left: Float[Tensor, "3 height width"] | None = None  # for a depth camera: its colour image
    right: Float[Tensor, "3 height width"] | None = None
    depth: Float[Tensor, "height width"] | None = None  # m, NaN where there is no reading


@dataclass(frozen=True)
class Backgrounds:
    """Frames of the empty scene; a field is None where there are none."""

    left: Float[Tensor, "num 3 height width"] | None = None
    right: Float[Tensor, "num 3 height width"] | None = None
    depth: Float[Tensor, "num height width"] | None = None  # m, NaN where there is no reading


class UnreadableFrame(ValueError):
    """One frame of a recording cannot be read; the others may well be. Says which frame, and when it was."""

    def __init__(self, message: str, index: int, time_s: float) -> None:
        super().__init__(message)
        self.index = index
        self.time_s = time_s


@runtime_checkable
class Recording(Protocol):
    """Anything that has frames by one camera, whether on disk or made up."""

    @property
    def camera(self) -> StereoCamera:
        """The camera that all frames belong to."""

    def __len__(self) -> int: ...

    def __getitem__(self, position: int, /) -> Frame:
        """The frame at `position`, 0 to len - 1. Raises UnreadableFrame, and IndexError after the last."""

    def background(self) -> Backgrounds:
        """The frames of the empty scene, if there are any."""


class FolderRecording:
    """A recording in a folder, see `open_recording`; nothing but the frame asked for is in memory."""

    def __init__(self, folder: Path, calibration: Calibration) -> None:
        self.folder = folder
        self.calibration = calibration
        if calibration.depth_unit is None:
            streams = ["left", "right"]
        else:
            streams = ["depth", "colour"] if (folder / "colour").is_dir() else ["depth"]
        self._files = _paired_files(folder, streams)
        self.indices = tuple(sorted(self._files[streams[0]]))  # frame numbers, ascending
        for stream in streams:
            self._check_size(stream)

    @property
    def camera(self) -> StereoCamera:
        return self.calibration.camera

    def __len__(self) -> int:
        return len(self.indices)

    def __iter__(self) -> Iterator[Frame]:
        return (self[position] for position in range(len(self)))

    def __getitem__(self, position: int, /) -> Frame:
        """The frame at `position`, 0 to len - 1 (or from the end, -1 to -len).

        Raises UnreadableFrame where an image is damaged or of another size than the calibration's.
        """
        index = self.indices[position]
        time_s = index / self.camera.frame_rate
        try:
            images = {stream: self._read(stream, files[index])[None] for stream, files in self._files.items()}
        except ValueError as error:
            raise UnreadableFrame(f"frame {index} cannot be read: {error}", index, time_s) from None
        if "depth" in images:
            colour = images.get("colour")
            return Frame(index, time_s, None if colour is None else colour[0], depth=images["depth"][0])
        left, right = self._rectify(images["left"], images["right"])
        return Frame(index, time_s, left[0], right[0])

    def background(self) -> Backgrounds:
        """The frames of the empty scene in `background/`; none where there is no such folder.

        Raises ValueError where one cannot be read, or where the left and the right ones do not pair up.
        """
        folder = self.folder / "background"
        if self.calibration.depth_unit is not None:
            files = _numbered_files(folder, "depth_")
            return Backgrounds(depth=self._stack("depth", files)) if files else Backgrounds()
        left, right = _numbered_files(folder, "left_"), _numbered_files(folder, "right_")
        if left.keys() != right.keys():
            raise ValueError(
                f"every left_K in {folder} must have its right_K, got left {sorted(left)} and right "
                f"{sorted(right)}; add the missing images or remove the single ones"
            )
        if not left:
            return Backgrounds()
        return Backgrounds(*self._rectify(self._stack("left", left), self._stack("right", right)))

    def _read(self, stream: str, path: Path) -> Float[Tensor, "*channels height width"]:
        unit = self.calibration.depth_unit
        image = _read_depth(path, unit) if unit and stream == "depth" else _read_colour(path)
        self._require_size(path, image.shape[-1], image.shape[-2])
        return image

    def _stack(self, stream: str, files: Mapping[int, Path]) -> Float[Tensor, "num *channels height width"]:
        return torch.stack([self._read(stream, files[index]) for index in sorted(files)])

    def _rectify(
        self, left: Float[Tensor, "num 3 height width"], right: Float[Tensor, "num 3 height width"]
    ) -> tuple[Float[Tensor, "num 3 height width"], Float[Tensor, "num 3 height width"]]:
        if self.calibration.raw is None:
            return left, right
        left, right, _ = self.calibration.raw.rectify(left, right)
        return left, right

    def _require_size(self, path: Path, width: int, height: int) -> None:
        if (width, height) != (self.camera.width, self.camera.height):
            raise ValueError(
                f"{path} must have the calibration's size {self.camera.width} x {self.camera.height}, got "
                f"{width} x {height}; calibrate this camera at this resolution or correct image_size"
            )

    def _check_size(self, stream: str) -> None:
        """Raise ValueError unless the stream's first image that can be read has the calibration's size."""
        damage = []
        for index in self.indices:
            path = self._files[stream][index]
            try:
                height, width = _decode(path).shape[:2]
            except ValueError as error:
                damage.append(str(error))
            else:
                return self._require_size(path, width, height)
        raise ValueError(f"{self.folder / stream} must have an image that can be read, got none: {damage[0]}")


def open_recording(path: str | Path) -> FolderRecording:
    """The recording in a folder.

    It has `calibration.yaml` (see `read_calibration`); `left/NNNNNN.{jpg,png}` and `right/NNNNNN.{jpg,png}`,
    or `depth/NNNNNN.png` (uint16, 0 where there is no reading) and, if there is any,
    `colour/NNNNNN.{jpg,png}` on the depth camera's pixels; and, if there are any, frames of the empty scene,
    `background/left_K.*` and `background/right_K.*`, or `background/depth_K.png`. NNNNNN is the frame's
    number, and the frame's time is this number over the frame rate.

    Raises ValueError where the folder, its calibration or its files are not so. Images after the first are
    looked at when they are read.
    """
    folder = Path(path)
    if not folder.exists():
        raise ValueError(f"the recording must be a folder, but {folder} does not exist; check the path")
    if not folder.is_dir():
        raise ValueError(
            f"the recording must be a folder with {CALIBRATION}, left/ and right/, got the file {folder}; "
            "give the folder, and write a video's frames into one first"
        )
    return FolderRecording(folder, read_calibration(folder / CALIBRATION))


def write_recording(
    folder: str | Path,
    camera: StereoCamera,
    frames: Iterable[Frame],
    backgrounds: Backgrounds | None = None,
    suffix: str = ".png",
) -> Path:
    """Write frames as a folder that `open_recording` reads, and return it; each file appears whole.

    Colour images become `suffix`, `.png` (exact to 1/510) or `.jpg`; depth, where the camera has no baseline,
    becomes uint16 in millimetres. The calibration is written last: a folder that has one is complete.
    """
    if suffix not in (".png", ".jpg"):
        raise ValueError(f"suffix must be .png or .jpg, got {suffix!r}; choose one of the two")
    folder = Path(folder)
    stereo = camera.baseline is not None
    names = {"left": "left", "right": "right"} if stereo else {"left": "colour", "depth": "depth"}
    required = ("left", "right") if stereo else ("depth",)
    count = 0
    for frame in frames:
        for field in required:
            if getattr(frame, field) is None:
                raise ValueError(
                    f"frame {frame.index} must have a {field} image for this camera, got None; "
                    "a camera with a baseline takes stereo pairs, one without takes depth"
                )
        for field, stream in names.items():
            _write_image(folder / stream / f"{frame.index:06d}", getattr(frame, field), suffix)
        count += 1
    if not count:
        raise ValueError("a recording must have at least one frame, got none; give some frames")
    for field in required if backgrounds else ():
        stack = getattr(backgrounds, field)
        for k, image in enumerate(stack if stack is not None else ()):
            _write_image(folder / "background" / f"{field}_{k}", image, suffix)
    calibration = {
        "image_size": [camera.width, camera.height],
        "focal_length": camera.focal_length,
        "principal_point": [camera.cx, camera.cy],
        **({"baseline": camera.baseline} if stereo else {"depth_unit": _WRITTEN_DEPTH_UNIT}),
        "frame_rate": camera.frame_rate,
        "rectified": True,
    }
    with replacing(folder / CALIBRATION) as partial:
        partial.write_text(yaml.safe_dump(calibration, sort_keys=False), encoding="utf-8")
    return folder


def _numbered_files(folder: Path, prefix: str = "") -> dict[int, Path]:
    """The images named `prefix` and a number in a folder, by number; {} where there is no such folder."""
    files: dict[int, Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        match = re.fullmatch(prefix + _FRAME_NAME, path.name, re.IGNORECASE)
        if match is None:
            continue
        number = int(match[1])
        if number in files:
            raise ValueError(
                f"every number must stand for one image, got {files[number].name} and {path.name} in "
                f"{folder}; remove one of them"
            )
        files[number] = path
    return files


def _paired_files(folder: Path, streams: list[str]) -> dict[str, dict[int, Path]]:
    """The images of each stream by frame number: the same numbers in each, and at least one."""
    found = {stream: _numbered_files(folder / stream) for stream in streams}
    for stream, files in found.items():
        if not (folder / stream).is_dir():
            raise ValueError(
                f"the recording must have a folder {stream}/, but {folder / stream} does not exist; add it "
                "or correct the calibration: a baseline goes with left/ and right/, a depth_unit with depth/"
            )
        if not files:
            raise ValueError(
                f"{folder / stream} must have images named by the frame's number, such as 000000.png, "
                "got none; name them so"
            )
    first, *others = streams
    for other in others:
        odd = sorted(found[first].keys() ^ found[other].keys())
        if odd:
            lone = first if odd[0] in found[first] else other
            raise ValueError(
                f"every image in {first}/ must have its partner in {other}/, got {len(found[first])} and "
                f"{len(found[other])} images in {folder}, and frame {odd[0]} only in {lone}/; "
                "add the missing images or remove the single ones"
            )
    return found


def _decode(path: Path, flags: int = cv2.IMREAD_UNCHANGED) -> np.ndarray:
    """The pixels of an image file, as OpenCV orders them; ValueError where the file is damaged or cut off."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path} must be readable, got {error.strerror}; replace the file") from None
    # The decoders fill up what is missing at the end of a file with grey, so look for the end itself.
    end, start = (b"IEND", 0) if data.startswith(b"\x89PNG") else (b"\xff\xd9", data.rfind(b"\xff\xda") + 1)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if end in data[start:] else None
    if image is None:
        raise ValueError(f"{path} must be a whole JPEG or PNG image, got {len(data)} bytes that are not")
    return image


def _read_colour(path: Path) -> Float[Tensor, "3 height width"]:
    # The calibration is of the sensor's rows and columns, whatever the file says of its orientation.
    pixels = _decode(path, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    return torch.from_numpy(pixels).permute(2, 0, 1).float().div(255)


def _read_depth(path: Path, unit: float) -> Float[Tensor, "height width"]:
    steps = _decode(path)
    if steps.dtype != np.uint16 or steps.ndim != 2:
        raise ValueError(
            f"{path} must be a depth image of one channel of uint16, got {steps.dtype} of shape "
            f"{steps.shape}; write it as a 16 bit grey PNG"
        )
    depth = torch.from_numpy(steps.astype(np.float32)) * unit
    return depth.masked_fill(depth == 0, torch.nan)


def _write_image(path: Path, image: Tensor | None, suffix: str) -> None:
    """Write colour (3, H, W) as `suffix` or depth (H, W) as PNG; nothing where there is no image."""
    if image is None:
        return
    image = image.detach().cpu()
    if image.ndim == 2:
        steps = (image / _WRITTEN_DEPTH_UNIT).round()
        # 0 is no reading; so is what does not fit into 16 bits.
        steps = steps.where((steps > 0) & (steps < 2**16), 0)
        suffix, pixels = ".png", steps.numpy().astype(np.uint16)
    else:
        levels = (image.clamp(0, 1) * 255).round().byte()
        pixels = np.ascontiguousarray(levels.permute(1, 2, 0).numpy()[..., ::-1])
    _, data = cv2.imencode(suffix, pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    with replacing(path.with_suffix(suffix)) as partial:
        partial.write_bytes(data.tobytes())
