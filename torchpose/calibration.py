"""Calibrations: what `calibration.yaml`, or a DepthAI `calib.json`, says of a recording's cameras, all of it checked.

Pixels, metres, hertz. A wrong file is a ValueError of one sentence: what must hold, what came, what to do.
"""

import difflib
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from torchpose.atomic import replacing
from torchpose.depthai import depthai_stereo
from torchpose.vision.camera import RAW_KEYS, RawStereo, StereoCamera

_KEYS = (
    "image_size",
    "focal_length",
    "principal_point",
    "baseline",
    "frame_rate",
    "rectified",
    "depth_unit",
    "person_height",
    *RAW_KEYS,
)
_LONGEST_BASELINE = 5.0  # m; a longer one was given in mm or cm
_SHORTEST_FOCAL_LENGTH = 0.1  # image widths, a view of 157 degrees; a shorter one was given in mm
_SHORTEST_PERSON, _TALLEST_PERSON = 0.5, 2.6  # m
_COARSEST_DEPTH_UNIT = 0.1  # m; a coarser one is the number of steps in a metre


@dataclass(frozen=True)
class Calibration:
    """The cameras of a recording."""

    camera: StereoCamera  # after rectification
    raw: RawStereo | None = None  # how to rectify; None: the images are rectified already
    depth_unit: float | None = None  # m per step of the depth images; None: a stereo pair
    # m, of the person, from whom the focal length is to be estimated: the camera's is but a place holder; None: known
    person_height: float | None = None


def read_calibration(
    path: str | Path, image_size: tuple[int, int] | None = None, frame_rate: float | None = None
) -> Calibration:
    """The calibration in a YAML file, also in one that OpenCV wrote, or in a DepthAI JSON file.

    Always `image_size` [width, height] px and `frame_rate` Hz. Rectified stereo: `focal_length` px,
    `principal_point` [cx, cy] px, `baseline` m, `rectified: true`. A depth camera: the same with `depth_unit`
    (m per step of its images) instead of `baseline`; with `person_height` (m) instead of `focal_length`, if that is not
    known, and the image's centre as `principal_point`, if none is given. Raw stereo: OpenCV's
    `K1, D1, K2, D2, R, T` (m) instead. Other keys are left alone. DepthAI: see `depthai_stereo`.

    Args:
        path: the file.
        image_size: width and height of an eye's images, px, to which a DepthAI calibration is scaled.
        frame_rate: Hz, of the recording; for a DepthAI calibration, which has none.

    Raises ValueError where the file is absent or no YAML, and where a value is missing or makes no sense.
    """
    path = Path(path)
    try:
        values = _load(path)
        if "cameraData" in values:
            return _depthai(values, image_size, frame_rate)
        return _raw(values) if any(key in values for key in RAW_KEYS) else _rectified(values)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def write_calibration(path: str | Path, calibration: Calibration) -> None:
    """Write a calibration as YAML that `read_calibration` reads to the same numbers; the file appears whole."""
    camera, raw = calibration.camera, calibration.raw
    values: dict[str, Any] = {"image_size": [camera.width, camera.height], "frame_rate": camera.frame_rate}
    if raw is not None:
        values = raw.values()
    elif calibration.person_height is not None:
        values |= {"depth_unit": calibration.depth_unit, "person_height": calibration.person_height}
        values |= {"principal_point": [camera.cx, camera.cy]}
    else:
        values |= {"focal_length": camera.focal_length, "principal_point": [camera.cx, camera.cy]}
        stereo = calibration.depth_unit is None
        values |= {"baseline": camera.baseline} if stereo else {"depth_unit": calibration.depth_unit}
        values |= {"rectified": True}
    with replacing(Path(path)) as partial:
        partial.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")


def _rectified(values: dict[str, Any]) -> Calibration:
    person_height = _person_height(values)
    if person_height is not None:
        values = {"rectified": True, **values}  # one camera has no other to agree with
    if _require(values, "rectified", "true: a point lies on the same row of both images") is not True:
        raise ValueError(
            f"rectified must be true, got {values['rectified']!r}; "
            f"for raw images give {', '.join(RAW_KEYS)} instead of focal_length, principal_point and baseline"
        )
    if "baseline" in values and "depth_unit" in values:
        raise ValueError(
            "there must be a baseline (stereo pair) or a depth_unit (depth camera), got both; remove one"
        )
    width, height = _image_size(values)
    if person_height is not None:
        values = {"focal_length": width, "principal_point": [(width - 1) / 2, (height - 1) / 2], **values}
    focal_length = _positive(values, "focal_length", "px")
    if focal_length < _SHORTEST_FOCAL_LENGTH * width:
        raise ValueError(
            f"focal_length must be in px, at least {_SHORTEST_FOCAL_LENGTH * width:g} at width {width}, "
            f"got {focal_length:g}; divide a focal length in mm by the size of a pixel in mm"
        )
    cx, cy = _numbers(values, "principal_point", 2, "[cx, cy] in px")
    frame_rate = _positive(values, "frame_rate", "Hz")
    baseline = depth_unit = None
    if "depth_unit" in values:
        depth_unit = _positive(values, "depth_unit", "m per step")
        if depth_unit > _COARSEST_DEPTH_UNIT:
            raise ValueError(
                f"depth_unit must be the metres in one step of the depth images, at most "
                f"{_COARSEST_DEPTH_UNIT:g}, got {depth_unit:g}; 0.001 is a millimetre"
            )
    else:
        baseline = _positive(values, "baseline", "m", "for a depth camera give depth_unit instead")
        _check_length("baseline", baseline)
    return Calibration(
        StereoCamera(width, height, focal_length, cx, cy, baseline, frame_rate),
        depth_unit=depth_unit,
        person_height=person_height,
    )


def _person_height(values: dict[str, Any]) -> float | None:
    """Of the person who stands in for a focal length, m; None where none is given."""
    if "person_height" not in values:
        return None
    if "depth_unit" not in values:
        raise ValueError(
            "person_height must come with a depth_unit (a depth camera), got none; remove it, or add depth_unit"
        )
    if "focal_length" in values:
        raise ValueError(
            "there must be a focal_length or a person_height to estimate it from, got both; remove one"
        )
    height = _positive(values, "person_height", "m")
    if not _SHORTEST_PERSON <= height <= _TALLEST_PERSON:
        raise ValueError(
            f"person_height must be in m, {_SHORTEST_PERSON:g} to {_TALLEST_PERSON:g}, got {height:g}; "
            "divide centimetres by 100"
        )
    return height


def _raw(values: dict[str, Any]) -> Calibration:
    for key in RAW_KEYS:
        _require(values, key, f"raw cameras need all of {', '.join(RAW_KEYS)}")
    if values.get("rectified", False) is not False:
        raise ValueError(
            f"rectified must be false, or absent, beside raw cameras ({RAW_KEYS[0]} and so on), "
            f"got {values['rectified']!r}; remove one of the two"
        )
    if "depth_unit" in values:
        raise ValueError("raw cameras are a stereo pair, got a depth_unit beside them; remove one of the two")
    raw = RawStereo(
        **{key: _array(key, values[key]) for key in RAW_KEYS},
        image_size=_image_size(values),
        frame_rate=_positive(values, "frame_rate", "Hz"),
    )
    _check_length("T", float((raw.T**2).sum() ** 0.5))
    return Calibration(raw.camera, raw)


def _depthai(
    values: dict[str, Any], image_size: tuple[int, int] | None, frame_rate: float | None
) -> Calibration:
    if frame_rate is None or "frame_rate" in values:
        frame_rate = _positive(values, "frame_rate", "Hz", "DepthAI knows none: add a line to the file")
    raw = depthai_stereo(values, frame_rate, image_size)
    _check_length("the translation", float((raw.T**2).sum() ** 0.5))
    return Calibration(raw.camera, raw)


def _array(key: str, value: object) -> np.ndarray:
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{key} must be a list of numbers, got {value!r}; check the calibration") from None


def _check_length(key: str, length: float) -> None:
    if length > _LONGEST_BASELINE:
        raise ValueError(
            f"{key} must be in m, no longer than {_LONGEST_BASELINE:g}, got {length:g}; "
            "divide millimetres by 1000"
        )


def _image_size(values: dict[str, Any]) -> tuple[int, int]:
    numbers = _numbers(values, "image_size", 2, "[width, height] in whole px")
    if any(number < 1 or number != int(number) for number in numbers):
        raise ValueError(
            f"image_size must be [width, height] in whole px, got {values['image_size']!r}; "
            "use the size of the images in this recording"
        )
    return int(numbers[0]), int(numbers[1])


def _positive(values: dict[str, Any], key: str, unit: str, hint: str = "check the calibration") -> float:
    number = _number(_require(values, key, f"a positive number of {unit}; {hint}"))
    if number is None or number <= 0:
        raise ValueError(f"{key} must be a positive number of {unit}, got {values[key]!r}; {hint}")
    return number


def _numbers(values: dict[str, Any], key: str, count: int, meaning: str) -> list[float]:
    value = _require(values, key, meaning)
    items = value if isinstance(value, list) else []
    numbers = [number for number in map(_number, items) if number is not None]
    if len(items) != count or len(numbers) != count:
        raise ValueError(f"{key} must be {meaning}, got {value!r}; check the calibration")
    return numbers


def _number(value: object) -> float | None:
    """A finite number, or None. YAML 1.1 reads `1e-3` as a string, so strings are given a try."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        number = float(value)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _require(values: dict[str, Any], key: str, meaning: str) -> Any:
    if values.get(key) is not None:
        return values[key]
    # A key that is spelt right belongs to another value.
    near = difflib.get_close_matches(key, [name for name in values if name not in _KEYS], 1)
    hint = f"did you mean {near[0]!r} to be it?" if near else "add it"
    raise ValueError(f"{key} is missing ({meaning}); {hint}")


class _Loader(yaml.SafeLoader):
    """Plain YAML, and OpenCV's matrices as nested lists."""


def _matrix(loader: yaml.SafeLoader, node: yaml.Node) -> list[list[float]]:
    assert isinstance(node, yaml.MappingNode)
    matrix = loader.construct_mapping(node, deep=True)
    try:
        rows, columns, data = int(matrix["rows"]), int(matrix["cols"]), list(matrix["data"])
    except (KeyError, TypeError, ValueError):
        raise ValueError("an !!opencv-matrix must have rows, cols and data; write it by OpenCV") from None
    if len(data) != rows * columns:
        raise ValueError(
            f"an !!opencv-matrix of {rows} x {columns} must have {rows * columns} numbers, got {len(data)}; "
            "write it by OpenCV"
        )
    return [data[row * columns : (row + 1) * columns] for row in range(rows)]


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def _load(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise ValueError(
            "a recording must have this file, and it does not exist; "
            "write image_size, focal_length, principal_point, baseline, frame_rate and rectified: true there"
        )
    try:
        text = path.read_text(encoding="utf-8")
        if path.suffix == ".json":
            values = json.loads(text)
        else:  # OpenCV's first line, `%YAML:1.0`, is no YAML.
            values = yaml.load(text.partition("\n")[2] if text.startswith("%YAML:") else text, _Loader)
    except (UnicodeDecodeError, json.JSONDecodeError, yaml.YAMLError) as error:
        kind, reason = "JSON" if path.suffix == ".json" else "YAML", " ".join(str(error).split())
        raise ValueError(f"the calibration must be {kind}, but {reason}; correct the file") from None
    if not isinstance(values, dict):
        raise ValueError(
            f"the calibration must be lines of `key: value`, got {type(values).__name__}; correct the file"
        )
    return values
