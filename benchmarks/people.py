"""Accuracy and speed of `infer.py` on recordings with true joints.

python -m benchmarks.people ../shared/data/people [--json FILE] [--oracle STAGE ...] [--frames N] [key=value ...]

Limb angles (degrees) and joints (mm) follow DESIGN.md's definitions on both sides; `within` is the share of
the twelve limb joints within 10 cm, `unanswered` the share of frames without a pose. Errors are over the
answered frames. Times are CPU milliseconds a frame on one thread. An oracle puts the truth in the place of one
stage, which tells what that stage costs: `disparity` the true depth, `mask` the true silhouette, `labels` the
true body parts, `start` the true pose before the first frame, `size` the true lengths of the limbs. Settings
are those of infer.py.
"""

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body.angle import limb_angles
from torchpose.body.model import BodyModel
from torchpose.cli import InferConfig, load_config
from torchpose.pipeline import Eyes, FramePose, Sight, SmoothingWindow, StereoToPose
from torchpose.recording import Frame, open_recording
from torchpose.registration.likelihood import Evidence, PartLikelihood
from torchpose.vision.points import sample_grid

ORACLES = ("disparity", "mask", "labels", "start", "size")
KINDS = ("elbow", "knee", "shoulder", "hip")
# Our limb joints, left before right, and the truth's names for them.
LIMB_JOINTS = [
    f"{joint}_{side}" for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for side in "LR"
]
# The truth's body parts as segments of ours; neck, chest and pelvis are its own.
SEGMENT_OF_PART = {"head": "head", "neck": "torso", "chest": "torso", "pelvis": "torso"} | {
    f"{part}_{side[0].upper()}": f"{part}_{side}"
    for part in ("upper_arm", "forearm", "hand", "thigh", "shank", "foot")
    for side in ("left", "right")
}


class Truth:
    """A recording's truth folder, read by benchmarks alone."""

    def __init__(self, recording: Path):
        self.folder = recording / "truth"
        data = np.load(self.folder / "truth.npz")
        names = list(data["joint_names"])
        joints = torch.from_numpy(data["joints_cam"]).float()
        self.all_joints = {name: joints[:, i] for i, name in enumerate(names)}
        self.joints = torch.stack([self.all_joints[name] for name in LIMB_JOINTS], 1)  # (T, 12, 3)
        self.parts: list[str] = json.loads((self.folder / "meta.json").read_text())["parts"]

    def depth(self, index: int) -> Float[Tensor, "1 height width"]:
        """True depth, m; NaN where there is none."""
        depth = torch.from_numpy(self._image(index, "depth").astype(np.float32) / 1000)[None]
        return torch.where(depth > 0, depth, torch.nan)

    def labels(self, index: int) -> np.ndarray:
        """Index of the body part at each pixel, 0 = background."""
        return self._image(index, "label")

    def _image(self, index: int, kind: str) -> np.ndarray:
        path = self.folder / f"{index:06d}_{kind}.png"
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise ValueError(f"the oracle needs {path}")
        return image


class OracleEyes(Eyes):
    """Eyes of which some findings are replaced by the truth."""

    def __init__(self, eyes: Eyes, truth: Truth, oracles: Sequence[str]):
        super().__init__(eyes.camera, eyes.config)
        self.truth, self.oracles, self.stopwatch = truth, oracles, eyes.stopwatch

    def forward(self, frame: Frame, device: torch.device) -> Sight:
        sight = super().forward(frame, device)
        true_mask = torch.from_numpy(self.truth.labels(frame.index) > 0)[None]
        depth = self.truth.depth(frame.index) if "disparity" in self.oracles else sight.depth
        mask = true_mask if "mask" in self.oracles else sight.silhouette
        cloud = sample_grid(
            depth,
            mask & true_mask if "disparity" in self.oracles else mask,
            self.camera,
            self.config.sampling,
        )
        return replace(
            sight,
            depth=depth,
            silhouette=mask,
            cloud=cloud,
            present=bool(cloud.mask.sum() >= self.config.min_points),
        )


class TrueLabels(PartLikelihood):
    """A perfect part detector: the frame's true label image as log-odds. `index` names the frame."""

    def __init__(self, segment_names: Sequence[str], truth: Truth, certainty: float = 8.0):
        super().__init__(segment_names)
        self.truth, self.certainty, self.index = truth, certainty, 0
        table = [
            self.segment_names.index(SEGMENT_OF_PART[p]) if p in SEGMENT_OF_PART else -1 for p in truth.parts
        ]
        self.segment_of_part = torch.tensor(table)

    def forward(self, evidence: Evidence) -> Float[Tensor, "batch num parts"]:
        labels = torch.from_numpy(self.truth.labels(self.index).astype(np.int64))
        u, v = evidence.cloud.pixels[0].round().long().unbind(-1)
        part = self.segment_of_part[labels[v, u]]
        known = torch.nn.functional.one_hot(part.clamp_min(0), len(self.segment_names)) * (part >= 0)[:, None]
        return self.certainty * known[None].to(evidence.cloud.points)


def true_pose(body: BodyModel, truth: Truth, index: int) -> Float[Tensor, "1 parameters"]:
    """The pose whose limbs point as the true ones do."""
    at = {name: joints[index] for name, joints in truth.all_joints.items()}
    hips, shoulders = (at[f"{joint}_L"] + at[f"{joint}_R"] for joint in ("hip", "shoulder"))
    y = torch.nn.functional.normalize(hips - shoulders, dim=0)
    x = at["hip_L"] - at["hip_R"] + at["shoulder_L"] - at["shoulder_R"]
    x = torch.nn.functional.normalize(x - (x @ y) * y, dim=0)
    R = torch.stack([x, y, torch.linalg.cross(x, y)], 1)
    angles = torch.stack([torch.atan2(R[0, 2], R[2, 2]), torch.asin(-R[1, 2]), torch.atan2(R[1, 0], R[1, 1])])
    bones = [("neck", "head_top")] + [
        (f"{a}_{s}", f"{b}_{s}")
        for a1, b1, c1 in (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"))
        for s in "LR"
        for a, b in ((a1, b1), (b1, c1))
    ]
    directions = torch.stack([torch.nn.functional.normalize(at[b] - at[a], dim=0) for a, b in bones]) @ R
    return body.pose_from_directions(hips[None] / 2, angles[None], directions[None])


def true_size(body: BodyModel, truth: Truth) -> Float[Tensor, "1 sizes"]:
    """Sizes with the true lengths of the limbs and widths; girths and the head by the body file."""
    at = {name: joints[0] for name, joints in truth.all_joints.items()}
    posed = body(torch.zeros(1, body.num_parameters))
    ours = dict(zip(LIMB_JOINTS, posed.joints[0, 3:], strict=True))
    size = body.default_size(1)
    pairs = {
        "trunk": None,
        "shoulder_width": ("shoulder_L", "shoulder_R"),
        "hip_width": ("hip_L", "hip_R"),
        "upper_arm": ("shoulder_L", "elbow_L"),
        "forearm": ("elbow_L", "wrist_L"),
        "thigh": ("hip_L", "knee_L"),
        "shank": ("knee_L", "ankle_L"),
    }
    for name, pair in pairs.items():
        if pair is None:
            true, own = (
                ((j["shoulder_L"] + j["shoulder_R"]) / 2 - (j["hip_L"] + j["hip_R"]) / 2).norm()
                for j in (at, ours)
            )
        else:
            true, own = ((j[pair[0]] - j[pair[1]]).norm() for j in (at, ours))
        size[0, body.size_names.index(name)] = true / own
    return size


def measure(
    folder: Path, config: InferConfig, oracles: Sequence[str], frames: int | None
) -> dict[str, float]:
    """Figures of one recording."""
    recording, truth = open_recording(folder), Truth(folder)
    model = StereoToPose(recording.camera, config.eyes, config.pose)
    labels = TrueLabels(model.body.segment_names, truth)
    if set(oracles) & {"disparity", "mask"}:
        model.eyes = OracleEyes(model.eyes, truth, oracles)
    if "labels" in oracles:
        model.likelihoods.append(labels)
    begin = time.process_time()
    model.prepare(recording)
    prepared = time.process_time() - begin
    model.stopwatch.seconds.clear()
    if "size" in oracles:
        model.size = true_size(model.body, truth)
    results: list[FramePose] = []
    window = SmoothingWindow(model)
    begin = time.process_time()
    for position in range(min(len(recording), frames or len(recording))):
        frame = recording[position]
        labels.index = frame.index
        if "start" in oracles and position == 0:
            model.tracker.begin(true_pose(model.body, truth, frame.index), frame.time_s)
        results += window.push(model.follow(frame))
    results += window.flush()
    total = time.process_time() - begin
    sequence = model.sequence(results)
    index = sequence.frame
    answered = sequence.joints.isfinite().flatten(1).all(1)
    ours, true = sequence.joints[answered], truth.joints[index][answered]
    gap = (ours[:, 3:] - true).norm(dim=-1)
    # limb_angles reads the twelve limb joints alone; the first three stand in for none of them.
    error = (
        (limb_angles(ours) - limb_angles(torch.cat([torch.zeros_like(true[:, :3]), true], 1))).abs().rad2deg()
    )
    figures = {f"{kind}_deg": float(error[:, 2 * i : 2 * i + 2].mean()) for i, kind in enumerate(KINDS)}
    figures |= {
        "angle_deg": float(error.mean()),
        "joint_mm": float(1000 * gap.mean()),
        "within": float((gap < 0.1).float().mean()),
        "unanswered": float((~answered).float().mean()),
        "point_to_model_mm": float(1000 * sequence.point_to_model.nanmean()),
        "prepare_ms": 1000 * prepared,
    }
    count = len(results)
    figures |= {f"{stage}_ms": 1000 * seconds / count for stage, seconds in model.stopwatch.seconds.items()}
    return figures | {"frame_ms": 1000 * (total + prepared) / count}


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.people", description=__doc__.split("\n")[0])
    parser.add_argument("people", type=Path, help="folder of recordings, each with a truth/ folder")
    parser.add_argument("settings", nargs="*", help="settings of infer.py, key=value")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    parser.add_argument(
        "--oracle", nargs="+", choices=ORACLES, default=[], help="stages that the truth replaces"
    )
    parser.add_argument("--frames", type=int, help="only the first frames of each recording")
    parser.add_argument("--only", help="only recordings whose name contains this")
    arguments = parser.parse_intermixed_args(argv)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    config = load_config("infer", arguments.settings)
    folders = sorted(path.parent for path in arguments.people.glob("*/truth"))
    folders = [folder for folder in folders if not arguments.only or arguments.only in folder.name]
    if not folders:
        parser.error(f"{arguments.people} must hold recordings with a truth/ folder, got none")
    table = {}
    for folder in folders:
        torch.manual_seed(config.seed)
        table[folder.name] = measure(folder, config, arguments.oracle, arguments.frames)
        if len(table) == 1:
            print(_row("recording", {name: name for name in table[folder.name]}))
        print(_row(folder.name, table[folder.name]), flush=True)
    stages = list(dict.fromkeys(name for figures in table.values() for name in figures))
    table["overall"] = {
        name: float(np.nanmean([row.get(name, np.nan) for row in table.values()])) for name in stages
    }
    print(_row("overall", table["overall"]))
    if arguments.json:
        arguments.json.write_text(
            json.dumps({"settings": arguments.settings, "oracle": arguments.oracle, "table": table})
        )


def _row(name: str, figures: dict) -> str:
    cells = []
    for column, value in figures.items():
        width = max(7, len(column) - 3)
        text = (
            column.removesuffix("_deg").removesuffix("_ms")
            if isinstance(value, str)
            else f"{value:.{_digits(column)}f}"
        )
        cells.append(f"{text:>{width}}")
    return f"{name:<22}" + " ".join(cells)


def _digits(column: str) -> int:
    return 3 if column in ("within", "unanswered") else 1 if column.endswith(("_deg", "_mm")) else 0


if __name__ == "__main__":
    main()
