"""Accuracy and speed of `infer.py` on recordings with true joints.

python -m benchmarks.people ../shared/data/people [--json FILE] [--oracle STAGE ...] [--settings thesis] [--ablate]
    [--frames N] [--only NAME] [key=value ...]

Limb angles (degrees) and joints (mm) follow DESIGN.md's definitions on both sides; `within` is the share of
the twelve limb joints within 10 cm, `covered` the share of the limbs' anatomical angles whose truth lies within two of
our standard deviations, `unanswered` the share of frames without a pose. Errors are over the
answered frames. Times are CPU milliseconds a frame on one thread. An oracle puts the truth in the place of one
stage, which tells what that stage costs: `disparity` the true depth, `mask` the true silhouette, `labels` the
true body parts, `start` the true pose before the first frame, `size` the true lengths of the limbs. `--ablate` runs
the registration with each term switched off, and the thesis's with each correction alone; frames are looked at
once. Settings are those of infer.py.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body.angle import anatomical_angles, limb_angles
from torchpose.body.model import BodyModel
from torchpose.cli import InferConfig, load_config
from torchpose.eyes import Eyes, View
from torchpose.people import People
from torchpose.pipeline import FramePose, StereoToPose
from torchpose.recording import Backgrounds, Frame, Recording, open_recording
from torchpose.registration.likelihood import Evidence, PartLikelihood
from torchpose.window import PeopleWindows

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


_THESIS = "registration=thesis"
_R, _T = "pose.registration", "pose.tracking"
# Settings beside the default: the thesis, each correction alone added to it, and each term of ours switched off.
ABLATIONS: dict[str, tuple[str, ...]] = {
    "as it is": (),
    "the thesis as written": (_THESIS,),
    "thesis, no Potts and geodesic": (_THESIS, f"{_R}.labelling.potts=0", f"{_R}.labelling.geodesic=0"),
    "thesis, sigma 0.10 to 0.03 m": (_THESIS, f"{_R}.sigma_first=0.1", f"{_R}.sigma_last=0.03"),
    "  that, no geodesic": (
        _THESIS,
        f"{_R}.sigma_first=0.1",
        f"{_R}.sigma_last=0.03",
        f"{_R}.labelling.geodesic=0",
    ),
    "thesis + visible side": (_THESIS, f"{_R}.visible=true"),
    "thesis + robust, no part": (_THESIS, f"{_R}.robust_sd=0.05", f"{_R}.outlier=3"),
    "thesis + silhouette": (_THESIS, f"{_R}.rim.weight=1"),
    "thesis + swings": (_THESIS, "pose.body.joint=swing"),
    "thesis + swings, hinged elbows, knees": (_THESIS, "pose.body.joint=anatomical"),
    "thesis + sizes": (_THESIS, "pose.size.rounds=5"),
    "thesis + colours": (_THESIS, "pose.colour.strength=1"),
    "thesis + chain of frames": (_THESIS, "pose.smoothing.rounds=3"),
    "all but colours": ("pose.colour.strength=0",),
    "all but the chain of frames": ("pose.smoothing.rounds=0",),
    "all but limb search": (f"{_T}.look_around=1e6", f"{_T}.stray_share=1", "pose.start.refreshes=0"),
    "all but sizes": ("pose.size.rounds=0",),
    "all but visible side": (f"{_R}.visible=false",),
    "all but silhouette": (f"{_R}.rim.weight=0",),
    "all but robust weights": (f"{_R}.robust_sd=0",),
    "all but the label `no part`": (f"{_R}.outlier=0",),
    "all but annealing": (f"{_R}.sigma_first=0.03",),
    "all but sliding (tangential 1)": (f"{_R}.tangential=1",),
    "all but Potts": (f"{_R}.labelling.potts=0",),
    "all but face and torso": ("pose.appearance.face=0", "pose.appearance.torso=0"),
    "all but limits": (f"{_R}.fitting.limit_sd=0",),
    "all but the rest pose": (f"{_R}.rest_sd=0",),
    "all, hinges everywhere": ("pose.body.joint=revolute",),
    "all, swings everywhere": ("pose.body.joint=swing",),
    "all but hypotheses over time": ("pose.smoothing.hypotheses.sweeps=0",),
    "all but occlusion": ("pose.registration.occlusion.penalty=0",),
    "all, fewer nearest parts (near 1)": (f"{_R}.near=1",),
    "all, soft labels": (f"{_R}.hard=false",),
    "all, and geodesic": (f"{_R}.labelling.geodesic=0.04",),
    "all, algebraic distance": (f"{_R}.distance=algebraic",),
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


class RememberingEyes(Eyes):
    """Eyes that look at each frame once, however often the recording is run."""

    def __init__(self, eyes: Eyes):
        super().__init__(eyes.camera, eyes.config)
        self.eyes, self.seen, self.stopwatch = eyes, dict[int, View](), eyes.stopwatch

    def learn_background(self, backgrounds: Backgrounds, recording: Recording, device: torch.device) -> None:
        if self.eyes.background is None:
            self.eyes.learn_background(backgrounds, recording, device)
        self.background_depth = self.eyes.background_depth

    def look(self, frame: Frame, device: torch.device, most: int | None = None) -> View:
        if frame.index not in self.seen:
            self.seen[frame.index] = self.eyes.look(frame, device, most)
        return self.seen[frame.index]


class OracleEyes(Eyes):
    """Eyes of which some findings are replaced by the truth."""

    def __init__(self, eyes: Eyes, truth: Truth, oracles: Sequence[str]):
        super().__init__(eyes.camera, eyes.config)
        self.truth, self.oracles, self.stopwatch = truth, oracles, eyes.stopwatch

    def look(self, frame: Frame, device: torch.device, most: int | None = None) -> View:
        view = super().look(frame, device, most)
        true_mask = torch.from_numpy(self.truth.labels(frame.index) > 0)[None]
        if "disparity" in self.oracles:
            view = replace(view, depth=self.truth.depth(frame.index).where(true_mask, torch.nan))
        return replace(view, silhouette=true_mask) if "mask" in self.oracles else view


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
    folder: Path,
    config: InferConfig,
    oracles: Sequence[str] = (),
    frames: int | None = None,
    eyes: Eyes | None = None,
) -> dict[str, float]:
    """Figures of one recording. `eyes` that have looked at it before may look again."""
    recording, truth = open_recording(folder), Truth(folder)
    torch.manual_seed(config.seed)
    model = StereoToPose(recording.camera, config.eyes, config.pose)
    if eyes is not None:
        model.eyes = eyes
    labels = TrueLabels(model.body.segment_names, truth)
    if set(oracles) & {"disparity", "mask"}:
        model.eyes = OracleEyes(model.eyes, truth, oracles)
    if "labels" in oracles:
        model.likelihoods.append(labels)
    people = People(model, config.people)
    begin = time.process_time()
    people.prepare(recording)
    prepared = time.process_time() - begin
    model.stopwatch.seconds.clear()
    if "size" in oracles:
        model.size = true_size(model.body, truth)
    results: list[FramePose] = []
    windows = PeopleWindows(people.followers)
    begin = time.process_time()
    for position in range(min(len(recording), frames or len(recording))):
        frame = recording[position]
        labels.index = frame.index
        if "start" in oracles and position == 0:
            model.tracker.begin(true_pose(model.body, truth, frame.index), frame.time_s)
        results += [everybody[0] for everybody in windows.push(people.follow(frame))]
    results += [everybody[0] for everybody in windows.flush()]
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
    true_poses = torch.cat([true_pose(model.body, truth, int(i)) for i in index[answered]])
    true_angles = anatomical_angles(model.body, model.body(true_poses, true_size(model.body, truth)))
    off = (sequence.angles[answered] - true_angles + torch.pi).remainder(2 * torch.pi) - torch.pi
    # The truth's trunk and neck are other points than ours: the limbs' angles alone.
    limbs = [i for i, name in enumerate(sequence.angle_names) if not name.startswith(("trunk", "neck"))]
    covered = off.abs()[:, limbs] < 2 * sequence.angle_sd[answered][:, limbs]
    figures |= {
        "covered": float(covered.float().mean()),
        "angle_deg": float(error.mean()),
        "joint_mm": float(1000 * gap.mean()),
        "within": float((gap < 0.1).float().mean()),
        "unanswered": float((~answered).float().mean()),
        "point_to_model_mm": float(1000 * sequence.point_to_model.nanmean()),
        "prepare_ms": 1000 * prepared,
        "others": float(len(people.followers) - 1),
    }
    count = len(results)
    figures |= {f"{stage}_ms": 1000 * seconds / count for stage, seconds in model.stopwatch.seconds.items()}
    return figures | {"frame_ms": 1000 * (total + prepared) / count}


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.people", description=__doc__.split("\n")[0])
    parser.add_argument("people", type=Path, help="folder of recordings, each with a truth/ folder")
    parser.add_argument("overrides", nargs="*", help="settings of infer.py, key=value")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    parser.add_argument(
        "--oracle", nargs="+", choices=ORACLES, default=[], help="stages that the truth replaces"
    )
    parser.add_argument("--frames", type=int, help="only the first frames of each recording")
    parser.add_argument(
        "--settings", choices=("default", "thesis"), default="default", help="of the registration"
    )
    parser.add_argument(
        "--ablate", action="store_true", help="a row for each term that is switched off, or alone on"
    )
    parser.add_argument("--only", help="only recordings whose name contains this")
    arguments = parser.parse_intermixed_args(argv)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    overrides = [f"registration={arguments.settings}", *arguments.overrides]
    config = load_config("infer", overrides)
    folders = sorted(path.parent for path in arguments.people.glob("*/truth"))
    folders = [folder for folder in folders if not arguments.only or arguments.only in folder.name]
    if not folders:
        parser.error(f"{arguments.people} must hold recordings with a truth/ folder, got none")
    if arguments.ablate:
        ablation = ablate(folders, arguments.overrides, arguments.frames)
        if arguments.json:
            arguments.json.write_text(json.dumps({"settings": arguments.overrides, "ablation": ablation}))
        return
    table = {}
    for folder in folders:
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
            json.dumps({"settings": overrides, "oracle": arguments.oracle, "table": table})
        )


def ablate(
    folders: Sequence[Path], overrides: Sequence[str], frames: int | None
) -> dict[str, dict[str, dict[str, float]]]:
    """Figures by setting and recording; every recording is looked at once. Progress goes to the error stream."""
    table: dict[str, dict[str, dict[str, float]]] = {name: {} for name in ABLATIONS}
    for folder in folders:
        recording = open_recording(folder)
        config = load_config("infer", overrides)
        eyes = RememberingEyes(Eyes(recording.camera, config.eyes))
        for name, settings in ABLATIONS.items():
            own = load_config("infer", [*settings, *overrides])
            row = table[name][folder.name] = measure(folder, own, (), frames, eyes)
            told = (
                f"{row['angle_deg']:.1f} degrees, {row['joint_mm']:.0f} mm, {row['within']:.3f} within 10 cm"
            )
            print(f"{folder.name}, {name}: {told}", file=sys.stderr, flush=True)
    short = [folder.name.removesuffix("_m2") for folder in folders]
    print(f"{'degrees':<34}" + " ".join(f"{name[:9]:>9}" for name in [*short, "overall", "mm", "within"]))
    for name, rows in table.items():
        angles = [row["angle_deg"] for row in rows.values()]
        mean = [float(np.mean([row[key] for row in rows.values()])) for key in ("joint_mm", "within")]
        cells = [f"{value:9.1f}" for value in [*angles, float(np.mean(angles)), mean[0]]]
        print(f"{name:<34}" + " ".join([*cells, f"{mean[1]:9.3f}"]))
    return table


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
    return (
        3 if column in ("within", "unanswered", "covered") else 1 if column.endswith(("_deg", "_mm")) else 0
    )


if __name__ == "__main__":
    main()
