"""Bounds of the geodesic distances: against shortest ways over the surfaces of posed bodies, by SciPy's Dijkstra."""

import pytest
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from synthetic_cloud import see, standing
from torch.testing import assert_close

from torchpose.body.model import BodyModel
from torchpose.registration.geodesic import geodesic_bounds, geodesic_term
from torchpose.vision.points import group_cells

PER_PART = 150
REACH = 0.1  # m, between points that are linked


@pytest.fixture(scope="module")
def body():
    return BodyModel().double()


def surface(body, pose, size):
    """Points of the body's skin: of every ellipsoid those that lie in no other one, with their parts."""
    posed = body(pose, size)
    ball = torch.nn.functional.normalize(torch.randn(14, PER_PART, 3, dtype=torch.float64), dim=-1)
    extent = posed.radii[0]
    points = (ball * extent[:, None]) @ posed.frames[0].mT + posed.centers[0][:, None]
    part = torch.arange(14)[:, None].expand(-1, PER_PART).flatten()
    points = points.flatten(0, 1)
    inside = (((points - posed.centers[0][:, None]) @ posed.frames[0]) / extent[:, None]).norm(dim=-1) < 1
    inside[part, torch.arange(len(part))] = False
    skin = ~inside.any(0)
    return points[skin], part[skin]


def ways(body, points, part):
    """Shortest ways over links between near points of one rigid body or of a body and its parent: limbs that touch
    otherwise are not linked."""
    owner = torch.tensor(body.segment_bodies)[part]
    parent = torch.tensor([-1, *body.parents])[owner]
    kin = (owner[:, None] == owner) | (parent[:, None] == owner) | (owner[:, None] == parent)
    gap = (points[:, None] - points).norm(dim=-1)
    row, column = ((gap < REACH) & (gap > 0) & kin).nonzero(as_tuple=True)
    graph = coo_matrix((gap[row, column].numpy(), (row.numpy(), column.numpy())), shape=gap.shape).tocsr()
    return torch.from_numpy(dijkstra(graph, directed=False))


@pytest.mark.parametrize("seed", range(4))
def test_no_way_over_the_skin_of_a_usual_pose_is_out_of_bounds(body, seed):
    torch.manual_seed(seed)
    size = 1 + 0.08 * torch.randn(1, len(body.size_names), dtype=torch.float64)
    pose = standing(body)
    low, high = body.low[6:], body.high[6:]
    pose[:, 6:] = low + (high - low) * (0.35 + 0.3 * torch.rand(18, dtype=torch.float64))
    points, part = surface(body, pose, size)
    way = ways(body, points, part)
    bounds = geodesic_bounds(body, size)
    known = way.isfinite()
    assert known.double().mean() > 0.95
    # Ellipsoids reach past their joints, and over two that touch the way is shorter than along the bones.
    assert (way + 0.13 >= bounds.shortest[part][:, part])[known].all()
    assert (way <= bounds.longest[part][:, part])[known].all()


def test_bounds_are_not_idle(body):
    """In a relaxed pose the ways come near their bounds, and most labels exclude one another somewhere."""
    size = body.default_size(1)
    points, part = surface(body, standing(body), size)
    way, bounds = ways(body, points, part), geodesic_bounds(body, size)
    foot, hand, head = (body.segment_names.index(name) for name in ("foot_left", "hand_right", "head"))
    for v, w in ((foot, hand), (foot, head), (hand, head)):
        seen = way[part == v][:, part == w]
        seen = seen[seen.isfinite()]
        assert bounds.shortest[v, w] > 0.4 * seen.min()
        assert bounds.longest[v, w] < 2.0 * seen.max()
    assert (bounds.shortest > 0).double().mean() > 0.6


def test_bounds_by_hand(body):
    """Foot to head along the skeleton of the body file, the upper bound without margin or stretch."""
    bounds = geodesic_bounds(body, body.default_size(1), margin=0.0, stretch=1.0)
    names, file = body.segment_names, {s.name: s for s in body.skeleton.segments}
    hand, other = names.index("hand_left"), names.index("hand_right")
    # From the hand's near end to the elbow, the upper arm, and between the shoulders; twice 2 r at each joint.
    elbow = 0.350 - 0.095
    shortest = 2 * (elbow + 0.278) + 0.386 - 2 * 2 * (0.062 + 0.042)
    assert file["hand_left"].half_length[1] == 0.095
    assert_close(bounds.shortest[hand, other], torch.tensor(shortest, dtype=torch.float64), rtol=0, atol=4e-3)
    longest = (
        2 * (0.350 + 0.095 + 0.278) + 0.386 + 2 * torch.pi * (0.062 + 0.040) + 2 * (torch.pi - 2) * 0.042
    )
    assert_close(bounds.longest[hand, other], torch.tensor(longest, dtype=torch.float64), rtol=0, atol=2e-2)


def test_bounds_know_no_pose_side_or_order(body):
    size = body.default_size(1)
    bounds = geodesic_bounds(body, size)
    for table in (bounds.shortest, bounds.longest):
        assert_close(table, table.mT)
        swap = [body.segment_names.index(swapped(name)) for name in body.segment_names]
        assert_close(table, table[swap][:, swap], rtol=0, atol=1e-4)
    assert (bounds.shortest.diagonal() == 0).all()
    assert (bounds.longest > bounds.shortest).all()
    assert_close(bounds.most.sum(), torch.tensor(1.0, dtype=torch.float64))
    assert body.segment_names[int(bounds.most.argmax())] == "torso"


def swapped(name):
    sides = {"left": "right", "right": "left"}
    return "_".join(sides.get(word, word) for word in name.split("_"))


def test_bounds_grow_with_the_person(body):
    small, large = (geodesic_bounds(body, factor * body.default_size(1), margin=0.0) for factor in (1.0, 1.2))
    assert_close(large.shortest, 1.2 * small.shortest)
    assert_close(large.longest, 1.2 * small.longest)
    assert_close(large.most, small.most)


@pytest.mark.parametrize("outlier", [False, True])
def test_no_part_is_never_bound(body, outlier):
    view = see(body, standing(body), num=150)
    bounds = geodesic_bounds(body, body.default_size(1))
    term = geodesic_term(group_cells(view.cloud), bounds, outlier)
    labels = 14 + outlier
    assert term.shortest.shape == term.longest.shape == (labels, labels)
    assert_close(term.shortest[:14, :14], bounds.shortest)
    assert_close(term.longest[:14, :14], bounds.longest)
    assert (term.shortest[14:] == 0).all()
    assert (term.shortest[:, 14:] == 0).all()
    assert (term.longest[14:] == torch.inf).all()
    assert (term.longest[:, 14:] == torch.inf).all()


def test_the_true_labels_of_a_view_break_few_bounds(body):
    """Cells of a real cloud at their true labels: between connected cells bounds hold, but where limbs hide others."""
    view = see(body, standing(body), num=400)
    cells = group_cells(view.cloud)
    bounds = geodesic_bounds(body, body.default_size(1))
    label = torch.stack(
        [
            torch.bincount(view.part[0][cells.index[0] == j], minlength=14).argmax()
            for j in range(int(cells.mask.sum()))
        ]
    )
    way = cells.distances[0, : len(label), : len(label)]
    known = way.isfinite()
    broken = (way < bounds.shortest[label][:, label]) | (way > bounds.longest[label][:, label])
    assert broken[known].double().mean() < 0.02
    shuffled = label[torch.randperm(len(label))]
    wrong = (way < bounds.shortest[shuffled][:, shuffled]) | (way > bounds.longest[shuffled][:, shuffled])
    assert wrong[known].double().mean() > 0.1
