"""Joint angles of your own recording, frame by frame, in Python.

    python examples/your_own_recording.py my_recording --frames 60
    python examples/your_own_recording.py left.mp4 --right right.mp4 --calibration rig.yaml

Without a recording one is made in runs/example_recording: look at it for what such a folder holds.
"""

import argparse
from itertools import islice
from pathlib import Path

import torch

import torchpose as tp
from torchpose.recording import Backgrounds
from torchpose.synthesis.database import make_recording, synthetic_camera


def make_one(folder: Path, frames: int) -> Path:
    """A stereo recording of somebody who raises both hands, as a folder."""
    made = make_recording("both_hands", 1, 0, frames, synthetic_camera(320, 240, 10.0))
    images = [tp.Frame(i, i / 10, pair.left[0], pair.right[0]) for i, pair in enumerate(made)]
    return tp.write_recording(folder, made.camera, images, Backgrounds(*made.background(2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recording", nargs="?", help="folder, video of both cameras, or the left one's")
    parser.add_argument("--right", help="video of the right camera")
    parser.add_argument("--calibration", help="calibration.yaml, where the folder has none")
    parser.add_argument("--frames", type=int, default=12)
    options = parser.parse_args()
    path = options.recording or make_one(Path("runs/example_recording"), options.frames)
    recording = tp.open_recording(path, options.right, options.calibration)

    people = tp.People(tp.StereoToPose(recording.camera))
    people.prepare(recording)  # the empty scene, and the person's size
    shown = [tp.ANATOMICAL_NAMES.index(f"{joint}_flexion_left") for joint in ("shoulder", "elbow", "knee")]
    print(
        "time s   status     left shoulder   left elbow     left knee   (flexion, degrees +- standard deviation)"
    )
    for everybody in islice(people(recording), options.frames):
        person = everybody[0]  # the first to be seen; the others follow
        sequence = people.model.sequence([person])  # the same arrays that poses.npz has
        pairs = torch.stack([sequence.angles[0, shown], sequence.angle_sd[0, shown]], 1).rad2deg().tolist()
        cells = "   ".join(f"{angle:5.0f} +- {sd:4.1f}" for angle, sd in pairs)
        print(f"{person.time_s:6.2f}   {person.status.value:9}  {cells}")


if __name__ == "__main__":
    torch.set_num_threads(1)  # two on busy cores are slower
    with torch.no_grad():
        main()
