"""Skeletons of joint positions: which joint is which, the body's frame, and bone directions in it.

Positions in m, in any frame, right- or left-handed; directions do not depend on place, heading and size.
"""

import re
from collections.abc import Mapping
from functools import lru_cache
from types import MappingProxyType

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
_SIDED = ("left", "right")
_PAIRED = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
_TRUNK = ("shoulder_left", "shoulder_right", "hip_left", "hip_right")
# Depth sensors place hands and feet badly: with them 3 points fewer of UTKinect's sequences are recognised.
_LIMBS = (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
BONES = (
    ("neck", "head"),
    *((f"{start}_{side}", f"{end}_{side}") for side in ("left", "right") for start, end in _LIMBS),
)
_PLACED = (
    "head",
    *(f"{part}_{side}" for part in ("elbow", "wrist", "knee", "ankle", "shoulder") for side in _SIDED),
)
_ARM = tuple(f"{part}_{side}" for part in ("wrist", "elbow") for side in _SIDED)
# Hands to each other and to what they work on, then what tells standing from sitting and bending.
_PAIRS = (
    ("wrist_left", "wrist_right"),
    *((f"wrist_{side}", "head") for side in _SIDED),
    *((f"wrist_{side}", f"{part}_{side}") for side in _SIDED for part in ("hip", "shoulder", "knee")),
    *((f"hip_{side}", end) for side in _SIDED for end in ("head", f"ankle_{side}")),
    ("knee_left", "knee_right"),
    ("ankle_left", "ankle_right"),
)


@lru_cache
def joint_index(names: tuple[str, ...]) -> Mapping[str, int]:
    """Where each joint stands, by this package's names: `left_elbow`, `elbow_left` and `LeftElbow` are one.

    Raises:
        ValueError: a shoulder or a hip, which span the body's frame, is not among the names.
    """
    index: dict[str, int] = {}
    for position, name in enumerate(names):
        words = _words(name)
        side = [word for word in words if word in _SIDED]
        part = "_".join(word for word in words if word not in _SIDED)
        if len(side) == 1 and part in _PAIRED:
            index.setdefault(f"{part}_{side[0]}", position)
        elif not side and part in _MIDDLE:
            index.setdefault(_MIDDLE[part], position)
    missing = [name for name in _TRUNK if name not in index]
    if missing:
        raise ValueError(
            f"a skeleton needs both shoulders and both hips, but {', '.join(missing)} cannot be found in "
            f"joint_names {', '.join(names)}; name them so"
        )
    return MappingProxyType(index)  # shared by all who ask


def trunk_frame(
    joints: Float[Tensor, "time joints 3"], index: Mapping[str, int], upright: bool
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
    joints: Float[Tensor, "time joints 3"], names: tuple[str, ...], upright: bool = False
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


def joint_places(
    joints: Float[Tensor, "time joints 3"], names: tuple[str, ...], upright: bool = False
) -> Float[Tensor, "time places 3"]:
    """Head, shoulders, elbows, wrists, knees and ankles from the middle of the hips, in the body's frame.

    In trunk lengths, as are `arm_places`, `joint_distances` and `travel`: bodies of all sizes compare.
    """
    index = joint_index(names)
    return _places(joints, index, _PLACED, _middle(joints, index, "hip"), upright)


def arm_places(
    joints: Float[Tensor, "time joints 3"], names: tuple[str, ...], upright: bool = False
) -> Float[Tensor, "time places 3"]:
    """Wrists and elbows from the middle of the shoulders, in the body's frame: the arms alone, however one bends."""
    index = joint_index(names)
    return _places(joints, index, _ARM, _middle(joints, index, "shoulder"), upright)


def joint_distances(
    joints: Float[Tensor, "time joints 3"], names: tuple[str, ...]
) -> Float[Tensor, "time pairs"]:
    """Between the hands, from them to head, shoulder, hip and knee, and from the hips to head and feet."""
    index = joint_index(names)
    pairs = [pair for pair in _PAIRS if all(joint in index for joint in pair)]
    apart = joints[:, [index[a] for a, _ in pairs]] - joints[:, [index[b] for _, b in pairs]]
    return torch.linalg.vector_norm(apart, dim=2) / _trunk_length(joints, index)


def travel(joints: Float[Tensor, "time joints 3"], names: tuple[str, ...]) -> Float[Tensor, "time 3"]:
    """Since the first frame that was seen: how far the hips went over the ground, how far they rose, and the head.

    The vertical is the data's second axis, up where the shoulders are; without a head the shoulders stand for it.
    """
    index = joint_index(names)
    hips = _middle(joints, index, "hip")
    top = joints[:, index["head"]] if "head" in index else _middle(joints, index, "shoulder")
    seen = (~(hips + top).isnan().any(1)).nonzero()
    first = int(seen[0]) if len(seen) > 0 else 0
    way = torch.linalg.vector_norm((hips - hips[first])[:, ::2], dim=1)
    up = (_middle(joints, index, "shoulder") - hips)[:, 1].nanmedian().sign()
    rise = up * torch.stack([hips[:, 1] - hips[first, 1], top[:, 1] - top[first, 1]], dim=1)
    return torch.cat([way.unsqueeze(1), rise], dim=1) / _trunk_length(joints, index)


def mirror_joints(
    joints: Float[Tensor, "time joints 3"], names: tuple[str, ...]
) -> Float[Tensor, "time joints 3"]:
    """The same done with the other side: left and right change places, and so do the ends of the first axis."""
    position = {_words(name): number for number, name in enumerate(names)}
    swapped = {"left": "right", "right": "left"}
    others = [tuple(swapped.get(word, word) for word in _words(name)) for name in names]
    order = [position.get(other, number) for number, other in enumerate(others)]
    return joints[:, order] * joints.new_tensor([-1, 1, 1])


def _words(name: str) -> tuple[str, ...]:
    """`elbow_left`, `LeftElbow`, `LElbow` to its words in lower case, sides in full."""
    words = (word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name))
    return tuple(_SIDES.get(word, word) for word in words)


def _middle(joints: Tensor, index: Mapping[str, int], part: str) -> Float[Tensor, "time 3"]:
    return (joints[:, index[f"{part}_left"]] + joints[:, index[f"{part}_right"]]) / 2


def _trunk_length(joints: Tensor, index: Mapping[str, int]) -> Float[Tensor, ""]:
    """Median over the clip, m."""
    trunk = _middle(joints, index, "shoulder") - _middle(joints, index, "hip")
    return torch.linalg.vector_norm(trunk, dim=1).nanmedian()


def _places(
    joints: Tensor, index: Mapping[str, int], wanted: tuple[str, ...], origin: Tensor, upright: bool
) -> Float[Tensor, "time places 3"]:
    there = [index[name] for name in wanted if name in index]
    placed = (joints[:, there] - origin.unsqueeze(1)) @ trunk_frame(joints, index, upright)
    return placed / _trunk_length(joints, index)
