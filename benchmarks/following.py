"""Following people who walk in, cross, are half hidden and walk out: status, identity and angles of `infer.py`.

python -m benchmarks.following ../shared/data/realsense_rehab [--people ../shared/data/people] [--only NAME]
    [--seeds N] [--json FILE] [key=value ...]

rehab     the real depth recording, by its README: frames 0 to 75 are empty, from 80 on somebody is there (76 to 79 do
          not count). `status` is the share of frames declared absent or present rightly: `absent` and `left` mean
          absent, `entering`, `tracked`, `partial` and `recovered` present, `lost` neither. `answered` is over the
          frames from 80 on; `median_px` between our joints, projected, and OpenPose's of confidence above 0.5: legs,
          arms and neck.
leaving   people/walking_m2 turned to begin and end with an empty room (benchmarks.leaving). `status`: absent where
          nobody is there; cut by more than `BORDER` px of border `partial`, cut by less or whole `tracked` or
          `recovered`, and `entering` in the first `GREET` frames; frames with less than a tenth of the person do not
          count. `stale` counts empty frames with a pose.
crossing  two self-made people one behind the other, N seeds, a depth camera's frames with colour (nothing is rendered
          twice, no matching). `kept`: seeds in which each is followed by one track of its own, before and after every
          meeting; `angle` is the limb angles' error of whoever is followed, `answered` the share of frames in clear
          view in which somebody's track follows.
crossing_stereo  one of these rendered in stereo, end to end.
cost      two people side by side against the mean of the same two alone, on depth frames: CPU ms a frame of
          registration, and in all without the writing of files. Each the least of `TURNS` runs.
cost_stereo  the same people rendered in stereo: images are compared and matched once, whoever is in them.
hidden    somebody behind a counter, seen from the waist up: error of elbows and shoulders (`upper_deg`) while both
          legs are hidden, `joints` the share of hidden joints' coordinates whose truth is within two of our standard
          deviations (by draws from the pose's covariance), `angles` the same of the anatomical angles of hidden legs,
          by `poses.csv`. A joint is hidden where the person is not seen at its pixel.
hidden_stereo  `HIDDEN_STEREO` of these rendered in stereo, end to end.

Each recording is run by `infer.py`'s own function into a folder of its own, and poses.csv, poses_2.csv, ... are read
back; who has no file was never found. Settings are those of infer.py.
"""

import argparse
import contextlib
import io
import json
import math
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks.identity import TruePerson, read_people, score
from benchmarks.leaving import turn_around
from torchpose.body.angle import ANATOMICAL_NAMES, anatomical_angles, limb_angles
from torchpose.body.model import BodyModel
from torchpose.cli import InferConfig, find_device, infer, load_config
from torchpose.export import JOINT_NAMES, PoseSequence, read_poses_csv, read_poses_npz
from torchpose.recording import open_recording
from torchpose.registration.size import read_size
from torchpose.rendered import write_company
from torchpose.synthesis.company import Company, CompanyRecording
from torchpose.synthesis.database import synthetic_camera
from torchpose.synthesis.scenario import behind_counter, crossing, side_by_side

AWAY = ("absent", "left")
THERE = ("entering", "tracked", "partial", "recovered")
EMPTY_UNTIL, THERE_FROM = 75, 80  # frames of realsense_rehab
BORDER = 8  # px of the person on the image's border; fewer are hardly a cut
GREET = 5  # frames, in which somebody may be entering
SLIVER = 0.1  # of the person's largest silhouette; less of a person is not counted
CONFIDENCE = 0.5  # of OpenPose
# Ours and OpenPose's names.
OPENPOSE = {"neck": "Neck"} | {
    f"{joint}_{side}": f"{side[0].upper()}{joint.capitalize()}"
    for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    for side in ("left", "right")
}
REACH = {
    "rehab": "status >= 0.98, median_px <= 8",
    "leaving": "status >= 0.97, stale 0",
    "crossing": "kept all",
    "cost": "registration, all <= 1.5",
    "hidden": "upper_deg <= 8, joints >= 0.9",
}
FAST = synthetic_camera(480, 360, 10.0)  # of the depth frames
STEREO = synthetic_camera(640, 480, 10.0)
LEGS = [JOINT_NAMES.index(f"{joint}_{side}") for joint in ("knee", "ankle") for side in ("left", "right")]
# Elbows and shoulders among the limb angles.
UPPER = [0, 1, 4, 5]
DRAWS = 256
TURNS = 3
HIDDEN_STEREO = 6


@dataclass(frozen=True)
class Answer:
    """What `infer.py` wrote for one recording."""

    people: tuple[PoseSequence, ...]
    details: tuple[PoseSequence, ...]  # the same with pose and covariance
    body: BodyModel
    size: Float[Tensor, "1 sizes"]  # of the first person
    cpu_ms: dict[str, float]  # a frame, by stage


def run(recording: Path, config: InferConfig, output: Path) -> Answer:
    """`infer.py` on a recording, without its words."""
    config = replace(config, recording=str(recording), output=str(output), fresh=True)
    torch.manual_seed(config.seed)
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        infer(config, find_device(config.device))
    names = ["poses"]
    while (output / f"poses_{len(names) + 1}.csv").exists():
        names.append(f"poses_{len(names) + 1}")
    body = BodyModel(config.pose.body)
    summary = json.loads((output / "summary.json").read_text())
    return Answer(
        tuple(read_poses_csv(output / f"{name}.csv") for name in names),
        tuple(read_poses_npz(output / f"{name}.npz") for name in names),
        body,
        read_size(output / "person.yaml", body),
        summary["cpu_ms_per_frame"],
    )


def rehab(folder: Path, config: InferConfig, work: Path) -> dict[str, float]:
    """The figures of realsense_rehab."""
    found = run(folder, config, work / "output").people[0]
    camera = open_recording(folder).camera
    with np.load(folder / "openpose.npz") as data:
        names, theirs = list(data["names"]), torch.from_numpy(data["uvc"])
        first = int(data["first_frame"])
    frame, away, there = found.frame, words(found, AWAY), words(found, THERE)
    empty, inside = frame <= EMPTY_UNTIL, frame >= THERE_FROM
    right = torch.cat([away[empty], there[inside]])
    answered = torch.tensor(found.answered)
    ours = camera.project(found.joints.float())[:, [JOINT_NAMES.index(name) for name in OPENPOSE]]
    theirs = theirs[frame - first][:, [names.index(name) for name in OPENPOSE.values()]]
    known = (theirs[..., 2] > CONFIDENCE) & (answered & inside)[:, None]
    gap = (ours - theirs[..., :2]).norm(dim=-1)[known]
    return {
        "status": share(right),
        "empty_right": share(away[empty]),
        "present_right": share(there[inside]),
        "answered": share(answered[inside]),
        "stale": float((answered & empty).sum()),
        "median_px": float(gap.median()) if len(gap) else math.nan,
        "compared": float(len(gap)),
    }


def leaving(source: Path, config: InferConfig, work: Path) -> dict[str, float]:
    """The figures of the turned walking recording."""
    known = turn_around(source, work / "recording")
    found = run(work / "recording", config, work / "output").people[0]
    seen, border = (torch.tensor(known[name])[found.frame] for name in ("seen", "border"))
    right, counted = status_right(found, seen, border)
    answered = torch.tensor(found.answered)
    empty = seen == 0
    return {
        "status": share(right[counted]),
        "empty_right": share(right[empty]),
        "whole_right": share(right[counted & ~empty & (border <= BORDER)]),
        "cut_right": share(right[counted & (border > BORDER)]),
        "answered": share(answered[counted & ~empty]),
        "stale": float((answered & empty).sum()),
    }


def status_right(
    found: PoseSequence, seen: Tensor, border: Tensor
) -> tuple[Bool[Tensor, " time"], Bool[Tensor, " time"]]:
    """In which frames the status is right, and which frames count.

    `seen` are the person's pixels in each frame and `border` those on the image's border.
    """
    there = seen > 0
    first = int(there.float().argmax())
    row = torch.arange(len(seen))
    right = torch.where(there, words(found, ("tracked", "recovered")), words(found, AWAY))
    right |= there & (border > 0) & words(found, ("partial",))
    right &= ~(there & (border > BORDER) & words(found, ("tracked", "recovered")))
    right |= there & (row < first + GREET) & words(found, ("entering",))
    return right, ~there | (seen >= SLIVER * seen.max())


def words(found: PoseSequence, some: Sequence[str]) -> Bool[Tensor, " time"]:
    """In which frames the status is one of some words."""
    return torch.tensor([status in some for status in found.status], dtype=torch.bool)


def share(flags: Bool[Tensor, " num"]) -> float:
    """Share of flags that are set; NaN of none."""
    return float(flags.float().mean()) if len(flags) else math.nan


def observe(
    company: Company, config: InferConfig, work: Path, stereo: bool
) -> tuple[Answer, list[TruePerson]]:
    """A company as a recording, what is made of it, and the truth."""
    recording = CompanyRecording(company, STEREO if stereo else FAST)
    folder = write_company(work / "recording", recording, stereo)
    return run(folder, config, work / "output"), read_people(folder)


def cross(seed: int, config: InferConfig, work: Path, stereo: bool = False) -> dict[str, float]:
    """The figures of one crossing."""
    answer, people = observe(crossing(seed), config, work, stereo)
    found = score(answer.people, people)
    return {
        "kept": float(found.kept),
        "tracks": float(sum(any(one.answered) for one in answer.people)),
        "angle_deg": float(np.nanmean(found.angle_deg)) if np.isfinite(found.angle_deg).any() else math.nan,
        "answered": float(np.mean(found.answered)),
        "answered_least": min(found.answered),
    }


def cost(seed: int, config: InferConfig, work: Path, stereo: bool = False) -> dict[str, float]:
    """CPU ms a frame of two people and of the same two alone, in turns: how busy the machine is counts for all."""
    both = side_by_side(seed)
    camera = STEREO if stereo else FAST
    folders = [
        write_company(work / f"recording_{k}", CompanyRecording(replace(both, guests=guests), camera), stereo)
        for k, guests in enumerate((both.guests, both.guests[:1], both.guests[1:]))
    ]
    return cost_figures(
        [[run(folder, config, work / "output").cpu_ms for folder in folders] for _ in range(TURNS)]
    )


def cost_figures(turns: Sequence[Sequence[dict[str, float]]]) -> dict[str, float]:
    """The least that two people, and each alone, took in any turn, and the ratio: what disturbs a run only adds."""
    figures: dict[str, float] = {}
    for name in ("registration", "all"):
        two, *alone = (min(stages_ms(run, name) for run in runs) for runs in zip(*turns, strict=True))
        one = sum(alone) / len(alone)
        figures |= {f"{name}_two_ms": two, f"{name}_one_ms": one, name: two / one}
    return figures


def stages_ms(cpu_ms: dict[str, float], name: str) -> float:
    """Of one stage, or of `all` of them but the writing of files; NaN of none."""
    if name == "all":
        return sum(value for stage, value in cpu_ms.items() if stage != "export")
    return cpu_ms.get(name, math.nan)


def hide(seed: int, config: InferConfig, work: Path, stereo: bool = False) -> dict[str, float]:
    """The figures of somebody behind a counter."""
    answer, (person,) = observe(behind_counter(seed), config, work, stereo)
    with np.load(work / "recording" / "truth" / "person_1.npz") as data:
        pose, size = (torch.from_numpy(data[name]) for name in ("pose", "size"))
    drawn = BodyModel()  # whose parameters the true poses are
    true_angles = anatomical_angles(drawn, drawn(pose, size[None]))
    found, detail = answer.people[0], answer.details[0]
    answered = torch.tensor(found.answered)
    covered = ~person.joints_seen[found.frame][:, LEGS].any(1) & (person.seen[found.frame] > 0)
    covered &= ~person.cut[found.frame]
    open_view = person.clear[found.frame]
    joints = person.joints[found.frame]
    error = (limb_angles(found.joints.float()) - limb_angles(joints)).abs().rad2deg()
    rows = covered & answered
    hidden = ~person.joints_seen[found.frame][rows]  # (rows, 15)
    within = torch.zeros(0, dtype=torch.bool)
    if rows.any():
        assert detail.pose is not None
        assert detail.pose_covariance is not None
        sd = joint_sd(answer.body, detail.pose[rows], detail.pose_covariance[rows], answer.size)
        off = (found.joints[rows].float() - joints[rows]).abs()
        within = (off <= 2 * sd)[hidden].flatten()
    off = (found.angles.float() - true_angles[found.frame])[rows]
    off = torch.atan2(off.sin(), off.cos()).abs()
    legs = [i for i, name in enumerate(ANATOMICAL_NAMES) if name.startswith(("hip", "knee"))]
    inside = (off <= 2 * found.angle_sd[rows].float())[:, legs].flatten()
    return {
        "upper_deg": float(error[rows][:, UPPER].mean()) if rows.any() else math.nan,
        "open_deg": float(error[open_view & answered][:, UPPER].mean()),
        "joints": share(within),
        "angles": share(inside),
        "answered": share(answered[covered]),
        "partial": share(words(found, ("partial",))[covered]),
        "frames": float(covered.sum()),
    }


def joint_sd(
    body: BodyModel,
    pose: Float[Tensor, "batch parameters"],
    covariance: Float[Tensor, "batch parameters parameters"],
    size: Float[Tensor, "1 sizes"],
) -> Float[Tensor, "batch 15 3"]:
    """Standard deviations of the joints' coordinates, m, by draws from the pose's covariance."""
    pose, covariance = pose.to(size), covariance.to(size)
    value, axes = torch.linalg.eigh(covariance)
    root = axes * value.clamp_min(0).sqrt()[:, None]
    normal = torch.randn(DRAWS, pose.shape[1], generator=torch.Generator().manual_seed(0)).to(size)
    drawn = pose[:, None] + normal @ root.mT
    joints = body(drawn.flatten(0, 1), size).joints.unflatten(0, (len(pose), DRAWS))
    return (joints - body(pose, size).joints[:, None]).square().mean(1).sqrt()


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.following", description=__doc__.split("\n")[0]
    )
    parser.add_argument("rehab", type=Path, help="folder of realsense_rehab")
    parser.add_argument("settings", nargs="*", help="settings of infer.py, key=value")
    parser.add_argument("--people", type=Path, help="folder of people; beside the other one if not given")
    parser.add_argument("--only", help="only the measure of this name, or those whose names contain it")
    parser.add_argument("--seeds", type=int, default=20, help="crossings; a quarter as many are hidden")
    parser.add_argument(
        "--json", type=Path, help="also write the figures, recording by recording, to this file"
    )
    arguments = parser.parse_intermixed_args(argv)
    if arguments.seeds < 1:
        parser.error(f"--seeds must be at least 1, got {arguments.seeds}")
    torch.set_num_threads(1)
    config, seeds = load_config("infer", arguments.settings), arguments.seeds
    walking = (arguments.people or arguments.rehab.parent / "people") / "walking_m2"
    measures: dict[str, list[Callable[..., dict[str, float]]]] = {
        "rehab": [partial(rehab, arguments.rehab, config)],
        "leaving": [partial(leaving, walking, config)],
        "crossing": [partial(cross, seed, config) for seed in range(seeds)],
        "crossing_stereo": [partial(cross, 0, config, stereo=True)],
        "cost": [partial(cost, 0, config)],
        "cost_stereo": [partial(cost, 0, config, stereo=True)],
        "hidden": [partial(hide, seed, config) for seed in range(math.ceil(seeds / 4))],
        "hidden_stereo": [
            partial(hide, seed, config, stereo=True) for seed in range(min(HIDDEN_STEREO, seeds))
        ],
    }
    chosen = [name for name in measures if not arguments.only or arguments.only in name]
    if arguments.only in measures:  # the others' names may contain it
        chosen = [arguments.only]
    if not chosen:
        parser.error(f"--only must be part of one of {', '.join(measures)}, got {arguments.only!r}")
    table: dict[str, list[dict[str, float]]] = {}
    for name in chosen:
        table[name] = []
        for measure in measures[name]:
            with tempfile.TemporaryDirectory() as work:
                table[name].append(measure(work=Path(work)))
        print(row(name, table[name]), flush=True)
        if arguments.json:
            arguments.json.write_text(json.dumps({"settings": arguments.settings, "table": table}))


def row(name: str, figures: Sequence[dict[str, float]]) -> str:
    """A line of the table: means over the recordings; of `kept` the count."""
    cells = []
    for key in figures[0]:
        values = [one[key] for one in figures]
        known = [value for value in values if not math.isnan(value)]
        mean = sum(known) / len(known) if known else math.nan
        if key == "kept":
            cells.append(f"kept {sum(values):.0f} of {len(values)}")
        else:
            cells.append(f"{key} {mean:.{_digits(key)}f}")
    reach = REACH.get(name, REACH.get(name.removesuffix("_stereo"), ""))
    return f"{name:<16}" + ", ".join(cells) + (f"   (reach: {reach})" if reach else "")


def _digits(key: str) -> int:
    return 1 if key.endswith(("_deg", "_px", "_ms")) else 0 if key in ("stale", "compared", "frames") else 3


if __name__ == "__main__":
    main()
