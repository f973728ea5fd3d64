"""The parts of a run: poses, points and states by stretches of frames, which an interrupted run finds again.

All of a person's points never are in memory together: 100,000 frames of them are gigabytes.
"""

import bisect
import dataclasses
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from torchpose.atomic import replacing
from torchpose.export import PoseSequence, read_poses_npz, write_poses_npz
from torchpose.pipeline import FramePose

_STAMP = "settings.txt"  # whose parts they are


@dataclass(frozen=True)
class LabelledPoints:
    """The points on a person in one frame, none where he or she was not seen or has no pose."""

    points: Float[Tensor, "num 3"]  # m, left-camera frame
    labels: Int[Tensor, " num"]  # the part of the body of each, by its number; above the last: no part

    @classmethod
    def none(cls) -> "LabelledPoints":
        """No points."""
        return cls(torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64))

    @classmethod
    def of(cls, frame: FramePose) -> "LabelledPoints":
        """Those of a frame, on the CPU."""
        if frame.sight is None or frame.registration is None:
            return cls.none()
        seen, cloud = frame.sight.cloud.mask[0], frame.sight.cloud
        labels = frame.registration.belief[0].argmax(0)[seen]
        return cls(cloud.points[0, seen].float().cpu(), labels.cpu())


class Parts:
    """A folder of parts, see `save`. The first person's files lie in it, those of others in folders below it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def are_of(self, key: str) -> bool:
        """Whether the parts are those of the run that has this key."""
        stamp = self.folder / _STAMP
        return stamp.is_file() and stamp.read_text() == key

    def begin(self, key: str) -> None:
        """Forget what there is; from now on the parts are those of this key."""
        shutil.rmtree(self.folder, ignore_errors=True)
        with replacing(self.folder / _STAMP) as partial:
            partial.write_text(key)

    def remove(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder)

    @property
    def ends(self) -> list[int]:
        """The number of frames up to the end of each part, ascending."""
        return sorted(int(path.stem.removeprefix("poses_")) for path in self.folder.glob("poses_*.npz"))

    @property
    def people(self) -> int:
        """How many people have parts."""
        return 1 + len(list(self.folder.glob("person_*")))

    def states(self) -> list[dict[str, Tensor]]:
        """What the run goes on from, of each person: the states of the last part. [] where there is none."""
        # The first person's part is written last: what others have beyond it is of a stretch that was not finished.
        ends, found = self.ends, []
        for person in range(self.people) if ends else ():
            path = self.path(person, "state", ends[-1])
            if path.exists():
                with np.load(path) as saved:
                    found.append({name: torch.from_numpy(saved[name]) for name in saved.files})
        return found

    def save(
        self,
        end: int,
        sequences: Sequence[PoseSequence],
        points: Sequence[Sequence[LabelledPoints]],
        states: Sequence[Mapping[str, Tensor]],
        depths: Sequence[np.ndarray] | None = None,
    ) -> None:
        """One part of everybody, up to frame `end`: points, what the next frame starts from, and last the poses.

        `depths` are the frames' depth images as PNG, uint8 of any length each, where they are wanted later.
        """
        if depths is not None:
            with replacing(self.path(0, "depth", end)) as partial:
                np.savez(partial, *depths)
        earlier = list(self.folder.rglob("state_*.npz"))
        for person in reversed(range(len(sequences))):
            if not states[person]:  # came after the part's end
                continue
            frames = points[person]
            with replacing(self.path(person, "points", end)) as partial:
                np.savez(
                    partial,
                    counts=np.array([len(frame.labels) for frame in frames]),
                    points=torch.cat([frame.points for frame in frames]).numpy(),
                    labels=torch.cat([frame.labels for frame in frames]).numpy().astype(np.int8),
                )
            state = {name: value.cpu().numpy() for name, value in states[person].items()}
            with replacing(self.path(person, "state", end)) as partial:
                np.savez_compressed(partial, allow_pickle=False, **state)
            write_poses_npz(self.path(person, "poses", end), sequences[person])
        for path in earlier:  # nobody goes on from these any more
            path.unlink()

    def depth(self, position: int) -> UInt8[np.ndarray, " bytes"]:
        """The depth image of a frame as it was saved; nothing where there is none."""
        ends = self.ends
        part = bisect.bisect_right(ends, position)
        path = self.path(0, "depth", ends[part])
        if not path.exists():
            return np.zeros(0, np.uint8)
        with np.load(path) as saved:
            return saved[f"arr_{position - (ends[part - 1] if part else 0)}"]

    def person(self, number: int) -> "PersonParts":
        """All that the parts have of a person, counted from 0."""
        return PersonParts(self, number)

    def path(self, person: int, kind: str, end: int) -> Path:
        """The file of a person's part: `poses`, `points` or `state`; of the frames themselves (person 0) `depth`."""
        folder = self.folder if person == 0 else self.folder / f"person_{person + 1}"
        return folder / f"{kind}_{end:08d}.npz"


class PersonParts:
    """One person of a run. `sequence` is in memory; points and covariances are read part by part."""

    def __init__(self, parts: Parts, number: int) -> None:
        self.parts, self.number, self.ends = parts, number, parts.ends
        self._at = -1  # the part whose points are in memory
        self._points: list[LabelledPoints] = []

    @cached_property
    def sequence(self) -> PoseSequence:
        """The poses of all frames, without `pose_covariance`; absent wherever there is no part of this person."""
        fields: dict[str, Any] = {}
        start = 0
        for part in self._sequences():
            stop = start + len(part)
            for field in dataclasses.fields(part):
                value = getattr(part, field.name)
                if isinstance(value, Tensor) and field.name != "pose_covariance":
                    # One part after another into the whole: the sum of the parts would be as large again.
                    whole = fields.setdefault(field.name, value.new_empty(self.ends[-1], *value.shape[1:]))
                    whole[start:stop] = value
                elif field.name == "status":
                    fields.setdefault(field.name, []).extend(map(sys.intern, value))
                elif not isinstance(value, Tensor):
                    fields[field.name] = value
            start = stop
        return PoseSequence(**fields | {"status": tuple(fields["status"])})

    def covariances(self) -> Iterator[Float[Tensor, "time parameters parameters"]]:
        """The poses' covariances, part by part."""
        for part in self._sequences():
            assert part.pose_covariance is not None
            yield part.pose_covariance

    def points(self, position: int) -> LabelledPoints:
        """The labelled points at `position`, 0 to the number of frames - 1. Reading in order reads each part once."""
        part = bisect.bisect_right(self.ends, position)
        if part != self._at:
            self._points, self._at = self._read(part), part
        return self._points[position - (self.ends[part - 1] if part else 0)]

    def _sequences(self) -> Iterator[PoseSequence]:
        for end in self.ends:
            own = self.parts.path(self.number, "poses", end)
            there = own.exists()
            part = read_poses_npz(own if there else self.parts.path(0, "poses", end))
            yield part if there else part.of_nobody()

    def _read(self, part: int) -> list[LabelledPoints]:
        path = self.parts.path(self.number, "points", self.ends[part])
        if not path.exists():
            count = self.ends[part] - (self.ends[part - 1] if part else 0)
            return [LabelledPoints.none()] * count
        with np.load(path) as saved:
            counts = saved["counts"].tolist()
            points = torch.from_numpy(saved["points"]).split(counts)
            labels = torch.from_numpy(saved["labels"]).long().split(counts)
        return [LabelledPoints(*pair) for pair in zip(points, labels, strict=True)]
