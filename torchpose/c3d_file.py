"""The joint centres as C3D, which motion laboratories exchange; written by `ezc3d`, which is asked for only here.

OpenSim's frame, see opensim.py: on the floor and upright if the sequence was levelled, else the left camera's.
"""

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from torchpose.atomic import replacing
from torchpose.export import JOINT_NAMES, PoseSequence
from torchpose.opensim import MARKERS, to_opensim
from torchpose.resampling import frame_rate, resample

_MM = 1000.0


def check_c3d() -> None:
    """ValueError where this machine cannot write C3D."""
    if find_spec("ezc3d") is None:
        raise ValueError(
            "c3d files must be written by ezc3d, which is not installed; pip install 'torchpose[c3d]'"
        )


def write_c3d(path: str | Path, sequence: PoseSequence) -> None:
    """Write the fifteen joint centres as points: mm, OpenSim's axes (y up), the camera's constant rate.

    A frame without a pose, or one that was dropped, has residual -1, which means that nothing was measured.

    Raises:
        ValueError: `ezc3d` is not installed, or time does not go on.
    """
    check_c3d()
    import ezc3d

    steady = resample(sequence, frame_rate(sequence))
    points = _MM * to_opensim(steady.joints).numpy().transpose(2, 1, 0)  # (3, points, frames)
    missing = ~np.isfinite(points).all(0, keepdims=True)
    file = ezc3d.c3d()
    point = file["parameters"]["POINT"]
    point["RATE"]["value"] = [frame_rate(sequence)]
    point["UNITS"]["value"] = ["mm"]
    point["LABELS"]["value"] = [MARKERS[joint] for joint in JOINT_NAMES]
    point["DESCRIPTIONS"]["value"] = [f"{joint}, joint centre" for joint in JOINT_NAMES]
    file.add_parameter("POINT", "X_SCREEN", ["+X"])
    file.add_parameter("POINT", "Y_SCREEN", ["+Y"])
    file.add_parameter("MANUFACTURER", "SOFTWARE", ["torchpose"])
    whole = np.concatenate([points, np.ones_like(points[:1])])
    file["data"]["points"] = np.where(missing, 0.0, whole)
    file["data"]["meta_points"]["residuals"] = np.where(missing, -1.0, 0.0)
    with replacing(Path(path)) as partial:
        file.write(str(partial))
