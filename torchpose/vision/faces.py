"""Where the face is: Haar detector, skin colour and plausible shape, inside the silhouette (T. 3.2.1, 4.3.1).

Images are RGB in [0, 1]; boxes are pixels of the left image; positions are metres in the left camera's frame.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import kornia.color
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.vision.camera import StereoCamera
from torchpose.vision.skin import (
    SkinConfig,
    SkinModel,
    fade_skin,
    learn_skin,
    skin_prior,
    skin_probability,
    stack_skin,
)
from torchpose.vision.windows import window_max, window_min

STANDING_HEIGHT = 1.7  # m, tells the distance where depth does not
COARSE = 4  # px, step at which the silhouette is searched for a head
LIT = 0.5  # brightness that the brightest tenth of a person has at least, where faces are looked for
COLOURLESS = 0.02  # greatest difference of red and blue where the camera has no colours

Box = tuple[float, float, float, float]  # px, x0, y0, x1, y1


@dataclass(frozen=True)
class Cascade:
    """One of the detectors that ship with OpenCV."""

    file: str
    box: float  # width of its boxes to the face's, as measured
    mirrored: bool  # whether it knows faces to one side only


CASCADES = (
    Cascade("haarcascade_frontalface_alt2.xml", 1.17, False),
    Cascade("haarcascade_profileface.xml", 1.35, True),
)


@dataclass(frozen=True)
class FaceConfig:
    """Settings of `FaceDetector`."""

    min_width: float = 0.105  # m, of a face
    max_width: float = 0.175  # m
    profile: bool = True  # look for profiles too, where no frontal face is found
    scale_step: float = 1.1  # ratio of successive sizes looked for
    min_neighbours: int = (
        1  # overlapping detections that make a face, as colour, size and place are asked too
    )
    grey_neighbours: int = 3  # where there is no colour to ask
    face_pixels: int = 26  # px, width to which the narrowest face's box is scaled; the cascades need 20
    search_height: float = 0.75  # m below the silhouette's top; a raised arm may be above the head
    search_margin: float = 0.15  # m about the last frame's face, where this one is looked for first
    min_inside: float = 0.75  # share of the face that must lie on the silhouette
    min_skin: float = 0.4  # share of that which must be one patch of skin
    min_fill: float = 0.4  # share of the rectangle about the patch that it fills; a face is round
    min_aspect: float = 0.7  # height to width of that rectangle
    max_aspect: float = 2.2
    skin: SkinConfig = field(default_factory=SkinConfig)

    def __post_init__(self) -> None:
        for low, high in (("min_width", "max_width"), ("min_aspect", "max_aspect")):
            if not 0 < getattr(self, low) < getattr(self, high):
                raise ValueError(
                    f"{low} must be positive and below {high}, got {getattr(self, low)} and {getattr(self, high)}"
                )
        if not self.scale_step > 1:
            raise ValueError(f"scale_step must be above 1, got {self.scale_step}; 1.1 is usual")
        if self.face_pixels < 20:
            raise ValueError(f"face_pixels must be at least 20, the cascade's own, got {self.face_pixels}")
        for name in ("search_height", "search_margin"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)} m")
        for name in ("min_skin", "min_fill", "min_inside"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)}")


@dataclass(frozen=True)
class FaceMemory:
    """What the next frame is told of this one."""

    box: Float[Tensor, "batch 4"]  # of `Faces`
    skin: SkinModel


@dataclass(frozen=True)
class Faces:
    """At most one face a frame."""

    box: Float[Tensor, "batch 4"]  # px, x0, y0, x1, y1; NaN where none
    found: Bool[Tensor, " batch"]
    mask: Bool[Tensor, "batch height width"]  # face pixels: the box's ellipse on the silhouette
    position: Float[Tensor, "batch 3"]  # m, a point of the face's surface; NaN where none or without depth
    memory: FaceMemory | None = None  # for the next frame
    sought: bool = True  # False: these images cannot show a face, so that none is found says nothing


@dataclass(frozen=True)
class _Scene:
    """One frame, as the search needs it."""

    image: Float[Tensor, "1 3 height width"]
    skin: SkinModel
    silhouette: Bool[Tensor, "height width"]
    depth: Float[Tensor, "height width"]  # m
    focal_length: float  # px
    metre: float  # px, at the person's distance
    top: int  # row
    bottom: int


def read_cascade(file: str) -> cv2.CascadeClassifier:
    """A Haar cascade of OpenCV's.

    Raises:
        ValueError: OpenCV does not bring it.
    """
    path = Path(cv2.__file__).parent / "data" / file
    cascade = cv2.CascadeClassifier(str(path))
    if cascade.empty():
        raise ValueError(f"the Haar cascade {path} cannot be read; install opencv-python-headless<5")
    return cascade


class FaceDetector:
    """The face of the person whose silhouette is given."""

    def __init__(self, config: FaceConfig = FaceConfig()):
        self.config = config
        self._cascades = [
            (kind, read_cascade(kind.file)) for kind in CASCADES if config.profile or not kind.mirrored
        ]

    def __call__(
        self,
        images: Float[Tensor, "batch 3 height width"],
        silhouette: Bool[Tensor, "batch mask_height mask_width"],
        depth: Float[Tensor, "batch depth_height depth_width"],
        camera: StereoCamera,
        last: FaceMemory | None = None,
    ) -> Faces:
        """Faces in the upper part of the silhouette, of a width that is plausible at their depth.

        Args:
            images: (B, 3, H, W) in [0, 1].
            silhouette: (B, H, W) of one person a frame.
            depth: (B, H, W) m, NaN where unknown; the silhouette's height stands in for it.
            last: the last frame's `Faces.memory`, one for each frame of the batch: where to look first and what the
                person's skin looks like.

        Raises:
            ValueError: the images do not have one size, or `last` has another batch.
        """
        batch, _, height, width = images.shape
        if silhouette.shape != (batch, height, width) or depth.shape != (batch, height, width):
            raise ValueError(
                f"silhouette and depth must have the images' size {(batch, height, width)}, "
                f"got {tuple(silhouette.shape)} and {tuple(depth.shape)}"
            )
        box = depth.new_full((batch, 4), torch.nan)
        if last is None:
            last = FaceMemory(box, skin_prior(images, self.config.skin, batch))
        elif len(last.box) != batch:
            raise ValueError(f"the last frame's memory must be of {batch} faces, got {len(last.box)}")
        faded = fade_skin(last.skin, self.config.skin)
        skins = [faded.item(index) for index in range(batch)]
        box = box.clone()
        mask = torch.zeros_like(silhouette)
        position = depth.new_full((batch, 3), torch.nan)
        for index in range(batch):  # OpenCV takes one image at a time
            rows = silhouette[index].any(1).nonzero()[:, 0]
            if len(rows) == 0:
                continue
            top, bottom = int(rows[0]), int(rows[-1])
            distance = float(depth[index][silhouette[index]].nanmedian())
            if not distance > 0:
                distance = camera.focal_length * STANDING_HEIGHT / (bottom - top + 1)
            scene = _Scene(
                images[index : index + 1],
                skins[index],
                silhouette[index],
                depth[index],
                camera.focal_length,
                camera.focal_length / distance,
                top,
                bottom,
            )
            face = self._search(scene, last.box[index].tolist())
            if face is None:
                continue
            box[index] = depth.new_tensor(face)
            part, oval = _oval(box[index], silhouette[index])
            mask[index][part] = oval & silhouette[index][part]
            middle = 0.5 * (box[index, :2] + box[index, 2:])
            reading = depth[index][part][mask[index][part]].nanmedian()
            position[index] = camera.back_project(middle, reading)
            seen = images[index : index + 1, :, *part], mask[index][part][None]
            skins[index] = learn_skin(skins[index], *seen, self.config.skin)
        return Faces(box, ~box[:, 0].isnan(), mask, position, FaceMemory(box, stack_skin(skins)))

    def _search(self, scene: _Scene, last: list[float]) -> Box | None:
        """The best face about the last frame's, else in all of the head's window."""
        for window in self._windows(scene, last):
            face = self._search_window(scene, window)
            if face is not None:
                return face
        return None

    def _windows(self, scene: _Scene, last: list[float]) -> Iterator[tuple[slice, slice]]:
        height, width = scene.silhouette.shape
        if not math.isnan(last[0]):
            margin = self.config.search_margin * scene.metre
            x0, y0 = (max(0, math.floor(edge - margin)) for edge in last[:2])
            x1, y1 = (math.ceil(edge + margin) + 1 for edge in last[2:])
            yield slice(y0, min(y1, height)), slice(x0, min(x1, width))
        window = _head_window(scene.silhouette, scene.top, scene.metre, self.config.search_height)
        if window is not None:
            yield window

    def _search_window(self, scene: _Scene, window: tuple[slice, slice]) -> Box | None:
        """The face that most overlapping detections agree on: frontal ones, then profiles."""
        if not scene.silhouette[window].any():
            return None
        y0, x0 = window[0].start, window[1].start
        colours = scene.image[:, :, *window]
        coloured = float((colours[:, 0] - colours[:, 2]).abs().amax()) > COLOURLESS
        brightness = kornia.color.rgb_to_grayscale(colours)[0, 0]
        # In bytes, as OpenCV wants it, too little contrast is left of a dark face.
        bright = float(brightness[scene.silhouette[window]].quantile(0.9))
        gain = max(1.0, LIT / max(bright, LIT / 10))
        grey = (255 * gain * brightness).round().clamp(0, 255).byte().cpu().numpy()
        for kind, cascade in self._cascades:
            metre = kind.box * scene.metre  # px, of a box about a face of 1 m
            scale = self.config.face_pixels / (self.config.min_width * metre)
            if scale * min(grey.shape) < self.config.face_pixels:
                continue  # too small a window for any face
            shrunk = cv2.resize(
                grey,
                None,
                fx=scale,
                fy=scale,
                interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR,
            )
            best, most = None, 0
            for mirrored in (False, True)[: 1 + kind.mirrored]:
                view = np.ascontiguousarray(shrunk[:, ::-1]) if mirrored else shrunk
                for (x, y, w, h), votes in self._detect(cascade, view, coloured):
                    x = shrunk.shape[1] - x - w if mirrored else x
                    # The centre of the first pixel is 0 in both images, so its edge is what scales.
                    box = (
                        (x / scale) + x0 - 0.5,
                        (y / scale) + y0 - 0.5,
                        (x + w) / scale + x0 - 0.5,
                        (y + h) / scale + y0 - 0.5,
                    )
                    if votes > most and self._plausible(box, kind, scene, coloured):
                        best, most = box, votes
            if best is not None:
                return best
        return None

    def _detect(
        self, cascade: cv2.CascadeClassifier, view: np.ndarray, coloured: bool
    ) -> list[tuple[tuple[int, int, int, int], int]]:
        """Boxes (x, y, w, h) of face-like patches with the number of overlapping hits of each."""
        least = max(20, int(0.9 * self.config.face_pixels))
        most = int(1.1 * self.config.face_pixels * self.config.max_width / self.config.min_width)
        boxes, votes = cascade.detectMultiScale2(
            view,
            scaleFactor=self.config.scale_step,
            minNeighbors=self.config.min_neighbours if coloured else self.config.grey_neighbours,
            minSize=(least, least),
            maxSize=(most, most),
        )
        return [
            ((int(x), int(y), int(w), int(h)), int(vote))
            for (x, y, w, h), vote in zip(boxes, votes, strict=True)
        ]

    def _plausible(self, box: Box, kind: Cascade, scene: _Scene, coloured: bool) -> bool:
        """Whether a box has a face's size, place and skin."""
        if 0.5 * (box[1] + box[3]) > 0.5 * (scene.top + scene.bottom):
            return False  # a face is in the upper half
        part, oval = _oval(scene.depth.new_tensor(box), scene.silhouette)
        inside = oval & scene.silhouette[part]
        area = int(inside.sum())
        if area == 0 or area < self.config.min_inside * int(oval.sum()):
            return False
        distance = float(scene.depth[part][inside].nanmedian())
        width = (box[2] - box[0]) / kind.box * distance / scene.focal_length
        if distance > 0 and not self.config.min_width <= width <= self.config.max_width:
            return False
        if not coloured:
            return True
        skin = skin_probability(scene.image[:, :, *part], scene.skin, self.config.skin)[0]
        return self._skin_shaped((skin > 0.5) & inside, area)

    def _skin_shaped(self, skin: Bool[Tensor, "height width"], area: int) -> bool:
        """Whether the largest patch of skin among the `area` pixels of a face is as large and as round as one."""
        _, _, patches, _ = cv2.connectedComponentsWithStats(skin.byte().cpu().numpy())
        if len(patches) < 2:
            return False
        _, _, width, height, pixels = patches[1 + patches[1:, cv2.CC_STAT_AREA].argmax()].tolist()
        config = self.config
        return (
            pixels >= config.min_skin * area
            and pixels >= config.min_fill * width * height
            and config.min_aspect <= height / width <= config.max_aspect
        )


def _head_window(
    silhouette: Bool[Tensor, "height width"], top: int, metre: float, search_height: float
) -> tuple[slice, slice] | None:
    """Rows and columns where the upper silhouette is as wide as a head, with a margin; `metre` in px.

    Opened by a square of 0.1 m on a coarse image: arms are thinner than that, mostly, and cost search time.
    """
    height, width = silhouette.shape
    bottom = min(height, top + round(search_height * metre))
    coarse = silhouette[top:bottom:COARSE, ::COARSE].to(torch.float32)
    radius = round(0.05 * metre / COARSE)
    thick = window_max(window_min(coarse, radius), radius) > 0
    found = [thick.any(axis).nonzero()[:, 0] for axis in (1, 0)]
    if len(found[0]) == 0:
        return None
    margin = round(0.06 * metre)
    slices = [
        slice(
            max(0, int(index[0]) * COARSE + offset - margin),
            min(size, (int(index[-1]) + 1) * COARSE + offset + margin),
        )
        for index, offset, size in ((found[0], top, height), (found[1], 0, width))
    ]
    return slices[0], slices[1]


def _oval(
    box: Float[Tensor, "4"], image: Bool[Tensor, "height width"]
) -> tuple[tuple[slice, slice], Bool[Tensor, "part_height part_width"]]:
    """Where a box (x0, y0, x1, y1) lies in an image, and the ellipse that fits into it there."""
    height, width = image.shape
    x0, y0, x1, y1 = box.tolist()
    part = (
        slice(max(0, math.ceil(y0)), min(height, math.floor(y1) + 1)),
        slice(max(0, math.ceil(x0)), min(width, math.floor(x1) + 1)),
    )
    middle, half = 0.5 * (box[:2] + box[2:]), 0.5 * (box[2:] - box[:2])
    x = (torch.arange(part[1].start, part[1].stop, device=box.device, dtype=box.dtype) - middle[0]) / half[0]
    y = (torch.arange(part[0].start, part[0].stop, device=box.device, dtype=box.dtype) - middle[1]) / half[1]
    return part, x.square() + y.square()[:, None] <= 1
