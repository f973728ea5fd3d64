"""Boxes as furniture: where rays meet them, and what they hide.

The world is the left camera's frame (x right, y down, z forward; metres).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Box:
    """A piece of furniture; its size and grain are along its own axes, turned about the vertical."""

    center: Vector  # m
    size: Vector  # m
    colour: Vector
    turn: float = 0.0  # rad
    contrast: float = 0.1  # of the texture
    chroma: float = 0.02  # of large coloured blots
    grain: Vector = (1.0, 1.0, 1.0)  # below 1: the texture is drawn out along that axis

    def __post_init__(self) -> None:
        if not min(self.size) > 0:
            raise ValueError(f"a box must have positive sizes, got {self.size}; give metres")


class BoxHits(NamedTuple):
    """What rays meet of the boxes."""

    distance: Float[Tensor, " num"]  # in units of the direction, inf where nothing
    box: Int[Tensor, " num"]  # any where nothing
    normal: Float[Tensor, "num 3"]  # toward where the ray comes from


class Boxes(nn.Module):
    """Some boxes, at least one, cast exactly by slabs."""

    centers: Tensor  # (K, 3) m
    halves: Tensor  # (K, 3) m
    cosines: Tensor  # (K,) of the turns
    sines: Tensor

    def __init__(self, boxes: Sequence[Box]):
        super().__init__()
        if not boxes:
            raise ValueError("there must be at least one box, got none; leave the boxes out instead")
        turns = torch.tensor([box.turn for box in boxes])
        constants = {
            "centers": torch.tensor([box.center for box in boxes]),
            "halves": torch.tensor([box.size for box in boxes]) / 2,
            "cosines": turns.cos(),
            "sines": turns.sin(),
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, origins: Float[Tensor, "num 3"], directions: Float[Tensor, "num 3"]) -> BoxHits:
        """The first face on each ray from outside the boxes."""
        enter, leave, starts = self._slabs(origins, directions)
        near, box = torch.where((enter < leave) & (enter > 1e-4), enter, math.inf).min(0)
        pick = box[None]
        # The slab entered last.
        face = torch.stack([start.gather(0, pick)[0] for start in starts], -1).argmax(-1)
        x, y, z = F.one_hot(face, 3).to(near).unbind(-1)
        c, s = self.cosines[box], self.sines[box]
        outward = torch.stack(
            (c * x + s * z, y, c * z - s * x), -1
        )  # of one of the two faces across the axis
        outward = -outward * (outward * directions).sum(-1, keepdim=True).sign()  # the one that faces the ray
        return BoxHits(near, box, outward)

    def between(
        self, origins: Float[Tensor, "num 3"], directions: Float[Tensor, "num 3"]
    ) -> Bool[Tensor, " num"]:
        """Whether a box is met on the way from the origin to origin + direction."""
        enter, leave, _ = self._slabs(origins, directions)
        return ((enter < leave) & (leave > 0) & (enter < 1)).any(0)

    def _slabs(
        self, origins: Float[Tensor, "num 3"], directions: Float[Tensor, "num 3"]
    ) -> tuple[Float[Tensor, "boxes num"], Float[Tensor, "boxes num"], list[Float[Tensor, "boxes num"]]]:
        """Where each ray's line enters and leaves each box (enter > leave: it passes by), and each of its
        slabs.
        """
        x, y, z = (origins.T[:, None] - self.centers.T[..., None]).unbind(
            0
        )  # (K, N): the rays last, for speed
        dx, dy, dz = torch.where(directions.abs() < 1e-9, 1e-9, directions).T
        c, s = self.cosines[:, None], self.sines[:, None]
        entries, exits = [], []
        for axis, (start, ray) in enumerate(
            ((c * x - s * z, c * dx - s * dz), (y, dy), (s * x + c * z, s * dx + c * dz))
        ):
            inverse = 1 / ray
            middle, reach = start * inverse, self.halves[:, axis, None] * inverse.abs()
            entries.append(-middle - reach)
            exits.append(reach - middle)
        enter = torch.maximum(torch.maximum(entries[0], entries[1]), entries[2])
        leave = torch.minimum(torch.minimum(exits[0], exits[1]), exits[2])
        return enter, leave, entries
