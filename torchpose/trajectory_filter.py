"""Smoothing of what was recorded: Butterworth forth and back, One-Euro, and the Rauch-Tung-Striebel smoother.

Time is the first axis, series the second; seconds, Hz, and the series' own units. Float64 on the CPU.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from enum import Enum

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.export import PoseSequence
from torchpose.tracking.kalman import Gaussian, kalman_filter, kalman_smoother

Series = Float[np.ndarray, "time series"]
_BREAK = 1.5  # usual time steps; a longer step ends a stretch
_DIFFUSE = 1e6  # variance of the smoother's first belief, in those of a measurement
ROOT_TURNS = slice(3, 6)  # of a pose's parameters: yaw, pitch and roll, which may go round; no joint can


class FilterKind(Enum):
    """What smooths a motion; see the functions of this file."""

    none = "none"
    butterworth = "butterworth"
    one_euro = "one_euro"
    rts = "rts"


def butterworth(values: Series, rate: float, cutoff: float, order: int = 4) -> Series:
    """Low pass without delay: a Butterworth filter of half the `order` forth, then back.

    At `cutoff` (Hz) one half is left, as each pass takes 3 dB: no correction is made for the second pass. Movement
    scientists call this a zero-lag filter of the whole order (Winter, Biomechanics and Motor Control of Human
    Movement, 2009, 2.2.4.4). The ends are continued point-symmetrically and both passes begin at rest there, as
    SciPy's `filtfilt` does. A series of no more than `padding(order)` values is left as it is.

    Raises:
        ValueError: the order is odd or below 2, or the cutoff is not between 0 and half the rate.
    """
    if order < 2 or order % 2:
        raise ValueError(
            f"order must be even and at least 2, as half of it runs each way, got {order}; 4 is usual"
        )
    if not 0 < cutoff < rate / 2:
        raise ValueError(
            f"cutoff must lie between 0 and half of {rate:g} frames a second, got {cutoff:g} Hz; 6 Hz is usual"
        )
    pad = padding(order)
    if len(values) <= pad:
        return values.copy()
    before = 2 * values[0] - values[pad:0:-1]
    after = 2 * values[-1] - values[-2 : -pad - 2 : -1]
    extended = np.concatenate([before, values, after])
    for _ in range(2):
        for section in _sections(order // 2, cutoff / rate):
            extended = _run(section, extended)
        extended = extended[::-1]
    return extended[pad:-pad].copy()


def padding(order: int) -> int:
    """How many values `butterworth` puts before and after a stretch, which must be longer than that."""
    return 3 * (order // 2 + 1)


def one_euro(
    values: Series,
    time: Float[np.ndarray, " time"],
    min_cutoff: float = 1.0,
    beta: float = 2.0,
    speed_cutoff: float = 1.0,
) -> Series:
    """The 1 Euro filter: a low pass that follows faster the faster the signal moves; it lags, as it knows no future.

    Its cutoff (Hz) is `min_cutoff + beta |speed|`, of a speed that itself passed a low pass at `speed_cutoff`.
    Source: Casiez, Roussel and Vogel, CHI 2012, algorithm 1.
    """

    def weight(cutoff: np.ndarray | float, step: float) -> np.ndarray | float:
        return 1 / (1 + 1 / (2 * math.pi * cutoff * step))

    smooth = values.copy()
    speed = np.zeros_like(values[0])
    for t in range(1, len(values)):
        step = float(time[t] - time[t - 1])
        change = (values[t] - smooth[t - 1]) / step
        speed = speed + weight(speed_cutoff, step) * (change - speed)
        share = weight(min_cutoff + beta * np.abs(speed), step)
        smooth[t] = smooth[t - 1] + share * (values[t] - smooth[t - 1])
    return smooth


def smooth_rts(values: Series, time: Float[np.ndarray, " time"], cutoff: float) -> Series:
    """What the whole series tells of each moment, where velocity drifts as white noise: Rauch, Tung and Striebel.

    The noise is such that what is left of a long oscillation at `cutoff` (Hz) is one half, as with `butterworth` of
    order 4, whose curve 1 / (1 + (f / cutoff)^4) it has; unlike that one it needs no padding and takes uneven
    times.
    """
    if len(values) < 2:
        return values.copy()
    steps = torch.from_numpy(np.diff(time))
    # Of the acceleration; a measurement has variance 1.
    density = (2 * math.pi * cutoff) ** 4 * float(np.median(np.diff(time)))
    one, zero = torch.ones_like(steps), torch.zeros_like(steps)
    move = torch.stack([one, steps, zero, one], -1).unflatten(-1, (2, 2))
    spread = density * torch.stack([steps**3 / 3, steps**2 / 2, steps**2 / 2, steps], -1).unflatten(
        -1, (2, 2)
    )
    y = torch.from_numpy(np.ascontiguousarray(values.T))[..., None]  # (S, T, 1)
    start = Gaussian(
        torch.cat([y[:, 0], torch.zeros_like(y[:, 0])], -1),
        _DIFFUSE * torch.diag(torch.tensor([1.0, (2 * math.pi * cutoff) ** 2]).to(y)).expand(len(y), 2, 2),
    )
    see, noise = torch.tensor([[1.0, 0.0]]).to(y), torch.ones_like(y)[..., None]
    past = kalman_filter(start, y, move, spread, see, noise)
    return kalman_smoother(past.filtered, past.predicted.mean, move, spread).mean[..., 0].mT.numpy()


def usual_rate(time: Float[np.ndarray, " time"]) -> float:
    """Rows a second, by the median of their steps; infinite where there is none."""
    return 1 / float(np.median(np.diff(time))) if len(time) > 1 else math.inf


def stretches(answered: Bool[np.ndarray, " time"], time: Float[np.ndarray, " time"]) -> list[slice]:
    """Runs of frames that all have a pose, none missing between them."""
    late = np.diff(time) > _BREAK / usual_rate(time)
    broken = np.concatenate([[True], late | ~answered[1:] | ~answered[:-1]])
    starts = np.flatnonzero(broken)
    runs = zip(starts, [*starts[1:], len(time)], strict=True) if len(time) else ()
    return [slice(int(start), int(stop)) for start, stop in runs if answered[start]]


def filter_sequence(
    sequence: PoseSequence,
    kind: FilterKind,
    cutoff: float = 6.0,
    order: int = 4,
    min_cutoff: float = 1.0,
    beta: float = 2.0,
    speed_cutoff: float = 1.0,
) -> PoseSequence:
    """Positions, angles and pose smoothed over time, within each stretch of frames with a pose and never across gaps.

    Angles are followed past 180 degrees while they are smoothed. What is too short for the filter is left as it is,
    and so are standard deviations, distances and statuses.

    Args:
        kind: `none` gives the sequence without stale numbers, as all others do.
        cutoff: Hz, of `butterworth` and `rts`.
        order: of `butterworth`, both passes together.
        min_cutoff: Hz; with `beta` and `speed_cutoff` those of `one_euro`, where speeds are in m/s and rad/s.

    Raises:
        ValueError: as `butterworth` does.
    """
    clean = sequence.without_stale_numbers()
    if kind is FilterKind.none:
        return clean
    time = clean.time_s.numpy()
    rate = usual_rate(time)

    def smooth(values: Series, moments: np.ndarray) -> Series:
        if len(values) < 2:
            return values
        if kind is FilterKind.butterworth:
            return butterworth(values, rate, cutoff, order)
        if kind is FilterKind.one_euro:
            return one_euro(values, moments, min_cutoff, beta, speed_cutoff)
        return smooth_rts(values, moments, cutoff)

    runs = stretches(np.array(clean.answered, dtype=bool), time)
    return replace(
        clean,
        joints=_each(clean.joints.flatten(1), time, runs, smooth).unflatten(1, clean.joints.shape[1:]),
        angles=_each(clean.angles, time, runs, smooth, turning=slice(None)),
        limb_angles=_each(clean.limb_angles, time, runs, smooth),
        pose=None if clean.pose is None else _each(clean.pose, time, runs, smooth, turning=ROOT_TURNS),
    )


def _each(
    values: Float[Tensor, "time series"],
    time: np.ndarray,
    runs: list[slice],
    smooth: Callable[[Series, np.ndarray], Series],
    turning: slice = slice(0),
) -> Float[Tensor, "time series"]:
    """Each stretch smoothed, for itself; those of `turning` go round the circle."""
    smoothed = values.numpy().copy()
    circular = np.zeros(values.shape[1], dtype=bool)
    circular[turning] = True
    for run in runs:
        known = np.isfinite(smoothed[run]).all(0)  # a series with a hole is left as it is
        part = smoothed[run][:, known]
        turns = circular[known]
        part[:, turns] = np.unwrap(part[:, turns], axis=0)
        part = smooth(part, time[run])
        part[:, turns] = math.pi - np.remainder(math.pi - part[:, turns], 2 * math.pi)  # (-pi, pi]
        smoothed[run, known] = part
    return torch.from_numpy(smoothed)


def _sections(order: int, cutoff: float) -> list[tuple[float, float, float, float, float]]:
    """b0, b1, b2, a1, a2 of a Butterworth low pass; `cutoff` in cycles a sample, by the bilinear transform.

    Pairs of poles at the angles of the analogue filter, then the one on the axis if the order is odd.
    """
    k = math.tan(math.pi * cutoff)
    sections = []
    for pair in range(order // 2):
        damping = 2 * math.sin(math.pi * (2 * pair + 1) / (2 * order))  # 1 / Q
        norm = 1 + k * damping + k * k
        gain = k * k / norm
        sections.append((gain, 2 * gain, gain, 2 * (k * k - 1) / norm, (1 - k * damping + k * k) / norm))
    if order % 2:
        sections.append((k / (1 + k), k / (1 + k), 0.0, (k - 1) / (k + 1), 0.0))
    return sections


def _run(section: tuple[float, float, float, float, float], values: Series) -> Series:
    """One section over time, transposed direct form II, as if the first value had always been there."""
    b0, b1, b2, a1, a2 = section
    second = (b2 - a2) * values[0]
    first = (b1 - a1) * values[0] + second
    result = np.empty_like(values)
    for t, value in enumerate(values):
        result[t] = b0 * value + first
        first = b1 * value - a1 * result[t] + second
        second = b2 * value - a2 * result[t]
    return result
