"""How fast the fit is: a frame's registration, a cold fit against SciPy's, and one iteration three ways.

python -m benchmarks.fit_speed [--repeats N] [--starts N] [--compile] [--json FILE]

CPU time on one thread, medians; the rivals take turns. Data: the body in random poses about a relaxed one, 3 m away;
500 points of its visible surface, 5 mm of noise in depth, labelled by the part that they lie on where labels are given.

warm      `Registrar.forward` with its defaults from a pose 3 degrees off in every angle and 2 cm off in place, in
          batches: ms a frame, and how they divide. `rows` weighs the points and the silhouette; `fit` is the M-step.
          `joints` is the mean distance of the joints from the true ones, before and after. With `--compile` again with
          `compile=true` (a minute or more for each batch size).
cold      One pose of 24 parameters fitted to 600 points whose parts are known, from starts 15 to 35 degrees off in
          every joint (half of that in yaw, pitch and roll, 10 cm in place). `places known`: it is also known where on
          its part each point is, as inside an M-step; the squares of the three coordinates' differences in units of 2
          cm are summed, ours by moments. `nearest points`: the squares of the signed distances from the surface of the
          part; every evaluation finds the nearest points anew, on both sides. To either come the squares of the joints'
          distance from the rest pose in units of 0.5 rad and those of broken limits. Both solvers get the same
          residuals, analytic Jacobian and tolerances; SciPy's `trf` asks for the two one after the other, the second is
          remembered. A start has arrived whose loss is within 1 % of the least that any start and solver reached in
          that frame; times are of the starts from which all arrived. A batch is done when its slowest row is.
iteration One step of Levenberg-Marquardt at a given number of points (three rows each, as in the M-step) with the
          normal equations from moments, from the rows' closed-form Jacobian, and from the rows by autograd; `sums` is
          what the moments cost before the first step.
"""

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np
import scipy.optimize
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose.atomic import replacing
from torchpose.body.ellipsoid import NEWTON_STEPS, foot_of_part
from torchpose.body.model import BodyModel
from torchpose.least_squares import (
    Linearize,
    LMConfig,
    NormalEquations,
    Solution,
    levenberg_marquardt,
    linearize_by_autograd,
    minimize,
    normal_equations,
)
from torchpose.registration.fitting import (
    FittingConfig,
    PosePrior,
    Rows,
    equations_by_moments,
    fit_pose,
    linearize_by_screws,
    linearize_posed,
    pose_residual,
)
from torchpose.registration.silhouette import nearest_inside
from torchpose.registration.vem import STAGES, Observation, Registrar, Registration, RegistrationConfig
from torchpose.vision.camera import StereoCamera
from torchpose.vision.points import SamplingConfig, sample_grid

CAMERA = StereoCamera(320, 240, 320.0, 159.5, 119.5, baseline=0.12)
NOISE = 0.005  # m
BATCHES = (1, 8, 64)
POINTS = (200, 1000, 4000)
COLD_POINTS, COLD_BATCH = 600, 32
SD, REST_SD = 0.02, 0.5  # m, rad
WITHIN = 1.01  # of the least loss
AUTOGRAD_LIMIT = 10_000  # points of a batch: more take seconds
# The default starting damping suits a pose that is nearly right.
PATIENT = LMConfig(max_steps=50, damping=1e-2, step_tolerance=1e-4, loss_tolerance=1e-4)


@dataclass(frozen=True)
class Warm:
    """Registration of a batch of frames from nearby poses."""

    batch: int
    compiled: bool
    ms: float  # a frame
    stages: dict[str, float]  # ms a frame
    start_mm: float
    error_mm: float


@dataclass(frozen=True)
class Cold:
    """A solver on all starts of all frames."""

    kind: str
    solver: str
    ms: float  # a fit, where all solvers arrived
    arrived: float  # share of the starts
    evaluations: float  # mean, of residuals and Jacobian


@dataclass(frozen=True)
class Iteration:
    batch: int
    points: int
    ms: dict[str, float]  # by way, of the whole batch


def seeded(name: str) -> torch.Generator:
    return torch.Generator().manual_seed(sum(name.encode()))


def random_poses(
    body: BodyModel, batch: int, generator: torch.Generator
) -> Float[Tensor, "batch parameters"]:
    """Standing before the camera, every joint up to 30 degrees from the rest pose and within its limits."""
    pose = torch.zeros(batch, body.num_parameters)
    pose[:, 2] = 3.0
    pose[:, 3:6] = math.radians(15) * (2 * torch.rand(batch, 3, generator=generator) - 1)
    swing = math.radians(30) * (2 * torch.rand(batch, len(body.rest), generator=generator) - 1)
    pose[:, 6:] = torch.minimum(torch.maximum(body.rest + swing, body.low[6:]), body.high[6:])
    return pose


def cast(
    body: BodyModel, pose: Float[Tensor, "batch parameters"]
) -> tuple[Float[Tensor, "batch height width"], Int[Tensor, "batch height width"]]:
    """Depth (m, NaN beside the body) and part of every pixel: with an ellipsoid as the unit ball, |o + t d| = 1."""
    posed = body(pose)
    v, u = torch.meshgrid(torch.arange(CAMERA.height), torch.arange(CAMERA.width), indexing="ij")
    rays = CAMERA.back_project(torch.stack([u, v], -1).flatten(0, 1).float(), torch.ones(u.numel()))
    extent = posed.radii[:, :, None]
    origin = -(posed.centers[:, :, None] @ posed.frames) / extent
    way = (rays @ posed.frames) / extent
    dd, od, oo = (way * way).sum(-1), (origin * way).sum(-1), (origin * origin).sum(-1) - 1
    root = od * od - dd * oo
    depth, part = torch.where(root > 0, (-od - root.clamp_min(0).sqrt()) / dd, torch.inf).min(1)
    depth = torch.where(depth.isfinite(), depth, torch.nan)
    return depth.unflatten(1, v.shape), part.unflatten(1, v.shape)


def observe(
    body: BodyModel, pose: Float[Tensor, "batch parameters"], generator: torch.Generator
) -> Observation:
    """What registration is given of the body in these poses: 500 noisy points and the silhouette."""
    depth, _ = cast(body, pose)
    mask = depth.isfinite()
    noisy = depth + NOISE * torch.randn(depth.shape, generator=generator)
    cloud = sample_grid(noisy, mask, CAMERA, SamplingConfig())
    potential = torch.zeros(*cloud.mask.shape, body.num_parts)
    return Observation(cloud, potential, nearest_inside(mask), CAMERA)


def median_ms(runs: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median CPU milliseconds of each, in turns, after one run to warm up."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats + 1):
        for name, run in runs.items():
            begin = time.process_time()
            run()
            times[name].append(1000 * (time.process_time() - begin))
    return {name: statistics.median(found[1:]) for name, found in times.items()}


class Clock:
    """Sums the CPU time that functions take."""

    def __init__(self) -> None:
        self.ms = dict.fromkeys(STAGES, 0.0)

    def timed(self, stage: str, function: Callable) -> Callable:
        def run(*arguments: object, **named: object) -> object:
            begin = time.process_time()
            answer = function(*arguments, **named)
            self.ms[stage] += 1000 * (time.process_time() - begin)
            return answer

        return run


@dataclass(frozen=True)
class WarmRun:
    """A registrar, what it is asked, and the answer that would be right."""

    registrar: Registrar
    observation: Observation
    truth: Float[Tensor, "batch parameters"]
    start: Float[Tensor, "batch parameters"]
    compiled: bool

    def __call__(self) -> Registration:
        return self.registrar(self.observation, self.start, self.registrar.body.default_size(1))

    def stages(self, repeats: int) -> tuple[dict[str, float], Registration]:
        """Milliseconds of each stage, and the answer."""
        clock = Clock()
        with ExitStack() as stack:
            for stage in STAGES:
                timed = clock.timed(stage, getattr(self.registrar, stage))
                stack.enter_context(mock.patch.object(self.registrar, stage, timed))
            for _ in range(repeats):
                answer = self()
        return {stage: ms / repeats for stage, ms in clock.ms.items()}, answer


def warm_run(batch: int, compiled: bool) -> WarmRun:
    body, generator = BodyModel(), seeded(f"warm {batch}")
    truth = random_poses(body, batch, generator)
    shift = 0.02 * torch.nn.functional.normalize(torch.randn(batch, 3, generator=generator), dim=1)
    turn = math.radians(3) * torch.randn(batch, truth.shape[1] - 3, generator=generator).sign()
    registrar = Registrar(body, RegistrationConfig(compile=compiled))
    observation = observe(body, truth, generator)
    return WarmRun(registrar, observation, truth, truth + torch.cat([shift, turn], 1), compiled)


@torch.no_grad()
def warm(repeats: int, compiled: bool) -> list[Warm]:
    runs = {
        f"{batch} {kind}": warm_run(batch, kind)
        for batch in BATCHES
        for kind in ((False, True) if compiled else (False,))
    }
    times = median_ms(runs, repeats)
    found = []
    for name, run in runs.items():
        batch = len(run.truth)
        stages, answer = run.stages(repeats)
        joints, exact, first = (
            run.registrar.body(pose).joints for pose in (answer.pose, run.truth, run.start)
        )
        found.append(
            Warm(
                batch,
                run.compiled,
                times[name] / batch,
                {stage: ms / batch for stage, ms in stages.items()},
                1000 * float((first - exact).norm(dim=-1).mean()),
                1000 * float((joints - exact).norm(dim=-1).mean()),
            )
        )
    return found


@dataclass(frozen=True)
class Problem:
    """Labelled points of some frames, to be fitted with the body."""

    body: BodyModel
    known: bool  # where on its part each point is
    local: Float[Tensor, "batch num 3"]  # m, these places
    points: Float[Tensor, "batch num 3"]  # m
    part: Int[Tensor, "batch num"]
    config: FittingConfig = field(default_factory=lambda: FittingConfig(lm=PATIENT))

    def __getitem__(self, index: slice | Int[Tensor, " some"]) -> "Problem":
        return replace(self, local=self.local[index], points=self.points[index], part=self.part[index])

    @property
    def size(self) -> Float[Tensor, "1 sizes"]:
        return self.body.default_size(1)

    @property
    def prior(self) -> PosePrior:
        rest = self.body.rest.expand(len(self.points), -1)
        root = rest.new_zeros(len(rest), 6)
        joints = torch.full_like(rest, 1 / REST_SD**2)
        return PosePrior(torch.cat([root, rest], 1), torch.cat([root, joints], 1))

    @property
    def rows(self) -> Rows:
        """Where the places are known: a row for each coordinate of each point."""
        part, local, points = (
            x.repeat(1, 3, *[1] * (x.ndim - 2)) for x in (self.part, self.local, self.points)
        )
        directions = torch.eye(3).to(points).repeat_interleave(self.points.shape[1], 0) / SD
        return Rows(part, local, points, directions.expand_as(points), self.points.shape[1])

    def fit(self, start: Float[Tensor, "batch parameters"]) -> Solution:
        if self.known:
            return fit_pose(self.body, start, self.size, self.rows, self.prior, self.config)
        return levenberg_marquardt(self.linearize(), start, PATIENT)

    def linearize(self) -> Linearize:
        if self.known:
            return linearize_by_screws(self.body, self.size, self.rows, self.prior, self.config)
        size, prior = self.size, self.prior

        def linearize(pose: Tensor) -> tuple[Tensor, Tensor]:
            """A signed distance changes like its foot point along the normal, as if that were fixed to the part."""
            posed = self.body(pose, size)
            foot = foot_of_part(posed, self.part[:, None], self.points, False, NEWTON_STEPS)
            index = self.part[:, None].expand(-1, 9, -1)
            frames = posed.frames.flatten(2).mT.gather(2, index).unflatten(1, (3, 3))
            normal = (frames * foot.normal.mT).sum(2).mT
            rows = Rows(self.part, foot.local[:, 0], self.points, normal / SD)
            return linearize_posed(self.body, pose, posed, rows, prior, self.config)

        return linearize


def cold_problem(
    body: BodyModel, frames: int, known: bool
) -> tuple[Problem, Float[Tensor, "frames parameters"]]:
    """Frames to fit, and their true poses."""
    generator = seeded("cold")
    truth = random_poses(body, frames, generator)
    depth, part = (x.flatten(1) for x in cast(body, truth))
    draw = torch.rand(depth.shape, generator=generator) * depth.isfinite()
    pixel = draw.topk(COLD_POINTS, 1).indices
    z, part = depth.gather(1, pixel), part.gather(1, pixel)
    uv = torch.stack([pixel % CAMERA.width, pixel // CAMERA.width], -1).float()
    posed = body(truth)
    rows = torch.arange(frames)[:, None]
    gap = CAMERA.back_project(uv, z) - posed.centers[rows, part]
    local = (posed.frames[rows, part].mT @ gap[..., None])[..., 0]
    noisy = CAMERA.back_project(uv, z + NOISE * torch.randn(z.shape, generator=generator))
    return Problem(body, known, local, noisy, part), truth


def cold_starts(truth: Float[Tensor, "frames parameters"], each: int) -> Float[Tensor, "starts parameters"]:
    """15 to 35 degrees off in every joint, half of that in yaw, pitch and roll, 10 cm in place."""
    generator = seeded("starts")
    shape = (len(truth), each)
    angle = torch.deg2rad(15 + 20 * torch.rand(*shape, 1, generator=generator))
    turn = angle * torch.randn(*shape, truth.shape[1] - 3, generator=generator).sign()
    turn[..., :3] *= 0.5
    shift = 0.1 * torch.nn.functional.normalize(torch.randn(*shape, 3, generator=generator), dim=-1)
    return (truth[:, None] + torch.cat([shift, turn], -1)).flatten(0, 1)


def scipy_fit(problem: Problem, start: Float[Tensor, " parameters"]) -> tuple[float, int]:
    """The loss of SciPy's answer, and how often it asked for residuals."""
    linearize = problem.linearize()
    asked: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def ask(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if not (asked and np.array_equal(asked[0][0], x)):
            residual, jacobian = linearize(torch.from_numpy(x).to(start)[None])
            asked[:] = [(x.copy(), residual[0].double().numpy(), jacobian[0].double().numpy())]
        return asked[0][1:]

    answer = scipy.optimize.least_squares(
        lambda x: ask(x)[0],
        start.double().numpy(),
        jac=lambda x: ask(x)[1],
        method="trf",
        x_scale="jac",
        xtol=PATIENT.step_tolerance,
        ftol=PATIENT.loss_tolerance,
        gtol=None,
        max_nfev=PATIENT.max_steps,
    )
    return float(answer.cost), int(answer.nfev)


@torch.no_grad()
def cold(frames: int, each: int, known: bool) -> list[Cold]:
    problem, truth = cold_problem(BodyModel(), frames, known)
    starts = cold_starts(truth, each)
    frame = torch.arange(frames).repeat_interleave(each)
    names = ("torchpose", f"torchpose, batch {COLD_BATCH}", "scipy trf")
    loss, ms, asked = (torch.zeros(3, len(frame)) for _ in range(3))
    for i, start in enumerate(starts):
        one = problem[frame[i] : frame[i] + 1]
        begin = time.process_time()
        ours = one.fit(start[None])
        middle = time.process_time()
        loss[2, i], asked[2, i] = scipy_fit(one, start)
        ms[0, i], ms[2, i] = 1000 * (middle - begin), 1000 * (time.process_time() - middle)
        loss[0, i], asked[0, i] = ours.loss[0], 1 + ours.steps[0]
    for rows in torch.arange(len(frame)).split(COLD_BATCH):
        many = problem[frame[rows]]
        begin = time.process_time()
        ours = many.fit(starts[rows])
        ms[1, rows] = 1000 * (time.process_time() - begin) / len(rows)
        loss[1, rows], asked[1, rows] = ours.loss, 1.0 + ours.steps
    least = loss.amin(0).view(frames, each).amin(1)[frame]
    arrived = loss <= WITHIN * least
    everywhere = arrived.all(0)
    return [
        Cold(
            "places known" if known else "nearest points",
            name,
            float(ms[k, everywhere].median()),
            float(arrived[k].float().mean()),
            float(asked[k].mean()),
        )
        for k, name in enumerate(names)
    ]


@torch.no_grad()
def iterations(repeats: int) -> list[Iteration]:
    return [iteration(batch, points, repeats) for batch in BATCHES for points in POINTS]


def iteration(batch: int, points: int, repeats: int) -> Iteration:
    body, config, generator = BodyModel(), FittingConfig(), seeded(f"iteration {batch} {points}")
    pose, size = random_poses(body, batch, generator), body.default_size(1)
    posed, prior = body(pose, size), PosePrior(pose, torch.ones_like(pose))
    part = torch.randint(body.num_parts, (batch, 3 * points), generator=generator)
    local, direction, noise = torch.randn(3, batch, 3 * points, 3, generator=generator)
    direction = torch.nn.functional.normalize(direction, dim=-1) / SD
    rows = Rows(part, 0.1 * local, torch.zeros_like(local), direction)
    rows = replace(rows, target=rows.points(posed) + NOISE * noise)
    start = pose + 0.05
    there = body(start, size)
    sums = partial(equations_by_moments, body, size, rows, prior, config, there)
    ways: dict[str, NormalEquations] = {
        "moments": sums(),
        "rows": normal_equations(linearize_by_screws(body, size, rows, prior, config)),
        "autograd": normal_equations(linearize_by_autograd(pose_residual(body, size, rows, prior, config))),
    }
    runs: dict[str, Callable[[], object]] = {"sums": sums}
    if batch * points > AUTOGRAD_LIMIT:
        del ways["autograd"]
    for name, way in ways.items():
        for steps in (1, 4):
            lm = LMConfig(max_steps=steps, step_tolerance=0.0, loss_tolerance=0.0)
            runs[f"{name} {steps}"] = partial(minimize, way, start, lm)
    times = median_ms(runs, repeats)
    # The first evaluation belongs to no step.
    ms = {name: (times[f"{name} 4"] - times[f"{name} 1"]) / 3 for name in ways}
    return Iteration(batch, points, ms | {"sums": times["sums"]})


def render(warmed: Sequence[Warm], cooled: Sequence[Cold], stepped: Sequence[Iteration]) -> str:
    lines = ["warm: ms a frame            " + "".join(f"{stage:>11}" for stage in STAGES) + "   joints, mm"]
    for w in warmed:
        kind = "compiled" if w.compiled else "eager"
        stages = "".join(f"{w.stages[stage]:11.2f}" for stage in STAGES)
        lines.append(
            f"  batch {w.batch:3} {kind:8} {w.ms:8.2f}{stages}   {w.start_mm:.1f} to {w.error_mm:.1f}"
        )
    lines.append("\ncold: 24 parameters, 600 points        ms a fit   arrived   evaluations")
    lines += [
        f"  {c.kind:14} {c.solver:20} {c.ms:8.1f} {c.arrived:9.1%} {c.evaluations:13.1f}" for c in cooled
    ]
    lines.append("\niteration, ms of the whole batch    moments      rows  autograd      sums")
    for s in stepped:
        names = ("moments", "rows", "autograd", "sums")
        ms = "".join(f"{s.ms[name]:10.2f}" if name in s.ms else f"{'-':>10}" for name in names)
        lines.append(f"  batch {s.batch:3}  {s.points:5} points         {ms}")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=9, help="of every timing")
    parser.add_argument("--frames", type=int, default=8, help="of the cold fits")
    parser.add_argument("--starts", type=int, default=12, help="of each cold frame")
    parser.add_argument("--compile", action="store_true", help="also with torch.compile")
    parser.add_argument("--json", type=Path, help="file for the numbers")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    warmed = warm(options.repeats, options.compile)
    cooled = [row for known in (True, False) for row in cold(options.frames, options.starts, known)]
    stepped = iterations(options.repeats)
    print(render(warmed, cooled, stepped))
    if options.json is not None:
        numbers = {
            "torch": torch.__version__,
            "warm": [asdict(w) for w in warmed],
            "cold": [asdict(c) for c in cooled],
            "iteration": [asdict(s) for s in stepped],
        }
        with replacing(options.json) as partial_file:
            partial_file.write_text(json.dumps(numbers, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
