"""The stereo matchers behind one interface: which there are, and which one a configuration names."""

from dataclasses import dataclass, field
from enum import Enum

import cv2
import numpy as np
import torch
from torch import Tensor

from torchpose.vision.disparity import Disparity, MatchingTask, StereoMatcher, bounding_box, smooth
from torchpose.vision.growing_seeds import GrowingSeeds, GrowingSeedsConfig
from torchpose.vision.semi_global import SemiGlobal, SemiGlobalConfig


class MatcherKind(Enum):
    """The matchers by name."""

    gcs = "gcs"  # Growing Correspondence Seeds: the thesis's, whose cost goes with what is matched
    sgm = "sgm"  # semi-global matching: dense, in a time that hardly depends on the images
    opencv = "opencv"  # OpenCV's own semi-global matcher, on the CPU


@dataclass(frozen=True)
class OpenCVConfig:
    """Settings of `cv2.StereoSGBM`, named as there."""

    block_size: int = 5  # px
    uniqueness_ratio: int = 10  # per cent by which the best must beat the second
    speckle_window: int = 100  # px, least area
    speckle_range: int = 2  # px
    left_right: int = 1  # px by which both directions may differ
    smoothing: int = 2  # px, radius of the last mean over neighbours within 1 px of disparity

    def __post_init__(self) -> None:
        if self.block_size < 1 or self.block_size % 2 == 0:
            raise ValueError(f"block_size must be odd, got {self.block_size}; 5 is usual")
        if self.smoothing < 0:
            raise ValueError(f"smoothing must not be negative, got {self.smoothing}; 0 turns it off")


class OpenCVMatcher(StereoMatcher):
    """OpenCV's semi-global block matcher, 3-way mode; for comparison, and a plain choice. Seeds do not help it."""

    def __init__(self, config: OpenCVConfig = OpenCVConfig()) -> None:
        super().__init__()
        self.config = config

    def match(self, task: MatchingTask) -> Disparity:
        config, least = self.config, task.least
        count = -(-(task.greatest - least + 1) // 16) * 16  # as OpenCV wants it
        area = config.block_size**2
        matcher = cv2.StereoSGBM.create(
            minDisparity=least,
            numDisparities=count,
            blockSize=config.block_size,
            P1=8 * area,
            P2=32 * area,
            disp12MaxDiff=config.left_right,
            uniquenessRatio=config.uniqueness_ratio,
            speckleWindowSize=config.speckle_window,
            speckleRange=config.speckle_range,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )
        values = task.unanswered().values
        for index in range(len(values)):  # OpenCV takes one pair at a time
            mask = task.mask[index : index + 1]
            if not mask.any():
                continue
            rows, columns = bounding_box(mask)
            # OpenCV answers nothing in the first columns, for which the right image may not reach.
            start = max(0, columns.start - max(0, least + count))
            end = min(values.shape[2], columns.stop - min(least, 0))
            if end - start + min(least, 0) <= max(0, least + count):
                continue
            images = [_eight_bit(image[index, rows, start:end]) for image in (task.left, task.right)]
            found = torch.from_numpy(matcher.compute(*images).astype(np.float32) / 16).to(values)
            found = found.where((found >= least) & (found <= task.greatest), torch.nan)
            values[index, rows, start:end] = found
        values = smooth(values.where(task.mask, torch.nan), config.smoothing)
        return Disparity(values, (~values.isnan()).to(values.dtype))


@dataclass(frozen=True)
class StereoConfig:
    """Which matcher, and the settings of each."""

    matcher: MatcherKind = MatcherKind.gcs
    gcs: GrowingSeedsConfig = field(default_factory=GrowingSeedsConfig)
    sgm: SemiGlobalConfig = field(default_factory=SemiGlobalConfig)
    opencv: OpenCVConfig = field(default_factory=OpenCVConfig)


def stereo_matcher(config: StereoConfig = StereoConfig()) -> StereoMatcher:
    """The matcher that a configuration names."""
    match config.matcher:
        case MatcherKind.gcs:
            return GrowingSeeds(config.gcs)
        case MatcherKind.sgm:
            return SemiGlobal(config.sgm)
        case MatcherKind.opencv:
            return OpenCVMatcher(config.opencv)


def _eight_bit(image: Tensor) -> np.ndarray:
    return (255 * image).round().clamp(0, 255).byte().cpu().numpy()
