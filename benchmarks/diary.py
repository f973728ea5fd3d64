"""The diary on 30 minutes of chained activities with pauses: frames, boundaries, speed.

python -m benchmarks.diary [--minutes 30] [--people 2] [--delay 3] [--json FILE] [--picture FILE]

What is recorded: the true poses of `torchpose.synthesis.motion`, the eight activities of the thesis for 4 to 20 s each
in random order, after seven of ten of them standing at ease for 2 to 8 s, passing from one to the next in 0.6 s, whose
middle counts as the boundary. Nothing is rendered, 30 minutes of which would take the pipeline hours. Instead every
angle has an error of its own, of 3 to 8 degrees standard deviation, that decays to 1/e in 0.4 s, and every 30 s on the
average the person is lost for 0.2 to 1.5 s. The pipeline's errors at 320 x 240 are as large, but follow the pose; these
do not. 10 frames a second. Training: 15 people, 4 sequences of 2.8 to 6 s of each activity, with such errors; the
people of the recording are others.

taught      the recogniser has learned the pause as a ninth activity
in common   it has not: a pause is what the eight have in common
stranger    as `taught`, on a recording with two motions more that were never learned, which should be `other`

frames      share of the frames with the right label; `other` is right for a stranger's motion
boundary    distance of each true boundary to the nearest that was found, median, and the share beyond 0.5 s
entries     found over true
odd frames  share of the stranger's frames that are `other`, and of the others' that are
faster      seconds of recording per second of CPU, one thread, settled with the delay as a live diary
"""

import argparse
import itertools
import json
import math
import time
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.activity.codebook import CodebookConfig
from torchpose.activity.dataset import Clip
from torchpose.activity.diary import OTHER, PAUSE, Diary, DiaryConfig, Entry
from torchpose.activity.features import FeatureConfig, Stream
from torchpose.activity.recognizer import Recognizer, RecognizerConfig
from torchpose.atomic import replacing
from torchpose.body.model import BodyModel
from torchpose.body.superquadric import draw_person
from torchpose.synthesis.database import synthetic_camera
from torchpose.synthesis.motion import ACTIVITIES, Draw, perform, pose_figure, stand_at_ease
from torchpose.timeline import Stretch, plot_timeline

RATE = 10.0  # Hz, as the package's database
BLEND = 0.6  # s, from one activity to the next; the boundary is its middle
NOISE = (math.radians(3), math.radians(8))  # standard deviation of a parameter's error, drawn for each
CORRELATION = 0.4  # s, in which the errors decay to 1/e
LOST_EVERY, LOST = 30.0, (0.2, 1.5)  # s between stretches without a pose, on average, and their length
TRAIN_PEOPLE, TAKES = tuple(range(100, 115)), 4
TEST_PEOPLE = 900  # the first of them
ROW = "{:10} {:>6} {:>7} {:>8} {:>7} {:>7} {:>6} {:>6} {:>7}"
STRANGE = ("shoulder", "elbow_horizontal")  # motions that are never learned


class Actors:
    """True motions with errors."""

    def __init__(self) -> None:
        self.body, self.camera = BodyModel(), synthetic_camera(320, 240, RATE)

    @torch.no_grad()
    def act(self, activity: str, frames: int, person: int, take: int) -> Float[Tensor, "time 24"]:
        times = torch.arange(frames) / RATE
        size = draw_person(person).size(self.body)
        if activity == PAUSE:
            figure = stand_at_ease(Draw("pause", person, take), times)
            heading = 0.61 * Draw("heading", person, take)(-1, 1)
            return pose_figure(self.body, figure, times.new_full((frames,), heading))
        return perform(self.body, size, activity, times, self.camera, person, take)


def disturbed(pose: Float[Tensor, "time 24"], generator: torch.Generator) -> Float[Tensor, "time 24"]:
    """The pose with correlated errors in every angle, and lost stretches."""
    T = len(pose)
    sd = NOISE[0] + (NOISE[1] - NOISE[0]) * torch.rand(20, generator=generator)
    keep = math.exp(-1 / (RATE * CORRELATION))
    fresh = torch.randn(T, 20, generator=generator) * sd * math.sqrt(1 - keep**2)
    error = torch.empty_like(fresh)
    error[0] = fresh[0] / math.sqrt(1 - keep**2)
    for t in range(1, T):
        error[t] = keep * error[t - 1] + fresh[t]
    noisy = pose.clone()
    noisy[:, 4:] += error
    position = 0.0
    while True:
        position += -LOST_EVERY * math.log(1 - float(torch.rand((), generator=generator)))
        length = LOST[0] + (LOST[1] - LOST[0]) * float(torch.rand((), generator=generator))
        start = round(position * RATE)
        if start >= T:
            return noisy
        noisy[start : start + round(length * RATE)] = torch.nan
        position += length


@dataclass(frozen=True)
class Day:
    """A recording and what was done in it."""

    clip: Clip
    labels: tuple[str, ...]  # of each frame
    boundaries: tuple[int, ...]  # first frames of segments, but for the first


def make_day(actors: Actors, minutes: float, person: int, seed: int, strange: bool = False) -> Day:
    """A recording of one person; no activity comes twice in succession."""
    draw = Draw("day", person, seed)
    choice = [*ACTIVITIES, *(STRANGE if strange else ())]
    total, half = round(60 * minutes * RATE), round(BLEND * RATE / 2)
    mix = torch.linspace(0, 1, 2 * half + 2)[1:-1, None]
    pose, labels, boundaries = torch.empty(0, 24), list[str](), list[int]()
    last = name = ""
    take = 0
    while len(labels) < total:
        if name not in ("", PAUSE) and draw(0, 1) < 0.7:
            name, frames = PAUSE, round(draw(2, 8) * RATE)
        else:
            name = last = [other for other in choice if other != last][int(draw(0, len(choice) - bool(last)))]
            frames = round(draw(4, 20) * RATE)
        part = actors.act(name, frames + 2 * half, person, take)
        take += 1
        if len(labels) > 0:
            boundaries.append(len(labels))
            blend = (1 - mix) * pose[-2 * half :] + mix * part[: 2 * half]
            pose = torch.cat([pose[: -2 * half], blend, part[2 * half :]])
        else:
            pose = part
        labels += [name] * (len(pose) - half - len(labels))
    labels = [OTHER if name in STRANGE else name for name in labels[:total]]
    pose = disturbed(pose[:total], torch.Generator().manual_seed(1000 * person + seed))
    clip = Clip("day", str(person), str(seed), pose=pose)
    return Day(clip, tuple(labels), tuple(b for b in boundaries if b < total))


def training_clips(actors: Actors, pause: bool) -> list[Clip]:
    """Sequences of the training people, of all lengths alike for each activity."""
    clips = []
    for number, name in enumerate((*ACTIVITIES, PAUSE) if pause else ACTIVITIES):
        for person in TRAIN_PEOPLE:
            for take in range(TAKES):
                frames = int(Draw("length", number, person, take)(28, 60))
                generator = torch.Generator().manual_seed(100_000 * number + 100 * person + take)
                pose = disturbed(actors.act(name, frames, person, take), generator)
                clips.append(Clip(name, str(person), str(take), pose=pose))
    return clips


def train(actors: Actors, pause: bool) -> Recognizer:
    """Angles and their changes, 128 symbols each."""
    config = RecognizerConfig(
        feature=FeatureConfig(streams=(Stream.feature, Stream.velocity)), codebook=CodebookConfig(size=128)
    )
    return Recognizer(config).fit(training_clips(actors, pause))


@dataclass(frozen=True)
class Score:
    """How good a diary is."""

    case: str
    person: int
    frames: float
    boundary_s: float
    beyond: float  # share of the boundaries that are further than 0.5 s from any that was found
    entries: float
    odd_found: float  # NaN without a stranger's motion
    odd_wrong: float
    faster: float


def by_frame(entries: list[Entry], frames: int) -> list[str]:
    """The label of each frame."""
    found = [""] * frames
    for entry in entries:
        start, end = round(entry.start_s * RATE), min(frames, round(entry.end_s * RATE))
        found[start:end] = [entry.activity] * (end - start)
    return found


def score(case: str, diary: Diary, day: Day, person: int) -> tuple[Score, list[Entry]]:
    """Write a day's diary and compare it with what was done."""
    begin = time.process_time()
    entries = diary.write(day.clip)
    seconds = time.process_time() - begin
    found, truth = by_frame(entries, len(day.labels)), day.labels
    cuts = torch.tensor([entry.start_s for entry in entries[1:]])
    apart = (torch.tensor(day.boundaries)[:, None] / RATE - cuts).abs().amin(1)
    odd = [label == OTHER for label in truth]
    said = [label == OTHER for label in found]
    both = sum(a and b for a, b in zip(odd, said, strict=True))
    return Score(
        case,
        person,
        sum(a == b for a, b in zip(found, truth, strict=True)) / len(truth),
        float(apart.median()),
        float((apart > 0.5 + 1e-6).float().mean()),
        len(entries) / (len(day.boundaries) + 1),
        both / sum(odd) if any(odd) else math.nan,
        (sum(said) - both) / (len(odd) - sum(odd)),
        len(truth) / RATE / seconds,
    ), entries


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--people", type=int, default=2)
    parser.add_argument("--delay", type=float, default=3.0, help="s; negative settles all at the end")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--picture", type=Path, help="timeline of the first person's diary, truth above")
    args = parser.parse_args()
    torch.set_num_threads(1)
    actors = Actors()
    delay = None if args.delay < 0 else args.delay
    print(ROW.format("", "person", "frames", "boundary", "beyond", "entries", "odd", "frames", "faster"))
    scores: list[Score] = []
    models: dict[bool, Recognizer] = {}  # whether the pause was taught
    for case in ("taught", "in common", "stranger"):
        taught = case != "in common"
        if taught not in models:
            models[taught] = train(actors, taught)
        diary = Diary(models[taught], DiaryConfig(delay=delay, pause=PAUSE if taught else None))
        for person in range(TEST_PEOPLE, TEST_PEOPLE + args.people):
            day = make_day(actors, args.minutes, person, 0, case == "stranger")
            found, entries = score(case, diary, day, person)
            scores.append(found)
            numbers = (
                found.frames,
                found.boundary_s,
                found.beyond,
                found.entries,
                found.odd_found,
                found.odd_wrong,
            )
            print(ROW.format(case, person, *(f"{x:.3f}" for x in numbers), f"{found.faster:.0f}"), flush=True)
            if args.picture is not None and len(scores) == 1:
                draw_picture(args.picture, day, entries)
    if args.json is not None:
        with replacing(args.json) as partial:
            partial.write_text(json.dumps([asdict(found) for found in scores], indent=2) + "\n")


def draw_picture(path: Path, day: Day, entries: list[Entry]) -> None:
    """The truth and the diary, one above the other, as if it began at 9 o'clock."""
    begin = datetime(2026, 11, 23, 9)
    edges = [0, *day.boundaries, len(day.labels)]
    truth = [Entry(a / RATE, b / RATE, day.labels[a], 0.0) for a, b in itertools.pairwise(edges)]
    stretches = [
        Stretch(name, begin + timedelta(seconds=e.start_s), begin + timedelta(seconds=e.end_s), e.activity)
        for name, part in (("a truth", truth), ("b diary", entries))
        for e in part
    ]
    plot_timeline(path, stretches)


if __name__ == "__main__":
    main()
