"""`python train.py`: the comparison of features, its files and tables, and bad input in one sentence."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from clip_stand_in import DATABASE, Maker, tiny_maker

from torchpose.activity.codebook import CodebookConfig
from torchpose.activity.dataset import Clip, Fold, Split, split_clips
from torchpose.activity.features import FeatureConfig, FeatureKind
from torchpose.activity.recognizer import Evaluation, Recognizer, RecognizerConfig
from torchpose.cli import load_config, train_main
from torchpose.clips import ClipMaker, build_database
from torchpose.study import THESIS_ACCURACY, FeatureScore, count_material, run_study, study_notes, study_table
from torchpose.synthesis.database import plan_database

RECOGNIZER = RecognizerConfig(FeatureConfig(num_components=10), CodebookConfig(size=8, restarts=1))
# The same on the command line.
TINY = (
    "data.database.activities=[left_hand,right_leg]",
    "data.database.train_subjects=1",
    "data.database.test_subjects=1",
    "data.database.train_sequences=2",
    "data.database.test_sequences=2",
    "data.database.frames=[28,32]",
    "data.database.width=64",
    "data.database.height=48",
    "recognizer.codebook.size=8",
    "recognizer.feature.num_components=10",
    "recognizer.codebook.restarts=1",
    "workers=1",
)


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> Maker:
    made = Maker()
    monkeypatch.setattr(ClipMaker, "make", lambda maker, planned: made(maker, planned))
    return made


def test_the_study_counts_right_and_wrong_answers(tmp_path: Path, stand_in: Maker):
    database = build_database(tiny_maker(tmp_path), workers=1)
    clips, fold = database.clips, database.fold
    kinds = (FeatureKind.angles, FeatureKind.pca)
    angles, pca = run_study(clips, [fold], kinds, RECOGNIZER)
    assert (angles.kind, pca.kind) == kinds
    assert angles.evaluation.activities == ("left_hand", "right_leg")
    assert angles.evaluation.confusion.tolist() == [[2, 0], [0, 2]]
    assert int(pca.evaluation.confusion.sum()) == 4
    assert angles.seconds > 0
    # A test clip under a wrong name is answered by its right one, which then is the wrong one.
    clips[2] = replace(clips[2], activity="right_leg")
    wrong = run_study(clips, [fold], [FeatureKind.angles], RECOGNIZER)[0]
    assert wrong.evaluation.confusion.tolist() == [[1, 0], [1, 2]]
    assert wrong.evaluation.accuracy == 0.75


def test_folds_add_up_and_the_recogniser_learns_from_all_of_them(tmp_path: Path, stand_in: Maker):
    clips = build_database(tiny_maker(tmp_path), workers=1).clips
    folds = split_clips(clips, Split.leave_one_subject_out)
    assert len(folds) == 2
    score = run_study(clips, folds, [FeatureKind.angles], RECOGNIZER)[0]
    assert int(score.evaluation.confusion.sum()) == 8
    whole = Recognizer(
        replace(RECOGNIZER, feature=replace(RECOGNIZER.feature, kind=FeatureKind.angles)),
        ("left_hand", "right_leg"),
    ).fit(clips)
    assert torch.equal(score.recognizer(clips).log_likelihood, whole(clips).log_likelihood)


def run(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    code = train_main(argv)
    return code, *capsys.readouterr()


def test_train_writes_and_prints_what_it_promises(
    tmp_path: Path, stand_in: Maker, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("COLUMNS", "80")
    output = tmp_path / "results"
    argv = (*TINY, f"output={output}", f"data.cache={tmp_path / 'cache'}", "seed=3")
    code, out, err = run(capsys, *argv)
    assert (code, err) == (0, "")
    results = json.loads((output / "results.json").read_text())
    assert results["seed"] == results["settings"]["seed"] == 3
    assert results["settings"]["data"]["database"]["frames"] == [28, 32]
    assert results["version"]
    assert results["activities"] == ["left_hand", "right_leg"]
    assert results["data"]["sequences"] == 8
    assert results["data"]["tests"] == 4
    assert results["data"]["lost_frames"] == 8  # one a clip
    assert results["data"]["angle_error_deg"] == pytest.approx(np.rad2deg(0.1), abs=1e-3)
    assert set(results["features"]) == {"pca", "ica", "angles"}
    for name, scored in results["features"].items():
        confusion = torch.tensor(scored["confusion"])
        assert confusion.sum(1).tolist() == [2, 2]
        assert scored["accuracy"] == pytest.approx(float(confusion.diagonal().sum()) / 4)
        by_class = scored["accuracy_by_class"]
        assert [by_class[a] for a in results["activities"]] == (confusion.diagonal() / 2).tolist()
        assert scored["seconds"] > 0
        recognizer = Recognizer.load(output / "recognizers" / name)
        assert recognizer.config.feature.kind.value == name
        assert recognizer.config.seed == 3
    assert results["features"]["angles"]["accuracy"] == 1.0
    for text in ("PCA", "ICA", "joint angles", "58.12 %", "64.06 %", "92.81 %", "100.00 %", "1 left_hand"):
        assert text in out
    assert max(map(len, out.splitlines()[:8])) <= 80

    # The same again, all from the cache.
    made = len(stand_in.made)
    assert run(capsys, *argv)[0] == 0
    assert len(stand_in.made) == made
    again = json.loads((output / "results.json").read_text())
    for name, scored in results["features"].items():
        assert {**again["features"][name], "seconds": 0} == {**scored, "seconds": 0}


def test_an_interrupted_train_leaves_the_old_results(
    tmp_path: Path, stand_in: Maker, capsys: pytest.CaptureFixture[str]
):
    argv = (*TINY, f"output={tmp_path / 'results'}", f"data.cache={tmp_path / 'cache'}")
    stand_in.interrupt_at = 5
    assert run(capsys, *argv)[0] == 130
    assert not list((tmp_path / "results").glob("*"))
    stand_in.interrupt_at = None
    assert run(capsys, *argv)[0] == 0
    assert stand_in.made == plan_database(DATABASE)


JOINTS = ("head", "shoulder_left", "shoulder_right", "elbow_left", "wrist_left", "hip_left", "hip_right")
STANDING = ((0, 1.6), (0.2, 1.4), (-0.2, 1.4), (0.25, 1.1), (0.25, 0.85), (0.1, 0.9), (-0.1, 0.9))


def write_skeletons(
    path: Path, labels: tuple[str, ...] = ("wave", "rest"), drop: tuple[str, str] | None = None
) -> Path:
    """Four subjects, two takes each: an arm that is raised, or not; y up, m. `drop` leaves a (label, subject) out."""
    generator = torch.Generator().manual_seed(0)
    joints, rows = [], []
    for label in labels:
        for subject in "1234":
            for take in "12":
                if (label, subject) == drop:
                    continue
                frames = int(torch.randint(12, 18, (), generator=generator))
                at = torch.tensor(STANDING).repeat(frames, 1, 1)
                still = torch.cat([at, torch.zeros(frames, len(JOINTS), 1)], 2)
                if label == "wave":
                    turn = torch.linspace(0, 3, frames)
                    hand = torch.stack([turn.sin(), -turn.cos(), 0 * turn], 1)
                    still[:, 3] = still[:, 1] + 0.3 * hand
                    still[:, 4] = still[:, 1] + 0.55 * hand
                joints.append(still + 0.01 * torch.randn(still.shape, generator=generator))
                rows.append((label, subject, take))
    label, subject, take = zip(*rows, strict=True)
    offsets = np.cumsum([0, *map(len, joints)])
    stack = torch.cat(joints).numpy()
    np.savez(path, joints=stack, offsets=offsets, label=label, subject=subject, take=take, joint_names=JOINTS)
    return path


@pytest.mark.parametrize(
    ("split", "folds", "tests"),
    [
        ("half_subjects", 3, 24),
        ("cross_subject", 1, 8),
        ("leave_one_subject_out", 4, 16),
        ("leave_one_sequence_out", 16, 16),
    ],
)
def test_skeletons_go_through_the_same_study(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], split: str, folds: int, tests: int
):
    data = write_skeletons(tmp_path / "skeletons.npz")
    small = (
        "recognizer.codebook.size=6",
        "recognizer.members=1",
        "recognizer.feature.streams=[feature,velocity]",
        "splits=3",
        f"output={tmp_path}",
    )
    code, out, err = run(capsys, "experiment=skeleton", f"data.path={data}", f"split={split}", *small)
    assert (code, err) == (0, "")
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["data"] == {
        "sequences": 16,
        "tests": tests,
        "folds": folds,
        "frames": results["data"]["frames"],
        "lost_frames": 0,
        "short_sequences": 0,
        "single_sequence_activities": 0,
    }
    skeleton = results["features"]["skeleton"]
    assert skeleton["confusion"] == [[tests // 2, 0], [0, tests // 2]]
    assert skeleton["accuracy_by_fold"] == [1.0] * folds
    assert ("+- of the folds" in out) == (split in ("half_subjects", "leave_one_subject_out"))
    assert (tmp_path / "confusion.png").stat().st_size > 5000
    assert skeleton["accuracy_by_class"] == {"wave": 1.0, "rest": 1.0}
    assert "thesis" not in out
    assert Recognizer.load(tmp_path / "recognizers" / "skeleton").activities == ("wave", "rest")


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (
            ["experiment=skeleton", "data.path=nowhere.npz"],
            "no skeleton data set at nowhere.npz; give an .npz",
        ),
        (
            ["experiment=skeleton"],
            "data.path must be a skeleton data set for the features [skeleton], got null",
        ),
        (["data.path=x.npz"], "features must be [skeleton] for a skeleton data set, got [pca, ica, angles]"),
        (["split=odd"], "split must be one of cross_subject, half_subjects, leave_one_subject_out"),
        (["experiment=slow"], "unknown experiment 'slow'"),
        (["features=[]"], "features must be one or more, each once, got none"),
        (["features=[pca,pca]"], "features must be one or more, each once, got pca, pca"),
        (["features=[pcb]"], "features must be a list [...]"),
        (["splits=0"], "splits must be at least 1, got 0"),
        (["workers=0"], "workers must be at least 1, got 0"),
        (["recognizer.feature.kind=pca"], "recognizer.feature.kind and recognizer.seed must be left alone"),
        (["recognizer.seed=1"], "recognizer.feature.kind and recognizer.seed must be left alone"),
        (["data.silhouette_height=0"], "data.silhouette_height must be at least 1 px, got 0"),
        (["data.database.train_sequences=0"], "data.database.train_sequences must be at least 1, got 0"),
        (["data.database.activities=[juggling]"], "activities must be some of"),
        (["data.databse.seed=1"], "unknown config key 'data.databse.seed'; did you mean 'database'?"),
    ],
)
def test_bad_input_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], argv: list[str], message: str
):
    code, out, err = run(capsys, *argv, f"output={tmp_path / 'results'}")
    assert (code, out) == (2, "")
    assert message in err
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert not list((tmp_path / "results").glob("*"))


def test_an_activity_needs_a_training_sequence_in_every_fold(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    data = write_skeletons(tmp_path / "skeletons.npz", drop=("wave", "1"))
    with np.load(data) as arrays:
        label = arrays["label"].copy()
    label[0] = "jump"  # a single sequence
    with np.load(data) as arrays:
        np.savez(data, **{**arrays, "label": label})
    argv = (
        "experiment=skeleton",
        f"data.path={data}",
        "split=leave_one_sequence_out",
        f"output={tmp_path / 'r'}",
    )
    code, _, err = run(capsys, *argv)
    assert code == 2
    assert (
        "every activity that is tested must have a training sequence, got none of 'jump' in fold 1 of 14"
        in err
    )
    assert not list((tmp_path / "r").glob("*"))


def scored(
    kind: FeatureKind, confusion: list[list[int]], unanswered: list[int] | None = None
) -> FeatureScore:
    names = ("left_hand", "boxing", *(f"activity_{n}" for n in range(2, len(confusion))))
    lacking = torch.tensor(unanswered or [0] * len(confusion))
    evaluation = Evaluation(names[: len(confusion)], torch.tensor(confusion), lacking)
    return FeatureScore(kind, evaluation, (evaluation.accuracy,), 1.25, Recognizer())


def test_the_tables_stand_side_by_side():
    scores = [scored(FeatureKind.pca, [[2, 1], [0, 3]]), scored(FeatureKind.angles, [[3, 0], [0, 2]], [0, 1])]
    assert study_table(scores, THESIS_ACCURACY) == "\n".join(
        (
            "                    PCA   joint angles",
            "                  1 2 -          1 2 -",
            "1 left_hand       2 1 .          3 . .",
            "2 boxing          . 3 .          . 2 1",
            "right           83.33 %        83.33 %",
            "in the thesis   58.12 %        92.81 %",
            "seconds             1.2            1.2",
        )
    )


def test_tables_that_are_too_wide_stand_below_each_other():
    eight = (torch.eye(8, dtype=torch.long) * 3).tolist()
    scores = [scored(kind, eight) for kind in THESIS_ACCURACY]
    beside = study_table(scores, THESIS_ACCURACY, 80).splitlines()
    assert len(beside) == 13
    assert max(map(len, beside)) <= 80
    below = study_table(
        [scored(kind, (torch.eye(8, dtype=torch.long) * 40).tolist()) for kind in THESIS_ACCURACY]
    )
    assert len(below.splitlines()) == 2 * 12 + 1
    assert max(map(len, below.splitlines())) <= 80
    assert len(study_table(scores, width=10).splitlines()) == 3 * 12 + 2


def test_lost_frames_are_counted():
    joints = torch.ones(4, 7, 3)
    joints[1:3] = torch.nan
    clips = [
        Clip("a", "1", "1", joints=joints, joint_names=JOINTS),
        Clip("a", "2", "1", pose=torch.zeros(5, 24)),
    ]
    counted = count_material(clips, [Fold((0,), (1,))], states=5)
    assert counted == {
        "sequences": 2,
        "tests": 1,
        "folds": 1,
        "frames": 9,
        "lost_frames": 2,
        "short_sequences": 1,
        "single_sequence_activities": 0,
    }
    odd = count_material([clips[0], replace(clips[1], activity="b")], [Fold((0,), (1,))], states=6)
    assert (odd["short_sequences"], odd["single_sequence_activities"]) == (2, 2)
    about = {"data": odd, "seconds": {"all": 1.0, "data": 0.0}}
    assert "2 sequences have fewer frames than the HMMs have states" in study_notes(about)
    assert "2 activities have a single sequence" in study_notes(about)


def test_what_train_does_without_settings_takes_minutes():
    config = load_config("train")
    plan = plan_database(config.data.database)
    assert sum(planned.frames for planned in plan) < 2000  # at about a third of a second each
    assert len({planned.activity for planned in plan}) == 8
    thesis = load_config("train", ["experiment=thesis"]).data.database
    assert len(plan_database(thesis)) == 8 * (15 + 40)
