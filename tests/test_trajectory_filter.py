"""Filters against SciPy, the published 1 Euro algorithm and exact Gaussian conditioning; resampling against NumPy."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy import signal
from torch.testing import assert_close

from torchpose.export import PoseSequence
from torchpose.resampling import frame_rate, longest_stretch, resample
from torchpose.trajectory_filter import (
    FilterKind,
    butterworth,
    filter_sequence,
    one_euro,
    padding,
    smooth_rts,
    stretches,
)

RATE = 20.0
NUMBERS = ("point_to_model", "joints", "angles", "angle_sd", "limb_angles", "pose")


def noise(time: int, series: int = 3) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(time, series)).cumsum(0)


def motion(time: int, rate: float = RATE, gone: tuple[int, ...] = ()) -> PoseSequence:
    """Somebody who moves at random, and is `lost` at the positions `gone`, where stale numbers stand."""
    draw = torch.Generator().manual_seed(1)
    step = torch.randn(time, 100, generator=draw, dtype=torch.float64).mul(0.05).cumsum(0)
    return PoseSequence(
        frame=torch.arange(time),
        time_s=torch.arange(time).double() / rate,
        status=tuple("lost" if t in gone else "tracked" for t in range(time)),
        point_to_model=step[:, 0].abs(),
        joints=step[:, :45].unflatten(1, (15, 3)),
        angle_names=("a", "b", "c"),
        angles=step[:, 45:48],
        angle_sd=step[:, 48:51].abs(),
        limb_angle_names=("d",),
        limb_angles=step[:, 51:52].abs(),
        pose=step[:, 60:84],
    )


def part(sequence: PoseSequence, rows: slice | list[int]) -> PoseSequence:
    names = ("angle_names", "limb_angle_names")
    fields = {}
    for field in dataclasses.fields(sequence):
        value = getattr(sequence, field.name)
        if field.name == "status":
            value = tuple(np.array(value)[rows].tolist())
        elif field.name not in names and value is not None:
            value = value[rows]
        fields[field.name] = value
    return PoseSequence(**fields)


class TestButterworth:
    @pytest.mark.parametrize("order", [2, 4, 6, 8, 10])
    @pytest.mark.parametrize("cutoff", [0.5, 3.0, 6.0, 9.5])
    def test_equals_scipy(self, order: int, cutoff: float) -> None:
        values = noise(60)
        expected = signal.filtfilt(*signal.butter(order // 2, cutoff, fs=RATE), values, axis=0)
        np.testing.assert_allclose(butterworth(values, RATE, cutoff, order), expected, atol=1e-7, rtol=1e-7)

    def test_halves_what_is_at_the_cutoff_without_delay(self) -> None:
        time = np.arange(2000)[:, None] / 100
        wave = np.cos(2 * math.pi * 6 * time)
        kept = butterworth(wave, 100.0, 6.0)[500:1500]
        np.testing.assert_allclose(kept, wave[500:1500] / 2, atol=1e-6)

    def test_what_is_too_short_is_left_as_it_is(self) -> None:
        longest = padding(4)
        np.testing.assert_array_equal(butterworth(noise(longest), RATE, 6.0), noise(longest))
        expected = signal.filtfilt(*signal.butter(2, 6.0, fs=RATE), noise(longest + 1), axis=0)
        np.testing.assert_allclose(butterworth(noise(longest + 1), RATE, 6.0), expected, atol=1e-10)

    def test_bad_input(self) -> None:
        for order in (0, 3):
            with pytest.raises(ValueError, match=f"order must be even and at least 2, .*got {order}"):
                butterworth(noise(60), RATE, 6.0, order)
        for cutoff in (0.0, 10.0):
            with pytest.raises(ValueError, match="cutoff must lie between 0 and half of 20 frames a second"):
                butterworth(noise(60), RATE, cutoff)


class LowPass:
    """As published, for one number at a time."""

    last: float | None = None

    def __call__(self, value: float, alpha: float) -> float:
        self.last = value if self.last is None else alpha * value + (1 - alpha) * self.last
        return self.last


def published_one_euro(values: np.ndarray, time: np.ndarray, lowest: float, beta: float, speed: float):
    """Casiez, Roussel, Vogel (2012), algorithm 1 and 2, line by line."""

    def alpha(rate: float, cutoff: float) -> float:
        tau, te = 1 / (2 * math.pi * cutoff), 1 / rate
        return 1 / (1 + tau / te)

    smooth, slope, result = LowPass(), LowPass(), []
    for t, value in enumerate(values.tolist()):
        rate = 1 / (time[t] - time[t - 1]) if t else 1.0
        change = 0.0 if smooth.last is None else (value - smooth.last) * rate
        followed = slope(change, alpha(rate, speed))
        result.append(smooth(value, alpha(rate, lowest + beta * abs(followed))))
    return result


def test_one_euro_is_the_published_one() -> None:
    values, time = noise(50), np.cumsum(np.random.default_rng(3).uniform(0.02, 0.08, 50))
    got = one_euro(values, time, 1.2, 0.7, 0.9)
    for series in range(values.shape[1]):
        expected = published_one_euro(values[:, series], time, 1.2, 0.7, 0.9)
        np.testing.assert_allclose(got[:, series], expected, rtol=1e-12)


class TestRts:
    def test_equals_exact_conditioning_at_uneven_times(self) -> None:
        """The posterior mean of a doubly integrated white noise, from its covariance at all times at once."""
        values, time = noise(25), np.cumsum(np.random.default_rng(3).uniform(0.03, 0.06, 25))
        turn = 2 * math.pi * 3.0
        t = time - time[0]
        s, u = np.minimum.outer(t, t), np.maximum.outer(t, t)
        prior = 1e6 * (1 + turn**2 * np.outer(t, t)) + turn**4 * np.median(np.diff(t)) * (
            s**2 * u / 2 - s**3 / 6
        )
        mean = values[:1]
        expected = mean + prior @ np.linalg.solve(prior + np.eye(25), values - mean)
        np.testing.assert_allclose(smooth_rts(values, time, 3.0), expected, atol=2e-5)

    def test_halves_what_is_at_the_cutoff_without_delay(self) -> None:
        time = np.arange(300) / 100
        wave = np.cos(2 * math.pi * 4 * time)[:, None]
        kept = smooth_rts(wave, time, 4.0)[100:200]
        np.testing.assert_allclose(kept, wave[100:200] / 2, atol=5e-3)

    def test_a_straight_line_stays(self) -> None:
        time = np.arange(30) / RATE
        line = np.stack([2 + 3 * time, -time], 1)
        np.testing.assert_allclose(smooth_rts(line, time, 2.0), line, atol=1e-4)
        np.testing.assert_array_equal(smooth_rts(line[:1], time[:1], 2.0), line[:1])


class TestSequence:
    @pytest.mark.parametrize("kind", list(FilterKind))
    def test_each_stretch_for_itself(self, kind: FilterKind) -> None:
        """Lost frames, and frames that were dropped altogether, divide it."""
        rows = [t for t in range(70) if t not in (40, 41)]
        sequence = part(motion(70, gone=(20,)), rows)
        got = filter_sequence(sequence, kind, cutoff=4.0)
        for run in (slice(0, 20), slice(21, 40), slice(40, 68)):
            alone = filter_sequence(part(sequence, run), kind, cutoff=4.0)
            for name in NUMBERS:
                assert_close(getattr(part(got, run), name), getattr(alone, name), atol=1e-12, rtol=0)
        assert got.status == sequence.status
        assert bool(got.joints[20].isnan().all())
        assert bool(got.angles[20].isnan().all())

    def test_columns_are_those_that_the_filter_gives(self) -> None:
        sequence = motion(50)
        got = filter_sequence(sequence, FilterKind.butterworth, cutoff=3.0)
        tools = signal.butter(2, 3.0, fs=RATE)
        for name in ("joints", "angles", "limb_angles", "pose"):
            expected = signal.filtfilt(*tools, getattr(sequence, name).numpy(), axis=0)
            np.testing.assert_allclose(getattr(got, name).numpy(), expected, atol=1e-9)
        for name in ("angle_sd", "point_to_model", "time_s"):
            assert torch.equal(getattr(got, name), getattr(sequence, name))

    def test_none_changes_nothing_but_stale_numbers(self) -> None:
        sequence = motion(10, gone=(4,))
        got, clean = filter_sequence(sequence, FilterKind.none), sequence.without_stale_numbers()
        for name in NUMBERS:
            assert_close(getattr(got, name), getattr(clean, name), equal_nan=True, atol=0, rtol=0)

    @pytest.mark.parametrize("kind", [FilterKind.butterworth, FilterKind.one_euro, FilterKind.rts])
    def test_an_angle_goes_round_the_circle_without_a_jump(self, kind: FilterKind) -> None:
        sequence, ramp = motion(60), torch.linspace(2.0, 5.0, 60, dtype=torch.float64)
        wrapped = torch.remainder(ramp + math.pi, 2 * math.pi) - math.pi
        angles, pose = sequence.angles.clone(), sequence.pose.clone()
        angles[:, 1], pose[:, 3] = wrapped, wrapped
        got = filter_sequence(dataclasses.replace(sequence, angles=angles, pose=pose), kind)
        lag = 0.2 if kind is FilterKind.one_euro else 1e-3
        for column in (got.angles[:, 1], got.pose[:, 3]):
            gap = torch.remainder(column - ramp + math.pi, 2 * math.pi) - math.pi
            assert gap.abs().max() < lag
            assert column.abs().max() <= math.pi

    def test_a_column_with_a_hole_and_a_missing_pose_are_left(self) -> None:
        sequence = motion(40)
        joints = sequence.joints.clone()
        joints[7, 3] = torch.nan
        got = filter_sequence(dataclasses.replace(sequence, joints=joints, pose=None), FilterKind.butterworth)
        assert_close(got.joints[:, 3], joints[:, 3], equal_nan=True, atol=0, rtol=0)
        assert not torch.equal(got.joints[:, 4], joints[:, 4])
        assert got.pose is None

    def test_stretches(self) -> None:
        time = np.array([0, 1, 2, 5, 6, 7, 8]) / 10
        assert stretches(np.ones(7, dtype=bool), time) == [slice(0, 3), slice(3, 7)]
        assert stretches(np.array([0, 1, 1, 1, 0, 0, 1], dtype=bool), time) == [
            slice(1, 3),
            slice(3, 4),
            slice(6, 7),
        ]
        assert stretches(np.zeros(0, dtype=bool), time[:0]) == []


class TestResampling:
    def test_an_even_sequence_stays(self) -> None:
        sequence = motion(30, gone=(11,))
        got, clean = resample(sequence, RATE), sequence.without_stale_numbers()
        assert got.status == sequence.status
        assert torch.equal(got.frame, sequence.frame)
        for name in NUMBERS:
            assert_close(getattr(got, name), getattr(clean, name), equal_nan=True, atol=0, rtol=0)

    def test_short_gaps_are_bridged_and_long_ones_are_not(self) -> None:
        sequence = part(motion(30, gone=(4, 5)), [t for t in range(30) if t not in (10, 20, 21, 22, 23, 24)])
        got = resample(sequence, RATE, gap=0.16)
        assert torch.equal(got.frame, torch.arange(30))
        missing = [t for t, status in enumerate(got.status) if status == "lost"]
        assert missing == [20, 21, 22, 23, 24]
        known = np.array(sequence.answered)
        time = sequence.time_s.numpy()[known]
        for name in ("joints", "angles", "pose"):
            values = getattr(sequence, name).flatten(1).numpy()[known]
            for column in range(values.shape[1]):
                expected = np.interp(np.arange(30) / RATE, time, values[:, column])
                expected[missing] = np.nan
                np.testing.assert_allclose(
                    getattr(got, name).flatten(1)[:, column].numpy(), expected, atol=1e-12
                )
        assert [t for t, s in enumerate(resample(sequence, RATE).status) if s == "lost"] == [
            4,
            5,
            10,
            *missing,
        ]

    def test_uneven_times_are_interpolated(self) -> None:
        sequence = motion(20)
        uneven = sequence.time_s + 0.3 / RATE * torch.sin(torch.arange(20.0).double())
        got = resample(dataclasses.replace(sequence, time_s=uneven), RATE)
        moments = uneven[0].item() + np.arange(len(got)) / RATE
        inside = moments <= uneven[-1].item()
        expected = np.interp(moments, uneven.numpy(), sequence.angles[:, 0].numpy())
        np.testing.assert_allclose(got.angles[:, 0].numpy()[inside], expected[inside], atol=1e-3)

    def test_angles_take_the_short_way_round(self) -> None:
        sequence = motion(3, gone=(1,))
        angles, pose = sequence.angles.clone(), sequence.pose.clone()
        for column in (angles[:, 0], pose[:, 3]):
            column[0], column[2] = 3.0, -3.0
        got = resample(dataclasses.replace(sequence, angles=angles, pose=pose), RATE, gap=0.2)
        assert_close(got.angles[1, 0].cos(), torch.tensor(-1.0).double())
        assert_close(got.pose[1, 3].cos(), torch.tensor(-1.0).double())

    def test_nobody_and_nothing(self) -> None:
        assert resample(motion(5, gone=(0, 1, 2, 3, 4)), RATE).status == ("lost",) * 5
        assert len(resample(part(motion(5), slice(0, 0)), RATE)) == 0

    def test_every_other_frame_is_half_the_rate(self) -> None:
        sequence = part(motion(40), [t for t in range(0, 40, 2) if t != 10])
        assert frame_rate(sequence) == RATE / 2
        got = resample(sequence, frame_rate(sequence))
        assert got.frame.tolist() == list(range(0, 40, 2))
        assert [t for t, status in zip(got.frame.tolist(), got.status, strict=True) if status == "lost"] == [
            10
        ]

    def test_the_rate_counts_dropped_frames(self) -> None:
        assert frame_rate(part(motion(30, rate=15.0), [0, 3, 4, 5, 29])) == 15.0
        assert frame_rate(part(motion(5), slice(2, 3))) == 30.0
        with pytest.raises(ValueError, match="time_s and frame must increase from row to row"):
            frame_rate(part(motion(5), [0, 2, 1]))

    def test_longest_stretch(self) -> None:
        assert longest_stretch((False, True, True, False, True, True, True)) == slice(4, 7)
        assert longest_stretch((True, False, True)) == slice(0, 1)
        assert longest_stretch((False,)) == slice(0, 0)
