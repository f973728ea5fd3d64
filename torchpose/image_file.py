"""Image files: colour, and depth as 16 bit PNG; read whole or not at all, and found by their numbers.

Images are RGB, float32 in [0, 1], (3, H, W); depth is in metres, (H, W), NaN where there is no reading. On the CPU.
"""

import re
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchpose.atomic import replacing

DEPTH_UNIT = 0.001  # m, of the depth images that are written
_JPEG_QUALITY = 95
_FRAME_NAME = r"(\d+)\.(?:jpg|jpeg|png)"


def numbered_files(folder: Path, prefix: str = "") -> dict[int, Path]:
    """The images named `prefix` and a number in a folder, by number; {} where there is no such folder."""
    files: dict[int, Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        match = re.fullmatch(prefix + _FRAME_NAME, path.name, re.IGNORECASE)
        if match is None:
            continue
        number = int(match[1])
        if number in files:
            raise ValueError(
                f"every number must stand for one image, got {files[number].name} and {path.name} in "
                f"{folder}; remove one of them"
            )
        files[number] = path
    return files


def decode(path: Path, flags: int = cv2.IMREAD_UNCHANGED) -> np.ndarray:
    """The pixels of an image file, as OpenCV orders them; ValueError where the file is damaged or cut off."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path} must be readable, got {error.strerror}; replace the file") from None
    # The decoders fill up what is missing at the end of a file with grey, so look for the end itself.
    end, start = (b"IEND", 0) if data.startswith(b"\x89PNG") else (b"\xff\xd9", data.rfind(b"\xff\xda") + 1)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if end in data[start:] else None
    if image is None:
        raise ValueError(
            f"{path} must be a whole JPEG or PNG image, got {len(data)} bytes that are not; copy it again"
        )
    return image


def read_colour(path: Path) -> Float[Tensor, "3 height width"]:
    """The image in a JPEG or PNG file, as RGB in [0, 1]; ValueError where the file is damaged."""
    # The calibration is of the sensor's rows and columns, whatever the file says of its orientation.
    return to_colour(decode(path, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION))


def to_colour(pixels: UInt8[np.ndarray, "height width 3"]) -> Float[Tensor, "3 height width"]:
    """RGB bytes as RGB in [0, 1]."""
    return torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1).float().div(255)


def read_depth(path: Path, unit: float) -> Float[Tensor, "height width"]:
    """The depth in a 16 bit PNG file, m; `unit` is the metres in a step, and 0 is no reading.

    Raises ValueError where the file is damaged or holds another kind of image.
    """
    steps = decode(path)
    if steps.dtype != np.uint16 or steps.ndim != 2:
        raise ValueError(
            f"{path} must be a depth image of one channel of uint16, got {steps.dtype} of shape "
            f"{steps.shape}; write it as a 16 bit grey PNG"
        )
    depth = torch.from_numpy(steps.astype(np.float32)) * unit
    return depth.masked_fill(depth == 0, torch.nan)


def write_image(path: Path, image: Tensor | None, suffix: str) -> None:
    """Write colour (3, H, W) as `suffix`, .png or .jpg, or depth (H, W), m, as PNG; nothing where there is no image.

    The file appears whole. What depth does not fit into 16 bits of `DEPTH_UNIT` becomes no reading.
    """
    if image is None:
        return
    image = image.detach().cpu()
    if image.ndim == 2:
        steps = (image / DEPTH_UNIT).round()
        # 0 is no reading; so is what does not fit into 16 bits.
        steps = steps.where((steps > 0) & (steps < 2**16), 0)
        suffix, pixels = ".png", steps.numpy().astype(np.uint16)
    else:
        levels = (image.clamp(0, 1) * 255).round().byte()
        pixels = np.ascontiguousarray(levels.permute(1, 2, 0).numpy()[..., ::-1])
    encode(path.with_suffix(suffix), pixels)


def encode(path: Path, pixels: np.ndarray) -> None:
    """Write pixels, as OpenCV orders them, as the kind of image that the path's suffix says; the file appears whole."""
    # OpenCV complains on stderr of a setting that the other format does not know.
    settings = [] if path.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    _, data = cv2.imencode(path.suffix, pixels, settings)
    with replacing(path) as partial:
        partial.write_bytes(data.tobytes())
