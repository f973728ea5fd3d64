"""Accuracy and speed of the stereo matchers on pairs with true disparity, with OpenCV's in the same run.

python -m benchmarks.stereo ../shared/data/stereo_truth [--people ../shared/data/people] [--degrade] [--json FILE]

`density` is the share of the pixels with known truth that are answered; `bad-1` and `bad-2` the shares that
are off by more than 1 and 2 px: of all such pixels, where no answer counts as bad, and of the answered;
`median` the median error of the answered (px); `ms` CPU milliseconds a pair on one thread, the matchers in turns:

gcs      Growing Correspondence Seeds, the defaults: made for people, holes filled
certain  the same without filling and with small windows: what it is sure of
paper    the same as published
sgm      semi-global matching, the defaults
sgbm     OpenCV's, 3-way mode, as `matcher: opencv` runs it
hh4      OpenCV's with four paths
bm       OpenCV's block matcher, 15 x 15

A first table times a full frame of 640 x 480 with 64 disparities. With `--people`, pixels are those of the true
person, and its region is the mask that the first five are given: alone with all disparities that the room allows,
and as in a video, with the last frame's answer as seeds, and its range and a margin as range, as `Eyes` does it.
`arms` are the hardest part: bare, thin and of little texture. `--degrade` repeats all with the right image spoilt.
"""

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from torchpose.atomic import replacing
from torchpose.calibration import read_calibration
from torchpose.eyes import EyesConfig
from torchpose.vision.camera import StereoCamera
from torchpose.vision.disparity import Disparity
from torchpose.vision.growing_seeds import GrowingSeeds, GrowingSeedsConfig
from torchpose.vision.semi_global import SemiGlobal
from torchpose.vision.stereo import OpenCVMatcher
from torchpose.vision.windows import window_max

SCENE_RANGE = (0, 63)  # px
PERSON_RANGE = (8, 64)  # px: 1.4 to 11 m with the recordings' camera
PERSON_FRAMES = (3, 15, 27, 39, 51)  # of the 60 of a recording; the defaults were chosen on others
MARGIN = 4  # px of the person's region around the true person
LAST_MARGIN = EyesConfig().last_margin  # m around the last frame's range
ARMS = ("upper_arm_L", "forearm_L", "upper_arm_R", "forearm_R")

Image = Float[Tensor, "1 3 height width"]
Map = Float[Tensor, "height width"]
Mask = Bool[Tensor, "height width"]
Table = dict[str, dict[str, dict[str, "Score"]]]
Matcher = Callable[[Image, Image, Mask | None, Map | None, tuple[int, int]], Map]


@dataclass(frozen=True)
class Pair:
    """Two images, the true disparity (px, NaN where unknown), and the parts of it to score by name."""

    left: Image
    right: Image
    truth: Map
    parts: dict[str, Mask]
    last: "Pair | None" = None  # the frame before
    camera: StereoCamera | None = None


@dataclass(frozen=True)
class Score:
    density: float
    bad1: float  # of all pixels with known truth
    bad2: float
    bad1_answered: float
    bad2_answered: float
    median: float  # px
    ms: float  # CPU time a pair


def ours(network: Callable[..., Disparity]) -> Matcher:
    """One of the package's matchers on one pair."""

    def run(left: Image, right: Image, mask: Mask | None, seeds: Map | None, span: tuple[int, int]) -> Map:
        masks, maps = (None if image is None else image[None] for image in (mask, seeds))
        return network(left, right, masks, maps, span).values[0]

    return run


def hh4(left: Image, right: Image, mask: Mask | None, seeds: Map | None, span: tuple[int, int]) -> Map:
    """OpenCV's semi-global matcher with four paths, on the full frame."""
    least, count = span[0], -(-(span[1] - span[0] + 1) // 16) * 16
    mode = cv2.STEREO_SGBM_MODE_HH4
    matcher = cv2.StereoSGBM.create(least, count, 5, 8 * 25, 32 * 25, 1, 0, 10, 100, 2, mode)
    return _by_opencv(matcher, left, right, least)


def block_matching(
    left: Image, right: Image, mask: Mask | None, seeds: Map | None, span: tuple[int, int]
) -> Map:
    """OpenCV's block matcher on the full frame."""
    matcher = cv2.StereoBM.create(-(-(span[1] - span[0] + 1) // 16) * 16, 15)
    matcher.setMinDisparity(span[0])
    matcher.setUniquenessRatio(10)
    matcher.setSpeckleWindowSize(100)
    matcher.setSpeckleRange(2)
    return _by_opencv(matcher, left, right, span[0])


def _by_opencv(matcher: cv2.StereoMatcher, left: Image, right: Image, least: int) -> Map:
    grey = [
        cv2.cvtColor((image[0].permute(1, 2, 0) * 255).round().byte().numpy(), cv2.COLOR_RGB2GRAY)
        for image in (left, right)
    ]
    disparity = torch.from_numpy(matcher.compute(*grey).astype(np.float32) / 16)
    return disparity.where(disparity >= least, torch.nan)


CERTAIN = GrowingSeedsConfig(windows=(3, 5), tau=0.5, mu=0.05, fill=False)
PAPER = GrowingSeedsConfig(windows=(5,), min_island=0, fill=False, smoothing=0)
MATCHERS: dict[str, Matcher] = {
    "gcs": ours(GrowingSeeds()),
    "certain": ours(GrowingSeeds(CERTAIN)),
    "paper": ours(GrowingSeeds(PAPER)),
    "sgm": ours(SemiGlobal()),
    "sgbm": ours(OpenCVMatcher()),
    "hh4": hh4,
    "bm": block_matching,
}
REGIONAL = ("gcs", "paper", "sgm", "sgbm")  # take the person's region and the last frame's range


def shifted(image: Image, rows: float) -> Image:
    """The image moved down by a fraction of a row, bilinearly."""
    grid = F.affine_grid(
        torch.tensor([[[1.0, 0, 0], [0, 1, -2 * rows / image.shape[2]]]]), list(image.shape), False
    )
    return F.grid_sample(image, grid, padding_mode="border", align_corners=False)


def noisy(image: Image) -> Image:
    """With a standard deviation of four of 255 levels."""
    generator = torch.Generator().manual_seed(0)
    return (image + 4 / 255 * torch.randn(image.shape, generator=generator)).clamp(0, 1)


def blurred(image: Image) -> Image:
    """By a Gaussian of 1 px."""
    pixels = np.ascontiguousarray(image[0].permute(1, 2, 0).numpy())
    return torch.from_numpy(cv2.GaussianBlur(pixels, (0, 0), 1.0)).permute(2, 0, 1)[None]


DEGRADATIONS: dict[str, Callable[[Image], Image]] = {
    "half a row lower": partial(shifted, rows=0.5),
    "noise of 4 levels": noisy,
    "5 % brighter": lambda image: (1.05 * image).clamp(0, 1),
    "blurred by 1 px": blurred,
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
        camera = read_calibration(calibration).camera
        part_names = json.loads((recording / "truth" / "meta.json").read_text())["parts"]
        arms = torch.tensor([part_names.index(name) for name in ARMS])
        pairs = []
        for frame in PERSON_FRAMES:
            last = person(recording, frame - 1, camera, arms)
            pairs.append(replace(person(recording, frame, camera, arms), last=last, camera=camera))
        yield recording.name, pairs


def person(recording: Path, frame: int, camera: StereoCamera, arms: Tensor) -> Pair:
    """One frame of a recording with true depth and body parts."""
    depth, part = (
        torch.from_numpy(cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.int64))  # type: ignore[union-attr]
        for path in (recording / "truth" / f"{frame:06d}_{kind}.png" for kind in ("depth", "label"))
    )
    truth = camera.disparity(depth.float() / 1000).where(part > 0, torch.nan)
    left, right = (read_image(recording / side / f"{frame:06d}.jpg") for side in ("left", "right"))
    return Pair(left, right, truth, {"person": part > 0, "arms": torch.isin(part, arms)})


def region(pair: Pair) -> Mask:
    """The true person and a margin."""
    return window_max(pair.parts["person"][None].float(), MARGIN)[0] > 0


def full_frame(pair: Pair, matcher: Matcher) -> tuple[Mask | None, Map | None, tuple[int, int]]:
    """What a matcher is given of a scene."""
    return None, None, SCENE_RANGE


def alone(pair: Pair, matcher: Matcher) -> tuple[Mask | None, Map | None, tuple[int, int]]:
    """What a matcher is given of a person in a single frame."""
    return region(pair), None, PERSON_RANGE


def in_video(pair: Pair, matcher: Matcher) -> tuple[Mask | None, Map | None, tuple[int, int]]:
    """What a matcher is given of a person whom it saw in the frame before."""
    assert pair.last is not None
    assert pair.camera is not None
    seeds = matcher(pair.last.left, pair.last.right, region(pair.last), None, PERSON_RANGE)
    far, near = torch.tensor([0.99, 0.01]), torch.tensor([LAST_MARGIN, -LAST_MARGIN])
    depth = pair.camera.depth(seeds[~seeds.isnan()]).quantile(far) + near
    least, greatest = pair.camera.disparity(depth).tolist()
    return region(pair), seeds, (math.floor(least), math.ceil(greatest))


def evaluate(
    groups: Iterable[tuple[str, list[Pair]]],
    given: Callable[[Pair, Matcher], tuple[Mask | None, Map | None, tuple[int, int]]],
    matchers: Iterable[str],
    repeats: int,
    spoil: Callable[[Image], Image] = lambda image: image,
) -> Table:
    """Scores by part, group (and "all") and matcher; the matchers take turns on each pair."""
    errors: dict[tuple[str, str, str], list[Tensor]] = {}
    times: dict[tuple[str, str], list[float]] = {}
    for group, pairs in groups:
        for pair in pairs:
            right = spoil(pair.right)
            inputs = {name: given(pair, MATCHERS[name]) for name in matchers}
            for repeat in range(repeats + 1):  # the first warms up
                for name in matchers:
                    mask, seeds, span = inputs[name]
                    begin = time.process_time()
                    values = MATCHERS[name](pair.left, right, mask, seeds, span)
                    if repeat == 0:
                        for part, pixels in pair.parts.items():
                            error = (values - pair.truth).abs()[pixels & ~pair.truth.isnan()]
                            for key in (group, "all"):
                                errors.setdefault((part, key, name), []).append(error)
                        continue
                    for key in (group, "all"):
                        times.setdefault((key, name), []).append(time.process_time() - begin)
    table: Table = {}
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


def frame_times(repeats: int) -> dict[str, float]:
    """Median CPU milliseconds of a full frame of 640 x 480 with 64 disparities, the matchers in turns."""
    generator = torch.Generator().manual_seed(0)
    left = F.avg_pool2d(torch.rand(1, 3, 484, 644, generator=generator), 5, 1)
    right = left.roll(-20, 3)
    times: dict[str, list[float]] = {name: [] for name in MATCHERS}
    for _ in range(repeats + 1):
        for name, matcher in MATCHERS.items():
            begin = time.process_time()
            matcher(left, right, None, None, SCENE_RANGE)
            times[name].append(time.process_time() - begin)
    return {name: 1000 * statistics.median(found[1:]) for name, found in times.items()}


def render(title: str, table: Table) -> str:
    lines = [title]
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
    parser.add_argument(
        "--degrade", action="store_true", help="again with the right image spoilt in four ways"
    )
    parser.add_argument("--json", type=Path, help="file for the numbers")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    for folder, pattern in ((options.folder, "*/disparity.npz"), (options.people, "*/calibration.yaml")):
        if folder is not None and not any(folder.glob(pattern)):
            print(f"{folder} must hold {pattern}, found none; give the folder of the data", file=sys.stderr)
            return 2
    times = frame_times(repeats=5)
    print("full frame, ms:  " + "  ".join(f"{name} {ms:.0f}" for name, ms in times.items()) + "\n")
    spoilt = {"as they are": lambda image: image} | (DEGRADATIONS if options.degrade else {})
    tables: dict[str, Table] = {}
    for title, spoil in spoilt.items():
        tables[f"scenes, {title}"] = evaluate(scenes(options.folder), full_frame, MATCHERS, 3, spoil)
        if options.people is not None:
            for kind, given in (("a single frame", alone), ("a video", in_video)):
                name = f"people, {kind}, {title}"
                tables[name] = evaluate(recordings(options.people), given, REGIONAL, 2, spoil)
    for title, table in tables.items():
        print(render(title, table))
    if options.json is not None:
        scores = {
            title: {
                part: {
                    group: {name: asdict(score) for name, score in row.items()}
                    for group, row in groups.items()
                }
                for part, groups in table.items()
            }
            for title, table in tables.items()
        }
        numbers = {"torch": torch.__version__, "full_frame_ms": times, "scores": scores}
        with replacing(options.json) as partial_file:
            partial_file.write_text(json.dumps(numbers, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
