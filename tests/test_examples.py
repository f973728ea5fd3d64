"""The examples run as their first lines say, in small."""

import csv
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

import torchpose as tp
from torchpose.cli import CONFIGS
from torchpose.recording import Backgrounds
from torchpose.synthesis.database import make_recording, synthetic_camera

ROOT = CONFIGS.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
QUICK = ["pose.height=1.75", "pose.size.rounds=0", "pose.size_frames=1", "pose.start.final_rounds=4"]


def run(folder: Path, name: str, *words: str, code: int = 0) -> str:
    """What an example prints when it is run in a folder."""
    quiet = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    quiet["PYTHONWARNINGS"] = "error,ignore::DeprecationWarning"  # torch's own, which no user sees
    command = [sys.executable, str(ROOT / "examples" / name), *words]
    done = subprocess.run(command, cwd=folder, env=quiet, capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    assert done.stderr == ""
    return done.stdout


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_an_example_is_short_and_explains_itself(path: Path):
    lines = path.read_text().splitlines()
    end = next(i for i, line in enumerate(lines[1:], 1) if line.startswith('"""'))
    assert f"python examples/{path.name}" in "\n".join(lines[:end])
    assert len([line for line in lines[end + 1 :] if line.strip()]) < 60
    assert path.name in (ROOT / "examples" / "README.md").read_text()


def test_a_recording_of_one_s_own(tmp_path: Path):
    lines = run(tmp_path, "your_own_recording.py", "--frames", "2").splitlines()
    assert len(lines) == 3
    for number, line in enumerate(lines[1:]):
        time_s, status, *angles = re.sub(r"\+-", " ", line).split()
        assert float(time_s) == pytest.approx(number / 10)
        assert status == "tracked"
        assert len(angles) == 6
        assert all(0 < float(sd) < 90 for sd in angles[1::2])
    assert (tmp_path / "runs/example_recording/calibration.yaml").is_file()


def test_a_new_likelihood_says_what_it_changes(tmp_path: Path):
    lines = run(tmp_path, "new_likelihood.py", "1").splitlines()
    assert [line.split()[0] for line in lines] == ["without", "with"]
    shares = [float(re.findall(r"([\d.]+) %", line)[0]) for line in lines]
    assert shares[0] != shares[1]
    assert min(shares) > 60


def test_a_ninth_activity_is_told_from_eight(tmp_path: Path):
    lines = run(tmp_path, "new_activity.py").splitlines()
    waving = [line for line in lines if line.startswith("waving")]
    assert len(waving) == 2
    assert all("-> waving" in line for line in waving)
    assert int(re.findall(r"^(\d+) % of 18 clips right", lines[-1])[0]) >= 80
    assert "waving" in tp.Recognizer.load(tmp_path / "runs/new_activity").activities


def test_a_batch_goes_on_where_one_fails(tmp_path: Path):
    """One recording is good, one is not there; run again, the good one is not computed anew."""
    made = make_recording("both_hands", 1, 0, 2, synthetic_camera(320, 240, 10.0))
    frames = [tp.Frame(i, i / 10, pair.left[0], pair.right[0]) for i, pair in enumerate(made)]
    tp.write_recording(tmp_path / "good", made.camera, frames, Backgrounds(*made.background(2)))
    words = ["good", "missing", "--output", "out", "--", *QUICK]
    text = run(tmp_path, "batch.py", *words, code=1)
    assert "1 of 2 recordings done" in text
    with (tmp_path / "out/summary.csv").open() as file:
        good, missing = csv.DictReader(file)
    assert (good["recording"], good["frames"], good["problem"]) == ("good", "2", "")
    assert float(good["answered"]) == 1.0
    assert missing["frames"] == ""
    assert "missing" in missing["problem"]
    summary = tmp_path / "out/000_good/summary.json"
    summary.write_text(json.dumps(json.loads(summary.read_text()) | {"frames": 7}))
    assert ",7,1.0," in run(tmp_path, "batch.py", "good", *words[2:])


def test_a_printed_chessboard_is_found_at_its_size(tmp_path: Path):
    """OpenCV finds the inner corners, a square apart: 254 dots an inch are 10 a millimetre."""
    words = ["--board", "7x5", "--square", "0.02", "--output", "board.png"]
    assert "190 x 150 mm" in run(tmp_path, "chessboard.py", *words)
    image = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    found, corners = cv2.findChessboardCorners(image, (7, 5))
    assert found
    steps = abs(corners.reshape(5, 7, 2)[:, 1:] - corners.reshape(5, 7, 2)[:, :-1])
    assert steps[..., 0] == pytest.approx(200, abs=1.5)
    assert steps[..., 1] == pytest.approx(0, abs=1.5)
