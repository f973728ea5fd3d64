"""The whole of `infer.py`: a recording in, every file of the contract out, and every bad recording in one sentence."""

import csv
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import torchpose as tp
from torchpose import cli, session
from torchpose.cli import CONFIGS, infer_main
from torchpose.export import JOINT_NAMES, pose_columns
from torchpose.recording import Backgrounds, write_recording
from torchpose.synthesis.database import SyntheticRecording, make_recording, synthetic_camera

FRAMES = 7
EMPTY, BROKEN = 4, 5  # a frame with nobody in it, and one that cannot be read
# Small and quick: the person's height is given, so no other frames are searched for proportions.
QUICK = ["pose.height=1.75", "pose.size.rounds=0", "pose.size_frames=1", "pose.start.final_rounds=4"]
QUICK += ["pose.smoothing.stretch=2", "pose.smoothing.ahead=1"]


@pytest.fixture(scope="module")
def synthetic() -> SyntheticRecording:
    return make_recording("both_hands", 1, 0, FRAMES, synthetic_camera(320, 240, 10.0))


@pytest.fixture(scope="module")
def folder(synthetic: SyntheticRecording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording in which a frame is empty and a frame is damaged."""
    path = tmp_path_factory.mktemp("recording") / "hands"
    left, right = synthetic.background(2)
    frames = [tp.Frame(i, i / 10, f.left[0], f.right[0]) for i, f in enumerate(synthetic)]
    frames[EMPTY] = tp.Frame(EMPTY, EMPTY / 10, left[1], right[1])
    write_recording(path, synthetic.camera, frames, Backgrounds(left, right))
    (path / "right" / f"{BROKEN:06d}.png").write_bytes(b"not an image")
    return path


@pytest.fixture(scope="module")
def result(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording's results, made once."""
    output = tmp_path_factory.mktemp("result")
    assert infer_main([f"recording={folder}", f"output={output}", *QUICK]) == 0
    return output


def rows(path: Path) -> list[dict[str, str]]:
    with (path / "poses.csv").open() as file:
        return list(csv.DictReader(file))


def test_every_file_is_there_and_nothing_else(result: Path):
    names = {path.name for path in result.iterdir()}
    assert names == {
        *("poses.csv", "poses.npz", "poses.mot", "poses.trc", "poses.bvh"),
        *("person.yaml", "overlay.mp4", "angles.png", "summary.json", "report.html"),
    }


def test_the_table_has_the_contract_s_columns_and_a_row_a_frame(result: Path):
    table = rows(result)
    assert list(table[0]) == pose_columns(tp.ANATOMICAL_NAMES, tp.LIMB_ANGLE_NAMES)
    assert [int(row["frame"]) for row in table] == list(range(FRAMES))
    assert [float(row["time_s"]) for row in table] == pytest.approx([i / 10 for i in range(FRAMES)])


def test_poses_are_right_against_the_renderer_s_truth(result: Path, synthetic: SyntheticRecording):
    """At 320 x 240 and 3.3 m a pixel of disparity is 15 cm: 8 cm over all joints is what the image holds."""
    sequence = tp.read_poses_csv(result / "poses.csv")
    answered = torch.tensor(sequence.answered)
    gap = (sequence.joints - synthetic.joints.to(sequence.joints))[answered, 3:].norm(dim=-1)
    assert answered.sum() == FRAMES - 2
    assert gap.mean() < 0.08
    left, right = ((sequence.joints[answered, JOINT_NAMES.index(f"wrist_{s}"), 0]) for s in ("left", "right"))
    assert (left > right).all()  # the subject's left is on the image's right


def test_an_empty_frame_is_absent_and_a_damaged_one_lost_and_both_are_empty(result: Path):
    table = rows(result)
    assert table[EMPTY]["status"] == "absent"
    assert table[BROKEN]["status"] == "lost"
    for i in (EMPTY, BROKEN):
        assert set(list(table[i].values())[3:]) == {""}
    assert table[FRAMES - 1]["status"] in ("tracked", "recovered")


def test_the_summary_says_what_was_wrong(result: Path):
    summary = json.loads((result / "summary.json").read_text())
    assert summary["status"]["absent"] == summary["status"]["lost"] == 1
    assert summary["problems"] == [pytest.approx(summary["problems"][0])]
    assert f"{BROKEN:06d}.png" in summary["problems"][0]
    assert summary["warnings"] == []
    assert summary["settings"]["pose"]["height"] == 1.75
    assert summary["version"] == tp.__version__


def test_the_video_shows_every_frame(result: Path):
    video = cv2.VideoCapture(str(result / "overlay.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == FRAMES
    images = [video.read()[1] for _ in range(FRAMES)]
    assert images[0].shape == (240, 320, 3)
    assert images[BROKEN].mean() < 0.2 * images[0].mean()  # unreadable: black


def test_full_precision_agrees_with_the_table(result: Path):
    table, full = tp.read_poses_csv(result / "poses.csv"), tp.read_poses_npz(result / "poses.npz")
    assert full.pose is not None
    assert full.pose.shape == (FRAMES, 24)
    torch.testing.assert_close(table.angles, full.angles, atol=2e-4, rtol=0, equal_nan=True)  # 0.01 degree
    sd = full.angle_sd[torch.tensor(full.answered)]
    assert ((sd > 0) & (sd <= torch.pi)).all()


def test_motion_is_written_for_other_programs_and_old_files_go(folder: Path, tmp_path: Path):
    """One frame, filtered; a BVH of a second person and a C3D are left by an earlier run."""
    old = ("poses_2.bvh", "poses.c3d", "poses_2_filtered.csv")
    for name in old:
        (tmp_path / name).write_text("old")
    (tmp_path / "summary.json").write_text(json.dumps({"files": old}))
    command = [f"recording={folder}", f"output={tmp_path}", "max_frames=1", *QUICK]
    assert infer_main([*command, "export.formats=[mot,bvh]", "export.filter=rts"]) == 0
    names = {path.name for path in tmp_path.glob("poses*")}
    assert names == {"poses.csv", "poses.npz", "poses_filtered.csv", "poses.mot", "poses.bvh"}
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["bvh"] == {"poses.bvh": {"first_frame": 0, "frames": 1, "left_out": 0}}
    assert summary["settings"]["export"]["formats"] == ["mot", "bvh"]


def test_a_filter_that_the_camera_is_too_slow_for_is_said_at_once(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    command = [f"recording={folder}", f"output={tmp_path / 'out'}", "export.filter=butterworth", *QUICK]
    assert infer_main(command) == 2
    assert "export.cutoff must be below half of the 10 frames a second, got 6 Hz" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def interrupted_at(last: int) -> Callable[..., object]:
    """A step of the pipeline that Ctrl-C ends at this position."""
    step = tp.People.step

    def interrupted(self, recording, position):
        if position == last:
            raise KeyboardInterrupt
        return step(self, recording, position)

    return interrupted


def test_an_interrupted_run_goes_on_and_ends_the_same(
    folder: Path,
    result: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    step = tp.People.step
    command = [f"recording={folder}", f"output={tmp_path}", *QUICK]
    with monkeypatch.context() as patch:
        patch.setattr(tp.People, "step", interrupted_at(3))
        assert infer_main(command) == 130
    assert "goes on" in capsys.readouterr().err
    assert not (tmp_path / "poses.csv").exists()
    seen = []
    monkeypatch.setattr(tp.People, "step", lambda s, r, p: seen.append(p) or step(s, r, p))
    # The output folder is not what makes a run the same: the settings and the recording are.
    assert infer_main(command) == 0
    assert seen == list(range(2, FRAMES))
    again, whole = tp.read_poses_csv(tmp_path / "poses.csv"), tp.read_poses_csv(result / "poses.csv")
    assert again.status == whole.status
    torch.testing.assert_close(again.joints, whole.joints, atol=1e-3, rtol=0, equal_nan=True)


def test_other_settings_start_over(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    model = tp.People(tp.StereoToPose(tp.open_recording(folder).camera))
    run = session.Session(model, tp.open_recording(folder), tmp_path, {"a": 1}, "1")
    assert run.begin(fresh=False) == 0
    (run.parts.folder / "poses_00000002.npz").write_bytes(b"")
    other = session.Session(model, tp.open_recording(folder), tmp_path, {"a": 2}, "1")
    assert other.begin(fresh=False) == 0
    assert other.parts.ends == []


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("registration/*.yaml")), ids=lambda path: path.stem)
def test_every_registration_config_runs_for_a_step(path: Path, folder: Path, tmp_path: Path):
    command = [
        f"recording={folder}",
        f"output={tmp_path}",
        f"registration={path.stem}",
        "max_frames=1",
        *QUICK,
    ]
    assert infer_main(command) == 0
    assert len(rows(tmp_path)) == 1


def test_a_depth_camera_s_recording_runs_too(synthetic: SyntheticRecording, tmp_path: Path):
    """The renderer's true depth as a depth camera would give it, the empty room learned from the recording."""
    camera = tp.StereoCamera(**{**vars(synthetic.camera), "baseline": None})
    shots = [frame for _, frame in zip(range(2), synthetic, strict=False)]
    room = shots[0].depth[0].clone()
    room[shots[0].mask[0]] = torch.nan  # where the person stands, the background is not known
    frames = [tp.Frame(i, i / 10, depth=shot.depth[0]) for i, shot in enumerate(shots)]
    write_recording(tmp_path / "depth", camera, frames, Backgrounds(depth=room[None]))
    output = tmp_path / "out"
    assert infer_main([f"recording={tmp_path / 'depth'}", f"output={output}", *QUICK]) == 0
    sequence = tp.read_poses_csv(output / "poses.csv")
    assert all(sequence.answered)
    assert (sequence.joints - synthetic.joints[:2].to(sequence.joints))[:, 3:].norm(dim=-1).mean() < 0.08


@pytest.mark.filterwarnings("always::UserWarning")
def test_a_side_by_side_video_s_poses_are_right_and_its_other_frame_rate_is_said(
    synthetic: SyntheticRecording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The renderer's pairs as one lossless video at 12 Hz, by a calibration that says 10."""
    camera = synthetic.camera
    shots = [shot for _, shot in zip(range(2), synthetic, strict=False)]
    write_recording(
        tmp_path / "empty", camera, [tp.Frame(0, 0.0, *(image[0] for image in synthetic.background(1)))]
    )
    for side in ("left", "right"):
        (tmp_path / "empty" / side / "000000.png").rename(tmp_path / "empty" / f"{side}_0.png")
    path = tmp_path / "both.avi"
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), 12, (640, 240))
    for shot in shots:
        pair = torch.cat([shot.left[0], shot.right[0]], dim=2)
        writer.write(np.ascontiguousarray((pair * 255).round().byte().permute(1, 2, 0).numpy()[..., ::-1]))
    writer.release()
    command = [f"calibration={tmp_path / 'empty' / 'calibration.yaml'}", f"background={tmp_path / 'empty'}"]
    assert infer_main([f"recording={path}", *command, f"output={tmp_path / 'out'}", *QUICK]) == 0
    error = capsys.readouterr().err
    assert error.startswith(
        f"warning: {path} has 12 frames a second and the calibration says 10: times are by"
    )
    assert error.count("\n") == 1
    told = json.loads((tmp_path / "out" / "summary.json").read_text())["warnings"]
    assert [f"warning: {sentence}\n" for sentence in told] == [error]
    assert "12 frames a second" in (tmp_path / "out" / "report.html").read_text()
    sequence = tp.read_poses_csv(tmp_path / "out" / "poses.csv")
    assert sequence.time_s.tolist() == [0, 0.1]
    assert all(sequence.answered)
    assert (sequence.joints - synthetic.joints[:2].to(sequence.joints))[:, 3:].norm(dim=-1).mean() < 0.08


def test_a_live_camera_is_recorded_and_then_run(
    synthetic: SyntheticRecording,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    """A video file stands in for the device."""
    shots = [shot for _, shot in zip(range(3), synthetic, strict=False)]
    path = tmp_path / "device.avi"
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), 10, (640, 240))
    for shot in shots:
        pair = torch.cat([shot.left[0], shot.right[0]], dim=2)
        writer.write(np.ascontiguousarray((pair * 255).round().byte().permute(1, 2, 0).numpy()[..., ::-1]))
    writer.release()
    left, right = synthetic.background(1)
    write_recording(tmp_path / "rig", synthetic.camera, [tp.Frame(0, 0.0, left[0], right[0])])
    (tmp_path / "empty").mkdir()
    for side in ("left", "right"):
        (tmp_path / "rig" / side / "000000.png").rename(tmp_path / "empty" / f"{side}_0.png")
    rig = [f"calibration={tmp_path / 'rig' / 'calibration.yaml'}", f"background={tmp_path / 'empty'}"]
    command = [
        "recording=camera:0",
        "record_first=true",
        *rig,
        f"output={tmp_path / 'out'}",
        "max_frames=2",
        *QUICK,
    ]
    opened = []
    monkeypatch.setattr(
        cli, "open_cameras", lambda numbers: opened.append(numbers) or [cv2.VideoCapture(str(path))]
    )
    assert infer_main(command) == 0
    assert opened == [(0,)]
    output = capsys.readouterr().out
    assert f"recording 2 frames into {tmp_path / 'out' / 'recording'}, Ctrl-C ends it" in output
    assert "recorded 2 frames in 0.1 s, 0 dropped" in output
    sequence = tp.read_poses_csv(tmp_path / "out" / "poses.csv")
    assert all(sequence.answered)
    assert (sequence.joints - synthetic.joints[:2].to(sequence.joints))[:, 3:].norm(dim=-1).mean() < 0.08
    # The recording stays, runs again as a folder, and is not lost to the same command.
    recording = tp.open_recording(tmp_path / "out" / "recording")
    assert len(recording) == 2
    assert recording.background().left.shape == (1, 3, 240, 320)
    assert infer_main(command) == 2
    assert "recording runs that, and fresh=true or another output records anew" in capsys.readouterr().err
    # An interrupted run goes on with what was recorded, and with nothing that another command recorded.
    command = [*command[: -len(QUICK) - 1], "max_frames=3", *QUICK, "pose.smoothing.ahead=0"]
    step = tp.People.step
    with monkeypatch.context() as patch:
        patch.setattr(tp.People, "step", interrupted_at(2))
        assert infer_main([*command, "fresh=true"]) == 130
    assert "the same command again goes on" in capsys.readouterr().err
    assert len(tp.open_recording(tmp_path / "out" / "recording")) == 3
    for change in ("recording=camera:1", "max_frames=4"):
        assert infer_main([*command, change]) == 2
        assert f"got {tmp_path / 'out' / 'recording'} with an earlier one" in capsys.readouterr().err
    opened.clear()
    seen = []
    monkeypatch.setattr(tp.People, "step", lambda s, r, p: seen.append(p) or step(s, r, p))
    assert infer_main(command) == 0
    assert (seen, opened) == ([2], [])
    assert f"going on with {tmp_path / 'out' / 'recording'}; fresh=true records" in capsys.readouterr().out
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["frames"], summary["settings"]["recording"]) == (3, "camera:0")


def test_a_live_camera_needs_its_settings_and_a_device(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    camera = [
        "recording=camera:87+88",
        f"calibration={tmp_path}",
        "max_frames=2",
        f"output={tmp_path / 'out'}",
    ]
    for command, message in (
        (camera, "camera:87 must be a camera of this machine, got none that can be opened; plug it in"),
        (
            [*camera[:2], "record_first=true"],
            "max_frames must be given for a camera, got null; add max_frames=",
        ),
        (camera[::2], "calibration must be given for a camera, got null; add calibration="),
        ([*camera, "right=b.mp4"], "right must be a video beside a left one, got b.mp4 beside a camera"),
        (
            ["recording=camera:1+1"],
            "must be camera:N, a side-by-side stereo camera, or camera:N+M, two cameras",
        ),
    ):
        assert infer_main(command) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def damage(folder: Path, kind: str) -> None:
    calibration = folder / "calibration.yaml"
    if kind == "unequal counts":
        (folder / "right" / "000003.png").unlink()
    elif kind == "wrong size":
        for side in ("left", "right"):
            cv2.imwrite(str(folder / side / "000000.png"), np.zeros((100, 100, 3), np.uint8))
    elif kind == "missing value":
        calibration.write_text(re.sub(r"baseline.*\n", "", calibration.read_text()))
    elif kind == "senseless value":
        calibration.write_text(re.sub(r"focal_length.*\n", "focal_length: -3\n", calibration.read_text()))
    else:
        raise AssertionError(kind)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("unequal counts", ("left", "right")),
        ("wrong size", ("320", "100")),
        ("missing value", ("baseline",)),
        ("senseless value", ("focal_length", "-3")),
    ],
)
def test_a_bad_recording_is_one_sentence_and_nothing_is_written(
    kind: str, words: tuple[str, ...], folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    shutil.copytree(folder, tmp_path / "bad")
    damage(tmp_path / "bad", kind)
    assert infer_main([f"recording={tmp_path / 'bad'}", f"output={tmp_path / 'out'}"]) == 2
    message = capsys.readouterr().err.strip()
    assert message.startswith("error: ")
    assert "\n" not in message
    assert all(word in message for word in words)
    assert not (tmp_path / "out").exists()


def test_a_missing_folder_and_an_unknown_setting_are_one_sentence(capsys: pytest.CaptureFixture[str]):
    assert infer_main(["recording=/nowhere/at/all"]) == 2
    assert "/nowhere/at/all" in capsys.readouterr().err
    assert infer_main(["right=right.mp4"]) == 2
    assert "right must come with a recording, got none; give recording=PATH" in capsys.readouterr().err
    assert infer_main(["pose.registration.round=3"]) == 2
    assert "did you mean 'rounds'?" in capsys.readouterr().err
