"""`python train.py`: clips from the real pipeline and their cache, the comparison of features, its files and tables."""

import functools
import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from torchpose import clips
from torchpose.activity.codebook import CodebookConfig
from torchpose.activity.dataset import Clip, Fold, Split, split_clips
from torchpose.activity.features import FeatureConfig, FeatureKind
from torchpose.activity.recognizer import Evaluation, Recognizer, RecognizerConfig
from torchpose.body.model import BodyModel
from torchpose.cli import load_config, train_main
from torchpose.clips import ClipMaker, DataConfig, ObservedClip, build_database
from torchpose.pipeline import EyesConfig, PoseConfig
from torchpose.registration.size import SizeConfig
from torchpose.registration.start import StartConfig
from torchpose.rendered import RenderedRecording
from torchpose.study import THESIS_ACCURACY, FeatureScore, count_material, run_study, study_table
from torchpose.synthesis.database import DatabaseConfig, PlannedClip, plan_database
from torchpose.version import __version__
from torchpose.vision.silhouette import SilhouetteConfig

ROOT = Path(__file__).resolve().parents[1]
BODY = BodyModel()
DATABASE = DatabaseConfig(
    activities=("left_hand", "right_leg"),
    train_subjects=1,
    test_subjects=1,
    train_sequences=2,
    test_sequences=2,
    frames=(28, 32),
    width=64,
    height=48,
)
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


class Maker:
    """Stands in for rendering and registration, which take seconds a clip: poses near the truth, dots at the joints."""

    def __init__(self, interrupt_at: int | None = None) -> None:
        self.made: list[PlannedClip] = []
        self.interrupt_at = interrupt_at

    def __call__(self, maker: ClipMaker, planned: PlannedClip) -> ObservedClip:
        if len(self.made) == self.interrupt_at:
            raise KeyboardInterrupt
        self.made.append(planned)
        assert maker.data.database == DATABASE
        return made_up(planned)


@functools.cache
def made_up(planned: PlannedClip) -> ObservedClip:
    synthetic = planned.record(DATABASE, BODY)
    generator = torch.Generator().manual_seed(0)
    pose = synthetic.pose + 0.05 * torch.randn(synthetic.pose.shape, generator=generator)
    pose[3] = torch.nan  # a lost frame
    directions = BODY.limb_directions(BODY(synthetic.pose, synthetic.size))
    u, v = synthetic.camera.project(synthetic.joints).round().long().unbind(-1)
    silhouettes = torch.zeros(len(pose), 48, 64, dtype=torch.bool)
    silhouettes[torch.arange(len(pose))[:, None], v.clamp(0, 47), u.clamp(0, 63)] = True
    clip = Clip(planned.activity, str(planned.subject), str(planned.take), pose, directions, silhouettes)
    return ObservedClip(clip, torch.full((len(pose), 8), 0.1))


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> Maker:
    made = Maker()
    monkeypatch.setattr(ClipMaker, "make", lambda maker, planned: made(maker, planned))
    return made


def tiny_maker(folder: Path) -> ClipMaker:
    return ClipMaker(DataConfig(cache=str(folder), database=DATABASE))


# The pipeline itself, in a few frames and with as little search as will do.
QUICK_POSE = PoseConfig(
    start=StartConfig(
        points=60, rounds=2, final_rounds=2, finalists=1, refreshes=0, face_yaws=(0.0,), yaws=(0.0,)
    ),
    size=SizeConfig(rounds=0),
    size_frames=1,
)
SEEN = PlannedClip("left_hand", 4, 1, "train", 3, 1.0)


def seeing_maker() -> ClipMaker:
    data = DataConfig(silhouette_height=60, database=replace(DATABASE, width=160, height=120))
    return ClipMaker(data, EyesConfig(silhouette=SilhouetteConfig()), QUICK_POSE)


def test_a_clip_is_what_the_pipeline_sees():
    maker = seeing_maker()
    observed = maker.make(SEEN)
    truth = SEEN.record(maker.data.database)
    assert str(observed.clip) == "clip 'left_hand' (subject 4, take 1)"
    assert len(observed.clip) == 3
    mask = truth.frames().mask[:, ::2, ::2]
    seen = observed.clip.stream("silhouettes")
    assert seen.shape == (3, 60, 80)
    assert ((seen & mask).sum() / (seen | mask).sum()) > 0.7
    pose = observed.clip.stream("pose")
    assert pose.isfinite().all()
    assert not torch.equal(pose, truth.pose)
    # The directions are the estimated pose's, whatever the person's size.
    expected = BODY.limb_directions(BODY(pose, BODY.default_size(1)))
    torch.testing.assert_close(observed.clip.stream("directions"), expected, atol=1e-5, rtol=0)
    assert observed.angle_error.shape == (3, 8)
    assert (observed.angle_error >= 0).all()
    assert 0 < observed.angle_error.mean().rad2deg() < 40


def test_without_a_person_in_the_images_there_is_no_pose(monkeypatch: pytest.MonkeyPatch):
    frame = RenderedRecording.__getitem__

    def empty(recording: RenderedRecording, position: int):
        left, right = recording.synthetic.background(1)
        return replace(frame(recording, position), left=left[0], right=right[0])

    monkeypatch.setattr(RenderedRecording, "__getitem__", empty)
    observed = seeing_maker().make(SEEN)
    assert observed.clip.stream("pose").isnan().all()
    assert observed.clip.stream("directions").isnan().all()
    assert not observed.clip.stream("silhouettes").any()
    assert observed.angle_error.isnan().all()


def test_what_is_in_the_cache_is_not_made_again(tmp_path: Path, stand_in: Maker):
    maker = tiny_maker(tmp_path)
    first = build_database(maker, workers=1)
    assert stand_in.made == plan_database(DATABASE)
    assert first.fold == Fold((0, 1, 4, 5), (2, 3, 6, 7))
    assert [clip.activity for clip in first.clips] == ["left_hand"] * 4 + ["right_leg"] * 4
    assert {first.clips[i].subject for i in first.fold.train}.isdisjoint(
        first.clips[i].subject for i in first.fold.test
    )
    assert first.mean_angle_error == pytest.approx(0.1)
    again = build_database(maker, workers=1)
    assert len(stand_in.made) == 8
    for one, other in zip(first.observed, again.observed, strict=True):
        assert str(one.clip) == str(other.clip)
        for name in ("pose", "directions", "silhouettes"):
            torch.testing.assert_close(
                one.clip.stream(name), other.clip.stream(name), atol=0, rtol=0, equal_nan=True
            )
        assert torch.equal(one.angle_error, other.angle_error)
    build_database(maker, workers=1, fresh=True)
    assert len(stand_in.made) == 16


def test_a_clips_file_is_named_after_all_that_it_depends_on():
    maker = ClipMaker()
    names = {maker.path(SEEN).name}
    changed = [
        replace(maker, eyes=EyesConfig(min_points=61)),
        replace(maker, pose=PoseConfig(size_frames=3)),
        replace(maker, data=DataConfig(silhouette_height=90)),
        replace(maker, data=DataConfig(database=DatabaseConfig(width=640))),
    ]
    names |= {other.path(SEEN).name for other in changed}
    names |= {maker.path(replace(SEEN, take=2)).name, replace(maker, version="another").path(SEEN).name}
    assert len(names) == 7


def test_changed_code_makes_new_clips(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    code = {"clips.py": "a", "body/human.yaml": "b", "activity/hmm.py": "c", "study.py": "d"}
    for name, text in code.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr("torchpose.clips.__file__", str(tmp_path / "clips.py"))

    def version() -> str:
        clips._code_version.cache_clear()
        return ClipMaker().version

    first = version()
    assert first.startswith(__version__)
    for name in ("activity/hmm.py", "study.py"):
        (tmp_path / name).write_text("changed")
    assert version() == first
    (tmp_path / "body/human.yaml").write_text("changed")
    second = version()
    (tmp_path / "clips.py").write_text("changed")
    assert len({first, second, version()}) == 3
    clips._code_version.cache_clear()


@pytest.mark.parametrize(
    "other",
    [
        ClipMaker(device="cuda"),
        ClipMaker(DataConfig(cache="elsewhere")),
        ClipMaker(DataConfig(database=DatabaseConfig(train_sequences=5))),
    ],
)
def test_a_clips_file_is_not_named_after_anything_else(other: ClipMaker):
    assert other.path(SEEN).name == ClipMaker().path(SEEN).name


def test_an_interrupted_build_goes_on(tmp_path: Path, stand_in: Maker):
    maker = tiny_maker(tmp_path)
    stand_in.interrupt_at = 3
    with pytest.raises(KeyboardInterrupt):
        build_database(maker, workers=1)
    assert len(list(tmp_path.glob("*.npz"))) == 3
    stand_in.interrupt_at = None
    build_database(maker, workers=1)
    assert stand_in.made == plan_database(DATABASE)  # each once


@pytest.mark.parametrize("damage", ["cut", "foreign", "empty"])
def test_a_damaged_file_is_made_again(tmp_path: Path, stand_in: Maker, damage: str):
    maker = tiny_maker(tmp_path)
    whole = build_database(maker, workers=1)
    path = maker.path(plan_database(DATABASE)[2])
    content = path.read_bytes()
    if damage == "foreign":
        np.savez(path, something=np.zeros(3))
    else:
        path.write_bytes(content[: len(content) // 2] if damage == "cut" else b"")
    again = build_database(maker, workers=1)
    assert len(stand_in.made) == 9
    assert torch.equal(again.clips[2].stream("silhouettes"), whole.clips[2].stream("silhouettes"))


def test_no_damage_gets_through(tmp_path: Path, stand_in: Maker):
    maker, planned = tiny_maker(tmp_path), plan_database(DATABASE)[0]
    maker.store(planned)
    path = maker.path(planned)
    content = path.read_bytes()
    whole = maker.find(planned)
    assert whole is not None
    for start in range(0, len(content), 31):
        path.write_bytes(content[:start] + b"\xff" * 25 + content[start + 25 :])
        found = maker.find(planned)
        if found is not None:  # some bytes of an archive, such as times, say nothing
            for name in ("pose", "directions", "silhouettes"):
                expected = whole.clip.stream(name)
                torch.testing.assert_close(found.clip.stream(name), expected, atol=0, rtol=0, equal_nan=True)


@pytest.mark.slow  # two processes import torch
def test_processes_make_what_one_process_makes(tmp_path: Path):
    database = replace(DATABASE, train_sequences=1, test_sequences=1, frames=(2, 2), width=160, height=120)
    makers = [
        ClipMaker(DataConfig(cache=str(tmp_path / n), database=database), pose=QUICK_POSE) for n in "12"
    ]
    alone, together = (build_database(maker, workers) for workers, maker in enumerate(makers, 1))
    for one, other in zip(alone.clips, together.clips, strict=True):
        assert torch.equal(one.stream("silhouettes"), other.stream("silhouettes"))
        torch.testing.assert_close(one.stream("pose"), other.stream("pose"), equal_nan=True)


ONE_WORKER = """
import multiprocessing, os, time
from concurrent.futures import ProcessPoolExecutor
from torchpose.clips import _be_one_of_many
pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _be_one_of_many)
print(pool.submit(os.getpid).result(), flush=True)
time.sleep(60)
"""


@pytest.mark.slow  # two processes import torch
def test_workers_end_with_whoever_started_them():
    with subprocess.Popen(
        [sys.executable, "-c", ONE_WORKER], stdout=subprocess.PIPE, text=True, cwd=ROOT
    ) as parent:
        assert parent.stdout is not None
        worker = int(parent.stdout.readline())
        os.kill(worker, 0)  # it is there
        parent.kill()
        for _ in range(100):
            try:
                os.kill(worker, 0)
            except ProcessLookupError:
                return
            time.sleep(0.1)
    pytest.fail(f"process {worker} goes on without its parent")


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
    folds = split_clips(clips, Split.half_subjects)
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
    assert not (tmp_path / "results").exists()
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
    ("split", "folds"), [("half_subjects", 2), ("cross_subject", 4), ("leave_one_sequence_out", 16)]
)
def test_skeletons_go_through_the_same_study(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], split: str, folds: int
):
    data = write_skeletons(tmp_path / "skeletons.npz")
    small = ("recognizer.codebook.size=6", "recognizer.codebook.restarts=1", f"output={tmp_path}")
    code, out, err = run(capsys, "experiment=skeleton", f"data.path={data}", f"split={split}", *small)
    assert (code, err) == (0, "")
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["data"] == {
        "sequences": 16,
        "tests": 16,
        "folds": folds,
        "frames": results["data"]["frames"],
        "lost_frames": 0,
    }
    skeleton = results["features"]["skeleton"]
    assert skeleton["confusion"] == [[8, 0], [0, 8]]
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
        (["split=odd"], "split must be one of half_subjects, cross_subject, leave_one_sequence_out"),
        (["experiment=slow"], "unknown experiment 'slow'"),
        (["features=[]"], "features must be one or more, each once, got none"),
        (["features=[pca,pca]"], "features must be one or more, each once, got pca, pca"),
        (["features=[pcb]"], "features must be a list [...]"),
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
    assert not (tmp_path / "results").exists()


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
    assert not (tmp_path / "r").exists()


def scored(
    kind: FeatureKind, confusion: list[list[int]], unanswered: list[int] | None = None
) -> FeatureScore:
    names = ("left_hand", "boxing", *(f"activity_{n}" for n in range(2, len(confusion))))
    lacking = torch.tensor(unanswered or [0] * len(confusion))
    evaluation = Evaluation(names[: len(confusion)], torch.tensor(confusion), lacking)
    return FeatureScore(kind, evaluation, 1.25, Recognizer())


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
    counted = count_material(clips, [Fold((0,), (1,))])
    assert counted == {"sequences": 2, "tests": 1, "folds": 1, "frames": 9, "lost_frames": 2}


def test_what_train_does_without_settings_takes_minutes():
    config = load_config("train")
    plan = plan_database(config.data.database)
    assert sum(planned.frames for planned in plan) < 2000  # at about a third of a second each
    assert len({planned.activity for planned in plan}) == 8
    thesis = load_config("train", ["experiment=thesis"]).data.database
    assert len(plan_database(thesis)) == 8 * (15 + 40)
