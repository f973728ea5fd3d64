"""Recordings that the package makes itself, read like any other: rendered people before a stereo camera.

Left-camera frame (x right, y down, z forward); metres, seconds. Images are multiples of 1/255.
"""

from collections.abc import Iterator

import torch
from torch import Tensor

from torchpose.recording import Backgrounds, Frame
from torchpose.synthesis.database import SyntheticRecording, make_demo
from torchpose.vision.camera import StereoCamera


class RenderedRecording:
    """A synthetic recording as a `Recording`: each frame is rendered when it is first asked for, and kept.

    What is kept are bytes, as in an image file, so nothing is lost. The truth stays in `synthetic`.
    """

    def __init__(self, synthetic: SyntheticRecording, num_backgrounds: int = 2) -> None:
        if num_backgrounds < 0:
            raise ValueError(f"num_backgrounds must be 0 or more, got {num_backgrounds}; 0 gives none")
        self.synthetic = synthetic
        self._num_backgrounds = num_backgrounds
        self._rendered: dict[int, Tensor] = {}  # (2, 3, H, W) bytes, left and right

    @property
    def camera(self) -> StereoCamera:
        return self.synthetic.camera

    def __len__(self) -> int:
        return len(self.synthetic)

    def __iter__(self) -> Iterator[Frame]:
        return (self[position] for position in range(len(self)))

    def __getitem__(self, position: int, /) -> Frame:
        """The frame at `position`, 0 to len - 1 (or from the end, -1 to -len)."""
        index = range(len(self))[position]
        if index not in self._rendered:
            frames = self.synthetic.frames(index, index + 1)
            pair = torch.cat([frames.left, frames.right])
            self._rendered[index] = (pair * 255).round().byte()
        left, right = self._rendered[index].float().div(255)
        return Frame(index, index / self.camera.frame_rate, left, right)

    def background(self) -> Backgrounds:
        """Frames of the empty room."""
        if self._num_backgrounds == 0:
            return Backgrounds()
        return Backgrounds(*self.synthetic.background(self._num_backgrounds))


def demo_recording(seed: int = 0) -> RenderedRecording:
    """What `python infer.py` runs without a recording, see `make_demo`."""
    return RenderedRecording(make_demo(seed))
