"""Everybody's frames wait together until those that follow have had their say, and come out smoothed."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

from torch import Tensor

from torchpose.pipeline import FramePose, SmoothingWindow, StereoToPose
from torchpose.tracking.tracker import TrackStatus


@runtime_checkable
class Followed(Protocol):
    """One person: the model that follows him or her, and what the next frame starts from."""

    model: StereoToPose

    def state(self) -> dict[str, Tensor]:
        """As tensors."""


class PeopleWindows:
    """A smoothing window for each person, which fill and empty together.

    `people` are those who are followed; newcomers are appended to this very list.
    """

    def __init__(self, people: Sequence[Followed], states: Sequence[Mapping[str, Tensor]] | None = None):
        self.people = people
        self.windows = [
            SmoothingWindow(person.model, states[k] if states else None, person.state)
            for k, person in enumerate(people)
        ]

    def push(self, poses: list[FramePose]) -> list[list[FramePose]]:
        """Take the next frame of everybody; the frames that are ready, of everybody, often none."""
        for person in self.people[len(self.windows) : len(poses)]:
            window = SmoothingWindow(person.model, None, person.state)
            # Not pushed: of a time before somebody came there is no state to go on from.
            window.waiting = [
                replace(earlier, status=TrackStatus.absent, registration=None, sight=None, observation=None)
                for earlier in self.windows[0].waiting
            ]
            self.windows.append(window)
        return _by_frame([window.push(pose) for window, pose in zip(self.windows, poses, strict=True)])

    def flush(self) -> list[list[FramePose]]:
        """The frames that are left at the end of the recording."""
        return _by_frame([window.flush() for window in self.windows])


def _by_frame(poses: list[list[FramePose]]) -> list[list[FramePose]]:
    return [list(frame) for frame in zip(*poses, strict=True)]
