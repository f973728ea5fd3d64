"""Tapered super-quadrics: the surface, its normals, and where rays enter the solid."""

import math

import pytest
import torch
from torch import Tensor

from torchpose.body.superquadric import Superquadric, bounding_box, implicit, intersect, normals, surface

SHAPES = [
    pytest.param(0.0, 2, id="ellipsoid"),
    pytest.param(-0.45, 2, id="tapered round"),
    pytest.param(0.7, 2, id="widening round"),
    pytest.param(0.0, 4, id="straight"),
    pytest.param(-0.7, 4, id="tapered"),
    pytest.param(-0.5, 6, id="tapered flat-ended"),
    pytest.param(1.2, 6, id="widening flat-ended"),
]
SIZE = (0.05, 0.11, 0.4)


def one(taper: float, exponent: int, size: tuple[float, float, float] = SIZE) -> Superquadric:
    return Superquadric(
        torch.tensor(size, dtype=torch.float64),
        torch.tensor(taper, dtype=torch.float64),
        torch.tensor(exponent),
    )


def rays(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Rays from all around towards points in and near a shape of `SIZE`: some hit, some graze, some miss."""
    generator = torch.Generator().manual_seed(seed)
    away = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    origins = away / away.norm(dim=-1, keepdim=True) * 1.5
    box = torch.tensor(SIZE, dtype=torch.float64) * torch.tensor([2.6, 2.6, 1.3], dtype=torch.float64)
    targets = (
        torch.rand(count, 3, generator=generator, dtype=torch.float64) - torch.tensor([0.5, 0.5, 0.1])
    ) * box
    return origins, targets - origins


def sampled_entry(
    origins: Tensor, directions: Tensor, shape: Superquadric, count: int = 4001
) -> tuple[Tensor, Tensor]:
    """The definition: walk along each ray and take the first sample inside; with it the least value met on
    the way.
    """
    at = torch.linspace(0, 2, count, dtype=torch.float64)
    values = implicit(origins[:, None] + at[:, None] * directions[:, None], shape)
    inside = values <= 0
    first = at[inside.int().argmax(-1)]
    return torch.where(inside.any(-1), first, math.inf), values.amin(-1)


@pytest.mark.parametrize(("taper", "exponent"), SHAPES)
def test_rays_enter_where_dense_sampling_finds_the_solid(taper, exponent):
    shape = one(taper, exponent)
    origins, directions = rays(400)
    expected, least = sampled_entry(origins, directions, shape)
    found = intersect(origins, directions, shape)
    assert 60 < torch.isfinite(expected).sum() < 340  # both kinds are there
    # A ray that dips in by less than a sample's width is seen by the solver and not by the sampling.
    clear = least.abs() > 2e-2
    assert torch.equal(torch.isfinite(found)[clear], torch.isfinite(expected)[clear])
    both = torch.isfinite(found) & torch.isfinite(expected)
    assert (expected - found)[both].min() >= -1e-9  # never later than a sample that is inside
    assert (expected - found)[both & clear].max() <= 2 / 4000 + 1e-9
    points = (origins + found[:, None] * directions)[torch.isfinite(found)]
    assert implicit(points, shape).abs().max() < 1e-6


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_without_taper_and_with_exponent_two_it_is_the_ellipsoid(dtype):
    origins, directions = (tensor.to(dtype) for tensor in rays(500, seed=1))
    half = torch.tensor([SIZE[0], SIZE[1], SIZE[2] / 2], dtype=torch.float64)
    middle = torch.tensor([0, 0, SIZE[2] / 2], dtype=torch.float64)
    p, d = (origins.double() - middle) / half, directions.double() / half
    a, b, c = (d * d).sum(-1), (p * d).sum(-1), (p * p).sum(-1) - 1
    root = b * b - a * c
    expected = torch.where(root >= 0, (-b - root.clamp_min(0).sqrt()) / a, math.inf)
    shape = Superquadric(torch.tensor(SIZE, dtype=dtype), torch.tensor(0, dtype=dtype), torch.tensor(2))
    found = intersect(origins, directions, shape)
    clear = root.abs() > 1e-3 * a
    assert torch.equal(torch.isfinite(found)[clear], torch.isfinite(expected)[clear])
    hit = clear & torch.isfinite(expected)
    assert hit.sum() > 100
    torch.testing.assert_close(
        found[hit].double(), expected[hit], atol=1e-9 if dtype == torch.float64 else 3e-6, rtol=0
    )


def test_grazing_rays_in_single_precision_stay_near_the_surface():
    shape = one(-0.5, 6)
    points, outward = surface(shape, 16, 9)
    points, outward = points[1:-1].reshape(-1, 3), outward[1:-1].reshape(-1, 3)
    tangent = torch.linalg.cross(
        outward, torch.tensor([0.3, 0.5, 0.8], dtype=torch.float64).expand_as(outward)
    )
    tangent = tangent / tangent.norm(dim=-1, keepdim=True)
    single = Superquadric(shape.size.float(), shape.taper.float(), shape.exponent)
    for depth, hits in ((1e-4, True), (-1e-4, False)):  # metres below or above the surface
        start = points - depth * outward - 2 * tangent
        found = intersect(start.float(), tangent.float(), single)
        assert torch.isfinite(found).all() == hits
        assert torch.isfinite(found).any() == hits
        if hits:
            near = implicit(start + found.double()[:, None] * tangent, shape)
            assert near.abs().max() < 1e-3


def test_a_ray_along_the_axis_and_one_from_inside():
    shape = one(-0.4, 4)
    below = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)
    assert intersect(below, up, shape).item() == pytest.approx(0.5, abs=1e-9)
    assert intersect(-below, up, shape).item() == math.inf  # it has passed
    beside = below + torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    assert intersect(beside, up, shape).item() == math.inf
    assert intersect(torch.tensor([0.0, 0.0, 0.2], dtype=torch.float64), up, shape).item() == 0


@pytest.mark.parametrize(("taper", "exponent"), SHAPES)
def test_surface_points_lie_on_the_surface_within_the_box_and_normals_are_its_gradient(taper, exponent):
    shape = one(taper, exponent)
    points, outward = surface(shape, 20, 15)
    assert implicit(points, shape).abs().max() < 1e-9
    corners = bounding_box(shape)
    assert (points.flatten(0, 1) >= corners.amin(0) - 1e-12).all()
    assert (points.flatten(0, 1) <= corners.amax(0) + 1e-12).all()
    interior = points[1:-1].reshape(-1, 3).requires_grad_()
    (gradient,) = torch.autograd.grad(implicit(interior, shape).sum(), interior)
    torch.testing.assert_close(outward[1:-1].reshape(-1, 3), torch.nn.functional.normalize(gradient, dim=-1))
    torch.testing.assert_close(normals(interior, shape).detach(), outward[1:-1].reshape(-1, 3))


def test_many_shapes_at_once_equal_one_by_one():
    sizes = torch.tensor([SIZE, (0.2, 0.1, 0.3), (0.1, 0.1, 0.5)], dtype=torch.float64)
    many = Superquadric(sizes, torch.tensor([-0.4, 0.0, 0.6], dtype=torch.float64), torch.tensor([2, 4, 6]))
    origins, directions = rays(60, seed=2)
    together = intersect(origins[:, None], directions[:, None], many)
    for i in range(3):
        torch.testing.assert_close(together[:, i], intersect(origins, directions, many[i]))
        torch.testing.assert_close(surface(many)[0][i], surface(many[i])[0])


def test_the_distance_is_differentiable_in_the_ray():
    shape = one(-0.5, 4)
    target = torch.tensor([[0.01, -0.02, 0.15], [0.0, 0.05, 0.3]], dtype=torch.float64)
    origins = torch.tensor([[1.0, 0.4, 0.1], [-0.5, 0.9, 0.6]], dtype=torch.float64, requires_grad=True)
    directions = (target - origins.detach()).requires_grad_()
    assert torch.autograd.gradcheck(lambda o, d: intersect(o, d, shape), (origins, directions), atol=1e-4)


@pytest.mark.parametrize(
    ("size", "taper", "exponent", "message"),
    [
        ((0.1, 0.1, 0.0), 0.0, 2, "sizes must be positive, got 0"),
        (SIZE, 0.0, 3, "exponents must be 2, 4 or 6, got 3"),
        (SIZE, -0.6, 2, r"tapers must lie in .* got -0.6 with d = 2"),
        (SIZE, 1.1, 2, r"tapers must lie in .* got 1.1 with d = 2"),
    ],
)
def test_senseless_shapes_are_refused(size, taper, exponent, message):
    with pytest.raises(ValueError, match=message):
        one(taper, exponent, size)


def test_a_surface_needs_enough_points():
    with pytest.raises(ValueError, match="around >= 3"):
        surface(one(0.0, 2), around=2)
