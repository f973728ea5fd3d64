"""Colours of the body's parts, learned while following: skin, shirt, trousers and shoes tell parts apart.

An appearance term as (3.9), of which the thesis has two; this one learns in the run and from the run alone. Colours are
RGB in [0, 1] on the way in.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.registration.likelihood import Evidence, PartLikelihood
from torchpose.vision.colour_histogram import NUM_BINS, colour_bins

RARE = 1e-5  # share of the person's colours that any colour may have; what was hardly seen says nothing of any part


@dataclass(frozen=True)
class ColourConfig:
    strength: float = 1.0  # power of p(colour | part) / p(colour); 0 switches the term off
    floor: float = 0.03  # share of each part's colours that may be anybody's: the ratio never falls below it
    near: float = 0.04  # m from its part's surface, within which a point teaches that part its colour
    trust: float = 40.0  # points, from which a part's colours count as much as the person's own mixture
    memory: float = 150.0  # frames, over which what was learned fades

    def __post_init__(self) -> None:
        if not self.strength >= 0:
            raise ValueError(
                f"strength must not be negative, got {self.strength}; 0 switches the colours off"
            )
        if not 0 < self.floor < 1:
            raise ValueError(f"floor must be a share between 0 and 1, got {self.floor}")
        for name in ("near", "trust"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if not self.memory >= 1:
            raise ValueError(f"memory must be at least 1 frame, got {self.memory}")


class ColourLikelihood(PartLikelihood):
    """log p(colour | part) - log p(colour) of each point. Left and right parts share their colours."""

    counts: Float[Tensor, "parts bins"]  # points seen; a sided pair's rows are equal
    other_side: Int[Tensor, " parts"]  # the part itself, where it has no other side

    def __init__(self, segment_names: Sequence[str], config: ColourConfig = ColourConfig()):
        super().__init__(segment_names)
        self.config = config
        other = [self.segment_names.index(_other_side(name)) for name in self.segment_names]
        for name, value in {
            "counts": torch.zeros(len(other), NUM_BINS),
            "other_side": torch.tensor(other),
        }.items():
            self.register_buffer(name, value, persistent=False)

    def forget(self) -> None:
        """Start as if no colour had been seen."""
        self.counts.zero_()

    def forward(self, evidence: Evidence) -> Float[Tensor, "batch num parts"]:
        """Log-potentials of the parts: 0 on padding and while nothing is learned, never below
        `strength` log `floor`."""
        place, share = colour_bins(_colours(evidence))
        total = self.counts.sum(0)
        person = total / total.sum().clamp_min(1)
        mass = self.counts.sum(1, keepdim=True)
        trust = mass / (mass + self.config.trust)
        part = trust * self.counts / mass.clamp_min(1e-6) + (1 - trust) * person
        floor = self.config.floor
        ratio = ((1 - floor) * part + floor * person + RARE) / (person + RARE)
        value = (ratio[:, place] * share).sum(-1)  # (parts, B, N)
        log = self.config.strength * value.log() * evidence.cloud.mask
        return log.permute(1, 2, 0)

    def learn(
        self,
        evidence: Evidence,
        belief: Float[Tensor, "batch labels num"],
        distance: Float[Tensor, "batch num"],
    ) -> None:
        """Add the colours of points that lie near the surface of the part they are believed to be of.

        Args:
            belief: of each label; those after the parts are left out.
            distance: of each point to the nearest part, m.
        """
        place, share = colour_bins(_colours(evidence))
        sure = (distance < self.config.near) & evidence.cloud.mask
        weight = belief[:, : len(self.segment_names)] * sure[:, None]
        weight = (weight + weight[:, self.other_side]).transpose(0, 1).flatten(1)  # (parts, B N)
        spread = (weight[..., None] * share.flatten(0, 1)).flatten(1)
        self.counts.mul_(1 - 1 / self.config.memory).index_add_(1, place.flatten(), spread)


def _colours(evidence: Evidence) -> Float[Tensor, "batch num 3"]:
    """Mean RGB of the 3 x 3 pixels around each point; at the border the last pixel stands for those beyond."""
    H, W = evidence.images.shape[2:]
    column, row = evidence.cloud.pixels.round().long()[..., None].unbind(2)
    around = torch.arange(-1, 2, device=row.device)
    rows, columns = (row + around).clamp(0, H - 1), (column + around).clamp(0, W - 1)  # (B, N, 3)
    index = (rows[..., :, None] * W + columns[..., None, :]).flatten(1)[:, None].expand(-1, 3, -1)
    near = evidence.images.flatten(2).gather(2, index).unflatten(2, (-1, 9))
    return near.mean(-1).clamp(0, 1).mT


def _other_side(name: str) -> str:
    for one, other in (("_left", "_right"), ("_right", "_left")):
        if name.endswith(one):
            return name.removesuffix(one) + other
    return name
