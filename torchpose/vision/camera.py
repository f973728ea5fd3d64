"""Pinhole geometry of a rectified stereo pair or a depth camera, and the rectification of a raw pair.

Left-camera frame (x right, y down, z forward), metres. Pixels (u, v) are column and row; an integer is a
pixel's centre.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

# k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]]: the lengths that OpenCV knows.
DISTORTION_LENGTHS = (4, 5, 8, 12, 14)
RAW_KEYS = ("K1", "D1", "K2", "D2", "R", "T")  # OpenCV's names of what is known of a raw pair


@dataclass(frozen=True)
class StereoCamera:
    """A rectified pair of pinhole cameras, or a depth camera where there is no baseline.

    Both images of a pair share the focal length and the principal point, and a point lies on the same row of
    both. Plain numbers, so there is nothing to move between devices. Any leading axes, any float dtype.
    """

    width: int  # px
    height: int  # px
    focal_length: float  # px, the same along rows and columns
    cx: float  # px, principal point's column
    cy: float  # px, principal point's row
    baseline: float | None = None  # m, from the left to the right camera; None: a depth camera
    frame_rate: float = 20.0  # Hz

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            if getattr(self, name) < 1:
                raise ValueError(
                    f"{name} must be at least 1 px, got {getattr(self, name)}; check the image size"
                )
        for name, unit in (("focal_length", "px"), ("frame_rate", "Hz")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(
                    f"{name} must be a positive number of {unit}, got {value}; check the calibration"
                )
        if self.baseline is not None and not (math.isfinite(self.baseline) and self.baseline > 0):
            raise ValueError(
                f"baseline must be a positive number of m, got {self.baseline}; "
                "give the distance from the left to the right camera, or none for a depth camera"
            )
        for name, size in (("cx", self.width), ("cy", self.height)):
            value = getattr(self, name)
            if not -0.5 <= value <= size - 0.5:  # the outer edges of the first and the last pixel
                raise ValueError(
                    f"{name} must lie inside the image, 0 to {size - 1} px, got {value}; "
                    "check the principal point and the image size"
                )

    def project(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Pixels (u, v) of points (m): u = f X / Z + cx, v = f Y / Z + cy; NaN where Z is not positive."""
        x, y, z = points.unbind(-1)
        scale = self.focal_length / torch.where(z > 0, z, torch.nan)
        return torch.stack([x * scale + self.cx, y * scale + self.cy], dim=-1)

    def back_project(
        self, pixels: Float[Tensor, "*batch 2"], depth: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch 3"]:
        """Points (m) at pixels (u, v) with depth Z (m): (3.2) of T., plus the principal point."""
        u, v = pixels.unbind(-1)
        scale = depth / self.focal_length
        return torch.stack([(u - self.cx) * scale, (v - self.cy) * scale, depth], dim=-1)

    def depth(self, disparity: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Depth Z = f b / d (m) of a disparity (px), (3.1) of T.; NaN where the disparity is not positive."""
        return self._focal_baseline() / torch.where(disparity > 0, disparity, torch.nan)

    def disparity(self, depth: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Disparity d = f b / Z (px) of a depth (m); NaN where the depth is not positive."""
        return self._focal_baseline() / torch.where(depth > 0, depth, torch.nan)

    def scaled(self, factor: float) -> "StereoCamera":
        """The camera of the images resized by `factor`, corner on corner as `cv2.resize` does.

        The size is rounded to whole pixels; the rest is exact: cx + 1/2 is what scales, as cx counts from
        the centre of the first pixel.
        """
        if not (math.isfinite(factor) and factor > 0):
            raise ValueError(f"factor must be positive, got {factor}; 0.5 halves the image")
        return replace(
            self,
            width=round(self.width * factor),
            height=round(self.height * factor),
            focal_length=self.focal_length * factor,
            cx=(self.cx + 0.5) * factor - 0.5,
            cy=(self.cy + 0.5) * factor - 0.5,
        )

    def _focal_baseline(self) -> float:
        if self.baseline is None:
            raise ValueError("disparity needs a baseline, but this camera has none")
        return self.focal_length * self.baseline


@dataclass(frozen=True, eq=False)
class RawStereo:
    """Calibration of a raw pair as OpenCV writes it: X_right = R X_left + T, T in metres.

    `K1, K2` are 3 x 3 camera matrices, `D1, D2` distortions of 4, 5, 8, 12 or 14 coefficients; `R` (3 x 3)
    and `T` (3) lead from the left camera's frame into the right's. Rows, columns and flat vectors are alike.
    """

    K1: np.ndarray
    D1: np.ndarray
    K2: np.ndarray
    D2: np.ndarray
    R: np.ndarray
    T: np.ndarray
    image_size: tuple[int, int]  # px, width and height, of both images
    frame_rate: float = 20.0  # Hz

    def __post_init__(self) -> None:
        for name in RAW_KEYS:
            value = getattr(self, name).astype(np.float64)
            if not np.isfinite(value).all():
                raise ValueError(f"{name} must be finite, got {value.tolist()}; check the calibration")
            if name in ("D1", "D2", "T"):
                value = value.reshape(-1)  # OpenCV writes them as rows or columns
            object.__setattr__(self, name, value)
        if len(self.image_size) != 2 or min(self.image_size) < 1:
            raise ValueError(
                f"image_size must be a width and a height in px, got {self.image_size}; check the calibration"
            )
        for name in ("K1", "K2"):
            matrix = getattr(self, name)
            if (
                matrix.shape != (3, 3)
                or matrix[0, 0] <= 0
                or matrix[1, 1] <= 0
                or (matrix[2] != (0, 0, 1)).any()
            ):
                raise ValueError(
                    f"{name} must be a 3 x 3 camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with "
                    f"positive fx and fy, got {matrix.tolist()}; check the calibration"
                )
        for name in ("D1", "D2"):
            if (length := getattr(self, name).size) not in DISTORTION_LENGTHS:
                raise ValueError(
                    f"{name} must have 4, 5, 8, 12 or 14 coefficients, got {length}; "
                    "fill a shorter set up with zeros"
                )
        if (
            self.R.shape != (3, 3)
            or not np.allclose(self.R @ self.R.T, np.eye(3), atol=1e-3)
            or np.linalg.det(self.R) < 0
        ):
            raise ValueError(f"R must be a 3 x 3 rotation, got {self.R.tolist()}; check the calibration")
        if self.T.size != 3 or self.T[0] >= 0 or abs(self.T[0]) < abs(self.T[1:]).max():
            raise ValueError(
                "T must be 3 numbers in m that lead to a right camera beside the left, so mainly along -x, "
                f"got {self.T.tolist()}; exchange the cameras if the first number is positive"
            )

    @cached_property
    def camera(self) -> StereoCamera:
        """The rectified camera, which takes the images that `rectify` returns."""
        projection = self._rectification[2]
        return StereoCamera(
            width=self.image_size[0],
            height=self.image_size[1],
            focal_length=float(projection[0, 0]),
            cx=float(projection[0, 2]),
            cy=float(projection[1, 2]),
            baseline=float(-projection[0, 3] / projection[0, 0]),
            frame_rate=self.frame_rate,
        )

    def values(self) -> dict[str, Any]:
        """The calibration as plain numbers and lists, as a file holds it."""
        keys = {key: getattr(self, key).tolist() for key in RAW_KEYS}
        return {"image_size": list(self.image_size), "frame_rate": self.frame_rate, **keys}

    def rectify_pixels(
        self, left: Float[np.ndarray, "*batch 2"], right: Float[np.ndarray, "*batch 2"]
    ) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch 2"]]:
        """Raw pixels (u, v) of both images as the rectified images show them, px: what `rectify_maps` undoes."""
        left_rotation, right_rotation, projection = self._rectification

        def rectified(
            pixels: np.ndarray, matrix: np.ndarray, distortion: np.ndarray, rotation: np.ndarray
        ) -> np.ndarray:
            points = pixels.reshape(-1, 1, 2).astype(np.float64)
            found = cv2.undistortPoints(points, matrix, distortion, R=rotation, P=projection[:, :3])
            return found.reshape(pixels.shape)

        return (
            rectified(left, self.K1, self.D1, left_rotation),
            rectified(right, self.K2, self.D2, right_rotation),
        )

    def rectify_maps(self) -> tuple[Float[np.ndarray, "height width 2"], Float[np.ndarray, "height width 2"]]:
        """Raw pixel (u, v) of each pixel of the rectified left and right image, as `cv2.remap` takes them."""
        return self._maps

    def rectify(
        self,
        left: Float[Tensor, "batch channels height width"],
        right: Float[Tensor, "batch channels height_right width_right"],
    ) -> tuple[
        Float[Tensor, "batch channels height width"],
        Float[Tensor, "batch channels height width"],
        StereoCamera,
    ]:
        """Resample raw images bilinearly, so that a point lies on the same row of both.

        Returns the rectified left and right images, on the device of the raw ones, and their `camera`. Raises
        ValueError where the images' size is not the calibration's.
        """
        size = (self.image_size[1], self.image_size[0])
        for name, image in (("left", left), ("right", right)):
            if image.shape[-2:] != size:
                raise ValueError(
                    f"the {name} image must have the calibration's size {size[1]} x {size[0]}, "
                    f"got {image.shape[-1]} x {image.shape[-2]}; use the calibration of this recording"
                )
        rectified_left, rectified_right = (
            _resample(image, torch.from_numpy(pixels).to(image))
            for image, pixels in zip((left, right), self._maps, strict=True)
        )
        return rectified_left, rectified_right, self.camera

    @cached_property
    def _rectification(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rotations of the left and right camera into their common frame (3, 3); right projection (3, 4)."""
        # alpha = 0 zooms until no pixel is blank; zero disparity makes both principal points the same.
        left, right, _, projection, *_ = cv2.stereoRectify(
            self.K1,
            self.D1,
            self.K2,
            self.D2,
            self.image_size,
            self.R,
            self.T,
            flags=cv2.CALIB_ZERO_DISPARITY,
            alpha=0,
        )
        return left, right, projection

    @cached_property
    def _maps(self) -> tuple[np.ndarray, np.ndarray]:
        left, right, projection = self._rectification

        def pixels(matrix: np.ndarray, distortion: np.ndarray, rotation: np.ndarray) -> np.ndarray:
            columns, rows = cv2.initUndistortRectifyMap(
                matrix, distortion, rotation, projection[:, :3], self.image_size, cv2.CV_32FC1
            )
            return np.stack([columns, rows], axis=-1)

        return pixels(self.K1, self.D1, left), pixels(self.K2, self.D2, right)


def _resample(
    images: Float[Tensor, "batch channels height width"], pixels: Float[Tensor, "height width 2"]
) -> Float[Tensor, "batch channels height width"]:
    """Bilinear values of the images at pixels (u, v), 0 outside."""
    size = pixels.new_tensor([images.shape[-1], images.shape[-2]])
    grid = (pixels * 2 + 1) / size - 1  # -1 and 1 are the outer edges of the first and the last pixel
    return F.grid_sample(
        images,
        grid.expand(images.shape[0], -1, -1, -1),
        mode="bilinear",
        padding_mode="zeros",
        align_corners=False,
    )
