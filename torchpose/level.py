"""A motion upright and on the floor, for programs that know neither our camera nor how it was held.

The floor's frame: y down along the floor's normal and 0 on the floor, z along the floor as the left camera looks, x to
its right; the origin is on the floor straight below the left camera. Metres, radians.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body.angle import TRUNK_NAMES, trunk_angles, trunk_turn
from torchpose.export import PoseSequence
from torchpose.trajectory_filter import ROOT_TURNS
from torchpose.vision.floor import Floor

_CHUNK = 4096  # frames turned at once


def level_sequence(sequence: PoseSequence, floor: Floor) -> PoseSequence:
    """The motion in the floor's frame: joints, the trunk's angles, and the pose's root are other numbers there.

    Angles between limbs stay. The trunk's standard deviations are NaN and the pose's covariance is None: bending and
    turning mix, which their variances alone do not tell, and the files for other programs have no place for either.

    Raises ValueError where the floor's normal does not point up, or the sequence lacks an angle of the trunk.
    """
    if not float(floor.normal[1]) < 0:
        raise ValueError(
            f"floor.normal must point up, against the camera's y axis, got {floor.normal.tolist()}; turn it round"
        )
    missing = sorted(set(TRUNK_NAMES) - set(sequence.angle_names))
    if missing:
        raise ValueError(
            f"angle_names must have the trunk's angles for another frame, {missing[0]} is missing; give them all"
        )
    rotation, height = rotation_to_floor(floor), floor.height.to("cpu", torch.float64)
    columns = [sequence.angle_names.index(name) for name in TRUNK_NAMES]

    def place(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        shift = torch.stack([torch.zeros_like(height), -height, torch.zeros_like(height)])
        return points @ rotation.mT.to(points) + shift.to(points)

    angles, spread, pose = sequence.angles.clone(), sequence.angle_sd.clone(), sequence.pose
    angles[:, columns] = _turned(sequence.angles[:, columns], rotation)
    spread[:, columns] = torch.nan
    if pose is not None:
        pose = torch.cat([place(pose[:, :3]), _turned_root(pose[:, ROOT_TURNS], rotation), pose[:, 6:]], 1)
    return replace(
        sequence,
        joints=place(sequence.joints),
        angles=angles,
        angle_sd=spread,
        pose=pose,
        pose_covariance=None,
    )


def rotation_to_floor(floor: Floor) -> Float[Tensor, "3 3"]:
    """R_floor_camera in float64, which keeps where the camera looks: z is its viewing direction along the floor."""
    down = -torch.nn.functional.normalize(floor.normal.to("cpu", torch.float64), dim=0)
    ahead = torch.zeros_like(down)
    ahead[2] = 1
    ahead = torch.nn.functional.normalize(ahead - (ahead @ down) * down, dim=0)
    return torch.stack([torch.linalg.cross(down, ahead), down, ahead])


def _turned(angles: Float[Tensor, "time 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "time 3"]:
    """Angles of the trunk, as `trunk_angles` has them, in a frame that is turned."""
    return torch.cat([trunk_angles(rotation.to(few) @ trunk_turn(few)) for few in angles.split(_CHUNK)])


def _turned_root(root: Float[Tensor, "time 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "time 3"]:
    """Yaw, pitch and roll in a frame that is turned.

    Whoever bends to the floor passes a pitch of 90 degrees, where two triples give each rotation, (y, p, r) and
    (y + pi, pi - p, r + pi): the one nearer to the pose's own is taken, so that it goes on as smoothly.
    """
    yaw, pitch, roll = root.unbind(1)
    flexion, bending, turn = _turned(torch.stack([pitch, -roll, yaw], 1), rotation).unbind(1)
    first = torch.stack([turn, flexion, -bending], 1)
    other = torch.stack([turn + torch.pi, torch.pi - flexion, torch.pi - bending], 1)

    def apart(triple: Float[Tensor, "time 3"]) -> Float[Tensor, "time 1"]:
        return _wrapped(triple - root).abs().sum(1, keepdim=True)

    return _wrapped(torch.where(apart(other) < apart(first), other, first))


def _wrapped(angles: Float[Tensor, "time 3"]) -> Float[Tensor, "time 3"]:
    return torch.pi - torch.remainder(torch.pi - angles, 2 * torch.pi)  # (-pi, pi]
