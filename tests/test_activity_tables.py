"""The benchmark of activities: its clips, who is left out to choose, and that its tables count the answers."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from clip_stand_in import DATABASE, Maker, made_up, tiny_maker

import benchmarks.activity as activity
from benchmarks.activity import find_clips, groups_of_people, main, options_of
from torchpose.activity.dataset import Clip
from torchpose.activity.features import FeatureKind
from torchpose.activity.recognizer import RecognizerConfig
from torchpose.clips import ClipMaker
from torchpose.synthesis.database import DatabaseConfig, plan_database

TINY = [
    "data.database.activities=[left_hand,right_leg]",
    "data.database.train_subjects=2",
    "data.database.test_subjects=1",
    "data.database.train_sequences=4",
    "data.database.test_sequences=2",
    "data.database.frames=[28,32]",
    "data.database.width=64",
    "data.database.height=48",
    "recognizer.codebook.size=8",
    "recognizer.codebook.restarts=1",
    "recognizer.feature.num_components=10",
    "recognizer.hmm.iterations=5",
    "workers=1",
]


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> Maker:
    made = Maker()
    monkeypatch.setattr(ClipMaker, "make", lambda maker, planned: made(maker, planned))
    return made


def test_the_tables_hold_what_was_answered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(ClipMaker, "make", lambda maker, planned: made_up(planned))
    monkeypatch.setattr(activity, "TRIES", 1)
    file = tmp_path / "tables.json"
    argv = ["--cache", str(tmp_path), "--seeds", "2", "--make", "--json", str(file)]
    main([*argv, "--only", "angles", *TINY])
    thesis, ours = (table := json.loads(file.read_text()))["tables"]
    assert (table["train"], table["test"]) == (8, 4)
    assert table["angle_error_deg"] == pytest.approx(torch.rad2deg(torch.tensor(0.1)).item(), abs=1e-3)
    assert thesis["name"] == "angles"
    assert thesis["options"] == []
    assert thesis["thesis"] == {"left_hand": 87.5, "right_leg": 97.5}
    for one in (thesis, ours):
        confusion = torch.tensor(one["confusion"])
        assert int(confusion.sum()) + sum(one["unanswered"]) == 2 * 4  # both starts
        right = 100 * confusion.diagonal() / 4
        assert list(one["by_class"].values()) == right.tolist()
        assert one["mean"] == pytest.approx(right.mean().item())
    best = max(ours["options"], key=lambda option: option["held_out"])
    assert ours["name"] == best["name"]
    out = capsys.readouterr().out
    for text in ("8 training and 4 test", "percent right", "87.50", "right_leg", "on training people"):
        assert text in out


def test_the_thesis_comes_first_and_every_option_differs():
    for kind in (FeatureKind.pca, FeatureKind.ica, FeatureKind.angles):
        config = RecognizerConfig()
        options = options_of(kind, config)
        assert next(iter(options.values())) == replace(config, feature=replace(config.feature, kind=kind))
        assert len(set(options.values())) == len(options)


def test_people_are_left_out_whole_and_each_once():
    clips = [Clip("walking", str(i % 5), str(i), pose=torch.zeros(1, 24)) for i in range(20)]
    train = range(0, 20, 2)
    folds = groups_of_people(clips, train)
    assert sorted(i for fold in folds for i in fold.test) == list(train)
    for fold in folds:
        assert {*fold.train, *fold.test} == set(train)
        assert not {clips[i].subject for i in fold.train} & {clips[i].subject for i in fold.test}
    with pytest.raises(ValueError, match="two training people, got 1"):
        groups_of_people(clips, [0, 5, 10])


def test_missing_clips_are_told_and_others_may_do(tmp_path: Path, stand_in: Maker):
    maker, plan = tiny_maker(tmp_path), plan_database(DATABASE)
    with pytest.raises(ValueError, match=r"all 8 clips .* got 0; run python train.py experiment=thesis"):
        find_clips(maker, any_version=True, partial=True)
    for planned in plan[:3]:
        maker.store(planned)
    with pytest.raises(ValueError, match="got 3"):
        find_clips(maker, any_version=False, partial=False)
    assert find_clips(maker, any_version=False, partial=True)[0] == plan[:3]
    # Another version does not find them, unless any will do; a clip of another length is not the planned one.
    other = replace(maker, version="another")
    assert find_clips(other, any_version=True, partial=True)[0] == plan[:3]
    with pytest.raises(ValueError, match="got 0"):
        find_clips(other, any_version=False, partial=True)
    longer = replace(other.data, database=DatabaseConfig(**{**vars(DATABASE), "frames": (50, 60)}))
    with pytest.raises(ValueError, match="got 0"):
        find_clips(replace(other, data=longer), any_version=True, partial=True)
