"""The room and the renderer against closed forms, brute force, and the geometry of two views."""

import functools
import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from torchpose.body.model import BodyModel
from torchpose.body.superquadric import DisplayModel, Person, Superquadric, draw_person, intersect
from torchpose.synthesis.motion import perform
from torchpose.synthesis.render import (
    PosedShapes,
    RenderConfig,
    SensorConfig,
    StereoFrames,
    StereoRenderer,
    cast,
)
from torchpose.synthesis.room import Room, RoomConfig, SolidTexture, edge_pixels, subpixels
from torchpose.vision.camera import StereoCamera

BODY = BodyModel()
TINY = StereoCamera(80, 60, 75.0, 39.3, 29.7, 0.12)
SMALL = StereoCamera(200, 150, 187.5, 99.2, 75.1, 0.12)
NOISY = RenderConfig()
QUIET = RenderConfig(sensor=SensorConfig(0.0, 0.0, 0.0, 0.0))


def pose_of(
    person: Person, motion: str = "both_hands", count: int = 2, camera: StereoCamera = TINY
) -> Tensor:
    return perform(BODY, person.size(BODY), motion, torch.arange(count) * 0.4, camera, 3, 1)


@functools.cache
def renderer(camera: StereoCamera = TINY, config: RenderConfig = NOISY, seed: int = 0) -> StereoRenderer:
    return StereoRenderer(camera, BODY, Person(), config, seed)


def rendered(camera: StereoCamera = TINY, config: RenderConfig = NOISY, seed: int = 0) -> StereoFrames:
    posed = BODY(pose_of(Person(), camera=camera), Person().size(BODY))
    return renderer(camera, config, seed)(posed)


def rays_of(camera: StereoCamera) -> Tensor:
    pixels = torch.cartesian_prod(torch.arange(camera.height), torch.arange(camera.width)).flip(-1).float()
    return camera.back_project(pixels, torch.ones(len(pixels)))


def rotation(seed: int) -> Tensor:
    q = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(seed)))[0]
    return q * torch.linalg.det(q)


def test_the_depth_of_one_ellipsoid_is_the_closed_form():
    size, turn, place = torch.tensor([0.3, 0.2, 0.9]), rotation(4), torch.tensor([0.1, -0.1, 3.0])
    shape = Superquadric(size[None], torch.zeros(1), torch.full((1,), 2))
    rays = rays_of(TINY)
    hits = cast(PosedShapes(shape, turn[None], (place - turn @ torch.tensor([0, 0, 0.45]))[None]), rays)
    half = size / torch.tensor([1, 1, 2])
    d, p = rays.double() @ turn.double() / half, -place.double() @ turn.double() / half
    a, b, c = (d * d).sum(-1), d @ p, p @ p - 1
    expected = torch.where(b * b >= a * c, (-b - (b * b - a * c).clamp_min(0).sqrt()) / a, math.inf)
    seen = torch.isfinite(expected)
    assert 100 < seen.sum() < 1000
    assert torch.equal(torch.isfinite(hits.depth), seen)
    torch.testing.assert_close(hits.depth[seen].double(), expected[seen], atol=1e-5, rtol=0)
    assert torch.equal(hits.part, torch.where(seen, 0, -1))


def test_the_nearest_part_wins_as_in_trying_every_part_on_every_ray():
    person = draw_person(2)
    display = DisplayModel(BODY, person)
    parts = display(BODY(pose_of(person, "boxing"), person.size(BODY)))
    rays = rays_of(TINY)
    turn, origin = parts.rotations[1], parts.origins[1]
    hits = cast(PosedShapes(display.shapes, turn, origin), rays)
    start = -(turn.mT @ origin[..., None])[..., 0]
    each = intersect(start, (turn.mT @ rays[:, None, :, None])[..., 0], display.shapes)
    depth, part = each.min(-1)
    torch.testing.assert_close(hits.depth, depth, atol=1e-5, rtol=0)
    tie = each.sort(-1).values[:, :2].diff(dim=-1)[:, 0] < 1e-5
    assert torch.equal(hits.part[~tie], torch.where(torch.isfinite(depth), part, -1)[~tie])
    assert hits.part[torch.isfinite(hits.depth)].unique().numel() > 15


def test_depth_and_labels_are_those_of_the_nearest_surface():
    person = draw_person(2)
    frames = StereoRenderer(TINY, BODY, person, QUIET)(BODY(pose_of(person), person.size(BODY)))
    display = DisplayModel(BODY, person)
    parts = display(BODY(pose_of(person), person.size(BODY)))
    hits = cast(PosedShapes(display.shapes, parts.rotations[1], parts.origins[1]), rays_of(TINY))
    expected = torch.where(hits.part >= 0, display.segments[hits.part] + 1, 0).reshape(60, 80)
    assert torch.equal(frames.labels[1], expected)
    assert torch.equal(frames.mask, frames.labels > 0)
    torch.testing.assert_close(frames.depth[1][frames.mask[1]], hits.depth[hits.part >= 0], atol=1e-5, rtol=0)


def test_floor_and_back_wall_have_the_depth_of_their_planes():
    config = RoomConfig()
    view = Room(config, torch.Generator().manual_seed(0)).view(TINY, torch.zeros(3))
    v = torch.arange(60) - TINY.cy
    floor = torch.where(v > 0, config.camera_height * TINY.focal_length / v, math.inf)
    expected = floor.clamp_max(config.depth)
    free = (expected == config.depth) | (expected < config.depth - 0.3)  # but for the skirting board
    free &= ((expected * v / TINY.focal_length) < config.camera_height - 0.12) | (expected < config.depth)
    middle = view.depth[:, 36:44]  # between the pictures and the furniture
    torch.testing.assert_close(middle[free], expected[free, None].expand(-1, 8), atol=1e-4, rtol=0)
    assert free.sum() > 50


def test_furniture_is_met_where_marching_along_the_ray_enters_it():
    room = Room(RoomConfig(), torch.Generator().manual_seed(3))
    generator = torch.Generator().manual_seed(1)
    directions = torch.randn(250, 3, generator=generator) * torch.tensor([0.5, 0.25, 0.0]) + torch.tensor(
        [0, 0.1, 1]
    )
    origins = torch.zeros(250, 3)
    hits = room.cast(origins, directions)
    boxes = room.furniture
    angle = torch.atan2(boxes.sines, boxes.cosines)
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    rows = (angle.cos(), zero, angle.sin(), zero, one, zero, -angle.sin(), zero, angle.cos())
    turn = torch.stack(rows, -1).unflatten(-1, (3, 3))  # R_world_box

    def inside(points: Tensor, slack: float) -> Tensor:
        local = (turn.mT @ (points[..., None, :] - boxes.centers)[..., None])[..., 0]
        return ((local.abs() - boxes.halves).amax(-1) < slack).any(-1)

    share = torch.linspace(0, 0.9995, 800)[:, None, None]
    assert not inside(share * hits.distance[:, None] * directions, -2e-3).any()
    points = hits.distance[:, None] * directions
    on_box = hits.surface >= 6
    assert 25 < on_box.sum() < 200
    assert inside(points[on_box], 1e-4).all()
    assert inside(points + 2e-3 * directions, -1e-5)[on_box].float().mean() > 0.9
    assert (hits.normal.norm(dim=-1) - 1).abs().max() < 1e-5
    assert ((hits.normal * directions).sum(-1) < 0).all()


def test_normals_of_turned_furniture_point_out_of_its_faces():
    room = Room(RoomConfig(), torch.Generator().manual_seed(3))
    rays = rays_of(SMALL)
    hits = room.cast(torch.zeros_like(rays), rays)
    points = (hits.distance[:, None] * rays).reshape(SMALL.height, SMALL.width, 3)
    surface, normal = hits.surface.reshape(150, 200), hits.normal.reshape(150, 200, 3)
    # Between neighbours on one face, the step along the surface is across its normal.
    step = points[:, 1:] - points[:, :-1]
    same = (surface[:, 1:] == surface[:, :-1]) & (normal[:, 1:] == normal[:, :-1]).all(-1)
    assert same.float().mean() > 0.9
    assert ((step * normal[:, 1:]).sum(-1).abs() / step.norm(dim=-1))[same].max() < 2e-3


def warped(image: Tensor, disparity: Tensor) -> Tensor:
    """The left image made from the right one: each pixel taken at column u - d."""
    height, width = disparity.shape
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    grid = torch.stack(((u - disparity + 0.5) * 2 / width - 1, (v + 0.5) * 2 / height - 1), -1)
    return F.grid_sample(image[None], grid[None], align_corners=False)[0]


def test_the_right_view_warped_by_the_true_disparity_is_the_left_view():
    frames = rendered(SMALL, QUIET)
    near = -F.max_pool2d(-frames.depth[:1], 5, 1, 2)[0]
    smooth = (F.max_pool2d(frames.depth[:1], 5, 1, 2)[0] - near) < 0.15
    smooth &= torch.arange(SMALL.width) > 15
    disparity = SMALL.disparity(frames.depth[0])

    def error(shift: float, where: Tensor) -> float:
        return (
            (warped(frames.right[0], disparity + shift) - frames.left[0]).abs().mean(0)[where].mean().item()
        )

    for where in (smooth, smooth & frames.mask[0]):
        assert where.sum() > 500
        assert error(0.0, where) < 0.015
        assert min(error(0.7, where), error(-0.7, where)) > 1.8 * error(0.0, where)  # texture, at pixel scale


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others():
    first = rendered()
    again = StereoRenderer(TINY, BODY, Person())(BODY(pose_of(Person()), Person().size(BODY)))
    assert torch.equal(first.left, again.left)
    assert torch.equal(first.right, again.right)
    other = rendered(seed=1)
    assert not torch.equal(first.left, other.left)
    assert torch.equal(first.depth, other.depth)  # the noise differs, the room and the person do not
    elsewhere = StereoRenderer(TINY, BODY, Person(), replace(RenderConfig(), room=RoomConfig(seed=5)))
    assert not torch.equal(elsewhere.depths, renderer().depths)


def test_frames_do_not_depend_on_how_they_are_grouped():
    whole = rendered()
    pose = pose_of(Person())
    second = renderer()(BODY(pose[1:], Person().size(BODY)), first_frame=1)
    for name in ("left", "right", "depth", "labels"):
        assert torch.equal(getattr(whole, name)[1:], getattr(second, name))
    first = renderer()(BODY(pose[1:], Person().size(BODY)), first_frame=0)
    assert not torch.equal(second.left, first.left)


def test_images_are_eight_bit_and_noise_is_as_large_as_stated():
    sensor = SensorConfig(read_noise=0.02, shot_noise=0.0, gain_difference=0.0, offset_difference=0.0)
    noisy, clean = rendered(TINY, RenderConfig(sensor=sensor)), rendered(TINY, QUIET)
    torch.testing.assert_close(noisy.left * 255, (noisy.left * 255).round(), atol=1e-4, rtol=0)
    inner = (clean.left > 0.1) & (clean.left < 0.9)
    assert (noisy.left - clean.left)[inner].std().item() == pytest.approx(0.02, rel=0.05)
    gain = rendered(TINY, RenderConfig(sensor=SensorConfig(0.0, 0.0, 0.1, 0.0)))
    middle = (clean.right > 0.1) & (clean.right < 0.85)
    assert (gain.right / clean.right)[middle].mean().item() == pytest.approx(1.1, abs=0.005)
    assert torch.equal(gain.left, clean.left)


def test_the_empty_room_is_the_frame_without_the_person_and_the_shadow():
    frames, background = rendered(TINY, QUIET), renderer(TINY, QUIET).background(2)
    assert torch.equal(background[0][0], background[0][1])
    room = ~F.max_pool2d(frames.mask.float(), 3, 1, 1).bool()
    darker = (background[0] - frames.left).amax(1)[room]
    assert darker.min() > -1e-6
    assert (darker > 0.05).sum() > 50  # the shadow
    assert (darker < 1e-6).float().mean() > 0.5
    noisy = renderer().background(2)
    assert not torch.equal(noisy[0][0], noisy[0][1])


def test_the_shadow_lies_on_the_line_from_the_lamp_through_the_person():
    frames, background = rendered(TINY, QUIET), renderer(TINY, QUIET).background(1)
    outside = ~F.max_pool2d(frames.mask[:1].float(), 3, 1, 1)[0].bool()
    dark = ((background[0][0] - frames.left[0]).amax(0) > 0.08) & outside
    rays = rays_of(TINY).reshape(60, 80, 3)
    points = (rays * frames.depth[0][..., None])[dark]
    lamp = torch.tensor(RoomConfig().light)
    display = DisplayModel(BODY, Person())
    parts = display(BODY(pose_of(Person()), Person().size(BODY)))
    scene = PosedShapes(display.shapes, parts.rotations[0], parts.origins[0] - lamp)
    toward = points - lamp
    blocked = torch.stack(
        [
            torch.isfinite(cast(scene, (toward + shift) / (toward + shift)[:, 2:]).depth)
            for shift in torch.cartesian_prod(*[torch.tensor([-0.1, 0.0, 0.1])] * 3)
        ]
    ).any(0)
    assert len(points) > 60
    assert blocked.float().mean() > 0.95


def test_a_person_out_of_view_or_behind_furniture_is_not_drawn():
    pose = pose_of(Person())[:1].clone()
    pose[:, 0] += 30
    away = renderer(TINY, QUIET)(BODY(pose, Person().size(BODY)))
    assert torch.equal(away.left, renderer(TINY, QUIET).background(1)[0])
    assert not away.mask.any()
    pose = pose_of(Person())[:1].clone()
    pose[:, 2] += 3  # behind the back wall
    assert not renderer(TINY, QUIET)(BODY(pose, Person().size(BODY))).mask.any()


def test_textures_fade_before_they_alias():
    texture = SolidTexture(torch.Generator().manual_seed(0))
    points = torch.rand(4000, 3) * 2
    fine = texture(points, torch.full((4000,), 0.002))
    assert fine.mean().abs() < 0.1
    assert 0.6 < fine.std() < 1.5
    assert texture(points, torch.full((4000,), 0.5)).abs().max() == 0
    pixel = 0.01
    step = torch.tensor([pixel, 0, 0])
    seen = torch.full((4000,), pixel)
    first, second = texture(points, seen), texture(points + step, seen)
    assert torch.corrcoef(torch.stack((first, second)))[0, 1] > 0.5  # neighbours are alike: no aliasing


def test_edges_and_subpixels():
    index = torch.tensor([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    expected = torch.tensor([[False, True, True], [False, True, True], [False, False, True]])
    assert torch.equal(edge_pixels(index), expected)
    assert sorted(subpixels(2, torch.zeros(1)).tolist()) == [
        [-0.25, -0.25],
        [-0.25, 0.25],
        [0.25, -0.25],
        [0.25, 0.25],
    ]


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: StereoRenderer(replace(TINY, baseline=None), BODY, Person()),
            "needs a camera with a baseline",
        ),
        (lambda: RenderConfig(samples=0), "samples must be at least 1"),
        (lambda: RoomConfig(depth=-1.0), "depth must be positive, got -1"),
        (lambda: RoomConfig(camera_height=4.0), "must hang below the ceiling"),
        (lambda: SensorConfig(read_noise=-0.1), "noise must be at least 0"),
    ],
)
def test_senseless_settings_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
