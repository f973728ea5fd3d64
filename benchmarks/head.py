"""How well the head is found without a face, and the trunk: on recordings with truth and on drawn people.

python -m benchmarks.head ../shared/data/people [--every K] [--frames N]

Faces are never looked at. `found` is the share of frames with an answer, `mm` the mean distance of the head's centre
from the truth (on recordings the middle of `head` and `head_top`), `worst` the greatest, `within` the share of all
frames within 10 cm, `level` the root of the mean squared error in units of the
standard deviation that was given (1 is right, less is careful), `trunk_mm` the trunk's distance from the middle of
shoulders and hips, `ms` CPU milliseconds a frame.
The drawn people stand, stoop and sit with arms in six places, turned in eight directions, at 3 m, with a stereo
matcher's errors.
"""

import argparse
import itertools
import math
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.people import Truth
from torchpose.body.model import BodyModel
from torchpose.body.superquadric import DisplayModel
from torchpose.cli import load_config
from torchpose.eyes import Eyes
from torchpose.recording import open_recording
from torchpose.synthesis.depth import cast_depth, spoil
from torchpose.vision.camera import StereoCamera
from torchpose.vision.head import find_head
from torchpose.vision.points import PointCloud, sample_grid
from torchpose.vision.trunk import find_trunk

CAMERA = StereoCamera(640, 480, 480.0, 319.5, 239.5, 0.12)
COLUMNS = ("found", "mm", "worst", "within", "level", "trunk_mm", "ms")
# Left upper arm and forearm in the torso's frame (x to the left, y down, z back); the right side mirrors them.
ARMS = {
    "down": ((0.15, 1.0, 0.0), (0.05, 1.0, -0.1)),
    "up": ((0.25, -1.0, 0.0), (0.05, -1.0, 0.0)),
    "wide": ((1.0, 0.1, 0.0), (1.0, 0.0, 0.0)),
    "behind the head": ((0.9, -0.6, 0.1), (-0.8, -0.6, 0.2)),
    "before the face": ((0.2, 0.2, -1.0), (-0.2, -1.0, -0.2)),
    "one up": ((0.1, -1.0, 0.0), (0.05, -1.0, 0.0)),
}
LEGS = {"stands": ((0.08, 1.0, 0.0), (0.05, 1.0, 0.03)), "sits": ((0.2, 0.25, -1.0), (0.1, 1.0, 0.0))}
POSTURES = {
    "upright": ("stands", 0.0),
    "stoops": ("stands", 0.7),
    "bent low": ("stands", 1.3),
    "sits": ("sits", 0.1),
}


def figures(
    depth: Tensor, silhouette: Tensor, cloud: PointCloud, camera: StereoCamera, head: Tensor, trunk: Tensor
) -> dict[str, Tensor]:
    """Of each frame; `head` and `trunk` are the truth."""
    begin = time.process_time()
    middle = find_trunk(cloud.points, cloud.mask)
    found = find_head(depth, silhouette, middle.position, camera)
    error = (found.position - head).norm(dim=-1)
    return {
        "error": error,
        "level": error / found.sd / math.sqrt(3),
        "trunk": (middle.position - trunk).norm(dim=-1),
        "ms": torch.full_like(error, 1000 * (time.process_time() - begin)),
    }


def row(name: str, frames: Sequence[dict[str, Tensor]]) -> str:
    joined = {key: torch.cat([frame[key] for frame in frames]) for key in frames[0]}
    error = joined["error"]
    values = (
        float(error.isfinite().double().mean()),
        1000 * float(error.nanmean()),
        1000 * float(error.nan_to_num().max()),
        float((error < 0.1).double().mean()),
        float(joined["level"].square().nanmean().sqrt()),
        1000 * float(joined["trunk"].nanmean()),
        float(joined["ms"].mean()),
    )
    return f"{name:<28}" + " ".join(f"{value:>8.{2 if value < 10 else 0}f}" for value in values)


def recorded(folder: Path, every: int, limit: int | None) -> list[dict[str, Tensor]]:
    recording, truth = open_recording(folder), Truth(folder)
    eyes, device = Eyes(recording.camera, load_config("infer", []).eyes), torch.device("cpu")
    eyes.learn_background(recording.background(), recording, device)
    joints, rows = truth.all_joints, []
    head = 0.5 * (joints["head"] + joints["head_top"])
    middle = [joints[f"{name}_{side}"] for name in ("shoulder", "hip") for side in "LR"]
    trunk = torch.stack(middle).mean(0)
    for position in range(0, min(len(recording), limit or len(recording)), every):
        frame = recording[position]
        sight, at = eyes(frame, device), slice(frame.index, frame.index + 1)
        rows.append(
            figures(sight.depth, sight.silhouette, sight.cloud, recording.camera, head[at], trunk[at])
        )
    return rows


def drawn(posture: str, arms: str) -> list[dict[str, Tensor]]:
    body = BodyModel()
    display, size = DisplayModel(body), body.default_size(1)
    legs, lean = POSTURES[posture]
    upper = torch.tensor(ARMS[arms])
    other = torch.tensor(ARMS["down"] if arms == "one up" else ARMS[arms])
    mirror = torch.tensor([-1.0, 1.0, 1.0])
    head = torch.tensor([[0.0, -math.cos(0.1), -math.sin(0.1)]])
    lower = torch.tensor(LEGS[legs])
    # Legs go where they go, however the trunk leans.
    back = torch.tensor(
        [[1, 0, 0], [0, math.cos(lean), -math.sin(lean)], [0, math.sin(lean), math.cos(lean)]]
    )
    lower_parts = torch.cat([lower, lower * mirror]) @ back
    directions = torch.nn.functional.normalize(torch.cat([head, upper, other * mirror, lower_parts]), dim=-1)
    rows = []
    for k in range(8):
        root = torch.tensor([[2 * math.pi * k / 8, lean, 0.0]])
        posed = body(
            body.pose_from_directions(torch.tensor([[0.0, 0.15, 3.0]]), root, directions[None]), size
        )
        scene = cast_depth(display, posed, CAMERA)
        matched = spoil(scene.depth[0], scene.mask[0], CAMERA, torch.Generator().manual_seed(k))
        depth, silhouette = CAMERA.depth(matched.disparity)[None], matched.silhouette[None]
        joint = {name: posed.joints[:, i] for i, name in enumerate(body.joint_names)}
        middle = [joint[f"{name}_{side}"] for name in ("shoulder", "hip") for side in ("left", "right")]
        trunk = torch.stack(middle).mean(0)
        true_head = posed.centers[:, body.segment_names.index("head")]
        rows.append(
            figures(depth, silhouette, sample_grid(depth, silhouette, CAMERA), CAMERA, true_head, trunk)
        )
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.head",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "people", type=Path, nargs="?", help="folder of recordings, each with a truth/ folder"
    )
    parser.add_argument("--every", type=int, default=2, help="score every K-th frame")
    parser.add_argument("--frames", type=int, help="only the first frames of each recording")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    print(" " * 28 + " ".join(f"{name:>8}" for name in COLUMNS))
    folders = sorted(path.parent for path in options.people.glob("*/truth")) if options.people else []
    together: list[dict[str, Tensor]] = []
    for folder in folders:
        rows = recorded(folder, options.every, options.frames)
        together += rows
        print(row(folder.name, rows), flush=True)
    if folders:
        print(row("all recordings", together))
    together = []
    for posture, arms in itertools.product(POSTURES, ARMS):
        rows = drawn(posture, arms)
        together += rows
        print(row(f"{posture}, arms {arms}", rows), flush=True)
    print(row("all drawn", together))


if __name__ == "__main__":
    main()
