"""Files that are there completely or not at all."""

import contextlib
import os
import tempfile
from pathlib import Path

from ssplat_jax.errors import StorageError


def write_atomic(path: str | os.PathLike, data: bytes) -> None:
    """Puts `data` at `path`; whoever opens `path`, at any time, finds the old file or the new one.

    The bytes go to a temporary file in the same folder, to the disk, and then take the name in one step.

    Raises:
        StorageError: the folder cannot be made or the file not written; what was at `path` is untouched.
    """
    path = Path(path)
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        # mkstemp makes private files; a scene is as readable as the user's other files.
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except OSError as error:
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
        raise StorageError(
            f"{path}: cannot be written ({error.strerror or error}); free space or choose another place."
        ) from error


def _umask() -> int:
    """The process's file mode mask, which can only be read by setting it."""
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
