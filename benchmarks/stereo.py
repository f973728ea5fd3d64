"""Accuracy and speed of the stereo matcher on pairs with true disparity, with OpenCV's SGBM in the same run.

python -m benchmarks.stereo ../shared/data/stereo_truth [--people ../shared/data/people] [--json FILE]

`density` is the share of the pixels with known truth that are answered; `bad-1` and `bad-2` the shares that
are off by more than 1 and 2 px: of all such pixels, where no answer counts as bad, and of the answered;
`median` the median error of the answered (px); `ms` CPU milliseconds a pair on one thread. The matchers:

paper  Growing Correspondence Seeds as published: one window, no filling, no smoothing
ours   the defaults of `GrowingSeedsConfig`
sgbm   OpenCV's semi-global matcher, 3-way mode, 5 x 5 blocks

With `--people`, pixels are those of the true person, whose mask the first two are given, and a second table
holds the arms alone, the hardest part: bare, thin and of little texture. SGBM takes no mask, so its time is
that of the full frame.
"""

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import yaml
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.vision.growing_seeds import GrowingSeeds, GrowingSeedsConfig

PAPER = GrowingSeedsConfig(windows=(5,), min_island=0, fill=False, smoothing=0)
SCENE_RANGE = (0, 63)  # px
PERSON_RANGE = (8, 64)  # px: 1.4 to 11 m with the recordings' camera
PERSON_FRAMES = (3, 15, 27, 39, 51)  # of the 60 of a recording; the defaults were chosen on others
ARMS = ("upper_arm_L", "forearm_L", "upper_arm_R", "forearm_R")

Image = Float[Tensor, "1 3 height width"]
Map = Float[Tensor, "height width"]
Mask = Bool[Tensor, "height width"]
Matcher = Callable[[Image, Image, Mask | None, tuple[int, int]], Map]


@dataclass(frozen=True)
class Pair:
    """Two images, the true disparity (px, NaN where unknown), and the parts of it to score by name."""

    left: Image
    right: Image
    truth: Map
    parts: dict[str, Mask]


@dataclass(frozen=True)
class Score:
    density: float
    bad1: float  # of all pixels with known truth
    bad2: float
    bad1_answered: float
    bad2_answered: float
    median: float  # px
    ms: float  # CPU time a pair


def growing_seeds(config: GrowingSeedsConfig) -> Matcher:
    network = GrowingSeeds(config)

    def run(left: Image, right: Image, mask: Mask | None, disparities: tuple[int, int]) -> Map:
        masks = None if mask is None else mask[None]
        return network(left, right, masks, disparity_range=disparities).values[0]

    return run


def sgbm(left: Image, right: Image, mask: Mask | None, disparities: tuple[int, int]) -> Map:
    least, greatest = disparities
    matcher = cv2.StereoSGBM.create(
        minDisparity=least,
        numDisparities=-(-(greatest - least + 1) // 16) * 16,
        blockSize=5,
        P1=8 * 25,
        P2=32 * 25,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    grey = [
        cv2.cvtColor((image[0].permute(1, 2, 0) * 255).round().byte().numpy(), cv2.COLOR_RGB2GRAY)
        for image in (left, right)
    ]
    disparity = torch.from_numpy(matcher.compute(*grey).astype(np.float32) / 16)
    return disparity.where(disparity >= least, torch.nan)


MATCHERS: dict[str, Matcher] = {
    "paper": growing_seeds(PAPER),
    "ours": growing_seeds(GrowingSeedsConfig()),
    "sgbm": sgbm,
}


def read_image(path: Path) -> Image:
    image = cv2.imread(str(path))
    if image is None:
        raise FileNotFoundError(f"no readable image {path}")
    return torch.from_numpy(cv2.cvtColor(image, cv2.COLOR_BGR2RGB)).permute(2, 0, 1)[None].float() / 255


def scenes(folder: Path) -> Iterator[tuple[str, list[Pair]]]:
    """Every scene of a folder: left.png, right.png, disparity.npz."""
    for truth_file in sorted(folder.glob("*/disparity.npz")):
        scene = truth_file.parent
        truth = torch.from_numpy(np.load(truth_file)["disparity"]).float()
        left, right = read_image(scene / "left.png"), read_image(scene / "right.png")
        yield scene.name, [Pair(left, right, truth, {"scene": ~truth.isnan()})]


def recordings(folder: Path) -> Iterator[tuple[str, list[Pair]]]:
    """Some frames of every recording with true depth and body parts."""
    for calibration in sorted(folder.glob("*/calibration.yaml")):
        recording = calibration.parent
        camera = yaml.safe_load(calibration.read_text())
        part_names = json.loads((recording / "truth" / "meta.json").read_text())["parts"]
        arms = torch.tensor([part_names.index(name) for name in ARMS])
        pairs = []
        for frame in PERSON_FRAMES:
            depth, part = (
                torch.from_numpy(cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.int64))  # type: ignore[union-attr]
                for path in (recording / "truth" / f"{frame:06d}_{kind}.png" for kind in ("depth", "label"))
            )
            truth = camera["focal_length"] * camera["baseline"] * 1000 / depth.float()
            truth = truth.where((depth > 0) & (part > 0), torch.nan)
            left, right = (read_image(recording / side / f"{frame:06d}.jpg") for side in ("left", "right"))
            pairs.append(Pair(left, right, truth, {"person": part > 0, "arms": torch.isin(part, arms)}))
        yield recording.name, pairs


def evaluate(
    groups: Iterator[tuple[str, list[Pair]]], disparities: tuple[int, int], repeats: int, masked: bool
) -> dict[str, dict[str, dict[str, Score]]]:
    """Scores by part, group (and "all") and matcher; the matchers take turns on each pair."""
    errors: dict[tuple[str, str, str], list[Tensor]] = {}
    times: dict[tuple[str, str], list[float]] = {}
    for group, pairs in groups:
        for pair in pairs:
            mask = next(iter(pair.parts.values())) if masked else None
            for repeat in range(repeats + 1):  # the first warms up
                for name, matcher in MATCHERS.items():
                    begin = time.process_time()
                    values = matcher(pair.left, pair.right, mask, disparities)
                    if repeat == 0:
                        for part, pixels in pair.parts.items():
                            error = (values - pair.truth).abs()[pixels & ~pair.truth.isnan()]
                            for key in (group, "all"):
                                errors.setdefault((part, key, name), []).append(error)
                        continue
                    for key in (group, "all"):
                        times.setdefault((key, name), []).append(time.process_time() - begin)
    table: dict[str, dict[str, dict[str, Score]]] = {}
    for (part, group, name), found in errors.items():
        error = torch.cat(found)
        answered = error[~error.isnan()]
        table.setdefault(part, {}).setdefault(group, {})[name] = Score(
            density=len(answered) / len(error),
            bad1=1 - (answered <= 1).sum().item() / len(error),
            bad2=1 - (answered <= 2).sum().item() / len(error),
            bad1_answered=(answered > 1).float().mean().item(),
            bad2_answered=(answered > 2).float().mean().item(),
            median=answered.median().item(),
            ms=1000 * statistics.median(times[group, name]),
        )
    return table


def render(table: dict[str, dict[str, dict[str, Score]]]) -> str:
    lines = []
    for part, groups in table.items():
        lines.append(
            f"{part:22} matcher  density   bad-1   bad-2  of answered: bad-1   bad-2  median px    ms"
        )
        for group, scores in sorted(groups.items(), key=lambda item: item[0] == "all"):
            for name, s in scores.items():
                lines.append(
                    f"{group:22} {name:7} {s.density:8.1%} {s.bad1:7.1%} {s.bad2:7.1%}"
                    f" {s.bad1_answered:19.1%} {s.bad2_answered:7.1%} {s.median:10.3f} {s.ms:5.0f}"
                )
        lines.append("")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="scenes: */left.png, right.png, disparity.npz")
    parser.add_argument("--people", type=Path, help="recordings with a truth folder")
    parser.add_argument("--json", type=Path, help="file for the numbers")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    for folder, pattern in ((options.folder, "*/disparity.npz"), (options.people, "*/calibration.yaml")):
        if folder is not None and not any(folder.glob(pattern)):
            print(f"{folder} must hold {pattern}, found none; give the folder of the data", file=sys.stderr)
            return 2
    table = evaluate(scenes(options.folder), SCENE_RANGE, repeats=3, masked=False)
    if options.people is not None:
        table |= evaluate(recordings(options.people), PERSON_RANGE, repeats=1, masked=True)
    print(render(table))
    if options.json is not None:
        scores = {
            part: {
                group: {name: asdict(score) for name, score in row.items()} for group, row in groups.items()
            }
            for part, groups in table.items()
        }
        temporary = options.json.with_name(options.json.name + ".part")
        temporary.write_text(json.dumps({"torch": torch.__version__, "scores": scores}, indent=1))
        os.replace(temporary, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
