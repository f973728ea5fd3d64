"""Calibrations of made-up cameras as plain values, and the files that hold them."""

from pathlib import Path

import cv2
import numpy as np
import yaml

from torchpose.vision.camera import RawStereo


def stereo_values(width: int, height: int, frame_rate: float, focal_length: float = 40.0) -> dict:
    """Of a rectified pair, its principal point half a pixel off the image's middle and not on its diagonal."""
    return {
        "image_size": [width, height],
        "focal_length": focal_length,
        "principal_point": [width / 2 - 0.5, height / 2 - 0.75],
        "baseline": 0.12,
        "frame_rate": frame_rate,
        "rectified": True,
    }


def raw_values(width: int, height: int, frame_rate: float, focal_length: float = 40.0) -> dict:
    """Of two unlike lenses, with distortions of unlike lengths; the right camera is turned by a degree or so."""
    return {
        "image_size": [width, height],
        "frame_rate": frame_rate,
        "K1": [[focal_length, 0.0, width / 2 - 1], [0.0, focal_length + 1, height / 2], [0.0, 0.0, 1.0]],
        "D1": [0.05, -0.01, 0.001, -0.001, 0.0],
        "K2": [
            [focal_length + 0.5, 0.0, width / 2],
            [0.0, focal_length + 0.5, height / 2 - 1],
            [0.0, 0.0, 1.0],
        ],
        "D2": [0.04, -0.02, 0.0, 0.001],
        "R": cv2.Rodrigues(np.array([0.01, -0.02, 0.015]))[0].tolist(),
        "T": [-0.12, 0.001, 0.002],
    }


def without(values: dict, *keys: str) -> dict:
    return {key: value for key, value in values.items() if key not in keys}


def calibrate(path: Path, values: object) -> Path:
    """Write the file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(values))
    return path


def raw_stereo(values: dict) -> RawStereo:
    """What reading `raw_values` must come to."""
    arrays = {key: np.array(values[key]) for key in ("K1", "D1", "K2", "D2", "R", "T")}
    return RawStereo(**arrays, image_size=tuple(values["image_size"]), frame_rate=values["frame_rate"])
