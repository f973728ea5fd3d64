"""Files for OpenSim 4: coordinates over time (.mot) and joint centres as markers (.trc).

OpenSim's frame, right-handed: x forward, y up, z to the right, of a person who faces the camera; so x points from the
scene to the camera. A levelled sequence (level.py) stands on the floor, y = 0; of any other the origin is the left
camera, and up is the camera's up. Names, axes and signs are those of the Rajagopal (2016) model, which OpenCap's models
share; docs/angles.md has the table.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body.angle import ANATOMICAL_NAMES, TRUNK_NAMES, trunk_turn
from torchpose.export import JOINT_NAMES, PoseSequence, write_table
from torchpose.resampling import frame_rate
from torchpose.trajectory_filter import stretches

# Our name, OpenSim's coordinate, and the sign of ours in it. What OpenSim's models have not keeps its name.
_SIDED = (
    ("hip_flexion", "hip_flexion", 1),
    ("hip_abduction", "hip_adduction", -1),
    ("hip_rotation", "hip_rotation", 1),
    ("knee_flexion", "knee_angle", 1),
    ("shoulder_flexion", "arm_flex", 1),
    ("shoulder_abduction", "arm_add", -1),
    ("shoulder_rotation", "arm_rot", 1),
    ("elbow_flexion", "elbow_flex", 1),
)
COORDINATES: tuple[tuple[str, str, int], ...] = (
    *(
        (f"{ours}_{side}", f"{theirs}_{side[0]}", sign)
        for side in ("right", "left")
        for ours, theirs, sign in _SIDED
    ),
    ("neck_flexion", "neck_flexion", 1),
    ("neck_lateral_bending", "neck_lateral_bending", 1),
)
PELVIS = ("pelvis_tilt", "pelvis_list", "pelvis_rotation", "pelvis_tx", "pelvis_ty", "pelvis_tz")
# The names of Pose2Sim's HALPE_26 model, where they mean the same point.
MARKERS: dict[str, str] = {
    "pelvis": "Hip",
    "neck": "Neck",
    "head": "HeadCentre",
    **{
        f"{j}_{s}": f"{s[0].upper()}{j.capitalize()}"
        for j in ("shoulder", "elbow", "wrist")
        for s in ("left", "right")
    },
    **{
        f"{j}_{s}": f"{s[0].upper()}{j.capitalize()}"
        for j in ("hip", "knee", "ankle")
        for s in ("left", "right")
    },
}
# From the middle of the hips to the origin of the model's pelvis, in front and above: m, Rajagopal's unscaled model.
_PELVIS_ORIGIN = (0.056276, 0.07849, 0.0)
_BENT_BACK = np.deg2rad(
    10
)  # an elbow or knee that is bent back by less is straight or a little over, as in OpenSim's ranges
_CHUNK = 4096  # frames turned at once
_MM = 1000.0


def to_opensim(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Points or directions of the left camera's frame (x right, y down, z forward) in OpenSim's."""
    return -points.flip(-1)


def write_mot(path: str | Path, sequence: PoseSequence) -> None:
    """Write OpenSim coordinates over time: degrees, metres, seconds; a row for each frame with a pose, and no others.

    OpenSim's `.mot` knows no missing number, so a frame without a pose has no row, and its time is missing. Angles run
    on past 180 degrees within a stretch. A straight elbow or knee that the rotation above it says is bent the wrong
    way round is written as bent back, which is the same pose.

    Raises:
        ValueError: the sequence has not all of `ANATOMICAL_NAMES`.
    """
    missing = sorted(set(ANATOMICAL_NAMES) - set(sequence.angle_names))
    if missing:
        raise ValueError(
            f"angle_names must have all anatomical angles for a .mot file, {missing[0]} is missing; give them all"
        )
    clean = replace(sequence, pose=None, pose_covariance=None).without_stale_numbers()
    column = dict(zip(clean.angle_names, clean.angles.numpy().T, strict=True))
    for joint, above in (("knee_flexion", "hip_rotation"), ("elbow_flexion", "shoulder_rotation")):
        for side in ("left", "right"):
            bend, turn = column[f"{joint}_{side}"], column[f"{above}_{side}"]
            back = (np.abs(turn) > np.pi / 2) & (bend < _BENT_BACK)
            column[f"{joint}_{side}"] = np.where(back, -bend, bend)
            column[f"{above}_{side}"] = np.where(back, turn - np.copysign(np.pi, turn), turn)
    tilt, place = _pelvis(clean, column)
    angles = np.column_stack([tilt, *(sign * column[ours] for ours, _, sign in COORDINATES)])
    table = np.column_stack([angles, place])
    whole = np.isfinite(table).all(1)
    time, table = clean.time_s.numpy(), table.copy()
    for run in stretches(whole, time):
        for i in range(angles.shape[1]):  # all at once take copies of a long run's whole table
            table[run, i] = np.rad2deg(np.unwrap(angles[run, i]))
    table = np.column_stack([time, table[:, :3], table[:, -3:], table[:, 3:-3]])[whole]
    names = ["time", *PELVIS, *(theirs for _, theirs, _ in COORDINATES)]
    head = [
        "Coordinates",
        "version=1",
        f"nRows={len(table)}",
        f"nColumns={len(names)}",
        "inDegrees=yes",
        "",
        "Units are S.I. units (second, meters, Newtons, ...); angles are in degrees.",
        "Frames without a pose have no row.",
        "endheader",
        "\t".join(names),
    ]
    row = "\t".join(["%.6f"] * len(names))
    write_table(path, head, row, table)


def write_trc(path: str | Path, sequence: PoseSequence) -> None:
    """Write the fifteen joint centres as markers, mm; without a pose they are NaN, which OpenSim reads as missing."""
    path, clean = Path(path), sequence.without_stale_numbers()
    rate, names = frame_rate(clean), [MARKERS[joint] for joint in JOINT_NAMES]
    points = _MM * to_opensim(clean.joints).flatten(1).numpy()
    first = int(clean.frame[0]) if len(clean) else 0
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate:g}\t{rate:g}\t{len(clean)}\t{len(names)}\tmm\t{rate:g}\t{first}\t{len(clean)}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{number}" for number in range(1, len(names) + 1) for axis in "XYZ"),
        "",
    ]
    row = "\t".join(["%d", "%.6f"] + ["%.3f"] * points.shape[1])
    write_table(path, head, row, np.column_stack([clean.frame.numpy(), clean.time_s.numpy(), points]))


def _pelvis(sequence: PoseSequence, column: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Tilt, list and rotation (T, 3), rad, and the place (T, 3), m, of the model's pelvis, which our trunk is.

    Ours turns first, then bends (R = Ry Rx Rz); OpenSim's pelvis tilts about z, lists about x, then turns about y.
    """
    pieces = [
        _pelvis_of(
            torch.stack([torch.from_numpy(column[name][start : start + _CHUNK]) for name in TRUNK_NAMES], -1),
            sequence.joints[start : start + _CHUNK, JOINT_NAMES.index("pelvis")],
        )
        for start in range(0, max(len(sequence), 1), _CHUNK)
    ]
    turns, places = zip(*pieces, strict=True)
    return torch.cat(turns).numpy(), torch.cat(places).numpy()


def _pelvis_of(
    angles: Float[Tensor, "time 3"], pelvis: Float[Tensor, "time 3"]
) -> tuple[Float[Tensor, "time 3"], Float[Tensor, "time 3"]]:
    R = trunk_turn(angles).flip(-1).flip(-2)  # both frames are turned alike, and the two signs cancel
    tilt, bow = torch.atan2(-R[:, 0, 1], R[:, 1, 1]), torch.asin(R[:, 2, 1].clamp(-1, 1))
    turn = torch.atan2(-R[:, 2, 0], R[:, 2, 2])
    offset = (R @ torch.tensor(_PELVIS_ORIGIN, dtype=torch.float64)[:, None])[..., 0]
    place = to_opensim(pelvis) + offset
    return torch.stack([tilt, bow, turn], -1), place
