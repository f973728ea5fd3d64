"""`poses.rrd`, read back by Rerun's own reader; and what is said where Rerun is not installed."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch.testing import assert_close

from torchpose import rerun_log
from torchpose.body.angle import ANATOMICAL_NAMES, LIMB_ANGLE_NAMES
from torchpose.body.model import BodyModel
from torchpose.cli import infer_main, load_config
from torchpose.export import PoseSequence
from torchpose.geometry import exp_rotation
from torchpose.recording import Backgrounds, Frame, write_recording
from torchpose.rerun_log import depth_png, open_rerun_log
from torchpose.synthesis.database import make_recording, synthetic_camera
from torchpose.vision.camera import StereoCamera

FRAMES, LOST = 5, 2
Columns = dict[str, list[Any]]


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return BodyModel()


@pytest.fixture
def read() -> Callable[[Path], dict[str, Columns]]:
    """A function that reads an .rrd: by entity and column the rows that are not static, in the order of frames."""
    chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed, it is the extra viz")

    def read_rrd(path: Path) -> dict[str, Columns]:
        found: dict[str, Columns] = {}
        for one in chunk.RrdReader(path).stream():
            table = one.to_record_batch().to_pydict()
            assert "log_time" not in table
            columns = found.setdefault(one.entity_path, {})
            for name, rows in table.items():
                if "frame" in table:
                    columns.setdefault(name, []).extend(zip(table["frame"], rows, strict=True))
        return {
            entity: {
                name: [row for _, row in sorted(rows, key=lambda pair: pair[0])]
                for name, rows in columns.items()
            }
            for entity, columns in found.items()
        }

    return read_rrd


def make_poses(body: BodyModel) -> PoseSequence:
    pose = torch.zeros(FRAMES, body.num_parameters)
    pose[:, 2], pose[:, 6:] = 3.0, body.rest
    pose[:, 3] = torch.linspace(-3, 3, FRAMES)
    pose[:, 10] += torch.linspace(0, 1.5, FRAMES)
    pose[LOST] = torch.nan
    return PoseSequence(
        frame=7 + torch.arange(FRAMES),
        time_s=torch.arange(FRAMES).double() / 20,
        status=tuple("lost" if i == LOST else "tracked" for i in range(FRAMES)),
        point_to_model=torch.rand(FRAMES).double(),
        joints=body(pose, body.default_size(1)).joints.double(),
        angle_names=ANATOMICAL_NAMES,
        angles=torch.randn(FRAMES, len(ANATOMICAL_NAMES)).double(),
        angle_sd=torch.rand(FRAMES, len(ANATOMICAL_NAMES)).double(),
        limb_angle_names=LIMB_ANGLE_NAMES,
        limb_angles=torch.rand(FRAMES, 8).double(),
        pose=pose,
    )


def test_what_is_written_is_read_back_by_rerun(
    tmp_path: Path, body: BodyModel, read: Callable[[Path], dict[str, Columns]]
):
    poses, size = make_poses(body), body.default_size(1)
    camera = StereoCamera(64, 48, 80.0, 31.5, 23.5, 0.1)
    points, labels = torch.randn(FRAMES, 20, 3), torch.randint(-1, 14, (FRAMES, 20))
    points[1, 3] = torch.nan
    depth = torch.rand(48, 64) * 5 + 0.5
    depth[0, 0] = torch.nan
    assert poses.pose is not None
    with open_rerun_log(tmp_path / "poses.rrd", body, camera, [size, size]) as log:
        log.add_angles(0, poses)
        for i in range(FRAMES):
            log.at(int(poses.frame[i]), float(poses.time_s[i]))
            log.add_image(torch.full((3, 48, 64), (i + 1) / (FRAMES + 1)))
            log.add_depth(depth_png(depth) if i != LOST else np.zeros(0, np.uint8))
            for person in range(2):
                log.add_person(person, poses.status[i], poses.pose[i], points[i], labels[i])
    assert [path.name for path in tmp_path.iterdir()] == ["poses.rrd"]
    found = read(tmp_path / "poses.rrd")

    for column, name in enumerate(ANATOMICAL_NAMES):
        band = np.array(found[f"/person_1/angles/{name}"]["Scalars:scalars"])
        angle, sd = (values[:, column].rad2deg().numpy() for values in (poses.angles, poses.angle_sd))
        expected = np.stack([angle, angle - 2 * sd, angle + 2 * sd], 1)
        expected[LOST] = np.nan
        np.testing.assert_allclose(band, expected, rtol=1e-6)
    assert found["/person_1/angles/knee_flexion_left"]["frame"] == list(range(7, 7 + FRAMES))
    assert "Scalars:scalars" not in found["/person_2/angles/knee_flexion_left"]

    seen = [i for i in range(FRAMES) if i != LOST]
    posed = body(poses.pose[seen], size)
    for person in ("/person_1", "/person_2"):
        solid = found[f"{person}/body"]
        rows = [i for i, value in enumerate(solid["Ellipsoids3D:centers"]) if value]
        assert len(rows) == len(seen)
        assert_close(torch.tensor([solid["Ellipsoids3D:centers"][i] for i in rows]), posed.centers)
        radii = torch.tensor([solid["Ellipsoids3D:half_sizes"][i] for i in rows])
        turn = torch.tensor([solid["Ellipsoids3D:quaternions"][i] for i in rows])
        axis, angle = turn[..., :3], 2 * torch.atan2(turn[..., :3].norm(dim=-1), turn[..., 3])
        R = exp_rotation(torch.nn.functional.normalize(axis, dim=-1) * angle[..., None])
        shape = R @ torch.diag_embed(radii**2) @ R.mT
        assert_close(
            shape, posed.frames @ torch.diag_embed(posed.radii**2) @ posed.frames.mT, atol=1e-6, rtol=1e-4
        )
        assert_close(torch.tensor(found[f"{person}/joints"]["Points3D:positions"][0]), posed.joints[0])
        assert len(found[f"{person}/skeleton"]["LineStrips3D:strips"][0]) == 14
        states = found[f"{person}/status"]["StateChange:state"]
        assert [state[0] for state in states] == ["tracked", "lost", "tracked"]
        cloud = found[f"{person}/points"]
        known = points[1].isfinite().all(1)
        assert_close(torch.tensor(cloud["Points3D:positions"][1]), points[1][known])
        classes = torch.tensor(cloud["Points3D:class_ids"][1])
        assert_close(classes, torch.where(labels[1] < 0, 14, labels[1])[known])

    pictures = [bytes(row[0]) for row in found["/camera/image"]["EncodedImage:blob"]]
    greys = [cv2.imdecode(np.frombuffer(code, np.uint8), cv2.IMREAD_COLOR).mean() for code in pictures]
    np.testing.assert_allclose(greys, [255 * (i + 1) / (FRAMES + 1) for i in range(FRAMES)], atol=1.5)
    depths = [bytes(row[0]) for row in found["/camera/depth"]["EncodedDepthImage:blob"] if row]
    assert len(depths) == FRAMES - 1
    levels = cv2.imdecode(np.frombuffer(depths[0], np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(levels / 1000, depth.nan_to_num(0.0), atol=0.00051)


def test_a_log_that_fails_leaves_nothing(tmp_path: Path, body: BodyModel):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed, it is the extra viz")
    with (
        pytest.raises(KeyError),
        open_rerun_log(
            tmp_path / "poses.rrd", body, StereoCamera(64, 48, 80.0, 31.5, 23.5), [body.default_size(1)]
        ),
    ):
        raise KeyError
    assert list(tmp_path.iterdir()) == []


def test_depth_out_of_range_is_none():
    depth = torch.tensor([[0.0, -1.0, torch.nan, torch.inf, 65.535, 65.536, 1.2344]])
    levels = cv2.imdecode(depth_png(depth), cv2.IMREAD_UNCHANGED)
    assert levels.tolist() == [[0, 0, 0, 0, 65535, 0, 1234]]


def test_without_rerun_the_command_says_what_to_install_before_it_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(rerun_log, "find_spec", lambda _: None)
    with pytest.raises(ValueError, match=r"pip install 'torchpose\[viz\]'"):
        load_config("infer", ["viz=true"])
    assert infer_main(["viz=true", f"output={tmp_path / 'result'}"]) == 2
    assert "pip install 'torchpose[viz]'" in capsys.readouterr().err
    assert not (tmp_path / "result").exists()
    assert not load_config("infer").viz


def test_infer_writes_it_when_asked(tmp_path: Path, read: Callable[[Path], dict[str, Columns]]):
    synthetic = make_recording("both_hands", 1, 0, 2, synthetic_camera(320, 240, 10.0))
    frames = [Frame(i, i / 10, f.left[0], f.right[0]) for i, f in enumerate(synthetic)]
    write_recording(tmp_path / "hands", synthetic.camera, frames, Backgrounds(*synthetic.background(2)))
    quick = ["pose.height=1.75", "pose.size.rounds=0", "pose.size_frames=1", "pose.start.final_rounds=4"]
    output = tmp_path / "result"
    assert infer_main([f"recording={tmp_path / 'hands'}", f"output={output}", "viz=true", *quick]) == 0
    found = read(output / "poses.rrd")
    for entity in ("/camera/image", "/camera/depth", "/person_1/points", "/person_1/body"):
        assert found[entity]["frame"] == [0, 1], entity
    # The points lie on the body that was fitted to them, and where the depth says.
    points = np.array(found["/person_1/points"]["Points3D:positions"][1])
    centres = np.array(found["/person_1/body"]["Ellipsoids3D:centers"][1])
    assert np.linalg.norm(points.mean(0) - centres.mean(0)) < 0.25
    depth = found["/camera/depth"]["EncodedDepthImage:blob"][1][0]
    levels = cv2.imdecode(np.frombuffer(bytes(depth), np.uint8), cv2.IMREAD_UNCHANGED) / 1000
    assert np.median(levels[levels > 0]) == pytest.approx(np.median(points[:, 2]), abs=1.5)
