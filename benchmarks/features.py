"""PCA, FastICA and k-means against scikit-learn: CPU time, and how good what they find is.

python -m benchmarks.features [--repeats N] [--json FILE]

CPU time on one thread, medians; the rivals take turns. Data: silhouettes of people who move a limb, drawn as discs and
capsules and shrunk to 48 x 64 px, single precision, as `torchpose.activity.features` has them.

pca       7200 images of 3072 pixels to 150 components. scikit-learn's defaults, which here are a randomized solver, and
          its exact one by the covariance matrix. `quality` is the squared error of the images put together again from
          their components, over that of the exact decomposition in double precision.
ica       150 component images of 3072 pixels to as many independent ones by symmetric FastICA with tanh, 100 rounds and
          no tolerance from the same start, after which neither has converged. `quality` is FastICA's own objective, how
          far the mean of log cosh is from a normal distribution's, over scikit-learn's: more is better.
kmeans    64 code vectors of 6000 frames of 30 features, from the same start to convergence (`lloyd`), and from an own
          start by k-means++ with 3 restarts (`plus plus`). `quality` is the inertia, over scikit-learn's.
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
from jaxtyping import Float
from sklearn.cluster import KMeans
from sklearn.decomposition import PCA, FastICA
from sklearn.exceptions import ConvergenceWarning
from threadpoolctl import threadpool_limits
from torch import Tensor

from torchpose.activity.codebook import kmeans, kmeans_plus_plus
from torchpose.activity.subspace import fast_ica, pca
from torchpose.atomic import replacing

IMAGES, HEIGHT, WIDTH, COMPONENTS = 7200, 64, 48, 150
FRAMES, FEATURES, SYMBOLS, RESTARTS = 6000, 30, 64, 3
ICA_ROUNDS = 100
ROW = "{:18} {:28} {:>9} {:>8} {:>9} {:>9}"


@dataclass(frozen=True)
class Timing:
    """One rival on one task."""

    task: str
    rival: str
    ms: float  # CPU time
    times_slower: float  # than ours
    quality: float  # 1: as good as the reference; see above
    differs: float  # from 1


Rivals = Mapping[str, Callable[[], Tensor]]


def silhouettes(count: int, generator: torch.Generator) -> Float[Tensor, "images pixels"]:
    """People of different size who stand and move both arms: a head, a trunk, two legs and two arms of soft edge."""

    def draw(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, 1, 1, generator=generator)

    v, u = torch.meshgrid(torch.linspace(0, 1, HEIGHT), torch.linspace(-0.375, 0.375, WIDTH), indexing="ij")
    girth, lean, tall = draw(0.05, 0.09), draw(-0.05, 0.05), draw(0.85, 1.0)
    top = 1 - tall

    def capsule(u0: Tensor, v0: Tensor, u1: Tensor, v1: Tensor, radius: Tensor) -> Tensor:
        du, dv = u1 - u0, v1 - v0
        share = (((u - u0) * du + (v - v0) * dv) / (du**2 + dv**2).clamp(min=1e-9)).clamp(0, 1)
        distance = ((u - u0 - share * du) ** 2 + (v - v0 - share * dv) ** 2).sqrt()
        return ((radius - distance) * HEIGHT + 0.5).clamp(0, 1)

    parts = [
        capsule(lean, top + 0.08 * tall, lean, top + 0.08 * tall, 0.07 * tall),
        capsule(lean, top + 0.25 * tall, 0 * lean, top + 0.5 * tall, 1.3 * girth),
    ]
    for side in (-1, 1):
        spread, arm = draw(0.02, 0.12), draw(0.0, 3.0)
        parts.append(capsule(0 * lean, top + 0.5 * tall, side * spread, top + 0.97 * tall, 0.7 * girth))
        reach = 0.3 * tall
        shoulder = lean + side * girth, top + 0.2 * tall
        parts.append(
            capsule(
                *shoulder,
                shoulder[0] + side * reach * arm.sin(),
                shoulder[1] + reach * arm.cos(),
                0.5 * girth,
            )
        )
    return torch.stack(parts).amax(0).flatten(1)


def in_turns(rivals: Rivals, repeats: int) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Median CPU milliseconds of each rival, and what it returned; the first round warms up."""
    seconds: dict[str, list[float]] = {name: [] for name in rivals}
    found = {}
    for _ in range(repeats + 1):
        for name, rival in rivals.items():
            begin = time.process_time()
            found[name] = rival()
            seconds[name].append(time.process_time() - begin)
    return {name: 1000 * statistics.median(times[1:]) for name, times in seconds.items()}, found


def compare(
    task: str, rivals: Rivals, quality: Callable[[Tensor], float], reference: float, repeats: int
) -> list[Timing]:
    times, found = in_turns(rivals, repeats)
    ours = next(iter(times.values()))
    table = []
    for name, ms in times.items():
        value = quality(found[name]) / reference
        table.append(Timing(task, name, ms, ms / ours, value, abs(value - 1)))
    return table


def pca_tasks(repeats: int) -> list[Timing]:
    """Each rival returns the components' rows; the mean is the same."""
    images = silhouettes(IMAGES, torch.Generator().manual_seed(0))
    array = images.numpy()

    def theirs(solver: str) -> Tensor:
        fitted = PCA(COMPONENTS, svd_solver=solver, random_state=0).fit(array)
        return torch.from_numpy(np.asarray(fitted.components_))

    exact = images.double() - images.double().mean(0)

    def error(components: Tensor) -> float:
        rows = components.double()
        return float((exact - exact @ rows.T @ rows).square().sum())

    values = torch.linalg.eigvalsh(exact.T @ exact)
    least = float(values[: images.shape[1] - COMPONENTS].sum())
    rivals = {
        "torchpose": lambda: pca(images, COMPONENTS).components,
        "scikit-learn, its choice": lambda: theirs("auto"),
        "scikit-learn, covariance": lambda: theirs("covariance_eigh"),
    }
    return compare("pca", rivals, error, least, repeats)


def ica_tasks(repeats: int) -> list[Timing]:
    """Each rival returns the independent images (components, pixels)."""
    images = silhouettes(2000, torch.Generator().manual_seed(1)).double()
    signals = pca(images, COMPONENTS).components
    start = torch.randn(
        COMPONENTS, COMPONENTS, generator=torch.Generator().manual_seed(2), dtype=torch.float64
    )

    def ours() -> Tensor:
        found = fast_ica(signals, start, ICA_ROUNDS, tolerance=0.0)
        return found.unmixing @ (signals - signals.mean(1, keepdim=True))

    def theirs() -> Tensor:
        model = FastICA(
            COMPONENTS,
            max_iter=ICA_ROUNDS,
            tol=0.0,
            w_init=start.numpy(),
            whiten="unit-variance",
            whiten_solver="eigh",
        )
        return torch.from_numpy(model.fit_transform(signals.T.numpy()).T.copy())

    def objective(sources: Tensor) -> float:
        white = sources / sources.square().mean(1, keepdim=True).sqrt()
        # log cosh of a unit normal is 0.3746; what is not normal is away from it.
        return float((white.cosh().log().mean(1) - 0.37456721).abs().mean())

    rivals = {"torchpose": ours, "scikit-learn": theirs}
    return compare("ica", rivals, objective, objective(theirs()), repeats)


def kmeans_tasks(repeats: int) -> list[Timing]:
    """Each rival returns the centres."""
    generator = torch.Generator().manual_seed(3)
    walk = torch.randn(FRAMES, FEATURES, generator=generator).view(60, -1, FEATURES).cumsum(1).flatten(0, 1)
    points = (walk / walk.std(0)).double()
    array = points.numpy()
    start = points[torch.randperm(FRAMES, generator=generator)[:SYMBOLS]]

    def inertia(centers: Tensor) -> float:
        return float(torch.cdist(points, centers).amin(1).square().sum())

    def from_start() -> Tensor:
        return kmeans(points, start, iterations=300).centers

    def restarted() -> Tensor:
        draws = torch.Generator().manual_seed(4)
        tries = [kmeans(points, kmeans_plus_plus(points, SYMBOLS, draws), 300) for _ in range(RESTARTS)]
        return min(tries, key=lambda one: float(one.inertia)).centers

    def theirs(**settings: object) -> Tensor:
        model = KMeans(SYMBOLS, max_iter=300, tol=0, random_state=4, algorithm="lloyd", **settings)
        return torch.from_numpy(model.fit(array).cluster_centers_)

    lloyd = {
        "torchpose": from_start,
        "scikit-learn": lambda: theirs(init=start.numpy(), n_init=1),
    }
    plus = {
        "torchpose": restarted,
        "scikit-learn": lambda: theirs(init="k-means++", n_init=RESTARTS),
    }
    return [
        *compare("kmeans, lloyd", lloyd, inertia, inertia(lloyd["scikit-learn"]()), repeats),
        *compare("kmeans, plus plus", plus, inertia, inertia(plus["scikit-learn"]()), repeats),
    ]


def render(table: Sequence[Timing]) -> str:
    lines = [ROW.format("task", "rival", "ms", "slower", "quality", "differs")]
    for row in table:
        slower = "" if row.rival == "torchpose" else f"{row.times_slower:.2f}"
        lines.append(
            ROW.format(
                row.task, row.rival, f"{row.ms:.0f}", slower, f"{row.quality:.5f}", f"{row.differs:.1e}"
            )
        )
    return "\n".join(line.rstrip() for line in lines)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", type=Path, help="write the figures there as well")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # FastICA is asked for a number of rounds
        table = [*pca_tasks(options.repeats), *ica_tasks(options.repeats), *kmeans_tasks(options.repeats)]
    print(render(table))
    if options.json is not None:
        with replacing(options.json) as partial:
            partial.write_text(json.dumps([asdict(row) for row in table], indent=1))


if __name__ == "__main__":
    main()
