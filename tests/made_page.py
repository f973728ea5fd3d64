"""Made-up runs as pages, and what a page says read back, for tests of the page."""

import base64
import json
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchpose.body.angle import ANATOMICAL_NAMES, LIMB_ANGLE_NAMES
from torchpose.body.model import BodyModel
from torchpose.export import PoseSequence
from torchpose.report import Report

SUMMARY: dict[str, Any] = {
    "version": "1.2.3",
    "versions": {"torch": "2"},
    "settings": {"seed": 0, "pose": {"height": 1.75}},
    "frames": 6,
    "status": {"tracked": 5, "lost": 1},
    "answered": 5 / 6,
    "point_to_model_m": {"mean": 0.011, "sd": float("nan")},
    "size": {"trunk": 0.97, "thigh": 1.02},
    "seconds": 12.0,
    "seconds_per_frame": 2.0,
    "problems": [],
    "warnings": [],
    "others": [],
    "rows_apart_px": None,
}


def make_poses(body: BodyModel, count: int, lost: tuple[int, ...] = (), aside: float = 0.0) -> PoseSequence:
    """Somebody who raises an arm 3 m before the camera, and walks to the right."""
    pose = torch.zeros(count, body.num_parameters)
    pose[:, 0] = torch.linspace(-0.3, 0.3, count) + aside
    pose[:, 2] = 3.0
    pose[:, 6:] = body.rest
    pose[:, 10] += torch.linspace(0, 1.2, count)
    joints = body(pose, body.default_size(1)).joints
    status = tuple("lost" if i in lost else "partial" if i == 1 else "tracked" for i in range(count))
    return PoseSequence(
        frame=10 + torch.arange(count),
        time_s=torch.arange(count).double() / 20,
        status=status,
        point_to_model=torch.rand(count).double() / 50,
        joints=joints.double(),
        angle_names=ANATOMICAL_NAMES,
        angles=torch.randn(count, len(ANATOMICAL_NAMES)).double().clamp(-3.1, 3.1),
        angle_sd=torch.full((count, len(ANATOMICAL_NAMES)), 0.1).double(),
        limb_angle_names=LIMB_ANGLE_NAMES,
        limb_angles=torch.rand(count, 8).double(),
        pose=pose,
        pose_covariance=torch.eye(body.num_parameters).expand(count, -1, -1),
    )


def make_report(body: BodyModel, *people: PoseSequence, title: str = "hands") -> Report:
    """With a picture of each frame whose grey tells the frame, and points on the ellipsoids' middles."""
    size, count = body.default_size(1), len(people[0])
    report = Report(title, body, [size] * len(people), count)
    for number, poses in enumerate(people):
        report.add_poses(number, 0, poses)
        for i in range(count):
            if poses.answered[i]:
                assert poses.pose is not None
                centres = body(poses.pose[i : i + 1], size).centers[0]
                report.add_points(number, i, centres, torch.arange(body.num_parts))
    for i in range(count):
        report.add_image(i, torch.full((3, 90, 120), (i + 1) / (count + 1)))
    return report


class Page(HTMLParser):
    """The elements of a page, and the text of its scripts and its title."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, str] = {}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        tag, attributes = self.tags[-1] if self.tags else ("", {})
        name = attributes.get("id") or tag
        self.texts[name] = self.texts.get(name, "") + data


def read_page(path: Path) -> tuple[Page, dict[str, Any]]:
    page = Page(path.read_text(encoding="utf-8"))
    return page, json.loads(page.texts["data"])


def unpack(text: str, dtype: str, *shape: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype).reshape(-1, *shape)


def in_units(values: np.ndarray, unit: float) -> np.ndarray:
    return np.where(values == -32768, np.nan, values * unit)
