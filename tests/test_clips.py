"""Clips from the real pipeline, and their cache: what is made, found again, and made anew."""

import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from clip_stand_in import BODY, DATABASE, Maker, tiny_maker

from torchpose import clips
from torchpose.activity.dataset import Fold
from torchpose.clips import ClipMaker, DataConfig, build_database
from torchpose.eyes import EyesConfig
from torchpose.pipeline import PoseConfig
from torchpose.registration.size import SizeConfig
from torchpose.registration.start import StartConfig
from torchpose.rendered import RenderedRecording
from torchpose.synthesis.database import DatabaseConfig, PlannedClip, plan_database
from torchpose.version import __version__
from torchpose.vision.silhouette import SilhouetteConfig

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> Maker:
    made = Maker()
    monkeypatch.setattr(ClipMaker, "make", lambda maker, planned: made(maker, planned))
    return made


# The pipeline itself, in a few frames and with as little search as will do.
QUICK_POSE = PoseConfig(
    start=StartConfig(
        points=60, rounds=2, final_rounds=2, finalists=1, refreshes=0, face_yaws=(0.0,), yaws=(0.0,)
    ),
    size=SizeConfig(rounds=0),
    size_frames=1,
)
STREAMS = ("pose", "directions", "silhouettes", "joints", "pose_sd")
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
        for name in STREAMS:
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
            for name in STREAMS:
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
