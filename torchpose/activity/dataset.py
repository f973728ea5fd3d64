"""Sequences to learn activities from, and how they are divided into training and test.

A `Clip` is one person's one performance: what the pose column (or another recorder) found in each frame. A
frame that was lost is NaN, an empty silhouette is a lost frame too.
"""

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

POSE_PARAMETERS = 24  # 3 translations, yaw, pitch, roll, 18 joint parameters
_STREAMS = ("pose", "directions", "silhouettes", "joints", "pose_sd")
_FIELDS = ("joints", "offsets", "label", "subject", "take", "joint_names")


@dataclass(frozen=True)
class Clip:
    """What was seen of one performance: streams of T frames each, of which any may be absent.

    T has another name in each annotation, so that unequal lengths reach the check with the better message.
    """

    activity: str
    subject: str
    take: str
    # Body pose: translation m, root angles (yaw, pitch, roll) and joint parameters rad; NaN in a lost frame.
    pose: Float[Tensor, "poses 24"] | None = None
    # Unit vectors of the limbs in the torso's frame (x left, y down, z backward).
    directions: Float[Tensor, "frames limbs 3"] | None = None
    # Foreground, or the share of each pixel that is.
    silhouettes: Float[Tensor, "images height width"] | Bool[Tensor, "images height width"] | None = None
    joints: Float[Tensor, "skeletons joints 3"] | None = None  # m, any frame; needs `joint_names`
    joint_names: tuple[str, ...] = ()
    # Standard deviations of the pose, in its units, where they are known.
    pose_sd: Float[Tensor, "spreads 24"] | None = None

    def __post_init__(self) -> None:
        lengths = {name: len(stream) for name in _STREAMS if (stream := getattr(self, name)) is not None}
        if not lengths:
            raise ValueError(f"{self} must have one of {', '.join(_STREAMS)}, got none")
        if len(set(lengths.values())) > 1:
            raise ValueError(f"the streams of {self} must have the same number of frames, got {lengths}")
        if min(lengths.values()) == 0:
            raise ValueError(f"{self} must have at least one frame, got none")
        if self.joints is not None and self.joints.shape[1] != len(self.joint_names):
            have, named = self.joints.shape[1], len(self.joint_names)
            raise ValueError(f"joint_names of {self} must name each of its {have} joints, got {named}")

    def __str__(self) -> str:
        return f"clip '{self.activity}' (subject {self.subject}, take {self.take})"

    def __len__(self) -> int:
        return next(len(stream) for name in _STREAMS if (stream := getattr(self, name)) is not None)

    def stream(self, name: str) -> Tensor:
        """The stream of this name; `ValueError` where the clip does not have it."""
        value: Tensor | None = getattr(self, name)
        if value is None:
            there = [other for other in _STREAMS if getattr(self, other) is not None]
            raise ValueError(
                f"this feature needs '{name}' in every clip, but {self} has only {', '.join(there)}; "
                "choose another feature.kind or record that stream"
            )
        return value


class Split(Enum):
    """How sequences are divided. Lower-case names, as Hydra reads an enum by its member's name."""

    cross_subject = "cross_subject"  # odd subjects train (the first, third ... in order), even ones test
    half_subjects = "half_subjects"  # half the subjects train, drawn anew `splits` times
    leave_one_subject_out = "leave_one_subject_out"  # each subject in turn tests, all others train
    leave_one_sequence_out = "leave_one_sequence_out"  # each sequence in turn tests, all others train


@dataclass(frozen=True)
class Fold:
    """Indices of the clips that train and of those that test."""

    train: tuple[int, ...]
    test: tuple[int, ...]


def split_clips(clips: Sequence[Clip], split: Split | str, splits: int = 5, seed: int = 0) -> list[Fold]:
    """The folds of a protocol; `splits` and `seed` are of `half_subjects`, where an odd subject more tests.

    Raises:
        ValueError: an unknown protocol, or too few subjects or sequences for it.
    """
    try:
        split = Split(split)
    except ValueError:
        known = ", ".join(member.value for member in Split)
        raise ValueError(f"split must be one of {known}, got '{split}'") from None
    if splits < 1:
        raise ValueError(f"splits must be at least 1, got {splits}; 5 is usual")
    subjects = sorted({clip.subject for clip in clips}, key=_natural)
    by_sequence = split is Split.leave_one_sequence_out
    if (len(clips) if by_sequence else len(subjects)) < 2:
        raise ValueError(
            f"split {split.value} needs at least two subjects or sequences to tell training from test, got "
            f"{len(clips)} sequences by {len(subjects)} subjects; give more, or another split"
        )
    match split:
        case Split.leave_one_sequence_out:
            tests = [{index} for index in range(len(clips))]
        case Split.leave_one_subject_out:
            tests = [_of_subjects(clips, {name}) for name in subjects]
        case Split.cross_subject:
            tests = [_of_subjects(clips, set(subjects[1::2]))]
        case Split.half_subjects:
            generator = torch.Generator().manual_seed(seed)
            orders = [torch.randperm(len(subjects), generator=generator).tolist() for _ in range(splits)]
            half = len(subjects) // 2
            tests = [_of_subjects(clips, {subjects[i] for i in order[half:]}) for order in orders]
    everything = range(len(clips))
    return [Fold(tuple(i for i in everything if i not in test), tuple(sorted(test))) for test in tests]


def _of_subjects(clips: Sequence[Clip], names: set[str]) -> set[int]:
    return {index for index, clip in enumerate(clips) if clip.subject in names}


def _natural(name: str) -> tuple[int, int, str]:
    """Subject 2 before subject 10, numbers before words."""
    return (0, int(name), name) if name.isdecimal() else (1, 0, name)


def read_skeletons(path: Path | str, dtype: torch.dtype = torch.float32) -> list[Clip]:
    """Read a skeleton data set: an `.npz` with the joints of all sequences one after the other.

    It holds `joints` (frames, J, 3), `offsets` (sequences + 1) into the frames, from 0 to their number,
    `label`, `subject` and `take` of each sequence, and `joint_names` (J). A frame whose joints are all zero,
    as depth sensors write where they have lost the person, or that has a non-finite joint becomes NaN.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not an `.npz`, an array missing, or arrays that do not fit together.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no skeleton data set at {path}; give an .npz as data.path")
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in _FIELDS if name in archive}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"{path} must be an .npz of plain arrays, but it cannot be read: {error}; write it by numpy.savez"
        ) from error
    except TypeError as error:  # an .npy is an array, which is no context manager
        raise ValueError(
            f"{path} must be an .npz with several arrays, got a single array; write it by numpy.savez"
        ) from error
    missing = [name for name in _FIELDS if name not in arrays]
    if missing:
        raise ValueError(f"{path} must hold {', '.join(_FIELDS)}; it lacks {', '.join(missing)}")

    joints, offsets = arrays["joints"], arrays["offsets"]
    names = tuple(str(name) for name in arrays["joint_names"])
    if joints.ndim != 3 or joints.shape[1:] != (len(names), 3) or joints.dtype.kind != "f":
        raise ValueError(
            f"joints in {path} must be floating point of shape (frames, {len(names)} joint_names, 3), got "
            f"{joints.dtype} {joints.shape}; name every joint once"
        )
    if offsets.ndim != 1 or offsets.dtype.kind not in "iu" or len(offsets) < 2 or offsets[0] != 0:
        raise ValueError(
            f"offsets in {path} must be integers that start with 0 and end with the number of frames, got "
            f"{offsets.dtype} {offsets.shape} from {offsets.ravel()[:1]}; they are where each sequence begins"
        )
    if offsets[-1] != len(joints):
        raise ValueError(
            f"offsets in {path} must end with the number of frames, {len(joints)}, got {offsets[-1]}; add the last one"
        )
    steps = np.diff(offsets.astype(np.int64))
    if (steps < 1).any():
        raise ValueError(
            f"offsets in {path} must increase, as every sequence has a frame; "
            f"sequence {int(np.argmax(steps < 1))} has {steps.min()}"
        )
    for name in ("label", "subject", "take"):
        if arrays[name].shape != steps.shape:
            shape = arrays[name].shape
            raise ValueError(
                f"{name} in {path} must have one entry a sequence, {len(steps)}, got {shape}; add them"
            )

    positions = torch.from_numpy(joints).to(dtype)
    lost = ~positions.isfinite().all(2).all(1) | (positions == 0).all(2).all(1)
    positions = torch.where(lost[:, None, None], torch.nan, positions)
    return [
        Clip(str(label), str(subject), str(take), joints=sequence, joint_names=names)
        for label, subject, take, sequence in zip(
            arrays["label"],
            arrays["subject"],
            arrays["take"],
            positions.split(steps.tolist()),
            strict=True,
        )
    ]
