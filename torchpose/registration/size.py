"""The person's size: lengths and girths fitted together with the poses of a few frames, under a prior.

Sizes are factors on the body file's lengths and girths, so a prior on them is a prior on proportions. Camera's frame,
metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import torch
import yaml
from jaxtyping import Float
from torch import Tensor

from torchpose.atomic import replacing
from torchpose.body.model import BodyModel, PosedBody
from torchpose.least_squares import LMConfig, levenberg_marquardt, linearize_by_autograd
from torchpose.registration.fitting import PosePrior, Rows, linearize_by_screws, pose_terms
from torchpose.registration.vem import Observation, Registrar
from torchpose.vision.points import PointCloud

# Factors on the body file's person that no grown-up or half-grown person leaves.
SMALLEST, LARGEST = 0.6, 1.5


@dataclass(frozen=True)
class SizeConfig:
    rounds: int = 5  # of labelling and joint fitting; 0 keeps the proportions of the body file
    lm_steps: int = 2  # per round
    common_length_sd: float = 0.03  # of the factor that all lengths share
    length_sd: float = 0.025  # of each length beside it
    common_girth_sd: float = 0.03
    girth_sd: float = 0.02

    def __post_init__(self) -> None:
        if self.rounds < 0 or self.lm_steps < 1:
            raise ValueError(
                f"rounds must not be negative and lm_steps at least 1, got {self.rounds}, {self.lm_steps}"
            )
        for name in ("common_length_sd", "length_sd", "common_girth_sd", "girth_sd"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


def stack_observations(observations: Sequence[Observation]) -> Observation:
    """Frames by the same camera as one batch."""
    clouds = [observation.cloud for observation in observations]
    cloud = PointCloud(
        **{f.name: torch.cat([getattr(c, f.name) for c in clouds]) for f in fields(PointCloud)}
    )
    potential = torch.cat([observation.potential for observation in observations])
    nearest = torch.cat([observation.nearest for observation in observations])
    terms = [observation.geodesic for observation in observations if observation.geodesic is not None]
    geodesic = None
    if len(terms) == len(observations):
        geodesic = replace(
            terms[0],
            cell=torch.cat([term.cell for term in terms]),
            distance=torch.cat([term.distance for term in terms]),
        )
    noise = max(observation.depth_noise for observation in observations)
    return Observation(cloud, potential, nearest, observations[0].camera, geodesic, None, noise)


def fit_size(
    registrar: Registrar,
    observation: Observation,
    pose: Float[Tensor, "batch parameters"],
    size: Float[Tensor, "1 sizes"],
    config: SizeConfig = SizeConfig(),
) -> tuple[Float[Tensor, "1 sizes"], Float[Tensor, "batch parameters"]]:
    """Sizes of the one person in all frames of `observation`, and the frames' poses, from first guesses of both.

    Every round labels the points anew and takes a few Levenberg-Marquardt steps in all poses and the sizes at once.
    `size` is also the prior's mean.
    """
    body, mean = registrar.body, size
    root = torch.linalg.cholesky(size_precision(body, config)).mT  # |root (s - mean)|^2 is the prior's term
    nothing = PosePrior(pose, torch.zeros_like(pose))
    for _ in range(config.rounds):
        posed = body(pose, size)
        foot = registrar.correspond(posed, observation)
        labelling = registrar.label(posed, foot, observation, registrar.config.sigma_last)
        rows, support = registrar.rows(posed, foot, labelling, observation)
        prior = registrar.with_rest(nothing, support)
        problem = JointProblem(registrar, rows, prior, posed, mean, root)
        start = torch.cat([pose.flatten(), size[0]])[None]
        lm = LMConfig(max_steps=config.lm_steps)
        solution = levenberg_marquardt(problem.linearize, start, lm, problem.residual)
        pose, size = problem.split(solution.value)
        size = size.clamp(SMALLEST, LARGEST)
    return size, pose


def write_size(path: Path, body: BodyModel, size: Float[Tensor, "1 sizes"]) -> None:
    """Save a person's sizes, factors on the body file's, as YAML that a person can read and edit."""
    rows = {name: round(float(value), 4) for name, value in zip(body.size_names, size[0], strict=True)}
    with replacing(path) as partial:
        partial.write_text(
            "# Sizes of a person: factors on the lengths and girths of the body file.\n"
            + yaml.safe_dump(rows, sort_keys=False)
        )


def read_size(path: str | Path, body: BodyModel) -> Float[Tensor, "1 sizes"]:
    """The sizes that `write_size` saved.

    Raises ValueError, naming the file, if it is missing, has other names than the body file or senseless numbers.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(
            f"the person's file must exist, got {path}; leave `pose.person` empty to measure the person"
        )
    try:
        rows = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise ValueError(
            f"{path} must be YAML with a number for each size, got: {error}; give the person.yaml of another run"
        ) from error
    if not isinstance(rows, dict) or set(rows) != set(body.size_names):
        raise ValueError(
            f"{path} must hold the sizes {list(body.size_names)}, got {rows}; measure the person anew"
        )
    wrong = {
        n: v
        for n, v in rows.items()
        if isinstance(v, bool) or not isinstance(v, int | float) or not SMALLEST <= v <= LARGEST
    }
    if wrong:
        raise ValueError(
            f"sizes in {path} must lie between {SMALLEST} and {LARGEST}, got {wrong}; "
            "correct them, or give the person.yaml of another run"
        )
    return torch.tensor([[float(rows[name]) for name in body.size_names]]).to(body.axes)


def size_precision(body: BodyModel, config: SizeConfig) -> Float[Tensor, "sizes sizes"]:
    """Precision of the sizes: independent variations around a common factor, for lengths and for girths."""
    count, lengths = len(body.size_names), body.num_lengths
    covariance = body.default_size(1).new_zeros(count, count)
    for part, common, own in (
        (slice(0, lengths), config.common_length_sd, config.length_sd),
        (slice(lengths, count), config.common_girth_sd, config.girth_sd),
    ):
        covariance[part, part] = common**2
        covariance[part, part] += torch.diag_embed(torch.full_like(covariance[part, part].diagonal(), own**2))
    return torch.linalg.inv(covariance)


@dataclass(frozen=True)
class JointProblem:
    """All frames' poses and the sizes as one least-squares problem: the rows of a frame see its own pose alone."""

    registrar: Registrar
    rows: Rows
    prior: PosePrior
    posed: (
        PosedBody  # where the rows were made: a foot point keeps its place relative to the ellipsoid's radii
    )
    mean: Tensor
    root: Tensor

    def split(self, unknowns: Float[Tensor, "1 unknowns"]) -> tuple[Tensor, Tensor]:
        frames = self.prior.mean
        return unknowns[0, : frames.numel()].reshape(frames.shape), unknowns[:, frames.numel() :]

    def linearize(self, unknowns: Float[Tensor, "1 unknowns"]) -> tuple[Tensor, Tensor]:
        body, fitting = self.registrar.body, self.registrar.config.fitting
        pose, size = self.split(unknowns)
        B, P = pose.shape
        residual, by_pose = linearize_by_screws(
            body, size, self._resized(body(pose, size)), self.prior, fitting
        )(pose)
        _, by_size = linearize_by_autograd(lambda sizes: self._row_residual(body(pose, sizes)))(
            size.repeat(B, 1)
        )
        R, M = by_size.shape[1], residual.shape[1]
        jacobian = residual.new_zeros(B, M, B, P)
        frame = torch.arange(B)
        jacobian[frame, :, frame] = by_pose
        shared = torch.cat([by_size, by_size.new_zeros(B, M - R, by_size.shape[2])], 1)
        both = torch.cat([jacobian.flatten(2), shared], 2).flatten(0, 1)
        own = torch.cat([self.root.new_zeros(len(self.root), B * P), self.root], 1)
        prior = (self.root @ (size - self.mean)[0])[None]
        return torch.cat([residual.reshape(1, -1), prior], 1), torch.cat([both, own])[None]

    def residual(self, unknowns: Float[Tensor, "1 unknowns"]) -> Float[Tensor, "1 residuals"]:
        """What `linearize` gives first."""
        body, fitting = self.registrar.body, self.registrar.config.fitting
        pose, size = self.split(unknowns)
        terms, _ = pose_terms(body, pose, self.prior, fitting)
        frames = torch.cat([self._row_residual(body(pose, size)), terms.flatten(1)], 1)
        prior = (self.root @ (size - self.mean)[0])[None]
        return torch.cat([frames.reshape(1, -1), prior], 1)

    def _resized(self, posed: PosedBody) -> Rows:
        """The rows with their model points where the ellipsoids' new radii put them."""
        grown = posed.radii / self.posed.radii
        local = self.rows.local * grown.gather(1, self.rows.part[..., None].expand(-1, -1, 3))
        return Rows(self.rows.part, local, self.rows.target, self.rows.direction)

    def _row_residual(self, posed: PosedBody) -> Tensor:
        rows = self._resized(posed)
        return (rows.direction * (rows.target - rows.points(posed))).sum(-1)
