"""The stages as one module: frames of a recording in, poses of a person out.

`Eyes` turns a frame into points and evidence, `StereoToPose` turns a recording's frames into poses. Left-camera frame,
metres and radians.
"""

import math
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from kornia.color import rgb_to_grayscale
from torch import Tensor, nn

from torchpose.body.angle import ANATOMICAL_NAMES, LIMB_ANGLE_NAMES, anatomical_angles, angle_sd, limb_angles
from torchpose.body.model import BodyConfig, BodyModel
from torchpose.export import PoseSequence
from torchpose.recording import (
    Backgrounds,
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
from torchpose.registration.start import StartConfig, Starter, select
from torchpose.registration.vem import (
    Observation,
    Registrar,
    Registration,
    RegistrationConfig,
    stack_registrations,
)
from torchpose.tracking.smoother import Message, Smoother, SmoothingConfig
from torchpose.tracking.tracker import Tracker, TrackingConfig, TrackStatus
from torchpose.vision.background import (
    BackgroundConfig,
    BackgroundModel,
    DepthBackground,
    DepthBackgroundConfig,
    far_readings,
)
from torchpose.vision.camera import StereoCamera
from torchpose.vision.disparity import bridge_gaps
from torchpose.vision.empty_scene import EmptySceneConfig, learn_empty_scene
from torchpose.vision.faces import FaceConfig, FaceDetector, FaceMemory, Faces
from torchpose.vision.growing_seeds import GrowingSeeds
from torchpose.vision.photometry import temporal_median
from torchpose.vision.points import CellConfig, PointCloud, SamplingConfig, group_cells, sample_grid
from torchpose.vision.scene_match import SceneMatch, SceneMatchConfig
from torchpose.vision.silhouette import SilhouetteConfig, person_silhouette, search_region
from torchpose.vision.skin import SkinModel
from torchpose.vision.stereo import StereoConfig, stereo_matcher


@dataclass(frozen=True)
class EyesConfig:
    """From images to points."""

    nearest: float = 1.2  # m, of the person: with `farthest` it bounds the disparities that are searched
    farthest: float = 8.0  # m
    background_frames: int = 15  # of the recording, from which the empty scene is learned if none is given
    background: BackgroundConfig = field(default_factory=BackgroundConfig)
    empty_scene: EmptySceneConfig = field(default_factory=EmptySceneConfig)
    depth_background: DepthBackgroundConfig = field(default_factory=DepthBackgroundConfig)
    scene_match: SceneMatchConfig = field(default_factory=SceneMatchConfig)
    silhouette: SilhouetteConfig = field(default_factory=SilhouetteConfig)
    memory: float = 0.5  # s, for which the last frame's silhouette tells which part of this one is the person
    stereo: StereoConfig = field(default_factory=StereoConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    face: FaceConfig = field(default_factory=FaceConfig)
    range_scale: int = 4  # by which images are shrunk to find the person's range of disparities
    glance_margin: float = 0.8  # m around it: an arm may be too thin for the small images
    last_margin: float = 0.5  # m around the last frame's range
    least_matched: float = 0.7  # share of the foreground; with less the range was wrong, and all is searched
    min_points: int = 60  # fewer points on the person are nobody

    def __post_init__(self) -> None:
        if not 0 < self.nearest < self.farthest:
            raise ValueError(
                f"0 < nearest < farthest must hold, in m, got {self.nearest} and {self.farthest}"
            )
        if min(self.background_frames, self.min_points, self.range_scale) < 1:
            raise ValueError("background_frames, min_points and range_scale must be at least 1")


@dataclass(frozen=True)
class PoseConfig:
    """From points to poses."""

    body: BodyConfig = field(default_factory=BodyConfig)
    appearance: AppearanceConfig = field(default_factory=AppearanceConfig)
    colour: ColourConfig = field(default_factory=ColourConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    start: StartConfig = field(default_factory=StartConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    shape_sd: float = (
        0.05  # rad, by which a body that is not quite the person's misleads every joint, in all frames alike
    )
    smoothing: SmoothingConfig = field(default_factory=SmoothingConfig)
    person: str = ""  # person.yaml of an earlier run, whose sizes are taken; empty measures them
    height: float = 0.0  # m, of the person; 0 measures it
    size: SizeConfig = field(default_factory=SizeConfig)
    size_frames: int = 4  # of the recording, from which height and proportions are measured
    cells: CellConfig = field(default_factory=CellConfig)  # of the geodesic term


@dataclass(frozen=True)
class Sight:
    """What the eyes make of one frame, batch 1."""

    images: Float[Tensor, "1 3 height width"]  # the left or the colour image; grey depth where there is none
    depth: Float[Tensor, "1 height width"]  # m, NaN where unknown
    silhouette: Bool[Tensor, "1 height width"]
    cloud: PointCloud
    faces: Faces
    present: bool  # somebody is there
    cut: bool  # the silhouette meets the image's border
    coloured: bool = True  # False: `images` are a picture of the depth


@dataclass(frozen=True)
class LastSight:
    """What the next frame is told of this one."""

    time_s: float
    silhouette: Bool[Tensor, "1 height width"]
    disparity: Float[Tensor, "1 height width"] | None  # px, of the person alone; None: a depth camera
    face: FaceMemory | None


class Stopwatch:
    """Processor time by stage, s."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        begin = time.process_time()
        yield
        self.seconds[stage] += time.process_time() - begin


class Eyes(nn.Module):
    """Silhouette, depth, points and face of each frame of one recording."""

    def __init__(self, camera: StereoCamera, config: EyesConfig = EyesConfig()):
        super().__init__()
        self.camera = camera
        self.config = config
        self.stereo = stereo_matcher(config.stereo)
        # On a small copy the person is small, too, and holes do not matter.
        island = max(1, config.stereo.gcs.min_island // config.range_scale**2)
        self.glance = GrowingSeeds(replace(config.stereo.gcs, windows=(5,), min_island=island, fill=False))
        self.find_faces = FaceDetector(config.face)
        self.stopwatch = Stopwatch()
        self.background: BackgroundModel | DepthBackground | None = None
        self.background_depth: Tensor | None = None
        self.scene_match: SceneMatch | None = None
        self.last: LastSight | None = None

    @property
    def disparity_range(self) -> tuple[int, int]:
        """Disparities that `nearest` to `farthest` allow, px."""
        near, far = self.camera.disparity(torch.tensor([self.config.nearest, self.config.farthest])).tolist()
        return math.floor(far), math.ceil(near)

    def person_range(
        self,
        left: Float[Tensor, "1 3 height width"],
        right: Float[Tensor, "1 3 height width"],
        region: Bool[Tensor, "1 height width"],
        last: Float[Tensor, "1 height width"] | None,
    ) -> tuple[int, int]:
        """Disparities to search in this frame, px: around the last frame's person, or around what a small copy shows.

        The cost of matching is that of the disparities searched, and most of those that `nearest` and `farthest`
        allow lie before and behind the person.
        """
        low, high = self.disparity_range
        margin = self.config.last_margin
        if last is None:
            shrink, margin = self.config.range_scale, self.config.glance_margin
            size = (left.shape[2] // shrink, left.shape[3] // shrink)
            small = [torch.nn.functional.interpolate(image, size, mode="area") for image in (left, right)]
            mask = torch.nn.functional.interpolate(region[:, None].to(left), size, mode="area")[:, 0] > 0
            last = (
                shrink * self.glance(*small, mask, disparity_range=(low // shrink, -(-high // shrink))).values
            )
        depth = self.camera.depth(last[last.isfinite()])
        if len(depth) < self.config.min_points:
            return low, high
        near, far = (float(depth.quantile(share)) for share in (0.01, 0.99))
        ends = self.camera.disparity(torch.tensor([far + margin, max(near - margin, self.config.nearest)]))
        least, greatest = ends.tolist()
        return max(low, math.floor(least)), min(high, math.ceil(greatest))

    def learn_background(self, backgrounds: Backgrounds, recording: Recording, device: torch.device) -> None:
        """Learn the empty scene from its frames, or where there are none from the recording itself."""
        spread = spread_positions(len(recording), self.config.background_frames)
        if self.camera.baseline is None:
            depth = backgrounds.depth
            if depth is None:
                depth = far_readings(_stack([frame.depth for frame in readable_frames(recording, spread)]))
            self.background = DepthBackground(depth.to(device), self.config.depth_background)
            self.background_depth = self.background.depth
            return
        if backgrounds.left is not None and backgrounds.right is not None:
            left, right = backgrounds.left.to(device), backgrounds.right.to(device)
            with self.stopwatch.measure("background"):
                pair = left.median(0, keepdim=True).values, right.median(0, keepdim=True).values
                disparity = self.stereo(*pair, disparity_range=(0, self.disparity_range[1])).values[0]
        else:
            frames = list(readable_frames(recording, spread))
            left, right = (
                _stack([getattr(f, side) for f in frames]).to(device) for side in ("left", "right")
            )
            with self.stopwatch.measure("background"):
                scene = learn_empty_scene(
                    left,
                    right,
                    self.stereo,
                    self.camera,
                    (0, self.disparity_range[1]),
                    self.config.empty_scene,
                )
            left, right, disparity = scene.left, scene.right, scene.disparity
        disparity = bridge_gaps(disparity)  # a bare wall and a glaring floor match nowhere but at their rims
        self.background = BackgroundModel(left, self.config.background)
        self.background_depth = self.camera.depth(disparity)
        empty = rgb_to_grayscale(torch.stack([temporal_median(left), temporal_median(right)]))[:, 0]
        self.scene_match = SceneMatch(empty[0], empty[1], disparity, self.config.scene_match)

    def state(self) -> dict[str, Tensor]:
        """What is remembered of the last frame, to go on from there; {} if there was none."""
        if self.last is None:
            return {}
        time_s = torch.tensor(self.last.time_s, dtype=torch.float64)
        state = {"time_s": time_s, "silhouette": self.last.silhouette}
        if self.last.face is not None:
            state |= {"face": self.last.face.box}
            state |= {f"skin_{name}": value for name, value in vars(self.last.face.skin).items()}
        return state if self.last.disparity is None else state | {"disparity": self.last.disparity}

    def restore(self, state: dict[str, Tensor], device: torch.device) -> None:
        """Take up what `state` gave."""
        self.last = None
        if state:
            disparity, box = state.get("disparity"), state.get("face")
            skin = {name[5:]: value.to(device) for name, value in state.items() if name.startswith("skin_")}
            self.last = LastSight(
                float(state["time_s"]),
                state["silhouette"].to(device),
                None if disparity is None else disparity.to(device),
                None if box is None else FaceMemory(box.to(device), SkinModel(**skin)),
            )

    def forward(self, frame: Frame, device: torch.device) -> Sight:
        """Look at one frame."""
        if self.background is None:
            raise ValueError(
                "the background must be learned before a frame is looked at; call learn_background"
            )
        last = self.last if self.last and 0 < frame.time_s - self.last.time_s < self.config.memory else None
        if frame.depth is not None:
            depth = frame.depth[None].to(device)
            images = frame.left[None].to(device) if frame.left is not None else depth_picture(depth)
            grey = rgb_to_grayscale(images)[:, 0]
            with self.stopwatch.measure("background"):
                log_odds = self.background(depth)
        else:
            assert frame.left is not None
            assert frame.right is not None
            images, right = frame.left[None].to(device), frame.right[None].to(device)
            with self.stopwatch.measure("background"):
                assert self.scene_match is not None
                log_odds = self.background(images)
                region = search_region(log_odds, self.config.silhouette)
                grey, grey_right = (rgb_to_grayscale(image)[:, 0] for image in (images, right))
                log_odds = log_odds + self.scene_match(grey, grey_right, region)
                region = search_region(log_odds, self.config.silhouette)
            with self.stopwatch.measure("stereo"):
                seeds = last.disparity if last else None
                span = self.person_range(images, right, region, seeds)
                disparity = self.stereo(images, right, region, seeds, span)
                changed = log_odds > 0
                share = float((disparity.values.isfinite() & changed).sum() / changed.sum().clamp_min(1))
                if span != self.disparity_range and share < self.config.least_matched:
                    disparity = self.stereo(images, right, region, None, self.disparity_range)
                depth = self.camera.depth(disparity.values)
        with self.stopwatch.measure("silhouette"):
            silhouette = person_silhouette(
                log_odds,
                depth,
                self.config.silhouette,
                self.background_depth,
                self.camera,
                guide=grey,
                previous=last.silhouette if last else None,
            ).mask
            seen = depth.where(silhouette, torch.nan)
            matched = None if self.camera.baseline is None else self.camera.disparity(seen)
        with self.stopwatch.measure("points"):
            cloud = sample_grid(depth, silhouette, self.camera, self.config.sampling)
        with self.stopwatch.measure("faces"):
            faces = self.find_faces(images, silhouette, depth, self.camera, last.face if last else None)
        self.last = LastSight(frame.time_s, silhouette, matched, faces.memory)
        present = int(cloud.mask.sum()) >= self.config.min_points
        cut = _touches_border(silhouette[0])
        return Sight(images, depth, silhouette, cloud, faces, present, cut, frame.left is not None)


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
        self, camera: StereoCamera, eyes: EyesConfig = EyesConfig(), config: PoseConfig = PoseConfig()
    ):
        super().__init__()
        self.camera = camera
        self.config = config
        self.eyes = Eyes(camera, eyes)
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
        self._seen: dict[int, Sight] = {}

    @property
    def device(self) -> torch.device:
        """Where the computing happens."""
        return self.body.axes.device

    def evidence(self, sight: Sight) -> Evidence:
        """A sight as the likelihoods take it."""
        return Evidence(sight.images, sight.silhouette, sight.cloud, sight.faces)

    def observe(self, sight: Sight) -> Observation:
        """A sight as registration takes it."""
        evidence = self.evidence(sight)
        potential = appearance_potential(self.likelihoods, evidence, self.body.num_parts)
        geodesic = None
        if self.config.registration.labelling.geodesic > 0:
            cells = group_cells(sight.cloud, self.config.cells)
            bounds = geodesic_bounds(self.body, self.size)
            geodesic = geodesic_term(cells, bounds, outlier=self.config.registration.outlier > 0)
        return Observation(sight.cloud, potential, nearest_inside(sight.silhouette), self.camera, geodesic)

    def learn_background(self, recording: Recording) -> None:
        """Learn the empty scene of the recording."""
        self.eyes.learn_background(recording.background(), recording, self.device)

    def prepare(self, recording: Recording) -> None:
        """Learn the recording's empty scene and the person's size and colours, and forget any other person."""
        known = read_size(Path(self.config.person), self.body) if self.config.person else None
        self.learn_background(recording)
        self.tracker.forget()
        self.eyes.last = None
        self.colour.forget()
        frames = readable_frames(recording, spread_positions(len(recording), self.config.size_frames))
        # These frames come again in their turn; what was seen of them is kept until then.
        self._seen = {frame.index: self.eyes(frame, self.device) for frame in frames}
        with self.stopwatch.measure("size"):
            self.size = self.measure_size(list(self._seen.values()), known)

    def measure_size(
        self, sights: list[Sight], known: Float[Tensor, "1 sizes"] | None = None
    ) -> Float[Tensor, "1 sizes"]:
        """Lengths and girths of the person in these frames; the body file's where no pose is found in any.

        Sizes that are `known` stay. The parts' colours are learned on the way.
        """
        size = known
        if size is None:
            size = self.body.size_of_height(self.config.height or self.measure_height(sights))
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
        if known is not None or self.config.size.rounds == 0:
            return size
        # Once all frames have taught the parts' colours, these speak, too.
        observations = [self.observe(sight) for sight, _ in fits]
        again = [
            self.tracker.starter.refresh(observation, found.pose, size)
            for observation, (_, found) in zip(observations, fits, strict=True)
        ]
        poses = torch.cat([found.pose for found in again])
        return fit_size(
            self.tracker.registrar, stack_observations(observations), poses, size, self.config.size
        )[0]

    def learn_colours(self, sight: Sight, found: Registration) -> None:
        """Let a frame's fit teach which colours the parts have."""
        if self.config.colour.strength > 0 and sight.coloured:
            self.colour.learn(self.evidence(sight), found.belief, found.distance)

    def measure_height(self, sights: list[Sight]) -> float:
        """The person's height, m: from the head's top to the lowest point, the greatest of the frames.

        Whoever stoops looks shorter, never taller, so of the frames with a whole person the second tallest counts
        (the tallest may hold a stray point). Without a whole person it is the body file's height.
        """
        heights = sorted(_upright_extent(sight) for sight in sights if sight.present and not sight.cut)
        if not heights:
            return self.body.height
        # The cloud's rim lies half a grid step inside the silhouette, at the head and at the feet.
        measured = heights[-2] if len(heights) > 2 else heights[-1]
        return min(max(measured + 0.03, 0.95 * self.body.height), 1.2 * self.body.height)

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
        sight = self._seen.pop(frame.index, None)
        if sight is None:
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
            answer[i] = replace(frames[i], registration=select(smooth.registration, torch.tensor(row)))
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
        for prefix, part in (("tracker_", self.tracker), ("eyes_", self.eyes)):
            own = {name.removeprefix(prefix): v for name, v in state.items() if name.startswith(prefix)}
            part.restore(own, self.device)

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
        shape[:3] = 0
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

    `state` is what a run that was interrupted goes on from: that of the model after the last frame returned.
    """

    def __init__(self, model: StereoToPose, state: Mapping[str, Tensor] | None = None):
        self.model = model
        self.before = None if not state or "message_pose" not in state else Message.from_state(state)
        self.state: dict[str, Tensor] = {}
        self._next: dict[str, Tensor] = {}
        self._waiting: list[FramePose] = []

    def push(self, frame: FramePose) -> list[FramePose]:
        """Take the next frame; the frames that are ready, often none."""
        config = self.model.config.smoothing
        self._waiting.append(frame)
        if len(self._waiting) == config.stretch:
            self._next = self.model.state()
        if len(self._waiting) < config.stretch + (config.ahead if config.rounds else 0):
            return []
        return self._smooth(config.stretch)

    def flush(self) -> list[FramePose]:
        """The frames that are left at the end of the recording."""
        self._next = self.model.state()
        return self._smooth(len(self._waiting)) if self._waiting else []

    def _smooth(self, count: int) -> list[FramePose]:
        smooth, self.before = self.model.smooth(self._waiting, self.before, count - 1)
        self._waiting = self._waiting[count:]
        self.state = self._next | ({} if self.before is None else self.before.state())
        return [replace(frame, observation=None) for frame in smooth[:count]]


def _upright_extent(sight: Sight) -> float:
    """From the head's top down to the lowest point, m."""
    points = sight.cloud.points[0][sight.cloud.mask[0]]
    middle = points.median(0).values
    center = sight.faces.position[0, 0] if bool(sight.faces.found[0]) else middle[0]
    column = points[(points[:, 0] - center).abs() < 0.12, 1]  # raised hands are beside the head
    return float(torch.quantile(points[:, 1], 0.99) - torch.quantile(column, 0.01))


def _touches_border(mask: Bool[Tensor, "height width"]) -> bool:
    """Whether a few pixels of a mask lie on the image's edge; the sides of stereo's blind strip count as inside."""
    edge = torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    return int(edge.sum()) > 4


def _stack(values: list[Tensor | None]) -> Tensor:
    there = [value for value in values if value is not None]
    if not there:
        raise ValueError(
            "the scene must be seen in at least one readable frame, got none; check the recording"
        )
    return torch.stack(there)


def depth_picture(depth: Float[Tensor, "batch height width"]) -> Float[Tensor, "batch 3 height width"]:
    """A picture of a depth image for people: near is bright."""
    near = (1 / depth.clamp_min(0.5)).nan_to_num(0.0).clamp(0, 2) / 2
    return near[:, None].expand(-1, 3, -1, -1)
