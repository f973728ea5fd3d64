"""Memory of a long run: peak resident set at 1,000, 10,000 and 100,000 frames.

OMP_NUM_THREADS=1 python -m benchmarks.memory              # writing the files: parts of made-up poses, real export
OMP_NUM_THREADS=1 python -m benchmarks.memory following    # following, too: a small recording over and over

Each count runs in a process of its own, in a temporary folder (7 GB at 100,000 frames, removed afterwards).
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch

from torchpose.export import PoseSequence
from torchpose.parts import LabelledPoints
from torchpose.people import People
from torchpose.pipeline import FramePose, StereoToPose
from torchpose.recording import Backgrounds, Frame
from torchpose.rendered import RenderedRecording
from torchpose.session import Session
from torchpose.synthesis.database import make_recording, synthetic_camera
from torchpose.tracking.tracker import TrackStatus
from torchpose.vision.camera import StereoCamera
from torchpose.vision.floor import Floor

STRETCH, POINTS = 50, 500
SMALL = StereoCamera(64, 48, 60.0, 31.5, 23.5, 0.12, 30.0)


class Repeated:
    """A recording of any length that shows the same few frames over and over, forth and back."""

    def __init__(self, shown: list[Frame], camera: StereoCamera, length: int, empty: Backgrounds) -> None:
        self.shown, self.camera, self.length, self.empty = shown, camera, length, empty

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, position: int, /) -> Frame:
        turn = 2 * len(self.shown) - 2
        place = position % turn if turn else 0
        one = self.shown[min(place, turn - place)]
        return replace(one, index=position, time_s=position / self.camera.frame_rate)

    def background(self) -> Backgrounds:
        return self.empty


def peak() -> float:
    """MB, of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def export(count: int, folder: Path) -> dict[str, float]:
    """Parts of a made-up person, then everything that a run does at its end."""
    black = torch.zeros(3, SMALL.height, SMALL.width)
    recording = Repeated([Frame(0, 0.0, black, black)], SMALL, count, Backgrounds())
    model = StereoToPose(SMALL)
    model.eyes.floor = Floor(torch.tensor([0.0, -0.96, -0.28]), torch.tensor(1.2))  # its files are levelled
    session = Session(People(model), recording, folder, {}, "1")
    session.begin(fresh=True)
    part = poses(model)
    points = [LabelledPoints(torch.rand(POINTS, 3) + 2, torch.randint(0, 14, (POINTS,)))] * STRETCH
    for end in range(STRETCH, count + 1, STRETCH):
        frame = torch.arange(end - STRETCH, end)
        sequence = replace(part, frame=frame, time_s=frame.double() / SMALL.frame_rate)
        session.parts.save(end, [sequence], [points], [model.state()])
    before, begin = peak(), time.perf_counter()
    session.finish(begin, count, {})
    return {"before_mb": before, "peak_mb": peak(), "seconds": time.perf_counter() - begin}


def poses(model: StereoToPose) -> PoseSequence:
    """A stretch of a person who moves a little."""
    frames = [FramePose(i, float(i), TrackStatus.absent, None, None) for i in range(STRETCH)]
    empty = model.sequence(frames)
    place = torch.tensor([0.0, 0.0, 3.0, 0.0, 0.0, 0.0])
    pose = torch.cat([place, model.body.rest]) + 0.02 * torch.randn(STRETCH, model.body.num_parameters)
    posed = model.body(pose, model.size)
    return replace(
        empty,
        status=("tracked",) * STRETCH,
        joints=posed.joints,
        pose=pose,
        angles=torch.randn_like(empty.angles),
        angle_sd=torch.rand_like(empty.angle_sd) / 10,
        limb_angles=torch.rand_like(empty.limb_angles),
        point_to_model=torch.full((STRETCH,), 0.01),
        pose_covariance=torch.eye(pose.shape[1]).expand(STRETCH, -1, -1) / 100,
    )


def following(count: int, folder: Path) -> dict[str, float]:
    """A whole run over eight frames of a rendered person, forth and back."""
    made = RenderedRecording(make_recording("both_hands", 1, 0, 8, synthetic_camera(160, 120, 10.0)))
    shown = [made[i] for i in range(8)]
    recording = Repeated(shown, made.camera, count, made.background())
    session = Session(People(StereoToPose(made.camera)), recording, folder, {}, "1")
    begin = time.perf_counter()
    session.run(fresh=True)
    return {"peak_mb": peak(), "seconds": time.perf_counter() - begin}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", nargs="?", choices=["export", "following"], default="export")
    parser.add_argument("--counts", type=int, nargs="+", help="frames")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    measure = following if args.what == "following" else export
    if args.one:
        torch.set_num_threads(1)
        torch.manual_seed(0)
        with tempfile.TemporaryDirectory() as folder:
            found = measure(args.one, Path(folder))
        print(f"{args.one:8} frames  " + "  ".join(f"{name} {value:8.1f}" for name, value in found.items()))
        return
    counts = args.counts or ([100, 400, 1600] if args.what == "following" else [1000, 10_000, 100_000])
    for count in counts:
        subprocess.run(
            [sys.executable, "-m", "benchmarks.memory", args.what, "--one", str(count)], check=True
        )


if __name__ == "__main__":
    main()
