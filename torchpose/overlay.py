"""What is drawn over the frames: the model's outlines, the skeleton, labelled points and words."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from torchpose.body.ellipsoid import outline
from torchpose.export import PoseSequence
from torchpose.figures import WORST_SD, Overlay
from torchpose.parts import LabelledPoints
from torchpose.pipeline import StereoToPose

_SHOWN = ("elbow_flexion_left", "elbow_flexion_right", "knee_flexion_left", "knee_flexion_right")


def overlays(
    model: StereoToPose,
    sequence: PoseSequence,
    points: Sequence[LabelledPoints],
    number: int | None = None,
) -> list[Overlay]:
    """An overlay for each of some frames of a person, whose model this is: body, points, status, angles.

    `number` is the person's among several, from 0: their statuses stand below one another. None: there is one.
    An angle of which little is known is left out.
    """
    assert sequence.pose is not None
    camera, body, size = model.camera, model.body, model.size
    posed = sequence.pose.isfinite().all(1)
    found = body(sequence.pose[posed].to(size), size)
    outlines, joints = camera.project(outline(found)).cpu(), camera.project(found.joints).cpu()
    shown = [sequence.angle_names.index(name) for name in _SHOWN]
    degrees, known = sequence.angles[:, shown].rad2deg(), ~(sequence.angle_sd[:, shown] > WORST_SD)
    places = [f"{joint}_{side}" for joint, side in (name.split("_flexion_") for name in _SHOWN)]
    name, row = ("", 0) if number is None else (str(number + 1), number)
    answer = []
    for i, word in enumerate(sequence.status):
        status = f"{name} {word}".strip()
        if not bool(posed[i]):
            answer.append(Overlay(status, row=row))
            continue
        at = int(posed[:i].sum())
        pixels: Float[Tensor, "num 2"] = camera.project(points[i].points)
        marks = [
            (place, f"{degree:.0f}")
            for place, degree, sure in zip(places, degrees[i].tolist(), known[i].tolist(), strict=True)
            if sure
        ]
        answer.append(
            Overlay(
                status,
                outlines[at],
                joints[at],
                pixels,
                points[i].labels,
                row=row,
                name=name,
                marks=tuple(marks),
            )
        )
    return answer
