"""Results as files: tables of poses, a summary, a video. Each file is there whole or not at all.

Positions are in metres in the left camera's frame (x right, y down, z forward), angles in radians in tensors
and in degrees in the table. Left and right are the subject's.
"""

import csv
import dataclasses
import errno
import json
import math
import os
import shutil
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor
from torch.nn import functional as F

from torchpose.atomic import replacing

STATUSES = ("absent", "entering", "tracked", "partial", "recovered", "lost")
EMPTY_STATUSES = ("absent", "lost")  # frames without a pose: their cells are empty, whatever the tensors hold
JOINT_NAMES = (
    "pelvis",
    "neck",
    "head",
    *(f"{joint}_{side}" for joint in ("shoulder", "elbow", "wrist") for side in ("left", "right")),
    *(f"{joint}_{side}" for joint in ("hip", "knee", "ankle") for side in ("left", "right")),
)
_FIRST_COLUMNS = ("frame", "time_s", "status", "point_to_model_m")
_ROWS_AT_ONCE = 1024  # of a table, in memory as text or as copies
_LOOK = 50  # frames, after which it is seen whether the disk is full
_FULL_DISK = 2**20  # bytes; with fewer left a disk is taken to be full
_ROWS = 4096  # of a table, that are Python's numbers at once
_VIDEO_CODECS = ("mp4v", "avc1")  # OpenCV's own wheels have the first


@dataclass(frozen=True)
class PoseSequence:
    """The poses of one person over time, one row a frame; NaN where there is no number.

    Tensors of any float dtype on any device; they are written as float64. Frames whose status is in
    `EMPTY_STATUSES` have no pose, and what stands there is never written.
    """

    frame: Int[Tensor, " time"]  # the recording's frame numbers
    time_s: Float[Tensor, " time"]  # s
    status: tuple[str, ...]  # of each frame, one of `STATUSES`
    point_to_model: Float[Tensor, " time"]  # m, mean distance of the points to the body (5.2)
    joints: Float[Tensor, "time 15 3"]  # m, in the order of `JOINT_NAMES`
    angle_names: tuple[str, ...]  # of the anatomical angles
    angles: Float[Tensor, "time angles"]  # rad
    angle_sd: Float[Tensor, "time angles"]  # rad, standard deviations
    limb_angle_names: tuple[str, ...]
    limb_angles: Float[Tensor, "time limb_angles"]  # rad, 0 = the two limbs aligned
    pose: Float[Tensor, "time parameters"] | None = None  # m and rad, the body model's own
    pose_covariance: Float[Tensor, "time parameters parameters"] | None = None

    def __post_init__(self) -> None:
        unknown = sorted(set(self.status) - set(STATUSES))
        if unknown:
            raise ValueError(f"status must be one of {', '.join(STATUSES)}, got {unknown[0]!r}; choose one")
        for name, count in (
            ("status", len(self.frame)),
            ("angle_names", self.angles.shape[1]),
            ("limb_angle_names", self.limb_angles.shape[1]),
        ):
            if len(getattr(self, name)) != count:
                raise ValueError(
                    f"{name} must have an entry for each of {count}, got {len(getattr(self, name))}; "
                    "give as many names as there are columns, and as many statuses as there are frames"
                )

    def __len__(self) -> int:
        return len(self.status)

    def __getitem__(self, frames: slice | Int[Tensor, " few"], /) -> "PoseSequence":
        """Some of the frames, by a slice or by their positions."""
        status = (
            self.status[frames]
            if isinstance(frames, slice)
            else tuple(self.status[i] for i in frames.tolist())
        )
        cut: dict[str, Any] = {
            field.name: value[frames]
            for field in dataclasses.fields(self)
            if isinstance(value := getattr(self, field.name), Tensor)
        }
        return dataclasses.replace(self, status=status, **cut)

    @property
    def answered(self) -> tuple[bool, ...]:
        """Whether each frame has a pose."""
        posed = self.joints.isfinite().flatten(1).any(1).tolist()  # whoever is entering may have none yet
        return tuple(p and status not in EMPTY_STATUSES for p, status in zip(posed, self.status, strict=True))

    def of_nobody(self) -> "PoseSequence":
        """The same frames of somebody who is not there."""
        empty = dataclasses.replace(self, status=("absent",) * len(self))
        return empty.without_stale_numbers()

    def without_stale_numbers(self) -> "PoseSequence":
        """The sequence in float64 on the CPU, with NaN in every number of a frame that has no pose."""
        empty = ~torch.tensor(self.answered, dtype=torch.bool)
        cleaned: dict[str, Any] = {}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor) and value.is_floating_point():
                value = value.detach().to("cpu", torch.float64)
                if field.name != "time_s":
                    value = value.masked_fill(empty.view(-1, *[1] * (value.ndim - 1)), torch.nan)
            cleaned[field.name] = value
        return PoseSequence(**cleaned)


def pose_columns(angle_names: Sequence[str], limb_angle_names: Sequence[str]) -> list[str]:
    """The columns of `poses.csv`, in order."""
    return [
        *_FIRST_COLUMNS,
        *(f"{joint}_{axis}_m" for joint in JOINT_NAMES for axis in "xyz"),
        *(f"{name}_{kind}" for name in angle_names for kind in ("deg", "sd_deg")),
        *(f"{name}_deg" for name in limb_angle_names),
    ]


def write_poses_csv(path: Path, sequence: PoseSequence) -> None:
    """Write `poses.csv`: a row a frame, to micrometres and 1e-4 degrees; cells without a number are empty."""
    with replacing(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(pose_columns(sequence.angle_names, sequence.limb_angle_names))
        for start in range(0, len(sequence), _ROWS_AT_ONCE):
            writer.writerows(_table_rows(sequence[start : start + _ROWS_AT_ONCE].without_stale_numbers()))


def _table_rows(clean: PoseSequence) -> Iterator[list[str | int]]:
    """The rows of `poses.csv`."""
    degrees = torch.stack([clean.angles, clean.angle_sd], dim=-1).flatten(1)
    columns = {
        ".6f": torch.cat([clean.point_to_model[:, None], clean.joints.flatten(1)], dim=1),
        ".4f": torch.cat([degrees, clean.limb_angles], dim=1).rad2deg(),
    }
    for row, status in enumerate(clean.status):
        numbers = [
            format(number, spec) if math.isfinite(number) else ""
            for spec, values in columns.items()
            for number in values[row].tolist()
        ]
        yield [int(clean.frame[row]), format(clean.time_s[row].item(), ".6f"), status, *numbers]


def read_poses_csv(path: str | Path) -> PoseSequence:
    """The sequence in a `poses.csv`, in float64; without `pose`, which the table has not.

    Raises ValueError where the file is no such table.
    """
    path = Path(path)
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    names = header[len(_FIRST_COLUMNS) + 3 * len(JOINT_NAMES) :]
    angle_names = [name.removesuffix("_sd_deg") for name in names if name.endswith("_sd_deg")]
    limb_angle_names = [name.removesuffix("_deg") for name in names[2 * len(angle_names) :]]
    if header != pose_columns(angle_names, limb_angle_names) or any(len(row) != len(header) for row in rows):
        raise ValueError(
            f"{path} must have the columns of poses.csv, got {', '.join(header[:6])} ...; make it anew"
        )
    cells = [[float(cell) if cell else math.nan for cell in row[3:]] for row in rows]
    numbers = torch.tensor(cells, dtype=torch.float64).reshape(len(rows), len(header) - 3)
    distance, joints, angles, limb_angles = numbers.split(
        [1, 3 * len(JOINT_NAMES), 2 * len(angle_names), len(limb_angle_names)], dim=1
    )
    angle, sd = angles.deg2rad().unflatten(1, (len(angle_names), 2)).unbind(-1)
    return PoseSequence(
        frame=torch.tensor([int(row[0]) for row in rows], dtype=torch.int64),
        time_s=torch.tensor([float(row[1]) for row in rows], dtype=torch.float64),
        status=tuple(row[2] for row in rows),
        point_to_model=distance[:, 0],
        joints=joints.unflatten(1, (len(JOINT_NAMES), 3)),
        angle_names=tuple(angle_names),
        angles=angle,
        angle_sd=sd,
        limb_angle_names=tuple(limb_angle_names),
        limb_angles=limb_angles.deg2rad(),
    )


def write_poses_npz(
    path: Path,
    sequence: PoseSequence,
    covariances: Iterable[Float[Tensor, "some parameters parameters"]] | None = None,
) -> None:
    """Write everything in full precision: an array for each field of `PoseSequence`, and `joint_names`.

    `covariances` are those of all frames in pieces, for a sequence without: of a long one they need not be in memory
    together.
    """
    chunks = [slice(start, start + _ROWS_AT_ONCE) for start in range(0, len(sequence), _ROWS_AT_ONCE)]
    fields = {field.name: getattr(sequence, field.name) for field in dataclasses.fields(sequence)}
    numbers = {n for n, value in fields.items() if isinstance(value, Tensor) and value.is_floating_point()}
    others = {n: np.asarray(v) for n, v in fields.items() if v is not None and n not in numbers}
    with replacing(path) as partial:
        np.savez(partial, allow_pickle=False, joint_names=np.asarray(JOINT_NAMES), **others)
        for name in sorted(numbers):
            rows = (getattr(sequence[chunk].without_stale_numbers(), name) for chunk in chunks)
            _append_array(partial, name, fields[name].shape, rows)
        if covariances is not None and sequence.pose is not None:
            parameters = sequence.pose.shape[1]
            _append_array(partial, "pose_covariance", (len(sequence), parameters, parameters), covariances)


def _append_array(path: Path, name: str, shape: Sequence[int], pieces: Iterable[Tensor]) -> None:
    """Add to an `.npz` an array of float64 that comes in pieces along its first axis."""
    with zipfile.ZipFile(path, "a") as archive, archive.open(f"{name}.npy", "w", force_zip64=True) as file:
        header = {"descr": "<f8", "fortran_order": False, "shape": tuple(shape)}
        np.lib.format.write_array_header_1_0(file, header)
        for piece in pieces:
            file.write(np.ascontiguousarray(piece.detach().to("cpu", torch.float64), "<f8").tobytes())


def read_poses_npz(path: str | Path, covariance: bool = True) -> PoseSequence:
    """The sequence that `write_poses_npz` wrote; without `pose_covariance`, three quarters of it, where not wanted."""
    fields: dict[str, Any] = {}
    with np.load(path) as arrays:
        for name in set(arrays.files) - {"joint_names"} - (set() if covariance else {"pose_covariance"}):
            value = arrays[name]
            fields[name] = tuple(map(str, value)) if value.dtype.kind == "U" else torch.from_numpy(value)
    return PoseSequence(**fields)


def read_pose_sd(path: str | Path) -> Float[Tensor, "time parameters"] | None:
    """Standard deviations of the pose that `write_poses_npz` wrote, m and rad; None where it has no covariances.

    The covariances are read a piece at a time, and never are in memory together.
    """
    with zipfile.ZipFile(path) as archive:
        if "pose_covariance.npy" not in archive.namelist():
            return None
        with archive.open("pose_covariance.npy") as file:
            assert np.lib.format.read_magic(file) == (1, 0)
            (length, size, _), _, dtype = np.lib.format.read_array_header_1_0(file)
            found = torch.empty(length, size, dtype=torch.float64)
            for start in range(0, length, _ROWS_AT_ONCE):
                count = min(_ROWS_AT_ONCE, length - start)
                rows = np.frombuffer(file.read(count * size * size * dtype.itemsize), dtype)
                variance = torch.from_numpy(rows.reshape(count, size, size).copy()).diagonal(dim1=1, dim2=2)
                found[start : start + count] = variance.clamp(min=0).sqrt()
    return found


def write_table(
    path: str | Path, head: Sequence[str], row: str, table: Shaped[np.ndarray, "rows columns"]
) -> None:
    """Write lines of text: those of `head`, then `row` filled with each row of numbers, some thousand at a time.

    What is missing becomes NaN, as programs other than Python spell it.
    """
    with replacing(Path(path)) as partial, partial.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(line + "\n" for line in head)
        for start in range(0, len(table), _ROWS):
            few = table[start : start + _ROWS].tolist()
            file.writelines((row % tuple(values)).replace("nan", "NaN") + "\n" for values in few)


def write_summary(path: Path, summary: Mapping[str, object]) -> None:
    """Write a mapping as JSON with sorted keys; dataclasses, tensors and paths will do, NaN becomes null."""
    text = json.dumps(_jsonable(summary), indent=2, sort_keys=True, ensure_ascii=False, allow_nan=False)
    with replacing(path) as partial:
        partial.write_text(text + "\n", encoding="utf-8")


class VideoWriter:
    """Appends images to a video, see `open_video`."""

    def __init__(self, path: Path, width: int, height: int, frame_rate: float) -> None:
        self.path, self.width, self.height, self.frames = path, width, height, 0
        self._padding = (0, width % 2, 0, height % 2)  # codecs want even sizes
        size = (width + width % 2, height + height % 2)
        for codec in _VIDEO_CODECS:
            self._writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), frame_rate, size)
            if self._writer.isOpened():
                return
        raise _lost(path)

    def write(self, image: Float[Tensor, "3 height width"]) -> None:
        """Append an RGB image in [0, 1] of the video's size."""
        if image.shape[1:] != (self.height, self.width):
            raise ValueError(
                f"images must have the video's size {self.width} x {self.height}, got {image.shape[2]} x "
                f"{image.shape[1]}; open the video with the size of its images"
            )
        image = F.pad(image.detach().cpu()[None], self._padding, mode="replicate")[0]
        levels = image.clamp(0, 1).mul(255).round().byte()
        self._writer.write(np.ascontiguousarray(levels.permute(1, 2, 0).numpy()[..., ::-1]))
        self.frames += 1
        if self.frames % _LOOK == 0 and shutil.disk_usage(self.path.parent).free < _FULL_DISK:
            raise _lost(self.path)

    def close(self) -> None:
        """Finish the file."""
        self._writer.release()


@contextmanager
def open_video(path: Path, width: int, height: int, frame_rate: float) -> Iterator[VideoWriter]:
    """A writer for an MP4 file at `path`, which is there when the block ends without error.

    Raises UnwritableFile where the file does not hold all that was written, as on a full disk.
    """
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # one sentence is enough
    with replacing(path) as partial:
        try:
            video = VideoWriter(partial, width, height, frame_rate)
            try:
                yield video
            finally:
                video.close()
        finally:
            cv2.utils.logging.setLogLevel(level)
        if not _holds(partial, video.frames):  # OpenCV does not tell
            raise _lost(partial)


def _lost(path: Path) -> OSError:
    """Why a video could not be written."""
    if shutil.disk_usage(path.parent).free < _FULL_DISK:
        return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
    return OSError(errno.EIO, f"OpenCV wrote no whole video by {' or '.join(_VIDEO_CODECS)}", str(path))


def _holds(path: Path, frames: int) -> bool:
    """Whether a video has so many frames, and the last one can be read."""
    video = cv2.VideoCapture(str(path))
    if frames == 0 or int(video.get(cv2.CAP_PROP_FRAME_COUNT)) != frames:
        return frames == 0
    video.set(cv2.CAP_PROP_POS_FRAMES, frames - 1)
    return bool(video.read()[0])


def _jsonable(value: Any) -> Any:
    """`value` made of what JSON has: dictionaries, lists, strings, finite numbers, null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _jsonable(item) for key, item in value.items()}
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, Tensor | np.ndarray | np.generic):
        return _jsonable(value.tolist())
    if isinstance(value, list | tuple):
        return [_jsonable(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, str | bool | int | float):
        return value
    return str(value)
