"""Recordings at a lower resolution: the same scene by a camera of fewer pixels."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from torch.testing import assert_close

from torchpose.recording import Backgrounds, Frame, Recording
from torchpose.scaled import ScaledRecording, at_most
from torchpose.vision.camera import StereoCamera

STEREO = StereoCamera(80, 60, 70.0, 41.5, 28.0, 0.1)


class Fixed:
    """One frame and its empty scene."""

    def __init__(self, camera: StereoCamera, frame: Frame, background: Backgrounds) -> None:
        self.camera, self.frame, self.empty = camera, frame, background

    def __len__(self) -> int:
        return 1

    def __getitem__(self, position: int, /) -> Frame:
        return self.frame

    def background(self) -> Backgrounds:
        return self.empty


def stereo() -> Fixed:
    frame = Frame(7, 0.35, torch.rand(3, 60, 80), torch.rand(3, 60, 80))
    return Fixed(STEREO, frame, Backgrounds(torch.rand(2, 3, 60, 80), torch.rand(2, 3, 60, 80)))


def test_colour_is_opencvs_area_mean() -> None:
    whole = stereo()
    half = ScaledRecording(whole, 0.5)
    assert isinstance(half, Recording)
    assert (half.camera.width, half.camera.height, len(half)) == (40, 30, 1)
    frame = half[0]
    assert (frame.index, frame.time_s, frame.depth) == (7, 0.35, None)
    for ours, original in (
        (frame.left, whole.frame.left),
        (half.background().right[1], whole.empty.right[1]),
    ):
        pixels = np.ascontiguousarray(original.permute(1, 2, 0).numpy())
        expected = cv2.resize(pixels, (40, 30), interpolation=cv2.INTER_AREA)
        assert_close(ours, torch.from_numpy(expected).permute(2, 0, 1))


def test_a_point_keeps_its_place() -> None:
    """A bright spot of the large image lies where the small camera projects the same point; u and v differ."""
    camera, point = STEREO, torch.tensor([0.31, -0.17, 1.9])
    u, v = camera.project(point).tolist()
    y, x = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    spot = torch.exp(-((x - u) ** 2 + (y - v) ** 2) / 18).expand(3, 60, 80)
    small = ScaledRecording(Fixed(camera, Frame(0, 0.0, spot, spot), Backgrounds()), 0.5)
    image = small[0].left[0]
    rows, columns = torch.meshgrid(torch.arange(30.0), torch.arange(40.0), indexing="ij")
    centre = torch.stack([(image * columns).sum(), (image * rows).sum()]) / image.sum()
    assert_close(centre, small.camera.project(point), atol=0.05, rtol=0)


def test_depth_is_never_mixed() -> None:
    depth = torch.full((60, 80), 2.0)
    depth[:, 41:], depth[10:20, 10:20] = 5.0, torch.nan
    camera = replace(STEREO, baseline=None)
    small = ScaledRecording(Fixed(camera, Frame(0, 0.0, depth=depth), Backgrounds(depth=depth[None])), 0.4)
    found = small[0].depth
    assert found.shape == (24, 32)
    assert set(found[~found.isnan()].tolist()) == {2.0, 5.0}
    assert found[4:8, 4:8].isnan().all()
    assert_close(small.background().depth[0], found, equal_nan=True)
    assert small[0].left is None


def test_only_what_is_too_wide_is_shrunk() -> None:
    recording = stereo()
    assert at_most(recording, 80) is recording
    assert at_most(recording, 60).camera == STEREO.scaled(0.75)
    with pytest.raises(ValueError, match="factor must lie between 0 and 1, got 2"):
        ScaledRecording(recording, 2.0)
