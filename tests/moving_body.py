"""A body of known pose in every frame, for the files that other programs read."""

import math

import pytest
import torch

from torchpose.body.angle import ANATOMICAL_NAMES, LIMB_ANGLE_NAMES, anatomical_angles, limb_angles
from torchpose.body.model import BodyConfig, BodyModel, JointKind
from torchpose.export import PoseSequence

RATE = 20.0


def in_double(kind: JointKind) -> BodyModel:
    torch.set_default_dtype(torch.float64)
    try:
        return BodyModel(BodyConfig(joint=kind))
    finally:
        torch.set_default_dtype(torch.float32)


def body_fixture():
    """The fixture `body`: with either kind of joints, in double precision."""

    @pytest.fixture(
        scope="module", params=[JointKind.anatomical, JointKind.swing], ids=lambda kind: kind.value
    )
    def body(request: pytest.FixtureRequest) -> BodyModel:
        return in_double(request.param)

    return body


def size_fixture():
    """The fixture `size`: somebody whose every length is another share of the body file's."""

    @pytest.fixture(scope="module")
    def size(body: BodyModel) -> torch.Tensor:
        return torch.linspace(0.85, 1.15, len(body.size_names), dtype=torch.float64)[None]

    return size


def moving(body: BodyModel, size: torch.Tensor, time: int = 24, gone: tuple[int, ...] = ()) -> PoseSequence:
    """All joints from limit to limit, out of step, while the person turns twice on the spot and walks."""
    t = torch.arange(time, dtype=torch.float64)[:, None] / time
    phase = torch.arange(18.0, dtype=torch.float64) * 1.3
    low, high = body.low[6:], body.high[6:]
    joints = (low + high) / 2 + 0.45 * (high - low) * torch.sin(2 * math.pi * t + phase)
    root = torch.cat(
        [t, 0.1 * t, 3 + t, 4 * math.pi * t - 3, 0.4 * torch.sin(9 * t), 0.3 * torch.cos(7 * t)], 1
    )
    root[:, 3] = torch.remainder(root[:, 3] + math.pi, 2 * math.pi) - math.pi
    pose = torch.cat([root, joints], 1)
    posed = body(pose, size)
    stale = list(gone)
    return PoseSequence(
        frame=torch.arange(time) + 7,
        time_s=(torch.arange(time).double() + 7) / RATE,
        status=tuple("lost" if row in gone else "tracked" for row in range(time)),
        point_to_model=torch.full((time,), 0.01, dtype=torch.float64),
        joints=posed.joints.index_fill(0, torch.tensor(stale, dtype=torch.int64), 9.0),
        angle_names=ANATOMICAL_NAMES,
        angles=anatomical_angles(body, posed),
        angle_sd=torch.full((time, 21), 0.1, dtype=torch.float64),
        limb_angle_names=LIMB_ANGLE_NAMES,
        limb_angles=limb_angles(posed.joints),
        pose=pose,
    )
