"""Where each person is: head and body with their velocities, followed by an extended Kalman filter (T. 4.3.1).

The state is (s^H, s^B, ds^H/dt, ds^B/dt), 12 numbers: places of the head's centre and of the trunk's middle in the left
camera's frame, m, and m/s. Time is in seconds, whatever the frame rate. Batch axes are persons.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.tracking.kalman import (
    Gaussian,
    Update,
    kalman_predict,
    kalman_smoother,
    kalman_update,
    stack_beliefs,
)

HEAD, BODY, HEAD_VELOCITY, BODY_VELOCITY = (slice(start, start + 3) for start in (0, 3, 6, 9))
STATES = 12
UNKNOWN = 1.0  # m, standard deviation of a first place about its own measurement, which then narrows it
FLAGS = (
    "head_used",
    "body_used",
    "head_rejected",
    "body_rejected",
    "log_likelihood",
)  # of a `LocationUpdate`
NO_LENGTH = 1e-6  # m; the direction from the body to a head at the same place is anything


@dataclass(frozen=True)
class LocationConfig:
    """Settings of `LocationFilter`."""

    speed: float = 2.0  # m/s, standard deviation of a first velocity and of its change within `change_time`
    change_time: float = 0.5  # s
    together: float = 0.97  # correlation of the accelerations of head and body; 0 is the thesis's
    head_sd: float = 0.04  # m, of each coordinate of a head, where the measurement does not say
    body_sd: float = 0.08  # m, the same for a body
    distance: float = 0.55  # m, d of (4.15), from the head's centre to the trunk's middle
    distance_sd: float = 0.06  # m; a person stoops, and the cloud's middle is not quite the trunk's
    upright_sd: float = 0.25  # m by which a head that was never seen is off the place above the body
    gate: float = 0.001  # chance at which a right measurement is rejected
    pelvis_share: float = 0.35  # of `distance`, by which the pelvis lies beyond the body, away from the head
    pelvis_sd: float = 0.05  # m, of that, in each coordinate

    def __post_init__(self) -> None:
        for name in ("speed", "change_time", "head_sd", "body_sd", "distance", "distance_sd", "upright_sd"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if not 0 <= self.together < 1:
            raise ValueError(
                f"together must be a correlation in [0, 1), got {self.together}; 0 lets head and body go apart"
            )
        if not 0 <= self.gate < 1:
            raise ValueError(f"gate must be a chance in [0, 1), got {self.gate}; 0 believes everything")
        for name in ("pelvis_share", "pelvis_sd"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")


@dataclass(frozen=True)
class Sighting:
    """What was measured of persons at one time; NaN where something was not.

    Standard deviations are of each coordinate; NaN stands for the filter's own. A `distance` is the person's own d of
    (4.15); NaN stands for the filter's.
    """

    head: Float[Tensor, "*batch 3"]  # m, centre of the head
    body: Float[Tensor, "*batch 3"]  # m, middle of the trunk
    head_sd: Float[Tensor, "*batch"]  # m
    body_sd: Float[Tensor, "*batch"]  # m
    distance: Float[Tensor, "*batch"]  # m

    @property
    def head_there(self) -> Bool[Tensor, "*batch"]:
        return self.head.isfinite().all(-1)

    @property
    def body_there(self) -> Bool[Tensor, "*batch"]:
        return self.body.isfinite().all(-1)


def sighting(
    head: Float[Tensor, "*batch 3"] | None = None,
    body: Float[Tensor, "*batch 3"] | None = None,
    head_sd: Float[Tensor, "*batch"] | None = None,
    body_sd: Float[Tensor, "*batch"] | None = None,
    distance: Float[Tensor, "*batch"] | None = None,
) -> Sighting:
    """A `Sighting` of what is given.

    Raises:
        ValueError: neither head nor body is given.
    """
    like = body if head is None else head
    if like is None:
        raise ValueError("a sighting needs a head or a body, got neither; give NaN where none was found")
    places = [torch.full_like(like, torch.nan) if place is None else place for place in (head, body)]
    rest = [
        torch.full_like(like[..., 0], torch.nan) if x is None else x for x in (head_sd, body_sd, distance)
    ]
    return Sighting(*places, *rest)


@dataclass(frozen=True)
class Location:
    """What is believed of persons at their times; rows of NaN are of nobody."""

    mean: Float[Tensor, "*batch 12"]
    covariance: Float[Tensor, "*batch 12 12"]
    time_s: Float[Tensor, "*batch"]  # float64: seconds since 1970 are too many for float32

    @property
    def known(self) -> Bool[Tensor, "*batch"]:
        """Whether there is somebody."""
        return ~self.time_s.isnan()

    @property
    def head(self) -> Gaussian:
        """Centre of the head, m."""
        return self._part(HEAD)

    @property
    def body(self) -> Gaussian:
        """Middle of the trunk, m."""
        return self._part(BODY)

    def _part(self, part: slice) -> Gaussian:
        return Gaussian(self.mean[..., part], self.covariance[..., part, part])

    def where(self, rows: Bool[Tensor, "*batch"], other: "Location") -> "Location":
        """This in the given rows, the other elsewhere."""
        return Location(
            torch.where(rows[..., None], self.mean, other.mean),
            torch.where(rows[..., None, None], self.covariance, other.covariance),
            torch.where(rows, self.time_s, other.time_s),
        )

    def state(self) -> dict[str, Tensor]:
        """As tensors, to go on from after an interruption."""
        return {"mean": self.mean, "covariance": self.covariance, "time_s": self.time_s}

    @staticmethod
    def restore(state: Mapping[str, Tensor]) -> "Location":
        """What `state` gave."""
        return Location(state["mean"], state["covariance"], state["time_s"])


def nowhere(like: Float[Tensor, "*batch 3"]) -> Location:
    """Nobody yet, as many rows as `like` has, on its device and in its dtype."""
    mean = like.new_full((*like.shape[:-1], STATES), torch.nan)
    return Location(mean, torch.diag_embed(mean), mean[..., 0].double())


@dataclass(frozen=True)
class LocationUpdate:
    """A location after a sighting, and what was made of that."""

    location: Location
    head_used: Bool[Tensor, "*batch"]
    body_used: Bool[Tensor, "*batch"]
    head_rejected: Bool[Tensor, "*batch"]  # was there, and is not believed
    body_rejected: Bool[Tensor, "*batch"]
    log_likelihood: Float[Tensor, "*batch"]  # log p(head and body | location before), whether believed or not


class LocationFilter:
    """Follows persons by (4.9) to (4.15). It remembers nothing itself: a `Location` goes in and one comes out.

    Accelerations are white noise, so what a step adds does not depend on how it is cut into frames: over t seconds
    the velocity's variance grows by a = speed^2 / change_time times t, the place's by a t^3 / 3. Head and body
    accelerate `together`, more or less, so that whoever is seen in part is followed whole.
    """

    def __init__(self, config: LocationConfig = LocationConfig()):
        self.config = config

    def step(
        self, location: Location, seen: Sighting, time_s: Float[Tensor, "*#batch"] | float
    ) -> LocationUpdate:
        """The locations at `time_s`, given what is seen then: predicted and updated, or begun where nobody was known.

        A sighting at the time of the last one is the same frame again, and is not counted twice.

        Raises:
            ValueError: a time lies before the last one.
        """
        time_s = self._times(location, time_s)
        again = location.known & (time_s == location.time_s)
        known = location.known
        followed = begun = None
        if bool(known.any()):
            followed = self.update(self.predict(location, time_s), seen)
        if not bool(known.all()):
            begun = self.begin(seen, time_s)
        followed, begun = followed or begun, begun or followed
        assert followed is not None
        assert begun is not None
        after = location.where(again, followed.location.where(known, begun.location))
        flags = []
        for name in FLAGS:
            value = torch.where(known, getattr(followed, name), getattr(begun, name))
            flags.append(value.masked_fill(again, 0))  # the same frame, of which nothing is used
        return LocationUpdate(after, *flags)

    def begin(self, seen: Sighting, time_s: Float[Tensor, "*#batch"] | float) -> LocationUpdate:
        """First locations, from sightings alone; nobody where neither head nor body was seen.

        Of what was not seen only this is known: a body is below its head. Where the two do not fit together the body is
        believed, as a face is found by mistake more easily. The log-likelihoods are 0.
        """
        config = self.config
        wrong = self._apart(seen)
        seen = _without(seen, wrong, torch.zeros_like(wrong))
        distance = self._distance(seen)
        down = distance[..., None] * seen.head.new_tensor([0.0, 1.0, 0.0])
        there = seen.head_there | seen.body_there
        head = torch.where(seen.head_there[..., None], seen.head, seen.body - down)
        body = torch.where(seen.body_there[..., None], seen.body, seen.head + down)
        still = torch.zeros_like(head)
        mean = torch.where(there[..., None], torch.cat([head, body, still, still], -1), torch.nan)
        apart = config.upright_sd**2 / 4
        place = mean.new_tensor([[1.0, 1.0], [1.0, 1.0]]) * UNKNOWN**2
        place = place + apart * mean.new_tensor([[1.0, -1.0], [-1.0, 1.0]])
        axes = torch.eye(3).to(mean)
        cover = torch.block_diag(
            torch.kron(place, axes), torch.kron(config.speed**2 * self._shared(mean), axes)
        )
        cover = torch.where(there[..., None, None], cover, torch.nan)
        time = torch.as_tensor(time_s, dtype=torch.float64, device=mean.device).expand(mean.shape[:-1])
        start = Location(mean, cover, time.where(there, torch.nan))
        found = self._believe(start, seen, gate=0.0)
        return replace(found, head_rejected=wrong, log_likelihood=torch.zeros_like(found.log_likelihood))

    def predict(self, location: Location, time_s: Float[Tensor, "*#batch"] | float) -> Location:
        """The locations at a later time, (4.9) to (4.12).

        Raises:
            ValueError: a time lies before the last one.
        """
        time_s = self._times(location, time_s)
        move, noise = self.transition((time_s - location.time_s).to(location.mean))
        belief = kalman_predict(Gaussian(location.mean, location.covariance), move, noise)
        return Location(belief.mean, belief.covariance, time_s.where(location.known, torch.nan))

    def update(self, location: Location, seen: Sighting) -> LocationUpdate:
        """The locations with a sighting of their own time, (4.13) to (4.15).

        Head and body are gated each on its own; where they are further or nearer to each other than a person's can
        be, the one that is the less expected is rejected.
        """
        return self._believe(location, seen, self.config.gate)

    def log_likelihood(self, location: Location, seen: Sighting) -> Float[Tensor, "persons sightings"]:
        """log p(sighting | person) for each pair of a person (predicted to the sightings' time) and a sighting.

        0 where the sighting is empty, -inf where the person is unknown. Sightings of heads alone and of heads and
        bodies differ in unit, so compare persons for a sighting, or whole assignments, but not sightings.
        """
        one = Location(location.mean[:, None], location.covariance[:, None], location.time_s[:, None])
        return self._measure(one, seen, 0.0).log_likelihood

    def pelvis(self, location: Location) -> Gaussian:
        """Middle of the hips (m), on from the body away from the head: what the registration's root starts from."""
        share = self.config.pelvis_share
        axes = torch.eye(3).to(location.mean)
        lever = torch.cat([-share * axes, (1 + share) * axes, torch.zeros(3, 6).to(axes)], 1)
        cover = lever @ location.covariance @ lever.mT + self.config.pelvis_sd**2 * axes
        return Gaussian(location.mean @ lever.mT, cover)

    def smooth(
        self, seen: Sighting, time_s: Float[Tensor, "*#batch time"]
    ) -> tuple[LocationUpdate, Location]:
        """A complete recording: each moment as the past has it, and as the whole recording has it.

        Args:
            seen: (*batch, time), NaN where nothing was seen.
            time_s: s, rising.

        Returns:
            The steps with their flags, and the smoothed locations: (*batch, time) both, NaN before the first
            sighting of each person.
        """
        times = time_s.expand(seen.head.shape[:-1]).double()
        location, steps, expected, moves, noises = nowhere(seen.head[..., 0, :]), [], [], [], []
        for t in range(times.shape[-1]):
            now = Sighting(**{name: value.select(times.ndim - 1, t) for name, value in vars(seen).items()})
            expected.append(self.predict(location, times[..., t]).mean)
            gap = (times[..., t] - location.time_s).nan_to_num().to(location.mean)
            steps.append(self.step(location, now, times[..., t]))
            if t > 0:
                move, noise = self.transition(gap)
                moves.append(move)
                noises.append(noise)
            location = steps[-1].location
        past = [Gaussian(step.location.mean, step.location.covariance) for step in steps]
        if len(past) == 1:
            smoothed = stack_beliefs(past)
        else:
            smoothed = kalman_smoother(
                stack_beliefs(past),
                torch.stack(expected, -2),
                torch.stack(moves, -3),
                torch.stack(noises, -3),
            )
        when = torch.stack([step.location.time_s for step in steps], -1)
        filtered = stack_beliefs(past)
        flags = [torch.stack([getattr(step, name) for step in steps], -1) for name in FLAGS]
        return (
            LocationUpdate(Location(filtered.mean, filtered.covariance, when), *flags),
            Location(smoothed.mean, smoothed.covariance, when),
        )

    def transition(self, elapsed: Float[Tensor, "*batch"]) -> tuple[Tensor, Tensor]:
        """Transition and its noise over `elapsed` seconds, (*batch, 12, 12) both."""
        t = elapsed[..., None, None]
        still = torch.eye(STATES).to(t).expand(*elapsed.shape, STATES, STATES)
        move = still + t * torch.eye(STATES).to(t).roll(6, 1).triu()
        rate = self.config.speed**2 / self.config.change_time
        pull = rate * torch.kron(self._shared(elapsed), torch.eye(3).to(elapsed))
        upper = torch.cat([t**3 / 3 * pull, t**2 / 2 * pull], -1)
        lower = torch.cat([t**2 / 2 * pull, t * pull], -1)
        return move, torch.cat([upper, lower], -2)

    def _shared(self, like: Tensor) -> Float[Tensor, "2 2"]:
        return like.new_tensor([[1.0, self.config.together], [self.config.together, 1.0]])

    def _distance(self, seen: Sighting) -> Float[Tensor, "*batch"]:
        return torch.where(seen.distance.isnan(), self.config.distance, seen.distance)

    def _spread(self, seen: Sighting) -> tuple[Tensor, Tensor]:
        """Standard deviations of head and body, m."""
        config = self.config
        return (
            torch.where(seen.head_sd.isnan(), config.head_sd, seen.head_sd),
            torch.where(seen.body_sd.isnan(), config.body_sd, seen.body_sd),
        )

    def _times(self, location: Location, time_s: Tensor | float) -> Float[Tensor, "*batch"]:
        times = torch.as_tensor(time_s, dtype=torch.float64, device=location.mean.device)
        if bool((times < location.time_s).any()):
            raise ValueError(
                f"time must not run backwards, got {float(times.min())} s after "
                f"{float(location.time_s.nan_to_num(nan=-torch.inf).max())} s; put the frames in order"
            )
        return times.expand(location.time_s.shape)

    def _apart(self, seen: Sighting) -> Bool[Tensor, "*batch"]:
        """Whether head and body are both there and cannot be of one person, by (4.15)."""
        head_sd, body_sd = self._spread(seen)
        sd = (head_sd.square() + body_sd.square() + self.config.distance_sd**2).sqrt()
        off = ((seen.head - seen.body).norm(dim=-1) - self._distance(seen)).abs() / sd
        return seen.head_there & seen.body_there & (torch.erfc(off / math.sqrt(2)) < self.config.gate)

    def _measure(self, location: Location, seen: Sighting, gate: float) -> Update:
        """(4.13) and (4.14)."""
        there = torch.stack([seen.head_there, seen.body_there], -1).repeat_interleave(3, -1)
        value = torch.where(there, torch.cat([seen.head, seen.body], -1), torch.nan)
        spread = torch.stack(self._spread(seen), -1).repeat_interleave(3, -1)
        places = torch.eye(6, STATES).to(value)
        belief = Gaussian(location.mean, location.covariance)
        return kalman_update(belief, value, places, torch.diag_embed(spread.square()), gate, (3, 3))

    def _believe(self, location: Location, seen: Sighting, gate: float) -> LocationUpdate:
        found = self._measure(location, seen, gate)
        wrong = self._apart(seen) & found.used.all(-1)
        head_worse = found.deviation[..., 0] >= found.deviation[..., 1]
        kept = found
        if bool(wrong.any()):
            kept = self._measure(location, _without(seen, wrong & head_worse, wrong & ~head_worse), gate)
        head, body = kept.used[..., 0], kept.used[..., 3]
        # Of somebody unseen the distance tells nothing new.
        distance = torch.where(head | body, self._distance(seen), torch.nan)[..., None]
        noise = distance.new_full((1, 1), self.config.distance_sd**2)
        belief = kalman_update(kept.belief, distance, _head_body_distance, noise).belief
        return LocationUpdate(
            Location(belief.mean, belief.covariance, location.time_s),
            head,
            body,
            seen.head_there & ~head,
            seen.body_there & ~body,
            found.log_likelihood,
        )


def _head_body_distance(mean: Float[Tensor, "*batch 12"]) -> tuple[Tensor, Tensor]:
    """(4.15) and its Jacobian."""
    gap = mean[..., HEAD] - mean[..., BODY]
    length = gap.norm(dim=-1, keepdim=True)
    direction = gap / length.clamp_min(NO_LENGTH)
    rest = torch.zeros_like(mean[..., 6:])
    return length, torch.cat([direction, -direction, rest], -1)[..., None, :]


def _without(seen: Sighting, heads: Bool[Tensor, "*batch"], bodies: Bool[Tensor, "*batch"]) -> Sighting:
    """The sighting less the heads and the bodies that are named."""
    return replace(
        seen,
        head=torch.where(heads[..., None], torch.nan, seen.head),
        body=torch.where(bodies[..., None], torch.nan, seen.body),
    )
