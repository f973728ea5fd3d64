"""Row alignment of a stereo pair: how far apart a rectified pair's two images of a point lie, in rows.

Every matcher here searches along a row. A row that is half a pixel off costs matches and depth, and nothing
else shows why, so this is measured on the pictures themselves. Pixels; rows count downwards.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from torch import Tensor

WARN_ABOVE = 0.5  # px
AGREE_WITHIN = 2.0  # px of spread; beyond it the matches follow no one error of the rig
MIN_MATCHES = 20
CALIBRATE = "python -m torchpose.vision.calibrate --help"
SIGNIFICANT = 4.0  # standard errors, from which a slope is named
NOTABLE_SLOPE = 0.002  # px/px, 0.5 px at 250 px from the middle; a lesser one is no cause worth naming

FEATURES = 2000  # of an image, of which the best of each tile are kept
TILES = (8, 10)  # down and across the image
TILE_FEATURES = 16  # so that a busy corner of the room, or a person, does not outvote the rest
CELL = 8  # px; of the matches in one cell, at the same place in several frames too, one counts
EDGE = 16  # px at the image's border without corners; OpenCV's 31 hide half of a roll
FAST_THRESHOLD = 7  # grey levels; OpenCV's 20 leaves plain rooms without corners
MIN_CONTRAST = 10.0  # grey levels; below it contrast is left weak, and 0 is no divisor
DISTINCT = 0.9  # descriptor distance over that of the second best; repeated texture has the two alike
WINDOW = 15  # px, side of the patch that is matched to a fraction of a pixel
MAX_REFINEMENT = 4.0  # px, from the corner found in the right image
MAX_RETURN = 0.3  # px, how far a match may end from its start when followed back
REACH = (0.1, 0.5)  # share of the height and of the width, within which a match is looked for


@dataclass(frozen=True)
class Alignment:
    """How far the right image of a point lies below its left image; all NaN where matches are too few."""

    dy: float  # px, median row in the right image less row in the left
    typical: (
        float  # px, median over the image of the rows' distance, whatever its sign: a roll has it, and no dy
    )
    spread: float  # px, robust standard deviation of one match about what a misaligned rig can do
    matches: int  # that are left to measure by
    roll: float  # rad, slope of the rows' difference along a row: the right image is turned clockwise
    scale: float  # slope down a column, px/px: the right image is larger by this share
    roll_error: float  # standard errors of the two
    scale_error: float

    @property
    def error(self) -> float:
        """Standard error of `dy`, px, from the spread of the matches.

        Up to 1.6 times too small, for neighbouring matches overlap; and between whole pixels there is a bias of up to
        0.05 px, mostly of the resampling.
        """
        return _MEDIAN_ERROR * self.spread / math.sqrt(self.matches) if self.matches else math.nan


_MEDIAN_ERROR = math.sqrt(math.pi / 2)  # of a median, relative to that of a mean, for a normal error
_TO_SD = 1.4826  # from the median absolute deviation to the standard deviation, for a normal error


def measure_alignment(
    left: Float[Tensor, "batch channels height width"],
    right: Float[Tensor, "batch channels height_right width_right"],
) -> Alignment:
    """Vertical misalignment of the pairs of one rig, all pooled; images in [0, 1], any device and float dtype.

    Corners (ORB) are matched both ways, the match is refined by Lucas and Kanade's method on images of evened
    brightness and contrast, and followed back. Disparities of either sign may be up to half the width, rows
    up to a tenth of the height apart. Medians, so up to half of the matches may lie on what moved between the
    two exposures. About 35 ms of one CPU for a pair of 640 x 480.
    """
    if left.shape != right.shape:
        raise ValueError(
            f"the left and the right images must be of one shape, got {tuple(left.shape)} and "
            f"{tuple(right.shape)}; give the pairs of one recording"
        )
    height, width = left.shape[-2:]
    pairs = zip(_grey(left), _grey(right), strict=True)
    matches = np.concatenate([np.zeros((0, 4), np.float32), *(_match(*pair) for pair in pairs)])
    cells = (matches[:, 1] // CELL) * (width // CELL + 1) + matches[:, 0] // CELL
    matches = matches[np.unique(cells, return_index=True)[1]].astype(np.float64)
    if len(matches) < MIN_MATCHES:
        nan = math.nan
        return Alignment(nan, nan, nan, len(matches), nan, nan, nan, nan)
    rows = matches[:, 3] - matches[:, 1]
    unit = width / 2  # px, so that the columns of the design are alike in size
    x, y = (matches[:, 0] - (width - 1) / 2) / unit, (matches[:, 1] - (height - 1) / 2) / unit
    # What turning the right camera about its axes and changing its focal length do to first order: pitch (1, y^2),
    # roll (x), yaw (x y), focal length (y).
    design = np.stack([np.ones_like(x), x, y, x * y, y * y], 1)
    modes = _least_absolute(design, rows)
    spread = _TO_SD * float(np.median(np.abs(rows - design @ modes)))
    covariance = np.linalg.pinv(design.T @ design)
    errors = _MEDIAN_ERROR * spread * np.sqrt(covariance.diagonal())
    return Alignment(
        dy=float(np.median(rows)),
        typical=float(np.median(np.abs(design @ modes))),
        spread=spread,
        matches=len(matches),
        roll=float(modes[1]) / unit,
        scale=float(modes[2]) / unit,
        roll_error=float(errors[1]) / unit,
        scale_error=float(errors[2]) / unit,
    )


def alignment_warning(alignment: Alignment) -> str | None:
    """What to tell the user, in one sentence; None where rows are aligned to 0.5 px or nothing was measured."""
    if alignment.spread > AGREE_WITHIN:
        return (
            f"the rows of {alignment.matches} points matched between the left and right images scatter by "
            f"{alignment.spread:.1f} px, as where the two were not taken at the same moment or show one pattern "
            "again and again; check the recording, and where its scene is an ordinary one calibrate again "
            f"({CALIBRATE})"
        )
    if not alignment.typical > WARN_ABOVE:  # NaN, too
        return None
    causes = []
    if abs(alignment.dy) > WARN_ABOVE:
        side = "lower" if alignment.dy > 0 else "higher"
        causes.append(f"lies {abs(alignment.dy):.2f} px {side}")
    if abs(alignment.roll) > max(NOTABLE_SLOPE, SIGNIFICANT * alignment.roll_error):
        sense = "clockwise" if alignment.roll > 0 else "anticlockwise"
        causes.append(f"is turned {sense} by {math.degrees(abs(alignment.roll)):.2f} degrees")
    if abs(alignment.scale) > max(NOTABLE_SLOPE, SIGNIFICANT * alignment.scale_error):
        sense = "larger" if alignment.scale > 0 else "smaller"
        causes.append(f"is {sense} by {100 * abs(alignment.scale):.2f} %")
    cause = f" (the right image {', '.join(causes)})" if causes else ""
    return (
        f"the rows of the left and right images are {alignment.typical:.2f} px apart (at most {WARN_ABOVE:g} is "
        f"good), which spoils matches and depth{cause}; calibrate again "
        f"({CALIBRATE}), or give the raw images with their calibration K1, D1, K2, D2, R, T"
    )


def _grey(images: Float[Tensor, "batch channels height width"]) -> np.ndarray:
    grey = images.detach().float().mean(1).nan_to_num().clamp(0, 1) * 255
    return grey.round().byte().cpu().numpy()


def _match(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Columns and rows of matched points, (matches, 4): left u, left v, right u, right v, px."""
    nothing = np.zeros((0, 4), np.float32)
    finder = cv2.ORB.create(
        nfeatures=FEATURES, scaleFactor=1.3, nlevels=4, fastThreshold=FAST_THRESHOLD, edgeThreshold=EDGE
    )
    chosen = [_spread_out(finder.detect(image, None), image.shape) for image in (left, right)]
    if min(map(len, chosen)) < 2:
        return nothing
    points, descriptors = zip(
        *(finder.compute(image, corners) for image, corners in zip((left, right), chosen, strict=True)),
        strict=True,
    )
    there, back = (
        _distinct(*pair) for pair in ((descriptors[0], descriptors[1]), (descriptors[1], descriptors[0]))
    )
    kept = [(a, b) for a, b in there.items() if back.get(b) == a]
    if not kept:
        return nothing
    start, end = (
        np.array([found[index].pt for index in chosen], np.float32)
        for found, chosen in zip(points, zip(*kept, strict=True), strict=True)
    )
    distance = np.abs(end - start)
    near = (distance[:, 1] <= REACH[0] * left.shape[0]) & (distance[:, 0] <= REACH[1] * left.shape[1])
    start, end = start[near], end[near]
    if not len(start):
        return nothing
    even_left, even_right = _evened(left), _evened(right)
    refined, found = _follow(even_left, even_right, start, end)
    returned, found_back = _follow(even_right, even_left, refined, start)
    good = (
        (found & found_back)
        & (np.abs(returned - start).max(1) <= MAX_RETURN)
        & (np.abs(refined - end).max(1) <= MAX_REFINEMENT)
    )
    return np.concatenate([start[good], refined[good]], 1)


def _spread_out(corners: Sequence[cv2.KeyPoint], shape: tuple[int, ...]) -> list[cv2.KeyPoint]:
    """The corners of the strongest response in each tile of the image."""
    if not corners:
        return []
    u, v = np.array([corner.pt for corner in corners]).T
    tile = (v * TILES[0] // shape[0]) * TILES[1] + u * TILES[1] // shape[1]
    order = np.lexsort((-np.array([corner.response for corner in corners]), tile))
    _, first, counts = np.unique(tile[order], return_index=True, return_counts=True)
    rank = np.arange(len(order)) - np.repeat(first, counts)
    return [corners[index] for index in order[rank < TILE_FEATURES]]


def _distinct(descriptors: np.ndarray, others: np.ndarray) -> dict[int, int]:
    """The nearest of the others for each descriptor that has one clearly nearer than the next."""
    matches = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(descriptors, others, 2)
    return {a.queryIdx: a.trainIdx for a, b in matches if a.distance < DISTINCT * b.distance}


def _evened(image: np.ndarray) -> np.ndarray:
    """The image with its brightness and contrast made the same everywhere: two cameras differ in gain."""
    grey = image.astype(np.float32)
    mean = cv2.blur(grey, (WINDOW, WINDOW))
    variance = (cv2.blur(grey * grey, (WINDOW, WINDOW)) - mean * mean).clip(0)
    return (128 + 40 * (grey - mean) / np.sqrt(variance + MIN_CONTRAST**2)).clip(0, 255).astype(np.uint8)


def _follow(
    image: np.ndarray, other: np.ndarray, points: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where the points of an image lie in the other, (n, 2), found from near there; and whether they do, (n,)."""
    refined, found, _ = cv2.calcOpticalFlowPyrLK(
        image,
        other,
        points[:, None],
        start[:, None].copy(),  # written to
        winSize=(WINDOW, WINDOW),
        maxLevel=1,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.005),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return refined[:, 0], found[:, 0] > 0


def _least_absolute(design: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The coefficients with the least sum of absolute residuals, by least squares weighted again and again."""
    weight = np.ones_like(values)
    for _ in range(30):
        root = np.sqrt(weight)
        coefficients = np.linalg.lstsq(design * root[:, None], values * root, rcond=None)[0]
        weight = 1 / np.maximum(np.abs(values - design @ coefficients), 1e-3)  # px, below what is measured
    return coefficients
