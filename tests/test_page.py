"""The page of a run in a browser: what it shows and does."""

import base64
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from made_page import SUMMARY, make_poses, make_report

from torchpose.activity.diary import Entry
from torchpose.body.ellipsoid import outline
from torchpose.body.model import BodyModel
from torchpose.report import Report, add_activities
from torchpose.vision.camera import StereoCamera

CHROMIUM = Path("/usr/bin/chromium")
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return BodyModel()


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
