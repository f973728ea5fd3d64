"""Files that are there whole or not at all: written beside their place, then renamed into it."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_FULL = (errno.ENOSPC, errno.EDQUOT)
_PROBE = 2**16  # bytes, which a full disk does not take


class UnwritableFile(OSError):
    """A file cannot be written. One sentence: which, why, and what to do. What stood there before still stands."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path`, with its suffix; renamed to `path` when the block ends without error.

    After an error, or an interruption, the temporary file is removed and what stood at `path` still stands.
    The folder is made if need be. Raises UnwritableFile where the folder cannot be written or its disk is full.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(path, error) from error
    partial = path.with_name(f".{path.stem}.partial{path.suffix}")
    try:
        yield partial
        os.replace(partial, path)
    except OSError as error:
        # Of another file: whatever the block reads.
        if isinstance(error, UnwritableFile) or error.filename not in (None, str(partial), partial):
            raise
        raise unwritable(path, error) from error
    except ValueError as error:  # zipfile's, when it closes what the disk had no room for
        if not isinstance(error.__context__, OSError) or error.__context__.errno not in _FULL:
            raise
        raise unwritable(path, error.__context__) from error
    finally:
        partial.unlink(missing_ok=True)


def unwritable(path: Path, error: OSError) -> UnwritableFile:
    """What to tell of a file that could not be written because of `error`."""
    reason = error.strerror or str(error)
    if error.errno in _FULL:
        remedy = "free some space there and give the same command again, or choose another folder"
    else:
        remedy = "choose a folder in which you may write"
    return UnwritableFile(f"{path} must be written, got: {reason}; {remedy}")


def require_writable(folder: Path) -> None:
    """Raise UnwritableFile unless a file can be written into `folder`, which is made if need be."""
    probe = folder / ".probe"
    try:
        with replacing(probe) as partial:
            partial.write_bytes(bytes(_PROBE))
    except UnwritableFile as error:
        cause = error.__cause__
        raise unwritable(folder, cause if isinstance(cause, OSError) else error) from error
    probe.unlink()
