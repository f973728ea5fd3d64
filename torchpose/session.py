"""One recording from beginning to end: poses in parts that an interrupted run finds again, then every file at once.

Angles are in radians in memory and in degrees in the files; metres, left-camera frame.
"""

import dataclasses
import hashlib
import json
import math
import shutil
import sys
import time
import warnings
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from tqdm import tqdm

from torchpose.atomic import replacing
from torchpose.body.ellipsoid import outline
from torchpose.export import (
    PoseSequence,
    open_video,
    read_poses_npz,
    write_poses_csv,
    write_poses_npz,
    write_summary,
)
from torchpose.eyes import depth_picture
from torchpose.figures import WORST_SD, Overlay, draw_overlay, plot_angles
from torchpose.people import People
from torchpose.pipeline import FramePose
from torchpose.recording import Recording, UnreadableFrame, readable_frames, spread_positions
from torchpose.registration.size import write_size
from torchpose.report import Report
from torchpose.rerun_log import RerunLog, depth_png, open_rerun_log
from torchpose.vision.alignment import alignment_warning, correction_warning, measure_alignment
from torchpose.window import PeopleWindows

CHECKED = 3  # frames whose rows are compared
FEWEST = 5  # frames with a pose, from which somebody further is written
_PARTS, _STAMP = "parts", "settings.txt"  # of a run that is not finished: their folder, and whose they are
_SHOWN = ("elbow_flexion_left", "elbow_flexion_right", "knee_flexion_left", "knee_flexion_right")


@dataclass(frozen=True)
class _Labelled:
    """The labelled points of some frames, for the overlay alone."""

    pixels: Float[Tensor, "time num 2"]
    labels: Int[Tensor, "time num"]


class Session:
    """Runs a model over a recording into a folder. The same settings on the same recording go on where they stopped.

    `rows_before` is how far apart, in px of the recording's images, the rows were before they were corrected; None
    where they were not; `told` gathers the warnings, see `kept_warnings`; `viz` writes
    `poses.rrd`, too.
    """

    def __init__(
        self,
        people: People,
        recording: Recording,
        output: Path,
        settings: Mapping[str, Any],
        version: str,
        rows_before: float | None = None,
        told: list[str] | None = None,
        viz: bool = False,
    ):
        self.people, self.model = people, people.model
        self.recording, self.output = recording, output
        self.settings, self.version, self.rows_before = settings, version, rows_before
        self.parts = output / _PARTS
        self.problems: list[str] = []
        self.told = [] if told is None else told
        self.viz = viz
        self._open: dict[tuple[Path, str], tuple[Path, dict[str, np.ndarray] | None]] = {}  # being read
        self._ends: list[int] = []  # one beyond the last frame of each part
        self.kept: list[dict[str, Tensor]] = []  # what an interrupted run goes on from, of each person

    def run(self, fresh: bool = False, max_frames: int | None = None) -> dict[str, Any]:
        """Recover all poses and write the files of an output folder.

        Returns the summary. `fresh` forgets what an interrupted run left.
        """
        begin, count = time.perf_counter(), min(len(self.recording), max_frames or len(self.recording))
        done = self._resume(fresh)
        rows_apart = self._check_rows()
        if done < count:
            self.people.prepare(self.recording) if done == 0 else self.model.learn_background(self.recording)
            self._follow(done, count)
        self._ends = [int(file.stem.removeprefix("poses_")) for file in self._files()]
        found = self._collect()
        report = self._report(found)
        with self.model.stopwatch.measure("export"):
            for pattern in ("poses_*.csv", "poses_*.npz", "angles_*.png", "person_*.yaml", "*.rrd"):
                for old in self.output.glob(pattern):  # an earlier run may have found more people
                    old.unlink()
            for number, (sequence, _, person) in enumerate(found, 1):
                mark = "" if number == 1 else f"_{number}"
                write_poses_csv(self.output / f"poses{mark}.csv", sequence)
                write_poses_npz(self.output / f"poses{mark}.npz", sequence)
                plot_angles(self.output / f"angles{mark}.png", sequence)
                size = self.people.followers[person].model.size
                write_size(self.output / f"person{mark}.yaml", self.model.body, size)
            self._draw(found, report)
        sequence = found[0][0]
        summary = self._summary(sequence, time.perf_counter() - begin, count - done)
        summary["others"] = [dict(Counter(other.status)) for other, _, _ in found[1:]]
        summary |= {"rows_apart_px": rows_apart, "rows_apart_before_px": self.rows_before}
        write_summary(self.output / "summary.json", summary)
        report.write(self.output / "report.html", summary)
        shutil.rmtree(self.parts)
        return summary

    def _check_rows(self) -> float | None:
        """How far apart the rows of a recording's left and right images are, px, with a warning where it spoils depth.

        A correction is told, too. None for a depth camera, and where too few points are seen in both images.
        """
        frames = list(readable_frames(self.recording, spread_positions(len(self.recording), CHECKED)))
        left = [frame.left for frame in frames if frame.left is not None]
        right = [frame.right for frame in frames if frame.right is not None]
        if not right:
            return None
        alignment = measure_alignment(torch.stack(left), torch.stack(right))
        typical = None if math.isnan(alignment.typical) else alignment.typical
        if self.rows_before is None:
            sentence = alignment_warning(alignment)
        else:
            sentence = correction_warning(self.rows_before, typical)
        if sentence:
            warnings.warn(sentence, stacklevel=2)
        return typical

    def _resume(self, fresh: bool) -> int:
        """How many frames the parts of an interrupted run hold; they are removed if they are not ours."""
        if fresh or not is_interrupted(self.output, self.settings, self.version):
            shutil.rmtree(self.parts, ignore_errors=True)
            with replacing(self.parts / _STAMP) as partial:
                partial.write_text(_key(self.settings, self.version))
            return 0
        files = self._files()
        if not files:
            return 0
        # The first person's part is written last: what others have beyond it is of a stretch that was not finished.
        for person in range(self._count()):
            state = self._folder(person) / files[-1].name.replace("poses", "state")
            if state.exists():
                saved = np.load(state)
                self.kept.append({name: torch.from_numpy(saved[name]) for name in saved.files})
        self.people.restore(self.kept)
        return sum(len(read_poses_npz(file)) for file in files)

    def _folder(self, person: int) -> Path:
        """Where the parts of a person are, counted from 0."""
        return self.parts if person == 0 else self.parts / f"person_{person + 1}"

    def _count(self) -> int:
        """How many people have parts."""
        return 1 + len(list(self.parts.glob("person_*")))

    def _files(self) -> list[Path]:
        return sorted(self.parts.glob("poses_*.npz"))

    def _follow(self, done: int, count: int) -> None:
        """Frames `done` to `count`, saved whenever a stretch of them is smooth."""
        windows = PeopleWindows(self.people.followers, self.kept)
        with tqdm(
            total=count, initial=done, unit="frame", disable=not sys.stderr.isatty(), leave=False
        ) as bar:
            for position in range(done, count):
                result = self.people.step(self.recording, position)
                if result[0].problem:
                    self.problems.append(f"frame {result[0].index}: {result[0].problem}")
                ready = windows.push(result)
                ready += windows.flush() if position == count - 1 else []
                bar.set_postfix_str(result[0].status.value)
                bar.update()
                if ready:
                    done += len(ready)
                    for person in reversed(range(len(windows.windows))):
                        state = windows.windows[person].state
                        if state:
                            self._save(person, done, [frame[person] for frame in ready], state)

    def _save(self, person: int, end: int, frames: list[FramePose], kept: Mapping[str, Tensor]) -> None:
        """One part of a person: labelled points, what the next frame starts from, and last the poses."""
        folder = self._folder(person)
        num = max((f.sight.cloud.mask.shape[1] for f in frames if f.sight is not None), default=1)
        pixels, metres, labels = (
            np.full((len(frames), num, 2), np.nan, np.float32),
            np.full((len(frames), num, 3), np.nan, np.float16),  # 2 mm at 4 m
            np.full((len(frames), num), -1, np.int8),
        )
        for i, frame in enumerate(frames):
            if frame.sight is not None and frame.registration is not None:
                seen = frame.sight.cloud.mask[0].cpu()
                pixels[i, seen] = frame.sight.cloud.pixels[0].cpu()[seen]
                metres[i, seen] = frame.sight.cloud.points[0].cpu()[seen].half()
                labels[i, seen] = frame.registration.belief[0].argmax(0).cpu()[seen]
        with replacing(folder / f"points_{end:08d}.npz") as partial:
            np.savez(partial, pixels=pixels, metres=metres, labels=labels)
        if self.viz and person == 0:
            pngs = [np.zeros(0, np.uint8) if f.sight is None else depth_png(f.sight.depth[0]) for f in frames]
            with replacing(folder / f"depth_{end:08d}.npz") as partial:
                np.savez(partial, *pngs)
        state = {name: value.cpu().numpy() for name, value in kept.items()}
        with replacing(folder / f"state_{end:08d}.npz") as partial:
            np.savez_compressed(partial, allow_pickle=False, **state)
        model = self.people.followers[person].model
        write_poses_npz(folder / f"poses_{end:08d}.npz", model.sequence(frames))

    def _collect(self) -> list[tuple[PoseSequence, _Labelled, int]]:
        """Poses and labelled points of the first person, and of others who have enough poses, with their numbers."""
        found = []
        for person in range(self._count()):
            poses, points = [], []
            for file in self._files():
                first, own = read_poses_npz(file), self._folder(person) / file.name
                poses.append(read_poses_npz(own) if own.exists() else first.of_nobody())
                points.append(self._points(own, len(first)))
            sequence = PoseSequence.join(poses)
            if person == 0 or int(np.sum(sequence.answered)) >= FEWEST:
                most = max(labels.shape[1] for _, labels in points)
                pixels, labels = (
                    np.concatenate(
                        [
                            np.pad(
                                part,
                                [(0, 0), (0, most - part.shape[1])] + [(0, 0)] * (part.ndim - 2),
                                constant_values=nothing,
                            )
                            for part in parts
                        ]
                    )
                    for parts, nothing in zip(zip(*points, strict=True), (np.nan, -1), strict=True)
                )
                labelled = _Labelled(torch.from_numpy(pixels), torch.from_numpy(labels).long())
                found.append((sequence, labelled, person))
        return found

    def _points(self, poses: Path, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Labelled points of a part, none where a person has none."""
        file = poses.with_name(poses.name.replace("poses", "points"))
        if not file.exists():
            return np.zeros((count, 0, 2), np.float32), np.zeros((count, 0), np.int8)
        part = np.load(file)
        return part["pixels"], part["labels"]

    def _report(self, found: list[tuple[PoseSequence, _Labelled, int]]) -> Report:
        """The page, with everything but the pictures."""
        title = Path(str(self.settings.get("recording") or "demo")).name
        sizes = [self.people.followers[person].model.size for _, _, person in found]
        report = Report(title, self.model.body, sizes, len(found[0][0]))
        for number, (sequence, _, person) in enumerate(found):
            report.add_poses(number, 0, sequence)
            for position in report.shown.tolist():
                report.add_points(number, position, *self._metres(person, position))
        return report

    def _metres(self, person: int, position: int) -> tuple[Float[Tensor, "num 3"], Int[Tensor, " num"]]:
        """The points of a person in a frame, m, and the parts they belong to."""
        part, row = self._part(self._folder(person), "points", position)
        if part is None:
            return torch.zeros(0, 3), torch.zeros(0, dtype=torch.int8)
        return torch.from_numpy(part["metres"][row]).float(), torch.from_numpy(part["labels"][row])

    def _part(self, folder: Path, kind: str, position: int) -> tuple[dict[str, np.ndarray] | None, int]:
        """The arrays of the part that has a frame, and the frame's row; the last of each folder and kind are kept."""
        place = bisect_right(self._ends, position)
        start, end = self._ends[place - 1] if place else 0, self._ends[place]
        path = folder / f"{kind}_{end:08d}.npz"
        if self._open.get((folder, kind), (None, None))[0] != path:
            arrays = None
            if path.exists():
                with np.load(path) as part:
                    arrays = {name: part[name] for name in part.files}
            self._open[folder, kind] = (path, arrays)
        return self._open[folder, kind][1], position - start

    def _draw(self, found: list[tuple[PoseSequence, _Labelled, int]], report: Report) -> None:
        """What needs the recording's images: overlay video, the page's pictures, and the log for Rerun."""
        camera, first = self.model.camera, found[0][0]
        sizes = [self.people.followers[person].model.size for _, _, person in found]
        with ExitStack() as stack:
            video = stack.enter_context(
                open_video(self.output / "overlay.mp4", camera.width, camera.height, camera.frame_rate)
            )
            log = None
            if self.viz:
                log = stack.enter_context(
                    open_rerun_log(self.output / "poses.rrd", self.model.body, camera, sizes)
                )
                for number, (sequence, _, _) in enumerate(found):
                    log.add_angles(number, sequence)
            for i in range(len(first)):
                image = self._image(i)
                if log is not None:
                    log.at(int(first.frame[i]), float(first.time_s[i]))
                    self._log(log, found, image, i)
                for number, (sequence, labelled, person) in enumerate(found):
                    row = number if len(found) > 1 else -1
                    image = draw_overlay(image, self._overlay(sequence, labelled, person, i, row))
                video.write(image)
                report.add_image(i, image)

    def _log(
        self,
        log: RerunLog,
        found: list[tuple[PoseSequence, _Labelled, int]],
        image: Float[Tensor, "3 height width"],
        i: int,
    ) -> None:
        log.add_image(image)
        pngs, row = self._part(self.parts, "depth", i)
        log.add_depth(np.zeros(0, np.uint8) if pngs is None else pngs[f"arr_{row}"])
        for number, (sequence, _, person) in enumerate(found):
            assert sequence.pose is not None
            log.add_person(number, sequence.status[i], sequence.pose[i], *self._metres(person, i))

    def _overlay(self, sequence: PoseSequence, labelled: _Labelled, person: int, i: int, row: int) -> Overlay:
        """What is drawn of a person in a frame. `row` is the person's among the written statuses, -1 alone."""
        camera, body, size = self.model.camera, self.model.body, self.people.followers[person].model.size
        assert sequence.pose is not None
        name, row = (str(row + 1), row) if row >= 0 else ("", 0)
        status = f"{name} {sequence.status[i]}".strip()
        if not bool(sequence.pose[i].isfinite().all()):
            return Overlay(status, row=row)
        posed = body(sequence.pose[i : i + 1].to(size), size)
        marks = []
        for angle in _SHOWN:
            joint, side = angle.split("_flexion_")
            column = sequence.angle_names.index(angle)
            if not float(sequence.angle_sd[i, column]) > WORST_SD:
                marks.append((f"{joint}_{side}", f"{math.degrees(sequence.angles[i, column]):.0f}"))
        return Overlay(
            status,
            camera.project(outline(posed))[0].cpu(),
            camera.project(posed.joints)[0].cpu(),
            labelled.pixels[i],
            labelled.labels[i],
            row=row,
            name=name,
            marks=tuple(marks),
        )

    def _image(self, position: int) -> Float[Tensor, "3 height width"]:
        """What a person sees of a frame: its left image, its depth as grey, or black where it cannot be read."""
        camera = self.model.camera
        try:
            frame = self.recording[position]
        except UnreadableFrame:
            return torch.zeros(3, camera.height, camera.width)
        if frame.left is not None:
            return frame.left
        assert frame.depth is not None
        return depth_picture(frame.depth[None])[0]

    def _summary(self, sequence: PoseSequence, seconds: float, frames: int) -> dict[str, Any]:
        counts = Counter(sequence.status)
        lengths = dict(zip(self.model.body.size_names, self.model.size[0].tolist(), strict=True))
        stages = self.model.stopwatch.seconds
        return {
            "version": self.version,
            "versions": {
                "torch": torch.__version__,
                "numpy": np.__version__,
                "python": sys.version.split()[0],
            },
            "settings": self.settings,
            "frames": len(sequence),
            "status": dict(counts),
            "answered": float(np.mean(sequence.answered)) if len(sequence) else 0.0,
            "point_to_model_m": {
                "mean": float(sequence.point_to_model.nanmean()),
                "sd": float(np.nanstd(sequence.point_to_model.numpy()))
                if bool(sequence.point_to_model.isfinite().any())
                else float("nan"),
            },
            "size": lengths,
            "seconds": seconds,
            "seconds_per_frame": seconds / max(frames, 1),
            "cpu_ms_per_frame": {name: 1000 * value / max(frames, 1) for name, value in stages.items()},
            "problems": self.problems,
            "warnings": list(dict.fromkeys(self.told)),
        }


@contextmanager
def kept_warnings() -> Iterator[list[str]]:
    """A list to which the sentences of all warnings are added that are shown while the block runs."""
    told: list[str] = []
    with warnings.catch_warnings():
        show = warnings.showwarning

        def keep(message: Warning | str, *details: Any, **more: Any) -> None:
            told.append(str(message))
            show(message, *details, **more)

        warnings.showwarning = keep
        yield told


def is_interrupted(output: Path, settings: Mapping[str, Any], version: str) -> bool:
    """Whether a folder holds an interrupted run with these settings, which `Session.run` goes on with."""
    stamp = output / _PARTS / _STAMP
    return stamp.is_file() and stamp.read_text() == _key(settings, version)


def _key(settings: Mapping[str, Any], version: str) -> str:
    """What tells one run from another; `fresh` says how it begins, not what it is."""
    settings = {name: value for name, value in settings.items() if name != "fresh"}
    return hashlib.sha256(json.dumps([settings, version], sort_keys=True, default=str).encode()).hexdigest()


def summary_table(summary: Mapping[str, Any], output: Path) -> str:
    """What a person wants to know at the end, in a few lines."""
    status = ", ".join(f"{count} {name}" for name, count in summary["status"].items())
    distance = summary["point_to_model_m"]["mean"]
    fitted = "-" if math.isnan(distance) else f"{1000 * distance:.1f} mm"
    lines = [
        f"frames            {summary['frames']}: {status}",
        f"answered          {100 * summary['answered']:.1f} %",
        f"point to model    {fitted}",
        f"time              {summary['seconds']:.1f} s, {summary['seconds_per_frame']:.2f} s a frame",
        "CPU ms a frame    "
        + ", ".join(f"{name} {ms:.0f}" for name, ms in summary["cpu_ms_per_frame"].items()),
        *(
            f"person {number}          " + ", ".join(f"{count} {name}" for name, count in other.items())
            for number, other in enumerate(summary["others"], 2)
        ),
        f"results           {output}/ report.html, poses.csv, poses.npz, person.yaml, overlay.mp4, angles.png",
    ]
    problems = summary["problems"]
    lines += [f"problem           {problem}" for problem in problems[:5]]
    if len(problems) > 5:
        lines.append(f"                  and {len(problems) - 5} more, see summary.json")
    return "\n".join(lines)


def settings_of(config: Any) -> dict[str, Any]:
    """A configuration as plain data, for a summary and for recognising the same run again."""
    return json.loads(
        json.dumps(dataclasses.asdict(config), default=lambda value: getattr(value, "value", str(value)))
    )
