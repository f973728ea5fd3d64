"""Disparity of a rectified pair by semi-global matching of census transforms, in bytes.

Hirschmuller, "Stereo processing by semiglobal matching and mutual information", PAMI 2008; the costs are Hamming
distances of centre-symmetric census transforms (Spangenberg, Langner and Rojas, "Weighted semi-global matching
and center-symmetric census transform for robust driver assistance", CAIP 2013).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int16, UInt8
from torch import Tensor
from torch.nn import functional as F

from torchpose.vision.disparity import Disparity, Grey, StereoMatcher

PATHS = 4  # from above, below, left and right
HIGHEST = 255 // PATHS  # of one path's cost, for the sum over the paths to fit into a byte
RANK_BITS = 7  # of a disparity in the 15 bits that hold a summed cost and its disparity


@dataclass(frozen=True)
class SemiGlobalConfig:
    """What smoothness costs, in bits of the census, and which matches are kept."""

    radius: tuple[int, int] = (3, 3)  # px, half the census window's height and width
    small_step: int = 6  # P1, for a disparity that differs by 1 px from the path's last pixel
    large_step: int = 36  # P2, for one that differs by more
    least_step: int = 16  # P2 across the strongest edges of the image
    edge: float = 0.1  # grey difference to the path's last pixel that halves P2
    consistency: float = 1.0  # px by which the left and the right image's disparity may differ; inf: any
    speckle: int = 100  # px, least area of matches that hang together
    fill: bool = False  # continue the farther side into what only the left camera sees

    def __post_init__(self) -> None:
        bits = self.bits
        if min(self.radius) < 1 or bits > 32:
            raise ValueError(f"radius must be at least 1 px and the window's pairs at most 32, got {self.radius}")
        if not 0 <= self.small_step <= self.least_step <= self.large_step:
            steps = f"{self.small_step}, {self.least_step} and {self.large_step}"
            raise ValueError(f"0 <= small_step <= least_step <= large_step must hold, got {steps}")
        if bits + self.large_step > HIGHEST:
            raise ValueError(
                f"large_step must be at most {HIGHEST - bits} with {bits} bits of census, got {self.large_step}; "
                "the sum over the paths must fit into a byte"
            )
        if not self.edge > 0:
            raise ValueError(f"edge must be positive, got {self.edge}; inf leaves P2 the same everywhere")
        if not self.consistency >= 0 or self.speckle < 0:
            raise ValueError(
                f"consistency and speckle must not be negative, got {self.consistency} and {self.speckle}"
            )

    @property
    def bits(self) -> int:
        """Pairs of pixels that a census compares."""
        return ((2 * self.radius[0] + 1) * (2 * self.radius[1] + 1) - 1) // 2


class SemiGlobal(StereoMatcher):
    """x"""

    def __init__(self, config: SemiGlobalConfig = SemiGlobalConfig()) -> None:
        super().__init__()
        self.config = config

    def match(self, left, right, mask, seeds, least, greatest):
        config = self.config
        values, confidence = torch.full_like(left, torch.nan), torch.zeros_like(left)
        rows, columns = (mask.any(2).any(0).nonzero()[:, 0], mask.any(1).any(0).nonzero()[:, 0])
        top, bottom = int(rows[0]), int(rows[-1]) + 1
        first, last = int(columns[0]), int(columns[-1]) + 1
        mask = mask[:, top:bottom, first:last]
        import time
        t0=time.process_time()
        cost = matching_cost(left, right, mask, (top, bottom), (first, last), (least, greatest), config)
        t1=time.process_time()
        total = aggregate(cost, left[:, top:bottom, first:last], config)
        t2=time.process_time()
        found, conf = winners(total, config)
        t3=time.process_time()
        print(f"cost {t1-t0:.3f} agg {t2-t1:.3f} win {t3-t2:.3f}") if PRINT else 0
        found = torch.where(mask, found + least, torch.nan)
        values[:, top:bottom, first:last] = found
        confidence[:, top:bottom, first:last] = torch.where(found.isnan(), 0, conf)
        return Disparity(values, confidence)
PRINT=False

def census(grey, radius) -> UInt8[Tensor, "batch bytes height width"]:
    """Bits of which pixel of each pair that lies opposite about the centre is brighter, in bytes."""
    v, u = radius
    height, width = grey.shape[1:]
    padded = F.pad(grey[:, None], (u, u, v, v), mode="replicate")[:, 0]
    offsets = [(y, x) for y in range(-v, 1) for x in range(-u, u + 1) if y < 0 or x < 0]
    planes = []
    for start in range(0, len(offsets), 8):
        byte = torch.zeros_like(grey, dtype=torch.uint8)
        for bit, (y, x) in enumerate(offsets[start : start + 8]):
            one = padded[:, v + y : v + y + height, u + x : u + x + width]
            other = padded[:, v - y : v - y + height, u - x : u - x + width]
            byte += (one > other).to(torch.uint8) << bit
        planes.append(byte)
    return torch.stack(planes, 1)


def matching_cost(left, right, mask, rows, columns, disparities, config) -> UInt8[Tensor, "height batch disparities width"]:
    """Hamming distance of the census transforms of a region; 0 off the mask, the most where the right image ends."""
    (top, bottom), (first, last), (least, greatest) = rows, columns, disparities
    v, u = config.radius
    height, width = bottom - top, last - first
    wide = -(-width // 8) * 8  # eight pixels at a time, as one number
    # Columns of the right image from first - greatest on
    low, high = max(0, top - v), min(left.shape[1], bottom + v)
    l = census(left[:, low:high], config.radius)[:, :, top - low : top - low + height, first:last]
    r = census(right[:, low:high], config.radius)[:, :, top - low : top - low + height]
    before = max(0, greatest - first)
    after = max(0, first + wide - least - right.shape[2])
    r = F.pad(r, (before, after))
    l = F.pad(l, (0, wide - width)).contiguous()
    B = l.shape[0]
    out = torch.empty(height, B, greatest - least + 1, width, dtype=torch.uint8, device=l.device)
    differ = torch.empty_like(l)
    words = differ.view(torch.int64)
    half = torch.empty_like(words)
    neutral = mask.to(torch.uint8)
    for index, disparity in enumerate(range(least, greatest + 1)):
        start = first - disparity + before
        torch.bitwise_xor(l, r[..., start : start + wide], out=differ)
        count_bits_(words, half)
        plane = differ[:, 0, :, :width]
        for byte in range(1, l.shape[1]):
            plane += differ[:, byte, :, :width]
        lost = disparity - first  # columns to the left of the right image
        if lost > 0:
            plane[..., :lost] = config.bits
        lost = first + width - disparity - right.shape[2]
        if lost > 0:
            plane[..., -lost:] = config.bits
        torch.mul(plane, neutral, out=plane)
        out[:, :, index] = plane.transpose(0, 1)
    return out


def count_bits_(words, half):
    """The number of ones in each byte, in place; `half` is a buffer of the same size."""
    torch.bitwise_right_shift(words, 1, out=half)
    half &= 0x5555555555555555
    words -= half
    torch.bitwise_right_shift(words, 2, out=half)
    half &= 0x3333333333333333
    words &= 0x3333333333333333
    words += half
    torch.bitwise_right_shift(words, 4, out=half)
    words += half
    words &= 0x0F0F0F0F0F0F0F0F


def aggregate(cost, grey, config):
    """Sum over the paths, (height, batch, disparities, width)"""
    total = torch.zeros_like(cost)
    limit = step_limits(grey, config)
    sweep(cost, limit[0].transpose(0, 1), total, config.small_step)
    across = cost.permute(3, 1, 2, 0).contiguous()
    total_across = torch.zeros_like(across)
    sweep(across, limit[1].permute(2, 0, 1), total_across, config.small_step)
    total += total_across.permute(3, 1, 2, 0)
    return total


def step_limits(grey, config):
    """P2 of the step into each pixel down and to the right"""
    out = []
    for dim in (1, 2):
        n = grey.shape[dim]
        step = (grey.narrow(dim, 1, n - 1) - grey.narrow(dim, 0, n - 1)).abs()
        p2 = (config.large_step / (1 + step / config.edge)).clamp_min(config.least_step).round().to(torch.uint8)
        out.append(p2)
    return out


def sweep(cost, limits, total, small):
    n, B, D, W = cost.shape
    for order in (range(n), range(n - 1, -1, -1)):
        order = list(order)
        path = cost.new_empty(B, D, W)
        least = cost.new_empty(B, 1, W)
        ring = cost.new_empty(B, D + 2, W)
        ring[:, 0] = ring[:, -1] = 255
        best = ring[:, 1:-1]
        near = cost.new_empty(B, D, W)
        costs, totals, lim = cost.unbind(0), total.unbind(0), [l[:, None] for l in limits.unbind(0)]
        below, above = ring[:, :-2], ring[:, 2:]
        previous = None
        for i in order:
            if previous is None:
                path.copy_(costs[i])
            else:
                torch.amin(path, 1, keepdim=True, out=least)
                path -= least
                torch.minimum(path, lim[min(i, previous)], out=path)
                torch.add(path, small, out=best)
                torch.minimum(below, above, out=near)
                torch.minimum(path, near, out=path)
                path += costs[i]
            totals[i].add_(path)
            previous = i


def winners(total, config):
    H, B, D, W = total.shape
    best = torch.full((H, B, W), torch.iinfo(torch.int16).max, dtype=torch.int16)
    best_right = torch.full((H, B, W + D - 1), torch.iinfo(torch.int16).max, dtype=torch.int16)
    packed = torch.empty_like(best)
    for d in range(D):
        packed.copy_(total[:, :, d])
        packed <<= RANK_BITS
        packed += d
        torch.minimum(best, packed, out=best)
        view = best_right[..., D - 1 - d : D - 1 - d + W]
        torch.minimum(view, packed, out=view)
    layer = (best & (2**RANK_BITS - 1)).long()
    column = torch.arange(W) + D - 1 - layer
    other = best_right.gather(2, column) & (2**RANK_BITS - 1)
    agree = (other - layer).abs() <= config.consistency
    at = layer[:, :, None]
    here = best >> RANK_BITS
    below = total.gather(2, (at - 1).clamp_min(0))[:, :, 0].to(torch.int16)
    above = total.gather(2, (at + 1).clamp_max(D - 1))[:, :, 0].to(torch.int16)
    inner = (layer > 0) & (layer < D - 1)
    bl, ab = (below - here).float(), (above - here).float()
    # parabola or equiangular
    if SUB == 'par':
        shift = 0.5 * (bl - ab) / (bl + ab).clamp_min(1)
    else:
        shift = 0.5 * (bl - ab) / torch.maximum(bl, ab).clamp_min(1)
    found = layer + torch.where(inner, shift, 0)
    found = torch.where(agree, found, torch.nan).transpose(0, 1)
    conf = torch.ones_like(found)
    found = without_speckles(found, config.speckle)
    return found, conf
SUB='equi'


def without_speckles(found, area):
    out = []
    for image in found:
        steps = (image.nan_to_num(-1) * 16).round().short().numpy()
        cv2.filterSpeckles(steps, -16, area, 16)
        out.append(torch.where(torch.from_numpy(steps < 0), torch.nan, image))
    return torch.stack(out)
