"""The head without a face, and the trunk: balls and boxes with known places, drawn people, and the recordings."""

import math

import pytest
import torch
from torch.testing import assert_close

from torchpose.body.model import BodyModel
from torchpose.body.superquadric import DisplayModel
from torchpose.synthesis.depth import cast_depth
from torchpose.vision.camera import StereoCamera
from torchpose.vision.head import HeadConfig, find_head
from torchpose.vision.mean_shift import MeanShiftConfig, mean_shift
from torchpose.vision.points import sample_grid
from torchpose.vision.trunk import TrunkConfig, find_trunk

CAMERA = StereoCamera(320, 240, 240.0, 158.0, 121.0, 0.12)
DOWN = ((0.15, 1.0, 0.0), (0.05, 1.0, -0.1))
UP = ((0.25, -1.0, 0.0), (0.05, -1.0, 0.0))
LEGS = ((0.08, 1.0, 0.0), (0.05, 1.0, 0.03))


def drawn(arms, yaws, lean=0.0, place=(0.1, 0.15, 3.0)):
    """Depth, silhouette, and the true head's and trunk's middle of one person in several directions."""
    body = BodyModel()
    display = DisplayModel(body)
    side = torch.tensor([-1.0, 1.0, 1.0])
    back = torch.tensor(
        [[1, 0, 0], [0, math.cos(lean), -math.sin(lean)], [0, math.sin(lean), math.cos(lean)]]
    )
    legs, arms = torch.tensor(LEGS), torch.tensor(arms)
    rows = torch.cat(
        [torch.tensor([[0.0, -1.0, -0.1]]), arms, arms * side, torch.cat([legs, legs * side]) @ back]
    )
    rows = torch.nn.functional.normalize(rows, dim=-1).expand(len(yaws), -1, -1)
    root = torch.tensor([[yaw, lean, 0.0] for yaw in yaws])
    pose = body.pose_from_directions(torch.tensor([place]).expand(len(yaws), 3), root, rows)
    posed = body(pose, body.default_size(1))
    frames = cast_depth(display, posed, CAMERA)
    names = [f"{name}_{side}" for name in ("shoulder", "hip") for side in ("left", "right")]
    trunk = posed.joints[:, [body.joint_names.index(name) for name in names]].mean(1)
    return frames.depth, frames.mask, posed.centers[:, body.segment_names.index("head")], trunk


def answers(depth, mask, **options):
    cloud = sample_grid(depth, mask, CAMERA)
    trunk = find_trunk(cloud.points, cloud.mask)
    return find_head(depth, mask, trunk.position, CAMERA, **options), trunk


@pytest.mark.parametrize(
    ("arms", "lean"), [(DOWN, 0.0), (UP, 0.0), (DOWN, 0.6)], ids=["stands", "hands up", "stoops"]
)
def test_heads_of_drawn_people_from_before_aside_and_behind(arms, lean):
    # Bent away from the camera a head is behind the back.
    yaws = (0.0, 0.8, -1.6) if lean else (0.0, 0.8, -1.6, 2.4, math.pi)
    depth, mask, head, middle = drawn(arms, yaws, lean)
    found, trunk = answers(depth, mask)
    error = (found.position - head).norm(dim=-1)
    assert found.found.all()
    assert error.max() < 0.15
    assert (error < 3.5 * math.sqrt(3) * found.sd).all()
    assert (trunk.position - middle).norm(dim=-1).max() < 0.3


def ball(place, radius=0.1, hole=None):
    """A silhouette of a ball on a narrow neck over shoulders, at 3 m; known in closed form."""
    v, u = torch.meshgrid(torch.arange(240.0), torch.arange(320.0), indexing="ij")
    x, y = (u - CAMERA.cx) * 3 / CAMERA.focal_length, (v - CAMERA.cy) * 3 / CAMERA.focal_length
    mask = ((x - place[0]) / (0.8 * radius)) ** 2 + ((y - place[1]) / (1.15 * radius)) ** 2 <= 1
    mask |= ((x - place[0]).abs() < 0.05) & (y > place[1]) & (y < place[1] + 0.2)
    mask |= ((x - place[0]).abs() < 0.2) & (y >= place[1] + 0.18) & (y < place[1] + 0.8)
    depth = torch.where(mask, 3.0, torch.nan)
    if hole is not None:
        depth[(x - hole[0]) ** 2 + (y - hole[1]) ** 2 < 0.05**2] = torch.nan
    return depth[None], mask[None]


@pytest.mark.parametrize("place", [(0.0, -0.5), (0.6, -0.2), (-0.8, -0.6)])
@pytest.mark.parametrize("holed", [False, True])
def test_an_oval_over_shoulders_is_found_where_it_is(place, holed):
    depth, mask = ball(place, hole=place if holed else None)
    trunk = torch.tensor([[place[0], place[1] + 0.5, 3.1]])
    found = find_head(depth, mask, trunk, CAMERA)
    # From the middle of the surface inwards along the ray.
    surface = torch.tensor([[*place, 3.0]])
    expected = surface + 0.07 * surface / surface.norm()
    assert_close(found.position, expected, atol=0.035, rtol=0)
    assert found.score > 0.7


def test_a_head_off_the_image_or_none_is_not_found():
    for place in ((0.0, -1.6), (0.0, -1.53)):  # above the image, whose edge is at -1.5 m; cut by it
        depth, mask = ball(place)
        assert mask.any()
        found = find_head(depth, mask, torch.tensor([[0.0, place[1] + 0.5, 3.1]]), CAMERA)
        assert not found.found.any()
        assert found.position.isnan().all()
        assert found.sd.isnan().all()
    empty = torch.zeros(1, 240, 320, dtype=torch.bool)
    nobody = find_head(torch.full((1, 240, 320), 3.0), empty, torch.full((1, 3), torch.nan), CAMERA)
    assert not nobody.found.any()
    assert nobody.score[0] == -torch.inf
    v, u = torch.meshgrid(torch.arange(240), torch.arange(320), indexing="ij")
    plank = ((u > 100) & (u < 200) & (v > 60) & (v < 200))[None]  # as broad as two men
    depth = torch.where(plank, 3.0, torch.nan)
    assert not find_head(depth, plank, torch.tensor([[-0.1, 0.1, 3.0]]), CAMERA).found.any()


def test_an_expected_head_decides_between_two():
    left, right = ball((-0.4, -0.5)), ball((0.4, -0.5))
    depth, mask = torch.where(left[1], left[0], right[0]), left[1] | right[1]
    trunk = torch.tensor([[0.0, 0.0, 3.1]])
    for side in (-1, 1):
        expected = torch.tensor([[side * 0.35, -0.45, 3.05]])
        found = find_head(depth, mask, trunk, CAMERA, expected=expected, expected_sd=torch.tensor([0.1]))
        assert_close(found.position[:, 0], torch.tensor([side * 0.41]), atol=0.03, rtol=0)
    nothing = torch.full((1, 3), torch.nan)
    free = find_head(depth, mask, trunk, CAMERA)
    assert_close(find_head(depth, mask, trunk, CAMERA, expected=nothing).position, free.position)


def test_a_batch_is_its_rows_in_any_dtype():
    depth, mask, _, _ = drawn(DOWN, (0.0, 1.2))
    mask[1, :60] = False  # another top row
    found, trunk = answers(depth, mask)
    for k in range(2):
        alone, middle = answers(depth[k : k + 1], mask[k : k + 1])
        assert_close(found.position[k : k + 1], alone.position, atol=1e-3, rtol=0, equal_nan=True)
        assert_close(trunk.position[k : k + 1], middle.position, atol=1e-3, rtol=0)
    exact = find_head(depth.double(), mask, trunk.position.double(), CAMERA)
    assert exact.position.dtype == torch.float64
    assert_close(exact.position.float(), found.position, atol=1e-3, rtol=0, equal_nan=True)


def test_the_trunk_starts_in_the_weighted_middle_and_goes_inwards():
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(2, 300, 3, generator=generator, dtype=torch.float64) * 0.15
    points += torch.tensor([0.3, 0.1, 3.0])
    weights = torch.rand(2, 300, generator=generator, dtype=torch.float64)
    weights[1, 100:] = 0
    points[1, 100:] = torch.nan
    config = TrunkConfig(MeanShiftConfig(bandwidth=0.2, steps=500, tolerance=1e-9), inset=0.1)
    found = find_trunk(points, weights, config)
    for k in range(2):
        seen = weights[k] > 0
        start = points[k][seen].mean(0)[None, None]  # one mode only: it is reached from anywhere
        mode = mean_shift(points[k][seen][None], weights[k][seen][None], start, config.shift).position[0, 0]
        assert_close(found.position[k], mode * (1 + 0.1 / mode.norm()), atol=1e-6, rtol=0)


def test_the_expected_trunk_is_found_beside_another_person():
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(1, 400, 3, generator=generator) * 0.1
    points[:, :250, 0] -= 0.6
    points[:, 250:, 0] += 0.6
    points[..., 2] += 3.0
    mask = torch.ones(1, 400, dtype=torch.bool)
    free = find_trunk(points, mask)
    assert free.position[0, 0] < -0.5
    found = find_trunk(points, mask, expected=torch.tensor([[0.5, 0.0, 3.1]]))
    assert found.position[0, 0] > 0.5
    for nowhere in (torch.full((1, 3), torch.nan), torch.tensor([[9.0, 0.0, 3.0]])):
        assert_close(find_trunk(points, mask, expected=nowhere).position, free.position)
    nobody = find_trunk(points, torch.zeros_like(mask))
    assert not nobody.found.any()
    assert nobody.position.isnan().all()


def test_bad_input_is_said():
    with pytest.raises(
        ValueError, match=r"must both be \(B, 240, 320\), the camera's image, got \(1, 9, 9\)"
    ):
        find_head(torch.ones(1, 9, 9), torch.ones(1, 9, 9, dtype=torch.bool), torch.zeros(1, 3), CAMERA)
    with pytest.raises(ValueError, match="tilts needs at least one angle"):
        HeadConfig(tilts=())
    with pytest.raises(ValueError, match=r"width must be positive, got 0\.0 m"):
        HeadConfig(width=0.0)
    with pytest.raises(ValueError, match=r"sd must be positive, got -1\.0 m"):
        TrunkConfig(sd=-1.0)
