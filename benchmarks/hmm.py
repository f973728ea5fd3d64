"""How fast the discrete HMMs train and score, and whether they are the same models: against hmmlearn in the same run.

python -m benchmarks.hmm [--repeats N] [--json FILE]

CPU time on one thread, medians; the rivals take turns. Four states, no smoothing (hmmlearn has none), all from the same
start; hmmlearn fits one model at a time, ours all together.

bank    Baum-Welch of 8 models, each with 15 sequences of 60 frames, 32 symbols, 50 rounds.
long    Baum-Welch of one model with 1000 sequences of 200 frames, 10 rounds.
score   log-likelihood of 320 sequences of 60 frames under 8 models; hmmlearn's `.score` is asked for one sequence and
        model at a time, as it adds up what it gets.

`differs` is the greatest difference of the log-likelihoods from hmmlearn's default (log), relative: of every round and
model, or of every score. `left_to_right` is what the thesis uses; `ergodic` has transitions between all states.
"""

import argparse
import json
import statistics
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from hmmlearn.hmm import CategoricalHMM
from jaxtyping import Int
from torch import Tensor

from torchpose.activity.baum_welch import HMMConfig, Parameters, Topology, baum_welch, equal_segments
from torchpose.activity.hmm import DiscreteHMM
from torchpose.atomic import replacing

STATES, SYMBOLS = 4, 32
RIVALS = {"hmmlearn, log": "log", "hmmlearn, scaling": "scaling"}  # the first is its default
OURS = "torchpose"
ROW = "{:6} {:14} {:18} {:>9} {:>8} {:>9}"


@dataclass(frozen=True)
class Workload:
    """Sequences that follow hidden phases, so that there is something to learn."""

    models: int
    sequences: int  # of each model
    frames: int
    iterations: int


BANK, LONG, SCORE = Workload(8, 15, 60, 50), Workload(1, 1000, 200, 10), Workload(8, 40, 60, 5)


@dataclass(frozen=True)
class Timing:
    """One rival on one task."""

    task: str
    topology: str
    rival: str
    ms: float  # CPU time
    times_slower: float  # than ours
    differs: float | None  # from hmmlearn's default, relative


def sequences(work: Workload, generator: torch.Generator) -> tuple[Int[Tensor, "sequences time"], Tensor]:
    """Symbols and labels: in each of four phases, three frames of four show one of the model's three symbols for it."""
    labels = torch.arange(work.models).repeat_interleave(work.sequences)
    pace = torch.rand(len(labels), work.frames, generator=generator).cumsum(1)
    phase = (pace / pace[:, -1:] * STATES).long().clamp(max=STATES - 1)
    own = torch.randint(SYMBOLS, (work.models, STATES, 3), generator=generator)
    choice = torch.randint(3, phase.shape, generator=generator)
    anything = torch.randint(SYMBOLS, phase.shape, generator=generator)
    noisy = torch.rand(phase.shape, generator=generator) < 0.25
    return torch.where(noisy, anything, own[labels[:, None], phase, choice]), labels


def settings(work: Workload, topology: Topology) -> HMMConfig:
    """No smoothing and all the rounds, which is what hmmlearn does."""
    return HMMConfig(
        STATES, topology, emission_prior=1, transition_prior=1, iterations=work.iterations, tolerance=0
    )


def start_of(symbols: Tensor, labels: Tensor, work: Workload, config: HMMConfig) -> Parameters:
    lengths = torch.full_like(labels, work.frames)
    # Noise in the counts of all symbols: a zero would stay a zero.
    generous = HMMConfig(STATES, config.topology, emission_prior=1.5, start_noise=0.5)
    generator = torch.Generator().manual_seed(0)
    return equal_segments(symbols, lengths, labels, work.models, SYMBOLS, generous, generator)


def rival_model(start: Parameters, model: int, implementation: str, iterations: int) -> CategoricalHMM:
    rival = CategoricalHMM(
        STATES,
        n_iter=iterations,
        tol=-np.inf,
        init_params="",
        implementation=implementation,
        n_features=SYMBOLS,
    )
    rival.startprob_ = start.log_initial[model].exp().numpy()
    rival.transmat_ = start.log_transition[model].exp().numpy()
    rival.emissionprob_ = start.log_emission[model].exp().numpy()
    return rival


def in_turns(
    rivals: Mapping[str, Callable[[], Tensor]], repeats: int
) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Median CPU milliseconds of each rival, and what it returned; the first round warms up."""
    seconds: dict[str, list[float]] = {name: [] for name in rivals}
    found = {}
    for _ in range(repeats + 1):
        for name, rival in rivals.items():
            begin = time.process_time()
            found[name] = rival()
            seconds[name].append(time.process_time() - begin)
    return {name: 1000 * statistics.median(times[1:]) for name, times in seconds.items()}, found


def training(work: Workload, topology: Topology) -> dict[str, Callable[[], Tensor]]:
    """Each rival's training, which returns the log-likelihoods (rounds, models)."""
    symbols, labels = sequences(work, torch.Generator().manual_seed(0))
    lengths, config = torch.full_like(labels, work.frames), settings(work, topology)
    start = start_of(symbols, labels, work, config)
    flat = [symbols[labels == model].reshape(-1, 1).numpy() for model in range(work.models)]

    def ours() -> Tensor:
        return baum_welch(start, symbols, lengths, labels, config).objective

    def theirs(implementation: str) -> Tensor:
        history = []
        for model in range(work.models):
            rival = rival_model(start, model, implementation, work.iterations)
            rival.fit(flat[model], [work.frames] * work.sequences)
            history.append(list(rival.monitor_.history))
        return torch.tensor(history, dtype=torch.float64).T

    return {OURS: ours} | {name: lambda kind=kind: theirs(kind) for name, kind in RIVALS.items()}


def scoring(work: Workload, topology: Topology) -> dict[str, Callable[[], Tensor]]:
    """Each rival's scores (sequences, models)."""
    symbols, labels = sequences(work, torch.Generator().manual_seed(0))
    lengths, config = torch.full_like(labels, work.frames), settings(work, topology)
    bank = DiscreteHMM(work.models, SYMBOLS, config)
    parameters = start_of(symbols, labels, work, config)
    for name, value in vars(parameters).items():
        setattr(bank, name, value)
    rows = symbols[:, :, None].numpy()

    def theirs(implementation: str) -> Tensor:
        rivals = [rival_model(parameters, model, implementation, 1) for model in range(work.models)]
        return torch.tensor([[rival.score(row) for rival in rivals] for row in rows], dtype=torch.float64)

    return {OURS: lambda: bank.log_likelihood(symbols, lengths)} | {
        name: lambda kind=kind: theirs(kind) for name, kind in RIVALS.items()
    }


def measure(repeats: int) -> list[Timing]:
    """Every rival on every task and topology."""
    tasks = {"bank": (training, BANK), "long": (training, LONG), "score": (scoring, SCORE)}
    table = []
    for topology in Topology:
        for task, (rivals, work) in tasks.items():
            times, found = in_turns(rivals(work, topology), repeats)
            reference = found[next(iter(RIVALS))]
            for name, ms in times.items():
                worst = float(((found[name] - reference) / reference).abs().max())
                table.append(Timing(task, topology.value, name, ms, ms / times[OURS], worst))
    return table


def render(table: Sequence[Timing]) -> str:
    lines = [ROW.format("task", "topology", "rival", "ms", "slower", "differs")]
    for row in table:
        slower = "" if row.rival == OURS else f"{row.times_slower:.2f}"
        lines.append(
            ROW.format(row.task, row.topology, row.rival, f"{row.ms:.1f}", slower, f"{row.differs:.0e}")
        )
    return "\n".join(line.rstrip() for line in lines)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", type=Path, help="write the figures there as well")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # hmmlearn's log 0 of moves that cannot be
        table = measure(options.repeats)
    print(render(table))
    if options.json is not None:
        with replacing(options.json) as partial:
            partial.write_text(json.dumps([asdict(row) for row in table], indent=1))


if __name__ == "__main__":
    main()
