"""A whole run over awkward recordings, on awkward disks, and stopped half way."""

import errno
import json
import os
import signal
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import torchpose as tp
from torchpose import session as module
from torchpose.atomic import UnwritableFile
from torchpose.cli import infer_main
from torchpose.export import open_video
from torchpose.recording import Backgrounds, write_recording
from torchpose.registration.colour import ColourConfig
from torchpose.registration.size import SizeConfig
from torchpose.registration.start import StartConfig
from torchpose.session import Session
from torchpose.synthesis.database import make_recording, synthetic_camera
from torchpose.tracking.smoother import SmoothingConfig

FRAMES, RATE = 4, 10.0
TAKEN = [0, 3, 4, 9]  # of 30 a second
CONFIG = tp.PoseConfig(
    height=1.75,
    size=SizeConfig(rounds=0),
    size_frames=1,
    start=StartConfig(points=150, rounds=4, final_rounds=4, finalists=2, refreshes=0),
    smoothing=SmoothingConfig(stretch=4, ahead=1),
    colour=ColourConfig(strength=0.0),
)
QUICK = ["pose.height=1.75", "pose.size.rounds=0", "pose.size_frames=1", "pose.start.final_rounds=4"]
QUICK += ["pose.smoothing.stretch=2", "pose.smoothing.ahead=1"]


class Shown:
    """A depth camera's recording of these frames."""

    def __init__(self, camera: tp.StereoCamera, frames: list[tp.Frame], empty: torch.Tensor) -> None:
        self.camera, self.frames, self.empty = camera, frames, empty

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, position: int, /) -> tp.Frame:
        return self.frames[position]

    def background(self) -> Backgrounds:
        return Backgrounds(depth=self.empty[None])


@pytest.fixture(scope="module")
def shown() -> tuple[Shown, torch.Tensor]:
    """Somebody who lifts both hands, there from the first frame on, and the joints' truth."""
    made = make_recording("both_hands", 1, 0, 10, synthetic_camera(200, 150, 30.0))
    camera = replace(made.camera, baseline=None, frame_rate=RATE)
    shots = [made.frames(k, k + 1) for k in TAKEN]
    room = torch.stack([shot.depth[0].masked_fill(shot.mask[0], torch.nan) for shot in shots])
    frames = [
        tp.Frame(k, k / 30, shot.left[0], depth=shot.depth[0]) for k, shot in zip(TAKEN, shots, strict=True)
    ]
    return Shown(camera, frames, room.nanmedian(0).values), made.joints[TAKEN]


def run(recording: tp.Recording, output: Path) -> tp.PoseSequence:
    """What a run writes, read back."""
    people = tp.People(tp.StereoToPose(recording.camera, config=CONFIG))
    summary = Session(people, recording, output, {}, "1").run()
    found = tp.read_poses_npz(output / "poses.npz")
    table = tp.read_poses_csv(output / "poses.csv")
    assert table.status == found.status
    assert summary["answered"] == sum(found.answered) / len(found)
    expected = [recording[i].time_s for i in range(len(recording))]
    torch.testing.assert_close(found.time_s, torch.tensor(expected, dtype=torch.float64))
    assert table.time_s.tolist() == pytest.approx(expected, abs=1e-6)
    assert not (output / "parts").exists()
    return found


def misfit(found: tp.PoseSequence, truth: torch.Tensor) -> torch.Tensor:
    """Mean distance of the joints to the truth in each frame, m."""
    return (found.joints - truth.to(found.joints))[:, 3:].norm(dim=-1).mean(1)


def test_an_uneven_frame_rate_keeps_its_times(shown: tuple[Shown, torch.Tensor], tmp_path: Path):
    recording, truth = shown
    found = run(recording, tmp_path)
    assert set(found.status) == {"tracked"}
    assert found.time_s.tolist() == [0, 0.1, 4 / 30, 0.3]
    video = cv2.VideoCapture(str(tmp_path / "overlay.mp4"))
    assert video.get(cv2.CAP_PROP_FPS) == 10  # 4 frames in 0.3 s
    assert misfit(found, truth).max() < 0.1


def test_dropped_frames_are_left_out_and_times_stay(shown: tuple[Shown, torch.Tensor], tmp_path: Path):
    recording, truth = shown
    kept = [0, 2, 3]
    found = run(Shown(recording.camera, [recording.frames[i] for i in kept], recording.empty), tmp_path)
    assert found.frame.tolist() == [0, 4, 9]
    assert set(found.status) <= {"tracked", "recovered"}
    assert misfit(found, truth[kept]).max() < 0.1


def test_identical_frames_have_nearly_the_same_pose(shown: tuple[Shown, torch.Tensor], tmp_path: Path):
    recording, truth = shown
    order = [0, 1, 1]
    frames = [replace(recording.frames[k], index=i, time_s=i / RATE) for i, k in enumerate(order)]
    found = run(Shown(recording.camera, frames, recording.empty), tmp_path)
    assert set(found.status) == {"tracked"}
    assert (found.joints[2] - found.joints[1]).norm(dim=-1).max() < 0.1
    assert misfit(found, truth[order]).max() < 0.1


def test_frames_of_one_moment_do_not_break_a_run(shown: tuple[Shown, torch.Tensor], tmp_path: Path):
    """A camera that gives one frame twice, with one time stamp."""
    recording, truth = shown
    order, times = [0, 1, 1], [0.0, 0.1, 0.1]
    frames = [
        replace(recording.frames[k], index=i, time_s=t)
        for i, (k, t) in enumerate(zip(order, times, strict=True))
    ]
    found = run(Shown(recording.camera, frames, recording.empty), tmp_path)
    assert all(found.answered)
    assert found.pose.isfinite().all()
    assert misfit(found, truth[order]).max() < 0.1


def test_depth_with_holes(shown: tuple[Shown, torch.Tensor], tmp_path: Path):
    recording, truth = shown
    generator = torch.Generator().manual_seed(3)
    frames = []
    for frame in recording.frames:
        coarse = torch.rand(1, 1, 30, 40, generator=generator) < 0.2  # a fifth, in squares of 8 px
        holes = torch.nn.functional.interpolate(coarse.float(), frame.depth.shape)[0, 0] > 0
        frames.append(replace(frame, depth=frame.depth.masked_fill(holes, torch.nan)))
    found = run(Shown(recording.camera, frames, recording.empty), tmp_path)
    assert sum(found.answered) >= FRAMES - 1
    assert misfit(found, truth)[list(found.answered)].max() < 0.12


def test_one_frame_is_enough(shown: tuple[Shown, torch.Tensor], tmp_path: Path):
    recording, truth = shown
    found = run(Shown(recording.camera, recording.frames[:1], recording.empty), tmp_path)
    assert found.status == ("tracked",)
    assert misfit(found, truth[:1]).max() < 0.1
    assert {path.name for path in tmp_path.iterdir()} == {
        *("poses.csv", "poses.npz", "poses.mot", "poses.trc", "poses.bvh"),
        *("person.yaml", "overlay.mp4", "angles.png", "report.html", "summary.json"),
    }


def test_files_stand_on_the_floor_also_when_only_they_were_left_to_write(
    shown: tuple[Shown, torch.Tensor], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The room's floor is 1.1 m below a level camera; what learned it was another process."""
    recording, truth = shown
    short = Shown(recording.camera, recording.frames[:2], recording.empty)

    def session() -> Session:
        return Session(tp.People(tp.StereoToPose(short.camera, config=CONFIG)), short, tmp_path, {}, "1")

    with monkeypatch.context() as patch:
        patch.setattr(Session, "finish", lambda *_: {})  # it ends before its files
        session().run()
    assert not (tmp_path / "summary.json").exists()
    monkeypatch.setattr(tp.Eyes, "learn_background", lambda *_: pytest.fail("there is no frame to follow"))
    floor = session().run()["floor"]
    assert floor["tilt_deg"] < 1
    assert floor["height_m"] == pytest.approx(1.1, abs=0.02)
    markers = np.loadtxt(tmp_path / "poses.trc", skiprows=6)[:, 2:].reshape(2, 15, 3)
    feet = 1000 * (1.1 - truth[:2, -2:, 1].numpy())  # mm
    np.testing.assert_allclose(markers[:, -2:, 1], feet, atol=80)
    assert (feet > 0).all()
    table = tp.read_poses_csv(tmp_path / "poses.csv")
    np.testing.assert_allclose(table.joints[:, :, 1], floor["height_m"] - markers[..., 1] / 1000, atol=0.01)


def test_whoever_is_only_entering_answers_nothing(
    shown: tuple[Shown, torch.Tensor], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    recording, _ = shown
    monkeypatch.setattr(tp.Tracker, "acceptable", lambda self, found: False)
    people = tp.People(tp.StereoToPose(recording.camera, config=CONFIG))
    short = Shown(recording.camera, recording.frames[:2], recording.empty)
    summary = Session(people, short, tmp_path, {}, "1").run()
    assert summary["status"] == {"entering": 2}
    assert summary["answered"] == 0.0
    assert "answered          0.0 %: no frame has a pose" in module.summary_table(summary, tmp_path, 80)


@pytest.fixture(scope="module")
def nobody() -> Shown:
    """A wall, quickly done."""
    camera, wall = replace(synthetic_camera(80, 60, RATE), baseline=None), torch.full((60, 80), 5.0)
    return Shown(camera, [tp.Frame(i, i / RATE, depth=wall) for i in range(4)], wall)


@pytest.fixture(scope="module")
def folder(nobody: Shown, tmp_path_factory: pytest.TempPathFactory) -> Path:
    empty = Backgrounds(depth=nobody.empty[None])
    return write_recording(tmp_path_factory.mktemp("r") / "depth", nobody.camera, nobody.frames, empty)


@pytest.fixture(autouse=True)
def no_plot(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """The plot takes a second, and is tested elsewhere."""
    if "one_frame" not in request.node.name:
        monkeypatch.setattr(module, "plot_angles", lambda path, _: path.write_bytes(b""))


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 4 MB; skipped where none may be mounted."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(disk)]
    if os.name != "posix" or os.geteuid() != 0 or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("a small disk can be mounted by root alone")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def fill(disk: Path, left: int) -> Path:
    """A file beside the results, which leaves so many bytes."""
    stats = os.statvfs(disk)
    file = disk / "other"
    file.write_bytes(bytes(stats.f_bavail * stats.f_frsize - left))
    return file


def test_a_full_disk_loses_nothing_and_the_same_command_goes_on(
    folder: Path, small_disk: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    command = [f"recording={folder}", f"output={small_disk / 'out'}", *QUICK]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "SPACE", 0)
        assert infer_main(command) == 0
    before = {path.name: path.read_bytes() for path in (small_disk / "out").iterdir()}
    capsys.readouterr()
    step, filled = tp.People.step, []

    def fills(self, recording, position):
        if position == 3:  # a part of two frames is on the disk
            filled.append(fill(small_disk, 8_000))
        return step(self, recording, position)

    with monkeypatch.context() as patch:
        patch.setattr(tp.People, "step", fills)
        assert infer_main([*command, "--fresh"]) == 2
    error = capsys.readouterr().err
    assert "No space left on device; free some space there and give the same command again" in error
    assert f"{small_disk / 'out' / 'parts'}" in error
    assert {p.name: p.read_bytes() for p in (small_disk / "out").iterdir() if p.is_file()} == before
    filled[0].unlink()
    # Room for the parts, but not for the files: the video is the largest.
    seen = []
    write = module.write_poses_npz

    def then_full(*args):
        write(*args)
        filled.append(fill(small_disk, 10_000))

    with monkeypatch.context() as patch:
        patch.setattr(tp.People, "step", lambda s, r, p: seen.append(p) or step(s, r, p))
        patch.setattr(module, "write_poses_npz", then_full)
        assert infer_main(command) == 2
    assert seen == [2, 3]
    assert "No space left on device; free" in capsys.readouterr().err
    assert {p.name: p.read_bytes() for p in (small_disk / "out").iterdir() if p.is_file()} == before
    filled[-1].unlink()
    monkeypatch.setattr(tp.People, "step", lambda s, r, p: pytest.fail("all frames were done"))
    assert infer_main(command) == 0
    again = tp.read_poses_csv(small_disk / "out" / "poses.csv")
    assert len(again) == 4
    assert not (small_disk / "out" / "parts").exists()


def test_a_full_disk_is_told_although_the_video_s_writer_does_not(small_disk: Path):
    fill(small_disk, 30_000)
    noise = torch.rand(3, 240, 320)
    message = r"a.mp4 must be written, got: No space left on device; free some"

    def write() -> None:
        with open_video(small_disk / "a.mp4", 320, 240, 10.0) as video:
            for _ in range(30):
                video.write(noise)

    with pytest.raises(UnwritableFile, match=message):
        write()
    assert [path.name for path in small_disk.iterdir()] == ["other"]


def test_little_room_is_a_warning_before_the_run(
    nobody: Shown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    run = Session(tp.People(tp.StereoToPose(nobody.camera)), nobody, tmp_path, {}, "1")
    monkeypatch.setattr(module, "SPACE", 10**15)
    with pytest.warns(
        UserWarning, match=r"4 frames may take 4000000.0 GB and the disk of .* free some space"
    ):
        run.begin(fresh=False, count=4)


@pytest.mark.parametrize("place", ["/proc/torchpose", "file/out"])
def test_an_output_that_cannot_be_written_is_one_sentence_before_the_run(
    place: str,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(tp.People, "prepare", lambda *_: pytest.fail("it ran"))
    assert infer_main([f"recording={folder}", f"output={tmp_path / place}"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {tmp_path / place} must be written, got: ")
    assert error.endswith("; choose a folder in which you may write\n")
    assert error.count("\n") == 1


def test_a_write_that_fails_half_way_keeps_what_was_there(
    nobody: Shown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Without a small disk: the operating system's answer is made up."""
    run(nobody, tmp_path)
    # What only an earlier run wrote goes with it; what it did not write stays.
    listed = json.loads((tmp_path / "summary.json").read_text())
    assert sorted(listed["files"]) == sorted(path.name for path in tmp_path.iterdir())
    listed["files"] += ["poses.rrd", "../outside"]
    (tmp_path / "summary.json").write_text(json.dumps(listed))
    for kept in ("poses.rrd", "notes.txt", "poses_last.csv"):
        (tmp_path / kept).write_text("")
    (tmp_path.parent / "outside").write_text("")
    run(nobody, tmp_path)
    assert not (tmp_path / "poses.rrd").exists()
    assert (tmp_path / "notes.txt").exists()
    assert (tmp_path / "poses_last.csv").exists()
    assert (tmp_path.parent / "outside").exists()
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(path: Path, **arrays: np.ndarray) -> None:
        path.write_bytes(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", full)
        with pytest.raises(UnwritableFile, match="No space left on device"):
            run(nobody, tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before
    assert not list(tmp_path.rglob("*.partial*"))


def test_sigterm_is_taken_like_ctrl_c(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    step, seen = tp.People.step, []
    command = [f"recording={folder}", f"output={tmp_path / 'out'}", *QUICK]

    def terminated(self, recording, position):
        if position == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        return step(self, recording, position)

    handler = signal.getsignal(signal.SIGTERM)
    with monkeypatch.context() as patch:
        patch.setattr(tp.People, "step", terminated)
        assert infer_main(command) == 130
    assert signal.getsignal(signal.SIGTERM) is handler
    monkeypatch.setattr(tp.People, "step", lambda s, r, p: seen.append(p) or step(s, r, p))
    assert infer_main([*command, "max_frames=4", "--fresh"]) == 0
    assert seen == [0, 1, 2, 3]


def test_the_summary_fits_a_screen(tmp_path: Path):
    """24 lines of 80 columns at the worst: four people, a live run, forty problems."""
    status = dict.fromkeys(("absent", "entering", "tracked", "partial", "recovered", "lost"), 100_000)
    stages = ("background", "stereo", "silhouette", "points", "faces", "size", "people", "registration")
    summary = {
        "frames": 600_000,
        "status": status,
        "answered": 0.5,
        "point_to_model_m": {"mean": 0.01},
        "seconds": 1e5,
        "seconds_per_frame": 0.2,
        "cpu_ms_per_frame": {**dict.fromkeys(stages, 123.0), "smoothing": 1.0, "export": 1.0},
        "others": [status] * 3,
        "files": [f"{kind}{n}" for kind in ("poses.csv", "poses.npz", "angles.png") for n in range(9)],
        "problems": [f"frame {n} cannot be read: {'x' * 60} must be a whole image" for n in range(40)],
        "live": {
            **{"offered": 10**6, "seconds": 1e5, "followed": 10**5, "dropped": 9 * 10**5},
            **{"drop_rate": 0.9, "missed_by_camera": 12},
        },
    }
    lines = module.summary_table(summary, tmp_path, 80).splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    assert lines[-1].strip() == "and 37 more, see summary.json"
