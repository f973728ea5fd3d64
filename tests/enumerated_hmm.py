"""Random hidden Markov models and every path of them, for tests against the definition."""

import itertools

import torch

from torchpose.activity.baum_welch import (
    MISSING,
    Parameters,
    Topology,
)


def random_parameters(models, states, num_symbols, topology=Topology.ergodic):
    """Log-parameters with structural zeros where the topology has them."""

    def rows(*shape, allowed=None):
        weights = torch.rand(*shape, dtype=torch.float64) + 0.1
        weights = weights if allowed is None else weights * allowed
        return (weights / weights.sum(-1, keepdim=True)).log()

    start = move = None
    if topology is Topology.left_to_right:
        start = torch.eye(states)[0]
        move = torch.eye(states) + torch.eye(states).roll(1, dims=1).triu()
    return Parameters(
        rows(models, states, allowed=start),
        rows(models, states, states, allowed=move),
        rows(models, states, num_symbols),
    )


def log_joint(log_initial, log_transition, log_emission):
    """Every path's log p(z, y), by enumeration: the definition, and the oracle. Batch axes first."""
    time, states = log_emission.shape[-2:]
    paths = torch.tensor(list(itertools.product(range(states), repeat=time)))
    prior = log_initial[..., paths[:, 0]] + log_transition[..., paths[:, :-1], paths[:, 1:]].sum(-1)
    return paths, prior + log_emission[..., torch.arange(time), paths].sum(-1)


def symbols_of(sequences, time, num_symbols, missing=0.0):
    symbols = torch.randint(num_symbols, (sequences, time))
    return torch.where(torch.rand(sequences, time) < missing, MISSING, symbols)
