"""The colour of skin: a Gaussian in the plane of hue and saturation, which learns from the faces that are found.

Hue is an angle and says nothing where saturation is low, so both are taken together as a point of a plane
(`chroma`): its direction is the hue, its length the saturation, and grey is the origin. Light and dark skin differ in
value, which is left out; the room's light moves the point. So the model begins wide and is narrowed by the person's
own face (Bayesian: the prior counts as pixels that were seen before), and what was learned fades.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# What is not skin: half of it is grey, within this of the plane's origin, and half of any colour of the unit disc.
GREY_SPREAD = 0.05


@dataclass(frozen=True)
class SkinConfig:
    """What skin looks like before a face is seen, and how fast a face changes that."""

    hue: float = 0.4  # rad, of skin in white light, 0 = red
    saturation: float = 0.4
    spread: float = 0.2  # of single persons and lights about it, in the plane
    prior_pixels: float = 20.0  # pixels that the prior is worth
    face_pixels: float = 20.0  # pixels that one face is worth; neighbours are no independent witnesses
    memory: float = 0.95  # share of what was learned that is left after a frame
    least_value: float = 0.06  # darker pixels have no certain colour and are not skin

    def __post_init__(self) -> None:
        for name in ("spread", "prior_pixels", "face_pixels"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("saturation", "memory", "least_value"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)}")


@dataclass(frozen=True)
class SkinModel:
    """Sums over the chroma x of the skin seen, the prior's pixels included; one model for each item of a batch."""

    weight: Float[Tensor, " batch"]  # pixels
    total: Float[Tensor, "batch 2"]  # sum of x
    square: Float[Tensor, "batch 2 2"]  # sum of x x^T

    @property
    def mean(self) -> Float[Tensor, "batch 2"]:
        return self.total / self.weight[:, None]

    @property
    def covariance(self) -> Float[Tensor, "batch 2 2"]:
        mean = self.mean
        return self.square / self.weight[:, None, None] - mean[:, :, None] * mean[:, None]

    def item(self, index: int) -> "SkinModel":
        """The model of one item, batch 1."""
        part = slice(index, index + 1)
        return SkinModel(self.weight[part], self.total[part], self.square[part])


def skin_prior(like: Tensor, config: SkinConfig = SkinConfig(), batch: int = 1) -> SkinModel:
    """The model before any face, on the device and in the dtype of `like`."""
    mean = config.saturation * like.new_tensor([math.cos(config.hue), math.sin(config.hue)])
    second = config.spread**2 * torch.eye(2, dtype=like.dtype, device=like.device) + mean[:, None] * mean
    return SkinModel(
        like.new_full((batch,), config.prior_pixels),
        (config.prior_pixels * mean).expand(batch, 2),
        (config.prior_pixels * second).expand(batch, 2, 2),
    )


def stack_skin(models: Sequence[SkinModel]) -> SkinModel:
    """One batch of several."""
    return SkinModel(
        torch.cat([model.weight for model in models]),
        torch.cat([model.total for model in models]),
        torch.cat([model.square for model in models]),
    )


def chroma(images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch 2 height width"]:
    """Saturation times the hue's cosine and sine: the hexagon of HSV laid out in the plane, red at (1, 0).

    Within 1.2 degrees of HSV's hue and between 0.86 and 1 of its saturation. Black is the origin, like grey.
    """
    red, green, blue = images.unbind(1)
    value = images.amax(1).clamp_min(1e-6)
    return torch.stack([red - 0.5 * (green + blue), math.sqrt(0.75) * (green - blue)], 1) / value[:, None]


def skin_probability(
    images: Float[Tensor, "batch 3 height width"], model: SkinModel, config: SkinConfig = SkinConfig()
) -> Float[Tensor, "batch height width"]:
    """Probability of each pixel to be skin, which is as likely beforehand as all else together.

    Wherever the silhouette is True it tells the face and bare hands and arms from clothes and hair. `model` has the
    images' batch, or one for all of them. Differentiable in the images and in the model.

    Raises:
        ValueError: there are several models, but not one an image.
    """
    if len(model.weight) not in (1, len(images)):
        raise ValueError(
            f"there must be one skin model for all images or one for each of {len(images)}, "
            f"got {len(model.weight)}"
        )
    covariance = model.covariance
    a, b, d = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    determinant = a * d - b * b
    at = chroma(images)
    x, y = (at - model.mean[:, :, None, None]).unbind(1)
    a, b, d = ((entry / determinant)[:, None, None] for entry in (a, b, d))
    squared = d * x * x - 2 * b * x * y + a * y * y  # Mahalanobis; the inverse of a 2 x 2 matrix written out
    skin = -0.5 * squared - (2 * math.pi * determinant.sqrt()).log()[:, None, None]
    grey = (-0.5 * at.square().sum(1) / GREY_SPREAD**2).exp() / (2 * math.pi * GREY_SPREAD**2)
    probability = (skin - (0.5 * grey + 0.5 / math.pi).log()).sigmoid()
    return torch.where(images.amax(1) >= config.least_value, probability, 0.0)


def fade_skin(model: SkinModel, config: SkinConfig = SkinConfig()) -> SkinModel:
    """The model a frame later: what was learned fades towards the prior, so a new light or person is let in."""
    prior = skin_prior(model.weight, config)
    return SkinModel(
        torch.lerp(prior.weight, model.weight, config.memory),
        torch.lerp(prior.total, model.total, config.memory),
        torch.lerp(prior.square, model.square, config.memory),
    )


def learn_skin(
    model: SkinModel,
    images: Float[Tensor, "batch 3 height width"],
    face: Bool[Tensor, "batch height width"],
    config: SkinConfig = SkinConfig(),
) -> SkinModel:
    """The model with the pixels of the face added: the posterior of a normal-inverse-Wishart prior.

    Each pixel counts by its probability to be skin, so eyes, hair and beard hardly do. A face that is all skin is
    worth `face_pixels`, half of one half of that, and none nothing.

    Args:
        face: (B, H, W), True on the face.
    """
    probability = skin_probability(images, model, config) * face
    weight = config.face_pixels * probability.flatten(1) / face.sum((1, 2)).clamp_min(1)[:, None]
    x = chroma(images).flatten(2)
    weighted = x * weight[:, None]
    return SkinModel(
        model.weight + weight.sum(1), model.total + weighted.sum(2), model.square + weighted @ x.mT
    )
