"""A camera that is followed as its frames come, and shown on a page of this machine.

Three threads: one records every pair that the camera gives, one serves the page, and the main one follows. What it is
too slow for is dropped, never queued: only the newest pair waits. Times are the camera's, or the clock's.
"""

import shutil
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchpose.aligned import AlignedRecording, align_recording
from torchpose.calibration import read_calibration, write_calibration
from torchpose.capture import (
    CaptureDevice,
    prepare_cameras,
    require_empty,
)
from torchpose.feed import EmptyScene, LiveRecording, Mailbox, Recorder, stereo_frame
from torchpose.figures import draw_overlay
from torchpose.image_file import to_colour, write_image
from torchpose.overlay import overlays
from torchpose.parts import LabelledPoints
from torchpose.pipeline import FramePose
from torchpose.recording import (
    BACKGROUND,
    CALIBRATION,
    Backgrounds,
    Frame,
    Recording,
)
from torchpose.scaled import at_most
from torchpose.session import Session
from torchpose.tracking.smoother import SmoothingConfig
from torchpose.web_view import WebView

_GRAB = 15.0  # s that a camera may take to answer
_RECENT = 20  # frames over which the rate is measured
_SIDES = ("left", "right")
_SHOWN = ("shoulder_flexion", "shoulder_abduction", "elbow_flexion", "hip_flexion", "knee_flexion")


@dataclass(frozen=True)
class LiveConfig:
    """A camera that is followed live."""

    port: int = 8600  # of the page, http://127.0.0.1:8600; 0 takes any that is free
    step_out: float = (
        8.0  # s to leave the view before the empty scene is recorded, where background= is not given
    )
    empty_frames: int = 20  # of the empty scene that are recorded then
    stretch: int = 12  # at most so many frames are smoothed at once: nobody is followed meanwhile
    ahead: int = 6  # coming frames that they hear of, at most

    def __post_init__(self) -> None:
        if not 0 <= self.port < 2**16:
            raise ValueError(f"port must be from 0 to 65535, got {self.port}; 8600 is the default")
        if self.step_out < 0 or self.empty_frames < 1:
            raise ValueError(
                f"step_out must not be negative and empty_frames at least 1, got {self.step_out} and "
                f"{self.empty_frames}; 8 and 20 are the defaults"
            )
        if not 0 <= self.ahead < self.stretch:
            raise ValueError(
                f"0 <= ahead < stretch must hold, in frames, got {self.ahead} and {self.stretch}; 6 and 12 are the "
                "defaults"
            )

    def smoothing(self, config: SmoothingConfig) -> SmoothingConfig:
        """The smoothing of a live run: in shorter stretches."""
        stretch = min(config.stretch, self.stretch)
        return replace(config, stretch=stretch, ahead=min(config.ahead, self.ahead, stretch - 1))


@dataclass
class LiveRun:
    """A live run from the empty scene to the files.

    `session_of` makes the session for a recording whose rows were that far apart, see `Session`.
    """

    folder: Path  # of the recording, to be made
    calibration: Path
    config: LiveConfig
    session_of: Callable[[Recording, float | None], Session]
    max_width: int
    align: bool
    background: str | None = None
    max_frames: int | None = None
    clock: Callable[[], float] = time.monotonic

    def run(self, devices: Sequence[CaptureDevice]) -> dict[str, Any]:
        """Follow the cameras until they end, or somebody ends it by Ctrl-C or on the page; returns the summary.

        Raises ValueError where the folder is not empty, the port is taken, or no image comes.
        """
        require_empty(self.folder)
        known = prepare_cameras(devices, self.calibration)
        recorder = Recorder(devices, self.folder, known.camera.frame_rate, self.max_frames, self.clock)
        view = WebView(self.config.port, recorder.end)
        live = LiveRecording(self.folder, known, recorder.mailbox)
        print(f"live on {view.url}; Ctrl-C, or the button on that page, ends it and writes the files")
        begin = time.perf_counter()
        followed = 0
        recorder.start()
        try:
            with _ended_by_ctrl_c(recorder.end):
                session, rows = self._prepare(live, recorder, view)
                recorder.begin()
                watch = Watch(session, live, recorder, view)
                session.follow(live.positions(), None, watch)
                followed = len(live)
            recorder.end()
            recorder.join()
            if not followed:
                raise _nothing(recorder, "a camera must give images, got none that can be decoded")
            if recorder.error is not None:
                session.problems.append(f"the recording ended early: {recorder.error}")
            view.show(watch.state("writing", "writing the files"))
            write_calibration(self.folder / CALIBRATION, known)
            summary = session.finish(begin, followed, {"live": watch.counts(), "rows_apart_px": rows})
            view.show(watch.state("ended", f"ended: the files are in {session.output}"))
            return summary
        finally:
            recorder.end()
            recorder.join(_GRAB)  # the cameras are closed after this
            view.close()
            if not followed:
                shutil.rmtree(self.folder, ignore_errors=True)

    def resume(self) -> dict[str, Any] | None:
        """Write the files of a run that ended before it had; None where there is none."""
        known = read_calibration(self.calibration)
        live = LiveRecording(self.folder, known, Mailbox())
        session = self.session_of(at_most(live, self.max_width), None)
        if not session.begin(fresh=False):
            return None
        sequence = session.parts.person(0).sequence
        earlier = LiveRecording(
            self.folder, known, Mailbox(), sequence.frame.tolist(), sequence.time_s.tolist()
        )
        session.recording = at_most(earlier, self.max_width)
        write_calibration(self.folder / CALIBRATION, known)
        return session.finish(time.perf_counter(), len(earlier), {"rows_apart_px": None})

    def _prepare(
        self, live: LiveRecording, recorder: Recorder, view: WebView
    ) -> tuple[Session, float | None]:
        """The session, which knows the empty scene, and how far apart the cameras' rows are, px."""
        if self.background is not None:
            shutil.copytree(self.background, self.folder / BACKGROUND)
        else:
            self._record_empty_scene(live, recorder, view)
        _tell(view, "learning", "learning the empty scene: stay out of the view")
        scene: Recording = EmptyScene(live)
        if not len(scene):
            raise ValueError(
                f"the background must have images left_K and right_K, got none in {self.background}; add them, or "
                "leave background= out and step out of the view when asked to"
            )
        recording, rows_before = align_recording(scene) if self.align else scene, None
        frames: Recording = live
        if isinstance(recording, AlignedRecording):
            frames = AlignedRecording(live, recording.alignment)
            rows_before = recording.alignment.typical * min(1.0, self.max_width / live.camera.width)
        recording, frames = at_most(recording, self.max_width), at_most(frames, self.max_width)
        session = self.session_of(frames, rows_before)
        session.begin(fresh=True)
        rows = session.check_rows(recording)
        session.people.prepare(recording)
        print("following: come into the view")
        return session, rows

    def _record_empty_scene(self, live: LiveRecording, recorder: Recorder, view: WebView) -> None:
        """Ask everybody out of the view, wait, and record some frames."""
        print(f"step out of the camera's view: the empty scene is recorded in {self.config.step_out:.0f} s")
        until, count = time.monotonic() + self.config.step_out, 0
        while count < self.config.empty_frames:
            shot = recorder.mailbox.take()
            if shot is None:
                wanted = self.config.empty_frames
                raise _nothing(
                    recorder, f"a camera must give {wanted} images of the empty scene, got {count}"
                )
            left = until - time.monotonic()
            seconds = f"step out of the view\n{left:.0f} s" if left > 0 else "stay out of the view"
            image = stereo_frame(live.calibration, shot).left if view.watched else None
            view.show({"phase": "empty", "image": shot.number, "message": seconds}, image)
            if left <= 0:
                for side, pixels in zip(_SIDES, shot.pair, strict=True):
                    colour = to_colour(np.ascontiguousarray(pixels[..., ::-1]))
                    write_image(live.folder / BACKGROUND / f"{side}_{count}", colour, ".png")
                count += 1


class Watch:
    """Tells the page of each frame that was followed, and counts."""

    def __init__(self, session: Session, live: LiveRecording, recorder: Recorder, view: WebView) -> None:
        self.session, self.live, self.recorder, self.view = session, live, recorder, view
        self._moments: deque[float] = deque(maxlen=_RECENT)
        self._last: dict[str, Any] = {}

    def __call__(self, poses: list[FramePose]) -> None:
        """The poses in the newest frame, as they are before they are smoothed."""
        self._moments.append(time.monotonic())
        people: list[dict[str, Any]] = [{"status": pose.status.value, "angles": {}} for pose in poses]
        image = None
        if self.view.watched:
            image = self._draw(poses, people)
        self._last = {"people": people, "time_s": poses[0].time_s, "image": poses[0].index}
        self.view.show(self.state("live", ""), image)

    def state(self, phase: str, message: str) -> dict[str, Any]:
        """What the page shows."""
        elapsed = self._moments[-1] - self._moments[0] if self._moments else 0.0
        counts = self.counts()
        rates = {
            "fps": (len(self._moments) - 1) / elapsed if elapsed > 0 else None,
            "camera_fps": counts["camera_rate"],
        }
        return {**self._last, **counts, **rates, "phase": phase, "message": message}

    def counts(self) -> dict[str, int | float]:
        """Pairs that the camera gave, that were followed and dropped, and that it missed itself, by its rate."""
        box, seconds = self.recorder.mailbox, self.recorder.last_s
        offered, dropped = box.offered, box.dropped
        return {
            "offered": offered,
            "followed": len(self.live),
            "dropped": dropped,
            "drop_rate": dropped / max(offered, 1),
            "missed_by_camera": self.recorder.missed,
            "camera_rate": (offered - 1) / seconds if seconds > 0 else 0.0,
            "seconds": seconds,
        }

    def _draw(self, poses: list[FramePose], people: list[dict[str, Any]]) -> torch.Tensor | None:
        """The newest frame with everybody over it; everybody's angles go to `people`."""
        sight = next((pose.sight for pose in poses if pose.sight is not None), None)
        image = None if sight is None else sight.images[0]
        for k, (pose, person) in enumerate(zip(poses, people, strict=True)):
            model = self.session.people.followers[k].model
            sequence = model.sequence([pose])
            degrees = dict(zip(sequence.angle_names, sequence.angles[0].rad2deg().tolist(), strict=True))
            person["angles"] = {
                f"{name}_{side}": round(value, 1) if value == value else None
                for name in _SHOWN
                for side in _SIDES
                if (value := degrees.get(f"{name}_{side}", float("nan"))) is not None
            }
            if image is not None:
                drawn = overlays(model, sequence, [LabelledPoints.of(pose)], k if len(poses) > 1 else None)[0]
                image = draw_overlay(image, drawn)
        if image is None:
            frame = self.live[len(self.live) - 1]
            image = at_most(_Single(frame, self.live), self.session.model.camera.width)[0].left
        return image


class _Single:
    """One frame as a recording."""

    def __init__(self, frame: Frame, live: LiveRecording) -> None:
        self.frame, self.camera = frame, live.camera

    def __len__(self) -> int:
        return 1

    def __getitem__(self, position: int, /) -> Frame:
        return self.frame

    def background(self) -> Backgrounds:
        return Backgrounds()


def _nothing(recorder: Recorder, sentence: str) -> BaseException:
    """Why there is nothing to follow."""
    if recorder.ended and recorder.error is None:
        return KeyboardInterrupt()
    return recorder.error or ValueError(
        f"{sentence}; try the camera in another program, or unplug it and plug it in again"
    )


def _tell(view: WebView, phase: str, message: str) -> None:
    view.show({"phase": phase, "image": 0, "message": message})
    print(message)


@contextmanager
def _ended_by_ctrl_c(end: Callable[[], None]) -> Iterator[None]:
    """The first Ctrl-C or SIGTERM ends the run in good order, the next one at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {name: signal.getsignal(name) for name in (signal.SIGINT, signal.SIGTERM)}

    def ending(*_: object) -> None:
        for name in before:
            signal.signal(name, signal.default_int_handler)
        end()

    for name in before:
        signal.signal(name, ending)
    try:
        yield
    finally:
        for name, handler in before.items():
            signal.signal(name, handler)
