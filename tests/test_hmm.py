"""Training and scoring of HMMs against enumerated counts, hmmlearn, and properties of EM."""

import itertools
import warnings

import pytest
import torch
from enumerated_hmm import log_joint, random_parameters, symbols_of
from hmmlearn.hmm import CategoricalHMM
from torch.testing import assert_close

from torchpose.activity import hmm
from torchpose.activity.baum_welch import (
    MISSING,
    HMMConfig,
    Parameters,
    Status,
    Topology,
    baum_welch,
    emission_scores,
    equal_segments,
    mask_padding,
)
from torchpose.activity.hmm import DiscreteHMM
from torchpose.activity.inference import hmm_filter, hmm_smoother

NO_SMOOTHING = {"emission_prior": 1.0, "transition_prior": 1.0}


@pytest.mark.parametrize("topology", list(Topology))
@pytest.mark.parametrize("prior", [1.0, 1.3])
def test_one_round_of_baum_welch_matches_enumerated_counts(topology, prior):
    states, num_symbols, time = 3, 4, 5
    start = random_parameters(2, states, num_symbols, topology)
    symbols, lengths = symbols_of(6, time, num_symbols, missing=0.2), torch.tensor([5, 3, 1, 4, 5, 2])
    labels = torch.tensor([0, 1, 0, 1, 1, 0])
    config = HMMConfig(
        states, topology, emission_prior=prior, transition_prior=prior, iterations=1, tolerance=0.0
    )
    fitted = baum_welch(start, symbols, lengths, labels, config).parameters

    for model in range(2):
        starts, moves = torch.zeros(states).double(), torch.zeros(states, states).double()
        emitted = torch.zeros(states, num_symbols).double()
        for sequence, length, label in zip(symbols, lengths.tolist(), labels.tolist(), strict=True):
            if label != model:
                continue
            scores = emission_scores(start.log_emission[model], sequence[None, :length])[0]
            paths, joint = log_joint(start.log_initial[model], start.log_transition[model], scores)
            for path, weight in zip(paths.tolist(), joint.softmax(0), strict=True):
                starts[path[0]] += weight
                for before, after in itertools.pairwise(path):
                    moves[before, after] += weight
                for state, symbol in zip(path, sequence[:length].tolist(), strict=True):
                    if symbol != MISSING:
                        emitted[state, symbol] += weight

        def mode(counts, allowed, before):
            weights = torch.where(allowed, counts + prior - 1, 0.0)
            rows = weights.sum(-1, keepdim=True)
            return torch.where(rows > 0, weights / rows, before)

        for name, counts in (("log_initial", starts), ("log_transition", moves), ("log_emission", emitted)):
            before = getattr(start, name)[model].exp()
            assert_close(getattr(fitted, name)[model].exp(), mode(counts, before > 0, before))


def stream_scores(log_emission, sequence, weights=None):
    """log p(y_t | z_t) (T, K) of one model (R, K, V) and one sequence (T, R), by loops."""
    time, streams = sequence.shape
    scores = torch.zeros(time, log_emission.shape[1], dtype=torch.float64)
    for t in range(time):
        for r in range(streams):
            if sequence[t, r] != MISSING:
                share = 1.0 if weights is None else weights[t, r]
                scores[t] += share * log_emission[r, :, sequence[t, r]]
    return scores


def random_streams(models, states, streams, num_symbols, topology):
    one = random_parameters(models, states, num_symbols, topology)
    more = [random_parameters(models, states, num_symbols).log_emission for _ in range(streams)]
    return Parameters(one.log_initial, one.log_transition, torch.stack(more, dim=1))


def bank_of(parameters, config=HMMConfig()):  # noqa: B008 (frozen)
    models, *streams, _, num_symbols = parameters.log_emission.shape
    bank = DiscreteHMM(models, num_symbols, config, streams=tuple(streams))
    for name, value in vars(parameters).items():
        setattr(bank, name, value)
    return bank


@pytest.mark.parametrize("topology", list(Topology))
@pytest.mark.parametrize("weighted", [False, True])
def test_streams_and_weights_match_enumeration(topology, weighted):
    """Scores, posteriors, paths, and one round of training with Dirichlet priors."""
    states, streams, num_symbols, prior = 3, 2, 4, 1.3
    start = random_streams(2, states, streams, num_symbols, topology)
    symbols = torch.randint(num_symbols, (6, 5, streams))
    symbols[torch.rand(symbols.shape) < 0.2] = MISSING
    weights = torch.rand(symbols.shape, dtype=torch.float64) if weighted else None
    lengths, labels = torch.tensor([5, 3, 1, 4, 5, 2]), torch.tensor([0, 1, 0, 1, 1, 0])
    config = HMMConfig(states, topology, prior, prior, iterations=1, tolerance=0.0)
    bank = bank_of(start, config)
    fitted = baum_welch(start, symbols, lengths, labels, config, weights)
    scores = bank.log_likelihood(symbols, lengths, weights)
    decoded = bank.decode(symbols, lengths, labels, weights)
    smoothed = bank.smooth(symbols, lengths, labels, weights)

    total = torch.zeros(2).double()
    for model in range(2):
        starts, moves = torch.zeros(states).double(), torch.zeros(states, states).double()
        emitted = torch.zeros(streams, states, num_symbols).double()
        for s, (sequence, length, label) in enumerate(
            zip(symbols, lengths.tolist(), labels.tolist(), strict=True)
        ):
            share = None if weights is None else weights[s]
            emission = stream_scores(start.log_emission[model], sequence[:length], share)
            paths, joint = log_joint(start.log_initial[model], start.log_transition[model], emission)
            assert_close(scores[s, model], joint.logsumexp(0), rtol=1e-12, atol=1e-12)
            if label != model:
                continue
            total[model] += joint.logsumexp(0)
            assert decoded.states[s, :length].tolist() == paths[joint.argmax()].tolist()
            visits = torch.nn.functional.one_hot(paths, states).to(joint)
            assert_close(smoothed.states[s, :length], torch.einsum("p,ptk->tk", joint.softmax(0), visits))
            for path, weight in zip(paths.tolist(), joint.softmax(0), strict=True):
                starts[path[0]] += weight
                for before, after in itertools.pairwise(path):
                    moves[before, after] += weight
                for t, state in enumerate(path):
                    for r in range(streams):
                        if sequence[t, r] != MISSING:
                            emitted[r, state, sequence[t, r]] += weight * (
                                1 if share is None else share[t, r]
                            )

        for name, counts in (("log_initial", starts), ("log_transition", moves), ("log_emission", emitted)):
            allowed = getattr(start, name)[model].exp() > 0
            expected = torch.where(allowed, counts + prior - 1, 0.0)
            expected = expected / expected.sum(-1, keepdim=True)
            assert_close(getattr(fitted.parameters, name)[model].exp(), expected)
    priors = sum(
        (prior - 1) * rows[rows > -torch.inf].sum()
        for rows in (start.log_initial, start.log_transition, start.log_emission)
    )
    assert_close(fitted.objective[0].sum(), total.sum() + priors)


def test_two_streams_match_hmmlearn_on_the_product_of_their_symbols():
    """One state's pairs of independent symbols are one symbol of a model whose table is the product."""
    start = random_streams(2, 4, 2, 3, Topology.left_to_right)
    symbols = torch.randint(3, (5, 40, 2))
    scores = bank_of(start).log_likelihood(symbols, torch.full((5,), 40))
    for model in range(2):
        oracle = CategoricalHMM(4, n_features=9)
        oracle.startprob_ = start.log_initial[model].exp().numpy()
        oracle.transmat_ = start.log_transition[model].exp().numpy()
        first, second = start.log_emission[model].exp()
        oracle.emissionprob_ = (first[:, :, None] * second[:, None]).flatten(1).numpy()
        for s, sequence in enumerate(symbols):
            pairs = (3 * sequence[:, 0] + sequence[:, 1])[:, None].numpy()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # log 0 of the structural zeros
                expected = oracle.score(pairs)
            assert abs(float(scores[s, model]) - expected) < 1e-10


def test_a_weight_of_zero_is_a_missing_symbol_and_of_one_none():
    start = random_streams(2, 3, 2, 4, Topology.ergodic)
    symbols, lengths = torch.randint(4, (3, 8, 2)), torch.tensor([8, 5, 1])
    weights = (torch.rand(symbols.shape) < 0.6).double()
    weights[2, 1:] = torch.nan  # of padding nothing is asked
    bank = bank_of(start)
    missing = torch.where(weights > 0, symbols, MISSING)
    assert_close(bank.log_likelihood(symbols, lengths, weights), bank.log_likelihood(missing, lengths))


@pytest.mark.parametrize("topology", list(Topology))
def test_where_plain_probabilities_fall_out_of_range_logarithms_take_over(topology, monkeypatch):
    """Of two symbols that take turns, states emit one each; a wrong one costs 46 nats and a move 120."""
    start = random_parameters(2, 3, 4, topology)
    emission, transition = start.log_emission.clone(), start.log_transition.clone()
    emission[1, :2, 0], emission[1, 2, 0] = 0.0, -46.0
    emission[1, :2, 1], emission[1, 2, 1] = -46.0, 0.0
    transition[1] = torch.where(torch.eye(3) > 0, 0.0, transition[1] - 120)
    start = Parameters(start.log_initial, transition, emission)
    symbols = torch.randint(4, (3, 80))
    symbols[1] = torch.arange(80) // 10 % 2
    lengths = torch.tensor([80, 80, 60])
    scores = emission_scores(emission, mask_padding(symbols, lengths))
    exact = hmm_filter(start.log_initial[:, None], start.log_transition[:, None], scores).log_likelihood.T
    assert_close(bank_of(start).log_likelihood(symbols, lengths), exact, rtol=1e-12, atol=0)

    with monkeypatch.context() as patch:  # it is out of range, and that shows
        patch.setattr(hmm, "exact_above", lambda dtype: -1.0)
        with pytest.warns(RuntimeWarning, match="1 of 6 scores are minus infinity"):
            assert torch.isneginf(bank_of(start).log_likelihood(symbols, lengths)[1, 1])

    labels = torch.tensor([0, 1, 1])
    config = HMMConfig(3, topology, **NO_SMOOTHING, iterations=1, tolerance=0.0)
    fitted = baum_welch(start, symbols, lengths, labels, config)
    assert_close(
        fitted.objective[0], torch.stack([exact[0, 0], exact[1, 1] + exact[2, 1]]), rtol=1e-12, atol=0
    )
    smoothed = hmm_smoother(
        start.log_initial[labels], start.log_transition[labels], scores[labels, torch.arange(3)]
    )
    inside = torch.arange(80) < lengths[:, None]
    visits = torch.einsum(
        "stk,stv->skv", smoothed.states * inside[..., None], torch.nn.functional.one_hot(symbols, 4).double()
    )
    counts = torch.stack([visits[0], visits[1] + visits[2]])
    assert_close(
        fitted.parameters.log_emission.exp(), counts / counts.sum(-1, keepdim=True), rtol=1e-9, atol=1e-15
    )


def test_durations_are_the_mean_stay():
    bank = DiscreteHMM(1, 2, HMMConfig(3))
    stay = torch.tensor([0.9, 0.5, 1.0], dtype=torch.float64)
    bank.log_transition = (torch.diag(stay) + torch.diag(1 - stay[:2], 1)).log()[None]
    assert_close(bank.durations[0], torch.tensor([10, 2, torch.inf]).double())


@pytest.mark.parametrize("topology", list(Topology))
def test_baum_welch_matches_hmmlearn(topology):
    states, num_symbols, iterations = 4, 6, 12
    start = random_parameters(1, states, num_symbols, topology)
    lengths = torch.tensor([17, 30, 8, 25])
    symbols = symbols_of(4, 30, num_symbols)
    config = HMMConfig(states, topology, **NO_SMOOTHING, iterations=iterations, tolerance=0.0)
    fitted = baum_welch(start, symbols, lengths, torch.zeros_like(lengths), config)

    oracle = CategoricalHMM(states, n_iter=iterations, tol=-float("inf"), init_params="", algorithm="viterbi")
    oracle.startprob_ = start.log_initial[0].exp().numpy()
    oracle.transmat_ = start.log_transition[0].exp().numpy()
    oracle.emissionprob_ = start.log_emission[0].exp().numpy()
    flat = torch.cat([row[:n] for row, n in zip(symbols, lengths.tolist(), strict=True)])[:, None].numpy()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # log 0 of the structural zeros
        oracle.fit(flat, lengths.numpy())
        score = oracle.score(flat, lengths.numpy())

    tolerance = {"rtol": 1e-10, "atol": 1e-10}
    history = torch.tensor(list(oracle.monitor_.history), dtype=torch.float64)
    assert_close(fitted.objective[:, 0], history, **tolerance)
    assert_close(fitted.parameters.log_initial[0].exp(), torch.from_numpy(oracle.startprob_), **tolerance)
    assert_close(fitted.parameters.log_transition[0].exp(), torch.from_numpy(oracle.transmat_), **tolerance)
    assert_close(fitted.parameters.log_emission[0].exp(), torch.from_numpy(oracle.emissionprob_), **tolerance)
    scores = emission_scores(fitted.parameters.log_emission, mask_padding(symbols, lengths))
    evidence = hmm_filter(fitted.parameters.log_initial, fitted.parameters.log_transition, scores)
    assert_close(evidence.log_likelihood.sum(), torch.tensor(score, dtype=torch.float64), **tolerance)


def test_a_long_likelihood_matches_hmmlearn():
    model = random_parameters(1, 4, 6)
    symbols = symbols_of(1, 5000, 6)
    scores = emission_scores(model.log_emission, symbols)
    oracle = CategoricalHMM(4)
    oracle.startprob_ = model.log_initial[0].exp().numpy()
    oracle.transmat_ = model.log_transition[0].exp().numpy()
    oracle.emissionprob_ = model.log_emission[0].exp().numpy()
    expected = torch.tensor(oracle.score(symbols.T.numpy()), dtype=torch.float64)
    found = hmm_filter(model.log_initial[:, None], model.log_transition[:, None], scores).log_likelihood
    assert_close(found[0, 0], expected, rtol=1e-12, atol=0)
    in_single = hmm_filter(
        model.log_initial[0].float(), model.log_transition[0].float(), scores[0, 0].float()
    ).log_likelihood
    assert_close(in_single.double(), expected, rtol=1e-5, atol=0)


@pytest.mark.parametrize("topology", list(Topology))
@pytest.mark.parametrize("prior", [1.0, 1.01, 2.0])
def test_the_objective_never_falls_and_structural_zeros_stay(topology, prior):
    symbols, lengths = symbols_of(24, 20, 7, missing=0.1), torch.randint(1, 21, (24,))
    labels = torch.arange(24) % 3
    config = HMMConfig(4, topology, prior, prior, iterations=40, tolerance=0.0)
    start = equal_segments(symbols, lengths, labels, 3, 7, config, torch.Generator().manual_seed(1))
    fitted = baum_welch(start, symbols, lengths, labels, config)
    assert fitted.objective.isfinite().all()
    assert (fitted.objective.diff(dim=0) >= -1e-9).all()
    assert (fitted.objective[-1] > fitted.objective[0] + 1).all()  # and it does learn, 1 nat at least
    for rows in (fitted.parameters.log_initial, fitted.parameters.log_transition):
        assert_close(rows.exp().sum(-1), torch.ones_like(rows[..., 0]))
    assert_close(fitted.parameters.log_emission.exp().sum(-1), torch.ones(3, 4, dtype=torch.float64))
    if topology is Topology.left_to_right:
        assert torch.isneginf(fitted.parameters.log_transition[:, 2, [0, 1]]).all()
        assert torch.isneginf(fitted.parameters.log_initial[:, 1:]).all()


def test_models_of_a_bank_are_fitted_as_if_alone():
    symbols, lengths = symbols_of(30, 25, 8), torch.randint(2, 26, (30,))
    labels = torch.arange(30) % 3
    config = HMMConfig(iterations=100, tolerance=1e-3)  # models converge after different numbers of rounds
    start = equal_segments(symbols, lengths, labels, 3, 8, config, torch.Generator().manual_seed(1))
    together = baum_welch(start, symbols, lengths, labels, config)
    assert len(set(together.iterations.tolist())) > 1
    assert (together.status == Status.CONVERGED).all()
    for model in range(3):
        own = labels == model
        longest = int(lengths[own].max())
        alone = baum_welch(
            Parameters(*(getattr(start, name)[model : model + 1] for name in vars(start))),
            symbols[own, :longest],
            lengths[own],
            torch.zeros_like(lengths[own]),
            config,
        )
        assert alone.iterations[0] == together.iterations[model]
        for name in vars(start):
            assert_close(getattr(alone.parameters, name)[0], getattr(together.parameters, name)[model])


def test_scores_of_a_padded_batch_are_those_of_each_sequence():
    hmm = DiscreteHMM(3, 6, HMMConfig(iterations=5))
    symbols, lengths = symbols_of(12, 15, 6, missing=0.1), torch.randint(1, 16, (12,))
    hmm.fit(symbols, lengths, torch.arange(12) % 3)
    garbage = torch.where(torch.arange(15) < lengths[:, None], symbols, 10**6)  # padding is never looked at
    scores = hmm.log_likelihood(garbage, lengths)
    decoded = hmm.decode(garbage, lengths, torch.arange(12) % 3)
    for s, length in enumerate(lengths.tolist()):
        one = symbols[s : s + 1, :length], lengths[s : s + 1]
        assert_close(scores[s], hmm.log_likelihood(*one)[0])
        assert_close(decoded.states[s, :length], hmm.decode(*one, torch.tensor([s % 3])).states[0])


def test_a_known_left_to_right_model_is_found():
    """Four phases, each with a symbol of its own in nine frames of ten: training must find both."""
    generator = torch.Generator().manual_seed(3)
    phase = torch.arange(40) // 10
    noisy = torch.rand(50, 40, generator=generator) < 0.1
    symbols = torch.where(noisy, torch.randint(4, 8, (50, 40), generator=generator), phase)
    hmm = DiscreteHMM(1, 8, HMMConfig())
    fitted = hmm.fit(symbols, torch.full((50,), 40), torch.zeros(50, dtype=torch.long))
    assert fitted.status.tolist() == [Status.CONVERGED]
    share = hmm.log_emission[0].exp()
    assert_close(share[range(4), range(4)], torch.full((4,), 0.9).double(), rtol=0, atol=0.03)
    stay = hmm.log_transition[0].exp().diagonal()
    assert_close(stay[:3], torch.full((3,), 0.9).double(), rtol=0, atol=0.01)
    states = hmm.decode(symbols, torch.full((50,), 40), torch.zeros(50, dtype=torch.long)).states
    assert (states == phase).float().mean() > 0.97  # a noisy frame at a border may fall to either side


def test_an_unseen_symbol_is_finite_with_smoothing_and_never_silent_without():
    symbols, lengths = torch.tensor([[0, 0, 1, 1]]), torch.tensor([4])
    unseen = torch.tensor([[0, 2, 1, 1]])
    smoothed = DiscreteHMM(1, 3, HMMConfig(2))
    smoothed.fit(symbols, lengths, torch.tensor([0]))
    assert smoothed.log_likelihood(unseen, lengths).isfinite().all()
    assert smoothed.log_likelihood(unseen, lengths) < smoothed.log_likelihood(symbols, lengths)

    hard = DiscreteHMM(1, 3, HMMConfig(2, **NO_SMOOTHING))
    hard.fit(symbols, lengths, torch.tensor([0]))
    assert hard.log_likelihood(symbols, lengths).isfinite().all()
    with pytest.warns(RuntimeWarning, match=r"1 of 1 scores are minus infinity.*emission_prior above 1"):
        assert torch.isneginf(hard.log_likelihood(unseen, lengths)).all()


def test_an_impossible_training_sequence_spoils_its_own_model_only():
    start = Parameters(
        torch.zeros(2, 1).double(),
        torch.zeros(2, 1, 1).double(),
        torch.tensor([[[0.5, 0.5, 0.0]], [[0.5, 0.25, 0.25]]]).double().log(),
    )
    symbols = torch.tensor([[0, 1, 2], [0, 1, 2]])
    config = HMMConfig(1, **NO_SMOOTHING)
    fitted = baum_welch(start, symbols, torch.tensor([3, 3]), torch.tensor([0, 1]), config)
    assert fitted.status.tolist() == [Status.IMPOSSIBLE, Status.CONVERGED]
    assert torch.isneginf(fitted.objective[:, 0]).all()
    assert fitted.objective[:, 1].isfinite().all()
    assert_close(fitted.parameters.log_emission[1].exp(), torch.full((1, 3), 1 / 3).double())
    assert "model 0: impossible" in fitted.summary()
    smoothed = hmm_smoother(
        start.log_initial[0], start.log_transition[0], start.log_emission[0, 0, symbols[0], None]
    )
    assert torch.isneginf(smoothed.log_likelihood)
    assert (smoothed.states == 0).all()


def test_models_without_data_or_time_say_so():
    symbols = torch.tensor([[0, 1, 0, 1, 1, 0], [MISSING] * 6])
    hmm = DiscreteHMM(3, 2, HMMConfig(2, iterations=1))
    fitted = hmm.fit(symbols, torch.tensor([6, 6]), torch.tensor([0, 1]))
    assert fitted.status.tolist() == [Status.MAX_ITERATIONS, Status.NO_DATA, Status.NO_DATA]
    assert_close(hmm.log_likelihood(symbols, torch.tensor([6, 6]))[1], torch.zeros(3).double())


@pytest.mark.parametrize("config", [HMMConfig(), HMMConfig(**NO_SMOOTHING)], ids=["smoothed", "not smoothed"])
def test_sequences_shorter_than_the_states_train(config):
    """In two frames a sequence gets no further than the second state, which must then know its symbol."""
    symbols, lengths = (
        torch.tensor([[0, 0, 1, 1, 2, 2, 3, 3], [0, 4, 0, 0, 0, 0, 0, 0]]),
        torch.tensor([8, 2]),
    )
    hmm = DiscreteHMM(1, 5, config)
    fitted = hmm.fit(symbols, lengths, torch.tensor([0, 0]))
    assert fitted.status.tolist() == [Status.CONVERGED]
    assert hmm.log_likelihood(symbols, lengths).isfinite().all()


def test_the_seed_decides_the_start():
    symbols, lengths, labels = symbols_of(4, 9, 5), torch.full((4,), 9), torch.zeros(4, dtype=torch.long)

    def start(seed):
        generator = torch.Generator().manual_seed(seed)
        return equal_segments(symbols, lengths, labels, 1, 5, HMMConfig(), generator).log_emission

    assert torch.equal(start(1), start(1))
    assert not torch.equal(start(1), start(2))


def test_bad_input_is_named():
    hmm = DiscreteHMM(2, 3)
    symbols, lengths, labels = torch.tensor([[0, 1, 2]]), torch.tensor([3]), torch.tensor([0])
    with pytest.raises(ValueError, match=r"symbols must lie in \[0, 3\).* got 0 to 3"):
        hmm.log_likelihood(torch.tensor([[0, 3, 2]]), lengths)
    with pytest.raises(ValueError, match=r"lengths must hold a number of frames in \[1, 3\].* got \[4\]"):
        hmm.log_likelihood(symbols, torch.tensor([4]))
    with pytest.raises(ValueError, match=r"lengths must .* got \[0\]"):
        hmm.fit(symbols, torch.tensor([0]), labels)
    with pytest.raises(ValueError, match=r"labels must name a model in \[0, 2\).* got \[2\]"):
        hmm.fit(symbols, lengths, torch.tensor([2]))
    with pytest.raises(
        ValueError, match=r"must have the shape \(sequences, time\) of the bank's streams, got \(1, 3, 2\)"
    ):
        hmm.log_likelihood(torch.zeros(1, 3, 2, dtype=torch.long), lengths)
    with pytest.raises(ValueError, match=r"weights must lie in \[0, 1\], .* got \(1, 3\) from 0 to 2"):
        hmm.fit(symbols, lengths, labels, weights=torch.tensor([[0.0, 1.0, 2.0]]))
    with pytest.raises(ValueError, match=r"a model, a symbol and a stream at least, got 1, 2 and \(0,\)"):
        DiscreteHMM(1, 2, streams=(0,))
    with pytest.raises(ValueError, match="states must be at least 1, got 0"):
        HMMConfig(states=0)
    with pytest.raises(ValueError, match="emission_prior and transition_prior must be at least 1"):
        HMMConfig(emission_prior=0.5)
    with pytest.raises(ValueError, match="tolerance and start_noise must not be negative"):
        HMMConfig(tolerance=-1.0)
    with pytest.raises(ValueError, match="must have at least one frame"):
        hmm_filter(torch.zeros(1), torch.zeros(1, 1), torch.zeros(0, 1))
