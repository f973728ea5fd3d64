"""Videos read frame by frame, each by its number, whatever the container says of itself.

A frame's number is the rank of its time stamp among the stamps of the file's packets, which are read without
decoding them (a hundredth of the time), so a frame that the decoder drops leaves its number empty and shifts no
other. Where packets have no stamps, frames are counted, and found again from the start. Images are RGB bytes,
(H, W, 3), by OpenCV's FFmpeg.
"""

import bisect
import math
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

_SEEK_COST = 16  # frames that OpenCV decodes before the one it seeks
_RATE_ROUNDING = 1e-3  # relative; time stamps are whole units of the container's clock
_LATE_FAILURES = 64  # failed grabs that a decoder with delayed frames may give beyond one a frame


class VideoFile:
    """The frames of one video file, 0 to len - 1; only the last one read is in memory.

    Reading in order decodes each frame once and never seeks. After a jump the decoder starts again at a key frame
    before, so a frame is the same however it is reached. A frame that the decoder patches up by itself is taken
    as it is.
    """

    def __init__(self, path: str | Path) -> None:
        """Read the time stamps, and decode the end, back to a key frame, to know what the last frame is.

        Raises ValueError where the file is absent, is no video, or none of its frames can be decoded.
        """
        self.path = Path(path)
        if not self.path.is_file():
            raise ValueError(f"the video must be a file, but {self.path} is none; check the path")
        self._capture = self._open()
        self._at: float = -1  # the number of the frame that was grabbed last
        self._image: UInt8[np.ndarray, "height width 3"] | None = None  # of this frame, once it is asked for
        self._stamps, self._keys = self._packets()
        self._stamped = len(set(self._stamps)) == len(self._stamps)
        if not self._stamped:  # old MPEG streams and the like: their frames can only be counted
            self._stamps, self._keys = list(range(self._count())), [0]
        self._numbers = {stamp: number for number, stamp in enumerate(self._stamps)}
        length = self._decodable()
        self._stamps = self._stamps[:length]
        self.width = int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        self.height = int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT))

    def __len__(self) -> int:
        """The last frame that can be decoded, and all before it."""
        return len(self._stamps)

    @property
    def frame_rate(self) -> float:
        """Frames in a second, Hz: the header's if the time stamps bear it out, else the time stamps'."""
        promised = float(self._capture.get(cv2.CAP_PROP_FPS))
        if len(self) < 2 or not self._stamped:
            return promised
        measured = 1e6 * (len(self) - 1) / (self._stamps[-1] - self._stamps[0])
        return promised if abs(promised - measured) <= _RATE_ROUNDING * measured else measured

    def read(self, number: int) -> UInt8[np.ndarray, "height width 3"]:
        """The image of frame `number`, 0 to len - 1; ValueError where the decoder has none for it."""
        if not 0 <= number < len(self):
            raise IndexError(f"{self.path} has the frames 0 to {len(self) - 1}, got {number}")
        if number != self._at:
            key = self._keys[bisect.bisect_right(self._keys, number) - 1]
            if number < self._at or key > self._at + _SEEK_COST:
                self._seek(number)
            while self._at < number:
                self._grab()
        if number != self._at:
            raise ValueError(
                f"{self.path} must have a frame {number} that can be decoded, got damaged data; copy the video again"
            )
        if self._image is None:
            image = self._capture.retrieve()[1]
            self._image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        return self._image

    def _open(self) -> cv2.VideoCapture:
        # One thread: with more, the first frames after a jump wait for the others.
        capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
        if not capture.isOpened():
            raise ValueError(
                f"{self.path} must be a video that OpenCV can read, got a file that it cannot open; "
                "give an MP4, AVI, MKV or WebM, and where it was cut off, record or copy it again"
            )
        # The calibration is of the sensor's rows and columns, whatever the file says of its orientation.
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        return capture

    def _packets(self) -> tuple[list[int], list[int]]:
        """Time stamps of all packets in order, us, and the numbers of those that decoding can start from."""
        capture = self._open()
        capture.set(cv2.CAP_PROP_FORMAT, -1)  # packets, not images
        packets = []
        while capture.grab():
            packets.append((_stamp(capture), bool(capture.get(cv2.CAP_PROP_LRF_HAS_KEY_FRAME))))
        packets.sort()
        keys = {0} | {number for number, (_, key) in enumerate(packets) if key}
        return [stamp for stamp, _ in packets], sorted(keys)

    def _count(self) -> int:
        """How many frames can be decoded, by decoding them all."""
        capture, count, failures = self._open(), 0, 0
        while failures < _LATE_FAILURES:
            there = capture.grab()
            count, failures = count + there, 0 if there else failures + 1
        return count

    def _decodable(self) -> int:
        """One more than the last frame that can be decoded: a file that was cut off promises more."""
        last = -1
        for key in reversed(self._keys if self._stamps else []):
            self._seek(key)
            while self._at < len(self._stamps):
                last = max(last, int(self._at))
                self._grab()
            if last >= 0:
                return last + 1
        raise ValueError(
            f"{self.path} must have a frame that can be decoded, got none in {len(self._stamps)} packets; "
            "record or copy it again"
        )

    def _seek(self, number: int) -> None:
        """Go to `number` or a frame before it: before, where time stamps are uneven or the file lies."""
        for before in (0, 4 * _SEEK_COST) if self._stamped else ():
            self._capture.set(cv2.CAP_PROP_POS_MSEC, self._stamps[max(number - before, 0)] / 1000)
            self._grab()
            if self._at <= number:
                return
        self._capture, self._at, self._image = self._open(), -1, None

    def _grab(self) -> None:
        """Go to the next frame that can be decoded; past the last one, to infinity."""
        self._image = None
        for _ in range(len(self._stamps) + _LATE_FAILURES):  # a grab fails at each damaged frame
            if self._capture.grab():
                self._at = (
                    self._numbers.get(_stamp(self._capture), math.inf) if self._stamped else self._at + 1
                )
                return
        self._at = math.inf


def _stamp(capture: cv2.VideoCapture) -> int:
    """Time of the frame or packet that was grabbed last, us."""
    return round(1000 * capture.get(cv2.CAP_PROP_POS_MSEC))
