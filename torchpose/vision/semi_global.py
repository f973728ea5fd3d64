"""Disparity of a rectified pair by semi-global matching of census transforms, in bytes.

Hirschmuller, "Stereo processing by semiglobal matching and mutual information", PAMI 2008, with the Hamming distance
of census transforms (Zabih and Woodfill, ECCV 1994) for the matching cost.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from torchpose.vision.disparity import (
    Disparity,
    Grey,
    MatchingTask,
    StereoMatcher,
    bounding_box,
    smooth,
    without_islands,
)
from torchpose.vision.disparity_space import crop_beyond

PATHS = 4  # from the left, the right, above and below
HIGHEST = 255 // PATHS  # a path's greatest cost, for the sum of all to fit into a byte
LAYER_BITS = 7  # of the 15 bits that hold a summed cost and its layer
MOST_LAYERS = 2**LAYER_BITS
WORD = 8  # bytes, pixels that are counted at a time

Census = UInt8[Tensor, "bytes batch h w"]
Volume = UInt8[Tensor, "h batch layers w"]  # the rows first: a path's step is one piece of memory


@dataclass(frozen=True)
class SemiGlobalConfig:
    """What smoothness costs, in bits of the census, and which matches are kept."""

    radius: tuple[int, int] = (2, 2)  # px, half the height and width of the census window
    noise: float = 1 / 255  # a neighbour is brighter by more than that: lest noise should match on flat cloth
    small_step: int = 12  # P1, of a disparity 1 px off the path's last
    large_step: int = 39  # P2, of one farther off, within a surface
    least_step: int = 16  # P2 at the strongest edges of the image, where surfaces end
    edge: float = 0.1  # grey difference between a path's pixels that halves P2
    consistency: int = 1  # px by which the right image's own disparity may differ
    min_island: int = 100  # px, least area of matches that hang together
    smoothing: int = 2  # px, radius of the last mean over neighbours within 1 px of disparity

    def __post_init__(self) -> None:
        if min(self.radius) < 0 or not 1 <= self.bits <= HIGHEST:
            raise ValueError(
                f"radius must make windows of 2 to {HIGHEST + 1} px, got {self.radius}; (2, 2) is 5 x 5"
            )
        if not 0 <= self.small_step <= self.least_step <= self.large_step:
            steps = f"{self.small_step}, {self.least_step} and {self.large_step}"
            raise ValueError(f"0 <= small_step <= least_step <= large_step must hold, got {steps}")
        if self.bits + self.large_step > HIGHEST:
            raise ValueError(
                f"large_step must be at most {HIGHEST - self.bits} beside {self.bits} bits of census, for the sum of "
                f"{PATHS} paths to fit into a byte, got {self.large_step}"
            )
        if self.noise < 0:
            raise ValueError(f"noise must not be negative, got {self.noise}; 1 / 255 is a level of 8 bits")
        if not self.edge > 0:
            raise ValueError(f"edge must be positive, got {self.edge}; .inf makes P2 the same everywhere")
        for name in ("consistency", "min_island", "smoothing"):
            if getattr(self, name) < 0:
                raise ValueError(
                    f"{name} must not be negative, got {getattr(self, name)}; 0 is the strictest"
                )

    @property
    def bits(self) -> int:
        """Neighbours that a census compares with its centre, so the greatest matching cost."""
        return (2 * self.radius[0] + 1) * (2 * self.radius[1] + 1) - 1


class SemiGlobal(StereoMatcher):
    """Dense stereo matching at a cost that depends on the region's size and range alone.

    1. Cost: in how many bits the census transforms of the two pixels differ.
    2. Aggregation along four paths, of which each favours what its last pixel had: the cost of a disparity is
       its own, plus the least of going on with it, with a neighbour for P1 and with any for P2, which is less
       where the image has an edge.
    3. The disparity of the least sum, if the right image's own choice agrees; what lies beyond the right image
       has none.
    4. Sub-pixel: the peak of the two lines of equal slope through the sums of three disparities.
    5. Islands of matches too small to trust go, and what is left is smoothed.

    All sums fit into bytes, of which a processor adds 32 at a time. Pixels off the mask cost nothing at any
    disparity, so what lies there has no influence. The confidence is the margin to the best disparity more
    than 1 px away, as a share of its sum (and of one census, lest sums near 0 should count). Seeds do not help
    this method: narrow the range instead. The memory is 4 bytes a cell over the masks' bounding box: 80 MB for
    640 x 480 with 64 disparities.
    """

    def __init__(self, config: SemiGlobalConfig = SemiGlobalConfig()) -> None:
        super().__init__()
        self.config = config

    def match(self, task: MatchingTask) -> Disparity:
        """As `StereoMatcher.match`. Raises ValueError for more disparities than a byte's sum can number."""
        if task.greatest - task.least + 1 > MOST_LAYERS:
            raise ValueError(
                f"semi-global matching takes at most {MOST_LAYERS} disparities, got {task.least} to "
                f"{task.greatest} px; raise the nearest depth or shrink the images"
            )
        answer, (rows, columns) = task.unanswered(), bounding_box(task.mask)
        region = task.mask[:, rows, columns]
        cost = matching_cost(task, rows, columns, self.config)
        total = aggregate(cost, task.left[:, rows, columns].where(region, 0), self.config)
        # A right pixel lies in the image if its column does: column >= layer + least, and the same at the other end.
        before = columns.start - task.least
        found, margin = winners(total, region, (before, task.right.shape[2] - 1 - before), self.config)
        found = smooth(without_islands(found, self.config.min_island), self.config.smoothing)
        answer.values[:, rows, columns] = found + task.least
        answer.confidence[:, rows, columns] = margin.where(~found.isnan(), 0).to(answer.confidence)
        return answer


def matching_cost(task: MatchingTask, rows: slice, columns: slice, config: SemiGlobalConfig) -> Volume:
    """Bits in which the census transforms of a region differ: all beyond the right image, none off the mask."""
    region = task.mask[:, rows, columns]
    count, height, width = region.shape
    up, across = config.radius
    wide = -(-width // WORD) * WORD
    top, first = rows.start, columns.start
    high, beyond = height + 2 * up, wide + 2 * across
    ours = census(crop_beyond(task.left, top - up, first - across, high, beyond), config)
    # The right image from the column that the greatest disparity sees.
    layers = task.greatest - task.least + 1
    start = first - task.greatest
    theirs = census(crop_beyond(task.right, top - up, start - across, high, beyond + layers - 1), config)
    differ, spare = torch.empty_like(ours), torch.empty_like(ours)
    counted = region.to(torch.uint8)
    cost = counted.new_empty(height, count, layers, width)
    for layer in range(layers):
        shift = layers - 1 - layer
        torch.bitwise_xor(ours, theirs[..., shift : shift + wide], out=differ)
        count_bits(differ, spare)
        plane = differ.sum(0, dtype=torch.uint8)[..., :width]
        seen = start + shift  # column of the right image that the region's first sees
        plane[..., : max(0, -seen)] = config.bits
        plane[..., max(0, task.right.shape[2] - seen) :] = config.bits
        torch.mul(plane, counted, out=cost[:, :, layer].transpose(0, 1))
    return cost


def census(grey: Grey, config: SemiGlobalConfig) -> Census:
    """Which neighbours in the window are brighter than its centre, eight to a byte, for the windows inside an image."""
    up, across = config.radius
    height, width = grey.shape[1] - 2 * up, grey.shape[2] - 2 * across
    bar = grey[:, up : up + height, across : across + width] + config.noise
    offsets = [(y, x) for y in range(2 * up + 1) for x in range(2 * across + 1) if (y, x) != (up, across)]
    planes = torch.zeros(-(-len(offsets) // 8), *bar.shape, dtype=torch.uint8, device=grey.device)
    for index, (y, x) in enumerate(offsets):
        brighter = grey[:, y : y + height, x : x + width] > bar
        planes[index // 8] |= brighter.view(torch.uint8) << index % 8
    return planes


def count_bits(planes: UInt8[Tensor, "*shape width"], spare: UInt8[Tensor, "*shape width"]) -> None:
    """Replace each byte by the number of its ones; `spare` is scratch, and the width whole words.

    Sums of neighbouring bits, of pairs, of nibbles (Warren, "Hacker's Delight", 5-1), eight bytes at a time.
    """
    number, half = planes.view(torch.int64), spare.view(torch.int64)
    torch.bitwise_right_shift(number, 1, out=half)
    number -= half.bitwise_and_(0x5555555555555555)
    torch.bitwise_right_shift(number, 2, out=half)
    number &= 0x3333333333333333
    number += half.bitwise_and_(0x3333333333333333)
    torch.bitwise_right_shift(number, 4, out=half)
    number += half
    number &= 0x0F0F0F0F0F0F0F0F


def aggregate(cost: Volume, grey: Float[Tensor, "batch height width"], config: SemiGlobalConfig) -> Volume:
    """Sum over the four paths of Hirschmuller's L (his (13), less the least of the last pixel). Overwrites `cost`."""
    height, count, layers, width = cost.shape
    down, across = (large_steps(grey, dim, config) for dim in (1, 2))
    # Turned as a matrix, which is four times faster than any other permutation of bytes.
    turned = cost.view(height, -1).t().contiguous().view(count, layers, width, height)
    total, sideways = torch.empty_like(cost), torch.empty_like(turned)
    sum_paths(cost.unbind(0), down.unbind(1), config.small_step, total.unbind(0))
    sum_paths(turned.unbind(2), across.unbind(2), config.small_step, sideways.unbind(2))
    cost.view(height, -1).copy_(sideways.view(-1, height).t())  # the costs themselves have had their day
    return total.add_(cost)


def large_steps(
    grey: Float[Tensor, "batch height width"], dim: int, config: SemiGlobalConfig
) -> UInt8[Tensor, "batch h w"]:
    """P2 between each pixel and the next along `dim`: large / (1 + difference / edge), at least the least."""
    difference = grey.diff(dim=dim).abs()
    step = config.large_step / (1 + difference / config.edge)
    return step.clamp_min(config.least_step).round().to(torch.uint8)


def sum_paths(
    costs: Sequence[UInt8[Tensor, "batch layers width"]],
    large_steps: Sequence[UInt8[Tensor, "batch width"]],
    small_step: int,
    totals: Sequence[UInt8[Tensor, "batch layers width"]],
) -> None:
    """Costs of the paths through a sequence of lines of pixels, the sum of both ways, in `totals`.

    L(p, d) = C(p, d) + min(L(q, d), L(q, d - 1) + P1, L(q, d + 1) + P1, P2), where q is the path's last pixel and
    its L counts from its least.
    """
    count, layers, width = costs[0].shape
    limits = [step[:, None] for step in large_steps]
    least, near = costs[0].new_empty(count, 1, width), costs[0].new_empty(count, layers, width)
    # The layers beside the first and the last are never the best.
    beside = near.new_full((count, layers + 2, width), 255)
    middle, below, above = beside[:, 1:-1], beside[:, :-2], beside[:, 2:]
    for total in totals:
        total.zero_()
    for order in (range(len(costs)), range(len(costs) - 1, -1, -1)):
        path = costs[order[0]].clone()
        totals[order[0]].add_(path)
        for last, here in pairwise(order):
            torch.amin(path, 1, keepdim=True, out=least)
            path -= least
            torch.add(path, small_step, out=middle)
            torch.minimum(path, limits[min(last, here)], out=path)
            torch.minimum(below, above, out=near)
            torch.minimum(path, near, out=path)
            path += costs[here]
            totals[here].add_(path)


def winners(
    total: Volume, region: Bool[Tensor, "batch h w"], reach: tuple[int, int], config: SemiGlobalConfig
) -> tuple[Float[Tensor, "batch h w"], Float[Tensor, "batch h w"]]:
    """The layer of the least sum, to a fraction, NaN where the right image disagrees; and its margin, 0 to 1.

    `reach`: a pixel's match lies in the right image if -reach[0] <= column - layer <= reach[1], columns of the region.
    Overwrites `total`.
    """
    height, count, layers, width = total.shape
    region = region.transpose(0, 1)
    highest = torch.iinfo(torch.int16).max
    # A cost and its layer in one number: the least number has the least cost.
    best = torch.full((height, count, width), highest, dtype=torch.int16, device=total.device)
    right_best = best.new_full((height, count, width + layers - 1), highest)
    elsewhere = (~region).to(torch.int16) * (highest - MOST_LAYERS + 1)
    packed = torch.empty_like(best)
    for index in range(layers):
        packed.copy_(total[:, :, index])
        packed <<= LAYER_BITS
        packed |= elsewhere
        packed += index
        torch.minimum(best, packed, out=best)
        seen = right_best[..., layers - 1 - index : layers - 1 - index + width]
        torch.minimum(seen, packed, out=seen)
    layer = (best & (MOST_LAYERS - 1)).long()
    match = torch.arange(width, device=total.device) - layer
    other = right_best.gather(2, match + layers - 1) & (MOST_LAYERS - 1)
    agreed = (
        region & (match >= -reach[0]) & (match <= reach[1]) & ((other - layer).abs() <= config.consistency)
    )

    sides = (layer[:, :, None] + torch.tensor([-1, 0, 1], device=total.device)[:, None]).clamp(0, layers - 1)
    below, here, above = total.gather(2, sides).to(torch.float32).unbind(2)
    total.scatter_(2, sides, 255)
    second = total.amin(2).to(torch.float32)
    shift = 0.5 * (below - above) / (torch.maximum(below, above) - here).clamp_min(1)
    inner = (layer > 0) & (layer < layers - 1)  # at either end of the range a side is missing
    found = torch.where(agreed, layer + shift.where(inner, 0), torch.nan)
    margin = (second - here) / (second + config.bits)
    return found.transpose(0, 1), margin.clamp_min(0).transpose(0, 1)
