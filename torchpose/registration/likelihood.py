"""What images say of the points' body parts: each term adds log-potentials (T. 3.9 to 3.11).

This is where a learned part likelihood plugs in: subclass `PartLikelihood`. Pixels (u, v), metres.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchpose.vision.faces import Faces
from torchpose.vision.points import PointCloud


@dataclass(frozen=True)
class Evidence:
    """What is known of a frame before the pose: the images' findings and the points."""

    images: Float[Tensor, "batch 3 height width"]  # left images, RGB in [0, 1]
    silhouette: Bool[Tensor, "batch height width"]
    cloud: PointCloud
    faces: Faces


class PartLikelihood(nn.Module, ABC):
    """log p(appearance | part) of each point, up to a constant per point.

    It is not shown the pose, so it cannot depend on it: it shapes the labels (VE-step) and leaves the joint
    update (M-step) and the bound's guarantee alone.
    """

    def __init__(self, segment_names: Sequence[str]):
        super().__init__()
        self.segment_names = tuple(segment_names)

    @abstractmethod
    def forward(self, evidence: Evidence) -> Float[Tensor, "batch num parts"]:
        """Log-potentials of the parts in the order of `segment_names`."""


@dataclass(frozen=True)
class AppearanceConfig:
    face: float = 1.0  # c of (3.9): log-odds that a face pixel's point is the head's; 0 switches the term off
    torso: float = 1.0  # power of (3.10), whose kappa is e; 0 switches the term off
    torso_aspect: float = 0.6  # the torso's ellipse in the image: width to height
    torso_length: float = 0.9  # its half height in ways from the face to the silhouette's centre

    def __post_init__(self) -> None:
        for name in ("torso_aspect", "torso_length"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


class FaceLikelihood(PartLikelihood):
    """phi(head) = e^c on face pixels, 1 elsewhere (3.9)."""

    def __init__(self, segment_names: Sequence[str], config: AppearanceConfig = AppearanceConfig()):
        super().__init__(segment_names)
        self.config, self.head = config, self.segment_names.index("head")

    def forward(self, evidence: Evidence) -> Float[Tensor, "batch num parts"]:
        cloud = evidence.cloud
        on_face = _at_pixels(evidence.faces.mask, cloud.pixels) & cloud.mask
        potential = cloud.points.new_zeros(*cloud.mask.shape, len(self.segment_names))
        potential[..., self.head] = self.config.face * on_face
        return potential


class TorsoLikelihood(PartLikelihood):
    """phi(torso) = kappa exp(-d(x)) where d(x) <= 1, else 1 (3.10, 3.11); d is algebraic, 0 on the ellipse.

    The ellipse lies half way between the face and the silhouette's centre, along the line that joins them.
    Frames without a face get nothing.
    """

    def __init__(self, segment_names: Sequence[str], config: AppearanceConfig = AppearanceConfig()):
        super().__init__(segment_names)
        self.config, self.torso = config, self.segment_names.index("torso")

    def forward(self, evidence: Evidence) -> Float[Tensor, "batch num parts"]:
        cloud, box = evidence.cloud, evidence.faces.box
        face = (box[:, :2] + box[:, 2:]) / 2
        center = _mask_center(evidence.silhouette, cloud.points)
        way = center - face
        half = self.config.torso_length * way.norm(dim=-1, keepdim=True).clamp_min(1.0)
        along = way / way.norm(dim=-1, keepdim=True).clamp_min(1.0)
        offset = cloud.pixels - ((face + center) / 2)[:, None]
        down = (offset * along[:, None]).sum(-1)
        side = offset[..., 0] * along[:, None, 1] - offset[..., 1] * along[:, None, 0]
        distance = (down / half) ** 2 + (side / (half * self.config.torso_aspect)) ** 2 - 1
        inside = (distance <= 1) & evidence.faces.found[:, None] & cloud.mask
        potential = cloud.points.new_zeros(*cloud.mask.shape, len(self.segment_names))
        # log(kappa exp(-d)) with kappa = e is 1 - d, which falls to 0 where d = 1.
        potential[..., self.torso] = torch.where(inside, self.config.torso * (1 - distance), 0.0)
        return potential


def appearance_potential(
    likelihoods: Iterable[nn.Module], evidence: Evidence, num_parts: int
) -> Float[Tensor, "batch num parts"]:
    """The sum of the terms' log-potentials, B x M x parts."""
    total = evidence.cloud.points.new_zeros(*evidence.cloud.mask.shape, num_parts)
    for likelihood in likelihoods:
        total = total + likelihood(evidence)
    return total


def _at_pixels(
    mask: Bool[Tensor, "batch height width"], pixels: Float[Tensor, "batch num 2"]
) -> Bool[Tensor, "batch num"]:
    H, W = mask.shape[1:]
    column, row = pixels.round().long().unbind(-1)
    return mask.flatten(1).gather(1, row.clamp(0, H - 1) * W + column.clamp(0, W - 1))


def _mask_center(
    mask: Bool[Tensor, "batch height width"], like: Float[Tensor, "batch num 3"]
) -> Float[Tensor, "batch 2"]:
    """Mean pixel (u, v) of each mask; zero where it is empty."""
    weight = mask.to(like)
    count = weight.sum((1, 2)).clamp_min(1)
    v = (weight.sum(2) * torch.arange(mask.shape[1], device=mask.device)).sum(1) / count
    u = (weight.sum(1) * torch.arange(mask.shape[2], device=mask.device)).sum(1) / count
    return torch.stack([u, v], -1)
