"""A run as one page, `report.html`: pictures, a 3-D view, angles over time and what went wrong; opens offline.

The page's own files are in `torchpose/page`; the numbers go into it as base64 of little-endian typed arrays. A long
run is thinned evenly until the page is bounded, and the page says so. Metres, left-camera frame; angles in degrees.
"""

import base64
import html
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from torchpose.activity.diary import OTHER, PAUSE, UNSEEN, Entry
from torchpose.atomic import replacing
from torchpose.body.angle import ANATOMICAL_NAMES
from torchpose.body.model import BodyModel, PosedBody
from torchpose.export import EMPTY_STATUSES, JOINT_NAMES, STATUSES, PoseSequence
from torchpose.figures import (
    BONES,
    LEAST_SPAN,
    PART_COLOURS,
    STATUS_COLOURS,
    UNLABELLED,
    WORST_SD,
    angle_panels,
    panel_title,
)

# What bounds the page: 12 MB of pictures, 5 MB of poses and 2 MB of points, as base64.
ALL_IMAGES = 120  # a run of so many frames or fewer shows them all
MOST_IMAGES = 200  # of a longer run
IMAGE_BYTES = 9_000_000  # of all pictures together, before base64
MOST_SAMPLES = 8000  # frames with a pose, of all people together
MOST_POINTS = 800  # of a frame, of all people together
FEET, FEET_SD = 30, 0.03  # places of feet that count as independent, and m by which they are off the floor
SLOPE_SD = 0.2  # of the floor in the camera's frame, before feet have moved
_WIDTH, _WIDTH_OF_MANY = 640, 480  # px of the pictures
_QUALITIES = (85, 75, 60, 45, 30)  # of JPEG, until a picture is small enough
_MISSING = np.iinfo(np.int16).min  # in place of a number that is not there
_CHUNK = 512  # poses at once
_PAGE = resources.files("torchpose") / "page"
_SCRIPTS = ("run.js", "scene.js", "plot.js", "page.js")
_ACTIVITIES = '<script type="application/json" id="activities">'
_MOST_SENTENCES = 200  # problems on the page; summary.json has all


class Report:
    """Gathers what a page shows while a run's results are gone through, in any order, and writes it.

    What it holds is bounded, however long the run.

    Args:
        title: of the page.
        body: whose poses these are.
        sizes: (1, S) of each person.
        count: frames of the run.
    """

    def __init__(self, title: str, body: BodyModel, sizes: Sequence[Float[Tensor, "1 sizes"]], count: int):
        self.title, self.body, self.sizes, self.count = title, body, sizes, count
        people = max(len(sizes), 1)
        self.samples = _spread(count, MOST_SAMPLES // people)
        few = len(self.samples) if count <= ALL_IMAGES else min(MOST_IMAGES, len(self.samples))
        self.shown = self.samples[_spread(len(self.samples), few)]  # positions with a picture and points
        self._points_each = max(MOST_POINTS // people, 1)
        self._images: dict[int, bytes] = {}
        self._points: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
        self._people = [_Series(len(self.samples), body, size) for size in sizes]
        self._frame = np.zeros(len(self.samples), np.int32)
        self._time = np.zeros(len(self.samples), np.float64)
        self._shown = set(self.shown.tolist())

    def add_poses(self, person: int, start: int, poses: PoseSequence) -> None:
        """A stretch of a person's poses, of which the first is at position `start` of the run."""
        at = slice(*np.searchsorted(self.samples, [start, start + len(poses)]))
        rows = torch.from_numpy(self.samples[at] - start)
        if not len(rows):
            return
        few = replace(poses, pose_covariance=None)[rows].without_stale_numbers()
        self._frame[at], self._time[at] = few.frame.numpy(), few.time_s.numpy()
        self._people[person].fill(at, few, self.body, self.sizes[person])

    def wants(self, position: int) -> bool:
        """Whether a frame's picture and points are shown."""
        return position in self._shown

    def add_image(self, position: int, image: Float[Tensor, "3 height width"]) -> None:
        """A frame's RGB picture in [0, 1]; one that is not shown is passed over."""
        if self.wants(position):
            many = self.count > ALL_IMAGES
            width, room = (_WIDTH_OF_MANY if many else _WIDTH), IMAGE_BYTES // len(self.shown)
            self._images[position] = _jpeg(image, width, room)

    def add_points(
        self, person: int, position: int, points: Float[Tensor, "num 3"], labels: Shaped[Tensor, " num"]
    ) -> None:
        """A frame's points, m, with the parts they are labelled as; what is NaN, or too many, is left out."""
        if not self.wants(position):
            return
        known = points.isfinite().all(1).nonzero()[:, 0]
        known = known[torch.from_numpy(_spread(len(known), self._points_each))]
        parts = labels[known]
        parts = torch.where((parts >= 0) & (parts < self.body.num_parts), parts, -1)
        self._points[person, position] = (_millimetres(points[known]), parts.to(torch.int8).numpy())

    def write(self, path: Path, summary: Mapping[str, Any]) -> None:
        """Write the page. Of `summary` (see `Session.run`) it shows counts, sizes, settings, warnings, problems."""
        names = {"title": html.escape(self.title), "style": _text("page.css")}
        names |= {"script": "\n".join(_text(name) for name in _SCRIPTS), "data": _json(self._data(summary))}
        page = re.sub(r"\{\{(\w+)\}\}", lambda found: names[found[1]], _text("page.html"))
        with replacing(path) as partial:
            partial.write_text(page, encoding="utf-8")

    def _data(self, summary: Mapping[str, Any]) -> dict[str, Any]:
        images = [int(position) for position in self.shown if int(position) in self._images]
        at = np.searchsorted(self.samples, images)
        panels = [
            {"title": panel_title(name), "lines": [[side, column] for side, column in columns.items()]}
            for name, columns in angle_panels(ANATOMICAL_NAMES).items()
        ]
        return {
            "title": self.title,
            "count": self.count,
            "position": _packed(self.samples.astype(np.int32)),
            "frame": _packed(self._frame),
            "time": _packed(self._time),
            "shown": _packed(at.astype(np.int32)),
            "images": [base64.b64encode(self._images[position]).decode() for position in images],
            "people": [
                one.packed() | self._packed_points(person, images) for person, one in enumerate(self._people)
            ],
            "floor": _plane(summary.get("floor")) or _floor(self._people),
            "floor_seen": bool(summary.get("floor")),
            "missing": int(_MISSING),
            "panels": panels,
            "worst_sd": math.degrees(WORST_SD),
            "least_span": LEAST_SPAN,
            "joint_names": JOINT_NAMES,
            "bones": [[JOINT_NAMES.index(start), JOINT_NAMES.index(end)] for start, end in BONES],
            "parts": self.body.segment_names,
            "part_colours": [*PART_COLOURS, UNLABELLED],
            "statuses": [[name, STATUS_COLOURS[name], name not in EMPTY_STATUSES] for name in STATUSES],
            "quiet": [PAUSE, OTHER, UNSEEN],
            "thinned": self._thinned(images),
            "summary": _without_flood(summary),
        }

    def _packed_points(self, person: int, images: list[int]) -> dict[str, Any]:
        nothing = (np.zeros((0, 3), np.int16), np.zeros(0, np.int8))
        clouds = [self._points.get((person, position), nothing) for position in images]
        starts = np.cumsum([0, *(len(points) for points, _ in clouds)])
        points, labels = (np.concatenate([nothing[k], *(cloud[k] for cloud in clouds)]) for k in (0, 1))
        return {
            "points": _packed(points),
            "labels": _packed(labels),
            "starts": _packed(starts.astype(np.int32)),
        }

    def _thinned(self, images: list[int]) -> list[str]:
        """What of the run is not on the page, as sentences."""
        sentences = []
        if len(self.samples) < self.count:
            sentences.append(
                f"Angles, statuses and 3-D poses of {len(self.samples):,} of {self.count:,} frames, evenly spread, are "
                "on this page; poses.csv has all."
            )
        if len(images) < self.count:
            sentences.append(
                f"Pictures and points of {len(images):,} of {self.count:,} frames are on this page; overlay.mp4 shows "
                "all."
            )
        return sentences


class _Series:
    """One person's numbers at the samples, as the page has them."""

    def __init__(self, count: int, body: BodyModel, size: Float[Tensor, "1 sizes"]) -> None:
        parts = body.num_parts
        self.status = np.zeros(count, np.uint8)
        self.distance = np.full(count, np.nan, np.float32)  # m, of the points to the model
        self.angles = np.full((count, len(ANATOMICAL_NAMES)), _MISSING, np.int16)  # 0.01 degrees
        self.sd = np.full((count, len(ANATOMICAL_NAMES)), _MISSING, np.int16)
        self.joints = np.full((count, len(JOINT_NAMES), 3), _MISSING, np.int16)  # mm
        self.centres = np.full((count, parts, 3), _MISSING, np.int16)  # mm, of the ellipsoids
        self.axes = np.zeros((count, parts, 2, 3), np.int16)  # their first two axes, 1 = 32767
        self.radii = body(size.new_zeros(1, body.num_parameters), size).radii[0].tolist()  # m
        self.lowest: list[list[float]] = []  # m, of the ellipsoids in each frame

    def fill(self, at: slice, poses: PoseSequence, body: BodyModel, size: Float[Tensor, "1 sizes"]) -> None:
        self.status[at] = [STATUSES.index(status) for status in poses.status]
        self.distance[at] = poses.point_to_model.numpy()
        self.angles[at] = _hundredths(poses.angles)
        self.sd[at] = _hundredths(poses.angle_sd)
        self.joints[at] = _millimetres(poses.joints)
        if poses.pose is None:
            return
        known = poses.pose.isfinite().all(1).nonzero()[:, 0]
        for rows in known.split(_CHUNK):
            posed = body(poses.pose[rows].to(size), size)
            places = at.start + rows.numpy()
            self.centres[places] = _millimetres(posed.centers)
            self.axes[places] = (posed.frames[..., :2].mT * 32767).round().cpu().numpy().astype(np.int16)
            self.lowest += _lowest(posed).tolist()

    def packed(self) -> dict[str, Any]:
        names = ("status", "distance", "angles", "sd", "joints", "centres", "axes")
        return {name: _packed(getattr(self, name)) for name in names} | {"radii": self.radii}


def add_activities(path: Path, people: Iterable[Sequence[Entry]]) -> None:
    """Put the activities of each person of a page onto its time line, in place of earlier ones.

    ValueError where the file is no such page.
    """
    page = path.read_text(encoding="utf-8")
    before, mark, rest = page.partition(_ACTIVITIES)
    _, end, after = rest.partition("</script>")
    if not mark or not end:
        raise ValueError(
            f"{path} must be a page that torchpose wrote, got something else; run infer.py again"
        )
    with replacing(path) as partial:
        text = _json([[asdict(entry) for entry in entries] for entries in people])
        partial.write_text(before + mark + text + end + after, encoding="utf-8")


def _spread(count: int, most: int) -> Int[np.ndarray, " few"]:
    """Up to `most` of the positions 0 to count - 1, evenly spread from the first to the last."""
    return (
        np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))
        if count
        else np.arange(0)
    )


def _jpeg(image: Float[Tensor, "3 height width"], width: int, room: int) -> bytes:
    """A picture of at most `width` px and `room` bytes."""
    levels = image.detach().cpu().clamp(0, 1).mul(255).round().byte().permute(1, 2, 0).numpy()[..., ::-1]
    scale = min(1.0, width / levels.shape[1])
    while True:
        size = [max(round(scale * length), 1) for length in (levels.shape[1], levels.shape[0])]
        small = levels if scale == 1 else cv2.resize(levels, size, interpolation=cv2.INTER_AREA)
        for quality in _QUALITIES:
            done, code = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality])
            if done and (len(code) <= room or max(size) <= 16):
                return code.tobytes()
        scale *= 0.7


def _lowest(posed: PosedBody) -> Float[Tensor, "batch 3"]:
    """The middle of the ellipsoid that reaches lowest (y points down), with the y that it reaches, m."""
    reach = posed.centers[..., 1] + (posed.frames[..., 1, :] * posed.radii).square().sum(-1).sqrt()
    y, part = reach.max(-1)
    x, _, z = posed.centers[torch.arange(len(part)), part].unbind(-1)
    return torch.stack([x, y, z], -1)


def _plane(floor: Mapping[str, Any] | None) -> list[float] | None:
    """A summary's floor as `_floor` gives one."""
    if floor is None:
        return None
    x, y, z = floor["normal"]
    return [-floor["height_m"] / y, -x / y, -z / y]


def _floor(people: Sequence[_Series]) -> list[float] | None:
    """Where a floor that was not seen should be drawn, [a, b, c] of y = a + b x + c z in m; None without a pose.

    The plane under the feet. How it slopes, because the camera looks down, shows only where feet have moved.
    """
    lowest = np.array([place for one in people for place in one.lowest])
    if not len(lowest):
        return None
    x, y, z = lowest.T
    middle = np.array([x.mean(), z.mean()])
    across = np.column_stack([np.ones_like(x), x - middle[0], z - middle[1]])
    plane, used = np.zeros(3), np.ones(len(x), bool)
    for _ in range(3):  # lifted feet are above the plane: the lower half of what is left tells it
        rows = across[used] * (FEET / used.sum()) ** 0.5 / FEET_SD
        prior = np.diag([0.0, 1 / SLOPE_SD, 1 / SLOPE_SD])
        sides = np.concatenate([y[used] * (FEET / used.sum()) ** 0.5 / FEET_SD, np.zeros(3)])
        plane = np.linalg.lstsq(np.concatenate([rows, prior]), sides, rcond=None)[0]
        used = y - across @ plane >= np.median(y - across @ plane)
    a, b, c = plane
    return [float(a - b * middle[0] - c * middle[1]), float(b), float(c)]


def _hundredths(angles: Float[Tensor, "*shape"]) -> Int[np.ndarray, "*shape"]:
    return _whole(angles.rad2deg() * 100)


def _millimetres(metres: Float[Tensor, "*shape"]) -> Int[np.ndarray, "*shape"]:
    return _whole(metres * 1000)


def _whole(values: Float[Tensor, "*shape"]) -> Int[np.ndarray, "*shape"]:
    """Rounded to 16 bits, `_MISSING` in place of what is no number or too large for them."""
    rounded = values.detach().cpu().double().round()
    fits = rounded.abs() <= np.iinfo(np.int16).max
    return torch.where(fits, rounded, float(_MISSING)).to(torch.int16).numpy()


def _packed(values: np.ndarray) -> str:
    return base64.b64encode(values.astype(values.dtype.newbyteorder("<")).tobytes()).decode()


def _without_flood(summary: Mapping[str, Any]) -> dict[str, Any]:
    """The summary with so many problems as people read."""
    problems = list(summary.get("problems", ()))
    if len(problems) > _MOST_SENTENCES:
        more = f"and {len(problems) - _MOST_SENTENCES:,} more, see summary.json"
        problems = [*problems[:_MOST_SENTENCES], more]
    return {**summary, "problems": problems}


def _json(value: Any) -> str:
    """JSON that may stand in a script element: nothing in it ends the element, NaN is null."""
    text = json.dumps(_finite(value), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _text(name: str) -> str:
    return (_PAGE / name).read_text(encoding="utf-8")
