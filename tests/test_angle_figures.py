"""The drawings of the angles: poses that have the angles they show, and files that are small."""

from pathlib import Path

import pytest
import torch
from PIL import Image
from test_angle import in_double

from benchmarks.angle_figures import DRAWINGS, draw_angle, pose_of_angles
from torchpose.body.angle import ANATOMICAL_NAMES, anatomical_angles
from torchpose.body.model import BodyModel, JointKind


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return in_double(JointKind.anatomical)


def test_every_angle_is_drawn() -> None:
    assert {name.removesuffix("_left").removesuffix("_right") for name in ANATOMICAL_NAMES} == set(DRAWINGS)


def test_a_pose_has_the_angles_that_it_is_made_of(body: BodyModel) -> None:
    """Each within what its joint can do, so that no other angles give the same limbs."""
    draw = torch.rand(len(ANATOMICAL_NAMES), dtype=torch.float64)
    hinges = torch.tensor(["elbow" in name or "knee" in name for name in ANATOMICAL_NAMES])
    degrees = torch.where(hinges, 20 + 80 * draw, 60 * draw - 30)
    pose = pose_of_angles(body, dict(zip(ANATOMICAL_NAMES, degrees.tolist(), strict=True)))
    torch.testing.assert_close(anatomical_angles(body, body(pose))[0].rad2deg(), degrees)


def test_a_drawing_is_a_small_picture(body: BodyModel, tmp_path: Path) -> None:
    path = tmp_path / "hip_flexion.png"
    draw_angle(path, body, "hip_flexion", DRAWINGS["hip_flexion"])
    assert path.stat().st_size < 40_000
    picture = Image.open(path).convert("RGB")
    colours = [colour for _, colour in picture.getcolors(100_000)]
    assert any(blue > red + 50 for red, _, blue in colours)  # the moved limb
    assert any(red > blue + 100 for red, _, blue in colours)  # the arrow
