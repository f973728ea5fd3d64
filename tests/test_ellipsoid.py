"""Distances to ellipsoids against minimisation by SciPy, dense search and the homogeneous form."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from torchpose.body.ellipsoid import (
    FootPoint,
    algebraic_distance,
    flattened,
    foot_of_part,
    foot_point,
    nearest_point,
    outline,
    rough_distance,
    surface_normal,
    to_camera,
    to_local,
    unflattened,
)
from torchpose.body.model import BodyModel, PosedBody, ellipsoid_matrix
from torchpose.geometry import exp_rotation

F64 = torch.float64


def ellipsoids(centers: Tensor, turns: Tensor, radii: Tensor) -> PosedBody:
    """A posed "body" of nothing but ellipsoids: centres (K, 3), rotation vectors (K, 3), radii (K, 3)."""
    none = torch.zeros(1, 0, 3, dtype=centers.dtype)
    return PosedBody(
        torch.zeros(1, 0, 3, 3, dtype=centers.dtype),
        none,
        centers[None],
        exp_rotation(turns)[None],
        radii[None],
        none,
        none,
        none,
    )


def scene(num: int, dtype: torch.dtype = F64) -> PosedBody:
    """Ellipsoids of all slants, flat and round ones, 2 to 4 m from the camera, of a body's sizes."""
    g = torch.Generator().manual_seed(1)
    centers = torch.randn(num, 3, generator=g, dtype=F64) * 0.5 + torch.tensor([0.0, 0.0, 3.0], dtype=F64)
    a = 0.03 + 0.13 * torch.rand(num, 1, generator=g, dtype=F64)
    b = a * (0.5 + torch.rand(num, 1, generator=g, dtype=F64))
    c = torch.maximum(a, b) * (1 + 4 * torch.rand(num, 1, generator=g, dtype=F64))
    b[::3] = a[::3]  # spheroids among them
    radii = torch.cat([a, b, c], 1)
    turns = torch.randn(num, 3, generator=g, dtype=F64)
    return ellipsoids(*(x.to(dtype) for x in (centers, turns, radii)))


def around(posed: PosedBody, num: int, reach: float = 2.0) -> Tensor:
    """Points inside and around the ellipsoids of a scene, camera's frame."""
    radii = posed.radii
    local = torch.randn(*radii.shape[:2], num, 3, dtype=radii.dtype) * radii[:, :, None] * reach / 2
    return to_camera(posed, local).flatten(1, 2)


def distance_by_bisection(point: Sequence[float], radii: Sequence[float]) -> float:
    """Distance of a point to the ellipsoid of these half axes, in double precision.

    Eberly's method: the root of F(s) = |r x / (s + r^2 - m^2)|^2 - 1, where m is the shortest half axis and s the
    distance from the last pole, by bisection on a logarithmic scale. If there is none, because the point lies in the
    plane across the shortest axis, that axis takes what the others leave.
    """
    x, r = np.abs(np.array(point, dtype=float)), np.array(radii, dtype=float)
    least = r.argmin()
    beyond = (r - r[least]) * (r + r[least])
    low, high = 1e-150, float(np.linalg.norm(r * x)) * (1 + 1e-15) + 1e-140

    def F(s: float) -> float:
        return float((r * x / (s + beyond)) @ (r * x / (s + beyond))) - 1

    if F(low) > 0:
        for _ in range(200):
            middle = math.sqrt(low * high) if low * 4 < high else (low + high) / 2
            low, high = (middle, high) if F(middle) > 0 else (low, middle)
    foot = r * r * x / (low + beyond)
    share = (foot / r) ** 2
    foot[least] = r[least] * math.sqrt(max(0.0, 1 - (share.sum() - share[least])))
    return float(np.linalg.norm(x - foot))


def distance_by_search(point: Sequence[float], radii: Sequence[float]) -> float:
    """The same by minimising over the ellipsoid's two angles from the best of a dense grid."""
    x, r = np.abs(np.array(point)), np.array(radii)

    def foot(angles: np.ndarray) -> np.ndarray:
        t, u = angles
        return (r * np.array([np.sin(t) * np.cos(u), np.sin(t) * np.sin(u), np.cos(t)]).T).T

    grid = np.stack(np.meshgrid(*2 * [np.linspace(0, math.pi / 2, 181)], indexing="ij")).reshape(2, -1)
    start = grid[:, np.linalg.norm(foot(grid) - x[:, None], axis=0).argmin()]
    found = scipy.optimize.minimize(
        lambda angles: float(((foot(angles) - x) ** 2).sum()),
        start,
        method="Nelder-Mead",
        options={"xatol": 1e-12, "fatol": 1e-26, "maxiter": 4000},
    )
    return math.sqrt(found.fun)


def nearest(point: Tensor, *radii: float) -> Tensor:
    """`nearest_point` of one point and one ellipsoid."""
    return nearest_point(point[None, None, None], torch.tensor([[radii]], dtype=point.dtype))[0, 0, 0]


# Named by where the point lies; radii in metres.
HARD: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "centre": ((0.0, 0.0, 0.0), (0.1, 0.1, 0.3)),
    "centre of a ball": ((0.0, 0.0, 0.0), (0.2, 0.2, 0.2)),
    "centre of a needle": ((0.0, 0.0, 0.0), (0.001, 0.001, 0.4)),
    "long axis, inside, side is nearest": ((0.0, 0.0, 0.1), (0.1, 0.1, 0.3)),
    "long axis, inside, pole is nearest": ((0.0, 0.0, 0.29), (0.1, 0.1, 0.3)),
    "long axis, at the evolute's cusp": ((0.0, 0.0, 0.3 - 0.1**2 / 0.3), (0.1, 0.1, 0.3)),
    "long axis, on the pole": ((0.0, 0.0, -0.3), (0.1, 0.1, 0.3)),
    "long axis, outside": ((0.0, 0.0, -0.9), (0.1, 0.1, 0.3)),
    "just off the axis": ((1e-9, -1e-9, 0.1), (0.1, 0.1, 0.3)),
    "off the axis by single precision's last digit": ((0.0, 1e-7, -0.2), (0.1, 0.1, 0.3)),
    "near the axis, inside": ((1e-4, 0.0, 0.25), (0.1, 0.1, 0.3)),
    "equator plane, inside": ((0.03, -0.04, 0.0), (0.1, 0.1, 0.3)),
    "equator plane, on the surface": ((0.06, 0.08, 0.0), (0.1, 0.1, 0.3)),
    "equator plane, outside": ((0.3, 0.4, 0.0), (0.1, 0.1, 0.3)),
    "just off the equator plane": ((0.03, 0.04, 1e-9), (0.1, 0.1, 0.3)),
    "on the surface": ((0.06, 0.0, 0.24), (0.1, 0.1, 0.3)),
    "far outside": ((30.0, -40.0, 70.0), (0.1, 0.1, 0.3)),
    "needle, outside": ((0.02, 0.01, 0.1), (0.001, 0.001, 0.4)),
    "needle, at its tip": ((0.0005, 0.0, 0.3999), (0.001, 0.001, 0.4)),
    "needle, inside": ((0.0003, 0.0, -0.2), (0.001, 0.001, 0.4)),
    "ball, inside": ((0.05, 0.1, -0.02), (0.2, 0.2, 0.2)),
    "ball, outside": ((0.5, 0.1, -0.2), (0.2, 0.2, 0.2)),
    "almost a ball": ((1e-6, 0.0, 2e-6), (0.2, 0.2, 0.2000001)),
    "flat, centre": ((0.0, 0.0, 0.0), (0.2, 0.1, 0.4)),
    "flat, on the long axis": ((0.0, 0.0, 0.2), (0.2, 0.1, 0.4)),
    "flat, on the middle axis": ((0.1, 0.0, 0.0), (0.2, 0.1, 0.4)),
    "flat, on the middle axis, end is nearest": ((0.19, 0.0, 0.0), (0.2, 0.1, 0.4)),
    "flat, on the short axis": ((0.0, -0.06, 0.0), (0.2, 0.1, 0.4)),
    "flat, on the short axis, outside": ((0.0, -0.6, 0.0), (0.2, 0.1, 0.4)),
    "flat, across the short axis": ((0.05, 0.0, 0.2), (0.2, 0.1, 0.4)),
    "flat, across the short axis, near the rim": ((0.1, 0.0, 0.33), (0.2, 0.1, 0.4)),
    "flat, across the short axis, outside": ((0.3, 0.0, 0.4), (0.2, 0.1, 0.4)),
    "flat, just off the plane across the short axis": ((0.05, 1e-9, 0.2), (0.2, 0.1, 0.4)),
    "flat, across the middle axis": ((0.0, 0.03, 0.2), (0.2, 0.1, 0.4)),
    "flat, across the long axis": ((0.05, 0.03, 0.0), (0.2, 0.1, 0.4)),
    "flat, at the cusp of the long axis": ((0.0, 0.0, 0.4 - 0.1**2 / 0.4), (0.2, 0.1, 0.4)),
    "flat, far outside": ((30.0, -40.0, 70.0), (0.2, 0.1, 0.4)),
    "disc, inside": ((0.1, 0.0005, 0.2), (0.4, 0.001, 0.4)),
    "disc, at its rim": ((0.2399, 0.0, 0.3199), (0.4, 0.001, 0.4)),
    "blade, inside": ((0.03, 0.0002, 0.3), (0.05, 0.001, 0.4)),
    "almost round": ((1e-6, 0.03, 0.29), (0.1, 0.1000001, 0.3)),
    "nearly round, beyond the first cusp": ((-1.7e-6, -0.007, 0.993 * 3), (0.1, 0.10001, 3.0)),
}
radius = st.floats(0.01, 0.3)
ratios = st.one_of(st.floats(1, 3), st.floats(-7, 0).map(lambda digits: 1 + 10**digits), st.just(1.0))
coordinate = st.one_of(st.floats(-3, 3), st.floats(-1e-6, 1e-6), st.just(0.0))


class TestNearestPoint:
    @pytest.mark.parametrize("name", HARD)
    def test_the_oracles_agree(self, name: str) -> None:
        """Bisection and minimisation know nothing of each other."""
        assert distance_by_bisection(*HARD[name]) == pytest.approx(distance_by_search(*HARD[name]), abs=1e-9)

    @pytest.mark.parametrize("dtype", [torch.float32, F64], ids=["single", "double"])
    @pytest.mark.parametrize("name", HARD)
    def test_hard_cases(self, name: str, dtype: torch.dtype) -> None:
        point, radii = HARD[name]
        self.assert_nearest(torch.tensor(point, dtype=dtype), *radii)

    @given(coordinate, coordinate, coordinate, radius, st.floats(1, 30))
    def test_any_spheroid_and_point(self, x: float, y: float, z: float, a: float, ratio: float) -> None:
        for dtype in (torch.float32, F64):
            self.assert_nearest(torch.tensor([x, y, z], dtype=dtype), a, a, a * ratio)

    @given(coordinate, coordinate, coordinate, radius, ratios, ratios, st.booleans())
    def test_any_ellipsoid_and_point(
        self, x: float, y: float, z: float, a: float, flat: float, long: float, turned: bool
    ) -> None:
        across = (a * flat, a) if turned else (a, a * flat)
        for dtype in (torch.float32, F64):
            # Of a million hard pairs a few are off by up to 2e-6 m, in double precision too: a Newton step short.
            self.assert_nearest(torch.tensor([x, y, z], dtype=dtype), *across, a * flat * long, slack=2e-6)

    @given(st.floats(-9, 0), st.floats(-3e-2, 3e-2), radius, ratios, st.floats(1.01, 10))
    def test_near_the_cusp(self, exponent: float, off: float, a: float, flat: float, ratio: float) -> None:
        """About the end of the medial surface iterations converge worst (8 plain Newton steps left 5e-5 m)."""
        c = a * flat * ratio
        point = torch.tensor(
            [0.6 * a * 10**exponent, -0.8 * a * 10**exponent, (c - a * a / c) * (1 + off)], dtype=F64
        )
        self.assert_nearest(point, a, a * flat, c)
        self.assert_nearest(point.float(), a, a * flat, c)

    @staticmethod
    def assert_nearest(point: Tensor, *radii: float, slack: float = 0.0) -> None:
        foot = nearest(point, *radii)
        # The oracle gets the numbers that single precision has made of them.
        exact = torch.tensor(radii, dtype=point.dtype).double()
        expected = distance_by_bisection(point.tolist(), exact.tolist())
        # METHOD's 1e-6 m, plus the half unit of the last digit that a coordinate of many metres has.
        size = float(point.abs().max()) + max(radii)
        rounding = size * torch.finfo(point.dtype).eps
        atol = (1e-6 if point.dtype == torch.float32 else 1e-12) + rounding + slack
        assert (point.double() - foot.double()).norm().item() == pytest.approx(expected, abs=atol)
        # On the surface: along the normal that is off by the form's error over its slope.
        form = float((foot.double() / exact).norm()) - 1
        assert abs(form) * min(radii) < atol

    def test_many_at_once_equal_one_by_one(self) -> None:
        radii = torch.tensor(
            [[[0.1, 0.2, 0.3], [0.05, 0.05, 0.05]], [[0.2, 0.15, 0.25], [0.01, 0.01, 0.4]]], dtype=F64
        )
        points = torch.randn(2, 2, 7, 3, dtype=F64) * 0.3
        feet = nearest_point(points, radii)
        for b in range(2):
            for k in range(2):
                for n in range(7):
                    alone = nearest(points[b, k, n], *radii[b, k].tolist())
                    assert_close(feet[b, k, n], alone, atol=1e-15, rtol=0)

    def test_turns_and_flips_with_the_point(self) -> None:
        """A spheroid looks the same turned about its axis and from its other end."""
        point = torch.tensor([0.05, 0.02, 0.17], dtype=F64)
        foot = nearest(point, 0.1, 0.1, 0.3)
        turn = exp_rotation(torch.tensor([0.0, 0.0, 2.1], dtype=F64))
        flip = torch.tensor([1.0, 1.0, -1.0], dtype=F64)
        assert_close(nearest(turn @ point, 0.1, 0.1, 0.3), turn @ foot, atol=1e-14, rtol=0)
        assert_close(nearest(flip * point, 0.1, 0.1, 0.3), flip * foot, atol=1e-14, rtol=0)

    def test_mirrored_and_with_its_axes_renamed(self) -> None:
        """An ellipsoid is its own mirror image in three planes; the order of its axes means nothing."""
        point, radii = torch.tensor([0.05, -0.02, 0.17], dtype=F64), (0.2, 0.1, 0.3)
        foot = nearest(point, *radii)
        for signs in itertools.product((1.0, -1.0), repeat=3):
            flip = torch.tensor(signs, dtype=F64)
            assert_close(nearest(flip * point, *radii), flip * foot, atol=1e-15, rtol=0)
        for order in itertools.permutations(range(3)):
            renamed = nearest(point[list(order)], *(radii[i] for i in order))
            assert_close(renamed, foot[list(order)], atol=1e-15, rtol=0)

    @pytest.mark.parametrize("radii", [(0.1, 0.1, 0.3), (0.1, 0.15, 0.3), (0.15, 0.1, 0.3)])
    @pytest.mark.parametrize(
        "point",
        [(0.3, -0.1, 0.4), (0.02, 0.03, 0.1), (0.0601, 0.0, 0.24), (0.3, 0.2, 0.0), (0.02, 0.05, 0.0)],
        ids=["outside", "inside", "near the surface", "equator plane outside", "equator plane inside"],
    )
    def test_gradients(self, point: tuple[float, ...], radii: tuple[float, ...]) -> None:
        inputs = (
            torch.tensor([[[point]]], dtype=F64, requires_grad=True),
            torch.tensor([[radii]], dtype=F64, requires_grad=True),
        )
        assert torch.autograd.gradcheck(nearest_point, inputs, atol=1e-6)
        # The gradient of the distance is the unit vector from the foot, which autograd does not know.
        local, half_axes = inputs
        (gap := (local - nearest_point(local, half_axes))).norm().backward()
        assert local.grad is not None
        assert_close(local.grad, (gap / gap.norm()).detach(), atol=1e-7, rtol=0)

    @pytest.mark.parametrize("name", HARD)
    def test_gradients_are_finite_everywhere(self, name: str) -> None:
        point, half_axes = HARD[name]
        local = torch.tensor([[[point]]], dtype=F64, requires_grad=True)
        radii = torch.tensor([[half_axes]], dtype=F64, requires_grad=True)
        nearest_point(local, radii).sum().backward()
        assert local.grad is not None
        assert radii.grad is not None
        assert local.grad.isfinite().all()
        assert radii.grad.isfinite().all()


class TestSurfaceNormal:
    def test_is_unit_outward_and_square_to_the_surface(self) -> None:
        posed = scene(6)
        extent = posed.radii[:, :, None]
        ball = torch.nn.functional.normalize(torch.randn(1, 6, 50, 3, dtype=F64), dim=-1)
        point = ball * extent
        normal = surface_normal(point, posed.radii)
        assert_close(normal.norm(dim=-1), torch.ones(1, 6, 50, dtype=F64), atol=1e-14, rtol=0)
        form = ((point + 1e-4 * normal) / extent).norm(dim=-1)
        assert (form > 1).all()
        # A curve on the surface through the point moves square to the normal.
        across = torch.linalg.cross(ball, torch.randn(1, 6, 50, 3, dtype=F64)) * extent
        assert_close((across * normal).sum(-1), torch.zeros(1, 6, 50, dtype=F64), atol=1e-14, rtol=0)

    def test_gap_of_a_nearest_point_is_along_it(self) -> None:
        posed = scene(6)
        local = to_local(posed, around(posed, 20))
        foot = nearest_point(local, posed.radii)
        gap = torch.nn.functional.normalize(local - foot, dim=-1)
        along = (gap * surface_normal(foot, posed.radii)).sum(-1).abs()
        assert_close(along, torch.ones_like(along), atol=1e-6, rtol=0)


class TestFrames:
    def test_there_and_back(self) -> None:
        posed = scene(5)
        points = around(posed, 4)
        local = to_local(posed, points)
        assert_close(to_camera(posed, local), points[:, None].expand(-1, 5, -1, -1), atol=1e-14, rtol=0)
        assert_close(
            to_local(posed, posed.centers)[0].diagonal().mT, torch.zeros(5, 3, dtype=F64), atol=1e-15, rtol=0
        )


def faces_camera(posed: PosedBody, foot: FootPoint) -> Tensor:
    """Cosine between the surface's normal and the way to the camera: positive where the camera sees it."""
    place = to_camera(posed, foot.local)
    normal = (posed.frames[:, :, None] @ foot.normal[..., None])[..., 0]
    return -(torch.nn.functional.normalize(place, dim=-1) * normal).sum(-1)


class TestFootPoint:
    def test_plain_is_the_nearest_point(self) -> None:
        posed = scene(8)
        points = around(posed, 30)
        foot = foot_point(posed, points, visible=False)
        local = to_local(posed, points)
        assert_close(foot.local, nearest_point(local, posed.radii))
        assert_close(foot.residual, local - foot.local)
        assert_close(foot.distance, (local - foot.local).norm(dim=-1))
        assert torch.equal(foot.hidden, faces_camera(posed, foot) < 0)
        assert 0.2 < foot.hidden.double().mean() < 0.8

    def test_visible_or_on_the_rim(self) -> None:
        posed = scene(8)
        points = around(posed, 40, reach=4.0)
        foot, plain = foot_point(posed, points), foot_point(posed, points, visible=False)
        assert torch.equal(foot.hidden, plain.hidden)
        facing = faces_camera(posed, foot)
        assert (facing > -1e-7).all()
        assert_close(facing[foot.hidden], torch.zeros_like(facing[foot.hidden]), atol=1e-7, rtol=0)
        # On the surface, all of them; and on the visible side nothing has changed.
        form = (foot.local / posed.radii[:, :, None]).norm(dim=-1)
        assert_close(form, torch.ones_like(form), atol=1e-12, rtol=0)
        assert_close(foot.local[~foot.hidden], plain.local[~foot.hidden], atol=0, rtol=0)
        assert (foot.distance >= plain.distance - 1e-12).all()

    @pytest.mark.parametrize("reach", [3.0, 0.7], ids=["around", "inside"])
    def test_is_the_nearest_of_all_visible_points(self, reach: float) -> None:
        """Against a dense sampling of the side that faces the camera."""
        posed = scene(6)
        # A sunflower spreads evenly over the ball; the rim, where most answers lie, is sampled on top.
        n = torch.arange(40_000, dtype=F64) + 0.5
        height, turn = 1 - 2 * n / 40_000, n * math.pi * (3 - 5**0.5)
        level = (1 - height**2).sqrt()
        ball = torch.stack([level * turn.cos(), level * turn.sin(), height], -1)
        surface = to_camera(posed, ball * posed.radii[:, :, None])
        normal = surface_normal(to_local_each(posed, surface), posed.radii)
        normal = (posed.frames[:, :, None] @ normal[..., None])[..., 0]
        seen = (surface * normal).sum(-1) < 0
        points = around(posed, 3, reach=reach)
        foot = foot_point(posed, points)
        for k in range(6):
            samples = torch.cat([surface[0, k, seen[0, k]], outline(posed, 2000)[0, k]])
            expected = torch.cdist(points[0], samples).amin(1)
            assert_close(foot.distance[0, k], expected, atol=3e-4, rtol=0)
            # The samples are spaced by millimetres: they can be further away, never nearer.
            assert (foot.distance[0, k] <= expected + 1e-9).all()

    def test_point_across_a_flat_one(self) -> None:
        """Behind the middle of a flat one the front is nearer than the rim: exact on the axis, a search beside it."""
        posed = ellipsoids(
            torch.tensor([[0.0, 0.0, 3.0]], dtype=F64),
            torch.zeros(1, 3, dtype=F64),
            torch.tensor([[0.3, 0.4, 0.1]], dtype=F64),  # the order of axes means nothing here
        )
        points = torch.tensor(
            [[[0.0, 0.0, 3.02], [0.05, -0.1, 3.01], [0.0, 0.0, 3.09], [0.29, 0.0, 3.01]]], dtype=F64
        )
        foot = foot_point(posed, points)
        assert foot.hidden.all()
        assert_close(foot.distance[0, 0, 0].item(), 0.12, atol=1e-12, rtol=0)
        assert_close(foot.local[0, 0, 0], torch.tensor([0.0, 0.0, -0.1], dtype=F64), atol=1e-12, rtol=0)
        x, y = torch.meshgrid(*2 * [torch.linspace(-0.3, 0.3, 1201, dtype=F64)], indexing="ij")
        front = torch.stack([x, y, -0.1 * (1 - (x / 0.3) ** 2 - (y / 0.4) ** 2).clamp_min(0).sqrt()], -1)
        local = points[0, 1] - posed.centers[0, 0]
        expected = (front.flatten(0, 1) - local).norm(dim=-1).min()
        assert_close(foot.distance[0, 0, 1], expected, atol=1e-6, rtol=0)
        gap = torch.nn.functional.normalize(foot.residual[0, 0, 1], dim=-1)
        assert_close(gap, -foot.normal[0, 0, 1], atol=1e-12, rtol=0)
        # Near the edge there is no such point and the rim is nearest.
        facing = faces_camera(posed, foot)[0, 0]
        assert facing[:3].min() > 0.5
        assert facing[3].item() == pytest.approx(0, abs=1e-9)

    def test_distance_is_continuous_across_the_rim(self) -> None:
        """Along lines through ellipsoids of every slant the distance changes by no more than the way walked.

        (Turning the hidden points to the near side of the rim's plane made it jump by up to 5 cm.)
        """
        posed = scene(12)
        start = around(posed, 20).unflatten(1, (12, 20))
        way = torch.nn.functional.normalize(torch.randn(1, 12, 20, 1, 3, dtype=F64), dim=-1)
        walk = torch.linspace(-0.2, 0.2, 801, dtype=F64)
        for k in range(12):
            lines = start[:, k, :, None] + walk[:, None] * way[:, k]
            foot = foot_point(posed, lines.flatten(1, 2))
            distance = foot.distance[0].unflatten(1, (20, 801))
            assert (distance.diff(dim=-1).abs() <= walk[1] - walk[0] + 1e-9).all()
            crossed = foot.hidden[0].unflatten(1, (20, 801)).diff(dim=-1)
            assert crossed.any()

    def test_gap_to_a_rim_point_is_square_to_the_rim(self) -> None:
        """Moving along the rim does not bring the foot nearer."""
        posed = scene(1)
        points = around(posed, 40)
        foot = foot_point(posed, points)
        rim = outline(posed, 20_000)[0, 0]
        place = to_camera(posed, foot.local)[0, 0][foot.hidden[0, 0]]
        index = torch.cdist(place, rim).argmin(1)
        tangent = torch.nn.functional.normalize(rim[(index + 1) % 20_000] - rim[index - 1], dim=-1)
        gap = torch.nn.functional.normalize(points[0][foot.hidden[0, 0]] - place, dim=-1)
        assert len(gap) > 5
        assert_close((gap * tangent).sum(-1), torch.zeros(len(gap), dtype=F64), atol=2e-3, rtol=0)

    def test_camera_inside_sees_no_rim(self) -> None:
        posed = ellipsoids(
            torch.tensor([[0.01, 0.0, 0.02]], dtype=F64),
            torch.zeros(1, 3, dtype=F64),
            torch.tensor([[0.1, 0.1, 0.3]], dtype=F64),
        )
        foot = foot_point(posed, torch.randn(1, 20, 3, dtype=F64))
        assert not foot.hidden.any()
        assert foot.local.isfinite().all()

    def test_camera_on_the_long_axis(self) -> None:
        """The rim is then a circle, whose axes are arbitrary."""
        posed = ellipsoids(
            torch.tensor([[0.0, 0.0, 3.0]], dtype=F64),
            torch.zeros(1, 3, dtype=F64),
            torch.tensor([[0.1, 0.1, 0.3]], dtype=F64),
        )
        # C = 10 half lengths away: the rim is at 1/10 of them, sqrt(1 - 1/100) wide.
        point = torch.tensor([[[0.0, 0.2, 3.2]]], dtype=F64)
        foot = foot_point(posed, point)
        assert foot.hidden.all()
        expected = torch.tensor([0.0, 0.1 * math.sqrt(1 - 0.01), -0.3 * 0.1], dtype=F64)
        assert_close(foot.local[0, 0, 0], expected, atol=1e-12, rtol=0)

    @pytest.mark.parametrize(("visible", "reach"), [(True, 2.0), (False, 2.0), (True, 0.3)])
    def test_gradient_of_the_distance(self, visible: bool, reach: float) -> None:
        base = scene(3)
        points = around(base, 2, reach).requires_grad_()
        centers, radii = base.centers.clone().requires_grad_(), base.radii.clone().requires_grad_()
        turns = torch.zeros(3, 3, dtype=F64, requires_grad=True)

        def distance(points: Tensor, centers: Tensor, turns: Tensor, radii: Tensor) -> Tensor:
            posed = PosedBody(
                base.rotations,
                base.origins,
                centers,
                exp_rotation(turns)[None] @ base.frames,
                radii,
                base.joints,
                base.screw_axes,
                base.screw_origins,
            )
            return foot_point(posed, points, visible).distance

        assert foot_point(base, points).hidden.any()
        assert torch.autograd.gradcheck(distance, (points, centers, turns, radii), atol=1e-6)

    def test_single_precision(self) -> None:
        posed, single = scene(6), scene(6, torch.float32)
        points = around(posed, 50)
        error = (foot_point(single, points.float()).distance - foot_point(posed, points).distance).abs()
        # 1e-6 m of the solver, and the rounding of coordinates of 3 m.
        assert error.max() < 3e-6

    def test_batch_equals_one_by_one(self) -> None:
        posed = scene(4)
        points = around(posed, 10)
        both = foot_point(repeat(posed, 2), torch.cat([points, points.flip(1)]))
        assert_close(both.local[:1], foot_point(posed, points).local, atol=1e-14, rtol=0)
        assert_close(both.local[1:], foot_point(posed, points.flip(1)).local, atol=1e-14, rtol=0)


def repeat(posed: PosedBody, times: int) -> PosedBody:
    return PosedBody(
        *(getattr(posed, name).repeat_interleave(times, 0) for name in PosedBody.__dataclass_fields__)
    )


def to_local_each(posed: PosedBody, points: Tensor) -> Tensor:
    """Points (B, K, N, 3) of the camera's frame, each ellipsoid's own, in its frame."""
    return (points - posed.centers[:, :, None]) @ posed.frames


class TestAlgebraicDistance:
    def test_equals_the_homogeneous_form(self) -> None:
        """q = X^T A X - 2 (T. 3.3)."""
        posed = scene(5)
        points = around(posed, 10, reach=4.0)
        X = torch.cat([points, torch.ones_like(points[..., :1])], -1)[:, None]
        q = (X @ ellipsoid_matrix(posed) * X).sum(-1) - 2
        assert_close(algebraic_distance(posed, points), q, atol=1e-9, rtol=1e-9)

    def test_sign_and_surface(self) -> None:
        posed = scene(5)
        foot = to_camera(posed, foot_point(posed, around(posed, 5), visible=False).local)
        for k in range(5):
            q = algebraic_distance(posed, foot[:, k])[0, k]
            assert_close(q, torch.zeros_like(q), atol=1e-12, rtol=0)
        q = algebraic_distance(posed, posed.centers)
        assert_close(q.diagonal(dim1=1, dim2=2), -torch.ones(1, 5, dtype=F64), atol=1e-12, rtol=0)


class TestOutline:
    def test_lies_on_the_surface_and_its_rays_are_tangent(self) -> None:
        posed = scene(20)
        rim = outline(posed, 16)
        assert rim.shape == (1, 20, 16, 3)
        A = ellipsoid_matrix(posed)
        X = torch.cat([rim, torch.ones_like(rim[..., :1])], -1)
        form = (X @ A * X).sum(-1)
        assert_close(form, torch.full_like(form, 2.0), atol=1e-10, rtol=0)
        # The gradient of the form, A's rows times X, is square to the ray.
        gradient = torch.nn.functional.normalize((X @ A)[..., :3], dim=-1)
        slope = (gradient * torch.nn.functional.normalize(rim, dim=-1)).sum(-1)
        assert_close(slope, torch.zeros_like(slope), atol=1e-12, rtol=0)

    def test_goes_all_the_way_round(self) -> None:
        """The rim's image has the ellipsoid's centre inside: the points' bearings about it cover the circle."""
        posed = scene(20)
        rim, center = (x[..., :2] / x[..., 2:] for x in (outline(posed, 32), posed.centers))
        spokes = rim - center[:, :, None]
        bearing = torch.atan2(spokes[..., 1], spokes[..., 0]).sort(dim=-1).values
        gaps = torch.cat([bearing.diff(dim=-1), bearing[..., :1] + 2 * math.pi - bearing[..., -1:]], -1)
        assert gaps.max() < 2.0

    def test_gradient(self) -> None:
        base = scene(2)

        def rim(centers: Tensor, radii: Tensor) -> Tensor:
            return outline(ellipsoids(centers, torch.full((2, 3), 0.4, dtype=F64), radii), 5)

        inputs = (base.centers[0].clone().requires_grad_(), base.radii[0].clone().requires_grad_())
        assert torch.autograd.gradcheck(rim, inputs, atol=1e-6)


class TestRoughDistance:
    def test_by_definition(self) -> None:
        """(|y| - 1) |y| / |y / r| with y = local / r, one pair after another; and the way behind the middle plane."""
        posed = scene(6)
        points = around(posed, 10)
        local = to_local(posed, points)
        plain, seen = rough_distance(posed, points, visible=False), rough_distance(posed, points)
        for k in range(6):
            for n in range(points.shape[1]):
                y = local[0, k, n] / posed.radii[0, k]
                level = float(y.norm())
                first = (level - 1) * level / float((y / posed.radii[0, k]).norm())
                assert float(plain[0, k, n]) == pytest.approx(first, abs=1e-9)
                center = posed.centers[0, k]
                behind = max(0.0, float((points[0, n] - center) @ center / center.norm()))
                assert float(seen[0, k, n]) == pytest.approx(math.hypot(first, behind), abs=1e-9)

    def test_is_exact_for_spheres_and_to_first_order_beside_a_surface(self) -> None:
        posed = scene(6)
        ball = replace(posed, radii=posed.radii[..., :1].expand(-1, -1, 3))
        points = around(posed, 20)
        far = (to_local(ball, points).norm(dim=-1) - ball.radii[..., :1]).double()
        assert_close(rough_distance(ball, points, visible=False), far, atol=1e-9, rtol=0)
        for away in (1e-2, 1e-3):
            surface = torch.nn.functional.normalize(torch.randn(1, 6, 20, 3, dtype=F64), dim=-1)
            foot = surface * posed.radii[:, :, None]
            local = foot + away * posed.radii.amin() * surface_normal(foot, posed.radii)
            every = rough_distance(posed, to_camera(posed, local).flatten(1, 2), visible=False)
            own = every.unflatten(2, (6, 20)).diagonal(dim1=1, dim2=2).mT
            wanted = away * posed.radii.amin()
            assert ((own - wanted).abs() < 30 * away * wanted).all()

    def test_single_precision_and_shared_points(self) -> None:
        posed, single = scene(6), scene(6, torch.float32)
        points = around(posed, 50)
        error = rough_distance(single, points.float()) - rough_distance(posed, points)
        assert error.abs().max() < 1e-4
        assert_close(rough_distance(repeat(posed, 3), points)[2:], rough_distance(posed, points))


def _pressed_by_hand(posed, part, points, share):
    """Points of a part's surface, and data points, moved along the part's ray: (surface, its moved, data moved)."""
    generator = torch.Generator().manual_seed(3)
    ball = torch.nn.functional.normalize(torch.randn(200_000, 3, generator=generator).double(), dim=-1)
    center, frame, radii = posed.centers[0, part], posed.frames[0, part], posed.radii[0, part]
    surface = (ball * radii) @ frame.mT + center
    ray = center / center.norm()

    def press(places):
        along = ((places - center) @ ray)[:, None] * ray
        return places - (1 - share) * along

    return surface, press(surface), press(points)


@pytest.mark.parametrize("share", [1.0, 0.5, 0.2])
def test_a_flattened_body_is_the_body_pressed_along_each_parts_ray(share):
    """Nearest points by sampling the pressed surface; the foot is where that point was before."""
    body = BodyModel().double()
    pose = torch.cat([torch.tensor([[0.3, 0.1, 3.5, 0.4, 0.1, 0.0]]).double(), body.rest[None].double()], 1)
    posed = body(pose)
    generator = torch.Generator().manual_seed(0)
    points = posed.centers[0, [2, 5, 9]] + 0.15 * torch.randn(3, 3, generator=generator).double()
    flat, back = flattened(posed, torch.full(posed.radii.shape[:2], share, dtype=torch.float64))
    part = torch.tensor([2, 5, 9])[None, None]
    foot = foot_of_part(flat, part, points[None], False)
    whole = unflattened(foot, posed, part, points[None], back)
    for n, k in enumerate((2, 5, 9)):
        surface, moved, target = _pressed_by_hand(posed, k, points[n : n + 1], share)
        gap = (moved - target).norm(dim=1)
        assert_close(foot.residual[0, 0, n].norm(), gap.min(), atol=2e-3, rtol=0)
        place = posed.centers[0, k] + posed.frames[0, k] @ whole.local[0, 0, n]
        assert (place - surface[gap.argmin()]).norm() < 0.02
        gap = posed.frames[0, k] @ whole.residual[0, 0, n]
        assert_close(place + gap, points[n], atol=1e-6, rtol=0)
        assert_close(((whole.local[0, 0, n] / posed.radii[0, k]) ** 2).sum().item(), 1.0, atol=1e-6, rtol=0)
    if share == 1.0:
        plain = foot_of_part(posed, part, points[None], False)
        assert_close(whole.local, plain.local, atol=1e-6, rtol=0)
        assert_close(whole.normal, plain.normal, atol=1e-6, rtol=0)


def test_a_broken_row_does_not_keep_others_from_being_flattened():
    body = BodyModel()
    pose = torch.cat([torch.tensor([[0.3, 0.1, 3.5, 0.4, 0.1, 0.0]]), body.rest[None]], 1)
    share = torch.full((2, body.num_parts), 0.5)
    broken, _ = flattened(body(torch.cat([pose, pose * torch.nan])), share)
    alone, _ = flattened(body(pose), share[:1])
    assert_close(broken.radii[:1], alone.radii)
    assert broken.radii[1].isnan().all()
