"""Which colours somebody wears: histograms in CIELAB, and their back-projection onto an image.

Colours are RGB in [0, 1]. Each counts in the eight bins around it, so a histogram is smooth in the colour and needs few
pixels; bins span what clothes and skin span.
"""

import math

import torch
from jaxtyping import Bool, Float, Int
from kornia.color import rgb_to_lab
from torch import Tensor

BINS = (7, 12, 12)  # of lightness, of green to red and of blue to yellow
NUM_BINS = math.prod(BINS)
LOW, HIGH = (
    (0.0, -48.0, -48.0),
    (100.0, 48.0, 48.0),
)  # middles of the outermost bins in CIELAB; few clothes are more colourful
CORNERS = ((0, 0, 0), (0, 0, 1), (0, 1, 0), (0, 1, 1), (1, 0, 0), (1, 0, 1), (1, 1, 0), (1, 1, 1))


def colour_bins(
    colours: Float[Tensor, "*batch 3"],
) -> tuple[Int[Tensor, "*batch corners"], Float[Tensor, "*batch corners"]]:
    """The eight of `NUM_BINS` bins around each colour and the share of each; vivid ones are of the last bin."""
    flat = colours.reshape(-1, 3).mT[None, :, :, None]
    lab = rgb_to_lab(flat)[0, ..., 0].mT.view(*colours.shape)
    last = torch.tensor(BINS, device=lab.device) - 1
    low = lab.new_tensor(LOW)
    spacing = (lab.new_tensor(HIGH) - low) / last
    at = torch.minimum(((lab - low) / spacing).clamp_min(0), last)[..., None, :]
    corner = torch.minimum(at.floor(), last - 1)
    rest = at - corner
    steps = torch.tensor(CORNERS, device=lab.device)
    share = torch.where(steps.bool(), rest, 1 - rest).prod(-1)
    lightness, red, yellow = (corner.long() + steps).unbind(-1)
    return (lightness * BINS[1] + red) * BINS[2] + yellow, share


def colour_histogram(
    images: Float[Tensor, "batch 3 height width"],
    mask: Bool[Tensor, "batch height width"] | Float[Tensor, "batch height width"],
) -> Float[Tensor, "batch bins"]:
    """Share of each bin among the pixels of a silhouette, or of weights; all 0 where there is none."""
    frame, row, column = mask.nonzero(as_tuple=True)
    place, share = colour_bins(images[frame, :, row, column].clamp(0, 1))
    share = share * mask[frame, row, column].to(images)[:, None]
    table = images.new_zeros(len(images) * NUM_BINS)
    table = table.index_add(0, (frame[:, None] * NUM_BINS + place).flatten(), share.flatten())
    table = table.view(-1, NUM_BINS)
    return table / table.sum(1, keepdim=True).clamp_min(torch.finfo(table.dtype).tiny)


def back_projection(
    colours: Float[Tensor, "batch *num 3"],
    person: Float[Tensor, "batch bins"],
    scene: Float[Tensor, "batch bins"] | None = None,
) -> Float[Tensor, "batch ..."]:
    """How much each colour is a person's, from 0 to 1.

    Beside the scene's histogram the probability of the person, if both are as likely beforehand; without it the share
    of the person that is so coloured, to that of the most frequent colour.

    Args:
        colours: RGB of points, or of an image with its channels last.
    """
    table = person / person.amax(1, keepdim=True).clamp_min(torch.finfo(person.dtype).tiny)
    if scene is not None:
        table = person / (person + scene).clamp_min(torch.finfo(person.dtype).tiny)
    place, share = colour_bins(colours.clamp(0, 1))
    found = table.gather(1, place.flatten(1)).view(place.shape)
    return (found * share).sum(-1)


def colour_similarity(
    one: Float[Tensor, "*#batch bins"], other: Float[Tensor, "*#batch bins"]
) -> Float[Tensor, "*batch"]:
    """Bhattacharyya's coefficient of two histograms: 1 if they are equal, 0 if they share no colour."""
    return (one * other).clamp_min(0).sqrt().sum(-1)
