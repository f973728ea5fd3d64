"""Recordings: folders of stereo pairs or of depth frames, and videos, read lazily and checked before anything starts.

Images are RGB, float32 in [0, 1], (3, H, W); depth is in metres, (H, W), NaN where there is no reading. All
are on the CPU and rectified; depth belongs to the left camera, whose frame is x right, y down, z forward.
"""

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.calibration import Calibration, read_calibration, write_calibration
from torchpose.image_file import (
    DEPTH_UNIT,
    decode,
    numbered_files,
    read_colour,
    read_depth,
    to_colour,
    write_image,
)
from torchpose.video import VideoFile
from torchpose.vision.background import far_readings
from torchpose.vision.camera import StereoCamera
from torchpose.vision.focal_length import focal_length_of_person

CALIBRATION = "calibration.yaml"
BACKGROUND = "background"
_RATE_TOLERANCE = 0.01  # relative; frame rates that differ by more are not the same
_PERSON_FRAMES = 15  # over the recording, in which a person is looked for whose height is known
_LATE_END = 1.0  # s, by which one of two videos may end later than the other


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

    def __init__(self, folder: Path, calibration: Calibration, background: Path | None = None) -> None:
        self.folder = folder
        self.calibration = calibration
        self.background_folder = background or folder / BACKGROUND
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
        left, right = rectify_pair(self.calibration, images["left"], images["right"])
        return Frame(index, time_s, left[0], right[0])

    def background(self) -> Backgrounds:
        """The frames of the empty scene; none where there is no folder of them.

        Raises ValueError where one cannot be read, or where the left and the right ones do not pair up.
        """
        return read_backgrounds(self.background_folder, self.calibration)

    def _read(self, stream: str, path: Path) -> Float[Tensor, "*channels height width"]:
        return _read_image(path, self.calibration, stream == "depth")

    def _check_size(self, stream: str) -> None:
        """Raise ValueError unless the stream's first image that can be read has the calibration's size."""
        damage = []
        for index in self.indices:
            path = self._files[stream][index]
            try:
                height, width = decode(path).shape[:2]
            except ValueError as error:
                damage.append(str(error))
            else:
                return _require_size(path, self.camera, width, height)
        raise ValueError(f"{self.folder / stream} must have an image that can be read, got none: {damage[0]}")


class VideoRecording:
    """A recording in one side-by-side stereo video or in two videos, see `open_recording`.

    Nothing but the frame asked for is in memory. Reading in order decodes each frame once.
    """

    def __init__(
        self, videos: Sequence[VideoFile], calibration: Calibration, background: Path | None = None
    ) -> None:
        self.calibration = calibration
        self._videos = tuple(videos)
        self._background = background
        self._length = min(map(len, videos))
        if calibration.depth_unit is not None:
            raise ValueError(
                f"a video must be of a stereo pair, got the calibration of a depth camera for {videos[0].path}; "
                "write a depth camera's frames into a folder depth/ of 16 bit PNG"
            )
        self._check_sizes()
        self._check_rates()

    @property
    def camera(self) -> StereoCamera:
        return self.calibration.camera

    def __len__(self) -> int:
        return self._length

    def __iter__(self) -> Iterator[Frame]:
        return (self[position] for position in range(len(self)))

    def __getitem__(self, position: int, /) -> Frame:
        """The frame at `position`, 0 to len - 1 (or from the end, -1 to -len).

        Raises UnreadableFrame where the video is damaged.
        """
        index = range(self._length)[position]
        time_s = index / self.camera.frame_rate
        try:
            pixels = [video.read(index) for video in self._videos]
        except ValueError as error:
            raise UnreadableFrame(f"frame {index} cannot be read: {error}", index, time_s) from None
        eyes = pixels if len(pixels) == 2 else np.split(pixels[0], 2, axis=1)
        left, right = (to_colour(eye)[None] for eye in eyes)
        left, right = rectify_pair(self.calibration, left, right)
        return Frame(index, time_s, left[0], right[0])

    def background(self) -> Backgrounds:
        """The frames of the empty scene; none where there is no folder of them."""
        return read_backgrounds(self._background, self.calibration) if self._background else Backgrounds()

    def _check_sizes(self) -> None:
        camera, single = self.camera, len(self._videos) == 1
        width = camera.width * (2 if single else 1)
        for video in self._videos:
            if (video.width, video.height) != (width, camera.height):
                meaning = "twice the calibration's width" if single else "the calibration's size"
                hint = "for two videos give right=FILE as well" if single else "correct image_size"
                raise ValueError(
                    f"{video.path} must have {meaning}, {width} x {camera.height}, got {video.width} x "
                    f"{video.height}; calibrate this camera at this resolution, or {hint}"
                )

    def _check_rates(self) -> None:
        """Raise ValueError for two videos that cannot be paired; warn where they, or the calibration, differ."""
        rates = [video.frame_rate for video in self._videos]
        lengths = [len(video) for video in self._videos]
        names = " and ".join(str(video.path) for video in self._videos)
        if not _same_rate(rates[0], rates[-1]):
            raise ValueError(
                f"the two videos must have one frame rate, got {rates[0]:.4g} and {rates[1]:.4g} Hz in {names}; "
                "record both at the same rate"
            )
        if max(lengths) - min(lengths) > _LATE_END * rates[0]:
            raise ValueError(
                f"the two videos must have the same frames, got {lengths[0]} and {lengths[1]} in {names}; "
                "cut both to the same moments"
            )
        if lengths[0] != lengths[-1]:
            warnings.warn(
                f"of {lengths[0]} and {lengths[1]} frames in {names} the last {max(lengths) - min(lengths)} have no "
                "partner and are left out; where they matter, cut both videos to the same moments",
                stacklevel=3,
            )
        if not _same_rate(rates[0], self.camera.frame_rate):
            warnings.warn(
                f"{self._videos[0].path} has {rates[0]:.4g} frames a second and the calibration says "
                f"{self.camera.frame_rate:.4g}: times are by the calibration; where the video is right, "
                "correct frame_rate there",
                stacklevel=3,
            )


def open_recording(
    path: str | Path,
    right: str | Path | None = None,
    calibration: str | Path | None = None,
    background: str | Path | None = None,
) -> FolderRecording | VideoRecording:
    """The recording in a folder, in a side-by-side stereo video, or in two videos.

    A folder has `calibration.yaml` (see `read_calibration`); `left/NNNNNN.{jpg,png}` and
    `right/NNNNNN.{jpg,png}`, or videos `left.*` and `right.*`, or `depth/NNNNNN.png` (uint16, 0 where there
    is no reading) and, if there is any, `colour/NNNNNN.{jpg,png}` on the depth camera's pixels; and, if there
    are any, frames of the empty scene, `background/left_K.*` and `background/right_K.*`, or
    `background/depth_K.png`. NNNNNN is the frame's number, in a video its place, and the frame's time is this
    number over the calibration's frame rate.

    Args:
        path: the folder, or a video: the left one, or one whose left half is the left camera's image.
        right: the right video, where `path` is the left one.
        calibration: file of the calibration, instead of the folder's own; a video must have one.
        background: folder with the frames of the empty scene, instead of the folder's own.

    Raises ValueError where these are not so. Images and frames after the first are looked at when they are
    read. Warns where the calibration's frame rate is not the video's.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(
            f"the recording must be a folder or a video, but {path} does not exist; check the path"
        )
    scene = None if background is None else Path(background)
    if scene is not None and not scene.is_dir():
        raise ValueError(
            f"the background must be a folder with left_K and right_K images, got {scene}; check it"
        )
    if not path.is_dir():
        if calibration is None:
            raise ValueError(
                f"a video must come with its calibration, got none for {path}; give calibration=FILE"
            )
        videos = [VideoFile(file) for file in (path, right) if file is not None]
        return _video_recording(videos, Path(calibration), scene)
    if right is not None:
        raise ValueError(
            f"right must be a video beside a left one, got {right} beside the folder {path}; leave it out"
        )
    file = path / CALIBRATION if calibration is None else Path(calibration)
    videos = [VideoFile(video) for side in ("left", "right") for video in _video_in(path, side)]
    if not videos:
        recording = FolderRecording(path, read_calibration(file), scene)
        height = recording.calibration.person_height
        return recording if height is None else _with_focal_length(recording, height)
    if len(videos) != 2:
        raise ValueError(
            f"there must be a left.* and a right.* video, got only {videos[0].path}; add the other one"
        )
    return _video_recording(videos, file, scene or path / BACKGROUND)


def _with_focal_length(recording: FolderRecording, height: float) -> FolderRecording:
    """The recording by a camera whose focal length is estimated from a person who is `height` m tall."""
    positions = spread_positions(len(recording), _PERSON_FRAMES)
    frames = [frame.depth for frame in readable_frames(recording, positions) if frame.depth is not None]
    empty, camera = recording.background().depth, recording.camera
    try:
        if not frames:
            raise ValueError("there must be a frame that can be read, got none; check the recording")
        depth = torch.stack(frames)
        focal_length = focal_length_of_person(
            depth, far_readings(depth) if empty is None else empty, height, camera.cy
        )
    except ValueError as error:
        raise ValueError(f"{recording.folder}: {error}") from None
    warnings.warn(
        f"the focal length was estimated as {focal_length:.0f} px from a person of {height:g} m; all lengths are as "
        "right as that; calibrate the camera to know them",
        stacklevel=3,
    )
    camera = replace(camera, focal_length=focal_length)
    known = replace(recording.calibration, camera=camera, person_height=None)
    return FolderRecording(recording.folder, known, recording.background_folder)


def _video_recording(
    videos: Sequence[VideoFile], calibration: Path, background: Path | None
) -> VideoRecording:
    size = (videos[0].width // (3 - len(videos)), videos[0].height)  # of one eye
    return VideoRecording(videos, read_calibration(calibration, size, videos[0].frame_rate), background)


def _video_in(folder: Path, side: str) -> list[Path]:
    """The video of one eye, in a list; empty where there is none, as there are images."""
    files = [path for path in sorted(folder.glob(f"{side}.*")) if path.is_file()]
    if files and (len(files) > 1 or (folder / side).is_dir()):
        names = " and ".join(path.name for path in [*files, folder / side][:2])
        raise ValueError(
            f"the {side} camera must have one video or one folder, got {names} in {folder}; remove one"
        )
    return files


def spread_positions(length: int, count: int) -> list[int]:
    """At most `count` positions from 0 to length - 1, evenly apart, ends included; 0 alone where one is wanted."""
    count = min(count, length)
    return [round(i * (length - 1) / max(count - 1, 1)) for i in range(count)]


def readable_frames(recording: Recording, positions: list[int]) -> Iterator[Frame]:
    """The frames at these positions that can be read."""
    for position in positions:
        try:
            yield recording[position]
        except UnreadableFrame:
            continue


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
            write_image(folder / stream / f"{frame.index:06d}", getattr(frame, field), suffix)
        count += 1
    if not count:
        raise ValueError("a recording must have at least one frame, got none; give some frames")
    for field in required if backgrounds else ():
        stack = getattr(backgrounds, field)
        for k, image in enumerate(stack if stack is not None else ()):
            write_image(folder / "background" / f"{field}_{k}", image, suffix)
    write_calibration(folder / CALIBRATION, Calibration(camera, depth_unit=None if stereo else DEPTH_UNIT))
    return folder


def _paired_files(folder: Path, streams: list[str]) -> dict[str, dict[int, Path]]:
    """The images of each stream by frame number: the same numbers in each, and at least one."""
    found = {stream: numbered_files(folder / stream) for stream in streams}
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


def rectify_pair(
    calibration: Calibration,
    left: Float[Tensor, "num 3 height width"],
    right: Float[Tensor, "num 3 height width"],
) -> tuple[Float[Tensor, "num 3 height width"], Float[Tensor, "num 3 height width"]]:
    """Left and right images as the calibration's rectified camera would see them; as they are where that took them."""
    if calibration.raw is None:
        return left, right
    left, right, _ = calibration.raw.rectify(left, right)
    return left, right


def read_backgrounds(folder: Path, calibration: Calibration) -> Backgrounds:
    """The frames of the empty scene in a folder; ValueError where one cannot be read or has no partner."""

    def stack(files: Mapping[int, Path], depth: bool = False) -> Float[Tensor, "num *channels height width"]:
        return torch.stack([_read_image(files[index], calibration, depth) for index in sorted(files)])

    if calibration.depth_unit is not None:
        files = numbered_files(folder, "depth_")
        return Backgrounds(depth=stack(files, depth=True)) if files else Backgrounds()
    left, right = numbered_files(folder, "left_"), numbered_files(folder, "right_")
    if left.keys() != right.keys():
        raise ValueError(
            f"every left_K in {folder} must have its right_K, got left {sorted(left)} and right "
            f"{sorted(right)}; add the missing images or remove the single ones"
        )
    if not left:
        return Backgrounds()
    return Backgrounds(*rectify_pair(calibration, stack(left), stack(right)))


def _read_image(
    path: Path, calibration: Calibration, depth: bool = False
) -> Float[Tensor, "*channels height width"]:
    """A colour image, or where `depth` depth in m; ValueError unless it has the calibration's size."""
    unit = calibration.depth_unit
    image = read_depth(path, unit) if unit and depth else read_colour(path)
    _require_size(path, calibration.camera, image.shape[-1], image.shape[-2])
    return image


def _require_size(path: Path, camera: StereoCamera, width: int, height: int) -> None:
    if (width, height) != (camera.width, camera.height):
        raise ValueError(
            f"{path} must have the calibration's size {camera.width} x {camera.height}, got "
            f"{width} x {height}; calibrate this camera at this resolution or correct image_size"
        )


def _same_rate(one: float, other: float) -> bool:
    return abs(one - other) <= _RATE_TOLERANCE * other
