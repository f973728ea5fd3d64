"""The floor that is found, and how tall people are over it.

python -m benchmarks.floor RECORDING ... [--seeds N]

Of each recording: the camera's height over the floor and its tilt against it, the share of the empty scene's readings
within 3 cm, and the time to find it. Then of people of N self-made companies, each alone before a depth camera whose
frames have a matcher's errors: the height of the drawn body, as it is found by floor and crown, and without a floor
by the lowest point that is seen (`pose.least_height` aside). The drawn floor is level, 1.1 m below the camera.
"""

import argparse
import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.following import FAST
from torchpose.body.model import BodyModel
from torchpose.cli import load_config
from torchpose.pipeline import StereoToPose
from torchpose.recording import Recording, open_recording, readable_frames, spread_positions
from torchpose.rendered import write_company
from torchpose.synthesis.company import CompanyRecording
from torchpose.synthesis.scenario import side_by_side
from torchpose.vision.floor import find_floor

LOOKS = 12  # frames of a recording
NEAR = 0.03  # m


def learned(recording: Recording) -> StereoToPose:
    """A model that knows the recording's empty scene."""
    config = load_config("infer", [])
    model = StereoToPose(recording.camera, config.eyes, replace(config.pose, least_height=0.01))
    model.learn_background(recording)
    return model


def row_of(folder: Path) -> str:
    """The floor of one recording."""
    recording = open_recording(folder)
    model = learned(recording)
    eyes, depth = model.eyes, model.eyes.background_depth
    if eyes.floor is None or depth is None:
        return f"{folder.name:22s} none"
    begin = time.process_time()
    find_floor(depth, recording.camera, eyes.depth_noise, eyes.config.floor)
    ms = 1000 * (time.process_time() - begin)
    v, u = depth.isfinite().nonzero(as_tuple=True)
    seen = recording.camera.back_project(torch.stack([u, v], -1).float(), depth[v, u])
    share = float((eyes.floor.above(seen).abs() < NEAR).float().mean())
    tilt = math.degrees(math.acos(min(1.0, -float(eyes.floor.normal[1]))))
    return f"{folder.name:22s} {float(eyes.floor.height):6.3f} m  {tilt:5.1f} degrees  {share:5.1%}  {ms:4.0f} ms"


def stature(body: BodyModel, size: Float[Tensor, "1 sizes"]) -> float:
    """Of the drawn body at rest, from its ellipsoids' highest point to their lowest, m."""
    posed = body(torch.cat([torch.zeros(1, 6), body.rest[None]], 1), size)
    middle, half = posed.centers[0, :, 1], (posed.frames[0, :, 1] * posed.radii[0]).norm(dim=-1)
    return float((middle + half).max() - (middle - half).min())


def heights_of(seed: int, work: Path) -> list[str]:
    """Two drawn people, each alone."""
    rows = []
    for k, guest in enumerate(side_by_side(seed).guests):
        company = CompanyRecording(replace(side_by_side(seed), guests=(guest,)), FAST)
        recording = open_recording(write_company(work / f"{seed}_{k}", company, stereo=False))
        model = learned(recording)
        floor, found = model.eyes.floor, []
        frames = readable_frames(recording, spread_positions(len(recording), LOOKS))
        sights = [model.eyes(frame, model.device) for frame in frames]
        for model.eyes.floor in (floor, None):
            heights = [model.height_in(sight) for sight in sights if sight.present and not sight.cut]
            found.append(model.height_of(heights))
        drawn, over = (
            stature(model.body, company.sizes[0]),
            "none" if floor is None else f"{floor.height:.3f} m",
        )
        rows.append(
            f"side by side {seed}, {k + 1:2d}    drawn {drawn:.2f} m, found {found[0]:.2f}, "
            f"without the floor {found[1]:.2f}; floor {over}"
        )
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.floor", description=__doc__.split("\n")[0])
    parser.add_argument("recordings", nargs="*", type=Path, help="folders of recordings")
    parser.add_argument("--seeds", type=int, default=2, help="companies of self-made people")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    for folder in options.recordings:
        print(row_of(folder), flush=True)
    with tempfile.TemporaryDirectory() as work:
        for seed in range(options.seeds):
            print("\n".join(heights_of(seed, Path(work))), flush=True)


if __name__ == "__main__":
    main()
