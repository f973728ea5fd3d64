"""The benchmark on recordings with true joints: its oracles are what they say, and its figures are in range."""

from pathlib import Path

import pytest
import torch

from benchmarks.people import ABLATIONS, LIMB_JOINTS, Truth, measure, true_pose, true_size
from torchpose.body.angle import limb_angles
from torchpose.body.model import BodyModel
from torchpose.cli import load_config


@pytest.fixture
def recording(shared_data: Path) -> Path:
    folder = shared_data / "people" / "knee_lifts_m2"
    if not folder.is_dir():
        pytest.skip(f"no folder {folder}")
    return folder


def test_the_start_and_size_oracles_put_the_body_on_the_true_joints(recording: Path):
    truth, body = Truth(recording), BodyModel()
    for index in (0, 20, 40):
        posed = body(true_pose(body, truth, index), true_size(body, truth))
        true = truth.joints[index]
        # Limbs point the same way, so their angles agree; both hips hang on one straight pelvis in our body.
        same = limb_angles(torch.cat([torch.zeros(3, 3), true]))
        torch.testing.assert_close(limb_angles(posed.joints[0])[:6], same[:6], atol=0.05, rtol=0)
        assert (posed.joints[0, 3:] - true).norm(dim=-1).max() < 0.08
    assert len(LIMB_JOINTS) == truth.joints.shape[1] == 12


@pytest.mark.slow
@pytest.mark.parametrize(
    "oracles", [(), ("disparity", "mask", "labels", "start", "size")], ids=["ours", "truth"]
)
def test_a_real_recording_is_measured_within_the_first_issue_s_targets(
    recording: Path, oracles: tuple[str, ...]
):
    figures = measure(recording, load_config("infer"), oracles, frames=10)
    assert figures["angle_deg"] < 12
    assert figures["joint_mm"] < 100
    assert figures["unanswered"] == 0


def test_every_ablation_is_a_setting_of_its_own():
    configs = [load_config("infer", settings).pose for settings in ABLATIONS.values()]
    assert configs[0] == load_config("infer").pose
    assert all(first != other for i, first in enumerate(configs) for other in configs[:i])
