"""Calibration files: those that PyYAML and OpenCV write here, and every kind of bad one by its message."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from calibration_file import calibrate, raw_values, stereo_values, without

from torchpose.calibration import read_calibration, write_calibration
from torchpose.recording import open_recording

WIDTH, HEIGHT = 24, 16
STEREO = stereo_values(WIDTH, HEIGHT, 10.0, 20.0)
RAW = raw_values(WIDTH, HEIGHT, 15.0, 20.0)
DEPTH = without(STEREO, "baseline") | {"depth_unit": 0.0005}
PERSON = without(DEPTH, "focal_length", "principal_point", "rectified") | {"person_height": 1.75}


@pytest.mark.parametrize("transposed", [False, True], ids=["row", "column"])
def test_a_calibration_that_opencv_wrote(tmp_path: Path, transposed: bool):
    path = tmp_path / "calibration.yaml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in RAW.items():
        matrix = np.atleast_2d(np.array(value, dtype=float))
        storage.write(
            key, value if key == "frame_rate" else matrix.T if transposed and key in "D1D2T" else matrix
        )
    storage.release()
    text = path.read_text()
    size = re.search(r"image_size: !!opencv-matrix.*?\]\n", text, re.DOTALL)
    path.write_text(text.replace(size[0], f"image_size: [ {WIDTH}, {HEIGHT} ]\n"))
    assert "!!opencv-matrix" in path.read_text()
    calibration = read_calibration(path)
    assert calibration.camera == read_calibration(calibrate(tmp_path / "plain.yaml", RAW)).camera
    assert calibration.raw is not None
    np.testing.assert_array_equal(calibration.raw.K1, RAW["K1"])


def test_yaml_numbers_may_be_written_with_an_exponent(tmp_path: Path):
    path = tmp_path / "calibration.yaml"
    path.write_text(yaml.safe_dump(DEPTH).replace("0.0005", "5e-4"))
    assert read_calibration(path).depth_unit == 0.0005


@pytest.mark.parametrize(
    "values",
    [STEREO, RAW, DEPTH, PERSON | {"principal_point": [11.0, 6.25]}],
    ids=["stereo", "raw", "depth", "unknown intrinsics"],
)
def test_a_written_calibration_reads_back(tmp_path: Path, values: dict[str, object]):
    given = read_calibration(calibrate(tmp_path / "calibration.yaml", values))
    write_calibration(tmp_path / "new" / "calibration.yaml", given)
    written = read_calibration(tmp_path / "new" / "calibration.yaml")
    for name in ("camera", "depth_unit", "person_height"):
        assert getattr(written, name) == getattr(given, name)
    assert (written.raw is None) == (given.raw is None)
    for key in ("K1", "D1", "K2", "D2", "R", "T", "image_size", "frame_rate") if given.raw else ():
        np.testing.assert_array_equal(getattr(written.raw, key), getattr(given.raw, key))


def test_a_depth_camera_of_unknown_intrinsics(tmp_path: Path):
    path = tmp_path / "calibration.yaml"
    read = read_calibration(calibrate(path, PERSON))
    assert (read.camera.cx, read.camera.cy, read.person_height) == (11.5, 7.5, 1.75)
    read = read_calibration(calibrate(path, PERSON | {"principal_point": [10, 7.25]}))
    assert (read.camera.cx, read.camera.cy, read.person_height) == (10, 7.25, 1.75)
    for values, message in (
        (PERSON | {"person_height": 175}, "person_height must be in m, 0.5 to 2.6, got 175; divide centim"),
        (PERSON | {"person_height": "tall"}, "person_height must be a positive number of m, got 'tall'"),
        (PERSON | {"focal_length": 200}, "a focal_length or a person_height to estimate it from, got both"),
        (
            without(PERSON, "depth_unit") | {"baseline": 0.1},
            "person_height must come with a depth_unit .* got none",
        ),
        (PERSON | {"rectified": False}, "rectified must be true, got False"),
        (without(PERSON, "person_height") | {"rectified": True}, "focal_length is missing"),
    ):
        with pytest.raises(ValueError, match=message):
            read_calibration(calibrate(path, values))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (without(STEREO, "image_size"), "image_size is missing .*; add it"),
        (without(STEREO, "focal_length"), "focal_length is missing .*positive number of px.*add it"),
        (without(STEREO, "principal_point"), "principal_point is missing"),
        (without(STEREO, "baseline"), "baseline is missing .*for a depth camera give depth_unit"),
        (without(STEREO, "frame_rate"), "frame_rate is missing"),
        (without(STEREO, "rectified"), "rectified is missing"),
        (
            without(STEREO, "focal_length") | {"focal_lenght": 20},
            "focal_length is missing .*did you mean 'focal_lenght'",
        ),
        (STEREO | {"image_size": [24]}, r"image_size must be \[width, height\] in whole px, got \[24\]"),
        (STEREO | {"image_size": [24.5, 16]}, "image_size must be .* whole px"),
        (STEREO | {"image_size": [0, 16]}, "image_size must be .* whole px"),
        (STEREO | {"image_size": "24 x 16"}, "image_size must be .*got '24 x 16'"),
        (STEREO | {"focal_length": -20}, "focal_length must be a positive number of px, got -20"),
        (STEREO | {"focal_length": float("nan")}, "focal_length must be a positive number of px, got nan"),
        (STEREO | {"focal_length": True}, "focal_length must be a positive number of px, got True"),
        (STEREO | {"focal_length": 2.1}, "focal_length must be in px, at least 2.4 .* got 2.1; divide"),
        (STEREO | {"principal_point": [30, 8]}, "cx must lie inside the image.*got 30"),
        (STEREO | {"principal_point": [8, "middle"]}, "principal_point must be .*'middle'"),
        (STEREO | {"baseline": 0}, "baseline must be a positive number of m, got 0"),
        (STEREO | {"baseline": 120.0}, "baseline must be in m, .* got 120; divide millimetres by 1000"),
        (STEREO | {"frame_rate": "fast"}, "frame_rate must be a positive number of Hz, got 'fast'"),
        (STEREO | {"rectified": False}, "rectified must be true, got False; for raw images give K1"),
        (STEREO | {"depth_unit": 0.001}, "baseline .* or a depth_unit .* got both"),
        (DEPTH | {"depth_unit": 1000}, "depth_unit must be the metres in one step .* got 1000"),
        (without(RAW, "D2"), "D2 is missing .*all of K1, D1, K2, D2, R, T"),
        (RAW | {"D1": [0.1, 0.2, 0.3]}, "D1 must have 4, 5, 8, 12 or 14 coefficients, got 3"),
        (RAW | {"R": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, "R must be a 3 x 3 rotation"),
        (RAW | {"T": [-120.0, 1.0, 2.0]}, "T must be in m, no longer than 5, got 120"),
        (RAW | {"K1": [[20, 0, 11], [0, 20]]}, "K1 must be a list of numbers, got"),
        (RAW | {"rectified": True}, "rectified must be false, or absent"),
        (RAW | {"depth_unit": 0.001}, "raw cameras are a stereo pair, got a depth_unit"),
        (without(RAW, "frame_rate"), "frame_rate is missing"),
        (["a", "list"], "lines of `key: value`, got list"),
    ],
)
def test_a_calibration_that_makes_no_sense(tmp_path: Path, values: dict, message: str):
    calibrate(tmp_path / "calibration.yaml", values)
    with pytest.raises(ValueError, match=message) as error:
        open_recording(tmp_path)
    assert str(tmp_path / "calibration.yaml") in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("image_size: [24, 16", "must be YAML, but while parsing"),
        (
            "%YAML:1.0\n---\nK1: !!opencv-matrix\n  rows: 3\n  cols: 3\n  data: [1, 2]\n",
            "must have 9 numbers, got 2",
        ),
        ("%YAML:1.0\n---\nK1: !!opencv-matrix\n  rows: 3\n", "must have rows, cols and data"),
    ],
)
def test_a_calibration_that_is_not_yaml(tmp_path: Path, text: str, message: str):
    (tmp_path / "calibration.yaml").write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        open_recording(tmp_path)
    assert "\n" not in str(error.value)
