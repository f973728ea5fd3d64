"""Rotations against the matrix exponential, finite differences and dense search."""

import math

import numpy as np
import pytest
import scipy.linalg
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from torchpose.geometry import (
    angle_between,
    axis_pair_angles,
    exp_rotation,
    hat,
    left_jacobian,
    rotation_between,
)

F64 = torch.float64


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=F64)


def unit(*shape: int) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(*shape, dtype=F64), dim=-1)


# No angle between 1e-12 and 4 pi is special, least of all those about 1e-2, where the series takes over.
rotation_vectors = st.builds(
    lambda seed, exponent: unit_of(seed) * 10.0**exponent,
    st.integers(0, 10_000),
    st.one_of(st.floats(-12, 1.1), st.floats(-2.01, -1.99)),
)


def unit_of(seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=F64), dim=-1)


class TestHat:
    def test_is_the_cross_product(self) -> None:
        a, b = torch.randn(2, 5, 4, 3, dtype=F64)
        assert_close((hat(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b))


class TestExpRotation:
    @given(rotation_vectors)
    def test_equals_the_matrix_exponential(self, v: Tensor) -> None:
        # SciPy's: torch.linalg.matrix_exp is itself wrong by 2e-11 at an angle of 0.03.
        expected = torch.from_numpy(scipy.linalg.expm(hat(v).numpy()))
        assert_close(exp_rotation(v), expected, atol=1e-13, rtol=0)

    def test_turns_by_the_right_hand(self) -> None:
        turned = exp_rotation(vector(0, 0, math.pi / 2)) @ vector(1, 0, 0)
        assert_close(turned, vector(0, 1, 0), atol=1e-15, rtol=0)

    @pytest.mark.parametrize("angle", [0.0, 1e-20, 1e-8, 1e-3, 0.00999, 0.01001, 1.0, math.pi, 6.0])
    def test_is_a_rotation_in_single_precision(self, angle: float) -> None:
        R = exp_rotation(unit_of(3).float() * angle)
        assert_close(R @ R.mT, torch.eye(3), atol=5e-7, rtol=0)

    @pytest.mark.parametrize("start", [(0.0, 0.0, 0.0), (1e-9, -2e-9, 0.0), (0.3, -1.2, 0.8)])
    def test_gradient(self, start: tuple[float, float, float]) -> None:
        v = vector(*start).requires_grad_()
        assert torch.autograd.gradcheck(exp_rotation, v)
        assert torch.autograd.gradgradcheck(exp_rotation, v)

    def test_batch_equals_one_by_one(self) -> None:
        v = torch.randn(4, 3, 3, dtype=F64)
        one_by_one = torch.stack([exp_rotation(x) for x in v.flatten(0, 1)]).unflatten(0, (4, 3))
        assert_close(exp_rotation(v), one_by_one, atol=1e-15, rtol=0)


class TestLeftJacobian:
    @given(rotation_vectors)
    def test_equals_finite_differences(self, v: Tensor) -> None:
        R, J, h = exp_rotation(v), left_jacobian(v), 1e-6
        for k in range(3):
            d = torch.zeros(3, dtype=F64)
            d[k] = h
            slope = (exp_rotation(v + d) - exp_rotation(v - d)) / (2 * h)
            assert_close(slope, hat(J[:, k]) @ R, atol=1e-8, rtol=0)

    @given(rotation_vectors)
    def test_closes_with_the_rotation(self, v: Tensor) -> None:
        """exp(v) - 1 = hat(v) J(v), to rounding: finite differences cannot see the small angles' series."""
        gap = exp_rotation(v) - torch.eye(3, dtype=F64) - hat(v) @ left_jacobian(v)
        assert gap.abs().max() < 1e-15 * (1 + v.norm())

    def test_equals_its_integral(self) -> None:
        """J = integral of exp(s v) over s in [0, 1], by Gauss-Legendre's rule."""
        v = vector(1.1, -0.7, 2.0)
        nodes, weights = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(16))
        integral = (weights[:, None, None] / 2 * exp_rotation((nodes[:, None] + 1) / 2 * v)).sum(0)
        assert_close(left_jacobian(v), integral, atol=1e-13, rtol=0)

    @pytest.mark.parametrize("start", [(0.0, 0.0, 0.0), (0.4, 1.3, -0.9)])
    def test_gradient(self, start: tuple[float, float, float]) -> None:
        assert torch.autograd.gradcheck(left_jacobian, vector(*start).requires_grad_())


class TestRotationBetween:
    def test_turns_start_into_end_by_the_smallest_angle(self) -> None:
        start, end = unit(200, 3), unit(200, 3)
        v = rotation_between(start, end)
        assert_close((exp_rotation(v) @ start[..., None])[..., 0], end, atol=1e-13, rtol=0)
        assert_close(v.norm(dim=-1), torch.acos((start * end).sum(-1)), atol=1e-7, rtol=0)
        assert_close((v * start).sum(-1), torch.zeros(200, dtype=F64), atol=1e-14, rtol=0)

    def test_nothing_to_turn(self) -> None:
        start = unit(10, 3)
        # A unit vector times itself is parallel only up to rounding.
        assert_close(rotation_between(start, start), torch.zeros(10, 3, dtype=F64), atol=1e-15, rtol=0)

    @pytest.mark.parametrize("start", [(1, 0, 0), (0, -1, 0), (0, 0, 1), (0.6, 0.0, -0.8), (0.48, 0.6, 0.64)])
    def test_opposite_vectors_turn_by_half(self, start: tuple[float, float, float]) -> None:
        v = rotation_between(vector(*start), -vector(*start))
        assert v.norm().item() == pytest.approx(math.pi)
        assert_close(exp_rotation(v) @ vector(*start), -vector(*start), atol=1e-14, rtol=0)

    @given(st.integers(0, 10_000), st.floats(-9, 0))
    def test_nearly_opposite_vectors_in_single_precision(self, seed: int, exponent: float) -> None:
        """Their axis is all rounding error; the turn must still end where it should."""
        start = unit_of(seed)
        end = exp_rotation(torch.linalg.cross(start, unit_of(seed + 1)) * 10.0**exponent) @ -start
        start, end = start.float(), end.float()
        assert_close(exp_rotation(rotation_between(start, end)) @ start, end, atol=2e-6, rtol=0)

    @pytest.mark.parametrize("angle", [0.0, 1e-7, 0.5, 3.0])
    def test_gradient_in_directions(self, angle: float) -> None:
        """Of unit vectors, as they are turned: also where the two are equal."""
        start = unit_of(5)
        across = torch.linalg.cross(start, unit_of(6))
        end = exp_rotation(across / across.norm() * angle) @ start

        def turned(v: Tensor) -> Tensor:
            return rotation_between(start, exp_rotation(v) @ end)

        assert torch.autograd.gradcheck(turned, torch.zeros(3, dtype=F64, requires_grad=True), atol=1e-6)


class TestAngleBetween:
    # In double precision arccos is wrong by 1e-8 near 0 and pi and gives 0 below that.
    @pytest.mark.parametrize(
        "angle", [0.0, 1e-12, 1e-8, 1e-3, 1.0, math.pi / 2, 3.0, math.pi - 1e-8, math.pi]
    )
    def test_is_exact_up_to_the_ends(self, angle: float) -> None:
        first, second = vector(2, 0, 0), 3 * vector(math.cos(angle), math.sin(angle), 0)
        assert angle_between(first, second).item() == pytest.approx(angle, abs=1e-15, rel=1e-12)

    def test_does_not_depend_on_lengths_or_order(self) -> None:
        first, second = torch.randn(2, 50, 3, dtype=F64)
        expected = torch.acos(torch.nn.functional.cosine_similarity(first, second))
        assert_close(angle_between(first, second), expected, atol=1e-12, rtol=0)
        assert_close(angle_between(second * 7, first * 0.01), expected, atol=1e-12, rtol=0)

    @pytest.mark.parametrize(
        "second", [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (1.0, 1e-9, 0.0), (-1.0, 0.0, 1e-9)]
    )
    def test_gradient_is_finite_at_the_ends(self, second: tuple[float, float, float]) -> None:
        a, b = vector(1, 0, 0).requires_grad_(), vector(*second).requires_grad_()
        angle_between(a, b).backward()
        assert a.grad is not None
        assert b.grad is not None
        assert a.grad.isfinite().all()
        assert b.grad.isfinite().all()
        assert b.grad.norm() <= 1 + 1e-9  # an angle changes by no more than a unit vector's end moves

    def test_gradient(self) -> None:
        a, b = torch.randn(2, 6, 3, dtype=F64, requires_grad=True).unbind(0)
        assert torch.autograd.gradcheck(angle_between, (a, b))


class TestAxisPairAngles:
    def random_axes(self, batch: int) -> Tensor:
        frames = exp_rotation(torch.randn(batch, 3, dtype=F64) * 2)
        return frames[..., :2].mT  # rows: two unit vectors at a right angle

    def turned(self, axes: Tensor, angles: Tensor, start: Tensor) -> Tensor:
        """`angles` (B, S, 2): each solution's direction."""
        first, second = exp_rotation(axes[:, None] * angles[..., None]).unbind(2)
        return (first @ second @ start[:, None, :, None])[..., 0]

    def test_both_solutions_reach_a_reachable_direction(self) -> None:
        axes, start = self.random_axes(300), unit(300, 3)
        truth = (torch.rand(300, 1, 2, dtype=F64) - 0.5) * 2 * math.pi
        end = self.turned(axes, truth, start)[:, 0]
        found = axis_pair_angles(axes, start, end)
        assert_close(self.turned(axes, found, start), end[:, None].expand(-1, 2, -1), atol=1e-12, rtol=0)
        assert (found.abs() <= math.pi).all()
        # One of the two is the pair that made the direction.
        apart = (found - truth).remainder(2 * math.pi)
        apart = torch.minimum(apart, 2 * math.pi - apart).amax(-1)
        assert_close(apart.amin(1), torch.zeros(300, dtype=F64), atol=1e-6, rtol=0)

    def test_nearest_direction_where_none_reaches(self) -> None:
        """Against a dense search over both angles."""
        axes, start = self.random_axes(20), unit(20, 3)
        # A start near the second axis turns in a small circle about it and reaches a narrow band alone.
        start = torch.nn.functional.normalize(axes[:, 1] + 0.3 * start, dim=-1)
        end = torch.nn.functional.normalize(axes[:, 0] + 0.2 * unit(20, 3), dim=-1)
        found = self.turned(axes, axis_pair_angles(axes, start, end), start)
        grid = torch.linspace(-math.pi, math.pi, 121, dtype=F64)
        every = torch.cartesian_prod(grid, grid).expand(20, -1, 2)
        best = (self.turned(axes, every, start) * end[:, None]).sum(-1).amax(1)
        reached = (found * end[:, None]).sum(-1)
        assert (best < 0.99).any()  # some are out of reach indeed
        assert (reached >= best[:, None] - 1e-12).all()  # no worse than the grid,
        assert_close(reached, best[:, None].expand(-1, 2), atol=2e-3, rtol=0)  # and as good up to its spacing

    def test_start_along_the_second_axis(self) -> None:
        axes = vector(1, 0, 0, 0, 1, 0).reshape(2, 3)
        end = vector(0, 0.6, 0.8)
        found = axis_pair_angles(axes[None], axes[1][None], end[None])
        assert_close(self.turned(axes[None], found, axes[1][None])[0], end.expand(2, 3), atol=1e-12, rtol=0)
