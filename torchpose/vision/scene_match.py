"""Whether a stereo pair still shows the empty scene: the right image is read where the scene's own disparity points.

A cast shadow changes the scene's colour, but the pair matches where it matched before; a person does not. Grey images
in [0, 1]; disparity d = x_left - x_right in px, NaN where unknown.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchpose.vision.density import reading_density
from torchpose.vision.disparity import bounding_box
from torchpose.vision.windows import window_mean, window_min

Grey = Float[Tensor, "batch height width"]


@dataclass(frozen=True)
class SceneMatchConfig:
    """Settings of `SceneMatch`: how similarity is spread where the scene is seen, and where it is not."""

    radius: int = 2  # px, of the windows that are compared
    noise: float = 0.01  # standard deviation of a grey value: what is flat but for noise should not match
    least_similarity: float = 0.3  # of the empty pair to itself; where it is less, a match says nothing
    spread: float = 0.08  # of the similarity of the scene, where the empty pair matched perfectly
    spread_growth: float = 0.5  # and what is added to it for each 1 that it lacked
    chance_spread: float = 0.4  # of the similarity about 0 of windows that show different things
    outliers: float = 0.02  # share of the windows with any similarity
    weight: float = 0.5  # of the log-odds: windows overlap, and colour has spoken of the same pixels

    def __post_init__(self) -> None:
        if self.radius < 1:
            raise ValueError(f"radius must be at least 1 px, got {self.radius}")
        for name in ("noise", "spread", "chance_spread"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("spread_growth", "weight"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}; 0 switches it off")
        if not 0 < self.outliers < 1:
            raise ValueError(f"outliers must be in (0, 1), got {self.outliers}")


class SceneMatch(nn.Module):
    """Log-odds (at most 0) of the foreground, from how well a pair matches at the empty scene's disparity.

    Only a match counts, for no match has two reasons: somebody is there, or somebody hides the place from the right
    camera. With c the similarity (MNCC) of a window and c0 that of the empty pair, the log-odds are
    log (1 - e) N(c; 0, chance_spread) + e / 2 over (1 - e) N(min(c, c0); c0, spread + spread_growth (1 - c0)) + e / 2,
    of the nine windows about a pixel the best counts, so that a shadow's match reaches up to the person's edge.
    """

    disparity: Float[Tensor, "height width"]  # px
    similarity: Float[Tensor, "height width"]  # of the empty pair, NaN where it says nothing

    def __init__(
        self,
        left: Float[Tensor, "height width"],
        right: Float[Tensor, "right_height right_width"],
        disparity: Float[Tensor, "scene_height scene_width"],
        config: SceneMatchConfig = SceneMatchConfig(),
    ):
        """Learn from one grey pair of the empty scene, or its median, and its disparity; NaN where unknown."""
        super().__init__()
        if not left.shape == right.shape == disparity.shape:
            shapes = f"{tuple(left.shape)}, {tuple(right.shape)} and {tuple(disparity.shape)}"
            raise ValueError(f"left, right and disparity must have one size, got {shapes}")
        self.config = config
        self.register_buffer("disparity", disparity, persistent=False)
        similarity = scene_similarity(left[None], right[None], disparity, config.radius, config.noise)[0]
        similarity = torch.where(similarity >= config.least_similarity, similarity, torch.nan)
        self.register_buffer("similarity", similarity, persistent=False)

    def forward(
        self, left: Grey, right: Grey, mask: Bool[Tensor, "batch height width"] | None = None
    ) -> Grey:
        """Log-odds of grey pairs, 0 where unknown and off the mask, whose bounding box bounds the cost."""
        if left.shape[1:] != self.similarity.shape:
            raise ValueError(
                f"images must have the scene's size {tuple(self.similarity.shape)}, got {tuple(left.shape[1:])}; "
                "record the empty scene with the same camera"
            )
        log_odds = torch.zeros_like(left)
        if mask is None:
            mask = torch.ones_like(left, dtype=torch.bool)
        if not mask.any():
            return log_odds
        config, margin = self.config, self.config.radius + 1
        rows, columns = (slice(max(0, at.start - margin), at.stop + margin) for at in bounding_box(mask))
        box = rows, columns
        similarity = _similarity(left, right, self.disparity, config.radius, config.noise, box)
        empty = self.similarity[box]
        spread = config.spread + config.spread_growth * (1 - empty)
        span = 2.0  # a similarity lies in [-1, 1]
        scene = reading_density((empty - similarity).clamp_min(0), spread, config.outliers, span)
        other = reading_density(similarity, config.chance_spread, config.outliers, span)
        found = config.weight * window_min((other / scene).log().nan_to_num(0), 1).clamp_max(0)
        log_odds[:, rows, columns] = found
        return torch.where(mask, log_odds, 0)


def scene_similarity(
    left: Grey, right: Grey, disparity: Float[Tensor, "height width"], radius: int = 2, noise: float = 0.01
) -> Grey:
    """MNCC 2 cov / (v_left + v_right) of the windows about each left pixel, at the disparity of the scene there.

    In [-1, 1]; NaN where the disparity is unknown or points beyond the right image, or where fewer than half of the
    window's pixels have one. `noise` (standard deviation of a grey value) is added to the variances.
    """
    height, width = disparity.shape
    return _similarity(left, right, disparity, radius, noise, (slice(0, height), slice(0, width)))


def _similarity(
    left: Grey,
    right: Grey,
    disparity: Float[Tensor, "height width"],
    radius: int,
    noise: float,
    box: tuple[slice, slice],
) -> Float[Tensor, "batch h w"]:
    width = right.shape[2]
    columns = torch.arange(width, device=left.device, dtype=left.dtype)[box[1]] - disparity[box]
    known = (columns >= 0) & (columns <= width - 1)  # False for NaN
    columns = torch.where(known, columns, 0)
    before = columns.long().clamp_max(width - 2)
    share = columns - before
    before = before.expand(len(left), -1, -1)
    right = right[:, box[0]]
    right = torch.lerp(right.gather(2, before), right.gather(2, before + 1), share) * known
    left = left[:, box[0], box[1]] * known
    count = window_mean(known.to(left.dtype), radius)
    inverse = 1 / count.clamp_min(1e-6)
    mean_left, mean_right = window_mean(left, radius) * inverse, window_mean(right, radius) * inverse
    covariance = window_mean(left * right, radius) * inverse - mean_left * mean_right
    power = window_mean(left.square() + right.square(), radius) * inverse
    variances = (power - mean_left.square() - mean_right.square()).clamp_min(0) + 2 * noise**2
    return torch.where(known & (count >= 0.5), 2 * covariance / variances, torch.nan)
