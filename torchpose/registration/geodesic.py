"""Geodesic distances that the body allows between its parts, for the pairwise term of the labels (T. 3.12).

The way over the body's surface between two points hardly changes while the body moves: it follows the
skeleton, and inside a rigid body nothing moves at all. So the bounds come from the skeleton and the girths,
not from sampled poses. Metres.
"""

from dataclasses import dataclass
from math import pi

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.body.ellipsoid import nearest_point
from torchpose.body.model import BodyModel, PosedBody
from torchpose.registration.labelling import GeodesicTerm
from torchpose.vision.points import Cells, shortest_paths

RINGS, SPOKES = (
    16,
    12,
)  # points all over an ellipsoid; the farthest of them is within 2 % of the farthest of all


@dataclass(frozen=True)
class GeodesicBounds:
    """What a body allows, whatever its pose; symmetric in the parts."""

    shortest: Float[Tensor, "parts parts"]  # m, d_min of (3.12)
    longest: Float[Tensor, "parts parts"]  # m, d_max
    most: Float[Tensor, " parts"]  # M_v / M_c: the share of the cells that carry a part's label


def geodesic_bounds(
    body: BodyModel, size: Float[Tensor, "1 sizes"], margin: float = 0.05, stretch: float = 1.08
) -> GeodesicBounds:
    """Bounds of the geodesic distance between any two points of two parts, over all poses.

    The way along the skeleton between two surface points is theirs to the first and from the last joint, and
    between them the distances of joints on one rigid body: none of it depends on the pose. A way through the
    body passes every joint between within the girth r there, so it is at most 2 r a joint shorter. Over the
    surface it may go half around a bent joint (pi r) and half around either part (pi r instead of 2 r).

    `most` is the share of a part when every part is seen broadside, by the areas of their outlines.

    Args:
        margin: m, added on both sides: cells are centres of pieces of the surface.
        stretch: ratio of ways over the graph of cells to those over the surface, see `group_cells`.
    """
    posed = body(size.new_zeros(1, body.num_parameters), size)
    between = _joints_between(body).to(posed.centers)  # (K, K, J)
    girth = _joint_girths(body, posed)
    detour = between @ girth  # (K, K)
    near, far = _reaches(body, posed)
    ways = _ways(body, posed)
    width = posed.radii[0, :, :2].amax(-1)
    around = (pi - 2) * (width[:, None] + width)
    apart = between.any(-1)
    shortest = torch.where(apart, _over_joints(near, ways) - 2 * detour - margin, 0.0).clamp_min(0)
    farthest = torch.where(apart, _over_joints(far, ways), _extents(posed))
    area = width * posed.radii[0, :, 2]
    return GeodesicBounds(shortest, stretch * farthest + pi * detour + around + margin, area / area.sum())


def geodesic_term(cells: Cells, bounds: GeodesicBounds, outlier: bool) -> GeodesicTerm:
    """A frame's cells with the body's bounds. With `outlier` the last label is "no part", unbound."""
    shortest, longest, most = bounds.shortest, bounds.longest, bounds.most
    if outlier:
        pad = torch.nn.functional.pad
        shortest, longest = pad(shortest, (0, 1, 0, 1)), pad(longest, (0, 1, 0, 1), value=torch.inf)
        most = pad(most, (0, 1), value=1.0)
    return GeodesicTerm(cells.index, cells.distances, shortest, longest, most)


def _joints_between(body: BodyModel) -> Bool[Tensor, "parts parts joints"]:
    """Which joints lie on the way between two parts: those above one of them alone."""
    above = [[False] * len(body.parents)]
    for joint, parent in enumerate(body.parents):
        above.append([up or j == joint for j, up in enumerate(above[parent])])
    table = torch.tensor(above, device=body.axes.device)[list(body.segment_bodies)]
    return table[:, None] ^ table


def _joint_girths(body: BodyModel, posed: PosedBody) -> Float[Tensor, " joints"]:
    """Radius of the body at each joint, m: that of the thickest part below it."""
    on_body = torch.tensor(body.segment_bodies, device=posed.radii.device)
    child = torch.arange(1, len(body.parents) + 1, device=posed.radii.device)
    return torch.where(on_body == child[:, None], posed.radii[0, :, :2].amax(-1), 0.0).amax(1)


def _at_joints(body: BodyModel) -> Bool[Tensor, "bodies joints"]:
    """Which joints each rigid body has: the one to its parent, and those of its children."""
    joints = range(len(body.parents))
    rows = [[b == j + 1 or b == body.parents[j] for j in joints] for b in range(len(body.parents) + 1)]
    return torch.tensor(rows, device=body.axes.device)


def _ways(body: BodyModel, posed: PosedBody) -> Float[Tensor, "joints joints"]:
    """Lengths of the ways between joints along the skeleton, m."""
    joints = posed.origins[:, 1:]
    own = _at_joints(body)
    shared = (own[:, :, None] & own[:, None]).any(0)
    length = torch.where(shared, (joints[:, :, None] - joints[:, None]).norm(dim=-1), torch.inf)
    return shortest_paths(length, torch.ones_like(own[:1]))[0]


def _reaches(
    body: BodyModel, posed: PosedBody
) -> tuple[Float[Tensor, "parts joints"], Float[Tensor, "parts joints"]]:
    """Least and greatest distance (m) of each part from the joints of its rigid body; inf from others."""
    local = (posed.origins[:, None, 1:] - posed.centers[:, :, None]) @ posed.frames  # (1, K, J, 3)
    inside = (local / posed.radii[:, :, None]).norm(dim=-1) < 1
    near = torch.where(inside, 0.0, (local - nearest_point(local, posed.radii)).norm(dim=-1))
    far = (local[:, :, None] - _surface(posed)[:, :, :, None]).norm(dim=-1).amax(2)
    on_body = _at_joints(body)[list(body.segment_bodies)]
    return torch.where(on_body, near[0], torch.inf), torch.where(on_body, far[0], torch.inf)


def _surface(posed: PosedBody) -> Float[Tensor, "1 parts points 3"]:
    """Points all over each ellipsoid, in its own frame, m."""
    polar = torch.linspace(0, pi, RINGS + 1).to(posed.radii)[:, None]
    turn = torch.arange(SPOKES).to(posed.radii) * (2 * pi / SPOKES)
    x, y = polar.sin() * turn.cos(), polar.sin() * turn.sin()
    ball = torch.stack([x, y, polar.cos().expand_as(x)], -1)
    return ball.flatten(0, 1) * posed.radii[:, :, None]


def _extents(posed: PosedBody) -> Float[Tensor, "parts parts"]:
    """Greatest distance between points of two parts as they lie now, m: lasting on one rigid body."""
    points = (_surface(posed) @ posed.frames.mT + posed.centers[:, :, None])[0].flatten(0, 1)
    K = posed.centers.shape[1]
    return torch.cdist(points, points).unflatten(0, (K, -1)).unflatten(2, (K, -1)).amax((1, 3))


def _over_joints(
    reach: Float[Tensor, "parts joints"], ways: Float[Tensor, "joints joints"]
) -> Float[Tensor, "parts parts"]:
    """Part to first joint, along the skeleton, last joint to part.

    The least over the joints is the way of the tree: by the triangle's inequality any other joint only adds.
    """
    to_joint = (reach[:, :, None] + ways).amin(1)
    return (to_joint[:, None] + reach).amin(-1)
