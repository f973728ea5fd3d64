"""Distances of points to ellipsoids: nearest point (App. D), nearest visible point, algebraic distance (3.3).

An ellipsoid is given by its centre, its frame (columns: axes, the long one last) and its half axes along these, in
the camera's frame, metres. Every function returns all B x K x N pairs: parts before points. In memory the three
coordinates stand before the points, so that sums over them and products with matrices run along the points.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.body.model import PosedBody

# With one differentiable step after them. Measured against bisection on 1.2 million pairs that are hard on purpose
# (half axes up to 1 : 30 : 30): two are off by more than 1e-12 m in double, the worst by 1.7e-6 m; in single precision
# about a hundred are off by up to that much.
NEWTON_STEPS = 5
# Of points within some decimetres of a body's parts one leaves errors of 0.05 mm in a hundredth of them, 0.5 mm at
# worst, and 0.02 mm in the distance: enough for what is renewed in the next round.
FEW_STEPS = 1


@dataclass(frozen=True)
class FootPoint:
    """The model's point that answers for a data point, and how far away it is."""

    local: Float[Tensor, "batch parts num 3"]  # m, in the ellipsoid's frame: fixed there while the pose moves
    normal: Float[Tensor, "batch parts num 3"]  # outward unit normal of the surface at `local`, same frame
    residual: Float[Tensor, "batch parts num 3"]  # m, data point minus model point, same frame
    hidden: Bool[Tensor, "batch parts num"]  # the surface's nearest point faces away from the camera

    @property
    def distance(self) -> Float[Tensor, "batch parts num"]:
        """Euclidean distance, m."""
        return _length(self.residual)[..., 0]

    def take(self, index: Int[Tensor, "batch few num"]) -> "FootPoint":
        """Those numbered `index` among each point's."""
        wide = index[..., None].expand(-1, -1, -1, 3).mT
        local, normal, residual = (x.mT.gather(1, wide).mT for x in (self.local, self.normal, self.residual))
        return FootPoint(local, normal, residual, self.hidden.gather(1, index))


def to_local(posed: PosedBody, points: Float[Tensor, "batch num 3"]) -> Float[Tensor, "batch parts num 3"]:
    """Points of the camera's frame in the frame of every ellipsoid, m."""
    return (posed.frames.mT @ (points.mT[:, None] - posed.centers[..., None])).mT


def to_camera(
    posed: PosedBody, local: Float[Tensor, "batch parts num 3"]
) -> Float[Tensor, "batch parts num 3"]:
    """Points of the ellipsoids' frames in the camera's frame, m."""
    return (posed.frames @ local.mT + posed.centers[..., None]).mT


def nearest_point(
    local: Float[Tensor, "batch parts num 3"], radii: Float[Tensor, "batch parts 3"]
) -> Float[Tensor, "batch parts num 3"]:
    """The nearest point of the surface of each ellipsoid to each point, both in the ellipsoid's frame, m.

    Where two points are equally near, which happens across the shortest axis, it is the one on its positive side, and
    at the centre the end of that axis (of the first, if several are as short). Gradients are exact. There is none
    along the shortest axis where the point lies in the plane across it, since it is not defined inside.
    """
    return _nearest(local.mT, radii[..., None]).mT


def _nearest(
    local: Float[Tensor, "*batch axes num"],
    radii: Float[Tensor, "*batch axes #num"],
    steps: int = NEWTON_STEPS,
) -> Float[Tensor, "*batch axes num"]:
    """The nearest point of an ellipse (two axes) or an ellipsoid (three) to each point, in the frame of its axes.

    It is x / (1 + t / r^2) in each axis, for the t that puts it on the surface: with the shortest half axis m,
    s = 1 + t / m^2, d = (r / m)^2 - 1 and p = x r / m^2, its coordinates over r are p / (d + s), and s > 0 solves
    N(s) = |p / (d + s)|^2 = 1. Newton runs on 1/sqrt(N) - 1, concave and rising (a power mean of lines), from a lower
    bound of the root. The last step is differentiable, which makes gradients exact.
    """
    p, d = _scaled(local, radii)
    with torch.no_grad():
        s = _lower_bound(p, d)
        inverse, square = torch.empty_like(p), torch.empty_like(p)
        for _ in range(steps):  # as `_newton`, without new memory
            torch.add(d, s, out=inverse).reciprocal_()
            torch.mul(p, inverse, out=square).square_()
            N = square.sum(-2, keepdim=True)
            s = torch.addcdiv(s, N * (N.sqrt() - 1), square.mul_(inverse).sum(-2, keepdim=True))
    return _foot(_newton(s, p, d), p, d, radii)


def _scaled(local: Tensor, radii: Tensor) -> tuple[Tensor, Tensor]:
    """p and d of `_nearest`."""
    shortest, index = radii.detach().min(-2, keepdim=True)
    # Keeps the solver off its pole. A point in the plane across the shortest axis moves by 1e-7 of the radius
    # (float32), its distance to the foot, which is stationary, by the square of that.
    least = torch.zeros_like(radii).scatter(-2, index, torch.finfo(radii.dtype).eps * shortest)
    with torch.no_grad():
        aside = (least - local.abs()).clamp_min_(0).copysign_(local)
    return (local + aside) * (radii / shortest**2), (radii / shortest) ** 2 - 1


def _newton(s: Tensor, p: Tensor, d: Tensor) -> Tensor:
    inverse = (d + s).reciprocal()
    square = (p * inverse) ** 2
    N = square.sum(-2, keepdim=True)
    return torch.addcdiv(s, N * (N.sqrt() - 1), (square * inverse).sum(-2, keepdim=True))


def _foot(s: Tensor, p: Tensor, d: Tensor, radii: Tensor) -> Tensor:
    unit = p / (d + s)
    # Rounding in s leaves the point off the surface by its relative error; one scaling puts it back on.
    return unit * (torch.rsqrt((unit * unit).sum(-2, keepdim=True)) * radii)


def _lower_bound(
    p: Float[Tensor, "*batch axes num"], d: Float[Tensor, "*batch axes #num"]
) -> Float[Tensor, "*batch 1 num"]:
    """A lower bound of the root s of |p / (d + s)|^2 = 1 from which few Newton steps are left.

    Each axis alone gives one. Newton creeps from there where the pole of the shortest axis, s = 0, is close and what
    the longer axes contribute, Q(s), is nearly 1. Let axes with d up to a few s be close ones, whose sum is at least
    c / s^2 from here on. Q is convex, so 1 - Q(s) <= k + g s, a tangent: c <= s^2 (k + g s).
    """
    tiny = torch.finfo(p.dtype).tiny
    s = (p.abs() - d).amax(-2, keepdim=True)
    inverse = (d + s).reciprocal_()
    square = torch.mul(p, inverse).square_()
    N = square.sum(-2, keepdim=True)
    Q = square.mul_(d > 4 * s).sum(-2, keepdim=True)
    c = s * s * (N - Q)
    g = 2 * square.mul_(inverse).sum(-2, keepdim=True)
    k = 1 - Q - g * s
    g, short = g.clamp_min(tiny), k.clamp_min(tiny)
    most = torch.minimum((c / g) ** (1 / 3), (c / short).sqrt())  # with either term alone s is too large
    return torch.maximum(torch.maximum(s, (c / torch.addcmul(short, g, most)).sqrt()), -k / g)


def _across(
    local: Float[Tensor, "num 3"], radii: Float[Tensor, "num 3"]
) -> tuple[Float[Tensor, "num 3"], Bool[Tensor, " num"]]:
    """The second nearest point, on the other side across the shortest axis of each ellipsoid; and if there is one.

    Beside the nearest point a flat ellipsoid can have one more that is nearer than all its neighbours, for points
    near the plane across its shortest axis: the root of N(s) next to the pole s = 0 from below. There Newton's
    function is concave, too, and |p0 / s|^2 = 1 - Q(s) <= 1 - Q(0) bounds s, Q being what the longer axes give.
    """
    half_axes = radii.mT
    p, d = _scaled(local.mT, half_axes)
    with torch.no_grad():
        close = d <= 0
        Q = torch.where(close, 0.0, p / d).square().sum(-2, keepdim=True)
        pole = torch.where(close, p, 0.0).square().sum(-2, keepdim=True)
        edge = torch.where(close, torch.inf, d).amin(-2, keepdim=True)
        s = -(pole / (1 - Q)).sqrt()
        for _ in range(NEWTON_STEPS):
            s = _newton(s, p, d)
        unit = p / (d + s)
        slope = (unit.square() / (d + s)).sum(-2, keepdim=True)
        solved = (unit.square().sum(-2, keepdim=True) - 1).abs() < 1e-3
        found = solved & (s < 0) & (s > -edge) & (slope < 0)
        s = torch.where(found, s, -edge / 2)  # anything finite: it has gradients
    return _foot(_newton(s, p, d), p, d, half_axes).mT, found[0]


def surface_normal(
    local: Float[Tensor, "batch parts num 3"], radii: Float[Tensor, "batch parts 3"]
) -> Float[Tensor, "batch parts num 3"]:
    """Outward unit normal of the ellipsoid through each point, in its frame."""
    gradient = local / radii[:, :, None] ** 2
    return gradient / _length(gradient)


def foot_point(
    posed: PosedBody, points: Float[Tensor, "batch num 3"], visible: bool = True, steps: int = NEWTON_STEPS
) -> FootPoint:
    """The nearest point of every ellipsoid, or with `visible` the nearest one that the camera can see.

    A point whose nearest one faces away from the camera cannot have come from there. Of the visible side either the
    rim is then nearest, or the point across a flat ellipsoid (there is no third minimum), so the distance stays
    continuous where points cross over; taking the hit of the point's ray instead would make it jump.

    Args:
        steps: of Newton's method.
    """
    own = torch.cat([posed.radii, _camera(posed)], -1)[..., None]
    part = torch.arange(own.shape[1], device=own.device)[:, None]
    part = part.expand(len(own), own.shape[1], points.shape[1])
    return _foot_point(to_local(posed, points).mT, own, _rims(posed) if visible else None, part, steps)


def foot_of_part(
    posed: PosedBody,
    part: Int[Tensor, "batch few num"],
    points: Float[Tensor, "batch num 3"],
    visible: bool = True,
    steps: int = FEW_STEPS,
) -> FootPoint:
    """`foot_point` of each point on a few parts of its own alone: in the place of the parts stand these few.

    Args:
        steps: of Newton's method; with `NEWTON_STEPS` as exact as `foot_point`.
    """
    numbers = torch.cat([posed.frames.flatten(2), posed.centers, posed.radii, _camera(posed)], -1)
    frames, centers, own = _of_each(numbers, part).tensor_split((9, 12), 2)
    away = points.mT[:, None] - centers
    local = (frames.unflatten(2, (3, 3)) * away[:, :, :, None]).sum(2)
    return _foot_point(local, own, _rims(posed) if visible else None, part, steps)


def _of_each(
    numbers: Float[Tensor, "batch parts numbers"], part: Int[Tensor, "batch few num"]
) -> Float[Tensor, "batch few numbers num"]:
    """The numbers of the parts that each point has, with the points last in memory."""
    index = part.flatten(1)[:, None].expand(-1, numbers.shape[2], -1)
    return numbers.mT.gather(2, index).unflatten(2, part.shape[1:]).transpose(1, 2)


def _foot_point(
    local: Float[Tensor, "batch few 3 num"],
    own: Float[Tensor, "batch few 6 #num"],
    rims: Float[Tensor, "batch parts 14"] | None,
    part: Int[Tensor, "batch few num"],
    steps: int = NEWTON_STEPS,
) -> FootPoint:
    """Of points in the frames of ellipsoids that either all points of a part share or that are each point's own.

    Args:
        own: half axes and `_camera` of these ellipsoids.
        rims: see `_rims`; None takes the nearest point, seen or not.
        part: whose rim each point may need.
    """
    radii, camera = own.split(3, 2)
    nearest = _nearest(local, radii, steps)
    beyond = camera.square().sum(2) > 1  # a camera inside an ellipsoid sees no rim
    hidden = ((nearest * (camera / radii)).sum(2) < 1) & beyond
    if rims is not None:
        # Of three pairs one is hidden: only these are solved again.
        b, k, n = hidden.nonzero(as_tuple=True)
        place, there = local[b, k, :, n], own.expand(*own.shape[:3], local.shape[3])[b, k, :, n]
        seen = _seen_point(place, there, rims[b, part[b, k, n]], steps)
        nearest = nearest.mT.index_put((b, k, n), seen).mT
    gradient = nearest / radii**2
    normal = gradient * gradient.square().sum(2, keepdim=True).rsqrt()
    return FootPoint(nearest.mT, normal.mT, (local - nearest).mT, hidden)


def _seen_point(
    local: Float[Tensor, "num 3"],
    own: Float[Tensor, "num 6"],
    rims: Float[Tensor, "num 14"],
    steps: int,
) -> Float[Tensor, "num 3"]:
    """The nearest point that the camera sees, where the nearest one of all is hidden: on the rim, or across."""
    middle, center, axes, rim = rims.mT.split((3, 3, 6, 2))
    axes = axes.unflatten(0, (3, 2))
    aside = (axes * (local.mT - center)[:, None]).sum(0)  # the rim is an ellipse: its two axes are enough
    onto = ((axes * _nearest(aside, rim, steps)).sum(1) + center).mT
    near = (local.detach().abs() < middle.mT).all(1)
    if not near.any():
        return onto
    (row,) = near.nonzero(as_tuple=True)
    place, (radii, camera) = local[row], own[row].split(3, 1)
    across, found = _across(place, radii)
    better = found & ((across * camera / radii).sum(1) >= 1)
    better &= (place - across).square().sum(1) < (place - onto[row]).square().sum(1)
    return onto.index_put((row[better],), across[better])


def _length(vector: Float[Tensor, "batch parts num 3"]) -> Float[Tensor, "batch parts num 1"]:
    """The Euclidean norm, 30 times faster than torch's where the coordinates are not neighbours in memory."""
    # The root of 0 has no derivative; the floor gives it 0.
    square = (vector * vector).sum(-1, keepdim=True)
    return square.clamp_min(torch.finfo(square.dtype).tiny).sqrt()


@dataclass(frozen=True)
class _Rim:
    """Where the camera's rays touch each ellipsoid: an ellipse, in the ellipsoid's frame."""

    center: Float[Tensor, "batch parts 3"]  # m
    axes: Float[Tensor, "batch parts 3 2"]  # columns: unit directions of its short and its long half axis
    radii: Float[Tensor, "batch parts 2"]  # m, short and long


def _rim(posed: PosedBody) -> _Rim:
    """With the ellipsoid as the unit ball and the camera at C, a circle of radius sqrt(1 - 1/C^2) about C/C^2.

    Two directions of its plane at a right angle become, when the ball is stretched back, two conjugate half axes of
    an ellipse; turned in the plane by the right angle they are square to each other: its own half axes (Rytz).
    """
    extent, camera = posed.radii, _camera(posed)
    # The floor gives a camera inside a rim of no size.
    square = (camera * camera).sum(-1, keepdim=True).clamp_min(1 + 1e-6)
    x, y, z = camera.unbind(-1)
    level = x * x + y * y
    eps = torch.finfo(level.dtype).eps
    along_axis = level <= eps**2 * square[..., 0]
    safe = torch.where(along_axis, 1.0, level).sqrt()  # 1: the unused branch is differentiated too
    # The first direction lies across the long axis: a spheroid's rim needs no turn.
    first = torch.stack([torch.where(along_axis, 1.0, -y / safe), x / safe, torch.zeros_like(z)], -1)
    second = torch.linalg.cross(torch.nn.functional.normalize(camera, dim=-1), first) * extent
    first = first * extent
    one, two = (first * first).sum(-1, keepdim=True), (second * second).sum(-1, keepdim=True)
    skew = -2 * (first * second).sum(-1, keepdim=True)
    round_rim = torch.maximum(skew.abs(), (two - one).abs()) <= eps * (one + two)
    turn = torch.atan2(skew, torch.where(round_rim, 1.0, two - one)) / 2
    short = first * turn.cos() + second * turn.sin()
    long = second * turn.cos() - first * turn.sin()
    axes = torch.stack([short, long], -1)
    length = _length(axes.mT).mT  # (B, K, 1, 2)
    return _Rim(camera / square * extent, axes / length, (1 - 1 / square).sqrt() * length[..., 0, :])


def _rims(posed: PosedBody) -> Float[Tensor, "batch parts 14"]:
    """Of each ellipsoid what `_seen_point` needs: how far from its planes of symmetry `_across` can exist (no further
    than its centres of curvature are), and the rim's centre, axes and half axes.
    """
    radii = posed.radii.detach()
    square = radii.square()
    low, middle, _ = square.sort(-1).values.split(1, -1)
    near = torch.where(square > low, square - low, middle - low) / radii
    rim = _rim(posed)
    return torch.cat([near, rim.center, rim.axes.flatten(2), rim.radii], -1)


def _camera(posed: PosedBody) -> Float[Tensor, "batch parts 3"]:
    """Where the camera stands in the frame of each ellipsoid, stretched so that this is the unit ball."""
    return -(posed.centers[:, :, None] @ posed.frames)[:, :, 0] / posed.radii


def flattened(
    posed: PosedBody, share: Float[Tensor, "batch parts"]
) -> tuple[PosedBody, Float[Tensor, "batch parts 3 3"]]:
    """The body as if each part, with the points about it, were pressed to a `share` of its depth along its ray.

    The nearest point of the flatter ellipsoid is the likeliest one where the noise along rays is larger than across by
    1 / `share`, and the distance from it counts that noise as the one across. The frames are not rotations: they
    press points, too, so that `foot_point`, `foot_of_part` and `rough_distance` take the points as they are. Also
    returned: what takes a point from such a frame to the ellipsoid's own. Both are constants for autograd.
    """
    with torch.no_grad():
        ray = torch.nn.functional.normalize(posed.centers, dim=-1)[..., None]  # (B, K, 3, 1)
        less = share[..., None, None]
        unit = posed.frames / posed.radii[..., None, :]
        unit = unit + (1 / less - 1) * ray * (ray.mT @ unit)
        form = unit @ unit.mT  # 1 on the pressed surface
        # eigh raises for the whole batch where one row is not finite.
        sound = form.isfinite().all(-1, keepdim=True).all(-2, keepdim=True)
        square, axes = torch.linalg.eigh(torch.where(sound, form, torch.eye(3).to(form)))
        square = torch.where(sound[..., 0], square, torch.nan)
        frames = axes - (1 - less) * ray * (ray.mT @ axes)
        back = posed.frames.mT @ (axes + (1 / less - 1) * ray * (ray.mT @ axes))
    return replace(posed, frames=frames, radii=square.rsqrt()), back


def unflattened(
    foot: FootPoint,
    posed: PosedBody,
    part: Int[Tensor, "batch few num"],
    points: Float[Tensor, "batch num 3"],
    back: Float[Tensor, "batch parts 3 3"],
) -> FootPoint:
    """Foot points on the parts of a `flattened` body as those of the body itself, each in its ellipsoid's frame."""
    numbers = torch.cat([back.flatten(2), posed.frames.flatten(2), posed.centers, posed.radii], -1)
    turn, frames, centers, radii = _of_each(numbers, part).tensor_split((9, 18, 21), 2)
    local = (turn.unflatten(2, (3, 3)) * foot.local.mT[:, :, None]).sum(3)
    away = points.mT[:, None] - centers
    place = (frames.unflatten(2, (3, 3)) * away[:, :, :, None]).sum(2)
    gradient = local / radii**2
    normal = gradient * gradient.square().sum(2, keepdim=True).rsqrt()
    return FootPoint(local.mT, normal.mT, (place - local).mT, foot.hidden)


def algebraic_distance(
    posed: PosedBody, points: Float[Tensor, "batch num 3"]
) -> Float[Tensor, "batch parts num"]:
    """q(X) of (3.3): 0 on the surface, no unit, and smaller towards the poles than the Euclidean distance."""
    scaled = to_local(posed, points) / posed.radii[:, :, None]
    return (scaled * scaled).sum(-1) - 1


def rough_distance(
    posed: PosedBody, points: Float[Tensor, "#batch num 3"], visible: bool = True
) -> Float[Tensor, "batch parts num"]:
    """Distance to first order, m, without solving for the nearest point: exact for spheres and on long axes' ends.

    With `visible`, a point behind an ellipsoid's middle is as far as it lies behind it, too; without, one inside of an
    ellipsoid has a negative distance.
    """
    if visible:
        square = rough_square(posed, points)
        return square.clamp_min(torch.finfo(square.dtype).tiny).sqrt()
    distance, slope, _ = _rough(posed, points)
    return distance * slope.rsqrt()


def rough_square(
    posed: PosedBody, points: Float[Tensor, "#batch num 3"], visible: bool = True
) -> Float[Tensor, "batch parts num"]:
    """The square of `rough_distance`, m^2, in two thirds of the time."""
    distance, slope, behind = _rough(posed, points)
    square = distance.square() / slope
    return square + behind.clamp_min(0).square() if visible else square


def _rough(posed: PosedBody, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Distances to first order times a slope, its square, and how far points lie behind the middles, m.

    Level and slope of an ellipsoid's form are square forms of the point, so one product gives those of all pairs.
    """
    # From the middle of the points: the squares of the distances to the camera would cost digits.
    pivot = points.detach().mean(1)
    off = pivot[:, None] - posed.centers
    unit = posed.frames.mT / posed.radii[..., None]
    place = torch.cat([unit, unit @ off[..., None]], -1)  # (B, K, 3, 4)
    steep = place / posed.radii[..., None]
    forms = torch.cat([place.mT @ place, steep.mT @ steep], 1).flatten(2)
    one = torch.nn.functional.pad(points - pivot[:, None], (0, 1), value=1.0).mT  # (B, 4, N)
    squares = forms @ (one[:, :, None] * one[:, None]).flatten(1, 2)
    level, slope = squares.clamp_min(torch.finfo(squares.dtype).tiny).chunk(2, 1)
    ray = torch.nn.functional.normalize(posed.centers, dim=-1)
    behind = torch.cat([ray, (ray * off).sum(-1, keepdim=True)], -1) @ one
    return level - level.sqrt(), slope, behind


def outline(posed: PosedBody, num: int = 32) -> Float[Tensor, "batch parts num 3"]:
    """Points on the rim of each ellipsoid, where the camera's rays touch it, m in the camera's frame."""
    rim = _rim(posed)
    turn = torch.arange(num, dtype=rim.radii.dtype, device=rim.radii.device) * (2 * torch.pi / num)
    circle = torch.stack([turn.cos(), turn.sin()], -1)  # (num, 2)
    return to_camera(posed, rim.center[:, :, None] + (circle * rim.radii[:, :, None]) @ rim.axes.mT)
