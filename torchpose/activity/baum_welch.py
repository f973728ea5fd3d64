"""Baum-Welch for discrete hidden Markov models (T. 4.4), all models of a bank at once.

A frame may show several symbols, one a stream: given the state they are independent, each with an emission table of its
own. Weights in [0, 1] are the powers to which the emissions are taken: what is half certain counts half as often.

Letters: A models, S sequences, T time, R streams, K states, V symbols. Log-probabilities are in nats.
"""

from dataclasses import dataclass
from enum import Enum, IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose.activity.inference import (
    ForwardBackward,
    band_cells,
    exact_above,
    messages,
    possible_moves,
    posteriors,
)

MISSING = -1  # the symbol of a frame in which nothing was observed


class Topology(Enum):
    """Which transitions a model may make. Lower-case names, as Hydra reads an enum by its member's name."""

    left_to_right = "left_to_right"  # start in the first state, then stay or move on by one (T. 4.4)
    ergodic = "ergodic"  # from any state to any


class Status(IntEnum):
    """How Baum-Welch ended for one model."""

    CONVERGED = 0  # the last round gained less than the tolerance
    MAX_ITERATIONS = 1  # still gaining: raise `iterations`
    IMPOSSIBLE = 2  # a training sequence has probability zero: raise `emission_prior` above 1
    NO_DATA = 3  # the model has no observed frame to learn from


@dataclass(frozen=True)
class HMMConfig:
    """Structure, smoothing and training of the models."""

    states: int = 4  # of each activity's model
    topology: Topology = Topology.left_to_right  # left_to_right or ergodic
    emission_prior: float = (
        1.1  # Dirichlet concentration: each symbol's pseudo-count plus 1; 1 smooths nothing
    )
    transition_prior: float = 1.1  # the same for each transition that the topology allows
    iterations: int = 50  # at most, of Baum-Welch
    tolerance: float = 1e-5  # stop when the objective gains less, nats per observed frame
    start_noise: float = 0.1  # relative random disturbance of the start's emission counts

    def __post_init__(self) -> None:
        if self.states < 1:
            raise ValueError(f"states must be at least 1, got {self.states}; the thesis uses 4")
        if self.emission_prior < 1 or self.transition_prior < 1:
            raise ValueError(
                "emission_prior and transition_prior must be at least 1 (1 is no smoothing), got "
                f"{self.emission_prior} and {self.transition_prior}"
            )
        if self.iterations < 1:
            raise ValueError(f"iterations must be at least 1, got {self.iterations}")
        if self.tolerance < 0 or self.start_noise < 0:
            raise ValueError(
                f"tolerance and start_noise must not be negative, got {self.tolerance} and {self.start_noise}"
            )


@dataclass(frozen=True)
class Parameters:
    """Log-parameters of several models. Minus infinity in the first two is a structural zero and stays."""

    log_initial: Float[Tensor, "models states"]
    log_transition: Float[Tensor, "models states states"]
    log_emission: Float[Tensor, "models *streams states symbols"]


@dataclass(frozen=True)
class BaumWelch:
    """Fitted models and how their training went."""

    parameters: Parameters
    objective: Float[Tensor, "rounds models"]  # log-likelihood plus log-prior before each round; never falls
    iterations: Int[Tensor, " models"]  # rounds that changed the model
    status: Int[Tensor, " models"]  # `Status`

    def summary(self, names: tuple[str, ...] | None = None) -> str:
        """One sentence a model."""
        names = names or tuple(f"model {model}" for model in range(len(self.status)))
        lines = zip(names, self.status.tolist(), self.iterations.tolist(), strict=True)
        return "\n".join(
            f"{name}: {Status(status).name.lower()} after {rounds} rounds" for name, status, rounds in lines
        )


def mask_padding(
    symbols: Int[Tensor, "sequences time *streams"], lengths: Int[Tensor, " sequences"]
) -> Int[Tensor, "sequences time *streams"]:
    """The symbols with everything behind each sequence's end set to `MISSING`."""
    inside = torch.arange(symbols.shape[1], device=symbols.device) < lengths[:, None]
    return torch.where(inside.view(*inside.shape, *[1] * (symbols.ndim - 2)), symbols, MISSING)


def emission_scores(
    log_emission: Float[Tensor, "*models states symbols"], symbols: Int[Tensor, "sequences time"]
) -> Float[Tensor, "*models sequences time states"]:
    """log p(y_t | z_t) of every sequence under every model; 0 where the symbol is `MISSING`. One stream."""
    observed = symbols.clamp(min=0)
    scores = log_emission.transpose(-1, -2)[..., observed, :]
    return torch.where((symbols == MISSING).unsqueeze(-1), 0.0, scores)


def equal_segments(
    symbols: Int[Tensor, "sequences time *streams"],
    lengths: Int[Tensor, " sequences"],
    labels: Int[Tensor, " sequences"],
    models: int,
    num_symbols: int,
    config: HMMConfig,
    generator: torch.Generator,
    dtype: torch.dtype = torch.float64,
) -> Parameters:
    """A start for Baum-Welch: each sequence is cut into K equal parts, and state k emits what part k holds.

    The counts are disturbed by `config.start_noise`, drawn from `generator` (on the CPU). A state's expected
    stay is a K-th of the model's mean length.
    """
    states, device = config.states, symbols.device
    frame = torch.arange(symbols.shape[1], device=device)
    part = frame * states // lengths.clamp(min=1)[:, None]
    # A sequence shorter than K frames cannot have come further than one state a frame.
    part = torch.minimum(part, frame).clamp(max=states - 1)
    streams = symbols.shape[2:].numel()
    masked = mask_padding(symbols, lengths).reshape(*symbols.shape[:2], streams)
    seen = masked != MISSING

    noise = torch.rand(masked.shape, generator=generator, dtype=torch.float64)
    weight = 1 + config.start_noise * noise.to(device, dtype)
    stream = torch.arange(streams, device=device)
    cell = (labels[:, None, None] * streams + stream) * states + part[:, :, None]
    cell = cell * num_symbols + masked.clamp(min=0)
    counts = weight.new_zeros(models * streams * states * num_symbols)
    counts.scatter_add_(0, cell[seen], weight[seen])
    emission = counts.view(models, *symbols.shape[2:], states, num_symbols) + (config.emission_prior - 1)
    emission = torch.where(emission.sum(-1, keepdim=True) > 0, emission, 1.0)

    total = weight.new_zeros(models).scatter_add_(0, labels, lengths.to(dtype))
    members = weight.new_zeros(models).scatter_add_(0, labels, torch.ones_like(labels, dtype=dtype))
    leave = (states * members / total.clamp(min=1)).clamp(min=0.01, max=0.5)[:, None, None]
    eye = torch.eye(states, dtype=dtype, device=device)
    if config.topology is Topology.left_to_right:
        initial = eye[:1].expand(models, -1)
        onward = eye.roll(1, dims=1)
        onward[-1, 0] = 0
    else:
        initial = torch.full((models, states), 1.0, dtype=dtype, device=device)
        onward = 1 - eye
    transition = (1 - leave) * eye + leave * onward / onward.sum(1, keepdim=True).clamp(min=1)
    return Parameters(_log_normalize(initial), _log_normalize(transition), _log_normalize(emission))


def _log_normalize(weights: Float[Tensor, "*rows entries"]) -> Float[Tensor, "*rows entries"]:
    return (weights / weights.sum(-1, keepdim=True)).log()


@dataclass(frozen=True)
class _Training:
    """The training sequences, arranged for the E-step; the batch axis is last there."""

    labels: Int[Tensor, " sequences"]
    inside: Bool[Tensor, "time sequences"] | None  # False on padding; none has any
    # Where (model, stream, state, symbol) lies in a flat table, V + 1 symbols wide: the last is what was not seen.
    cell: Int[Tensor, "streams time states sequences"]
    weight: Float[Tensor, "streams time 1 sequences"] | None
    member: Float[Tensor, "models sequences"]  # 1 where the sequence trains the model
    shown: Float[Tensor, "models streams symbols_1"]  # how often, by weight
    observed: Float[Tensor, " models"]  # frames with a symbol, by weight of the most certain stream

    @classmethod
    def arrange(
        cls, start: Parameters, symbols: Tensor, lengths: Tensor, labels: Tensor, weights: Tensor | None
    ) -> "_Training":
        models, *_, states, num_symbols = start.log_emission.shape
        device, dtype = symbols.device, start.log_emission.dtype
        column, weight = observed_columns(symbols, lengths, weights, num_symbols)  # (R, T, S)
        stream = torch.arange(len(column), device=device)[:, None]
        row = (labels * len(column) + stream)[:, None] * states + torch.arange(states, device=device)[:, None]
        member = (torch.arange(models, device=device)[:, None] == labels).to(dtype)
        certain = (column < num_symbols).to(dtype) if weight is None else weight.to(dtype)
        shown = member.new_zeros(models * len(column) * (num_symbols + 1))
        place = (labels * len(column) + stream)[:, None] * (num_symbols + 1) + column
        shown.scatter_add_(0, place.flatten(), certain.flatten())
        inside = torch.arange(symbols.shape[1], device=device)[:, None] < lengths
        return cls(
            labels=labels,
            inside=None if bool(inside.all()) else inside,
            cell=row[:, None] * (num_symbols + 1) + column.unsqueeze(2),
            weight=None if weight is None else weight.to(dtype).unsqueeze(2),
            member=member,
            shown=shown.view(models, len(column), num_symbols + 1),
            observed=member @ certain.amax(0).sum(0),
        )

    def emission(
        self, table: Float[Tensor, "models streams states symbols_1"], sequences: Tensor | None = None
    ) -> Float[Tensor, "time states sequences"]:
        """Sum over the streams of the log-emissions in the table, by their weights."""
        cell, weight = self.cell, self.weight
        if sequences is not None:
            cell, weight = cell[..., sequences], None if weight is None else weight[..., sequences]
        rows = table.flatten().index_select(0, cell.flatten()).view(cell.shape)
        return (rows if weight is None else rows * weight).sum(0)


def observed_columns(
    symbols: Int[Tensor, "sequences time *streams"],
    lengths: Int[Tensor, " sequences"],
    weights: Float[Tensor, "sequences time *streams"] | None,
    num_symbols: int,
) -> tuple[Int[Tensor, "streams time sequences"], Float[Tensor, "streams time sequences"] | None]:
    """Symbols and weights, batch last. What is missing, padding or without weight is symbol V, of weight 0."""
    masked = mask_padding(symbols, lengths)
    if weights is not None:
        masked = torch.where(weights > 0, masked, MISSING)
    column = torch.where(masked == MISSING, num_symbols, masked)
    column = column.reshape(*symbols.shape[:2], -1).permute(2, 1, 0).contiguous()
    if weights is None:
        return column, None
    weight = weights.reshape(*symbols.shape[:2], -1).permute(2, 1, 0)
    return column, torch.where(column < num_symbols, weight, 0.0)


def relative_emission(
    log_emission: Float[Tensor, "models *streams states symbols"],
) -> tuple[Float[Tensor, "models streams states symbols_1"], Float[Tensor, "models streams symbols_1"]]:
    """Log-emissions less those of each symbol's best state, and these; with a symbol more, which is certain.

    A symbol that no state emits keeps its minus infinities: its best counts as 0.
    """
    models, *_, states, symbols = log_emission.shape
    table = nn.functional.pad(log_emission.reshape(models, -1, states, symbols), (0, 1))
    best = table.amax(2)
    best = torch.where(torch.isneginf(best), 0.0, best)
    return table - best.unsqueeze(2), best


def _expect(
    current: Parameters, training: _Training, smoother: ForwardBackward
) -> tuple[Float[Tensor, " models"], Float[Tensor, "models states"], Tensor, Tensor]:
    """E-step: log-likelihood of each model's sequences, expected counts of starts, moves and symbols."""
    labels, offsets = training.labels, smoother.offsets
    bands = band_cells(offsets, current.log_initial.shape[1], labels.device)
    log_initial = current.log_initial.T
    log_bands = current.log_transition.permute(1, 2, 0)[bands]
    relative, log_best = relative_emission(current.log_emission)
    if training.weight is None and len(training.cell) == 1:  # the exponentials of the table are fewer
        emission = training.emission(relative.exp())
    else:
        emission = training.emission(relative).exp()
    ratio, posterior, moves = smoother(log_initial.exp()[:, labels], log_bands.exp()[..., labels], emission)
    log_ratio = ratio.log()
    unsure = (~(ratio > exact_above(ratio.dtype))).nonzero()[:, 0]
    if len(unsure) > 0:
        log_ratio[unsure], posterior[..., unsure], moves[..., unsure] = _expect_in_logs(
            log_initial[:, labels[unsure]],
            offsets,
            log_bands[..., labels[unsure]],
            training.emission(relative, unsure),
            None if training.inside is None else training.inside[:, unsure],
        )

    # A product with the membership would turn a minus infinity into NaN for the other models.
    total = (training.shown * log_best).flatten(1).sum(1).scatter_add(0, labels, log_ratio)
    starts = training.member @ posterior[0].T
    moved = torch.zeros_like(current.log_transition)
    moved[:, *bands] = (moves @ training.member.T).movedim(-1, 0)
    counts = posterior.expand(training.cell.shape)
    if training.weight is not None:
        counts = counts * training.weight
    emitted = torch.zeros_like(relative).flatten()
    emitted.scatter_add_(0, training.cell.flatten(), counts.flatten())
    return total, starts, moved, emitted.view_as(relative)[..., :-1].reshape(current.log_emission.shape)


def _expect_in_logs(
    log_initial: Tensor,
    offsets: tuple[int, ...],
    log_bands: Tensor,
    log_emission: Tensor,
    inside: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """The same as `ForwardBackward` with the logarithm of its ratio, where plain probabilities are not exact."""
    log_alpha, log_beta = messages(log_initial, offsets, log_bands, log_emission)
    log_ratio, posterior, pairs = posteriors(log_alpha, log_beta, offsets, log_bands, log_emission, inside)
    return log_ratio, posterior, pairs.sum(0)


def _maximize(
    counts: Float[Tensor, " models *rows"],
    log_before: Float[Tensor, " models *rows"],
    prior: float,
    allowed: Bool[Tensor, " models *rows"],
    active: Bool[Tensor, " models"],
) -> Float[Tensor, " models *rows"]:
    """M-step: mode of the Dirichlet posterior on the allowed entries of the active models' rows.

    A row with neither evidence nor prior stays as it is.
    """
    weights = torch.where(allowed, counts + (prior - 1), 0.0)
    changes = (weights.sum(-1, keepdim=True) > 0) & active.view(-1, *[1] * (counts.ndim - 1))
    return torch.where(changes, _log_normalize(weights), log_before)


def _log_prior(
    log_rows: Float[Tensor, " models *rows"], prior: float, allowed: Bool[Tensor, " models *rows"]
) -> Float[Tensor, " models"]:
    """Log-density of the Dirichlet prior up to a constant."""
    if prior == 1:  # 0 times minus infinity is not 0
        return log_rows.new_zeros(len(log_rows))
    return (prior - 1) * torch.where(allowed, log_rows, 0.0).flatten(1).sum(1)


@torch.no_grad()
def baum_welch(
    start: Parameters,
    symbols: Int[Tensor, "sequences time *streams"],
    lengths: Int[Tensor, " sequences"],
    labels: Int[Tensor, " sequences"],
    config: HMMConfig = HMMConfig(),
    weights: Float[Tensor, "sequences time *streams"] | None = None,
) -> BaumWelch:
    """Fit every model to its own sequences, all together, by EM towards the posterior's mode.

    The objective, log-likelihood plus log Dirichlet prior, never falls. A model that has converged is left as
    it is, so each ends as if it had been trained alone. Entries of the initial and transition distributions
    that start at zero stay zero.

    Args:
        start: parameters of the A models.
        symbols: (S, T) or, with streams, (S, T, R) in [0, V), or `MISSING`; padded behind `lengths`.
        lengths: frames of each sequence.
        labels: the model, in [0, A), that each sequence trains.
        config: priors, rounds and tolerance.
        weights: of each symbol, in [0, 1]; none are all 1, and 0 is the same as `MISSING`.
    """
    training = _Training.arrange(start, symbols, lengths, labels, weights)
    log_transition = start.log_transition.permute(1, 2, 0)
    offsets = possible_moves(log_transition)
    bands = log_transition[band_cells(offsets, len(log_transition), labels.device)].exp()[..., labels]
    smoother = ForwardBackward(offsets, bands, symbols.shape[1], training.inside)
    may_start, may_move = ~torch.isneginf(start.log_initial), ~torch.isneginf(start.log_transition)
    may_emit = torch.ones_like(start.log_emission, dtype=torch.bool)

    current = start
    active = training.observed > 0
    rounds = torch.zeros_like(active, dtype=torch.long)
    history: list[Tensor] = []
    for _ in range(config.iterations):
        log_likelihood, starts, moves, emitted = _expect(current, training, smoother)
        history.append(
            log_likelihood
            + _log_prior(current.log_initial, config.transition_prior, may_start)
            + _log_prior(current.log_transition, config.transition_prior, may_move)
            + _log_prior(current.log_emission, config.emission_prior, may_emit)
        )
        if len(history) > 1:
            active = active & (history[-1] - history[-2] >= config.tolerance * training.observed)
        if not active.any():
            break
        current = Parameters(
            _maximize(starts, current.log_initial, config.transition_prior, may_start, active),
            _maximize(moves, current.log_transition, config.transition_prior, may_move, active),
            _maximize(emitted, current.log_emission, config.emission_prior, may_emit, active),
        )
        rounds += active

    status = torch.where(active, int(Status.MAX_ITERATIONS), int(Status.CONVERGED))
    status = torch.where(torch.isneginf(history[-1]), int(Status.IMPOSSIBLE), status)
    status = torch.where(training.observed > 0, status, int(Status.NO_DATA))
    return BaumWelch(current, torch.stack(history), rounds, status)
