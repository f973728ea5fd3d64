"""The nearest pixel of a mask against SciPy, and the rows that draw the body into it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt
from synthetic_cloud import CAMERA, see, standing
from torch.testing import assert_close

from torchpose.body.model import BodyConfig, BodyModel, JointKind
from torchpose.registration.fitting import PosePrior, linearize_by_screws
from torchpose.registration.silhouette import (
    RimConfig,
    nearest_inside,
    overhang,
    silhouette_residual,
    silhouette_rows,
)
from torchpose.registration.vem import FittingConfig

CONFIG = RimConfig()


def blobs(height=90, width=120):
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    mask = ((u - 40) / 12) ** 2 + ((v - 45) / 30) ** 2 < 1
    return (mask | ((u - 90).abs() + (v - 30).abs() < 9))[None]


def test_the_nearest_pixel_is_that_of_scipy():
    mask = blobs()
    nearest = nearest_inside(mask)[0]
    v, u = torch.meshgrid(torch.arange(mask.shape[1]), torch.arange(mask.shape[2]), indexing="ij")
    here = torch.stack([u, v], -1)
    exact, index = distance_transform_edt(~mask[0].numpy(), return_indices=True)
    true = torch.from_numpy(np.stack([index[1], index[0]], -1))  # (u, v)
    assert mask[0][nearest[..., 1].long(), nearest[..., 0].long()].all()
    distance = (nearest - here).norm(dim=-1).double()
    exact = torch.from_numpy(exact)
    assert (distance >= exact - 1e-5).all()  # px
    assert (distance <= 1.04 * exact + 1e-5).all()
    assert ((nearest == true).all(-1)).double().mean() > 0.5  # elsewhere there are ties, and OpenCV's 4 %


def test_inside_and_without_a_mask_a_pixel_is_its_own():
    mask = torch.cat([blobs(), torch.zeros_like(blobs())])
    nearest = nearest_inside(mask)
    v, u = torch.meshgrid(torch.arange(mask.shape[1]), torch.arange(mask.shape[2]), indexing="ij")
    here = torch.stack([u, v], -1).float()
    assert torch.equal(nearest[0][mask[0]], here[mask[0]])
    assert torch.equal(nearest[1], here)


@pytest.fixture(scope="module")
def frame():
    body = BodyModel(
        BodyConfig(joint=JointKind.swing)
    ).double()  # each of whose parameters moves a limb aside
    pose = standing(body)
    return body, pose, nearest_inside(see(body, pose, num=50).silhouette).double()


def kick(body, pose, joint, angle):
    moved = pose.clone()
    moved[:, body.parameter_names.index(joint)] += angle
    return moved


def test_rows_vanish_within_the_mask(frame):
    body, pose, nearest = frame
    everywhere = nearest_inside(torch.ones(1, CAMERA.height, CAMERA.width, dtype=torch.bool))
    rows = silhouette_rows(body(pose), everywhere, CAMERA, CONFIG)
    assert (rows.direction == 0).all()
    assert overhang(body(pose), everywhere, CAMERA, CONFIG) == 0
    # At the true pose rims are on the mask's edge, give or take a pixel.
    assert overhang(body(pose), nearest, CAMERA, CONFIG) < 5e-4
    assert overhang(body(kick(body, pose, "upper_arm_left_1", 0.4)), nearest, CAMERA, CONFIG) > 5e-3


def test_a_row_is_the_way_to_the_mask_in_metres(frame):
    """A mask of the image's left half: every rim point right of it goes left, by its distance."""
    body, pose, _ = frame
    mask = torch.zeros(1, CAMERA.height, CAMERA.width, dtype=torch.bool)
    mask[..., :161] = True  # up to u = 160, one pixel left of the axis
    nearest = nearest_inside(mask).double()
    far = replace(CONFIG, reach=10.0)
    rows = silhouette_rows(body(pose), nearest, CAMERA, far)
    points = rows.points(body(pose))
    u = CAMERA.project(points)[..., 0]
    residual = (rows.direction * (rows.target - points)).sum(-1)
    expected = -(u - 161).clamp_min(0) * points[..., 2] / 320 / far.sd  # a pixel is the edge's own
    assert (expected < 0).sum() > 50
    assert_close(residual, expected)
    # Along the ray a point may move freely.
    assert_close((rows.direction * points).sum(-1), torch.zeros_like(u), rtol=0, atol=1e-5)
    # No pull is stronger than from `reach`.
    near = silhouette_rows(body(pose), nearest, CAMERA, replace(CONFIG, reach=0.05))
    held = (near.direction * (near.target - points)).sum(-1).abs()
    assert_close(held, expected.abs().clamp_max(0.05 / CONFIG.sd))


@pytest.mark.parametrize("weight", [0.25, 1.0])
def test_overhang_is_in_metres_whatever_the_weight(frame, weight):
    body, pose, nearest = frame
    moved = body(kick(body, pose, "forearm_left_1", 0.6))
    assert_close(
        overhang(moved, nearest, CAMERA, replace(CONFIG, weight=weight)),
        overhang(moved, nearest, CAMERA, replace(CONFIG, weight=1.0)),
    )


@pytest.mark.parametrize(
    ("joint", "angle"),
    [
        *[("torso_x", 0.15), ("torso_y", -0.15), ("torso_roll", 0.15)],
        *[("upper_arm_left_1", 0.4), ("upper_arm_right_2", 0.4), ("forearm_left_2", -0.4)],
        *[("thigh_left_2", 0.4), ("thigh_right_2", 0.4), ("shank_left_2", -0.4)],
    ],
)
def test_the_pull_reduces_the_overhang(frame, joint, angle):
    """Down the gradient of the joint that was moved the rims come back, by the overhang's own measure."""
    body, pose, nearest = frame
    moved = kick(body, pose, joint, angle)
    rows = silhouette_rows(body(moved), nearest, CAMERA, CONFIG)
    assert (rows.direction != 0).any()
    silent = PosePrior(moved, torch.zeros_like(moved))
    linearize = linearize_by_screws(body, body.default_size(1), rows, silent, FittingConfig(limit_sd=0.0))
    residual, jacobian = linearize(moved)
    gradient = (jacobian.mT @ residual[..., None])[0, body.parameter_names.index(joint), 0]
    assert gradient.abs() > 100
    stepped = kick(body, moved, joint, -0.05 * gradient.sign())
    before, after = (overhang(body(p), nearest, CAMERA, CONFIG) for p in (moved, stepped))
    assert after < before - 1e-3  # m
    assert gradient * angle > 0  # back to where it came from


def test_the_gradient_is_that_of_the_squared_overhang(frame):
    """Finite differences of the sum of squares of the ways to a straight edge, which is smooth."""
    body, pose, _ = frame
    mask = torch.zeros(1, CAMERA.height, CAMERA.width, dtype=torch.bool)
    mask[..., :161] = True
    nearest, far = nearest_inside(mask).double(), replace(CONFIG, reach=10.0)
    rows = silhouette_rows(body(pose), nearest, CAMERA, far)
    silent = PosePrior(pose, torch.zeros_like(pose))
    size, fitting = body.default_size(1), FittingConfig(limit_sd=0.0)
    residual, jacobian = linearize_by_screws(body, size, rows, silent, fitting)(pose)
    gradient = (jacobian.mT @ residual[..., None])[0, :, 0]

    def cost(p):
        """With the same points of the body, in pixels by the camera, at the depth that they had."""
        u = CAMERA.project(rows.points(body(p)))[..., 0]
        depth = rows.target[..., 2]
        way = (u - 161) * depth / 320 / far.sd
        return 0.5 * (way**2 * (rows.direction != 0).any(-1)).sum()

    step = 1e-6 * torch.eye(24, dtype=torch.float64)
    slope = torch.stack([(cost(pose + d) - cost(pose - d)) / 2e-6 for d in step])
    assert_close(gradient, slope, rtol=1e-4, atol=1e-2)


def test_rows_begin_at_zero(frame):
    """Moved across the mask's edge in small steps, the body's squared residuals never jump."""
    body, pose, _ = frame
    mask = torch.zeros(1, CAMERA.height, CAMERA.width, dtype=torch.bool)
    mask[..., :161] = True
    nearest = nearest_inside(mask).double()
    steps = torch.linspace(-0.02, 0.02, 81, dtype=torch.float64)  # m, half a millimetre (0.05 px) each
    poses = pose.expand(81, -1).clone()
    poses[:, 0] += steps
    rows = silhouette_rows(body(poses), nearest, CAMERA, CONFIG)
    cost = (rows.direction * (rows.target - rows.points(body(poses)))).sum(-1).square()
    jump = cost.diff(dim=0).abs()
    assert (cost.amax(0) > 0).sum() > (cost.amin(0) > 0).sum()  # some points cross
    slope = 2 * cost.amax(0).sqrt() * 5e-4 / CONFIG.sd  # of the square, at its steepest
    assert (jump <= 1.1 * slope + 1e-6).all()


def test_points_outside_the_image_say_nothing(frame):
    body, pose, nearest = frame
    gone = pose.clone()
    gone[:, 0] += 20.0
    assert (silhouette_rows(body(gone), nearest, CAMERA, CONFIG).direction == 0).all()


def test_a_batch_equals_one_by_one(frame):
    body, pose, nearest = frame
    poses = torch.cat([kick(body, pose, "upper_arm_left_1", angle) for angle in (0.1, 0.4, -0.3)])
    other = nearest_inside(torch.ones(1, CAMERA.height, CAMERA.width, dtype=torch.bool)).double()
    masks = torch.cat([nearest, other, nearest])
    batch = silhouette_rows(body(poses), masks, CAMERA, CONFIG)
    shared = silhouette_rows(body(poses), nearest, CAMERA, CONFIG)
    for i in range(3):
        one = silhouette_rows(body(poses[i : i + 1]), masks[i : i + 1], CAMERA, CONFIG)
        residual = silhouette_residual(body(poses), masks, CAMERA, CONFIG)[i : i + 1]
        # The body's frames are square to single precision.
        assert_close(residual, one.residual(body(poses[i : i + 1])), rtol=0, atol=1e-5)
        assert_close(batch.direction[i : i + 1], one.direction)
        assert_close(batch.target[i : i + 1], one.target)
    assert_close(shared.direction[0], batch.direction[0])


@pytest.mark.parametrize("setting", [{"weight": -1.0}, {"sd": 0.0}, {"rim_points": 2}, {"reach": 0.0}])
def test_bad_settings_are_told(setting):
    with pytest.raises(ValueError, match="weight >= 0, sd > 0, rim_points >= 3 and reach > 0 must hold, got"):
        RimConfig(**setting)


def test_it_takes_part_in_one_round_or_is_switched_off():
    with pytest.raises(ValueError, match="last_rounds must be at least 1, got 0; weight=0 switches it off"):
        RimConfig(last_rounds=0)
