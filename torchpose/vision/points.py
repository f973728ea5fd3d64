"""The person as points: a regular sample of the depth inside the silhouette, and its cells with geodesics.

Left-camera frame (x right, y down, z forward), metres; pixels (u, v) are column and row.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from torchpose.vision.camera import StereoCamera

GROWTH = 1.02  # by which a grid is made coarser until its points, or its cells, are few enough


@dataclass(frozen=True)
class SamplingConfig:
    """Settings of `sample_grid`."""

    num_points: int = 500  # N, points of every cloud, padding included
    neighbour_radius: float = 2.0  # grid steps, d of T. (3.8)
    min_readings: float = 0.25  # share of a node's pixels that must have a depth on the person
    surface: float = 0.1  # m, a node's readings this far from their median lie on another surface
    isolation: float = 0.12  # m, a node is flying if no neighbour on the grid is this close in depth

    def __post_init__(self) -> None:
        if self.num_points < 1:
            raise ValueError(f"num_points must be at least 1, got {self.num_points}; 400 to 1000 are usual")
        for name in ("surface", "isolation"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}; inf switches it off")
        if not self.neighbour_radius >= 1:
            raise ValueError(f"neighbour_radius must be at least 1 grid step, got {self.neighbour_radius}")
        if not 0 < self.min_readings <= 1:
            raise ValueError(f"min_readings must be a share in (0, 1], got {self.min_readings}")


@dataclass(frozen=True)
class PointCloud:
    """Points on the person, one a node of a regular grid in raster order; padding where `mask` is False."""

    points: Float[Tensor, "batch num 3"]  # m, left-camera frame; 0 on padding
    pixels: Float[Tensor, "batch num 2"]  # px, (u, v), the mean of the node's readings; 0 on padding
    grid: Int[Tensor, "batch num 2"]  # (row, column) on the sampling grid; -1 on padding
    mask: Bool[Tensor, "batch num"]
    neighbours: Int[Tensor, "batch num near"]  # indices into num of the Potts neighbours; num where none


@dataclass(frozen=True)
class CellConfig:
    """Settings of `group_cells`."""

    num_cells: int = 150  # C, cells of every cloud, padding included
    max_jump: float = 0.1  # m, neighbours on the grid further apart in depth are on different limbs

    def __post_init__(self) -> None:
        if self.num_cells < 1:
            raise ValueError(f"num_cells must be at least 1, got {self.num_cells}; 100 to 200 are usual")
        if not self.max_jump > 0:
            raise ValueError(f"max_jump must be positive, got {self.max_jump}; 0.1 m parts arm and trunk")


@dataclass(frozen=True)
class Cells:
    """Points grouped into cells, and the shortest ways between them over the body's surface."""

    index: Int[Tensor, "batch num"]  # cell of each point; -1 on padding
    centres: Float[Tensor, "batch cells 3"]  # m, mean of the cell's points; 0 on padding
    mask: Bool[Tensor, "batch cells"]
    distances: Float[Tensor, "batch cells cells"]  # m, inf where no way leads and on padding


def sample_grid(
    depth: Float[Tensor, "batch height width"],
    silhouette: Bool[Tensor, "batch mask_height mask_width"],
    camera: StereoCamera,
    config: SamplingConfig = SamplingConfig(),
) -> PointCloud:
    """Points on a regular grid of pixels, as many as fit into `num_points` (T. 4.3.1, with cx and cy).

    The grid's spacing follows from the silhouette's area, so near and far persons get equally many points;
    where it gives too many, it is made coarser. A node is the square of pixels around it. Its depth and pixel
    are the means of its readings near their median, so a node on a depth edge takes one side of it. Nodes
    whose depth no node beside them shares are flying pixels and left out.

    Args:
        depth: (B, H, W) m, NaN (or 0) where there is none.
        silhouette: (B, H, W) of the person.

    Raises:
        ValueError: shapes differ from one another or from the camera's image.
    """
    if depth.shape != silhouette.shape or depth.shape[1:] != (camera.height, camera.width):
        raise ValueError(
            f"depth and silhouette must both be (B, {camera.height}, {camera.width}), the camera's image, "
            f"got {tuple(depth.shape)} and {tuple(silhouette.shape)}; scale the camera like the images"
        )
    batch, height, width = depth.shape
    frame, v, u = (silhouette & (depth > 0) & depth.isfinite()).nonzero(as_tuple=True)
    z = depth[frame, v, u]
    spacing = _spacing(frame, v, u, batch, config)
    rows, columns = math.ceil(height / float(spacing.min())), math.ceil(width / float(spacing.min()))
    node = _node(frame, v, u, spacing, rows, columns)  # (readings), of batch * rows * columns
    nodes = batch * rows * columns
    surface = (z - _group_median(z, node, nodes)[node]).abs() <= config.surface
    readings = torch.stack([torch.ones_like(z), u.to(z.dtype), v.to(z.dtype), z], 1) * surface[:, None]
    total = z.new_zeros(nodes, 4).index_add(0, node, readings)
    count = torch.bincount(node, minlength=nodes).view(batch, -1)
    enough = count >= config.min_readings * spacing[:, None].square()
    mean = (total[:, 1:] / total[:, :1].clamp_min(1)).view(batch, rows, columns, 3)
    valid = _not_flying(mean[..., 2], enough.view(batch, rows, columns), config.isolation)

    num = config.num_points
    order = valid.flatten(1).cumsum(1) - 1
    frame, node = valid.flatten(1).nonzero(as_tuple=True)
    place = order[frame, node]
    pixels = depth.new_zeros(batch, num, 2)
    values = mean.flatten(1, 2)[frame, node]
    pixels[frame, place] = values[:, :2]
    distance = depth.new_zeros(batch, num)
    distance[frame, place] = values[:, 2]
    grid = node.new_full((batch, num, 2), -1)
    grid[frame, place] = torch.stack([node // columns, node % columns], 1)
    mask = torch.arange(num, device=depth.device) < valid.flatten(1).sum(1, keepdim=True)
    points = torch.where(mask[..., None], camera.back_project(pixels, distance), 0)
    return PointCloud(points, pixels, grid, mask, _grid_neighbours(grid, mask, config.neighbour_radius))


def group_cells(cloud: PointCloud, config: CellConfig = CellConfig()) -> Cells:
    """Cells of points and their geodesic distances (T. 3.2.1): what (3.12) compares with the body's own.

    A cell is a connected piece of a square of grid nodes: two nodes side by side (also diagonally) are
    connected if their depths differ by less than `max_jump`. Cells are neighbours if any of their nodes are
    connected, at the distance of their centres; ways over such a graph are up to 8 % longer than over the
    surface. The squares grow until there are at most `num_cells` cells; if the person falls into more pieces
    than that, the last points go without.
    """
    batch, num, _ = cloud.points.shape
    beside = _grid_neighbours(cloud.grid, cloud.mask, 1.5)  # (B, N, 8)
    padded = torch.cat([cloud.points[..., 2], cloud.points.new_full((batch, 1), torch.inf)], 1)
    jump = (_take(padded, beside) - cloud.points[..., 2:]).abs()
    connected = (beside < num) & cloud.mask[..., None] & (jump < config.max_jump)
    count = cloud.mask.sum(1).clamp_min(1)
    side = (count / config.num_cells).sqrt().clamp_min(1).to(cloud.points.dtype)
    index = _connected_squares(cloud, beside, connected, side)
    while True:
        excess = (index.amax(1) >= config.num_cells) & (side <= cloud.grid.amax((1, 2)) + 1)
        if not excess.any():
            break
        side = torch.where(excess, side * GROWTH, side)
        index = torch.where(excess[:, None], _connected_squares(cloud, beside, connected, side), index)
    index = torch.where(index < config.num_cells, index, -1)

    frame, point = (index >= 0).nonzero(as_tuple=True)
    cell = index[frame, point]
    total = cloud.points.new_zeros(batch, config.num_cells, 4)
    ones = cloud.points.new_ones(len(frame), 1)
    total.index_put_((frame, cell), torch.cat([cloud.points[frame, point], ones], 1), accumulate=True)
    centres = total[..., :3] / total[..., 3:].clamp_min(1)
    mask = total[..., 3] > 0
    other = _take(torch.cat([index, index.new_full((batch, 1), -1)], 1), beside)
    linked = connected & (index[..., None] >= 0) & (other >= 0)
    frame, point, near = linked.nonzero(as_tuple=True)
    edges = torch.zeros(batch, config.num_cells, config.num_cells, dtype=torch.bool, device=index.device)
    edges[frame, index[frame, point], other[frame, point, near]] = True
    # Differences, not cdist: its matrix product is off by millimetres in float32.
    length = (centres[:, :, None] - centres[:, None]).norm(dim=-1)
    return Cells(index, centres, mask, shortest_paths(torch.where(edges, length, torch.inf), mask))


def shortest_paths(
    length: Float[Tensor, "batch cells cells"], mask: Bool[Tensor, "batch cells"]
) -> Float[Tensor, "batch cells cells"]:
    """Lengths of the shortest ways between all nodes of graphs with edges `length` (inf: no edge).

    By Floyd and Warshall. 0 from a node to itself; inf where no way leads and wherever `mask` is False.
    """
    itself = torch.eye(length.shape[1], dtype=torch.bool, device=length.device)
    way = length.masked_fill(~(mask[:, :, None] & mask[:, None]), torch.inf)
    way = way.masked_fill(itself & mask[:, :, None], 0)
    for via in range(length.shape[1]):
        way = torch.minimum(way, way[:, :, via, None] + way[:, via, None, :])
    return way


def _node(
    frame: Int[Tensor, " readings"],
    v: Int[Tensor, " readings"],
    u: Int[Tensor, " readings"],
    spacing: Float[Tensor, " batch"],
    rows: int,
    columns: int,
) -> Int[Tensor, " readings"]:
    """Index of the node of each pixel: (frame, row, column) on a grid of rows x columns for every frame."""
    step = spacing[frame]
    return (frame * rows + (v / step).long()) * columns + (u / step).long()


def _spacing(
    frame: Int[Tensor, " readings"],
    v: Int[Tensor, " readings"],
    u: Int[Tensor, " readings"],
    batch: int,
    config: SamplingConfig,
) -> Float[Tensor, " batch"]:
    """Least spacing (px) of each frame's grid, in steps of 2 %, with at most `num_points` valid nodes.

    It ends: n readings fill at most n / (min_readings spacing^2) nodes.
    """
    area = torch.bincount(frame, minlength=batch)
    height, width = (int(x.max()) + 1 if len(x) else 1 for x in (v, u))
    spacing = (area / config.num_points).sqrt().clamp_min(1)
    spacing = torch.where(
        area > 0, spacing, float(max(height, width))
    )  # of no account, but keeps tables small
    while True:
        step = float(spacing.min())
        rows, columns = math.ceil(height / step), math.ceil(width / step)
        count = torch.bincount(_node(frame, v, u, spacing, rows, columns), minlength=batch * rows * columns)
        enough = count.view(batch, -1) >= (config.min_readings * spacing.square())[:, None].clamp_min(1)
        excess = enough.sum(1) > config.num_points
        if not excess.any():
            return spacing
        spacing = torch.where(excess, spacing * GROWTH, spacing)


def _group_median(
    values: Float[Tensor, " readings"], group: Int[Tensor, " readings"], groups: int
) -> Float[Tensor, " groups"]:
    """Lower median of the values in each group, 0 for a group without any."""
    by_value = values.argsort()
    order = by_value[group[by_value].argsort(stable=True)]  # by group, then by value
    count = torch.bincount(group, minlength=groups)
    middle = count.cumsum(0) - count + (count - 1).clamp_min(0) // 2
    ordered = torch.cat([values[order], values.new_zeros(1)])  # an empty last group looks one past the end
    return torch.where(count > 0, ordered[middle.clamp_max(len(values))], 0)


def _not_flying(
    depth: Float[Tensor, "batch rows columns"], valid: Bool[Tensor, "batch rows columns"], isolation: float
) -> Bool[Tensor, "batch rows columns"]:
    """The valid nodes that one of the eight about them agrees with in depth."""
    border = F.pad(torch.where(valid, depth, torch.nan), (1, 1, 1, 1), value=torch.nan)
    rows, columns = depth.shape[1:]
    shared = torch.zeros_like(valid)
    for row, column in _offsets(1.5):
        there = border[:, 1 + row : 1 + row + rows, 1 + column : 1 + column + columns]
        shared |= (there - depth).abs() <= isolation
    return valid & shared


def _offsets(radius: float) -> list[tuple[int, int]]:
    """The steps (row, column) to the nodes within a radius: 12 for 2, 8 for 1.5."""
    reach = range(-math.floor(radius), math.floor(radius) + 1)
    return [(row, column) for row in reach for column in reach if 0 < row**2 + column**2 <= radius**2]


def _grid_neighbours(
    grid: Int[Tensor, "batch num 2"], mask: Bool[Tensor, "batch num"], radius: float
) -> Int[Tensor, "batch num near"]:
    """Indices of the points at the nodes about each point, num where none is, by a table of the grid."""
    (batch, num), border = mask.shape, math.floor(radius)
    rows, columns = (int(size) + 1 for size in grid.amax((0, 1)).clamp_min(0))
    stride = columns + 2 * border
    place = (grid[..., 0] + border) * stride + grid[..., 1] + border  # (B, N)
    table = grid.new_full((batch, (rows + 2 * border) * stride), num)
    frame, point = mask.nonzero(as_tuple=True)
    table[frame, place[frame, point]] = point
    steps = torch.tensor([row * stride + column for row, column in _offsets(radius)], device=grid.device)
    near = _take(table, torch.where(mask[..., None], place[..., None] + steps, 0))
    return torch.where(mask[..., None], near, num)


def _take(values: Tensor, index: Tensor) -> Tensor:
    """`values` (B, V) at `index` (B, N, K), frame by frame."""
    return values.gather(1, index.flatten(1)).view(index.shape)


def _connected_squares(
    cloud: PointCloud,
    beside: Int[Tensor, "batch num 8"],
    connected: Bool[Tensor, "batch num 8"],
    side: Float[Tensor, " batch"],
) -> Int[Tensor, "batch num"]:
    """Cell of each point, numbered from 0 in each frame, -1 on padding: connected pieces of squares of nodes.

    Every point takes the least index among those it is connected to in its square, over and over.
    """
    batch, num = cloud.mask.shape
    square = (cloud.grid / side[:, None, None]).floor()
    square = torch.cat([square, square.new_full((batch, 1, 2), -1)], 1)
    same = [_take(square[..., axis], beside) == square[:, :num, axis, None] for axis in (0, 1)]
    joined = torch.where(connected & same[0] & same[1], beside, num)
    own = torch.arange(num + 1, device=cloud.grid.device).expand(batch, -1)
    label, before = own, None
    while before is None or not torch.equal(label, before):
        before = label
        label = torch.minimum(label, torch.cat([_take(label, joined).amin(2), own[:, -1:]], 1))
    label = label[:, :num]
    first = (label == own[:, :num]) & cloud.mask
    number = first.cumsum(1) - 1
    return torch.where(cloud.mask, number.gather(1, label), -1)
