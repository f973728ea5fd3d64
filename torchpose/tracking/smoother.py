"""All frames of a stretch at once: each learns from its neighbours, past and coming, what it does not see itself.

Variational Bayesian EM over a chain (T. 3.2.2, 6.2.1, App. B): labels given poses frame by frame, poses given labels in one
Gauss-Newton problem whose matrix is block tridiagonal; its inverse's diagonal blocks are the poses' covariances, which is the
Rauch-Tung-Striebel smoother for these equations. Left-camera frame, metres, radians and seconds.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose.body.model import BodyModel
from torchpose.registration.fitting import PosePrior, equations_by_moments
from torchpose.registration.vem import Observation, Registrar, Registration

ANGLES = slice(3, 6)  # of the root, which come round again
MOST = 48  # rows registered at once: more are no faster


@dataclass(frozen=True)
class SmoothingConfig:
    sweeps: int = 2  # in which frames also start from their neighbours' poses
    apart: float = 0.25  # rad by which a neighbour must differ for that
    rounds: int = 3  # of labelling and joint fitting; 0 leaves the frames as they were tracked
    steps: int = 2  # of Gauss and Newton in each
    joint_drift: float = 1.0  # rad that a joint goes astray in a second, growing with the root of time
    root_drift: float = 0.5  # m and rad, the same for the root
    stretch: int = 50  # frames that are smoothed at once
    ahead: int = 12  # coming frames that they hear of
    rest_time: float = 2.0  # s after which an unseen limb forgets where it was

    def __post_init__(self) -> None:
        if self.sweeps < 0 or self.rounds < 0 or self.steps < 1:
            raise ValueError(f"sweeps and rounds must not be negative and steps at least 1, got {self}")
        if not 0 <= self.ahead < self.stretch:
            raise ValueError(f"0 <= ahead < stretch must hold, in frames, got {self.ahead} and {self.stretch}")
        for name in ("apart", "joint_drift", "root_drift", "rest_time"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


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
    filtered: Float[Tensor, "frames parameters parameters"]  # precision of each pose given the frames up to it

    def message(self, frame: int) -> Message:
        """What the frames up to this one say of its pose. Its mean has heard of the later ones, its precision has not."""
        return Message(float(self.time_s[frame]), self.registration.pose[frame], self.filtered[frame])


class Smoother(nn.Module):
    """Poses of a stretch of frames, given the poses that tracking found."""

    def __init__(self, body: BodyModel, registrar: Registrar, config: SmoothingConfig = SmoothingConfig()):
        super().__init__()
        self.body, self.registrar, self.config = body, registrar, config

    def forward(
        self,
        observation: Observation,
        time_s: Float[Tensor, " frames"],
        tracked: Registration,
        size: Float[Tensor, "#frames sizes"],
        before: Message | None = None,
    ) -> Smoothed:
        """Registrations of the frames, batch = frames, with the covariances of the whole stretch."""
        best = tracked
        pull = self._drift(time_s, tracked.pose)
        for _ in range(self.config.sweeps):
            best = self._try_neighbours(observation, best, pull, size)
        unwound = _unwound(best.pose[:, ANGLES], before)
        pose = torch.cat([best.pose[:, :3], unwound, best.pose[:, 6:]], 1)
        covariance = filtered = best.covariance
        for _ in range(self.config.rounds):
            pose, covariance, filtered = self._fit(observation, pose, size, pull, time_s, before)
        nothing = PosePrior(pose, torch.zeros_like(pose))
        result = self.registrar.evaluate(observation, pose, size, nothing, best.bound, best.status)
        return Smoothed(replace(result, covariance=covariance), time_s, filtered)

    def _drift(self, time_s: Tensor, like: Tensor) -> Float[Tensor, "frames_1 parameters"]:
        """Precision of the steps from frame to frame."""
        elapsed = time_s.diff().clamp_min(1e-3).to(like)
        rate = torch.full_like(like[0], self.config.joint_drift)
        rate[:6] = self.config.root_drift
        return 1 / (rate**2 * elapsed[:, None])

    def _try_neighbours(
        self, observation: Observation, now: Registration, pull: Tensor, size: Tensor
    ) -> Registration:
        """Each frame that differs from a neighbour is fitted from there, too, and keeps the better fit."""
        pose, T = now.pose, len(now.pose)
        frames = torch.arange(T, device=pose.device)
        for side in (-1, 1):
            other = frames + side
            inside = (other >= 0) & (other < T)
            other = other.clamp(0, T - 1)
            apart = (pose[other, 6:] - pose[:, 6:]).abs().amax(1) > self.config.apart
            rows = (inside & apart).nonzero()[:, 0]
            for part in rows.split(MOST) if len(rows) else ():
                near = other[part]
                link = pull[torch.minimum(part, near)]
                prior = PosePrior(pose[near], link)
                # Both answers are weighed with the same prior: the neighbour on the side that is tried.
                starts = torch.cat([pose[part], pose[near]])
                both = self.registrar(
                    _frames(observation, part.repeat(2)), starts, size, PosePrior(prior.mean.repeat(2, 1), prior.precision.repeat(2, 1))
                )
                mine, theirs = (_take(both, slice(i * len(part), (i + 1) * len(part))) for i in range(2))
                better = theirs.score < mine.score - 1.0
                now = _put(now, part[better], _take(theirs, better))
        return now

    def _fit(
        self, observation: Observation, pose: Tensor, size: Tensor, pull: Tensor, time_s: Tensor, before: Message | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        registrar, config = self.registrar, self.config
        posed = self.body(pose, size)
        foot = registrar.correspond(posed, observation)
        labelling = registrar.label(posed, foot, observation, registrar.config.sigma_last)
        rows, support = registrar.rows(posed, foot, labelling, observation)
        rest = registrar.with_rest(PosePrior(pose, torch.zeros_like(pose)), support)
        # Frame after frame an unseen limb would be drawn to rest anew: one pull in `rest_time` is meant.
        elapsed = time_s.diff().mean().clamp(1e-3, config.rest_time) if len(time_s) > 1 else config.rest_time
        rest = PosePrior(rest.mean, rest.precision * float(elapsed / config.rest_time))
        equations = equations_by_moments(self.body, size, rows, rest, registrar.config.fitting, posed)
        first = None if before is None else before
        damping = 1e-3
        loss, gradient, normal = equations(pose)
        total = loss.sum() + self._chain_loss(pose, pull, time_s, first)
        for _ in range(config.steps):
            g, blocks, off = self._chain(pose, gradient, normal, pull, time_s, first)
            damped = blocks + torch.diag_embed(damping * blocks.diagonal(dim1=1, dim2=2) + 1e-6)
            step, _, _ = solve_chain(damped, off, -g)
            trial = pose + step.clamp(-0.5, 0.5)
            new_loss, new_gradient, new_normal = equations(trial)
            new_total = new_loss.sum() + self._chain_loss(trial, pull, time_s, first)
            if bool(new_total < total):
                pose, total, gradient, normal = trial, new_total, new_gradient, new_normal
                damping /= 10
            else:
                damping *= 30
        _, blocks, off = self._chain(pose, gradient, normal, pull, time_s, first)
        eye = torch.eye(pose.shape[1], dtype=pose.dtype, device=pose.device)
        _, covariance, filtered = solve_chain(blocks + 1e-6 * eye, off, torch.zeros_like(pose))
        ahead = torch.cat([pull, torch.zeros_like(pull[:1])]) if len(pull) else torch.zeros_like(pose)
        return pose, covariance, filtered - torch.diag_embed(ahead)

    def _link(self, time_s: Tensor, before: Message, like: Tensor) -> Tensor:
        """Precision of the first frame's pose about that of the frame before."""
        rate = torch.full_like(like[0], self.config.joint_drift)
        rate[:6] = self.config.root_drift
        drift = torch.diag(rate**2 * max(float(time_s[0]) - before.time_s, 1e-3))
        return torch.linalg.inv(torch.linalg.inv(before.precision) + drift)

    def _chain_loss(self, pose: Tensor, pull: Tensor, time_s: Tensor, before: Message | None) -> Tensor:
        loss = 0.5 * (pull * pose.diff(dim=0) ** 2).sum()
        if before is not None:
            gap = pose[0] - before.pose
            loss = loss + 0.5 * gap @ self._link(time_s, before, pose) @ gap
        return loss

    def _chain(
        self, pose: Tensor, gradient: Tensor, normal: Tensor, pull: Tensor, time_s: Tensor, before: Message | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Gradient, diagonal blocks and the diagonals of the blocks beside them."""
        force = pull * pose.diff(dim=0)
        gradient = gradient.clone()
        gradient[:-1] -= force
        gradient[1:] += force
        around = torch.zeros_like(pose)
        around[:-1] += pull
        around[1:] += pull
        blocks = normal + torch.diag_embed(around)
        if before is not None:
            link = self._link(time_s, before, pose)
            gradient[0] += link @ (pose[0] - before.pose)
            blocks[0] += link
        return gradient, blocks, -pull


def solve_chain(
    blocks: Float[Tensor, "frames p p"], beside: Float[Tensor, "frames_1 p"], right: Float[Tensor, "frames p"]
) -> tuple[Float[Tensor, "frames p"], Float[Tensor, "frames p p"], Float[Tensor, "frames p p"]]:
    """Solution of a symmetric block tridiagonal system, the diagonal blocks of the matrix's inverse, and the diagonal
    blocks that elimination leaves (a frame's precision given those before it).

    The blocks beside the diagonal are diagonal themselves, `beside`. Elimination forward and substitution back, as the
    smoother of Rauch, Tung and Striebel.
    """
    T = len(blocks)
    left, inverse, value = [blocks[0]], [torch.linalg.inv(blocks[0])], [right[0]]
    for t in range(1, T):
        b = beside[t - 1]
        left.append(blocks[t] - b[:, None] * inverse[-1] * b)
        inverse.append(torch.linalg.inv(left[-1]))
        value.append(right[t] - b * (inverse[t - 1] @ value[-1]))
    x, covariance = [inverse[-1] @ value[-1]], [inverse[-1]]
    for t in range(T - 2, -1, -1):
        b = beside[t]
        x.append(inverse[t] @ (value[t] - b * x[-1]))
        gain = inverse[t] * b
        covariance.append(inverse[t] + gain @ covariance[-1] @ gain.T)
    return torch.stack(x[::-1]), torch.stack(covariance[::-1]), torch.stack(left)


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


def _frames(observation: Observation, index: Tensor) -> Observation:
    """Some frames of a batch of them."""
    cloud = replace(observation.cloud, **{n: getattr(observation.cloud, n)[index] for n in observation.cloud.__dataclass_fields__})
    return Observation(cloud, observation.potential[index], observation.nearest[index], observation.camera)


def _take(found: Registration, index) -> Registration:
    values = {n: getattr(found, n) for n in Registration.__dataclass_fields__}
    bound = values.pop("bound")
    return Registration(**{n: v[index] for n, v in values.items()}, bound=bound[:, index])


def _put(found: Registration, index: Tensor, new: Registration) -> Registration:
    values = {}
    for n in Registration.__dataclass_fields__:
        v = getattr(found, n).clone()
        if n == "bound":
            pass
        else:
            v[index] = getattr(new, n)
        values[n] = v
    return Registration(**values)
