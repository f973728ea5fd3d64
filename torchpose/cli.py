"""The command line: settings as `key=value`, checked before anything runs, and errors of one sentence."""

import math
import shutil
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, overload

import torch

from torchpose.activities import ActivityWriter, activity_lines
from torchpose.activity.dataset import Clip, Fold, Split, read_skeletons, split_clips
from torchpose.activity.diary import DiaryConfig
from torchpose.activity.features import FeatureKind
from torchpose.activity.recognizer import RecognizerConfig
from torchpose.aligned import AlignedRecording, align_recording
from torchpose.atomic import require_writable
from torchpose.body.model import BodyModel
from torchpose.capture import camera_numbers, capture_recording, open_cameras
from torchpose.clips import ClipMaker, DataConfig, build_database
from torchpose.eyes import EyesConfig
from torchpose.live import LiveConfig, LiveRun
from torchpose.manual import full_help, short_help
from torchpose.motion_export import ExportConfig
from torchpose.people import People, PeopleConfig
from torchpose.pipeline import PoseConfig, StereoToPose
from torchpose.recording import Recording, open_recording
from torchpose.rendered import demo_recording
from torchpose.rerun_log import check_rerun
from torchpose.scaled import at_most
from torchpose.session import Session, is_interrupted, kept_warnings, settings_of, summary_table
from torchpose.settings import compose_config, config_groups
from torchpose.study import (
    THESIS_ACCURACY,
    count_material,
    run_study,
    study_notes,
    study_table,
    write_study,
)
from torchpose.terminal import coloured, width
from torchpose.version import __version__

PACKAGE = Path(__file__).resolve().parent
# Inside the wheel, or beside the package in a checkout.
CONFIGS = PACKAGE / "configs" if (PACKAGE / "configs").is_dir() else PACKAGE.parent / "configs"

BAD_INPUT = 2  # exit codes
INTERRUPTED = 130

Kind = Literal["infer", "train"]


@dataclass(frozen=True)
class InferConfig:
    """Recover a person's joint angles from a recording by a stereo or depth camera."""

    # folder, side-by-side stereo video, left video, camera:0 (side by side) or camera:0+1; null: the package makes one
    recording: str | None = None
    right: str | None = None  # the right video, where `recording` is the left one
    calibration: str | None = None  # its file, instead of the folder's own; a video or a camera needs one
    background: str | None = None  # folder with images of the empty scene, instead of the folder's own
    output: str = "runs/infer"  # folder for the results
    max_frames: int | None = None  # take only the first so many frames; record_first needs it
    record_first: bool = (
        False  # a camera is recorded, max_frames of it, and then run, instead of followed live
    )
    max_width: int = 800  # px; wider images are shrunk as they are read, and are matched much faster
    align: bool = True  # move the right images' rows onto the left's where they are more than 0.25 px apart
    fresh: bool = False  # start over instead of continuing an interrupted run
    viz: bool = False  # write poses.rrd for the Rerun viewer, too; needs the extra viz
    seed: int = 0  # the same seed gives the same results
    device: str = "cpu"  # where to compute: cpu, cuda, cuda:1, mps
    threads: int = 1  # of the processor; more help only where cores are idle
    eyes: EyesConfig = field(default_factory=EyesConfig)
    pose: PoseConfig = field(default_factory=PoseConfig)
    people: PeopleConfig = field(default_factory=PeopleConfig)
    live: LiveConfig = field(default_factory=LiveConfig)
    export: ExportConfig = field(default_factory=ExportConfig)
    recognizer: str | None = (
        None  # folder of a trained one, runs/train/recognizers/angles: writes activities.csv
    )
    journal: str | None = (
        None  # SQLite file to which the activities are added, see python -m torchpose.journal --help
    )
    started: str | None = None  # local date and time of the first frame, 2026-11-23T08:30, for the journal
    person: str = "person"  # whose name the journal has
    diary: DiaryConfig = field(default_factory=DiaryConfig)

    def __post_init__(self) -> None:
        given = [name for name in ("right", "calibration", "background") if getattr(self, name) is not None]
        if self.recording is None and given:
            raise ValueError(f"{given[0]} must come with a recording, got none; give recording=PATH as well")
        if self.recording is not None and camera_numbers(self.recording) is not None:
            for name in ("calibration", "max_frames") if self.record_first else ("calibration",):
                if getattr(self, name) is None:
                    raise ValueError(f"{name} must be given for a camera, got null; add {name}=")
            if self.right is not None:
                raise ValueError(
                    f"right must be a video beside a left one, got {self.right} beside a camera; leave it out"
                )
        if self.max_frames is not None and self.max_frames < 1:
            raise ValueError(f"max_frames must be at least 1, got {self.max_frames}; null takes all frames")
        if self.max_width < 64:
            raise ValueError(
                f"max_width must be at least 64 px, got {self.max_width}; 640 to 1280 make sense"
            )
        self._check_journal()
        if self.viz:
            check_rerun()
        _check_machine(self.seed, self.threads)

    def _check_journal(self) -> None:
        if self.journal is None:
            return
        for name in ("recognizer", "started"):
            if getattr(self, name) is None:
                raise ValueError(f"{name} must be given for a journal, got null; add {name}=")
        self.beginning()

    def beginning(self) -> datetime | None:
        """When the recording started; ValueError where `started` is no local date and time."""
        if self.started is None:
            return None
        try:
            begin = datetime.fromisoformat(self.started)
        except ValueError:
            begin = None
        if begin is None or begin.tzinfo is not None:
            raise ValueError(
                f"started must be a local date and time such as 2026-11-23T08:30, got {self.started!r}"
            )
        return begin


@dataclass(frozen=True)
class TrainConfig:
    """Train and score the activity recogniser, and compare its features."""

    output: str = "runs/train"  # folder for the results
    fresh: bool = False  # start over instead of continuing an interrupted run
    seed: int = 0  # of the recogniser's starts; the same seed gives the same results
    device: str = "cpu"  # where to observe the recordings: cpu, cuda, cuda:1, mps
    threads: int = 1  # of the processor; more help only where cores are idle
    workers: int = 2  # processes that make the database, each with one thread and up to 0.7 GB of memory
    # feature sets to compare: angles, directions, pca, ica; of a skeleton data set: skeleton
    features: tuple[FeatureKind, ...] = (FeatureKind.pca, FeatureKind.ica, FeatureKind.angles)
    split: Split = Split.half_subjects  # of a skeleton data set; our own has test people of its own
    splits: int = 5  # of half_subjects: how often the training half is drawn
    data: DataConfig = field(default_factory=DataConfig)
    recognizer: RecognizerConfig = field(default_factory=RecognizerConfig)
    eyes: EyesConfig = field(default_factory=EyesConfig)
    pose: PoseConfig = field(default_factory=PoseConfig)

    def __post_init__(self) -> None:
        if not self.features or len(set(self.features)) < len(self.features):
            names = ", ".join(kind.value for kind in self.features)
            raise ValueError(f"features must be one or more, each once, got {names or 'none'}; name some")
        if self.splits < 1:
            raise ValueError(f"splits must be at least 1, got {self.splits}; 5 is usual")
        if self.workers < 1:
            raise ValueError(
                f"workers must be at least 1, got {self.workers}; one for each idle core is good"
            )
        if self.recognizer.feature.kind is not FeatureKind.angles or self.recognizer.seed != 0:
            raise ValueError(
                "recognizer.feature.kind and recognizer.seed must be left alone, as each of `features` and `seed` take "
                f"their places, got {self.recognizer.feature.kind.value} and {self.recognizer.seed}"
            )
        _check_machine(self.seed, self.threads)


CONFIG_TYPES: dict[Kind, type[InferConfig] | type[TrainConfig]] = {"infer": InferConfig, "train": TrainConfig}


@overload
def load_config(kind: Literal["infer"], overrides: Sequence[str] = ()) -> InferConfig: ...
@overload
def load_config(kind: Literal["train"], overrides: Sequence[str] = ()) -> TrainConfig: ...
@overload
def load_config(kind: Kind, overrides: Sequence[str] = ()) -> InferConfig | TrainConfig: ...
def load_config(kind: Kind, overrides: Sequence[str] = ()) -> InferConfig | TrainConfig:
    """The configuration of a command: the defaults, then `configs/{kind}.yaml`, then `overrides`.

    An override is `key=value`, with dots between the levels, or `group=NAME`, which takes
    `configs/group/NAME.yaml`. Raises ValueError, in one sentence, for an unknown key or a wrong value.
    """
    return compose_config(CONFIG_TYPES[kind], CONFIGS, kind, overrides)


def help_text(kind: Kind, whole: bool = False) -> str:
    """What `--help` prints, or `--help-all` for the `whole`, see `torchpose.manual`."""
    config = load_config(kind)
    text = full_help(kind, config, config_groups(CONFIGS, kind)) if whole else short_help(kind, config)
    return f"{text}\n"


def infer_main(argv: Sequence[str]) -> int:
    """`python infer.py`: returns the exit code, see `run_command`."""
    return run_command("infer", argv, infer)


def train_main(argv: Sequence[str]) -> int:
    """`python train.py`: returns the exit code, see `run_command`."""
    return run_command("train", argv, train)


def infer(config: InferConfig, device: torch.device) -> None:
    """Recover the poses of a recording, and write and print the results."""
    with kept_warnings() as told:
        _infer(config, device, told)


def _infer(config: InferConfig, device: torch.device, told: list[str]) -> None:
    output, settings = Path(config.output), settings_of(config)
    activities = _activities(config)
    camera = None if config.recording is None else camera_numbers(config.recording)
    live = camera is not None and not config.record_first
    pose = (
        replace(config.pose, smoothing=config.live.smoothing(config.pose.smoothing)) if live else config.pose
    )

    def session_of(recording: Recording, rows_before: float | None) -> Session:
        model = StereoToPose(recording.camera, config.eyes, pose).to(device)
        people = People(model, config.people)
        export, viz = config.export, config.viz
        return Session(people, recording, output, settings, __version__, rows_before, export, told, viz)

    if camera is not None and live:
        summary = _follow_live(config, camera, output, session_of)
    else:
        recording, rows_before = _open(config, output)
        summary = session_of(recording, rows_before).run(config.fresh, config.max_frames)
    print(summary_table(summary, output, width()))
    if activities is not None:
        print(activity_lines(activities.write(output, BodyModel(config.pose.body), str(output.resolve()))))


def _open(config: InferConfig, output: Path) -> tuple[Recording, float | None]:
    """The recording with its rows corrected and its images shrunk, and how far apart its rows were, px."""
    if config.recording is None:
        print("no recording given: making one (recording=DIR runs yours)")
        recording: Recording = demo_recording(config.seed)
    else:
        config = _captured(config, output)
        assert config.recording is not None
        recording = open_recording(config.recording, config.right, config.calibration, config.background)
    config.export.check_rate(recording.camera.frame_rate)
    require_writable(output)
    rows_before = None
    if config.align:
        recording = align_recording(recording)
        if isinstance(recording, AlignedRecording):
            shrunk = min(1.0, config.max_width / recording.camera.width)
            rows_before = recording.alignment.typical * shrunk
    return at_most(recording, config.max_width), rows_before


def _follow_live(
    config: InferConfig,
    camera: tuple[int, ...],
    output: Path,
    session_of: Callable[[Recording, float | None], Session],
) -> dict[str, Any]:
    """The summary of a camera that is followed live, or of the files of one that was before they could be written."""
    assert config.calibration is not None
    folder, interrupted = output / "recording", is_interrupted(output, settings_of(config), __version__)
    live = LiveRun(
        folder,
        Path(config.calibration),
        config.live,
        session_of,
        config.max_width,
        config.align,
        config.background,
        config.max_frames,
    )
    if interrupted and folder.is_dir() and not config.fresh:
        summary = live.resume()
        if summary is not None:
            return summary
    devices = open_cameras(camera)
    try:
        require_writable(output)
        if config.fresh:
            shutil.rmtree(folder, ignore_errors=True)
        return live.run(devices)
    finally:
        for device in devices:
            device.release()


def _activities(config: InferConfig) -> ActivityWriter | None:
    """What tells the activities, where the configuration names a recogniser."""
    if config.recognizer is None:
        return None
    return ActivityWriter(config.recognizer, config.diary, config.journal, config.person, config.beginning())


def _captured(config: InferConfig, output: Path) -> InferConfig:
    """The configuration that runs what was recorded into `output`, where the recording is a live camera.

    What an interrupted run of the same command has recorded is not recorded again.
    """
    assert config.recording is not None
    numbers = camera_numbers(config.recording)
    if numbers is None:
        return config
    assert config.calibration is not None
    assert config.max_frames is not None
    folder = output / "recording"
    recorded = replace(config, recording=str(folder), calibration=None, background=None)
    interrupted = folder.is_dir() and is_interrupted(output, settings_of(config), __version__)
    if interrupted and not config.fresh:
        print(f"going on with {folder}; fresh=true records anew")
        return recorded
    devices = open_cameras(numbers)
    if config.fresh:
        shutil.rmtree(folder, ignore_errors=True)
    print(f"recording {config.max_frames} frames into {folder}, Ctrl-C ends it")
    try:
        capture = capture_recording(devices, folder, config.calibration, config.max_frames, config.background)
    finally:
        for device in devices:
            device.release()
    print(f"recorded {capture.frames} frames in {capture.seconds:.1f} s, {capture.dropped} dropped")
    return recorded


def train(config: TrainConfig, device: torch.device) -> None:
    """Train and score the activity recogniser, and write and print the results."""
    begin = time.perf_counter()
    require_writable(Path(config.output))
    clips, folds, notes = _material(config, device)
    prepared = time.perf_counter() - begin
    scores = run_study(clips, folds, config.features, replace(config.recognizer, seed=config.seed))
    about = {
        "version": __version__,
        "settings": settings_of(config),
        "seed": config.seed,
        "data": count_material(clips, folds, config.recognizer.hmm.states) | notes,
        "seconds": {"data": prepared, "all": time.perf_counter() - begin},
    }
    output = Path(config.output)
    write_study(output, scores, about)
    thesis = THESIS_ACCURACY if config.data.path is None else {}
    print(study_table(scores, thesis, shutil.get_terminal_size().columns))
    print(f"\n{study_notes(about)}\nresults        {output}/ results.json, confusion.png, recognizers/")


def _material(
    config: TrainConfig, device: torch.device
) -> tuple[Sequence[Clip], Sequence[Fold], dict[str, float]]:
    """The clips, how they are divided, and what is known of their quality."""
    of_skeletons = [kind is FeatureKind.skeleton for kind in config.features]
    names = ", ".join(kind.value for kind in config.features)
    if config.data.path is None:
        if any(of_skeletons):
            raise ValueError(
                f"data.path must be a skeleton data set for the features [{names}], got null; give data.path=FILE.npz, "
                "or other features"
            )
        maker = ClipMaker(config.data, config.eyes, config.pose, str(device))
        database = build_database(maker, config.workers, config.fresh)
        return database.clips, [database.fold], {"angle_error_deg": math.degrees(database.mean_angle_error)}
    if not all(of_skeletons):
        raise ValueError(
            f"features must be [skeleton] for a skeleton data set, got [{names}]; add experiment=skeleton"
        )
    clips = read_skeletons(config.data.path)
    return clips, split_clips(clips, config.split, config.splits, config.seed), {}


def run_command(kind: Kind, argv: Sequence[str], action: Callable[[Any, torch.device], None]) -> int:
    """Run `action` with the configuration that `argv` describes, and its device; returns the exit code.

    0: done. 2: the input is at fault, and a sentence on stderr says how. 130: interrupted, by Ctrl-C or by SIGTERM. An
    error that the package did not raise itself is a fault of ours, and goes on with its traceback. `--fresh` is
    `fresh=true`.
    """
    try:
        if {"-h", "--help", "--help-all"} & set(argv):
            print(help_text(kind, "--help-all" in argv), end="")
            return 0
        config = load_config(kind, ["fresh=true" if word == "--fresh" else word for word in argv])
        torch.set_num_threads(config.threads)
        torch.manual_seed(config.seed)
        with warnings.catch_warnings(), _interruptible():
            warnings.showwarning = lambda message, *_, **__: _say("warning", "yellow", message)
            action(config, find_device(config.device))
    except KeyboardInterrupt:
        print("\ninterrupted: the same command again goes on where this one stopped", file=sys.stderr)
        return INTERRUPTED
    except OSError as error:
        _say("error", "red", f"{error.filename}: {error.strerror}" if error.filename else error)
        return BAD_INPUT
    except ValueError as error:
        if not _raised_by_the_package(error):
            raise
        _say("error", "red", error)
        return BAD_INPUT
    return 0


def _say(kind: str, colour: str, message: object) -> None:
    print(f"{coloured(f'{kind}:', colour, sys.stderr)} {message}", file=sys.stderr)


@contextmanager
def _interruptible() -> Iterator[None]:
    """SIGTERM, as sent by batch systems and at shutdown, is taken like Ctrl-C, so that nothing half written stays."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def find_device(name: str) -> torch.device:
    """The device called `name`; ValueError where this machine has none."""
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:  # torch without CUDA asserts
        raise ValueError(
            f"device must be one that this machine has, got {name!r}; device=cpu works everywhere"
        ) from error


def _check_machine(seed: int, threads: int) -> None:
    if seed < 0:
        raise ValueError(f"seed must be 0 or more, got {seed}; choose another")
    if threads < 1:
        raise ValueError(f"threads must be at least 1, got {threads}; 1 is the default")


def _raised_by_the_package(error: BaseException) -> bool:
    traceback = error.__traceback__
    while traceback is not None and traceback.tb_next is not None:
        traceback = traceback.tb_next
    return traceback is not None and PACKAGE in Path(traceback.tb_frame.f_code.co_filename).resolve().parents
