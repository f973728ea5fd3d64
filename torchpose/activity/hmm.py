"""Discrete hidden Markov models (T. 4.4): Baum-Welch, and a bank of models fitted and scored together.

Letters: A models, S sequences, T time, K states, V symbols. Log-probabilities are in nats.
"""

import warnings
from dataclasses import dataclass
from enum import Enum, IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose.activity.inference import (
    Decoded,
    band_cells,
    hmm_filter,
    messages,
    possible_moves,
    posteriors,
    viterbi,
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
    log_emission: Float[Tensor, "models states symbols"]


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


def mask_padding(symbols: Int[Tensor, "sequences time"], lengths: Int[Tensor, " sequences"]) -> Tensor:
    """The symbols with everything behind each sequence's end set to `MISSING`."""
    frame = torch.arange(symbols.shape[1], device=symbols.device)
    return torch.where(frame < lengths[:, None], symbols, MISSING)


def emission_scores(
    log_emission: Float[Tensor, "*models states symbols"], symbols: Int[Tensor, "sequences time"]
) -> Float[Tensor, "*models sequences time states"]:
    """log p(y_t | z_t) of every sequence under every model; 0 where the symbol is `MISSING`."""
    observed = symbols.clamp(min=0)
    scores = log_emission.transpose(-1, -2)[..., observed, :]
    return torch.where((symbols == MISSING).unsqueeze(-1), 0.0, scores)


def equal_segments(
    symbols: Int[Tensor, "sequences time"],
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
    seen = mask_padding(symbols, lengths) != MISSING

    noise = torch.rand(symbols.shape, generator=generator, dtype=torch.float64)
    weight = 1 + config.start_noise * noise.to(device, dtype)
    cell = (labels[:, None] * states + part) * num_symbols + symbols.clamp(min=0)
    counts = weight.new_zeros(models * states * num_symbols).scatter_add_(0, cell[seen], weight[seen])
    emission = counts.view(models, states, num_symbols) + (config.emission_prior - 1)
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

    symbols: int  # V
    labels: Int[Tensor, " sequences"]
    inside: Bool[Tensor, "time sequences"]  # False on padding
    cell: Int[
        Tensor, "time states sequences"
    ]  # where (model, state, symbol) lies in a flat table, V + 1 wide
    member: Float[Tensor, "models sequences"]  # 1 where the sequence trains the model
    observed: Float[Tensor, " models"]  # frames with a symbol

    @classmethod
    def arrange(cls, start: Parameters, symbols: Tensor, lengths: Tensor, labels: Tensor) -> "_Training":
        models, states, num_symbols = start.log_emission.shape
        device = symbols.device
        seen = mask_padding(symbols, lengths) != MISSING
        # Missing symbols and padding point at one more symbol, which every state emits with probability 1.
        column = torch.where(seen, symbols, num_symbols).T.unsqueeze(1)  # (T, 1, S)
        row = labels * states + torch.arange(states, device=device)[:, None]  # (K, S)
        member = (torch.arange(models, device=device)[:, None] == labels).to(start.log_emission.dtype)
        return cls(
            symbols=num_symbols,
            labels=labels,
            inside=torch.arange(symbols.shape[1], device=device)[:, None] < lengths,
            cell=row * (num_symbols + 1) + column,
            member=member,
            observed=member @ seen.sum(1).to(member.dtype),
        )


def _expect(
    current: Parameters, training: _Training, offsets: tuple[int, ...]
) -> tuple[Float[Tensor, " models"], Float[Tensor, "models states"], Tensor, Tensor]:
    """E-step: log-likelihood of each model's sequences, expected counts of starts, moves and symbols."""
    models, states = current.log_initial.shape
    bands = band_cells(offsets, states, training.cell.device)
    log_initial = current.log_initial.T[:, training.labels]
    log_bands = current.log_transition.permute(1, 2, 0)[bands][..., training.labels]
    log_emission = nn.functional.pad(current.log_emission, (0, 1)).flatten()[training.cell]

    log_alpha, log_beta = messages(log_initial, offsets, log_bands, log_emission)
    log_likelihood, posterior, pairs = posteriors(
        log_alpha, log_beta, offsets, log_bands, log_emission, training.inside
    )

    # A product with the membership would turn a minus infinity into NaN for the other models.
    total = log_likelihood.new_zeros(models).scatter_add_(0, training.labels, log_likelihood)
    starts = training.member @ posterior[0].T
    moves = torch.zeros_like(current.log_transition)
    moves[:, *bands] = (pairs.sum(0) @ training.member.T).movedim(-1, 0)
    emitted = posterior.new_zeros(models * states * (training.symbols + 1))
    emitted.scatter_add_(0, training.cell.flatten(), posterior.flatten())
    return total, starts, moves, emitted.view(models, states, -1)[..., : training.symbols]


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
    symbols: Int[Tensor, "sequences time"],
    lengths: Int[Tensor, " sequences"],
    labels: Int[Tensor, " sequences"],
    config: HMMConfig = HMMConfig(),
) -> BaumWelch:
    """Fit every model to its own sequences, all together, by EM towards the posterior's mode.

    The objective, log-likelihood plus log Dirichlet prior, never falls. A model that has converged is left as
    it is, so each ends as if it had been trained alone. Entries of the initial and transition distributions
    that start at zero stay zero.

    Args:
        start: parameters of the A models.
        symbols: (S, T) in [0, V), or `MISSING`; padded behind `lengths`.
        lengths: frames of each sequence.
        labels: the model, in [0, A), that each sequence trains.
        config: priors, rounds and tolerance.
    """
    training = _Training.arrange(start, symbols, lengths, labels)
    offsets = possible_moves(start.log_transition.permute(1, 2, 0))
    may_start, may_move = ~torch.isneginf(start.log_initial), ~torch.isneginf(start.log_transition)
    may_emit = torch.ones_like(start.log_emission, dtype=torch.bool)

    current = start
    active = training.observed > 0
    rounds = torch.zeros_like(active, dtype=torch.long)
    history: list[Tensor] = []
    for _ in range(config.iterations):
        log_likelihood, starts, moves, emitted = _expect(current, training, offsets)
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


class DiscreteHMM(nn.Module):
    """A discrete HMM per activity, all in the same log-parameter buffers, so fitted and scored at once.

    Args:
        num_models, num_symbols: A and V. Until `fit` every model is uniform on what its topology allows.
        config: states, topology, smoothing and training.
        dtype: of the parameters and of every score.
    """

    log_initial: Float[Tensor, "models states"]
    log_transition: Float[Tensor, "models states states"]
    log_emission: Float[Tensor, "models states symbols"]

    def __init__(
        self,
        num_models: int,
        num_symbols: int,
        config: HMMConfig = HMMConfig(),
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        if num_models < 1 or num_symbols < 1:
            raise ValueError(
                f"a bank of HMMs needs a model and a symbol at least, got {num_models} and {num_symbols}"
            )
        self.num_models, self.num_symbols, self.config = num_models, num_symbols, config
        nothing = torch.empty(0, 1, dtype=torch.long)
        start = equal_segments(
            nothing, nothing[:, 0], nothing[:, 0], num_models, num_symbols, config, torch.Generator(), dtype
        )
        self.register_buffer("log_initial", start.log_initial.clone())
        self.register_buffer("log_transition", start.log_transition)
        self.register_buffer("log_emission", start.log_emission)

    def fit(
        self,
        symbols: Int[Tensor, "sequences time"],
        lengths: Int[Tensor, " sequences"],
        labels: Int[Tensor, " sequences"],
        generator: torch.Generator | None = None,
    ) -> BaumWelch:
        """Train every model on the sequences with its label, from an equal segmentation.

        Args:
            symbols: (S, T), -1 where nothing was observed; padded with anything behind `lengths`.
            lengths: frames of each sequence; labels: its model, in [0, A).
            generator: of the start's noise, on the CPU; none is a generator seeded with 0.

        Returns:
            The course of the training, with a `Status` per model.
        """
        self._check(symbols, lengths)
        if labels.shape != lengths.shape or ((labels < 0) | (labels >= self.num_models)).any():
            raise ValueError(
                f"labels must name a model in [0, {self.num_models}) for each of {len(lengths)} sequences, "
                f"got {labels.tolist()[:10]}"
            )
        start = equal_segments(
            symbols,
            lengths,
            labels,
            self.num_models,
            self.num_symbols,
            self.config,
            generator or torch.Generator().manual_seed(0),
            self.log_emission.dtype,
        )
        result = baum_welch(start, symbols, lengths, labels, self.config)
        self.log_initial = result.parameters.log_initial
        self.log_transition = result.parameters.log_transition
        self.log_emission = result.parameters.log_emission
        return result

    def log_likelihood(
        self, symbols: Int[Tensor, "sequences time"], lengths: Int[Tensor, " sequences"]
    ) -> Float[Tensor, "sequences models"]:
        """log p(symbols | model) of every sequence under every model, nats; 0 without an observed frame.

        Minus infinity only where a model without smoothing (`emission_prior` 1) meets a symbol that its
        training never showed it; a `RuntimeWarning` says so.
        """
        scores = hmm_filter(*self._for_sequences(symbols, lengths)).log_likelihood
        impossible = int(torch.isneginf(scores).sum())
        if impossible:
            warnings.warn(
                f"{impossible} of {scores.numel()} scores are minus infinity, as the model gives a symbol "
                "probability zero; train with emission_prior above 1",
                RuntimeWarning,
                stacklevel=2,
            )
        return scores.T

    def decode(
        self,
        symbols: Int[Tensor, "sequences time"],
        lengths: Int[Tensor, " sequences"],
        labels: Int[Tensor, " sequences"],
    ) -> Decoded:
        """The most probable states of each sequence under the model that its label names."""
        self._check(symbols, lengths)
        scores = emission_scores(self.log_emission, mask_padding(symbols, lengths))
        sequence = torch.arange(len(labels), device=labels.device)
        return viterbi(
            self.log_initial[labels], self.log_transition[labels], scores[labels, sequence], lengths
        )

    def _for_sequences(self, symbols: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Arguments of the inference functions, with batch axes (A, S)."""
        self._check(symbols, lengths)
        scores = emission_scores(self.log_emission, mask_padding(symbols, lengths))
        return self.log_initial.unsqueeze(1), self.log_transition.unsqueeze(1), scores

    def _check(self, symbols: Tensor, lengths: Tensor) -> None:
        if lengths.shape != symbols.shape[:1] or ((lengths < 1) | (lengths > symbols.shape[1])).any():
            raise ValueError(
                f"lengths must hold a number of frames in [1, {symbols.shape[1]}] for each of "
                f"{len(symbols)} sequences, got {lengths.tolist()[:10]}"
            )
        masked = mask_padding(symbols, lengths)
        if ((masked < MISSING) | (masked >= self.num_symbols)).any():
            raise ValueError(
                f"symbols must lie in [0, {self.num_symbols}), or be {MISSING} where nothing was observed, "
                f"got {int(masked.min())} to {int(masked.max())}"
            )
