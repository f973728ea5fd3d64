"""Several poses of each limb in each frame of a stretch, and the sequence of them that fits frames and time best.

A frame alone cannot leave a run of wrong ones: the tie to its neighbours outweighs what it sees. So each limb keeps in
each frame several places: where it is, where a search finds points for it, and where it is in other frames. Arms and
legs are nearly independent given the trunk, so each limb has a chain of its own. Metres, radians, nats.
"""

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchpose.body.model import BodyModel, PosedBody
from torchpose.registration.fitting import PosePrior, pose_terms
from torchpose.registration.labelling import LabellingConfig
from torchpose.registration.limb_search import LimbSearch, LimbSearchConfig
from torchpose.registration.occlusion import OcclusionConfig, occlusion_potential
from torchpose.registration.size import stack_observations
from torchpose.registration.start import thin
from torchpose.registration.vem import Observation, Registrar, Registration
from torchpose.tracking.trellis import best_sequence, spread, step_cost, weights

MOST = 64  # rows registered at once: more are no faster
HELD = 1e6  # precision, rad and m, of the rest of the body while a limb is fitted


@dataclass(frozen=True)
class HypothesisConfig:
    sweeps: int = 3  # in which limbs also try where other frames have them; 0 keeps one pose of each frame
    every: int = 4  # frames of which one is searched
    points: int = 250  # of each cloud
    keep: int = 8  # places of each limb in each frame
    apart: float = 0.25  # rad by which two of them differ
    fits: int = 2  # new ones of each limb and frame that are fitted in each sweep
    rounds: int = 3  # of these fits
    sigma: float = 0.05  # m, in the first of them
    reach: tuple[int, ...] = (1, 3, 9)  # frames, to either side, from which places are tried
    limbs: LimbSearchConfig = field(default_factory=LimbSearchConfig)
    occlusion: OcclusionConfig = field(default_factory=OcclusionConfig)

    def __post_init__(self) -> None:
        if self.sweeps < 0:
            raise ValueError(f"sweeps must not be negative, got {self.sweeps}; 0 switches hypotheses off")
        for name in ("every", "points", "keep", "fits", "rounds", "apart", "sigma"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if not self.reach or min(self.reach) < 1:
            raise ValueError(f"reach needs at least one number of frames, from 1 on, got {self.reach}")


@dataclass(frozen=True)
class Table:
    """Places of every limb in every frame; empty ones have infinite cost."""

    place: Float[Tensor, "frames limbs hypotheses 4"]  # rad
    cost: Float[Tensor, "frames limbs hypotheses"]  # nats, of the frame alone

    def best(self, keep: int) -> "Table":
        """The cheapest ones; the first, where the limb is believed to be, always stays."""
        if self.cost.shape[2] <= keep:
            return self
        rank = self.cost.clone()
        rank[..., 0] = -torch.inf
        index = rank.topk(keep, 2, largest=False).indices
        return Table(
            self.place.gather(2, index[..., None].expand(-1, -1, -1, self.place.shape[3])),
            self.cost.gather(2, index),
        )

    def first(self, chosen: Int[Tensor, "frames limbs"]) -> "Table":
        """With the chosen ones in front."""
        H = self.cost.shape[2]
        order = torch.arange(H, device=chosen.device).expand(*chosen.shape, H).clone()
        order.scatter_(2, chosen[..., None], 0)
        order[..., 0] = chosen
        wide = order[..., None].expand(-1, -1, -1, self.place.shape[3])
        return Table(self.place.gather(2, wide), self.cost.gather(2, order))


class LimbHypotheses(nn.Module):
    """Chooses among several places of each limb over a stretch of frames."""

    def __init__(self, body: BodyModel, registrar: Registrar, config: HypothesisConfig = HypothesisConfig()):
        super().__init__()
        self.body, self.config = body, config
        alone = LabellingConfig(sweeps=0, potts=0.0)
        self.registrar = Registrar(body, replace(registrar.config, labelling=alone))
        self.search = LimbSearch(body, self.registrar, config.limbs)

    def forward(
        self,
        observation: Observation,
        pose: Float[Tensor, "frames parameters"],
        size: Float[Tensor, "#frames sizes"],
        pull: Float[Tensor, "frames_1 parameters"],
        rest_share: float,
    ) -> tuple[Float[Tensor, "frames parameters"], Float[Tensor, "frames parameters parameters"]]:
        """The poses with the best sequence of each limb, and what the other sequences add to their covariances.

        Args:
            observation: of all frames.
            pose: finite, where limbs are believed to be.
            pull: precision of the step from each frame to the next.
            rest_share: of the pull of unseen limbs to rest, that counts in each frame.
        """
        T, P = pose.shape
        L = len(self.search.limbs)
        few = stack_observations(
            [thin(observation.take(torch.tensor([t], device=pose.device)), self.config.points) for t in range(T)]
        )
        size = size.expand(T, -1)
        work = _Work(self, few, size, rest_share)
        limbs = self.search.limbs
        table = work.start(pose)
        table = work.add(table, pose, *work.searched(pose), self.config.fits + 1)
        pulls = pull[:, limbs]
        for sweep in range(self.config.sweeps):
            table = work.add(table, pose, *self._elsewhere(table), self.config.fits)
            for limb in range(L):
                step = step_cost(table.place[:, limb : limb + 1], pulls[:, limb : limb + 1])
                chosen = torch.zeros(T, L, dtype=torch.long, device=pose.device)
                chosen[:, limb] = best_sequence(_sound(table.cost[:, limb : limb + 1]), step)[:, 0]
                moved = chosen[:, limb] > 0
                table = table.first(chosen)
                pose = pose.index_put(
                    (torch.arange(T, device=pose.device)[:, None], limbs[limb]), table.place[:, limb, 0]
                )
                if bool(moved.any()):
                    table = work.again(table, pose, moved)
        weight = weights(_sound(table.cost), step_cost(table.place, pulls))
        more = spread(table.place, weight, table.place[:, :, 0])
        covariance = pose.new_zeros(T, P, P)
        for limb, own in enumerate(limbs):
            covariance[:, own[:, None], own] += more[:, limb]
        return pose, covariance

    def _elsewhere(self, table: Table) -> tuple[Tensor, Tensor, Tensor]:
        """Frames, limbs and places: where other frames have the limb, or might have it."""
        T, L, H, _ = table.place.shape
        # Of each frame the place where the limb is believed to be, and the best other one.
        rank = table.cost.clone()
        rank[..., 0] = torch.inf
        rank[(table.place - table.place[:, :, :1]).abs().amax(3) < self.config.apart] = torch.inf
        second = rank.argmin(2)
        known = rank.amin(2).isfinite()
        other = table.place.gather(2, second[..., None, None].expand(-1, -1, 1, 4))[:, :, 0]
        frames = torch.arange(T, device=second.device)
        out: list[tuple[Tensor, Tensor, Tensor]] = []
        for way in (d * side for d in self.config.reach for side in (-1, 1)):
            source = frames + way
            inside = ((source >= 0) & (source < T))[:, None].expand(-1, L)
            source = source.clamp(0, T - 1)
            for place, there in ((table.place[:, :, 0], None), (other, known)):
                ok = inside if there is None else inside & there[source]
                t, limb = ok.nonzero(as_tuple=True)
                out.append((t, limb, place[source][t, limb]))
        t, limb, place = (torch.cat(x) for x in zip(*out, strict=True))
        return t, limb, place


@dataclass(frozen=True)
class _Work:
    """Fits and scores of limbs in the frames of one stretch."""

    of: LimbHypotheses
    observation: Observation
    size: Float[Tensor, "frames sizes"]
    rest_share: float

    def start(self, pose: Float[Tensor, "frames parameters"]) -> Table:
        """The believed places alone."""
        T, L = len(pose), len(self.of.search.limbs)
        cost = self.nats(torch.arange(T, device=pose.device), pose)
        return Table(pose[:, self.of.search.limbs][:, :, None], cost[:, None, None].expand(-1, L, -1).clone())

    def nats(self, frame: Int[Tensor, " rows"], pose: Float[Tensor, "rows parameters"]) -> Float[Tensor, " rows"]:
        """Minus the log-density of frames at poses, with the pull to rest that counts in one frame of many."""
        registrar, out = self.of.registrar, []
        for t, p in zip(frame.split(MOST), pose.split(MOST), strict=True):
            nothing = PosePrior(p, torch.zeros_like(p))
            bound = p.new_zeros(1, len(p))
            found = registrar.evaluate(self.seen(t, p), p, self.size[t], nothing, bound, bound[0].long())
            out.append(self._score(found))
        return torch.cat(out) if out else pose.new_zeros(0)

    def seen(self, frame: Tensor, pose: Tensor) -> Observation:
        """Frames, whose points are not of parts that are hidden at these poses."""
        posed = self.of.body(pose, self.size[frame])
        return unoccluded(self.observation.take(frame), posed, self.of.config.occlusion)

    def _score(self, found: Registration) -> Tensor:
        K = self.of.body.num_parts
        best = found.belief.max(1)
        on = (best.indices < K) & (best.values > 0)
        support = found.pose.new_zeros(len(found.pose), K).scatter_add(
            1, best.indices.clamp_max(K - 1), on.to(found.pose)
        )
        nothing = PosePrior(found.pose, torch.zeros_like(found.pose))
        rest = self.of.registrar.with_rest(nothing, support)
        config = self.of.registrar.config.fitting
        terms, _ = pose_terms(self.of.body, found.pose, rest, replace(config, limit_sd=0.0))
        return found.score - (1 - self.rest_share) * 0.5 * terms.square().sum((1, 2))

    def searched(self, pose: Float[Tensor, "frames parameters"]) -> tuple[Tensor, Tensor, Tensor]:
        """Frames, limbs and places that a search in some frames finds."""
        limbs, best = self.of.search.limbs, self.of.config.limbs.best
        frames = torch.arange(self.of.config.every // 2, len(pose), self.of.config.every, device=pose.device)
        places = []
        for t in frames.split(1):
            found = self.of.search(self.observation.take(t), pose[t], self.size[t])  # (L, best, P)
            places.append(found.gather(2, limbs[:, None].expand(-1, best, -1)))
        L = len(limbs)
        t = frames.repeat_interleave(L * best)
        limb = torch.arange(L, device=pose.device).repeat_interleave(best).repeat(len(frames))
        return t, limb, torch.stack(places).flatten(0, 2)

    def add(
        self, table: Table, pose: Tensor, frame: Tensor, limb: Tensor, place: Tensor, fits: int
    ) -> Table:
        """With new places: those that differ from what is there, as they are and, the best few, fitted."""
        config, limbs = self.of.config, self.of.search.limbs
        gap = (table.place[frame, limb] - place[:, None]).abs().amax(2)
        gap = torch.where(table.cost[frame, limb].isinf(), torch.inf, gap)
        new = gap.amin(1) > config.apart
        frame, limb, place = frame[new], limb[new], place[new]
        if not len(frame):
            return table
        own = limbs[limb]
        start = pose[frame].scatter(1, own, place)
        cost = self.nats(frame, start)
        raw = self._packed(table, frame, limb, place, cost)
        some = raw.best_of_new(table, fits, config.apart)
        t, l, h = some.nonzero(as_tuple=True)
        start = pose[t].scatter(1, limbs[l], raw.table.place[t, l, h])
        fitted = self._fit(t, l, start)
        fitted_place = fitted.gather(1, limbs[l])
        # On the believed rest of the body, which the fit may have moved a little.
        done = self.nats(t, pose[t].scatter(1, limbs[l], fitted_place))
        kept = Table(raw.table.place, torch.where(raw.allowed(table, some), raw.table.cost, torch.inf))
        return self._packed(kept, t, l, fitted_place, done).table.best(config.keep)

    def _fit(self, frame: Tensor, limb: Tensor, start: Tensor) -> Tensor:
        config, out = self.of.config, []
        for t, l, p in zip(frame.split(MOST), limb.split(MOST), start.split(MOST), strict=True):
            hold = torch.full_like(p, HELD).scatter(1, self.of.search.limbs[l], 0.0)
            found = self.of.registrar(
                self.seen(t, p), p, self.size[t], PosePrior(p, hold), config.rounds, config.sigma
            )
            out.append(torch.where(found.pose.isfinite().all(1, keepdim=True), found.pose, p))
        return torch.cat(out)

    def _packed(self, table: Table, frame: Tensor, limb: Tensor, place: Tensor, cost: Tensor) -> "_Packed":
        """The table with a list of places behind."""
        T, L, H, _ = table.place.shape
        chain = frame * L + limb
        order = chain.argsort(stable=True)
        count = torch.bincount(chain, minlength=T * L)
        slot = torch.arange(len(chain), device=chain.device) - (count.cumsum(0) - count)[chain[order]]
        more = int(count.max()) if len(chain) else 0
        places = table.place[:, :, :1].repeat(1, 1, more, 1)
        costs = table.cost.new_full((T, L, more), torch.inf)
        places[frame[order], limb[order], slot] = place[order]
        costs[frame[order], limb[order], slot] = cost[order]
        return _Packed(Table(torch.cat([table.place, places], 2), torch.cat([table.cost, costs], 2)), H)

    def again(self, table: Table, pose: Tensor, moved: Tensor) -> Table:
        """With the costs of some frames anew, in which a limb was moved."""
        frame, limb, h = (table.cost.isfinite() & moved[:, None, None]).nonzero(as_tuple=True)
        placed = pose[frame].scatter(1, self.of.search.limbs[limb], table.place[frame, limb, h])
        cost = table.cost.index_put((frame, limb, h), self.nats(frame, placed))
        return Table(table.place, cost)


@dataclass(frozen=True)
class _Packed:
    table: Table
    old: int

    def best_of_new(self, before: Table, num: int, apart: float) -> Tensor:
        """The cheapest new ones that differ from each other."""
        cost, some = self.table.cost.clone(), torch.zeros_like(self.table.cost, dtype=torch.bool)
        cost[..., : self.old] = torch.inf
        for _ in range(num):
            best, index = cost.min(2)
            chosen = self.table.place.gather(2, index[..., None, None].expand(-1, -1, 1, 4))
            some |= torch.zeros_like(some).scatter(2, index[..., None], True) & best.isfinite()[..., None]
            near = (self.table.place - chosen).abs().amax(3) < apart
            cost = torch.where(near, torch.inf, cost)
        return some

    def allowed(self, before: Table, some: Tensor) -> Tensor:
        """The old ones and the chosen new ones."""
        keep = some.clone()
        keep[..., : self.old] = True
        return keep


def _sound(cost: Tensor) -> Tensor:
    """A frame without a finite cost for its first hypothesis says nothing."""
    broken = ~cost[..., :1].isfinite()
    return torch.where(broken, 0.0, torch.where(cost.isfinite(), cost, torch.inf))


def unoccluded(observation: Observation, posed: PosedBody, config: OcclusionConfig) -> Observation:
    """The observation with what the posed body hides of itself among its potentials."""
    if config.penalty == 0:
        return observation
    hidden = occlusion_potential(posed, observation.cloud.points, config)
    return replace(observation, potential=observation.potential + hidden)
