"""What the thesis's figures show of a frame or of an angle: panels for `benchmarks.figures`.

Pixels (u, v); angles in rad, drawn in degrees.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.body.ellipsoid import outline
from torchpose.eyes import Sight
from torchpose.figures import LEFT_COLOUR, PART_COLOURS, RIGHT_COLOUR, UNLABELLED
from torchpose.people import People
from torchpose.pipeline import StereoToPose
from torchpose.registration.likelihood import FaceLikelihood, TorsoLikelihood
from torchpose.registration.vem import Observation
from torchpose.rendered import RenderedRecording
from torchpose.vision.points import group_cells

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PALETTE = np.array([*PART_COLOURS, UNLABELLED]) / 255
LEFT, RIGHT = (tuple(np.array(colour) / 255) for colour in (LEFT_COLOUR, RIGHT_COLOUR))
UNKNOWN = torch.pi / 4  # rad; an angle of a greater standard deviation is not drawn, as in angles.png


@dataclass(frozen=True)
class Look:
    """What is seen in a frame and the pose that was fitted to it, batch 1."""

    sight: Sight
    observation: Observation
    pose: Float[Tensor, "1 parameters"]


@dataclass(frozen=True)
class Following:
    """A model and what it made of the first frames of a recording."""

    model: StereoToPose
    looks: tuple[Look, ...]


def follow_frames(recording: RenderedRecording, count: int) -> Following:
    """The first `count` frames of a recording in which somebody is seen throughout."""
    people = People(StereoToPose(recording.camera))
    people.prepare(recording)
    looks = []
    for i in range(count):
        found = people.step(recording, i)[0]
        if found.sight is None or found.observation is None or found.registration is None:
            raise ValueError(f"somebody must be seen in every frame, got {found.status.value} in frame {i}")
        looks.append(Look(found.sight, found.observation, found.registration.pose))
    return Following(people.followers[0].model, tuple(looks))


def new_figure(rows: int, columns: int, width: float, height: float, **options: Any) -> tuple["Figure", Any]:
    """A figure of `rows` x `columns` axes, inches."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def box_around(mask: Bool[Tensor, "height width"], margin: int = 20) -> tuple[slice, slice]:
    """Rows and columns of the pixels that are set, and a margin."""
    rows, columns = (mask.any(1 - axis).nonzero()[:, 0].tolist() for axis in (0, 1))
    return tuple(slice(max(0, hit[0] - margin), hit[-1] + 1 + margin) for hit in (rows, columns))  # type: ignore


def show(
    axes: "Axes", image: Float[Tensor, "height width"] | Float[Tensor, "3 height width"], **options: Any
) -> Any:
    """An image, with its pixels where they are, without ticks."""
    axes.set_xticks([])
    axes.set_yticks([])
    picture = image if image.ndim == 2 else image.permute(1, 2, 0)
    return axes.imshow(picture.cpu().numpy(), **options)


def frame_to(axes: "Axes", box: tuple[slice, slice]) -> None:
    """Show the pixels of a box alone, rows downwards, all of the same size."""
    axes.set_aspect("equal")
    axes.set_xlim(box[1].start, box[1].stop)
    axes.set_ylim(box[0].stop, box[0].start)
    axes.set_xticks([])
    axes.set_yticks([])


def scatter(axes: "Axes", look: Look, colour: Any, size: float = 9, **options: Any) -> Any:
    """The points of a frame at their pixels."""
    pixels = look.sight.cloud.pixels[look.sight.cloud.mask].cpu().numpy()
    return axes.scatter(pixels[:, 0], pixels[:, 1], s=size, c=colour, linewidths=0, **options)


def draw_appearance(axes: "Axes", following: Following, look: Look) -> Any:
    """What the image says of face and torso: the face's box, and the points by phi of (3.9) and (3.11)."""
    from matplotlib.patches import Rectangle

    names, cloud = following.model.body.segment_names, look.sight.cloud
    evidence = following.model.evidence(look.sight)
    face, torso = (kind(names)(evidence)[cloud.mask].exp() for kind in (FaceLikelihood, TorsoLikelihood))
    grey = look.sight.images[0].mean(0) * 0.5 + 0.5
    show(axes, grey, cmap="gray", vmin=0, vmax=1)
    phi = torso[:, names.index("torso")]
    head = face[:, names.index("head")] > 1
    on_torso = phi > 1
    pixels = cloud.pixels[cloud.mask]
    dots = axes.scatter(
        pixels[on_torso, 0],
        pixels[on_torso, 1],
        s=14,
        c=phi[on_torso],
        cmap="viridis",
        vmin=1,
        vmax=7.4,
        linewidths=0,
    )
    axes.scatter(
        pixels[~head & ~on_torso, 0],
        pixels[~head & ~on_torso, 1],
        s=3,
        color="0.35",
        linewidths=0,
        label="neither: φ = 1",
    )
    axes.scatter(
        pixels[head, 0],
        pixels[head, 1],
        s=26,
        facecolors="none",
        edgecolors="red",
        linewidths=1,
        label="φ(head) = e",
    )
    x0, y0, x1, y1 = look.sight.faces.box[0].tolist()
    axes.add_patch(
        Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, color="red", linewidth=1.5, label="face found")
    )
    frame_to(axes, box_around(look.sight.silhouette[0]))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.01), fontsize=7)
    return dots


def draw_body(axes: "Axes", following: Following, pose: Float[Tensor, "1 parameters"]) -> None:
    """The outlines of the ellipsoids, in the colours of their labels."""
    model = following.model
    rims = model.camera.project(outline(model.body(pose, model.size)))[0].cpu().numpy()
    for part, rim in enumerate(rims):
        axes.plot(*np.concatenate([rim, rim[:1]]).T, color=PALETTE[part], linewidth=1.4)


def draw_sides(
    axes: "Axes",
    time_s: Float[Tensor, " time"],
    estimate: Float[Tensor, "time 2"],
    truth: Float[Tensor, "time 2"],
    sd: Float[Tensor, "time 2"] | None = None,
) -> None:
    """Left and right angles over time, degrees: estimated as a line with two deviations about it, true as dashes."""
    if sd is not None:
        estimate = torch.where(sd > UNKNOWN, torch.nan, estimate)
    estimate, truth = estimate.rad2deg(), truth.rad2deg()
    for side, (name, colour) in enumerate((("left", LEFT), ("right", RIGHT))):
        off = (estimate - truth)[:, side].abs().nanmean()
        axes.plot(time_s, estimate[:, side], color=colour, linewidth=1.4, label=f"{name}, {off:.1f}° off")
        axes.plot(time_s, truth[:, side], color=colour, linewidth=1.2, linestyle=(0, (3, 2)), alpha=0.8)
        if sd is not None:
            band = 2 * sd[:, side].rad2deg()
            low, high = estimate[:, side] - band, estimate[:, side] + band
            axes.fill_between(time_s, low, high, color=colour, alpha=0.15, linewidth=0)
    axes.plot([], [], color="0.3", linestyle=(0, (3, 2)), label="truth")
    axes.legend(fontsize=7, ncols=3, loc="upper right", framealpha=0.8)
    axes.set_ylim(top=axes.get_ylim()[1] + 0.2 * np.diff(axes.get_ylim())[0])  # for the legend
    axes.margins(x=0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)


def draw_geodesic(axes: "Axes", following: Following, look: Look) -> Any:
    """Points by their way over the body from the head, with the ways to both hands."""
    model, cloud = following.model, look.sight.cloud
    cells, joints = group_cells(cloud), model.body(look.pose, model.size).joints[0]
    names = model.body.joint_names
    gap = (cells.centres[0][:, None] - joints).norm(dim=-1).where(cells.mask[0][:, None], torch.inf)
    head = int(gap[:, names.index("head")].argmin())
    way = cells.distances[0, head][cells.index[0].clamp_min(0)][cloud.mask[0]]
    drawn = scatter(axes, look, way.cpu().numpy(), cmap="plasma", vmin=0, vmax=1.6)
    for side, colour in (("left", LEFT), ("right", RIGHT)):
        hand = int(gap[:, names.index(f"wrist_{side}")].argmin())
        ends = model.camera.project(cells.centres[0, [head, hand]]).cpu().numpy()
        straight = float((cells.centres[0, head] - cells.centres[0, hand]).norm())
        label = f"{side} wrist: {float(cells.distances[0, head, hand]):.2f} m, straight {straight:.2f} m"
        axes.plot(*ends.T, color=colour, linewidth=1.2, marker="o", markersize=3, label=label)
    frame_to(axes, box_around(look.sight.silhouette[0]))
    axes.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.01))
    return drawn


def draw_components(images: Float[Tensor, "components pixels"]) -> "Figure":
    """Eight components, each scaled to its own greatest value."""
    figure, rows = new_figure(2, 4, 6.4, 4.6)
    for number, (axes, image) in enumerate(zip(rows.ravel(), images, strict=True), 1):
        drawn = show(
            axes,
            (image / image.abs().amax()).view(64, 48),
            cmap="RdBu_r",
            vmin=-1,
            vmax=1,
            interpolation="nearest",
        )
        axes.set_title(str(number), fontsize=9)
    figure.colorbar(drawn, ax=rows, label="weight of a pixel, of the component's greatest", shrink=0.8)
    return figure


def label_axes(rows: Any) -> None:
    """Seconds below, degrees at the left."""
    for axes in rows[-1]:
        axes.set_xlabel("time (s)")
    for axes in rows[:, 0]:
        axes.set_ylabel("degrees")
