"""A bank of discrete hidden Markov models (T. 4.4), one an activity, fitted and scored together.

Letters as in `torchpose.activity.baum_welch`.
"""

import warnings
from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchpose.activity.baum_welch import (
    MISSING,
    BaumWelch,
    HMMConfig,
    baum_welch,
    equal_segments,
    mask_padding,
    observed_columns,
    relative_emission,
)
from torchpose.activity.inference import (
    Decoded,
    Smoothed,
    band_cells,
    exact_above,
    hmm_filter,
    hmm_smoother,
    likelihood_ratio,
    possible_moves,
    viterbi,
)


class DiscreteHMM(nn.Module):
    """A discrete HMM per activity, all in the same log-parameter buffers, so fitted and scored at once.

    Args:
        num_models, num_symbols: A and V. Until `fit` every model is uniform on what its topology allows.
        config: states, topology, smoothing and training.
        dtype: of the parameters and of every score.
        streams: () for one symbol a frame, (R,) for R of them.
    """

    log_initial: Float[Tensor, "models states"]
    log_transition: Float[Tensor, "models states states"]
    log_emission: Float[Tensor, "models *streams states symbols"]

    def __init__(
        self,
        num_models: int,
        num_symbols: int,
        config: HMMConfig = HMMConfig(),  # noqa: B008 (frozen)
        dtype: torch.dtype = torch.float64,
        streams: tuple[int, ...] = (),
    ) -> None:
        super().__init__()
        if num_models < 1 or num_symbols < 1 or min(streams, default=1) < 1:
            raise ValueError(
                "a bank of HMMs needs a model, a symbol and a stream at least, got "
                f"{num_models}, {num_symbols} and {streams}"
            )
        self.num_models, self.num_symbols, self.config = num_models, num_symbols, config
        nothing = torch.empty(0, 1, *streams, dtype=torch.long)
        none = torch.empty(0, dtype=torch.long)
        start = equal_segments(nothing, none, none, num_models, num_symbols, config, torch.Generator(), dtype)
        self.register_buffer("log_initial", start.log_initial.clone())
        self.register_buffer("log_transition", start.log_transition)
        self.register_buffer("log_emission", start.log_emission)

    @property
    def durations(self) -> Float[Tensor, "models states"]:
        """Expected stay in each state, frames: 1 / (1 - a_kk). Infinite for a last state, which is never left."""
        return 1 / (1 - self.log_transition.diagonal(dim1=1, dim2=2).exp())

    def fit(
        self,
        symbols: Int[Tensor, "sequences time *streams"],
        lengths: Int[Tensor, " sequences"],
        labels: Int[Tensor, " sequences"],
        generator: torch.Generator | None = None,
        weights: Float[Tensor, "sequences time *streams"] | None = None,
    ) -> BaumWelch:
        """Train every model on the sequences with its label, from an equal segmentation.

        Args:
            symbols: (S, T) or (S, T, R), -1 where nothing was observed; padded with anything behind `lengths`.
            lengths: frames of each sequence; labels: its model, in [0, A).
            generator: of the start's noise, on the CPU; none is a generator seeded with 0.
            weights: of each symbol, in [0, 1]; none are all 1.

        Returns:
            The course of the training, with a `Status` per model.
        """
        self._check(symbols, lengths, weights)
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
        result = baum_welch(start, symbols, lengths, labels, self.config, weights)
        self.log_initial = result.parameters.log_initial
        self.log_transition = result.parameters.log_transition
        self.log_emission = result.parameters.log_emission
        return result

    @torch.no_grad()
    def log_likelihood(
        self,
        symbols: Int[Tensor, "sequences time *streams"],
        lengths: Int[Tensor, " sequences"],
        weights: Float[Tensor, "sequences time *streams"] | None = None,
    ) -> Float[Tensor, "sequences models"]:
        """log p(symbols | model) of every sequence under every model, nats; 0 without an observed frame.

        Minus infinity only where a model without smoothing (`emission_prior` 1) meets a symbol that its
        training never showed it; a `RuntimeWarning` says so.
        """
        self._check(symbols, lengths, weights)
        column, weight = observed_columns(symbols, lengths, weights, self.num_symbols)
        relative, log_best = relative_emission(self.log_emission)
        table = relative.permute(1, 2, 3, 0).contiguous()  # (R, K, V + 1, A)
        transition = self.log_transition.permute(1, 2, 0)
        offsets = possible_moves(transition)
        log_bands = transition[band_cells(offsets, len(transition), transition.device)]
        if weight is None:
            frames = _products(table.exp(), column)
        else:
            frames = _weighted_products(table, column, weight.to(table.dtype))
        ratio = likelihood_ratio(
            self.log_initial.T.exp().unsqueeze(1), offsets, log_bands.exp().unsqueeze(2), frames
        )
        certain = torch.ones_like(column, dtype=table.dtype) if weight is None else weight.to(table.dtype)
        shown = certain.new_zeros(len(lengths), log_best[0].numel())
        place = column + torch.arange(len(column), device=column.device)[:, None, None] * (
            self.num_symbols + 1
        )
        shown.scatter_add_(1, place.flatten(0, 1).T, certain.flatten(0, 1).T)
        scores = ratio.log() + shown @ log_best.flatten(1).T

        sequence, model = (~(ratio > exact_above(ratio.dtype))).nonzero().unbind(1)
        if len(sequence) > 0:
            log_emission = self._emission(column, weight, sequence, model)
            scores[sequence, model] = hmm_filter(
                self.log_initial[model], self.log_transition[model], log_emission
            ).log_likelihood
        impossible = int(torch.isneginf(scores).sum())
        if impossible:
            warnings.warn(
                f"{impossible} of {scores.numel()} scores are minus infinity, as the model gives a symbol "
                "probability zero; train with emission_prior above 1",
                RuntimeWarning,
                stacklevel=2,
            )
        return scores

    def decode(
        self,
        symbols: Int[Tensor, "sequences time *streams"],
        lengths: Int[Tensor, " sequences"],
        labels: Int[Tensor, " sequences"],
        weights: Float[Tensor, "sequences time *streams"] | None = None,
    ) -> Decoded:
        """The most probable states of each sequence under the model that its label names."""
        log_emission = self._of_models(symbols, lengths, labels, weights)
        return viterbi(self.log_initial[labels], self.log_transition[labels], log_emission, lengths)

    def smooth(
        self,
        symbols: Int[Tensor, "sequences time *streams"],
        lengths: Int[Tensor, " sequences"],
        labels: Int[Tensor, " sequences"],
        weights: Float[Tensor, "sequences time *streams"] | None = None,
    ) -> Smoothed:
        """The states' posteriors in each sequence under the model that its label names; padding is no evidence."""
        log_emission = self._of_models(symbols, lengths, labels, weights)
        return hmm_smoother(self.log_initial[labels], self.log_transition[labels], log_emission)

    def _of_models(
        self, symbols: Tensor, lengths: Tensor, labels: Tensor, weights: Tensor | None
    ) -> Float[Tensor, "sequences time states"]:
        self._check(symbols, lengths, weights)
        column, weight = observed_columns(symbols, lengths, weights, self.num_symbols)
        return self._emission(column, weight, torch.arange(len(labels), device=labels.device), labels)

    def _emission(
        self, column: Tensor, weight: Tensor | None, sequence: Tensor, model: Tensor
    ) -> Float[Tensor, "pairs time states"]:
        """log p(y_t | z_t) of pairs of a sequence and a model."""
        states = self.log_emission.shape[-2]
        table = self.log_emission.reshape(self.num_models, -1, states, self.num_symbols)
        table = nn.functional.pad(table, (0, 1)).transpose(2, 3)  # (A, R, V + 1, K)
        stream = torch.arange(len(column), device=column.device)[:, None, None]
        rows = table[model, stream, column[..., sequence]]  # (R, T, P, K)
        if weight is not None:
            rows = rows * weight[..., sequence].to(rows.dtype).unsqueeze(-1)
        return rows.sum(0).transpose(0, 1)

    def _check(self, symbols: Tensor, lengths: Tensor, weights: Tensor | None = None) -> None:
        if lengths.shape != symbols.shape[:1] or ((lengths < 1) | (lengths > symbols.shape[1])).any():
            raise ValueError(
                f"lengths must hold a number of frames in [1, {symbols.shape[1]}] for each of "
                f"{len(symbols)} sequences, got {lengths.tolist()[:10]}"
            )
        streams = self.log_emission.shape[1:-2]
        if symbols.shape[2:] != streams:
            shape = ", ".join(["sequences", "time", *map(str, streams)])
            raise ValueError(
                f"symbols must have the shape ({shape}) of the bank's streams, got {tuple(symbols.shape)}"
            )
        masked = mask_padding(symbols, lengths)
        if ((masked < MISSING) | (masked >= self.num_symbols)).any():
            raise ValueError(
                f"symbols must lie in [0, {self.num_symbols}), or be {MISSING} where nothing was observed, "
                f"got {int(masked.min())} to {int(masked.max())}"
            )
        if weights is not None and (
            weights.shape != symbols.shape
            or not ((weights >= 0) & (weights <= 1) | (masked == MISSING)).all()
        ):
            raise ValueError(
                f"weights must lie in [0, 1], one for each symbol of {tuple(symbols.shape)}, got "
                f"{tuple(weights.shape)} from {float(weights.min()):g} to {float(weights.max()):g}"
            )


def _products(
    table: Float[Tensor, "streams states symbols_1 models"], column: Int[Tensor, "streams time sequences"]
) -> Iterator[Float[Tensor, "states sequences models"]]:
    """The emission of each frame: the product of its symbols'."""
    first, *others = table.unbind()
    for seen in column.unbind(1):
        product = first.index_select(1, seen[0])
        for stream, symbol in zip(others, seen[1:].unbind(), strict=True):
            product *= stream.index_select(1, symbol)
        yield product


def _weighted_products(
    table: Float[Tensor, "streams states symbols_1 models"],
    column: Int[Tensor, "streams time sequences"],
    weight: Float[Tensor, "streams time sequences"],
) -> Iterator[Float[Tensor, "states sequences models"]]:
    """The same from a table of logarithms, each taken by its weight."""
    for seen, certain in zip(column.unbind(1), weight.unbind(1), strict=True):
        rows = [
            stream.index_select(1, symbol) * share.unsqueeze(1)
            for stream, symbol, share in zip(table.unbind(), seen.unbind(), certain.unbind(), strict=True)
        ]
        yield torch.stack(rows).sum(0).exp_()
