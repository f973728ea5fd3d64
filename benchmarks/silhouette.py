"""Silhouette and disparity of the person on recordings with truth, beside plain subtraction and OpenCV's SGBM.

python -m benchmarks.silhouette ../shared/data/people [--frames N] [--every K] [--online] [--degrade KIND ...]
                                [--json FILE] [key=value ...]

Every frame goes through the eyes of `infer.py`, in order and on one thread; every third one (`--every`, from the
first on) is scored. `iou` is the overlap of the mask with the true label > 0, its mean, its least, and the mean of
two rivals: `mog2`, OpenCV's mixture of Gaussians with its shadow detection, and `colour`, a threshold on the
difference in colour from the empty scene. `disparity` is compared on the true person's pixels: median error (px),
share of the answered that is off by more than 1 px, share answered; `sgbm` is OpenCV's on the same pixels.
The face is looked at in every frame (benchmarks/face.py says when one is visible and when one found is right): the
share of the visible ones that are `face_found`, the share of frames with a false one (`face_false`), and the same of
OpenCV's frontal cascade alone on the whole image, but `haar_false` is false hits a frame. Their figures by the angle
at which the face is turned aside stand below the table. Times are
CPU milliseconds a frame by stage.

`--online` keeps the empty frames from everybody. `--degrade` spoils all frames but the empty ones: `drift` darkens
by 30 % from the first frame to the last, `flicker` changes the light by up to 5 % from frame to frame, `tint` warms
it by up to 10 %, `noise` adds grain of 2 % to each channel.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks.face import FaceScore, HaarAlone, by_angle, face_figures, score_face, true_face
from benchmarks.people import Truth
from torchpose.atomic import replacing
from torchpose.cli import InferConfig, load_config
from torchpose.eyes import Eyes
from torchpose.recording import Backgrounds, Frame, Recording, open_recording
from torchpose.vision.stereo import OpenCVMatcher

Image = Float[Tensor, "3 height width"]
Mask = Bool[Tensor, "height width"]
COLOUR_THRESHOLD = 0.06  # of the plain subtraction: greatest difference of a channel, the best of 0.04 to 0.2
STAGES = ("background", "stereo", "silhouette", "points", "faces")


def drift(image: Image, share: float) -> Image:
    return image * (1 - 0.3 * share)


def flicker(image: Image, share: float) -> Image:
    return image * (1 + 0.05 * float(np.sin(1000 * share)))


def tint(image: Image, share: float) -> Image:
    return image * torch.tensor([1 + 0.1 * share, 1.0, 1 - 0.1 * share])[:, None, None]


def noise(image: Image, share: float) -> Image:
    return image + 0.02 * torch.randn(
        image.shape, generator=torch.Generator().manual_seed(round(1e6 * share))
    )


DEGRADATIONS: dict[str, Callable[[Image, float], Image]] = {
    "drift": drift,
    "flicker": flicker,
    "tint": tint,
    "noise": noise,
}


class SpoiledRecording:
    """A recording whose frames are degraded, and whose empty ones may be withheld."""

    def __init__(self, recording: Recording, degradations: Sequence[str], online: bool, length: int | None):
        self.recording, self.degradations, self.online = recording, degradations, online
        self.length = min(len(recording), length or len(recording))
        self.camera = recording.camera

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, position: int, /) -> Frame:
        frame = self.recording[position]
        left, right = frame.left, frame.right
        assert left is not None
        assert right is not None
        for name in self.degradations:
            spoil, share = DEGRADATIONS[name], position / max(self.length - 1, 1)
            left, right = (spoil(left, share).clamp(0, 1), spoil(right, share + 1e-3).clamp(0, 1))
        return replace(frame, left=left, right=right)

    def background(self) -> Backgrounds:
        return Backgrounds() if self.online else self.recording.background()


class Subtraction:
    """Two plain rivals, both given what the eyes are given: the empty frames, or frames spread over the recording."""

    def __init__(self, recording: Recording) -> None:
        frames = recording.background().left
        if frames is None:
            spread = np.linspace(0, len(recording) - 1, 15).round().astype(int)
            frames = torch.stack([_left(recording[int(position)]) for position in spread])
        self.center = frames.median(0).values
        self.mixture = cv2.createBackgroundSubtractorMOG2(history=100, detectShadows=True)
        for _ in range(max(1, 30 // len(frames))):
            for frame in frames:
                self.mixture.apply(_eight_bit(frame))

    def __call__(self, image: Image) -> dict[str, Mask]:
        mixture = self.mixture.apply(_eight_bit(image), learningRate=0)  # 255 foreground, 127 shadow
        colour = (image - self.center).abs().amax(0) > COLOUR_THRESHOLD
        return {"mog2": torch.from_numpy(mixture == 255), "colour": colour}


def overlap(mask: Mask, truth: Mask) -> float:
    """Intersection over union; 1 where both are empty."""
    union = int((mask | truth).sum())
    return int((mask & truth).sum()) / union if union else 1.0


def measure(
    folder: Path, config: InferConfig, options: argparse.Namespace
) -> tuple[dict[str, float], list[FaceScore]]:
    """Figures of one recording, and each frame's face."""
    recording = SpoiledRecording(open_recording(folder), options.degrade, options.online, options.frames)
    truth, eyes, device = Truth(folder), Eyes(recording.camera, config.eyes), torch.device("cpu")
    eyes.learn_background(recording.background(), recording, device)
    eyes.stopwatch.seconds.clear()
    rivals, sgbm, haar = Subtraction(recording), OpenCVMatcher(), HaarAlone()
    scores: list[FaceScore] = []
    ious: dict[str, list[float]] = {}
    errors: dict[str, list[Tensor]] = {}
    for position in range(len(recording)):
        frame = recording[position]
        sight = eyes(frame, device)
        face = true_face(truth, recording.camera, frame.index)
        scores.append(score_face(sight.faces, haar(_left(frame)), face))
        if position % options.every:
            continue
        person = torch.from_numpy(truth.labels(frame.index) > 0)
        masks = {"iou": sight.silhouette[0]} | rivals(_left(frame))
        for name, mask in masks.items():
            ious.setdefault(name, []).append(overlap(mask, person))
        true = recording.camera.disparity(truth.depth(frame.index)[0])
        assert frame.left is not None
        assert frame.right is not None
        ours = recording.camera.disparity(sight.depth[0])
        theirs = sgbm(frame.left[None], frame.right[None], disparity_range=eyes.disparity_range).values[0]
        known = person & true.isfinite()
        for name, found in (("disparity", ours), ("sgbm", theirs)):
            errors.setdefault(name, []).append((found - true).abs()[known])
    figures = {"iou": float(np.mean(ious["iou"])), "least": min(ious["iou"])}
    figures |= {name: float(np.mean(values)) for name, values in ious.items() if name != "iou"}
    for name, parts in errors.items():
        error = torch.cat(parts)
        answered = error[error.isfinite()]
        figures |= {
            f"{name}_px": float(answered.median()),
            f"{name}_off": float((answered > 1).float().mean()),
            f"{name}_density": len(answered) / len(error),
        }
    figures |= face_figures(scores)
    seconds = eyes.stopwatch.seconds
    times = {f"{stage}_ms": 1000 * seconds[stage] / len(recording) for stage in STAGES}
    return figures | times, scores


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.silhouette",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("people", type=Path, help="folder of recordings, each with a truth/ folder")
    parser.add_argument("settings", nargs="*", help="settings of infer.py, key=value")
    parser.add_argument("--frames", type=int, help="only the first frames of each recording")
    parser.add_argument("--every", type=int, default=3, help="score every K-th frame")
    parser.add_argument("--online", action="store_true", help="as if there were no empty frames")
    parser.add_argument("--degrade", nargs="+", choices=DEGRADATIONS, default=[], help="spoil the frames")
    parser.add_argument("--only", help="only recordings whose name contains this")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    options = parser.parse_intermixed_args(argv)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    config = load_config("infer", options.settings)
    folders = sorted(path.parent for path in options.people.glob("*/truth"))
    folders = [folder for folder in folders if not options.only or options.only in folder.name]
    if not folders:
        parser.error(f"{options.people} must hold recordings with a truth/ folder, got none")
    table: dict[str, dict[str, float]] = {}
    scores: list[FaceScore] = []
    for folder in folders:
        torch.manual_seed(config.seed)
        table[folder.name], faces = measure(folder, config, options)
        scores += faces
        if len(table) == 1:
            print(_header(list(table[folder.name])))
        print(_row(folder.name, table[folder.name]), flush=True)
    overall = {name: float(np.mean([row[name] for row in table.values()])) for name in table[folders[0].name]}
    table["overall"] = overall | {"least": min(row["least"] for row in table.values())}
    print(_row("overall", table["overall"]))
    faces_aside = by_angle(scores)
    print("\n" + _header(list(faces_aside["0-30"]), "face, degrees aside"))
    for band, row in faces_aside.items():
        print(_row(band, row))
    if options.json:
        chosen = {
            name: getattr(options, name) for name in ("settings", "frames", "every", "online", "degrade")
        }
        with replacing(options.json) as temporary:
            temporary.write_text(json.dumps({**chosen, "table": table, "faces_aside": faces_aside}, indent=1))


def _left(frame: Frame) -> Image:
    assert frame.left is not None
    return frame.left


def _eight_bit(image: Image) -> np.ndarray:
    return np.ascontiguousarray((255 * image).round().byte().permute(1, 2, 0).numpy())


def _header(columns: Sequence[str], title: str = "recording") -> str:
    names = [column.removesuffix("_ms").replace("disparity_", "d_") for column in columns]
    return f"{title:<20}" + " ".join(
        f"{name:>{_width(column)}}" for name, column in zip(names, columns, strict=True)
    )


def _row(name: str, figures: dict[str, float]) -> str:
    cells = []
    for column, value in figures.items():
        digits = 0 if column.endswith("_ms") or isinstance(value, int) else 3
        cells.append(f"{'-' if np.isnan(value) else f'{value:.{digits}f}':>{_width(column)}}")
    return f"{name:<20}" + " ".join(cells)


def _width(column: str) -> int:
    return max(5, len(column.removesuffix("_ms").replace("disparity_", "d_")))


if __name__ == "__main__":
    main()
