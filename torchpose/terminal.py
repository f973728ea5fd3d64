"""Words for people at a terminal: wrapped to its width, coloured only there, and how far a long run is.

Colour is left out where the stream is no terminal or NO_COLOR is set (https://no-color.org).
"""

import os
import shutil
import sys
import textwrap
import time
from collections.abc import Iterable, Sequence
from typing import Any, Protocol, runtime_checkable

from tqdm import tqdm

_CODES = {"red": 31, "green": 32, "yellow": 33, "bold": 1}
_LABEL = 18  # columns of a table's labels
_MINUTES = 120.0  # s, from which a wait is told in minutes
_EVERY = 15.0  # s between two lines of progress in a file


@runtime_checkable
class Stream(Protocol):
    """What is needed of `sys.stdout` and `sys.stderr`."""

    def isatty(self) -> bool: ...


def width(stream: Stream | None = None) -> int:
    """Columns of the terminal, at least 40; 100 where the stream is a file."""
    if not (stream or sys.stdout).isatty() and "COLUMNS" not in os.environ:
        return 100
    return max(40, shutil.get_terminal_size().columns)


def coloured(text: str, colour: str, stream: Stream | None = None) -> str:
    """The text in `red`, `green`, `yellow` or `bold` on a terminal; as it is elsewhere."""
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb" or not (stream or sys.stdout).isatty():
        return text
    return f"\033[{_CODES[colour]}m{text}\033[0m"


def table(rows: Iterable[tuple[str, str]], columns: int, most: int | None = None) -> list[str]:
    """Lines of a label and its text, which is wrapped at `columns`; texts longer than `most` lines are cut."""
    lines = []
    for label, text in rows:
        wrapped = textwrap.wrap(
            text, columns - _LABEL, max_lines=most, placeholder=" ...", break_on_hyphens=False
        ) or [""]
        lines += [f"{label if i == 0 else '':<{_LABEL}}{line}" for i, line in enumerate(wrapped)]
    return lines


class Progress:
    """How far a run is: a bar on a terminal, in a file a line every now and then. Both go to stderr.

    `total` is how many frames there are, None where nobody knows; `initial` are done already.
    """

    def __init__(self, total: int | None, initial: int = 0) -> None:
        self.done, self.total, self.initial = initial, total, initial
        self._begin = self._said = time.monotonic()
        self._bar: Any = None
        if sys.stderr.isatty():
            self._bar = tqdm(total=total, initial=initial, unit="frame", leave=False, dynamic_ncols=True)

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def step(self, statuses: Sequence[str]) -> None:
        """One more frame is done, with these statuses of everybody."""
        self.done += 1
        words = ", ".join(statuses)
        if self._bar is not None:
            self._bar.set_postfix_str(words, refresh=False)
            self._bar.update()
            return
        now = time.monotonic()
        if now - self._said >= _EVERY:
            self._said = now
            print(self._line(words, now - self._begin), file=sys.stderr, flush=True)

    def _line(self, words: str, seconds: float) -> str:
        rate = (self.done - self.initial) / seconds
        if self.total is None:
            return f"frame {self.done}, {rate:.1f} a second, {words}"
        left = (self.total - self.done) / rate
        wait = f"{left:.0f} s" if left < _MINUTES else f"{left / 60:.0f} min"
        return f"frame {self.done} of {self.total}, {rate:.1f} a second, {wait} left, {words}"
