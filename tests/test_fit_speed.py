"""The benchmark of speed: its data is what it says, both solvers minimise one function, and its table has every row."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.testing import assert_close

import benchmarks.fit_speed as fit_speed
from benchmarks.fit_speed import cast, cold_problem, cold_starts, main, observe, random_poses, seeded
from torchpose.body.ellipsoid import foot_point
from torchpose.body.model import BodyModel


@pytest.fixture(scope="module")
def body():
    return BodyModel()


def test_the_points_lie_on_their_parts_visible_surface(body):
    pose = random_poses(body, 2, seeded("test"))
    depth, part = cast(body, pose)
    posed = body(pose)
    for b in range(2):
        v, u = depth[b].isfinite().nonzero()[::37].unbind(1)
        points = fit_speed.CAMERA.back_project(torch.stack([u, v], -1).float(), depth[b, v, u])
        distance = foot_point(posed, points.expand(2, -1, -1), visible=False).distance[b]
        assert distance[part[b, v, u], torch.arange(len(u))].max() < 1e-4
    assert (pose[:, 6:] >= body.low[6:]).all()
    assert (pose[:, 6:] <= body.high[6:]).all()


def test_an_observation_has_some_400_points_with_noise(body):
    pose = random_poses(body, 2, seeded("test"))
    cloud = observe(body, pose, seeded("noise")).cloud
    assert (cloud.mask.sum(1) > 350).all()
    distance = foot_point(body(pose), cloud.points).distance.amin(1)[cloud.mask]
    assert 0.001 < float(distance.mean()) < 0.005


@pytest.mark.parametrize("known", [True, False], ids=["places", "nearest"])
def test_the_jacobian_that_scipy_gets_is_that_of_differences(body, known):
    problem, truth = cold_problem(body, 1, known)
    local, points = problem.local.double(), problem.points.double()
    problem = replace(problem, body=BodyModel().double(), local=local, points=points)
    pose = truth.double() + 0.05
    linearize = problem.linearize()
    _, jacobian = linearize(pose)
    step = 1e-6 * torch.eye(24, dtype=torch.float64)
    slope = torch.stack([(linearize(pose + d)[0] - linearize(pose - d)[0]) / 2e-6 for d in step], -1)
    assert_close(jacobian, slope, atol=1e-6 * float(slope.abs().max()), rtol=0)


def test_starts_are_as_far_off_as_stated():
    off = torch.rad2deg(cold_starts(torch.zeros(3, 24), 50)[:, 6:].abs())
    assert 15 <= off.min() < 16
    assert 34 < off.max() <= 35


def test_it_runs_and_writes_its_figures(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setattr(fit_speed, "BATCHES", (1, 2))
    monkeypatch.setattr(fit_speed, "POINTS", (50,))
    file = tmp_path / "speed.json"
    assert main(["--repeats", "1", "--frames", "2", "--starts", "2", "--json", str(file)]) == 0
    numbers = json.loads(file.read_text())
    assert [row["batch"] for row in numbers["warm"]] == [1, 2]
    assert all(row["error_mm"] < row["start_mm"] for row in numbers["warm"])
    assert [row["solver"] for row in numbers["cold"]] == 2 * ["torchpose", "torchpose, batch 32", "scipy trf"]
    assert all(row["arrived"] == 1 for row in numbers["cold"][:3])
    assert set(numbers["iteration"][0]["ms"]) == {"moments", "rows", "autograd", "sums"}
    assert "places known   scipy trf" in capsys.readouterr().out
