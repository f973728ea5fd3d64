"""Clips without rendering and registration, which take seconds each: what the database and the study are tested on."""

import functools
from pathlib import Path

import torch

from torchpose.activity.dataset import Clip
from torchpose.body.model import BodyModel
from torchpose.clips import ClipMaker, DataConfig, ObservedClip
from torchpose.synthesis.database import DatabaseConfig, PlannedClip

BODY = BodyModel()
DATABASE = DatabaseConfig(
    activities=("left_hand", "right_leg"),
    train_subjects=1,
    test_subjects=1,
    train_sequences=2,
    test_sequences=2,
    frames=(28, 32),
    width=64,
    height=48,
)


class Maker:
    """Stands in for rendering and registration, which take seconds a clip: poses near the truth, dots at the joints."""

    def __init__(self, interrupt_at: int | None = None) -> None:
        self.made: list[PlannedClip] = []
        self.interrupt_at = interrupt_at

    def __call__(self, maker: ClipMaker, planned: PlannedClip) -> ObservedClip:
        if len(self.made) == self.interrupt_at:
            raise KeyboardInterrupt
        self.made.append(planned)
        assert maker.data.database == DATABASE
        return made_up(planned)


@functools.cache
def made_up(planned: PlannedClip) -> ObservedClip:
    synthetic = planned.record(DATABASE, BODY)
    generator = torch.Generator().manual_seed(0)
    pose = synthetic.pose + 0.05 * torch.randn(synthetic.pose.shape, generator=generator)
    pose[3] = torch.nan  # a lost frame
    directions = BODY.limb_directions(BODY(synthetic.pose, synthetic.size))
    u, v = synthetic.camera.project(synthetic.joints).round().long().unbind(-1)
    silhouettes = torch.zeros(len(pose), 48, 64, dtype=torch.bool)
    silhouettes[torch.arange(len(pose))[:, None], v.clamp(0, 47), u.clamp(0, 63)] = True
    clip = Clip(
        planned.activity,
        str(planned.subject),
        str(planned.take),
        pose,
        directions,
        silhouettes,
        BODY(pose, synthetic.size).joints,
        BODY.joint_names,
        torch.full_like(pose, 0.05),
    )
    return ObservedClip(clip, torch.full((len(pose), 8), 0.1))


def tiny_maker(folder: Path) -> ClipMaker:
    return ClipMaker(DataConfig(cache=str(folder), database=DATABASE))
