"""Clips, skeleton archives and splits: round trips, and every way in which a file can be wrong."""

import re

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from torchpose.activity.dataset import Clip, Split, read_skeletons, split_clips

NAMES = np.array(["left_shoulder", "right_shoulder", "left_hip", "right_hip"])


def archive(**changes):
    rng = np.random.default_rng(0)
    arrays = {
        "joints": rng.normal(size=(9, 4, 3)).astype(np.float32),
        "offsets": np.array([0, 2, 5, 9]),
        "label": np.array(["walk", "sit", "walk"]),
        "subject": np.array([2, 10, 1]),
        "take": np.array([1, 1, 2]),
        "joint_names": NAMES,
    }
    return {name: value for name, value in (arrays | changes).items() if value is not None}


def test_every_sequence_comes_back_and_lost_frames_are_nan(tmp_path):
    arrays = archive()
    arrays["joints"][3] = 0  # a sensor that lost the person
    arrays["joints"][7, 1, 2] = np.inf
    np.savez(tmp_path / "data.npz", **arrays)
    clips = read_skeletons(tmp_path / "data.npz", dtype=torch.float64)
    assert [(c.activity, c.subject, c.take, len(c)) for c in clips] == [
        ("walk", "2", "1", 2),
        ("sit", "10", "1", 3),
        ("walk", "1", "2", 4),
    ]
    assert clips[0].joint_names == tuple(NAMES)
    assert_close(clips[0].joints, torch.from_numpy(arrays["joints"][:2]).double())
    assert clips[1].joints.isnan().all(2).all(1).tolist() == [False, True, False]
    assert clips[2].joints.isnan().all(2).all(1).tolist() == [False, False, True, False]
    assert_close(clips[2].joints[3], torch.from_numpy(arrays["joints"][8]).double())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"offsets": np.array([0, 2, 5, 8])}, "offsets .* must end with the number of frames, 9, got 8"),
        ({"offsets": np.array([0, 2, 5, 12])}, "offsets .* must end with the number of frames, 9, got 12"),
        ({"offsets": np.array([1, 2, 5, 9])}, "start with 0"),
        ({"offsets": np.array([0.0, 2.0, 5.0, 9.0])}, "must be integers .* got float64"),
        ({"offsets": np.array([0, 5, 5, 9])}, "offsets .* must increase.*sequence 1 has 0"),
        ({"offsets": np.array([0, 6, 5, 9])}, "offsets .* must increase.*sequence 1 has -1"),
        ({"offsets": np.array([0])}, r"offsets .* got int64 \(1,\)"),
        ({"label": np.array(["walk"])}, r"label .* one entry a sequence, 3, got \(1,\)"),
        ({"subject": np.array([[1, 2, 3]])}, r"subject .* got \(1, 3\)"),
        (
            {"joints": np.zeros((9, 4, 2), np.float32)},
            r"joints .* \(frames, 4 joint_names, 3\), got float32 \(9, 4, 2\)",
        ),
        ({"joint_names": NAMES[:3]}, r"joints .* \(frames, 3 joint_names, 3\)"),
        ({"joints": np.zeros((9, 4, 3), np.int64)}, "must be floating point .* got int64"),
        ({"take": None, "subject": None}, "it lacks subject, take"),
        ({"label": np.array(["walk", None, "sit"], dtype=object)}, "must be an .npz of plain arrays"),
    ],
    ids=lambda value: None if isinstance(value, dict) else re.sub(r"[^a-z ]", "", value)[:30],
)
def test_arrays_that_do_not_fit_are_named(tmp_path, changes, message):
    np.savez(tmp_path / "data.npz", **archive(**changes))
    with pytest.raises(ValueError, match=message):
        read_skeletons(tmp_path / "data.npz")


def test_files_that_are_no_archives_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no skeleton data set at .*none\.npz; give an \.npz"):
        read_skeletons(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(
        ValueError, match=r"text\.npz must be an \.npz of plain arrays, but it cannot be read"
    ):
        read_skeletons(tmp_path / "text.npz")
    np.savez(tmp_path / "whole.npz", **archive())
    (tmp_path / "cut.npz").write_bytes((tmp_path / "whole.npz").read_bytes()[:300])
    with pytest.raises(ValueError, match=r"cut\.npz must be an \.npz"):
        read_skeletons(tmp_path / "cut.npz")
    np.save(tmp_path / "single.npy", np.zeros(3))
    with pytest.raises(ValueError, match="got a single array"):
        read_skeletons(tmp_path / "single.npy")


def test_clips_that_do_not_fit_are_named():
    names = ("clip 'walk' (subject 1, take 2)", "walk", "1", "2")
    with pytest.raises(ValueError, match=re.escape(names[0]) + " must have one of pose, .* got none"):
        Clip(*names[1:])
    with pytest.raises(ValueError, match=r"the same number of frames, got \{'pose': 3, 'silhouettes': 2\}"):
        Clip(*names[1:], pose=torch.zeros(3, 24), silhouettes=torch.zeros(2, 4, 4))
    with pytest.raises(ValueError, match="at least one frame, got none"):
        Clip(*names[1:], pose=torch.zeros(0, 24))
    with pytest.raises(ValueError, match="must name each of its 4 joints, got 1"):
        Clip(*names[1:], joints=torch.zeros(3, 4, 3), joint_names=("head",))
    clip = Clip(*names[1:], pose=torch.zeros(3, 24))
    with pytest.raises(ValueError, match=r"needs 'joints' in every clip, but clip 'walk' .* has only pose"):
        clip.stream("joints")


def clips_by(*subjects):
    return [Clip("walk", subject, str(i), pose=torch.zeros(1, 24)) for i, subject in enumerate(subjects)]


def test_half_of_the_subjects_train_drawn_anew_each_time():
    clips = clips_by(*map(str, range(1, 8)), "1")
    folds = split_clips(clips, Split.half_subjects, splits=20, seed=3)
    assert len(folds) == 20
    assert len({fold.train for fold in folds}) > 10
    for fold in folds:
        assert len({clips[i].subject for i in fold.train}) == 3
        assert len({clips[i].subject for i in fold.test}) == 4
    assert folds == split_clips(clips, Split.half_subjects, splits=20, seed=3)
    assert folds != split_clips(clips, Split.half_subjects, splits=20, seed=4)


def test_odd_subjects_train_and_even_ones_test():
    clips = clips_by("10", "9", "1", "1", "2")  # in order: 1, 2, 9, 10
    (fold,) = split_clips(clips, Split.cross_subject)
    assert (fold.train, fold.test) == ((1, 2, 3), (0, 4))


def test_each_subject_tests_once():
    clips = clips_by("b", "a", "b", "c")
    folds = split_clips(clips, "leave_one_subject_out")
    assert [fold.test for fold in folds] == [(1,), (0, 2), (3,)]


@pytest.mark.parametrize("split", list(Split))
def test_no_clip_or_subject_is_on_both_sides(split):
    clips = clips_by(*"3141592653")
    folds = split_clips(clips, split)
    if split in (Split.leave_one_sequence_out, Split.leave_one_subject_out):
        assert sorted(index for fold in folds for index in fold.test) == list(range(10))
    for fold in folds:
        assert sorted(fold.train + fold.test) == list(range(10))
        if split is not Split.leave_one_sequence_out:
            subjects = [{clips[i].subject for i in part} for part in (fold.train, fold.test)]
            assert not subjects[0] & subjects[1]


def test_impossible_splits_are_named():
    with pytest.raises(ValueError, match=r"split must be one of cross_subject, .* got 'by_moon'"):
        split_clips(clips_by("1", "2"), "by_moon")
    for split, clips in ((Split.cross_subject, clips_by("1", "1")), (Split.half_subjects, clips_by("1"))):
        with pytest.raises(ValueError, match=f"split {split.value} needs at least two .* by 1 subjects"):
            split_clips(clips, split)
    with pytest.raises(ValueError, match="splits must be at least 1, got 0"):
        split_clips(clips_by("1", "2"), Split.half_subjects, splits=0)
    with pytest.raises(ValueError, match="got 1 sequences"):
        split_clips(clips_by("1"), Split.leave_one_sequence_out)


@pytest.mark.parametrize("split", list(Split))
def test_utkinect_reads(shared_data, split):
    clips = read_skeletons(shared_data / "utkinect.npz")
    assert len(clips) == 199
    assert sum(map(len, clips)) == 6053
    assert len({clip.activity for clip in clips}) == 10
    expected = {
        Split.cross_subject: 1,
        Split.half_subjects: 5,
        Split.leave_one_subject_out: 10,
        Split.leave_one_sequence_out: 199,
    }
    assert len(split_clips(clips, split)) == expected[split]
