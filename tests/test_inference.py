"""Inference in HMMs against the sum over all paths."""

import pytest
import torch
from enumerated_hmm import log_joint, random_parameters, symbols_of
from torch.testing import assert_close

from torchpose.activity.baum_welch import (
    MISSING,
    Topology,
    emission_scores,
    mask_padding,
)
from torchpose.activity.inference import hmm_backward, hmm_filter, hmm_smoother, viterbi

SHAPES = pytest.mark.parametrize(
    ("states", "time", "topology"),
    [
        (1, 3, Topology.ergodic),
        (2, 1, Topology.ergodic),
        (2, 6, Topology.left_to_right),
        (3, 5, Topology.ergodic),
        (4, 5, Topology.left_to_right),
    ],
)


@SHAPES
def test_inference_matches_enumeration(states, time, topology):
    model = random_parameters(3, states, 5, topology)
    scores = emission_scores(model.log_emission, symbols_of(2, time, 5, missing=0.2))  # (3, 2, T, K)
    arguments = (model.log_initial[:, None], model.log_transition[:, None], scores)
    paths, joint = log_joint(*arguments)  # (P, T), (3, 2, P)
    evidence = joint.logsumexp(-1)
    weight = (joint - evidence[..., None]).exp()
    visits = torch.nn.functional.one_hot(paths, states).to(weight)  # (P, T, K)
    pairs = torch.einsum("msp,pti,ptj->mstij", weight, visits[:, :-1], visits[:, 1:])

    smoothed = hmm_smoother(*arguments)
    assert_close(smoothed.log_likelihood, evidence)
    assert_close(smoothed.states, torch.einsum("msp,ptk->mstk", weight, visits))
    assert_close(smoothed.pairs, pairs)
    assert_close(hmm_filter(*arguments).log_likelihood, evidence)

    decoded = viterbi(*arguments)
    assert_close(decoded.log_probability, joint.amax(-1))
    assert_close(decoded.states, paths[joint.argmax(-1)])


@SHAPES
def test_filter_and_backward_see_the_past_and_the_future_only(states, time, topology):
    model = random_parameters(2, states, 4, topology)
    scores = emission_scores(model.log_emission, symbols_of(1, time, 4)).squeeze(1)
    log_filtered = hmm_filter(model.log_initial, model.log_transition, scores).log_filtered
    log_beta = hmm_backward(model.log_transition, scores)
    for t in range(time):
        paths, joint = log_joint(model.log_initial, model.log_transition, scores[:, : t + 1])
        here = torch.nn.functional.one_hot(paths[:, t], states).to(joint)
        assert_close(log_filtered[:, t].exp(), joint.softmax(-1) @ here)
        # p(y_t+1:T | z_t = k): start in state k with nothing observed at t.
        future = scores[:, t:].clone()
        future[:, 0] = 0
        for state in range(states):
            start = torch.full((states,), -torch.inf, dtype=torch.float64)
            start[state] = 0
            _, joint = log_joint(start, model.log_transition, future)
            assert_close(log_beta[:, t, state], joint.logsumexp(-1))


def test_viterbi_stops_at_the_end_of_each_sequence():
    model = random_parameters(1, 3, 4)
    arguments = (model.log_initial, model.log_transition)
    symbols, lengths = symbols_of(20, 6, 4), torch.randint(1, 7, (20,))
    scores = emission_scores(model.log_emission, mask_padding(symbols, lengths))[0]
    decoded = viterbi(*arguments, scores, lengths)
    for s, length in enumerate(lengths.tolist()):
        paths, joint = log_joint(model.log_initial[0], model.log_transition[0], scores[s, :length])
        assert decoded.states[s, :length].tolist() == paths[joint.argmax()].tolist()
        assert (decoded.states[s, length:] == -1).all()
        assert_close(decoded.log_probability[s], joint.max())


def test_a_long_sequence_stays_exact_where_scaling_would_lose_a_state():
    """A two-state left-to-right path is known by when it leaves, so 5,000 frames can be enumerated.

    For 2,000 frames the second state explains the symbols far better, by e^3200 in all: scaled probabilities
    lose the first state. Then come symbols that only the first can emit.
    """
    time = 5000
    stay = torch.tensor([[0.999, 0.001], [0.0, 1.0]], dtype=torch.float64).log()
    start = torch.tensor([1.0, 0.0], dtype=torch.float64).log()
    emission = torch.tensor([[0.1, 0.6, 0.3], [0.5, 1e-300, 0.5]], dtype=torch.float64)
    symbols = torch.full((1, time), 0)
    symbols[0, 2000:3000], symbols[0, 3000:] = 1, 2
    scores = emission_scores(emission.log(), symbols)[0]

    frames = torch.arange(time)
    first = scores[:, 0].cumsum(0) + frames * stay[0, 0]
    second = scores[:, 1].flip(0).cumsum(0).flip(0)
    leaves = first[:-1] + stay[0, 1] + second[1:]
    joint = torch.cat([leaves, first[-1:]])
    assert_close(hmm_filter(start, stay, scores).log_likelihood, joint.logsumexp(0), rtol=1e-12, atol=0)
    decoded = viterbi(start, stay, scores)
    assert_close(decoded.log_probability, joint.max(), rtol=1e-12, atol=0)
    assert decoded.states.sum() == time - 1 - joint.argmax()
    smoothed = hmm_smoother(start, stay, scores)
    assert smoothed.states.isfinite().all()
    assert_close(smoothed.states.sum(-1), torch.ones(time, dtype=torch.float64), rtol=0, atol=1e-9)


@pytest.mark.parametrize("topology", list(Topology))
def test_gradient_of_the_likelihood_is_the_posterior(topology):
    model = random_parameters(2, 3, 4, topology)
    scores = emission_scores(model.log_emission, symbols_of(1, 6, 4)).squeeze(1).requires_grad_()
    filtered = hmm_filter(model.log_initial, model.log_transition, scores)
    (gradient,) = torch.autograd.grad(filtered.log_likelihood.sum(), scores)
    assert_close(gradient, hmm_smoother(model.log_initial, model.log_transition, scores).states)
    assert torch.autograd.gradcheck(
        lambda x: hmm_filter(model.log_initial, model.log_transition, x).log_likelihood, scores
    )


def test_the_faster_sum_without_gradients_is_the_same():
    model = random_parameters(2, 4, 4, Topology.left_to_right)
    scores = emission_scores(model.log_emission, symbols_of(3, 9, 4, missing=0.2))
    arguments = (model.log_initial[:, None], model.log_transition[:, None], scores)
    with_gradients = hmm_smoother(*arguments)
    with torch.no_grad():
        without = hmm_smoother(*arguments)
    assert_close(without.log_likelihood, with_gradients.log_likelihood, rtol=1e-13, atol=0)
    assert_close(without.pairs, with_gradients.pairs, rtol=1e-11, atol=0)


def test_a_missing_symbol_is_summed_over():
    model = random_parameters(1, 3, 4)
    symbols = torch.tensor([[1, MISSING, 2, 0]])
    every = symbols.repeat(4, 1)
    every[:, 1] = torch.arange(4)

    def evidence(sequences):
        scores = emission_scores(model.log_emission, sequences)
        return hmm_filter(model.log_initial[:, None], model.log_transition[:, None], scores).log_likelihood

    assert_close(evidence(symbols)[0, 0], evidence(every)[0].logsumexp(0))
