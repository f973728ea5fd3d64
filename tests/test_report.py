"""The page of a run: its numbers by reading them back, and what it may hold."""

import base64
import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from made_page import SUMMARY, in_units, make_poses, make_report, read_page, unpack
from torch.testing import assert_close

from torchpose import report as report_module
from torchpose.activity.diary import Entry
from torchpose.body.angle import ANATOMICAL_NAMES
from torchpose.body.model import BodyModel
from torchpose.export import JOINT_NAMES, STATUSES
from torchpose.report import Report, _floor, _lowest, _Series, add_activities
from torchpose.vision.floor import Floor


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return BodyModel()


def test_the_page_holds_the_sequence_s_own_numbers(tmp_path: Path, body: BodyModel):
    poses = make_poses(body, 6, lost=(4,))
    poses.angle_sd[2, 3] = torch.nan
    make_report(body, poses).write(tmp_path / "report.html", SUMMARY)
    _, data = read_page(tmp_path / "report.html")
    clean, size = poses.without_stale_numbers(), body.default_size(1)
    one = data["people"][0]
    np.testing.assert_array_equal(unpack(data["frame"], "<i4"), np.arange(10, 16))
    np.testing.assert_array_equal(unpack(data["time"], "<f8"), poses.time_s)
    assert [STATUSES[i] for i in unpack(one["status"], "u1")] == list(poses.status)
    np.testing.assert_allclose(unpack(one["distance"], "<f4"), clean.point_to_model.float())
    for name, values in (("angles", clean.angles), ("sd", clean.angle_sd)):
        found = in_units(unpack(one[name], "<i2", len(ANATOMICAL_NAMES)), 0.01)
        np.testing.assert_allclose(found, values.rad2deg(), atol=0.0051)
    joints = in_units(unpack(one["joints"], "<i2", len(JOINT_NAMES), 3), 0.001)
    np.testing.assert_allclose(joints, clean.joints, atol=0.00051)
    assert np.isnan(joints[4]).all()

    assert poses.pose is not None
    posed = body(poses.pose, size)
    seen = torch.tensor([0, 1, 2, 3, 5])
    centres = in_units(unpack(one["centres"], "<i2", body.num_parts, 3), 0.001)
    np.testing.assert_allclose(centres[seen], posed.centers[seen], atol=0.00051)
    assert np.isnan(centres[4]).all()
    axes = torch.from_numpy(unpack(one["axes"], "<i2", body.num_parts, 2, 3) / 32767)[seen]
    frames = torch.stack(
        [axes[..., 0, :], axes[..., 1, :], axes[..., 0, :].cross(axes[..., 1, :], dim=-1)], -1
    )
    radii = torch.tensor(one["radii"])
    # An ellipsoid is the same whichever way its axes point: compare the matrices.
    found = frames @ torch.diag_embed(radii.double() ** 2) @ frames.mT
    true = posed.frames @ torch.diag_embed(posed.radii**2) @ posed.frames.mT
    assert_close(found, true[seen].double(), atol=2e-5, rtol=1e-3)

    np.testing.assert_array_equal(unpack(data["shown"], "<i4"), np.arange(6))
    starts = unpack(one["starts"], "<i4")
    np.testing.assert_array_equal(np.diff(starts), [14, 14, 14, 14, 0, 14])
    points = unpack(one["points"], "<i2", 3) * 0.001
    np.testing.assert_allclose(points[starts[3] : starts[4]], posed.centers[3], atol=0.00051)
    np.testing.assert_array_equal(unpack(one["labels"], "i1")[:14], np.arange(14))
    for i, image in enumerate(data["images"]):
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(image), np.uint8), cv2.IMREAD_COLOR)
        assert picture.shape == (90, 120, 3)
        assert abs(picture.mean() - 255 * (i + 1) / 7) < 2


def test_stretches_make_the_same_page_as_the_whole(tmp_path: Path, body: BodyModel):
    poses = make_poses(body, 7)
    whole, parts = (Report("a", body, [body.default_size(1)], 7) for _ in range(2))
    whole.add_poses(0, 0, poses)
    for start, stop in ((3, 7), (0, 3)):
        rows = {
            name: value[start:stop]
            for name, value in vars(poses).items()
            if isinstance(value, torch.Tensor) or name == "status"
        }
        parts.add_poses(0, start, replace(poses, **rows))
    for name, report in (("whole", whole), ("parts", parts)):
        report.write(tmp_path / f"{name}.html", SUMMARY)
    first, second = ((tmp_path / f"{name}.html").read_text() for name in ("whole", "parts"))
    assert re.sub('"floor":.*?]', "", first) == re.sub('"floor":.*?]', "", second)


def test_a_long_run_is_thinned_and_says_so(tmp_path: Path, body: BodyModel):
    poses = make_poses(body, 500)
    report = Report("long", body, [body.default_size(1)] * 2, 20_000)
    for start in range(0, 20_000, 500):
        for person in range(2):
            report.add_poses(person, start, poses)
        for i in range(start, start + 500):
            if report.wants(i):
                report.add_image(i, torch.rand(3, 240, 320))  # noise: the least that JPEG can shorten
                for person in range(2):
                    report.add_points(person, i, torch.rand(1000, 3), torch.zeros(1000).long())
    report.write(tmp_path / "report.html", SUMMARY | {"problems": ["a frame is damaged"] * 20_000})
    assert (tmp_path / "report.html").stat().st_size < 20e6
    _, data = read_page(tmp_path / "report.html")
    position = unpack(data["position"], "<i4")
    assert (position[0], position[-1], len(position)) == (0, 19_999, 4000)
    np.testing.assert_array_equal(unpack(data["frame"], "<i4"), 10 + position % 500)
    assert len(data["images"]) == 200
    assert data["thinned"][0].startswith("Angles, statuses and 3-D poses of 4,000 of 20,000 frames")
    assert data["thinned"][1].startswith("Pictures and points of 200 of 20,000 frames")
    assert data["summary"]["problems"][-1] == "and 19,800 more, see summary.json"


def test_pictures_are_shortened_until_they_fit(
    tmp_path: Path, body: BodyModel, monkeypatch: pytest.MonkeyPatch
):
    """The worst there is: noise in every pixel, which JPEG cannot shorten."""
    monkeypatch.setattr(report_module, "IMAGE_BYTES", 400_000)
    report = make_report(body, make_poses(body, 4))
    for i, size in enumerate(((480, 640), (30, 40), (480, 640), (900, 1200))):
        report.add_image(i, torch.rand(3, *size))
    report.write(tmp_path / "report.html", SUMMARY)
    pictures = [base64.b64decode(image) for image in read_page(tmp_path / "report.html")[1]["images"]]
    assert len(pictures) == 4
    assert max(map(len, pictures)) <= 100_000
    widths = [cv2.imdecode(np.frombuffer(picture, np.uint8), 0).shape[1] for picture in pictures]
    assert widths[1] == 40
    assert max(widths) <= 640
    assert min(widths[0], *widths[2:]) > 200


def test_names_and_warnings_stay_words(tmp_path: Path, body: BodyModel):
    wicked = "</script><script>alert(1)</script><img src=x onerror=alert(2)> & \u2028"
    report = make_report(body, make_poses(body, 2), title=f"<script>{wicked}")
    report.write(tmp_path / "report.html", SUMMARY | {"warnings": [wicked], "problems": [wicked]})
    add_activities(tmp_path / "report.html", [[Entry(0.0, 1.0, wicked, 1.0)]])
    page, data = read_page(tmp_path / "report.html")
    assert not set("<>") & set(page.texts["data"] + page.texts["activities"])
    assert [tag for tag, _ in page.tags].count("script") == 3
    assert all("onerror" not in attributes for _, attributes in page.tags)
    assert data["summary"]["warnings"] == [wicked]
    assert data["title"] == f"<script>{wicked}"
    assert json.loads(page.texts["activities"])[0][0]["activity"] == wicked


def test_it_reads_nothing_from_elsewhere(tmp_path: Path, body: BodyModel):
    make_report(body, make_poses(body, 2)).write(tmp_path / "report.html", SUMMARY)
    page, _ = read_page(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert not re.search(r"https?://|@import|url\(", text)
    for tag, attributes in page.tags:
        assert not {"src", "srcset", "data"} & set(attributes), tag
        assert attributes.get("href", "data:,") == "data:,"
    assert ("html", {"lang": "en"}) in page.tags
    assert page.texts["title"].strip() == "hands - torchpose"
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_activities_come_later_and_replace_earlier_ones(tmp_path: Path, body: BodyModel):
    path = tmp_path / "report.html"
    make_report(body, make_poses(body, 3)).write(path, SUMMARY)
    plain = path.read_text()
    for name in ("walking", "waving"):
        add_activities(path, [[Entry(0.0, 0.1, name, 2.5), Entry(0.1, 0.15, "unseen", float("nan"))], []])
    page, _ = read_page(path)
    entry = {"start_s": 0.0, "end_s": 0.1, "activity": "waving", "log_odds": 2.5}
    unseen = {"start_s": 0.1, "end_s": 0.15, "activity": "unseen", "log_odds": None}
    assert json.loads(page.texts["activities"]) == [[entry, unseen], []]
    add_activities(path, [])
    assert path.read_text() == plain
    (tmp_path / "other.html").write_text("<p>hello")
    with pytest.raises(
        ValueError, match=r"other.html must be a page that torchpose wrote, got something else; run"
    ):
        add_activities(tmp_path / "other.html", [])


def test_the_grid_lies_under_the_feet(body: BodyModel):
    """A camera that looks down by 10 degrees sees the floor slope; somebody who stays shows nothing of it."""
    one = _Series(0, body, body.default_size(1))
    z = torch.linspace(2, 5, 200)
    lifted = torch.where(torch.arange(200) % 4 == 0, 0.15, 0.0)
    one.lowest = torch.stack([torch.randn(200) / 5, 1.5 - 0.176 * z - lifted, z], -1).tolist()
    floor = _floor([one])
    assert floor is not None
    assert floor == pytest.approx([1.5, 0.0, -0.176], abs=0.03)
    one.lowest = [[0.0, 0.9, 3.0]] * 50
    assert _floor([one]) == pytest.approx([0.9, 0, 0])
    assert _floor([_Series(0, body, body.default_size(1))]) is None


def test_the_grid_lies_on_the_floor_that_was_found(tmp_path: Path, body: BodyModel):
    """A camera 1.2 m over the floor that leans and looks down: three of the grid's points are at no height."""
    normal = torch.nn.functional.normalize(torch.tensor([0.1, -1.0, -0.3]), dim=0)
    summary = {**SUMMARY, "floor": {"normal": normal.tolist(), "height_m": 1.2, "tilt_deg": 17.0}}
    make_report(body, make_poses(body, 2)).write(tmp_path / "report.html", summary)
    _, data = read_page(tmp_path / "report.html")
    assert data["floor_seen"]
    a, b, c = data["floor"]
    grid = torch.tensor([[x, a + b * x + c * z, z] for x, z in ((0.0, 0.0), (2.0, 1.0), (-1.0, 4.0))])
    assert_close(Floor(normal, torch.tensor(1.2)).above(grid), torch.zeros(3), atol=1e-6, rtol=0)
    make_report(body, make_poses(body, 2)).write(tmp_path / "report.html", {**SUMMARY, "floor": None})
    _, data = read_page(tmp_path / "report.html")
    assert not data["floor_seen"]
    assert data["floor"] is not None  # under the feet


def test_the_lowest_place_is_on_the_lowest_ellipsoid(body: BodyModel):
    posed = body(make_poses(body, 3).pose, body.default_size(1))
    generator = torch.Generator().manual_seed(0)
    sphere = torch.nn.functional.normalize(torch.randn(20_000, 3, generator=generator), dim=-1)
    surface = torch.einsum("bkij,bkj,nj->bkni", posed.frames, posed.radii, sphere) + posed.centers[:, :, None]
    assert_close(_lowest(posed)[:, 1], surface[..., 1].amax((1, 2)), atol=5e-4, rtol=0)
    names = [body.segment_names[i] for i in surface[..., 1].amax(2).argmax(1)]
    assert all(name.startswith("foot") for name in names)


@pytest.mark.parametrize("case", ["one", "nobody", "no frames"])
def test_pages_of_next_to_nothing(tmp_path: Path, body: BodyModel, case: str):
    count = {"one": 1, "nobody": 4, "no frames": 0}[case]
    poses = make_poses(body, count, lost=tuple(range(4)) if case == "nobody" else ())
    make_report(body, poses).write(tmp_path / "report.html", SUMMARY)
    _, data = read_page(tmp_path / "report.html")
    assert len(data["images"]) == count
    assert (data["floor"] is None) == (case != "one")
