"""Sums over a part's measurements from which the loss, its gradient and J^T J follow at any pose.

A measurement is a row: a point fixed to a part, at `local` in the part's frame, and a `direction` along which its
distance from a target counts. Its residual is linear in the part's frame T = (R | t), 3 x 4:

    r(T) = r_0 - n^T (T - T_0) h,   n = direction,   h = (local, 1),   r_0 = r(T_0)

so the products a a^T of a = (n h^T, r_0), 13 numbers, summed over the rows of each part, say all that the rows say.
With T_0 the frame at the start nothing large cancels in single precision: what is summed is the residual there, and
what it is multiplied by is how far the part has moved since. Camera's frame, metres.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.body.model import PosedBody
from torchpose.geometry import GENERATORS

# Rows whose products are held at once, 100 numbers each: larger tables leave the cache and take twice the time.
CHUNK = 2**14
# Of a symmetric 4 x 4 matrix ten entries are enough.
UPPER = torch.triu_indices(4, 4)


def _places() -> Int[Tensor, "169"]:
    """Where among the 100 products each entry of a a^T is: a_(4 i + j) = m_i h_j for i < 3, and m_3 h_3."""
    order = torch.zeros(4, 4, dtype=torch.long)
    order[UPPER[0], UPPER[1]] = order[UPPER[1], UPPER[0]] = torch.arange(10)
    i, j = torch.arange(13) // 4, torch.tensor([0, 1, 2, 3] * 3 + [3])
    return (10 * order[i[:, None], i] + order[j[:, None], j]).flatten()


PLACES = _places()
BOTTOM = torch.tensor([0.0, 0.0, 0.0, 1.0])  # a frame's fourth row
SHIFT = [3, 7, 11]  # the entries n of a
SLIDES = 3  # the first parameters of a pose move the body along their axes, the others turn it about them


@dataclass(frozen=True)
class Moments:
    """The summed rows of each part, and where the parts stood."""

    matrix: Float[Tensor, "batch parts 13 13"]  # sum of a a^T, no unit
    frames: Float[Tensor, "batch parts 3 4"]  # T_0 = (R | t), t from `pivot`
    pivot: Float[Tensor, "batch 1 3"]  # m, a point of the body: the turns' levers are taken about it


def sum_rows(
    part: Int[Tensor, "batch points"],
    local: Float[Tensor, "batch points 3"],
    direction: Float[Tensor, "batch rows 3"],
    residual: Float[Tensor, "batch rows"],
    posed: PosedBody,
    tripled: int = 0,
) -> Moments:
    """The moments of all parts; `residual` is that of each row with the body as `posed`.

    Every a is a choice from the products of m = (n, r_0) and h, so the ten of m m^T times the ten of h h^T are
    summed. A row belongs to the point of its number, but the first `tripled` points have three: their first
    directions come first, then their second, then their third.
    """
    K, upper = posed.centers.shape[1], UPPER.to(part.device)
    m = torch.cat([direction.mT, residual[:, None]], 1)  # (B, 4, R): rows last, each factor in one piece
    mm = m.index_select(1, upper[0]) * m.index_select(1, upper[1])
    if tripled > 0:
        first = mm[..., : 3 * tripled].unflatten(2, (3, tripled)).sum(2)
        mm = torch.cat([first, mm[..., 3 * tripled :]], 2)
    at_once = max(1, CHUNK // max(part.shape[1], 1))  # frames of the batch
    chunks = zip(*(x.split(at_once) for x in (part, local, mm)), strict=True)
    matrix = torch.cat([_sum_products(p, x, products, K) for p, x, products in chunks])
    pivot = posed.origins[:, :1]
    return Moments(matrix, _frames(posed, pivot), pivot)


def _sum_products(part: Tensor, local: Tensor, mm: Tensor, parts: int) -> Tensor:
    B, R = part.shape
    upper = UPPER.to(part.device)
    h = torch.cat([local.mT, torch.ones_like(local[..., :1]).mT], 1)
    hh = h.index_select(1, upper[0]) * h.index_select(1, upper[1])
    products = (mm[:, :, None] * hh[:, None]).flatten(1, 2)  # (B, 100, R)
    member = torch.zeros(B, parts, R, dtype=local.dtype, device=local.device)
    sums = member.scatter(1, part[:, None], 1.0) @ products.mT
    return sums.index_select(2, PLACES.to(part.device)).unflatten(2, (13, 13))


@dataclass(frozen=True)
class MomentEquations:
    """The normal equations of the rows' squares as a function of the posed body, whatever the number of rows."""

    moments: Moments
    moves: Bool[Tensor, "parts parameters"]  # which parameter moves which part

    def __call__(self, posed: PosedBody) -> Float[Tensor, "batch parameters_1 parameters_1"]:
        """(J | r)^T (J | r), summed over the rows: J^T J, beside it J^T r, and |r|^2 in the corner."""
        columns = self._columns(posed)
        return columns.flatten(1, 2).mT @ (self.moments.matrix @ columns).flatten(1, 2)

    def loss(self, posed: PosedBody) -> Float[Tensor, " batch"]:
        """|r|^2 alone, the corner of the whole: in a fraction of its time."""
        moments = self.moments
        moved = (_frames(posed, moments.pivot) - moments.frames).flatten(2)
        column = torch.cat([moved, torch.full_like(moved[..., :1], -1.0)], 2)[..., None]
        return (column * (moments.matrix @ column)).sum((1, 2, 3))

    def by_offset(self, posed: PosedBody) -> Float[Tensor, "batch parameters parts_3"]:
        """J^T N, 1/m, N the derivatives of the residuals by a shift of each part's points, along the part's axes.

        Of equations J^T J x = -J^T r, -(J^T J)^-1 J^T N b is how far x goes where all points of each part are off by b.
        """
        frames = self.moments.matrix.new_zeros(*posed.frames.shape[:2], 13, 3)
        frames[..., SHIFT, :] = posed.frames
        own = (self.moments.matrix @ frames).mT  # (B, K, 3, 13): each part's rows hear of its own shift alone
        return (own @ self._columns(posed)[..., :-1]).flatten(1, 2).mT

    def extent(self, posed: PosedBody) -> Float[Tensor, "batch parts"]:
        """How far the rows of each part are spread along it: their variance to that of an even spread over its length.

        The weights are the directions' squares; a part without rows has 0.
        """
        first, square, seen = self._along()
        variance = torch.where(seen, square - first.square(), 0.0).clamp_min(0)
        return 3 * variance / posed.radii[..., 2].square()

    def reach(self, posed: PosedBody, joint: Float[Tensor, "batch parts 3"]) -> Float[Tensor, "batch parts"]:
        """How far the rows of each part are from its joint along it: their mean square to an even spread's, at most 1.

        It is what they say of the part's direction to what they would say if all of it showed. The weights are the
        directions' squares; a part without rows has 0.

        Args:
            joint: m, that each part turns about.
        """
        first, square, seen = self._along()
        start = ((joint - posed.centers) * posed.frames[..., 2]).sum(-1)
        away = torch.where(seen, square - 2 * start * first + start.square(), 0.0)
        return (away / (start.square() + posed.radii[..., 2].square() / 3)).clamp(0, 1)

    def _along(self) -> tuple[Tensor, Tensor, Tensor]:
        """Mean and mean square of the rows' places along each part, m from its centre, and whether there are any."""
        z, one = [2, 6, 10], SHIFT  # the entries n h_2 and n of a: their products, added over n
        matrix = self.moments.matrix
        square, first, weight = (matrix[..., i, j].sum(-1) for i, j in ((z, z), (z, one), (one, one)))
        seen = weight > 0
        weight = torch.where(seen, weight, 1.0)
        return first / weight, square / weight, seen

    def weighted(self, weight: Float[Tensor, "batch parts"]) -> "MomentEquations":
        """With the squares of each part's rows times a weight."""
        matrix = self.moments.matrix * weight[..., None, None]
        return replace(self, moments=replace(self.moments, matrix=matrix))

    def _columns(self, posed: PosedBody) -> Float[Tensor, "batch parts 13 parameters_1"]:
        """What the derivatives by the parameters, and the residual, take of each part's a."""
        moments = self.moments
        frames = _frames(posed, moments.pivot)
        B, K = frames.shape[:2]
        # A parameter changes T by its twist (hat(w) | v) times (T; 0 0 0 1).
        bottom = BOTTOM.to(frames).expand(B, 1, K, 4)
        square = torch.cat([frames.transpose(1, 2), bottom], 1).flatten(2)  # (B, 4, 4 K)
        change = _twists(posed, moments.pivot).flatten(1, 2) @ square
        # The last column is how far each part has moved since the sums were made.
        moved = (frames - moments.frames).transpose(1, 2)[:, None]
        both = torch.cat([change.view(B, -1, 3, K, 4), moved], 1).permute(0, 3, 2, 4, 1)
        both = both * torch.nn.functional.pad(self.moves, (0, 1), value=True)[:, None, None]
        # a^T (dT, 0) = -dr and a^T (T - T_0, -1) = -r: the signs meet.
        last = both.new_zeros(both.shape[-1])
        last[-1] = -1
        return torch.cat([both.flatten(2, 3), last.expand(B, K, 1, -1)], 2)


def _frames(posed: PosedBody, pivot: Tensor) -> Float[Tensor, "batch parts 3 4"]:
    return torch.cat([posed.frames, (posed.centers - pivot)[..., None]], -1)


def _twists(posed: PosedBody, pivot: Tensor) -> Float[Tensor, "batch parameters 3 4"]:
    """What each parameter does: a turn about its axis through its origin, seen from `pivot`, or a slide."""
    slide, turn = posed.screw_axes.tensor_split([SLIDES], 1)
    origins = (posed.screw_origins - pivot)[:, SLIDES:]
    w = torch.cat([torch.zeros_like(slide), turn], 1)
    v = torch.cat([slide, torch.linalg.cross(origins, turn)], 1)
    return torch.cat([(w @ GENERATORS.to(w)).unflatten(2, (3, 3)), v[..., None]], -1)
