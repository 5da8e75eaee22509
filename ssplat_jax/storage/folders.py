"""Folders that results go to: found unwritable before the long part, and cleared of our own files only."""

import contextlib
import tempfile
from pathlib import Path

from ssplat_jax.errors import StorageError


def make_writable(folder: Path) -> None:
    """Makes `folder` if it is absent, and tries whether files can be made in it.

    Raises:
        StorageError: they cannot.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise StorageError(f"{folder}: cannot be written ({error.strerror or error}); choose another place.") from error


def remove_numbered(folder: Path, name: str) -> None:
    """Removes the files of `folder` called `name` with digits for its `#`, and the folder if nothing else is in it.

    A user's own files may stand beside them.

    Raises:
        StorageError: one cannot be removed.
    """
    try:
        for path in folder.glob(name.replace("#", "[0-9]")):
            path.unlink()
    except OSError as error:
        raise StorageError(f"{folder}: cannot be cleared ({error.strerror or error}); choose another place.") from error
    with contextlib.suppress(OSError):  # absent, or not empty
        folder.rmdir()
