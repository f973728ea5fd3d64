"""Tapered super-quadrics: the surface, its normals, where rays enter the solid, and a person."""

import math

import pytest
import torch
from torch import Tensor

from torchpose.body.model import BodyModel
from torchpose.body.superquadric import (
    DisplayModel,
    Person,
    Superquadric,
    bounding_box,
    draw_person,
    implicit,
    intersect,
    normals,
    surface,
)

BODY = BodyModel()
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


def upright(arms: Tensor | None = None) -> Tensor:
    """A pose at the origin with hanging limbs, or other arm directions (left and right, upper arm and
    forearm).
    """
    limbs = torch.tensor([0.0, 1.0, 0.0]).repeat(1, 9, 1)
    limbs[0, 0, 1] = -1
    if arms is not None:
        limbs[0, 1:5] = arms
    zero = torch.zeros(1, 3)
    return BODY.pose_from_directions(zero, zero, limbs)


def drawn(person: Person, pose: Tensor) -> tuple[Tensor, DisplayModel]:
    """Surface points (shapes, points, 3) of a person in a pose, in the camera's frame."""
    display = DisplayModel(BODY, person)
    parts = display(BODY(pose, person.size(BODY)))
    points = surface(display.shapes, 24, 13)[0].flatten(1, 2)
    return points @ parts.rotations[0].mT + parts.origins[0][:, None], display


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_a_person_is_as_tall_as_stated(seed):
    person = draw_person(seed)
    height = drawn(person, upright())[0][..., 1]
    assert (height.max() - height.min()).item() == pytest.approx(person.height, abs=0.02)


def test_each_part_lies_about_the_segment_it_is_labelled_with():
    points, display = drawn(Person(), upright())
    posed = BODY(upright(), Person().size(BODY))
    assert set(display.segments.tolist()) == set(range(14))
    for segment in range(14):
        center = points[display.segments == segment].mean((0, 1))
        assert (posed.centers[0] - center).norm(dim=-1).argmin() == segment


def test_the_right_side_is_the_mirror_image_of_the_left():
    one, other = torch.tensor([0.8, 0.0, -0.6]), torch.tensor([0.0, -0.6, -0.8])
    flip = torch.tensor([-1.0, 1.0, 1.0])
    points, display = drawn(Person(), upright(torch.stack((one, other, one * flip, other * flip))))
    pairs = [
        (BODY.segment_names.index(f"{name}_left"), BODY.segment_names.index(f"{name}_right"))
        for name in ("upper_arm", "forearm", "hand", "thigh", "shank", "foot")
    ]
    for left, right in pairs:
        first, second = (points[display.segments == side].flatten(0, 1) for side in (left, right))
        nearest = torch.cdist(first * flip, second).amin(-1)
        assert nearest.max() < 0.012  # as sets of surface points, whose spacing is about a centimetre


def test_clothes_reach_as_far_as_the_person_says():
    segment = {
        name: BODY.segment_names.index(name) for name in ("upper_arm_left", "forearm_left", "shank_right")
    }

    def cuts(person: Person, name: str) -> set[float]:
        display = DisplayModel(BODY, person)
        return {round(cut, 3) for cut in display.cuts[display.segments == segment[name]].tolist()}

    short = Person(sleeve=0.4, trouser=0.75)
    assert cuts(short, "upper_arm_left") == {0.8, 1.0}  # 1.0: the shoulder
    assert cuts(short, "forearm_left") == {0.0}
    assert cuts(short, "shank_right") == {0.5}
    assert cuts(Person(sleeve=1.0), "forearm_left") == {1.0}


def test_people_are_drawn_by_seed():
    assert draw_person(5) == draw_person(5)
    people = [draw_person(seed) for seed in range(30)]
    assert len({person.pattern for person in people}) == 30
    heights = torch.tensor([person.height for person in people])
    assert heights.min() > 1.54
    assert heights.max() < 1.93
    assert heights.std() > 0.05


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"height": 175.0}, r"height must lie in \[1.0, 2.3\], got 175"),
        ({"sleeve": 1.5}, "sleeve must lie in"),
        ({"colours": ((0.5, 0.5, 0.5),)}, "colours must be 5 RGB triples"),
    ],
)
def test_senseless_people_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        Person(**wrong)


def test_a_person_of_another_body_file_is_refused():
    with pytest.raises(ValueError, match="the person has 2 lengths and the body 8"):
        DisplayModel(BODY, Person(lengths=(1.0, 1.0)))
