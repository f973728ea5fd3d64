"""Rotations: the exponential map, its derivative and its inverse, minimal rotations and axis pairs.

Rotation vectors are in radians; every function takes any number of leading batch axes, any device and any
float dtype.
"""

from math import factorial

import torch
from jaxtyping import Float
from torch import Tensor


def hat(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The skew matrix with `hat(a) @ b = a x b`."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


# sin(t)/t, (1 - cos t)/t^2 and (t - sin t)/t^3 as series in -t^2: 1 / (2k + 1)!, 1 / (2k + 2)! and 1 / (2k + 3)!.
SERIES = torch.tensor([[1 / factorial(2 * k + n) for n in (1, 2, 3)] for k in range(4)], dtype=torch.float64)
# v @ GENERATORS are the nine entries of hat(v): one product in the place of nine small operations.
GENERATORS = hat(torch.eye(3)).flatten(1)


def _sinc_terms(theta2: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3"]:
    """sin(t)/t, (1 - cos t)/t^2 and (t - sin t)/t^3 of t^2, smooth through zero."""
    # Below 1e-2 the differences cancel; the series' first dropped term is then below 1e-16.
    small = theta2 < 1e-4
    # Both branches of `where` are differentiated, so the unused one must stay finite: hence 1.
    square = torch.where(small, 1.0, theta2)
    theta = square.sqrt()
    sine, half = theta.sin(), (0.5 * theta).sin()
    far = torch.stack([sine / theta, 2 * half * half / square, (theta - sine) / (square * theta)], -1)
    first, second, third, near = SERIES.to(theta2).unbind()
    for coefficients in (third, second, first):
        near = torch.addcmul(coefficients, theta2[..., None], near, value=-1)
    return torch.where(small[..., None], near, far)


def rotation_and_left_jacobian(
    vector: Float[Tensor, "*batch 3"],
) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3 3"]]:
    """`exp_rotation` and `left_jacobian` of the same vectors, for the price of one."""
    a, b, c = _sinc_terms((vector * vector).sum(-1))[..., None, None].unbind(-3)
    skew = (vector @ GENERATORS.to(vector)).unflatten(-1, (3, 3))
    square = skew @ skew
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return torch.addcmul(eye + a * skew, b, square), torch.addcmul(eye + b * skew, c, square)


def exp_rotation(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrix of a rotation vector (Rodrigues' formula), differentiable everywhere."""
    return rotation_and_left_jacobian(vector)[0]


def left_jacobian(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix J with `d exp(v) = hat(J dv) exp(v)`: column k is the axis about which v_k turns."""
    return rotation_and_left_jacobian(vector)[1]


def rotation_between(
    start: Float[Tensor, "*batch 3"], end: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Rotation vector of the smallest rotation that turns the unit vector `start` into `end`.

    Opposite vectors leave the axis undefined; an axis across `start` is then taken. Differentiable elsewhere,
    also where the two are equal.
    """
    axis = torch.linalg.cross(start, end)
    # Near opposite vectors the axis is as short as its rounding error, whose part along `start` would spoil
    # the turn.
    axis = axis - (axis * start).sum(-1, keepdim=True) * start
    square = (axis * axis).sum(-1, keepdim=True)
    cosine = (start * end).sum(-1, keepdim=True)
    parallel = square < torch.finfo(start.dtype).eps ** 2
    sine = torch.where(parallel, 1.0, square).sqrt()  # 1: the unused branch is differentiated too
    vector = axis * torch.where(parallel, 1.0, torch.atan2(sine, cosine) / sine)
    # The unit vector furthest from `start` is never parallel to it.
    least = torch.nn.functional.one_hot(start.abs().argmin(-1), 3).to(start)
    across = torch.nn.functional.normalize(torch.linalg.cross(start, least), dim=-1)
    return torch.where(parallel & (cosine < 0), across * torch.pi, vector)


def angle_between(
    first: Float[Tensor, "*batch 3"], second: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """Angle between two vectors of any length, rad in [0, pi]; exact near 0 and pi, where arccos is not."""
    cross = torch.linalg.cross(first, second)
    # A norm has no derivative at zero, where aligned vectors lie; the floor makes it 0 there.
    cross = (cross * cross).sum(-1).clamp_min(torch.finfo(first.dtype).tiny).sqrt()
    return torch.atan2(cross, (first * second).sum(-1))


def axis_pair_angles(
    axes: Float[Tensor, "*batch 2 3"], start: Float[Tensor, "*batch 3"], end: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 2 2"]:
    """Both pairs (t1, t2) with `exp(axis_1 t1) exp(axis_2 t2) start = end` (Paden-Kahan's second problem).

    The axes are unit vectors at a right angle to each other. Where `end` cannot be reached, the nearest
    direction that can is taken. Returns angles in radians, one solution per row of the second last axis.
    """
    first, second = axes.unbind(-2)
    third = torch.linalg.cross(first, second)
    # In the frame (first, second, third) the turn about `second` must bring start's part along `first` to
    # end's.
    along = (first * end).sum(-1)
    level = (first * start).sum(-1)
    side = (third * start).sum(-1)
    radius = torch.hypot(level, side)
    base = torch.atan2(side, level)  # start's direction in the (first, third) plane
    bend = torch.acos((along / radius.clamp_min(torch.finfo(end.dtype).tiny)).clamp(-1, 1))
    middle = (second * start).sum(-1)
    solutions = []
    for sign in (1.0, -1.0):
        t2 = base - sign * bend  # a turn by t2 about `second` takes angle `base` to `base - t2`
        rest = radius * torch.sin(base - t2)  # what then lies along `third`
        t1 = torch.atan2((third * end).sum(-1), (second * end).sum(-1)) - torch.atan2(rest, middle)
        solutions.append(torch.stack([t1, t2], -1))
    both = torch.stack(solutions, -2)
    return torch.remainder(both + torch.pi, 2 * torch.pi) - torch.pi
