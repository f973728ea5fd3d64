"""A run as `poses.rrd` for the Rerun viewer: pictures, depth, points by part, ellipsoids, skeletons, angles, statuses.

Rerun is an extra (`viz`) and is imported where it is used. Metres, left-camera frame; angles in degrees. Everything
is streamed to the file, so memory does not grow with the recording.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor

from torchpose.atomic import replacing
from torchpose.body.angle import ANATOMICAL_NAMES
from torchpose.body.model import BodyModel, PosedBody
from torchpose.export import EMPTY_STATUSES, JOINT_NAMES, PoseSequence
from torchpose.figures import (
    BONES,
    LEFT_COLOUR,
    MIDDLE_COLOUR,
    PART_COLOURS,
    RIGHT_COLOUR,
    STATUS_COLOURS,
    UNLABELLED,
    angle_panels,
    panel_title,
)
from torchpose.vision.camera import StereoCamera

_JPEG_QUALITY = 85
_DEPTH_UNIT = 1000.0  # of the depth images' levels in a metre
_RADIUS = 0.008  # m, of the points
_NONE = len(PART_COLOURS)  # the class of points that no part explains
_STRETCH = 1000  # rows of angles that are sent at once


def check_rerun() -> None:
    """ValueError where Rerun is not installed."""
    if find_spec("rerun") is None:
        raise ValueError(
            "viz=true must have the extra viz, and it is not installed; pip install 'torchpose[viz]', or leave viz out"
        )


def depth_png(depth: Float[Tensor, "height width"]) -> UInt8[np.ndarray, " bytes"]:
    """A depth image, m, as a PNG of 16 bits, mm; 0 where there is none or it is beyond 65 m."""
    levels = (depth.detach().cpu() * _DEPTH_UNIT).round().nan_to_num(0.0, 0.0, 0.0)
    levels = torch.where((levels > 0) & (levels <= 65535), levels, 0.0)
    return cv2.imencode(".png", levels.numpy().astype(np.uint16))[1]


class RerunLog:
    """Writes what happens in a run to a file, see `open_rerun_log`.

    Args:
        stream: Rerun's recording stream, already writing.
        body: whose poses are logged.
        camera: that took the pictures.
        sizes: (1, S) of each person.
    """

    def __init__(
        self, stream: Any, body: BodyModel, camera: StereoCamera, sizes: Sequence[Float[Tensor, "1 sizes"]]
    ) -> None:
        import rerun as rr

        self.rr, self.stream, self.body, self.sizes = rr, stream, body, sizes
        self._status: dict[int, str] = {}
        self._posed: dict[int, bool] = {}
        stream.log("/", rr.ViewCoordinates.RDF, static=True)
        names = [*body.segment_names, "no part"]
        classes = enumerate(zip(names, [*PART_COLOURS, UNLABELLED], strict=True))
        stream.log(
            "/", rr.AnnotationContext([(i, name, colour) for i, (name, colour) in classes]), static=True
        )
        pinhole = rr.Pinhole(
            focal_length=camera.focal_length,
            principal_point=[camera.cx, camera.cy],
            width=camera.width,
            height=camera.height,
            image_plane_distance=0.5,
        )
        stream.log("camera", pinhole, static=True)
        for person in range(len(sizes)):
            self._name_series(person)

    def add_angles(self, person: int, poses: PoseSequence) -> None:
        """A person's angles over time, each with its band of two standard deviations to each side, degrees."""
        for start in range(0, len(poses), _STRETCH):
            rows = slice(start, start + _STRETCH)
            posed = torch.tensor(poses.answered[rows])
            angle, sd = (values[rows].double().rad2deg().cpu() for values in (poses.angles, poses.angle_sd))
            band = torch.stack([angle, angle - 2 * sd, angle + 2 * sd], -1)
            shown = band.masked_fill(~posed[:, None, None], torch.nan).numpy()
            times = [
                self.rr.TimeColumn("frame", sequence=poses.frame[rows].tolist()),
                self.rr.TimeColumn("time", duration=poses.time_s[rows].double().numpy()),
            ]
            for column, name in enumerate(poses.angle_names):
                values = self.rr.Scalars.columns(scalars=shown[:, column].ravel()).partition([3] * len(shown))
                self.stream.send_columns(f"{_person(person)}/angles/{name}", times, values)

    def at(self, frame: int, time_s: float) -> None:
        """What is added from now on belongs to this frame."""
        self.stream.set_time("frame", sequence=frame)
        self.stream.set_time("time", duration=time_s)

    def add_image(self, image: Float[Tensor, "3 height width"]) -> None:
        """The frame's RGB picture in [0, 1]."""
        levels = image.detach().cpu().clamp(0, 1).mul(255).round().byte().permute(1, 2, 0).numpy()[..., ::-1]
        code = cv2.imencode(".jpg", levels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
        picture = self.rr.EncodedImage(contents=code.tobytes(), media_type="image/jpeg")
        self.stream.log("camera/image", picture)

    def add_depth(self, png: UInt8[np.ndarray, " bytes"]) -> None:
        """The frame's depth by `depth_png`; nothing of it where there is none."""
        if len(png):
            image = self.rr.EncodedDepthImage(blob=png.tobytes(), media_type="image/png", meter=_DEPTH_UNIT)
            self.stream.log("camera/depth", image)
        else:
            self.stream.log("camera/depth", self.rr.Clear(recursive=False))

    def add_person(
        self,
        person: int,
        status: str,
        pose: Float[Tensor, " parameters"],
        points: Float[Tensor, "num 3"],
        labels: Shaped[Tensor, " num"],
    ) -> None:
        """A person in the frame: status, body and points; without a pose where it is not finite."""
        rr, path, size = self.rr, _person(person), self.sizes[person]
        if self._status.get(person) != status:
            self.stream.log(f"{path}/status", rr.StateChange(state=status))
            self._status[person] = status
        posed = status not in EMPTY_STATUSES and bool(pose.isfinite().all())
        if not posed:
            if self._posed.get(person, True):
                for name in ("body", "skeleton", "joints", "points"):
                    self.stream.log(f"{path}/{name}", rr.Clear(recursive=False))
            self._posed[person] = False
            return
        self._posed[person] = True
        with torch.no_grad():
            body = self.body(pose[None].to(size), size)
        ellipsoids = rr.Ellipsoids3D(
            centers=body.centers[0].cpu().numpy(),
            half_sizes=body.radii[0].cpu().numpy(),
            quaternions=_quaternions(body)[0].cpu().numpy(),
            class_ids=list(range(self.body.num_parts)),
            fill_mode=rr.components.FillMode.Solid,
        )
        self.stream.log(f"{path}/body", ellipsoids)
        joints = body.joints[0].cpu().numpy()
        at = {name: joints[i] for i, name in enumerate(JOINT_NAMES)}
        bones = rr.LineStrips3D(
            [np.stack([at[start], at[end]]) for start, end in BONES],
            colors=[_side_colour(end) for _, end in BONES],
            radii=0.01,
        )
        self.stream.log(f"{path}/skeleton", bones)
        self.stream.log(f"{path}/joints", rr.Points3D(joints, radii=0.015))
        known: Bool[Tensor, " num"] = points.isfinite().all(1)
        part: Int[Tensor, " few"] = labels[known].long()
        part = torch.where((part >= 0) & (part < self.body.num_parts), part, _NONE)
        cloud = rr.Points3D(
            points[known].float().numpy(), class_ids=part.numpy().astype(np.uint16), radii=_RADIUS
        )
        self.stream.log(f"{path}/points", cloud)

    def _name_series(self, person: int) -> None:
        rr, path = self.rr, _person(person)
        for name in ANATOMICAL_NAMES:
            colour = _side_colour(name, (60, 60, 60))
            pale = tuple(round(0.5 * level + 127) for level in colour)
            lines = rr.SeriesLines(
                colors=[colour, pale, pale], widths=[2.0, 0.7, 0.7], names=[name, "- 2 sd", "+ 2 sd"]
            )
            self.stream.log(f"{path}/angles/{name}", lines, static=True)
        labels = rr.Points3D.from_fields(labels=list(JOINT_NAMES), show_labels=False)
        self.stream.log(f"{path}/joints", labels, static=True)
        states = rr.StateConfiguration(values=list(STATUS_COLOURS), colors=list(STATUS_COLOURS.values()))
        self.stream.log(f"{path}/status", states, static=True)


@contextmanager
def open_rerun_log(
    path: Path, body: BodyModel, camera: StereoCamera, sizes: Sequence[Float[Tensor, "1 sizes"]]
) -> Iterator[RerunLog]:
    """A log at `path`, which is there when the block ends without error; see `RerunLog`."""
    import rerun as rr

    with replacing(path) as partial:
        stream = rr.RecordingStream("torchpose")
        try:
            stream.save(partial, default_blueprint=_blueprint(len(sizes)))
            stream.set_log_time_enabled(False)  # the recording's own time alone
            yield RerunLog(stream, body, camera, sizes)
        finally:
            stream.flush()
            stream.disconnect()


def _blueprint(people: int) -> Any:
    """How the viewer lays things out: space and picture on the left, an angle a plot on the right, statuses below."""
    import rerun.blueprint as rrb

    plots = [
        rrb.TimeSeriesView(
            name=panel_title(panel),
            contents=[f"/{_person(person)}/angles/{ANATOMICAL_NAMES[column]}" for column in columns.values()],
        )
        for person in range(people)
        for panel, columns in angle_panels(ANATOMICAL_NAMES).items()
    ]
    count = len(plots) // max(people, 1)
    grids = [
        rrb.Grid(*plots[person * count : (person + 1) * count], name=_person(person), grid_columns=3)
        for person in range(people)
    ]
    statuses = rrb.StateTimelineView(name="status", contents=[f"/{_person(k)}/status" for k in range(people)])
    views = rrb.Vertical(
        rrb.Spatial3DView(name="space", origin="/", contents=["$origin/**", "- /camera/depth"]),
        rrb.Horizontal(
            rrb.Spatial2DView(
                name="picture",
                origin="/camera",
                contents=["$origin/**", "- /camera/depth", "/person_*/points"],
            ),
            rrb.Spatial2DView(name="depth", origin="/camera", contents=["/camera/depth"]),
        ),
        row_shares=[3, 2],
    )
    right = rrb.Vertical(rrb.Tabs(*grids), statuses, row_shares=[6, 1])
    return rrb.Blueprint(rrb.Horizontal(views, right, column_shares=[2, 3]), collapse_panels=True)


def _person(number: int) -> str:
    return f"person_{number + 1}"


def _side_colour(name: str, middle: tuple[int, int, int] = MIDDLE_COLOUR) -> tuple[int, int, int]:
    return LEFT_COLOUR if name.endswith("_left") else RIGHT_COLOUR if name.endswith("_right") else middle


def _quaternions(body: PosedBody) -> Float[Tensor, "batch parts 4"]:
    """The ellipsoids' frames as unit quaternions (x, y, z, w), by the eigenvector of Bar-Itzhack (2000).

    A frame that is left-handed is mirrored first, which leaves an ellipsoid what it is.
    """
    R = torch.cat(
        [body.frames[..., :2], body.frames[..., 0].cross(body.frames[..., 1], dim=-1)[..., None]], -1
    )
    trace = R.diagonal(dim1=-2, dim2=-1).sum(-1)
    K = torch.zeros(*R.shape[:-2], 4, 4, dtype=R.dtype, device=R.device)
    K[..., :3, :3] = R + R.mT - trace[..., None, None] * torch.eye(3, dtype=R.dtype, device=R.device)
    turn = torch.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1
    )
    K[..., :3, 3] = K[..., 3, :3] = turn
    K[..., 3, 3] = trace
    return torch.linalg.eigh(K).eigenvectors[..., -1]
