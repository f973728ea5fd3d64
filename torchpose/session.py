"""One recording from beginning to end: poses in parts that an interrupted run finds again, then every file at once.

Angles are in radians in memory and in degrees in the files; metres, left-camera frame.
"""

import dataclasses
import hashlib
import json
import math
import os
import shutil
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from torchpose.atomic import require_writable
from torchpose.export import (
    PoseSequence,
    write_poses_csv,
    write_poses_npz,
    write_summary,
)
from torchpose.figures import plot_angles
from torchpose.motion_export import ExportConfig, export_motion
from torchpose.parts import LabelledPoints, Parts, PersonParts
from torchpose.people import People
from torchpose.picture import draw_pictures
from torchpose.pipeline import FramePose
from torchpose.recording import Recording, readable_frames, spread_positions
from torchpose.registration.size import write_size
from torchpose.report import Report
from torchpose.rerun_log import depth_png
from torchpose.terminal import Progress, coloured, table
from torchpose.vision.alignment import alignment_warning, correction_warning, measure_alignment
from torchpose.vision.floor import Floor
from torchpose.window import PeopleWindows

CHECKED = 3  # frames whose rows are compared
FEWEST = 5  # frames with a pose, from which somebody further is written
SPACE = 60_000  # bytes that the parts and the files of a frame take, and some more
_PARTS, _FILES = "parts", "files"  # folders of a run that is not finished
_MOST_PROBLEMS = 4  # that are printed


class Session:
    """Runs a model over a recording into a folder. The same settings on the same recording go on where they stopped.

    `rows_before` is how far apart, in px of the recording's images, the rows were before they were corrected; None
    where they were not; `told` gathers the warnings, see `kept_warnings`; `viz` writes `poses.rrd`, too.
    """

    def __init__(
        self,
        people: People,
        recording: Recording,
        output: Path,
        settings: Mapping[str, Any],
        version: str,
        rows_before: float | None = None,
        export: ExportConfig | None = None,
        told: list[str] | None = None,
        viz: bool = False,
    ):
        self.people, self.model = people, people.model
        self.recording, self.output = recording, output
        self.settings, self.version, self.rows_before = settings, version, rows_before
        self.export = export or ExportConfig()
        self.export.check_rate(recording.camera.frame_rate)
        self.parts = Parts(output / _PARTS)
        self.problems: list[str] = []
        self.told = [] if told is None else told
        self.viz = viz
        self.kept: list[dict[str, Tensor]] = []  # what an interrupted run goes on from, of each person

    def run(self, fresh: bool = False, max_frames: int | None = None) -> dict[str, Any]:
        """Recover all poses and write the files of an output folder.

        Returns the summary. `fresh` forgets what an interrupted run left. Raises UnwritableFile where the folder
        cannot be written or its disk is full; nothing is lost then, and the same run goes on afterwards.
        """
        begin, count = time.perf_counter(), min(len(self.recording), max_frames or len(self.recording))
        done = self.begin(fresh, count)
        rows_apart = self.check_rows(self.recording)
        if done < count:
            self.people.prepare(self.recording) if done == 0 else self.model.learn_background(self.recording)
            self.follow(range(done, count), count)
        notes = {"rows_apart_px": rows_apart, "rows_apart_before_px": self.rows_before}
        return self.finish(begin, count - done, notes)

    def begin(self, fresh: bool, count: int | None = None) -> int:
        """How many frames an interrupted run did; what it left is removed if it is not ours, or if `fresh`.

        Warns where the disk has little room for `count` frames.
        """
        require_writable(self.output)
        done, key = 0, _key(self.settings, self.version)
        if fresh or not self.parts.are_of(key):
            self.parts.begin(key)
        elif self.parts.ends:
            self.kept, done = self.parts.states(), self.parts.ends[-1]
            self.people.restore(self.kept)
        free, needed = shutil.disk_usage(self.output).free, ((count or 0) - done) * SPACE
        if free < needed:
            warnings.warn(
                f"{count} frames may take {needed / 1e9:.1f} GB and the disk of {self.output} has {free / 1e9:.1f} GB "
                "left; free some space, or give output= on another disk",
                stacklevel=2,
            )
        return done

    def follow(
        self,
        positions: Iterable[int],
        count: int | None,
        watch: Callable[[list[FramePose]], None] | None = None,
    ) -> None:
        """Follow the frames at these positions, which begin where the parts end; a stretch that is smooth is saved.

        `count` is how many frames there will be, None where nobody knows. `watch` is told each frame's poses as they
        come, not smoothed yet.
        """
        windows, done = PeopleWindows(self.people.followers, self.kept), sum(self.parts.ends[-1:])
        with Progress(count, done) as progress:
            for position in positions:
                result = self.people.step(self.recording, position)
                if result[0].problem:
                    self.problems.append(f"frame {result[0].index}: {result[0].problem}")
                if watch is not None:
                    watch(result)
                self._save(windows, windows.push(result))
                progress.step([pose.status.value for pose in result])
            self._save(windows, windows.flush())

    def finish(self, begin: float, followed: int, notes: Mapping[str, Any]) -> dict[str, Any]:
        """Write all files, from the parts, and return the summary, to which `notes` are added.

        The files are written beside the parts and then take their places together: until then what an earlier run
        wrote still stands. `begin` is when the run began, by `time.perf_counter`; `followed` counts its frames.
        """
        staged = self.parts.folder / _FILES
        shutil.rmtree(staged, ignore_errors=True)
        found = self._found()
        with self.model.stopwatch.measure("export"):
            report = self._report(found)
            notes = {**notes, "bvh": self._write(found, staged, report)}
        summary = self._summary(found[0].sequence, time.perf_counter() - begin, followed)
        summary["others"] = [dict(Counter(other.sequence.status)) for other in found[1:]]
        files = [path.name for path in staged.iterdir()]
        summary |= {**notes, "files": sorted([*files, "report.html", "summary.json"])}
        report.write(staged / "report.html", summary)
        write_summary(staged / "summary.json", summary)
        self._publish(staged)
        self.parts.remove()
        return summary

    def _found(self) -> list[PersonParts]:
        """The first person, and others who have enough poses."""
        people = [self.parts.person(number) for number in range(self.parts.people)]
        return [one for one in people if one.number == 0 or sum(one.sequence.answered) >= FEWEST]

    def _report(self, found: Sequence[PersonParts]) -> Report:
        """The page, with the poses."""
        title = Path(str(self.settings.get("recording") or "demo")).name
        sizes = [self.people.followers[person.number].model.size for person in found]
        report = Report(title, self.model.body, sizes, len(found[0].sequence))
        for number, person in enumerate(found):
            report.add_poses(number, 0, person.sequence)
        return report

    def _write(self, found: Sequence[PersonParts], folder: Path, report: Report) -> dict[str, Any]:
        """Every file but page and summary, for which notes come back of files that do not hold every pose.

        A person's `sequence` has no covariances; `points(position)` are of a part.
        """
        notes, floor = dict[str, Any](), self.model.eyes.floor
        for number, person in enumerate(found, 1):
            mark = "" if number == 1 else f"_{number}"
            model = self.people.followers[person.number].model
            write_poses_csv(folder / f"poses{mark}.csv", person.sequence)
            write_poses_npz(folder / f"poses{mark}.npz", person.sequence, person.covariances())
            plot_angles(folder / f"angles{mark}.png", person.sequence)
            write_size(folder / f"person{mark}.yaml", model.body, model.size)
            notes |= export_motion(folder, mark, person.sequence, model.body, model.size, self.export, floor)
        people = [(self.people.followers[person.number].model, person) for person in found]
        draw_pictures(folder, self.recording, people, report, self.viz)
        return notes

    def _publish(self, staged: Path) -> None:
        """Move the files into the output folder, and remove those of an earlier run that this one did not write."""
        files = sorted(staged.iterdir())
        names = {file.name for file in files}
        for name in _files_of(self.output) - names:
            (self.output / name).unlink(missing_ok=True)
        for file in files:
            os.replace(file, self.output / file.name)

    def check_rows(self, recording: Recording) -> float | None:
        """How far apart the rows of a recording's left and right images are, px, with a warning where it spoils depth.

        A correction is told, too. None for a depth camera, and where too few points are seen in both images.
        """
        frames = list(readable_frames(recording, spread_positions(len(recording), CHECKED)))
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

    def _save(self, windows: PeopleWindows, ready: list[list[FramePose]]) -> None:
        """Frames that are smooth, of everybody, as one part."""
        if not ready:
            return
        people = list(zip(*ready, strict=True))
        self.parts.save(
            sum(self.parts.ends[-1:]) + len(ready),
            [
                follower.model.sequence(list(frames))
                for follower, frames in zip(self.people.followers, people, strict=False)
            ],
            [[LabelledPoints.of(frame) for frame in frames] for frames in people],
            [window.state for window in windows.windows],
            [_depth_of(frame) for frame in people[0]] if self.viz else None,
        )

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
            "floor": _floor_entry(self.model.eyes.floor),
            "size": lengths,
            "seconds": seconds,
            "seconds_per_frame": seconds / max(frames, 1),
            "cpu_ms_per_frame": {name: 1000 * value / max(frames, 1) for name, value in stages.items()},
            "problems": self.problems,
            "warnings": list(dict.fromkeys(self.told)),
        }


def _floor_entry(floor: Floor | None) -> dict[str, Any] | None:
    """A floor for the summary, with the angle by which the camera is off the level; None where none is known."""
    if floor is None:
        return None
    tilt = math.degrees(math.acos(min(1.0, -float(floor.normal[1]))))
    return {"normal": floor.normal.tolist(), "height_m": float(floor.height), "tilt_deg": tilt}


def _depth_of(frame: FramePose) -> UInt8[np.ndarray, " bytes"]:
    """A frame's depth as a PNG; nothing where it was not seen."""
    return np.zeros(0, np.uint8) if frame.sight is None else depth_png(frame.sight.depth[0])


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


def _files_of(output: Path) -> set[str]:
    """The files that an earlier run wrote into a folder, by its summary."""
    try:
        files = json.loads((output / "summary.json").read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError):  # none, or of an older version
        return set()
    return {name for name in files if isinstance(name, str) and Path(name).name == name}


def is_interrupted(output: Path, settings: Mapping[str, Any], version: str) -> bool:
    """Whether a folder holds an interrupted run with these settings, which `Session.run` goes on with."""
    return Parts(output / _PARTS).are_of(_key(settings, version))


def _key(settings: Mapping[str, Any], version: str) -> str:
    """What tells one run from another; `fresh` says how it begins, not what it is."""
    settings = {name: value for name, value in settings.items() if name != "fresh"}
    return hashlib.sha256(json.dumps([settings, version], sort_keys=True, default=str).encode()).hexdigest()


def summary_table(summary: Mapping[str, Any], output: Path, columns: int) -> str:
    """What a person wants to know at the end: at most 20 lines of so many columns."""
    distance = summary["point_to_model_m"]["mean"]
    share = 100 * summary["answered"]
    stages = sorted(summary["cpu_ms_per_frame"].items(), key=lambda stage: -stage[1])
    rows = [
        ("frames", f"{summary['frames']}: {_counted(summary['status'])}"),
        ("answered", f"{share:.1f} %" + ("" if share > 0 else ": no frame has a pose")),
        ("point to model", "-" if math.isnan(distance) else f"{1000 * distance:.1f} mm"),
        *((f"person {k}", _counted(other)) for k, other in enumerate(summary["others"], 2)),
        ("time", f"{summary['seconds']:.1f} s, {summary['seconds_per_frame']:.2f} s a frame"),
        ("CPU ms a frame", ", ".join(f"{name} {ms:.0f}" for name, ms in stages)),
        *(
            (
                name,
                f"holds the longest stretch of poses, {note['frames']} frames from {note['first_frame']} on; "
                f"{note['left_out']} poses are outside",
            )
            for name, note in summary.get("bvh", {}).items()
            if note["left_out"]
        ),
        ("results", f"{output}/ {', '.join(summary['files'])}"),
    ]
    if "live" in summary:
        live = summary["live"]
        words = (
            f"{live['offered']} pairs in {live['seconds']:.1f} s: {live['followed']} followed, {live['dropped']} "
            f"dropped ({100 * live['drop_rate']:.1f} %), {live['missed_by_camera']} missed by the camera; "
            "recording/ has all that came"
        )
        rows.insert(1, ("live", words))
    lines = table(rows, columns, most=3)
    problems = summary["problems"]
    told = [("problem", problem) for problem in problems[:_MOST_PROBLEMS]]
    if len(problems) > _MOST_PROBLEMS:
        told[_MOST_PROBLEMS - 1 :] = [
            ("", f"and {len(problems) - _MOST_PROBLEMS + 1} more, see summary.json")
        ]
    lines += [coloured(line, "yellow") for line in table(told, columns, most=1)]
    return "\n".join(lines)


def _counted(status: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in status.items())


def settings_of(config: Any) -> dict[str, Any]:
    """A configuration as plain data, for a summary and for recognising the same run again."""
    return json.loads(
        json.dumps(dataclasses.asdict(config), default=lambda value: getattr(value, "value", str(value)))
    )
