"""People through a recording: prediction, registration, loss and recovery, frame after frame.

Times are in seconds, poses in metres and radians. The next frame starts from the last (T. 3.2.2), and its root from
where the person's location is believed to be (T. 4.3.1).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose.body.model import BodyModel
from torchpose.registration.fitting import PosePrior
from torchpose.registration.size import stack_observations
from torchpose.registration.start import Starter, legs_uncrossed, other_side, pelvis_position, turned_by
from torchpose.registration.vem import Observation, Registrar, Registration, is_finite
from torchpose.tracking.kalman import Gaussian
from torchpose.vision.faces import Faces


class TrackStatus(Enum):
    """What a frame says of the person; only the last four of these words come with a pose, `lost` without."""

    absent = "absent"  # nobody is there
    entering = "entering"  # somebody is there, of whom no pose could be found yet
    lost = "lost"  # somebody was tracked, and no pose fits this frame
    tracked = "tracked"
    partial = "partial"  # tracked, but cut by the image's border
    recovered = "recovered"  # found anew after a loss or a jump


ANSWERED = (TrackStatus.tracked, TrackStatus.partial, TrackStatus.recovered)


@dataclass(frozen=True)
class TrackingConfig:
    velocity: float = 0.8  # share of the last velocity that the prediction keeps; 0 starts from the last pose
    joint_speed_sd: float = 8.0  # rad/s by which a joint departs from the prediction
    root_speed_sd: float = 2.0  # m/s and rad/s, the same for the root
    root_gate: float = 3.0  # times that, beyond which the location says where the root is
    accept_misfit: float = 0.060  # m: a pose that fits worse is none
    stray_distance: float = 0.08  # m from the model, from which a point strays from it
    stray_share: float = 0.004  # of the points straying: a limb may be lost, and is sought elsewhere
    doubt: float = 0.05  # of the points straying after that, from which all of the body is sought
    retry: float = 0.25  # s after a search that found nothing better, before the next one
    against: float = 1.75  # rad off the way somebody walks, from which the other way round is tried, too
    aside: float = 0.35  # rad off that way, from which a start faces it
    profile: float = 0.8  # sine of that way against the camera's, from which it is seen in profile
    uncross: bool = True  # crossed legs are also tried uncrossed
    search_slack: float = (
        3.0  # times the prediction's standard deviation, within which limbs are sought elsewhere
    )
    jump: float = 0.4  # rad by which a search moves a joint, whose velocity is not believed then
    look_around: float = 0.5  # s after which limbs are sought elsewhere although nothing seems wrong
    memory: float = 2.0  # s after which a lost person is forgotten

    def __post_init__(self) -> None:
        if not 0 <= self.velocity <= 1:
            raise ValueError(f"velocity must be between 0 and 1, got {self.velocity}")
        for name in (
            "joint_speed_sd",
            "root_speed_sd",
            "root_gate",
            "accept_misfit",
            "stray_distance",
            "stray_share",
            "doubt",
            "retry",
            "look_around",
            "jump",
            "search_slack",
            "against",
            "aside",
            "memory",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if not 0 <= self.profile <= 1:
            raise ValueError(f"profile must be a sine between 0 and 1, got {self.profile}")


@dataclass(frozen=True)
class TrackedFrame:
    """A frame's answer: no registration unless the status is one of `ANSWERED`."""

    status: TrackStatus
    registration: Registration | None


@dataclass(frozen=True)
class Expected:
    """Where a person's next registration starts."""

    starts: Float[Tensor, "2 parameters"]  # the prediction, and the last pose
    prior: PosePrior  # batch 1, about the prediction


class Tracker(nn.Module):
    """Holds one person's recent past. Frames come in order, through `forward`."""

    def __init__(self, body: BodyModel, config: TrackingConfig, registrar: Registrar, starter: Starter):
        super().__init__()
        self.body = body
        self.config = config
        self.registrar = registrar
        self.starter = starter
        self.forget()

    def forget(self) -> None:
        """Start as if no frame had been seen."""
        self._pose: Tensor | None = None
        self._velocity: Tensor | None = None  # per second
        self._time = 0.0
        self._known_stray = 0.0
        self._kept_stray = 0.0  # when all of the body was last sought
        self._looked = -math.inf  # when limbs were last sought elsewhere, s
        self._failed = -math.inf  # when a search last found nothing, s
        self._turned = -math.inf  # when all of the body was last sought out of doubt, s
        self._changed = -math.inf  # when it last started from a changed pose, s

    def state(self) -> dict[str, Tensor]:
        """What the next frame starts from, as tensors; empty where nothing is remembered."""
        poses: dict[str, Tensor] = {}
        memory = {} if self._failed == -math.inf else {"failed": self._failed}
        memory |= {} if self._turned == -math.inf else {"turned": self._turned}
        memory |= {} if self._changed == -math.inf else {"changed": self._changed}
        if self._pose is not None:
            poses["pose"] = self._pose
            memory |= {"time": self._time, "looked": self._looked}
            memory |= {"known_stray": self._known_stray, "kept_stray": self._kept_stray}
        if self._velocity is not None:
            poses["velocity"] = self._velocity
        return poses | {name: torch.tensor(value, dtype=torch.float64) for name, value in memory.items()}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a `state`; poses go to where the body is."""
        self.forget()
        if "failed" in state:
            self._failed = float(state["failed"])
        if "turned" in state:
            self._turned = float(state["turned"])
        if "changed" in state:
            self._changed = float(state["changed"])
        if "pose" in state:
            self._pose, self._time = state["pose"].to(self.body.axes), float(state["time"])
            self._velocity = state["velocity"].to(self.body.axes) if "velocity" in state else None
            self._known_stray, self._looked = float(state["known_stray"]), float(state["looked"])
            self._kept_stray = float(state["kept_stray"])

    def begin(self, pose: Float[Tensor, "1 parameters"], time_s: float) -> None:
        """Take a known pose as the last one: the next frame follows it instead of searching."""
        self._pose, self._velocity, self._time = pose, None, time_s

    def forward(
        self,
        time_s: float,
        observation: Observation | None,
        faces: Faces | None,
        size: Float[Tensor, "#batch sizes"],
        cut: bool = False,
        root: Gaussian | None = None,
        walking: float | None = None,
    ) -> TrackedFrame:
        """The person's pose at `time_s`.

        Args:
            observation: the frame, batch 1; None where nobody is seen.
            faces: of the same frame, for a cold start.
            cut: part of the person may lie outside the image, or behind something.
            root: the middle of the hips as the person's location has it, m, batch 1; None where nothing is known.
            walking: yaw of the way that the person walks, rad; None for whoever stands, or nobody knows.
        """
        return track_together([Sought(self, time_s, observation, faces, size, cut, root, walking)])[0]

    def expect(self, time_s: float, root: Gaussian | None = None) -> Expected | None:
        """Where the pose is at `time_s`, and how surely, as earlier frames and the location have it.

        None where there is no last pose, or one that is too old.
        """
        if self._pose is None or time_s - self._time > self.config.memory:
            return None
        elapsed = max(time_s - self._time, 1e-3)
        predicted = self._pose
        if self._velocity is not None and self.config.velocity > 0:
            predicted = self._pose + self.config.velocity * elapsed * self._velocity
            joints = predicted[:, 6:].clamp(self.body.low[6:], self.body.high[6:])
            predicted = torch.cat([predicted[:, :6], joints], 1)
        sd = torch.full_like(predicted, self.config.joint_speed_sd * elapsed)
        sd[:, :6] = self.config.root_speed_sd * elapsed
        precision = sd**-2
        if root is not None and bool(root.mean.isfinite().all()):
            place, own = root.mean.to(predicted), 1 / root.covariance.diagonal(dim1=-2, dim2=-1).to(predicted)
            far = (place - predicted[:, :3]).abs() > self.config.root_gate * sd[:, :3]
            # Where the two do not agree the person moved as the last poses did not foresee.
            held = torch.where(far.any(1, keepdim=True), 0.0, precision[:, :3])
            fused = (held * predicted[:, :3] + own * place) / (held + own)
            predicted = torch.cat([fused, predicted[:, 3:]], 1)
            precision = torch.cat([held + own, precision[:, 3:]], 1)
        return Expected(torch.cat([predicted, self._pose]), PosePrior(predicted, precision))

    def begin_frame(self, person: "Sought") -> TrackedFrame | Expected:
        """The answer where none needs a registration, or where to register from."""
        if self._pose is not None and person.time_s - self._time > self.config.memory:
            self.forget()
        if person.observation is None or person.faces is None:
            return TrackedFrame(TrackStatus.absent, None)
        expected = self.expect(person.time_s, person.root)
        if expected is not None:
            return self._another_start(person, expected)
        if 0 <= person.time_s - self._failed < self.config.retry:
            return TrackedFrame(TrackStatus.entering, None)
        found = self.starter(person.observation, person.faces, person.size, person.walking)
        if not self.acceptable(found):
            self._failed = person.time_s
            return TrackedFrame(TrackStatus.entering, None)
        self._remember(found, person.time_s)
        return TrackedFrame(TrackStatus.partial if person.cut else TrackStatus.tracked, found)

    def _another_start(self, person: "Sought", expected: Expected) -> Expected:
        """With a second start that is more of a change than the last pose, where there is one.

        Whoever walks and is not expected to face the way faces it. In profile left and right limbs look alike where
        depths are noisy, and whoever has them exchanged stands too near or too far by as much as they are apart:
        there it has them the other way round. Legs that are crossed it has uncrossed.
        """
        assert person.observation is not None
        assert person.faces is not None
        predicted, walking = expected.starts[:1], person.walking
        if 0 <= person.time_s - self._changed < self.config.retry:
            walking = None  # a change that was not taken is not tried again at once
        off = 0.0 if walking is None else math.remainder(walking - float(predicted[0, 3]), 2 * math.pi)
        if abs(off) > self.config.aside:
            self._changed = person.time_s
            turned = turned_by(self.body, predicted, predicted.new_tensor([off]), person.size)
            return replace(expected, starts=torch.cat([predicted, turned]))
        noisy = person.observation.depth_noise > 0  # else depth tells near limbs from far ones
        if noisy and walking is not None and abs(math.sin(walking)) > self.config.profile:
            self._changed = person.time_s
            directions = self.body.limb_directions(self.body(predicted, person.size))
            place = pelvis_position(person.observation.cloud, person.faces, person.size, self.body)
            root = torch.cat([predicted[:, :2], place[:, 2:], predicted[:, 3:6]], 1)
            sides = directions[:, other_side(self.body)]
            other = self.body.pose_from_directions(root[:, :3], root[:, 3:], sides)
            return replace(expected, starts=torch.cat([predicted, other]))
        uncrossed = legs_uncrossed(self.body, predicted, person.size) if self.config.uncross else None
        return expected if uncrossed is None else replace(expected, starts=torch.cat([predicted, uncrossed]))

    def seeks_limbs(self, person: "Sought", found: Registration) -> bool:
        """Whether limbs must be sought elsewhere than a registration has them."""
        stray = self._stray(found)
        # Points that stayed without a part after a search (a bag, a skirt) are no reason for another one at once.
        strayed = stray > max(self.config.stray_share, 1.5 * self._known_stray)
        look = person.time_s - self._looked >= self.config.look_around
        if strayed or look or not self.acceptable(found):
            return True
        self._known_stray = min(self._known_stray, stray)
        return False

    def looks_soon(self, person: "Sought") -> bool:
        """Whether limbs are to be sought soon anyway: with somebody else's that costs less than alone."""
        return person.time_s - self._looked >= self.config.look_around / 2

    def end_frame(self, person: "Sought", found: Registration, other: Registration | None) -> TrackedFrame:
        """The answer, from a registration, and from the `other` one if limbs were sought: where a limb moved too fast
        to follow, it is elsewhere. All of the body is sought if both fail, or many points stray."""
        assert person.observation is not None
        assert person.faces is not None
        status = TrackStatus.partial if person.cut else TrackStatus.tracked
        followed = found.pose
        if other is not None:
            self._looked = person.time_s
            if bool(is_finite(other)[0]) and bool(other.score < found.score):
                found = other
            self._known_stray = self._stray(found)
        face = bool(person.faces.found[0])
        against = person.walking is not None and not face and self._against(found, person.walking)
        doubtful = other is not None and self._doubtful(found)
        if (against or doubtful) and person.time_s - self._turned >= self.config.retry:
            anew = self.starter(person.observation, person.faces, person.size, person.walking)
            scores = [float(self.starter.score(one, person.walking)) for one in (found, anew)]
            if self.acceptable(anew) and scores[1] < scores[0]:
                found, status = anew, TrackStatus.recovered
                self.forget()
            self._kept_stray = self._stray(found)
            self._turned = person.time_s
        # Without colours the way that the person faces is given at the start, not measured: who does not walk away
        # turns away unseen. Whose face is seen does not turn away either.
        unseen = not person.faces.sought and person.walking is None
        away = self.starter.turned_away(found) and (face or unseen)
        if not self.acceptable(found) or away:
            anew = self.starter(person.observation, person.faces, person.size, person.walking)
            if self.acceptable(anew):
                found, status = anew, TrackStatus.recovered
                self.forget()  # the way here from the last pose is a jump, no velocity
        if not self.acceptable(found):
            return TrackedFrame(TrackStatus.lost, None)
        self._remember(found, person.time_s)
        if self._velocity is not None:
            # The way from a wrong place to the right one is no motion, and to go on with it leads far away.
            jumped = (found.pose - followed).abs() > self.config.jump
            jumped[:, :6] = False
            self._velocity = torch.where(jumped, 0.0, self._velocity)
        return TrackedFrame(status, found)

    def _against(self, found: Registration, walking: float) -> bool:
        """Whether a pose goes backwards."""
        return abs(math.remainder(float(found.pose[0, 3]) - walking, 2 * math.pi)) > self.config.against

    def _doubtful(self, found: Registration) -> bool:
        """Whether so many points stray although limbs were sought that trunk or head must be wrong, too.

        As with limbs, what strayed after the last search of all of the body (a bag, a skirt) is no reason for another.
        """
        stray = self._stray(found)
        self._kept_stray = min(self._kept_stray, stray)
        return stray > max(self.config.doubt, 1.5 * self._kept_stray)

    def _stray(self, found: Registration) -> float:
        """Share of the points that are believed to be of no part."""
        points = (found.distance > 0).sum().clamp_min(1)
        if found.belief.shape[1] > self.body.num_parts:
            return float(found.belief[0, -1].sum() / points)
        return float((found.distance > self.config.stray_distance).sum() / points)

    def acceptable(self, found: Registration) -> bool:
        """Whether a registration fits well enough to be believed."""
        return bool(is_finite(found)[0]) and float(found.misfit) < self.config.accept_misfit

    def _remember(self, found: Registration, time_s: float) -> None:
        if self._pose is not None and time_s > self._time:
            self._velocity = (found.pose - self._pose) / (time_s - self._time)
        self._pose, self._time = found.pose, time_s


@dataclass(frozen=True)
class Sought:
    """Whom a tracker is to find in one frame; see `Tracker.forward`."""

    tracker: Tracker
    time_s: float
    observation: Observation | None
    faces: Faces | None
    size: Float[Tensor, "#batch sizes"]
    cut: bool = False
    root: Gaussian | None = None
    walking: float | None = None


def track_together(people: Sequence[Sought]) -> list[TrackedFrame]:
    """The answers for several people in one frame, who are registered, and whose limbs are sought, as one batch.

    They must share body and settings. A cold start, which few need, is each person's own.
    """
    begun = [person.tracker.begin_frame(person) for person in people]
    going = [
        (person, expected, person.observation)
        for person, expected in zip(people, begun, strict=True)
        if isinstance(expected, Expected) and person.observation is not None
    ]
    if not going:
        return [answer for answer in begun if isinstance(answer, TrackedFrame)]
    one = going[0][0].tracker
    observation = stack_observations([observation for _, _, observation in going])
    size = torch.cat([person.size for person, _, _ in going])
    prior = PosePrior(
        torch.cat([expected.prior.mean for _, expected, _ in going]),
        torch.cat([expected.prior.precision for _, expected, _ in going]),
    )
    # From the prediction and from the last pose; what fits better is kept.
    rows = torch.arange(len(going), device=size.device)
    twice = rows.repeat_interleave(2)
    both = one.registrar(
        observation.share(twice),
        torch.cat([expected.starts for _, expected, _ in going]),
        size[twice],
        PosePrior(prior.mean[twice], prior.precision[twice]),
    )
    best = both.score.nan_to_num(nan=torch.inf).view(-1, 2).argmin(1)
    found = [both.take(2 * row + which) for row, which in zip(rows.split(1), best.split(1), strict=True)]
    must = [person.tracker.seeks_limbs(person, found[k]) for k, (person, _, _) in enumerate(going)]
    soon = [person.tracker.looks_soon(person) for person, _, _ in going]
    seeking = [k for k in range(len(going)) if must[k] or (any(must) and soon[k])]
    others: dict[int, Registration] = {}
    if seeking:
        some = rows[seeking]
        refreshed = one.starter.refresh(
            observation if len(seeking) == len(going) else observation.take(some),
            torch.cat([found[k].pose for k in seeking]),
            size[some],
            PosePrior(prior.mean[some], prior.precision[some] / one.config.search_slack**2),
        )
        others = {k: refreshed.take(rows[i : i + 1]) for i, k in enumerate(seeking)}
    ended = iter(
        [person.tracker.end_frame(person, found[k], others.get(k)) for k, (person, _, _) in enumerate(going)]
    )
    return [next(ended) if isinstance(answer, Expected) else answer for answer in begun]
