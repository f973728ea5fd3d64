"""What the empty scene looks like: a model of its colour or of its depth, and how far a frame is from it.

Images are RGB in [0, 1], depth is metres along the left camera's z axis, NaN where there is no reading.
Log-odds are log P(foreground) / P(background) per pixel, saturated so that no one cue settles a pixel.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchpose.vision.density import reading_density
from torchpose.vision.photometry import gradient_squared, noise_line, relative_gain, temporal_median
from torchpose.vision.windows import window_max, window_mean, window_min

Frames = Float[Tensor, "frames 3 height width"]
Plane = Float[Tensor, "height width"]
Planes = Float[Tensor, "batch height width"]
# Bounds of the log-odds: of a pixel, of one that may be in a shadow, on a mixed edge, and where the scene glares.
UNCHANGED, CHANGED = -6.0, 4.0
SHADED, MIXED = -2.0, -4.0
GLARING = (-1.0, 0.5)
_MODE_STEPS = 4  # of the mean shift to the farthest mode of a pixel's readings
CHANGED_SLOPE, SHADED_SLOPE = 4.0, 3.0  # log-odds by which a misfit of 1 more than the threshold counts


@dataclass(frozen=True)
class BackgroundConfig:
    """Settings of `BackgroundModel`. Thresholds are in units of the noise variance."""

    noise_floor: float = 0.008  # standard deviation that no pixel falls below: two of 255 levels
    gain_tolerance: float = 0.01  # relative brightness error left after the gain of a frame is taken out
    jitter: float = 0.15  # px, tremor of the camera: matters at edges of the background
    shadow_min: float = 0.4  # a cast shadow leaves at least this share of the light
    glare: float = 0.98  # intensity from which the sensor may be saturated
    shadow_tint: float = 0.03  # relative change of colour in a shadow, lit by another part of the room
    unchanged_threshold: float = 2.5  # mean squared change of a 3 x 3 window from which it has changed
    shadow_threshold: float = 1.2  # mean squared misfit of a 5 x 5 window from which it is no shadow
    unknown: float = -1.0  # log-odds where the scene was never seen: who hides it, and their rim

    def __post_init__(self) -> None:
        for name in ("noise_floor", "unchanged_threshold", "shadow_threshold"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("gain_tolerance", "jitter", "shadow_tint"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}; 0 switches it off")
        if not self.glare > 0:
            raise ValueError(f"glare must be positive, got {self.glare}; above 1 switches it off")
        if not 0 < self.shadow_min <= 1:
            raise ValueError(f"shadow_min must be in (0, 1], got {self.shadow_min}; 1 means no shadows")


class BackgroundModel(nn.Module):
    """Foreground log-odds from what the empty scene looks like.

    A pixel is background if a 3 x 3 window that holds it has not changed, or if a 5 x 5 one is the empty
    scene's texture darkened by one factor: a cast shadow keeps colour and texture. Of the windows that hold a
    pixel the best counts, so that the edge of a shadow or of the person does not widen. Pixels of which the scene is
    never seen are unknown: their log-odds are `unknown`, and windows leave them out.
    """

    center: Float[Tensor, "3 height width"]  # the empty scene, 0 where unknown
    known: Bool[Tensor, "height width"]  # the scene was seen there
    _weight: Tensor
    _shadow_weight: Tensor
    _square_weight: Tensor
    _power: Tensor
    _share: Tensor
    _shadow_share: Tensor

    def __init__(self, frames: Frames, config: BackgroundConfig = BackgroundConfig()):
        """Learn from K frames (K, 3, H, W) of the empty scene; one will do, two measure the noise better.

        NaN where somebody hides the scene, as `learn_empty_scene` marks it in the frames of a recording.
        """
        super().__init__()
        if frames.shape[0] == 0:
            raise ValueError("the background needs at least 1 frame, got 0; use `learn_empty_scene`")
        if (frames < 0).any() or (frames > 1).any():
            raise ValueError("background frames must be in [0, 1]; divide 8-bit images by 255")
        self.config = config
        center = temporal_median(frames)
        frames = frames / relative_gain(frames, center)
        center = temporal_median(frames)
        known = center.isfinite().all(0)
        if not known.any():
            raise ValueError(
                "background frames must show the scene somewhere, got NaN alone; add empty frames"
            )
        count = frames.isfinite().all(1).sum(0).clamp_min(1)  # (H, W)
        noise = noise_line(frames)
        level = (noise[0] + noise[1] * center).clamp_min(config.noise_floor**2)
        if len(frames) >= 5:  # enough to see a pixel flicker: a screen, a leaf, or a person who stood there
            spread = (1.4826 * (frames - center).abs().nanmedian(0).values).square().nan_to_num(0)
            spread = torch.where(count >= 5, window_mean(spread, 1), 0)
            level = level + (spread - 4 * level).clamp_min(0)
        edges = gradient_squared(center).nan_to_num(0)  # beside unknown pixels there is none
        variance = (
            level * (1 + 1 / count) + config.jitter**2 * edges + (config.gain_tolerance * center).square()
        )
        tinted = variance + (config.shadow_tint * center).square()
        center, variance = torch.where(known, center, 0), torch.where(known, variance, torch.inf)
        tinted = torch.where(known, tinted, torch.inf)  # so that unknown pixels weigh nothing
        power = window_mean((center.square() / (3 * tinted)).sum(0), 2).clamp_min(1e-12)
        share, shadow_share = (
            window_mean(known.to(center.dtype), radius).clamp_min(1e-6) for radius in (1, 2)
        )
        for name, value in (
            ("center", center),
            ("known", known),
            ("_weight", 1 / (3 * variance)),
            ("_shadow_weight", center / (3 * tinted)),
            ("_square_weight", 1 / (3 * tinted)),
            ("_power", power),
            ("_share", share),
            ("_shadow_share", shadow_share),
        ):
            self.register_buffer(name, value, persistent=False)

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Planes:
        """Log-odds in [-6, 4]: about -6 unchanged, -2 darkened like a shadow, 4 something else.

        Where the scene glares they are in [-1, 0.5], and where it was never seen they are `unknown`.

        What looks like a shadow may be a grey shirt: depth tells, in `person_silhouette`. So match the stereo
        pair in `search_region`, which keeps both, and not where the log-odds are positive.
        """
        if images.shape[-2:] != self.center.shape[-2:]:
            raise ValueError(
                f"images must have the background's size {tuple(self.center.shape[-2:])}, "
                f"got {tuple(images.shape[-2:])}; record the background with the same camera"
            )
        images = images / relative_gain(images, self.center)
        change = (self._weight * (images - self.center).square()).sum(1)  # 1 on average if unchanged
        unchanged = window_min(window_mean(change, 1) / self._share, 1)
        log_unchanged = (CHANGED_SLOPE * (unchanged - self.config.unchanged_threshold)).clamp(
            UNCHANGED, CHANGED
        )
        shaded = window_min(self._shadow_misfit(images), 2)
        log_shaded = (SHADED_SLOPE * (shaded - self.config.shadow_threshold)).clamp(SHADED, CHANGED)
        log_odds = torch.minimum(log_unchanged, log_shaded)
        # A pixel on the person's edge mixes both and belongs to the side that gave it more than half: beside
        # unchanged pixels, its change must be half of the strongest near by (a quarter of the square).
        mixed = (change < 0.25 * window_max(change, 1)) & (window_min(log_unchanged, 1) < 0)
        log_odds = torch.where(mixed & (log_unchanged > 0), log_odds.clamp_max(MIXED), log_odds)
        # Of a pixel that glares, any shade may be a shadow, and anything bright may hide.
        glaring = (self.center >= self.config.glare).all(0)
        log_odds = torch.where(glaring, log_odds.clamp(*GLARING), log_odds)
        return torch.where(self.known, log_odds, self.config.unknown)

    def _shadow_misfit(self, images: Float[Tensor, "batch 3 height width"]) -> Planes:
        """Mean over 5 x 5 windows of (image - s center)^2 / variance, at the best s in [shadow_min, 1]."""
        product = window_mean((self._shadow_weight * images).sum(1), 2)
        square = window_mean((self._square_weight * images.square()).sum(1), 2)
        scale = (product / self._power).clamp(self.config.shadow_min, 1)
        return (square - 2 * scale * product + scale.square() * self._power) / self._shadow_share


@dataclass(frozen=True)
class DepthBackgroundConfig:
    """Settings of `DepthBackground`; noise is noise_floor + noise_growth Z^2, or what is measured."""

    noise_floor: float = 0.02  # m
    noise_growth: float = 0.003  # m per m^2: 3 cm at 3 m
    drift: float = 2.0  # times the noise of successive frames: what a minute's drift makes of it
    outliers: float = 0.02  # share of readings that are anywhere
    max_depth: float = 10.0  # m, readings are believed up to here
    mixing: int = 8  # px about an edge, within which a reading may mix what is before and what is behind it
    ramp: float = 0.1  # share of the step from before to behind by which depth then grows in half of them

    def __post_init__(self) -> None:
        if not (self.noise_floor > 0 and self.noise_growth >= 0):
            noise = f"{self.noise_floor} and {self.noise_growth}"
            raise ValueError(f"noise_floor must be positive and noise_growth not negative, got {noise}")
        if not 0 < self.outliers < 1:
            raise ValueError(f"outliers must be in (0, 1), got {self.outliers}")
        if not self.max_depth > 0:
            raise ValueError(f"max_depth must be positive, got {self.max_depth}")
        if not self.drift >= 1:
            raise ValueError(f"drift must be at least 1, got {self.drift}")
        if self.mixing < 0 or not 0 < self.ramp < 0.5:
            raise ValueError(
                f"mixing must not be negative (0 switches it off) and ramp in (0, 0.5), got {self.mixing} and "
                f"{self.ramp}"
            )


class DepthBackground(nn.Module):
    """Foreground log-odds of a depth camera from the empty scene's depth; the noise grows as Z^2.

    From three frames on the noise is measured too, its growth and where it is worse; `drift` times what they show, for
    a minute's drift is more than what successive frames differ by.
    """

    depth: Plane  # m, NaN where the empty scene gave no reading
    sigma: Plane  # m, standard deviation of a reading from it
    roughness: Float[Tensor, ""]  # m per m^2, of the same noise, what neighbours on a surface differ by
    noise: Float[Tensor, ""]  # m per m^2, standard deviation of a reading over its squared depth

    def __init__(
        self,
        frames: Float[Tensor, "frames height width"],
        config: DepthBackgroundConfig = DepthBackgroundConfig(),
    ):
        """Learn from K frames (K, H, W) in metres; NaN, 0 and what is beyond `max_depth` are no readings."""
        super().__init__()
        if frames.shape[0] == 0:
            raise ValueError("the background needs at least 1 depth frame, got 0; record the empty scene")
        self.config = config
        frames = _clean_depth(frames, config.max_depth)
        depth = _middle(frames)
        roughness = _roughness(frames[:8], self._reach)
        noise = roughness
        growth, spread = torch.full_like(depth[0, 0], config.noise_growth), torch.zeros_like(depth)
        if (
            len(frames) < 3
        ):  # too few to tell noise over time: that between neighbouring readings stands for it
            growth = torch.maximum(growth, 1.5 * roughness)
        else:
            deviation = 1.4826 * (frames - depth).abs()
            deviation = deviation.masked_fill(frames.isfinite().sum(0) < 3, torch.nan)
            measured = (deviation / depth.square()).nanmedian()
            noise = torch.maximum(roughness, measured.nan_to_num(0.0))
            growth = torch.where(
                measured > 0, (config.drift * measured).clamp_min(config.noise_growth), growth
            )
            square = deviation.nanmedian(0).values.square()
            known = window_mean(square.isfinite().to(square.dtype), 2).clamp_min(1e-6)
            spread = config.drift * (window_mean(square.nan_to_num(), 2) / known).sqrt()
        self.register_buffer("depth", depth, persistent=False)
        self.register_buffer("roughness", roughness, persistent=False)
        self.register_buffer("noise", noise, persistent=False)
        sigma = config.noise_floor + torch.maximum(growth * depth.square(), spread)
        self.register_buffer("sigma", sigma, persistent=False)

    @property
    def _reach(self) -> int:
        return max(1, self.config.mixing // 2)

    def forward(self, depth: Planes) -> Planes:
        """Log-odds in [-4, 4] of frames in metres: 0 without a reading, 1 if only the background has none.

        A reading that mixes the scene with what stands before it belongs to the side that gave it more than half.
        """
        if depth.shape[-2:] != self.depth.shape:
            raise ValueError(
                f"depth must have the background's size {tuple(self.depth.shape)}, "
                f"got {tuple(depth.shape[-2:])}; record the background with the same camera"
            )
        depth, config = _clean_depth(depth, self.config.max_depth), self.config
        foreground = torch.where(depth < self.depth, (1 - config.outliers) / self.depth, 0)
        foreground = foreground + config.outliers / config.max_depth
        background = reading_density(depth - self.depth, self.sigma, config.outliers, config.max_depth)
        log_odds = torch.where(self.depth.isnan(), 1, torch.log(foreground / background).clamp(-4, 4))
        log_odds = torch.where(self.front_share(depth) < 0.5, MIXED, log_odds)
        return torch.where(depth.isnan(), 0, log_odds)

    def front_share(self, depth: Planes) -> Planes:
        """How much of each reading is of what stands before the scene: 1, and less where it is mixed with the scene.

        Where a camera's window holds an edge, its readings lead from the depth before to that behind as a ramp. A
        surface is none: there, depth does not grow to both sides by a share of the whole step.
        """
        radius = self.config.mixing
        if radius == 0:
            return torch.ones_like(depth)
        depth = _clean_depth(depth, self.config.max_depth)
        near = window_min(depth.nan_to_num(torch.inf), radius)
        far = window_max(depth.nan_to_num(0.0), radius)
        far = torch.where(self.depth.isnan(), far, torch.minimum(far, self.depth))
        step = far - near
        rough = 2 * 2**0.5 * self.roughness * depth.square()
        least, steep = (
            torch.maximum(self.config.ramp * step, rough),
            torch.zeros_like(depth, dtype=torch.bool),
        )
        reach = self._reach
        # A surface that slopes as the scene behind it does, or before a scene that slopes, is no ramp to it.
        gap = torch.where(self.depth.isnan(), -depth, self.depth - depth)
        for axis in (-2, -1):
            size = depth.shape[axis]
            inner = torch.arange(size, device=depth.device)
            inner = (inner >= reach) & (inner < size - reach)  # `roll` brings in the other side
            ramp = (inner[:, None] if axis == -2 else inner).expand_as(depth)
            for image in (depth, gap):
                before, after = torch.roll(image, reach, axis), torch.roll(image, -reach, axis)
                rise, fall = after - image, image - before
                ramp = ramp & ((torch.minimum(rise, fall) > least) | (torch.maximum(rise, fall) < -least))
            steep |= ramp
        noise = torch.where(self.sigma.isnan(), self.config.noise_floor, self.sigma)
        mixed = steep & (step > 3 * noise) & step.isfinite()
        return torch.where(mixed, ((far - depth) / step).clamp(0, 1), 1.0)


def _roughness(frames: Float[Tensor, "frames height width"], reach: int) -> Float[Tensor, ""]:
    """Noise of a reading against those `reach` px beside it, over Z^2, by second differences along the rows."""
    if frames.shape[2] <= 2 * reach:
        return frames.new_zeros(())
    middle = frames[..., reach:-reach]
    second = (frames[..., 2 * reach :] - 2 * middle + frames[..., : -2 * reach]).abs() / middle.square()
    return (1.4826 / 6**0.5 * second.nanmedian()).nan_to_num(0.0)


def far_readings(
    depth: Float[Tensor, "num height width"], config: DepthBackgroundConfig = DepthBackgroundConfig()
) -> Float[Tensor, "num height width"]:
    """The readings of each pixel that are the empty scene's, NaN elsewhere, m: those about the farthest mode.

    Whoever walks through stands before the scene. From the tenth reading from the far end, for the farthest is noise's
    choice, the middle of what lies within three standard deviations is taken, over and over, so that it is not drawn
    to the far end. The noise is measured: over the image by the differences of successive frames, which few see a
    person come or go in, and at a pixel by what is behind the middle, where nobody is.
    """
    depth = _clean_depth(depth, config.max_depth)
    far = torch.nanquantile(depth, 0.9, dim=0)
    growth = depth.new_tensor(config.noise_growth)
    if len(depth) >= 3:
        change = 1.4826 * (depth[1:] - depth[:-1]).abs() / (2**0.5 * far.square())
        growth = torch.fmax(growth, change.nanmedian())
    for _ in range(_MODE_STEPS):
        sigma = config.noise_floor + growth * far.square()
        far = _middle(depth.where((depth - far).abs() <= 3 * sigma, torch.nan))
    sigma = config.noise_floor + growth * far.square()
    behind = (depth - far).where(depth > far, torch.nan)
    count = window_mean(behind.isfinite().sum(0).to(depth.dtype), 2).clamp_min(1e-6)
    sigma = torch.maximum(sigma, (window_mean(behind.square().nansum(0), 2) / count).sqrt())
    return depth.where((depth - far).abs() <= 3 * sigma, torch.nan)


def _middle(depth: Float[Tensor, "num height width"]) -> Plane:
    """Median of each pixel's readings, the mean of the middle two where their number is even; NaN of none."""
    return torch.nanquantile(depth, 0.5, dim=0)


def _clean_depth(
    depth: Float[Tensor, "*batch height width"], greatest: float
) -> Float[Tensor, "*batch height width"]:
    return torch.where((depth > 0) & (depth <= greatest), depth, torch.nan)
