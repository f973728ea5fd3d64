"""The focal length of a depth camera from a person whose height is known: depth gives sizes in metres times pixels."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.vision.background import DepthBackground, DepthBackgroundConfig
from torchpose.vision.silhouette import person_silhouette
from torchpose.vision.windows import window_min

_RIM = 2  # px inside the silhouette's edge, where readings mix the person and the scene
_CUT = 4  # pixels of the silhouette on the image's edge, from which the person counts as cut
_FEWEST_ROWS = 20  # of a person, for the line through their depths


def focal_length_of_person(
    depth: Float[Tensor, "frames height width"],
    empty: Float[Tensor, "num height width"],
    height: float,
    cy: float,
) -> float:
    """The focal length, px, that makes an upright person `height` tall.

    From the first row of the head to the last of the feet it is f = ((v - cy) Z at the feet - (v - cy) Z at the head) /
    sqrt(height^2 - (Z at the feet - Z at the head)^2), so the camera may look a little up or down. Z is a line through
    the person's depths row by row, as readings at the head's and the feet's edges mix person and scene. Whoever stoops
    looks shorter, never taller: of the frames with a whole person the second tallest counts, for the tallest may hold a
    stray reading.

    Args:
        depth: frames that are spread over a recording, m, NaN where there is no reading.
        empty: frames of the empty scene, m, NaN where there is no reading or it is not the scene's.
        height: of the person, m.
        cy: row of the principal point, px.

    Raises ValueError where nobody is found, or where the image's border cuts the person in all frames.
    """
    # The feet's readings mix with the floor's: they would go with all others that do.
    background = DepthBackground(empty, DepthBackgroundConfig(mixing=0))
    mask = person_silhouette(background(depth), depth, background_depth=background.depth).mask
    there = mask.flatten(1).any(1)
    if not there.any():
        raise ValueError(
            f"a person must stand before the camera for the focal length to be estimated, got nobody in {len(depth)} "
            "frames; give focal_length, or record a person upright with the whole body in the image"
        )
    whole = there & (_border(mask) <= _CUT)
    if not whole.any():
        raise ValueError(
            f"the whole person must be in the image for the focal length to be estimated, got them cut by its border "
            f"in all {int(there.sum())} frames with a person; give focal_length, or step back"
        )
    found = [_focal_length(mask[i], depth[i], height, cy) for i in whole.nonzero()[:, 0].tolist()]
    lengths = sorted(length for length in found if length is not None)
    if not lengths:
        raise ValueError(
            f"a person must be {height} m tall and upright for the focal length to be estimated, got nobody so in "
            f"{len(found)} frames; check person_height and depth_unit, or give focal_length"
        )
    return lengths[-2] if len(lengths) > 1 else lengths[-1]


def _focal_length(
    mask: Bool[Tensor, "height width"], depth: Float[Tensor, "height width"], height: float, cy: float
) -> float | None:
    """From one frame's person; None where too little is seen of them, or they lie along the line of sight."""
    inner = window_min(mask[None].to(depth.dtype), _RIM)[0] > 0
    of_row = torch.where(inner, depth, torch.nan).nanmedian(1).values
    rows = of_row.isfinite().nonzero()[:, 0]
    if len(rows) < _FEWEST_ROWS:
        return None
    column = mask.nonzero()[:, 1].median()
    span = mask.any(1).nonzero()[:, 0]
    # Raised hands are beside the head: it is looked for within a seventh of the height around the middle.
    reach = (span[-1] - span[0]) / 14
    near = (torch.arange(mask.shape[1], device=mask.device) - column).abs() <= reach
    top = float((mask & near).any(1).nonzero()[0, 0]) - 0.5  # outer edges of the first and the last row
    bottom = float(span[-1]) + 0.5
    near_top, near_bottom = _line(rows.to(depth.dtype), of_row[rows], top, bottom)
    squared = height**2 - (near_bottom - near_top) ** 2
    extent = (bottom - cy) * near_bottom - (top - cy) * near_top
    return extent / squared**0.5 if squared > 0 and extent > 0 else None


def _line(
    rows: Float[Tensor, " num"], values: Float[Tensor, " num"], first: float, last: float
) -> tuple[float, float]:
    """Values at rows `first` and `last` of the line with the median slope (Theil and Sen) of rows far apart."""
    i, j = torch.triu_indices(len(rows), len(rows), 1, device=rows.device)
    apart = rows[j] - rows[i] > (rows[-1] - rows[0]) / 4
    slope = ((values[j] - values[i]) / (rows[j] - rows[i]))[apart].median()
    offset = (values - slope * rows).median()
    return float(offset + slope * first), float(offset + slope * last)


def _border(mask: Bool[Tensor, "frames height width"]) -> Tensor:
    """Pixels of each mask on the image's edge."""
    return torch.cat([mask[:, 0], mask[:, -1], mask[:, :, 0], mask[:, :, -1]], dim=1).sum(1)
