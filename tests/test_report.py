"""The page of a run: its numbers by reading them back, what it may hold, and in a browser what it shows and does."""

import base64
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch.testing import assert_close

from torchpose import report as report_module
from torchpose.activity.diary import Entry
from torchpose.body.angle import ANATOMICAL_NAMES, LIMB_ANGLE_NAMES
from torchpose.body.ellipsoid import outline
from torchpose.body.model import BodyModel
from torchpose.export import JOINT_NAMES, STATUSES, PoseSequence
from torchpose.report import Report, _floor, _lowest, _Series, add_activities
from torchpose.vision.camera import StereoCamera

CHROMIUM = Path("/usr/bin/chromium")
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
SUMMARY: dict[str, Any] = {
    "version": "1.2.3",
    "versions": {"torch": "2"},
    "settings": {"seed": 0, "pose": {"height": 1.75}},
    "frames": 6,
    "status": {"tracked": 5, "lost": 1},
    "answered": 5 / 6,
    "point_to_model_m": {"mean": 0.011, "sd": float("nan")},
    "size": {"trunk": 0.97, "thigh": 1.02},
    "seconds": 12.0,
    "seconds_per_frame": 2.0,
    "problems": [],
    "warnings": [],
    "others": [],
    "rows_apart_px": None,
}


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return BodyModel()


def make_poses(body: BodyModel, count: int, lost: tuple[int, ...] = (), aside: float = 0.0) -> PoseSequence:
    """Somebody who raises an arm 3 m before the camera, and walks to the right."""
    pose = torch.zeros(count, body.num_parameters)
    pose[:, 0] = torch.linspace(-0.3, 0.3, count) + aside
    pose[:, 2] = 3.0
    pose[:, 6:] = body.rest
    pose[:, 10] += torch.linspace(0, 1.2, count)
    joints = body(pose, body.default_size(1)).joints
    status = tuple("lost" if i in lost else "partial" if i == 1 else "tracked" for i in range(count))
    return PoseSequence(
        frame=10 + torch.arange(count),
        time_s=torch.arange(count).double() / 20,
        status=status,
        point_to_model=torch.rand(count).double() / 50,
        joints=joints.double(),
        angle_names=ANATOMICAL_NAMES,
        angles=torch.randn(count, len(ANATOMICAL_NAMES)).double().clamp(-3.1, 3.1),
        angle_sd=torch.full((count, len(ANATOMICAL_NAMES)), 0.1).double(),
        limb_angle_names=LIMB_ANGLE_NAMES,
        limb_angles=torch.rand(count, 8).double(),
        pose=pose,
        pose_covariance=torch.eye(body.num_parameters).expand(count, -1, -1),
    )


def make_report(body: BodyModel, *people: PoseSequence, title: str = "hands") -> Report:
    """With a picture of each frame whose grey tells the frame, and points on the ellipsoids' middles."""
    size, count = body.default_size(1), len(people[0])
    report = Report(title, body, [size] * len(people), count)
    for number, poses in enumerate(people):
        report.add_poses(number, 0, poses)
        for i in range(count):
            if poses.answered[i]:
                assert poses.pose is not None
                centres = body(poses.pose[i : i + 1], size).centers[0]
                report.add_points(number, i, centres, torch.arange(body.num_parts))
    for i in range(count):
        report.add_image(i, torch.full((3, 90, 120), (i + 1) / (count + 1)))
    return report


class Page(HTMLParser):
    """The elements of a page, and the text of its scripts and its title."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, str] = {}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        tag, attributes = self.tags[-1] if self.tags else ("", {})
        name = attributes.get("id") or tag
        self.texts[name] = self.texts.get(name, "") + data


def read_page(path: Path) -> tuple[Page, dict[str, Any]]:
    page = Page(path.read_text(encoding="utf-8"))
    return page, json.loads(page.texts["data"])


def unpack(text: str, dtype: str, *shape: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype).reshape(-1, *shape)


def in_units(values: np.ndarray, unit: float) -> np.ndarray:
    return np.where(values == -32768, np.nan, values * unit)


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


# In a browser.


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if not CHROMIUM.exists():
        pytest.skip(f"no browser at {CHROMIUM}")
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=str(CHROMIUM), args=list(FLAGS))
        yield chromium
        chromium.close()


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[Any]:
    """A function that opens a written page on a laptop's screen, and fails if that page complains or asks for more."""
    wrong: list[str] = []
    context = browser.new_context(viewport={"width": 1280, "height": 800}, reduced_motion="reduce")

    def open_page(path: Path) -> Any:
        page = context.new_page()
        page.on("console", lambda message: wrong.append(message.text))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on(
            "request",
            lambda request: wrong.extend([request.url] * (not request.url.startswith(("data:", "file:")))),
        )
        page.goto(path.as_uri())
        page.wait_for_selector("body[data-ready]")
        settle(page)
        return page

    yield open_page
    context.close()
    assert wrong == []


def settle(page: Any) -> None:
    page.evaluate("() => new Promise((go) => requestAnimationFrame(() => requestAnimationFrame(go)))")


def picture_of(page: Any) -> np.ndarray:
    """The 3-D view's pixels, (height, width, 4)."""
    settle(page)
    code = page.evaluate("() => document.getElementById('scene').toDataURL('image/png').split(',')[1]")
    return cv2.imdecode(np.frombuffer(base64.b64decode(code), np.uint8), cv2.IMREAD_UNCHANGED)


def frame_of(page: Any) -> int:
    return int(re.match(r"frame (\d+)", page.inner_text("#now"))[1])


def grey_of(page: Any) -> float:
    """The mean of the camera's picture that is shown."""
    source = page.get_attribute("#image", "src")
    return float(cv2.imdecode(np.frombuffer(base64.b64decode(source.split(",")[1]), np.uint8), 0).mean())


def test_the_page_moves_as_one(opened: Any, tmp_path: Path, body: BodyModel):
    poses = make_poses(body, 6, lost=(4,))
    make_report(body, poses).write(tmp_path / "report.html", SUMMARY)
    page = opened(tmp_path / "report.html")
    lines = "() => [...document.querySelectorAll('.cursor')].map((line) => line.getBoundingClientRect().left)"
    assert frame_of(page) == 10
    before, places = picture_of(page), page.evaluate(lines)
    assert len(places) == 14  # 13 panels and the time line
    assert len(np.unique(before.reshape(-1, 4), axis=0)) > 100

    page.keyboard.press("ArrowRight")
    assert frame_of(page) == 11
    assert grey_of(page) == pytest.approx(255 * 2 / 7, abs=2)
    assert (np.array(page.evaluate(lines)) > np.array(places)).all()
    assert (picture_of(page) != before).any()
    shown = page.inner_text(".panel .values")
    degrees = poses.angles[1, 0].rad2deg().round().int().item()
    assert shown.replace("−", "-").split("°")[0] == str(degrees)

    page.keyboard.press("End")
    page.keyboard.press("ArrowLeft")
    assert frame_of(page) == 14
    assert "lost" in page.inner_text("#now")
    assert "No pose" in page.inner_text("#scene-caption")
    page.keyboard.press("Home")
    assert frame_of(page) == 10

    box = page.locator(".plot canvas").nth(7).bounding_box()
    page.mouse.move(box["x"] + box["width"] - 8, box["y"] + box["height"] / 2)
    page.mouse.down()
    assert frame_of(page) == 15
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert frame_of(page) in (12, 13)
    page.mouse.up()
    box = page.locator("#line").bounding_box()
    page.mouse.click(box["x"] + 2, box["y"] + 5)
    assert frame_of(page) == 10
    assert page.get_attribute("#time", "aria-valuenow") == "0"
    assert page.get_attribute("#time", "aria-valuetext").startswith("frame 10, 0.00 s, tracked")


def test_the_3d_view_turns_zooms_and_hides(opened: Any, tmp_path: Path, body: BodyModel):
    make_report(body, make_poses(body, 3)).write(tmp_path / "report.html", SUMMARY)
    page = opened(tmp_path / "report.html")
    box = page.locator("#scene").bounding_box()
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    first = picture_of(page)
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 60, middle[1] + 20)
    page.mouse.up()
    turned = picture_of(page)
    assert (turned != first).any(-1).mean() > 0.03
    page.mouse.wheel(0, -400)
    nearer = picture_of(page)
    assert (nearer[..., 3] > 0).sum() > (turned[..., 3] > 0).sum()
    for name in ("body", "points", "skeleton"):
        page.click(f"#layers >> text={name}")
    assert (picture_of(page)[..., 3] > 0).mean() < 0.5 * (nearer[..., 3] > 0).mean()
    page.keyboard.press("r")
    assert (picture_of(page) != nearer).any()


def test_the_body_stands_where_the_camera_sees_it(opened: Any, tmp_path: Path, body: BodyModel):
    """From the camera's own place the drawn ellipsoids cover the pixels to which their middles project."""
    poses = make_poses(body, 1)
    make_report(body, poses).write(tmp_path / "report.html", SUMMARY)
    page = opened(tmp_path / "report.html")
    for name in ("points", "skeleton"):
        page.click(f"#layers >> text={name}")
    page.click("#looks >> text=camera")
    picture = picture_of(page)
    picture[-60:, :60] = 0  # the axes' names
    red, blue = picture[..., 2].astype(int), picture[..., 0].astype(int)
    solid = picture[..., 3] == 255
    rows, columns = np.nonzero(solid & (np.ptp(picture[..., :3].astype(int), axis=-1) > 25))
    warm, cool = (np.nonzero(solid & (gap > 60))[1].mean() for gap in (red - blue, blue - red))
    assert warm > cool  # the subject's left is on the right
    # The view's scale and middle are its own: the body's shape in it is the projection's.
    assert poses.pose is not None
    posed = body(poses.pose, body.default_size(1))
    rim = StereoCamera(640, 480, 500.0, 320.0, 240.0).project(outline(posed, 128))[
        0, 1:
    ]  # not the grey trunk
    across, down = np.ptp(rim[..., 0].numpy()), np.ptp(rim[..., 1].numpy())
    assert np.ptp(columns) / np.ptp(rows) == pytest.approx(across / down, rel=0.04)
    head, foot = rim[0, :, 0].mean() - rim[..., 0].amin(), rows.min()
    assert columns[rows < foot + 5].mean() - columns.min() == pytest.approx(
        head.item() / across * np.ptp(columns), abs=0.05 * np.ptp(columns)
    )


def test_time_is_zoomed_and_played(opened: Any, tmp_path: Path, body: BodyModel):
    make_report(body, make_poses(body, 40)).write(tmp_path / "report.html", SUMMARY)
    page = opened(tmp_path / "report.html")
    plot = "() => document.querySelector('.plot canvas').toDataURL()"
    whole = page.evaluate(plot)
    page.keyboard.press("+")
    assert page.evaluate(plot) != whole
    page.keyboard.press("0")
    assert page.evaluate(plot) == whole
    page.keyboard.press(" ")
    assert page.get_attribute("#play", "aria-label") == "Pause"
    page.wait_for_function("() => document.getElementById('now').textContent.startsWith('frame 49')")
    page.wait_for_selector("#play[aria-label='Play']")
    assert frame_of(page) == 49


def test_a_long_run_starts_with_a_stretch_and_says_which_frames_have_pictures(
    opened: Any, tmp_path: Path, body: BodyModel
):
    poses = make_poses(body, 2000)  # 100 s
    report = Report("long", body, [body.default_size(1)], 2000)
    report.add_poses(0, 0, poses)
    for i in report.shown.tolist():
        report.add_image(i, torch.rand(3, 24, 32))
        report.add_points(0, i, poses.joints[i].float(), torch.arange(15))
    report.write(tmp_path / "report.html", SUMMARY)
    page = opened(tmp_path / "report.html")
    assert page.inner_text("#shown") == "20 of 100 s"
    page.keyboard.press("ArrowRight")
    assert "the nearest of 200 with a picture" in page.inner_text("#image-caption")
    for name in ("body", "skeleton"):
        page.click(f"#layers >> text={name}")
    without = picture_of(page)
    page.click("#layers >> text=points")
    assert (picture_of(page) == without).all()  # points are shown with their own frame alone
    page.click("#layers >> text=points")
    views, plots = (page.locator(name).bounding_box() for name in ("#views", "#plots"))
    assert views["x"] + views["width"] <= plots["x"]
    page.keyboard.press("PageDown")
    assert frame_of(page) == 10 + report.shown[1]
    assert "nearest" not in page.inner_text("#image-caption")
    assert (picture_of(page)[..., 3] == 255).sum() > (without[..., 3] == 255).sum() + 20
    page.keyboard.press("End")  # the stretch goes along
    left, right = (page.locator(f".plot >> nth=0 >> {name}").bounding_box() for name in ("canvas", ".cursor"))
    assert left["x"] < right["x"] <= left["x"] + left["width"]
    assert "Pictures and points of 200 of 2,000 frames are on this page" in page.inner_text("#about")


def test_everything_that_matters_is_on_the_first_screen(opened: Any, tmp_path: Path, body: BodyModel):
    people = [make_poses(body, 6, aside=aside) for aside in (0.0, 1.0)]
    summary = SUMMARY | {
        "warnings": [f"warning {i}, look at it" for i in range(9)],
        "problems": ["frame 4: damaged"],
    }
    make_report(body, *people).write(tmp_path / "report.html", summary)
    add_activities(tmp_path / "report.html", [[Entry(0.0, 0.2, "walking", 1.0)], []])
    page = opened(tmp_path / "report.html")
    for part in ("#image", "#scene", "#plots", "#time", "#notes", "#play"):
        box = page.locator(part).bounding_box()
        assert box["y"] >= 0, part
        assert box["y"] + box["height"] <= 800, part
        assert box["x"] + box["width"] <= 1280, part
    assert page.locator("#scene").bounding_box()["height"] > 180
    assert page.locator(".plot").first.bounding_box()["height"] > 60
    assert page.evaluate("() => document.documentElement.scrollWidth") == 1280
    places = [page.locator(name).bounding_box() for name in ("#views", "#plots")]
    assert places[0]["x"] + places[0]["width"] <= places[1]["x"]
    assert "warning 0, look at it" in page.inner_text("#notes")
    page.click("#notes summary")
    assert "frame 4: damaged" in page.inner_text("#notes")
    assert "walking" in page.inner_text("#now")
    assert page.inner_text("#rows").split("\n") == ["status 1", "activity 1", "status 2"]
    assert "1.2.3" in page.inner_text("#about")
    assert page.locator("#who button").count() == 2
    before = page.inner_text(".panel .values")
    page.click("#who >> text=person 2")
    assert page.inner_text(".panel .values") != before


@pytest.mark.parametrize("case", ["one", "nobody", "no frames"])
def test_a_page_of_next_to_nothing_opens(opened: Any, tmp_path: Path, body: BodyModel, case: str):
    count = {"one": 1, "nobody": 4, "no frames": 0}[case]
    poses = make_poses(body, count, lost=tuple(range(4)) if case == "nobody" else ())
    make_report(body, poses, title="<script>alert(1)</script>").write(tmp_path / "report.html", SUMMARY)
    page = opened(tmp_path / "report.html")
    assert page.inner_text("h1") == "<script>alert(1)</script>"
    for key in ("ArrowRight", "End", " ", "+", "0", "PageDown"):
        page.keyboard.press(key)
    settle(page)
    assert page.locator("#notes").is_visible() == (case == "nobody")
