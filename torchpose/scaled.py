"""A recording with smaller images: what a camera of many pixels shows, at the cost of one of few."""

from dataclasses import replace

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from torchpose.recording import Backgrounds, Frame, Recording


class ScaledRecording:
    """Another recording, its images shrunk by one factor as they are read.

    Colour is averaged over the area of a new pixel. Depth is taken from one old pixel, since a mean over an edge
    would lie where nothing is.
    """

    def __init__(self, recording: Recording, factor: float) -> None:
        if not 0 < factor < 1:
            raise ValueError(f"factor must lie between 0 and 1, got {factor}; 0.5 halves the images")
        self.recording = recording
        self.camera = recording.camera.scaled(factor)

    def __len__(self) -> int:
        return len(self.recording)

    def __getitem__(self, position: int, /) -> Frame:
        """The frame at `position`, 0 to len - 1. Raises UnreadableFrame as the recording does."""
        frame = self.recording[position]
        return replace(
            frame,
            left=self._shrunk(frame.left, "area"),
            right=self._shrunk(frame.right, "area"),
            depth=self._shrunk(frame.depth, "nearest-exact"),
        )

    def background(self) -> Backgrounds:
        """The frames of the empty scene, if there are any."""
        found = self.recording.background()
        return Backgrounds(
            self._shrunk(found.left, "area"),
            self._shrunk(found.right, "area"),
            self._shrunk(found.depth, "nearest-exact"),
        )

    def _shrunk(
        self, images: Float[Tensor, "*shape height width"] | None, mode: str
    ) -> Float[Tensor, "*shape h w"] | None:
        if images is None:
            return None
        size = (self.camera.height, self.camera.width)
        planes = images.reshape(1, -1, *images.shape[-2:])
        return F.interpolate(planes, size, mode=mode).reshape(*images.shape[:-2], *size)


def at_most(recording: Recording, width: int) -> Recording:
    """The recording with images of at most `width` px, itself if they are."""
    if recording.camera.width <= width:
        return recording
    return ScaledRecording(recording, width / recording.camera.width)
