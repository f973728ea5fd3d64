"""Recordings that the package makes itself, read like any other: rendered people before a stereo camera.

Left-camera frame (x right, y down, z forward); metres, seconds. Images are multiples of 1/255.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torchpose.atomic import replacing
from torchpose.recording import Backgrounds, Frame, write_recording
from torchpose.synthesis.company import CompanyRecording, Presence
from torchpose.synthesis.database import SyntheticRecording, make_demo
from torchpose.vision.camera import StereoCamera


class RenderedRecording:
    """A synthetic recording as a `Recording`: each frame is rendered when it is first asked for, and kept.

    What is kept are bytes, as in an image file, so nothing is lost. The truth stays in `synthetic`.
    """

    def __init__(self, synthetic: SyntheticRecording, num_backgrounds: int = 2) -> None:
        if num_backgrounds < 0:
            raise ValueError(f"num_backgrounds must be 0 or more, got {num_backgrounds}; 0 gives none")
        self.synthetic = synthetic
        self._num_backgrounds = num_backgrounds
        self._rendered: dict[int, Tensor] = {}  # (2, 3, H, W) bytes, left and right

    @property
    def camera(self) -> StereoCamera:
        return self.synthetic.camera

    def __len__(self) -> int:
        return len(self.synthetic)

    def __iter__(self) -> Iterator[Frame]:
        return (self[position] for position in range(len(self)))

    def __getitem__(self, position: int, /) -> Frame:
        """The frame at `position`, 0 to len - 1 (or from the end, -1 to -len)."""
        index = range(len(self))[position]
        if index not in self._rendered:
            frames = self.synthetic.frames(index, index + 1)
            pair = torch.cat([frames.left, frames.right])
            self._rendered[index] = (pair * 255).round().byte()
        left, right = self._rendered[index].float().div(255)
        return Frame(index, index / self.camera.frame_rate, left, right)

    def background(self) -> Backgrounds:
        """Frames of the empty room."""
        if self._num_backgrounds == 0:
            return Backgrounds()
        return Backgrounds(*self.synthetic.background(self._num_backgrounds))


def demo_recording(seed: int = 0) -> RenderedRecording:
    """What `python infer.py` runs without a recording, see `make_demo`."""
    return RenderedRecording(make_demo(seed))


def write_company(
    folder: str | Path, company: CompanyRecording, stereo: bool = True, num_backgrounds: int = 2
) -> Path:
    """Write a company as a recording's folder with a folder `truth`, and return it.

    Rendered stereo pairs, or a depth camera's frames with colour. Of the K-th of the people `truth/person_K.npz` has
    joints_cam (T, 15, 3) m, joints_uv px, joint_names, pose (T, 24), size (S); seen and whole (T,), how many pixels of
    the person are seen and would be if nothing stood before; cut (T,), whether the image's border cuts the person off;
    joints_seen (T, 15), whether the person is seen at the joint's pixel. `truth/NNNNNN_people.png` has K where the K-th
    is seen, 0 elsewhere. The calibration is written last: a folder that has one is complete.
    """
    folder, camera, length = Path(folder), company.camera, len(company)
    truth = folder / "truth"
    truth.mkdir(parents=True, exist_ok=True)
    presence = [company.presence(i) for i in range(length)]
    for i, people in enumerate(presence):
        image = sum(np.uint8(k + 1) * one.mask.cpu().numpy().astype(np.uint8) for k, one in enumerate(people))
        with replacing(truth / f"{i:06d}_people.png") as partial:
            if not cv2.imwrite(str(partial), np.asarray(image)):
                raise OSError(f"could not write {partial}")
    for k in range(len(company.poses)):
        _write_person(truth / f"person_{k + 1}.npz", company, k, [people[k] for people in presence])
    if stereo:
        frames = (Frame(i, i / camera.frame_rate, one.left[0], one.right[0]) for i, one in enumerate(company))
        return write_recording(folder, camera, frames, Backgrounds(*company.background(num_backgrounds)))
    read = ((i, company.depth_frame(i)) for i in range(length))
    frames = (Frame(i, i / camera.frame_rate, one.colour, depth=one.depth) for i, one in read)
    empty = Backgrounds(depth=torch.stack([company.empty_depth(k) for k in range(num_backgrounds)]))
    return write_recording(folder, replace(camera, baseline=None), frames, empty)


def _write_person(path: Path, company: CompanyRecording, index: int, presence: list[Presence]) -> None:
    joints = company.joints[index]
    with replacing(path) as partial:
        np.savez_compressed(
            partial,
            joints_cam=joints.cpu().numpy(),
            joints_uv=company.camera.project(joints).cpu().numpy(),
            joint_names=np.array(company.body.joint_names),
            pose=company.poses[index].cpu().numpy(),
            size=company.sizes[index][0].cpu().numpy(),
            seen=np.array([int(one.mask.sum()) for one in presence]),
            whole=np.array([one.whole for one in presence]),
            cut=np.array([one.cut for one in presence]),
            joints_seen=np.stack([one.joints.cpu().numpy() for one in presence]),
        )
