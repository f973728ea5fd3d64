"""Colours of the body's parts, learned from the person while following: skin, shirt, trousers and shoes tell parts apart.

An appearance term as (3.9), of which the thesis has two; this one learns in the run and from the run alone. Colours are RGB in
[0, 1] on the way in.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from kornia.color import rgb_to_lab
from torch import Tensor

from torchpose.registration.likelihood import Evidence, PartLikelihood

BINS = (7, 12, 12)  # of lightness, of green to red and of blue to yellow
LOW, HIGH = (0.0, -48.0, -48.0), (100.0, 48.0, 48.0)  # what the bins span in CIELAB; few clothes are more colourful


@dataclass(frozen=True)
class ColourConfig:
    strength: float = 1.0  # power of p(colour | part) / p(colour); 0 switches the term off
    floor: float = 0.03  # share of each part's colours that may be anybody's: the ratio never falls below it
    near: float = 0.04  # m from its part's surface, within which a point teaches that part its colour
    trust: float = 40.0  # points, from which a part's colours count as much as the person's own mixture
    memory: float = 150.0  # frames, over which what was learned fades

    def __post_init__(self) -> None:
        if self.strength < 0 or not 0 < self.floor < 1:
            raise ValueError(f"strength >= 0 and 0 < floor < 1 must hold, got {self.strength} and {self.floor}")


class ColourLikelihood(PartLikelihood):
    """log p(colour | part) - log p(colour) of each point. Left and right parts share their colours."""

    counts: Tensor  # (parts, bins) points seen; a sided pair's rows are equal

    def __init__(self, segment_names: Sequence[str], config: ColourConfig = ColourConfig()):
        super().__init__(segment_names)
        self.config = config
        other = [
            self.segment_names.index(n.replace("_left", "_#").replace("_right", "_left").replace("_#", "_right"))
            for n in self.segment_names
        ]
        self.other_side = other
        self.register_buffer("counts", torch.zeros(len(other), BINS[0] * BINS[1] * BINS[2]), persistent=False)

    def forget(self) -> None:
        self.counts.zero_()

    def forward(self, evidence: Evidence) -> Float[Tensor, "batch num parts"]:
        place, share = self._bins(evidence)
        total = self.counts.sum(0)
        person = total / total.sum().clamp_min(1)
        mass = self.counts.sum(1, keepdim=True)
        trust = mass / (mass + self.config.trust)
        part = trust * self.counts / mass.clamp_min(1e-6) + (1 - trust) * person
        floor = self.config.floor
        # Nearly unseen colours say nothing of any part.
        ratio = ((1 - floor) * part + floor * person + 1e-5) / (person + 1e-5)
        value = (ratio[:, place] * share).sum(-1)  # (parts, B, N)
        log = self.config.strength * value.log() * evidence.cloud.mask
        return log.permute(1, 2, 0)

    def learn(self, evidence: Evidence, belief: Tensor, distance: Tensor) -> None:
        """Add the colours of points that lie near the surface of the part they are believed to be of."""
        place, share = self._bins(evidence)
        sure = (distance < self.config.near) & evidence.cloud.mask
        weight = belief[:, : len(self.segment_names)] * sure[:, None]
        weight = weight + weight[:, self.other_side]
        table = self.counts.new_zeros(self.counts.shape)
        flat = place.flatten(1)  # (B, N * 8)
        for row in range(len(flat)):
            spread = (weight[row][..., None] * share[row]).flatten(1)
            table.index_add_(1, flat[row], spread)
        self.counts.mul_(1 - 1 / self.config.memory).add_(table)

    def _bins(self, evidence: Evidence) -> tuple[Tensor, Tensor]:
        """The eight bins around each point's colour and the share of each."""
        B, _, H, W = evidence.images.shape
        u, v = evidence.cloud.pixels.round().long().unbind(-1)
        around = torch.arange(-1, 2, device=u.device)
        rows = (v[..., None] + around).clamp(0, H - 1)[..., :, None]
        columns = (u[..., None] + around).clamp(0, W - 1)[..., None, :]
        index = (rows * W + columns).flatten(1)[:, None].expand(-1, 3, -1)
        colour = evidence.images.flatten(2).gather(2, index).unflatten(2, (-1, 9)).mean(-1)
        lab = rgb_to_lab(colour[..., None].clamp(0, 1))[..., 0].transpose(1, 2)  # (B, N, 3)
        low, high, bins = (torch.tensor(x, dtype=lab.dtype, device=lab.device) for x in (LOW, HIGH, BINS))
        at = ((lab - low) / (high - low)).clamp(0, 1) * (bins - 1)
        corner = torch.minimum(at.floor(), bins - 2)
        rest = at - corner
        place = torch.zeros(*lab.shape[:2], 8, dtype=torch.long, device=lab.device)
        share = torch.ones(*lab.shape[:2], 8, dtype=lab.dtype, device=lab.device)
        for bit in range(8):
            step = torch.tensor([bit >> k & 1 for k in range(3)], device=lab.device)
            cell = (corner + step).long()
            place[..., bit] = (cell[..., 0] * BINS[1] + cell[..., 1]) * BINS[2] + cell[..., 2]
            share[..., bit] = torch.where(step.bool(), rest, 1 - rest).prod(-1)
        return place, share
