"""Exclusive lock on an output folder, so that two processes never write to the same one."""

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.storage.folders import make_writable


@contextlib.contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Holds an exclusive lock on `folder`, which is created if missing.

    The lock is the operating system's (`flock`) on the folder itself: it needs no lock file, and it ends with the
    process even if that is killed. A folder that was created here and is still empty at the end is removed.

    Raises:
        InputError: another process holds the lock.
        StorageError: the folder cannot be created or written to, or its file system does not support locks.
    """
    is_new = not folder.exists()
    make_writable(folder)
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise StorageError(f"{folder}: cannot be opened ({error.strerror or error}); choose another place.") from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(
                f"{folder}: another process is writing to it; wait until it ends, or choose another --out."
            ) from error
        except OSError as error:
            raise StorageError(
                f"{folder}: cannot be locked ({error.strerror or error}); choose another place."
            ) from error
        yield
    finally:
        if is_new:
            with contextlib.suppress(OSError):  # the folder is usually not empty
                folder.rmdir()
        os.close(descriptor)  # releases the lock, so it comes last
