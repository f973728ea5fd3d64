"""The motion for other programs, beside `poses.csv`: which files, and what smooths them."""

import math
import warnings
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body.model import BodyModel
from torchpose.bvh import GAP, write_bvh
from torchpose.c3d_file import check_c3d, write_c3d
from torchpose.export import PoseSequence, write_poses_csv
from torchpose.level import level_sequence
from torchpose.opensim import write_mot, write_trc
from torchpose.trajectory_filter import FilterKind, filter_sequence, usual_rate
from torchpose.vision.floor import Floor


class ExportFormat(Enum):
    """A kind of file, by its suffix."""

    mot = "mot"  # OpenSim coordinates
    trc = "trc"  # OpenSim markers
    bvh = "bvh"  # a moving skeleton
    c3d = "c3d"  # markers, for motion laboratories


@dataclass(frozen=True)
class ExportConfig:
    # files beside poses.csv: mot and trc (OpenSim), bvh (Blender and others), c3d (needs pip install 'torchpose[c3d]')
    formats: tuple[ExportFormat, ...] = (ExportFormat.mot, ExportFormat.trc, ExportFormat.bvh)
    # what smooths them: none, butterworth (no delay), one_euro, rts; also writes poses_filtered.csv
    filter: FilterKind = FilterKind.none
    cutoff: float = 6.0  # Hz, of butterworth and rts: faster movement is taken for noise
    order: int = 4  # of butterworth, both passes together
    min_cutoff: float = 1.0  # Hz, of one_euro at rest
    beta: float = 2.0  # Hz for each m/s or rad/s, of one_euro: greater follows faster
    speed_cutoff: float = 1.0  # Hz, of the speed in one_euro
    level: bool = True  # these files stand upright on the floor if it is seen, else in the camera's frame
    gap: float = GAP  # s; a BVH file bridges frames without a pose between two that are no further apart

    def __post_init__(self) -> None:
        if len(set(self.formats)) < len(self.formats):
            names = ", ".join(kind.value for kind in self.formats)
            raise ValueError(f"formats must be different, got {names}; name each once")
        for name in ("cutoff", "min_cutoff", "speed_cutoff"):
            if not getattr(self, name) > 0:
                raise ValueError(
                    f"{name} must be positive, got {getattr(self, name)} Hz; see --help for the default"
                )
        for name in ("beta", "gap"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}; 0 is none")
        if self.order < 2 or self.order % 2:
            raise ValueError(
                f"order must be even and at least 2, as half of it runs each way, got {self.order}; 4 is usual"
            )
        if ExportFormat.c3d in self.formats:
            check_c3d()

    def check_rate(self, rate: float) -> None:
        """ValueError where a camera of `rate` frames a second is too slow for the filter."""
        if self.filter is FilterKind.butterworth and self.cutoff >= rate / 2:
            raise ValueError(
                f"export.cutoff must be below half of the {rate:g} frames a second, got {self.cutoff:g} Hz; "
                f"{min(6.0, rate / 5):g} would do"
            )


def export_motion(
    folder: Path,
    mark: str,
    sequence: PoseSequence,
    body: BodyModel,
    size: Float[Tensor, "1 sizes"],
    config: ExportConfig,
    floor: Floor | None = None,
) -> dict[str, Any]:
    """Write `poses{mark}.mot` and its like into `folder`; with a filter, `poses{mark}_filtered.csv` too.

    The files for other programs stand on the `floor` where it is known; the table stays in the left camera's frame.
    Returns, for each file that may not hold every pose, which is the BVH, its first frame, its number of frames, and
    how many of the recording's frames with a pose it leaves out.
    """
    later = sequence.time_s.cpu() > torch.cat(
        [torch.tensor([-math.inf]), sequence.time_s.cpu().cummax(0)[0][:-1]]
    )
    sequence = sequence[later.nonzero()[:, 0]]  # other programs know one frame of a moment
    rate = usual_rate(sequence.time_s.double().numpy(force=True))
    if (
        config.filter is FilterKind.butterworth and config.cutoff >= rate / 2
    ):  # of a camera that dropped half its frames
        warnings.warn(
            f"export.cutoff must be below half of the {rate:g} frames a second that were recorded, got "
            f"{config.cutoff:g} Hz; poses{mark} is not filtered, tp.filter_sequence can do it with a lower cutoff",
            stacklevel=2,
        )
    elif config.filter is not FilterKind.none:
        sequence = filter_sequence(
            sequence,
            config.filter,
            config.cutoff,
            config.order,
            config.min_cutoff,
            config.beta,
            config.speed_cutoff,
        )
        write_poses_csv(folder / f"poses{mark}_filtered.csv", sequence)
    if config.level and floor is not None:
        sequence = level_sequence(sequence, floor)
    notes: dict[str, Any] = {}
    for kind in config.formats:
        path = folder / f"poses{mark}.{kind.value}"
        if kind is ExportFormat.mot:
            write_mot(path, sequence)
        elif kind is ExportFormat.trc:
            write_trc(path, sequence)
        elif kind is ExportFormat.c3d:
            write_c3d(path, sequence)
        else:
            written = write_bvh(path, sequence, body, size, config.gap)
            held = set(written.frame.tolist())
            out = sum(
                answered and frame not in held
                for frame, answered in zip(sequence.frame.tolist(), sequence.answered, strict=True)
            )
            notes[path.name] = {
                "first_frame": int(written.frame[0]) if len(written) else None,
                "frames": len(written),
                "left_out": out,
            }
    return notes
