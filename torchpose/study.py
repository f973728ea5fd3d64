"""A study of features: each set trains and scores the recogniser under one protocol, and the tables stand side by side.

Accuracies are shares, 0 to 1; seconds are of the wall clock.
"""

import statistics
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from torchpose.activity.dataset import Clip, Fold
from torchpose.activity.features import FeatureKind
from torchpose.activity.recognizer import Evaluation, Recognizer, RecognizerConfig
from torchpose.export import write_summary
from torchpose.figures import plot_confusions

# Tables 5.3 to 5.5, 8 activities, 15 training and 40 test sequences each.
THESIS_ACCURACY = {FeatureKind.pca: 0.5812, FeatureKind.ica: 0.6406, FeatureKind.angles: 0.9281}
_TITLES = {
    FeatureKind.angles: "joint angles",
    FeatureKind.directions: "limb directions",
    FeatureKind.pca: "PCA",
    FeatureKind.ica: "ICA",
    FeatureKind.skeleton: "skeletons",
}
_GAP = "   "


@dataclass(frozen=True)
class FeatureScore:
    """How well the recogniser does with one feature set."""

    kind: FeatureKind
    evaluation: Evaluation  # of all folds together
    of_folds: tuple[float, ...]  # accuracy of each
    seconds: float  # to train and to score, all folds
    recognizer: Recognizer  # of the training clips where there is one fold, else of all clips


def activities_of(clips: Sequence[Clip]) -> tuple[str, ...]:
    """The activities, in the order in which they first appear."""
    return tuple(dict.fromkeys(clip.activity for clip in clips))


def run_study(
    clips: Sequence[Clip],
    folds: Sequence[Fold],
    features: Sequence[FeatureKind],
    config: RecognizerConfig,
) -> list[FeatureScore]:
    """Train and score the recogniser with each feature set in turn; `config.feature.kind` is replaced.

    Raises ValueError where an activity is tested in a fold that has no training sequence of it, or where the clips
    lack what a feature needs.
    """
    _check_folds(clips, folds)
    with tqdm(
        total=len(features) * len(folds), desc="training", disable=not sys.stderr.isatty(), leave=False
    ) as bar:
        return [
            _score(clips, folds, replace(config, feature=replace(config.feature, kind=kind)), bar)
            for kind in features
        ]


def _score(clips: Sequence[Clip], folds: Sequence[Fold], config: RecognizerConfig, bar: tqdm) -> FeatureScore:
    activities = activities_of(clips)
    bar.set_postfix_str(config.feature.kind.value)
    begin = time.perf_counter()
    evaluations = []
    for fold in folds:
        recognizer = Recognizer(config, activities).fit([clips[i] for i in fold.train])
        evaluations.append(recognizer.evaluate([clips[i] for i in fold.test]))
        bar.update()
    evaluation = sum(evaluations[1:], start=evaluations[0])
    seconds = time.perf_counter() - begin
    if len(folds) > 1:
        recognizer = Recognizer(config, activities).fit(clips)
    of_folds = tuple(part.accuracy for part in evaluations)
    return FeatureScore(config.feature.kind, evaluation, of_folds, seconds, recognizer)


def _check_folds(clips: Sequence[Clip], folds: Sequence[Fold]) -> None:
    for number, fold in enumerate(folds, 1):
        taught = {clips[i].activity for i in fold.train}
        for i in fold.test:
            if clips[i].activity not in taught:
                raise ValueError(
                    f"every activity that is tested must have a training sequence, got none of {clips[i].activity!r} "
                    f"in fold {number} of {len(folds)}; choose another split, add sequences or leave it out"
                )


def count_material(clips: Sequence[Clip], folds: Sequence[Fold], states: int) -> dict[str, int]:
    """How many sequences, tests and frames there are, and how much of it says little.

    That is: frames of which nothing is known, sequences with fewer frames than an HMM has states, which end before its
    last state, and activities with a single sequence.
    """
    first = [clip.pose if clip.joints is None else clip.joints.flatten(1) for clip in clips]
    return {
        "sequences": len(clips),
        "tests": sum(len(fold.test) for fold in folds),
        "folds": len(folds),
        "frames": sum(len(clip) for clip in clips),
        "lost_frames": sum(int(rows.isnan().any(1).sum()) for rows in first if rows is not None),
        "short_sequences": sum(len(clip) < states for clip in clips),
        "single_sequence_activities": sum(
            count == 1 for count in Counter(clip.activity for clip in clips).values()
        ),
    }


def results_of(score: FeatureScore) -> dict[str, Any]:
    """Accuracy, accuracy by class, confusion (row: the truth, column: the answer) and seconds of a feature set."""
    evaluation = score.evaluation
    return {
        "accuracy": evaluation.accuracy,
        "accuracy_by_fold": score.of_folds,
        "accuracy_by_class": evaluation.accuracy_by_class,
        "confusion": evaluation.confusion.tolist(),
        "unanswered": dict(zip(evaluation.activities, evaluation.unanswered.tolist(), strict=True)),
        "seconds": score.seconds,
    }


def write_study(folder: Path, scores: Sequence[FeatureScore], about: Mapping[str, Any]) -> None:
    """Write recognisers into `recognizers/NAME/`, `confusion.png`, then `results.json` with `about` beside the scores.

    Its `activities` are in the order of the rows and columns of each confusion table.
    """
    for score in scores:
        score.recognizer.save(folder / "recognizers" / score.kind.value)
    plot_confusions(folder / "confusion.png", {_TITLES[score.kind]: score.evaluation for score in scores})
    results = {score.kind.value: results_of(score) for score in scores}
    activities = scores[0].evaluation.activities
    write_summary(folder / "results.json", {**about, "activities": activities, "features": results})


def study_table(
    scores: Sequence[FeatureScore], reference: Mapping[FeatureKind, float] | None = None, width: int = 80
) -> str:
    """The confusion tables side by side, as many as go into `width` columns; accuracies and seconds below them.

    A row is the truth, a column the answer, `-` none; `reference` holds the accuracies that the thesis reported.
    """
    reference = reference or {}
    activities = scores[0].evaluation.activities
    labels = ["", "", *(f"{number} {name}" for number, name in enumerate(activities, 1)), "right"]
    # Of a fold with a test or two the share says nothing.
    spread = all(len(score.of_folds) > 1 for score in scores) and all(
        int(score.evaluation.confusion.sum()) > len(activities) * len(score.of_folds) for score in scores
    )
    labels += ["+- of the folds"] * spread + ["in the thesis"] * bool(reference) + ["seconds"]
    column = max(map(len, labels))
    unanswered = any(bool(score.evaluation.unanswered.any()) for score in scores)
    tables = [_counts(score.evaluation, unanswered) for score in scores]
    cell = 1 + max(len(text) for table in tables for row in table for text in row)
    blocks = []
    for score, rows in zip(scores, tables, strict=True):
        lines = [_TITLES[score.kind], *("".join(text.rjust(cell) for text in row) for row in rows)]
        lines.append(f"{100 * score.evaluation.accuracy:.2f} %")
        if spread:
            lines.append(f"{100 * statistics.stdev(score.of_folds):.2f} %")
        if reference:
            lines.append(f"{100 * reference[score.kind]:.2f} %" if score.kind in reference else "")
        lines.append(f"{score.seconds:.1f}")
        wide = max(map(len, lines))
        blocks.append([line.rjust(wide) for line in lines])
    beside = max(1, (width - column) // (len(_GAP) + max(len(block[0]) for block in blocks)))
    return "\n\n".join(
        "\n".join(
            _GAP.join([label.ljust(column), *texts]).rstrip()
            for label, *texts in zip(labels, *blocks[start : start + beside], strict=True)
        )
        for start in range(0, len(blocks), beside)
    )


def _counts(evaluation: Evaluation, unanswered: bool) -> list[list[str]]:
    """The confusion table's head, which numbers the activities, and its rows; a dot is 0."""
    counts = evaluation.confusion
    if unanswered:
        counts = torch.cat([counts, evaluation.unanswered[:, None]], 1)
    head = [str(number) for number in range(1, len(evaluation.activities) + 1)] + ["-"] * unanswered
    return [head, *([str(count) if count else "." for count in row] for row in counts.tolist())]


def study_notes(about: Mapping[str, Any]) -> str:
    """What was learned from and how long it took, in a few lines."""
    data, seconds = about["data"], about["seconds"]
    folds = f" in {data['folds']} folds" if data["folds"] > 1 else ""
    lines = [
        f"sequences      {data['sequences']}, {data['tests']} tested{folds}; {data['frames']} frames, "
        f"{data['lost_frames']} without a pose"
    ]
    if data["short_sequences"]:
        lines.append(
            f"too short      {data['short_sequences']} sequences have fewer frames than the HMMs have states"
        )
    if data["single_sequence_activities"]:
        lines.append(f"few            {data['single_sequence_activities']} activities have a single sequence")
    if "angle_error_deg" in data:
        lines.append(
            f"limb angles    {data['angle_error_deg']:.1f} degrees off the rendered truth, on average"
        )
    lines.append(f"time           {seconds['all']:.0f} s, of which {seconds['data']:.0f} s for the data")
    return "\n".join(lines)
