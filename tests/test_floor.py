"""The floor's plane against planes that were drawn: level, tilted, noisy, half covered, absent."""

import math

import pytest
import torch
from torch.testing import assert_close

from torchpose.vision.camera import StereoCamera
from torchpose.vision.floor import Floor, FloorConfig, find_floor

CAMERA = StereoCamera(160, 120, 150.0, 80.3, 59.6, None, 30.0)
WALL = 5.0  # m away, square to the view


def rays(camera: StereoCamera = CAMERA) -> torch.Tensor:
    v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    return camera.back_project(
        torch.stack([u, v], -1).double(), torch.ones(camera.height, camera.width).double()
    )


def depth_of(normal: torch.Tensor, height: float) -> torch.Tensor:
    """Where each pixel's ray of depth 1 meets a plane; inf where it does not."""
    z = -height / (rays() @ normal)
    return torch.where(z > 0, z, torch.inf)


def tilted(pitch: float, roll: float) -> torch.Tensor:
    """Up in the frame of a camera that looks down by `pitch` and leans by `roll`, degrees."""
    p, r = math.radians(pitch), math.radians(roll)
    return torch.tensor(
        [math.sin(r) * math.cos(p), -math.cos(r) * math.cos(p), -math.sin(p)], dtype=torch.float64
    )


def scene(
    up: torch.Tensor, height: float, wall: float = 5.0, table: float | None = None, wide: int = 70
) -> torch.Tensor:
    """Floor, a wall square to the view, and a table of that height over the floor in the `wide` left columns."""
    depth = depth_of(up, height).clamp_max(WALL)
    if table is not None:
        top = depth_of(up, height - table)
        left = torch.arange(CAMERA.width) < wide
        depth = torch.where(left & (top < 2.4), torch.minimum(top, depth), depth)
    return depth


@pytest.mark.parametrize(
    ("pitch", "roll", "height"), [(0, 0, 0.8), (0, 0, 1.2), (14, 0, 1.2), (30, 5, 1.6), (-5, -8, 0.8)]
)
def test_a_drawn_floor_is_found(pitch, roll, height):
    up = tilted(pitch, roll)
    floor = find_floor(scene(up, height), CAMERA)
    assert floor is not None
    # The wall's lowest centimetres are as near to it as its own noise.
    assert_close(floor.normal, up, atol=2e-3, rtol=0)
    assert_close(float(floor.height), height, atol=0.01, rtol=0)


@pytest.mark.parametrize("wide", [70, 120])
def test_the_floor_is_below_the_table(wide):
    """Also where the table shows more readings than the floor: the floor has nothing below it."""
    up = tilted(10, 0)
    bare, with_table = scene(up, 1.4), scene(up, 1.4, table=0.75, wide=wide)
    share = (with_table < bare).double().mean() / (bare < WALL).double().mean()
    assert (share > 0.5) == (wide == 120)
    floor = find_floor(with_table, CAMERA)
    assert_close(float(floor.height), 1.4, atol=0.01, rtol=0)


def test_the_desk_that_the_camera_stands_on_is_no_floor():
    desk = depth_of(tilted(10, 0), 0.12).clamp_max(4.0)
    assert find_floor(desk, CAMERA) is None
    assert find_floor(desk, CAMERA, config=FloorConfig(lowest=0.1)) is not None


def test_noise_of_a_depth_camera_moves_it_by_little():
    up, noise = tilted(12, 3), 0.005
    clean = scene(up, 1.2)
    drawn = torch.randn(clean.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    floor = find_floor(clean + noise * clean.square() * drawn, CAMERA, noise)
    assert math.degrees(math.acos(min(1.0, float(floor.normal @ up)))) < 0.7
    there = torch.tensor([0.1, 0.3, 3.0], dtype=torch.float64)
    assert_close(float(floor.above(there)), float(there @ up) + 1.2, atol=0.02, rtol=0)


def test_readings_near_it_decide_and_others_do_not():
    """Of a third of the readings at random places the answer does not hear."""
    up = tilted(8, 0)
    depth = scene(up, 1.0)
    source = torch.Generator().manual_seed(2)
    wild = torch.rand(depth.shape, generator=source) < 0.33
    # Nearer than the floor: something stands there.
    depth = torch.where(wild, depth * (0.4 + 0.5 * torch.rand(depth.shape, generator=source)), depth)
    floor = find_floor(depth, CAMERA)
    assert math.degrees(math.acos(min(1.0, float(floor.normal @ up)))) < 0.3
    assert_close(float(floor.height), 1.0, atol=0.01, rtol=0)


@pytest.mark.parametrize(
    "depth",
    [
        torch.full((120, 160), 3.0),  # a wall
        torch.full((120, 160), torch.nan),
        torch.full((120, 160), 30.0),  # too far off
    ],
)
def test_where_no_floor_is_seen_there_is_none(depth):
    assert find_floor(depth, CAMERA) is None


def test_a_ceiling_and_a_steep_ramp_are_no_floor():
    ceiling = depth_of(tilted(0, 0), -1.5).clamp_max(5.0)
    assert find_floor(ceiling, CAMERA) is None
    ramp = depth_of(tilted(55, 0), 1.5).clamp_max(5.0)
    assert find_floor(ramp, CAMERA) is None
    assert find_floor(ramp, CAMERA, config=FloorConfig(tilt=60.0)) is not None


def test_a_few_readings_are_no_floor():
    depth = torch.full((120, 160), torch.nan, dtype=torch.float64)
    depth[110, 20:22] = 2.0
    assert find_floor(depth, CAMERA) is None


def test_the_same_scene_has_the_same_floor_in_either_precision():
    depth = scene(tilted(20, 1), 1.3)
    one, again = find_floor(depth, CAMERA), find_floor(depth, CAMERA)
    assert torch.equal(one.normal, again.normal)
    single = find_floor(depth.float(), CAMERA)
    assert single.normal.dtype == torch.float32
    assert_close(single.normal.double(), one.normal, atol=1e-4, rtol=0)


def test_heights_are_along_the_normal():
    floor = Floor(torch.tensor([0.0, -0.6, -0.8]), torch.tensor(2.0))
    points = torch.tensor([[[0.0, 0.0, 0.0], [5.0, 0.0, 2.5]], [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]])
    assert_close(floor.above(points), torch.tensor([[2.0, 0.0], [1.4, 2.6]]))


@pytest.mark.parametrize("depth", [0.8, 2.5, 6.0])
def test_pixels_above_it_are_those_whose_points_are(depth):
    floor = Floor(tilted(12, 4), torch.tensor(1.2, dtype=torch.float64))
    over = floor.above(depth * rays())
    above = floor.pixels_above(CAMERA, depth)
    assert torch.equal(above[over.abs() > 1e-9], over[over.abs() > 1e-9] > 0)
    assert above.shape == (CAMERA.height, CAMERA.width)


def test_a_depth_of_another_size_is_told():
    with pytest.raises(ValueError, match=r"camera's size \(120, 160\), got \(60, 160\)"):
        find_floor(torch.ones(60, 160), CAMERA)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"tilt": 90.0}, "tilt must be between 0 and 90 degrees, got 90.0"),
        ({"lowest": 0.0}, "lowest must be positive"),
        ({"roughness": -1.0}, "roughness must be positive"),
        ({"trials": 0}, "trials must be positive"),
        ({"noise": -0.1}, "noise must not be negative"),
        ({"least_share": 1.0}, "least_share must be a share"),
    ],
)
def test_bad_settings_are_told(setting, message):
    with pytest.raises(ValueError, match=message):
        FloorConfig(**setting)
