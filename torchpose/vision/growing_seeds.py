"""Disparity of a rectified pair by Growing Correspondence Seeds, as a wave front of tensors.

Cech and Sara, "Efficient sampling of disparity space for fast and accurate matching", BenCOS 2007.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from kornia.feature import harris_response
from torch import Tensor
from torch.nn import functional as F

from torchpose.vision.disparity import Disparity, MatchingTask, StereoMatcher, smooth, without_islands
from torchpose.vision.disparity_space import DisparitySpace, crop_beyond, similarities

HARRIS_REACH = 6  # px that a Harris maximum sees: gradient, blur and the comparison with its neighbours


@dataclass(frozen=True)
class GrowingSeedsConfig:
    """What is searched, and what counts as certain; tau, mu and beta are the paper's.

    The paper's method is `windows=(5,), min_island=0, fill=False, smoothing=0`. The rest is for people: a
    second window steadies cloth of little texture, and filling brings back bare arms, which no window matches
    for sure.
    """

    windows: tuple[int, ...] = (5, 9)  # px, odd sides; the similarity is the mean over them
    noise: float = 0.3 / 255  # standard deviation of a grey value; rounding to 8 bits makes 0.29 / 255
    seed_similarity: float = 0.9  # least similarity of a seed
    weakest_corners: float = 0.1  # share of the Harris points that is dropped
    seed_shift: int = 2  # px by which a given disparity may have changed
    tau: float = 0.6  # least similarity of a cell
    mu: float = 0.1  # a cell this much worse than the best at its pixels still grows
    max_waves: int = 500  # a wave grows by a pixel or two
    max_candidates: int = 10  # cells that one left pixel can carry
    beta: float = 0.1  # a match is better than its rivals by this much
    tolerance: int = 1  # px, cells of one pixel that are this close are no rivals; 0 is one-to-one
    matching_rounds: int = 5
    min_island: int = 100  # px, least area of matches that hang together
    fill: bool = True  # extend the matches into the mask's holes
    fill_levels: tuple[float, ...] = (0.95, 0.75, 0.55)  # least similarity, falling: best first
    fill_smoothness: float = 0.3  # similarity that a px away from the neighbours' mean must gain
    smoothing: int = 2  # px, radius of the last mean over neighbours within 1 px of disparity

    def __post_init__(self) -> None:
        if not self.windows or any(side < 3 or side % 2 == 0 for side in self.windows):
            raise ValueError(
                f"windows must be odd sides of at least 3 px, got {self.windows}; the paper has 5"
            )
        if self.noise <= 0:
            raise ValueError(f"noise must be positive, got {self.noise}; rounding to 8 bits makes 0.001")
        for name in ("tau", "seed_similarity"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(
                    f"{name} must lie between 0 and 1, got {getattr(self, name)}; it is a similarity"
                )
        if any(not 0 < level < 1 for level in self.fill_levels):
            raise ValueError(
                f"fill_levels must lie between 0 and 1, got {self.fill_levels}; they are similarities"
            )
        if not 0 <= self.weakest_corners < 1:
            raise ValueError(f"weakest_corners must be in [0, 1), got {self.weakest_corners}; it is a share")
        for name in ("mu", "beta", "tolerance", "seed_shift", "min_island", "fill_smoothness", "smoothing"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}; 0 turns it off")
        for name in ("max_waves", "max_candidates", "matching_rounds"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")


class GrowingSeeds(StereoMatcher):
    """Stereo matching that says what it knows, at a cost that goes with the region asked for.

    1. Similarity: modified normalised cross-correlation of the grey images.
    2. Seeds: Harris points with a good match on their row, or the caller's, such as the last frame's
       disparities.
    3. Growth, in waves: each new cell offers the best neighbour of each of four sets; one that is similar
       enough, and not much worse than the best at its two pixels, is a new cell. So depth goes on from where
       it is known.
    4. Strictly confident matching: a cell wins if it beats all rivals at its left and its right pixel by a
       margin.
    5. Sub-pixel: the peak of the parabola through the similarities of three disparities.
    6. Islands of matches too small to trust go, holes are filled from their rims, and what is left is
       smoothed.

    Steps 1 to 5 are the paper's, the sixth is ours. The confidence is the similarity, halved if filled in. The
    memory is 8 bytes a cell over the masks' bounding box: 250 MB for 640 x 480 with 97 disparities.
    """

    def __init__(self, config: GrowingSeedsConfig = GrowingSeedsConfig()) -> None:
        super().__init__()
        self.config = config

    def match(self, task: MatchingTask) -> Disparity:
        config, answer = self.config, task.unanswered()
        space = DisparitySpace.around(task.mask, task.least, task.greatest)
        mask = space.crop(task.mask)
        # The correlation is blind to a constant, and sums of squares lose less precision without one.
        middle = task.left.mean(dim=(1, 2), keepdim=True)
        left, right = task.left - middle, task.right - middle
        volume = similarities(left, right, mask, space, tuple(config.windows), config.noise)
        if task.seeds is None:
            cells = corner_seeds(volume, left, mask, space, config)
        else:
            cells = given_seeds(volume, space.crop(task.seeds), mask, space, config)
        layers, similarity = confident_matches(volume, grow(volume, cells, space, config), space, config)
        found = without_islands(space.unpad(layers), config.min_island)
        if config.fill:
            layers, similarity = fill(volume, space.pad(found, torch.nan), similarity, mask, space, config)
            found = space.unpad(layers)
        found = smooth(found, config.smoothing)
        space.crop(answer.values).copy_(found + (space.least - 1))
        space.crop(answer.confidence).copy_(space.unpad(similarity).clamp(0, 1).where(~found.isnan(), 0))
        return answer


def corner_seeds(
    volume: Float[Tensor, " cells"],
    grey: Float[Tensor, "batch height width"],
    mask: Bool[Tensor, "batch h w"],
    space: DisparitySpace,
    config: GrowingSeedsConfig,
) -> Int[Tensor, " seeds"]:
    """Cells of the Harris points inside the mask with the best similarity of their row, if that is good."""
    reach = HARRIS_REACH
    height, width = space.height + 2 * reach, space.width + 2 * reach
    response = harris_response(
        crop_beyond(grey, space.top - reach, space.left - reach, height, width)[:, None]
    )
    peak = (response == F.max_pool2d(response, 3, stride=1, padding=1)) & (response > 0)
    response, peak = (x[:, 0, reach:-reach, reach:-reach] for x in (response, peak))
    point = (peak & mask).flatten().nonzero()[:, 0]
    # Rank the points of each item by strength: sort by strength, then stably by item.
    point = point[response.flatten()[point].argsort(stable=True)]
    item = point // (space.height * space.width)
    order = item.argsort(stable=True)
    point, item = point[order], item[order]
    count = item.bincount(minlength=space.batch)
    rank = torch.arange(len(point), device=point.device) - (count.cumsum(0) - count)[item]
    point = point[rank >= (config.weakest_corners * count).floor()[item]]

    return similar_cells(volume, space.pixel(point), space, config)


def given_seeds(
    volume: Float[Tensor, " cells"],
    seeds: Float[Tensor, "batch h w"],
    mask: Bool[Tensor, "batch h w"],
    space: DisparitySpace,
    config: GrowingSeedsConfig,
) -> Int[Tensor, " seeds"]:
    """Cells near known disparities (px), and cells of other pixels that are similar enough to be seeds.

    What was known moves: the most similar layer within `seed_shift` counts. For whatever no seed speaks, such as an
    arm that was elsewhere, every fourth pixel takes the part of a Harris point.
    """
    layer = (seeds - (space.least - 1)).round()
    known = (mask & (layer >= 1) & (layer <= space.disparities)).flatten().nonzero()[:, 0]
    reach = torch.arange(-config.seed_shift, config.seed_shift + 1, device=known.device)[:, None]
    about = (layer.flatten().index_select(0, known).long() + reach).clamp(1, space.disparities)
    ground = space.pixel(known)
    near = space.cell(ground, torch.zeros_like(ground)) + about * space.columns  # (shifts, seeds)
    best, shift = volume.index_select(0, near.flatten()).view(near.shape).max(dim=0, keepdim=True)
    good = (best[0] >= config.tau).nonzero()[:, 0]
    cells = near.gather(0, shift)[0].index_select(0, good)

    silent = mask.flatten().index_fill(0, known.index_select(0, good), False).view(mask.shape)
    lattice = torch.zeros_like(mask)
    lattice[:, space.top % 2 :: 2, space.left % 2 :: 2] = True
    others = space.pixel((silent & lattice).flatten().nonzero()[:, 0])
    return torch.cat([cells, similar_cells(volume, others, space, config)])


def similar_cells(
    volume: Float[Tensor, " cells"],
    pixel: Int[Tensor, " pixels"],
    space: DisparitySpace,
    config: GrowingSeedsConfig,
) -> Int[Tensor, " seeds"]:
    """The most similar cell of each pixel, where that is similar enough for a seed."""
    bottom = space.cell(pixel, torch.ones_like(pixel))
    along = bottom + torch.arange(space.disparities, device=bottom.device)[:, None] * space.columns
    best, layer = volume.index_select(0, along.flatten()).view(along.shape).max(dim=0)
    good = best >= config.seed_similarity
    return bottom[good] + layer[good] * space.columns


def grow(
    volume: Float[Tensor, " cells"],
    seeds: Int[Tensor, " seeds"],
    space: DisparitySpace,
    config: GrowingSeedsConfig,
) -> Int[Tensor, " grown"]:
    """All cells that growth from the seeds accepts, wave after wave."""
    steps = space.steps(volume.device)
    best_left = volume.new_full((space.left_pixels,), -1)
    best_right = volume.new_full((space.right_pixels,), -1)
    carried = torch.zeros_like(best_left, dtype=torch.int32)
    # The number under which a cell was proposed, -1 if it never was. Where several parents propose one cell
    # in a wave, the last to write its number has it.
    number = torch.full_like(volume, -1, dtype=torch.int32)
    pixel = space.left_pixel(seeds)
    front = torch.stack([seeds, pixel, space.right_pixel(pixel, space.layer(seeds))])  # cell, left, right
    similarity = volume[seeds]
    grown = [seeds[:0]]
    proposed = 0
    for wave in range(config.max_waves):
        new = ((similarity >= config.tau) & (number.index_select(0, front[0]) < 0)).nonzero()[:, 0]
        if len(new) == 0:
            break
        front, similarity = front.index_select(1, new), similarity.index_select(0, new)
        cell, left, right = front
        own = torch.arange(proposed, proposed + len(new), dtype=torch.int32, device=volume.device)
        proposed += len(new)
        number.scatter_(0, cell, own)
        best_left.scatter_reduce_(0, left, similarity, "amax")
        best_right.scatter_reduce_(0, right, similarity, "amax")
        bar = torch.minimum(best_left.index_select(0, left), best_right.index_select(0, right)) - config.mu
        sole = number.index_select(0, cell) == own
        room = carried.index_select(0, left) < config.max_candidates
        front = front.index_select(1, (sole & room & (similarity >= bar)).nonzero()[:, 0])
        cell, left, _ = front
        carried.index_add_(0, left, torch.ones_like(left, dtype=torch.int32))
        grown.append(cell)
        if wave == 0:  # a seed among seeds has nothing to propose, and a last frame's are mostly so
            beside = torch.tensor([[-1], [1], [-space.columns], [space.columns]], device=cell.device)
            alone = carried.index_select(0, (left + beside).flatten()).view(4, -1) == 0
            front = front.index_select(1, alone.any(0).nonzero()[:, 0])
            cell = front[0]
        around = volume.index_select(0, (cell + steps[0].reshape(-1, 1)).flatten())
        around = around.view(steps.shape[1], steps.shape[2], len(cell))
        similarity, member = around.max(dim=1)  # (sets, cells)
        step = steps.gather(2, member.expand(3, -1, -1))
        front, similarity = (front[:, None] + step).flatten(1), similarity.flatten()
    return torch.cat(grown)


def confident_matches(
    volume: Float[Tensor, " cells"],
    grown: Int[Tensor, " grown"],
    space: DisparitySpace,
    config: GrowingSeedsConfig,
) -> tuple[Float[Tensor, " pixels"], Float[Tensor, " pixels"]]:
    """Strictly confident matching: maps of the sub-pixel layer, NaN where none, and of the similarity."""
    layers = volume.new_full((space.left_pixels,), torch.nan)
    similarity = torch.zeros_like(layers)
    left, layer, value = space.left_pixel(grown), space.layer(grown), volume.index_select(0, grown)
    right = space.right_pixel(left, layer)
    for _ in range(config.matching_rounds):
        rival = torch.maximum(
            best_rival(left, layer, value, space.left_pixels, config.tolerance),
            best_rival(right, layer, value, space.right_pixels, config.tolerance),
        )
        won = (value >= rival + config.beta).nonzero()[:, 0]
        if len(won) == 0:
            break
        # Close cells of one left pixel can win together: the best of them counts.
        place, most = left.index_select(0, won), value.index_select(0, won)
        best = torch.zeros_like(similarity).scatter_reduce_(0, place, most, "amax")
        sole = (most == best.index_select(0, place)).nonzero()[:, 0]
        won, place, most = won.index_select(0, sole), place.index_select(0, sole), most.index_select(0, sole)
        similarity.scatter_(0, place, most)
        level = layer.index_select(0, won)
        layers.scatter_(0, place, _sub_pixel(volume, space.cell(place, level), level, space))
        # Whatever shares a winner's left pixel goes, and what competes with it at its right pixel.
        winner = torch.full((space.right_pixels,), -1, device=layer.device)
        winner.scatter_(0, right.index_select(0, won), level)
        holder = winner.index_select(0, right)
        free = (holder < 0) | ((holder - layer).abs() <= config.tolerance)
        rest = (layers.index_select(0, left).isnan() & free).nonzero()[:, 0]
        left, right, layer, value = (x.index_select(0, rest) for x in (left, right, layer, value))
    return layers, similarity


def best_rival(
    pixel: Int[Tensor, " n"],
    layer: Int[Tensor, " n"],
    value: Float[Tensor, " n"],
    pixels: int,
    tolerance: int,
) -> Float[Tensor, " n"]:
    """For each cell, the best similarity at its pixel more than `tolerance` layers away, -1 if there is none.

    Two numbers a pixel will do: the best, and the best that is far from it, which stands for the rivals of
    all cells near the best.
    """
    first = value.new_full((pixels,), -1).scatter_reduce_(0, pixel, value, "amax")
    highest = first.index_select(0, pixel)
    leads = (value == highest).nonzero()[:, 0]
    leader = torch.zeros_like(first, dtype=layer.dtype)
    leader.scatter_(0, pixel.index_select(0, leads), layer.index_select(0, leads))
    far = (layer - leader.index_select(0, pixel)).abs() > tolerance
    away = far.nonzero()[:, 0]
    second = torch.full_like(first, -1)
    second.scatter_reduce_(0, pixel.index_select(0, away), value.index_select(0, away), "amax")
    return torch.where(far, highest, second.index_select(0, pixel))


def _sub_pixel(
    volume: Float[Tensor, " cells"], cell: Int[Tensor, " n"], layer: Int[Tensor, " n"], space: DisparitySpace
) -> Float[Tensor, " n"]:
    """The layer where the parabola through three similarities peaks, at most half a layer away."""
    below, here, above = (volume.index_select(0, cell + step) for step in (-space.columns, 0, space.columns))
    curvature = 2 * here - below - above
    shift = 0.5 * (above - below) / curvature.clamp(min=torch.finfo(volume.dtype).tiny)
    measured = (layer > 1) & (layer < space.disparities) & (curvature > 0)  # the padding is no measurement
    return layer + shift.clamp(-0.5, 0.5).where(measured, 0)


def fill(
    volume: Float[Tensor, " cells"],
    layers: Float[Tensor, " pixels"],
    similarity: Float[Tensor, " pixels"],
    mask: Bool[Tensor, "batch h w"],
    space: DisparitySpace,
    config: GrowingSeedsConfig,
) -> tuple[Float[Tensor, " pixels"], Float[Tensor, " pixels"]]:
    """Extend matches into the rest of the mask, inwards from the rims and the most similar first.

    A hole's pixel beside two or more matches takes one of the three layers about their mean: the most
    similar, less a penalty for leaving the mean, unless its right pixel is another's. It need not be unique:
    this is for limbs whose texture fades or repeats along the row, where the rim tells what the window
    cannot.
    """
    layers, similarity = layers.clone(), similarity.where(~layers.isnan(), 0)
    across = space.columns
    sides = [-1, 1, -across, across, -across - 1, -across + 1, across - 1, across + 1]
    side = torch.tensor(sides, device=layers.device)[:, None]
    about = torch.arange(-1, 2, device=layers.device)[:, None]
    taken = torch.full((space.right_pixels,), -1, device=layers.device)
    matched = (~layers.isnan()).nonzero()[:, 0]
    owner = layers.index_select(0, matched).round().long()
    taken.scatter_(0, space.right_pixel(matched, owner), owner)
    hole = space.pad(mask, False) & layers.isnan()
    number = torch.zeros_like(hole, dtype=torch.int32)
    filled = [matched.new_empty(2, 0)]
    for least in config.fill_levels:
        rim = hole.nonzero()[:, 0]
        while len(rim):
            beside = layers.index_select(0, (rim + side).flatten()).view(len(sides), -1)
            support = len(sides) - beside.isnan().sum(0)
            held = (support >= 2).nonzero()[:, 0]
            mean = (beside.nansum(0) / support).index_select(0, held)
            rim = rim.index_select(0, held)
            near = (mean.round().long() + about).clamp(1, space.disparities)  # (3, rim)
            value = volume.index_select(0, space.cell(rim.expand(3, -1), near).flatten()).view(3, -1)
            choice = (value - config.fill_smoothness * (near - mean).abs()).argmax(0, keepdim=True)
            value, layer = value.gather(0, choice)[0], near.gather(0, choice)[0]
            other = taken.index_select(0, space.right_pixel(rim, layer))
            free = (other < 0) | ((other - layer).abs() <= config.tolerance)
            accepted = (free & (value >= least)).nonzero()[:, 0]
            pixel, layer, value, mean = (x.index_select(0, accepted) for x in (rim, layer, value, mean))
            layers.scatter_(0, pixel, torch.maximum(torch.minimum(mean, layer + 0.5), layer - 0.5))
            filled.append(torch.stack([pixel, layer]))
            similarity.scatter_(0, pixel, 0.5 * value)
            hole.index_fill_(0, pixel, False)
            rim = (pixel + side).flatten()
            rim = rim.index_select(0, hole.index_select(0, rim).nonzero()[:, 0])
            # Each once: of its copies, the one whose number is left in the map.
            order = torch.arange(len(rim), dtype=torch.int32, device=rim.device)
            number.scatter_(0, rim, order)
            rim = rim.index_select(0, (number.index_select(0, rim) == order).nonzero()[:, 0])
    # What peaks at its layer was measured there, the rest keeps to its neighbours.
    pixel, layer = torch.cat(filled, dim=1)
    cell = space.cell(pixel, layer)
    below, here, above = (volume.index_select(0, cell + step) for step in (-across, 0, across))
    peak = (here >= torch.maximum(below, above)).nonzero()[:, 0]
    pixel, layer, cell = (x.index_select(0, peak) for x in (pixel, layer, cell))
    layers.scatter_(0, pixel, _sub_pixel(volume, cell, layer, space))
    return layers, similarity
