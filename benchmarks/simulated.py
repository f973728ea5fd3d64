"""Accuracy of the fit on simulated disparity: section 5.1 of the thesis, and the motions of its Tables 5.1 and 5.2.

python -m benchmarks.simulated [--draws N] [--frames N] [--only MOTION] [--oracle LIST] [--json FILE] [key=value ...]

People of super-quadrics (not the ellipsoids that are fitted), each recording with a person of its own, lengths and
girths about +-10 %, stand 3 to 4 m (further, where raised hands would leave the image) before a camera of 640 x 480,
f 800 px, 0.12 m, 20 Hz. Their disparity gets the errors of `torchpose.synthesis.depth.MatcherNoise`, their silhouette a
ragged rim; a face is found where it is seen. No images and no matching: the eyes are replaced, and everything behind
them is infer.py's, with its settings. Nothing of the truth reaches the fit: size and start are found.

Limb angles are DESIGN.md's, of our joints and the true ones. `failed` counts answered frames with a limb more than 30
degrees off in direction or a limb joint more than 200 mm off, `unanswered` frames without a pose; `within` is the share
of the twelve limb joints within 10 cm, `covered` the share of the anatomical angles within two of their standard
deviations of the true body's. Errors are over the answered frames; `registration` is in CPU ms a frame on one thread.

`--oracle` says what an error costs: `size` gives the true lengths and girths, `start` the true pose as every frame's
start, `shape` draws the very ellipsoids that are fitted. They may be joined: `--oracle size,shape`.
"""

import argparse
import json
import math
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body.angle import LIMB_ANGLE_NAMES, anatomical_angles, limb_angles
from torchpose.body.model import BodyModel, PosedBody
from torchpose.body.superquadric import DisplayModel, Person
from torchpose.cli import InferConfig, load_config
from torchpose.export import PoseSequence
from torchpose.eyes import Eyes, EyesConfig, Sight
from torchpose.geometry import angle_between
from torchpose.pipeline import SmoothingWindow, StereoToPose
from torchpose.recording import Frame, spread_positions
from torchpose.synthesis.depth import DepthFrames, MatchedFrame, MatcherNoise, Scene, cast_depth, spoil
from torchpose.synthesis.motion import MotionConfig, lowest, perform, random_stream
from torchpose.vision.camera import StereoCamera
from torchpose.vision.faces import Faces
from torchpose.vision.points import SamplingConfig, sample_grid

CAMERA = StereoCamera(640, 480, 800.0, 318.5, 241.5, baseline=0.12, frame_rate=20.0)
# Frames of each motion; `arms` is 5.1 of the thesis, then come Table 5.1, Table 5.2 and what else people do.
MOTIONS = {"arms": 110} | dict.fromkeys(
    (
        *("elbow_horizontal", "elbow_vertical", "knee", "shoulder", "walking", "free"),
        *("boxing", "both_hands", "sitting", "turning"),
    ),
    60,
)
ORACLES = ("size", "start", "shape")
KINDS = ("elbow", "knee", "shoulder", "hip")
# Limbs by the contract's joints: upper arms, forearms, thighs, shanks.
LIMBS = ((5, 3), (6, 4), (7, 5), (8, 6), (11, 9), (12, 10), (13, 11), (14, 12))
# Table 5.1 of the thesis, degrees, left and right: motion, our figure, theirs.
TABLE = (
    ("elbow_horizontal", "elbow", (8.21, 7.58)),
    ("elbow_vertical", "elbow", (6.79, 7.64)),
    ("knee", "knee", (8.03, 13.81)),
    ("shoulder", "arm_x", (5.66, 5.72)),
    ("shoulder", "arm_z", (9.08, 9.97)),
)
SAMPLING, NOISE = SamplingConfig(), MatcherNoise()
NEAR, FAR = 3.0, 4.0  # m
FACE = (0.0, -0.125, -0.105)  # m, the face's middle in the head's frame at size 1
FACE_WIDTH = 0.165  # m, of a face detector's box


@dataclass(frozen=True)
class Take:
    """One simulated recording: what the eyes make of it, and the truth."""

    motion: str
    sights: tuple[Sight, ...]
    size: Float[Tensor, "1 sizes"]
    pose: Float[Tensor, "time parameters"]
    joints: Float[Tensor, "time 15 3"]  # m
    angles: Float[Tensor, "time 21"]  # rad, anatomical

    def frame(self, index: int) -> Frame:
        """The frame as a tracker is asked for it; there are no images."""
        return Frame(index, index / CAMERA.frame_rate)


class SimulatedEyes(Eyes):
    """Eyes that have seen a take already."""

    def __init__(self, take: Take, config: EyesConfig):
        super().__init__(CAMERA, config)
        self.take = take

    def forward(self, frame: Frame, device: torch.device) -> Sight:
        return self.take.sights[frame.index]


def draw_shape(generator: torch.Generator, body: BodyModel) -> Person:
    """A person whose lengths and girths depart from the body file's by about 10 %."""
    girths = len(body.size_names) - body.num_lengths
    height, *factors = torch.rand(1 + len(body.size_names), generator=generator).tolist()
    return Person(
        height=1.60 + 0.30 * height,
        lengths=tuple(0.93 + 0.14 * factor for factor in factors[girths:]),
        girths=tuple(0.90 + 0.20 * factor for factor in factors[:girths]),
    )


def place(
    body: BodyModel,
    pose: Float[Tensor, "time parameters"],
    size: Float[Tensor, "1 sizes"],
    generator: torch.Generator,
) -> Float[Tensor, "time parameters"]:
    """The performance moved, as a whole, to where the camera sees all of it: 3 to 4 m away, or as far as need be."""
    posed = body(pose, size)
    # The box about each ellipsoid; super-quadrics reach a little further.
    half = (posed.frames * posed.radii[:, :, None]).norm(dim=-1) + 0.03
    low, high = posed.centers - half, posed.centers + half
    middle = (low.amin((0, 1)) + high.amax((0, 1)))[:2] / 2
    reach = torch.maximum(high[..., :2] - middle, middle - low[..., :2])
    edge = torch.tensor([CAMERA.width / 2, CAMERA.height / 2]) - 4  # px, from the image's middle
    aside, share = torch.rand(2, generator=generator).tolist()
    fits = (reach * CAMERA.focal_length / edge - low[..., 2:]).amax()
    distance = max(NEAR + (FAR - NEAR) * share, float(fits))
    spare = (edge * (distance + low[..., 2:]) / CAMERA.focal_length - reach)[..., 0].amin().clamp(0, 0.15)
    # The principal point is not the image's middle.
    off = torch.tensor([(CAMERA.width - 1) / 2 - CAMERA.cx, (CAMERA.height - 1) / 2 - CAMERA.cy])
    goal = off * distance / CAMERA.focal_length - middle
    shift = torch.stack([goal[0] + (2 * aside - 1) * spare, goal[1], torch.tensor(distance)])
    return torch.cat([pose[:, :3] + shift, pose[:, 3:]], 1)


@torch.no_grad()
def cast_ellipsoids(posed: PosedBody, camera: StereoCamera, scene: Scene) -> DepthFrames:
    """`cast_depth` of the ellipsoids that are fitted, in place of super-quadrics: a body without errors of shape."""
    v, u = (torch.arange(n).to(posed.origins) for n in (camera.height, camera.width))
    below = ((v - camera.cy) / camera.focal_length).clamp_min(scene.floor / scene.wall / 2)
    empty = (scene.floor / below).clamp_max(scene.wall)[:, None].expand(-1, camera.width)
    depth = empty.repeat(len(posed.origins), 1, 1)
    labels = torch.zeros_like(depth, dtype=torch.long)
    ray = camera.back_project(torch.cartesian_prod(v, u).flip(-1), torch.ones(len(v) * len(u)).to(v)).mT
    for i in range(len(depth)):
        for part in range(posed.radii.shape[1]):
            # In units of the half axes a ray meets the unit sphere where a t^2 - 2 b t + c = 0.
            to_unit = (posed.frames[i, part] / posed.radii[i, part]).mT
            way, center = to_unit @ ray, to_unit @ posed.centers[i, part]
            a, b, c = way.square().sum(0), center @ way, center.square().sum() - 1
            reach = ((b - (b.square() - a * c).sqrt()) / a).view_as(depth[i])  # NaN where it misses
            seen = reach < depth[i]
            depth[i], labels[i] = reach.where(seen, depth[i]), labels[i].masked_fill(seen, part + 1)
    return DepthFrames(depth, labels, (labels > 0).long())


@torch.no_grad()
def simulate(
    motion: str,
    draw: int = 0,
    frames: int | None = None,
    sampling: SamplingConfig = SAMPLING,
    noise: MatcherNoise = NOISE,
    true_shape: bool = False,
) -> Take:
    """A take of a motion by a new person, seen with errors. `draw` decides all, `frames` None is the motion's own.

    With `true_shape` the ellipsoids that are fitted are drawn in place of super-quadrics. Raises ValueError for an
    unknown motion or no frames.
    """
    if motion not in MOTIONS:
        raise ValueError(f"the motion must be one of {', '.join(MOTIONS)}, got {motion!r}")
    frames = MOTIONS[motion] if frames is None else frames
    if frames < 1:
        raise ValueError(f"a take must have at least one frame, got {frames}")
    body = BodyModel()
    generator = random_stream("simulated", motion, draw)
    person = draw_shape(generator, body)
    size = person.size(body)
    times = torch.arange(frames) / CAMERA.frame_rate
    seed = int(torch.randint(2**31, (), generator=generator))
    pose = perform(body, size, motion, times, CAMERA, seed, draw, MotionConfig())
    start = torch.cat([pose[:, :3] - pose[:1, :3], pose[:, 3:]], 1)
    pose = place(body, start, size, generator)
    posed = body(pose, size)
    scene = Scene(float(lowest(body, posed).amax()), float(pose[:, 2].amax()) + 1.5)
    display = DisplayModel(body, person)
    exact = cast_ellipsoids(posed, CAMERA, scene) if true_shape else cast_depth(display, posed, CAMERA, scene)
    matched = [spoil(exact.depth[i], exact.mask[i], CAMERA, generator, noise) for i in range(frames)]
    seen = face_boxes(body, display, posed, exact.depth, generator)
    sights = [look(one, box, sampling) for one, box in zip(matched, seen, strict=True)]
    return Take(motion, tuple(sights), size, pose, posed.joints, anatomical_angles(body, posed))


def face_boxes(
    body: BodyModel,
    display: DisplayModel,
    posed: PosedBody,
    depth: Float[Tensor, "batch height width"],
    generator: torch.Generator,
) -> Float[Tensor, "batch 4"]:
    """Boxes (px) that a detector would give; NaN where the face is turned away by more than 65 degrees or hidden.

    The box's middle is off by 2 px, its width by 5 %, standard deviations.
    """
    head = body.body_names.index("head")
    rotation, scale = posed.rotations[:, head], display.head_scale
    face = posed.origins[:, head] + rotation @ (display.head_scale.new_tensor(FACE) * scale)
    toward = torch.nn.functional.normalize(-face, dim=-1)
    faces_us = -(rotation[:, :, 2] * toward).sum(-1) > math.cos(math.radians(65.0))
    pixel = CAMERA.project(face)
    u, v = pixel.round().long().unbind(-1)
    seen = depth[torch.arange(len(depth)), v.clamp(0, CAMERA.height - 1), u.clamp(0, CAMERA.width - 1)]
    bare = (
        seen - face[:, 2]
    ).abs() < 0.06  # the nose and the cheeks' roundness are less, an arm before it is more
    off = torch.randn(len(face), 3, generator=generator).to(face)
    middle = pixel + 2.0 * off[:, :2]
    half = 0.5 * FACE_WIDTH * CAMERA.focal_length / face[:, 2] * (1 + 0.05 * off[:, 2])
    box = torch.cat([middle - half[:, None], middle + half[:, None]], 1)
    return torch.where((faces_us & bare)[:, None], box, torch.nan)


def look(matched: MatchedFrame, box: Float[Tensor, "4"], sampling: SamplingConfig) -> Sight:
    """The sight of a matched frame whose face has been found at `box` (NaN: not)."""
    depth, silhouette = CAMERA.depth(matched.disparity)[None], matched.silhouette[None]
    v = torch.arange(CAMERA.height).to(depth)[:, None]
    u = torch.arange(CAMERA.width).to(depth)
    middle, half = (box[:2] + box[2:]) / 2, (box[2:] - box[:2]) / 2
    oval = ((u - middle[0]) / half[0]) ** 2 + ((v - middle[1]) / half[1]) ** 2 <= 1  # False where NaN
    mask = oval & silhouette
    position = CAMERA.back_project(middle, depth[mask].nanmedian())[None]
    faces = Faces(box[None], position.isfinite().all(1), mask, position)
    cloud = sample_grid(depth, silhouette, CAMERA, sampling)
    blank = depth.new_zeros(1, 1, 1, 1).expand(1, 3, *depth.shape[1:])
    edge = torch.cat([silhouette[0, [0, -1]].flatten(), silhouette[0, :, [0, -1]].flatten()])
    return Sight(blank, depth, silhouette, cloud, faces, bool(cloud.mask.any()), bool(edge.any()), False)


def follow(
    take: Take, config: InferConfig, oracle: Collection[str] = ()
) -> tuple[PoseSequence, dict[str, float]]:
    """The product's poses for a take, and CPU seconds by stage. `oracle` may give it the true `size` and `start`."""
    model = StereoToPose(CAMERA, config.eyes, config.pose)
    model.eyes = SimulatedEyes(take, config.eyes)
    begin = time.process_time()
    spread = spread_positions(len(take.sights), config.pose.size_frames)
    model.size = take.size if "size" in oracle else model.measure_size([take.sights[i] for i in spread])
    seconds = {"size": time.process_time() - begin}
    window, poses = SmoothingWindow(model), []
    for i in range(len(take.sights)):
        frame = take.frame(i)
        if "start" in oracle:
            model.tracker.begin(take.pose[i : i + 1], frame.time_s)
        poses += window.push(model.follow(frame))
    poses += window.flush()
    return model.sequence(poses), seconds | dict(model.stopwatch.seconds)


def arm_axis_angles(joints: Float[Tensor, "*batch 15 3"]) -> Float[Tensor, "*batch 4"]:
    """Angles of the whole arms, shoulder to wrist, to the vertical and the horizontal of the image (T. Table 5.1).

    The thesis calls the vertical x and the horizontal z; left and right arm to x, then to z.
    """
    arm = joints[..., 7:9, :] - joints[..., 3:5, :]
    down, across = (arm.new_tensor(axis).expand_as(arm) for axis in ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0)))
    return torch.cat([angle_between(arm, down), angle_between(arm, across)], -1)


def failures(
    joints: Float[Tensor, "time 15 3"], truth: Float[Tensor, "time 15 3"]
) -> tuple[Float[Tensor, "time 9"], Float[Tensor, "time 12"]]:
    """How far the limbs are off in direction (rad; the last is the trunk), and the limb joints in place (m)."""

    def directions(at: Tensor) -> Tensor:
        ends, starts = (at[:, list(column)] for column in zip(*LIMBS, strict=True))
        trunk = at[:, 9:11].mean(1, keepdim=True) - at[:, 3:5].mean(1, keepdim=True)
        return torch.cat([ends - starts, trunk], 1)

    return angle_between(directions(joints), directions(truth)), (joints - truth)[:, 3:].norm(dim=-1)


def score(take: Take, sequence: PoseSequence) -> dict[str, float]:
    """The figures of a take; NaN for errors where no frame was answered."""
    answered = sequence.joints.isfinite().flatten(1).all(1)
    ours, true = sequence.joints[answered], take.joints[answered]
    error = (limb_angles(ours) - limb_angles(true)).abs().rad2deg()
    turned, gap = failures(ours, true)
    failed = (turned > math.radians(30)).any(1) | (gap > 0.2).any(1)
    off = sequence.angles[answered] - take.angles[answered]
    off = torch.atan2(off.sin(), off.cos()).abs()
    covered = off <= 2 * sequence.angle_sd[answered]
    arms = (arm_axis_angles(ours) - arm_axis_angles(true)).abs().rad2deg()
    figures = {f"{kind}_deg": error[:, 2 * i : 2 * i + 2].mean() for i, kind in enumerate(KINDS)}
    figures |= {
        "angle_deg": error.mean(),
        "joint_mm": 1000 * gap.mean(),
        "within": (gap < 0.1).float().mean(),
        "failed": failed.sum(),
        "unanswered": (~answered).sum(),
        "point_to_model_mm": 1000 * sequence.point_to_model[answered].mean(),
        "covered": covered.float().mean(),
    }
    sides = dict(zip(LIMB_ANGLE_NAMES, error.mean(0), strict=True))
    names = ("arm_x_left", "arm_x_right", "arm_z_left", "arm_z_right")
    figures |= {f"{name.removesuffix('_limb')}_deg": value for name, value in sides.items()}
    figures |= {f"{name}_deg": value for name, value in zip(names, arms.mean(0), strict=True)}
    return {name: float(value) for name, value in figures.items()}


def measure(
    motion: str, draw: int, frames: int | None, config: InferConfig, oracle: Collection[str] = ()
) -> dict[str, float]:
    """Figures of one simulated recording."""
    take = simulate(motion, draw, frames, config.eyes.sampling, true_shape="shape" in oracle)
    torch.manual_seed(config.seed)
    sequence, seconds = follow(take, config, oracle)
    times = {"registration_ms": 1000 * seconds["registration"] / len(take.sights)}
    return score(take, sequence) | times | {"size_ms": 1000 * seconds["size"]}


COLUMNS = {
    **{f"{kind}_deg": kind for kind in KINDS},
    "angle_deg": "angle",
    "joint_mm": "joint_mm",
    "within": "within",
    "failed": "failed",
    "unanswered": "unanswered",
    "point_to_model_mm": "to_model",
    "covered": "covered",
    "registration_ms": "fit_ms",
    "size_ms": "size_ms",
}


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.simulated", description=__doc__.split("\n")[0]
    )
    parser.add_argument("settings", nargs="*", help="settings of infer.py, key=value")
    parser.add_argument(
        "--draws", type=int, default=2, help="recordings of each motion, each of a new person"
    )
    parser.add_argument(
        "--frames", type=int, help="of each recording, instead of 110 for arms and 60 for others"
    )
    parser.add_argument("--only", help=f"only motions whose name contains this: {', '.join(MOTIONS)}")
    parser.add_argument(
        "--oracle", default="", help=f"what is given: some of {', '.join(ORACLES)}, with commas"
    )
    parser.add_argument("--json", type=Path, help="also write the figures, draw by draw, to this file")
    arguments = parser.parse_intermixed_args(argv)
    torch.set_num_threads(1)
    config = load_config("infer", arguments.settings)
    motions = [motion for motion in MOTIONS if not arguments.only or arguments.only in motion]
    if not motions:
        parser.error(f"--only must be part of one of {', '.join(MOTIONS)}, got {arguments.only!r}")
    if arguments.draws < 1 or (arguments.frames is not None and arguments.frames < 1):
        parser.error(f"--draws and --frames must be at least 1, got {arguments.draws} and {arguments.frames}")
    oracle = [name for name in arguments.oracle.split(",") if name]
    if unknown := set(oracle) - set(ORACLES):
        parser.error(f"--oracle takes some of {', '.join(ORACLES)}, got {', '.join(sorted(unknown))}")
    print(f"{'motion':<18}" + " ".join(f"{name:>{max(7, len(name))}}" for name in COLUMNS.values()))
    takes: list[dict] = []
    for motion in motions:
        rows = [measure(motion, draw, arguments.frames, config, oracle) for draw in range(arguments.draws)]
        takes += [{"motion": motion, "draw": draw, **row} for draw, row in enumerate(rows)]
        print(_line(motion, overall(rows)), flush=True)
    if len(motions) > 1:
        print(_line("overall", overall(takes)))
    for motion, name, theirs in TABLE:
        if motion in motions:
            means = overall([row for row in takes if row["motion"] == motion])
            ours = [means[f"{name}_{side}_deg"] for side in ("left", "right")]
            print(
                f"Table 5.1, {motion} {name}: left {ours[0]:.1f}, right {ours[1]:.1f}; "
                f"the thesis, on real recordings: {theirs[0]}, {theirs[1]} degrees"
            )
    if arguments.json:
        content = {"settings": arguments.settings, "takes": takes, "overall": overall(takes)}
        arguments.json.write_text(json.dumps(content))


def overall(rows: Sequence[dict]) -> dict[str, float]:
    """Means over recordings; failed and unanswered frames are counted."""
    names = [name for name in rows[0] if name not in ("motion", "draw")]
    counts = ("failed", "unanswered")
    return {
        name: float((np.nansum if name in counts else np.nanmean)([row[name] for row in rows]))
        for name in names
    }


def _line(name: str, figures: dict[str, float]) -> str:
    digits = {"within": 3, "covered": 3, "failed": 0, "unanswered": 0, "registration_ms": 0, "size_ms": 0}
    cells = [
        f"{figures[column]:>{max(7, len(title))}.{digits.get(column, 1)}f}"
        for column, title in COLUMNS.items()
    ]
    return f"{name:<18}" + " ".join(cells)


if __name__ == "__main__":
    main()
