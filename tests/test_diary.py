"""The diary: activities, pauses, what was not learned and nobody at all, of any rate, all at once or live."""

import itertools
import json
import math
from datetime import datetime

import pytest
import torch
from torch.testing import assert_close

from torchpose.activities import ActivityWriter, activity_lines
from torchpose.activity.baum_welch import HMMConfig
from torchpose.activity.codebook import CodebookConfig
from torchpose.activity.dataset import Clip
from torchpose.activity.diary import OTHER, PAUSE, UNSEEN, Diary, DiaryConfig, Entry, LiveDiary, clip_frames
from torchpose.activity.features import FeatureConfig, FeatureKind, Stream
from torchpose.activity.recognizer import Recognizer, RecognizerConfig
from torchpose.body.angle import ANATOMICAL_NAMES, LIMB_ANGLE_NAMES
from torchpose.body.model import BodyModel
from torchpose.cli import load_config
from torchpose.export import PoseSequence, write_poses_npz
from torchpose.journal import Journal, read_activities_csv

RATE = 10.0
MOVED = {"both": (6, 9), "left": (6,), "right": (9,), "stranger": (14, 17)}


def moving(activity, frames, generator):
    """Some joint parameters rise and fall every 2 s, from a random phase; the others are noise about zero."""
    time = torch.arange(frames) / RATE + 2 * torch.rand((), generator=generator)
    pose = 0.05 * torch.randn(frames, 24, generator=generator)
    for parameter in MOVED.get(activity, ()):
        pose[:, parameter] += 0.5 - 0.5 * (math.pi * time).cos()
    return pose


def recording(*parts, seed=0):
    """Poses of several activities in succession, and the label of each frame."""
    generator = torch.Generator().manual_seed(seed)
    poses = [moving(name, frames, generator) for name, frames in parts]
    for (name, _), pose in zip(parts, poses, strict=True):
        if name == UNSEEN:
            pose[:] = torch.nan
    labels = [OTHER if name == "stranger" else name for name, frames in parts for _ in range(frames)]
    return Clip("day", "1", "1", pose=torch.cat(poses)), labels


def train(config=None, names=("both", "left", "right")):
    generator = torch.Generator().manual_seed(7)
    clips = [Clip(name, str(i), "1", pose=moving(name, 40, generator)) for name in names for i in range(8)]
    config = config or RecognizerConfig(
        feature=FeatureConfig(streams=(Stream.feature, Stream.velocity)),
        codebook=CodebookConfig(size=16, restarts=1),
        hmm=HMMConfig(iterations=10),
    )
    return Recognizer(config).fit(clips)


@pytest.fixture(scope="module")
def recognizer():
    return train()


def by_frame(entries, frames, rate=RATE):
    found = [""] * frames
    for entry in entries:
        for frame in range(round(entry.start_s * rate), min(frames, round(entry.end_s * rate))):
            found[frame] = entry.activity
    return found


def agreement(entries, labels):
    return sum(a == b for a, b in zip(by_frame(entries, len(labels)), labels, strict=True)) / len(labels)


PARTS = [("left", 90), (PAUSE, 50), ("both", 120), ("right", 70), (PAUSE, 60), ("left", 80)]


@pytest.mark.parametrize("delay", [None, 2.0])
def test_activities_and_pauses_are_found(recognizer, delay):
    clip, labels = recording(*PARTS)
    entries = Diary(recognizer, DiaryConfig(delay=delay)).write(clip)
    assert [entry.activity for entry in entries] == [name for name, _ in PARTS]
    assert agreement(entries, labels) > 0.95
    assert all(a.end_s == b.start_s for a, b in itertools.pairwise(entries))
    assert (entries[0].start_s, entries[-1].end_s) == (0, len(labels) / RATE)
    assert all(entry.log_odds > 0 for entry in entries)


def test_a_pause_can_be_learned_as_an_activity():
    clip, labels = recording(*[("rest" if name == PAUSE else name, frames) for name, frames in PARTS])
    taught = train(names=("both", "left", "right", "rest"))
    diary = Diary(taught, DiaryConfig(pause="rest"))
    assert PAUSE not in diary.labels
    assert agreement(diary.write(clip), labels) > 0.95
    with pytest.raises(
        ValueError, match="pause must be an activity of the recogniser, both, left, rest, right, got"
    ):
        Diary(taught, DiaryConfig(pause="sleep"))


def test_what_was_not_learned_is_other(recognizer):
    clip, labels = recording(("left", 80), ("stranger", 80), ("right", 80))
    assert agreement(Diary(recognizer).write(clip), labels) > 0.9


def test_who_is_lost_for_a_moment_goes_on_and_who_is_lost_for_longer_is_unseen(recognizer):
    clip, _ = recording(("left", 100), (UNSEEN, 60), ("left", 50), ("right", 90))
    clip.pose[40:52] = torch.nan  # 1.2 s
    entries = Diary(recognizer).write(clip)
    assert [entry.activity for entry in entries] == ["left", UNSEEN, "left", "right"]
    # A change needs both of its frames, the pose itself does not.
    assert entries[1].start_s == pytest.approx(10.0, abs=0.11)
    assert entries[1].end_s == pytest.approx(16.0, abs=0.11)
    assert math.isnan(entries[1].log_odds)
    nobody, _ = recording((UNSEEN, 30))
    assert [entry.activity for entry in Diary(recognizer).write(nobody)] == [UNSEEN]


def test_a_recording_shorter_than_an_activity_is_one_entry(recognizer):
    clip, _ = recording(("left", 6))
    entries = Diary(recognizer).write(clip)
    assert [(entry.start_s, entry.end_s) for entry in entries] == [(0, 0.6)]
    one = Diary(recognizer).write(clip_frames(clip, 0, 1))
    assert [(entry.start_s, entry.end_s) for entry in one] == [(0, 0.1)]


@pytest.mark.parametrize("chunk", [1, 7, 100])
def test_live_it_says_the_same_as_at_once_and_not_later_than_its_delay(recognizer, chunk):
    clip, _ = recording(*PARTS[:3])
    config = DiaryConfig(delay=2.0)
    at_once = Diary(recognizer, config).write(clip)
    live, found = LiveDiary(Diary(recognizer, config)), []
    for start in range(0, len(clip), chunk):
        part = clip_frames(clip, start, start + chunk)
        now = (start + len(part) - 1) / RATE
        for entry in live.push(part, (start + torch.arange(len(part))) / RATE):
            late = config.delay + recognizer.config.feature.velocity_step / RATE + (chunk - 1) / RATE
            assert entry.end_s <= now <= entry.end_s + late + 1e-6
            found.append(entry)
    found += live.finish()
    assert [(e.start_s, e.end_s, e.activity) for e in found] == [
        (e.start_s, e.end_s, e.activity) for e in at_once
    ]
    assert_close([e.log_odds for e in found], [e.log_odds for e in at_once])


@pytest.mark.parametrize("rate", [30.0, 6.0])
def test_poses_are_taken_at_the_rate_that_was_learned(recognizer, rate):
    clip, labels = recording(*PARTS)
    times = 100 + torch.arange(0, len(labels) / RATE - 1e-9, 1 / rate, dtype=torch.float64)
    index = ((times - 100) * RATE).round().long().clamp(max=len(labels) - 1)
    entries = Diary(recognizer).write(Clip("day", "1", "1", pose=clip.pose[index]), times)
    shifted = [Entry(e.start_s - 100, e.end_s - 100, e.activity, e.log_odds) for e in entries]
    assert agreement(shifted, labels) > 0.93
    assert not any(e.activity == UNSEEN for e in entries)


def test_time_in_which_no_frame_came_is_unseen(recognizer):
    clip, _ = recording(("left", 80), ("right", 80))
    times = torch.arange(160) / RATE + 20 * (torch.arange(160) >= 80)
    entries = Diary(recognizer).write(clip, times)
    assert [entry.activity for entry in entries] == ["left", UNSEEN, "right"]
    assert entries[1].end_s - entries[1].start_s == pytest.approx(20, abs=0.21)


def test_bad_input_is_told_in_a_sentence(recognizer):
    clip, _ = recording(("left", 4))
    diary = Diary(recognizer)
    with pytest.raises(
        ValueError, match=r"later than the one before it, got 0.1 s after 0.2 s at row 2; sort"
    ):
        diary.write(clip, torch.tensor([0.0, 0.2, 0.1, 0.3]))
    live = LiveDiary(diary)
    live.push(clip, torch.arange(4) / RATE)
    with pytest.raises(ValueError, match=r"got 0.3 s after 0.3 s at row 0"):
        live.push(clip, 0.3 + torch.arange(4) / RATE)
    with pytest.raises(ValueError, match="a time for each of 4 frames"):
        diary.write(clip, torch.zeros(3))
    with pytest.raises(ValueError, match="must be positive, got 0"):
        DiaryConfig(frame_rate=0.0)
    with pytest.raises(ValueError, match="delay of the diary must not be negative"):
        DiaryConfig(delay=-1.0)
    joints = Recognizer(RecognizerConfig(feature=FeatureConfig(streams=(Stream.feature, Stream.travel))))
    with pytest.raises(ValueError, match="a diary needs streams that know no beginning, got travel"):
        Diary(joints)


def sequence(pose):
    time = len(pose)
    return PoseSequence(
        frame=torch.arange(time),
        time_s=torch.arange(time) / RATE,
        status=tuple("lost" if row.isnan().any() else "tracked" for row in pose),
        point_to_model=torch.full((time,), 0.02),
        joints=torch.zeros(time, 15, 3),
        angle_names=ANATOMICAL_NAMES,
        angles=torch.zeros(time, len(ANATOMICAL_NAMES)),
        angle_sd=torch.zeros(time, len(ANATOMICAL_NAMES)),
        limb_angle_names=LIMB_ANGLE_NAMES,
        limb_angles=torch.zeros(time, len(LIMB_ANGLE_NAMES)),
        pose=pose,
        pose_covariance=0.01 * torch.eye(24).expand(time, -1, -1),
    )


def test_a_folder_of_poses_gets_its_activities_and_a_journal_its_entries(recognizer, tmp_path):
    recognizer.save(tmp_path / "recognizer")
    clip, labels = recording(("left", 80), ("right", 80))
    write_poses_npz(tmp_path / "out" / "poses.npz", sequence(clip.pose.double()))
    write_poses_npz(tmp_path / "out" / "poses_2.npz", sequence(clip.pose.flip(0).double()))
    (tmp_path / "out" / "activities_3.csv").write_text("of an earlier run")
    page = tmp_path / "out" / "report.html"
    page.write_text('<script type="application/json" id="activities">[]</script>')
    started = datetime(2026, 11, 23, 11, 59, 50)
    writer = ActivityWriter(
        tmp_path / "recognizer", journal=tmp_path / "j.sqlite", person="anna", started=started
    )
    found = writer.write(tmp_path / "out", BodyModel(), "one")
    assert sorted(found) == ["anna", "anna_2"]
    assert not (tmp_path / "out" / "activities_3.csv").exists()
    entries = read_activities_csv(tmp_path / "out" / "activities.csv")
    assert agreement(entries, labels) > 0.95
    on_page = [[entry["activity"] for entry in person] for person in json.loads(page.read_text()[48:-9])]
    assert on_page == [[entry.activity for entry in person] for person in found.values()]
    journal = Journal(tmp_path / "j.sqlite")
    assert journal.people() == ["anna", "anna_2"]
    before_noon = sum(
        s.total_seconds() for s in [journal.total("left", "anna", end=datetime(2026, 11, 23, 12))]
    )
    assert before_noon == pytest.approx(8, abs=0.5)
    assert activity_lines(found).startswith("anna           ")


def test_directions_are_those_of_the_body(tmp_path):
    config = RecognizerConfig(
        feature=FeatureConfig(kind=FeatureKind.directions),
        codebook=CodebookConfig(size=4),
        hmm=HMMConfig(iterations=2),
    )
    body = BodyModel()
    pose = recording(("left", 20))[0].pose
    known = body.limb_directions(body(pose, body.default_size(1)))
    Recognizer(config).fit([Clip("left", "1", "1", pose=pose, directions=known)]).save(tmp_path)
    writer = ActivityWriter(tmp_path)
    pose[3] = torch.nan
    clip = writer.clip(sequence(pose.double()), body)
    seen = ~pose.isnan().any(1)
    assert_close(clip.directions[seen], known[seen], rtol=1e-5, atol=1e-5)
    assert clip.directions[3].isnan().all()
    assert_close(clip.pose_sd[0], torch.full((24,), 0.1))


def test_what_the_recording_cannot_show_is_told_before_it_is_run(tmp_path, recognizer):
    images = torch.rand(20, 12, 9)
    config = RecognizerConfig(
        feature=FeatureConfig(kind=FeatureKind.pca, num_components=2), codebook=CodebookConfig(size=4)
    )
    Recognizer(config).fit([Clip("left", "1", "1", silhouettes=images)]).save(tmp_path / "pca")
    with pytest.raises(ValueError, match="this feature needs 'silhouettes' in every clip"):
        ActivityWriter(tmp_path / "pca")
    recognizer.save(tmp_path / "angles")
    with pytest.raises(ValueError, match="a journal needs the date and time of the first frame"):
        ActivityWriter(tmp_path / "angles", journal=tmp_path / "j.sqlite")
    with pytest.raises(FileNotFoundError, match="no recogniser in"):
        ActivityWriter(tmp_path / "nowhere")


def test_infer_asks_for_what_a_journal_needs():
    with pytest.raises(ValueError, match="recognizer must be given for a journal"):
        load_config("infer", ["journal=x.sqlite", "started=2026-11-23T08:00"])
    with pytest.raises(ValueError, match="started must be given for a journal"):
        load_config("infer", ["journal=x.sqlite", "recognizer=r"])
    with pytest.raises(
        ValueError, match="started must be a local date and time such as 2026-11-23T08:30, got 'noon'"
    ):
        load_config("infer", ["journal=x.sqlite", "recognizer=r", "started=noon"])
