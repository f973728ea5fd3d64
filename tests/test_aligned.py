"""Recordings whose rows are moved together: which are, what of them is, and what `infer.py` says of it."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from torchpose import aligned
from torchpose.aligned import AlignedRecording, align_recording
from torchpose.cli import infer_main
from torchpose.recording import Backgrounds, Frame, Recording, UnreadableFrame, write_recording
from torchpose.synthesis.database import make_recording, synthetic_camera
from torchpose.vision.alignment import align_rows, measure_alignment
from torchpose.vision.camera import StereoCamera

CAMERA = StereoCamera(320, 240, 350.0, 160.0, 120.0, 0.1)
SHIFT = 2  # px
BROKEN = 3


class Fixed:
    """Frames held in memory, of which one cannot be read; counts which were asked for."""

    def __init__(self, frames: list[Frame], empty: Backgrounds, camera: StereoCamera = CAMERA) -> None:
        self.frames, self.empty, self.camera = frames, empty, camera
        self.read: list[int] = []

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, position: int, /) -> Frame:
        self.read.append(position)
        if position == BROKEN:
            raise UnreadableFrame("frame 3 cannot be read", 3, 0.15)
        return self.frames[position]

    def background(self) -> Backgrounds:
        return self.empty


def texture() -> Tensor:
    """Blobs of about 6 px, which corners are found on."""
    noise = F.avg_pool2d(torch.rand(1, 3, 300, 400), 5, 1)[0]
    return ((noise - 0.5) * 5 + 0.5).clamp(0, 1)


def seen(shift: int) -> tuple[Tensor, Tensor]:
    """A pair of which the right image lies `shift` px lower."""
    wall = texture()
    return wall[:, 20:260, 20:340], wall[:, 20 - shift : 260 - shift, 32:352]


def recording(shift: int = SHIFT, empty_shift: int | None = None, length: int = 12) -> Fixed:
    pairs = [seen(shift) for _ in range(length + 3)]
    frames = [Frame(i, i / 20, *pair) for i, pair in enumerate(pairs[:length])]
    empty = pairs[length:] if empty_shift is None else [seen(empty_shift) for _ in range(3)]
    return Fixed(frames, Backgrounds(*(torch.stack(side) for side in zip(*empty, strict=True))))


def test_frames_and_the_empty_scene_are_corrected_and_nothing_else():
    original = recording()
    found = align_recording(original)
    assert isinstance(found, AlignedRecording)
    assert isinstance(found, Recording)
    assert found.alignment.dy == pytest.approx(SHIFT, abs=0.05)
    assert (len(found), found.camera) == (12, CAMERA)
    frame, before = found[7], original.frames[7]
    assert frame.left is before.left
    assert (frame.index, frame.time_s, frame.depth) == (7, 0.35, None)
    # Two whole px: the very pixels, but for the last rows, which nobody saw.
    atol = 0.1  # of a texture that goes from 0 to 1 in a few pixels, moved by up to 0.03 px too much
    torch.testing.assert_close(frame.right[:, :-3], before.right[:, SHIFT:-1], atol=atol, rtol=0)
    empty = found.background()
    assert empty.left is original.empty.left
    torch.testing.assert_close(
        empty.right[1, :, :-3], original.empty.right[1, :, SHIFT:-1], atol=atol, rtol=0
    )
    assert torch.equal(empty.right, align_rows(original.empty.right, found.alignment))
    with pytest.raises(UnreadableFrame, match="frame 3"):
        found[BROKEN]


def test_frames_all_over_the_recording_and_two_empty_ones_are_measured(monkeypatch: pytest.MonkeyPatch):
    original = recording(length=51)
    pairs = []
    monkeypatch.setattr(
        aligned, "measure_alignment", lambda *images: pairs.append(images) or measure_alignment(*images)
    )
    align_recording(original)
    assert original.read == [0, 10, 20, 30, 40, 50]
    left, right = pairs[0]
    assert left.shape == right.shape == (8, 3, 240, 320)
    for images, side in ((left, "left"), (right, "right")):
        empty = getattr(original.empty, side)
        assert torch.equal(images[2], getattr(original.frames[20], side))
        assert torch.equal(images[6], empty[0])
        assert torch.equal(images[7], empty[2])
    assert len(pairs) == 2
    assert torch.equal(pairs[1][0], left)


def without_texture() -> Fixed:
    original = recording()
    return Fixed([replace(f, left=f.left * 0, right=f.right * 0) for f in original.frames], Backgrounds())


def depth_camera() -> Fixed:
    frames = [Frame(0, 0.0, seen(0)[0], depth=torch.ones(240, 320))]
    return Fixed(frames, Backgrounds(), replace(CAMERA, baseline=None))


@pytest.mark.parametrize(
    ("make", "measured"),
    [(lambda: recording(0), 1), (without_texture, 1), (depth_camera, 0)],
    ids=["good rows", "bare", "depth camera"],
)
def test_where_nothing_is_gained_the_recording_is_returned_itself_and_soon(
    make: Callable[[], Fixed], measured: int, monkeypatch: pytest.MonkeyPatch
):
    calls = []
    monkeypatch.setattr(
        aligned, "measure_alignment", lambda *images: calls.append(images) or measure_alignment(*images)
    )
    original = make()
    assert align_recording(original) is original
    assert len(calls) == measured
    assert bool(original.read) == bool(measured)


def test_a_recording_that_cannot_be_read_is_returned_itself(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(
        Fixed,
        "__getitem__",
        lambda self, position: (_ for _ in ()).throw(UnreadableFrame("gone", position, 0.0)),
    )
    original = Fixed(recording().frames, Backgrounds())
    assert align_recording(original) is original
    # The empty scene alone tells as well.
    assert isinstance(align_recording(Fixed(original.frames, recording().empty)), AlignedRecording)


def test_a_correction_that_leaves_the_rows_apart_is_not_made(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(aligned, "align_rows", lambda right, alignment: right)
    original = recording()
    assert align_recording(original) is original


def test_a_colour_image_beside_depth_has_no_right_image_to_correct():
    alignment = measure_alignment(*(image[None] for image in seen(SHIFT)))
    original = depth_camera()
    found = AlignedRecording(original, alignment)
    assert found[0] is original.frames[0]
    assert found.background() is original.empty


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rendered frames whose right images lie 2 px lower."""
    synthetic = make_recording("both_hands", 1, 0, 2, synthetic_camera(320, 240, 10.0))
    left, right = synthetic.background(2)

    def lower(images: Tensor) -> Tensor:
        return torch.cat([images[..., :SHIFT, :], images[..., :-SHIFT, :]], -2)

    frames = [Frame(i, i / 10, f.left[0], lower(f.right[0])) for i, f in enumerate(synthetic)]
    path = tmp_path_factory.mktemp("recording") / "lower"
    return write_recording(path, synthetic.camera, frames, Backgrounds(left, lower(right)))


QUICK = ["pose.height=1.75", "pose.size.rounds=0", "pose.size_frames=1", "pose.start.final_rounds=2"]


@pytest.mark.filterwarnings("always::UserWarning")
@pytest.mark.parametrize(
    ("settings", "before", "after", "words"),
    [
        ([], SHIFT, 0.0, "were {before:.2f} px apart and are now {after:.2f} px: the right"),
        (
            ["max_width=240"],
            0.75 * SHIFT,
            0.0,
            "were {before:.2f} px apart and are now {after:.2f} px: the right",
        ),
        (["align=false"], None, SHIFT, "are {after:.2f} px apart (at most 0.5 is good)"),
    ],
    ids=["corrected", "and shrunk", "not corrected"],
)
def test_infer_tells_how_far_apart_the_rows_were_and_are(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    settings: list[str],
    before: float | None,
    after: float,
    words: str,
):
    assert infer_main([f"recording={folder}", f"output={tmp_path}", *QUICK, *settings]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    told = {"before": summary["rows_apart_before_px"], "after": summary["rows_apart_px"]}
    assert told["before"] == (None if before is None else pytest.approx(before, abs=0.1))
    assert told["after"] == pytest.approx(after, abs=0.15)
    assert math.isfinite(summary["answered"])
    warnings = [line for line in capsys.readouterr().err.splitlines() if "rows of" in line]
    assert len(warnings) == 1
    assert words.format(**told) in warnings[0]
