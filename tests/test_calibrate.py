"""Calibration of a rig against chessboards drawn through known lenses: each sub-pixel's ray is met with the board."""

import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchpose.calibration import read_calibration
from torchpose.vision import calibrate
from torchpose.vision.alignment import alignment_warning, measure_alignment
from torchpose.vision.calibrate import (
    Board,
    Sightings,
    calibrate_rig,
    check_variety,
    find_corners,
    in_the_order_of,
    judgement,
    main,
    report,
    row_distance,
)
from torchpose.vision.camera import RawStereo

WIDTH, HEIGHT = 640, 480
BOARD = Board(9, 6, 0.025)
RIG = RawStereo(
    K1=np.array([[612.0, 0, 322.4], [0, 609.0, 236.1], [0, 0, 1]]),
    D1=np.array([-0.12, 0.05, 4e-4, -6e-4, -0.01]),
    K2=np.array([[605.0, 0, 315.2], [0, 607.0, 244.8], [0, 0, 1]]),
    D2=np.array([-0.10, 0.03, -5e-4, 3e-4, 0.005]),
    R=cv2.Rodrigues(np.array([0.012, -0.02, 0.009]))[0],
    T=np.array([-0.118, 0.0021, -0.0013]),
    image_size=(WIDTH, HEIGHT),
)
SAMPLES = 4  # along each side of a pixel

Pose = tuple[np.ndarray, np.ndarray]  # rotation and translation (m) of the board in the left camera's frame
Paint = Callable[[np.ndarray, np.ndarray], np.ndarray]


def draw(rig: RawStereo, pose: Pose, paint: Paint, ends: np.ndarray | None = None) -> list[np.ndarray]:
    """The left and right picture of the plane z = 0 of the pose, painted with grey levels by its x and y (m).

    With `ends` (m), a plane's corners, only what lies between them is drawn, before a grey wall.
    """
    images = []
    pixels = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1).astype(np.float64)
    between = [np.array([[0, 0], [WIDTH, HEIGHT]])] * 2
    if ends is not None:
        between = [
            np.stack([ends.min(0) - 2, ends.max(0) + 3]).astype(int) for ends in project(rig, at(pose, ends))
        ]
    for K, D, R, T, (first, last) in (
        (rig.K1, rig.D1, np.eye(3), np.zeros(3), between[0]),
        (rig.K2, rig.D2, rig.R, rig.T, between[1]),
    ):
        (u, v), (width, height) = first, last - first
        shown = pixels[v : v + height, u : u + width]
        rays = cv2.undistortPoints(shown.reshape(-1, 1, 2), K, D).reshape(height, width, 2)
        # Between the pixels' centres the lens is straight to 1e-6.
        step = np.array([[SAMPLES, 0, (SAMPLES - 1) / 2], [0, SAMPLES, (SAMPLES - 1) / 2]])
        rays = cv2.warpAffine(
            rays, step, (width * SAMPLES, height * SAMPLES), borderMode=cv2.BORDER_REPLICATE
        )
        turn, origin = R @ pose[0], R @ pose[1] + T
        to_plane = np.linalg.inv(np.stack([turn[:, 0], turn[:, 1], origin], 1)).astype(np.float32)
        x, y, scale = np.moveaxis(rays.astype(np.float32) @ to_plane[:, :2].T + to_plane[:, 2], -1, 0)
        image = np.full((HEIGHT, WIDTH), 110.0)
        samples = paint(x / scale, y / scale).reshape(height, SAMPLES, width, SAMPLES)
        image[v : v + height, u : u + width] = samples.mean((1, 3))
        image += torch.randn(HEIGHT, WIDTH).numpy() * 2
        images.append(image.round().clip(0, 255).astype(np.uint8))
    return images


def at(pose: Pose, points: np.ndarray) -> np.ndarray:
    """Points of the plane in the left camera's frame."""
    return points @ pose[0].T + pose[1]


MARGIN = 1.8 * BOARD.square
ENDS = np.array(
    [[x, y, 0] for x in (-MARGIN, 8 * BOARD.square + MARGIN) for y in (-MARGIN, 5 * BOARD.square + MARGIN)]
)


def squares(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """`BOARD`, its first inner corner at the origin, with a white margin, before a grey wall."""
    x, y = x / BOARD.square, y / BOARD.square
    middle = ((BOARD.columns - 1) / 2, (BOARD.rows - 1) / 2)
    dark = (np.floor(x) + np.floor(y)) % 2 == 0
    beyond = np.maximum(np.abs(x - middle[0]) - middle[0], np.abs(y - middle[1]) - middle[1])
    return np.where(beyond > 1.8, 110, np.where(dark & (beyond < 1), 30, 220))


def project(rig: RawStereo, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Raw pixels of points (m, left camera's frame) in both images."""
    zero = np.zeros(3)
    left = cv2.projectPoints(points, zero, zero, rig.K1, rig.D1)[0][:, 0]
    return left, cv2.projectPoints(points, cv2.Rodrigues(rig.R)[0], rig.T, rig.K2, rig.D2)[0][:, 0]


def corners_of(rig: RawStereo, pose: Pose, board: Board = BOARD) -> tuple[np.ndarray, np.ndarray]:
    return project(rig, at(pose, board.points))


def poses(count: int, tilt: float = 35.0, reach: float = 1.0, seed: int = 0) -> list[Pose]:
    """Boards wholly seen by both cameras, tilted by up to `tilt` degrees; `reach` is the share of the view they use."""
    generator = np.random.default_rng(seed)
    found: list[Pose] = []
    while len(found) < count:
        turn = cv2.Rodrigues(generator.uniform(-1, 1, 3) * np.radians([tilt, tilt, min(tilt, 15.0)]))[0]
        z = generator.uniform(0.45, 0.9)
        middle = z * np.array([*(reach * generator.uniform([-0.4, -0.3], [0.45, 0.3])), 1])
        pose = turn, middle - turn @ ENDS.mean(0)
        seen = np.concatenate(project(RIG, at(pose, ENDS)))
        if (seen > 3).all() and (seen < (WIDTH - 4, HEIGHT - 4)).all():
            found.append(pose)
    return found


def sightings(chosen: list[Pose], noise: float = 0.05, rig: RawStereo = RIG, scale: float = 1.0) -> Sightings:
    """What is found of `BOARD`, without drawing it; its corners `noise` px off."""
    left, right = np.stack([corners_of(rig, (turn, origin * scale)) for turn, origin in chosen], 1).astype(
        np.float32
    )
    left, right = (side + noise * torch.randn(side.shape).numpy() for side in (left, right))
    return Sightings(tuple(range(len(chosen))), left, right, (WIDTH, HEIGHT))


def seen_by_both(count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of points anywhere in both views, 0.5 to 4 m away, by the true rig."""
    points = np.random.default_rng(1).uniform([-0.6, -0.45, 0.5], [0.6, 0.45, 4.0], (count, 3))
    points[:, :2] *= points[:, 2:]
    left, right = project(RIG, points)
    inside = np.all([(side > 0) & (side < (WIDTH - 1, HEIGHT - 1)) for side in (left, right)], (0, 2))
    return left[inside], right[inside]


def angle(rotation: np.ndarray) -> float:
    return math.degrees(float(np.linalg.norm(cv2.Rodrigues(rotation)[0])))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve pairs, numbers 0 to 33 in threes; pair 40, whose board the right camera does not see; a lone left one."""
    torch.manual_seed(0)  # before the seed of the first test
    folder = tmp_path_factory.mktemp("boards")
    for side in ("left", "right"):
        (folder / side).mkdir()
    for index, pose in enumerate([*poses(12, seed=3), poses(1)[0]]):
        number = 3 * index if index < 12 else 40
        for side, image in zip(("left", "right"), draw(RIG, pose, squares, ENDS), strict=True):
            image = np.full_like(image, 110) if (side, number) == ("right", 40) else image
            cv2.imwrite(str(folder / side / f"{number:06d}.png"), image)
    shutil.copy(folder / "left" / "000000.png", folder / "left" / "000050.png")
    return folder


def run(folder: Path, *changes: str) -> int:
    return main([str(folder), "--board", "9x6", "--square", "0.025", *changes])


def test_a_drawn_rig_is_recovered_and_its_pictures_rectified(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    path = tmp_path / "made" / "calibration.yaml"
    assert run(folder, "--output", str(path), "--frame-rate", "24") == 0
    calibration = read_calibration(path)
    raw = calibration.raw
    assert raw is not None
    assert raw.image_size == (WIDTH, HEIGHT)
    assert raw.frame_rate == 24
    for found, true in ((raw.K1, RIG.K1), (raw.K2, RIG.K2)):
        assert found[0, 0] == pytest.approx(true[0, 0], rel=5e-3)
        assert found[1, 1] == pytest.approx(true[1, 1], rel=5e-3)
        assert found[:2, 2] == pytest.approx(true[:2, 2], abs=3)
    assert raw.D1.size == raw.D2.size == 5
    assert np.linalg.norm(raw.T) == pytest.approx(np.linalg.norm(RIG.T), rel=5e-3)
    assert np.abs(raw.T - RIG.T).max() < 5e-4
    assert angle(raw.R @ RIG.R.T) < 0.3  # what the principal points, 2 px off, make up for
    # Points where no board was, by the true rig: their rows as the calibration found rectifies them.
    rows = np.abs(row_distance(raw, *seen_by_both()))
    assert np.median(rows) < 0.1
    assert np.quantile(rows, 0.95) < 0.2
    # The same on pictures: raw rows differ by pixels, rectified ones do not.
    left, right = (torch.from_numpy(image)[None, None].float() / 255 for image in draw(RIG, WALL, texture))
    assert measure_alignment(left, right).typical > 2
    aligned = measure_alignment(*raw.rectify(left, right)[:2])
    assert aligned.matches > 100
    assert abs(aligned.dy) < 0.1
    assert aligned.typical < 0.2
    assert alignment_warning(aligned) is None
    printed = capsys.readouterr().out
    for words in (
        "board found in 12 of 13 pairs; not wholly seen in both images: 40",
        "left camera: focal length 61",
        "field of view 55 x 43 degrees",
        "baseline: 11",
        "good (below 0.3 px)",
        f"wrote {path}",
    ):
        assert words in printed
    assert path.read_text(encoding="utf-8").startswith("# board found in 12 of 13 pairs")


WALL = (cv2.Rodrigues(np.array([0.1, -0.15, 0.05]))[0], np.array([0.0, 0.0, 1.5]))


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Waves of 2 to 15 cm in all directions: 8 to 60 px at 1.5 m."""
    generator = np.random.default_rng(0)
    waves = np.zeros_like(x)
    for direction, phase, length in zip(
        *generator.uniform(0, 2 * math.pi, (2, 12)).astype(np.float32),
        generator.uniform(0.02, 0.15, 12),
        strict=True,
    ):
        waves += np.cos(2 * math.pi / length * (math.cos(direction) * x + math.sin(direction) * y) + phase)
    return 128 + 50 * waves / math.sqrt(6)


def test_corners_are_found_to_a_fraction_of_a_pixel_or_not_at_all(folder: Path):
    for index, pose in enumerate(poses(12, seed=3)[:4]):
        image = cv2.imread(str(folder / "left" / f"{3 * index:06d}.png"), cv2.IMREAD_GRAYSCALE)
        found, true = find_corners(image, BOARD), corners_of(RIG, pose)[0]
        assert found is not None
        found = min((found, found[::-1]), key=lambda corners: np.abs(corners - true).sum())
        distance = np.linalg.norm(found - true, axis=1)
        assert np.sqrt(np.square(distance).mean()) < 0.09
        assert distance.max() < 0.3
    far = cv2.Rodrigues(np.array([0.5, 0.3, 0.1]))[0], np.array([-0.1, -0.05, 1.6])  # squares of 8 px
    found, true = find_corners(draw(RIG, far, squares, ENDS)[0], BOARD), corners_of(RIG, far)[0]
    assert found is not None
    assert min(np.square(corners - true).sum(1).mean() for corners in (found, found[::-1])) < 0.15**2
    assert find_corners(np.full((HEIGHT, WIDTH), 110, np.uint8), BOARD) is None


@pytest.mark.parametrize("board", [BOARD, Board(5, 5, 0.03)])
@pytest.mark.parametrize("turn", range(4))
def test_both_cameras_name_the_same_corner_first(board: Board, turn: int):
    left, right = corners_of(RIG, poses(1)[0], board)
    if board is BOARD:  # only half a turn leaves it as it is
        turn = 2 * (turn % 2)
    grid = right.reshape(board.rows, board.columns, 2)
    assert (in_the_order_of(left, np.rot90(grid, turn).reshape(-1, 2), board) == right).all()


def test_the_board_s_points_run_along_its_rows():
    board = Board(4, 3, 0.1)
    assert board.points[:5] == pytest.approx(
        np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0], [0, 0.1, 0]])
    )
    assert board.points[-1] == pytest.approx([0.3, 0.2, 0])


def test_rows_agree_with_the_rectification_of_the_recordings():
    """The maps of `RawStereo` say which raw pixel each rectified pixel shows: those of one row are 0 apart."""
    left, right = RIG.rectify_maps()
    pixels = left[100:400:50, 100:500:80].astype(np.float64), right[90:390:50, 130:530:80].astype(np.float64)
    assert row_distance(RIG, *pixels) == pytest.approx(np.full((6, 5), -10.0), abs=2e-3)


@pytest.mark.parametrize("k3", [0.0, 0.3])
def test_the_last_radial_coefficient_is_fitted_where_it_is_told_from_nothing(k3: float):
    rig = replace(RIG, D1=np.array([-0.2, 0.05, 4e-4, -6e-4, k3]), D2=np.array([-0.2, 0.05, 0, 0, 0]))
    found = calibrate_rig(sightings(poses(25), noise=0.03, rig=rig), BOARD).raw
    if k3:
        assert found.D1[4] == pytest.approx(k3, abs=0.12)
        assert found.D2[4] != 0
    else:
        assert found.D1[4] == found.D2[4] == 0
        assert np.abs(found.D1 - rig.D1).max() < 0.02


def test_exact_corners_give_the_exact_rig_and_errors_near_nothing():
    found = calibrate_rig(sightings(poses(12), noise=0), BOARD)
    raw = found.raw
    assert np.abs(raw.K1 - RIG.K1).max() < 0.5
    assert np.abs(raw.T - RIG.T).max() < 1e-4
    assert max(*found.epipolar, *found.reprojection) < 0.02
    assert found.used == tuple(range(12))
    assert found.left_out == {}


def test_errors_are_those_of_the_corners():
    """Corners 0.2 px off along each axis: so is the reprojection (less what the fit absorbs), and rows by sqrt(2)."""
    found = calibrate_rig(sightings(poses(14), noise=0.2), BOARD)
    for error in found.reprojection:
        assert error == pytest.approx(0.2 * math.sqrt(2), rel=0.12)
    assert found.epipolar[0] == pytest.approx(0.6745 * 0.2 * math.sqrt(2), rel=0.15)
    assert found.epipolar[1] == pytest.approx(1.96 * 0.2 * math.sqrt(2), rel=0.1)
    others = [calibrate_rig(sightings(poses(14), noise=0.2), BOARD).raw.K1[0, 0] for _ in range(6)]
    assert 0.4 < np.std(others) / found.focal_length_error[0] < 2


def test_pairs_that_do_not_fit_are_left_out_and_named():
    seen = sightings(poses(12))
    right = seen.right.copy()
    right[4] += (5, 3)  # the board moved between the exposures
    left = seen.left.copy()
    left[7, :20] += (3, -3)  # a corner was taken for its neighbour's
    numbers = tuple(range(10, 22))
    found = calibrate_rig(replace(seen, numbers=numbers, left=left, right=right, missed=(3,)), BOARD)
    assert set(found.left_out) == {14, 17}
    assert found.used == tuple(number for number in numbers if number not in (14, 17))
    assert found.raw.K1[0, 0] == pytest.approx(RIG.K1[0, 0], rel=5e-3)
    assert found.epipolar[1] < 0.2  # of the pairs that were used
    text = report(found)
    assert "board found in 12 of 13 pairs; not wholly seen in both images: 3" in text
    assert (
        f"left out, for they do not fit the others: pair 14 ({found.left_out[14]:.2f} px), pair 17 (" in text
    )


@pytest.mark.parametrize(
    ("epipolar", "words"),
    [
        (0.29, "good (below"),
        (0.3, "usable (good is"),
        (0.49, "usable"),
        (0.5, "bad (usable is below 0.5 px)"),
    ],
)
def test_the_judgement_in_words(epipolar: float, words: str):
    assert judgement(epipolar).startswith(words)


def parallel() -> Sightings:
    return sightings(poses(12, tilt=3.0))


def two_tilted() -> Sightings:
    return sightings([*poses(10, tilt=3.0), *poses(2, tilt=35.0, seed=5)])


def at_one_place() -> Sightings:
    return sightings(poses(12, reach=0.05))


def seven() -> Sightings:
    return replace(sightings(poses(7)), missed=(7, 9))


@pytest.mark.parametrize(
    ("seen", "message"),
    [
        (seven, "at least 8 pairs with the whole board in both images, got 7 of 9; take 15 to 30 pairs"),
        (at_one_place, r"must cover at least 50% of each image, got \d+% of the left one; take more pairs"),
        (parallel, "at least 3 boards must be tilted by 10 degrees or more against the others, got 0, the"),
        (
            two_tilted,
            "at least 3 boards must be tilted by 10 degrees or more against the others, got [012], the",
        ),
    ],
)
def test_sets_of_too_little_variety_are_refused(seen: Callable[[], Sightings], message: str):
    check_variety(sightings(poses(12)), BOARD)
    with pytest.raises(ValueError, match=message):
        check_variety(seen(), BOARD)


def test_the_right_image_must_be_covered_too():
    seen = sightings(poses(12))
    with pytest.raises(ValueError, match="of the right one"):
        check_variety(replace(seen, right=seen.right * 0.4 + 100), BOARD)


def loose() -> Sightings:
    seen = sightings(poses(20))
    return replace(seen, right=seen.right + 5 * torch.randn(20, 1, 2).numpy())


def disagreeing() -> Sightings:
    seen = sightings(poses(9))
    return replace(
        seen, right=seen.right + (np.arange(9)[:, None, None] < 3) * torch.randn(9, 54, 2).numpy() * 9
    )


def exchanged() -> Sightings:
    seen = sightings(poses(12))
    return replace(seen, left=seen.right, right=seen.left)


def narrow() -> Sightings:
    return sightings(
        poses(12, tilt=6.0), noise=0.2
    )  # below 3 degrees the standard errors are no guide either


@pytest.mark.parametrize(
    ("seen", "board", "message"),
    [
        (
            loose,
            BOARD,
            r"the rows of a point must be within 1 px after rectification, got a median of \d\.\d\d px",
        ),
        (
            disagreeing,
            BOARD,
            r"at least 8 pairs must agree with one another, got 7 after leaving out pair \d \(",
        ),
        (exchanged, BOARD, "exchange the cameras"),
        (narrow, BOARD, r"must tell the focal length to 1%, got \d+ \+- \d+ px for the (left|right) camera"),
        (
            lambda: sightings(poses(12)),
            Board(9, 6, 25.0),
            r"the cameras must be 5 mm to 5 m apart, got 11\d\.?\d* m; give the side of a square in metres, not 25:",
        ),
        (lambda: sightings(poses(12)), Board(9, 6, 2.5e-5), "5 mm to 5 m apart"),
    ],
)
def test_rigs_that_cannot_be_used_are_refused(seen: Callable[[], Sightings], board: Board, message: str):
    with pytest.raises(ValueError, match=message):
        calibrate_rig(seen(), board)


def test_bad_pictures_end_the_command_with_a_sentence_and_leave_the_old_file(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    def refusal(place: Path, *changes: str) -> str:
        assert run(place, *changes) == 2
        return capsys.readouterr().err

    output = tmp_path / "calibration.yaml"
    output.write_text("old", encoding="utf-8")
    keep = ("--output", str(output))
    few = tmp_path / "few"
    for side in ("left", "right"):
        (few / side).mkdir(parents=True)
        for number in (0, 6):
            shutil.copy(folder / side / f"{number:06d}.png", few / side)
    assert "none of 8 x 6 inner corners in 2 pairs; check --board" in refusal(few, *keep, "--board", "8x6")
    assert "at least 8 pairs with the whole board in both images, got 2 of 2" in refusal(few, *keep)
    assert "got 0 left and 0 right images; name them so" in refusal(tmp_path / "nowhere", *keep)
    assert "--board must be columns x rows of inner corners, got '96'" in refusal(few, *keep, "--board", "96")
    assert "at least 3 x 3 inner corners, got 2 x 6" in refusal(few, *keep, "--board", "2x6")
    assert "square must be a positive number of m, got -1.0" in refusal(few, *keep, "--square", "-1")
    assert "--frame-rate must be a positive number of Hz, got 0.0" in refusal(few, *keep, "--frame-rate", "0")
    image = cv2.imread(str(few / "right" / "000006.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(few / "right" / "000006.png"), image[:-1])
    message = refusal(few, *keep)
    assert message.startswith("error: all images must have one size, got 640 x 480 for ")
    assert "000000.png and 640 x 479 for " in message
    (few / "right" / "000006.png").write_bytes(b"damaged")
    assert "must be a whole JPEG or PNG image" in refusal(few, *keep)
    assert output.read_text(encoding="utf-8") == "old"


def test_the_file_goes_beside_the_pictures_where_no_other_place_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(calibrate, "find_pairs", lambda folder, board: sightings(poses(12)))
    assert run(tmp_path) == 0
    assert read_calibration(tmp_path / "calibration.yaml").camera.frame_rate == 30


def test_help_says_how_to_take_the_pictures(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as end:
        main(["--help"])
    assert end.value.code == 0
    assert "Tilt it by 20 to 40 degrees" in capsys.readouterr().out
