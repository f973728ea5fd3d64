"""The thesis's figures, from recordings that the package makes itself: `make figures`.

python -m benchmarks.figures [--only 3.3 5.2 ...] [--output docs/figures/thesis] [--cache runs/figures]

A function draws each figure; what the poses of a recording cost is kept in the cache. The truth of the recordings is
drawn beside what was estimated, and reaches nothing else.
"""

import argparse
import io
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, Int
from PIL import Image
from torch import Tensor

from benchmarks.panel import (
    PALETTE,
    Following,
    box_around,
    draw_appearance,
    draw_body,
    draw_components,
    draw_geodesic,
    draw_sides,
    follow_frames,
    frame_to,
    label_axes,
    new_figure,
    scatter,
    show,
)
from benchmarks.simulated import CAMERA, Take, arm_axis_angles, follow, simulate
from torchpose.activity.subspace import SilhouetteConfig, fast_ica, pca, resize_silhouettes
from torchpose.atomic import replacing
from torchpose.body.angle import ANATOMICAL_NAMES, anatomical_angles
from torchpose.body.model import BodyModel
from torchpose.body.superquadric import DisplayModel, Person, draw_person
from torchpose.cli import load_config
from torchpose.export import PoseSequence, read_poses_npz, write_poses_npz
from torchpose.pipeline import StereoToPose
from torchpose.registration.geodesic import geodesic_bounds, geodesic_term
from torchpose.registration.labelling import mean_field
from torchpose.registration.vem import Registrar
from torchpose.rendered import RenderedRecording, demo_recording
from torchpose.synthesis.database import make_recording, synthetic_camera
from torchpose.synthesis.depth import Scene, cast_depth
from torchpose.synthesis.motion import ACTIVITIES, perform
from torchpose.version import __version__
from torchpose.vision.points import group_cells

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OUTPUT, CACHE = Path("docs/figures/thesis"), Path("runs/figures")
LARGEST = 140_000  # bytes of a file with all of its colours
FRAMES = 45  # of the recordings of single joints, 10 a second
HANDS_DOWN, HANDS_UP = 0, 11  # frames of the demonstration
EXAMPLES = ("boxing", "elbow_horizontal")  # motions whose points are labelled
BEFORE, NOW = 4, 6  # frames of these: whose pose is the start, and whose points are labelled
SEATED = 5  # frame of the sitting recording in which the hips are lowest
PEOPLE, MOMENTS = 6, 16  # people, and frames of each activity, whose silhouettes are analysed
COMPONENTS = 40  # principal components that are unmixed
SHOWN = (0, 22, 44, 66, 88, 109)  # frames of the simulated sequence


@cache
def demonstration() -> Following:
    """Both hands go up."""
    return follow_frames(demo_recording(), 1 + HANDS_UP)


def rendered(motion: str, frames: int) -> RenderedRecording:
    """A recording of a motion, ten frames a second."""
    return RenderedRecording(make_recording(motion, Person(), 0, frames, synthetic_camera(frame_rate=10.0)))


# Recordings that are followed for their angles


@dataclass(frozen=True)
class Angles:
    """Estimated and true angles of a recording, by the names of `ANATOMICAL_NAMES` and of the joints."""

    sequence: PoseSequence
    joints: Float[Tensor, "time 15 3"]  # m, true
    angles: Float[Tensor, "time 21"]  # rad, true

    def of(self, name: str) -> tuple[Tensor, Tensor, Tensor]:
        """Estimate, truth and standard deviation of an anatomical angle's left and right, rad."""
        columns = [ANATOMICAL_NAMES.index(f"{name}_{side}") for side in ("left", "right")]
        return self.sequence.angles[:, columns], self.angles[:, columns], self.sequence.angle_sd[:, columns]

    def measured(self, angle: Callable[[Tensor], Tensor], columns: slice) -> tuple[Tensor, Tensor]:
        """Estimate and truth of what an angle of the joints gives for left and right, rad."""
        return angle(self.sequence.joints)[:, columns], angle(self.joints)[:, columns]


def cached(name: str, folder: Path, compute: Callable[[], PoseSequence]) -> PoseSequence:
    """Poses from the cache, or computed and kept there."""
    path = folder / f"{name}_{__version__}.npz"
    if not path.is_file():
        write_poses_npz(path, compute())
    return read_poses_npz(path)


@cache
def arms() -> Take:
    """The simulated sequence of the thesis's 5.1."""
    return simulate("arms")


def angles_of_arms(folder: Path) -> Angles:
    """The simulated sequence, followed."""
    take = arms()
    sequence = cached("arms", folder, lambda: follow(take, load_config("infer"))[0])
    return Angles(sequence, take.joints, take.angles)


def angles_of(motion: str, folder: Path) -> Angles:
    """A rendered recording of a motion, followed from its images."""
    camera = synthetic_camera(480, 360, 10.0)
    synthetic = make_recording(motion, Person(), 0, FRAMES, camera)

    def run() -> PoseSequence:
        recording, model = RenderedRecording(synthetic), StereoToPose(camera)
        model.prepare(recording)
        return model.sequence(list(model(recording)))

    sequence, body = cached(motion, folder, run), BodyModel()
    angles = anatomical_angles(body, body(synthetic.pose, synthetic.size))
    return Angles(sequence, synthetic.joints, angles)


# The figures


def stereo_points(folder: Path) -> "Figure":
    """3.3: depth image, sampling on the grid, points in space."""
    from matplotlib.figure import Figure

    look = demonstration().looks[HANDS_UP]
    cloud, box = look.sight.cloud, box_around(look.sight.silhouette[0])
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    depth_axes, grid_axes = figure.add_subplot(1, 3, 1), figure.add_subplot(1, 3, 2)
    space = figure.add_subplot(1, 3, 3, projection="3d")
    depth = look.sight.depth[0].where(look.sight.silhouette[0], torch.nan)
    points = cloud.points[cloud.mask].cpu().numpy()
    low, high = np.quantile(points[:, 2], (0.01, 0.99))
    colours = {"cmap": "viridis_r", "vmin": low, "vmax": high}
    drawn = show(depth_axes, depth, **colours)
    frame_to(depth_axes, box)
    show(grid_axes, 1 - 0.2 * look.sight.silhouette[0].float(), cmap="gray", vmin=0, vmax=1)
    scatter(grid_axes, look, "tab:red", 4)
    frame_to(grid_axes, box)
    space.scatter(points[:, 0], points[:, 2], -points[:, 1], c=points[:, 2], s=5, linewidths=0, **colours)
    space.set_box_aspect(np.ptp(points[:, [0, 2, 1]], axis=0) + 0.05, zoom=0.85)
    space.view_init(elev=12, azim=-55)
    space.set_xlabel("x (m)")
    space.set_ylabel("z (m)")
    space.set_zlabel("-y (m)")
    space.tick_params(labelsize=7)
    space.locator_params(nbins=3)
    space.set_yticks(np.arange(np.floor(2 * low) / 2, high + 0.5, 0.5))
    figure.colorbar(drawn, ax=depth_axes, label="depth z (m)", shrink=0.8)
    depth_axes.set_title("(a) depth, from disparity", fontsize=10)
    grid_axes.set_title(f"(b) {len(points)} points on a grid", fontsize=10)
    space.set_title("(c) in space", fontsize=10)
    return figure


def label_factors(folder: Path) -> "Figure":
    """3.7: what the image says of face and torso; geodesic distances keep while straight ones change."""
    following = demonstration()
    figure, ((image_axes, *way_axes),) = new_figure(1, 3, 8.5, 4.4)
    dots = draw_appearance(image_axes, following, following.looks[HANDS_DOWN])
    figure.colorbar(dots, ax=image_axes, label="φ(torso)", shrink=0.8)
    image_axes.set_title("(a) face and torso", fontsize=10)
    for axes, frame in zip(way_axes, (HANDS_DOWN, HANDS_UP), strict=True):
        drawn = draw_geodesic(axes, following, following.looks[frame])
        axes.set_title("(b) " + ("hands down" if frame == HANDS_DOWN else "hands up"), fontsize=10)
    figure.colorbar(drawn, ax=way_axes, label="geodesic distance from the head (m)", shrink=0.8)
    return figure


def labelling(folder: Path) -> "Figure":
    """3.9: the model before, the labels that the first sweep starts from, and those of the last; by T.'s constants."""
    config = load_config("infer", ["registration=thesis"]).pose.registration
    figure, rows = new_figure(len(EXAMPLES), 3, 7.5, 3.6 * len(EXAMPLES))
    for number, (axes, motion) in enumerate(zip(rows, EXAMPLES, strict=True)):
        recording = rendered(motion, NOW + 1)
        following = follow_frames(recording, NOW + 1)
        look, start, model = following.looks[NOW], following.looks[BEFORE].pose, following.model
        cloud = look.sight.cloud
        registrar = Registrar(model.body, config)
        posed = model.body(start, model.size)
        foot = registrar.correspond(posed, look.observation)
        alone = look.observation.potential.mT - foot.square / (2 * config.sigma_first**2)
        term = geodesic_term(group_cells(cloud), geodesic_bounds(model.body, model.size), outlier=False)
        field = mean_field(alone, cloud.neighbours, cloud.mask, config.labelling, cloud.grid, term)
        first, last = (beliefs.argmax(1)[cloud.mask] for beliefs in (alone, field.belief))
        true = labels_at(recording.synthetic.frames(NOW, NOW + 1).labels[0], cloud.pixels[cloud.mask])
        scatter(axes[0], look, "0.75")
        draw_body(axes[0], following, start)
        for panel, labels in zip(axes[1:], (first, last), strict=True):
            scatter(panel, look, PALETTE[labels.cpu().numpy()])
            right = (labels == true)[true >= 0].float().mean()
            panel.set_xlabel(f"{100 * right:.0f} % of the points right", fontsize=9)
        for panel in axes:
            frame_to(panel, box_around(look.sight.silhouette[0]))
        axes[0].set_ylabel(f"({'ab'[number]})", rotation=0, labelpad=12)
    titles = ("initial model", "labels, first iteration", "labels, last iteration")
    for panel, title in zip(rows[0], titles, strict=True):
        panel.set_title(title, fontsize=10)
    return figure


def labels_at(labels: Int[Tensor, "height width"], pixels: Float[Tensor, "num 2"]) -> Int[Tensor, " num"]:
    """The true part of each point; -1 beside the person."""
    column, row = pixels.round().long().unbind(-1)
    return labels[row, column] - 1


@cache
def silhouettes() -> Float[Tensor, "frames rows columns"]:
    """Silhouettes of all activities by several people, one after another."""
    body, camera = BodyModel(), synthetic_camera(160, 120, 8.0)
    times, masks = torch.arange(MOMENTS) / camera.frame_rate, []
    for number in range(PEOPLE):
        person = draw_person(number)
        size, display = person.size(body), DisplayModel(body, person)
        for activity in ACTIVITIES:
            pose = perform(body, size, activity, times, camera, number)
            masks.append(cast_depth(display, body(pose, size), camera).mask > 0)
    return resize_silhouettes(torch.cat(masks), SilhouetteConfig(64, 48))


def principal_components(folder: Path) -> "Figure":
    """4.2: eight principal components of all activities' silhouettes."""
    return draw_components(pca(silhouettes().flatten(1), 8).components)


def independent_components(folder: Path) -> "Figure":
    """4.3: eight independent components of the same silhouettes, those of the greatest kurtosis."""
    mixtures = pca(silhouettes().flatten(1), COMPONENTS).components
    start = torch.randn(COMPONENTS, COMPONENTS, generator=torch.Generator().manual_seed(0))
    images = fast_ica(mixtures, start).unmixing @ mixtures
    images = images - images.mean(1, keepdim=True)
    peaked = images.pow(4).mean(1) / images.square().mean(1).square()
    return draw_components(images[peaked.topk(8).indices])


def seated(folder: Path) -> "Figure":
    """4.5: head and torso of a sitting person."""
    following = follow_frames(rendered("sitting", SEATED + 1), SEATED + 1)
    figure, ((axes,),) = new_figure(1, 1, 4.4, 5.0)
    figure.colorbar(draw_appearance(axes, following, following.looks[SEATED]), label="φ(torso)", shrink=0.8)
    return figure


def simulated_poses(folder: Path) -> "Figure":
    """5.1: simulated disparity (first and third rows) and recovered poses (second and fourth)."""
    take, sequence = arms(), angles_of_arms(folder).sequence
    assert sequence.pose is not None
    body, columns = BodyModel(), len(SHOWN) // 2
    size, display = take.size, DisplayModel(body, Person())
    box = box_around(torch.cat([take.sights[frame].silhouette for frame in SHOWN]).any(0))
    figure, rows = new_figure(4, columns, 2.3 * columns, 8.6)
    for number, frame in enumerate(SHOWN):
        sight, place = take.sights[frame], divmod(number, columns)
        above, below = rows[2 * place[0], place[1]], rows[2 * place[0] + 1, place[1]]
        disparity = CAMERA.disparity(sight.depth[0]).where(sight.silhouette[0], torch.nan)
        drawn = show(above, disparity, cmap="gray", vmin=23, vmax=31)
        above.set_facecolor("0.1")
        show(below, shaded(body, display, sequence.pose[frame : frame + 1], size))
        for axes in (above, below):
            frame_to(axes, box)
        below.set_xlabel(f"frame {frame}", fontsize=9)
    figure.colorbar(drawn, ax=rows, label="disparity (px)", shrink=0.4)
    return figure


def shaded(
    body: BodyModel,
    display: DisplayModel,
    pose: Float[Tensor, "1 parameters"],
    size: Float[Tensor, "1 sizes"],
) -> Float[Tensor, "3 height width"]:
    """A picture of a pose: super-quadrics in the colours of their labels, bright where they face the camera."""
    seen = cast_depth(display, body(pose.float(), size), CAMERA, Scene(wall=50.0))
    down, across = torch.gradient(seen.depth[0])
    slope = torch.stack([down, across]).norm(dim=0) * CAMERA.focal_length / seen.depth[0]
    bright = (1 / (1 + slope.square()).sqrt()).clamp_min(0.35)
    paint = torch.tensor(np.concatenate([[[1.0, 1.0, 1.0]], PALETTE])).float()[seen.labels[0]]
    return (paint * torch.where(seen.labels[0] > 0, bright, 1.0)[..., None]).permute(2, 0, 1)


def simulated_angles(folder: Path) -> "Figure":
    """5.2: estimated and true angles of the simulated sequence, two of the shoulders and two of the elbows."""
    angles = angles_of_arms(folder)
    panels = (
        ("(a) shoulder flexion", "shoulder_flexion"),
        ("(b) shoulder abduction", "shoulder_abduction"),
        ("(c) elbow flexion", "elbow_flexion"),
        ("(d) upper arm's rotation, seen at the elbow", "shoulder_rotation"),
    )
    figure, rows = new_figure(2, 2, 9, 5.4, sharex=True)
    for axes, (title, name) in zip(rows.ravel(), panels, strict=True):
        draw_sides(axes, angles.sequence.time_s, *angles.of(name))
        axes.set_title(title, fontsize=10)
    label_axes(rows)
    return figure


def elbow_angles(folder: Path) -> "Figure":
    """5.4: elbow flexion while the forearms move horizontally, and vertically."""
    figure, rows = new_figure(2, 1, 6.4, 5.2)
    for axes, way in zip(rows[:, 0], ("horizontal", "vertical"), strict=True):
        angles = angles_of(f"elbow_{way}", folder)
        draw_sides(axes, angles.sequence.time_s, *angles.of("elbow_flexion"))
        axes.set_title(f"({'ab'[way == 'vertical']}) elbow flexion, {way} movement", fontsize=10)
    label_axes(rows)
    return figure


def knee_and_shoulder_angles(folder: Path) -> "Figure":
    """5.7: the knees, and the whole arms to the image's vertical and horizontal."""
    figure, rows = new_figure(3, 1, 6.4, 7.4)
    knee, shoulder = angles_of("knee", folder), angles_of("shoulder", folder)
    draw_sides(rows[0, 0], knee.sequence.time_s, *knee.of("knee_flexion"))
    rows[0, 0].set_title("(a) knee flexion, the legs in turn", fontsize=10)
    for axes, (way, columns) in zip(
        rows[1:, 0], (("vertical", slice(0, 2)), ("horizontal", slice(2, 4))), strict=True
    ):
        draw_sides(axes, shoulder.sequence.time_s, *shoulder.measured(arm_axis_angles, columns))
        axes.set_title(f"(b) shoulders: from the image's {way} to the whole arm", fontsize=10)
    label_axes(rows)
    return figure


FIGURES: dict[str, Callable[[Path], "Figure"]] = {
    "3.3": stereo_points,
    "3.7": label_factors,
    "3.9": labelling,
    "4.2": principal_components,
    "4.3": independent_components,
    "4.5": seated,
    "5.1": simulated_poses,
    "5.2": simulated_angles,
    "5.4": elbow_angles,
    "5.7": knee_and_shoulder_angles,
}


@torch.no_grad()
def draw(number: str, output: Path = OUTPUT, folder: Path = CACHE) -> Path:
    """Draw a figure of the thesis by its number to a PNG, and return its path."""
    if number not in FIGURES:
        raise ValueError(f"the figure must be one of {', '.join(FIGURES)}, got {number!r}")
    torch.manual_seed(0)
    figure, path = FIGURES[number](folder), output / f"figure_{number.replace('.', '_')}.png"
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=100)
    with replacing(path) as partial:
        image, small = Image.open(drawn).convert("RGB"), io.BytesIO()
        image.save(small, "PNG", optimize=True)
        if len(small.getbuffer()) > LARGEST:  # fewer colours
            image = image.quantize(256, Image.Quantize.MAXCOVERAGE)
        image.save(partial, "PNG", optimize=True)
    return path


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.figures", description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=tuple(FIGURES), default=tuple(FIGURES), metavar="3.3")
    parser.add_argument("--output", type=Path, default=OUTPUT, help="folder of the figures")
    parser.add_argument(
        "--cache", type=Path, default=CACHE, help="folder of what the poses cost; may be deleted"
    )
    options = parser.parse_args(argv)
    for number in options.only:
        begin = time.perf_counter()
        path = draw(number, options.output, options.cache)
        print(
            f"{number}  {path}  {path.stat().st_size / 1000:.0f} kB, {time.perf_counter() - begin:.0f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
