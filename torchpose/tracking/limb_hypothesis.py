"""Several poses of each limb in each frame of a stretch, and the sequence of them that fits frames and time best.

A frame alone cannot leave a run of wrong ones: the tie to its neighbours outweighs what it sees. So each limb keeps in
each frame several places: where it is, where a search finds points for it, and where it is in other frames. Arms and
legs are nearly independent given the trunk, so each limb has a chain of its own. Metres, radians, nats.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose.body.model import BodyModel
from torchpose.registration.fitting import PosePrior, pose_terms
from torchpose.registration.labelling import LabellingConfig
from torchpose.registration.limb_score import KnownBody, LimbScore
from torchpose.registration.limb_search import LimbSearch, LimbSearchConfig
from torchpose.registration.start import thin
from torchpose.registration.vem import Observation, Registrar, Registration
from torchpose.tracking.trellis import best_sequence, spread, step_cost, weights

MOST = 64  # rows registered at once: more are no faster
SCORED = 128  # rows of which a limb alone is judged
Candidates = Float[Tensor, "frames limbs candidates 4"]
HELD = 1e6  # precision, rad and m, of the rest of the body while a limb is fitted


@dataclass(frozen=True)
class HypothesisConfig:
    sweeps: int = 3  # in which limbs also try where other frames have them; 0 keeps one pose of each frame
    every: int = 4  # frames of which one is searched
    points: int = 250  # of each cloud
    keep: int = 8  # places of each limb in each frame
    apart: float = 0.25  # rad by which two of them differ
    fits: int = 2  # new ones of each limb and frame that are fitted in each sweep
    hopeless: float = 30.0  # nats by which a place may be worse than where the limb is believed to be
    rounds: int = 3  # of these fits
    sigma: float = 0.05  # m, in the first of them
    reach: tuple[int, ...] = (1, 2, 4, 8)  # frames, to either side, from which places are tried
    limbs: LimbSearchConfig = field(default_factory=LimbSearchConfig)

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

    def best(self, keep: int, apart: float, hopeless: float) -> "Table":
        """The cheapest ones that differ from each other; the first, where the limb is believed to be, always stays."""
        rank = torch.where(self.cost > self.cost[..., :1] + hopeless, torch.inf, self.cost)
        rank[..., 0] = -torch.inf
        index, costs = [], []
        for _ in range(min(keep, rank.shape[2])):
            least, which = rank.min(2)
            index.append(which)
            costs.append(
                torch.where(least < torch.inf, self.cost.gather(2, which[..., None])[..., 0], torch.inf)
            )
            rank = torch.where(self._near(which, apart), torch.inf, rank)
        place = self.place.gather(2, torch.stack(index, 2)[..., None].expand(-1, -1, -1, self.place.shape[3]))
        cost = torch.stack(costs, 2)
        # An empty place is a number, too, or it would spoil sums in which it does not count.
        return Table(torch.where(cost[..., None].isinf(), place[:, :, :1], place), cost)

    def _near(self, which: Int[Tensor, "frames limbs"], apart: float) -> Tensor:
        """Those that hardly differ from one."""
        one = self.place.gather(2, which[..., None, None].expand(-1, -1, 1, self.place.shape[3]))
        near = (self.place - one).abs().amax(3) < apart
        return near.scatter(2, which[..., None], True)

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
        effective = registrar.config.effective_points / 2  # see `nearer_half`
        self.fitter = Registrar(body, replace(self.registrar.config, effective_points=effective))
        self.score = LimbScore(self.search)

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
        few = thin(observation, self.config.points)
        size = size.expand(T, -1)
        work, limbs = _Work(self, few, size, rest_share), self.search.limbs
        table, pulls = work.start(pose), pull[:, limbs]
        table = work.add(table, pose, work.searched(pose))
        for _ in range(self.config.sweeps):
            table = work.add(table, pose, self._elsewhere(table))
            for limb in range(L):
                own = slice(limb, limb + 1)
                chosen = torch.zeros(T, L, dtype=torch.long, device=pose.device)
                step = step_cost(table.place[:, own], pulls[:, own])
                chosen[:, own] = best_sequence(_sound(table.cost[:, own]), step)
                table = table.first(chosen)
                pose = pose.scatter(1, limbs[own].expand(T, -1), table.place[:, limb, 0])
                # Arms compete for the same points, and so do legs.
                beside = (chosen[:, own] > 0) & (self.search.beside == limb)
                table = work.again(table, pose, beside)
        weight = weights(_sound(table.cost), step_cost(table.place, pulls))
        more = spread(table.place, weight, table.place[:, :, 0])
        covariance = pose.new_zeros(T, P, P)
        for limb, own in enumerate(limbs):
            covariance[:, own[:, None], own] += more[:, limb]
        return pose, covariance

    def _elsewhere(self, table: Table) -> Candidates:
        """Where other frames have the limb: the place where it is believed to be there, and the best other one."""
        T = len(table.place)
        rank = table.cost.clone()
        rank[..., 0] = torch.inf
        second = table.place.gather(2, rank.argmin(2)[..., None, None].expand(-1, -1, 1, 4))[:, :, 0]
        second = torch.where(rank.amin(2)[..., None].isfinite(), second, torch.nan)
        frames, out = torch.arange(T, device=second.device), []
        for places in (second, table.place[:, :, 0]):
            for way in (d * side for d in self.config.reach for side in (-1, 1)):
                source = frames + way
                inside = ((source >= 0) & (source < T))[:, None, None]
                out.append(torch.where(inside, places[source.clamp(0, T - 1)], torch.nan))
        return torch.stack(out, 2)


@dataclass(frozen=True)
class _Work:
    """Fits and scores of limbs in the frames of one stretch."""

    of: LimbHypotheses
    observation: Observation
    size: Float[Tensor, "frames sizes"]
    rest_share: float

    @cached_property
    def blind(self) -> Bool[Tensor, " frames"]:
        """Frames of broken points: to them all places are alike, or they would hold their neighbours where they are."""
        cloud = self.observation.cloud
        broken = cloud.points.isnan().any(2) | self.observation.potential.isnan().any(2)
        return (broken & cloud.mask).any(1)

    @property
    def limbs(self) -> Int[Tensor, "limbs 4"]:
        return self.of.search.limbs

    def start(self, pose: Float[Tensor, "frames parameters"]) -> Table:
        """The believed places alone."""
        T, L = len(pose), len(self.of.search.limbs)
        cost = torch.where(self.blind, 0.0, self.nats(torch.arange(T, device=pose.device), pose))
        return Table(pose[:, self.of.search.limbs][:, :, None], cost[:, None, None].expand(-1, L, -1).clone())

    def nats(
        self, frame: Int[Tensor, " rows"], pose: Float[Tensor, "rows parameters"]
    ) -> Float[Tensor, " rows"]:
        """Minus the log-density of frames at poses, with the pull to rest that counts in one frame of many."""
        registrar, out = self.of.registrar, []
        for t, p in zip(frame.split(MOST), pose.split(MOST), strict=True) if len(frame) else ():
            nothing = PosePrior(p, torch.zeros_like(p))
            bound = p.new_zeros(1, len(p))
            found = registrar.evaluate(
                self.observation.share(t), p, self.size[t], nothing, bound, bound[0].long(), covariance=False
            )
            out.append(self._score(found))
        return torch.cat(out) if out else pose.new_zeros(0)

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

    def searched(self, pose: Float[Tensor, "frames parameters"]) -> Candidates:
        """Where a search in some frames finds points for a limb."""
        T, L, best = len(pose), len(self.limbs), self.of.config.limbs.best
        place = pose.new_full((T, L, best, 4), torch.nan)
        for t in range(self.of.config.every // 2, T, self.of.config.every):
            one = torch.tensor([t], device=pose.device)
            (found,) = self.of.search(self.observation.take(one), pose[one], self.size[one])  # (L, best, P)
            place[t] = found.gather(2, self.limbs[:, None].expand(-1, best, -1))
        return place

    def add(self, table: Table, pose: Float[Tensor, "frames parameters"], place: Candidates) -> Table:
        """With new places: the best few of those that differ from what is there, as they are and fitted."""
        config = self.of.config
        new = self._new(table, place)
        known = self._known(pose, new)
        raw = self._cost(pose, place, new, known)
        few = Table(place, raw).best(config.fits, config.apart, torch.inf)
        open_ = few.cost < table.cost[..., :1] + 2 * config.hopeless
        frame, limb, slot = open_.nonzero(as_tuple=True)
        fitted = few.place.clone()
        start = pose[frame].scatter(1, self.limbs[limb], few.place[frame, limb, slot])
        fitted[frame, limb, slot] = self._fit(frame, limb, start).gather(1, self.limbs[limb])
        cost = self._cost(pose, fitted, open_, known)
        together = Table(
            torch.cat([table.place, few.place, fitted], 2),
            torch.cat([table.cost, torch.where(open_, few.cost, torch.inf), cost], 2),
        )
        return together.best(config.keep, config.apart / 2, config.hopeless)

    def _new(self, table: Table, place: Candidates) -> Bool[Tensor, "frames limbs candidates"]:
        """Those that differ from the table's and from those before them."""
        apart, known = (
            self.of.config.apart,
            torch.where(table.cost[..., None].isfinite(), table.place, torch.nan),
        )
        known[:, :, 0] = table.place[:, :, 0]
        new = []
        for one in place.unbind(2):
            near = ((known - one[:, :, None]).abs().amax(3) <= apart).any(2)
            new.append(one.isfinite().all(2) & ~near)
            known = torch.cat([known, torch.where(new[-1][..., None], one, torch.nan)[:, :, None]], 2)
        return torch.stack(new, 2)

    def _known(
        self, pose: Float[Tensor, "frames parameters"], some: Bool[Tensor, "frames limbs candidates"]
    ) -> tuple[KnownBody, Tensor] | None:
        """The frames with places to be judged; None where this takes the whole registrar."""
        frames = some.flatten(1).any(1).nonzero()[:, 0]
        if len(frames) == 0 or not self.of.score.serves(self.of.registrar):
            return None
        row = frames.new_zeros(len(pose)).index_put(
            (frames,), torch.arange(len(frames), device=frames.device)
        )
        return self.of.score.know(self.observation.share(frames), pose[frames], self.size[frames]), row

    def _cost(
        self,
        pose: Float[Tensor, "frames parameters"],
        place: Candidates,
        some: Bool[Tensor, "frames limbs candidates"],
        known: tuple[KnownBody, Tensor] | None,
    ) -> Float[Tensor, "frames limbs candidates"]:
        """Of some places on the believed rest of the body; the others' are infinite."""
        frame, limb, slot = some.nonzero(as_tuple=True)
        own = place[frame, limb, slot]
        cost = place.new_full(place.shape[:3], torch.inf)
        if known is None:
            nats = self.nats(frame, pose[frame].scatter(1, self.limbs[limb], own))
        else:
            body, row = known
            pieces = zip(row[frame].split(SCORED), limb.split(SCORED), own.split(SCORED), strict=True)
            nats = torch.cat([self.of.score(body, *piece, self.rest_share) for piece in pieces])
        cost[frame, limb, slot] = torch.where(self.blind[frame], 0.0, nats.nan_to_num(nan=torch.inf))
        return cost

    def _fit(self, frame: Tensor, limb: Tensor, start: Tensor) -> Tensor:
        config, out = self.of.config, []
        for t, k, p in (
            zip(frame.split(MOST), limb.split(MOST), start.split(MOST), strict=True) if len(frame) else ()
        ):
            hold = torch.full_like(p, HELD).scatter(1, self.limbs[k], 0.0)
            half = self.of.score.nearer_half(self.observation.share(t), p, self.size[t], k)
            found, _, _ = self.of.fitter.approach(
                half, p, self.size[t], PosePrior(p, hold), config.rounds, config.sigma
            )
            out.append(torch.where(found.value.isfinite().all(1, keepdim=True), found.value, p))
        return torch.cat(out) if out else start

    def again(
        self, table: Table, pose: Float[Tensor, "frames parameters"], some: Bool[Tensor, "frames limbs"]
    ) -> Table:
        """With the costs of some limbs in some frames anew, since the limb beside it moved."""
        which = table.cost.isfinite() & some[..., None]
        cost = self._cost(pose, table.place, which, self._known(pose, which))
        return Table(table.place, torch.where(some[..., None], cost, table.cost))


def _sound(cost: Tensor) -> Tensor:
    """A frame without a finite cost for its first hypothesis says nothing."""
    broken = ~cost[..., :1].isfinite()
    return torch.where(broken, 0.0, torch.where(cost.isfinite(), cost, torch.inf))
