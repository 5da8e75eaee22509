"""Result folders: the names of their files, which are written here and nowhere else, the lock on a folder, and signals.

The first Ctrl-C or SIGTERM is recorded, so that a command can save its state; a second one has its usual effect.
"""

import contextlib
import fcntl
import os
import signal
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

from ssplat_jax.core.atomic import previous_path
from ssplat_jax.core.errors import InputError, StorageError, refusal


class RunFolder:
    """The result folder of `ssplat run`, `demo`, `eval` or `render`; each writes some of these files.

    Only files of these names are ever removed; others in the folder are the user's.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.scene = path / "scene.ply"  # as it was streamed, in the capture's frame
        self.refined_scene = path / "refined.ply"  # the refined scene, in the capture's frame
        self.refinement = path / "refinement.json"  # losses and scores of the refinement
        self.refinement_state = path / "refinement.npz"  # from which a stopped refinement continues
        self.state = path / "state.npz"  # the saved stream, from which a stopped run continues
        self.adjusted_poses = path / "adjusted_poses.npz"  # the poses that were adjusted before the stream
        self.metrics = path / "metrics.json"  # facts and scores
        self.split = path / "split.json"  # the context and target frames of an evaluation
        self.index = path / "index.json"  # the same frames as an index file
        self.deltas = path / "deltas"  # folder with one file of scene changes per chunk
        self.chunk_records = path / "chunks"  # folder with one record per chunk
        self.report = path / "report.html"  # the report as one page
        self.views = path / "views"  # folder with one picture per rendered frame
        self.film = path / "film.mp4"

    @property
    def best_scene(self) -> Path:
        """The scene that a person is shown: the refined one if there is one, else the streamed one."""
        return self.refined_scene if self.refined_scene.is_file() else self.scene

    def delta(self, num_views: int) -> Path:
        """The scene changes of the chunk that brought the stream to `num_views` views."""
        return self.deltas / f"{num_views:06d}.npz"

    def delta_files(self) -> list[Path]:
        """All deltas in stream order; the list is empty if there is no such folder."""
        return _numbered(self.deltas, "######.npz")

    def chunk_record(self, num_views: int) -> Path:
        """The record of the chunk that brought the stream to `num_views` views."""
        return self.chunk_records / f"{num_views:06d}.json"

    def chunk_record_files(self) -> list[Path]:
        """All chunk records in stream order; the list is empty if there is no such folder."""
        return _numbered(self.chunk_records, "######.json")

    def view(self, i: int) -> Path:
        """The picture of frame `i`."""
        return self.views / f"{i:05d}.png"

    def target(self, i: int) -> Path:
        """The picture of target frame `i` of an evaluation or the demo: target | render | depth."""
        return self.path / f"view_{i:05d}.png"

    def has_state(self) -> bool:
        """True if a state, the newest or the one before it, is saved here."""
        return self.state.exists() or previous_path(self.state).exists()

    def check_no_run(self) -> None:
        """Checks that no run is saved here, for commands whose results would replace its files.

        Raises:
            InputError: there is one.
        """
        if self.has_state():
            fix = "choose another folder"
            raise refusal(f"--out {self.path}", wanted="a folder without a run", got="that of a run", fix=fix)

    def clear_run(self) -> None:
        """Removes the run that the folder holds."""
        self._remove(self.state, previous_path(self.state), self.scene, self.metrics, self.adjusted_poses, self.report)
        self.clear_refinement()
        self.clear_deltas()
        remove_numbered(self.chunk_records, "######.json")
        self.clear_views()

    def _remove(self, *files: Path) -> None:
        for file in files:
            file.unlink(missing_ok=True)

    def clear_refinement(self) -> None:
        """Removes the refinement; the streamed scene stays."""
        self._remove(self.refinement_state, self.refined_scene, self.refinement)

    def clear_deltas(self) -> None:
        """Removes all deltas."""
        remove_numbered(self.deltas, "######.npz")

    def clear_views(self) -> None:
        """Removes the pictures in `views`."""
        remove_numbered(self.views, "#####.png")

    def clear_targets(self) -> None:
        """Removes the pictures of targets."""
        remove_numbered(self.path, "view_#####.png", and_folder=False)


def _numbered(folder: Path, name: str) -> list[Path]:
    return sorted(folder.glob(name.replace("#", "[0-9]")))


def remove_numbered(folder: Path, name: str, *, and_folder: bool = True) -> None:
    """Removes files whose name is `name` with a digit for every `#`, and by default a folder that is empty then.

    Raises:
        StorageError: a file cannot be removed.
    """
    with _storage_errors(folder, "cleared"):
        for path in _numbered(folder, name):
            path.unlink()
    if and_folder:
        _remove_if_empty(folder)


def make_writable(folder: Path) -> None:
    """Creates `folder` if it is missing and checks that files can be created in it.

    Raises:
        StorageError: the folder cannot be created or written to.
    """
    with _storage_errors(folder, "written"):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass


@contextlib.contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Holds an exclusive lock on `folder`, which is created if missing: one process at a time writes to it.

    The lock is the operating system's (`flock`) on the folder itself: it needs no lock file, and it ends with the
    process even if that is killed. A folder that was created here and is still empty at the end is removed.

    Raises:
        InputError: another process holds the lock.
        StorageError: the folder cannot be created or written to, or its file system does not support locks.
    """
    is_new = not folder.exists()
    make_writable(folder)
    with contextlib.ExitStack() as stack:
        with _storage_errors(folder, "locked"):
            descriptor = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, descriptor)  # releases the lock, so it comes last
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                message = f"{folder}: another process is writing to it; wait until it ends, or choose another --out."
                raise InputError(message) from None
        if is_new:
            stack.callback(_remove_if_empty, folder)
        yield


@contextlib.contextmanager
def _storage_errors(folder: Path, done: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StorageError(f"{folder}: cannot be {done} ({error.strerror or error}); choose another place.") from error


def _remove_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):  # missing, or not empty
        folder.rmdir()


# -- interrupts --------------------------------------------------------------------------------------------------------


class Interrupts:
    """Context manager that records the first SIGINT or SIGTERM, so that the caller can save its state and exit.

    Attributes:
        received: number of the signal, or None. Always None outside the main thread, where Python does not allow
            signal handlers.
        has_work: False while there is nothing to save: Ctrl-C then has its usual effect at once, instead of after a
            compilation that may take a minute. The caller sets it when the first step is done.
    """

    def __init__(self, *, has_work: bool = True) -> None:
        self.received: int | None = None
        self.has_work = has_work
        self._previous: dict = {}

    def __enter__(self) -> "Interrupts":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(number) is signal.SIG_IGN:
                    continue  # as of a background job, which the shell has told to ignore Ctrl-C
                self._previous[number] = signal.signal(number, self._record)
        return self

    def _record(self, number, frame) -> None:
        previous = self._previous[number]
        if not self.has_work and callable(previous):
            previous(number, frame)
            return
        self.received = number
        signal.signal(number, previous)

    def __exit__(self, *_) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
