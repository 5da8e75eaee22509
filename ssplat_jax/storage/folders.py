"""Output folders: a check that they are writable, and removal of numbered files from an earlier run."""

import contextlib
import tempfile
from pathlib import Path

from ssplat_jax.core.errors import StorageError


def make_writable(folder: Path) -> None:
    """Creates `folder` if it is missing and checks that files can be created in it.

    Raises:
        StorageError: the folder cannot be created or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise StorageError(f"{folder}: cannot be written ({error.strerror or error}); choose another place.") from error


def remove_numbered(folder: Path, name: str, *, and_folder: bool = True) -> None:
    """Removes numbered files from `folder`, and by default the folder itself if it is empty afterwards.

    Other files in the folder, such as the user's own, are kept.

    Args:
        folder: the folder to clear; it may be missing.
        name: file name in which each `#` stands for one digit, such as `#####.png`.
        and_folder: remove an empty folder too.

    Raises:
        StorageError: a file cannot be removed.
    """
    try:
        for path in folder.glob(name.replace("#", "[0-9]")):
            path.unlink()
    except OSError as error:
        raise StorageError(f"{folder}: cannot be cleared ({error.strerror or error}); choose another place.") from error
    if and_folder:
        with contextlib.suppress(OSError):  # missing, or not empty
            folder.rmdir()
