"""Draws every anatomical angle from the body model itself, at 0 and at +40 degrees, for docs/angles.md.

python -m benchmarks.angle_figures [--output docs/figures/angles]

The grey lines are the body at 0 degrees, the coloured limbs those that +40 degrees move, and the arrow is the way of a
point of theirs as the model turns it there. Of the limbs, the right one is drawn.
"""

import argparse
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from torchpose.atomic import replacing
from torchpose.body.angle import ANATOMICAL_NAMES, SIDES, anatomical_angles
from torchpose.body.model import BodyModel, PosedBody

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SHOWN = 40.0  # degrees
_STEPS = 15  # of the arrow
_COLOURS = 64  # a palette makes the files small
# How a picture looks at the person: the body's axes (x left, y down, z back) that go right and down, and its words.
VIEWS: dict[str, tuple[tuple[int, int, int], tuple[int, int, int], str]] = {
    "right": ((0, 0, -1), (0, 1, 0), "seen from the person's right"),
    "front": ((1, 0, 0), (0, 1, 0), "seen from the front"),
    "above": ((-1, 0, 0), (0, 0, 1), "seen from above, facing up the page"),
}


@dataclass(frozen=True)
class Drawing:
    """One angle: how it is looked at, a joint whose way is drawn, and other angles that make it visible (degrees)."""

    view: str
    joint: str
    others: tuple[tuple[str, float], ...] = ()
    along: tuple[
        tuple[str, float], ...
    ] = ()  # angles that turn along with it, times this: the legs stay upright


DRAWINGS: dict[str, Drawing] = {
    "trunk_flexion": Drawing("right", "head", along=(("hip_flexion_left", 1.0), ("hip_flexion_right", 1.0))),
    "trunk_lateral_bending": Drawing(
        "front", "head", along=(("hip_abduction_left", -1.0), ("hip_abduction_right", 1.0))
    ),
    "trunk_rotation": Drawing("above", "shoulder_right"),
    "neck_flexion": Drawing("right", "head"),
    "neck_lateral_bending": Drawing("front", "head"),
    "shoulder_flexion": Drawing("right", "wrist_right"),
    "shoulder_abduction": Drawing("front", "wrist_right"),
    "shoulder_rotation": Drawing("above", "wrist_right", (("elbow_flexion_right", 90.0),)),
    "elbow_flexion": Drawing("right", "wrist_right"),
    "hip_flexion": Drawing("right", "ankle_right"),
    "hip_abduction": Drawing("front", "ankle_right"),
    "hip_rotation": Drawing(
        "front", "ankle_right", (("hip_flexion_right", 90.0), ("knee_flexion_right", 90.0))
    ),
    "knee_flexion": Drawing("right", "ankle_right"),
}


def pose_of_angles(body: BodyModel, degrees: Mapping[str, float]) -> Float[Tensor, "1 parameters"]:
    """The pose that has these anatomical angles, 0 where none is given; the person faces the camera."""
    angle = {
        name: torch.tensor(degrees.get(name, 0.0), dtype=torch.float64).deg2rad() for name in ANATOMICAL_NAMES
    }

    def direction(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        return torch.stack([x, y, z])

    nod, tilt = angle["neck_flexion"], angle["neck_lateral_bending"]
    limbs = {"head": direction(-tilt.sin(), -tilt.cos() * nod.cos(), -tilt.cos() * nod.sin())}
    for way, side in zip((1, -1), SIDES, strict=True):
        for upper, lower, ball, hinge, bend in (
            ("upper_arm", "forearm", "shoulder", "elbow", -1),
            ("thigh", "shank", "hip", "knee", 1),
        ):
            f, a, r = (angle[f"{ball}_{motion}_{side}"] for motion in ("flexion", "abduction", "rotation"))
            k = angle[f"{hinge}_flexion_{side}"]

            def turned(
                out: Tensor, along: Tensor, back: Tensor, f: Tensor = f, a: Tensor = a, way: int = way
            ) -> Tensor:
                """From the frame that flexion and abduction turn: outward, along the limb and back."""
                down = a.cos() * along - a.sin() * out
                outward = a.cos() * out + a.sin() * along
                return direction(
                    way * outward, f.cos() * down + f.sin() * back, f.cos() * back - f.sin() * down
                )

            zero = torch.zeros_like(k)
            limbs[f"{upper}_{side}"] = turned(zero, zero + 1, zero)
            limbs[f"{lower}_{side}"] = turned(bend * k.sin() * r.sin(), k.cos(), bend * k.sin() * r.cos())
    root = torch.stack([angle["trunk_rotation"], angle["trunk_flexion"], -angle["trunk_lateral_bending"]])
    directions = torch.stack([limbs[name] for name in body.body_names[1:]])
    return body.pose_from_directions(torch.zeros(1, 3, dtype=torch.float64), root[None], directions[None])


def draw_angle(path: Path, body: BodyModel, name: str, drawing: Drawing) -> None:
    """Draw one angle to a PNG."""
    from matplotlib.figure import Figure

    full = name if name in ANATOMICAL_NAMES else f"{name}_right"
    ways = []
    for degrees in np.linspace(0, SHOWN, _STEPS + 1).tolist():
        turned = {other: share * degrees for other, share in drawing.along}
        ways.append(body(pose_of_angles(body, dict(drawing.others) | turned | {full: degrees})))
    start, end = ways[0], ways[-1]
    reached = anatomical_angles(body, end)[0, ANATOMICAL_NAMES.index(full)].rad2deg().item()
    if abs(reached - SHOWN) > 1e-6:
        raise AssertionError(f"{full} is drawn at {reached} degrees")
    right, down, words = VIEWS[drawing.view]
    axes_of_view = torch.tensor([right, down], dtype=torch.float64)
    toward = torch.linalg.cross(axes_of_view[0], axes_of_view[1])  # away from the eye
    figure = Figure(figsize=(3.2, 4.0 if drawing.view != "above" else 3.2), layout="constrained")
    axes = figure.subplots()
    moved = _moved(start, end)
    if drawing.along:  # the legs stay, but for the little that leaning hips shift them
        moved &= torch.tensor(
            [not name.startswith(("thigh", "shank", "foot")) for name in body.segment_names]
        )
    for part in (toward @ end.centers[0].mT).argsort(descending=True).tolist():
        colour = "#5b9bd5" if bool(moved[part]) else "#d9d9d9"
        _draw_ellipsoid(axes, end, part, axes_of_view, facecolor=colour, edgecolor="#404040", linewidth=0.8)
    for part in range(body.num_parts):
        if bool(moved[part]):
            _draw_ellipsoid(
                axes,
                start,
                part,
                axes_of_view,
                facecolor="none",
                edgecolor="#909090",
                linewidth=0.9,
                linestyle="--",
            )
    joint = body.joint_names.index(drawing.joint)
    way = (torch.cat([posed.joints[:, joint] for posed in ways]) @ axes_of_view.mT).numpy()
    axes.plot(*way[:-1].T, color="#c00000", linewidth=2)
    axes.annotate("", way[-1], way[-3], arrowprops={"arrowstyle": "-|>", "color": "#c00000", "linewidth": 2})
    axes.annotate(
        f"+{SHOWN:.0f}°",
        way[len(way) // 2],
        xytext=_beside(way),
        textcoords="offset points",
        color="#c00000",
        fontsize=12,
        weight="bold",
        ha="center",
        va="center",
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5},
    )
    axes.set_aspect("equal")
    axes.invert_yaxis()
    axes.autoscale_view()
    axes.margins(0.08)
    axes.axis("off")
    held = "".join(
        f", {other.removesuffix('_right').replace('_', ' ')} {value:.0f}°" for other, value in drawing.others
    )
    axes.set_title(f"{name.replace('_', ' ')}\n{words}{held.replace(', ', chr(10), 1)}", fontsize=9)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=95)
    with replacing(path) as partial:
        Image.open(buffer).convert("RGB").quantize(_COLOURS).save(partial, optimize=True)


def _moved(start: PosedBody, end: PosedBody) -> Bool[Tensor, " parts"]:
    """The ellipsoids that the angle turns or carries along."""
    cosine = ((start.frames * end.frames).sum((-2, -1))[0] - 1) / 2
    return (cosine < np.cos(np.deg2rad(10))) | ((end.centers - start.centers)[0].norm(dim=-1) > 0.1)


def _beside(way: Float[np.ndarray, "steps 2"]) -> tuple[float, float]:
    """Where the number stands: beside the arrow's middle, on the outer side of its bend, in points."""
    outward = way[len(way) // 2] - (way[0] + way[-1]) / 2
    x, y = 24 * outward / np.linalg.norm(outward)
    return float(x), float(-y)  # the picture's y goes down


def _draw_ellipsoid(
    axes: "Axes", posed: PosedBody, part: int, view: Float[Tensor, "2 3"], **style: object
) -> None:
    """The outline of an ellipsoid as a parallel projection sees it."""
    from matplotlib.patches import Polygon

    reach = view @ posed.frames[0, part] * posed.radii[0, part]  # (2, 3): the half axes in the picture
    left, half, _ = torch.linalg.svd(reach, full_matrices=False)
    t = torch.linspace(0, 2 * torch.pi, 60, dtype=torch.float64)
    rim = (left * half) @ torch.stack([t.cos(), t.sin()]) + (view @ posed.centers[0, part])[:, None]
    axes.add_patch(Polygon(rim.mT.numpy(), closed=True, **style))  # type: ignore[arg-type]


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=Path("docs/figures/angles"))
    output = parser.parse_args(argv).output
    torch.set_default_dtype(torch.float64)
    body = BodyModel()
    for name, drawing in DRAWINGS.items():
        draw_angle(output / f"{name}.png", body, name, drawing)
        print(output / f"{name}.png")


if __name__ == "__main__":
    main()
