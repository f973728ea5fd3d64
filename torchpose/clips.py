"""The clips of the package's own database: each performance is rendered, run through the pipeline, and kept in a cache.

What a clip holds is estimated from the images; the truth serves only to say how far off the estimates are. Radians.
"""

import functools
import hashlib
import io
import json
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from torchpose.activity.dataset import Clip, Fold
from torchpose.activity.subspace import Crop, SilhouetteConfig, resize_silhouettes
from torchpose.atomic import replacing
from torchpose.body.angle import limb_angles
from torchpose.body.model import BodyModel
from torchpose.eyes import EyesConfig
from torchpose.pipeline import PoseConfig, StereoToPose
from torchpose.rendered import RenderedRecording
from torchpose.session import settings_of
from torchpose.synthesis.database import DatabaseConfig, PlannedClip, plan_database
from torchpose.version import __version__

# What comes after the clips, and does not change them.
_AFTER_CLIPS = (
    *("activities.py", "activity/", "configs/", "cli.py", "export.py", "figures.py", "journal.py"),
    *("session.py", "study.py", "timeline.py"),
)
_STREAMS = ("pose", "directions", "silhouettes", "joints", "pose_sd")
_ARRAYS = (*_STREAMS, "angle_error")  # of a clip's file
_TELL = 20.0  # s between lines that say how far it is, where no bar can be drawn


@dataclass(frozen=True)
class DataConfig:
    """What the recogniser learns from."""

    path: str | None = None  # an .npz of skeletons; null: the database that the package makes itself
    cache: str = "runs/cache"  # folder for what was computed from each recording of this database
    silhouette_height: int = 120  # px, at which silhouettes are kept; a person fills about three quarters
    database: DatabaseConfig = field(default_factory=DatabaseConfig)

    def __post_init__(self) -> None:
        if self.silhouette_height < 1:
            raise ValueError(f"silhouette_height must be at least 1 px, got {self.silhouette_height}")


@dataclass(frozen=True)
class ObservedClip:
    """What the pipeline made of one performance."""

    clip: Clip
    # rad, of the estimated limb angles to the truth; NaN in frames without a pose.
    angle_error: Float[Tensor, "time limb_angles"]


@dataclass(frozen=True)
class Database:
    """The clips, and which of them train."""

    observed: tuple[ObservedClip, ...]
    fold: Fold

    @property
    def clips(self) -> list[Clip]:
        """The clips alone, in the order of the plan."""
        return [observed.clip for observed in self.observed]

    @property
    def mean_angle_error(self) -> float:
        """How far the estimated limb angles are from the truth, rad (T. 5.1); NaN where no pose was found."""
        return float(torch.cat([observed.angle_error for observed in self.observed]).nanmean())


@functools.cache
def _code_version() -> str:
    """The package's version and a digest of the code that makes clips, so that whoever changes it gets new ones."""
    package = Path(__file__).resolve().parent
    digest = hashlib.sha256()
    for path in sorted((*package.rglob("*.py"), *package.rglob("*.yaml"))):
        name = path.relative_to(package).as_posix()
        if not name.startswith(_AFTER_CLIPS):
            digest.update(f"{name}\n".encode() + path.read_bytes())
    return f"{__version__}+{digest.hexdigest()[:16]}"


@functools.cache
def _actors_body() -> BodyModel:
    """The body of those who perform; to build it takes as long as to render five frames."""
    return BodyModel()


@dataclass(frozen=True)
class ClipMaker:
    """Everything that a clip depends on; goes whole to another process."""

    data: DataConfig = field(default_factory=DataConfig)
    eyes: EyesConfig = field(default_factory=EyesConfig)
    pose: PoseConfig = field(default_factory=PoseConfig)
    device: str = "cpu"
    version: str = field(default_factory=_code_version)  # of the code that runs

    def path(self, planned: PlannedClip) -> Path:
        """Where the cache keeps a clip: the name changes with the version and with all that the clip depends on."""
        settings = [settings_of(self.eyes), settings_of(self.pose), self.data.silhouette_height]
        key = planned.key(self.data.database, self.version, *map(json.dumps, settings))
        return Path(self.data.cache) / f"{key}.npz"

    @torch.no_grad()
    def make(self, planned: PlannedClip) -> ObservedClip:
        """Render a performance and observe it as any other recording."""
        synthetic = planned.record(self.data.database, _actors_body())
        recording = RenderedRecording(synthetic)
        model = StereoToPose(recording.camera, self.eyes, self.pose).to(self.device)
        model.prepare(recording)
        height, width = recording.camera.height, recording.camera.width
        kept = min(self.data.silhouette_height, height)
        small = SilhouetteConfig(height=kept, width=round(kept * width / height), crop=Crop.image)
        silhouettes, frames = [], []
        for frame in model(recording):
            assert frame.sight is not None  # rendered frames can be read
            silhouettes.append(resize_silhouettes(frame.sight.silhouette, small) > 0.5)
            frames.append(replace(frame, sight=None))  # its images are large
        sequence = model.sequence(frames)
        assert sequence.pose is not None
        assert sequence.pose_covariance is not None
        pose = sequence.pose.cpu()
        found = ~pose.isnan().any(1)
        directions = pose.new_full((len(pose), len(model.body.body_names) - 1, 3), torch.nan)
        posed = model.body(sequence.pose[found.to(sequence.pose.device)], model.size)
        directions[found] = model.body.limb_directions(posed).cpu()
        covariance = sequence.pose_covariance
        assert covariance is not None
        clip = Clip(
            planned.activity,
            str(planned.subject),
            str(planned.take),
            pose=pose,
            directions=directions,
            silhouettes=torch.cat(silhouettes).cpu(),
            joints=sequence.joints.cpu(),
            joint_names=model.body.joint_names,
            pose_sd=covariance.diagonal(dim1=1, dim2=2).sqrt().cpu(),
        )
        error = (sequence.limb_angles.cpu() - limb_angles(synthetic.joints)).abs()
        return ObservedClip(clip, error)

    def store(self, planned: PlannedClip) -> None:
        """Make a clip and put it into the cache, whole or not at all."""
        observed = self.make(planned)
        streams = [observed.clip.stream(name) for name in _STREAMS]
        arrays = [stream.numpy() for stream in (*streams, observed.angle_error)]
        with replacing(self.path(planned)) as partial:
            np.savez_compressed(partial, allow_pickle=False, **dict(zip(_ARRAYS, arrays, strict=True)))

    def find(self, planned: PlannedClip) -> ObservedClip | None:
        """The clip in the cache; None where it is not there or its file is damaged."""
        path = self.path(planned)
        return read_clip(planned, path) if path.exists() else None


def read_clip(planned: PlannedClip, path: Path) -> ObservedClip | None:
    """What a file of the cache holds of a performance, whatever made it; None where the file is damaged."""
    content = io.BytesIO(path.read_bytes())
    try:
        with np.load(content) as archive:
            streams = {name: torch.from_numpy(archive[name]) for name in _STREAMS}
            error = torch.from_numpy(archive["angle_error"])
    except Exception:  # zipfile, zlib and NumPy's own parser each complain of damage in their own words
        return None
    names = _actors_body().joint_names
    clip = Clip(planned.activity, str(planned.subject), str(planned.take), joint_names=names, **streams)
    return ObservedClip(clip, error)


def build_database(maker: ClipMaker, workers: int = 2, fresh: bool = False) -> Database:
    """The planned clips, from the cache or else made and cached, `workers` at a time with a thread each.

    An interrupted build goes on with the clips that are missing; `fresh` makes all of them again.
    """
    plan = plan_database(maker.data.database)
    found = {planned: None if fresh else maker.find(planned) for planned in plan}
    missing = [planned for planned in plan if found[planned] is None]
    with tqdm(
        total=len(plan),
        initial=len(plan) - len(missing),
        desc="recordings",
        disable=not sys.stderr.isatty(),
        leave=False,
    ) as bar:
        begin = told = time.monotonic()
        for number, planned in enumerate(_stored(maker, missing, workers), 1):
            found[planned] = maker.find(planned)
            bar.set_postfix_str(planned.activity)
            bar.update()
            if bar.disable and time.monotonic() - told > _TELL:
                told = time.monotonic()
                done = len(plan) - len(missing) + number
                print(
                    f"recordings: {done} of {len(plan)} after {told - begin:.0f} s",
                    file=sys.stderr,
                    flush=True,
                )
    observed = [found[planned] for planned in plan]
    assert all(clip is not None for clip in observed)
    train, test = (
        tuple(i for i, planned in enumerate(plan) if planned.split == split) for split in ("train", "test")
    )
    return Database(tuple(clip for clip in observed if clip is not None), Fold(train, test))


def _stored(maker: ClipMaker, plan: Sequence[PlannedClip], workers: int) -> Iterator[PlannedClip]:
    """The clips of the plan, each as soon as it is in the cache."""
    workers = min(workers, len(plan))
    if workers <= 1:
        for planned in plan:
            maker.store(planned)
            yield planned
        return
    # A forked process would inherit torch's threads in any state; a spawned one starts clean.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, _be_one_of_many)
    try:
        running = {pool.submit(maker.store, planned): planned for planned in plan}
        for job in as_completed(running):
            job.result()
            yield running[job]
    finally:
        pool.shutdown(cancel_futures=True)


def _be_one_of_many() -> None:
    """A worker has one thread to compute with, and ends at once and without a word when the whole does."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Whoever is killed cannot tell its workers, and they would wait for work for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
