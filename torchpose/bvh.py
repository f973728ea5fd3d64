"""The motion as BVH, for Blender, MotionBuilder, Unity and others: the body file's tree, the person's limb lengths.

BVH's frame, right-handed: x to the left of a person who faces the camera, y up, z towards the camera. A levelled
sequence (level.py) stands on the floor, y = 0; of any other the origin is the left camera, and up is the camera's up.
Centimetres, degrees, frames at a constant rate.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body.model import BodyModel, PosedBody
from torchpose.export import PoseSequence, write_table
from torchpose.resampling import frame_rate, longest_stretch, resample

GAP = 0.25  # s; see `write_bvh`
_CM = 100.0
_CHUNK = 4096  # frames placed at once
_SAME = 1e-6  # m
_TURNS = "Zrotation Xrotation Yrotation"
_FLIP = np.array([1.0, -1.0, -1.0])  # from the camera's frame, and from a body's own: half a turn about x


@dataclass(frozen=True)
class _Node:
    """A joint of the file: it turns with a body, or is fixed to the one above; and where it ends if nothing follows."""

    name: str
    offset: np.ndarray  # (3,) m, in the frame of the node above
    children: tuple["_Node", ...] = ()
    end: np.ndarray | None = None
    body: int | None = None  # None: it does not turn against the node above


def write_bvh(
    path: str | Path,
    sequence: PoseSequence,
    body: BodyModel,
    size: Float[Tensor, "1 sizes"],
    gap: float = GAP,
) -> PoseSequence:
    """Write the longest stretch of poses as BVH, which has no missing frames: no old pose shall stand for a new one.

    The rest pose is upright with hanging arms, facing z. A joint that the body file places at a body's origin gives
    that body its name; others (head, wrists, ankles) never turn, and end at the tip of the body's last ellipsoid.

    Args:
        gap: s; frames without a pose between two with one that are no further apart than this are interpolated.

    Returns:
        What the file holds, at its rate; `frame` tells which of the recording's frames these are.

    Raises:
        ValueError: the sequence has no `pose`, or time does not go on.
    """
    if sequence.pose is None:
        raise ValueError(
            "sequence must have the body's pose for a BVH file, got None; read poses.npz, not poses.csv"
        )
    rate = frame_rate(sequence)
    steady = resample(sequence, rate, gap)
    steady = steady[longest_stretch(steady.answered)]
    root = _tree(body, size)
    order = list(_walk(root))
    lines = [
        "HIERARCHY",
        *_hierarchy(root, 0),
        "MOTION",
        f"Frames: {len(steady)}",
        f"Frame Time: {1 / rate:.8f}",
    ]
    bodies = [node.body for node in order if node.body is not None]
    place, turns = _motion(body, size, steady, bodies)
    fixed = iter(np.split(turns, len(bodies), axis=1))
    still = np.zeros((len(steady), 3))
    table = np.hstack([place, *(still if node.body is None else next(fixed) for node in order)])
    row = " ".join(["%.5f"] * table.shape[1])
    write_table(path, lines, row, table)
    return steady


def _tree(body: BodyModel, size: Float[Tensor, "1 sizes"]) -> _Node:
    """The nodes of the file, from the person's body in any pose: offsets do not depend on it."""
    posed = body(torch.zeros(1, body.num_parameters).to(size), size)
    R, t = posed.rotations[0].double().numpy(force=True), posed.origins[0].double().numpy(force=True)
    joints = posed.joints[0].double().numpy(force=True)
    parents = (-1, *body.parents)
    own = [(joints[j] - t[b]) @ R[b] for j, b in enumerate(body.joint_bodies)]  # R^T (p - t)

    def node(index: int) -> _Node:
        carried = [j for j, b in enumerate(body.joint_bodies) if b == index]
        name = next(
            (body.joint_names[j] for j in carried if np.abs(own[j]).max() < _SAME), body.body_names[index]
        )
        above = parents[index]
        offset = np.zeros(3) if above < 0 else (t[index] - t[above]) @ R[above]
        tip = _tip(body, posed, index)
        leaves = [
            _Node(body.joint_names[j], own[j], end=None if tip is None else tip - own[j])
            for j in carried
            if np.abs(own[j]).max() >= _SAME
        ]
        children = (*leaves, *(node(child) for child, parent in enumerate(parents) if parent == index))
        return _Node(name, offset, children, None if children else tip, index)

    return node(0)


def _tip(body: BodyModel, posed: PosedBody, index: int) -> np.ndarray | None:
    """The far end of a body's last ellipsoid, in the body's frame: of the head, a hand, a foot."""
    parts = [part for part, carrier in enumerate(body.segment_bodies) if carrier == index]
    if not parts:
        return None
    end = posed.centers[0, parts[-1]] + posed.radii[0, parts[-1], 2] * posed.frames[0, parts[-1], :, 2]
    return ((end - posed.origins[0, index]) @ posed.rotations[0, index]).double().numpy(force=True)


def _walk(node: _Node) -> list[_Node]:
    """The nodes in the order in which the file has their channels."""
    return [node, *(below for child in node.children for below in _walk(child))]


def _hierarchy(node: _Node, depth: int) -> list[str]:
    tab = "\t" * depth
    kind, channels = (
        ("JOINT", f"3 {_TURNS}") if depth else ("ROOT", f"6 Xposition Yposition Zposition {_TURNS}")
    )
    lines = [
        f"{tab}{kind} {node.name}",
        f"{tab}{{",
        f"{tab}\tOFFSET {_offset(node.offset)}",
        f"{tab}\tCHANNELS {channels}",
    ]
    for child in node.children:
        lines += _hierarchy(child, depth + 1)
    if not node.children:
        end = np.zeros(3) if node.end is None else node.end
        lines += [f"{tab}\tEnd Site", f"{tab}\t{{", f"{tab}\t\tOFFSET {_offset(end)}", f"{tab}\t}}"]
    return [*lines, f"{tab}}}"]


def _offset(vector: np.ndarray) -> str:
    return " ".join(f"{value:.5f}" for value in _CM * _FLIP * vector + 0.0)


def _motion(
    body: BodyModel, size: Float[Tensor, "1 sizes"], sequence: PoseSequence, bodies: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Place of the root (T, 3), cm, and turns of the bodies (T, 3 bodies) against those above, degrees."""
    assert sequence.pose is not None
    parents = torch.tensor([0, *body.parents])
    places, local = [np.zeros((0, 3))], [np.zeros((0, len(bodies), 3, 3))]
    for start in range(0, len(sequence), _CHUNK):
        posed = body(sequence.pose[start : start + _CHUNK].to(size), size)
        R = posed.rotations.double().cpu()
        above = R[:, parents].clone()
        above[:, 0] = torch.eye(3, dtype=R.dtype)
        local.append((above.mT @ R)[:, bodies].numpy())
        places.append(posed.origins[:, 0].double().numpy(force=True))
    whole = np.concatenate(local)
    # One body at a time: of 100,000 frames the angles' alternatives of all bodies are hundreds of megabytes.
    turns = np.concatenate(
        [_euler(whole[:, i : i + 1] * _FLIP[:, None] * _FLIP) for i in range(len(bodies))], axis=1
    )
    return _CM * np.concatenate(places) * _FLIP, np.rad2deg(turns).reshape(len(sequence), 3 * len(bodies))


def _euler(R: Float[np.ndarray, "time bodies 3 3"]) -> Float[np.ndarray, "time bodies 3"]:
    """Angles about z, x and y with R = Rz Rx Ry, that go on smoothly over time.

    Two triples give the same rotation, (z, x, y) and (z + pi, pi - x, y + pi): the one nearer to the frame before is
    taken, and no angle jumps by a turn.
    """
    z = np.arctan2(-R[..., 0, 1], R[..., 1, 1])
    x = np.arcsin(R[..., 2, 1].clip(-1, 1))
    y = np.arctan2(-R[..., 2, 0], R[..., 2, 2])
    first = np.stack([z, x, y], -1)
    other = np.stack([z + np.pi, np.pi - x, y + np.pi], -1)

    def apart(one: np.ndarray, two: np.ndarray) -> np.ndarray:
        return np.abs(np.remainder(one - two + np.pi, 2 * np.pi) - np.pi).sum(-1)

    swap = apart(other[1:], first[:-1]) < apart(first[1:], first[:-1])  # whether the frame changes sides
    swapped = np.concatenate([np.zeros_like(z[:1], dtype=bool), swap]).cumsum(0) % 2 == 1
    return np.unwrap(np.where(swapped[..., None], other, first), axis=0)
