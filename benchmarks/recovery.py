"""Recovery on simulated frames: from nothing, from wrong poses, and from a kick in the middle of a recording.

python -m benchmarks.recovery [--starts N] [--only MOTION] [--json FILE] [key=value ...]

Frames, people and noise are those of benchmarks.simulated; the person's size is measured from the take, as infer.py
does. A pose is right, and the person recovered, where the mean error of the fifteen joints is below 80 mm and no limb
(nor the trunk) points more than 30 degrees wrong.

- nothing known: the starter on one frame, with the face and with the face withheld.
- wrong by 15, 25, 45 degrees: every limb turned by that angle against its parent, each in a direction of its own within
  the joint's limits; yaw, pitch and roll together off by half that angle, the hips by 0.2 m a radian (5, 9, 16 cm).
  `registrar`: one registration from there, nothing else tried. `plain EM`: the same without visible side, silhouette,
  robust weights and limits. `tracker`: it takes that pose for the last frame's and follows at most 10 frames.
- kick: the tracker follows 10 frames, then every limb of the pose that it remembers is turned by 0.9 rad, and it
  follows at most 19 more. `undisturbed` is what came before the kick.

`at once` is the share with a right pose in the first frame, `recovered` in any frame given, `frames` the mean number
needed by those recovered. Of the frames without a right pose `known` is the share of which the product says so (no
pose, or status `recovered`, or a misfit that it does not accept); `alarms` is the share of frames in which it doubts a
right pose (misfit) or gives up or starts anew without a need (undisturbed). Statuses are counted over all frames.
"""

import argparse
import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks.simulated import CAMERA, MOTIONS, SimulatedEyes, Take, failures, simulate
from torchpose.body.model import BodyModel
from torchpose.cli import InferConfig, load_config
from torchpose.pipeline import StereoToPose
from torchpose.recording import spread_positions
from torchpose.registration.vem import Registrar, Registration, RegistrationConfig
from torchpose.synthesis.motion import random_stream
from torchpose.tracking.tracker import TrackStatus
from torchpose.vision.faces import Faces

ANGLES = (15.0, 25.0, 45.0)  # degrees
KICK = 0.9  # rad
FRAMES, KICKED, PATIENCE = 30, 10, 10  # of a take; before the kick; that the tracker gets from a wrong pose
RIGHT_MM, RIGHT_DEG = 80.0, 30.0
ROOT_TURN, ROOT_SHIFT = 0.5, 0.2  # of the limbs' angle; m a radian
CANDIDATES = 32  # directions tried, to have one within a joint's limits
TOLD = (TrackStatus.absent, TrackStatus.entering, TrackStatus.lost, TrackStatus.recovered)


@dataclass(frozen=True)
class Trial:
    """What came of one start: for each frame whether the pose was right, whether it was doubted, and its status."""

    row: str
    right: tuple[bool, ...]
    doubted: tuple[bool, ...]
    status: tuple[str, ...] = ()


def is_right(
    joints: Float[Tensor, "batch 15 3"], truth: Float[Tensor, "batch 15 3"]
) -> Bool[Tensor, " batch"]:
    """Whether poses count as recovered; never where joints are NaN."""
    turned, _ = failures(joints, truth)
    near = (joints - truth).norm(dim=-1).mean(1) < RIGHT_MM / 1000
    return near & (turned < math.radians(RIGHT_DEG)).all(1)


def plain(config: RegistrationConfig) -> RegistrationConfig:
    """Without visible side, silhouette, robust weights and limits."""
    return replace(
        config,
        visible=False,
        robust_sd=0.0,
        rim=replace(config.rim, weight=0.0),
        fitting=replace(config.fitting, limit_sd=0.0),
    )


def turn_limbs(
    body: BodyModel, pose: Float[Tensor, "batch parameters"], angle: float, generator: torch.Generator
) -> Float[Tensor, "batch parameters"]:
    """Poses whose every limb points `angle` (rad) off against its parent, in random directions within the limits.

    A joint that has no such direction among those tried gets the one that passes its limits least, put back to them.
    """
    B = len(pose)
    many = pose.repeat(CANDIDATES, 1)
    posed = body(many)
    direction = body.limb_directions(posed)
    parents = list(body.parents)

    def to_torso(rotations: Tensor) -> Tensor:
        return rotations[:, :1].mT @ rotations[:, parents]

    local = (to_torso(posed.rotations).mT @ direction[..., None])[..., 0]
    aside = torch.randn(local.shape, generator=generator).to(local)
    aside = aside - (aside * local).sum(-1, keepdim=True) * local
    local = math.cos(angle) * local + math.sin(angle) * torch.nn.functional.normalize(aside, dim=-1)
    for i in range(len(parents)):  # a limb's parent comes before it, and has itself turned
        turned = body(body.pose_from_directions(many[:, :3], many[:, 3:6], direction))
        direction[:, i] = (to_torso(turned.rotations)[:, i] @ local[:, i, :, None])[..., 0]
    tried = body.pose_from_directions(many[:, :3], many[:, 3:6], direction)
    outside = (body.low - tried).clamp_min(0) + (tried - body.high).clamp_min(0)
    joints = tried[:, 6:].view(CANDIDATES, B, -1, 2)
    # All within the limits have nothing outside: the first of them is taken.
    best = outside[:, 6:].view(CANDIDATES, B, -1, 2).sum(-1).argmin(0)
    chosen = joints.gather(0, best[None, ..., None].expand(1, -1, -1, 2))[0].flatten(1)
    return torch.cat([pose[:, :6], torch.maximum(torch.minimum(chosen, body.high[6:]), body.low[6:])], 1)


def turn_all(
    body: BodyModel, pose: Float[Tensor, "batch parameters"], angle: float, generator: torch.Generator
) -> Float[Tensor, "batch parameters"]:
    """`turn_limbs`, with the root turned and shifted in proportion."""
    turned = turn_limbs(body, pose, angle, generator)
    ways = torch.randn(2, len(pose), 3, generator=generator).to(pose)
    ways = torch.nn.functional.normalize(ways, dim=-1)
    off = torch.cat([ROOT_SHIFT * angle * ways[0], ROOT_TURN * angle * ways[1]], 1)
    return torch.cat([turned[:, :6] + off, turned[:, 6:]], 1)


class Bench:
    """The product before one take."""

    def __init__(self, take: Take, config: InferConfig):
        self.take = take
        self.model = StereoToPose(CAMERA, config.eyes, config.pose)
        self.model.eyes = SimulatedEyes(take, config.eyes)
        spread = spread_positions(len(take.sights), config.pose.size_frames)
        self.model.size = self.model.measure_size([take.sights[i] for i in spread])
        self.plain = Registrar(self.model.body, plain(config.pose.registration))
        self.drawn = BodyModel()  # whose parameters the true poses are

    def own(self, pose: Float[Tensor, "batch parameters"]) -> Float[Tensor, "batch parameters"]:
        """A pose in the parameters of the body that is fitted, which may have other joints."""
        directions = self.drawn.limb_directions(self.drawn(pose))
        return self.model.body.pose_from_directions(pose[:, :3], pose[:, 3:6], directions)

    def starts(self, row: str, hide_face: bool, positions: Sequence[int]) -> list[Trial]:
        """The starter on single frames."""
        trials = []
        for i in positions:
            sight = self.take.sights[i]
            if hide_face:
                sight = replace(sight, faces=_unseen(sight.faces))
            found = self.model.tracker.starter(self.model.observe(sight), sight.faces, self.model.size)
            trials.append(self._alone(row, found, i))
        return trials

    def registrations(
        self,
        row: str,
        registrar: Registrar,
        wrong: Float[Tensor, "starts parameters"],
        positions: Sequence[int],
    ) -> list[Trial]:
        """One registration from each wrong pose."""
        size, take = self.model.size, self.take
        return [
            self._alone(row, registrar(self.model.observe(take.sights[i]), self.own(pose[None]), size), i)
            for i, pose in zip(positions, wrong, strict=True)
        ]

    def tracked(
        self, row: str, wrong: Float[Tensor, "starts parameters"], positions: Sequence[int]
    ) -> list[Trial]:
        """The tracker from each wrong pose, as the last frame's."""
        trials = []
        for i, pose in zip(positions, wrong, strict=True):
            self.model.tracker.forget()
            self.model.tracker.begin(self.own(pose[None]), (i - 1) / CAMERA.frame_rate)
            trials.append(self._follow(row, range(i, min(i + PATIENCE, len(self.take.sights)))))
        return trials

    def kicked(self, row: str, kicks: int, generator: torch.Generator) -> tuple[list[Trial], list[Trial]]:
        """Recoveries from kicks, and frame by frame what came before them."""
        tracker = self.model.tracker
        tracker.forget()
        before = self._follow("undisturbed", range(KICKED), until_right=False)
        # The first frame is a start.
        quiet = [
            Trial(
                before.row,
                before.right[i : i + 1],
                (TrackStatus(before.status[i]) in TOLD,),
                before.status[i : i + 1],
            )
            for i in range(1, KICKED)
        ]
        state, trials = tracker.state(), []
        for _ in range(kicks if state else 0):
            tracker.restore(dict(state))
            # Turned in the parameters of the true poses, from the true directions of the remembered pose.
            body = self.model.body
            remembered = state["pose"].to(body.axes)
            directions = body.limb_directions(body(remembered))
            drawn = self.drawn.pose_from_directions(remembered[:, :3], remembered[:, 3:6], directions)
            pose = self.own(turn_limbs(self.drawn, drawn, KICK, generator))
            tracker.restore({**state, "pose": pose})
            trials.append(self._follow(row, range(KICKED, len(self.take.sights))))
        return trials, quiet

    def _alone(self, row: str, found: Registration, position: int) -> Trial:
        joints = self.model.body(found.pose, self.model.size).joints
        right = bool(is_right(joints, self.take.joints[position : position + 1])[0])
        return Trial(row, (right,), (not self.model.tracker.acceptable(found),))

    def _follow(self, row: str, positions: range, until_right: bool = True) -> Trial:
        """Frames in order, until a pose is right or to the end."""
        right, doubted, status = [], [], []
        for i in positions:
            answer = self.model.follow(self.take.frame(i))
            alone = None if answer.registration is None else self._alone(row, answer.registration, i)
            right.append(alone is not None and alone.right[0])
            doubted.append(answer.status in TOLD or alone is None or alone.doubted[0])
            status.append(answer.status.value)
            if until_right and right[-1]:
                break
        return Trial(row, tuple(right), tuple(doubted), tuple(status))


def _unseen(faces: Faces) -> Faces:
    return replace(
        faces,
        box=torch.full_like(faces.box, torch.nan),
        found=torch.zeros_like(faces.found),
        mask=torch.zeros_like(faces.mask),
        position=torch.full_like(faces.position, torch.nan),
    )


def measure(motion: str, starts: int, config: InferConfig) -> list[Trial]:
    """All trials on one take."""
    take = simulate(motion, 0, FRAMES, config.eyes.sampling)
    torch.manual_seed(config.seed)
    bench, generator = Bench(take, config), random_stream("recovery", motion)
    # Enough frames must follow for the tracker's patience.
    spread = spread_positions(FRAMES - PATIENCE - 1, starts)
    positions = [1 + spread[i % len(spread)] for i in range(starts)]
    trials = bench.starts("nothing known, face", False, spread)
    trials += bench.starts("nothing known, no face", True, spread)
    for degrees in ANGLES:
        wrong = turn_all(bench.drawn, take.pose[positions], math.radians(degrees), generator)
        registrar = bench.model.tracker.registrar
        trials += bench.registrations(f"{degrees:.0f} degrees, plain EM", bench.plain, wrong, positions)
        trials += bench.registrations(f"{degrees:.0f} degrees, registrar", registrar, wrong, positions)
        trials += bench.tracked(f"{degrees:.0f} degrees, tracker", wrong, positions)
    kicked, quiet = bench.kicked(f"kick of {KICK} rad, tracker", starts, generator)
    return trials + kicked + quiet


def tally(trials: Sequence[Trial]) -> dict[str, float]:
    """The figures of one row; NaN where there is nothing to count."""
    right = [frame for trial in trials for frame in trial.right]
    doubted = [frame for trial in trials for frame in trial.doubted]
    needed = [trial.right.index(True) + 1 for trial in trials if any(trial.right)]
    # After a loss, to say that the person was found anew is no alarm.
    disturbed = trials[0].row.endswith("tracker")
    return {
        "trials": len(trials),
        "at_once": _share([trial.right[0] for trial in trials]),
        "recovered": _share([any(trial.right) for trial in trials]),
        "frames": sum(needed) / len(needed) if needed else math.nan,
        "known": _share([d for r, d in zip(right, doubted, strict=True) if not r]),
        "alarms": math.nan if disturbed else _share([d for r, d in zip(right, doubted, strict=True) if r]),
    }


def _share(flags: Sequence[bool]) -> float:
    return sum(flags) / len(flags) if flags else math.nan


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.recovery", description=__doc__.split("\n")[0])
    parser.add_argument("settings", nargs="*", help="settings of infer.py, key=value")
    parser.add_argument("--starts", type=int, default=4, help="of each kind in each motion")
    parser.add_argument("--only", help=f"only motions whose name contains this: {', '.join(MOTIONS)}")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_intermixed_args(argv)
    torch.set_num_threads(1)
    config = load_config("infer", arguments.settings)
    motions = [motion for motion in MOTIONS if not arguments.only or arguments.only in motion]
    if not motions:
        parser.error(f"--only must be part of one of {', '.join(MOTIONS)}, got {arguments.only!r}")
    if arguments.starts < 1:
        parser.error(f"--starts must be at least 1, got {arguments.starts}")
    trials: dict[str, list[Trial]] = {}
    lost: dict[str, Counter[str]] = {}
    with torch.no_grad():
        for motion in motions:
            for trial in measure(motion, arguments.starts, config):
                trials.setdefault(trial.row, []).append(trial)
                if not any(trial.right):
                    lost.setdefault(trial.row, Counter())[motion] += 1
    table = {row: tally(made) for row, made in trials.items()}
    print(f"{'start':<26}" + " ".join(f"{name:>9}" for name in next(iter(table.values()))))
    for row, figures in table.items():
        cells = [f"{value:>9.{_digits(name)}f}" for name, value in figures.items()]
        print(f"{row:<26}" + " ".join(cells))
    for row, made in trials.items():
        words = Counter(word for trial in made for word in trial.status)
        told = ", ".join(f"{word} {count}" for word, count in words.most_common())
        where = ", ".join(f"{motion} {count}" for motion, count in lost.get(row, Counter()).most_common())
        if told or where:
            print(f"{row}: {told or 'no status'}; not recovered: {where or 'none'}")
    if arguments.json:
        arguments.json.write_text(json.dumps({"settings": arguments.settings, "table": table, "lost": lost}))


def _digits(name: str) -> int:
    return 0 if name == "trials" else 1 if name == "frames" else 3


if __name__ == "__main__":
    main()
