"""Row alignment of a stereo pair: how far apart a rectified pair's two images of a point lie, in rows.

Every matcher here searches along a row. A row that is half a pixel off costs matches and depth, and nothing
else shows why, so this is measured on the pictures themselves, and the right image is moved by what was measured.
Pixels; rows count downwards.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

WARN_ABOVE = 0.5  # px
CORRECT_ABOVE = 0.25  # px, root mean square; less is left alone, for resampling blurs
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

NUM_TERMS = 5  # of the smooth difference: 1, x, y, x y, y^2
FOLDS = 5  # of the cross-validation; a tile of the image is held out as a whole, as matches in it overlap
PREFERENCE = 2.0  # standard errors by which more terms must foretell what is held out better than fewer
MAX_MODEL_ERROR = 0.3  # px, greatest standard error of the difference inside its box
OUTLYING = 0.02  # share of the matches on each side that the box leaves out
MARGIN = 0.1  # of the width, by which the box reaches beyond them: corners are sought off the border


@dataclass(frozen=True)
class RowModel:
    """The rows' difference, right less left, as a smooth function of the place: what a right image is moved by.

    c0 + c1 x + c2 y + c3 x y + c4 y^2, px, what turning the right camera about its axes and changing its focal length
    do to first order: pitch (1, y^2), roll (x), yaw (x y), focal length (y). x is the right image's column and y the
    left's row, both from the image's middle in half widths. Outside its box, where hardly a match lies, it stays at
    what it is on the box's edge.
    """

    coefficients: tuple[float, ...]  # px, of the five terms; 0 for those that the matches do not support
    width: int  # px, of the images
    height: int
    box: tuple[float, float, float, float]  # px: first and last column, first and last row

    def place(self, pixels: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Where a pixel (u, v) of the corrected right image lies in the image as it came, px.

        A roll and a focal length move columns as well, by as much at the same distance from the middle: they follow.
        """
        u, v = pixels.unbind(-1)
        x = _from_middle(u.clamp(*self.box[:2]), self.width, self.width)
        y = _from_middle(v.clamp(*self.box[2:]), self.height, self.width)
        one, roll, scale, yaw, pitch = self.coefficients
        rows = one + roll * x + scale * y + yaw * x * y + pitch * y * y
        return torch.stack([u + scale * x - roll * y, v + rows], -1)


@dataclass(frozen=True)
class Alignment:
    """How far the right image of a point lies below its left image; all NaN where matches are too few."""

    dy: float  # px, median row in the right image less row in the left
    typical: float  # px, median of the rows' distance over the image; a roll has one, and no dy
    spread: float  # px, robust standard deviation of one match about what a misaligned rig can do
    matches: int  # that are left to measure by
    roll: float  # rad, slope of the rows' difference along a row: the right image is turned clockwise
    scale: float  # slope down a column, px/px: the right image is larger by this share
    roll_error: float  # standard errors of the two
    scale_error: float
    model: RowModel | None = None  # to correct by; None where that is no gain

    @property
    def error(self) -> float:
        """Standard error of `dy`, px, from the spread of the matches.

        Up to 1.6 times too small, for neighbouring matches overlap; and between whole pixels there is a bias of up to
        0.05 px, mostly of the resampling.
        """
        return _MEDIAN_ERROR * self.spread / math.sqrt(self.matches) if self.matches else math.nan


_MEDIAN_ERROR = math.sqrt(math.pi / 2)  # of a median, relative to that of a mean, for a normal error
_Place = TypeVar("_Place", Tensor, np.ndarray)
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
    design = _design(matches[:, 0], matches[:, 1], width, height)
    everything = np.ones((1, len(matches)), bool), np.ones((1, NUM_TERMS), bool)
    modes = _least_absolute(design, rows, *everything)[0]
    spread = _TO_SD * float(np.median(np.abs(rows - design @ modes)))
    errors = spread * np.sqrt(_unit_covariance(design).diagonal())
    return Alignment(
        dy=float(np.median(rows)),
        typical=float(np.median(np.abs(design @ modes))),
        spread=spread,
        matches=len(matches),
        roll=float(modes[1]) / unit,
        scale=float(modes[2]) / unit,
        roll_error=float(errors[1]) / unit,
        scale_error=float(errors[2]) / unit,
        model=_row_model(matches, width, height) if spread <= AGREE_WITHIN else None,
    )


def align_rows(
    right: Float[Tensor, "batch channels height width"], alignment: Alignment
) -> Float[Tensor, "batch channels height width"]:
    """The right images with their rows moved onto the left's, by cubic resampling; the rim is repeated beyond it.

    Images in [0, 1], any device and float dtype; gradients flow through them. They are returned as they are without a
    model to move them by: where the rows are within 0.25 px already (root mean square), where too few matches were
    found, or where they agree on nothing. Raises ValueError for images of another size than those that were measured.
    """
    model = alignment.model
    if model is None:
        return right
    height, width = right.shape[-2:]
    if (width, height) != (model.width, model.height):
        raise ValueError(
            f"the right images must have the size that was measured, {model.width} x {model.height}, got "
            f"{width} x {height}; measure these anew"
        )
    # Half precision has no place between the pixels of a wide image.
    images = right if right.dtype == torch.float64 else right.float()
    v, u = torch.meshgrid(
        *(torch.arange(size, dtype=images.dtype, device=images.device) for size in (height, width)),
        indexing="ij",
    )
    # -1 and 1 are the outer edges of the first and the last pixel.
    grid = (model.place(torch.stack([u, v], -1)) * 2 + 1) / images.new_tensor([width, height]) - 1
    # Cubic, for linear blurs: of what is answered on cones, teddy and motorcycle 0.3 % more would be off by 1 px.
    moved = F.grid_sample(
        images,
        grid.expand(len(images), -1, -1, -1),
        mode="bicubic",
        padding_mode="border",
        align_corners=False,
    )
    return moved.clamp(0, 1).to(right.dtype)


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


def correction_warning(before: float, after: float | None) -> str:
    """What to tell the user of a recording that is corrected, in one sentence.

    Args:
        before: px, how far apart the rows were, `Alignment.typical`.
        after: px, how far apart they still are; None where too few points tell.
    """
    left = "corrected, but too few points tell how well" if after is None else f"now {after:.2f} px"
    spoils = ", which spoils matches and depth" if after is not None and after > WARN_ABOVE else ""
    return (
        f"the rows of the left and right images were {before:.2f} px apart and are {left}{spoils}: the right images "
        f"are moved by what matched points tell, and depth is as right as the calibration; calibrate again "
        f"({CALIBRATE})"
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


def _row_model(matches: Float[np.ndarray, "num 4"], width: int, height: int) -> RowModel | None:
    """As many terms of the difference as foretell matches that were held out; None where none do, or it is small."""
    rows = matches[:, 3] - matches[:, 1]
    places = matches[:, 2], matches[:, 1]  # the corrected right image's column and row
    design = _design(*places, width, height)
    tile = matches[:, 0] * TILES[1] // width + 2 * (matches[:, 1] * TILES[0] // height)
    held = tile % FOLDS == np.arange(FOLDS)[:, None]  # (folds, num)
    used = np.tri(NUM_TERMS + 1, NUM_TERMS, -1, dtype=bool)  # the first terms, from none to all
    problems = np.repeat(~held, len(used), 0), np.tile(used, (FOLDS, 1))
    foretold = (_least_absolute(design, rows, *problems) @ design.T).reshape(FOLDS, len(used), -1)
    error = np.abs(rows - (foretold * held[:, None]).sum(0))  # (models, num), of the fit without the match
    margin = MARGIN * width
    columns, lines = (
        (max(float(low) - margin, 0.0), min(float(high) + margin, size - 1.0))
        for (low, high), size in zip(
            (np.quantile(place, (OUTLYING, 1 - OUTLYING)) for place in places), (width, height), strict=True
        )
    )
    lattice = np.meshgrid(np.linspace(*columns, 5), np.linspace(*lines, 5))
    corners = _design(lattice[0].ravel(), lattice[1].ravel(), width, height)
    fits = _least_absolute(design, rows, np.ones((len(used), len(rows)), bool), used)
    # One term, a shift, bends nothing where no match lies.
    sizes = [
        size
        for size, fit in enumerate(fits)
        if size <= 1 or _greatest_error(design, rows, fit, size, corners) <= MAX_MODEL_ERROR
    ]
    best = min(sizes, key=lambda size: error[size].mean())
    gap = error - error[best]
    uncertain = PREFERENCE * gap.std(1) / math.sqrt(len(rows))
    size = min(size for size in sizes if gap[size].mean() <= uncertain[size])
    # The fit of no terms is 0 everywhere.
    if math.sqrt(np.square(design @ fits[size]).mean()) <= CORRECT_ABOVE:
        return None
    return RowModel(tuple(map(float, fits[size])), width, height, (*columns, *lines))


def _greatest_error(
    design: np.ndarray, rows: np.ndarray, fit: np.ndarray, size: int, places: np.ndarray
) -> float:
    """Standard error, px, of a fit of the first `size` terms, where it is greatest among places."""
    spread = _TO_SD * float(np.median(np.abs(rows - design @ fit)))
    places = places[:, :size]
    return spread * math.sqrt(((places @ _unit_covariance(design[:, :size])) * places).sum(1).max())


def _unit_covariance(design: Float[np.ndarray, "num terms"]) -> Float[np.ndarray, "terms terms"]:
    """Covariance of the coefficients with the least absolute residuals, for residuals of unit spread."""
    return _MEDIAN_ERROR**2 * np.linalg.pinv(design.T @ design)


def _from_middle(place: _Place, size: int, width: int) -> _Place:
    """A column or a row from the middle of the image's `size` px, in half widths: both are then alike in size."""
    return (place - (size - 1) / 2) / (width / 2)


def _design(
    u: Float[np.ndarray, " num"], v: Float[np.ndarray, " num"], width: int, height: int
) -> Float[np.ndarray, "num terms"]:
    """The five terms at columns and rows, see `RowModel`."""
    x, y = _from_middle(u, width, width), _from_middle(v, height, width)
    return np.stack([np.ones_like(x), x, y, x * y, y * y], 1)


def _least_absolute(
    design: Float[np.ndarray, "num terms"],
    values: Float[np.ndarray, " num"],
    counted: Bool[np.ndarray, "problems num"],
    terms: Bool[np.ndarray, "problems terms"],
) -> Float[np.ndarray, "problems terms"]:
    """The coefficients with the least sum of absolute residuals, by least squares weighted again and again.

    Many problems at once: the values that count and the terms that may differ from 0 in each.
    """
    weight = counted.astype(np.float64)
    for _ in range(30):
        weighted = weight[:, :, None] * design
        normal = (weighted.swapaxes(1, 2) @ design) * (terms[:, :, None] & terms[:, None])
        right = (weighted.swapaxes(1, 2) @ values) * terms
        coefficients = (np.linalg.pinv(normal, 1e-10, hermitian=True) @ right[..., None])[..., 0]
        # 1e-3 px is below what is measured.
        weight = counted / np.maximum(np.abs(values - coefficients @ design.T), 1e-3)
    return coefficients
