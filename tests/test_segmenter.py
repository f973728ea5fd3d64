"""Segments by explicit durations, against every segmentation that there is."""

import itertools
import math

import pytest
import torch
from torch.testing import assert_close

from torchpose.activity.segmenter import Chain, Segmenter, log_normal_hazard, segment_frames


def random_chain(seed, labels=3, states=2, ages=4, forbidden=0):
    """Random durations of `ages` frames at most before the constant hazard; none shorter than 1 + `forbidden`."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    change = torch.log_softmax(draw(labels, labels).fill_diagonal_(-torch.inf), -1)
    hazard = 0.05 + 0.9 * draw(labels, ages)
    hazard[:, :forbidden] = 0
    return Chain(
        log_start=torch.log_softmax(2 * draw(labels), -1),
        log_change=change,
        log_leave=hazard.log(),
        log_initial=torch.log_softmax(2 * draw(labels, states), -1),
        log_transition=torch.log_softmax(2 * draw(labels, states, states), -1),
    )


def random_emission(seed, time, labels=3, states=2):
    generator = torch.Generator().manual_seed(100 + seed)
    return 2 * torch.randn(time, labels, states, generator=generator, dtype=torch.float64)


def log_duration(chain, label, frames, over):
    """log p(duration = frames), or, where the recording ends first, log p(duration >= frames)."""
    ages = chain.log_leave.shape[1]
    hazard = [float(chain.log_leave[label, min(d, ages) - 1].exp()) for d in range(1, frames + 1)]
    stay = sum(math.log(1 - h) if h < 1 else -math.inf for h in hazard[:-1])
    return stay + (math.log(hazard[-1]) if over and hazard[-1] > 0 else -math.inf if over else 0.0)


def state_paths(chain, emission, label, first, end):
    """log p(states, frames | label) of every path through the label's states."""
    states = range(emission.shape[2])
    for path in itertools.product(states, repeat=end - first):
        score = float(chain.log_initial[label, path[0]])
        score += sum(float(chain.log_transition[label, i, j]) for i, j in itertools.pairwise(path))
        yield score + sum(float(emission[first + t, label, k]) for t, k in enumerate(path))


def every_segmentation(chain, emission):
    """(log-probability, labels by frame) of all segmentations, each by its best states; all paths are tried."""
    time, labels = emission.shape[:2]
    inner = {
        (label, first, end): max(state_paths(chain, emission, label, first, end))
        for label in range(labels)
        for first in range(time)
        for end in range(first + 1, time + 1)
    }
    for names in itertools.product(range(labels), repeat=time):
        cuts = [0, *(t for t in range(1, time) if names[t] != names[t - 1]), time]
        score = float(chain.log_start[names[0]])
        for first, end in itertools.pairwise(cuts):
            score += (
                log_duration(chain, names[first], end - first, end < time) + inner[names[first], first, end]
            )
            if end < time:
                score += float(chain.log_change[names[first], names[end]])
        yield score, names


def by_frame(segments):
    return [segment.label for segment in segments for _ in range(segment.start, segment.end)]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("ages", "forbidden"), [(4, 0), (12, 2), (1, 0), (3, 3)])
def test_the_best_of_all_segmentations_is_found(seed, ages, forbidden):
    chain, emission = (
        random_chain(seed, ages=ages, forbidden=min(forbidden, ages - 1)),
        random_emission(seed, 7),
    )
    best, labels = max(every_segmentation(chain, emission))
    segmenter = Segmenter(chain)
    segments = segmenter.push(emission) + segmenter.finish()
    assert by_frame(segments) == list(labels)
    assert_close(float(segmenter.log_probability), best, rtol=1e-12, atol=1e-12)
    assert [segment.end for segment in segments[:-1]] == [segment.start for segment in segments[1:]]


@pytest.mark.parametrize("seed", range(3))
def test_with_three_states_the_bands_go_the_right_way(seed):
    chain, emission = random_chain(seed, labels=2, states=3), random_emission(seed, 6, 2, 3)
    closed = chain.log_transition.clone()  # 0 -> 1 -> 2 -> 0
    closed[:, [0, 1, 2], [2, 0, 1]] = -torch.inf
    closed = torch.log_softmax(closed, -1)
    chain = Chain(chain.log_start, chain.log_change, chain.log_leave, chain.log_initial, closed)
    best, labels = max(every_segmentation(chain, emission))
    segmenter = Segmenter(chain)
    assert by_frame(segmenter.push(emission) + segmenter.finish()) == list(labels)
    assert_close(float(segmenter.log_probability), best, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("lag", [0, 1, 3])
def test_a_settled_label_is_the_best_of_what_agrees_with_those_before(seed, lag):
    chain, emission = random_chain(seed, ages=3, forbidden=1), random_emission(seed, 7)
    settled = []
    for time in range(1, 8):
        agree = [
            pair
            for pair in every_segmentation(chain, emission[:time])
            if list(pair[1][: len(settled)]) == settled
        ]
        labels = max(agree)[1]
        settled = list(labels[: time - lag]) if time > lag else []
    assert by_frame(segment_frames(chain, emission, lag)) == list(labels)


@pytest.mark.parametrize("seed", range(5))
def test_a_long_lag_answers_as_if_all_were_over(seed):
    chain, emission = random_chain(seed, ages=5, forbidden=1), random_emission(seed, 200)
    whole, late = segment_frames(chain, emission), segment_frames(chain, emission, 200)
    assert len(whole) > 10
    assert [(s.start, s.end, s.label) for s in whole] == [(s.start, s.end, s.label) for s in late]


def test_no_answer_waits_for_longer_than_the_lag():
    chain, emission, lag = random_chain(0, ages=3, forbidden=1), random_emission(0, 300), 9
    whole = segment_frames(chain, emission, lag)
    segmenter, found = Segmenter(chain, lag), []
    for time in range(len(emission)):
        for segment in segmenter.push(emission[time : time + 1]):
            assert segment.end + lag == time  # the frame behind it is settled now
            found.append(segment)
    found += segmenter.finish()
    assert by_frame(found) == by_frame(whole)
    assert len(segmenter._frames) <= lag


@pytest.mark.parametrize("lag", [None, 0, 2, 30])
def test_durations_are_respected_whatever_the_lag(lag):
    shortest = torch.tensor([2, 4, 7])
    chain = random_chain(1)
    hazard = log_normal_hazard(shortest, torch.full((3,), 9.0), torch.full((3,), 0.7), 40).double()
    chain = Chain(chain.log_start, chain.log_change, hazard, chain.log_initial, chain.log_transition)
    segments = segment_frames(chain, random_emission(2, 500), lag)
    assert len(segments) > 20
    assert all(s.end - s.start >= shortest[s.label] for s in segments[:-1])  # the last is cut off by the end


def test_durations_are_log_normal():
    shortest, typical, spread = (
        torch.tensor([1, 3]),
        torch.tensor([8.0, 5.0]).double(),
        torch.tensor([1.0, 0.5]).double(),
    )
    leave = log_normal_hazard(shortest, typical, spread, 400)
    stay = torch.log1p(-leave.exp())
    mass = (leave + stay.cumsum(1) - stay).exp()  # p(duration = d)
    assert (mass[1, :2] == 0).all()
    low = torch.arange(1, 401).double() - 0.5

    def below(x, row):
        return 0.5 * (1 + torch.erf((x.log() - typical[row].log()) / spread[row] / math.sqrt(2)))

    for row in range(2):
        cut = below(low[shortest[row] - 1], row)
        expected = (below(low + 1, row) - below(low, row)) / (1 - cut)
        expected[: shortest[row] - 1] = 0
        assert_close(mass[row], expected, rtol=1e-6, atol=1e-12)


def test_a_segment_tells_the_likelihood_of_its_frames_under_every_label():
    chain, emission = random_chain(3, forbidden=2), random_emission(3, 12)
    for segment in segment_frames(chain, emission, 4):
        for label in range(3):
            paths = torch.tensor(list(state_paths(chain, emission, label, segment.start, segment.end)))
            assert_close(
                segment.log_likelihood[label], torch.logsumexp(paths.double(), 0), rtol=1e-5, atol=1e-5
            )


def test_frames_without_an_observation_cost_nothing():
    chain, emission = random_chain(4), random_emission(4, 7)
    emission[2:5] = 0
    _, labels = max(every_segmentation(chain, emission))
    assert by_frame(segment_frames(chain, emission)) == list(labels)


def test_a_sequence_shorter_than_any_segment_is_one_that_is_not_over():
    chain = random_chain(5, ages=6, forbidden=5)
    segments = segment_frames(chain, random_emission(5, 2), 20)
    assert [(s.start, s.end) for s in segments] == [(0, 2)]
    assert segment_frames(chain, random_emission(5, 0)) == []


def test_bad_input_is_told_in_a_sentence():
    chain, emission = random_chain(0), random_emission(0, 5)
    with pytest.raises(ValueError, match="lag must be 0 or more frames, got -1"):
        Segmenter(chain, -1)
    with pytest.raises(ValueError, match="a label must not follow itself"):
        Chain(
            chain.log_start,
            chain.log_change.nan_to_num(),
            chain.log_leave,
            chain.log_initial,
            chain.log_transition,
        )
    emission[3] = -torch.inf
    with pytest.raises(ValueError, match="frame 4 must be possible under some label"):
        segment_frames(chain, emission)
