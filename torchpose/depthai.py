"""Calibrations of OAK cameras, as DepthAI keeps them in the camera's memory and writes them to a JSON file.

Its translations are in centimetres, ours in metres.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from torchpose.vision.camera import RawStereo

_LEFT, _RIGHT = 1, 2  # sockets of an OAK-D's pair, where the file does not name them
_PERSPECTIVE = 0  # the camera type that has OpenCV's distortion
_CM = 0.01  # m
_ASPECT_TOLERANCE = 0.01  # relative, for sizes that were rounded to whole pixels


def depthai_stereo(
    values: Mapping[str, Any], frame_rate: float, image_size: tuple[int, int] | None = None
) -> RawStereo:
    """The stereo pair of a DepthAI calibration (`calib.json`, the EEPROM's `cameraData`).

    Each camera has intrinsics for its own width and height, up to 14 distortion coefficients in OpenCV's
    order, and extrinsics X_next = R X + t (cm) to another socket; left and right may meet at a third.

    Args:
        values: the file's content.
        frame_rate: Hz; the file has none.
        image_size: width and height of the images, px, if they were made smaller or larger than the
            calibration's; the intrinsics scale along.

    Raises ValueError where a value is missing or makes no sense, or where the images have another shape.
    """
    try:
        cameras = {int(socket): camera for socket, camera in values["cameraData"]}
        sockets = values.get("stereoRectificationData") or {}
        left, right = (
            int(sockets.get(f"{side}CameraSocket", default))
            for side, default in (("left", _LEFT), ("right", _RIGHT))
        )
        for side, socket in (("left", left), ("right", right)):
            if socket not in cameras:
                raise ValueError(
                    f"the {side} camera must be one of cameraData, got socket {socket} and the sockets "
                    f"{sorted(cameras)}; read the calibration of a stereo camera"
                )
            if cameras[socket].get("cameraType", _PERSPECTIVE) != _PERSPECTIVE:
                raise ValueError(
                    f"the {side} camera must be a perspective one (cameraType 0), got cameraType "
                    f"{cameras[socket]['cameraType']}; a fisheye lens is not supported"
                )
        width, height = int(cameras[left]["width"]), int(cameras[left]["height"])
        if (int(cameras[right]["width"]), int(cameras[right]["height"])) != (width, height):
            raise ValueError(
                f"both cameras must have one size, got {width} x {height} and {cameras[right]['width']} x "
                f"{cameras[right]['height']}; read the calibration of a stereo camera"
            )
        size = image_size or (width, height)
        scale = _scale((width, height), size)
        matrices = [scale @ np.array(cameras[socket]["intrinsicMatrix"], float) for socket in (left, right)]
        distortions = [np.array(cameras[socket]["distortionCoeff"], float) for socket in (left, right)]
        left_root, left_end = _to_root(cameras, left)
        right_root, right_end = _to_root(cameras, right)
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"a DepthAI calibration must have cameraData with intrinsicMatrix, distortionCoeff, extrinsics, width and "
            f"height for each socket, got {error!r} amiss; write it anew by DepthAI"
        ) from None
    if left_end != right_end:
        raise ValueError(
            f"the extrinsics of both cameras must lead to one socket, got {left_end} from the left and {right_end} "
            "from the right; calibrate the camera"
        )
    between = np.linalg.inv(right_root) @ left_root
    return RawStereo(
        *(matrices[0], distortions[0], matrices[1], distortions[1]),
        *(between[:3, :3], between[:3, 3], size, frame_rate),
    )


def _scale(size: tuple[int, int], wanted: tuple[int, int]) -> Float[np.ndarray, "3 3"]:
    """What turns a pixel of an image of `size` into the pixel of the same image resized; centres are integers."""
    x, y = wanted[0] / size[0], wanted[1] / size[1]
    if abs(x / y - 1) > _ASPECT_TOLERANCE:
        raise ValueError(
            f"the images must have the shape of the calibration's {size[0]} x {size[1]}, got {wanted[0]} x "
            f"{wanted[1]}; record without cropping"
        )
    return np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1]])


def _to_root(cameras: Mapping[int, Any], socket: int) -> tuple[Float[np.ndarray, "4 4"], int]:
    """The motion (m) from a camera's frame to that of the socket at the end of its chain, and this socket."""
    motion = np.eye(4)
    for _ in range(len(cameras)):
        extrinsics = cameras[socket]["extrinsics"]
        following = int(extrinsics["toCameraSocket"])
        if following not in cameras:
            return motion, socket
        step = np.eye(4)
        step[:3, :3] = extrinsics["rotationMatrix"]
        step[:3, 3] = [_CM * extrinsics["translation"][axis] for axis in "xyz"]
        motion, socket = step @ motion, following
    raise ValueError(
        f"the extrinsics must lead from socket to socket to an end, got a ring at {socket}; calibrate the camera"
    )
