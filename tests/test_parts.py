"""Parts of a run on the disk: read frame by frame, they are what was saved, whoever came when."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.testing import assert_close

from torchpose.export import PoseSequence
from torchpose.parts import LabelledPoints, Parts

LENGTHS = (3, 1, 4)  # frames of each part
STATES = {"size": torch.ones(1, 2)}


def poses(start: int, length: int) -> PoseSequence:
    """Numbers that tell their frames."""
    frame = torch.arange(start, start + length)
    number = frame.double()[:, None]
    return PoseSequence(
        frame=frame,
        time_s=frame.double() / 10,
        status=("tracked",) * length,
        point_to_model=number[:, 0],
        joints=number[:, None].expand(-1, 15, 3),
        angle_names=("knee",),
        angles=number,
        angle_sd=number,
        limb_angle_names=("elbow",),
        limb_angles=number,
        pose=number.expand(-1, 2),
        pose_covariance=number[..., None].expand(-1, 2, 2),
    )


def points(start: int, length: int) -> list[LabelledPoints]:
    """As many as the frame's number."""
    return [
        LabelledPoints(torch.full((i, 3), float(i)), torch.full((i,), i))
        for i in range(start, start + length)
    ]


@pytest.fixture
def parts(tmp_path: Path) -> Parts:
    """A first person in all parts, and a second one in all but the first."""
    found = Parts(tmp_path / "parts")
    found.begin("key")
    start = 0
    for number, length in enumerate(LENGTHS):
        one = (poses(start, length), points(start, length))
        people = [one, (replace(one[0], joints=one[0].joints + 100), one[1])]
        found.save(
            start + length,
            [sequence for sequence, _ in people],
            [seen for _, seen in people],
            [STATES | {"end": torch.tensor(start + length)}, STATES if number else {}],
        )
        start += length
    return found


def test_each_frame_has_its_own_points_in_any_order(parts: Parts):
    first, second = parts.person(0), parts.person(1)
    for position in (*range(8), 5, 0, 7, 3, 2):
        assert_close(first.points(position).points, torch.full((position, 3), float(position)))
        assert first.points(position).labels.tolist() == [position] * position
        assert len(second.points(position).labels) == (position if position >= LENGTHS[0] else 0)


def test_a_sequence_is_whole_and_whoever_came_late_was_absent(parts: Parts):
    first, second = parts.person(0).sequence, parts.person(1).sequence
    assert first.frame.tolist() == second.frame.tolist() == list(range(8))
    assert_close(first.angles[:, 0], torch.arange(8.0, dtype=torch.float64))
    assert first.pose_covariance is None
    assert second.status == ("absent",) * 3 + ("tracked",) * 5
    assert second.joints[:3].isnan().all()
    assert_close(second.joints[3:, 0, 0], torch.arange(103.0, 108.0, dtype=torch.float64))
    covariance = torch.cat(list(parts.person(0).covariances()))
    assert_close(covariance[:, 0, 1], torch.arange(8.0, dtype=torch.float64))
    assert torch.cat(list(parts.person(1).covariances())).shape == (8, 2, 2)


def test_a_run_goes_on_from_the_last_part_whose_first_person_is_there(parts: Parts):
    assert parts.ends == [3, 4, 8]
    assert parts.people == 2
    assert [int(state["end"]) for state in parts.states()[:1]] == [8]
    assert len(parts.states()) == 2
    # Earlier states are of no use to anybody.
    assert len(list(parts.folder.rglob("state_*.npz"))) == 2
    # Interrupted between the second person's and the first one's: that part does not count.
    later = (poses(8, 2), points(8, 2))
    files = set(parts.folder.rglob("*.npz"))
    with pytest.raises(RuntimeError):
        parts.save(
            10, [Broken.of(later[0]), later[0]], [later[1]] * 2, [STATES | {"end": torch.tensor(10)}] * 2
        )
    assert set(parts.folder.rglob("*.npz")) > files
    assert parts.path(1, "poses", 10).exists()  # the first person's are the last to be written
    assert parts.ends == [3, 4, 8]
    assert int(parts.states()[0]["end"]) == 8
    assert len(parts.person(1).sequence) == 8


class Broken(PoseSequence):
    """The disk is pulled out while this is written."""

    @classmethod
    def of(cls, sequence: PoseSequence) -> "Broken":
        return cls(**{name: getattr(sequence, name) for name in cls.__dataclass_fields__})

    def __getitem__(self, frames: slice, /) -> PoseSequence:
        raise RuntimeError


def test_parts_know_whose_they_are(parts: Parts):
    assert parts.are_of("key")
    assert not parts.are_of("other")
    parts.begin("other")
    assert parts.are_of("other")
    assert parts.ends == []
    assert parts.states() == []
    parts.remove()
    assert not parts.are_of("other")
