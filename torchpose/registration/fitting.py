"""The M-step: the pose that brings the body's points to their targets (T. 3.24, App. E).

Every measurement is a row: a point fixed to a part, a target in the camera's frame and a direction along
which their difference counts. Metres; a direction is divided by the row's standard deviation, so residuals
have no unit.
"""

from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.body.model import BodyModel, PosedBody
from torchpose.least_squares import (
    Linearize,
    LMConfig,
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
    # A round's steps: correspondences are renewed in between, and a second one before that gains nothing.
    lm: LMConfig = field(default_factory=lambda: LMConfig(max_steps=1))
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
    # The first 3 T rows are T points' first, then second, then third directions: what repeats is summed once.
    tripled: int = 0

    def points(self, posed: PosedBody) -> Float[Tensor, "batch rows 3"]:
        """The model's points in the camera's frame, m."""
        places = torch.cat([posed.frames, posed.centers[..., None]], -1)  # (B, K, 3, 4)
        # With the rows last in memory every operation runs along them: faster than a small product for each.
        own = places.flatten(2).mT.gather(2, self.part[:, None].expand(-1, 12, -1)).unflatten(1, (3, 4))
        return ((own[:, :, :3] * self.local.mT[:, None]).sum(2) + own[:, :, 3]).mT

    def residual(self, posed: PosedBody) -> Float[Tensor, "batch rows"]:
        """How far each row is from its target along its direction, no unit."""
        once = self.once()
        gap = (once.target - once.points(posed)).mT
        direction = self.direction.mT
        if self.tripled == 0:
            return (direction * gap).sum(1)
        T = self.tripled
        first = direction[..., : 3 * T].unflatten(2, (3, T)) * gap[:, :, None, :T]
        rest = direction[..., 3 * T :] * gap[..., T:]
        return torch.cat([first.sum(1).flatten(1), rest.sum(1)], 1)

    def once(self) -> "Rows":
        """One row of each point: its first."""
        if self.tripled == 0:
            return self
        T = self.tripled
        part, local, target, direction = (
            torch.cat([x[:, :T], x[:, 3 * T :]], 1)
            for x in (self.part, self.local, self.target, self.direction)
        )
        return Rows(part, local, target, direction)

    @staticmethod
    def cat(first: "Rows", rest: "Rows") -> "Rows":
        """Both; `rest` must have no tripled rows."""
        part, local, target, direction = (
            torch.cat([getattr(first, name), getattr(rest, name)], 1)
            for name in ("part", "local", "target", "direction")
        )
        return Rows(part, local, target, direction, first.tripled)


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
) -> Solution:
    """The pose that minimises the rows' squares, the prior's and those of broken limits, from `start`.

    The answer's `value` is differentiable in the rows, the size and the prior, not in the start, by the implicit
    function theorem (see `implicit_value`: nothing of the steps is kept, and nothing is done where no gradient is asked
    for). Rows with status NON_FINITE get gradients of 0, rows out of steps those of a Newton step from where they
    stopped.

    Args:
        start: where to begin.
        size: of each person, or of the one.
    """
    return fit_posed(body, start, size, rows, prior, config, body(start, size))[0]


def fit_posed(
    body: BodyModel,
    start: Float[Tensor, "batch parameters"],
    size: Float[Tensor, "#batch sizes"],
    rows: Rows,
    prior: PosePrior,
    config: FittingConfig,
    posed: PosedBody,
) -> tuple[Solution, PosedBody]:
    """`fit_pose` where the body at `start` is at hand, `posed`; and the body in the pose that is found."""
    with torch.no_grad():
        solution, found = _minimize(body, start, size, rows, prior, config, posed)
    inputs = (size, *_floats(rows).values(), *_floats(prior).values())
    if not (torch.is_grad_enabled() and any(x.requires_grad for x in inputs)):
        return solution, found
    # A broken row would turn its zeros into NaN on the way back.
    sound = solution.status != int(Status.NON_FINITE)
    value = torch.where(sound[:, None], solution.value, 0.0)
    sizes = torch.where(sound[:, None], size, 1.0)
    rows, prior = _silenced(rows, ~sound), _silenced(prior, ~sound)
    with torch.no_grad():
        posed = body(value, sizes)
    equations = equations_by_moments(body, sizes, rows, prior, config, posed)
    value = implicit_value(equations, replace(solution, value=value))
    value = torch.where(sound[:, None], value, solution.value)
    return replace(solution, value=value), body(value, size)


def _floats(data: Rows | PosePrior) -> dict[str, Tensor]:
    values = {name: getattr(data, name) for name in data.__dataclass_fields__}
    return {name: x for name, x in values.items() if isinstance(x, Tensor) and x.is_floating_point()}


def _silenced(data: Given, where: Bool[Tensor, " batch"]) -> Given:
    """With zeros, which say nothing, for some of the batch."""
    quiet: dict[str, Any] = {
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
    posed: PosedBody,
) -> tuple[Solution, PosedBody]:
    if config.jacobian is JacobianKind.autograd:
        equations = normal_equations(linearize_by_autograd(pose_residual(body, size, rows, prior, config)))
        solution = minimize(equations, start, config.lm)
        return solution, body(solution.value, size)
    by_moments = equations_by_moments(body, size, rows, prior, config, posed)
    tried: list[tuple[Tensor, PosedBody]] = []

    def remembered(pose: Tensor) -> tuple[Tensor, PosedBody]:
        tried.append((pose, body(pose, size)))
        return tried[-1]

    solution = minimize(
        lambda pose: by_moments.at(*remembered(pose)),
        start,
        config.lm,
        by_moments.at(start, posed),
        lambda pose: by_moments.loss(*remembered(pose)),
    )
    # The answer of a row is its start or one of its trials.
    for pose, there in tried:
        posed = there.where((pose == solution.value).all(1), posed)
    return solution, posed


@dataclass(frozen=True)
class PoseEquations:
    """The normal equations of rows, prior and limits as a function of the pose; see `NormalEquations`."""

    body: BodyModel
    size: Float[Tensor, "#batch sizes"]
    of_rows: MomentEquations
    prior: PosePrior
    config: FittingConfig

    def __call__(self, pose: Float[Tensor, "batch parameters"]) -> tuple[Tensor, Tensor, Tensor]:
        return self.at(pose, self.body(pose, self.size))

    def at(self, pose: Float[Tensor, "batch parameters"], posed: PosedBody) -> tuple[Tensor, Tensor, Tensor]:
        """The same with the body `posed` at this pose, if it is at hand."""
        residual, slope = pose_terms(self.body, pose, self.prior, self.config)
        # Each term depends on one parameter: its share of J^T J is diagonal.
        whole = self.of_rows(posed)
        by_pose = (slope * residual).sum(1)
        loss = whole[:, -1, -1] + (residual * residual).sum((1, 2))
        normal = whole[:, :-1, :-1] + torch.diag_embed((slope * slope).sum(1))
        # Where the sum of squares is 0 its terms still cancel only up to rounding.
        return 0.5 * loss.clamp_min(0), whole[:, :-1, -1] + by_pose, normal

    def loss(self, pose: Float[Tensor, "batch parameters"], posed: PosedBody) -> Float[Tensor, " batch"]:
        """Half the sum of squares alone, with the body `posed` at this pose."""
        residual, _ = pose_terms(self.body, pose, self.prior, self.config)
        return 0.5 * (self.of_rows.loss(posed) + residual.square().sum((1, 2))).clamp_min(0)


def equations_by_moments(
    body: BodyModel,
    size: Float[Tensor, "#batch sizes"],
    rows: Rows,
    prior: PosePrior,
    config: FittingConfig,
    posed: PosedBody,
) -> PoseEquations:
    """The normal equations of rows, prior and limits; the rows are summed once, near where the body is `posed`."""
    once = rows.once()
    moments = sum_rows(once.part, once.local, rows.direction, rows.residual(posed), posed, rows.tripled)
    return PoseEquations(body, size, MomentEquations(moments, body.part_moves), prior, config)


def pose_residual(
    body: BodyModel, size: Float[Tensor, "#batch sizes"], rows: Rows, prior: PosePrior, config: FittingConfig
) -> Residual:
    """All residuals as a function of the pose: rows, prior, limits."""

    def residual(pose: Tensor) -> Tensor:
        terms, _ = pose_terms(body, pose, prior, config)
        return torch.cat([rows.residual(body(pose, size)), terms.flatten(1)], 1)

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
    residual, slope = pose_terms(body, pose, prior, config)
    gap = (rows.direction * (rows.target - points)).sum(-1)
    jacobian = torch.cat([-(wrench @ screws.mT) * moves, torch.diag_embed(slope).flatten(1, 2)], 1)
    return torch.cat([gap, residual.flatten(1)], 1), jacobian


def pose_terms(
    body: BodyModel, pose: Float[Tensor, "batch parameters"], prior: PosePrior, config: FittingConfig
) -> tuple[Float[Tensor, "batch terms parameters"], Float[Tensor, "batch terms parameters"]]:
    """Residuals of the prior and of broken limits, one a parameter, and their derivatives by it; no unit."""
    # The root of 0 has no derivative.
    silent = prior.precision == 0
    slopes = [torch.where(silent, 1.0, prior.precision).sqrt() * ~silent]
    residuals = [slopes[0] * (pose - prior.mean)]
    if config.limit_sd > 0:
        over = pose - torch.minimum(torch.maximum(pose, body.low), body.high)
        slopes.append((over != 0).to(pose) / config.limit_sd)
        residuals.append(over / config.limit_sd)
    return torch.stack(residuals, 1), torch.stack(slopes, 1)
