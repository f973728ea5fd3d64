"""Gaussian beliefs over a state that moves and is measured: the Kalman filter, the extended one, and the smoother.

The extended filter takes a function and its Jacobian where the linear one takes a matrix; all else is the same
(T. 4.3.1, App. B). Batch axes come first and broadcast; units are the caller's. Nothing raises because one row of a
batch is bad.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# A matrix, or a function of the mean (*batch, n) that gives the value (*batch, m) and its Jacobian (*batch, m, n).
Model = Tensor | Callable[[Tensor], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Gaussian:
    """What is believed of a state."""

    mean: Float[Tensor, "*batch states"]
    covariance: Float[Tensor, "*batch states states"]


@dataclass(frozen=True)
class Update:
    """A belief after a measurement, and what was made of that."""

    belief: Gaussian
    used: Bool[Tensor, "*batch measures"]  # components that changed the belief
    rejected: Bool[Tensor, "*batch measures"]  # components that were there and were not believed
    log_likelihood: Float[Tensor, "*batch"]  # log p(those that were there | belief before), rejected ones too
    deviation: Float[
        Tensor, "*batch blocks"
    ]  # squared Mahalanobis distance of each block; 0 where it is missing


@dataclass(frozen=True)
class Filtered:
    """A sequence: what the past tells of each moment."""

    predicted: Gaussian  # (*batch, time, n), given the measurements before; the first is the start
    filtered: Gaussian  # (*batch, time, n), given those up to then
    used: Bool[Tensor, "*batch time measures"]
    rejected: Bool[Tensor, "*batch time measures"]
    log_likelihood: Float[Tensor, "*batch time"]  # of each moment's measurement, as in `Update`


def kalman_predict(belief: Gaussian, transition: Model, noise: Float[Tensor, "*#batch n n"]) -> Gaussian:
    """The belief a step later: x' = F x + w, or x' = f(x) + w, with w ~ N(0, `noise`)."""
    mean, jacobian = linearised(transition, belief.mean)
    return Gaussian(mean, _symmetric(jacobian @ belief.covariance @ jacobian.mT + noise))


def kalman_update(
    belief: Gaussian,
    value: Float[Tensor, "*#batch measures"],
    model: Model,
    noise: Float[Tensor, "*#batch measures measures"],
    gate: float = 0.0,
    blocks: Sequence[int] | None = None,
) -> Update:
    """The belief after a measurement y = H x + v, or y = h(x) + v, with v ~ N(0, `noise`).

    The covariance is updated in Joseph's form, which stays positive definite in float32. Each block of components
    is gated on its own, by its deviation from the belief before the measurement.

    Args:
        value: NaN components are missing and say nothing.
        gate: chance at which a right block is rejected: one whose squared Mahalanobis distance is so great that
            chi-square exceeds it more seldom is not believed. 0 believes all.
        blocks: sizes of the blocks, in order; one block by default.

    Returns:
        A row whose innovation covariance is not positive definite (NaN, or no noise on what is known exactly)
        keeps its belief, and its components are `rejected`.

    Raises:
        ValueError: a size or `gate` is wrong.
    """
    measures = value.shape[-1]
    blocks = (measures,) if blocks is None else tuple(blocks)
    if sum(blocks) != measures or min(blocks, default=0) < 1:
        raise ValueError(
            f"the blocks must be positive and add up to the {measures} components, got {tuple(blocks)}"
        )
    if not 0 <= gate < 1:
        raise ValueError(f"gate must be a chance in [0, 1), got {gate}; 0.001 rejects one of 1000 right ones")
    expected, jacobian = linearised(model, belief.mean)
    if expected.shape[-1] != measures:
        raise ValueError(
            f"the model must give {measures} components like the measurement, got {expected.shape[-1]}"
        )
    batch = torch.broadcast_shapes(value.shape[:-1], expected.shape[:-1], noise.shape[:-2])
    there = ~value.isnan().expand(*batch, measures)
    residual = value - expected

    innovation = _innovation(belief, jacobian, noise, residual, there)
    deviation, believed = [], []
    for start, size in zip(_starts(blocks), blocks, strict=True):
        own = slice(start, start + size)
        count = there[..., own].sum(-1)
        part = innovation.covariance[..., own, own]
        factor, bad = torch.linalg.cholesky_ex(part)
        square = _squared(factor, innovation.mean[..., own]).where(bad == 0, torch.inf)
        deviation.append(square.where(count > 0, 0.0))
        chance = torch.special.gammaincc((0.5 * count).clamp_min(0.5).to(square), 0.5 * square.detach())
        believed.append(((chance >= gate) & (bad == 0))[..., None].expand(*batch, size))
    used = there & torch.cat(believed, -1)

    whole, bad = torch.linalg.cholesky_ex(innovation.covariance)
    log_likelihood = -0.5 * (
        _squared(whole, innovation.mean)
        + 2 * whole.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        + there.sum(-1) * math.log(2 * math.pi)
    )
    log_likelihood = log_likelihood.where((bad == 0) & ~log_likelihood.isnan(), -torch.inf)

    innovation = _innovation(belief, jacobian, noise, residual, used)
    factor, bad = torch.linalg.cholesky_ex(innovation.covariance)
    used = used & (bad == 0)[..., None]
    kept = jacobian * used[..., None]
    gain = torch.cholesky_solve(kept @ belief.covariance, _safe(factor, bad)).mT
    left = torch.eye(belief.mean.shape[-1]).to(gain) - gain @ kept
    mean = belief.mean + (gain @ innovation.mean[..., None])[..., 0]
    covariance = left @ belief.covariance @ left.mT + gain @ _only(noise, used, 0.0) @ gain.mT
    works = used.any(-1)
    belief = Gaussian(
        torch.where(works[..., None], mean, belief.mean),
        torch.where(works[..., None, None], _symmetric(covariance), belief.covariance),
    )
    return Update(belief, used, there & ~used, log_likelihood, torch.stack(deviation, -1))


def kalman_filter(
    start: Gaussian,
    values: Float[Tensor, "*#batch time measures"],
    transition: Float[Tensor, "*#batch steps n n"],
    transition_noise: Float[Tensor, "*#batch noises n n"],
    model: Model,
    noise: Float[Tensor, "*#batch time measures measures"],
    gate: float = 0.0,
    blocks: Sequence[int] | None = None,
) -> Filtered:
    """A whole sequence, from the belief at its first measurement on; `transition` has one step less than `values`.

    A matrix `model` is the same at all times. Differentiable.

    Raises:
        ValueError: the numbers of steps do not fit, there is no measurement, or as in `kalman_update`.
    """
    time = values.shape[-2]
    if time == 0 or transition.shape[-3] != time - 1 or transition_noise.shape[-3] != time - 1:
        raise ValueError(
            f"there must be one step between each two of at least one measurements, got {time} measurements, "
            f"{transition.shape[-3]} transitions and {transition_noise.shape[-3]} of their noises"
        )
    belief, before, after = start, [], []
    noise = noise.expand(*noise.shape[:-3], time, *noise.shape[-2:])
    for t in range(time):
        if t > 0:
            belief = kalman_predict(belief, transition[..., t - 1, :, :], transition_noise[..., t - 1, :, :])
        before.append(belief)
        after.append(kalman_update(belief, values[..., t, :], model, noise[..., t, :, :], gate, blocks))
        belief = after[-1].belief
    return Filtered(
        stack_beliefs(before),
        stack_beliefs([update.belief for update in after]),
        torch.stack([update.used for update in after], -2),
        torch.stack([update.rejected for update in after], -2),
        torch.stack([update.log_likelihood for update in after], -1),
    )


def kalman_smoother(
    filtered: Gaussian,
    predicted: Float[Tensor, "*batch time n"],
    transition: Float[Tensor, "*#batch steps n n"],
    noise: Float[Tensor, "*#batch noises n n"],
) -> Gaussian:
    """What the whole sequence tells of each moment, by Rauch, Tung and Striebel, back from the last.

    In the form that stays positive definite. Where the transition is not linear, its Jacobians are given.

    Args:
        filtered: (*batch, time, n), given the measurements up to each moment.
        predicted: means given the measurements before each moment; the first is of no account.
        transition: from each moment to the next.
        noise: covariance of each of these steps.
    """
    time = filtered.mean.shape[-2]
    if transition.shape[-3] != time - 1 or noise.shape[-3] != time - 1:
        raise ValueError(
            f"there must be {time - 1} steps between {time} moments, got {transition.shape[-3]} transitions "
            f"and {noise.shape[-3]} noises"
        )
    smoothed = [Gaussian(filtered.mean[..., -1, :], filtered.covariance[..., -1, :, :])]
    identity = torch.eye(filtered.mean.shape[-1]).to(filtered.mean)
    for t in range(time - 2, -1, -1):
        own, move, spread = (x[..., t, :, :] for x in (filtered.covariance, transition, noise))
        onward = move @ own
        factor, bad = torch.linalg.cholesky_ex(_symmetric(onward @ move.mT + spread))
        gain = torch.cholesky_solve(onward, _safe(factor, bad)).mT
        gain = torch.where((bad == 0)[..., None, None], gain, torch.nan)
        later = smoothed[-1]
        mean = filtered.mean[..., t, :] + (gain @ (later.mean - predicted[..., t + 1, :])[..., None])[..., 0]
        left = identity - gain @ move
        covariance = left @ own @ left.mT + gain @ (spread + later.covariance) @ gain.mT
        smoothed.append(Gaussian(mean, _symmetric(covariance)))
    return stack_beliefs(smoothed[::-1])


def linearised(model: Model, mean: Float[Tensor, "*batch n"]) -> tuple[Tensor, Tensor]:
    """Value and Jacobian of a model at a mean."""
    if isinstance(model, Tensor):
        if model.shape[-1] != mean.shape[-1]:
            raise ValueError(
                f"the model's matrix must have {mean.shape[-1]} columns, one a state, got {model.shape[-1]}"
            )
        return (model @ mean[..., None])[..., 0], model
    return model(mean)


def stack_beliefs(beliefs: Sequence[Gaussian]) -> Gaussian:
    """Beliefs of successive moments as one, with the axis of time behind the batch's."""
    return Gaussian(
        torch.stack([belief.mean for belief in beliefs], -2),
        torch.stack([belief.covariance for belief in beliefs], -3),
    )


def _innovation(
    belief: Gaussian, jacobian: Tensor, noise: Tensor, residual: Tensor, chosen: Tensor
) -> Gaussian:
    """The chosen components of the residual and their covariance; the others 0 with variance 1, and alone."""
    covariance = jacobian @ belief.covariance @ jacobian.mT + noise
    return Gaussian(torch.where(chosen, residual, 0.0), _symmetric(_only(covariance, chosen, 1.0)))


def _only(matrix: Tensor, chosen: Tensor, rest: float) -> Tensor:
    """Rows and columns of the chosen; `rest` on the diagonal and 0 beside it for the others."""
    both = chosen[..., :, None] & chosen[..., None, :]
    return torch.where(both, matrix, torch.diag_embed(torch.where(chosen, 0.0, rest).to(matrix)))


def _squared(factor: Tensor, vector: Tensor) -> Tensor:
    """v^T (L L^T)^-1 v."""
    return torch.linalg.solve_triangular(factor, vector[..., None], upper=False)[..., 0].square().sum(-1)


def _safe(factor: Tensor, bad: Tensor) -> Tensor:
    """Factors with the identity in the place of those that failed, whose answers are thrown away."""
    return torch.where((bad == 0)[..., None, None], factor, torch.eye(factor.shape[-1]).to(factor))


def _starts(blocks: Sequence[int]) -> list[int]:
    return [sum(blocks[:index]) for index in range(len(blocks))]


def _symmetric(matrix: Tensor) -> Tensor:
    return 0.5 * (matrix + matrix.mT)
