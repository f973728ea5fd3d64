"""Rendered recordings read as any other: the same images as the synthesis gives, each rendered once."""

import pytest
import torch

from torchpose.body.model import BodyModel
from torchpose.recording import Recording
from torchpose.rendered import RenderedRecording, demo_recording
from torchpose.synthesis.database import SyntheticRecording, make_recording, synthetic_camera

BODY = BodyModel()


def synthetic() -> SyntheticRecording:
    return make_recording("left_leg", 4, 1, 3, synthetic_camera(80, 60, 10.0), body=BODY)


def test_frames_are_those_of_the_synthesis_in_any_order():
    made = synthetic()
    recording = RenderedRecording(made)
    assert isinstance(recording, Recording)
    assert (len(recording), recording.camera) == (3, made.camera)
    truth = made.frames()
    for position in (2, 0, -2):
        frame = recording[position]
        assert frame.index == position % 3
        assert frame.time_s == pytest.approx((position % 3) / 10)
        assert torch.equal(frame.left, truth.left[position])
        assert torch.equal(frame.right, truth.right[position])
        assert frame.depth is None
    assert [frame.index for frame in recording] == [0, 1, 2]
    with pytest.raises(IndexError):
        recording[3]


def test_a_frame_is_rendered_once(monkeypatch: pytest.MonkeyPatch):
    asked = []
    made = synthetic()
    frames = made.frames
    monkeypatch.setattr(made, "frames", lambda *span: asked.append(span) or frames(*span))
    recording = RenderedRecording(made)
    first, again = recording[1], recording[1]
    assert asked == [(1, 2)]
    assert torch.equal(first.left, again.left)
    first.left.zero_()  # a caller's images are the caller's
    assert torch.equal(recording[1].left, again.left)


def test_the_empty_room_is_seen_as_often_as_asked():
    made = synthetic()
    room = RenderedRecording(made, num_backgrounds=3).background()
    assert torch.equal(room.left, made.background(3)[0])
    assert torch.equal(room.right, made.background(3)[1])
    assert RenderedRecording(made, num_backgrounds=0).background().left is None
    with pytest.raises(ValueError, match="num_backgrounds must be 0 or more, got -1"):
        RenderedRecording(made, num_backgrounds=-1)


def test_the_demo_depends_on_its_seed_alone():
    one, other = demo_recording(3), demo_recording(4)
    assert len(one) > 0
    assert (one.camera.width, one.camera.height) == (640, 480)
    assert torch.equal(one.synthetic.pose, demo_recording(3).synthetic.pose)
    assert not torch.equal(one.synthetic.pose, other.synthetic.pose)
