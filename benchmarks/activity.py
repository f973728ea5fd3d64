"""The thesis's three tables of recognised activities (T. 5.3), beside ours: joint angles, PCA, ICA.

python -m benchmarks.activity [--cache DIR] [--seeds N] [--only FEATURE] [--make] [--any-version] [--partial]
    [--json FILE] [KEY=VALUE ...]

The clips are those of `python train.py experiment=thesis`, from its cache; `--make` makes what is missing there, in
minutes to an hour. Features come from what the pipeline estimates from rendered stereo pairs, and no test person
trains. Mean and standard deviation are over starts of codebooks, HMMs and ICA on this one database: they say nothing of
how another database would come out.

thesis  one stream of symbols, a left-to-right HMM of four states for each activity, the most likely one: the protocol
        of the thesis, whose own figures are beside it. They are of other recordings.
ours    for each feature the options that do best in leaving out a quarter of the *training* people in turn (one
        start): the list has them all with the share that they got there. For joint angles the limb directions are an
        option, too. Choosing takes a few minutes of a core for each feature; `--only-thesis` leaves it out.
"""

import argparse
import json
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from tqdm import tqdm

from torchpose.activity.baum_welch import Topology
from torchpose.activity.dataset import Clip, Fold
from torchpose.activity.features import FeatureKind, Stream
from torchpose.activity.recognizer import Evaluation, Recognizer, RecognizerConfig
from torchpose.atomic import replacing
from torchpose.cli import load_config
from torchpose.clips import ClipMaker, ObservedClip, build_database, read_clip
from torchpose.synthesis.database import PlannedClip, plan_database

# Tables 5.3, 5.4 and 5.5, in the order of `ACTIVITIES`, percent.
THESIS = {
    FeatureKind.pca: (47.5, 55.0, 60.0, 20.0, 60.0, 67.5, 70.0, 85.0),
    FeatureKind.ica: (47.5, 60.0, 67.5, 30.0, 72.5, 72.5, 75.0, 87.5),
    FeatureKind.angles: (87.5, 97.5, 87.5, 95.0, 92.5, 95.0, 92.5, 95.0),
}
TITLES = {FeatureKind.pca: "PCA", FeatureKind.ica: "ICA", FeatureKind.angles: "joint angles"}
GROUPS, TRIES = 4, 1  # of the training people, left out in turn; starts of each
ENSEMBLE = 5


@dataclass(frozen=True)
class Option:
    """A configuration, and how often it is right on training people that were left out."""

    name: str
    held_out: float  # percent


@dataclass(frozen=True)
class Table:
    """A feature under a protocol; percent, over the starts."""

    feature: str
    protocol: str  # thesis or ours
    name: str  # of the options
    mean: float
    sd: float
    by_class: dict[str, float]
    thesis: dict[str, float]
    confusion: list[list[int]]  # of all starts; row: the truth, column: the answer
    unanswered: list[int]
    seconds: float  # to train and score once
    options: list[Option]


def find_clips(
    maker: ClipMaker, any_version: bool, partial: bool
) -> tuple[list[PlannedClip], list[ObservedClip]]:
    """The planned clips that are in the cache.

    Raises ValueError where one is missing, unless `partial`; `any_version` takes one that other code or settings made.
    """
    plan = plan_database(maker.data.database)
    found = {planned: maker.find(planned) for planned in plan}
    if any_version:
        found |= {planned: _newest(maker, planned) for planned in plan if found[planned] is None}
    there = {planned: clip for planned, clip in found.items() if clip is not None}
    if len(there) < len(plan) and not (partial and there):
        raise ValueError(
            f"all {len(plan)} clips must be in {maker.data.cache}, got {len(there)}; run python train.py "
            "experiment=thesis with the same data.cache, or give --make, --any-version or --partial"
        )
    return list(there), list(there.values())


def _newest(maker: ClipMaker, planned: PlannedClip) -> ObservedClip | None:
    """The last clip of this take that is as long as planned, whatever made it."""
    prefix = maker.path(planned).stem.rpartition("-")[0]
    files = sorted(Path(maker.data.cache).glob(f"{prefix}-*.npz"), key=lambda path: -path.stat().st_mtime)
    clips = (read_clip(planned, path) for path in files)
    return next((clip for clip in clips if clip is not None and len(clip.clip) == planned.frames), None)


def options_of(kind: FeatureKind, config: RecognizerConfig) -> dict[str, RecognizerConfig]:
    """The configurations to choose from; the first is the thesis's."""
    kinds = {FeatureKind.angles: (FeatureKind.angles, FeatureKind.directions)}.get(kind, (kind,))
    both = (Stream.feature, Stream.velocity)
    options: dict[str, RecognizerConfig] = {}
    for one in kinds:
        plain = replace(config, feature=replace(config.feature, kind=one))
        moving = replace(plain, feature=replace(plain.feature, streams=both))
        free = replace(moving, hmm=replace(moving.hmm, topology=Topology.ergodic))
        steps = {
            "": plain,
            ", velocity": moving,
            ", velocity, ergodic": free,
            f", velocity, {ENSEMBLE} members": replace(moving, members=ENSEMBLE),
            f", velocity, ergodic, {ENSEMBLE} members": replace(free, members=ENSEMBLE),
            ", velocity, ergodic, layer": replace(free, layer=replace(free.layer, enabled=True)),
        }
        if one is FeatureKind.angles:
            steps[", certainty"] = replace(plain, certainty=True)
            steps[", velocity, ergodic, certainty"] = replace(free, certainty=True)
        options |= {one.value + name: option for name, option in steps.items()}
    return options


def groups_of_people(clips: Sequence[Clip], train: Sequence[int]) -> list[Fold]:
    """The training clips in folds: each tests a part of the people on what the others taught."""
    people = sorted({clips[i].subject for i in train})
    if len(people) < 2:
        raise ValueError(
            f"to choose needs at least two training people, got {len(people)}; give data.database.train_subjects=2 or "
            "--only-thesis"
        )
    folds = []
    for number in range(min(GROUPS, len(people))):
        out = set(people[number::GROUPS])
        folds.append(
            Fold(
                tuple(i for i in train if clips[i].subject not in out),
                tuple(i for i in train if clips[i].subject in out),
            )
        )
    return folds


def evaluate(
    clips: Sequence[Clip], folds: Sequence[Fold], config: RecognizerConfig, seed: int, names: tuple[str, ...]
) -> Evaluation:
    """All folds together, from one start."""
    parts = [
        Recognizer(replace(config, seed=seed), names)
        .fit([clips[i] for i in fold.train])
        .evaluate([clips[i] for i in fold.test])
        for fold in folds
    ]
    return sum(parts[1:], start=parts[0])


def make_tables(
    clips: Sequence[Clip],
    fold: Fold,
    kinds: Sequence[FeatureKind],
    config: RecognizerConfig,
    names: tuple[str, ...],
    seeds: int,
    choose: bool = True,
) -> list[Table]:
    """The tables of each feature: the thesis's protocol, then, with `choose`, what is best on the training people."""
    tables = []
    inner = groups_of_people(clips, fold.train) if choose else []
    for kind in kinds:
        options = options_of(kind, config)
        plain = next(iter(options))
        tables.append(_table(clips, fold, kind, "thesis", plain, options[plain], names, seeds, []))
        if not choose:
            continue
        tried = []
        for name, option in tqdm(options.items(), desc=TITLES[kind], leave=False, disable=None):
            right = [evaluate(clips, inner, option, seed, names).accuracy for seed in range(TRIES)]
            tried.append(Option(name, 100 * statistics.fmean(right)))
        best = max(tried, key=lambda option: option.held_out).name
        tables.append(_table(clips, fold, kind, "ours", best, options[best], names, seeds, tried))
    return tables


def _table(
    clips: Sequence[Clip],
    fold: Fold,
    kind: FeatureKind,
    protocol: str,
    name: str,
    config: RecognizerConfig,
    names: tuple[str, ...],
    seeds: int,
    options: list[Option],
) -> Table:
    begin = time.perf_counter()
    runs = [evaluate(clips, [fold], config, seed, names) for seed in range(seeds)]
    seconds = (time.perf_counter() - begin) / seeds
    right = [100 * run.accuracy for run in runs]
    whole = sum(runs[1:], start=runs[0])
    return Table(
        feature=TITLES[kind],
        protocol=protocol,
        name=name,
        mean=statistics.fmean(right),
        sd=statistics.stdev(right) if seeds > 1 else 0.0,
        by_class={activity: 100 * share for activity, share in whole.accuracy_by_class.items()},
        thesis=dict(zip(names, THESIS[kind], strict=False)),
        confusion=whole.confusion.tolist(),
        unanswered=whole.unanswered.tolist(),
        seconds=seconds,
        options=options,
    )


def render(tables: Sequence[Table], names: tuple[str, ...]) -> str:
    """The shares side by side, then every confusion table, and what was chosen from."""
    features = list(dict.fromkeys(table.feature for table in tables))
    lines = ["percent right".ljust(14) + "".join(f"{feature:>30}" for feature in features)]
    heads = ["T.", *dict.fromkeys(table.protocol for table in tables)]
    lines.append(" " * 14 + "".join(f"{head:>10}" for _ in features for head in heads).rstrip())

    def cells(text: str, value: str) -> str:
        row = text.ljust(14)
        for feature in features:
            of_feature = [table for table in tables if table.feature == feature]
            known = of_feature[0].thesis
            if value == "class":
                shares = [known.get(text, float("nan")), *(table.by_class[text] for table in of_feature)]
            elif value == "mean":
                shares = [statistics.fmean(known.values()), *(table.mean for table in of_feature)]
            else:
                shares = [float("nan"), *(getattr(table, value) for table in of_feature)]
            row += "".join(f"{'' if share != share else f'{share:.2f}':>10}" for share in shares)
        return row.rstrip()

    lines += [cells(name, "class") for name in names]
    lines += [cells("all", "mean"), cells("+- of starts", "sd"), cells("s to train", "seconds")]
    for table in tables:
        lines.append(f"\n{table.feature}, {table.protocol}: {table.name}; answers of all starts together")
        width = 1 + max(len(str(count)) for row in table.confusion for count in row)
        counts = [[*row, none] for row, none in zip(table.confusion, table.unanswered, strict=True)]
        head = [*map(str, range(1, len(names) + 1)), "-"]
        lines.append(" " * 14 + "".join(text.rjust(max(width, 3)) for text in head))
        for number, (name, row) in enumerate(zip(names, counts, strict=True), 1):
            texts = (str(count) if count else "." for count in row)
            lines.append(f"{number} {name}".ljust(14) + "".join(text.rjust(max(width, 3)) for text in texts))
        lines += [f"  {option.held_out:6.2f} on training people: {option.name}" for option in table.options]
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cache", type=Path, help="folder with the clips; else that of the settings")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", choices=[kind.value for kind in THESIS], help="one of the features")
    parser.add_argument("--only-thesis", action="store_true", help="its protocol alone: nothing is chosen")
    parser.add_argument("--make", action="store_true", help="make the clips that are missing")
    parser.add_argument("--any-version", action="store_true", help="take clips that other code made")
    parser.add_argument("--partial", action="store_true", help="go on with the clips that are there")
    parser.add_argument("--json", type=Path, help="write the figures there as well")
    parser.add_argument(
        "settings", nargs="*", help="of train.py, as key=value; experiment=thesis is the default"
    )
    options = parser.parse_intermixed_args(arguments)
    settings = options.settings
    if not any(setting.startswith("experiment=") for setting in settings):
        settings = ["experiment=thesis", *settings]
    if options.cache is not None:
        settings = [*settings, f"data.cache={options.cache}"]
    config = load_config("train", settings)
    torch.set_num_threads(1)
    maker = ClipMaker(config.data, config.eyes, config.pose, config.device)
    if options.make:
        build_database(maker, config.workers)
    plan, observed = find_clips(maker, options.any_version, options.partial)
    clips = [one.clip for one in observed]
    train, test = (
        tuple(i for i, planned in enumerate(plan) if planned.split == split) for split in ("train", "test")
    )
    error = torch.cat([one.angle_error for one in observed]).nanmean().rad2deg()
    lost = sum(int(clip.stream("pose").isnan().any(1).sum()) for clip in clips)
    people = len({clip.subject for clip in clips})
    print(
        f"{len(train)} training and {len(test)} test sequences of {people} people; {sum(map(len, clips))} frames, "
        f"{lost} without a pose; limb angles {error:.1f} degrees off; {options.seeds} starts on this one database\n"
    )
    names = config.data.database.activities
    kinds = [FeatureKind(options.only)] if options.only else list(THESIS)
    tables = make_tables(
        clips, Fold(train, test), kinds, config.recognizer, names, options.seeds, not options.only_thesis
    )
    print(render(tables, names))
    if options.json is not None:
        data = {
            "train": len(train),
            "test": len(test),
            "angle_error_deg": float(error),
            "seeds": options.seeds,
            "activities": names,
        }
        with replacing(options.json) as partial:
            partial.write_text(json.dumps(data | {"tables": [asdict(table) for table in tables]}, indent=1))


if __name__ == "__main__":
    main()
