"""Levenberg-Marquardt against known minima, SciPy and `lstsq`; the loss, the statuses and the batch."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import scipy.optimize
import torch
from torch import Tensor
from torch.testing import assert_close

from torchpose.least_squares import (
    Linearize,
    LMConfig,
    Residual,
    Solution,
    Status,
    implicit_value,
    levenberg_marquardt,
    linearize_by_autograd,
    minimize,
    normal_equations,
)

F64 = torch.float64


def rosenbrock(x: Tensor) -> Tensor:
    return torch.stack([10 * (x[:, 1] - x[:, 0] ** 2), 1 - x[:, 0]], 1)


def powell_singular(x: Tensor) -> Tensor:
    """The Jacobian loses two ranks at the minimum, 0."""
    a, b, c, d = x.unbind(1)
    return torch.stack([a + 10 * b, 5**0.5 * (c - d), (b - 2 * c) ** 2, 10**0.5 * (a - d) ** 2], 1)


def helical_valley(x: Tensor) -> Tensor:
    """Fletcher and Powell's; the minimum is (1, 0, 0)."""
    a, b, c = x.unbind(1)
    turn = torch.atan2(b, a) / (2 * math.pi)
    return torch.stack([10 * (c - 10 * turn), 10 * (torch.hypot(a, b) - 1), c], 1)


TIMES = torch.tensor([0.5, 1.0, 2.0, 3.0, 5.0, 8.0], dtype=F64)


def decay(x: Tensor) -> Tensor:
    """Two rates that data does not follow exactly: the loss at the minimum is not 0."""
    data = 2 * torch.exp(-0.7 * TIMES) + 0.05 * torch.cos(5 * TIMES)
    return x[:, :1] * torch.exp(-x[:, 1:2] * TIMES) - data


PROBLEMS: dict[str, tuple[Residual, list[float]]] = {
    "rosenbrock": (rosenbrock, [-1.2, 1.0]),
    "powell": (powell_singular, [3.0, -1.0, 0.0, 1.0]),
    "helix": (helical_valley, [-1.0, 0.5, 0.2]),
    "decay": (decay, [1.0, 0.1]),
}
LONG = LMConfig(max_steps=200, step_tolerance=1e-10, loss_tolerance=1e-14)
each_problem = pytest.mark.parametrize("name", PROBLEMS)


def problem(name: str) -> tuple[Residual, Tensor]:
    residual, start = PROBLEMS[name]
    return residual, torch.tensor([start], dtype=F64)


def starts(name: str, batch: int) -> Tensor:
    _, start = problem(name)
    return start + 0.2 * torch.randn(batch, start.shape[1], dtype=F64)


def recorded(linearize: Linearize, seen: list[Tensor]) -> Linearize:
    """The same callable, which keeps the loss of every point that it was asked for."""

    def wrapped(x: Tensor) -> tuple[Tensor, Tensor]:
        residual, jacobian = linearize(x)
        seen.append(0.5 * (residual**2).sum(1))
        return residual, jacobian

    return wrapped


class TestMinima:
    # Powell's function is flat at 0: steps halve, and near it its normal matrix is singular.
    @pytest.mark.parametrize(
        ("name", "minimum", "config", "atol"),
        [
            ("rosenbrock", [1.0, 1.0], LONG, 1e-9),
            ("powell", [0.0, 0.0, 0.0, 0.0], LMConfig(max_steps=100), 1e-4),
            ("helix", [1.0, 0.0, 0.0], LONG, 1e-9),
        ],
    )
    def test_known(self, name: str, minimum: list[float], config: LMConfig, atol: float) -> None:
        residual, start = problem(name)
        solution = levenberg_marquardt(linearize_by_autograd(residual), start, config)
        assert_close(solution.value, torch.tensor([minimum], dtype=F64), atol=atol, rtol=0)
        assert solution.loss.item() < 1e-15
        assert solution.status.tolist() == [Status.CONVERGED]

    def test_linear_problem_equals_lstsq(self) -> None:
        A, b = torch.randn(5, 9, 4, dtype=F64), torch.randn(5, 9, dtype=F64)

        def linearize(x: Tensor) -> tuple[Tensor, Tensor]:
            return (A @ x[..., None])[..., 0] - b, A

        solution = levenberg_marquardt(linearize, torch.zeros(5, 4, dtype=F64), LONG)
        expected = torch.linalg.lstsq(A, b[..., None]).solution[..., 0]
        assert_close(solution.value, expected, atol=1e-10, rtol=0)
        assert (solution.status == Status.CONVERGED).all()

    @each_problem
    def test_equals_scipy(self, name: str) -> None:
        residual, start = problem(name)
        ours = levenberg_marquardt(linearize_by_autograd(residual), start, LONG)
        # MINPACK's `lm` ended in a wrong minimum of the body's problem (LESSONS), `trf` did not.
        theirs = scipy.optimize.least_squares(
            lambda x: residual(torch.from_numpy(x)[None])[0].numpy(),
            start[0].numpy(),
            method="trf",
            xtol=1e-14,
            ftol=1e-14,
            gtol=1e-14,
        )
        atol = 2e-4 if name == "powell" else 1e-7
        assert ours.loss.item() == pytest.approx(theirs.cost, abs=1e-12)
        np.testing.assert_allclose(ours.value[0].numpy(), theirs.x, atol=atol, rtol=0)

    def test_single_precision(self) -> None:
        residual, start = problem("rosenbrock")
        solution = levenberg_marquardt(
            linearize_by_autograd(residual), start.float(), LMConfig(max_steps=100)
        )
        assert solution.value.dtype == torch.float32
        assert_close(solution.value, torch.ones(1, 2), atol=1e-4, rtol=0)


class TestLoss:
    @each_problem
    def test_never_rises(self, name: str) -> None:
        """As seen by the callable: the loss kept after n + 1 steps is never above that after n."""
        residual, _ = problem(name)
        start = starts(name, 16) * 2
        kept, refused = [], False
        for n in (1, 2, 3, 5, 8, 13, 21):
            seen: list[Tensor] = []
            config = LMConfig(max_steps=n, damping=1e-6)  # little damping: many steps fail
            solution = levenberg_marquardt(recorded(linearize_by_autograd(residual), seen), start, config)
            kept.append(solution.loss)
            # What is reported is the loss of the value, and the least of all that were tried.
            assert_close(solution.loss, 0.5 * (residual(solution.value) ** 2).sum(1), atol=0, rtol=1e-12)
            assert (solution.loss <= torch.stack(seen).nan_to_num(nan=torch.inf).amin(0)).all()
            refused = bool((torch.stack(seen).diff(dim=0) > 0).any())
        assert (torch.stack(kept).diff(dim=0) <= 0).all()
        if name in ("rosenbrock", "helix"):
            assert refused  # steps that would have raised the loss were met

    @each_problem
    @pytest.mark.parametrize("steps", [1, 2, 7])
    def test_the_last_steps_end_is_judged_by_residuals_alone_if_they_are_given(
        self, name: str, steps: int
    ) -> None:
        residual, _ = problem(name)
        start, config = starts(name, 6), LMConfig(max_steps=steps, damping=1e-6)
        seen: list[Tensor] = []
        linearize = recorded(linearize_by_autograd(residual), seen)
        ours = levenberg_marquardt(linearize, start, config, residual)
        assert len(seen) <= steps  # at the start, and at the end of all steps but the last
        plain = levenberg_marquardt(linearize_by_autograd(residual), start, config)
        for field in ("value", "loss", "status", "steps"):
            assert_close(getattr(ours, field), getattr(plain, field), atol=1e-12, rtol=1e-12)

    def test_a_step_uphill_is_refused(self) -> None:
        """Far out on arctan's tail Gauss-Newton overshoots more each time; refused and damped, it arrives."""
        solution = levenberg_marquardt(
            linearize_by_autograd(torch.atan),
            torch.tensor([[8.0], [-30.0]], dtype=F64),
            LMConfig(max_steps=100),
        )
        assert_close(solution.value, torch.zeros(2, 1, dtype=F64), atol=1e-5, rtol=0)

    def test_damping_follows_the_diagonal(self) -> None:
        """Marquardt's: unknowns in other units (1000 x) take the same steps."""
        residual, start = problem("rosenbrock")
        scale = torch.tensor([1.0, 1000.0], dtype=F64)
        config = LMConfig(max_steps=7, step_tolerance=0.0)
        plain = levenberg_marquardt(linearize_by_autograd(residual), start, config)
        scaled = levenberg_marquardt(
            linearize_by_autograd(lambda x: residual(x * scale)), start / scale, config
        )
        # The floor under the diagonal is of the greatest entry, so they agree to its 1e-16 x (1000)^2 only.
        assert_close(scaled.value * scale, plain.value, atol=1e-7, rtol=0)


class TestBatch:
    @each_problem
    def test_equals_one_by_one(self, name: str) -> None:
        residual, _ = problem(name)
        start = starts(name, 6)
        together = levenberg_marquardt(linearize_by_autograd(residual), start)
        for row in range(6):
            alone = levenberg_marquardt(linearize_by_autograd(residual), start[row : row + 1])
            # Not to the bit: a product of matrices sums in another order when it is alone.
            assert_close(together.value[row], alone.value[0], atol=1e-12, rtol=1e-12)
            assert_close(together.loss[row], alone.loss[0], atol=1e-12, rtol=1e-12)
            assert together.status[row] == alone.status[0]
            assert together.steps[row] == alone.steps[0]

    @each_problem
    def test_neighbours_of_a_broken_row_do_not_notice(self, name: str) -> None:
        residual, _ = problem(name)
        start = starts(name, 5)
        healthy = levenberg_marquardt(linearize_by_autograd(residual), start)
        broken = start.clone()
        broken[2, 0] = torch.nan
        solution = levenberg_marquardt(linearize_by_autograd(residual), broken)
        rest = [0, 1, 3, 4]
        assert solution.status[2] == Status.NON_FINITE
        assert solution.steps[2] == 0
        assert torch.equal(solution.value[2].isnan(), broken[2].isnan())
        for field in ("value", "loss", "status", "steps"):  # to the bit
            assert torch.equal(getattr(solution, field)[rest], getattr(healthy, field)[rest]), field

    def test_a_row_that_has_converged_stays_to_the_bit(self) -> None:
        """A neighbour that takes long does not drag it on."""
        residual, _ = problem("rosenbrock")
        start = torch.tensor([[1.0, 1.0], [-1.2, 1.0]], dtype=F64)
        solution = levenberg_marquardt(linearize_by_autograd(residual), start, LONG)
        assert torch.equal(solution.value[0], start[0])
        assert solution.steps[0] == 1 < solution.steps[1]


class TestStatus:
    def test_converged_and_out_of_steps(self) -> None:
        residual, _ = problem("rosenbrock")
        start = torch.tensor([[1.0, 1.0], [-1.2, 1.0]], dtype=F64)
        solution = levenberg_marquardt(linearize_by_autograd(residual), start, LMConfig(max_steps=3))
        assert solution.status.tolist() == [Status.CONVERGED, Status.MAX_STEPS]
        assert solution.steps.tolist() == [1, 3]

    @pytest.mark.parametrize("broken", ["residual", "jacobian"])
    @pytest.mark.parametrize("value", [torch.nan, torch.inf])
    def test_not_finite_at_the_start(self, broken: str, value: float) -> None:
        def linearize(x: Tensor) -> tuple[Tensor, Tensor]:
            residual, jacobian = x.clone(), torch.eye(2, dtype=F64).repeat(len(x), 1, 1)
            (residual if broken == "residual" else jacobian)[0, 0] = value
            return residual, jacobian

        start = torch.ones(2, 2, dtype=F64)
        solution = levenberg_marquardt(linearize, start)
        assert solution.status.tolist() == [Status.NON_FINITE, Status.CONVERGED]
        assert torch.equal(solution.value[0], start[0])
        assert_close(solution.value[1], torch.zeros(2, dtype=F64), atol=1e-6, rtol=0)

    def test_a_normal_matrix_that_overflows_is_not_finite(self) -> None:
        """Residual and gradient are still finite there."""

        def linearize(x: Tensor) -> tuple[Tensor, Tensor]:
            return 1e-60 * x, torch.tensor([[[1e200]], [[1.0]]], dtype=F64)

        solution = levenberg_marquardt(linearize, torch.ones(2, 1, dtype=F64))
        assert solution.status.tolist() == [Status.NON_FINITE, Status.CONVERGED]

    def test_a_trial_that_is_not_finite_is_refused(self) -> None:
        """log's argument must stay positive; the first Gauss-Newton step from 10 goes far below 0."""
        solution = levenberg_marquardt(
            linearize_by_autograd(torch.log), torch.tensor([[10.0]], dtype=F64), LMConfig(max_steps=100)
        )
        assert solution.status.tolist() == [Status.CONVERGED]
        assert_close(solution.value, torch.ones(1, 1, dtype=F64), atol=1e-5, rtol=0)

    def test_a_trial_whose_jacobian_is_not_finite_is_refused(self) -> None:
        """Else the way on would be lost."""

        def linearize(x: Tensor) -> tuple[Tensor, Tensor]:
            jacobian = torch.ones(len(x), 1, 1, dtype=F64)
            return x, torch.where(x[..., None].abs() < 0.5, torch.nan, jacobian)  # blind near the minimum

        solution = levenberg_marquardt(linearize, torch.tensor([[3.0]], dtype=F64), LMConfig(max_steps=60))
        assert 0.5 <= solution.value.item() < 3

    def test_an_unknown_that_nothing_depends_on_stays(self) -> None:
        solution = levenberg_marquardt(
            linearize_by_autograd(lambda x: x[:, :1] - 2), torch.tensor([[0.0, 7.0]], dtype=F64), LONG
        )
        assert solution.status.tolist() == [Status.CONVERGED]
        assert_close(solution.value, torch.tensor([[2.0, 7.0]], dtype=F64), atol=1e-8, rtol=0)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"max_steps": 0}, "max_steps must be at least 1, got 0"),
            ({"damping": 0.0}, "damping must be positive, got 0.0"),
            ({"damping": float("nan")}, "damping must be positive, got nan"),
        ],
    )
    def test_bad_config(self, change: dict[str, float], message: str) -> None:
        with pytest.raises(ValueError, match=message):
            LMConfig(**change)  # type: ignore[arg-type]


class TestLinearizeByAutograd:
    @each_problem
    def test_equals_finite_differences(self, name: str) -> None:
        residual, _ = problem(name)
        x, h = starts(name, 4), 1e-6
        value, jacobian = linearize_by_autograd(residual)(x)
        assert torch.equal(value, residual(x))
        for k in range(x.shape[1]):
            step = torch.zeros_like(x)
            step[:, k] = h
            slope = (residual(x + step) - residual(x - step)) / (2 * h)
            assert_close(jacobian[:, :, k], slope, atol=1e-7, rtol=1e-7)

    def test_equals_jacfwd_row_by_row(self) -> None:
        mix: Callable[[Tensor], Tensor] = lambda x: torch.stack([x.prod(1), x.sum(1).sin()], 1)  # noqa: E731
        x = torch.randn(3, 4, dtype=F64)
        _, jacobian = linearize_by_autograd(mix)(x)
        for row in range(3):
            assert_close(jacobian[row], torch.func.jacrev(lambda y: mix(y[None])[0])(x[row]))


class TestImplicitValue:
    """Derivatives of the answer in what the problem was built from, by the implicit function theorem."""

    def test_a_linear_problem_has_lstsqs_derivative(self) -> None:
        A, b = torch.randn(3, 9, 4, dtype=F64), torch.randn(3, 9, dtype=F64)

        def ours(A: Tensor, b: Tensor) -> Tensor:
            equations = normal_equations(lambda x: ((A @ x[..., None])[..., 0] - b, A))
            with torch.no_grad():
                solution = minimize(equations, torch.zeros(3, 4, dtype=F64), LONG)
            return implicit_value(equations, solution)

        inputs = A.requires_grad_(), b.requires_grad_()
        weight = torch.randn(3, 4, dtype=F64)
        got = torch.autograd.grad((weight * ours(*inputs)).sum(), inputs)
        expected = torch.autograd.grad((weight * (torch.linalg.pinv(A) @ b[..., None])[..., 0]).sum(), inputs)
        for one, other in zip(got, expected, strict=True):
            assert_close(one, other, atol=1e-8, rtol=1e-8)

    def test_large_residuals_need_the_exact_hessian(self) -> None:
        """x near the curve (x, x^2): the nearest point to a target far off it, where J^T J is half of the Hessian."""

        def nearest(target: Tensor) -> Tensor:
            def linearize(x: Tensor) -> tuple[Tensor, Tensor]:
                return torch.cat([x, x * x], 1) - target, torch.stack([torch.ones_like(x), 2 * x], 1)

            equations = normal_equations(linearize)
            with torch.no_grad():
                solution = minimize(equations, torch.full((2, 1), 0.5, dtype=F64), LONG)
            return implicit_value(equations, solution)

        target = torch.tensor([[0.4, -0.7], [2.0, 0.1]], dtype=F64, requires_grad=True)
        # The minimum solves 2 x^3 + (1 - 2 b) x - a = 0: dx/da = 1 / (6 x^2 + 1 - 2 b), dx/db = 2 x times it.
        x = nearest(target)
        (got,) = torch.autograd.grad(x.sum(), target)
        slope = 1 / (6 * x**2 + 1 - 2 * target[:, 1:])
        assert_close(got, torch.cat([slope, 2 * x * slope], 1).detach(), atol=1e-6, rtol=0)
        assert torch.equal(x, nearest(target.detach()))  # the value itself is the solution's, to the bit

    def test_where_there_is_no_minimum_the_derivative_is_zero(self) -> None:
        """An unknown that nothing depends on, and the top of a hill: neither has a positive definite Hessian."""
        shift = torch.zeros(2, 2, dtype=F64, requires_grad=True)

        def equations(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            y = x - shift
            curve = torch.tensor([[1.0, 0.0], [1.0, -1.0]], dtype=F64)
            return 0.5 * (curve * y * y).sum(1), curve * y, torch.diag_embed(curve)

        zero = torch.zeros(2, dtype=F64)
        stopped = Solution(torch.zeros(2, 2, dtype=F64), zero, zero.long(), zero.long())
        (got,) = torch.autograd.grad(implicit_value(equations, stopped).sum(), shift)
        assert (got == 0).all()

    def test_a_second_derivative_is_refused(self) -> None:
        b = torch.ones(1, 2, dtype=F64, requires_grad=True)
        equations = normal_equations(lambda x: (x - b, torch.eye(2, dtype=F64)[None]))
        with torch.no_grad():
            solution = minimize(equations, torch.zeros(1, 2, dtype=F64))
        with pytest.raises(RuntimeError, match="differentiated once: leave out create_graph"):
            torch.autograd.grad(implicit_value(equations, solution).sum(), b, create_graph=True)
