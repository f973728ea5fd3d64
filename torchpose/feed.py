"""What a camera feeds a live run with: every pair is recorded, the newest one waits, and the others are dropped.

Times are the camera's, or the clock's, in seconds from the first pair that is recorded.
"""

import threading
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from torchpose.calibration import Calibration
from torchpose.capture import CaptureDevice, camera_pairs, read_pair, write_pair
from torchpose.image_file import to_colour
from torchpose.recording import (
    BACKGROUND,
    Backgrounds,
    Frame,
    UnreadableFrame,
    read_backgrounds,
    rectify_pair,
)

_PATIENCE = 0.2  # s, after which whoever waits for a frame looks whether the run is to end
_LONG_AGO = -1e3  # s, when the empty scene was seen: before anything that is remembered in the first frames

Pair = Sequence[np.ndarray]  # left and right image, as OpenCV orders them


@dataclass(frozen=True)
class Shot:
    """A pair that a camera gave."""

    number: int
    time_s: float
    pair: Pair = field(repr=False)


class Mailbox:
    """Room for one shot: a newer one takes its place. `offered` are all that came, `dropped` those nobody took."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._shot: Shot | None = None
        self._closed = False
        self.offered = self.dropped = 0

    def put(self, shot: Shot) -> None:
        """Put a shot into the box, and drop the one in it."""
        with self._condition:
            self.offered += 1
            self.dropped += self._closed or self._shot is not None
            if not self._closed:
                self._shot = shot
            self._condition.notify()

    def take(self) -> Shot | None:
        """The newest shot, once there is one; None when the box is closed and empty."""
        with self._condition:
            while self._shot is None and not self._closed:
                self._condition.wait(_PATIENCE)
            shot, self._shot = self._shot, None
            return shot

    def close(self, empty: bool = False) -> None:
        """No more shots will come; with `empty` the last one is dropped, too."""
        with self._condition:
            self._closed = True
            if empty and self._shot is not None:
                self.dropped, self._shot = self.dropped + 1, None
            self._condition.notify_all()

    def clear(self) -> None:
        """Begin to count."""
        with self._condition:
            self._shot, self.offered, self.dropped = None, 0, 0


class LiveRecording:
    """The frames that are followed, as a `Recording`: the newest from memory, earlier ones from the folder.

    `positions` makes it grow: it waits for the newest shot. `numbers` and `times` are those of a run that goes on.
    """

    def __init__(
        self,
        folder: Path,
        calibration: Calibration,
        mailbox: Mailbox,
        numbers: Sequence[int] = (),
        times: Sequence[float] = (),
    ) -> None:
        self.folder, self.calibration, self.mailbox = folder, calibration, mailbox
        self.camera = calibration.camera
        self._numbers, self._times = array("q", numbers), array("d", times)
        self._newest: Shot | None = None

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, position: int, /) -> Frame:
        """The frame at `position`, 0 to len - 1. Raises UnreadableFrame where its images were not recorded."""
        number, time_s, newest = self._numbers[position], self._times[position], self._newest
        if newest is not None and newest.number == number:
            return stereo_frame(self.calibration, newest)
        try:
            pair = read_pair(self.folder, number)
        except ValueError as error:
            raise UnreadableFrame(f"frame {number} cannot be read: {error}", number, time_s) from None
        return stereo_frame(self.calibration, Shot(number, time_s, pair))

    def background(self) -> Backgrounds:
        """The frames of the empty scene."""
        return read_backgrounds(self.folder / BACKGROUND, self.calibration)

    def positions(self) -> Iterator[int]:
        """The position of the newest frame, one after another, until the camera or the user ends it."""
        while (shot := self.mailbox.take()) is not None:
            self._numbers.append(shot.number)
            self._times.append(shot.time_s)
            self._newest = shot
            yield len(self) - 1
        self._newest = None


class EmptyScene:
    """The empty scene as a recording in which nobody is seen: what a live run learns before it begins."""

    def __init__(self, live: LiveRecording) -> None:
        self.camera, self._empty = live.camera, live.background()

    def __len__(self) -> int:
        return 0 if self._empty.left is None else len(self._empty.left)

    def __getitem__(self, position: int, /) -> Frame:
        """One of the frames of the empty scene."""
        left, right = self._empty.left, self._empty.right
        assert left is not None
        assert right is not None
        return Frame(position, _LONG_AGO + position / self.camera.frame_rate, left[position], right[position])

    def background(self) -> Backgrounds:
        """All of them."""
        return self._empty


class Recorder(threading.Thread):
    """Takes every pair from the cameras, offers it to whoever follows, and once recording `begins` writes it.

    Ends with the camera, after `max_frames`, or when it is told to; `error` says what went wrong, if anything did.
    """

    def __init__(
        self,
        devices: Sequence[CaptureDevice],
        folder: Path,
        rate: float,
        max_frames: int | None,
        clock: Callable[[], float],
    ) -> None:
        super().__init__(daemon=True, name="recorder")
        self.folder, self.mailbox = folder, Mailbox()
        self.error: Exception | None = None
        self.missed, self.last_s = 0, 0.0  # numbers between those that came; the time of the last
        self._pairs = camera_pairs(devices, rate, clock)
        self._rate, self._max_frames = rate, max_frames
        self._begins, self._begun, self._ends = threading.Event(), threading.Event(), threading.Event()

    def begin(self) -> None:
        """Wait for the next pair; from it on, pairs are counted from 0 and recorded."""
        self._begins.set()
        self._begun.wait()

    @property
    def ended(self) -> bool:
        """Whether it was told to end."""
        return self._ends.is_set()

    def end(self) -> None:
        """Take no more pairs, and forget the one that waits."""
        self._ends.set()
        self.mailbox.close(empty=True)

    def run(self) -> None:
        """What the thread does."""
        first_s: float | None = None
        last = -1
        try:
            for number, time_s, pair in self._pairs:
                if self._ends.is_set():
                    break
                if not self._begins.is_set():
                    self.mailbox.put(Shot(number, time_s, pair))
                    continue
                if first_s is None:
                    first_s = time_s
                    self.mailbox.clear()
                    self._begun.set()
                shot = Shot(round(self._rate * (time_s - first_s)), time_s - first_s, pair)
                if shot.number <= last:  # the camera is faster than its calibration says
                    continue
                self.missed += shot.number - last - 1
                last, self.last_s = shot.number, shot.time_s
                self.mailbox.put(shot)
                write_pair(self.folder, shot.number, pair)
                if self.mailbox.offered == self._max_frames:
                    break
        except Exception as error:  # a full disk, a device's own: the run ends with what there is
            self.error = error
        finally:
            self.mailbox.close()
            self._begun.set()


def stereo_frame(calibration: Calibration, shot: Shot) -> Frame:
    """A camera's pair as a frame: RGB in [0, 1], rectified."""
    left, right = (to_colour(np.ascontiguousarray(image[..., ::-1]))[None] for image in shot.pair)
    left, right = rectify_pair(calibration, left, right)
    return Frame(shot.number, shot.time_s, left[0], right[0])
