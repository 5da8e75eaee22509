"""Atomic file writes: a reader finds the complete old file or the complete new one."""

import contextlib
import os
from pathlib import Path

from ssplat_jax.core.errors import StorageError


def write_atomic(path: str | os.PathLike, data: bytes, *, keep_previous: bool = False) -> None:
    """Writes `data` to `path` atomically: `path` always holds the old file or the complete new one.

    The bytes are written to `<name>.partial` in the same folder, synced to the disk, and renamed. A process that is
    killed during the write leaves the partial file behind; the next write overwrites it.

    Args:
        path: the file to write; missing folders are created.
        data: the contents of the file.
        keep_previous: keep the old file at `previous_path(path)`. Between the two renames `path` does not exist, so
            readers have to fall back on the previous file.

    Raises:
        StorageError: the folder cannot be created or the file cannot be written. `path` then holds the old file, or
            the complete new file if only syncing the folder failed.
    """
    path = Path(path)
    partial = path.with_name(path.name + ".partial")
    moved = False
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if keep_previous and path.exists():
            os.replace(path, previous_path(path))
            moved = True
        os.replace(partial, path)
        moved = False
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)  # so that the renames survive a power failure
        finally:
            os.close(folder)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
            if moved:
                os.replace(previous_path(path), path)
        reason = error.strerror or error
        raise StorageError(f"{path}: cannot be written ({reason}); free some space or choose another place.") from error


def previous_path(path: str | os.PathLike) -> Path:
    """Path at which `write_atomic` keeps the previous version of `path`."""
    return Path(path).with_name(Path(path).name + ".previous")
