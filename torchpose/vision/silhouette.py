"""Which pixels are the person: one posterior per pixel of colour and depth, and the person's part of it.

A pixel shows the empty scene, unchanged or in a cast shadow, or the person. Log-odds are log P(person) / P(scene).
What is seen adds: the background model's log-odds of the colour, the scene match's, and those of depth, each saturated
so that no one cue settles a pixel. Neighbours are tied by a Potts field, weaker across an edge of the image, and its
mean field is the posterior.

Depth is metres along the left camera's z axis, NaN where there is no reading.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from torchpose.vision.camera import StereoCamera
from torchpose.vision.density import reading_density
from torchpose.vision.disparity import bounding_box
from torchpose.vision.pieces import connected_pieces
from torchpose.vision.windows import window_max, window_min

Plane = Float[Tensor, "height width"]
Planes = Float[Tensor, "batch height width"]
Masks = Bool[Tensor, "batch height width"]
# Half of the eight neighbours (rows, columns) of a pixel; the others are their opposites.
NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))
UNCOUPLED = 100.0  # contrasts, across which the coupling is exactly 0 in float32 and in float64


@dataclass(frozen=True)
class Silhouette:
    """The person's pixels."""

    mask: Masks
    probability: Planes  # that a pixel is foreground, whoever's; 0 where colour rules it out


@dataclass(frozen=True)
class SilhouetteConfig:
    """Settings of `person_silhouette` and `search_region`."""

    search_threshold: float = -3.0  # log-odds above which a pixel is searched: unchanged ones are not
    search_margin: int = 4  # px added around
    depth_range: float = 1.0  # m, the person's depth to either side of the middle
    depth_noise: float = 0.006  # m per m^2 of depth, where no stereo camera is given
    disparity_noise: float = 0.25  # px, of a stereo camera
    noise_floor: float = 0.02  # m
    depth_weight: float = 2.5  # greatest log-odds that depth gives for or against a pixel
    agreement: int = 1  # px, depth counts where it says the same all around: edges are fattened
    coupling: float = 5.0  # log-odds between neighbours of one colour that differ in label
    contrast: float = 0.06  # difference in brightness at which the coupling has fallen to 0.6 of it
    sweeps: int = 5  # of the mean field; 0 leaves each pixel alone
    bridge: int = 2  # px, parts apart by up to twice this belong together
    max_hole: float = 0.002  # share of the person; larger holes stay if the background is seen through them:
    see_through: float = -2.2  # if the mean of their log-odds is less; a shadow's colour alone is no proof
    min_area: float = 0.008  # share of the image below which there is no person

    def __post_init__(self) -> None:
        for name in ("depth_range", "depth_noise", "disparity_noise", "noise_floor", "contrast"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in (
            *("search_margin", "agreement", "bridge", "depth_weight", "max_hole"),
            *("coupling", "sweeps"),
        ):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if not 0 < self.min_area < 1:
            raise ValueError(f"min_area must be a share of the image in (0, 1), got {self.min_area}")


def search_region(log_odds: Planes, config: SilhouetteConfig = SilhouetteConfig()) -> Masks:
    """Where to match the stereo pair: all that has changed, shadows too, for a grey shirt looks like one.

    With the scene match's log-odds added, shadows that match where the empty scene does are left out.
    """
    changed = window_min((log_odds > config.search_threshold).to(log_odds.dtype), 1)  # a lone pixel is noise
    return window_max(changed, 1 + config.search_margin) > 0


def person_silhouette(
    log_odds: Planes,
    depth: Float[Tensor, "batch depth_height depth_width"],
    config: SilhouetteConfig = SilhouetteConfig(),
    background_depth: Float[Tensor, "background_height background_width"] | None = None,
    camera: StereoCamera | None = None,
    guide: Float[Tensor, "batch guide_height guide_width"] | None = None,
    previous: Bool[Tensor, "batch previous_height previous_width"] | None = None,
    background_sigma: Float[Tensor, "sigma_height sigma_width"] | None = None,
) -> Silhouette:
    """The person's silhouette: the posterior of colour and depth, and one connected part of it (T. Fig. 3.6).

    Depth adds to the log-odds: for the person in front of the background, against where it is the background's own (a
    floor shadow lies on the floor), and what is far from the person's depth goes. Of the parts that are more likely
    person than not, the one that shares most pixels with the last mask stays, or else the largest, and its holes are
    filled, except those through which the background is seen. A frame without enough foreground gets an empty mask.

    Args:
        log_odds: (B, H, W) of `BackgroundModel` or `DepthBackground`, with those of `SceneMatch` added for a pair.
        depth: (B, H, W) m, NaN where there is none; all NaN leaves colour alone to decide.
        background_depth: (H, W) m of the empty scene, NaN where unknown.
        camera: a stereo camera makes depth's noise `disparity_noise` Z^2 / (f b).
        guide: (B, H, W) grey images in [0, 1], whose edges the silhouette follows; None ties all neighbours alike.
        previous: (B, H, W) masks of the frames before; None, or an empty one, where there was nobody.
        background_sigma: (H, W) m, noise of a reading of the empty scene as measured; None takes it by `config`.

    Raises ValueError where sizes differ.
    """
    count, height, width = log_odds.shape
    if background_depth is None:
        background_depth = depth.new_full((height, width), torch.nan)
    if guide is None:
        guide = torch.zeros_like(log_odds)
    if previous is None:
        previous = torch.zeros_like(log_odds, dtype=torch.bool)
    for name, image in (("depth", depth), ("guide", guide), ("previous", previous)):
        if image.shape != log_odds.shape:
            raise ValueError(
                f"{name} must have log_odds' shape {(count, height, width)}, got {tuple(image.shape)}"
            )
    if background_depth.shape != (height, width):
        raise ValueError(
            f"background_depth must be one image of {(height, width)}, got {tuple(background_depth.shape)}; "
            "take the median if there are several"
        )
    growth = config.depth_noise
    if camera is not None and camera.baseline is not None:
        growth = config.disparity_noise / (camera.focal_length * camera.baseline)
    sigma = config.noise_floor + growth * background_depth.square()
    if background_sigma is not None:
        sigma = background_sigma
    middle = _person_depth(log_odds, depth, background_depth - 3 * sigma)
    smallest = max(1, math.ceil(config.min_area * height * width))
    mask, probability = torch.zeros_like(log_odds, dtype=torch.bool), torch.zeros_like(log_odds)
    # Depth cannot outvote log-odds below -depth_weight, so all else happens in the box of the pixels above.
    margin = config.agreement + config.sweeps + 2 * config.bridge + 1
    inside = _boxes(log_odds > -config.depth_weight, margin)
    if not inside.any():
        return Silhouette(mask, probability)
    # The box of all frames; within it, nothing reaches across the edge of a frame's own.
    box = (slice(None), *bounding_box(inside))
    inside = inside[box]
    evidence = log_odds[box] + _depth_evidence(
        depth[box].where(inside, torch.nan), background_depth[box[1:]], sigma[box[1:]], middle, config
    )
    # Pixels turn from their neighbours alone, one a sweep: none does that is further from all that are likely by
    # themselves.
    inside &= _boxes((evidence > 0) & inside, margin + config.sweeps)
    if not inside.any():
        return Silhouette(mask, probability)
    part = (slice(None), *bounding_box(inside))
    inside, evidence = inside[part], evidence[part]
    edged = guide[box][part].where(inside, -UNCOUPLED * config.contrast)
    field = mean_field(evidence, edged, config.coupling, config.contrast, config.sweeps)
    probability[box][part] = field.sigmoid() * inside
    likely = (field > 0) & inside
    bridged = (window_max(likely.to(field.dtype), config.bridge) > 0) & inside
    mask[box][part] = _person_part(likely, bridged, evidence, previous[box][part], smallest, config)
    return Silhouette(mask, probability)


def mean_field(log_odds: Planes, guide: Planes, coupling: float, contrast: float, sweeps: int) -> Planes:
    """Log-odds of a binary Potts field's marginals, by the mean-field approximation.

    The field: log P = sum_p x_p log_odds_p / 2 + sum_pq w_pq x_p x_q / 2 + const with x = 1 or -1, over pairs of
    neighbours, w_pq = coupling exp(-(difference of guide)^2 / (2 contrast^2)) / distance. Each sweep sets the log-odds
    of all pixels to log_odds_p + sum_q w_pq tanh(log-odds_q / 2). All at once is safe here: couplings only attract, so
    the map is monotone and does not swing.

    Args:
        log_odds: (B, H, W) of each pixel by itself.
        guide: (B, H, W) whose edges weaken the coupling.
    """
    height, width = log_odds.shape[1:]
    pairs = []
    for down, right in NEIGHBOURS:
        first = (..., slice(0, height - down), slice(max(0, -right), width - max(0, right)))
        second = (..., slice(down, height), slice(max(0, right), width - max(0, -right)))
        difference = (guide[first] - guide[second]).div_(contrast).square_()
        weight = difference.mul_(-0.5).exp_().mul_(coupling / math.hypot(down, right))
        pairs.append((first, second, weight))
    field = log_odds
    for _ in range(sweeps):
        mean = torch.tanh(0.5 * field)
        field = log_odds.clone()
        for first, second, weight in pairs:
            field[first].addcmul_(weight, mean[second])
            field[second].addcmul_(weight, mean[first])
    return field


def _depth_evidence(
    depth: Planes,
    background_depth: Plane,
    sigma: Plane,
    middle: Float[Tensor, " batch"],
    config: SilhouetteConfig,
) -> Planes:
    """Log-odds that depth adds, 0 where it is unknown or where it says different things near by."""
    outliers, span = 0.02, 5.0  # share of the readings, and metres over which they lie
    in_front = ~(depth > background_depth + sigma)  # True where the background is unknown
    near = ~((depth - middle[:, None, None]).abs() > config.depth_range)  # True where either is unknown
    usual = (1 - outliers) / (2 * config.depth_range) + outliers / span
    log_person = torch.where(in_front & near, math.log(usual), math.log(outliers / span))
    at_background = reading_density(depth - background_depth, sigma, outliers, span)
    log_background = torch.where(background_depth.isnan(), math.log(1 / span), at_background.log())
    evidence = (log_person - log_background).clamp(-config.depth_weight, config.depth_weight)
    evidence = torch.where(near, evidence, -2 * config.depth_weight)  # out, whatever the colour
    unknown = depth.isnan()
    lowest = window_min(evidence.masked_fill(unknown, math.inf), config.agreement)
    highest = window_max(evidence.masked_fill(unknown, -math.inf), config.agreement)
    # The least that all readings around agree on; without any, lowest is inf and highest -inf.
    return torch.where(lowest <= highest, lowest.clamp_min(0) + highest.clamp_max(0), 0)


def _person_depth(log_odds: Planes, depth: Planes, limit: Plane) -> Float[Tensor, " batch"]:
    """Depth (m) about which most of the foreground lies, NaN if there is none: a smooth histogram's mode.

    Of the foreground clearly in front of the background (`limit`, m), if there is any.
    """
    step, bins = 0.1, 200
    log_odds, depth, limit = log_odds[:, ::2, ::2], depth[:, ::2, ::2], limit[::2, ::2]
    counted = (log_odds > 0) & (depth > 0)
    before = counted & (depth < limit)
    counted = torch.where(before.flatten(1).any(1)[:, None, None], before, counted)
    index = (torch.where(counted, depth, 0) / step).long().clamp_max(bins - 1).flatten(1)
    votes = depth.new_zeros(len(depth), bins).scatter_add(1, index, counted.flatten(1).to(depth.dtype))
    offsets = torch.arange(-10, 11, device=depth.device, dtype=depth.dtype) * step
    kernel = torch.exp(-0.5 * (offsets / 0.3).square())  # 0.3 m: half a person's extent in depth
    smooth = F.conv1d(votes[:, None], kernel[None, None], padding=10)[:, 0]
    return torch.where(votes.sum(1) > 0, (smooth.argmax(1) + 0.5) * step, torch.nan)


def _boxes(wanted: Masks, margin: int) -> Masks:
    """True in each image's bounding box of its wanted pixels, and `margin` more around; nowhere if there are none.

    Only of squares of two by two: lone pixels are noise, and do not survive the field.
    """
    wide = wanted[:, :, 1:] & wanted[:, :, :-1]
    square = (wide[:, 1:] & wide[:, :-1]).view(torch.uint8)  # a greatest byte is found sooner than any True
    spans = []
    for axis, size in ((2, wanted.shape[1]), (1, wanted.shape[2])):
        found = square.amax(axis) > 0
        place = torch.arange(size, device=wanted.device)
        first = place[:-1].where(found, size).amin(1, keepdim=True) - margin
        last = place[1:].where(found, -1 - margin).amax(1, keepdim=True) + margin
        spans.append((place >= first) & (place <= last))
    return spans[0][:, :, None] & spans[1][:, None]


def _person_part(
    mask: Masks, bridged: Masks, log_odds: Planes, previous: Masks, min_area: int, config: SilhouetteConfig
) -> Masks:
    """One part of each `mask` that `bridged` connects, holes filled; empty if none has `min_area` px.

    The part that shares most pixels with `previous`, or without any such the largest.
    """
    parts = connected_pieces(bridged)
    count = len(parts.area)
    areas = torch.bincount(parts.labels[mask], minlength=count)
    areas = areas.where(areas >= min_area, 0)
    shared = torch.bincount(parts.labels[mask & previous], minlength=count).where(areas > 0, 0)
    kept = parts.best(shared)
    chosen = kept.where(kept > 0, parts.best(areas))
    person = mask & (parts.labels == chosen[:, None, None]) & (chosen > 0)[:, None, None]
    holes = connected_pieces(~person, connectivity=4)
    total = torch.bincount(holes.labels.flatten(), log_odds.flatten().double(), minlength=len(holes.area))
    left, top, width, height = holes.box.unbind(1)
    inside = (left > 0) & (top > 0) & (left + width < mask.shape[2]) & (top + height < mask.shape[1])
    small = holes.area <= config.max_hole * areas[chosen][holes.image]
    filled = inside & (small | (total > config.see_through * holes.area))
    filled[0] = True  # off the holes is the person
    return filled[holes.labels]
