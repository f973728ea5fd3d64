"""What is drawn over the frames: the model's outlines, the skeleton, labelled points and words."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from torchpose.body.ellipsoid import outline
from torchpose.export import PoseSequence
from torchpose.figures import Overlay
from torchpose.parts import LabelledPoints
from torchpose.pipeline import StereoToPose

_SHOWN = ("elbow_flexion_left", "elbow_flexion_right", "knee_flexion_left", "knee_flexion_right")


def overlays(
    model: StereoToPose,
    sequence: PoseSequence,
    points: Sequence[LabelledPoints],
    words: bool = True,
) -> list[Overlay]:
    """An overlay for each of some frames of a person, whose model this is; with `words`, status and angles."""
    assert sequence.pose is not None
    camera, body, size = model.camera, model.body, model.size
    posed = sequence.pose.isfinite().all(1)
    found = body(sequence.pose[posed].to(size), size)
    outlines, joints = camera.project(outline(found)).cpu(), camera.project(found.joints).cpu()
    shown = [sequence.angle_names.index(name) for name in _SHOWN]
    degrees = sequence.angles[:, shown].rad2deg()
    answer = []
    for i, status in enumerate(sequence.status):
        status = status if words else ""
        if not bool(posed[i]):
            answer.append(Overlay(status))
            continue
        row = int(posed[:i].sum())
        left_elbow, right_elbow, left_knee, right_knee = degrees[i].round().int().tolist()
        lines = (f"elbow L {left_elbow}  R {right_elbow}", f"knee  L {left_knee}  R {right_knee}")
        pixels: Float[Tensor, "num 2"] = camera.project(points[i].points)
        answer.append(
            Overlay(status, outlines[row], joints[row], pixels, points[i].labels, lines if words else ())
        )
    return answer
