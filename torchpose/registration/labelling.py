"""The VE-step: a mean field over the points' body parts, with Potts and geodesic terms (T. 3.18 to 3.21).

Labels stand before points, (B, L, N): the softmax over labels is then nine times faster. The last label may
mean "no part". Probabilities and log-potentials have no unit, geodesic distances are in metres.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

# Grid neighbours within radius 2 never share (row + 2 column) mod 5: five sets, each updated at once.
COLOURS = 5
VECTOR = 16  # numbers of single precision in the widest register


@dataclass(frozen=True)
class LabellingConfig:
    sweeps: int = 2  # the field settles in 3 to 4; the poses are the same from 2 on
    potts: float = 0.5  # gamma of (3.8)
    # Update one independent set after another: the bound then never falls, at 5 times the cost. For the
    # neighbours within radius 2.
    coloured: bool = False
    geodesic: float = 0.0  # alpha = beta of (3.12) times M_v / M_c; T. has 0.04. Off: it costs accuracy

    def __post_init__(self) -> None:
        if self.sweeps < 0:
            raise ValueError(f"sweeps must not be negative, got {self.sweeps}; 0 labels each point alone")
        if self.potts < 0 or self.geodesic < 0:
            raise ValueError(
                f"potts and geodesic must not be negative, got {self.potts} and {self.geodesic}; 0 is off"
            )


@dataclass(frozen=True)
class GeodesicTerm:
    """What the pairwise geodesic potential needs: cells, their distances, and what the body allows."""

    cell: Int[Tensor, "batch num"]  # cell of each point, -1 on padding
    distance: Float[Tensor, "batch cells cells"]  # m, along the cloud
    shortest: Float[Tensor, "labels labels"]  # m, d_min of (3.12)
    longest: Float[Tensor, "labels labels"]  # m, d_max
    most: Float[Tensor, " labels"]  # M_v: the greatest share of cells that carries a label


@dataclass(frozen=True)
class Labelling:
    """Beliefs after the VE-step."""

    belief: Float[Tensor, "batch labels num"]  # q_i(v); 0 on padding
    # The part of (C.8) that labels change, of these beliefs; with `history` before and after each sweep. Without the
    # geodesic term, whose hardened cells have no bound.
    bound: Float[Tensor, "bounds batch"]


def mean_field(
    potential: Float[Tensor, "batch labels num"],
    neighbours: Int[Tensor, "batch num near"],
    mask: Bool[Tensor, "batch num"],
    config: LabellingConfig,
    grid: Int[Tensor, "batch num 2"] | None = None,
    geodesic: GeodesicTerm | None = None,
    history: bool = False,
) -> Labelling:
    """q_i(v) ~ exp(f_i(v) + gamma sum_j q_j(v) + sum_cells g(v, v_j)) (3.20), starting at softmax(f) (3.21).

    Args:
        potential: f_i(v), log-potentials of each point alone.
        neighbours: indices into the points, N where there is none; symmetric.
        mask: False on padding.
        grid: row and column of each point, needed for coloured updates.
        history: give the bounds of all sweeps, not of the last alone: together they take as long as the sweeps.
    """
    if config.coloured and grid is None:
        raise ValueError("coloured updates need the points' grid positions, got grid=None")
    belief = potential.softmax(1) * mask[:, None]
    bags = _bags(neighbours) if config.potts > 0 else None
    near = _near(belief, bags)
    bounds = [_bound(potential, belief, near, config.potts)] if history or config.sweeps == 0 else []
    colour = None if grid is None else (grid[..., 0] + 2 * grid[..., 1]) % COLOURS
    for sweep in range(config.sweeps):
        for now in range(COLOURS if config.coloured else 1):
            field = potential if near is None else torch.add(potential, near, alpha=config.potts)
            if geodesic is not None and config.geodesic > 0:
                field = field + _geodesic_field(belief, geodesic, config.geodesic)
            updated = field.softmax(1) * mask[:, None]
            if config.coloured and colour is not None:
                belief = torch.where((colour == now)[:, None], updated, belief)
            else:
                belief = updated
            near = _near(belief, bags)
        if history or sweep == config.sweeps - 1:
            bounds.append(_bound(potential, belief, near, config.potts))
    return Labelling(belief, torch.stack(bounds))


def neighbour_sum(
    belief: Float[Tensor, "batch labels num"], neighbours: Int[Tensor, "batch num near"]
) -> Float[Tensor, "batch labels num"]:
    """Sum of the neighbours' beliefs. `embedding_bag` never builds the B x N x near x L table."""
    return _sum_of(belief, _bags(neighbours))


def _bags(neighbours: Int[Tensor, "batch num near"]) -> Int[Tensor, "points near"]:
    """Each point's neighbours among the rows of all frames' tables, of N + 1 rows each."""
    B, N = neighbours.shape[:2]
    first = torch.arange(B, device=neighbours.device)[:, None, None] * (N + 1)
    return (neighbours + first).flatten(0, 1)


def _near(belief: Tensor, bags: Tensor | None) -> Tensor | None:
    """The Potts term's field over gamma, the neighbours' beliefs; None without one."""
    return None if bags is None else _sum_of(belief, bags)


def _sum_of(belief: Tensor, bags: Tensor) -> Float[Tensor, "batch labels num"]:
    B, L, N = belief.shape
    # Rows of whole vector registers: summing 15 labels takes ten times as long as summing 16.
    width = -(-L // VECTOR) * VECTOR
    table = torch.nn.functional.pad(belief, (0, 1, 0, width - L)).transpose(1, 2)
    # In one piece also where a view would do: of a table whose rows are not, the sums take eight times as long.
    table = table.contiguous().view(B * (N + 1), width)
    summed = torch.nn.functional.embedding_bag(bags, table, mode="sum")
    return summed.view(B, N, width)[..., :L].transpose(1, 2)


def label_bound(
    potential: Float[Tensor, "batch labels num"],
    belief: Float[Tensor, "batch labels num"],
    neighbours: Int[Tensor, "batch num near"],
    potts: float,
) -> Float[Tensor, " batch"]:
    """E_q[log p(V, D)] - E_q[log q] up to a constant (C.8): points, pairs counted once, and entropy."""
    return _bound(potential, belief, neighbour_sum(belief, neighbours) if potts > 0 else None, potts)


def _bound(potential: Tensor, belief: Tensor, near: Tensor | None, potts: float) -> Float[Tensor, " batch"]:
    # An impossible label has belief 0 and potential minus infinity: their product is 0 here.
    gain = torch.where(belief > 0, potential, 0.0)
    # A plain logarithm is twice as fast as `xlogy`, and its derivative is finite at 0.
    gain = gain - belief.clamp_min(torch.finfo(belief.dtype).tiny).log()
    if near is not None:
        gain = torch.add(gain, near, alpha=0.5 * potts)  # each pair counts once
    return (belief * gain).sum((1, 2))


def _geodesic_field(
    belief: Float[Tensor, "batch labels num"], term: GeodesicTerm, strength: float
) -> Float[Tensor, "batch labels num"]:
    """Sum over cells of log P_geo (3.12), each cell hardened to its best label as in T.

    A cell with label w speaks with alpha = strength M_c / M_w: all that may carry w speak with strength M_c.
    """
    B, L, _ = belief.shape
    C = term.distance.shape[1]
    slot = torch.where(term.cell < 0, C, term.cell)
    total = belief.new_zeros(B, L, C + 1).scatter_add_(2, slot[:, None].expand(-1, L, -1), belief)
    seen = total[..., :C].sum(1) > 0
    label = total[..., :C].argmax(1)  # (B, C), w
    distance = term.distance[:, None]  # (B, 1, C, C): from the point's cell to the other
    # (B, L, 1, C), for a point labelled v. No product with one-hot labels: 0 times an infinite bound is NaN.
    shortest, longest = (
        bound[:, label].transpose(0, 1)[:, :, None] for bound in (term.shortest, term.longest)
    )
    weight = strength / term.most.clamp_min(1 / C)[label] * seen  # alpha = beta of (3.12)
    outside = (distance < shortest) | (distance > longest)
    # Cells on another piece of the cloud say nothing: the way between them was not seen.
    outside = outside & distance.isfinite()
    field = -(outside.to(belief) * weight[:, None, None]).sum(-1)  # (B, L, C)
    field = torch.cat([field, field.new_zeros(B, L, 1)], 2)
    return field.gather(2, slot[:, None].expand(-1, L, -1))
