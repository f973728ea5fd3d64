"""Brightness of a camera: the gain between two pictures of a scene, and the noise level at each intensity.

Images are RGB in [0, 1], NaN where a picture does not show the scene.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

NOISE_BINS = 16  # of intensity, in which the noise level is measured
TRIM = 0.7  # share of the squared differences that count: who walks through the scene is in the rest
TRIMMED_VARIANCE = 0.3094  # of a unit normal cut off beyond its 70 %: 1 - 2 z phi(z) / 0.7 with z = 1.0364
GAIN_RANGE, GAIN_STEP = 0.6, 0.01  # of the gain's logarithm: 0.55 to 1.8, in bins of 1 %


def relative_gain(
    images: Float[Tensor, "batch 3 height width"], reference: Float[Tensor, "3 height width"]
) -> Float[Tensor, "batch 3 1 1"]:
    """Brightness of each image and channel relative to the reference, by the mode of the ratio.

    The mode, for a person and their shadow draw the median aside. Every fourth pixel of a row and a column
    counts, if neither black nor glaring; 1 where fewer than 5 % of them have a ratio of 0.55 to 1.8.
    """
    images, reference = images[..., ::4, ::4].flatten(2), reference[..., ::4, ::4].flatten(1)
    usable = (reference > 0.05) & (reference < 0.95) & (images > 0.02) & (images < 0.98)  # False for NaN
    ratio = torch.log(images.clamp_min(0.02) / reference.clamp_min(0.02)).nan_to_num(0)  # (B, 3, n)
    usable = usable & (ratio.abs() < GAIN_RANGE)
    bins = round(2 * GAIN_RANGE / GAIN_STEP)
    index = ((ratio + GAIN_RANGE) / GAIN_STEP).long().clamp(0, bins - 1)
    votes = images.new_zeros(*images.shape[:2], bins).scatter_add(2, index, usable.to(images.dtype))
    smooth = F.avg_pool1d(F.avg_pool1d(votes, 5, 1, 2), 5, 1, 2)
    mode = (smooth.argmax(2, keepdim=True) + 0.5) * GAIN_STEP - GAIN_RANGE
    for _ in range(3):  # mean shift to below the width of a bin
        weight = usable * (1 - ((ratio - mode) / (5 * GAIN_STEP)).square()).clamp_min(0)
        mode = mode + (weight * (ratio - mode)).sum(2, keepdim=True) / weight.sum(2, keepdim=True).clamp_min(
            1e-6
        )
    enough = usable.sum(2, keepdim=True) > 0.05 * ratio.shape[2]
    return torch.where(enough, mode.exp(), 1)[..., None].to(images.dtype)


def noise_line(frames: Float[Tensor, "frames 3 height width"]) -> Float[Tensor, "2"]:
    """Variance of the noise as a + b intensity (the sensor's and the photons' share), of one still scene.

    Measured on the differences of successive frames, the greatest 30 % left out. A single frame is judged by
    its second differences along the rows, in the calmest fifth of blocks of 8 x 8 pixels.
    """
    if len(frames) > 1:
        frames = frames[..., ::2, ::2]
        level = temporal_median(frames).expand_as(frames[1:]).flatten()
        square = (0.5 * (frames[1:] - frames[:-1]).square()).flatten()
        share, correction = TRIM, TRIMMED_VARIANCE
    else:
        second = (frames[..., 2:] - 2 * frames[..., 1:-1] + frames[..., :-2]).square() / 6
        block = min(8, *second.shape[-2:])
        level = F.avg_pool2d(frames[..., 1:-1], block).flatten()
        square = F.avg_pool2d(second, block).flatten()
        share, correction = 0.2, 1.0
    shown = square.isfinite() & level.isfinite()
    square, level = square[shown], level[shown]
    bins = (level * NOISE_BINS).long().clamp(0, NOISE_BINS - 1)
    rows = []
    for index in range(NOISE_BINS):
        chosen = square[bins == index]
        if len(chosen) >= 10:  # fewer pixels say nothing
            kept = chosen.sort().values[: math.ceil(share * len(chosen))]
            middle = level[bins == index].mean()
            rows.append(torch.stack([middle, kept.mean() / correction, kept.new_tensor(len(kept))]))
    if not rows:
        return square.new_zeros(2)
    middle, variance, weight = torch.stack(rows).unbind(1)
    variance = torch.minimum(variance, 4 * variance.median())  # a screen that flickers fills a bin of its own
    weight = weight / weight.sum()
    center = (weight * middle).sum()
    # The tiny pull keeps the slope at 0 in a scene of one intensity.
    slope = (weight * (middle - center) * variance).sum() / (
        (weight * (middle - center).square()).sum() + 1e-4
    )
    return torch.stack([(weight * variance).sum() - slope * center, slope])


def temporal_median(frames: Float[Tensor, "frames 3 height width"]) -> Float[Tensor, "3 height width"]:
    """Median over the frames that are not NaN, the mean of the middle two where their number is even.

    NaN where all are.
    """
    ordered = frames.sort(0).values  # NaN last
    if not ordered[-1].isnan().any():
        return 0.5 * (ordered[(len(frames) - 1) // 2] + ordered[len(frames) // 2])
    count = frames.isfinite().sum(0, keepdim=True)
    middle = [ordered.gather(0, index)[0] for index in ((count - 1).clamp_min(0) // 2, count // 2)]
    return torch.where(count[0] > 0, 0.5 * (middle[0] + middle[1]), torch.nan)


def gradient_squared(image: Float[Tensor, "3 height width"]) -> Float[Tensor, "3 height width"]:
    """Square of the slope (per px) of each channel, by central differences."""
    padded = F.pad(image[None], (1, 1, 1, 1), mode="replicate")[0]
    across = padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2]
    down = padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1]
    return 0.25 * (across.square() + down.square())
