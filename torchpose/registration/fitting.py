"""The M-step: the pose that brings the body's points to their targets (T. 3.24, App. E).

Every measurement is a row: a point fixed to a part, a target in the camera's frame and a direction along
which their difference counts. Metres; a direction is divided by the row's standard deviation, so residuals
have no unit.
"""

from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.body.model import BodyModel, PosedBody
from torchpose.least_squares import (
    Linearize,
    LMConfig,
    NormalEquations,
    Residual,
    Solution,
    Status,
    implicit_value,
    linearize_by_autograd,
    minimize,
    normal_equations,
)
from torchpose.registration.moment import MomentEquations, sum_rows


class JacobianKind(Enum):
    """Two ways to the same matrix: `autograd` is the reference, `geometric` the closed form of App. E."""

    autograd = "autograd"
    geometric = "geometric"


@dataclass(frozen=True)
class FittingConfig:
    jacobian: JacobianKind = JacobianKind.geometric
    # A round's steps: correspondences are renewed in between.
    lm: LMConfig = field(default_factory=lambda: LMConfig(max_steps=2))
    limit_sd: float = 0.05  # rad beyond a joint's limit that cost as much as one sigma; 0 switches limits off

    def __post_init__(self) -> None:
        if self.limit_sd < 0:
            raise ValueError(f"limit_sd must not be negative, got {self.limit_sd}; 0 switches the limits off")


@dataclass(frozen=True)
class Rows:
    """Linear measurements of points that are fixed to parts; a zero direction is an empty row."""

    part: Int[Tensor, "batch rows"]
    local: Float[Tensor, "batch rows 3"]  # m, the model's point in its part's frame
    target: Float[Tensor, "batch rows 3"]  # m, camera's frame
    direction: Float[Tensor, "batch rows 3"]  # 1/m, camera's frame: unit direction / standard deviation

    def points(self, posed: PosedBody) -> Float[Tensor, "batch rows 3"]:
        """The model's points in the camera's frame, m."""
        index = self.part[..., None]
        frames = posed.frames.flatten(2).gather(1, index.expand(-1, -1, 9)).unflatten(2, (3, 3))
        centers = posed.centers.gather(1, index.expand(-1, -1, 3))
        return (frames @ self.local[..., None])[..., 0] + centers

    @staticmethod
    def cat(*rows: "Rows") -> "Rows":
        return Rows(*(torch.cat([getattr(r, name) for r in rows], 1) for name in Rows.__dataclass_fields__))


@dataclass(frozen=True)
class PosePrior:
    """A Gaussian on the pose parameters, independent ones: precision 0 says nothing."""

    mean: Float[Tensor, "batch parameters"]
    precision: Float[Tensor, "batch parameters"]


Given = TypeVar("Given", Rows, PosePrior)


def fit_pose(
    body: BodyModel,
    start: Float[Tensor, "batch parameters"],
    size: Float[Tensor, "#batch sizes"],
    rows: Rows,
    prior: PosePrior,
    config: FittingConfig,
    posed: PosedBody | None = None,
) -> Solution:
    """The pose that minimises the rows' squares, the prior's and those of broken limits, from `start`.

    The answer's `value` is differentiable in the rows, the size and the prior, not in the start, by the implicit
    function theorem (see `implicit_value`: nothing of the steps is kept, and nothing is done where no gradient is asked
    for). Rows with status NON_FINITE get gradients of 0, rows out of steps those of a Newton step from where they
    stopped.

    Args:
        start: where to begin.
        size: of each person, or of the one.
        posed: the body at `start`, if it is at hand.
    """
    with torch.no_grad():
        solution = _minimize(body, start, size, rows, prior, config, posed)
    inputs = (size, *_floats(rows).values(), *_floats(prior).values())
    if not (torch.is_grad_enabled() and any(x.requires_grad for x in inputs)):
        return solution
    # A broken row would turn its zeros into NaN on the way back.
    sound = solution.status != int(Status.NON_FINITE)
    value = torch.where(sound[:, None], solution.value, 0.0)
    size = torch.where(sound[:, None], size, 1.0)
    rows, prior = _silenced(rows, ~sound), _silenced(prior, ~sound)
    with torch.no_grad():
        posed = body(value, size)
    equations = equations_by_moments(body, size, rows, prior, config, posed)
    value = implicit_value(equations, replace(solution, value=value))
    return replace(solution, value=torch.where(sound[:, None], value, solution.value))


def _floats(data: Rows | PosePrior) -> dict[str, Tensor]:
    values = {name: getattr(data, name) for name in data.__dataclass_fields__}
    return {name: x for name, x in values.items() if isinstance(x, Tensor) and x.is_floating_point()}


def _silenced(data: Given, where: Bool[Tensor, " batch"]) -> Given:
    """With zeros, which say nothing, for some of the batch."""
    quiet = {
        name: torch.where(where.view(-1, *[1] * (x.ndim - 1)), 0.0, x) for name, x in _floats(data).items()
    }
    return replace(data, **quiet)


def _minimize(
    body: BodyModel,
    start: Tensor,
    size: Tensor,
    rows: Rows,
    prior: PosePrior,
    config: FittingConfig,
    posed: PosedBody | None,
) -> Solution:
    if config.jacobian is JacobianKind.autograd:
        equations = normal_equations(linearize_by_autograd(pose_residual(body, size, rows, prior, config)))
    else:
        posed = body(start, size) if posed is None else posed
        equations = equations_by_moments(body, size, rows, prior, config, posed)
    return minimize(equations, start, config.lm)


def equations_by_moments(
    body: BodyModel,
    size: Float[Tensor, "#batch sizes"],
    rows: Rows,
    prior: PosePrior,
    config: FittingConfig,
    posed: PosedBody,
) -> NormalEquations:
    """The normal equations of rows, prior and limits; the rows are summed once, near where the body is `posed`."""
    residual = (rows.direction * (rows.target - rows.points(posed))).sum(-1)
    moments = sum_rows(rows.part, rows.local, rows.direction, residual, posed)
    of_rows = MomentEquations(moments, body.part_moves)

    def equations(pose: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        residual, jacobian = _pose_terms(body, pose, prior, config)
        columns = torch.cat([jacobian, residual[..., None]], 2)
        whole = torch.baddbmm(of_rows(body(pose, size)), columns.mT, columns)
        # Where the sum of squares is 0 its terms still cancel only up to rounding.
        return 0.5 * whole[:, -1, -1].clamp_min(0), whole[:, :-1, -1], whole[:, :-1, :-1]

    return equations


def pose_residual(
    body: BodyModel, size: Float[Tensor, "#batch sizes"], rows: Rows, prior: PosePrior, config: FittingConfig
) -> Residual:
    """All residuals as a function of the pose: rows, prior, limits."""

    def residual(pose: Tensor) -> Tensor:
        posed = body(pose, size)
        gap = rows.target - rows.points(posed)
        return torch.cat([(rows.direction * gap).sum(-1), _pose_terms(body, pose, prior, config)[0]], 1)

    return residual


def linearize_by_screws(
    body: BodyModel, size: Float[Tensor, "#batch sizes"], rows: Rows, prior: PosePrior, config: FittingConfig
) -> Linearize:
    """The same residuals with their Jacobian in closed form."""

    def linearize(pose: Tensor) -> tuple[Tensor, Tensor]:
        return linearize_posed(body, pose, body(pose, size), rows, prior, config)

    return linearize


def linearize_posed(
    body: BodyModel,
    pose: Float[Tensor, "batch parameters"],
    posed: PosedBody,
    rows: Rows,
    prior: PosePrior,
    config: FittingConfig,
) -> tuple[Float[Tensor, "batch residuals"], Float[Tensor, "batch residuals parameters"]]:
    """Residuals and Jacobian at one pose, with the body `posed` there: (p x n, n) of a row against each screw.

    With the screw S = (w, o x w) of an axis w through o, n . (w x (p - o)) = (p x n, n) . S; a translation
    along w is the screw (0, w). One product serves all rows and joints; rows of parts that a joint does not
    move are masked.
    """
    points = rows.points(posed)
    wrench = torch.cat([torch.linalg.cross(points, rows.direction), rows.direction], -1)
    turning = torch.cat([posed.screw_axes, torch.linalg.cross(posed.screw_origins, posed.screw_axes)], -1)
    sliding = torch.cat([torch.zeros_like(posed.screw_axes), posed.screw_axes], -1)
    screws = torch.cat([sliding[:, :3], turning[:, 3:]], 1)
    moves = body.part_moves.to(wrench)[rows.part]  # (B, R, P)
    residual, jacobian = _pose_terms(body, pose, prior, config)
    gap = (rows.direction * (rows.target - points)).sum(-1)
    return torch.cat([gap, residual], 1), torch.cat([-(wrench @ screws.mT) * moves, jacobian], 1)


def _pose_terms(
    body: BodyModel, pose: Tensor, prior: PosePrior, config: FittingConfig
) -> tuple[Float[Tensor, "batch terms"], Float[Tensor, "batch terms parameters"]]:
    """Residuals of the prior and of broken limits, and their Jacobian."""
    # The root of 0 has no derivative.
    silent = prior.precision == 0
    slopes = [torch.where(silent, 1.0, prior.precision).sqrt() * ~silent]
    residuals = [slopes[0] * (pose - prior.mean)]
    if config.limit_sd > 0:
        over = pose - torch.minimum(torch.maximum(pose, body.low), body.high)
        slopes.append((over != 0).to(pose) / config.limit_sd)
        residuals.append(over / config.limit_sd)
    return torch.cat(residuals, 1), torch.cat([torch.diag_embed(slope) for slope in slopes], 1)
