"""The stages as one module: frames of a recording in, smoothed poses of a person out.

Left-camera frame, metres and radians.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchpose.body.angle import ANATOMICAL_NAMES, LIMB_ANGLE_NAMES, anatomical_angles, angle_sd, limb_angles
from torchpose.body.model import BodyConfig, BodyModel
from torchpose.export import PoseSequence
from torchpose.eyes import Eyes, EyesConfig, Sight
from torchpose.recording import (
    Frame,
    Recording,
    UnreadableFrame,
    readable_frames,
    spread_positions,
)
from torchpose.registration.colour import ColourConfig, ColourLikelihood
from torchpose.registration.geodesic import geodesic_bounds, geodesic_term
from torchpose.registration.likelihood import (
    AppearanceConfig,
    Evidence,
    FaceLikelihood,
    TorsoLikelihood,
    appearance_potential,
)
from torchpose.registration.silhouette import nearest_inside
from torchpose.registration.size import SizeConfig, fit_size, read_size, stack_observations
from torchpose.registration.start import StartConfig, Starter
from torchpose.registration.vem import (
    Observation,
    Registrar,
    Registration,
    RegistrationConfig,
    stack_registrations,
)
from torchpose.tracking.smoother import Message, Smoother, SmoothingConfig
from torchpose.tracking.tracker import Tracker, TrackingConfig, TrackStatus
from torchpose.vision.camera import StereoCamera
from torchpose.vision.points import CellConfig, group_cells

RIM = (
    0.015  # m by which a cloud falls short of a person at the head, and at the feet: half a step of its grid
)
BELOW = 0.2  # m by which points may lie below a floor; somebody who reaches further down does not stand on it
SITTING = 0.76  # of the body file's height: whoever looks shorter sits or stoops
WHOLE_SIGHTS = 2  # of all of somebody, that tell the size


@dataclass(frozen=True)
class PoseConfig:
    """From points to poses."""

    body: BodyConfig = field(default_factory=BodyConfig)
    appearance: AppearanceConfig = field(default_factory=AppearanceConfig)
    colour: ColourConfig = field(default_factory=ColourConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    start: StartConfig = field(default_factory=StartConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    # rad, by which a body that is not quite the person's misleads every joint, in all frames alike, beside what
    # `smoothing.offset_sd` says of each part
    shape_sd: float = 0.02
    place_sd: float = 0.02  # m, the same for where the person is
    smoothing: SmoothingConfig = field(default_factory=SmoothingConfig)
    person: str = ""  # person.yaml of an earlier run, whose sizes are taken; empty measures them
    height: float = 0.0  # m, of the person; 0 measures it
    least_height: float = 1.66  # m; who looks shorter may have feet that are not seen
    size: SizeConfig = field(default_factory=SizeConfig)
    size_frames: int = 4  # of the recording, from which height and proportions are measured
    cells: CellConfig = field(default_factory=CellConfig)  # of the geodesic term


@dataclass(frozen=True)
class FramePose:
    """One frame's result: what was seen and what was fitted. `sight` is None where the frame could not be read."""

    index: int
    time_s: float
    status: TrackStatus
    registration: Registration | None
    sight: Sight | None
    problem: str = ""  # what was wrong with the frame
    observation: Observation | None = None  # what registration saw, until the frame is smoothed


class StereoToPose(nn.Module):
    """A recording's frames to poses: eyes, body, registration and tracking as one module.

    `likelihoods` are the appearance terms; a learned one is added to this list.
    """

    def __init__(
        self, camera: StereoCamera, eyes: EyesConfig | None = None, config: PoseConfig = PoseConfig()
    ):
        super().__init__()
        self.camera = camera
        self.config = config
        self.eyes = Eyes(camera, eyes or EyesConfig())
        self.body = BodyModel(config.body)
        names = self.body.segment_names
        self.likelihoods = nn.ModuleList(
            [FaceLikelihood(names, config.appearance), TorsoLikelihood(names, config.appearance)]
        )
        self.colour = ColourLikelihood(names, config.colour)
        if config.colour.strength > 0:
            self.likelihoods.append(self.colour)
        registrar = Registrar(self.body, config.registration)
        starter = Starter(self.body, config.start, config.registration)
        self.tracker = Tracker(self.body, config.tracking, registrar, starter)
        self.smoother = Smoother(self.body, registrar, config.smoothing)
        self.register_buffer("size", self.body.default_size(1), persistent=False)
        self.stopwatch = self.eyes.stopwatch

    def another(self) -> "StereoToPose":
        """A model for another person in the same scene: it shares eyes and likelihoods, and knows nothing yet."""
        other = StereoToPose(self.camera, self.eyes.config, self.config).to(self.device)
        other.eyes, other.stopwatch = self.eyes, self.stopwatch
        other.likelihoods = nn.ModuleList(
            [other.colour if module is self.colour else module for module in self.likelihoods]
        )
        return other

    @property
    def device(self) -> torch.device:
        """Where the computing happens."""
        return self.body.axes.device

    def evidence(self, sight: Sight) -> Evidence:
        """A sight as the likelihoods take it."""
        return Evidence(sight.images, sight.silhouette, sight.cloud, sight.faces)

    def observe(self, sight: Sight, covered: Bool[Tensor, "1 height width"] | None = None) -> Observation:
        """A sight as registration takes it. `covered` is where something nearer may hide the person."""
        evidence = self.evidence(sight)
        potential = appearance_potential(self.likelihoods, evidence, self.body.num_parts)
        geodesic = None
        if self.config.registration.labelling.geodesic > 0:
            cells = group_cells(sight.cloud, self.config.cells)
            bounds = geodesic_bounds(self.body, self.size)
            geodesic = geodesic_term(cells, bounds, outlier=self.config.registration.outlier > 0)
        # A limb may lie outside of the silhouette where something stands before it.
        allowed = self.eyes.standing_room(sight, covered)
        z, noise = sight.cloud.points[..., 2][sight.cloud.mask], self.eyes.depth_noise
        if not len(z) or noise * float(z.median()) ** 2 < self.config.registration.ray_sd:
            noise = 0.0
        return Observation(
            sight.cloud, potential, nearest_inside(allowed), self.camera, geodesic, None, noise
        )

    def learn_background(self, recording: Recording) -> None:
        """Learn the empty scene of the recording."""
        self.eyes.learn_background(recording.background(), recording, self.device)

    def prepare(self, recording: Recording, glance: Callable[[Frame], Sight | None] | None = None) -> bool:
        """Learn the recording's empty scene and the person's size and colours, and forget any other person.

        `glance` says whom a frame shows, None where that is not clear; without it the largest silhouette is the
        person's. Returns whether somebody was seen whole often enough to tell the size.
        """
        known = read_size(Path(self.config.person), self.body) if self.config.person else None
        self.learn_background(recording)
        self.tracker.forget()
        self.eyes.last = None
        self.colour.forget()
        frames = readable_frames(recording, spread_positions(len(recording), self.config.size_frames))
        look = glance or (lambda frame: self.eyes(frame, self.device))
        sights = [sight for sight in map(look, frames) if sight is not None]
        with self.stopwatch.measure("size"):
            self.size = self.measure_size(sights, known)
        return sum(sight.present and not sight.cut for sight in sights) >= WHOLE_SIGHTS

    def measure_size(
        self, sights: list[Sight], known: Float[Tensor, "1 sizes"] | None = None
    ) -> Float[Tensor, "1 sizes"]:
        """Lengths and girths of the person in these frames; the body file's where no pose is found in any.

        Sizes that are `known` stay. The parts' colours are learned on the way.
        """
        size = known
        if size is None:
            heights = [self.height_in(sight) for sight in sights if sight.present and not sight.cut]
            size = self.body.size_of_height(self.config.height or self.height_of(heights))
        if self.config.size.rounds == 0 and self.config.colour.strength == 0:
            return size
        self.colour.forget()
        fits = []
        for sight in sights:
            if sight.present:
                found = self.tracker.starter(self.observe(sight), sight.faces, size)
                if self.tracker.acceptable(found):
                    fits.append((sight, found))
        if not fits:
            return size
        for sight, found in fits:
            self.learn_colours(sight, found)
        if known is not None:
            return size
        # Once all frames have taught the parts' colours, these speak, too.
        observations = [self.observe(sight) for sight, _ in fits]
        again = [
            self.tracker.starter.refresh(observation, found.pose, size)
            for observation, (_, found) in zip(observations, fits, strict=True)
        ]
        self.size = size
        return self.fit_size(observations, torch.cat([found.pose for found in again]))

    def fit_size(
        self, observations: list[Observation], pose: Float[Tensor, "frames parameters"]
    ) -> Float[Tensor, "1 sizes"]:
        """The size of the person in these frames, near the one that is now believed; it if sizes are not fitted."""
        if self.config.size.rounds == 0:
            return self.size
        registrar, together = self.tracker.registrar, stack_observations(observations)
        with self.stopwatch.measure("size"):
            return fit_size(registrar, together, pose, self.size, self.config.size)[0]

    def learn_colours(self, sight: Sight, found: Registration) -> None:
        """Let a frame's fit teach which colours the parts have."""
        if self.config.colour.strength > 0 and sight.coloured:
            self.colour.learn(self.evidence(sight), found.belief, found.distance)

    def height_in(self, sight: Sight) -> float:
        """How tall somebody is in a sight, m: NaN where no point lies below the head.

        From the head's top down to the floor. Where no floor is seen, or what was taken for it is a table that
        somebody stands behind, down to the lowest point: feet that cannot be told from the floor are missing then,
        so it is `least_height` at least.
        """
        points = sight.cloud.points[0][sight.cloud.mask[0]]
        center = sight.faces.position[0, 0] if bool(sight.faces.found[0]) else points.median(0).values[0]
        column = points[(points[:, 0] - center).abs() < 0.12]  # raised hands are beside the head
        if not len(column):
            return math.nan
        floor = self.eyes.floor
        if floor is not None and float(floor.above(points).quantile(0.01)) > -BELOW:
            return float(floor.above(column).quantile(0.99)) + RIM
        extent = torch.quantile(points[:, 1], 0.99) - torch.quantile(column[:, 1], 0.01)
        least = self.config.least_height if float(extent) > SITTING * self.body.height else 0.0
        return max(float(extent) + 2 * RIM, least)

    def height_of(self, heights: Sequence[float]) -> float:
        """The person's height, m, from those in several sights.

        Whoever stoops looks shorter, never taller, so of three or more the second tallest counts (the tallest may
        hold a stray point). Without any that may be somebody upright it is the body file's height.
        """
        tall = sorted(one for one in heights if one > SITTING * self.body.height)
        if not tall:
            return self.body.height
        return min(tall[-2] if len(tall) > 2 else tall[-1], 1.2 * self.body.height)

    def forward(self, recording: Recording) -> Iterator[FramePose]:
        """Poses of a prepared recording's frames, in order and smoothed."""
        window = SmoothingWindow(self)
        for position in range(len(recording)):
            yield from window.push(self.step(recording, position))
        yield from window.flush()

    def step(self, recording: Recording, position: int) -> FramePose:
        """The pose of one frame, the next in order. A frame that cannot be read is lost, and says why."""
        try:
            frame = recording[position]
        except UnreadableFrame as error:
            return FramePose(error.index, error.time_s, TrackStatus.lost, None, None, str(error))
        return self.follow(frame)

    def follow(self, frame: Frame) -> FramePose:
        """The next frame's pose."""
        sight = self.eyes(frame, self.device)
        with self.stopwatch.measure("registration"):
            observation = self.observe(sight) if sight.present else None
            tracked = self.tracker(frame.time_s, observation, sight.faces, self.size, sight.cut)
            if tracked.registration is not None:
                self.learn_colours(sight, tracked.registration)
        return FramePose(
            frame.index, frame.time_s, tracked.status, tracked.registration, sight, "", observation
        )

    def smooth(
        self, frames: list[FramePose], before: Message | None = None, last: int = -1
    ) -> tuple[list[FramePose], Message | None]:
        """The same frames with poses that past and coming frames agree on; those without a pose stay without.

        `before` is what earlier frames say. Returned beside them: what the frames up to `last` say to later ones.
        """
        found = [i for i, frame in enumerate(frames) if frame.registration is not None]
        if self.config.smoothing.rounds == 0 or not found:
            return frames, before
        with self.stopwatch.measure("smoothing"):
            observations = [o for o in (frames[i].observation for i in found) if o is not None]
            registrations = [r for r in (frames[i].registration for i in found) if r is not None]
            smooth = self.smoother(
                stack_observations(observations),
                torch.tensor([frames[i].time_s for i in found], dtype=torch.float64),
                stack_registrations(registrations),
                self.size,
                before,
            )
        answer = list(frames)
        for row, i in enumerate(found):
            answer[i] = replace(frames[i], registration=smooth.registration.take(torch.tensor([row])))
        told = [row for row, i in enumerate(found) if i <= last % len(frames)]
        return answer, smooth.message(told[-1]) if told else before

    def state(self) -> dict[str, Tensor]:
        """What the next frame starts from, as tensors: the person's size and colours, and the last frame's memory."""
        parts = {"": {"size": self.size, "colours": self.colour.counts}}
        parts |= {"tracker_": self.tracker.state(), "eyes_": self.eyes.state()}
        return {
            prefix + name: value.clone() for prefix, part in parts.items() for name, value in part.items()
        }

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a `state`."""
        self.size = state["size"].to(self.size)
        self.colour.counts = state["colours"].to(self.size)
        own = {
            prefix: {name.removeprefix(prefix): v for name, v in state.items() if name.startswith(prefix)}
            for prefix in ("tracker_", "eyes_")
        }
        self.tracker.restore(own["tracker_"])
        self.eyes.restore(own["eyes_"], self.device)

    def sequence(self, frames: list[FramePose]) -> PoseSequence:
        """The frames' numbers, as they are written: NaN wherever there is no pose."""
        T, body = len(frames), self.body
        found = [i for i, frame in enumerate(frames) if frame.registration is not None]
        fits = [frame.registration for frame in frames if frame.registration is not None]

        def spread(rows: Tensor) -> Tensor:
            full = rows.new_full((T, *rows.shape[1:]), torch.nan)
            full[found] = rows
            return full

        P = body.num_parameters
        pose = torch.cat([fit.pose for fit in fits]) if fits else self.size.new_zeros(0, P)
        covariance = torch.cat([fit.covariance for fit in fits]) if fits else self.size.new_zeros(0, P, P)
        # Neither more points nor more frames take this away.
        shape = torch.full((P,), self.config.shape_sd**2).to(pose)
        shape[:3] = self.config.place_sd**2
        covariance = covariance + torch.diag(shape)
        distance = torch.cat([fit.point_to_model for fit in fits]) if fits else self.size.new_zeros(0)
        posed = body(pose, self.size)
        return PoseSequence(
            frame=torch.tensor([frame.index for frame in frames]),
            time_s=torch.tensor([frame.time_s for frame in frames], dtype=torch.float64),
            status=tuple(frame.status.value for frame in frames),
            point_to_model=spread(distance),
            joints=spread(posed.joints),
            angle_names=ANATOMICAL_NAMES,
            angles=spread(anatomical_angles(body, posed)),
            angle_sd=spread(angle_sd(body, pose, covariance, self.size)),
            limb_angle_names=LIMB_ANGLE_NAMES,
            limb_angles=spread(limb_angles(posed.joints)),
            pose=spread(pose),
            pose_covariance=spread(covariance),
        )


class SmoothingWindow:
    """Frames wait here until those that follow have had their say: pushed one by one, returned smoothed.

    `state` is what a run that was interrupted goes on from: that of the model after the last frame returned, or what
    `snapshot` gives then.
    """

    def __init__(
        self,
        model: StereoToPose,
        state: Mapping[str, Tensor] | None = None,
        snapshot: Callable[[], dict[str, Tensor]] | None = None,
    ):
        self.model = model
        self.snapshot = snapshot or model.state
        self.before = None if not state or "message_pose" not in state else Message.from_state(state)
        self.state: dict[str, Tensor] = {}
        self._next: dict[str, Tensor] = {}
        self.waiting: list[FramePose] = []

    def push(self, frame: FramePose) -> list[FramePose]:
        """Take the next frame; the frames that are ready, often none."""
        config = self.model.config.smoothing
        self.waiting.append(frame)
        if len(self.waiting) == config.stretch:
            self._next = self.snapshot()
        if len(self.waiting) < config.stretch + (config.ahead if config.rounds else 0):
            return []
        return self._smooth(config.stretch)

    def flush(self) -> list[FramePose]:
        """The frames that are left at the end of the recording."""
        self._next = self.snapshot()
        return self._smooth(len(self.waiting)) if self.waiting else []

    def _smooth(self, count: int) -> list[FramePose]:
        smooth, self.before = self.model.smooth(self.waiting, self.before, count - 1)
        self.waiting = self.waiting[count:]
        self.state = self._next | ({} if self.before is None else self.before.state())
        return [replace(frame, observation=None) for frame in smooth[:count]]
