"""A recording of benchmarks.people turned to begin with an empty room and to end with the person's leaving.

Made of the recording's own pictures: `EMPTY` frames of the empty room (the mean of its background frames) with fresh
sensor noise; the frames as they are; `OUT` frames in which the person goes out of the image sideways; `EMPTY` frames of
the empty room again. For the way out the last frames are played backwards, so that the legs go on walking, and the
person's pixels, by the true masks, are moved sideways over the empty room, slowly first and then by `STEP` px a frame,
in both eyes alike: a move sideways at the same depth. The right eye's mask is the left one's, moved by the true
disparity. Shadows stay away, and the person is seen from the side as from the front.
"""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose.recording import FolderRecording, Frame, open_recording, write_recording
from torchpose.synthesis.motion import random_stream
from torchpose.vision.camera import StereoCamera

EMPTY = 30  # frames, before and after
OUT = 40  # frames at most
STEP = 16.0  # px a frame: 1.1 m/s at 2.5 m and 20 Hz
SLOW = 10  # frames, until it goes that fast


def turn_around(source: Path, folder: Path) -> dict[str, list]:
    """Write the turned recording of `source` into `folder`.

    Returns for each frame `seen`, how many pixels of the person are in the image, `border`, how many of these lie on
    the image's border, and `source`, the frame of the given recording, -1 in an empty room.
    """
    recording = open_recording(source)
    assert isinstance(recording, FolderRecording)
    known: dict[str, list] = {"seen": [], "border": [], "source": []}
    frames = _frames(recording, source, known)
    # The background frames are those given, of which the empty frames are not copies.
    write_recording(folder, recording.camera, frames, recording.background(), ".jpg")
    return known


def _frames(recording: FolderRecording, source: Path, known: dict[str, list]) -> Iterator[Frame]:
    camera, empty = recording.camera, recording.background()
    assert empty.left is not None
    assert empty.right is not None
    room = (empty.left.mean(0), empty.right.mean(0))
    # What a new frame differs by from the mean of two: the noise of the one and half of that of each of the two.
    sd = (
        1.5**0.5
        * float(torch.stack([empty.left[0] - empty.left[1], empty.right[0] - empty.right[1]]).std())
        / 2**0.5
    )
    number = 0

    def made(left: Tensor, right: Tensor, mask: Tensor | None, origin: int) -> Frame:
        nonlocal number
        rim = (
            0 if mask is None else int(mask[0].sum() + mask[-1].sum() + mask[:, 0].sum() + mask[:, -1].sum())
        )
        known["seen"].append(0 if mask is None else int(mask.sum()))
        known["border"].append(rim)
        known["source"].append(origin)
        number += 1
        return Frame(number - 1, (number - 1) / camera.frame_rate, left, right)

    def bare() -> tuple[Tensor, Tensor]:
        return _noisy(room[0], sd, number, 0), _noisy(room[1], sd, number, 1)

    for _ in range(EMPTY):
        yield made(*bare(), None, -1)
    for i, frame in enumerate(recording):
        assert frame.left is not None
        assert frame.right is not None
        yield made(frame.left, frame.right, _masks(source, i, camera)[0], i)
    shift = 0.0
    for k in range(OUT):
        shift += STEP * min(1.0, (k + 1) / SLOW)
        i = len(recording) - 2 - k
        frame, masks = recording[i], _masks(source, i, camera)
        assert frame.left is not None
        assert frame.right is not None
        # To the side that is nearer.
        columns = masks[0].any(0).nonzero()[:, 0]
        way = 1 if float(columns.float().mean()) > camera.width / 2 else -1
        if k == 0:
            toward = way
        by = toward * round(shift)
        left, right = bare()
        left = _over(left, _moved(frame.left, by), _moved(masks[0], by))
        right = _over(right, _moved(frame.right, by), _moved(masks[1], by))
        mask = _moved(masks[0], by)
        if not mask.any():
            break
        yield made(left, right, mask, i)
    for _ in range(EMPTY):
        yield made(*bare(), None, -1)


def _noisy(image: Float[Tensor, "3 height width"], sd: float, number: int, eye: int) -> Tensor:
    """An image with noise of its own, of 8 bits."""
    noise = torch.randn(image.shape, generator=random_stream("empty room", number, eye))
    return ((image + sd * noise).clamp(0, 1) * 255).round() / 255


def _masks(source: Path, index: int, camera: StereoCamera) -> tuple[Tensor, Tensor]:
    """Where the person is in the left image, by the true labels, and in the right one, by the true disparity."""
    labels = cv2.imread(str(source / "truth" / f"{index:06d}_label.png"), cv2.IMREAD_UNCHANGED)
    depth = cv2.imread(str(source / "truth" / f"{index:06d}_depth.png"), cv2.IMREAD_UNCHANGED)
    if labels is None or depth is None:
        raise ValueError(f"{source / 'truth'} must hold the labels and the depth of frame {index}")
    assert camera.baseline is not None
    # Depth mixes person and room at the rim: the nearer one of the neighbours is the person's.
    near = cv2.erode(np.where(depth > 0, depth, 65535).astype(np.uint16), np.ones((3, 3), np.uint8))
    v, u = np.nonzero(labels)
    to = np.round(u - camera.focal_length * camera.baseline * 1000 / near[v, u]).astype(int)
    right = np.zeros(labels.shape, np.uint8)
    inside = (to >= 0) & (to < labels.shape[1])
    right[v[inside], to[inside]] = 1
    closed = cv2.morphologyEx(right, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    return torch.from_numpy(labels > 0), torch.from_numpy(closed > 0)


def _moved(image: Tensor, columns: int) -> Tensor:
    """An image or a mask moved to the right (or to the left, negative); what comes in is 0."""
    moved = torch.zeros_like(image)
    width = image.shape[-1]
    if abs(columns) >= width:
        return moved
    if columns >= 0:
        moved[..., columns:] = image[..., : width - columns]
    else:
        moved[..., :columns] = image[..., -columns:]
    return moved


def _over(
    image: Float[Tensor, "3 height width"],
    picture: Float[Tensor, "3 height width"],
    mask: Bool[Tensor, "height width"],
) -> Float[Tensor, "3 height width"]:
    """A picture over an image where the mask says so, with a soft rim."""
    soft = torch.from_numpy(cv2.GaussianBlur(mask.float().numpy(), (3, 3), 0.7))
    return image + soft * mask * (picture - image)
