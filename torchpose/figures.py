"""Pictures for people: the pose drawn over an image, the joint angles over time, and confusion matrices.

Pixels (u, v) are column and row, an integer is a pixel's centre. Angles come in radians and are drawn in
degrees. Left and right are the subject's.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import Float, Int
from torch import Tensor, from_numpy

from torchpose.activity.recognizer import Evaluation
from torchpose.atomic import replacing
from torchpose.export import JOINT_NAMES, PoseSequence

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Colour = tuple[int, int, int]  # RGB, 0 to 255

# One for each of the body's 14 segments, in their order: the left limbs warm and the right ones cool, which
# the colour-blind tell apart, too, and paler towards the hands and feet.
PART_COLOURS: tuple[Colour, ...] = (
    (150, 150, 150),
    (240, 228, 66),
    *((190, 50, 0), (240, 120, 20), (255, 195, 130)),
    *((0, 60, 150), (50, 130, 230), (160, 220, 255)),
    *((130, 0, 120), (195, 70, 170), (235, 155, 215)),
    *((0, 80, 40), (0, 165, 90), (150, 235, 160)),
)
_DARK: Colour = (60, 60, 60)
UNLABELLED: Colour = (90, 90, 90)
LEFT_COLOUR, RIGHT_COLOUR, MIDDLE_COLOUR = (213, 94, 0), (0, 114, 178), (255, 255, 255)
STATUS_COLOURS: dict[str, Colour] = {
    "absent": (190, 190, 190),
    "entering": (86, 180, 233),
    "tracked": (120, 220, 150),
    "partial": (240, 228, 66),
    "recovered": (214, 130, 178),
    "lost": (255, 110, 90),
}
BONES: tuple[tuple[str, str], ...] = (
    ("pelvis", "neck"),
    ("neck", "head"),
    *(
        (f"{start}_{side}" if start not in ("neck", "pelvis") else start, f"{end}_{side}")
        for side in ("left", "right")
        for start, end in (
            *(("neck", "shoulder"), ("shoulder", "elbow"), ("elbow", "wrist")),
            *(("pelvis", "hip"), ("hip", "knee"), ("knee", "ankle")),
        )
    ),
)
# What a positive and a negative angle mean, by the name's last words (see `torchpose.body.angle`).
_SIGNS = {
    "trunk_rotation": "rotation, + to the right",
    "lateral_bending": "lateral bending, + to the right",
    "flexion": "flexion +, extension −",
    "abduction": "abduction +, adduction −",
    "rotation": "rotation, + inward",
}
WORST_SD = np.pi / 4  # rad; an angle that is less certain says nothing, and its band would fill the panel
_NO_POSE: dict[str, Any] = {"facecolor": "0.92", "edgecolor": "0.75", "hatch": "////", "linewidth": 0}
_PANEL_COLUMNS = 3
_MOST_DRAWN = 4000  # frames of a plot whose panels are 400 px wide; of more, each second, third and so on
LEAST_SPAN = 20.0  # degrees from the bottom to the top of a panel, so that noise looks like noise
_SHIFT = 4  # bits behind the point in OpenCV's coordinates
_FAR = 1e5  # px; beyond it OpenCV's coordinates would overflow


@dataclass(frozen=True)
class Overlay:
    """What to draw over one image; what is None, or has a NaN, is not drawn."""

    status: str
    outlines: Float[Tensor, "parts rim 2"] | None = None  # px, the ellipsoids' silhouettes as polygons
    joints: Float[Tensor, "15 2"] | None = None  # px, in the order of `JOINT_NAMES`
    points: Float[Tensor, "num 2"] | None = None  # px
    labels: Int[Tensor, " num"] | None = None  # the part of each point; anything but 0 to 13 is none
    row: int = 0  # in which the status stands: several people are drawn one after the other
    name: str = ""  # above the head
    marks: tuple[tuple[str, str], ...] = ()  # joint and what stands beside it


def draw_overlay(image: Float[Tensor, "3 height width"], overlay: Overlay) -> Float[Tensor, "3 height width"]:
    """The RGB image in [0, 1] with points, outlines, skeleton, status and text drawn over it, on the CPU."""
    levels = image.detach().cpu().clamp(0, 1).mul(255).round().byte()
    canvas = np.ascontiguousarray(levels.permute(1, 2, 0).numpy())
    unit = max(1.0, canvas.shape[0] / 480)  # px; what is thin on a small image is not on a large one
    if overlay.points is not None:
        _draw_points(canvas, overlay, round(unit))
    if overlay.outlines is not None:
        _draw_outlines(canvas, overlay.outlines, round(unit))
    if overlay.joints is not None:
        _draw_skeleton(canvas, overlay.joints, unit)
        _draw_marks(canvas, overlay, unit)
    _draw_text(canvas, overlay, unit)
    return from_numpy(canvas).permute(2, 0, 1).to(image.dtype).div(255)


def plot_angles(path: Path, sequence: PoseSequence) -> None:
    """Draw the anatomical angles over time to a PNG: a panel for each, left and right in one.

    The band is two standard deviations wide to each side; frames without a pose are shaded; an angle is left
    out where its standard deviation is above 45 degrees.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    clean = sequence[:: max(1, len(sequence) // _MOST_DRAWN)].without_stale_numbers()
    panels = angle_panels(clean.angle_names)
    rows = -(-len(panels) // _PANEL_COLUMNS)
    figure = Figure(figsize=(11, 0.9 + 1.75 * rows), layout="constrained")
    axes = figure.subplots(rows, _PANEL_COLUMNS, squeeze=False, sharex=True).ravel()
    for panel, lines in zip(axes, panels.items(), strict=False):
        _draw_panel(panel, clean, *lines)
    for number, panel in enumerate(axes):
        if number >= len(panels):
            panel.set_visible(False)
        elif number + _PANEL_COLUMNS >= len(panels):
            panel.tick_params(labelbottom=True)
            panel.set_xlabel("time (s)")
        if number % _PANEL_COLUMNS == 0:
            panel.set_ylabel("degrees")
    figure.legend(
        handles=[
            Line2D([], [], color=_hex(LEFT_COLOUR), label="left"),
            Line2D([], [], color=_hex(RIGHT_COLOUR), label="right"),
            Line2D([], [], color=_hex(_DARK), label="trunk and neck"),
            Patch(color="0.5", alpha=0.25, linewidth=0, label="two standard deviations to each side"),
            Patch(**_NO_POSE, label="no pose"),
        ],
        loc="outside upper center",
        ncols=5,
        frameon=False,
    )
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110)


def plot_confusions(path: Path, evaluations: Mapping[str, Evaluation]) -> None:
    """Draw confusion matrices side by side to a PNG, by title: a row is the truth, a column the answer, `-` none.

    The shade is the share of the row; a cell has its count, and beside a name stands how often it was right.
    """
    from matplotlib.figure import Figure

    size = max(len(evaluation.activities) for evaluation in evaluations.values())
    figure = Figure(
        figsize=((0.42 * size + 1.6) * len(evaluations) + 1, 0.42 * size + 2.2), layout="constrained"
    )
    panels = figure.subplots(1, len(evaluations), squeeze=False)[0]
    for number, (axes, (title, evaluation)) in enumerate(zip(panels, evaluations.items(), strict=True)):
        _draw_confusion(axes, evaluation, named=number == 0)
        axes.set_title(f"{title}: {100 * evaluation.accuracy:.1f} % right", fontsize=10)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110)


def _draw_confusion(axes: "Axes", evaluation: Evaluation, named: bool) -> None:
    counts = evaluation.confusion.numpy()
    columns = [name.replace("_", " ") for name in evaluation.activities]
    rows = [
        f"{name}  {100 * right:.0f} %" if np.isfinite(right) else name
        for name, right in zip(columns, evaluation.accuracy_by_class.values(), strict=True)
    ]
    if evaluation.unanswered.any():
        counts = np.concatenate([counts, evaluation.unanswered.numpy()[:, None]], axis=1)
        columns = [*columns, "-"]
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="equal")
    for row, column in zip(*np.nonzero(counts), strict=True):
        colour = "white" if share[row, column] > 0.6 else "black"
        axes.text(column, row, str(counts[row, column]), ha="center", va="center", color=colour, fontsize=8)
    axes.set_xticks(range(len(columns)), columns, rotation=60, ha="right", rotation_mode="anchor", fontsize=8)
    axes.set_yticks(range(len(rows)), rows, fontsize=8)
    axes.set_xlabel("answer")
    if named:
        axes.set_ylabel("truth")
    axes.tick_params(length=0)


def angle_panels(names: tuple[str, ...]) -> dict[str, dict[str, int]]:
    """The columns of each panel's lines, by side: {"neck_flexion": {"": 3}, "hip_flexion": {"left": 5}}."""
    panels: dict[str, dict[str, int]] = {}
    for column, name in enumerate(names):
        words = name.split("_")
        side = next((word for word in words if word in ("left", "right")), "")
        panels.setdefault("_".join(word for word in words if word != side), {})[side] = column
    return panels


def panel_title(name: str) -> str:
    """What a panel of `angle_panels` shows, in words, with the meaning of the sign."""
    for ending, meaning in _SIGNS.items():
        if name.endswith(ending):
            joint = name.removesuffix(ending).strip("_") or name.removesuffix("_rotation")
            return f"{joint.capitalize()}: {meaning}"
    return name.replace("_", " ").capitalize()


def _draw_panel(axes: "Axes", sequence: PoseSequence, name: str, columns: dict[str, int]) -> None:
    time = sequence.time_s.numpy()
    colours = {"left": LEFT_COLOUR, "right": RIGHT_COLOUR, "": _DARK}
    low, high = np.inf, -np.inf
    for side, column in columns.items():
        angle, sd = (np.rad2deg(values[:, column].numpy()) for values in (sequence.angles, sequence.angle_sd))
        angle = np.where(sd > np.rad2deg(WORST_SD), np.nan, angle)  # an unknown sd is not a large one
        colour = _hex(colours[side])
        axes.fill_between(time, angle - 2 * sd, angle + 2 * sd, color=colour, alpha=0.2, linewidth=0)
        axes.plot(time, angle, color=colour, linewidth=1.2, marker=".", markersize=1.5)
        known = np.isfinite(angle)
        margin = np.median(2 * sd[known & np.isfinite(sd)]) if (known & np.isfinite(sd)).any() else 0.0
        low = min(low, angle[known].min(initial=np.inf) - margin)
        high = max(high, angle[known].max(initial=-np.inf) + margin)
    if low > high:
        low = high = 0.0
    half = max(LEAST_SPAN, 1.1 * (high - low)) / 2
    axes.set_ylim((low + high) / 2 - half, (low + high) / 2 + half)
    for start, stop in _gaps(sequence):
        axes.axvspan(start, stop, **_NO_POSE, zorder=0)
    axes.axhline(0, color="0.7", linewidth=0.6, zorder=0.5)
    axes.set_title(panel_title(name), fontsize=9, loc="left")
    axes.tick_params(labelsize=8)
    axes.margins(x=0)
    axes.spines[["top", "right"]].set_visible(False)


def _gaps(sequence: PoseSequence) -> Iterator[tuple[float, float]]:
    """Start and end (s) of each run of frames without a pose, half a frame beyond its first and last."""
    time = sequence.time_s.numpy()
    half = np.diff(time).min(initial=np.inf) / 2 if len(time) > 1 else 0.5
    lost = np.concatenate([[False], ~np.asarray(sequence.answered, dtype=bool), [False]])
    edges = np.flatnonzero(lost[1:] != lost[:-1])
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        yield float(time[first] - half), float(time[end - 1] + half)


def _draw_points(canvas: np.ndarray, overlay: Overlay, radius: int) -> None:
    assert overlay.points is not None
    pixels = overlay.points.detach().cpu().double().numpy()
    known = np.isfinite(pixels).all(axis=1)
    centres = np.rint(np.where(known[:, None], pixels, -_FAR)).clip(-_FAR, _FAR).astype(np.int64)
    palette = np.array([*PART_COLOURS, UNLABELLED], dtype=np.uint8)
    labels = np.full(len(pixels), -1) if overlay.labels is None else overlay.labels.detach().cpu().numpy()
    labels = np.where((labels >= 0) & (labels < len(PART_COLOURS)), labels, len(PART_COLOURS))
    steps = np.arange(-radius, radius + 1)
    du, dv = (offset.ravel() for offset in np.meshgrid(steps, steps))
    disc = du**2 + dv**2 <= radius**2 + 1
    u, v = centres[:, :1] + du[disc], centres[:, 1:] + dv[disc]
    seen = (u >= 0) & (u < canvas.shape[1]) & (v >= 0) & (v < canvas.shape[0])
    canvas[v[seen], u[seen]] = np.broadcast_to(palette[labels][:, None], (*u.shape, 3))[seen]


def _draw_outlines(canvas: np.ndarray, outlines: Float[Tensor, "parts rim 2"], thickness: int) -> None:
    for part, polygon in enumerate(outlines.detach().cpu().double().numpy()):
        if np.isfinite(polygon).all():
            colour = PART_COLOURS[part % len(PART_COLOURS)]
            cv2.polylines(canvas, [_fixed_point(polygon)], True, colour, thickness, cv2.LINE_AA, _SHIFT)


def _draw_skeleton(canvas: np.ndarray, joints: Float[Tensor, "15 2"], unit: float) -> None:
    pixels = dict(zip(JOINT_NAMES, joints.detach().cpu().double().numpy(), strict=True))
    # A dark rim below all bones, then the bones: they stand out on any background.
    for rim in (True, False):
        for start, end in BONES:
            if not np.isfinite([pixels[start], pixels[end]]).all():
                continue
            left, right = end.endswith("_left"), end.endswith("_right")
            colour = LEFT_COLOUR if left else RIGHT_COLOUR if right else MIDDLE_COLOUR
            a, b = _fixed_point(np.stack([pixels[start], pixels[end]])).tolist()
            width = round((4 if rim else 2) * unit)
            cv2.line(canvas, a, b, (0, 0, 0) if rim else colour, width, cv2.LINE_AA, _SHIFT)
    for pixel in pixels.values():
        if np.isfinite(pixel).all():
            radius = round(2.5 * unit * 2**_SHIFT)
            centre = _fixed_point(pixel).tolist()
            cv2.circle(canvas, centre, radius, (255, 255, 255), cv2.FILLED, cv2.LINE_AA, _SHIFT)


def _draw_marks(canvas: np.ndarray, overlay: Overlay, unit: float) -> None:
    """The name above the head, and the marks: of a left and a right joint each to its own side, so they never meet."""
    assert overlay.joints is not None
    pixels = dict(
        zip(JOINT_NAMES, overlay.joints.detach().cpu().double().numpy().clip(-_FAR, _FAR), strict=True)
    )
    size, pad = 0.4 * unit, 2 * unit
    for joint, text in overlay.marks:
        left = joint.endswith("_left")
        side, other = ("_left", "_right") if left else ("_right", "_left")
        place, partner = pixels[joint], pixels[joint.removesuffix(side) + other]
        if not np.isfinite(place).all():
            continue
        outward = 1 if place[0] > partner[0] or (left and not place[0] < partner[0]) else -1
        (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, round(unit))
        start = place[0] + outward * 8 * unit - (0 if outward > 0 else width)
        corners = (
            (start - pad, place[1] - height / 2 - pad),
            (start + width + pad, place[1] + height / 2 + pad),
        )
        low, high = (tuple(round(value) for value in corner) for corner in corners)
        cv2.rectangle(canvas, low, high, LEFT_COLOUR if left else RIGHT_COLOUR, cv2.FILLED)
        _write(canvas, text, (start, place[1] + height / 2), size, (255, 255, 255), round(unit))
    head, neck = pixels["head"], pixels["neck"]
    if overlay.name and np.isfinite([head, neck]).all():
        (width, _), _ = cv2.getTextSize(overlay.name, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * unit, round(unit))
        top = min(head[1], neck[1]) - 0.9 * np.linalg.norm(head - neck) - 4 * unit
        _write(
            canvas,
            overlay.name,
            (head[0] - width / 2, max(top, 12 * unit)),
            0.5 * unit,
            (255, 255, 255),
            round(unit),
            True,
        )


def _draw_text(canvas: np.ndarray, overlay: Overlay, unit: float) -> None:
    colour = STATUS_COLOURS.get(overlay.status.rpartition(" ")[2], (255, 255, 255))
    origin = (8 * unit, 17 * unit * (overlay.row + 1.1))
    _write(canvas, overlay.status, origin, 0.48 * unit, colour, round(unit), True)


def _write(
    canvas: np.ndarray,
    text: str,
    origin: tuple[float, float],
    size: float,
    colour: Colour,
    width: int,
    rim: bool = False,
) -> None:
    """ASCII text whose line starts at `origin`; the rim is dark."""
    place = (round(origin[0]), round(origin[1]))
    for shade, thickness in (((0, 0, 0), 3 * width), (colour, width))[0 if rim else 1 :]:
        cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, shade, thickness, cv2.LINE_AA)


def _fixed_point(pixels: np.ndarray) -> np.ndarray:
    """Pixels in OpenCV's coordinates with `_SHIFT` bits behind the point."""
    return np.rint(pixels.clip(-_FAR, _FAR) * 2**_SHIFT).astype(np.int32)


def _hex(colour: Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)
