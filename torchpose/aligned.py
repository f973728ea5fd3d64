"""A recording whose right images are moved onto the rows of the left ones, as a rig's calibration should have done."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.recording import Backgrounds, Frame, Recording, readable_frames, spread_positions
from torchpose.vision.alignment import Alignment, align_rows, measure_alignment

MEASURED = 6  # frames over the recording by whose matches it is corrected
MEASURED_EMPTY = 2  # frames of the empty scene, which shows what a person hides
WORTH = 0.8  # of the distance between the rows; what leaves more is no correction

Image = Float[Tensor, "3 height width"]


class AlignedRecording:
    """Another recording, the rows of its right images moved onto the left's as they are read.

    `alignment` is that of the other recording, see `align_rows`. Left images, depth and the camera are as they were.
    """

    def __init__(self, recording: Recording, alignment: Alignment) -> None:
        self.recording, self.alignment = recording, alignment
        self.camera = recording.camera

    def __len__(self) -> int:
        return len(self.recording)

    def __getitem__(self, position: int, /) -> Frame:
        """The frame at `position`, 0 to len - 1. Raises UnreadableFrame as the recording does."""
        frame = self.recording[position]
        if frame.right is None:
            return frame
        return replace(frame, right=align_rows(frame.right[None], self.alignment)[0])

    def background(self) -> Backgrounds:
        """The frames of the empty scene, if there are any."""
        found = self.recording.background()
        if found.right is None:
            return found
        return replace(found, right=align_rows(found.right, self.alignment))


def align_recording(recording: Recording) -> Recording:
    """The recording with its rows corrected by what a few of its frames tell; itself where they are good.

    Itself, too, for a depth camera, where too few points are seen in both images, and where moving them leaves the
    rows of these frames apart.
    """
    if recording.camera.baseline is None:
        return recording
    pairs = _pairs(recording)
    if not pairs:
        return recording
    left, right = (torch.stack(images) for images in zip(*pairs, strict=True))
    alignment = measure_alignment(left, right)
    if alignment.model is None:
        return recording
    corrected = measure_alignment(left, align_rows(right, alignment))
    worth = corrected.typical < WORTH * alignment.typical
    return AlignedRecording(recording, alignment) if worth else recording


def _pairs(recording: Recording) -> list[tuple[Image, Image]]:
    """Left and right images spread over the recording, and some of the empty scene."""
    frames = readable_frames(recording, spread_positions(len(recording), MEASURED))
    pairs = [(f.left, f.right) for f in frames if f.left is not None and f.right is not None]
    empty = recording.background()
    if empty.left is not None and empty.right is not None:
        count = min(len(empty.left), len(empty.right))
        pairs += [(empty.left[i], empty.right[i]) for i in spread_positions(count, MEASURED_EMPTY)]
    return pairs
