"""Registration by variational EM: label the points (VE-step), fit the body (M-step), until the pose stands (T. 3.2.2).

Left-camera frame; metres and radians. A batch holds frames, or several starts of one frame: evidence of batch 1 is
shared by all rows.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cache, reduce

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose.body.ellipsoid import (
    FEW_STEPS,
    NEWTON_STEPS,
    FootPoint,
    algebraic_distance,
    flattened,
    foot_of_part,
    foot_point,
    rough_square,
    unflattened,
)
from torchpose.body.model import BodyModel, PosedBody
from torchpose.least_squares import Solution, Status
from torchpose.registration.fitting import (
    FittingConfig,
    PosePrior,
    Rows,
    equations_by_moments,
    fit_posed,
    pose_terms,
)
from torchpose.registration.labelling import GeodesicTerm, Labelling, LabellingConfig, mean_field
from torchpose.registration.occlusion import OcclusionConfig, depth_behind
from torchpose.registration.silhouette import RimConfig, overhang_of, silhouette_residual, silhouette_rows
from torchpose.registration.solid import SolidConfig, parts_of, solid_residual, solid_rows
from torchpose.vision.camera import StereoCamera
from torchpose.vision.points import PointCloud

STAGES = ("correspond", "label", "rows", "fit")  # the registrar's methods that make up a round


class Distance(Enum):
    """What the labels are judged by: metres to the surface, or the cheaper and biased q(X) of (3.3)."""

    euclidean = "euclidean"
    algebraic = "algebraic"


@dataclass(frozen=True)
class RegistrationConfig:
    rounds: int = 3  # VE-steps, each followed by an M-step
    sigma_first: float = 0.10  # m, of the reconstruction term (3.13) in the first round
    sigma_last: float = 0.03  # m, in the last; in between it falls geometrically
    distance: Distance = Distance.euclidean
    visible: bool = True  # correspond with the side that the camera sees
    outlier: float = 3.0  # sigmas beyond which a point rather has no part; 0 gives every point a part
    near: int = (
        2  # parts whose foot points a point with a hard label is given; the others are judged to first order
    )
    hard: bool = True  # each point answers to its best label alone; soft costs 14 times the rows
    tangential: float = 0.3  # weight of the residual along the surface; 1: the distance to a fixed foot
    robust_sd: float = 0.05  # m, at which a residual loses three quarters of its weight; 0 weighs all alike
    noise_sd: float = 0.02  # m, of a point in the M-step
    ray_sd: float = (
        0.03  # m along the ray, up to which the settings above hold; noisier points count as if so far off
    )
    effective_points: float = 150.0  # what the correlated points are worth as independent ones
    rest_sd: float = 0.5  # rad, of the pull to the rest pose on joints of which nothing is seen; 0 is none
    rest_support: float = 5.0  # points on a limb that halve this pull, if they are
    rest_lever: float = 0.25  # m or more from its joint; nearer ones count less
    compile: bool = False  # by torch.compile: 2 to 3 times as fast at batch 1, after minutes of compiling
    labelling: LabellingConfig = field(default_factory=LabellingConfig)
    fitting: FittingConfig = field(default_factory=FittingConfig)
    rim: RimConfig = field(default_factory=RimConfig)
    solid: SolidConfig = field(default_factory=SolidConfig)
    # Of what a body hides of itself, where poses of points noisier than `ray_sd` are judged.
    occlusion: OcclusionConfig = field(default_factory=OcclusionConfig)

    def __post_init__(self) -> None:
        for name in ("rounds", "near"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in (
            "sigma_first",
            "sigma_last",
            "noise_sd",
            "ray_sd",
            "effective_points",
            "rest_support",
            "rest_lever",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("outlier", "robust_sd", "rest_sd", "tangential"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}; 0 switches it off")


@dataclass(frozen=True)
class Observation:
    """A frame as registration sees it. Batch 1 serves any number of starts."""

    cloud: PointCloud
    potential: Float[Tensor, "batch num parts"]  # log-potentials of the appearance terms
    nearest: Float[
        Tensor, "masks height width 2"
    ]  # `nearest_inside` of the silhouettes; one mask serves all rows
    camera: StereoCamera
    geodesic: GeodesicTerm | None = None
    frame: Int[Tensor, " batch"] | None = (
        None  # whose row of `nearest` each row has; None: its own, or the one
    )
    depth_noise: float = 0.0  # 1/m: a point's standard deviation along its ray, m, over its squared depth

    def expand(self, batch: int) -> "Observation":
        """The same observation for `batch` starts, without a copy."""
        cloud = PointCloud(
            *(_rows(getattr(self.cloud, name), batch) for name in PointCloud.__dataclass_fields__)
        )
        geodesic = self.geodesic
        if geodesic is not None:
            geodesic = GeodesicTerm(
                _rows(geodesic.cell, batch),
                _rows(geodesic.distance, batch),
                geodesic.shortest,
                geodesic.longest,
                geodesic.most,
            )
        return Observation(
            cloud,
            _rows(self.potential, batch),
            self.nearest,
            self.camera,
            geodesic,
            None if self.frame is None else _rows(self.frame, batch),
            self.depth_noise,
        )

    def take(self, index: Tensor) -> "Observation":
        """Some rows of the batch, each as often as `index` names it."""
        cloud = PointCloud(*(getattr(self.cloud, name)[index] for name in PointCloud.__dataclass_fields__))
        nearest = self.nearest[index] if len(self.nearest) == len(self.potential) else self.nearest
        geodesic = self.geodesic
        if geodesic is not None:
            geodesic = replace(geodesic, cell=geodesic.cell[index], distance=geodesic.distance[index])
        return Observation(
            cloud, self.potential[index], nearest, self.camera, geodesic, None, self.depth_noise
        )

    def share(self, index: Tensor) -> "Observation":
        """`take` without a copy of the silhouettes, which are by far the largest: for many rows of few frames.

        Of a single frame, whose rows are all the same, nothing is copied.
        """
        if len(self.potential) == 1:
            return self.expand(len(index))
        few = replace(self, nearest=self.nearest[:1]).take(index)
        return (
            few
            if len(self.nearest) == 1
            else replace(few, nearest=self.nearest, frame=index if self.frame is None else self.frame[index])
        )


@dataclass(frozen=True)
class Registration:
    """The fitted poses and what speaks for them."""

    pose: Float[Tensor, "batch parameters"]
    covariance: Float[
        Tensor, "batch parameters parameters"
    ]  # of the pose, from rows, prior and limits (Laplace)
    belief: Float[
        Tensor, "batch labels num"
    ]  # q(label) of each point; the last label is "no part" where there is one
    distance: Float[Tensor, "batch num"]  # m, to the nearest part; 0 on padding
    point_to_model: Float[Tensor, " batch"]  # m, (5.2): the mean of `distance` over the points
    misfit: Float[
        Tensor, " batch"
    ]  # m, capped distances plus overhang: whether this can be the person at all
    score: Float[
        Tensor, " batch"
    ]  # nats, minus the log of the joint density: compares starts, less is better
    bound: Float[Tensor, "rounds batch"]  # (C.8) after each VE-step, at that round's sigma
    status: Int[Tensor, " batch"]  # of the last M-step, see `Status`

    def take(self, index: Tensor) -> "Registration":
        """Some rows of the batch."""
        names = [name for name in Registration.__dataclass_fields__ if name != "bound"]
        return Registration(
            **{name: getattr(self, name)[index] for name in names}, bound=self.bound[:, index]
        )

    def put(self, index: Tensor, other: "Registration") -> "Registration":
        """With the rows at `index` replaced by those of another; of the bounds the last is kept."""
        names = [name for name in Registration.__dataclass_fields__ if name != "bound"]
        values = {name: getattr(self, name).index_put((index,), getattr(other, name)) for name in names}
        bound = self.bound[-1].index_put((index,), other.bound[-1])
        return Registration(**values, bound=bound[None])


@dataclass(frozen=True)
class Correspondence:
    """The model's points that may answer for each data point, and how far it is from every part."""

    part: Int[Tensor, "batch few num"]  # the parts that these points are on
    foot: FootPoint  # batch, few, num; of the body `flattened` where `back` is not None
    square: Float[Tensor, "batch parts num"]  # m^2; of other parts than these to first order
    back: Float[Tensor, "batch parts 3 3"] | None = None  # of `flattened`

    def of(self, posed: PosedBody, points: Float[Tensor, "batch num 3"], index: Tensor | None) -> FootPoint:
        """Of each point those numbered `index` (B, few, N), None for all, on the parts as they are `posed`."""
        foot, part = self.foot, self.part
        if index is not None:
            foot, part = foot.take(index), part.gather(1, index)
        return foot if self.back is None else unflattened(foot, posed, part, points, self.back)


@dataclass(frozen=True)
class _Answer:
    """The parts that answer for each point."""

    part: Int[Tensor, "batch few num"]
    weight: Float[Tensor, "batch few num"]
    index: Int[Tensor, "batch 1 num"] | None  # of the one among the `Correspondence`'s; None: all of these


@cache
def compiling_works(device: str) -> bool:
    """Whether torch.compile can make code for this kind of device here; if not, one warning says why."""
    try:
        torch.compile(torch.sin)(torch.ones(2, device=device))
    except Exception as error:  # every backend has its own
        reason = str(error).strip().splitlines()[0]
        warnings.warn(
            f"compile=true needs a compiler, going on without: {reason}; install one, or leave compile=false",
            stacklevel=3,
        )
        return False
    return True


class Registrar(nn.Module):
    """Fits a body to observations from given starts. Everything it knows of a person comes as arguments."""

    limb_parts: Tensor  # (own,) those of all limbs
    core_parts: Tensor  # (others,) trunk and head

    def __init__(self, body: BodyModel, config: RegistrationConfig = RegistrationConfig()):
        super().__init__()
        self.body = body
        self.config = config
        moved = body.part_moves[:, body.limb_starts].any(1)
        self.register_buffer("limb_parts", moved.nonzero()[:, 0], persistent=False)
        self.register_buffer("core_parts", (~moved).nonzero()[:, 0], persistent=False)
        if config.compile and compiling_works(body.axes.device.type):
            for stage in STAGES:
                setattr(self, stage, torch.compile(getattr(self, stage)))

    def forward(
        self,
        observation: Observation,
        start: Float[Tensor, "batch parameters"],
        size: Float[Tensor, "#batch sizes"],
        prior: PosePrior | None = None,
        rounds: int | None = None,
        sigma_first: float | None = None,
        covariance: bool = True,
    ) -> Registration:
        """Register from `start`. A row that is not finite keeps its start, with status NON_FINITE.

        Args:
            prior: what earlier frames say of the pose; None says nothing.
            rounds: overrides the config, for a cold start.
            sigma_first: the same, m.
            covariance: as for `evaluate`.
        """
        if prior is None:
            prior = PosePrior(start, torch.zeros_like(start))
        solution, posed, bound = self.approach(observation, start, size, prior, rounds, sigma_first)
        pose, status = solution.value, solution.status
        return self.evaluate(observation, pose, size, prior, bound, status, posed, covariance)

    def approach(
        self,
        observation: Observation,
        start: Float[Tensor, "batch parameters"],
        size: Float[Tensor, "#batch sizes"],
        prior: PosePrior,
        rounds: int | None = None,
        sigma_first: float | None = None,
    ) -> tuple[Solution, PosedBody, Float[Tensor, "rounds batch"]]:
        """The rounds of `forward` alone: the last M-step's answer, the body there, and the bound of each VE-step."""
        config, B = self.config, start.shape[0]
        observation = observation.expand(B)
        rounds = rounds or config.rounds
        sigma_first = sigma_first or config.sigma_first
        pose, bounds = start, []
        posed = self.body(pose, size)
        for i in range(rounds):
            share = i / max(rounds - 1, 1)
            sigma = sigma_first ** (1 - share) * config.sigma_last**share
            foot = self.correspond(posed, observation)
            occlude = i >= rounds - config.occlusion.last_rounds
            labelling = self.label(posed, foot, observation, sigma, occlude)
            bounds.append(labelling.bound[-1])
            rim = i >= rounds - config.rim.last_rounds
            rows, support = self.rows(posed, foot, labelling, observation, rim)
            full = self.with_rest(prior, support)
            solution, posed = self.fit(pose, size, rows, full, posed)
            pose = solution.value
        return solution, posed, torch.stack(bounds)

    def fit(
        self,
        pose: Float[Tensor, "batch parameters"],
        size: Float[Tensor, "#batch sizes"],
        rows: Rows,
        prior: PosePrior,
        posed: PosedBody,
    ) -> tuple[Solution, PosedBody]:
        """The M-step from `pose`, where the body is `posed`; and the body afterwards."""
        return fit_posed(self.body, pose, size, rows, prior, self.config.fitting, posed)

    def correspond(self, posed: PosedBody, observation: Observation) -> Correspondence:
        """The model's points that may answer for each data point, and its distances from all parts."""
        config, points = self.config, observation.cloud.points
        K = self.body.num_parts
        seen, back = self.pressed(posed, observation)
        if not config.hard or config.near >= K:
            part = torch.arange(K, device=points.device)[:, None].expand(len(points), K, points.shape[1])
            foot = foot_point(seen, points, config.visible, FEW_STEPS if config.hard else NEWTON_STEPS)
            square = foot.residual.square().sum(-1)
        else:
            # A point's label is one of the nearest parts; those far off need no foot point to be told apart from these.
            rough = rough_square(seen, points, config.visible)
            part = nearest_parts(rough.detach(), config.near)
            foot = foot_of_part(seen, part, points, config.visible)
            square = rough.scatter(1, part, foot.residual.square().sum(-1))
        return Correspondence(part, foot, square, back)

    def pressed(
        self, posed: PosedBody, observation: Observation
    ) -> tuple[PosedBody, Float[Tensor, "batch parts 3 3"] | None]:
        """The body as distances are measured to: where depths are noisier than `ray_sd` those along the ray count for
        less, and it is `flattened`. Beside it what `flattened` returns; None where it is the body itself."""
        if observation.depth_noise == 0:
            return posed, None
        return flattened(posed, self.trust(posed, observation))

    def trust(self, posed: PosedBody, observation: Observation) -> Float[Tensor, "batch parts"]:
        """How much a distance along the ray counts at each part: less where it is noise of more than `ray_sd`."""
        noise = observation.depth_noise * posed.centers[..., 2].square()
        return self.config.ray_sd / noise.clamp_min(self.config.ray_sd)

    def label(
        self,
        posed: PosedBody,
        foot: Correspondence,
        observation: Observation,
        sigma: float,
        occlude: bool = True,
    ) -> Labelling:
        """The VE-step at one pose: beliefs over the parts, and "no part" last if outliers are modelled.

        With `occlude`, parts that the body hides are not believed to have given points.
        """
        square = foot.square
        if self.config.distance is Distance.algebraic:
            square = algebraic_distance(posed, observation.cloud.points).square()
        potential = observation.potential.mT - square / (2 * sigma**2)
        if occlude and self.config.occlusion.penalty > 0:
            potential = potential + self.config.occlusion.potential(
                depth_behind(posed, observation.cloud.points)
            )
        if self.config.outlier > 0:
            none = torch.full_like(potential[:, :1], -0.5 * self.config.outlier**2)
            potential = torch.cat([potential, none], 1)
        cloud = observation.cloud
        return mean_field(
            potential, cloud.neighbours, cloud.mask, self.config.labelling, cloud.grid, observation.geodesic
        )

    def rows(
        self,
        posed: PosedBody,
        foot: Correspondence,
        labelling: Labelling,
        observation: Observation,
        rim: bool = True,
        tangential: float | None = None,
    ) -> tuple[Rows, Float[Tensor, "batch parts"]]:
        """The M-step's rows from beliefs, and how many points support each part; if `rim`, the rows have the
        silhouette's among them and those that keep limbs out of the trunk.

        `tangential` overrides the config.
        """
        tangential = self.config.tangential if tangential is None else tangential
        answer = self._answer(foot, labelling.belief, observation.cloud)
        rows = self._point_rows(posed, foot, answer, observation, tangential)
        others = []
        if rim and self.config.rim.weight > 0:
            # Rims of one part move together, so they count as a few independent measurements, not as many.
            others.append(
                silhouette_rows(
                    posed, observation.nearest, observation.camera, self.config.rim, observation.frame
                )
            )
        if rim and self.config.solid.sd > 0:
            others.append(solid_rows(posed, self.limb_parts, self.core_parts, self.config.solid))
        if others:
            rows = Rows.cat(rows, reduce(Rows.cat, others))
        return rows, self._support(posed, answer, observation.cloud)

    def _answer(
        self, foot: Correspondence, belief: Float[Tensor, "batch labels num"], cloud: PointCloud
    ) -> _Answer:
        """Which parts answer for each point, and how far."""
        weight = belief.gather(1, foot.part)
        if not self.config.hard:
            return _Answer(foot.part, weight, None)
        K = self.body.num_parts
        best, index = weight.max(1, keepdim=True)  # far faster than `argmax`
        none = belief[:, K:].amax(1, keepdim=True) if belief.shape[1] > K else torch.zeros_like(best)
        weight = ((best > none) & cloud.mask[:, None]).to(belief)
        return _Answer(foot.part.gather(1, index), weight, index)

    def _support(self, posed: PosedBody, answer: _Answer, cloud: PointCloud) -> Float[Tensor, "batch parts"]:
        """How many points speak for each part."""
        K = self.body.num_parts
        part, weight = answer.part.flatten(1), answer.weight.flatten(1)
        target = cloud.points.mT.repeat(1, 1, answer.part.shape[1])
        # What a point says of a limb's direction grows with the square of its distance from the joint.
        joint = posed.origins[:, self.body.carriers[:K]].mT.gather(2, part[:, None].expand(-1, 3, -1))
        lever = (target - joint).square().sum(1)
        far = (lever / self.config.rest_lever**2).clamp_max(1)
        return weight.new_zeros(len(part), K).scatter_add(1, part, weight * far)

    def _point_rows(
        self,
        posed: PosedBody,
        foot: Correspondence,
        answer: _Answer,
        observation: Observation,
        tangential: float,
    ) -> Rows:
        """Three rows for each pair of point and part, all first coordinates first.

        In memory the coordinates stand before the pairs, so that every operation runs along the pairs.
        """
        config, cloud = self.config, observation.cloud
        target = cloud.points.mT.repeat(1, 1, answer.part.shape[1])
        part, weight = answer.part.flatten(1), answer.weight.flatten(1)
        chosen = foot.of(posed, cloud.points, answer.index)
        local, normal = (x.mT.transpose(1, 2).flatten(2) for x in (chosen.local, chosen.normal))
        gap = foot.square.gather(1, answer.part).flatten(1)
        count = cloud.mask.sum(1, keepdim=True).clamp_min(1)
        weight = weight * (config.effective_points / count).clamp_max(1)
        if config.robust_sd > 0:  # Geman and McClure
            weight = weight / (1 + gap / config.robust_sd**2) ** 2
        # The root of 0 has no derivative; the floor gives it 0.
        tiny = torch.finfo(weight.dtype).tiny
        scale = torch.where(weight > 0, weight.clamp_min(tiny).sqrt(), 0.0) / config.noise_sd
        frames = posed.frames.flatten(2).mT.gather(2, part[:, None].expand(-1, 9, -1)).unflatten(1, (3, 3))
        normal = (frames * normal[:, None]).sum(2)
        slack: float | Tensor = 1 - tangential
        if (
            observation.depth_noise > 0
        ):  # normals of the flatter body, which say little of where a limb may slide
            trust = self.trust(posed, observation).gather(1, part)[:, None]
            ray = nn.functional.normalize(posed.centers, dim=-1).mT.gather(2, part[:, None].expand(-1, 3, -1))
            normal = normal + (1 / trust - 1) * (ray * normal).sum(1, keepdim=True) * ray
            # torch's norm across memory takes sixty times as long.
            normal = normal * normal.square().sum(1, keepdim=True).clamp_min(tiny).rsqrt()
            slack = (slack * trust)[:, None] if tangential > 0 else slack
        # Along the normal the distance counts in full; along the surface only as far as asked, which lets a limb slide
        # to where it fits. A point behind the rim differs from its foot along the surface too, and counts less there.
        eye = torch.eye(3, dtype=normal.dtype, device=normal.device)[..., None]
        outer = normal[:, :, None] * normal[:, None]
        spread = slack * outer + (1 - slack) * eye  # (B, 3, 3, pairs), symmetric
        if observation.depth_noise > 0:
            spread = spread - ((1 - trust) * ray)[:, :, None] * (ray[:, :, None] * spread).sum(1)[:, None]
        direction = (scale[:, None, None] * spread).flatten(2)
        local, target, direction = (x.mT for x in (local.repeat(1, 1, 3), target.repeat(1, 1, 3), direction))
        return Rows(part.repeat(1, 3), local, target, direction, part.shape[1])

    def with_rest(self, prior: PosePrior, support: Float[Tensor, "batch parts"]) -> PosePrior:
        """The prior, joined by a pull towards the rest pose on every joint below which little is seen."""
        if self.config.rest_sd == 0:
            return prior
        seen = support @ self.body.part_moves[:, 6:].to(support)  # (B, joint parameters)
        rest = 1 / (self.config.rest_sd**2 * (1 + seen / self.config.rest_support))
        rest = torch.cat([torch.zeros_like(rest[:, :6]), rest], 1)
        toward = torch.cat([torch.zeros_like(prior.mean[:, :6]), self.body.rest.expand(len(rest), -1)], 1)
        precision = prior.precision + rest
        mean = (prior.precision * prior.mean + rest * toward) / precision.clamp_min(1e-12)
        return PosePrior(mean, precision)

    def evaluate(
        self,
        observation: Observation,
        pose: Float[Tensor, "batch parameters"],
        size: Float[Tensor, "#batch sizes"],
        prior: PosePrior,
        bound: Tensor,
        status: Tensor,
        posed: PosedBody | None = None,
        covariance: bool = True,
    ) -> Registration:
        """What speaks for a pose, with the body `posed` there if it is at hand.

        Without `covariance` that is NaN: half of the time, for those who compare many poses.
        """
        config, observation = self.config, observation.expand(len(pose))
        cloud = observation.cloud
        posed = self.body(pose, size) if posed is None else posed
        foot = self.correspond(posed, observation)
        labelling = self.label(posed, foot, observation, config.sigma_last)
        doubt = pose.new_tensor(torch.nan).expand(*pose.shape, pose.shape[1])
        if covariance:
            rows, support = self.rows(posed, foot, labelling, observation)
            full = self.with_rest(prior, support)
            equations = equations_by_moments(self.body, size, rows, full, config.fitting, posed)
            doubt = _inverse(equations.at(pose, posed)[2])
        else:
            answer = self._answer(foot, labelling.belief, cloud)
            full = self.with_rest(prior, self._support(posed, answer, cloud))
        rims = pose.new_zeros(len(pose), 0)
        if config.rim.weight > 0:
            rims = silhouette_residual(
                posed, observation.nearest, observation.camera, config.rim, observation.frame
            )
        count = cloud.mask.sum(1).clamp_min(1)
        fit, index = foot.square.gather(1, foot.part).min(1, keepdim=True)
        nearest = foot.of(posed, cloud.points, index).distance[:, 0] * cloud.mask
        fit = fit[:, 0].clamp_min(0).sqrt() * cloud.mask
        # The bound stands in for the points' rows, with every label and none.
        terms, _ = pose_terms(self.body, pose, full, config.fitting)
        others = 0.5 * (rims.square().sum(1) + terms.square().sum((1, 2)))
        if config.solid.sd > 0:
            trunk, middles = parts_of(posed, self.core_parts), posed.centers[:, self.limb_parts]
            inside = solid_residual(trunk, middles, config.solid)
            others = others + 0.5 * inside.square().sum((1, 2))
        score = others - labelling.bound[-1] * (config.effective_points / count).clamp_max(1)
        misfit = fit.clamp_max(0.2).sum(1) / count
        if config.rim.weight > 0:
            misfit = misfit + overhang_of(rims, config.rim)
        return Registration(
            pose, doubt, labelling.belief, nearest, nearest.sum(1) / count, misfit, score, bound, status
        )


def nearest_parts(square: Float[Tensor, "*batch parts num"], count: int) -> Int[Tensor, "*batch few num"]:
    """Of each point the `count` parts with the least distances, the nearest first."""
    few: list[Tensor] = []
    for _ in range(count):  # by one least value after another: for two of them twice as fast as `topk`
        if few:
            square = square.scatter(-2, few[-1], torch.inf)
        few.append(square.min(-2, keepdim=True).indices)
    return torch.cat(few, -2)


def _inverse(
    information: Float[Tensor, "batch parameters parameters"],
) -> Float[Tensor, "batch parameters parameters"]:
    """Of symmetric matrices; infinite where one is not positive definite."""
    factor, failed = torch.linalg.cholesky_ex(information)
    known = (failed == 0)[:, None, None]
    # cholesky_inverse raises for the whole batch where one factor is singular.
    eye = torch.eye(information.shape[1], dtype=information.dtype, device=information.device)
    return torch.where(known, torch.cholesky_inverse(torch.where(known, factor, eye)), torch.inf)


def stack_registrations(found: Sequence[Registration]) -> Registration:
    """Registrations of single frames as one batch; of the bounds only the last is kept."""
    names = [name for name in Registration.__dataclass_fields__ if name != "bound"]
    values = {name: torch.cat([getattr(one, name) for one in found]) for name in names}
    return Registration(**values, bound=torch.cat([one.bound[-1:] for one in found], 1))


def _rows(value: Tensor, batch: int) -> Tensor:
    return value if value.shape[0] == batch else value.expand(batch, *value.shape[1:])


def is_finite(registration: Registration) -> Bool[Tensor, " batch"]:
    """Which rows have a usable answer."""
    return registration.pose.isfinite().all(1) & (registration.status != int(Status.NON_FINITE))
