"""A person's sizes: fitted to points of a body whose sizes are known, saved and read again."""

from pathlib import Path

import pytest
import torch
from synthetic_cloud import CAMERA, RELAXED, see, standing
from torch.testing import assert_close

from torchpose.body.model import BodyModel
from torchpose.pipeline import StereoToPose
from torchpose.registration.fitting import PosePrior
from torchpose.registration.size import (
    JointProblem,
    SizeConfig,
    fit_size,
    read_size,
    size_precision,
    stack_observations,
    write_size,
)
from torchpose.registration.vem import Registrar

BODY = BodyModel()


def test_sizes_come_nearer_to_the_truth_with_the_poses_known_roughly():
    """A longer shank, shorter arms and a stout trunk; the frames differ in all limbs."""
    torch.manual_seed(0)
    true = BODY.default_size(1)
    for name, factor in (("shank", 1.1), ("upper_arm", 0.93), ("thigh", 0.94), ("trunk_girth", 1.12)):
        true[0, BODY.size_names.index(name)] = factor
    poses = torch.cat(
        [
            standing(
                BODY,
                RELAXED + bend * torch.tensor([0.0, 0.0, -1.0]) * (torch.arange(9) % 2)[:, None],
                yaw=yaw,
            )
            for bend, yaw in ((0.0, 0.0), (0.8, 0.3), (1.5, -0.3), (0.4, 0.0))
        ]
    )
    views = [see(BODY, pose[None], true, noise=0.003) for pose in poses]
    observation = stack_observations([view.observation() for view in views])
    start = poses + 0.03 * torch.randn_like(poses)
    # Wider than the prior on real people, so that what the frames say is seen.
    wide = SizeConfig(common_length_sd=0.06, length_sd=0.04, common_girth_sd=0.10, girth_sd=0.05)
    size, _ = fit_size(Registrar(BODY), observation, start, BODY.default_size(1), wide)
    before, after = (BODY.default_size(1) - true).abs(), (size - true).abs()
    changed = before[0] > 0
    assert after[0, changed].mean() < 0.5 * before[0, changed].mean()
    assert after.max() < 0.08


def test_sizes_survive_a_file_to_a_ten_thousandth(tmp_path: Path):
    size = 1 + 0.1 * torch.randn(1, len(BODY.size_names))
    write_size(tmp_path / "person.yaml", BODY, size)
    assert (tmp_path / "person.yaml").read_text().startswith("#")
    torch.testing.assert_close(read_size(tmp_path / "person.yaml", BODY), size, atol=6e-5, rtol=0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "must exist"),
        ("trunk: 1.0\n", "must hold the sizes"),
        ("[1, 2]", "must hold the sizes"),
        ("{", "must be YAML"),
        (
            "\n".join(f"{name}: 1.0" for name in BODY.size_names).replace("neck: 1.0", "neck: 9"),
            "between 0.6 and",
        ),
        (
            "\n".join(f"{name}: 1.0" for name in BODY.size_names).replace("neck: 1.0", "neck: no"),
            "got {'neck': False}",
        ),
    ],
)
def test_a_file_that_is_not_a_person_is_told(tmp_path: Path, text: str | None, message: str):
    if text is not None:
        (tmp_path / "person.yaml").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_size(tmp_path / "person.yaml", BODY)


def test_residuals_alone_are_those_with_the_jacobian():
    torch.manual_seed(1)
    pose, size = torch.cat([standing(BODY, RELAXED), standing(BODY, RELAXED, yaw=0.4)]), BODY.default_size(1)
    observation = stack_observations([see(BODY, one[None], size).observation() for one in pose])
    registrar, posed = Registrar(BODY), BODY(pose, size)
    foot = registrar.correspond(posed, observation)
    labelling = registrar.label(posed, foot, observation, registrar.config.sigma_last)
    rows, support = registrar.rows(posed, foot, labelling, observation)
    prior = registrar.with_rest(PosePrior(pose, torch.ones_like(pose)), support)
    root = torch.linalg.cholesky(size_precision(BODY, SizeConfig())).mT
    problem = JointProblem(registrar, rows, prior, posed, size, root)
    unknowns = torch.cat([pose.flatten(), size[0]])[None]
    unknowns = unknowns + 0.1 * torch.randn_like(unknowns)
    residual, _ = problem.linearize(unknowns)
    assert residual.square().sum() > 100
    assert_close(problem.residual(unknowns), residual, atol=1e-3, rtol=1e-4)


def test_sizes_fitted_while_following_count_as_sizes(monkeypatch: pytest.MonkeyPatch):
    now = [0.0]
    monkeypatch.setattr("torchpose.eyes.time.process_time", lambda: now[0])

    def slow(registrar, observation, pose, size, config):
        now[0] += 2.0
        return size, pose

    monkeypatch.setattr("torchpose.pipeline.fit_size", slow)
    model, pose = StereoToPose(CAMERA), standing(BODY)
    with model.stopwatch.measure("registration"):
        model.fit_size([see(BODY, pose).observation()], pose)
        now[0] += 1.0
    assert dict(model.stopwatch.seconds) == {"size": 2.0, "registration": 1.0}
