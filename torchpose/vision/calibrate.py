"""Calibrates a stereo rig from pictures of a chessboard.

python -m torchpose.vision.calibrate FOLDER --board 9x6 --square 0.025 [--output FILE] [--frame-rate 30]

FOLDER/left and FOLDER/right hold the pictures, PNG or JPEG, named by the same numbers. It prints how good the
calibration is, in words, and writes the calibration.yaml of a recording by this rig.

How to take the pictures:
- Print a chessboard, glue it onto something flat, and measure a square: --square is its side in metres. --board counts
  the inner corners, where four squares meet: a board of 10 x 7 squares is 9x6. Leave a white margin about it.
- Focus and zoom must not change any more, nor may the cameras move against each other.
- Take 15 to 30 pairs, both cameras at the same moment, the board held still and wholly seen by both.
- Move it over the whole of both pictures, near and far, into the corners, too.
- Tilt it by 20 to 40 degrees to all sides in most of the pairs: a board that always faces the cameras says nothing of
  the focal length.
- Good light, so that nothing is blurred.

Pixels (u, v) are column and row, an integer is a pixel's centre; metres.
"""

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml
from jaxtyping import Float, UInt8

from torchpose.atomic import replacing
from torchpose.image_file import decode, numbered_files
from torchpose.vision.camera import RawStereo

MIN_PAIRS = 8
GOOD, USABLE, REFUSED = 0.3, 0.5, 1.0  # px, median distance of rows after rectification
BASELINES = (0.005, 5.0)  # m; beyond them the square was not given in metres
COVERAGE_CELLS = 4  # along each side of the image
MIN_COVERAGE = 0.5  # share of these cells with a corner of a board in some picture
MIN_TILT = 10.0  # degrees from the mean direction of the boards, for at least
TILTED_BOARDS = 3
MAX_FOCAL_LENGTH_ERROR = 0.01  # relative standard error
OUTLIER = 3.0  # times the median reprojection error of the pairs
LEAST_OUTLIER = 0.3  # px; a lesser error is no reason to leave a pair out
SIGNIFICANT = 3.0  # standard errors, from which the last radial coefficient is told from 0
_K3 = 8  # its place among OpenCV's standard errors: fx fy cx cy k1 k2 p1 p2 k3
MORE = "take 15 to 30 pairs (--help says how)"


@dataclass(frozen=True)
class Board:
    """A chessboard."""

    columns: int  # inner corners
    rows: int
    square: float  # m, side of a square

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise ValueError(
                f"a board must have at least 3 x 3 inner corners, got {self.columns} x {self.rows}; count where "
                "four squares meet"
            )
        if not (math.isfinite(self.square) and self.square > 0):
            raise ValueError(
                f"the side of a square must be a positive number of m, got {self.square}; 0.025 is 25 mm"
            )

    @property
    def points(self) -> Float[np.ndarray, "corners 3"]:
        """The inner corners in the board's own frame, m, row by row."""
        grid = np.zeros((self.rows, self.columns, 3), np.float32)
        grid[..., :2] = np.moveaxis(np.mgrid[: self.columns, : self.rows], 0, -1).swapaxes(0, 1) * self.square
        return grid.reshape(-1, 3)


@dataclass(frozen=True)
class Sightings:
    """Where the corners of a board are in the pairs that show it twice, px."""

    numbers: tuple[int, ...]  # of the pairs, as in the files' names
    left: Float[np.ndarray, "pairs corners 2"]
    right: Float[np.ndarray, "pairs corners 2"]  # each the same corner of the board as in `left`
    image_size: tuple[int, int]  # px, width and height
    missed: tuple[int, ...] = ()  # pairs without the board in both images


@dataclass(frozen=True)
class RigCalibration:
    """What the sightings say of the rig, and how well they agree with it."""

    raw: RawStereo
    reprojection: tuple[float, float]  # px, root mean square of the left and the right camera
    focal_length_error: tuple[float, float]  # px, standard errors
    epipolar: tuple[float, float]  # px, median and 95th percentile of the rows' distance after rectification
    used: tuple[int, ...]  # numbers of the pairs
    left_out: dict[int, float]  # number: reprojection error, px, of the pairs that do not fit the others
    missed: tuple[int, ...] = ()


def find_corners(image: UInt8[np.ndarray, "height width"], board: Board) -> np.ndarray | None:
    """The board's inner corners in a grey image, (corners, 2) px row by row; None where it is not wholly seen.

    Found by OpenCV's sector-based detector, which copes with blur and tilt, and refined on the slopes of the
    squares' edges (`cornerSubPix`): 0.06 px off on rendered boards, where the detector alone is 0.15 px off.
    """
    size = (board.columns, board.rows)
    found, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        return None
    grid = corners.reshape(board.rows, board.columns, 2)
    step = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min()) for axis in (0, 1))
    window = int(np.clip(0.4 * step, 2, 11))  # px, half a side; it must not reach the next corner
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)
    return cv2.cornerSubPix(image, corners, (window, window), (-1, -1), criteria).reshape(-1, 2)


def in_the_order_of(
    left: Float[np.ndarray, "corners 2"], right: Float[np.ndarray, "corners 2"], board: Board
) -> Float[np.ndarray, "corners 2"]:
    """The right image's corners in the order of the left's, where they began at another corner of the board.

    A board turned by 180 degrees, or a square one by 90, looks alike. The two cameras are upright alike to some
    degrees, so the right order is that in which the two layouts are most alike.
    """
    grid = right.reshape(board.rows, board.columns, 2)
    turns = range(4) if board.rows == board.columns else (0, 2)
    orders = [np.rot90(grid, turn).reshape(-1, 2) for turn in turns]
    layout = left - left.mean(0)
    return min(orders, key=lambda order: float(np.square(order - order.mean(0) - layout).sum()))


def find_pairs(folder: Path, board: Board) -> Sightings:
    """The sightings of the board in FOLDER/left and FOLDER/right.

    Raises ValueError where there are no such pairs, an image cannot be read, sizes differ, or no pair shows it.
    """
    files = {side: numbered_files(folder / side) for side in ("left", "right")}
    numbers = sorted(files["left"].keys() & files["right"].keys())
    if not numbers:
        raise ValueError(
            f"{folder} must have left/NUMBER.png (or .jpg) and right/NUMBER.png, one pair to a number, got "
            f"{len(files['left'])} left and {len(files['right'])} right images; name them so"
        )
    kept, corners, size, first = [], [], None, None
    for number in numbers:
        pair = []
        for side in ("left", "right"):
            path = files[side][number]
            image = decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
            if size is None:
                size, first = image.shape, path
            if image.shape != size:
                raise ValueError(
                    f"all images must have one size, got {size[1]} x {size[0]} for {first} and {image.shape[1]} x "
                    f"{image.shape[0]} for {path}; take them all with the resolution of the recordings"
                )
            pair.append(find_corners(image, board))
        if pair[0] is not None and pair[1] is not None:
            kept.append(number)
            corners.append((pair[0], in_the_order_of(pair[0], pair[1], board)))
    if not kept:
        raise ValueError(
            f"the board must be wholly seen in both images of a pair, got none of {board.columns} x {board.rows} "
            f"inner corners in {len(numbers)} pairs; check --board: it counts the corners where four squares meet"
        )
    assert size is not None
    left, right = np.stack(corners, 1)
    missed = tuple(number for number in numbers if number not in kept)
    return Sightings(tuple(kept), left, right, (size[1], size[0]), missed)


def check_variety(sightings: Sightings, board: Board) -> None:
    """Raise ValueError where the sightings cannot tell a rig: too few, all at one place, or all alike in tilt."""
    if (count := len(sightings.numbers)) < MIN_PAIRS:
        raise ValueError(
            f"there must be at least {MIN_PAIRS} pairs with the whole board in both images, got {count} of "
            f"{count + len(sightings.missed)}; {MORE}"
        )
    width, height = sightings.image_size
    for side, corners in (("left", sightings.left), ("right", sightings.right)):
        cells = np.floor(corners.reshape(-1, 2) * COVERAGE_CELLS / (width, height)).clip(
            0, COVERAGE_CELLS - 1
        )
        share = len(np.unique(cells, axis=0)) / COVERAGE_CELLS**2
        if share < MIN_COVERAGE:
            raise ValueError(
                f"the boards must cover at least {MIN_COVERAGE:.0%} of each image, got {share:.0%} of the {side} one; "
                "take more pairs with the board near every edge and corner, and closer"
            )
    tilts = np.sort(_tilts(sightings, board))
    if tilts[-TILTED_BOARDS] < MIN_TILT:
        raise ValueError(
            f"at least {TILTED_BOARDS} boards must be tilted by {MIN_TILT:.0f} degrees or more against the others, got "
            f"{(tilts >= MIN_TILT).sum()}, the greatest tilt {tilts[-1]:.0f} degrees; take more pairs with the board "
            "tilted by 20 to 40 degrees to all sides, for boards that all face one way do not tell the focal length"
        )


def _tilts(sightings: Sightings, board: Board) -> Float[np.ndarray, " pairs"]:
    """Angle of each board against the mean of all, degrees, roughly: with a usual lens, before any calibration."""
    width, height = sightings.image_size
    guess = np.array(
        [[max(width, height), 0, (width - 1) / 2], [0, max(width, height), (height - 1) / 2], [0, 0, 1]]
    )
    normals = []
    for corners in sightings.left:
        _, turn, _ = cv2.solvePnP(board.points, corners, guess, None, flags=cv2.SOLVEPNP_IPPE)
        normals.append(cv2.Rodrigues(turn)[0][:, 2])
    mean = np.mean(normals, 0)
    return np.degrees(np.arccos(np.clip(normals @ mean / np.linalg.norm(mean), -1, 1)))


def calibrate_rig(sightings: Sightings, board: Board, frame_rate: float = 30.0) -> RigCalibration:
    """The rig that the sightings show, without the pairs that do not fit the others; see `check_variety`.

    Raises ValueError where the calibration cannot be used: see `REFUSED`, `BASELINES`, `MAX_FOCAL_LENGTH_ERROR`, and
    `RawStereo` for cameras that are not side by side.
    """
    chosen = np.arange(len(sightings.numbers))
    left_out: dict[int, float] = {}
    while True:
        fit = _fit(sightings, chosen, board)
        worst = int(fit.errors.max(1).argmax())
        error = float(fit.errors[worst].max())
        if error <= max(LEAST_OUTLIER, OUTLIER * float(np.median(fit.errors.max(1)))):
            break
        left_out[sightings.numbers[chosen[worst]]] = error
        chosen = np.delete(chosen, worst)
        if len(chosen) < MIN_PAIRS:
            raise ValueError(
                f"at least {MIN_PAIRS} pairs must agree with one another, got {len(chosen)} after leaving out "
                f"{_listed(left_out)}; check that the cameras are triggered together and fixed, and {MORE}"
            )
    for side, length, error in zip(("left", "right"), fit.focal_length, fit.focal_length_error, strict=True):
        if error > MAX_FOCAL_LENGTH_ERROR * length:
            raise ValueError(
                f"the pairs must tell the focal length to {MAX_FOCAL_LENGTH_ERROR:.0%}, got {length:.0f} +- "
                f"{error:.0f} px for the {side} camera; take more pairs with the board close and tilted to all sides"
            )
    baseline = float(np.linalg.norm(fit.T))
    if not BASELINES[0] <= baseline <= BASELINES[1]:
        raise ValueError(
            f"the cameras must be {1e3 * BASELINES[0]:g} mm to {BASELINES[1]:g} m apart, got {baseline:g} m; give the "
            f"side of a square in metres, not {board.square:g}: 0.025 is 25 mm"
        )
    raw = RawStereo(fit.K1, fit.D1, fit.K2, fit.D2, fit.R, fit.T, sightings.image_size, frame_rate)
    distance = np.abs(row_distance(raw, sightings.left[chosen], sightings.right[chosen]))
    epipolar = float(np.median(distance)), float(np.quantile(distance, 0.95))
    if epipolar[0] > REFUSED:
        raise ValueError(
            f"the rows of a point must be within {REFUSED:g} px after rectification, got a median of {epipolar[0]:.2f} "
            f"px; check that both cameras are triggered together, fixed and sharp, and {MORE}"
        )
    left_error, right_error = (float(error) for error in np.sqrt(np.square(fit.errors).mean(0)))
    return RigCalibration(
        raw=raw,
        reprojection=(left_error, right_error),
        focal_length_error=fit.focal_length_error,
        epipolar=epipolar,
        used=tuple(sightings.numbers[index] for index in chosen),
        left_out=left_out,
        missed=sightings.missed,
    )


def row_distance(
    raw: RawStereo, left: Float[np.ndarray, "*batch 2"], right: Float[np.ndarray, "*batch 2"]
) -> Float[np.ndarray, "*batch"]:
    """Row in the right image less row in the left, px, after rectification, of points at raw pixels of both."""
    rectified_left, rectified_right = raw.rectify_pixels(left, right)
    return rectified_right[..., 1] - rectified_left[..., 1]


@dataclass(frozen=True, eq=False)
class _Fit:
    K1: np.ndarray
    D1: np.ndarray
    K2: np.ndarray
    D2: np.ndarray
    R: np.ndarray
    T: np.ndarray
    errors: Float[np.ndarray, "pairs 2"]  # px, root mean square of each view
    focal_length: tuple[float, float]  # px, of each camera by itself
    focal_length_error: tuple[float, float]  # px


def _fit(sightings: Sightings, chosen: np.ndarray, board: Board) -> _Fit:
    """Each camera by itself, then the pair with all its parameters free.

    The last radial coefficient is fitted only where it is told from 0 in a camera: in the others it follows the noise,
    and the image's corners, where no board was, go astray by a pixel.
    """
    points = [board.points] * len(chosen)
    left, right = ([corners[index] for index in chosen] for corners in (sightings.left, sightings.right))
    size = sightings.image_size
    for flags in (0, cv2.CALIB_FIX_K3):
        single = [
            cv2.calibrateCameraExtended(points, corners, size, np.eye(3), np.zeros(5), flags=flags)
            for corners in (left, right)
        ]
        if any(abs(one[2].flat[4]) > SIGNIFICANT * one[5].flat[_K3] for one in single):
            break
    (K1, D1), (K2, D2) = ((one[1], one[2]) for one in single)
    _, K1, D1, K2, D2, R, T, _, _, _, _, errors = cv2.stereoCalibrateExtended(
        *(points, left, right, K1, D1, K2, D2, size, np.eye(3), np.zeros(3)),
        flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
    )
    deviations = float(single[0][5].flat[0]), float(single[1][5].flat[0])
    focal_lengths = float(single[0][1][0, 0]), float(single[1][1][0, 0])
    return _Fit(K1, D1, K2, D2, R, T, errors, focal_lengths, deviations)


def judgement(epipolar: float) -> str:
    """What a median distance of rows, px, is worth, in words."""
    if epipolar < GOOD:
        return f"good (below {GOOD:g} px)"
    if epipolar < USABLE:
        return f"usable (good is below {GOOD:g} px); sharper pictures and more pairs make it better"
    return f"bad (usable is below {USABLE:g} px): matches and depth will suffer, so take better pictures"


def report(rig: RigCalibration) -> str:
    """How good a calibration is, in words."""
    raw = rig.raw
    width, height = raw.image_size
    lines = [f"board found in {len(rig.used) + len(rig.left_out)} of {_total(rig)} pairs"]
    if rig.missed:
        lines[0] += f"; not wholly seen in both images: {', '.join(map(str, rig.missed))}"
    if rig.left_out:
        lines.append(f"left out, for they do not fit the others: {_listed(rig.left_out)}")
    for side, matrix, error, spread in zip(
        ("left", "right"), (raw.K1, raw.K2), rig.reprojection, rig.focal_length_error, strict=True
    ):
        view = [
            2 * math.degrees(math.atan(size / 2 / matrix[axis, axis]))
            for axis, size in enumerate((width, height))
        ]
        lines.append(
            f"{side} camera: focal length {matrix[0, 0]:.1f} px (+- {spread:.1f}), field of view {view[0]:.0f} x "
            f"{view[1]:.0f} degrees, reprojection error {error:.2f} px"
        )
    lines.append(f"baseline: {1e3 * float(np.linalg.norm(raw.T)):.1f} mm")
    lines.append(
        f"rows after rectification: {rig.epipolar[0]:.2f} px apart in the median, 95 % within {rig.epipolar[1]:.2f} "
        f"px: {judgement(rig.epipolar[0])}"
    )
    return "\n".join(lines)


def _total(rig: RigCalibration) -> int:
    return len(rig.used) + len(rig.left_out) + len(rig.missed)


def _listed(left_out: dict[int, float]) -> str:
    return ", ".join(f"pair {number} ({error:.2f} px)" for number, error in sorted(left_out.items()))


def write_calibration(path: Path, rig: RigCalibration) -> None:
    """Write OpenCV's K1, D1, K2, D2, R, T (m) with the image size and the frame rate; the file appears whole."""
    comment = "".join(f"# {line}\n" for line in report(rig).splitlines())
    with replacing(path) as partial:
        partial.write_text(
            comment + yaml.safe_dump(rig.raw.values(), sort_keys=False, default_flow_style=None),
            encoding="utf-8",
        )


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit code: 0 where a calibration was written, 2 where the pictures are at fault."""
    parser = argparse.ArgumentParser(
        prog="python -m torchpose.vision.calibrate",
        description=__doc__.rpartition("\n\n")[0],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path, help="with left/ and right/")
    parser.add_argument("--board", required=True, metavar="9x6", help="inner corners, columns x rows")
    parser.add_argument("--square", required=True, type=float, metavar="0.025", help="side of a square, m")
    parser.add_argument("--output", type=Path, metavar="FILE", help="default: calibration.yaml in the folder")
    parser.add_argument("--frame-rate", type=float, default=30.0, metavar="30", help="of the recordings, Hz")
    arguments = parser.parse_args(argv)
    try:
        if not (math.isfinite(arguments.frame_rate) and arguments.frame_rate > 0):
            raise ValueError(
                f"--frame-rate must be a positive number of Hz, got {arguments.frame_rate}; 30 is usual"
            )
        board = _board(arguments.board, arguments.square)
        sightings = find_pairs(arguments.folder, board)
        check_variety(sightings, board)
        rig = calibrate_rig(sightings, board, arguments.frame_rate)
        output = arguments.output or arguments.folder / "calibration.yaml"
        write_calibration(output, rig)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(report(rig))
    print(f"wrote {output}; put it beside left/ and right/ of the recordings by this rig")
    return 0


def _board(size: str, square: float) -> Board:
    columns, times, rows = size.lower().partition("x")
    if not (times and columns.strip().isdecimal() and rows.strip().isdecimal()):
        raise ValueError(f"--board must be columns x rows of inner corners, got {size!r}; write 9x6")
    return Board(int(columns), int(rows), square)


if __name__ == "__main__":
    raise SystemExit(main())
