"""The height of a person from a few frames: whoever is short is measured where legs cannot be hidden."""

import pytest
import torch

from torchpose.eyes import Sight
from torchpose.pipeline import PoseConfig, StereoToPose
from torchpose.synthesis.database import synthetic_camera
from torchpose.vision.faces import Faces
from torchpose.vision.points import PointCloud


def column(height: float, cut: bool = False) -> Sight:
    """Somebody upright 3 m away: points down a line of this height, m."""
    y = torch.linspace(-0.5, height - 0.5, 501)
    points = torch.stack((0 * y, y, 3 + 0 * y), -1)[None]
    nothing = torch.zeros(1, 501, 2)
    cloud = PointCloud(
        points, nothing, nothing.long(), torch.ones(1, 501, dtype=torch.bool), nothing.long() + 501
    )
    image = torch.zeros(1, 4, 4)
    unseen = torch.full((1, 4), torch.nan)
    faces = Faces(unseen, torch.zeros(1, dtype=torch.bool), image > 0, unseen[:, :3])
    return Sight(image.expand(1, 3, 4, 4), image, image > 0, cloud, faces, True, cut)


@pytest.mark.parametrize(
    ("least", "heights", "expected"),
    [
        (1.45, (1.2, 1.57, 1.6, 1.3), 1.57 * 0.98 + 0.03),  # the second tallest, for two of the frames stand
        (1.75, (1.2, 1.57, 1.6, 1.3), 1.75),  # too short to be believed
        (1.75, (1.8, 1.81, 1.85), 1.81 * 0.98 + 0.03),
        (1.45, (1.2, 1.0), 1.45),
    ],
)
def test_the_height_is_measured_down_to_the_least_believed(least, heights, expected):
    model = StereoToPose(synthetic_camera(64, 48), config=PoseConfig(least_height=least))
    sights = [column(height) for height in heights]
    assert model.measure_height(sights) == pytest.approx(expected, abs=1e-3)
    assert model.measure_height([*sights, column(1.95, cut=True)]) == pytest.approx(expected, abs=1e-3)


def test_without_a_whole_person_the_height_is_the_body_files():
    model = StereoToPose(synthetic_camera(64, 48), config=PoseConfig(least_height=1.45))
    assert model.measure_height([column(1.6, cut=True)]) == pytest.approx(model.body.height)
