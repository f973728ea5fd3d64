"""Who is followed by whom: tracks of `infer.py` against the truth of recordings of several people.

Left-camera frame, metres. Truth is that of `torchpose.rendered.write_company`, read by benchmarks alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose.body.angle import limb_angles
from torchpose.export import PoseSequence

NEAR = 0.4  # m, mean distance of the joints within which a track follows a person
MEETING = 0.7  # m aside, within which two people are one behind the other, or nearly
CLEAR = 0.8  # share of a person that must be seen for the person to be in clear view
LEAST = 3  # frames; shorter stretches in clear view do not count


@dataclass(frozen=True)
class TruePerson:
    """One person of a recording: what is true, and what of it can be seen."""

    joints: Float[Tensor, "time 15 3"]  # m
    seen: Int[Tensor, " time"]  # px
    whole: Int[Tensor, " time"]  # px, that would be seen if nothing stood before
    cut: Bool[Tensor, " time"]  # by the image's border
    joints_seen: Bool[Tensor, "time 15"]

    @property
    def clear(self) -> Bool[Tensor, " time"]:
        """In which frames almost all of the person is seen."""
        return (self.seen >= CLEAR * self.whole) & (self.seen > 0) & ~self.cut


def read_people(folder: Path) -> list[TruePerson]:
    """The truth of everybody in a recording's folder."""
    people: list[TruePerson] = []
    while (path := folder / "truth" / f"person_{len(people) + 1}.npz").exists():
        with np.load(path) as data:
            names = ("joints_cam", "seen", "whole", "cut", "joints_seen")
            people.append(TruePerson(*(torch.from_numpy(data[name]) for name in names)))
    if not people:
        raise ValueError(f"{folder / 'truth'} must hold person_1.npz, and does not; write a company there")
    return people


def tracked_joints(track: PoseSequence, frames: int) -> Float[Tensor, "time 15 3"]:
    """A track's joints by frame number, NaN in frames that it does not answer."""
    joints = torch.full((frames, 15, 3), torch.nan)
    rows = torch.tensor(track.answered, dtype=torch.bool) & (track.frame < frames)
    joints[track.frame[rows]] = track.joints[rows].float()
    return joints


def followers(
    tracks: Sequence[Float[Tensor, "time 15 3"]], people: Sequence[TruePerson]
) -> Int[Tensor, "time people"]:
    """The track that follows each person in each frame, -1 where none does.

    A track follows the person whom it is nearest to, within `NEAR`; of several such tracks the nearest one counts.
    """
    truth = torch.stack([person.joints for person in people], 1)  # (T, people, 15, 3)
    if not tracks:
        return torch.full(truth.shape[:2], -1)
    gap = (torch.stack(list(tracks), 1)[:, :, None] - truth[:, None]).norm(dim=-1).mean(-1)
    gap = gap.nan_to_num(nan=torch.inf)  # (T, tracks, people)
    own = torch.where(gap == gap.amin(2, keepdim=True), gap, torch.inf)
    best, track = own.min(1)
    return torch.where(best < NEAR, track, -1)


def meeting(people: Sequence[TruePerson]) -> Bool[Tensor, " time"]:
    """Whether any two people who are in the image are within `MEETING` of each other, seen from the camera."""
    pelvis = torch.stack([person.joints[:, 0] for person in people], 1)  # (T, people, 3)
    side = pelvis[..., 0] / pelvis[..., 2].clamp_min(0.1)
    there = torch.stack([person.whole > 0 for person in people], 1)
    meets = torch.zeros(len(pelvis), dtype=torch.bool)
    for i in range(len(people)):
        for j in range(i):
            aside = (side[:, i] - side[:, j]).abs() * (pelvis[:, i, 2] + pelvis[:, j, 2]) / 2
            meets |= (aside < MEETING) & there[:, i] & there[:, j]
    return meets


@dataclass(frozen=True)
class Following:
    """How well each of the people was followed."""

    kept: bool  # each person by one track of its own, before and after every meeting
    owners: tuple[tuple[int, ...], ...]  # of each person, the track of each stretch between meetings; -1 none
    answered: tuple[float, ...]  # of each person, share of frames in clear view in which some track follows
    angle_deg: tuple[float, ...]  # of each person, mean error of the limb angles in these frames


def score(tracks: Sequence[PoseSequence], people: Sequence[TruePerson]) -> Following:
    """Identities and limb angles, over the frames in clear view and between meetings.

    A stretch belongs to the track that follows the person in most of its frames, and to none if that are fewer than
    half.
    """
    joints = [tracked_joints(track, len(people[0].seen)) for track in tracks]
    owner, meets = followers(joints, people), meeting(people)
    owners, answered, angles = [], [], []
    for k, person in enumerate(people):
        clear = person.clear & ~meets
        owners.append(tuple(_owner(owner[rows, k]) for rows in _stretches(clear, meets)))
        ours = owner[:, k]
        good = clear & (ours >= 0)
        answered.append(float(good.sum() / clear.sum().clamp_min(1)))
        found = [joints[int(track)][row] for row, track in enumerate(ours) if good[row]]
        if found:
            error = limb_angles(torch.stack(found)) - limb_angles(person.joints[good])
            angles.append(float(error.abs().rad2deg().mean()))
        else:
            angles.append(float("nan"))
    firsts = [own[0] if own else -1 for own in owners]
    kept = (
        min(firsts) >= 0
        and len(set(firsts)) == len(people)
        and all(set(own) == {first} for own, first in zip(owners, firsts, strict=True))
    )
    return Following(kept, tuple(owners), tuple(answered), tuple(angles))


def _stretches(clear: Bool[Tensor, " time"], meets: Bool[Tensor, " time"]) -> list[Int[Tensor, " rows"]]:
    """The frames in clear view, divided by the meetings."""
    number = (meets[1:] & ~meets[:-1]).cumsum(0)
    number = torch.cat([number.new_zeros(1), number])
    parts = [(clear & (number == n)).nonzero()[:, 0] for n in range(int(number[-1]) + 1)]
    return [rows for rows in parts if len(rows) >= LEAST]


def _owner(tracks: Int[Tensor, " rows"]) -> int:
    values, counts = tracks.unique(return_counts=True)
    best = int(counts.argmax())
    return int(values[best]) if 2 * int(counts[best]) >= len(tracks) else -1
