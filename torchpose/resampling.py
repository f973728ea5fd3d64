"""A motion at a constant frame rate, for the file formats that know no other."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchpose.export import EMPTY_STATUSES, PoseSequence
from torchpose.trajectory_filter import ROOT_TURNS

_ALONE = 30.0  # Hz, said of a single frame
_ON_TIME = 1e-3  # frames; what is nearer to a frame's time is that frame
_NEIGHBOURS = 1.5  # frames; what is nearer to each other has no gap between


def frame_rate(sequence: PoseSequence) -> float:
    """Frames a second, by the frames' numbers and their usual step, so dropped ones count; 30 where there is one frame.

    Raises ValueError where time does not go on.
    """
    if len(sequence) < 2:
        return _ALONE
    frame, time = sequence.frame.double().cpu(), sequence.time_s.double().cpu()
    if not bool((time.diff() > 0).all() and (frame.diff() > 0).all()):
        raise ValueError(
            "time_s and frame must increase from row to row; sort the sequence, and give each frame once"
        )
    return round(float((frame[-1] - frame[0]) / (time[-1] - time[0])) / _step(sequence), 3)


def _step(sequence: PoseSequence) -> int:
    """By how much a frame's number usually exceeds the one before: 2 where every other image was kept."""
    return int(sequence.frame.diff().median()) if len(sequence) > 1 else 1


def resample(sequence: PoseSequence, rate: float, gap: float = 0.0) -> PoseSequence:
    """The sequence at `rate` Hz, from its first frame on; every moment between two frames by straight lines.

    Args:
        gap: s; where two frames with a pose are no further apart than that, what is missing between them is
            interpolated (yaw, pitch and roll the short way round). Neighbours have no gap between.

    Returns:
        A sequence without stale numbers, numbered on from the first frame by the usual step. A moment in a longer gap
        is `lost`; others have the status of the nearest frame with a pose.
    """
    clean = sequence.without_stale_numbers()
    time, answered = clean.time_s, torch.tensor(clean.answered, dtype=torch.bool)
    if not len(clean):
        return clean
    count = round(float((time[-1] - time[0]) * rate)) + 1
    moment = time[0] + torch.arange(count, dtype=torch.float64) / rate
    known = answered.nonzero()[:, 0]
    if not len(known):
        left = right = torch.zeros(count, dtype=torch.int64)
        there, share = torch.zeros(count, dtype=torch.bool), torch.zeros(count, dtype=torch.float64)
    else:
        late = torch.searchsorted(time[known], moment - _ON_TIME / rate)
        exact = (late < len(known)) & (
            (time[known[late.clamp_max(len(known) - 1)]] - moment).abs() <= _ON_TIME / rate
        )
        right = known[late.clamp_max(len(known) - 1)]
        left = torch.where(exact, right, known[(late - 1).clamp_min(0)])
        span = time[right] - time[left]
        inside = (late > 0) & (late < len(known)) & (span <= max(gap, _NEIGHBOURS / rate) + _ON_TIME / rate)
        there = exact | inside
        share = torch.where(exact | ~inside, 0.0, (moment - time[left]) / span.clamp_min(1e-9))

    def between(values: Tensor, turning: slice = slice(0)) -> Tensor:
        change = values[right] - values[left]
        change[:, turning] = torch.pi - torch.remainder(torch.pi - change[:, turning], 2 * torch.pi)
        weight = share.view(-1, *[1] * (values.ndim - 1))
        mixed = torch.where(weight == 0, values[left], values[left] + weight * change)
        return mixed.masked_fill(~there.view(weight.shape), torch.nan)

    nearest = torch.where(share < 0.5, left, right).tolist()
    return replace(
        clean,
        frame=clean.frame[0] + _step(clean) * torch.arange(count),
        time_s=moment,
        status=tuple(
            clean.status[row] if known_here else EMPTY_STATUSES[-1]
            for row, known_here in zip(nearest, there.tolist(), strict=True)
        ),
        point_to_model=between(clean.point_to_model[:, None])[:, 0],
        joints=between(clean.joints),
        angles=between(clean.angles, slice(None)),
        angle_sd=between(clean.angle_sd),
        limb_angles=between(clean.limb_angles),
        pose=None if clean.pose is None else between(clean.pose, ROOT_TURNS),
        pose_covariance=None if clean.pose_covariance is None else between(clean.pose_covariance),
    )


def longest_stretch(answered: tuple[bool, ...]) -> slice:
    """The longest run of frames with a pose, the first of such; empty where there is none."""
    edges = np.flatnonzero(
        np.diff(np.concatenate([[False], np.array(answered, dtype=bool), [False]]).astype(np.int8))
    )
    runs = edges.reshape(-1, 2)
    if not len(runs):
        return slice(0, 0)
    start, stop = runs[np.argmax(runs[:, 1] - runs[:, 0])].tolist()
    return slice(start, stop)
