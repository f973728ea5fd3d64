"""Eyes: a frame of a recording in, silhouette, depth, points and face of the person out.

Left-camera frame, metres; pixels.
"""

import math
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from kornia.color import rgb_to_grayscale
from torch import Tensor, nn

from torchpose.recording import (
    Backgrounds,
    Frame,
    Recording,
    readable_frames,
    spread_positions,
)
from torchpose.vision.background import (
    BackgroundConfig,
    BackgroundModel,
    DepthBackground,
    DepthBackgroundConfig,
)
from torchpose.vision.camera import StereoCamera
from torchpose.vision.disparity import bridge_gaps
from torchpose.vision.empty_scene import (
    EmptySceneConfig,
    clear_depth,
    empty_depth,
    learn_empty_scene,
    stands_in_background,
)
from torchpose.vision.faces import FaceConfig, FaceDetector, FaceMemory, Faces
from torchpose.vision.floor import Floor, FloorConfig, find_floor
from torchpose.vision.growing_seeds import GrowingSeeds
from torchpose.vision.photometry import temporal_median
from torchpose.vision.points import PointCloud, SamplingConfig, sample_grid
from torchpose.vision.scene_match import SceneMatch, SceneMatchConfig
from torchpose.vision.silhouette import SilhouetteConfig, person_silhouette, search_region
from torchpose.vision.skin import SkinModel
from torchpose.vision.stereo import StereoConfig, stereo_matcher
from torchpose.vision.windows import window_max

GLANCES = 5  # frames of the recording that see whether somebody stands in its background
SURE = 3.0  # log-odds of a depth reading that is nobody's noise
PURE = 0.75  # share of a depth reading that must be the person's: with less it lies behind the body's surface
NEARER, FARTHER = 0.1, 0.95  # of a person's points, that are nearer than where the person begins and ends
FOOT = 0.1  # m by which a foot is before the scene
SURE_SD = 3.0  # standard deviations of a depth, by which it is surely another one
UNSEEN_FEET = 0.25  # m above the floor, from which on legs are seen
NOBODY = -1e3  # log-odds of a pixel that has been given to somebody


@dataclass(frozen=True)
class EyesConfig:
    """From images to points."""

    nearest: float = 1.2  # m, of the person: with `farthest` it bounds the disparities that are searched
    farthest: float = 8.0  # m
    background_frames: int = 15  # of the recording, from which the empty scene is learned if none is given
    depth_frames: int = 40  # the same for a depth camera, whose frames cost nothing and whose noise is large
    disparity_sd: float = 0.15  # px, of a matched disparity, on surfaces as smooth as a person
    background: BackgroundConfig = field(default_factory=BackgroundConfig)
    empty_scene: EmptySceneConfig = field(default_factory=EmptySceneConfig)
    depth_background: DepthBackgroundConfig = field(default_factory=DepthBackgroundConfig)
    scene_match: SceneMatchConfig = field(default_factory=SceneMatchConfig)
    floor: FloorConfig = field(default_factory=FloorConfig)
    silhouette: SilhouetteConfig = field(default_factory=SilhouetteConfig)
    memory: float = 0.5  # s, for which the last frame's silhouette tells which part of this one is the person
    stereo: StereoConfig = field(default_factory=StereoConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    face: FaceConfig = field(default_factory=FaceConfig)
    range_scale: int = 4  # by which images are shrunk to find the person's range of disparities
    glance_margin: float = 0.8  # m around it: an arm may be too thin for the small images
    last_margin: float = 0.5  # m around the last frame's range
    least_matched: float = 0.7  # share of the foreground; with less the range was wrong, and all is searched
    least_body: float = (
        0.08  # m^2 that a depth camera must surely see of a person: head and shoulders are 0.1
    )
    min_points: int = 60  # fewer points on the person are nobody
    people: int = 4  # at the most; 1 takes the largest silhouette for the person and all else for nothing
    beside: int = 3  # px around somebody that are nobody else's

    def __post_init__(self) -> None:
        if not 0 < self.nearest < self.farthest:
            raise ValueError(
                f"0 < nearest < farthest must hold, in m, got {self.nearest} and {self.farthest}"
            )
        if not self.least_body >= 0:
            raise ValueError(f"least_body must not be negative, in m^2, got {self.least_body}")
        if min(self.background_frames, self.depth_frames, self.min_points, self.range_scale, self.people) < 1:
            raise ValueError(
                "background_frames, depth_frames, min_points, range_scale and people must be at least 1"
            )


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
class View:
    """What the eyes make of one frame before people are told apart, batch 1."""

    images: Float[Tensor, "1 3 height width"]  # as a `Sight` has them
    depth: Float[Tensor, "1 height width"]  # m, NaN where unknown
    silhouette: Bool[Tensor, "1 height width"]  # of everybody
    coloured: bool


@dataclass(frozen=True)
class LastSight:
    """What the next frame is told of this one."""

    time_s: float
    silhouette: Bool[Tensor, "1 height width"]
    disparity: Float[Tensor, "1 height width"] | None  # px, of the person alone; None: a depth camera
    face: FaceMemory | None


class Stopwatch:
    """Processor time by stage, s. What a stage measures within another is its own, not the other's."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._within = [0.0]  # s, of the stages within each that is under way

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        begin = time.process_time()
        self._within.append(0.0)
        try:
            yield
        finally:
            spent = time.process_time() - begin
            self.seconds[stage] += spent - self._within.pop()
            self._within[-1] += spent


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
        self.floor: Floor | None = None
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

    @property
    def depth_noise(self) -> float:
        """Standard deviation of a depth, m, over its square: as the empty scene shows it, or as matching has it."""
        if isinstance(self.background, DepthBackground):
            return float(self.background.noise)
        if self.camera.baseline is None:
            return 0.0
        return self.config.disparity_sd / (self.camera.focal_length * self.camera.baseline)

    def standing_room(
        self, sight: Sight, covered: Bool[Tensor, "1 height width"] | None = None
    ) -> Bool[Tensor, "1 height width"]:
        """Where somebody (batch 1) may be: the silhouette, and what is `covered` by something nearer.

        Of whoever stands before a noisy depth camera also where the floor is as near as he or she, for there feet
        cannot be told from it; and nothing below the floor. For stereo colour tells them apart.
        """
        allowed = sight.silhouette if covered is None else sight.silhouette | covered
        points = sight.cloud.points[0][sight.cloud.mask[0]]
        if not isinstance(self.background, DepthBackground) or self.floor is None or len(points) == 0:
            return allowed
        if float(self.floor.above(points).quantile(0.01)) > UNSEEN_FEET:
            return allowed
        near, far = (float(points[:, 2].quantile(share)) for share in (NEARER, FARTHER))
        doubt = SURE_SD * self.depth_noise * far**2
        if doubt < FOOT:
            return allowed
        untold = self.background.depth < far + FOOT + doubt
        return sight.silhouette | ((allowed | untold) & self.floor.pixels_above(self.camera, near))

    def learn_background(self, backgrounds: Backgrounds, recording: Recording, device: torch.device) -> None:
        """Learn the empty scene from its frames, or where there are none from the recording itself."""
        depth_camera = self.camera.baseline is None
        count = self.config.depth_frames if depth_camera else self.config.background_frames
        spread = spread_positions(len(recording), count)
        if depth_camera:
            seen = _stack([frame.depth for frame in readable_frames(recording, spread)])
            config, rules = self.config.depth_background, self.config.empty_scene
            if backgrounds.depth is not None:
                depth = clear_depth(backgrounds.depth, seen, self.camera, config, rules)
            else:
                depth = empty_depth(seen, self.camera, config, rules)
                config = replace(config, drift=1.0)  # the frames are spread over all of the recording's
            self.background = DepthBackground(depth.to(device), config)
            self.background_depth = self.background.depth
            self.floor = find_floor(self.background_depth, self.camera, self.depth_noise, self.config.floor)
            return
        span, rules = (0, self.disparity_range[1]), self.config.empty_scene
        left, right = backgrounds.left, backgrounds.right
        if left is not None and right is not None:
            left, right = left.to(device), right.to(device)
            some = self._pairs(recording, spread_positions(len(recording), GLANCES), device)
            both = min(len(left), len(right))
            with self.stopwatch.measure("background"):
                if stands_in_background(
                    (left[:both], right[:both]), some, self.stereo, self.camera, span, rules
                ):
                    left = right = None
        if left is not None and right is not None:
            with self.stopwatch.measure("background"):
                pair = left.median(0, keepdim=True).values, right.median(0, keepdim=True).values
                disparity = self.stereo(*pair, disparity_range=span).values[0]
        else:
            pairs = self._pairs(recording, spread, device)
            with self.stopwatch.measure("background"):
                scene = learn_empty_scene(*pairs, self.stereo, self.camera, span, rules)
            left, right, disparity = scene.left, scene.right, scene.disparity
        disparity = bridge_gaps(disparity)  # a bare wall and a glaring floor match nowhere but at their rims
        self.background = BackgroundModel(left, self.config.background)
        self.background_depth = self.camera.depth(disparity)
        self.floor = find_floor(self.background_depth, self.camera, self.depth_noise, self.config.floor)
        empty = rgb_to_grayscale(torch.stack([temporal_median(left), temporal_median(right)]))[:, 0]
        self.scene_match = SceneMatch(empty[0], empty[1], disparity, self.config.scene_match)

    @staticmethod
    def _pairs(recording: Recording, positions: list[int], device: torch.device) -> tuple[Tensor, Tensor]:
        """Left and right images of some frames, (T, 3, H, W) each."""
        frames = list(readable_frames(recording, positions))
        left, right = (_stack([getattr(f, side) for f in frames]).to(device) for side in ("left", "right"))
        return left, right

    def state(self) -> dict[str, Tensor]:
        """What is remembered of the last frame and of the floor, to go on from there; {} if there was neither."""
        state = {}
        if self.floor is not None:
            state["floor"] = torch.cat([self.floor.normal, self.floor.height[None]])
        if self.last is None:
            return state
        time_s = torch.tensor(self.last.time_s, dtype=torch.float64)
        state |= {"time_s": time_s, "silhouette": self.last.silhouette}
        if self.last.face is not None:
            state |= {"face": self.last.face.box}
            state |= {f"skin_{name}": value for name, value in vars(self.last.face.skin).items()}
        return state if self.last.disparity is None else state | {"disparity": self.last.disparity}

    def restore(self, state: dict[str, Tensor], device: torch.device) -> None:
        """Take up what `state` gave."""
        self.last = None
        if "floor" in state:  # only the files may be left to write: the empty scene is then not learned again
            plane = state["floor"].to(device)
            self.floor = Floor(plane[:3], plane[3])
        if "time_s" in state:
            disparity, box = state.get("disparity"), state.get("face")
            skin = {name[5:]: value.to(device) for name, value in state.items() if name.startswith("skin_")}
            self.last = LastSight(
                float(state["time_s"]),
                state["silhouette"].to(device),
                None if disparity is None else disparity.to(device),
                None if box is None else FaceMemory(box.to(device), SkinModel(**skin)),
            )

    def forward(self, frame: Frame, device: torch.device) -> Sight:
        """Look at one frame, and at whom it shows as one person."""
        memory = self.last.face if self.last and self._recent(frame.time_s) else None
        view = self.look(frame, device, most=1)
        sight = self.sight(view, view.silhouette, memory)
        assert self.last is not None
        self.last = replace(self.last, face=sight.faces.memory)
        return sight

    def _recent(self, time_s: float) -> bool:
        return self.last is not None and 0 < time_s - self.last.time_s < self.config.memory

    def look(self, frame: Frame, device: torch.device, most: int | None = None) -> View:
        """Look at one frame: depth, and where anybody is, `most` people in it (None: as configured).

        The next frame is told of it, but not of faces.
        """
        if self.background is None:
            raise ValueError(
                "the background must be learned before a frame is looked at; call learn_background"
            )
        last = self.last if self._recent(frame.time_s) else None
        if frame.depth is not None:
            depth = frame.depth[None].to(device)
            images = frame.left[None].to(device) if frame.left is not None else depth_picture(depth)
            grey = rgb_to_grayscale(images)[:, 0]
            with self.stopwatch.measure("background"):
                assert isinstance(self.background, DepthBackground)
                log_odds = self.background(depth)
                surface = depth.where(self.background.front_share(depth) > PURE, torch.nan)
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
            silhouette = self._silhouette(
                log_odds, depth, grey, last.silhouette if last else None, most or self.config.people
            )
            seen = depth.where(silhouette, torch.nan)
            matched = None if self.camera.baseline is None else self.camera.disparity(seen)
        self.last = LastSight(frame.time_s, silhouette, matched, None)
        return View(images, depth if frame.depth is None else surface, silhouette, frame.left is not None)

    def _silhouette(
        self,
        log_odds: Float[Tensor, "1 height width"],
        depth: Float[Tensor, "1 height width"],
        grey: Float[Tensor, "1 height width"],
        previous: Bool[Tensor, "1 height width"] | None,
        most: int,
    ) -> Bool[Tensor, "1 height width"]:
        """One silhouette after another, each of what is left of the foreground, until there is too little of it."""
        config = self.config.silhouette
        sigma = self.background.sigma if isinstance(self.background, DepthBackground) else None
        everybody = torch.zeros_like(log_odds, dtype=torch.bool)
        fewest = config.min_area * log_odds[0].numel()
        for _ in range(most):
            one = person_silhouette(
                log_odds,
                depth,
                config,
                self.background_depth,
                self.camera,
                guide=grey,
                previous=previous,
                background_sigma=sigma,
            ).mask
            if not bool(one.any()):
                break
            if sigma is None or self._is_body(one, log_odds, depth):
                everybody = everybody | one
            taken = window_max(one.to(log_odds), self.config.beside) > 0
            log_odds = log_odds.masked_fill(taken, NOBODY)
            if float((log_odds > 0).sum()) < fewest:
                break
            previous = None if previous is None else previous & ~taken
        return everybody

    def _is_body(
        self,
        silhouette: Bool[Tensor, "1 height width"],
        log_odds: Float[Tensor, "1 height width"],
        depth: Float[Tensor, "1 height width"],
    ) -> bool:
        """Whether enough of a silhouette is surely before the scene: a depth camera's noise comes in large patches.

        What is surely there is measured in m^2, so a patch that is far away must be as clear as one that is near.
        """
        unknown = torch.zeros_like(silhouette)
        if (
            self.background_depth is not None
        ):  # where the scene was never seen, nothing is surer than a reading
            unknown = self.background_depth.isnan()[None].expand_as(silhouette)
        sure = silhouette & ((log_odds > SURE) | unknown) & depth.isfinite()
        return float((depth[sure] / self.camera.focal_length).square().sum()) >= self.config.least_body

    def sight(self, view: View, silhouette: Bool[Tensor, "1 height width"], face: FaceMemory | None) -> Sight:
        """Whom a silhouette shows, of a view's people; `face` is what his or her last sight remembers."""
        with self.stopwatch.measure("points"):
            cloud = sample_grid(view.depth, silhouette, self.camera, self.config.sampling)
        with self.stopwatch.measure("faces"):
            # A picture of the depth shows no face; an empty silhouette spares the search.
            shown = silhouette if view.coloured else torch.zeros_like(silhouette)
            faces = self.find_faces(view.images, shown, view.depth, self.camera, face)
            faces = replace(faces, sought=view.coloured)
        present = int(cloud.mask.sum()) >= self.config.min_points
        cut = _touches_border(silhouette[0])
        return Sight(view.images, view.depth, silhouette, cloud, faces, present, cut, view.coloured)


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
