"""What a recogniser makes of an output folder: `activities.csv` for each person, and entries in a journal."""

from collections.abc import Iterable
from datetime import datetime, timedelta
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.activity.codebook import Codebook
from torchpose.activity.dataset import Clip
from torchpose.activity.diary import Diary, DiaryConfig, Entry
from torchpose.activity.recognizer import Recognizer
from torchpose.body.model import BodyModel
from torchpose.export import JOINT_NAMES, PoseSequence, read_pose_sd, read_poses_npz
from torchpose.journal import Journal, write_activities_csv
from torchpose.report import add_activities

Diaries = dict[str, list[Entry]]


class ActivityWriter:
    """Writes diaries of what was found in recordings.

    Whatever is wrong with what it is given is found when it is made, before a recording is run.

    Args:
        recognizer: folder of a trained recogniser.
        config: of the diary.
        journal: SQLite file to add to; None for none.
        person: whose name the journal has; others in a recording are `person_2` and so on.
        started: local date and time of the recording's first frame, for the journal.
    """

    def __init__(
        self,
        recognizer: Path | str,
        config: DiaryConfig = DiaryConfig(),  # noqa: B008 (frozen)
        journal: Path | str | None = None,
        person: str = "person",
        started: datetime | None = None,
    ) -> None:
        if journal is not None and started is None:
            raise ValueError(
                "a journal needs the date and time of the first frame, got none; give when it started"
            )
        self.diary = Diary(Recognizer.load(recognizer), config)
        self.journal = None if journal is None else Journal(journal)
        self.person, self.started = person, started
        codebook = self.diary.members[0].codebooks[0]
        assert isinstance(codebook, Codebook)
        self._dtype = codebook.centers.dtype
        # A feature that such clips do not have is told now.
        nothing = torch.full((5, 24), torch.nan)
        joints = torch.full((5, len(JOINT_NAMES), 3), torch.nan)
        directions = torch.full((5, 9, 3), torch.nan)
        self.diary.log_emission(self._clip(nothing, nothing, joints, directions))

    def write(self, output: Path, body: BodyModel, recording: str) -> Diaries:
        """Write `activities.csv`, `activities_2.csv` and so on beside the poses in a folder; returns the entries.

        A `report.html` there gets them, too.
        `recording` is the journal's name for it: adding it again replaces it.
        """
        for old in output.glob("activities*.csv"):  # an earlier run may have found more people
            old.unlink()
        found: Diaries = {}
        for path in sorted(output.glob("poses*.npz")):
            mark = path.stem.removeprefix("poses")
            sequence = read_poses_npz(path, covariance=False)
            clip = self.clip(sequence, body, read_pose_sd(path))
            entries = self.diary.write(clip, sequence.time_s)
            write_activities_csv(output / f"activities{mark}.csv", entries)
            found[self.person + mark] = entries
        page = output / "report.html"
        if page.exists():
            add_activities(page, found.values())
        if self.journal is not None:
            assert self.started is not None
            for person, entries in found.items():
                self.journal.add(person, recording, self.started, entries)
        return found

    def clip(
        self,
        sequence: PoseSequence,
        body: BodyModel,
        pose_sd: Float[Tensor, "time parameters"] | None = None,
    ) -> Clip:
        """The poses as the recogniser's features take them; a frame without a pose is NaN.

        `pose_sd` are the standard deviations of a sequence without covariances, m and rad.
        """
        clean = sequence.without_stale_numbers()
        if clean.pose is None:
            raise ValueError(
                "activities need the body model's own pose, got a sequence without it; read poses.npz"
            )
        pose, like = clean.pose, body.default_size(1)
        sd = torch.full_like(pose, torch.nan) if pose_sd is None else pose_sd
        if clean.pose_covariance is not None:
            sd = clean.pose_covariance.diagonal(dim1=1, dim2=2).clamp(min=0).sqrt()
        seen = pose.isfinite().all(1)
        directions = pose.new_full((len(pose), len(body.body_names) - 1, 3), torch.nan)
        if seen.any():
            known = pose[seen].to(like)
            posed = body(known, like)
            directions[seen] = body.limb_directions(posed).to(directions)
        return self._clip(pose, sd, clean.joints, directions)

    def _clip(self, pose: Tensor, sd: Tensor, joints: Tensor, directions: Tensor) -> Clip:
        return Clip(
            "recording",
            self.person,
            "",
            pose=pose.to(self._dtype),
            directions=directions.to(self._dtype),
            joints=joints.to(self._dtype),
            joint_names=JOINT_NAMES,
            pose_sd=sd.to(self._dtype),
        )


def activity_lines(diaries: Diaries) -> str:
    """How long each activity went on, a line a person."""
    return "\n".join(f"{person:15}{_times(entries)}" for person, entries in diaries.items())


def _times(entries: Iterable[Entry]) -> str:
    total: dict[str, timedelta] = {}
    for entry in entries:
        length = timedelta(seconds=entry.end_s - entry.start_s)
        total[entry.activity] = total.get(entry.activity, timedelta()) + length
    longest = sorted(total.items(), key=lambda pair: -pair[1])
    return ", ".join(f"{name} {length.total_seconds():.1f} s" for name, length in longest) or "nothing"
