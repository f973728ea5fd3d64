"""How likely a reading is: near its expectation by the noise, or, rarely, anywhere."""

import math

import torch
from torch import Tensor


def reading_density(deviation: Tensor, sigma: Tensor | float, outliers: float, span: float) -> Tensor:
    """(1 - outliers) N(deviation; 0, sigma^2) + outliers / span, of any shapes that broadcast.

    Args:
        deviation: of the readings from what is expected; NaN stays NaN.
        sigma: standard deviation of their noise, in the same unit.
        outliers: share of the readings that are anywhere, evenly.
        span: how far that is, in the same unit.
    """
    normal = torch.exp(-0.5 * (deviation / sigma).square()) / (sigma * math.sqrt(2 * math.pi))
    return (1 - outliers) * normal + outliers / span
