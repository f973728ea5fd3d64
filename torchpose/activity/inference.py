"""Inference in hidden Markov models (T. App. B): filter, smoother and most probable path, for many at once.

The functions know no symbols, only `log_initial` log p(z_1), `log_transition` log p(z_t+1 | z_t) (rows sum to
one) and `log_emission` log p(y_t | z_t), looked up already. Log-probabilities are in nats. A frame without an
observation has `log_emission` 0 in every state, which marginalises it. So has the padding behind a shorter
sequence: the likelihood of the padded sequence is that of the sequence itself.

The functions named `hmm_` stay in the log domain: on a long sequence a left-to-right model leaves the range
of scaled probabilities. `likelihood_ratio` and `ForwardBackward` take plain probabilities, which is several
times faster, and `exact_above` tells from their result where that was exact. The recursions run over the
*bands* of the transition matrix, the moves by d states, that are possible at all: two for a left-to-right model
of any size. Letters: T time, K states, D bands.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import reduce

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

PADDING = -1  # the state of a frame behind the sequence's end


@dataclass(frozen=True)
class Filtered:
    """What the past tells of the present."""

    log_likelihood: Float[Tensor, "*batch"]  # log p(y_1:T)
    log_filtered: Float[Tensor, "*batch time states"]  # log p(z_t | y_1:t)


@dataclass(frozen=True)
class Smoothed:
    """What the whole sequence tells of each moment. All zero where the sequence has probability zero."""

    log_likelihood: Float[Tensor, "*batch"]  # log p(y_1:T)
    states: Float[Tensor, "*batch time states"]  # p(z_t | y_1:T)
    pairs: Float[Tensor, "*batch steps states states"]  # p(z_t, z_t+1 | y_1:T), T - 1 steps


@dataclass(frozen=True)
class Decoded:
    """The most probable path."""

    log_probability: Float[Tensor, "*batch"]  # log p(z, y) of that path
    states: Int[Tensor, "*batch time"]  # -1 on padding


def possible_moves(log_transition: Float[Tensor, "states states *batch"]) -> tuple[int, ...]:
    """The steps d, modulo K, for which some state i may move to i + d: (0, 1) for a left-to-right model."""
    states = len(log_transition)
    cells = band_cells(tuple(range(states)), states, log_transition.device)
    possible = ~torch.isneginf(log_transition[cells]).flatten(1).all(1)
    return tuple(offset for offset, allowed in enumerate(possible.tolist()) if allowed) or (0,)


def band_cells(offsets: tuple[int, ...], states: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Row and column of the bands' entries, (D, K) each: at i, band d has the move to i + d, modulo K."""
    origin = torch.arange(states, device=device).expand(len(offsets), -1)
    return origin, (origin + torch.tensor(offsets, device=device)[:, None]) % states


def _shift(values: Tensor, offset: int, dim: int = 0) -> Tensor:
    """The value of state i to the place of state i + offset; rolling by nothing would copy."""
    return values.roll(offset, dims=dim) if offset else values


def _log_sum(terms: list[Tensor]) -> Tensor:
    """log of the sum of exponentials."""
    if not torch.is_grad_enabled():
        return reduce(torch.logaddexp, terms)  # half the time of logsumexp on tensors this small
    stacked = torch.stack(terms)
    # All minus infinity would give a NaN gradient, and both branches of `where` are differentiated: hence 0.
    possible = ~torch.isneginf(stacked).all(0)
    return torch.where(possible, torch.logsumexp(torch.where(possible, stacked, 0.0), dim=0), -torch.inf)


def _predict(
    log_start: Float[Tensor, " states *batch"],
    offsets: tuple[int, ...],
    log_bands: Float[Tensor, "bands states *batch"],
    log_emission: Float[Tensor, "time states *batch"],
) -> Float[Tensor, "time states *batch"]:
    """log p(z_t, y_1:t-1). Batch axes come last, so that each step runs over contiguous memory."""
    predicted = [log_start]
    for leave in (log_emission[:-1].unsqueeze(1) + log_bands).unbind():  # (D, K, *batch) a step
        leaving = zip(offsets, (predicted[-1] + leave).unbind(), strict=True)
        predicted.append(_log_sum([_shift(move, offset) for offset, move in leaving]))
    return torch.stack(predicted)


def _reversed_bands(
    offsets: tuple[int, ...], log_bands: Float[Tensor, "bands states *batch"]
) -> Float[Tensor, "bands states *batch"]:
    """The transposed transitions with the states counted from the last: their bands have the same offsets."""
    moved = [_shift(band, offset).flip(0) for offset, band in zip(offsets, log_bands.unbind(), strict=True)]
    return torch.stack(moved)


def messages(
    log_initial: Float[Tensor, " states *batch"],
    offsets: tuple[int, ...],
    log_bands: Float[Tensor, "bands states *batch"],
    log_emission: Float[Tensor, "time states *batch"],
) -> tuple[Float[Tensor, "time states *batch"], Float[Tensor, "time states *batch"]]:
    """log alpha_t = log p(z_t, y_1:t) and log beta_t = log p(y_t+1:T | z_t), in one pass.

    beta obeys alpha's recursion on the reversed sequence with the transposed transitions, from a start of
    ones. So both run side by side as one batch of twice the size, in half the steps.
    """
    both = _predict(
        torch.stack([log_initial, torch.zeros_like(log_initial)], dim=1),
        offsets,
        torch.stack([log_bands, _reversed_bands(offsets, log_bands)], dim=2),
        torch.stack([log_emission, log_emission.flip(0, 1)], dim=2),
    )
    return both[:, :, 0] + log_emission, both[:, :, 1].flip(0, 1)


def posteriors(
    log_alpha: Float[Tensor, "time states *batch"],
    log_beta: Float[Tensor, "time states *batch"],
    offsets: tuple[int, ...],
    log_bands: Float[Tensor, "bands states *batch"],
    log_emission: Float[Tensor, "time states *batch"],
    inside: Bool[Tensor, " time *batch"] | None = None,
) -> tuple[
    Float[Tensor, "*batch"], Float[Tensor, "time states *batch"], Float[Tensor, "steps bands states *batch"]
]:
    """log p(y), p(z_t | y) and, for each band, p(z_t = i, z_t+1 = i + d | y).

    The posteriors are zero in frames that are not `inside` and for a sequence of probability zero.
    """
    log_likelihood = torch.logsumexp(log_alpha[-1], dim=0)
    counts = ~torch.isneginf(log_likelihood) if inside is None else inside & ~torch.isneginf(log_likelihood)
    # exp(x - inf) = 0, for x = -inf too.
    evidence = torch.where(counts, log_likelihood, torch.inf).expand(len(log_alpha), *log_likelihood.shape)
    states = (log_alpha + log_beta - evidence.unsqueeze(1)).exp()
    arrival = log_emission[1:] + log_beta[1:] - evidence[1:].unsqueeze(1)
    arrival = torch.stack([_shift(arrival, -offset, dim=1) for offset in offsets], dim=1)
    pairs = (arrival.add_(log_alpha[:-1].unsqueeze(1)).add_(log_bands)).exp_()
    return log_likelihood, states, pairs


def exact_above(dtype: torch.dtype) -> float:
    """The least `likelihood_ratio` that plain probabilities get right to rounding.

    With emissions of at most 1, all that follows a frame is a factor of at most 1. So a number that fell below the
    smallest normal one, `tiny`, has lost no more than `tiny` of the result, which is rounding beside `tiny / eps`.
    (Scaling each frame to a sum of 1 gives no such bound: the state that fell to zero may be the one that explains
    the rest.)
    """
    limits = torch.finfo(dtype)
    return limits.tiny / limits.eps


def _mover(
    offsets: tuple[int, ...],
    bands: Float[Tensor, "bands states *#batch"],
    origin: Float[Tensor, "frames states *batch"],
    target: Float[Tensor, "frames states *batch"],
) -> Callable[[int, int], None]:
    """A function that moves `origin[i]` on by all moves into `target[j]`; all views are cut here, once.

    It reads `bands` anew each time, but moves around from the last states to the first only if they are possible now.
    """
    states = bands.shape[1]
    origins, targets = origin.unbind(), target.unbind()
    pieces = []
    for offset, band in zip(offsets, bands.unbind(), strict=True):
        for start, end, length in ((0, offset, states - offset), (states - offset, 0, offset)):
            weight = band.narrow(0, start, length)
            if length and (start == 0 or bool(weight.any())):
                sources = origin.narrow(1, start, length).unbind()
                pieces.append((sources, target.narrow(1, end, length).unbind(), weight))
    # The first piece may write instead of add where it fills all states.
    stay = pieces.pop(0)[2] if offsets[0] == 0 else None

    def by_bands(i: int, j: int) -> None:
        if stay is None:
            targets[j].zero_()
        else:
            torch.mul(origins[i], stay, out=targets[j])
        for sources, ends, weight in pieces:
            ends[j].addcmul_(sources[i], weight)

    return by_bands


def likelihood_ratio(
    initial: Float[Tensor, "states *#batch"],
    offsets: tuple[int, ...],
    bands: Float[Tensor, "bands states *#batch"],
    emission: Iterable[Tensor],
) -> Float[Tensor, "*batch"]:
    """p(y_1:T) over the product of the frames' greatest emissions, from probabilities, frame by frame.

    `emission`, (states, *batch) a frame, is divided by that already: at most 1. Exact where the result is above
    `exact_above`.
    """
    state = move = None
    for time, seen in enumerate(emission):
        now = time % 2
        if state is None or move is None:
            state = seen.new_empty(2, *seen.shape)
            move = _mover(offsets, bands, state, state)
            state[0] = initial
        else:
            move(1 - now, now)
        state[now].mul_(seen)
    if state is None:
        raise ValueError("a sequence must have at least one frame, got emission with none")
    return state[now].sum(0)


class ForwardBackward:
    """The smoother from plain probabilities, for one batch of sequences again and again, in the same memory.

    Args:
        offsets, bands: possible moves, and their probabilities (D, K, S); what is zero here stays zero.
        time: frames.
        inside: False on padding; none has any.
    """

    def __init__(
        self,
        offsets: tuple[int, ...],
        bands: Float[Tensor, "bands states sequences"],
        time: int,
        inside: Bool[Tensor, "time sequences"] | None = None,
    ) -> None:
        _, states, sequences = bands.shape
        self.offsets, self.inside = offsets, inside
        # Forward and, with time and states counted from the last, backward, side by side: half the steps.
        shape = (time, states, 2, sequences)
        self.emission, self.predicted, self.updated = (bands.new_empty(shape) for _ in range(3))
        self.bands = torch.stack([bands, _reversed_bands(offsets, bands)], dim=2)
        self._move = _mover(offsets, self.bands, self.updated, self.predicted)
        self._steps = list(
            zip(self.predicted.unbind(), self.emission.unbind(), self.updated.unbind(), strict=True)
        )

    def __call__(
        self,
        initial: Float[Tensor, "states sequences"],
        bands: Float[Tensor, "bands states sequences"],
        emission: Float[Tensor, "time states sequences"],
    ) -> tuple[
        Float[Tensor, " sequences"],
        Float[Tensor, "time states sequences"],
        Float[Tensor, "bands states sequences"],
    ]:
        """Ratio as `likelihood_ratio`, p(z_t | y), and for each band the expected number of moves.

        The posteriors are zero in frames that are not `inside`. Not finite where the ratio is zero.
        """
        self.bands[:, :, 0], self.bands[:, :, 1] = bands, _reversed_bands(self.offsets, bands)
        self.emission[:, :, 0], self.emission[:, :, 1] = emission, emission.flip(0, 1)
        self.predicted[0, :, 0], self.predicted[0, :, 1] = initial, 1
        for time, (before, seen, after) in enumerate(self._steps):
            if time > 0:
                self._move(time - 1, time)
            torch.mul(before, seen, out=after)

        alpha = self.updated[:, :, 0]
        ratio = alpha[-1].sum(0)
        future = self.updated[:, :, 1].flip(0, 1).div_(ratio)  # p(y_t:T | z_t) / p(y)
        if self.inside is not None:
            future.mul_(self.inside.unsqueeze(1))
        moves = [(alpha[:-1] * _shift(future[1:], -offset, dim=1)).sum(0) for offset in self.offsets]
        return ratio, future.mul_(self.predicted[:, :, 0]), torch.stack(moves).mul_(bands)


def _batch_last(
    log_initial: Tensor, log_transition: Tensor, log_emission: Tensor
) -> tuple[Tensor, tuple[int, ...], Tensor, Tensor]:
    """(*batch, K), (*batch, K, K), (*batch, T, K) to the arguments of `messages`, batch axes broadcast."""
    batch = torch.broadcast_shapes(log_initial.shape[:-1], log_transition.shape[:-2], log_emission.shape[:-2])
    time, states = log_emission.shape[-2:]
    if log_initial.shape[-1] != states or log_transition.shape[-2:] != (states, states):
        raise ValueError(
            f"log_initial, log_transition and log_emission must agree on the number of states, got "
            f"{tuple(log_initial.shape)}, {tuple(log_transition.shape)} and {tuple(log_emission.shape)}"
        )
    if time == 0:
        raise ValueError("a sequence must have at least one frame, got log_emission with none")
    transition = log_transition.expand(*batch, states, states).movedim((-2, -1), (0, 1))
    offsets = possible_moves(transition)
    return (
        log_initial.expand(*batch, states).movedim(-1, 0),
        offsets,
        transition[band_cells(offsets, states, transition.device)],
        log_emission.expand(*batch, time, states).movedim((-2, -1), (0, 1)),
    )


def hmm_filter(
    log_initial: Float[Tensor, "*#batch states"],
    log_transition: Float[Tensor, "*#batch states states"],
    log_emission: Float[Tensor, "*#batch time states"],
) -> Filtered:
    """Forward recursion (T. App. B): likelihood and p(z_t | y_1:t). Batch axes broadcast; differentiable."""
    initial, offsets, bands, emission = _batch_last(log_initial, log_transition, log_emission)
    log_alpha = _predict(initial, offsets, bands, emission) + emission
    log_joint = torch.logsumexp(log_alpha, dim=1)
    log_filtered = log_alpha - log_joint.unsqueeze(1)
    return Filtered(log_joint[-1], log_filtered.movedim((0, 1), (-2, -1)))


def hmm_backward(
    log_transition: Float[Tensor, "*#batch states states"], log_emission: Float[Tensor, "*#batch time states"]
) -> Float[Tensor, "*out time states"]:
    """Backward recursion (T. App. B): log beta_t = log p(y_t+1:T | z_t)."""
    start = torch.zeros_like(log_emission[..., 0, :])
    initial, offsets, bands, emission = _batch_last(start, log_transition, log_emission)
    backward = _predict(initial, offsets, _reversed_bands(offsets, bands), emission.flip(0, 1)).flip(0, 1)
    return backward.movedim((0, 1), (-2, -1))


def hmm_smoother(
    log_initial: Float[Tensor, "*#batch states"],
    log_transition: Float[Tensor, "*#batch states states"],
    log_emission: Float[Tensor, "*#batch time states"],
) -> Smoothed:
    """Forward-backward: posteriors of the states and of neighbouring pairs given the whole sequence."""
    initial, offsets, bands, emission = _batch_last(log_initial, log_transition, log_emission)
    log_alpha, log_beta = messages(initial, offsets, bands, emission)
    log_likelihood, posterior, moves = posteriors(log_alpha, log_beta, offsets, bands, emission)
    steps, _, states, *batch = moves.shape
    pairs = moves.new_zeros(states, states, steps, *batch)
    pairs[band_cells(offsets, states, moves.device)] = moves.movedim(0, 2)
    return Smoothed(
        log_likelihood, posterior.movedim((0, 1), (-2, -1)), pairs.movedim((2, 0, 1), (-3, -2, -1))
    )


def viterbi(
    log_initial: Float[Tensor, "*#batch states"],
    log_transition: Float[Tensor, "*#batch states states"],
    log_emission: Float[Tensor, "*#batch time states"],
    lengths: Int[Tensor, "*#batch"] | None = None,
) -> Decoded:
    """The path of greatest probability. Frames at and behind `lengths` (default: none) are padding.

    Padding must be named here, while the likelihood needs no lengths: a maximum over paths, unlike a sum,
    would pay for the transitions inside the padding.
    """
    initial, offsets, bands, emission = _batch_last(log_initial, log_transition, log_emission)
    time, states = emission.shape[:2]
    singles = [1] * (emission.ndim - 2)
    frame = torch.arange(time, device=emission.device).view(-1, *singles)
    within = (frame < (time if lengths is None else lengths)).expand(time, *emission.shape[2:])
    state = torch.arange(states, device=emission.device).view(-1, *singles)
    # The state before j when j was reached by band d.
    origin = (state.flatten() - torch.tensor(offsets, device=emission.device)[:, None]) % states

    best, previous = initial + emission[0], []
    for inside, step in zip(within[1:].unbind(), emission[1:].unbind(), strict=True):
        arriving = [_shift(best + move, offset) for offset, move in zip(offsets, bands.unbind(), strict=True)]
        score, band = torch.stack(arriving).max(dim=0)
        best = torch.where(inside, score + step, best)
        previous.append(torch.where(inside, origin[band, state], state))

    log_probability, last = best.max(dim=0)
    path = [last]
    for before in reversed(previous):
        path.append(before.gather(0, path[-1].unsqueeze(0)).squeeze(0))
    decoded = torch.where(within, torch.stack(path[::-1]), PADDING)
    return Decoded(log_probability, decoded.movedim(0, -1))
