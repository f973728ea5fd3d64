"""Other places for one limb: many of them are scored against the points while the rest of the body stays.

The hierarchical step (T. 6.2.1): the root is known, the chains outward are sought. Left-camera frame, metres and
radians.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchpose.body.ellipsoid import FEW_STEPS, foot_point, rough_square
from torchpose.body.model import BodyModel, PosedBody
from torchpose.registration.silhouette import silhouette_residual
from torchpose.registration.solid import parts_of, solid_residual
from torchpose.registration.vem import Observation, Registrar

# Of a limb: of its first joint, and of the one after it.
PARAMETERS = 4
AT_ONCE = (
    2**17
)  # pairs of parts and points judged together to first order, and a sixth as many of those judged exactly
LEAST = -80.0  # nats below the most that count as so many
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
    parts: Tensor  # (limbs, own) these parts' numbers
    beside: Tensor  # (limbs,) the limb of the other side; -1 where there is none
    pairs: Tensor  # (pairs, 2) each limb and the one of its other side

    def __init__(self, body: BodyModel, registrar: Registrar, config: LimbSearchConfig = LimbSearchConfig()):
        super().__init__()
        self.body, self.registrar, self.config = body, registrar, config
        first = torch.tensor(body.limb_starts)
        limbs = first[:, None] + torch.arange(PARAMETERS)
        even = torch.quasirandom.SobolEngine(PARAMETERS, scramble=True, seed=0).draw(config.candidates)
        low, high = body.low[limbs][:, None], body.high[limbs][:, None]
        self.register_buffer("limbs", limbs, persistent=False)
        self.register_buffer("places", low + even.to(low) * (high - low), persistent=False)
        self.register_buffer("own", body.part_moves[:, first].T, persistent=False)
        parts = torch.stack([own.nonzero()[:, 0] for own in self.own])
        self.register_buffer("parts", parts, persistent=False)
        names = [_unsided(body.parameter_names[k]) for k in first.tolist()]
        beside = [
            next((n for n, b in enumerate(names) if n != k and a == b), -1) for k, a in enumerate(names)
        ]
        self.register_buffer("beside", torch.tensor(beside), persistent=False)
        pairs = [(k, other) for k, other in enumerate(beside) if other > k]
        self.register_buffer("pairs", torch.tensor(pairs, dtype=torch.long).view(-1, 2), persistent=False)

    def forward(
        self,
        observation: Observation,
        pose: Float[Tensor, "batch parameters"],
        size: Float[Tensor, "#batch sizes"],
    ) -> Float[Tensor, "batch limbs best parameters"]:
        """For each frame and limb the best poses that differ from `pose` in that limb alone."""
        B, (L, C) = len(pose), self.places.shape[:2]
        rest = self._rest_of_body(observation, pose, size)
        places = self.places.expand(B, L, C, PARAMETERS)
        score = self._score(observation, pose, places, size, rest, exact=False).nan_to_num(nan=-torch.inf)
        short = score.topk(self.config.shortlist, 2).indices
        places = places.gather(2, short[..., None].expand(-1, -1, -1, PARAMETERS))
        score = self._score(observation, pose, places, size, rest, exact=True).nan_to_num(nan=-torch.inf)
        # The best ones of all are often one place several times.
        rank, best = score, []
        for _ in range(self.config.best):
            best.append(rank.argmax(2))
            one = places.gather(2, best[-1][..., None, None].expand(-1, -1, 1, PARAMETERS))
            # Those beside it come last, in case there are no others.
            rank = torch.where((places - one).abs().amax(3) < self.config.apart, rank - CLOSE, rank)
            rank = rank.scatter(2, best[-1][..., None], -torch.inf)
        index = torch.stack(best, 2)
        chosen = places.gather(2, index[..., None].expand(-1, -1, -1, PARAMETERS))
        poses = pose[:, None, None].expand(B, L, index.shape[2], -1)
        return poses.scatter(3, self.limbs[:, None].expand_as(chosen), chosen)

    def _score(
        self,
        observation: Observation,
        pose: Float[Tensor, "batch parameters"],
        places: Float[Tensor, "batch limbs candidates 4"],
        size: Float[Tensor, "#batch sizes"],
        rest: Float[Tensor, "batch limbs num"],
        exact: bool,
    ) -> Float[Tensor, "batch limbs candidates"]:
        """Log-density of the points and of the rims, up to a constant for each limb."""
        limbs, parts = self._moved(pose, places, size), self.parts
        # To first order every other point will do; the few best are judged by all of them.
        step, registrar = 1 if exact else 2, self.registrar
        points, mask = observation.cloud.points[:, ::step], observation.cloud.mask[:, None, None, ::step]
        rest = rest[..., ::step]
        count = observation.cloud.mask.sum(1).clamp_min(1)[:, None, None]
        share = step * (registrar.config.effective_points / count).clamp_max(1)
        appearance = observation.potential[:, ::step].mT[:, None, parts]
        # Larger tables leave the cache. An exact distance takes some with three coordinates of two points.
        pairs = AT_ONCE // 6 if exact else AT_ONCE
        together = max(1, pairs // (parts.numel() * mask.numel()))
        bounds = []
        for some in _pieces(limbs, together * parts.numel()):
            if exact:
                foot = foot_point(some, points, registrar.config.visible, FEW_STEPS)
                square = foot.residual.square().sum(-1)
            else:
                square = rough_square(some, points, registrar.config.visible)
            square = square.unflatten(1, (-1, *parts.shape))  # (B, candidates, L, own parts, N)
            inside = appearance - square / (2 * self.config.sigma**2)
            # By hand: `exp` of what is 0 in single precision takes 20 times as long.
            most = torch.maximum(inside.amax(3), rest[:, None])
            total = (inside - most[:, :, :, None]).clamp_min_(LEAST).exp_().sum(3)
            total = total + (rest[:, None] - most).clamp_min_(LEAST).exp_()
            bounds.append(((most + total.log_()) * mask).sum(3))
        score = (share * torch.cat(bounds, 1)).transpose(1, 2)
        return score - self._cost_beside_points(observation, pose, size, limbs, places)

    def score_pairs(
        self,
        observation: Observation,
        pose: Float[Tensor, "batch parameters"],
        places: Float[Tensor, "batch limbs candidates 4"],
        size: Float[Tensor, "#batch sizes"],
    ) -> Float[Tensor, "batch pairs candidates candidates"]:
        """Log-density of frames with both limbs of a pair in any of their places, the rest of the body as in `pose`.

        Each point is of the limbs, the rest or none, as the registrar judges them, to first order and without what
        hides what: for all combinations of places only these three sums are added anew.
        """
        registrar, config, points = self.registrar, self.registrar.config, observation.cloud.points
        limbs, parts = self._moved(pose, places, size), self.parts

        def square(posed: PosedBody) -> Tensor:
            return rough_square(registrar.pressed(posed, observation)[0], points, config.visible)

        C, appearance = places.shape[2], observation.potential.mT
        moved = appearance[:, None, parts] - square(limbs).unflatten(1, (C, *parts.shape)) / (
            2 * config.sigma_last**2
        )
        still = appearance - square(self.body(pose, size)) / (2 * config.sigma_last**2)  # (B, parts, N)
        none = torch.full_like(still[:, :1], -0.5 * config.outlier**2 if config.outlier > 0 else -torch.inf)
        most = torch.maximum(torch.cat([still, none], 1).amax(1), moved.flatten(1, 3).amax(1))
        limb = (moved - most[:, None, None, None]).clamp_min_(LEAST).exp_().sum(3)  # (B, C, L, N)
        left, right = limb[:, :, self.pairs].permute(3, 0, 2, 1, 4)  # (B, pairs, C, N) each
        others = ~self.own[self.pairs].any(1)  # (pairs, parts)
        rest = others.to(still) @ (still - most[:, None]).clamp_min_(LEAST).exp_()
        rest = rest + (none - most[:, None]).clamp_min_(LEAST).exp_()
        total = (left[:, :, :, None] + right[:, :, None] + rest[:, :, None, None]).log_()
        count = observation.cloud.mask.sum(1).clamp_min(1)
        bound = ((total + most[:, None, None, None]) * observation.cloud.mask[:, None, None, None]).sum(4)
        score = bound * (config.effective_points / count).clamp_max(1)[:, None, None, None]
        cost = self._cost_beside_points(observation, pose, size, limbs, places)[:, self.pairs]
        return score - cost[:, :, 0, :, None] - cost[:, :, 1, None]

    def _moved(
        self, pose: Tensor, places: Float[Tensor, "batch limbs candidates 4"], size: Tensor
    ) -> PosedBody:
        """The limbs' ellipsoids in all places, as those of one body of each frame, candidates first.

        They hang on the root and on their own parameters alone: all limbs are moved at once.
        """
        B, C = len(pose), places.shape[2]
        moved = pose[:, None].repeat(1, C, 1)
        moved[:, :, self.limbs] = places.transpose(1, 2)
        sizes = size.expand(B, -1).repeat_interleave(C, 0)
        return _only(self.body(moved.flatten(0, 1), sizes), self.parts.flatten(), B)

    def _cost_beside_points(
        self, observation: Observation, pose: Tensor, size: Tensor, limbs: PosedBody, places: Tensor
    ) -> Float[Tensor, "batch limbs candidates"]:
        """What its rims cost each limb in each place, and what of it runs through trunk or head, nats."""
        config, shape = self.registrar.config, (places.shape[2], places.shape[1], -1)
        cost = torch.zeros_like(places[..., 0])
        if config.rim.weight > 0:
            residual = silhouette_residual(
                limbs, observation.nearest, observation.camera, config.rim, observation.frame
            )
            cost = cost + 0.5 * residual.square().unflatten(1, shape).sum(3).transpose(1, 2)
        if config.solid.sd > 0:
            trunk = parts_of(self.body(pose, size), self.registrar.core_parts)
            inside = solid_residual(trunk, limbs.centers, config.solid).square().sum(1)
            cost = cost + 0.5 * inside.unflatten(1, shape).sum(3).transpose(1, 2)
        return cost

    def _rest_of_body(
        self, observation: Observation, pose: Tensor, size: Tensor
    ) -> Float[Tensor, "batch limbs num"]:
        """Log-density of each point by all parts but a limb's own, and by none."""
        posed = self.body(pose, size)
        square = foot_point(posed, observation.cloud.points, self.registrar.config.visible).residual.square()
        potential = observation.potential.mT - square.sum(-1) / (2 * self.config.sigma**2)  # (B, parts, N)
        potential = potential[:, None].masked_fill(self.own[:, :, None], -torch.inf)
        none = torch.full_like(potential[:, :, :1], -0.5 * max(self.registrar.config.outlier, 3.0) ** 2)
        return torch.cat([potential, none], 2).logsumexp(2)


def _only(posed: PosedBody, parts: Int[Tensor, " own"], batch: int) -> PosedBody:
    """These ellipsoids alone, of several posed bodies of each of `batch` frames as those of one body."""
    every = len(posed.centers) // batch
    one = {name: getattr(posed, name)[::every] for name in PosedBody.__dataclass_fields__}
    for name in ("centers", "frames", "radii"):
        one[name] = getattr(posed, name)[:, parts].unflatten(0, (batch, every)).flatten(1, 2)
    return PosedBody(**one)


def _pieces(posed: PosedBody, size: int) -> Iterator[PosedBody]:
    """Some of the ellipsoids at a time."""
    for k in range(0, posed.centers.shape[1], size):
        own = {name: getattr(posed, name)[:, k : k + size] for name in ("centers", "frames", "radii")}
        yield replace(posed, **own)


def _unsided(name: str) -> str:
    return name.replace("left", "").replace("right", "")
