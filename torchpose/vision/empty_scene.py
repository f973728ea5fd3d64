"""The empty scene out of a stereo recording with people in it: where they stand in each frame, and what is behind.

What moves in front of the scene is a person for sure. A person's still parts hang together with the moving ones, at the
same depth, and stand out of the planes of the room (floor and walls). The rest of each frame shows the scene; where no
frame does, it stays unknown. Left-camera frame, metres; disparity in px, NaN where unknown.
"""

import warnings
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from torchpose.vision.background import DepthBackground, DepthBackgroundConfig, far_readings
from torchpose.vision.camera import StereoCamera
from torchpose.vision.disparity import StereoMatcher, nearest_known
from torchpose.vision.photometry import temporal_median
from torchpose.vision.pieces import connected_pieces
from torchpose.vision.windows import window_max, window_min

Frames = Float[Tensor, "frames 3 height width"]
Plane = Float[Tensor, "height width"]
Planes = Float[Tensor, "frames height width"]
Masks = Bool[Tensor, "frames height width"]
LEAST_PERSON = 0.004  # share of the image, of somebody before the scene; less is noise
BESIDE, BELOW = 0.15, 0.4  # of a person's height as far as it is found, around which the scene is not trusted
LEAST_FRAMES = 3  # in which the scene must be seen
DISPARITY_NOISE = 0.2  # px, of a depth camera that is taken for a stereo camera


@dataclass(frozen=True)
class EmptySceneConfig:
    """Settings of `learn_empty_scene`. Disparities (px) are those of the shrunken images."""

    shrink: int = 2  # by which images are made smaller to find the people
    far_share: float = 0.2  # of the frames; the disparity that so many do not exceed is the farthest seen
    step: float = 1.0  # px, by which a pixel is nearer than that where somebody has moved
    plane_noise: float = 0.6  # px, to either side of a plane of the room
    least_plane: float = 0.2  # share of the image that a plane takes at least
    gap: float = 1.5  # px, disparity step at which things do not hang together
    reach: float = 0.6  # m, of a person before and behind the middle
    least_moved: int = 50  # px, fewer are noise
    fattening: int = 4  # px of the full images, by which disparity next to what is unseen is not trusted
    margin: int = 1  # px, added around people: the disparity of edges is fattened
    smallest: float = 0.8  # m, height of a person where nobody moves
    tallest: float = 2.3  # m

    def __post_init__(self) -> None:
        if self.shrink < 1 or self.least_moved < 1 or self.margin < 0:
            values = f"{self.shrink}, {self.least_moved} and {self.margin}"
            raise ValueError(f"shrink and least_moved must be at least 1 and margin 0, got {values}")
        if not (0 <= self.far_share < 1 and 0 < self.least_plane < 1):
            raise ValueError(
                f"far_share and least_plane must be shares, got {self.far_share} and {self.least_plane}"
            )
        for name in ("step", "plane_noise", "gap", "reach"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


@dataclass(frozen=True)
class EmptyScene:
    """What a recording shows of the scene behind its people."""

    left: Frames  # NaN where somebody hides the scene
    right: Frames
    disparity: Plane  # px; what nobody ever sees is continued from the farther side of the row
    seen: Bool[Tensor, "height width"]  # by one frame at least; elsewhere `disparity` is a guess


def learn_empty_scene(
    left: Frames,
    right: Frames,
    matcher: StereoMatcher,
    camera: StereoCamera,
    disparity_range: tuple[int, int],
    config: EmptySceneConfig = EmptySceneConfig(),
) -> EmptyScene:
    """The scene behind the people of a few frames (T, 3, H, W) spread over a recording, RGB in [0, 1].

    Where nobody moves, the tallest thing of a person's height that stands out of the room is taken for a person, with
    a warning.
    """
    disparity = _small_disparity(left, right, matcher, disparity_range, config)
    people = find_people(disparity, camera.scaled(1 / config.shrink), config)
    hidden = [_enlarge(mask, left) for mask in (people, _in_right_image(people, disparity))]
    shown = [
        torch.where(h[:, None], torch.nan, images) for h, images in zip(hidden, (left, right), strict=True)
    ]
    empty, whole = ([temporal_median(images) for images in two] for two in (shown, (left, right)))
    seen = empty[0].isfinite().all(0)
    # The people who stay unseen through are matched with themselves, and then left out.
    pair = [torch.where(a.isnan(), b, a)[None] for a, b in zip(empty, whole, strict=True)]
    scene = matcher(pair[0], pair[1], disparity_range=disparity_range).values[0]
    trusted = window_min(seen.to(scene.dtype), config.fattening) > 0
    return EmptyScene(shown[0], shown[1], continue_rows(scene, trusted), seen)


def stands_in_background(
    empty: tuple[Tensor, Tensor],
    frames: tuple[Tensor, Tensor],
    matcher: StereoMatcher,
    camera: StereoCamera,
    disparity_range: tuple[int, int],
    config: EmptySceneConfig = EmptySceneConfig(),
) -> bool:
    """Whether somebody stands in the stereo pairs that should show the empty scene; warns of it.

    Who does is nearer there than what frames, spread over the recording, see behind; both are left and right images,
    (T, 3, H, W) each, RGB in [0, 1].
    """
    background, seen = (
        _small_disparity(left, right, matcher, disparity_range, config) for left, right in (empty, frames)
    )
    far = seen.nanquantile(config.far_share, dim=0)
    nearer = window_min((background > far + config.step).to(background.dtype), 1) > 0
    if not _tallest(nearer, background, camera.scaled(1 / config.shrink), config).any():
        return False
    warnings.warn(
        "somebody or something stands in the background that the recording sees behind; the empty scene is taken "
        "from the recording instead; record the empty scene anew into its folder background/",
        stacklevel=2,
    )
    return True


def _small_disparity(
    left: Frames,
    right: Frames,
    matcher: StereoMatcher,
    disparity_range: tuple[int, int],
    config: EmptySceneConfig,
) -> Float[Tensor, "frames h w"]:
    """Disparities of shrunken pairs, px of these."""
    size = (left.shape[2] // config.shrink, left.shape[3] // config.shrink)
    least, greatest = disparity_range[0] // config.shrink, -(-disparity_range[1] // config.shrink)
    found = []
    for images in zip(left, right, strict=True):  # one by one: a batch's volume of all disparities is large
        small = [F.interpolate(image[None], size, mode="area") for image in images]
        found.append(matcher(small[0], small[1], disparity_range=(least, greatest)).values)
    return torch.cat(found)


def empty_depth(
    depth: Float[Tensor, "frames height width"],
    camera: StereoCamera,
    config: DepthBackgroundConfig,
    scene: EmptySceneConfig,
) -> Planes:
    """A depth camera's readings of the scene behind the people of a few frames, m; NaN where somebody may be.

    Whoever stands before what is seen behind him at another time is found first. Around him nothing counts, for his
    feet are as far away as the floor; where that leaves too few frames, the farthest readings are the scene's. Where
    nobody comes or goes, somebody may stay: who moves an arm is found by `find_people`, with its warning where
    nobody moves at all, and what he hides is continued from the farther side of the row.
    """
    far = far_readings(depth, config)
    hidden, tallest = people_boxes(depth, far, camera, config)
    if tallest >= scene.smallest:
        open_view = depth.masked_fill(hidden, torch.nan)
        enough = open_view.isfinite().sum(0) >= LEAST_FRAMES
        return torch.where(enough, open_view, far)
    # Noise that grows with the square of depth is the same everywhere in disparity, whatever the baseline.
    as_stereo = replace(camera, baseline=DISPARITY_NOISE / (camera.focal_length * config.noise_growth))
    people = find_people(as_stereo.disparity(depth), as_stereo, scene)
    open_view = depth.masked_fill(people, torch.nan)
    seen = open_view.isfinite().any(0)
    middle = as_stereo.disparity(torch.where(seen, open_view, depth).nanmedian(0).values)
    never = people.any(0) & ~seen
    behind = as_stereo.depth(continue_rows(middle, seen))
    return torch.where(never, behind, open_view)


def clear_depth(
    backgrounds: Float[Tensor, "num height width"],
    depth: Float[Tensor, "frames height width"],
    camera: StereoCamera,
    config: DepthBackgroundConfig,
    scene: EmptySceneConfig,
) -> Float[Tensor, "more height width"]:
    """A depth camera's frames of the empty scene, NaN where somebody stands in one; warns of those who do.

    They are told by frames of the recording that see what is behind them, and where no background frame sees the
    scene these frames' readings stand in: then some more frames follow.
    """
    far = far_readings(depth, config)
    hidden, _ = people_boxes(backgrounds, far, camera, config)
    wrong = hidden.flatten(1).any(1)
    if not wrong.any():
        return backgrounds
    names = ", ".join(str(k) for k in wrong.nonzero()[:, 0].tolist())
    warnings.warn(
        f"somebody or something stands in the background that the recording sees behind, in {int(wrong.sum())} of "
        f"{len(wrong)} background frames ({names}); what is behind is taken from the recording; "
        "record the empty scene anew into its folder background/",
        stacklevel=2,
    )
    clear = backgrounds.masked_fill(hidden, torch.nan)
    missing = hidden.any(0) & ~clear.isfinite().any(0)
    return torch.cat([clear, torch.where(missing, empty_depth(depth, camera, config, scene), torch.nan)])


def people_boxes(
    depth: Planes,
    far: Float[Tensor, "num height width"],
    camera: StereoCamera,
    config: DepthBackgroundConfig,
) -> tuple[Masks, float]:
    """Boxes of whoever stands before the scene in each frame, with room about them, and the greatest height, m.

    Args:
        far: (K, H, W) m, readings of the scene, as `far_readings` gives them.
    """
    background = DepthBackground(far, config)
    found = connected_pieces(window_min((background(depth) > 0).to(depth.dtype), 1) > 0)
    height, width = depth.shape[1:]
    hidden = torch.zeros_like(depth, dtype=torch.bool)
    large = found.area >= LEAST_PERSON * height * width
    large[0] = False
    tallest = 0.0
    for piece in large.nonzero()[:, 0].tolist():
        left, top, wide, high = found.box[piece].tolist()
        frame = int(found.image[piece])
        distance = float(depth[frame][found.labels[frame] == piece].nanmedian())
        tallest = max(tallest, high * distance / camera.focal_length)
        rows = slice(max(0, round(top - BESIDE * high)), round(top + (1 + BELOW) * high))
        columns = slice(max(0, round(left - BESIDE * high)), round(left + wide + BESIDE * high))
        hidden[frame, rows, columns] = True
    return hidden, tallest


def find_people(
    disparity: Planes, camera: StereoCamera, config: EmptySceneConfig = EmptySceneConfig()
) -> Masks:
    """Where people stand in each frame of a still camera, from the frames' disparities (T, H, W).

    Warns where nobody moves.
    """
    far = disparity.nanquantile(config.far_share, dim=0)
    room = torch.zeros_like(disparity, dtype=torch.bool)
    for plane in room_planes(far, config):
        room |= (disparity - plane).abs() < config.plane_noise
    standing = disparity.isfinite() & ~room
    moved = window_min((standing & (disparity > far + config.step)).to(disparity.dtype), 1) > 0
    # A step between a pixel and its neighbours cuts what hangs together.
    nearest = window_max(disparity.nan_to_num(-torch.inf), 1)
    farthest = window_min(torch.where(disparity.isnan(), torch.inf, disparity), 1)
    pieces = standing & ~(nearest - farthest > config.gap)
    moving = moved.flatten(1).sum(1) >= config.least_moved
    if not moving.any():
        warnings.warn(
            "nobody moves in this recording, so its empty scene is a guess that may hold the person; "
            "record a frame or two of the empty scene into its folder background/",
            stacklevel=2,
        )
        return _rim(_tallest(pieces, disparity, camera, config), standing, config)
    depth = camera.depth(disparity)
    people = torch.zeros_like(moved)
    # Whoever rests in one frame moves in another: in the second round, whatever stands where a person was
    # found, at that person's disparity, is a seed too.
    for _ in range(2):
        found = torch.where(people, disparity, torch.nan).nanmedian(0).values
        resting = (disparity - found).abs() < config.plane_noise
        seeds = (moved | resting) & standing
        measured = depth.where(moved.where(moving[:, None, None], seeds), torch.nan)
        near = (depth - _middle(measured)).abs() < config.reach
        people = _pieces_with(pieces & near, seeds, config.least_moved // 2)
    return _rim(people, standing, config)


def room_planes(disparity: Plane, config: EmptySceneConfig = EmptySceneConfig()) -> list[Plane]:
    """Disparities (H, W) of the planes that fill a share of the image: a plane of the room is one in disparity too.

    By RANSAC on 4000 pixels, plane after plane, the largest first; the random numbers are always the same.
    """
    height, width = disparity.shape
    generator = torch.Generator().manual_seed(0)
    v, u = (disparity.isfinite()).nonzero().unbind(1)
    if len(u) < 3:
        return []
    chosen = torch.randperm(len(u), generator=generator)[:4000].to(u.device)
    u, v = u[chosen], v[chosen]
    points = torch.stack([u, v, torch.ones_like(u)], 1).to(disparity.dtype)
    values = disparity[v, u]
    grid = torch.stack(
        [
            torch.arange(width, device=u.device).expand(height, -1),
            torch.arange(height, device=u.device)[:, None].expand(-1, width),
            torch.ones(height, width, device=u.device),
        ],
        -1,
    ).to(disparity.dtype)
    least, tolerance, planes = config.least_plane * len(points), 0.5 * config.plane_noise, []
    while len(points) > least:
        corners = torch.randint(len(points), (500, 3), generator=generator).to(u.device)
        triangle = points[corners]
        wide = torch.linalg.det(triangle).abs() > 1e-3 * height * width  # twice its area: not on one line
        if not wide.any():
            break
        candidates = torch.linalg.solve(triangle[wide], values[corners[wide]][..., None])[..., 0]
        inside = (points @ candidates.T - values[:, None]).abs() < tolerance
        best = candidates[inside.sum(0).argmax()]
        for _ in range(2):
            inside = (points @ best - values).abs() < tolerance
            best = torch.linalg.lstsq(points[inside], values[inside][:, None]).solution[:, 0]
        inside = (points @ best - values).abs() < tolerance
        if inside.sum() < least:
            break
        planes.append(grid @ best)
        points, values = points[~inside], values[~inside]
    return planes


def continue_rows(disparity: Plane, seen: Bool[Tensor, "height width"]) -> Plane:
    """The disparity, where not `seen` that of the nearest seen pixel of the row, of two the farther; else NaN."""
    width = disparity.shape[1]
    before, after = nearest_known(seen & disparity.isfinite())
    left = disparity.gather(1, before.clamp_min(0)).where(before >= 0, torch.inf)
    right = disparity.gather(1, after.clamp_max(width - 1)).where(after < width, torch.inf)
    farther = torch.minimum(left, right)
    return disparity.where(seen, farther.where(farther.isfinite(), torch.nan))


def _middle(values: Planes) -> Float[Tensor, "frames 1 1"]:
    """Median of each frame, without NaN."""
    return values.flatten(1).nanmedian(1).values[:, None, None]


def _pieces_with(pieces: Masks, seeds: Masks, least: int) -> Masks:
    """The connected pieces that hold `least` seeds."""
    found = connected_pieces(pieces)
    held = torch.bincount(found.labels[seeds], minlength=len(found.area)) >= least
    held[0] = False
    return held[found.labels]


def _tallest(pieces: Masks, disparity: Planes, camera: StereoCamera, config: EmptySceneConfig) -> Masks:
    """The connected piece of each frame that is the tallest within a person's height, if there is any."""
    found = connected_pieces(pieces)
    label, depth = found.labels.flatten(), camera.depth(disparity).flatten()
    by_depth = depth.argsort()
    # Piece after piece, the nearest pixel first.
    ordered = depth[by_depth[label[by_depth].argsort(stable=True)]]
    first = found.area.cumsum(0) - found.area
    middle = 0.5 * (ordered[first + (found.area - 1) // 2] + ordered[first + found.area // 2])
    height = found.box[:, 3] * middle / camera.focal_length
    fits = (found.area >= config.least_moved) & (config.smallest < height) & (height < config.tallest)
    person = found.best(height.where(fits, 0))
    return (found.labels == person[:, None, None]) & (person > 0)[:, None, None]


def _rim(people: Masks, standing: Masks, config: EmptySceneConfig) -> Masks:
    """The people with what the cuts took from their rims, and a margin around."""
    whole = standing & (window_max(people.to(torch.float32), 2) > 0)
    return window_max((people | whole).to(torch.float32), config.margin) > 0


def _in_right_image(people: Masks, disparity: Planes) -> Masks:
    """The same people in the right images: each pixel moved by its disparity, or the middle one of the person."""
    inside = torch.where(people, disparity, torch.nan)
    shift = torch.where(inside.isnan(), _middle(inside).nan_to_num(0), inside).round().long()
    columns = (torch.arange(people.shape[2], device=people.device) - shift).clamp(0, people.shape[2] - 1)
    moved = torch.zeros_like(disparity).scatter_reduce(2, columns, people.to(disparity.dtype), "amax")
    return window_max(moved, 1) > 0


def _enlarge(masks: Masks, images: Frames) -> Bool[Tensor, "frames h w"]:
    size = (images.shape[2], images.shape[3])
    return F.interpolate(masks[:, None].to(images.dtype), size, mode="nearest")[:, 0] > 0
