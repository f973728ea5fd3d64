"""The diary (T. 6.2.2): which activity when, from a continuous recording of any length.

The recogniser's activity models are chained with explicit durations and three models more: a `pause`, in which the
person shows what all activities have in common, standing at ease; `other`, symbols in no order or far from all that was
learned; and `unseen`, nobody there. Several members of a recogniser are averaged state by state: their states are the
same shares of the same sequences. The layer is left out, as it weighs whole sequences.

Letters: T time, L labels, K states, R streams, V symbols. Seconds; log-probabilities in nats.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.activity.baum_welch import MISSING, Topology
from torchpose.activity.codebook import Codebook
from torchpose.activity.dataset import Clip
from torchpose.activity.features import Stream
from torchpose.activity.recognizer import Member, Recognizer, Symbols
from torchpose.activity.segmenter import Chain, Segment, Segmenter, log_normal_hazard

PAUSE, OTHER, UNSEEN = "pause", "other", "unseen"


@dataclass(frozen=True)
class DiaryConfig:
    """How activities follow one another, and how much a frame says."""

    # Hz, at which the recogniser's sequences were recorded; the poses are taken at this rate, whatever their own.
    frame_rate: float = 10.0
    delay: float | None = 3.0  # s after which an activity is settled; null: when the recording is over
    shortest: float = 1.0  # s, of activities and pauses
    typical: float = 8.0  # s, median of their durations
    spread: float = 1.0  # standard deviation of the durations' logarithm: 1 is a factor of 2.7
    counted: float = 30.0  # s up to which durations are told apart; longer ones end at a constant rate
    longest_gap: float = 2.0  # s for which a person may be lost within an activity; longer is `unseen`
    lost: float = 0.05  # share of the frames in which a person who is there is lost
    # Frames close to one another err alike: so many a second count as independent.
    evidence: float = 4.0
    other_width: float = 2.0  # how much further from what was learned `other` is thought to be; 1: no further
    other_margin: float = 10.0  # nats by which `other` must explain a frame better than an activity does
    # The activity of the recogniser that is the pause; null: what all activities have in common.
    pause: str | None = None

    def __post_init__(self) -> None:
        for name in ("frame_rate", "shortest", "typical", "spread", "counted", "longest_gap", "evidence"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} of the diary must be positive, got {getattr(self, name)}")
        if self.delay is not None and self.delay < 0:
            raise ValueError(f"delay of the diary must not be negative, got {self.delay}")
        if not 0 < self.lost < 1:
            raise ValueError(f"lost must be a share between 0 and 1, got {self.lost}; 0.05 is the default")
        if not self.other_width >= 1:
            raise ValueError(f"other_width must be 1 or more, got {self.other_width}; 2 is the default")


@dataclass(frozen=True)
class Entry:
    """A person did something for a while."""

    start_s: float
    end_s: float
    activity: str
    # Of the activity's model over the next best, nats per frame; NaN where nobody was seen.
    log_odds: float

    def __post_init__(self) -> None:
        if not self.start_s < self.end_s:
            raise ValueError(f"an entry must end after its start, got {self.start_s} to {self.end_s} s")


class Diary:
    """A recogniser's models, chained. `Diary(recognizer).write(clip, time_s)` is all that a whole recording needs."""

    def __init__(self, recognizer: Recognizer, config: DiaryConfig = DiaryConfig()) -> None:
        features = recognizer.config.feature
        if Stream.travel in features.streams:
            raise ValueError(
                "a diary needs streams that know no beginning, got travel, the way since the first frame; train the "
                "recogniser without it"
            )
        if config.pause is not None and config.pause not in recognizer.activities:
            raise ValueError(
                f"pause must be an activity of the recogniser, {', '.join(recognizer.activities)}, got "
                f"{config.pause!r}; null takes what they have in common"
            )
        self.recognizer, self.config = recognizer, config
        self.members = [member for member in recognizer.members if isinstance(member, Member)]
        own = (PAUSE,) if config.pause is None else ()
        self.labels = (*recognizer.activities, *own, OTHER, UNSEEN)
        self.chain = self._chain()

    def write(self, clip: Clip, time_s: Float[Tensor, " time"] | None = None) -> list[Entry]:
        """All entries of a recording. `time_s` are its frames' times, in order; none are at `frame_rate`."""
        live = LiveDiary(self)
        return live.push(clip, time_s) + live.finish()

    def log_emission(self, clip: Clip) -> Float[Tensor, "time labels states"]:
        """log p(frame | label, state), tempered by `evidence`, of a clip at `frame_rate`; a lost frame only says so."""
        config = self.config
        rows = self.recognizer.feature(clip)
        deviations = [self.recognizer.feature.deviation(clip)] if self.recognizer.config.certainty else None
        of_members, seen = [], torch.zeros(len(clip), dtype=torch.bool, device=rows[0].device)
        for member in self.members:
            symbols = member.encode([rows], deviations)
            of_members.append(self._of_member(member, rows, symbols))
            seen |= symbols.seen[0]
        tempering = min(1.0, config.evidence / config.frame_rate)
        there = torch.stack(of_members).mean(0) * tempering
        there = torch.where(seen[:, None, None], there, math.log(config.lost))
        absent = torch.where(seen, -torch.inf, 0.0).to(there)[:, None, None].expand(-1, 1, there.shape[2])
        return torch.cat([there, absent], dim=1)

    def _of_member(
        self, member: Member, rows: Sequence[Tensor], symbols: Symbols
    ) -> Float[Tensor, "time labels states"]:
        """log p(frame | label, state) under a member's codebooks and models, for all labels but `unseen`."""
        own, values = member.hmm.log_emission, symbols.values[0]  # (L, R, K, V), (T, R)
        tables = [own]
        if self.config.pause is None:
            tables.append(_in_common(own)[None, :, None].expand(-1, -1, own.shape[2], -1))
        other = member.log_background - self.config.other_margin / values.shape[1]
        tables.append(other[None, :, None].expand(-1, -1, own.shape[2], -1))
        table = torch.cat(tables).permute(1, 3, 0, 2)  # (R, V, L, K)
        found = table[torch.arange(len(table), device=values.device), values.clamp(min=0)]  # (T, R, L, K)
        found[:, :, -1] += self._novelty(member, rows, values)[..., None].to(found)
        certain = (values != MISSING).to(found)
        if symbols.weights is not None:
            certain = certain * symbols.weights[0]
        return (found * certain[..., None, None]).sum(1)

    def _novelty(
        self, member: Member, rows: Sequence[Tensor], symbols: Int[Tensor, "time streams"]
    ) -> Float[Tensor, "time streams"]:
        """How much better a wider Gaussian about its code vector explains what was quantised, nats.

        The codebook names the nearest code vector for whatever comes; what is far from all was not learned. Each
        stream's distances are taken as of `distortion`, or, for `other`, `other_width` times as far.
        """
        narrow = 1 - self.config.other_width**-2
        found = []
        for row, symbol, codebook in zip(rows, symbols.unbind(1), member.codebooks, strict=True):
            assert isinstance(codebook, Codebook)
            away = ((row - codebook.mean) / codebook.scale - codebook.centers[symbol]).square().sum(1)
            share = away / codebook.distortion.clamp(min=torch.finfo(away.dtype).tiny)
            bonus = row.shape[1] * (share * narrow / 2 - math.log(self.config.other_width))
            found.append(bonus.nan_to_num(nan=0.0))
        return torch.stack(found, dim=1)

    def _chain(self) -> Chain:
        hmm, config = self.members[0].hmm, self.config
        extra, states = len(self.labels) - hmm.num_models, hmm.config.states
        like = hmm.log_initial
        # A segment may begin anywhere in an activity that repeats itself.
        inner = torch.stack([member.hmm.log_transition.exp() for member in self.members]).mean(0).log()
        if hmm.config.topology is Topology.left_to_right and states > 1:
            inner = _closed(inner)
        # The models without states of their own stay in the first one.
        initial = like.new_full((len(self.labels), states), -math.log(states))
        initial[hmm.num_models :] = -torch.inf
        initial[hmm.num_models :, 0] = 0
        resting = torch.eye(states, device=like.device, dtype=like.dtype).log().expand(extra, -1, -1)
        labels = len(self.labels)
        change = like.new_full((labels, labels), -math.log(labels - 1)).fill_diagonal_(-torch.inf)
        shortest = torch.full((labels,), round(config.shortest * config.frame_rate), device=like.device)
        shortest[-1] = round(config.longest_gap * config.frame_rate)
        leave = log_normal_hazard(
            shortest,
            like.new_full((labels,), config.typical * config.frame_rate),
            like.new_full((labels,), config.spread),
            math.ceil(config.counted * config.frame_rate),
        )
        start = like.new_full((labels,), -math.log(labels))
        return Chain(start, change, leave, initial, torch.cat([inner, resting]))

    def entry(self, segment: Segment, start_s: float) -> Entry:
        """A segment as the diary has it; its first frame is counted from `start_s`."""
        rate, seen = self.config.frame_rate, self.labels[:-1]
        label, frames = segment.label, segment.end - segment.start
        odds = math.nan
        if label < len(seen):
            # What was taken off by tempering is put back: nats per frame, as the recogniser's.
            rest = segment.log_likelihood[: len(seen)].clone()
            own = float(rest[label])
            rest[label] = -torch.inf
            odds = (own - float(rest.max())) / frames / min(1.0, self.config.evidence / rate)
        return Entry(start_s + segment.start / rate, start_s + segment.end / rate, self.labels[label], odds)


class LiveDiary:
    """A diary that is written while the recording goes on, `config.delay` and a few frames behind it."""

    def __init__(self, diary: Diary) -> None:
        config = diary.config
        self.diary = diary
        lag = None if config.delay is None else round(config.delay * config.frame_rate)
        self._segmenter = Segmenter(diary.chain, lag)
        self._reach = diary.recognizer.config.feature.velocity_step
        self._start: float | None = None
        self._last = -math.inf  # time of the last frame that came
        self._step = 1 / config.frame_rate  # s, between the frames that came
        self._source: Clip | None = None  # what came and is still needed
        self._times: Tensor | None = None
        self._taken = 0  # frames at the diary's rate
        self._kept: Clip | None = None  # the last of them, with what the next changes need
        self._done = 0  # frames whose emission the segmenter has

    def push(self, clip: Clip, time_s: Float[Tensor, " time"] | None = None) -> list[Entry]:
        """Take the next frames; returns what is over and settled.

        Raises ValueError where a time is not after the one before it, or there is not one for each frame.
        """
        rate = self.diary.config.frame_rate
        if time_s is None:
            first = 0.0 if self._start is None else self._last + 1 / rate
            time_s = first + torch.arange(len(clip), dtype=torch.float64) / rate
        time_s = time_s.double().cpu()
        self._check(clip, time_s)
        if self._start is None:
            self._start = float(time_s[0])
        if len(time_s) > 1:
            self._step = float(time_s.diff().median())
        self._last = float(time_s[-1])
        self._source = clip if self._source is None else join_clips([self._source, clip])
        self._times = time_s if self._times is None else torch.cat([self._times, time_s])
        # The nearest frame to each moment is known when one behind it has come.
        moments = math.floor((self._last - self._start) * rate + 1e-3) + 1
        self._take(moments)
        return self._write(self._taken - self._reach)

    def finish(self) -> list[Entry]:
        """The entries that were not settled yet."""
        entries = self._write(self._taken)
        return entries + self._entries(self._segmenter.finish())

    def _check(self, clip: Clip, time_s: Tensor) -> None:
        if time_s.shape != (len(clip),):
            raise ValueError(
                f"there must be a time for each of {len(clip)} frames, got {tuple(time_s.shape)}"
            )
        times = torch.cat([time_s.new_tensor([self._last]), time_s])
        wrong = (~(times.diff() > 0) | ~time_s.isfinite()).nonzero()
        if len(wrong):
            frame = int(wrong[0])
            raise ValueError(
                f"each frame must be later than the one before it, got {float(times[frame + 1]):g} s after "
                f"{float(times[frame]):g} s at row {frame}; sort the rows, or begin a new recording there"
            )

    def _take(self, moments: int) -> None:
        """Bring what came to the diary's rate, up to that many moments; a moment with no frame near is lost."""
        assert self._source is not None
        assert self._times is not None
        assert self._start is not None
        if moments <= self._taken:
            return
        rate = self.diary.config.frame_rate
        wanted = self._start + torch.arange(self._taken, moments, dtype=torch.float64) / rate
        after = torch.searchsorted(self._times, wanted).clamp(max=len(self._times) - 1)
        before = (after - 1).clamp(min=0)
        nearer = (wanted - self._times[before]) <= (self._times[after] - wanted)
        index = torch.where(nearer, before, after)
        # A recording that is slower than the diary is not full of gaps.
        lost = (self._times[index] - wanted).abs() > 0.75 * max(1 / rate, self._step)
        taken = pick_frames(self._source, index, lost)
        self._kept = taken if self._kept is None else join_clips([self._kept, taken])
        self._taken = moments
        # The next moment may be nearest to the last frame that came.
        self._source, self._times = clip_frames(self._source, len(self._times) - 1), self._times[-1:]

    def _write(self, until: int) -> list[Entry]:
        """Feed the segmenter with all frames before `until`."""
        if self._kept is None or until <= self._done:
            return []
        kept = self._kept
        emission = self.diary.log_emission(kept)
        first = self._taken - len(kept)
        segments = self._segmenter.push(emission[self._done - first : until - first])
        self._done = until
        self._kept = clip_frames(kept, max(0, until - self._reach - first))
        return self._entries(segments)

    def _entries(self, segments: Sequence[Segment]) -> list[Entry]:
        return [self.diary.entry(segment, self._start or 0.0) for segment in segments]


def _clip_tensors(clip: Clip) -> dict[str, Any]:
    return {
        field.name: value for field in fields(clip) if isinstance(value := getattr(clip, field.name), Tensor)
    }


def join_clips(clips: Sequence[Clip]) -> Clip:
    """One clip of several with the same streams, in their order."""
    parts = [_clip_tensors(clip) for clip in clips]
    if any(part.keys() != parts[0].keys() for part in parts):
        raise ValueError(
            f"clips must have the same streams to be joined, got {[', '.join(part) for part in parts]}"
        )
    joined: dict[str, Any] = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    return replace(clips[0], **joined)


def clip_frames(clip: Clip, start: int, end: int | None = None) -> Clip:
    """The frames from `start` to before `end` (none: all that follow)."""
    return replace(clip, **{name: value[start:end] for name, value in _clip_tensors(clip).items()})


def pick_frames(clip: Clip, index: Tensor, lost: Tensor) -> Clip:
    """The frames of the clip that `index` names, with those that are `lost` empty."""
    found: dict[str, Any] = {}
    for name, value in _clip_tensors(clip).items():
        rows = value[index.to(value.device)]
        gone = lost.to(value.device).view(-1, *[1] * (rows.ndim - 1))
        # A lost silhouette is an empty one.
        found[name] = rows.masked_fill(
            gone, torch.nan if rows.is_floating_point() and name != "silhouettes" else 0
        )
    return replace(clip, **found)


def _in_common(
    log_emission: Float[Tensor, "models streams states symbols"],
) -> Float[Tensor, "streams symbols"]:
    """log p(symbol) of what all activities share: the geometric mean of their shares of each symbol."""
    share = torch.logsumexp(log_emission, dim=2) - math.log(log_emission.shape[2])
    return torch.log_softmax(share.mean(0), dim=-1)


def _closed(log_transition: Float[Tensor, "models states states"]) -> Float[Tensor, "models states states"]:
    """Left-to-right models that go on from the last state to the first as fast as the others on the average."""
    stay = log_transition.diagonal(dim1=1, dim2=2).exp()
    leave = (1 - stay[:, :-1]).mean(1)
    closed = log_transition.clone()
    closed[:, -1] = -torch.inf
    closed[:, -1, -1], closed[:, -1, 0] = torch.log1p(-leave), leave.log()
    return closed
