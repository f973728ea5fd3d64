"""A live run by cameras that are made up here: they give frames by the clock, as fast as a camera does."""

import http.client
import json
import os
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import torchpose as tp
from torchpose import cli
from torchpose.atomic import UnwritableFile
from torchpose.calibration import Calibration, write_calibration
from torchpose.cli import infer_main
from torchpose.feed import LiveRecording, Mailbox, Recorder, Shot
from torchpose.live import LiveConfig
from torchpose.synthesis.database import make_recording, synthetic_camera
from torchpose.tracking.smoother import SmoothingConfig
from torchpose.web_view import WebView

RATE = 30.0
CAMERA = synthetic_camera(160, 120, RATE)
QUICK = ["pose.height=1.75", "pose.size.rounds=0", "pose.size_frames=1", "pose.start.final_rounds=4"]
QUICK += ["pose.smoothing.stretch=4", "pose.smoothing.ahead=1", "live.port=0", "live.empty_frames=4"]
QUICK += ["live.step_out=0.1", "align=false", "pose.colour.strength=0", "eyes.sampling.num_points=200"]
QUICK += ["pose.start.points=100", "pose.start.rounds=3", "pose.start.finalists=2", "pose.start.refreshes=0"]


class ClockedCamera:
    """A side-by-side camera that gives its frames by the clock; who asks late misses some.

    Shows the empty room, and from `enter` on somebody who moves, forth and back. Ends after `lasts` frames.
    """

    def __init__(self, pairs: list[np.ndarray], empty: np.ndarray, lasts: int | None = None) -> None:
        self.pairs, self.empty, self.lasts = pairs, empty, lasts
        self.entered = threading.Event()
        self.begin, self.tick, self.given, self.released = time.monotonic(), -1, 0, False

    def grab(self) -> bool:
        if self.entered.is_set():
            self.given += 1
            if self.lasts is not None and self.given > self.lasts:
                return False
        now = (time.monotonic() - self.begin) * RATE
        self.tick = max(self.tick + 1, int(now))
        time.sleep(max(0.0, (self.tick - now) / RATE))
        return True

    def retrieve(self) -> tuple[bool, np.ndarray]:
        if not self.entered.is_set():
            return True, self.empty
        turn = 2 * len(self.pairs) - 2
        place = self.given % turn
        return True, self.pairs[min(place, turn - place)]

    def get(self, name: int) -> float:
        size = {cv2.CAP_PROP_FRAME_WIDTH: 2 * CAMERA.width, cv2.CAP_PROP_FRAME_HEIGHT: CAMERA.height}
        return float(size.get(name, RATE if name == cv2.CAP_PROP_FPS else 0.0))

    def set(self, name: int, value: float) -> bool:
        return True

    def release(self) -> None:
        self.released = True


def side_by_side(left: torch.Tensor, right: torch.Tensor) -> np.ndarray:
    pair = torch.cat([left, right], 2).mul(255).round().byte().permute(1, 2, 0).numpy()
    return np.ascontiguousarray(pair[..., ::-1])


@pytest.fixture(scope="module")
def images() -> tuple[list[np.ndarray], np.ndarray]:
    made = make_recording("both_hands", 1, 0, 6, CAMERA)
    left, right = made.background(1)
    return [side_by_side(shot.left[0], shot.right[0]) for shot in made], side_by_side(left[0], right[0])


@pytest.fixture
def camera(
    images: tuple[list[np.ndarray], np.ndarray], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> ClockedCamera:
    """A camera that `camera:0` opens, and its calibration in rig.yaml."""
    device = ClockedCamera(*images)
    monkeypatch.setattr(cli, "open_cameras", lambda numbers: [device])
    write_calibration(tmp_path / "rig.yaml", Calibration(CAMERA, depth_unit=None))
    return device


class Browser(threading.Thread):
    """Looks at the page as a browser does, lets somebody come in once the run is live, and ends it."""

    def __init__(self, camera: ClockedCamera, follows: int, stops: bool = True, ctrl_c: bool = False) -> None:
        super().__init__(daemon=True)
        self.camera, self.follows, self.stops, self.ctrl_c = camera, follows, stops, ctrl_c
        self.port = 0
        self.states: list[dict] = []
        self.page = self.image = b""

    def ask(self, path: str, method: str = "GET", **headers: str) -> tuple[int, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=10)
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        found = answer.status, answer.read()
        connection.close()
        return found

    def run(self) -> None:
        while not self.port:
            time.sleep(0.01)
        self.page = self.ask("/")[1]
        while True:
            try:
                state = json.loads(self.ask("/state.json")[1])
            except OSError:
                return
            self.states.append(state)
            if state.get("phase") == "live":
                self.camera.entered.set()
                self.image = self.ask("/frame.jpg")[1]
                if self.stops and state["followed"] >= self.follows:
                    if self.ctrl_c:
                        os.kill(os.getpid(), signal.SIGINT)
                    else:
                        self.ask("/stop", "POST")
                    return
            time.sleep(0.02)


@pytest.fixture(autouse=True)
def no_plot(monkeypatch: pytest.MonkeyPatch) -> None:
    """The plot takes a second, and is tested elsewhere."""
    monkeypatch.setattr("torchpose.session.plot_angles", lambda path, _: path.write_bytes(b""))


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> list[Browser]:
    """Browsers that are told the port of the page."""
    browsers: list[Browser] = []
    make = WebView.__init__

    def told(self: WebView, port: int, stop) -> None:
        make(self, port, stop)
        for browser in browsers:
            browser.port = self.port

    monkeypatch.setattr(WebView, "__init__", told)
    return browsers


def test_a_camera_is_followed_live_and_everything_is_written(
    camera: ClockedCamera, watched: list[Browser], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    browser = Browser(camera, follows=6)
    watched.append(browser)
    browser.start()
    output = tmp_path / "out"
    command = ["recording=camera:0", f"calibration={tmp_path / 'rig.yaml'}", f"output={output}", *QUICK]
    assert infer_main(command) == 0
    browser.join(10)
    assert camera.released
    live = json.loads((output / "summary.json").read_text())["live"]
    # What came was followed or dropped, and nothing waited.
    assert live["followed"] + live["dropped"] == live["offered"]
    assert live["dropped"] > 0
    assert live["drop_rate"] == pytest.approx(live["dropped"] / live["offered"])
    found = tp.read_poses_csv(output / "poses.csv")
    assert len(found) == live["followed"] >= 6
    assert "tracked" in found.status
    # All pairs are in the recording, which runs again; times are the clock's, numbers those at the camera's rate.
    recorded = tp.open_recording(output / "recording")
    assert len(recorded) == live["offered"]
    assert recorded.background().left.shape == (4, 3, 120, 160)
    assert set(found.frame.tolist()) <= set(recorded.indices)
    assert (found.time_s - found.frame / RATE).abs().max() <= 0.5 / RATE + 1e-6
    assert found.time_s[0] == 0
    assert (found.time_s.diff() > 0).all()
    video = cv2.VideoCapture(str(output / "overlay.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == len(found)
    elapsed = float(found.time_s[-1])
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx((len(found) - 1) / elapsed, abs=0.01)
    # The page has shown all of it.
    assert b"torchpose live" in browser.page
    assert b"http" not in browser.page.replace(b"http-equiv", b"")  # nothing from elsewhere
    assert cv2.imdecode(np.frombuffer(browser.image, np.uint8), cv2.IMREAD_COLOR).shape == (120, 160, 3)
    phases = [state.get("phase") for state in browser.states]
    assert [p for p in ("empty", "learning", "live") if p in phases] == ["empty", "learning", "live"]
    last = [state for state in browser.states if state.get("phase") == "live"][-1]
    assert last["followed"] + last["dropped"] + 1 >= last["offered"]  # one may wait
    assert last["fps"] > 0
    assert any(
        isinstance(angle, float)
        for state in browser.states
        for person in state.get("people", [])
        for angle in person["angles"].values()
    )
    printed = capsys.readouterr().out
    assert f"live on http://127.0.0.1:{browser.port}; Ctrl-C" in printed
    assert "step out of the camera's view" in printed
    assert f"live              {live['offered']} pairs in " in printed
    assert f"{live['dropped']} dropped (" in printed
    # Again is not over it.
    assert infer_main(command) == 2
    assert "fresh=true or another output records anew" in capsys.readouterr().err


def test_a_camera_that_goes_away_ends_the_run_with_what_there_is(
    camera: ClockedCamera, watched: list[Browser], tmp_path: Path
):
    camera.lasts = 10
    browser = Browser(camera, follows=0, stops=False)
    watched.append(browser)
    browser.start()
    command = ["recording=camera:0", f"calibration={tmp_path / 'rig.yaml'}", f"output={tmp_path / 'out'}"]
    assert infer_main([*command, *QUICK]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["frames"] == summary["live"]["followed"] > 0
    # Those of the person and those of the empty room before; the last one was followed, since nobody ended it.
    assert summary["live"]["offered"] >= 10
    found = tp.read_poses_npz(tmp_path / "out" / "poses.npz")
    assert int(found.frame[-1]) == tp.open_recording(tmp_path / "out" / "recording").indices[-1]


def test_whoever_ends_it_before_it_began_leaves_nothing(
    camera: ClockedCamera, watched: list[Browser], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    class Hasty(Browser):
        def run(self) -> None:
            while not self.port:
                time.sleep(0.01)
            assert self.ask("/stop", "POST")[0] == 200

    watched.append(Hasty(camera, 0))
    watched[0].start()
    command = ["recording=camera:0", f"calibration={tmp_path / 'rig.yaml'}", f"output={tmp_path / 'out'}"]
    assert infer_main([*command, *QUICK, "live.step_out=60"]) == 130
    assert camera.released
    assert list((tmp_path / "out").iterdir()) == []


def test_files_that_could_not_be_written_are_written_by_the_same_command(
    camera: ClockedCamera, watched: list[Browser], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    browser = Browser(camera, follows=3, ctrl_c=True)
    watched.append(browser)
    browser.start()
    command = ["recording=camera:0", f"calibration={tmp_path / 'rig.yaml'}", f"output={tmp_path / 'out'}"]
    command += QUICK

    def full(*_: object) -> None:
        raise UnwritableFile("poses.csv must be written, got: No space left on device; free some")

    with monkeypatch.context() as patch:
        patch.setattr("torchpose.session.write_poses_csv", full)
        assert infer_main(command) == 2
    assert not (tmp_path / "out" / "poses.csv").exists()
    monkeypatch.setattr(cli, "open_cameras", lambda numbers: pytest.fail("it was recorded already"))
    assert infer_main(command) == 0
    found = tp.read_poses_csv(tmp_path / "out" / "poses.csv")
    assert len(found) >= 3
    video = cv2.VideoCapture(str(tmp_path / "out" / "overlay.mp4"))
    images = [video.read()[1] for _ in range(len(found))]
    assert min(image.mean() for image in images) > 20  # none is black: they came from the recording


def test_a_port_in_use_is_one_sentence_and_nothing_is_recorded(
    camera: ClockedCamera, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    view = WebView(0, lambda: None)
    command = ["recording=camera:0", f"calibration={tmp_path / 'rig.yaml'}", f"output={tmp_path / 'out'}"]
    assert infer_main([*command, *QUICK, f"live.port={view.port}"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: live.port must be a port that this machine has free, got {view.port}: ")
    assert "such as live.port=0 for any" in error
    assert error.count("\n") == 1
    assert camera.released
    assert not (tmp_path / "out" / "recording").exists()
    view.close()


def test_only_our_own_page_may_ask():
    stopped = []
    view = WebView(0, lambda: stopped.append(True))
    browser = Browser.__new__(Browser)
    browser.port = view.port
    try:
        assert browser.ask("/state.json") == (200, b"{}")
        assert browser.ask("/frame.jpg")[0] == 404
        assert browser.ask("/state.json", Host="evil.example")[0] == 403
        assert browser.ask("/stop", "POST", Origin="http://evil.example")[0] == 403
        assert browser.ask("/../secret")[0] == 404
        assert stopped == []
        assert browser.ask("/stop", "POST", Origin=view.url)[0] == 200
        assert stopped == [True]
        assert view.watched
    finally:
        view.close()
    with pytest.raises(OSError, match="refused"):
        browser.ask("/")


def test_the_mailbox_holds_one_and_counts_right():
    box, pair = Mailbox(), [np.zeros((1, 1, 3), np.uint8)] * 2
    for number in range(5):
        box.put(Shot(number, 0.0, pair))
    assert box.take().number == 4
    assert (box.offered, box.dropped) == (5, 4)
    box.put(Shot(5, 0.0, pair))
    box.close()
    assert box.take().number == 5  # what waits is taken, when the camera ends by itself
    assert box.take() is None
    box.put(Shot(6, 0.0, pair))  # after the end
    assert box.take() is None
    assert (box.offered, box.dropped) == (7, 5)
    ended = Mailbox()
    ended.put(Shot(0, 0.0, pair))
    ended.close(empty=True)
    assert ended.take() is None
    assert (ended.offered, ended.dropped) == (1, 1)


def test_a_full_disk_ends_the_recording_and_is_told(
    images: tuple[list[np.ndarray], np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The thread that records must not die unseen, nor leave the one that follows waiting."""
    recorder = Recorder([ClockedCamera(*images)], tmp_path, RATE, None, time.monotonic)
    live = LiveRecording(tmp_path, Calibration(CAMERA, depth_unit=None), recorder.mailbox)

    def full(*_: object) -> None:
        raise UnwritableFile("no space")

    monkeypatch.setattr("torchpose.feed.write_pair", full)
    recorder.start()
    recorder.begin()
    assert list(live.positions()) == [0]
    recorder.join(5)
    assert isinstance(recorder.error, UnwritableFile)
    with pytest.raises(tp.recording.UnreadableFrame, match="frame 0 cannot be read"):
        live[0]


def test_wrong_settings_are_one_sentence():
    with pytest.raises(ValueError, match="port must be from 0 to 65535, got 70000"):
        LiveConfig(port=70000)
    with pytest.raises(ValueError, match="step_out must not be negative"):
        LiveConfig(step_out=-1.0)
    with pytest.raises(ValueError, match="0 <= ahead < stretch must hold"):
        LiveConfig(stretch=3, ahead=3)


def test_live_smoothing_is_in_shorter_stretches():
    usual = SmoothingConfig()
    assert LiveConfig().smoothing(usual) == replace(usual, stretch=12, ahead=6)
    short = replace(usual, stretch=4, ahead=1)
    assert LiveConfig().smoothing(short) == short
    assert LiveConfig().smoothing(replace(usual, stretch=5, ahead=4)).ahead == 4
