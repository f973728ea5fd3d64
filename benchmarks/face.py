"""Whether a face is visible, by the truth of a recording, and whether what was found is that face.

A face is *visible* where it is turned away from the camera by at most 60 degrees (the way from the head joint to the
middle of the eyes against the way to the camera, both in the horizontal plane) and both eyes are seen: each projects
onto a pixel that is labelled head, and no hand or arm is before it (the true depth there is at most 4 cm less than
the eye's). Its centre lies 3 cm below the middle of the eyes, towards the chin; its width is 0.15 m. A face that is
found is *right* if its box's centre is within half a width of that centre, and *false* if it is not, or if the face
is turned away by more than 90 degrees. A face that is found rightly where it is not visible counts as neither.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.people import Truth
from torchpose.vision.camera import StereoCamera
from torchpose.vision.faces import Faces, read_cascade

WIDTH = 0.15  # m, of a face
BELOW_EYES = 0.03  # m, of its centre
MOST_VISIBLE, AWAY = 60.0, 90.0  # degrees aside
BEFORE_EYE = 0.04  # m; the truth's eyes are the eyeballs' centres
ANGLES = (0, 30, 60, 90, 180)  # degrees, edges of the report's rows


@dataclass(frozen=True)
class TrueFace:
    """Where the face is."""

    center: Float[Tensor, "2"]  # px, left image
    width: float  # px
    angle: float  # degrees aside from the camera, 0 to 180
    visible: bool

    def holds(self, box: Float[Tensor, "4"]) -> bool:
        """Whether a box (x0, y0, x1, y1) is this face."""
        away = 0.5 * (box[:2] + box[2:]) - self.center
        return self.angle <= AWAY and bool(away.norm() <= 0.5 * self.width)


@dataclass(frozen=True)
class FaceScore:
    """One frame's verdict."""

    angle: float  # degrees
    visible: bool
    right: bool  # a face was found and is the face
    false: bool  # a face was found and is not
    haar_right: bool  # the same of OpenCV's cascade alone, on the whole image
    haar_false: int  # its false hits


def true_face(truth: Truth, camera: StereoCamera, index: int) -> TrueFace:
    """The face of the person in frame `index`."""
    joint = {name: at[index] for name, at in truth.all_joints.items()}
    eyes = torch.stack([joint["eye_L"], joint["eye_R"]])
    middle = eyes.mean(0)
    forward, to_camera = (middle - joint["head"])[[0, 2]], -middle[[0, 2]]
    aside = torch.nn.functional.cosine_similarity(forward, to_camera, dim=0)
    angle = float(torch.rad2deg(aside.clamp(-1, 1).acos()))
    up = torch.nn.functional.normalize(joint["head_top"] - joint["head"], dim=0)
    center = middle - BELOW_EYES * up
    labels, depth = truth.labels(index), truth.depth(index)[0]
    u, v = camera.project(eyes).round().long().unbind(-1)
    inside = bool(((u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)).all())
    seen = inside and bool(
        (torch.from_numpy(labels == truth.parts.index("head"))[v, u]).all()
        and (depth[v, u] >= eyes[:, 2] - BEFORE_EYE).all()
    )
    width = camera.focal_length * WIDTH / float(center[2])
    return TrueFace(camera.project(center), width, angle, seen and angle <= MOST_VISIBLE)


class HaarAlone:
    """The rival: OpenCV's frontal cascade on the whole image, with its own settings and nothing else asked."""

    def __init__(self) -> None:
        self.cascade = read_cascade("haarcascade_frontalface_default.xml")

    def __call__(self, image: Float[Tensor, "3 height width"]) -> Float[Tensor, "boxes 4"]:
        """Boxes (x0, y0, x1, y1), px."""
        colour = (255 * image).round().byte().permute(1, 2, 0).numpy()
        boxes = np.array(self.cascade.detectMultiScale(cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)))
        corner = torch.from_numpy(boxes.reshape(-1, 4)).float()
        return torch.cat([corner[:, :2], corner[:, :2] + corner[:, 2:]], 1) - 0.5


def score_face(faces: Faces, haar: Float[Tensor, "boxes 4"], truth: TrueFace) -> FaceScore:
    """The verdict on the face (batch 1) and on the boxes of `HaarAlone` in one frame."""
    found = bool(faces.found[0])
    right = found and truth.holds(faces.box[0])
    hits = [truth.holds(box) for box in haar]
    return FaceScore(truth.angle, truth.visible, right, found and not right, any(hits), len(hits) - sum(hits))


def face_figures(scores: Sequence[FaceScore]) -> dict[str, float]:
    """Shares of the visible faces that were found and of the frames with a false one; NaN where there are none.

    `haar_false` is false hits a frame.
    """

    def mean(values: list[bool] | list[int]) -> float:
        return float(np.mean(values)) if values else float("nan")

    visible = [s for s in scores if s.visible]
    return {
        "face_found": mean([s.right for s in visible]),
        "face_false": mean([s.false for s in scores]),
        "haar_found": mean([s.haar_right for s in visible]),
        "haar_false": mean([s.haar_false for s in scores]),
    }


def by_angle(scores: Sequence[FaceScore]) -> dict[str, dict[str, float]]:
    """Figures of the frames whose face is 0 to 30, 30 to 60, ... degrees aside, with their number."""
    bands = {f"{low}-{high}": [s for s in scores if low <= s.angle < high] for low, high in pairwise(ANGLES)}
    return {
        name: {"frames": len(band), "visible": sum(s.visible for s in band)} | face_figures(band)
        for name, band in bands.items()
    }
