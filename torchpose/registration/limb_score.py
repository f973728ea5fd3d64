"""What frames say of many places of their limbs: the rest of the body is judged once, and of each place the limb alone.

`Registrar.evaluate` gives the same for labels that are hard and of each point alone, at several times the cost.
Left-camera frame; metres, radians and nats.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose.body.ellipsoid import foot_of_part, rough_square
from torchpose.body.model import PosedBody
from torchpose.registration.fitting import PosePrior, pose_terms
from torchpose.registration.limb_search import LEAST, LimbSearch
from torchpose.registration.occlusion import behind, entries
from torchpose.registration.silhouette import silhouette_residual
from torchpose.registration.solid import parts_of, solid_residual
from torchpose.registration.start import picked
from torchpose.registration.vem import Distance, Observation, Registrar, nearest_parts


@dataclass(frozen=True)
class KnownBody:
    """Frames and their bodies' parts, those of the limb among them that is moved each time."""

    observation: Observation
    pose: Float[Tensor, "frames parameters"]
    size: Float[Tensor, "frames sizes"]
    potential: Float[Tensor, "frames parts num"]  # of each part by its distance to first order
    enters: Float[Tensor, "frames parts num"]  # see `entries`
    front: Float[Tensor, "frames parts num"]
    far: Float[Tensor, "frames parts num"]  # what a point says of the joint that its part hangs on, at most 1
    near: Int[Tensor, "frames limbs few num"]  # the parts of other limbs and the trunk that are nearest
    rough: Float[Tensor, "frames limbs few num"]  # m^2, their distances to first order
    near_potential: Float[Tensor, "frames limbs few num"]  # of these by their exact distances
    rims: Float[Tensor, "frames limbs"]  # squared residuals of all rims but the limb's


class LimbScore(nn.Module):
    """Judges poses that differ from their frame's in one limb alone."""

    limbs: Tensor  # as the search has them
    parts: Tensor

    def __init__(self, search: LimbSearch):
        super().__init__()
        self.body, self.registrar = search.body, search.registrar
        self.register_buffer("limbs", search.limbs, persistent=False)
        self.register_buffer("parts", search.parts, persistent=False)

    @staticmethod
    def serves(registrar: Registrar) -> bool:
        """Whether the registrar judges points as it is done here."""
        config = registrar.config
        alone = config.labelling.sweeps == 0 and config.labelling.potts == 0
        return alone and config.hard and config.distance is Distance.euclidean

    def know(
        self,
        observation: Observation,
        pose: Float[Tensor, "frames parameters"],
        size: Float[Tensor, "frames sizes"],
    ) -> KnownBody:
        """What all places of the limbs of some frames have in common."""
        config, points = self.registrar.config, observation.cloud.points
        posed = self.body(pose, size)
        pressed, _ = self.registrar.pressed(posed, observation)
        square = rough_square(pressed, points, config.visible)
        F, K = square.shape[:2]
        own = torch.zeros(len(self.parts), K, dtype=torch.bool, device=pose.device).scatter(
            1, self.parts, True
        )
        others = torch.where(own[:, :, None], torch.inf, square[:, None])
        few = min(config.near, K - self.parts.shape[1])
        near = nearest_parts(others, few)
        rough = others.gather(2, near)
        asked = torch.zeros_like(square, dtype=torch.bool).scatter(1, near.flatten(1, 2), True)
        exact = self._exact(pressed, points, square, asked)
        potential = observation.potential.mT
        shape = near.flatten(1, 2)
        at_near = potential.gather(1, shape) - exact.gather(1, shape) / (2 * config.sigma_last**2)
        enters, front = entries(posed, points)
        rims = pose.new_zeros(F, K)
        if config.rim.weight > 0:
            rims = self._rims(posed, observation)
        return KnownBody(
            observation,
            pose,
            size,
            potential - square / (2 * config.sigma_last**2),
            enters,
            front,
            self._far(posed.origins[:, self.body.carriers[:K]], points),
            near,
            rough,
            at_near.view_as(near),
            rims @ (~own).to(rims).mT,
        )

    def forward(
        self,
        known: KnownBody,
        frame: Int[Tensor, " rows"],
        limb: Int[Tensor, " rows"],
        place: Float[Tensor, "rows 4"],
        rest_share: float,
    ) -> Float[Tensor, " rows"]:
        """Minus the log-density of frames with one limb of each in another place, nats, up to a constant of the frame.

        Args:
            frame: among the known ones.
            rest_share: of the pull of unseen limbs to rest, that counts.
        """
        config, few = self.registrar.config, known.near.shape[2]
        observation = known.observation.share(frame)
        cloud, points = observation.cloud, observation.cloud.points
        pose = known.pose[frame].scatter(1, self.limbs[limb], place)
        whole = self.body(pose, known.size[frame])
        own = self.parts[limb]  # (rows, own)
        posed = _chosen(whole, own)
        pressed, _ = self.registrar.pressed(posed, observation)
        at = torch.arange(len(own), device=own.device)[:, None], own  # of a table of all parts the limb's
        near, rough = known.near[frame, limb], known.rough[frame, limb]
        # A part is judged by its exact distance where it is among the nearest of all parts.
        square = rough_square(pressed, points, config.visible)
        among = _least(torch.cat([rough, square], 1), config.near)
        square = self._exact(pressed, points, square, among[:, few:])
        # All parts in one table: the known ones, the nearest among them exactly, and the limb's own.
        potential, appearance = known.potential[frame], observation.potential.mT
        exact = torch.where(among[:, :few], known.near_potential[frame, limb], potential.gather(1, near))
        potential.scatter_(1, near, exact)
        potential[at] = appearance[at] - square / (2 * config.sigma_last**2)
        if config.occlusion.penalty > 0:
            enters, front = known.enters[frame], known.front[frame]
            enters[at], front[at] = entries(posed, points)
            potential = potential + config.occlusion.potential(behind(enters, front))
        none = -0.5 * config.outlier**2 if config.outlier > 0 else -torch.inf
        best = potential.amax(1, keepdim=True)
        most = best.clamp_min(none)
        # By hand: `exp` of what is 0 in single precision takes 20 times as long.
        total = (potential - most).clamp_min_(LEAST).exp_().sum(1, keepdim=True) + (none - most).exp()
        bound = ((most + total.log())[:, 0] * cloud.mask).sum(1)
        count = cloud.mask.sum(1).clamp_min(1)
        score = -bound * (config.effective_points / count).clamp_max(1)
        if config.rim.weight > 0:
            score = score + 0.5 * (known.rims[frame, limb] + self._rims(posed, observation).sum(1))
        if config.solid.sd > 0:
            trunk = parts_of(whole, self.registrar.core_parts)
            inside = solid_residual(trunk, posed.centers, config.solid)
            score = score + 0.5 * inside.square().sum((1, 2))
        nothing = PosePrior(pose, torch.zeros_like(pose))
        seen = (best > none) & cloud.mask[:, None]
        support = ((potential == best) & seen).sum(2).to(pose)
        rest = self.registrar.with_rest(nothing, support)
        terms, _ = pose_terms(self.body, pose, rest, replace(config.fitting, limit_sd=0.0))
        score = score - (1 - rest_share) * 0.5 * terms.square().sum((1, 2))
        # The nearest parts' points alone count for the pull, and the further from the joint, the more.
        answer = torch.cat([potential.gather(1, near), potential[at]], 1)
        answer = torch.where(among, answer, -torch.inf)
        best = answer.amax(1, keepdim=True)
        joints = whole.origins[at[0], self.body.carriers[own]]
        far = torch.cat([known.far[frame].gather(1, near), self._far(joints, points)], 1)
        far = torch.where((answer == best) & (best > none) & cloud.mask[:, None], far, 0.0)
        support = torch.zeros_like(support).scatter_add(1, near.flatten(1), far[:, :few].flatten(1))
        support[at] = far[:, few:].sum(2)
        terms, _ = pose_terms(self.body, pose, self.registrar.with_rest(nothing, support), config.fitting)
        return score + 0.5 * terms.square().sum((1, 2))

    def nearer_half(
        self,
        observation: Observation,
        pose: Float[Tensor, "rows parameters"],
        size: Float[Tensor, "rows sizes"],
        limb: Int[Tensor, " rows"],
    ) -> Observation:
        """Of each frame the half of its points that is nearer to a limb: what other limbs' points say does not move it.

        A registrar with half the `effective_points` gives these their weights among all.
        """
        cloud = observation.cloud
        posed = _chosen(self.body(pose, size), self.parts[limb])
        away = rough_square(posed, cloud.points, self.registrar.config.visible).amin(1)
        away = torch.where(cloud.mask, away, torch.inf)
        half = picked(observation, away.topk(-(-away.shape[1] // 2), 1, largest=False).indices)
        count = (cloud.mask.sum(1, keepdim=True) + 1) // 2
        own = torch.arange(half.cloud.mask.shape[1], device=limb.device) < count
        return replace(half, cloud=replace(half.cloud, mask=half.cloud.mask & own))

    def _exact(
        self, posed: PosedBody, points: Tensor, square: Tensor, where: Bool[Tensor, "rows parts num"]
    ) -> Tensor:
        """Squared distances, exact ones where asked for."""
        row, part, point = where.nonzero(as_tuple=True)
        if len(row) == 0:
            return square
        one = {name: getattr(posed, name)[:1] for name in PosedBody.__dataclass_fields__}
        one |= {name: getattr(posed, name).flatten(0, 1)[None] for name in ("centers", "frames", "radii")}
        index = (row * where.shape[1] + part)[None, None]
        foot = foot_of_part(PosedBody(**one), index, points[row, point][None], self.registrar.config.visible)
        return square.index_put((row, part, point), foot.residual.square().sum(-1)[0, 0])

    def _far(
        self, joints: Float[Tensor, "rows parts 3"], points: Float[Tensor, "rows num 3"]
    ) -> Float[Tensor, "rows parts num"]:
        gap = points.mT[:, None] - joints[..., None]
        return (gap.square().sum(2) / self.registrar.config.rest_lever**2).clamp_max(1)

    def _rims(self, posed: PosedBody, observation: Observation) -> Float[Tensor, "rows parts"]:
        rim = self.registrar.config.rim
        residual = silhouette_residual(posed, observation.nearest, observation.camera, rim, observation.frame)
        return residual.square().unflatten(1, (-1, rim.rim_points)).sum(2)


def _chosen(posed: PosedBody, part: Int[Tensor, "rows own"]) -> PosedBody:
    """Some ellipsoids of each body."""
    row = torch.arange(len(part), device=part.device)[:, None]
    own = {name: getattr(posed, name)[row, part] for name in ("centers", "frames", "radii")}
    return replace(posed, **own)


def _least(value: Float[Tensor, "rows parts num"], count: int) -> Bool[Tensor, "rows parts num"]:
    """Which are among the `count` least of each point; all of equal ones."""
    level = value.amin(1, keepdim=True)
    for _ in range(min(count, value.shape[1]) - 1):
        level = torch.where(value <= level, torch.inf, value).amin(1, keepdim=True)
    return value <= level
