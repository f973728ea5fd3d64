"""Words at a terminal: their width, their colour, and how far a run is."""

import io
import sys

import pytest

from torchpose import terminal
from torchpose.terminal import Progress, coloured, table, width


class Screen(io.StringIO):
    """A terminal."""

    def isatty(self) -> bool:
        return True


def test_colour_is_for_terminals_alone(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    assert coloured("error:", "red", Screen()) == "\033[31merror:\033[0m"
    assert coloured("error:", "red", io.StringIO()) == "error:"
    monkeypatch.setenv("TERM", "dumb")
    assert coloured("error:", "red", Screen()) == "error:"
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("NO_COLOR", "1")
    assert coloured("error:", "red", Screen()) == "error:"


def test_lines_are_wrapped_below_their_label():
    text = "one two three four five six seven eight nine ten"
    lines = table([("numbers", text), ("none", "")], 40)
    assert lines[0] == "numbers           one two three four"
    assert lines[1] == "                  five six seven eight"
    assert lines[-1].strip() == "none"
    assert max(map(len, lines)) <= 40
    assert " ".join(line[18:] for line in lines[:-1]) == text
    assert table([("numbers", text)], 40, most=2)[-1].endswith(" ...")
    assert len(table([("numbers", text)], 40, most=2)) == 2


def test_the_width_is_the_terminal_s(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "72")
    assert width(Screen()) == 72
    monkeypatch.setenv("COLUMNS", "10")
    assert width(Screen()) == 40
    monkeypatch.delenv("COLUMNS")
    assert width(io.StringIO()) == 100


def test_a_file_gets_a_line_now_and_then(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    clock = [0.0]
    monkeypatch.setattr(terminal.time, "monotonic", lambda: clock[0])
    with Progress(100, 40) as progress:
        for _ in range(40):
            clock[0] += 1.0
            progress.step(["tracked", "absent"])
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "frame 55 of 100, 1.0 a second, 45 s left, tracked, absent",
        "frame 70 of 100, 1.0 a second, 30 s left, tracked, absent",
    ]
    with Progress(None) as progress:
        clock[0] += 20
        progress.step(["lost"])
    assert capsys.readouterr().err == "frame 1, 0.1 a second, lost\n"


def test_a_terminal_gets_a_bar_with_rate_and_status(monkeypatch: pytest.MonkeyPatch):
    screen = Screen()
    monkeypatch.setattr(sys, "stderr", screen)
    with Progress(3, 1) as progress:
        progress.step(["tracked"])
        assert progress._bar.n == 2
        progress._bar.refresh()
    assert "2/3" in screen.getvalue()
    assert "tracked" in screen.getvalue()
    assert "frame/s" in screen.getvalue() or "s/frame" in screen.getvalue()
