"""All frames of a stretch at once: each learns from its neighbours, past and coming, what it does not see itself.

Variational Bayesian EM over a chain (T. 3.2.2, 6.2.1, App. B): labels given poses frame by frame, poses given labels in
one Gauss-Newton problem over the frames' chain. Left-camera frame, metres, radians and seconds.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchpose.body.model import BodyModel
from torchpose.least_squares import Status
from torchpose.registration.fitting import PoseEquations, PosePrior, equations_by_moments
from torchpose.registration.start import turned_by
from torchpose.registration.vem import Observation, Registrar, Registration, is_finite
from torchpose.registration.walk import WalkConfig, backwards_cost, walking_yaw
from torchpose.tracking.chain import FLOOR, Chain, fit_chain, solve_chain
from torchpose.tracking.limb_hypothesis import HypothesisConfig, LimbHypotheses

ANGLES = slice(3, 6)  # of the root, which come round again
MOST = 48  # rows registered at once: more are no faster
BETTER = 1.0  # nats by which another pose must fit better to be taken


@dataclass(frozen=True)
class SmoothingConfig:
    rounds: int = 3  # of labelling and joint fitting; 0 leaves the frames as they were tracked
    steps: int = 2  # of Gauss and Newton in each
    joint_drift: float = 1.0  # rad that a joint goes astray in a second, growing with the root of time
    root_drift: float = 0.5  # m and rad, the same for the root
    walk: WalkConfig = field(default_factory=WalkConfig)
    aside: float = 0.7  # rad off that way, from which a frame is also fitted facing it
    facing_rounds: int = 5  # of this
    stretch: int = 50  # frames that are smoothed at once
    ahead: int = 12  # coming frames that they hear of
    rest_time: float = 0.5  # s in which the pull of unseen limbs to rest counts once, see `_rest_share`
    # Of what all points of a part have in common, in all frames: m by which they may be off across it and along it, as
    # surface, joints and borders are not quite the person's. It says how sure the poses are and does not move them.
    offset_sd: float = 0.008
    slide_sd: float = 0.02
    piece: float = 6.0  # times as much for a piece of a part as for all of it
    hypotheses: HypothesisConfig = field(default_factory=HypothesisConfig)

    def __post_init__(self) -> None:
        if self.rounds < 0 or self.steps < 1:
            raise ValueError(f"rounds must not be negative and steps at least 1, got {self}")
        if not 0 <= self.ahead < self.stretch:
            raise ValueError(
                f"0 <= ahead < stretch must hold, in frames, got {self.ahead} and {self.stretch}"
            )
        for name in ("joint_drift", "root_drift", "rest_time", "aside"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if self.facing_rounds < 1:
            raise ValueError(f"facing_rounds must be at least 1, got {self.facing_rounds}")
        for name in ("offset_sd", "slide_sd"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}; 0 switches it off")
        if not self.piece >= 1:
            raise ValueError(
                f"piece must be at least 1, got {self.piece}; 1 takes pieces of parts for whole ones"
            )


@dataclass(frozen=True)
class Message:
    """What the frames before a stretch say of the pose in their last one."""

    time_s: float
    pose: Float[Tensor, " parameters"]
    precision: Float[Tensor, "parameters parameters"]

    def state(self) -> dict[str, Tensor]:
        """As tensors, to go on from after an interruption."""
        time_s = torch.tensor(self.time_s, dtype=torch.float64)
        return {"message_time_s": time_s, "message_pose": self.pose, "message_precision": self.precision}

    @staticmethod
    def from_state(state: Mapping[str, Tensor]) -> "Message":
        """What `state` gave."""
        return Message(float(state["message_time_s"]), state["message_pose"], state["message_precision"])


@dataclass(frozen=True)
class Smoothed:
    """A stretch of frames."""

    registration: Registration  # batch = frames; covariances given all of them
    time_s: Float[Tensor, " frames"]
    filtered: Float[
        Tensor, "frames parameters parameters"
    ]  # precision of each pose given the frames up to it

    def message(self, frame: int) -> Message:
        """What the frames up to this one say of its pose: its mean has heard of later ones, its precision has not."""
        return Message(float(self.time_s[frame]), self.registration.pose[frame], self.filtered[frame])


class Smoother(nn.Module):
    """Poses of a stretch of frames, given the poses that tracking found."""

    def __init__(self, body: BodyModel, registrar: Registrar, config: SmoothingConfig = SmoothingConfig()):
        super().__init__()
        self.body, self.registrar, self.config = body, registrar, config
        self.hypotheses = LimbHypotheses(body, registrar, config.hypotheses)

    def forward(
        self,
        observation: Observation,
        time_s: Float[Tensor, " frames"],
        tracked: Registration,
        size: Float[Tensor, "#frames sizes"],
        before: Message | None = None,
    ) -> Smoothed:
        """Registrations of the frames, batch = frames, with the covariances of the whole stretch.

        A frame whose tracked pose is not finite starts from the nearest one that is and keeps status NON_FINITE; one
        whose observation is not finite gets its neighbours' pose.

        Args:
            observation: of all frames.
            time_s: of each frame, rising.
            tracked: where to begin.
            before: what the frames before this stretch say of it; None says nothing.
        """
        if len(time_s) != len(tracked.pose) or bool((time_s.diff() < 0).any()):
            raise ValueError(
                f"time_s must give one time for each of the {len(tracked.pose)} frames, rising, got {time_s.tolist()}"
            )
        # Before anything compares poses of neighbours: a turn of 2 pi between them is none.
        sound = is_finite(tracked)
        pose = _without_gaps(tracked.pose, sound)
        if self.config.walk.backwards_penalty > 0:
            tracked = self._face_the_way(observation, replace(tracked, pose=pose), time_s, size)
            pose = tracked.pose
        pose = torch.cat([pose[:, :3], _unwound(pose[:, ANGLES], before), pose[:, 6:]], 1)
        best = replace(tracked, pose=pose)
        chain = self._chain(time_s, pose, before)
        pose, covariance, filtered = best.pose, best.covariance, torch.zeros_like(best.covariance)
        between = torch.zeros_like(covariance)
        if self.config.rounds and self.config.hypotheses.sweeps:
            pose, between = self.hypotheses(observation, pose, size, chain.pull, self._rest_share(time_s))
        for _ in range(self.config.rounds):
            equations = self._equations(observation, pose, size, time_s)
            pose, _, filtered = fit_chain(equations, pose, chain, self.config.steps)
        if self.config.rounds:
            # A point's foot slides over the surface: it says where the surface is, nothing along it.
            equations = self._equations(observation, pose, size, time_s, tangential=0.0)
            covariance = self._covariance(equations, pose, size, chain)
        nothing = PosePrior(pose, torch.zeros_like(pose))
        status = torch.where(sound, best.status, int(Status.NON_FINITE))
        result = self.registrar.evaluate(observation, pose, size, nothing, best.bound, status)
        return Smoothed(replace(result, covariance=covariance + between), time_s, filtered)

    def _chain(self, time_s: Tensor, pose: Tensor, before: Message | None) -> Chain:
        """The poses' random walk."""
        rate = torch.full_like(pose[0], self.config.joint_drift)
        rate[:6] = self.config.root_drift
        pull = 1 / (rate**2 * time_s.diff().clamp_min(1e-3).to(pose)[:, None])
        if before is None:
            return Chain(pull, pose[0], torch.zeros_like(pose[0]).diag())
        first = 1 / (rate**2 * max(float(time_s[0]) - before.time_s, 1e-3))
        # (P^-1 + D^-1)^-1 for the precisions P of the pose and D of the step, where P may be singular.
        gain = torch.linalg.solve(before.precision + first.diag(), first.diag())
        return Chain(pull, before.pose, first.diag() - first[:, None] * gain)

    def _face_the_way(
        self, observation: Observation, now: Registration, time_s: Tensor, size: Tensor
    ) -> Registration:
        """Each frame of somebody who walks otherwise than he or she faces is fitted facing the way, too.

        Tracking hears of the way only when some of it is gone.
        """
        config, nothing = self.config, torch.zeros_like(now.pose)
        way = walking_yaw(time_s, now.pose[:, :3], config.walk)
        off = torch.remainder(way - now.pose[:, 3] + torch.pi, 2 * torch.pi) - torch.pi
        rows = (off.abs() > config.aside).nonzero()[:, 0]
        sizes = size.expand(len(time_s), -1)

        def judged(found: Registration, part: Tensor) -> Tensor:
            against = backwards_cost(found.pose[:, 3], way[part], config.walk)
            return found.score.nan_to_num(nan=torch.inf) + against

        for part in rows.split(MOST) if len(rows) else ():
            seen, own = observation.share(part), now.pose[part]
            old = self.registrar.evaluate(
                seen,
                own,
                sizes[part],
                PosePrior(own, nothing[part]),
                now.bound[:, part],
                now.status[part],
            )
            turned = turned_by(self.body, own, off[part], sizes[part])
            new = self.registrar(seen, turned, sizes[part], None, config.facing_rounds)
            better = judged(new, part) < judged(old, part) - BETTER
            now = now.put(part[better], new.take(better.nonzero()[:, 0]))
        return now

    def _equations(
        self,
        observation: Observation,
        pose: Tensor,
        size: Tensor,
        time_s: Tensor,
        tangential: float | None = None,
    ) -> PoseEquations:
        """Of each frame alone, with the labels that its points have at this pose."""
        registrar = self.registrar
        posed = self.body(pose, size)
        foot = registrar.correspond(posed, observation)
        labelling = registrar.label(posed, foot, observation, registrar.config.sigma_last)
        rows, support = registrar.rows(posed, foot, labelling, observation, tangential=tangential)
        rest = registrar.with_rest(PosePrior(pose, torch.zeros_like(pose)), support)
        rest = PosePrior(rest.mean, rest.precision * self._rest_share(time_s))
        equations = equations_by_moments(self.body, size, rows, rest, registrar.config.fitting, posed)
        # Points near a limb's joint alone err alike, as surfaces are not quite the person's: many points in many frames
        # say no more of its direction than one does, and must not outvote what the limb did before, or its rest.
        joints = posed.origins[:, self.body.carriers[: self.body.num_parts]]
        weight = equations.of_rows.reach(posed, joints) ** 4
        return replace(equations, of_rows=equations.of_rows.weighted(weight))

    def _covariance(
        self, equations: PoseEquations, pose: Float[Tensor, "frames parameters"], size: Tensor, chain: Chain
    ) -> Float[Tensor, "frames parameters parameters"]:
        """Of the poses given all frames: from each point's own errors, and from those of a part's points together.

        A part's surface is not quite the person's, and labels end elsewhere than its points do: its points are off by
        one shift in all frames, normal with `offset_sd` across the part and `slide_sd` along it. The poses follow it as
        the chain's equations say: a limb that shows in full hardly turns, one of which only the top shows does.
        """
        posed = self.body(pose, size)
        _, _, normal = equations.at(pose, posed)
        pushed = equations.of_rows.by_offset(posed)
        sound = (normal.isfinite() & pushed.isfinite().all(2, keepdim=True)).all((1, 2), keepdim=True)
        floor = torch.full_like(pose, FLOOR).diag_embed()
        blocks = torch.where(sound, normal, 0.0) + chain.blocks() + floor
        # A part's long axis is its last. What a whole part's points have in common the sizes have taken up; where only
        # a piece of it shows, its points may be off by more.
        across, along = self.config.offset_sd, self.config.slide_sd
        more = (
            1 + (self.config.piece - 1) * (1 - equations.of_rows.extent(posed).clamp_max(1).sqrt()).square()
        )
        sd = more[..., None] * pose.new_tensor([across, across, along])
        pushed = torch.where(sound, pushed * sd.flatten(1)[:, None], 0.0)
        followed, own, _ = solve_chain(blocks, -chain.pull, pushed)
        return own + followed @ followed.mT

    def _rest_share(self, time_s: Tensor) -> float:
        """Frame after frame an unseen limb would be drawn to rest anew: one pull in `rest_time` is meant.

        Of what it was it then keeps exp(-t / l) after t seconds, with l = rest_sd rest_time^(1/2) / joint_drift, and at
        last it is as unsure as joint_drift (l / 2)^(1/2): by default 0.35 s and 0.42 rad.
        """
        if len(time_s) < 2:
            return 1.0
        return float(time_s.diff().mean().clamp(1e-3, self.config.rest_time)) / self.config.rest_time


def _unwound(angles: Float[Tensor, "frames 3"], before: Message | None) -> Float[Tensor, "frames 3"]:
    """Angles without jumps by whole turns."""
    steps = torch.cat([angles[:1], angles.diff(dim=0)])
    if before is not None:
        steps[0] = steps[0] - before.pose[ANGLES]
    turn = 2 * torch.pi
    whole = (steps / turn).round()
    if before is None:
        whole[0] = 0
    return angles - turn * whole.cumsum(0)


def _without_gaps(
    pose: Float[Tensor, "frames parameters"], sound: Bool[Tensor, " frames"]
) -> Float[Tensor, "frames parameters"]:
    """With the nearest sound frame's pose where a frame has none; zeros if no frame has one."""
    frames = torch.arange(len(pose), device=pose.device)
    away = (frames[:, None] - frames).abs() + len(pose) * ~sound
    return torch.where(sound.any(), pose[away.argmin(1)], torch.zeros_like(pose))
