"""Where the face is: Haar detector, skin colour and plausible shape, inside the silhouette (T. 3.2.1, 4.3.1).

Images are RGB in [0, 1]; boxes are pixels of the left image; positions are metres in the left camera's frame.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import kornia.color
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.vision.camera import StereoCamera
from torchpose.vision.windows import window_max, window_min

CASCADES = ("haarcascade_frontalface_alt2.xml", "haarcascade_profileface.xml")
STANDING_HEIGHT = 1.7  # m, tells the distance where depth does not
COARSE = 4  # px, step at which the silhouette is searched for a head


@dataclass(frozen=True)
class FaceConfig:
    """Settings of `FaceDetector`."""

    min_width: float = 0.12  # m, of a face's box
    max_width: float = 0.22  # m
    profile: bool = True  # look for profiles too, where no frontal face is found
    scale_step: float = 1.1  # ratio of successive sizes looked for
    min_neighbours: int = (
        1  # overlapping detections that make a face; colour, size and place are asked besides
    )
    face_pixels: int = (
        20  # px, width to which the narrowest face is scaled before the search: the cascade's own
    )
    search_height: float = 0.75  # m below the silhouette's top; a raised arm may be above the head
    max_hue: float = 0.9  # rad, skin is red to orange yellow: from -max_hue / 2 to max_hue
    min_saturation: float = 0.12
    min_value: float = 0.06  # dark skin in the shade; below, hue is noise
    min_skin: float = 0.4  # share of the face's pixels that must have the colour of skin
    min_inside: float = 0.75  # share of the face that must lie on the silhouette

    def __post_init__(self) -> None:
        if not 0 < self.min_width < self.max_width:
            raise ValueError(
                f"min_width must be positive and below max_width, got {self.min_width} and {self.max_width} m"
            )
        if not self.scale_step > 1:
            raise ValueError(f"scale_step must be above 1, got {self.scale_step}; 1.1 is usual")
        if self.face_pixels < 20:
            raise ValueError(f"face_pixels must be at least 20, the cascade's own, got {self.face_pixels}")
        if not self.search_height > 0:
            raise ValueError(f"search_height must be positive, got {self.search_height} m")
        for name in ("min_saturation", "min_value", "min_skin", "min_inside"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)}")


@dataclass(frozen=True)
class Faces:
    """At most one face a frame."""

    box: Float[Tensor, "batch 4"]  # px, x0, y0, x1, y1; NaN where none
    found: Bool[Tensor, " batch"]
    mask: Bool[Tensor, "batch height width"]  # face pixels: the box's ellipse on the silhouette
    position: Float[Tensor, "batch 3"]  # m, a point of the face's surface; NaN where none or without depth


class FaceDetector:
    """The face of the person whose silhouette is given."""

    def __init__(self, config: FaceConfig = FaceConfig()):
        self.config = config
        self._cascades = []
        for name in CASCADES[: 2 if config.profile else 1]:
            path = Path(cv2.__file__).parent / "data" / name
            cascade = cv2.CascadeClassifier(str(path))
            if cascade.empty():
                raise ValueError(f"the Haar cascade {path} cannot be read; install opencv-python-headless<5")
            self._cascades.append(cascade)

    def __call__(
        self,
        images: Float[Tensor, "batch 3 height width"],
        silhouette: Bool[Tensor, "batch mask_height mask_width"],
        depth: Float[Tensor, "batch depth_height depth_width"],
        camera: StereoCamera,
    ) -> Faces:
        """Faces in the upper part of the silhouette, of a width that is plausible at their depth.

        Args:
            images: (B, 3, H, W) in [0, 1].
            silhouette: (B, H, W) of one person a frame.
            depth: (B, H, W) m, NaN where unknown; the silhouette's height stands in for it.

        Raises:
            ValueError: the images do not have one size.
        """
        batch, _, height, width = images.shape
        if silhouette.shape != (batch, height, width) or depth.shape != (batch, height, width):
            raise ValueError(
                f"silhouette and depth must have the images' size {(batch, height, width)}, "
                f"got {tuple(silhouette.shape)} and {tuple(depth.shape)}"
            )
        box = depth.new_full((batch, 4), torch.nan)
        mask = torch.zeros_like(silhouette)
        position = depth.new_full((batch, 3), torch.nan)
        for index in range(batch):  # OpenCV takes one image at a time
            face = self._search(images[index], silhouette[index], depth[index], camera)
            if face is None:
                continue
            box[index] = depth.new_tensor(face)
            mask[index] = _ellipse(box[index], height, width) & silhouette[index]
            readings = depth[index][mask[index]]
            middle = 0.5 * (box[index, :2] + box[index, 2:])
            position[index] = camera.back_project(middle, readings.nanmedian())
        return Faces(box, ~box[:, 0].isnan(), mask, position)

    def _search(
        self,
        image: Float[Tensor, "3 height width"],
        silhouette: Bool[Tensor, "height width"],
        depth: Float[Tensor, "height width"],
        camera: StereoCamera,
    ) -> tuple[float, float, float, float] | None:
        """Box of the best face (x0, y0, x1, y1) px, None if there is none."""
        rows = silhouette.any(1).nonzero()[:, 0]
        if len(rows) == 0:
            return None
        distance = float(depth[silhouette].nanmedian())
        if not distance > 0:
            distance = camera.focal_length * STANDING_HEIGHT / (int(rows[-1]) - int(rows[0]) + 1)
        metre = camera.focal_length / distance  # px
        window = _head_window(silhouette, int(rows[0]), metre, self.config.search_height)
        if window is None:
            return None
        y0, x0, crop = window[0].start, window[1].start, (slice(None), *window)
        scale = self.config.face_pixels / (self.config.min_width * metre)
        grey = kornia.color.rgb_to_grayscale(image[None, crop[0], crop[1], crop[2]])[0, 0]
        shrunk = cv2.resize(
            (255 * grey).round().clamp(0, 255).byte().cpu().numpy(),
            None,
            fx=scale,
            fy=scale,
            interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR,
        )
        skin = _is_skin(image[crop], self.config)
        for profile, cascade in enumerate(self._cascades):
            best, most = None, 0
            for mirrored in (False, True)[: 1 + profile]:  # the cascade knows profiles to one side only
                view = np.ascontiguousarray(shrunk[:, ::-1]) if mirrored else shrunk
                for (x, y, w, h), votes in self._detect(cascade, view, metre * scale):
                    x = shrunk.shape[1] - x - w if mirrored else x
                    # The centre of the first pixel is 0 in both images, so its edge is what scales.
                    box = (
                        (x / scale) + x0 - 0.5,
                        (y / scale) + y0 - 0.5,
                        (x + w) / scale + x0 - 0.5,
                        (y + h) / scale + y0 - 0.5,
                    )
                    if votes > most and self._plausible(box, silhouette, depth, skin, window, camera, rows):
                        best, most = box, votes
            if best is not None:
                return best
        return None

    def _detect(
        self, cascade: cv2.CascadeClassifier, view: np.ndarray, metre: float
    ) -> list[tuple[tuple[int, int, int, int], int]]:
        """Boxes (x, y, w, h) of face-like patches with the number of overlapping hits of each."""
        least = max(20, int(0.9 * self.config.min_width * metre))
        most = max(least + 1, int(1.1 * self.config.max_width * metre))
        if min(view.shape) < least:
            return []
        boxes, votes = cascade.detectMultiScale2(
            view,
            scaleFactor=self.config.scale_step,
            minNeighbors=self.config.min_neighbours,
            minSize=(least, least),
            maxSize=(most, most),
        )
        return [
            ((int(x), int(y), int(w), int(h)), int(vote))
            for (x, y, w, h), vote in zip(boxes, votes, strict=True)
        ]

    def _plausible(
        self,
        box: tuple[float, float, float, float],
        silhouette: Bool[Tensor, "height width"],
        depth: Float[Tensor, "height width"],
        skin: Bool[Tensor, "crop_height crop_width"],
        window: tuple[slice, slice],
        camera: StereoCamera,
        rows: Tensor,
    ) -> bool:
        """Whether a box has a face's size, skin and place."""
        oval = _ellipse(depth.new_tensor(box), *silhouette.shape)
        inside = oval & silhouette
        area = int(oval.sum())
        if area == 0 or int(inside.sum()) < self.config.min_inside * area:
            return False
        distance = float(depth[inside].nanmedian())
        width = (box[2] - box[0]) * distance / camera.focal_length
        if distance > 0 and not self.config.min_width <= width <= self.config.max_width:
            return False
        if 0.5 * (box[1] + box[3]) > 0.5 * (int(rows[0]) + int(rows[-1])):
            return False  # a face is in the upper half
        return int((skin & inside[window]).sum()) >= self.config.min_skin * int(inside.sum())


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


def _is_skin(image: Float[Tensor, "3 height width"], config: FaceConfig) -> Bool[Tensor, "height width"]:
    """Pixels that have the hue of skin; light and dark skin differ in value, hardly in hue."""
    hue, saturation, value = kornia.color.rgb_to_hsv(image[None])[0]  # hue in radians, 0 to 2 pi
    red = (hue <= config.max_hue) | (hue >= 2 * torch.pi - 0.5 * config.max_hue)
    return red & (saturation >= config.min_saturation) & (value >= config.min_value)


def _ellipse(box: Float[Tensor, "4"], height: int, width: int) -> Bool[Tensor, "{height} {width}"]:
    """The pixels of the ellipse that fits into a box (x0, y0, x1, y1)."""
    middle, half = 0.5 * (box[:2] + box[2:]), 0.5 * (box[2:] - box[:2])
    x = (torch.arange(width, device=box.device, dtype=box.dtype) - middle[0]) / half[0]
    y = (torch.arange(height, device=box.device, dtype=box.dtype) - middle[1]) / half[1]
    return x.square() + y.square()[:, None] <= 1
