"""Segments of a long sequence: Viterbi over chained models with explicit durations, a hidden semi-Markov model.

A segment has a label; inside it that label's own HMM runs, and from a duration of d frames it is left with the label's
hazard p(d | at least d). `Segmenter` takes frames as they come, and gives its answers when the recording is over (the
most probable segments of all) or a fixed number of frames later (the most probable ones that go on from what was
answered before).

Letters: T time, L labels, K states, D ages. Log-probabilities are in nats.
"""

from collections import deque
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.activity.inference import band_cells, possible_moves


@dataclass(frozen=True)
class Chain:
    """Labels that follow one another, each with a distribution of durations and an HMM of its own."""

    log_start: Float[Tensor, " labels"]  # log p(first label)
    log_change: Float[Tensor, "labels labels"]  # log p(next label | this one); the diagonal is minus infinity
    # log p(duration = d | it is d or more) for d = 1 ... D frames; the last holds for all that are longer.
    log_leave: Float[Tensor, "labels ages"]
    log_initial: Float[Tensor, "labels states"]  # log p(first state of a segment)
    log_transition: Float[Tensor, "labels states states"]

    def __post_init__(self) -> None:
        if not torch.isneginf(self.log_change.diagonal()).all():
            raise ValueError(
                "a label must not follow itself, as two such segments are one, got a log_change that is finite "
                "on its diagonal; set it to minus infinity"
            )


@dataclass(frozen=True)
class Segment:
    """Frames of one label."""

    start: int  # its first frame
    end: int  # the frame behind its last one
    label: int
    log_likelihood: Float[Tensor, " labels"]  # of these frames under each label's HMM


def log_normal_hazard(
    shortest: Int[Tensor, " labels"],
    typical: Float[Tensor, " labels"],
    spread: Float[Tensor, " labels"],
    ages: int,
) -> Float[Tensor, "labels ages"]:
    """log p(duration = d | d or more), d = 1 ... `ages` frames, of log-normal durations that are `shortest` or more.

    `typical` is the median in frames, `spread` the standard deviation of the logarithm, both before the cut.
    """
    age = torch.arange(1, ages + 2, device=typical.device, dtype=typical.dtype)
    # A duration of d frames is one of d - 1/2 to d + 1/2.
    log_reach = torch.special.log_ndtr(
        (typical.log()[:, None] - (age - 0.5).log()) / spread[:, None]
    )  # log P(duration >= d)
    log_stay = log_reach.diff(dim=1)
    log_stay = torch.where(age[:-1] < shortest[:, None], 0.0, log_stay)
    return (-torch.expm1(log_stay)).log()


class Segmenter:
    """The most probable segments of frames that come one after the other.

    Args:
        chain: labels, durations and models.
        lag: frames after which a frame's label is settled; 0 settles it at once, None when all is over. What is
            settled binds: later answers are the best of those that agree with it, so no segment is shorter than
            the durations allow. With a lag as long as the sequence the answer is that of None.
    """

    def __init__(self, chain: Chain, lag: int | None = None) -> None:
        if lag is not None and lag < 0:
            raise ValueError(f"lag must be 0 or more frames, got {lag}; None answers when all is over")
        self.chain, self.lag = chain, lag
        labels, ages = chain.log_leave.shape
        # A segment that reaches into what is settled must be of the last age at most, which knows its start.
        missing = max(2, 0 if lag is None else lag + 1) - ages
        leave = torch.cat(
            [chain.log_leave, chain.log_leave[:, -1:].expand(-1, max(missing, 0))], dim=1
        ).unsqueeze(2)
        self._leave, self._stay = leave, torch.log(-torch.expm1(leave))
        transition = chain.log_transition.permute(1, 2, 0)
        self._offsets = possible_moves(transition)
        bands = transition[band_cells(self._offsets, len(transition), transition.device)]
        self._bands = bands.permute(0, 2, 1).unsqueeze(2).contiguous()  # (D, L, 1, K)
        self._label = torch.arange(labels, device=leave.device)
        self._score = leave.new_full((labels, leave.shape[1], chain.log_initial.shape[1]), -torch.inf)
        self._oldest = self._label.new_zeros(
            labels, self._score.shape[2]
        )  # start of the segments of the last age
        self._time = 0  # frames that came
        self._settled = 0  # frames whose label is known
        # Of each frame that is not settled: its emission, and of a segment of each label that starts there the label
        # before it and the start of that.
        self._frames: deque[tuple[Tensor, Tensor, Tensor]] = deque()
        self._open: tuple[int, int, Tensor] | None = (
            None  # the segment that is being settled: start, label, filter
        )
        self.log_probability = leave.new_zeros(())  # of the best path so far

    @torch.no_grad()
    def push(self, log_emission: Float[Tensor, "time labels states"]) -> list[Segment]:
        """Take more frames: log p(y_t | label, state), 0 where nothing was observed. Returns what segments are over."""
        done: list[Segment] = []
        for emission in log_emission.unbind():
            self._advance(emission)
            if self.lag is not None and self._time > self.lag:
                done += self._settle(self._decide())
        return done

    @torch.no_grad()
    def finish(self) -> list[Segment]:
        """The segments that are not over yet, the last of which is cut off by the end. Then there is nothing left."""
        if self._time == 0:
            return []
        done = []
        label, start = self._best()
        labels: list[int] = []
        end = self._time
        while end > self._settled:
            first = max(start, self._settled)
            labels[:0] = [label] * (end - first)
            end = first
            if start > self._settled:
                _, before, began = self._frames[start - self._settled]
                label, start = int(before[label]), int(began[label])
        for settled in labels:
            done += self._settle(settled)
        if self._open is not None:
            done.append(self._close(*self._open))
            self._open = None
        return done

    def _advance(self, emission: Float[Tensor, "labels states"]) -> None:
        chain, time, last = self.chain, self._time, self._score.shape[1] - 1
        score = torch.full_like(self._score, -torch.inf)
        if time == 0:
            score[:, 0] = chain.log_start[:, None] + chain.log_initial
            before = began = torch.full_like(self._label, -1)
        else:
            out, cell = (self._score + self._leave).flatten(1).max(1)
            age, state = cell // self._score.shape[2], cell % self._score.shape[2]
            start = torch.where(age == last, self._oldest[self._label, state], time - 1 - age)
            enter, before = (out[:, None] + chain.log_change).max(0)
            began = start[before]
            score[:, 0] = enter[:, None] + chain.log_initial
            staying = self._score + self._stay
            moved = torch.stack(
                [
                    (staying + band).roll(offset, 2) if offset else staying + band
                    for offset, band in zip(self._offsets, self._bands.unbind(), strict=True)
                ]
            ).amax(0)
            # Whoever has the last age keeps it, and remembers when it began.
            longer, origin = (staying[:, last, :, None] + chain.log_transition).max(1)
            score[:, 1:] = moved[:, :-1]
            older = longer > score[:, last]
            score[:, last] = torch.where(older, longer, score[:, last])
            self._oldest = torch.where(older, self._oldest.gather(1, origin), time - last)
        self._score = score.add_(emission[:, None])
        self._frames.append((emission, before, began))
        self._time += 1

    def _best(self) -> tuple[int, int]:
        """Label and start of the last segment of the most probable path."""
        self.log_probability, cell = self._score.flatten().max(0)
        if torch.isneginf(self.log_probability):
            raise ValueError(
                f"frame {self._time - 1} must be possible under some label, got probability zero under all; "
                "train with emission_prior above 1"
            )
        _, ages, states = self._score.shape
        label, age, state = int(cell) // (ages * states), int(cell) // states % ages, int(cell) % states
        return label, int(self._oldest[label, state]) if age == ages - 1 else self._time - 1 - age

    def _decide(self) -> int:
        """The label of the first frame that is not settled in the most probable path; paths that differ there end."""
        assert self.lag is not None
        label, start = self._best()
        young = self._labels_before()
        decided = label if start <= self._settled else int(young[start - self._settled - 1, label])
        # The last cell is of age lag + 1 or more: of a segment that was there already.
        if self.lag > 0:
            other = (young != decided).flip(0).T  # (L, lag): by age
            self._score[:, : self.lag][other] = -torch.inf
        self._score[self._label != decided, self.lag :] = -torch.inf
        return decided

    def _labels_before(self) -> Int[Tensor, "lag labels"]:
        """Which label the first frame that is not settled has, if a segment of each label starts at each later one."""
        waiting = list(self._frames)[1:]
        if not waiting:
            return self._label[None, :][:0]
        label = torch.stack([before for _, before, _ in waiting])
        # Place of the start of the segment before in these lists; negative for one that holds the frame asked for.
        place = torch.stack([began for _, _, began in waiting]) - (self._settled + 1)
        while bool((place >= 0).any()):
            at = place.clamp(min=0)
            label, place = (
                torch.where(place >= 0, label[at, label], label),
                torch.where(place >= 0, place[at, label], place),
            )
        return label

    def _settle(self, label: int) -> list[Segment]:
        """The label of the next frame; returns the segment that ends before it."""
        emission, _, _ = self._frames.popleft()
        done = []
        if self._open is not None and self._open[1] != label:
            done.append(self._close(*self._open))
            self._open = None
        if self._open is None:
            self._open = (self._settled, label, self.chain.log_initial + emission)
        else:
            start, _, joint = self._open
            predicted = torch.logsumexp(joint[:, :, None] + self.chain.log_transition, dim=1)
            self._open = (start, label, predicted + emission)
        self._settled += 1
        return done

    def _close(self, start: int, label: int, joint: Float[Tensor, "labels states"]) -> Segment:
        return Segment(start, self._settled, label, torch.logsumexp(joint, dim=1))


def segment_frames(
    chain: Chain, log_emission: Float[Tensor, "time labels states"], lag: int | None = None
) -> list[Segment]:
    """The segments of a whole sequence."""
    segmenter = Segmenter(chain, lag)
    return segmenter.push(log_emission) + segmenter.finish()
