"""Point clouds, cells and geodesics: planes and strips with closed forms, brute force, and SciPy."""

import itertools
import math

import numpy as np
import pytest
import torch
from scipy.sparse.csgraph import shortest_path
from torch.testing import assert_close

from torchpose.vision.camera import StereoCamera
from torchpose.vision.points import (
    CellConfig,
    PointCloud,
    SamplingConfig,
    group_cells,
    sample_grid,
    shortest_paths,
)

CAMERA = StereoCamera(160, 120, 150.0, 83.25, 55.5, 0.12)  # the principal point is not the centre


def box(*sides, batch=1):
    top, bottom, left, right = sides
    mask = torch.zeros(batch, CAMERA.height, CAMERA.width, dtype=torch.bool)
    mask[:, top:bottom, left:right] = True
    return mask


def flat(z=2.0, batch=1):
    return torch.full((batch, CAMERA.height, CAMERA.width), z, dtype=torch.float64)


def person(batch):
    """A trunk, a thin arm and a leg before a wall, depth with noise and holes."""
    mask = (
        box(20, 100, 60, 90, batch=batch)
        | box(30, 36, 20, 60, batch=batch)
        | box(100, 118, 75, 85, batch=batch)
    )
    mask |= box(40, 70, 95, 100, batch=batch)
    depth = torch.where(mask, 2.0 + 0.02 * torch.randn(mask.shape), 4.0).double()
    depth[:, 35:90, 92:] -= 0.4  # the other arm, nearer
    depth[torch.rand(depth.shape) < 0.2] = torch.nan
    return depth, mask


def test_every_point_lies_on_its_plane_at_its_pixel():
    """A tilted plane, back-projected: the mean of a node's pixels and depths is on the plane again."""
    normal, offset = torch.tensor([0.2, -0.3, 1.0], dtype=torch.float64), 2.5
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (120, 160)), indexing="ij")
    ray = torch.stack([(u - 83.25) / 150, (v - 55.5) / 150, torch.ones_like(u)], -1)
    depth = (offset / (ray @ normal))[None]
    cloud = sample_grid(depth, box(10, 110, 20, 80), CAMERA, SamplingConfig(num_points=300))
    points, pixels = cloud.points[0][cloud.mask[0]], cloud.pixels[0][cloud.mask[0]]
    assert 270 <= len(points) <= 300
    # The plane's depth curves over a node by less than a millimetre.
    assert_close(points @ normal, torch.full((len(points),), offset, dtype=torch.float64), atol=1e-3, rtol=0)
    expected = torch.stack([(pixels[:, 0] - 83.25), (pixels[:, 1] - 55.5)], 1) * points[:, 2:] / 150
    assert_close(points[:, :2], expected, atol=1e-12, rtol=0)
    assert_close(CAMERA.project(points), pixels, atol=1e-9, rtol=0)
    assert pixels[:, 0].min() < 25
    assert pixels[:, 0].max() > 75  # u spans the columns 20 to 79, v the rows 10 to 109
    assert pixels[:, 1].min() < 15
    assert pixels[:, 1].max() > 105


def test_one_point_a_pixel_where_there_are_few():
    mask = box(50, 54, 60, 65)
    cloud = sample_grid(flat(1.5), mask, CAMERA, SamplingConfig(num_points=50))
    assert int(cloud.mask.sum()) == 20
    expected = mask[0].nonzero().flip(1).double()  # raster order, (u, v)
    assert torch.equal(cloud.pixels[0, :20], expected)
    assert torch.equal(cloud.grid[0, :20], mask[0].nonzero())


@pytest.mark.parametrize("num_points", [1, 7, 100, 400, 1000])
def test_about_num_points_and_never_more(num_points):
    depth, mask = person(4)
    depth = torch.where(depth.isnan(), 2.0, depth)
    cloud = sample_grid(depth, mask, CAMERA, SamplingConfig(num_points=num_points, isolation=math.inf))
    assert cloud.points.shape == (4, num_points, 3)
    count = cloud.mask.sum(1)
    assert (count <= num_points).all()
    if num_points >= 100:
        assert (count >= 0.88 * num_points).all()
    assert (cloud.mask.sort(1, descending=True).values == cloud.mask).all()  # padding comes last


def test_padding_is_zero_and_holes_never_become_points():
    depth, mask = person(3)
    depth[2] = torch.nan
    depth[1, 50:70, 60:90] = 0.0  # as a depth camera writes a hole
    cloud = sample_grid(depth, mask, CAMERA, SamplingConfig(num_points=200))
    assert cloud.points.isfinite().all()
    assert cloud.mask.any(1).tolist() == [True, True, False]
    assert (cloud.points[~cloud.mask] == 0).all()
    assert (cloud.pixels[~cloud.mask] == 0).all()
    assert (cloud.grid[~cloud.mask] == -1).all()
    assert (cloud.neighbours[~cloud.mask] == 200).all()
    assert (cloud.points[..., 2][cloud.mask] > 1.4).all()
    u, v = cloud.pixels[1][cloud.mask[1]].unbind(1)
    assert not ((u > 61) & (u < 88) & (v > 51) & (v < 68)).any()


def test_a_node_on_a_depth_edge_takes_one_side():
    depth = flat(2.0)
    depth[:, :, 83:] = 2.6
    cloud = sample_grid(
        depth, box(10, 110, 40, 130), CAMERA, SamplingConfig(num_points=200, isolation=math.inf)
    )
    z = cloud.points[..., 2][cloud.mask]
    assert ((z - 2.0).abs() < 1e-9).logical_or((z - 2.6).abs() < 1e-9).all()


def test_a_flying_node_is_dropped():
    depth = flat(2.0)
    depth[:, 50:55, 60:65] = 3.0
    config = SamplingConfig(num_points=240)  # 5 px a node, so that the patch is just one
    kept = sample_grid(depth, box(0, 100, 40, 100), CAMERA, config)
    every = sample_grid(
        depth, box(0, 100, 40, 100), CAMERA, SamplingConfig(num_points=240, isolation=math.inf)
    )
    assert (every.points[..., 2] > 2.9).any()
    assert not (kept.points[..., 2] > 2.9).any()
    assert int(kept.mask.sum()) == int(every.mask.sum()) - 1 == 239


def test_batch_equals_one_by_one():
    depth, mask = person(3)
    mask[1] = box(40, 60, 60, 80)[0]
    mask[2] = False
    clouds = sample_grid(depth, mask, CAMERA, SamplingConfig(num_points=150))
    cells = group_cells(clouds, CellConfig(num_cells=40))
    for k in range(3):
        alone = sample_grid(depth[k : k + 1], mask[k : k + 1], CAMERA, SamplingConfig(num_points=150))
        for name in ("points", "pixels", "grid", "mask", "neighbours"):
            assert_close(getattr(clouds, name)[k : k + 1], getattr(alone, name))
        cell = group_cells(alone, CellConfig(num_cells=40))
        for name in ("index", "centres", "mask", "distances"):
            assert_close(getattr(cells, name)[k : k + 1], getattr(cell, name))


@pytest.mark.parametrize("radius", [1.0, 1.5, 2.0, 3.0])
def test_neighbours_equal_brute_force(radius):
    depth, mask = person(2)
    cloud = sample_grid(depth, mask, CAMERA, SamplingConfig(num_points=80, neighbour_radius=radius))
    if radius == 2.0:
        assert cloud.neighbours.shape[2] == 12  # d = 2 of T.
    for k in range(2):
        for i in range(80):
            near = {
                j
                for j in range(80)
                if cloud.mask[k, i]
                and cloud.mask[k, j]
                and i != j
                and float((cloud.grid[k, i] - cloud.grid[k, j]).square().sum()) <= radius**2
            }
            row = cloud.neighbours[k, i]
            assert set(row[row < 80].tolist()) == near
            assert int((row < 80).sum()) == len(near)


def test_dtype_is_kept():
    depth, mask = person(1)
    single, double = (sample_grid(d, mask, CAMERA) for d in (depth.float(), depth))
    assert single.points.dtype == torch.float32
    assert double.points.dtype == torch.float64
    assert_close(single.points.double(), double.points, atol=1e-5, rtol=0)
    assert group_cells(single).distances.dtype == torch.float32


@pytest.mark.parametrize("size", [1, 2, 20])
def test_shortest_paths_equal_scipy(size):
    length = torch.rand(5, size, size, dtype=torch.float64)
    length = torch.where(torch.rand(5, size, size) < 2.5 / size, length, torch.inf)
    length = torch.minimum(length, length.mT)
    mask = torch.rand(5, size) < 0.8
    found = shortest_paths(length, mask)
    for k in range(5):
        keep = mask[k].numpy()
        dense = np.where(np.isfinite(length[k].numpy()), length[k].numpy(), 0)  # SciPy: 0 is no edge
        np.fill_diagonal(dense, 0)
        expected = np.full((size, size), np.inf)
        expected[np.ix_(keep, keep)] = shortest_path(dense[np.ix_(keep, keep)], method="D", directed=False)
        assert_close(found[k], torch.from_numpy(expected))


def strip(grid, points):
    """A cloud of given nodes with given points, neighbours left out: cells do not use them."""
    num = len(grid)
    return PointCloud(
        torch.as_tensor(points, dtype=torch.float64)[None],
        torch.zeros(1, num, 2, dtype=torch.float64),
        torch.as_tensor(grid)[None],
        torch.ones(1, num, dtype=torch.bool),
        torch.full((1, num, 12), num),
    )


def test_geodesics_of_a_bent_strip_are_exact():
    """A row of points along a half circle in depth: every way follows the bend, chord by chord."""
    angle = torch.linspace(0, math.pi, 41, dtype=torch.float64)
    points = torch.stack([0.5 * angle.sin(), torch.zeros_like(angle), 2 - 0.5 * angle.cos()], 1)
    cloud = strip([(0, k) for k in range(41)], points)
    cells = group_cells(cloud, CellConfig(num_cells=41))
    steps = (torch.arange(41)[:, None] - torch.arange(41)).abs().double()
    chord = 2 * 0.5 * math.sin(math.pi / 40 / 2)
    assert_close(cells.distances[0], chord * steps)
    assert cells.distances[0, 0, -1] > 1.5 > 1.1 > (points[0] - points[-1]).norm()


def test_a_way_leads_around_a_gap_and_over_no_depth_jump():
    """A ring of nodes, cut in one place and with a step in depth elsewhere."""
    ring = [p for p in itertools.product(range(5), range(5)) if 0 in p or 4 in p]
    ring.remove((0, 2))
    points = [(0.05 * c, 0.05 * r, 2.0) for r, c in ring]
    cells = group_cells(strip(ring, points), CellConfig(num_cells=30))
    left, right = ring.index((0, 1)), ring.index((0, 3))
    way = cells.distances[0, cells.index[0, left], cells.index[0, right]]
    # Along the ring, corners cut: (0,1) to (1,0), to (3,0), (4,1), (4,3), (3,4), (1,4), (0,3).
    assert_close(float(way), 0.05 * (4 * math.sqrt(2) + 6))
    stepped = [(x, y, z + (0.3 if y > 0.09 else 0.0)) for x, y, z in points]
    cells = group_cells(strip(ring, stepped), CellConfig(num_cells=30))
    assert cells.distances[0, cells.index[0, left], cells.index[0, right]].isinf()


@pytest.mark.parametrize("num_cells", [1, 6, 25, 80])
def test_cells_are_connected_pieces_and_few_enough(num_cells):
    depth, mask = person(2)
    cloud = sample_grid(depth, mask, CAMERA, SamplingConfig(num_points=300))
    config = CellConfig(num_cells=num_cells)
    cells = group_cells(cloud, config)
    assert cells.distances.shape == (2, num_cells, num_cells)
    assert ((cells.index >= 0) <= cloud.mask).all()
    if num_cells >= 6:  # one cell is too few for this person, who falls into two pieces
        assert ((cells.index >= 0) == cloud.mask).all()
        assert (cells.mask.sum(1) >= 0.5 * num_cells).all()
    for k in range(2):
        grid, z = cloud.grid[k], cloud.points[k, :, 2]
        touch = ((grid[:, None] - grid).abs().amax(-1) == 1) & ((z[:, None] - z).abs() < config.max_jump)
        expected = torch.full((num_cells, num_cells), torch.inf, dtype=torch.float64)
        for c in range(int(cells.mask[k].sum())):
            members = (cells.index[k] == c).nonzero()[:, 0]
            assert_close(cells.centres[k, c], cloud.points[k, members].mean(0))
            inner = touch[members][:, members].numpy()
            assert np.isfinite(shortest_path(inner.astype(float))).all()
        for i, j in touch.nonzero().tolist():
            a, b = int(cells.index[k, i]), int(cells.index[k, j])
            if a != b and a >= 0 and b >= 0:
                expected[a, b] = (cells.centres[k, a] - cells.centres[k, b]).norm()
        dense = np.where(np.isfinite(expected.numpy()), expected.numpy(), 0)
        there = cells.mask[k].numpy()
        ways = shortest_path(dense[np.ix_(there, there)])
        assert_close(cells.distances[k][cells.mask[k]][:, cells.mask[k]], torch.from_numpy(ways))
        assert cells.distances[k][~cells.mask[k]].isinf().all()


def test_a_cell_never_joins_arm_and_trunk():
    depth, mask = person(1)
    cells = group_cells(cloud := sample_grid(depth, mask, CAMERA), CellConfig(num_cells=20))
    for c in range(int(cells.mask.sum())):
        z = cloud.points[0, cells.index[0] == c, 2]
        assert z.max() - z.min() < 0.25  # the arm is 0.4 m before the trunk


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: SamplingConfig(num_points=0), "num_points"),
        (lambda: SamplingConfig(neighbour_radius=0.5), "neighbour_radius"),
        (lambda: SamplingConfig(min_readings=0.0), "min_readings"),
        (lambda: SamplingConfig(surface=-1.0), "surface"),
        (lambda: SamplingConfig(isolation=0.0), "isolation"),
        (lambda: CellConfig(num_cells=0), "num_cells"),
        (lambda: CellConfig(max_jump=0.0), "max_jump"),
        (lambda: sample_grid(flat(), box(0, 9, 0, 9)[:, :60], CAMERA), "the camera's image"),
        (lambda: sample_grid(flat()[:, :60], box(0, 9, 0, 9)[:, :60], CAMERA), "the camera's image"),
    ],
)
def test_bad_input_is_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()
