"""What every test stands on: one thread, one seed, and the shared recordings where they are."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: two threads on busy cores are slower than one

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import settings

torch.set_num_threads(1)
# The same examples every time, and no failures because another process was busy.
settings.register_profile("torchpose", derandomize=True, deadline=None)
settings.load_profile("torchpose")


@pytest.fixture(autouse=True)
def seed() -> int:
    """Every test starts from the same random numbers, whichever ran before it."""
    torch.manual_seed(0)
    np.random.seed(0)  # noqa: NPY002  (the oracles' libraries draw from the global generator)
    return 0


@pytest.fixture
def shared_data() -> Path:
    """The folder of recordings by others, see its README; the test is skipped where it is absent."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("TORCHPOSE_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no folder {folder}; set TORCHPOSE_DATA to where the shared recordings are")
    return folder
