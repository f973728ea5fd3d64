"""Artefacts: what lies far from the person whom it is said to be goes before the registration (T. 4.3.1, Fig. 4.4).

Not point by point: what hangs together with the person stays, so a stretched arm does, and a clump that does not goes
as a whole, so a chair beside the knees does not leave its near half. Left-camera frame, metres.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.vision.points import PointCloud

HIPS, FEET = -0.5, -1.8  # along the line from the trunk's middle (0) to the head's (1)


@dataclass(frozen=True)
class ArtefactConfig:
    """Settings of `person_points`."""

    reach: float = 1.1  # m, from the line between head and hips: nothing of a person is further away
    core: float = 0.45  # m, across the view, from the line of head, trunk and feet, and
    arm: float = 0.75  # m, in depth, within which a clump must come to be the person's
    spill: float = 0.1  # share of a clump that may be beyond reach; of one with more, what is beyond it goes
    joint: float = 0.10  # m, in depth, by which neighbours on the grid may differ in one clump
    sd_weight: float = 2.0  # standard deviations of the track, by which reach and core are widened
    most_sd: float = 0.3  # m, of the track, beyond which it says too little to remove more
    min_share: float = 0.02  # of all points; a smaller clump is noise unless it lies wholly within `core`

    def __post_init__(self) -> None:
        for name in ("reach", "core", "arm", "joint", "most_sd"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)} m")
        if not self.core < self.reach:
            raise ValueError(f"core must be below reach, got {self.core} and {self.reach} m")
        for name in ("min_share", "spill"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} must be a share in [0, 1), got {getattr(self, name)}")
        if not self.sd_weight >= 0:
            raise ValueError(f"sd_weight must not be negative, got {self.sd_weight}")


def clumps(
    points: Float[Tensor, "batch num 3"],
    grid: Int[Tensor, "batch num 2"],
    mask: Bool[Tensor, "batch num"],
    joint: float,
) -> Int[Tensor, "batch num"]:
    """The clump of each point, named by its first point; -1 on padding.

    Points at neighbouring nodes (also diagonally) are of one clump if their depths differ by at most `joint` (m).
    """
    batch, num = mask.shape
    rows, columns = (int(size) + 3 for size in grid.amax((0, 1)).clamp_min(0))
    place = (grid[..., 0] + 1) * columns + grid[..., 1] + 1
    table = grid.new_full((batch, rows * columns), num)
    frame, point = mask.nonzero(as_tuple=True)
    table[frame, place[frame, point]] = point
    steps = torch.tensor(
        [r * columns + c for r in (-1, 0, 1) for c in (-1, 0, 1) if r or c], device=grid.device
    )
    beside = table.gather(1, torch.where(mask[..., None], place[..., None] + steps, 0).flatten(1)).view(
        batch, num, 8
    )
    depth = torch.cat([points[..., 2], points.new_full((batch, 1), torch.inf)], 1)
    jump = (depth.gather(1, beside.flatten(1)).view(beside.shape) - points[..., 2:]).abs()
    beside = torch.where(mask[..., None] & (jump <= joint), beside, num)
    label = torch.arange(num + 1, device=grid.device).expand(batch, -1)
    while True:
        least = label.gather(1, beside.flatten(1)).view(beside.shape).amin(2)
        after = torch.cat([torch.minimum(label[:, :num], least), label[:, num:]], 1)
        # A point also takes the name of the one that it is named after: long arms take few rounds.
        after = after.gather(1, after)
        if torch.equal(after, label):
            return torch.where(mask, label[:, :num], -1)
        label = after


def person_points(
    cloud: PointCloud,
    head: Float[Tensor, "batch 3"],
    body: Float[Tensor, "batch 3"],
    head_sd: Float[Tensor, " batch"],
    body_sd: Float[Tensor, " batch"],
    config: ArtefactConfig = ArtefactConfig(),
) -> Bool[Tensor, "batch num"]:
    """Which points are the tracked person's; all of them where no track is known.

    Clumps stay that come near the line from the head through the trunk, as far down as feet stand; so do legs below a
    table. Of those that go on beyond a person's reach, as a wall that is leant on does, what is beyond goes.

    Args:
        head: m; NaN, or too uncertain: the trunk alone counts.
        body: m, the trunk's middle.
        head_sd: m, of each coordinate, as the filter has it.
        body_sd: m, the same.
    """
    nothing = torch.full_like(body, torch.nan)
    known = body.isfinite().all(-1) & (body_sd <= config.most_sd)
    trunk = torch.where(known[:, None], body, nothing)
    top = torch.where((head.isfinite().all(-1) & (head_sd <= config.most_sd))[:, None], head, trunk)
    line = top - trunk
    span = line.square().sum(-1).clamp_min(1e-6)
    along = ((cloud.points - trunk[:, None]) * line[:, None]).sum(-1) / span[:, None]

    def beside(lowest: float) -> Tensor:
        """The way to each point from the line of the head and a place below the trunk, in heads' distances."""
        foot = trunk[:, None] + along.clamp(lowest, 1.0)[..., None] * line[:, None]
        return cloud.points - foot

    slack = config.sd_weight * torch.where(known, body_sd, 0.0)[:, None]
    far = beside(HIPS).norm(dim=-1) > config.reach + slack
    way = beside(FEET)
    inner = (
        (way[..., :2].norm(dim=-1) <= config.core + slack) & (way[..., 2].abs() <= config.arm + slack) & ~far
    )
    own = clumps(cloud.points, cloud.grid, cloud.mask, config.joint)
    index = torch.where(cloud.mask, own, cloud.mask.shape[1])[..., None].expand(-1, -1, 3)
    marks = torch.stack([torch.ones_like(far), inner, far], -1).to(cloud.points)
    total = marks.new_zeros(len(far), cloud.mask.shape[1] + 1, 3).scatter_add(1, index, marks)
    size, core, beyond = total.gather(1, index).unbind(-1)
    enough = (size >= config.min_share * cloud.mask.sum(1, keepdim=True)) | (core == size)
    kept = cloud.mask & (core > 0) & enough & (~far | (beyond <= config.spill * size))
    return torch.where((known & kept.any(1))[:, None], kept, cloud.mask)


def keep_points(cloud: PointCloud, kept: Bool[Tensor, "batch num"]) -> PointCloud:
    """The cloud without the other points: the kept ones in their order, and padding behind them."""
    num = cloud.mask.shape[1]
    mask = cloud.mask & kept
    order = (~mask).byte().argsort(dim=1, stable=True)
    place = torch.where(mask, mask.cumsum(1) - 1, num)
    place = torch.cat([place, place.new_full((len(place), 1), num)], 1)
    after = mask.gather(1, order)
    neighbours = place.gather(1, cloud.neighbours.flatten(1)).view(cloud.neighbours.shape)

    def moved(values: Tensor, padding: int) -> Tensor:
        own = values.gather(1, order[..., None].expand(values.shape))
        return own.masked_fill(~after[..., None], padding)

    return PointCloud(
        moved(cloud.points, 0), moved(cloud.pixels, 0), moved(cloud.grid, -1), after, moved(neighbours, num)
    )
