"""Disparity of a rectified pair by Growing Correspondence Seeds, as a wave front of tensors.

Cech and Sara, "Efficient sampling of disparity space for fast and accurate matching", BenCOS 2007.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from kornia.feature import harris_response
from torch import Tensor
from torch.nn import functional as F

from torchpose.vision.disparity import Disparity, Grey, StereoMatcher
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
    tau: float = 0.6  # least similarity of a cell
    mu: float = 0.1  # a cell this much worse than the best at its pixels still grows
    max_waves: int = 500  # a wave grows by a pixel or two
    max_candidates: int = 10  # cells that one left pixel can carry
    beta: float = 0.1  # a match is better than its rivals by this much
    tolerance: int = 1  # px, cells of one pixel that are this close are no rivals; 0 is one-to-one
    matching_rounds: int = 5
    min_island: int = 100  # px, least area of matches that hang together
    fill: bool = True  # extend the matches into the mask's holes
    fill_levels: tuple[float, ...] = (0.95, 0.85, 0.75, 0.65, 0.55)  # least similarity, falling: best first
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
        for name in ("mu", "beta", "tolerance", "min_island", "fill_smoothness", "smoothing"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}; 0 turns it off")
        for name in ("max_waves", "max_candidates", "matching_rounds"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")


class GrowingSeeds(StereoMatcher):
    """Stereo matching that says what it knows, at a cost that goes with the region asked for.

    1. Similarity: modified normalised cross-correlation of the grey images.
    2. Seeds: Harris points with a good match on their row, and the caller's, such as the last frame's
       disparities.
    3. Growth, in waves: each new cell offers the best neighbour of each of four sets; one that is similar
       enough, and not much worse than the best at its two pixels, is a new cell. So depth goes on from where
       it is known.
    4. Strictly confident matching: a cell wins if it beats all rivals at its left and its right pixel by a
       margin.
    5. Sub-pixel: the peak of the parabola through the similarities of three disparities.
    6. Islands of matches too small to trust go, holes are filled from their rims, and what is left is
       smoothed.

    Steps 1 to 5 are the paper's, the sixth is ours. The confidence is the similarity, halved if filled in. The memory is 8 bytes a cell over the
    masks' bounding box: 250 MB for 640 x 480 with 97 disparities.
    """

    def __init__(self, config: GrowingSeedsConfig = GrowingSeedsConfig()) -> None:
        super().__init__()
        self.config = config

    def match(
        self,
        left: Grey,
        right: Grey,
        mask: Bool[Tensor, "batch height width"],
        seeds: Grey | None,
        least: int,
        greatest: int,
    ) -> Disparity:
        config = self.config
        values, confidence = torch.full_like(left, torch.nan), torch.zeros_like(left)
        space = DisparitySpace.around(mask, least, greatest)
        mask = space.crop(mask)
        # The correlation is blind to a constant, and sums of squares lose less precision without one.
        middle = left.mean(dim=(1, 2), keepdim=True)
        left, right = left - middle, right - middle
        volume = similarities(left, right, mask, space, tuple(config.windows), config.noise)
        cells = corner_seeds(volume, left, mask, space, config)
        if seeds is not None:
            cells = torch.cat([cells, given_seeds(space.crop(seeds), mask, space)])
        layers, similarity = confident_matches(volume, grow(volume, cells, space, config), space, config)
        if config.min_island > 1:
            layers = without_islands(layers, space, config.min_island)
        if config.fill:
            layers, similarity = fill(volume, layers, similarity, mask, space, config)
        found = smooth(space.unpad(layers), config.smoothing)
        space.crop(values).copy_(found + (space.least - 1))
        space.crop(confidence).copy_(space.unpad(similarity).clamp(0, 1).where(~found.isnan(), 0))
        return Disparity(values, confidence)


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

    bottom = space.cell(space.pixel(point), torch.ones_like(point))
    along = bottom[:, None] + torch.arange(space.disparities, device=bottom.device) * space.columns
    best, layer = volume[along].max(dim=1)
    good = best >= config.seed_similarity
    return bottom[good] + layer[good] * space.columns


def given_seeds(
    seeds: Float[Tensor, "batch h w"], mask: Bool[Tensor, "batch h w"], space: DisparitySpace
) -> Int[Tensor, " seeds"]:
    """Cells of known disparities (px), as far as they lie in the mask and in the range."""
    layer = (seeds - (space.least - 1)).round()
    inside = mask & (layer >= 1) & (layer <= space.disparities)
    return space.cell(space.pixel(inside.flatten().nonzero()[:, 0]), layer[inside].long())


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
    for _ in range(config.max_waves):
        new = ((similarity >= config.tau) & (number[front[0]] < 0)).nonzero()[:, 0]
        if len(new) == 0:
            break
        front, similarity = front[:, new], similarity[new]
        cell, left, right = front
        own = torch.arange(proposed, proposed + len(new), dtype=torch.int32, device=volume.device)
        proposed += len(new)
        number[cell] = own
        best_left.scatter_reduce_(0, left, similarity, "amax")
        best_right.scatter_reduce_(0, right, similarity, "amax")
        bar = torch.minimum(best_left[left], best_right[right]) - config.mu
        accepted = (number[cell] == own) & (similarity >= bar) & (carried[left] < config.max_candidates)
        front = front[:, accepted.nonzero()[:, 0]]
        cell, left, _ = front
        carried.index_add_(0, left, torch.ones_like(left, dtype=torch.int32))
        grown.append(cell)
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
    left, layer, value = space.left_pixel(grown), space.layer(grown), volume[grown]
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
        best = torch.zeros_like(similarity).scatter_reduce_(0, left[won], value[won], "amax")
        won = won[value[won] == best[left[won]]]
        similarity[left[won]] = value[won]
        layers[left[won]] = _sub_pixel(volume, space.cell(left[won], layer[won]), layer[won], space)
        # Whatever shares a winner's left pixel goes, and what competes with it at its right pixel.
        winner = torch.full((space.right_pixels,), -1, device=layer.device)
        winner[right[won]] = layer[won]
        free = (winner[right] < 0) | ((winner[right] - layer).abs() <= config.tolerance)
        rest = (layers[left].isnan() & free).nonzero()[:, 0]
        left, right, layer, value = left[rest], right[rest], layer[rest], value[rest]
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
    leads = value == first[pixel]
    leader = torch.zeros_like(first, dtype=layer.dtype)
    leader[pixel[leads]] = layer[leads]
    far = (layer - leader[pixel]).abs() > tolerance
    second = torch.full_like(first, -1).scatter_reduce_(0, pixel[far], value[far], "amax")
    return torch.where(far, first[pixel], second[pixel])


def _sub_pixel(
    volume: Float[Tensor, " cells"], cell: Int[Tensor, " n"], layer: Int[Tensor, " n"], space: DisparitySpace
) -> Float[Tensor, " n"]:
    """The layer where the parabola through three similarities peaks, at most half a layer away."""
    below, here, above = volume[cell - space.columns], volume[cell], volume[cell + space.columns]
    curvature = 2 * here - below - above
    shift = 0.5 * (above - below) / curvature.clamp(min=torch.finfo(volume.dtype).tiny)
    measured = (layer > 1) & (layer < space.disparities) & (curvature > 0)  # the padding is no measurement
    return layer + shift.clamp(-0.5, 0.5).where(measured, 0)


def without_islands(
    layers: Float[Tensor, " pixels"], space: DisparitySpace, min_size: int
) -> Float[Tensor, " pixels"]:
    """NaN where fewer than `min_size` pixels hang together, by steps to a side of at most one layer."""
    pixel = (~layers.isnan()).nonzero()[:, 0]
    place = torch.zeros_like(layers, dtype=torch.long)
    place[pixel] = torch.arange(len(pixel), device=pixel.device)
    edges = []
    for step in (1, space.columns):  # to the right, down; the padding is NaN
        joined = ((layers[pixel] - layers[pixel + step]).abs() <= 1).nonzero()[:, 0]
        edges.append(torch.stack([joined, place[pixel[joined] + step]]))
    size = component_sizes(len(pixel), torch.cat(edges, dim=1))
    return layers.index_fill(0, pixel[size < min_size], torch.nan)


def component_sizes(nodes: int, edges: Int[Tensor, "2 edges"]) -> Int[Tensor, " nodes"]:
    """Size of the connected component of each node: union-find, all edges at once."""
    root = torch.arange(nodes, device=edges.device)
    while edges.shape[1]:
        low, high = root[edges].aminmax(dim=0)
        root = root.scatter_reduce(0, high, low, "amin")  # hook each root below a smaller neighbour
        while not torch.equal(flatter := root[root], root):
            root = flatter
        edges = edges[:, (root[edges[0]] != root[edges[1]]).nonzero()[:, 0]]
    return root.bincount(minlength=nodes)[root]


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
    taken = torch.full((space.right_pixels,), -1, device=layers.device)
    matched = (~layers.isnan()).nonzero()[:, 0]
    owner = layers[matched].round().long()
    taken[space.right_pixel(matched, owner)] = owner
    hole = space.pad(mask, False) & layers.isnan()
    for least in config.fill_levels:
        rim = hole.nonzero()[:, 0]
        while len(rim):
            beside = layers[rim + side]  # (8, rim)
            support = len(sides) - beside.isnan().sum(0)
            held = (support >= 2).nonzero()[:, 0]
            rim, mean = rim[held], beside[:, held].nansum(0) / support[held]
            near = mean.round() + torch.arange(-1, 2, device=mean.device)[:, None]
            near = near.clamp(1, space.disparities)  # (3, rim)
            value = volume[space.cell(rim.expand(3, -1), near.long())]
            choice = (value - config.fill_smoothness * (near - mean).abs()).argmax(0, keepdim=True)
            value, layer = value.gather(0, choice)[0], near.gather(0, choice)[0].long()
            other = taken[space.right_pixel(rim, layer)]
            free = (other < 0) | ((other - layer).abs() <= config.tolerance)
            accepted = (free & (value >= least)).nonzero()[:, 0]
            pixel, layer, value, mean = rim[accepted], layer[accepted], value[accepted], mean[accepted]
            cell = space.cell(pixel, layer)
            peak = (value >= volume[cell - across]) & (value >= volume[cell + across])
            settled = torch.maximum(torch.minimum(mean, layer + 0.5), layer - 0.5)
            layers[pixel] = torch.where(peak, _sub_pixel(volume, cell, layer, space), settled)
            similarity[pixel] = 0.5 * value
            hole[pixel] = False
            rim = (pixel + side).unique()
            rim = rim[hole[rim]]
    return layers, similarity


def smooth(layers: Float[Tensor, "batch h w"], radius: int) -> Float[Tensor, "batch h w"]:
    """Mean of the neighbours in a square whose disparity is within 1 px of the pixel's own; NaN stays NaN."""
    height, width = layers.shape[1:]
    padded = F.pad(layers, (radius,) * 4, value=torch.nan)
    total, count = torch.zeros_like(layers), torch.zeros_like(layers)
    for row in range(2 * radius + 1):
        for column in range(2 * radius + 1):
            difference = padded[:, row : row + height, column : column + width] - layers
            near = difference.abs() <= 1  # False for NaN
            total += difference.where(near, 0)
            count += near
    return layers + total / count.clamp(min=1)
