"""Skeletons of joint positions: which joint is which, the body's frame, and bone directions in it.

Positions in m, in any frame, right- or left-handed; directions do not depend on place, heading and size.
"""

import re
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

# Joints by the names of this package, with what other recorders call those that lie in the middle.
_MIDDLE = {
    "neck": "neck",
    "shoulder_center": "neck",
    "spine_shoulder": "neck",
    "head": "head",
    "pelvis": "pelvis",
    "hip_center": "pelvis",
    "hips": "pelvis",
    "spine_base": "pelvis",
}
_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}
_PAIRED = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
_TRUNK = ("shoulder_left", "shoulder_right", "hip_left", "hip_right")
# Depth sensors place hands and feet badly: with them 3 points fewer of UTKinect's sequences are recognised.
_LIMBS = (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
BONES = (
    ("neck", "head"),
    *((f"{start}_{side}", f"{end}_{side}") for side in ("left", "right") for start, end in _LIMBS),
)


def joint_index(names: Sequence[str]) -> dict[str, int]:
    """Where each joint stands, by this package's names: `left_elbow`, `elbow_left` and `LeftElbow` are one.

    Raises:
        ValueError: a shoulder or a hip, which span the body's frame, is not among the names.
    """
    index: dict[str, int] = {}
    for position, name in enumerate(names):
        words = re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)
        words = [word.lower() for word in words]
        side = [_SIDES[word] for word in words if word in _SIDES]
        part = "_".join(word for word in words if word not in _SIDES)
        if len(side) == 1 and part in _PAIRED:
            index.setdefault(f"{part}_{side[0]}", position)
        elif not side and part in _MIDDLE:
            index.setdefault(_MIDDLE[part], position)
    missing = [name for name in _TRUNK if name not in index]
    if missing:
        raise ValueError(
            f"a skeleton needs both shoulders and both hips, but {', '.join(missing)} cannot be found in "
            f"joint_names {', '.join(names)}"
        )
    return index


def trunk_frame(
    joints: Float[Tensor, "time joints 3"], index: dict[str, int], upright: bool
) -> Float[Tensor, "time 3 3"]:
    """Axes of the body in the columns: x to the left, y down, z = x cross y. Orthonormal.

    y runs from the middle of the shoulders to the middle of the hips; x, square to it, from the right hip to
    the left. `upright` takes the data's second axis for y instead, turned to point down the trunk.
    """
    shoulders = (joints[:, index["shoulder_left"]] + joints[:, index["shoulder_right"]]) / 2
    hips = (joints[:, index["hip_left"]] + joints[:, index["hip_right"]]) / 2
    down = hips - shoulders
    if upright:
        vertical = torch.zeros_like(down)
        # One sign for the clip: a person who bends over must not flip the frame.
        vertical[:, 1] = down[:, 1].nanmedian().sign()
        down = vertical
    y = torch.nn.functional.normalize(down, dim=1)
    across = joints[:, index["hip_left"]] - joints[:, index["hip_right"]]
    x = torch.nn.functional.normalize(across - (across * y).sum(1, keepdim=True) * y, dim=1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=2)


def bone_directions(
    joints: Float[Tensor, "time joints 3"], names: Sequence[str], upright: bool = False
) -> Float[Tensor, "time bones 3"]:
    """Unit vectors along the bones, in the body's frame: those of `BONES` whose ends are among the names.

    With `upright` (see `trunk_frame`) the trunk is one bone more, the first.
    """
    index = joint_index(names)
    bones = [bone for bone in BONES if all(end in index for end in bone)]
    start = joints[:, [index[parent] for parent, _ in bones]]
    bone = joints[:, [index[child] for _, child in bones]] - start
    if upright:
        shoulders = joints[:, index["shoulder_left"]] + joints[:, index["shoulder_right"]]
        trunk = joints[:, index["hip_left"]] + joints[:, index["hip_right"]] - shoulders
        bone = torch.cat([trunk.unsqueeze(1), bone], dim=1)
    return torch.nn.functional.normalize(bone, dim=2) @ trunk_frame(joints, index, upright)
