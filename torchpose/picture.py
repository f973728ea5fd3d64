"""What a run draws over the recording's own images: the overlay video, the page's pictures, and the log for Rerun."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.export import open_video
from torchpose.eyes import depth_picture
from torchpose.figures import draw_overlay
from torchpose.overlay import overlays
from torchpose.parts import PersonParts
from torchpose.pipeline import StereoToPose
from torchpose.recording import Recording, UnreadableFrame
from torchpose.report import Report
from torchpose.rerun_log import open_rerun_log

_DRAWN = 50  # frames whose outlines are computed at once
_SAME_RATE = 0.01  # relative


def draw_pictures(
    folder: Path,
    recording: Recording,
    people: Sequence[tuple[StereoToPose, PersonParts]],
    report: Report,
    viz: bool,
) -> None:
    """Write `overlay.mp4`, with `viz` also `poses.rrd`, and give the report what it shows of the images.

    The video takes as long as the recording did. Each image is read once, and a stretch of frames is in memory at a
    time. `people` are the models that followed them and what their parts hold.
    """
    (model, first), *_ = people
    camera, times = model.camera, first.sequence.time_s
    with ExitStack() as stack:
        rate = video_rate(times, camera.frame_rate)
        video = stack.enter_context(open_video(folder / "overlay.mp4", camera.width, camera.height, rate))
        log = None
        if viz:
            sizes = [own.size for own, _ in people]
            log = stack.enter_context(open_rerun_log(folder / "poses.rrd", model.body, camera, sizes))
            for number, (_, person) in enumerate(people):
                log.add_angles(number, person.sequence)
        for start in range(0, len(times), _DRAWN):
            positions = range(start, min(start + _DRAWN, len(times)))
            stretches = [person.sequence[start : start + _DRAWN] for _, person in people]
            points = [[person.points(position) for position in positions] for _, person in people]
            layers = [
                overlays(own, stretch, seen, number if len(people) > 1 else None)
                for number, ((own, _), stretch, seen) in enumerate(
                    zip(people, stretches, points, strict=True)
                )
            ]
            for i, position in enumerate(positions):
                image = plain_image(recording, position, (camera.height, camera.width))
                if log is not None:
                    log.at(int(first.sequence.frame[position]), float(times[position]))
                    log.add_image(image)
                    log.add_depth(first.parts.depth(position))
                for number, stretch in enumerate(stretches):
                    seen = points[number][i]
                    report.add_points(number, position, seen.points, seen.labels)
                    if log is not None:
                        assert stretch.pose is not None
                        log.add_person(number, stretch.status[i], stretch.pose[i], seen.points, seen.labels)
                for layer in layers:
                    image = draw_overlay(image, layer[i])
                video.write(image)
                report.add_image(position, image)


def plain_image(
    recording: Recording, position: int, size: tuple[int, int]
) -> Float[Tensor, "3 height width"]:
    """What a person sees of a frame: its left image, its depth as grey, or black of this size if it is unreadable."""
    try:
        frame = recording[position]
    except UnreadableFrame:
        return torch.zeros(3, *size)
    if frame.left is not None:
        return frame.left
    assert frame.depth is not None
    return depth_picture(frame.depth[None])[0]


def video_rate(time_s: Float[Tensor, " time"], rate: float) -> float:
    """Frames a second, Hz, at which a video lasts as long as these frames did; the camera's `rate` if that fits."""
    elapsed = float(time_s[-1] - time_s[0]) if len(time_s) > 1 else 0.0
    if not elapsed > 0:
        return rate
    measured = (len(time_s) - 1) / elapsed
    return rate if abs(measured - rate) <= _SAME_RATE * rate else max(round(measured, 2), 0.1)
