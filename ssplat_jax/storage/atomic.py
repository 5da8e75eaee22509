"""Files that are there completely or not at all."""

import contextlib
import os
from pathlib import Path

from ssplat_jax.errors import StorageError


def write_atomic(path: str | os.PathLike, data: bytes, *, keep_previous: bool = False) -> None:
    """Puts `data` at `path`; whoever opens `path`, at any time, finds the old file or the new one.

    The bytes go to `<name>.partial` in the same folder, to the disk, and then take the name in one step. A process
    killed on the way leaves that file behind; the next write overwrites it.

    Args:
        path: where to; its folder is made.
        data: the whole file.
        keep_previous: what was at `path` stays as `previous_path(path)`. Between the two renames there is no `path`:
            readers then look there.

    Raises:
        StorageError: the folder cannot be made or the file not written; what was at `path` is there as before (or,
            if all that failed is making the new name durable, the whole new file).
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
        _sync_directory(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
            if moved:
                os.replace(previous_path(path), path)
        raise StorageError(
            f"{path}: cannot be written ({error.strerror or error}); free some space or choose another place."
        ) from error


def previous_path(path: str | os.PathLike) -> Path:
    """Where the file before the one at `path` is kept."""
    return Path(path).with_name(Path(path).name + ".previous")


def _sync_directory(directory: Path) -> None:
    """Makes the renames themselves durable."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
