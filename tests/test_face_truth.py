"""The benchmark's verdict on faces: a head that is turned, hidden or cut, with its eyes put by hand."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from benchmarks.face import by_angle, face_figures, score_face, true_face
from torchpose.vision.camera import StereoCamera
from torchpose.vision.faces import Faces

CAMERA = StereoCamera(200, 100, 300.0, 100.0, 40.0, 0.12)


def head(degrees, hand=False, cut=False, bearing=0.2):
    """A head 3 m away, `degrees` aside from the way to the camera, as a truth folder gives it."""
    center = 3 * torch.tensor([math.sin(bearing), 0.0, math.cos(bearing)])
    turn = math.radians(degrees) + bearing
    forward = -torch.tensor([math.sin(turn), 0.0, math.cos(turn)])
    aside = torch.tensor([forward[2], 0.0, -forward[0]])
    eyes = center + 0.09 * forward + torch.tensor([0.0, -0.03, 0.0])
    joints = {"head": center, "eye_L": eyes + 0.03 * aside, "eye_R": eyes - 0.03 * aside}
    joints["head_top"] = center + torch.tensor([0.0, -0.15, 0.0])
    depth = torch.full((1, 100, 200), float(eyes[2]) - (0.2 if hand else 0.01))
    return SimpleNamespace(
        all_joints={name: at[None] for name, at in joints.items()},
        parts=["background", "head"],
        labels=lambda index: np.full((100, 200), 0 if cut else 1),
        depth=lambda index: depth,
        eyes=eyes,
    )


@pytest.mark.parametrize("degrees", [-170, -95, -63, -57, -30, 0, 20, 57, 63, 89, 120])
def test_angle_and_visibility(degrees):
    """The angle is to the way from the eyes to the camera, up to 2 degrees from that of the head."""
    face = true_face(head(degrees), CAMERA, 0)
    assert face.angle == pytest.approx(abs(degrees), abs=2)
    assert face.visible is (abs(degrees) < 60)


def test_a_hidden_face_is_not_visible():
    assert true_face(head(10), CAMERA, 0).visible
    assert not true_face(head(10, hand=True), CAMERA, 0).visible
    assert not true_face(head(10, cut=True), CAMERA, 0).visible
    assert not true_face(head(10, bearing=0.5), CAMERA, 0).visible  # outside the image


def verdict(degrees, offset, found=True):
    """Of a box whose centre is `offset` face widths beside the face's, and of one far away by Haar."""
    truth = head(degrees)
    face = true_face(truth, CAMERA, 0)
    at = face.center + torch.tensor([offset * face.width, 0.0])
    box = torch.cat([at - 9, at + 9])[None] if found else torch.full((1, 4), torch.nan)
    faces = Faces(box, torch.tensor([found]), torch.zeros(1, 100, 200, dtype=torch.bool), torch.zeros(1, 3))
    center = 300 * (truth.eyes[:2] + torch.tensor([0.0, 0.03])) / truth.eyes[2] + torch.tensor([100.0, 40.0])
    assert_close(face.center, center)  # 3 cm below the eyes
    assert face.width == pytest.approx(300 * 0.15 / float(truth.eyes[2]))
    return score_face(faces, torch.tensor([[0.0, 0.0, 9.0, 9.0]]), face)


def test_a_face_is_right_within_half_a_width_and_unless_turned_away():
    near, far, aside, away, none = (
        verdict(*case) for case in ((5, 0.45), (5, -0.55), (75, 0.0), (100, 0.0), (5, 0.0, False))
    )
    assert [s.right for s in (near, far, aside, away, none)] == [True, False, True, False, False]
    assert [s.false for s in (near, far, aside, away, none)] == [False, True, False, True, False]
    figures = face_figures([near, far, aside, away, none])
    assert figures["face_found"] == pytest.approx(1 / 3)  # three are visible
    assert figures["face_false"] == pytest.approx(2 / 5)
    assert figures["haar_found"] == 0
    assert figures["haar_false"] == 1
    bands = by_angle([near, far, aside, away, none])
    assert [band["frames"] for band in bands.values()] == [3, 0, 1, 1]
    assert [band["visible"] for band in bands.values()] == [3, 0, 0, 0]
    assert math.isnan(bands["30-60"]["face_found"])
