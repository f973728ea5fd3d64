"""Other places for one limb: many of them are scored against the points while the rest of the body stays.

The hierarchical step (T. 6.2.1): the root is known, the chains outward are sought. Left-camera frame, metres and
radians.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchpose.body.ellipsoid import foot_point, rough_distance
from torchpose.body.model import BodyModel, PosedBody
from torchpose.registration.silhouette import silhouette_rows
from torchpose.registration.vem import Observation, Registrar

# A limb is a body on the root that others hang from: its joint, and that of the body after it, have four parameters.
PARAMETERS = 4
CLOSE = 1e6  # nats by which a place falls behind that is beside a better one


@dataclass(frozen=True)
class LimbSearchConfig:
    candidates: int = 512  # poses of each limb that are scored roughly
    shortlist: int = 32  # of them that are scored exactly
    best: int = 3  # of these that are fitted
    apart: float = 0.4  # rad by which these differ
    sigma: float = 0.06  # m, at which points count as a candidate's

    def __post_init__(self) -> None:
        if not 1 <= self.best <= self.shortlist <= self.candidates:
            raise ValueError(f"1 <= best <= shortlist <= candidates must hold, got {self}")
        if not self.sigma > 0:
            raise ValueError(f"sigma must be positive, in m, got {self.sigma}")
        if self.apart < 0:
            raise ValueError(f"apart must not be negative, in rad, got {self.apart}")


class LimbSearch(nn.Module):
    """Scores poses of each arm and leg that fill the limits of their joints evenly (Sobol's sequence)."""

    limbs: Tensor  # (limbs, 4) parameters of each
    places: Tensor  # (limbs, candidates, 4) rad
    own: Tensor  # (limbs, parts) bool: parts that the limb's first parameter moves

    def __init__(self, body: BodyModel, registrar: Registrar, config: LimbSearchConfig = LimbSearchConfig()):
        super().__init__()
        self.body, self.registrar, self.config = body, registrar, config
        roots = [k for k, parent in enumerate(body.parents, 1) if parent == 0 and k in body.parents]
        first = torch.tensor([6 + 2 * (k - 1) for k in roots])
        limbs = first[:, None] + torch.arange(PARAMETERS)
        even = torch.quasirandom.SobolEngine(PARAMETERS, scramble=True, seed=0).draw(config.candidates)
        low, high = body.low[limbs][:, None], body.high[limbs][:, None]
        self.register_buffer("limbs", limbs, persistent=False)
        self.register_buffer("places", low + even.to(low) * (high - low), persistent=False)
        self.register_buffer("own", body.part_moves[:, first].T, persistent=False)

    def forward(
        self,
        observation: Observation,
        pose: Float[Tensor, "1 parameters"],
        size: Float[Tensor, "#batch sizes"],
    ) -> Float[Tensor, "limbs best parameters"]:
        """For each limb the best poses that differ from `pose` in that limb alone."""
        L, C = self.places.shape[:2]
        rest = self._rest_of_body(observation, pose, size)
        poses = pose.expand(L, C, -1).scatter(2, self.limbs[:, None].expand(-1, C, -1), self.places)
        score = self._score(observation, poses, size, rest, exact=False).nan_to_num(nan=-torch.inf)
        short = score.topk(self.config.shortlist, 1).indices
        poses = poses.gather(1, short[..., None].expand(-1, -1, poses.shape[2]))
        score = self._score(observation, poses, size, rest, exact=True).nan_to_num(nan=-torch.inf)
        # The best ones of all are often one place several times.
        places = poses.gather(2, self.limbs[:, None].expand(-1, poses.shape[1], -1))
        rank, best = score, []
        for _ in range(self.config.best):
            best.append(rank.argmax(1))
            gap = (places - places.gather(1, best[-1][:, None, None].expand(-1, 1, PARAMETERS))).abs().amax(2)
            # Those beside it come last, in case there are no others.
            rank = torch.where(gap < self.config.apart, rank - CLOSE, rank)
            rank = rank.scatter(1, best[-1][:, None], -torch.inf)
        index = torch.stack(best, 1)
        return poses.gather(1, index[..., None].expand(-1, -1, poses.shape[2]))

    def _score(
        self,
        observation: Observation,
        poses: Float[Tensor, "limbs candidates parameters"],
        size: Float[Tensor, "#batch sizes"],
        rest: Float[Tensor, "limbs num"],
        exact: bool,
    ) -> Float[Tensor, "limbs candidates"]:
        """Log-density of the points and of the rims, up to a constant for each limb."""
        L, C = poses.shape[:2]
        parts = torch.stack([own.nonzero()[:, 0] for own in self.own])  # (L, own parts)
        limb = _only(self.body(poses.flatten(0, 1), size), parts.repeat_interleave(C, 0))
        cloud, registrar = observation.cloud, self.registrar
        if exact:
            points = cloud.points.expand(L * C, -1, -1)
            square = (foot_point(limb, points, registrar.config.visible).residual ** 2).sum(-1)
        else:
            square = rough_distance(limb, cloud.points, registrar.config.visible) ** 2
        appearance = observation.potential.mT[0, parts].repeat_interleave(C, 0)
        inside = (appearance - square / (2 * self.config.sigma**2)).logsumexp(1)
        share = (registrar.config.effective_points / cloud.mask.sum().clamp_min(1)).clamp_max(1)
        score = share * (torch.logaddexp(rest.repeat_interleave(C, 0), inside) * cloud.mask).sum(1)
        if registrar.config.rim.weight > 0:
            rows = silhouette_rows(limb, observation.nearest, observation.camera, registrar.config.rim)
            score = score - 0.5 * rows.residual(limb).square().sum(1)
        return score.unflatten(0, (L, C))

    def _rest_of_body(
        self, observation: Observation, pose: Tensor, size: Tensor
    ) -> Float[Tensor, "limbs num"]:
        """Log-density of each point by all parts but a limb's own, and by none."""
        posed = self.body(pose, size)
        square = (
            foot_point(posed, observation.cloud.points, self.registrar.config.visible).residual ** 2
        ).sum(-1)
        potential = observation.potential.mT - square / (2 * self.config.sigma**2)  # (1, parts, N)
        potential = potential.masked_fill(self.own[:, :, None], -torch.inf)
        none = torch.full_like(potential[:, :1], -0.5 * max(self.registrar.config.outlier, 3.0) ** 2)
        return torch.cat([potential, none], 1).logsumexp(1)


def _only(posed: PosedBody, parts: Int[Tensor, "batch own"]) -> PosedBody:
    """A posed body with these ellipsoids alone."""
    index = parts[..., None]
    return replace(
        posed,
        centers=posed.centers.gather(1, index.expand(-1, -1, 3)),
        frames=posed.frames.flatten(2).gather(1, index.expand(-1, -1, 9)).unflatten(2, (3, 3)),
        radii=posed.radii.gather(1, index.expand(-1, -1, 3)),
    )
