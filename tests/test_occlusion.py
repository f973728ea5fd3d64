"""Depths behind other parts against ray marching through the ellipsoids."""

from dataclasses import replace

import pytest
import torch
from synthetic_cloud import see, standing
from torch.testing import assert_close

from torchpose.body.model import BodyModel
from torchpose.registration.occlusion import OcclusionConfig, depth_behind


@pytest.fixture(scope="module")
def scene():
    body = BodyModel().double()
    pose = standing(body, yaw=0.9).double()
    cloud = see(body, pose, num=60).observation().cloud
    return body, body(pose, body.default_size(1).double()), cloud.points[:, cloud.mask[0]].double()


def test_depths_are_those_of_marching_along_rays(scene):
    _, posed, points = scene
    behind = depth_behind(posed, points)[0]
    depth = torch.linspace(1.0, 6.0, 50001, dtype=torch.float64)
    for n in range(0, points.shape[1], 7):
        way = points[0, n] / points[0, n, 2]
        local = torch.einsum(
            "kij,ksi->ksj", posed.frames[0], depth[:, None] * way - posed.centers[0][:, None]
        )
        level = ((local / posed.radii[0][:, None]) ** 2).sum(-1)  # (K, steps)
        inside = level < 1
        front = torch.where(inside.any(1), depth[inside.int().argmax(1)], torch.inf)
        own = torch.where(inside.any(1), front, depth[level.argmin(1)])
        for k in range(len(front)):
            others = torch.cat([front[:k], front[k + 1 :]]).min()
            assert_close(behind[k, n], own[k] - others, rtol=0, atol=5e-3)


def test_a_seen_part_is_not_hidden_and_one_behind_the_trunk_is(scene):
    body, posed, _ = scene
    names = body.segment_names
    torso, hand = names.index("torso"), names.index("hand_left")
    config = OcclusionConfig()
    front = posed.centers[:, torso][:, None] * 0.95
    centers = posed.centers.clone()
    centers[:, hand] = centers[:, torso] * 1.1
    moved = replace(posed, centers=centers)
    potential = config.potential(depth_behind(moved, front))[0, :, 0]
    assert potential[hand] == -config.penalty
    assert potential[torso] == 0


def test_padding_gives_numbers(scene):
    _, posed, points = scene
    padded = torch.cat([points, torch.zeros_like(points[:, :2])], 1)
    assert OcclusionConfig().potential(depth_behind(posed, padded)).isfinite().all()


@pytest.mark.parametrize("setting", [{"penalty": -1.0}, {"margin": -0.1}, {"ramp": 0.0}])
def test_bad_settings_are_told(setting):
    with pytest.raises(ValueError, match=r"penalty >= 0, margin >= 0 and ramp > 0 must hold, got"):
        OcclusionConfig(**setting)


def test_a_term_of_no_rounds_is_told_how_to_switch_it_off():
    with pytest.raises(ValueError, match="last_rounds must be at least 1, got 0; penalty=0 switches it off"):
        OcclusionConfig(last_rounds=0)
