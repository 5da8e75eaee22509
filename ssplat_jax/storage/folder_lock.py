"""One process at a time in a folder that is written to over hours."""

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from ssplat_jax.errors import InputError, StorageError
from ssplat_jax.storage.folders import make_writable


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Holds `folder`, which is made if absent, against other processes that ask for the same.

    The system's lock on the folder itself: there is no file to be left behind, and it ends with its process, however
    that ends. If nothing was written, a folder made here is taken away again.

    Raises:
        InputError: another process holds it.
        StorageError: the folder cannot be made or written to, or its file system has no locks.
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
            with contextlib.suppress(OSError):  # not empty: the usual case
                folder.rmdir()
        os.close(descriptor)  # last: until then it is ours
