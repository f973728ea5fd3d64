"""Two people from one recording: a file each, absent before they come, and a run that goes on ends the same."""

import csv
import json
from pathlib import Path as File

import numpy as np
import pytest
import torch

import torchpose as tp
from torchpose.body.superquadric import draw_person
from torchpose.cli import infer_main
from torchpose.people import PeopleConfig
from torchpose.rendered import write_company
from torchpose.synthesis.company import Company, CompanyRecording, Guest
from torchpose.synthesis.database import synthetic_camera
from torchpose.synthesis.path import Path

FRAMES, COMES = 14, 3  # the second is wholly out of view before this one
QUICK = [
    "pose.smoothing.stretch=4",
    "pose.smoothing.ahead=2",
    "pose.size.rounds=0",
    "pose.start.final_rounds=4",
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> File:
    """One stands there, another walks in from the right and stops."""
    stays = Path((0.0, 9.0), ((-0.55, 3.3), (-0.55, 3.3)))
    comes = Path((0.0, 1.0, 9.0), ((2.9, 3.6), (0.75, 3.6), (0.75, 3.6)))
    guests = (Guest(draw_person(3), stays, 1), Guest(draw_person(8), comes, 2))
    company = CompanyRecording(Company("two", guests, FRAMES / 10), synthetic_camera(320, 240, 10.0))
    return write_company(tmp_path_factory.mktemp("company") / "two", company, stereo=False)


@pytest.fixture(scope="module")
def result(folder: File, tmp_path_factory: pytest.TempPathFactory) -> File:
    output = tmp_path_factory.mktemp("result")
    old = ("poses_3.csv", "poses_3.bvh")
    for name in old:
        (output / name).write_text("an earlier run found a third one")
    (output / "summary.json").write_text(json.dumps({"files": old}))
    assert infer_main([f"recording={folder}", f"output={output}", *QUICK]) == 0
    return output


def truth(folder: File, person: int) -> torch.Tensor:
    with np.load(folder / "truth" / f"person_{person}.npz") as data:
        return torch.from_numpy(data["joints_cam"]).double()


def test_each_has_files_of_their_own_and_nothing_stale_stays(result: File):
    names = {path.name for path in result.iterdir()}
    assert names == {
        *("poses.csv", "poses.npz", "angles.png", "person.yaml"),
        *("poses_2.csv", "poses_2.npz", "angles_2.png", "person_2.yaml"),
        *(f"poses{mark}.{kind}" for mark in ("", "_2") for kind in ("mot", "trc", "bvh")),
        *("overlay.mp4", "summary.json", "report.html"),
    }
    others = json.loads((result / "summary.json").read_text())["others"]
    assert len(others) == 1
    assert sum(others[0].values()) == FRAMES


def test_each_is_followed_where_he_or_she_is(result: File, folder: File):
    for name, person, first in (("poses.csv", 1, 0), ("poses_2.csv", 2, 10)):
        found, true = tp.read_poses_csv(result / name), truth(folder, person)
        assert all(found.answered[first:])
        # The middle of the limb joints: at 320 x 240 without a face left and right may be taken for each other.
        gap = (found.joints - true)[first:, 3:].mean(1).norm(dim=-1)
        assert gap.max() < 0.2


def test_whoever_is_not_there_yet_is_absent_and_has_no_numbers(result: File):
    with (result / "poses_2.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [int(row["frame"]) for row in table] == list(range(FRAMES))
    for row in table[:COMES]:
        assert row["status"] == "absent"
        assert set(list(row.values())[3:]) == {""}


def test_a_run_that_was_interrupted_ends_the_same(
    result: File, folder: File, tmp_path: File, monkeypatch: pytest.MonkeyPatch
):
    step = tp.People.step

    def interrupted(self, recording, position):
        if position == 11:
            raise KeyboardInterrupt
        return step(self, recording, position)

    command = [f"recording={folder}", f"output={tmp_path}", *QUICK]
    with monkeypatch.context() as patch:
        patch.setattr(tp.People, "step", interrupted)
        assert infer_main(command) == 130
    seen: list[int] = []
    monkeypatch.setattr(tp.People, "step", lambda s, r, p: seen.append(p) or step(s, r, p))
    assert infer_main(command) == 0
    assert seen == list(range(8, FRAMES))
    for name in ("poses.csv", "poses_2.csv"):
        again, whole = tp.read_poses_csv(tmp_path / name), tp.read_poses_csv(result / name)
        assert again.status == whole.status
        torch.testing.assert_close(again.joints, whole.joints, atol=1e-3, rtol=0, equal_nan=True)


def test_one_person_is_asked_for_and_one_is_followed(folder: File, tmp_path: File):
    command = [f"recording={folder}", f"output={tmp_path}", "max_frames=3", "eyes.people=1", *QUICK]
    assert infer_main(command) == 0
    assert not (tmp_path / "poses_2.csv").exists()


def test_wrong_settings_are_one_sentence():
    with pytest.raises(ValueError, match="before must be positive, got 0"):
        PeopleConfig(before=0.0)
    with pytest.raises(ValueError, match=r"same_clothes must be a similarity in \[0, 1\), got 1"):
        PeopleConfig(same_clothes=1.0)
    with pytest.raises(ValueError, match="arrival must be at least 1"):
        PeopleConfig(arrival=0)
