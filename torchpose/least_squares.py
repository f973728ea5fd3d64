"""Levenberg-Marquardt for a batch of independent nonlinear least-squares problems, with a status for each.

It takes a callable and knows nothing of bodies or cameras.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import torch
from jaxtyping import Float, Int
from torch import Tensor

Residual = Callable[[Float[Tensor, "batch unknowns"]], Float[Tensor, "batch residuals"]]
Linearize = Callable[
    [Float[Tensor, "batch unknowns"]],
    tuple[Float[Tensor, "batch residuals"], Float[Tensor, "batch residuals unknowns"]],
]
# Half the sum of squares, its gradient J^T r and J^T J: all that the minimiser needs of the residuals.
Normal = tuple[
    Float[Tensor, " batch"],
    Float[Tensor, "batch unknowns"],
    Float[Tensor, "batch unknowns unknowns"],
]
NormalEquations = Callable[[Float[Tensor, "batch unknowns"]], Normal]
Loss = Callable[[Float[Tensor, "batch unknowns"]], Float[Tensor, " batch"]]


class Status(IntEnum):
    """What became of a problem."""

    CONVERGED = 0  # the step or the fall of the loss became smaller than its tolerance
    MAX_STEPS = 1  # out of steps: a longer run may still improve it
    NON_FINITE = 2  # residuals or Jacobian were not finite at the start; x is returned as given


@dataclass(frozen=True)
class LMConfig:
    max_steps: int = 20
    damping: float = 1e-3  # lambda at the start, relative to the diagonal; much less ends in flipped poses
    step_tolerance: float = 1e-6  # stop when no unknown moves further
    loss_tolerance: float = 1e-9  # stop when the loss falls by a smaller share

    def __post_init__(self) -> None:
        if self.max_steps < 1:
            raise ValueError(f"max_steps must be at least 1, got {self.max_steps}")
        if not self.damping > 0:
            raise ValueError(f"damping must be positive, got {self.damping}; 1e-3 suits most problems")


@dataclass(frozen=True)
class Solution:
    """The answer to each problem of the batch."""

    value: Float[Tensor, "batch unknowns"]
    loss: Float[Tensor, " batch"]  # half the sum of squares at `value`
    status: Int[Tensor, " batch"]
    steps: Int[Tensor, " batch"]  # tried, whether kept or not


def levenberg_marquardt(
    linearize: Linearize,
    start: Float[Tensor, "batch unknowns"],
    config: LMConfig = LMConfig(),
    residual: Residual | None = None,
) -> Solution:
    """Minimise |r(x)|^2 / 2 for each row of `start` on its own: `minimize` for residuals with a Jacobian.

    Args:
        linearize: maps x (B, P) to residuals r (B, M) and their Jacobian (B, M, P).
        start: first guess, a problem a row.
        residual: r alone, if it takes less time.
    """
    loss = None if residual is None else _half_squares(residual)
    return minimize(normal_equations(linearize), start, config, loss=loss)


def _half_squares(residual: Residual) -> Loss:
    return lambda x: 0.5 * residual(x).square().sum(1)


def minimize(
    equations: NormalEquations,
    start: Float[Tensor, "batch unknowns"],
    config: LMConfig = LMConfig(),
    first: Normal | None = None,
    loss: Loss | None = None,
) -> Solution:
    """Minimise a sum of squares for each row of `start` on its own, by Levenberg and Marquardt's method.

    Each step solves (J^T J + lambda diag(J^T J)) d = -J^T r. A step that lowers the loss is kept and lambda
    falls tenfold; otherwise x stays and lambda rises tenfold. So the loss never rises, and a row that is not
    finite, or has converged, changes neither itself nor its neighbours.

    Args:
        equations: maps x (B, P) to the loss |r|^2 / 2 (B,), J^T r (B, P) and J^T J (B, P, P).
        start: first guess, a problem a row.
        first: the equations at `start`, if they are at hand.
        loss: the loss alone, if it takes less time: of the last step's end nothing else is asked.
    """
    x = start
    least, gradient, normal = equations(x) if first is None else first
    # A column of J that is not finite shows on the diagonal of J^T J.
    finite = least.isfinite() & gradient.isfinite().all(1) & _diagonal(normal).isfinite().all(1)
    active = finite
    status = torch.where(finite, int(Status.MAX_STEPS), int(Status.NON_FINITE))
    steps = torch.zeros_like(status)
    damping = torch.full_like(least, config.damping)
    normal = torch.where(finite[:, None, None], normal, 0.0)
    for i in range(config.max_steps):
        last = i + 1 == config.max_steps
        step, solved = _solve(normal, gradient, damping)
        trial = torch.where(active[:, None], x + step, x)
        further = None
        if last and loss is not None:
            trial_loss = loss(trial)
        else:
            trial_loss, *further = equations(trial)
        # False where the trial is not finite.
        better = active & (trial_loss < least)
        if further is not None:  # a Jacobian that is not would leave no way on: its diagonal tells
            better &= _diagonal(further[1]).amax(1) < torch.inf
        small = step.abs().amax(1) < config.step_tolerance
        slow = least - trial_loss <= config.loss_tolerance * least
        # A rejected step this small means that the loss cannot be resolved any further.
        done = active & torch.where(better, small | slow, solved & small)
        x = torch.where(better[:, None], trial, x)
        least = torch.where(better, trial_loss, least)
        steps = steps + active
        status = torch.where(done, int(Status.CONVERGED), status)
        active = active & ~done
        # Asking waits for the device: not after the last step.
        if last or further is None or not bool(active.any()):
            break
        gradient = torch.where(better[:, None], further[0], gradient)
        normal = torch.where(better[:, None, None], further[1], normal)
        damping = torch.where(better, damping / 10, damping * 10).clamp(1e-12, 1e12)
    return Solution(x, least, status, steps)


def normal_equations(linearize: Linearize) -> NormalEquations:
    """The normal equations of residuals that come with their Jacobian."""

    def equations(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        residual, jacobian = linearize(x)
        gradient = (jacobian.mT @ residual[..., None])[..., 0]
        return 0.5 * (residual * residual).sum(1), gradient, jacobian.mT @ jacobian

    return equations


def implicit_value(equations: NormalEquations, solution: Solution) -> Float[Tensor, "batch unknowns"]:
    """`solution.value`, differentiable in whatever the closed form `equations` was built from.

    At a minimum the gradient g(x, theta) is 0, so dx / d theta = -H^-1 dg / d theta with H = dg / dx, the loss's
    exact Hessian (the implicit function theorem): the steps that led there are neither kept nor differentiated, and
    H is made and factored in the backward pass only. Of a row that stopped short of the minimum this is the derivative
    of a Newton step from there; one whose H is not positive definite gets 0.

    `equations` must be finite in all rows. Differentiable once: a second derivative raises RuntimeError.
    """
    x = solution.value.detach().requires_grad_()
    _, gradient, _ = equations(x)

    def solve(cotangent: Tensor | None) -> Tensor | None:
        if cotangent is None:
            return None
        if torch.is_grad_enabled():
            raise RuntimeError("the value of a fit can be differentiated once: leave out create_graph=True")
        P = x.shape[1]
        unit = torch.eye(P, dtype=x.dtype, device=x.device)[:, None].expand(P, *x.shape)
        (hessian,) = torch.autograd.grad(gradient, x, unit, retain_graph=True, is_grads_batched=True)
        factor, failed = torch.linalg.cholesky_ex(hessian.transpose(0, 1))
        minimum = (failed == 0)[:, None]
        factor = torch.where(minimum[..., None], factor, unit.transpose(0, 1))
        return torch.where(minimum, -torch.cholesky_solve(cotangent[..., None], factor)[..., 0], 0.0)

    gap = gradient - gradient.detach()  # 0: only its derivative counts
    gap.register_hook(solve)
    return x.detach() + gap


def linearize_by_autograd(residual: Residual) -> Linearize:
    """Residuals and Jacobian of a residual function by forward-mode differentiation: the reference.

    Row b of the residuals may depend on row b of x alone. The columns are pushed through together, as one
    batch of B x P tangents, which keeps the batch axis where the function expects it.
    """

    def linearize(x: Tensor) -> tuple[Tensor, Tensor]:
        B, P = x.shape
        tangents = torch.eye(P, dtype=x.dtype, device=x.device)[:, None].expand(P, B, P)

        def push(tangent: Tensor) -> Tensor:
            return torch.func.jvp(residual, (x,), (tangent,))[1]

        columns = torch.func.vmap(push)(tangents)  # (P, B, M)
        return residual(x), columns.permute(1, 2, 0)

    return linearize


def _diagonal(matrix: Tensor) -> Tensor:
    return matrix.diagonal(dim1=1, dim2=2)


def _solve(normal: Tensor, gradient: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
    """The damped Gauss-Newton step, and where there is one: elsewhere it is zero, so that lambda rises."""
    diagonal = _diagonal(normal)
    # An unknown that nothing depends on has a zero diagonal; the floor keeps its step at zero, not at NaN.
    floor = diagonal.amax(1, keepdim=True) * torch.finfo(normal.dtype).eps + torch.finfo(normal.dtype).tiny
    factor, failed = torch.linalg.cholesky_ex(normal + torch.diag_embed(damping[:, None] * diagonal + floor))
    step = -torch.cholesky_solve(gradient[..., None], factor)[..., 0]
    solved = (failed == 0) & (step.abs().amax(1) < torch.inf)
    return torch.where(solved[:, None], step, 0.0), solved
