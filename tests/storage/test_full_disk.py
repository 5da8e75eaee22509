"""Runs on a full disk or with damaged state files end with exit code 3 or a warning, never with a wrong result.

The same command finishes the run once there is space. Every request to the disk fails once: opening a file for writing,
creating a folder and renaming (`refuse`), writing after some bytes (`write`), and syncing (`fsync`).
"""

import errno
import json
import os
import resource
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from ssplat_jax.commands.main import main
from ssplat_jax.core.atomic import previous_path, write_atomic
from ssplat_jax.core.errors import StorageError
from ssplat_jax.storage.saved_states import load_newest_state
from tests.commands.command_fixture import make_capture

NUM_CHUNKS, CHUNK_SIZE = 3, 2
FIELDS_OF_ONE_PROCESS = ("compile_s", "step_memory_bytes", "peak_memory_bytes")  # of metrics.json
KINDS = ("refuse", "write", "fsync")


# -- a disk that fails ------------------------------------------------------------------------------------------------


class Killed(BaseException):
    """Ends a run immediately, since the program does not catch it."""


FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class Disk:
    """Counts the disk requests of one kind for paths that begin with `prefix`; the `failing`-th one fails.

    For `write`, the kernel lets the file grow to `limit` bytes and no further; else `error` is raised.
    """

    def __init__(
        self, prefix: Path, kind: str, failing: int | None = None, limit: int = 0, error: BaseException = FULL
    ) -> None:
        self.prefix, self.kind, self.failing, self.limit, self.error = str(prefix), kind, failing, limit, error
        self.count = 0
        self.sizes: list[int] = []  # sizes of the written files, in order
        self.states_saved = 0  # number of states saved before the failure
        self.failed_file = ""

    def __enter__(self) -> "Disk":
        self._limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        self._fsync = os.fsync
        os.fsync = self._sync
        _watching.append(self)
        return self

    def __exit__(self, *_) -> None:
        _watching.remove(self)
        os.fsync = self._fsync
        resource.setrlimit(resource.RLIMIT_FSIZE, self._limits)

    def heard(self, event: str, arguments: tuple) -> None:
        """Handles an audit event, which precedes the operation; an exception prevents the operation."""
        if event not in ("open", "os.rename", "os.mkdir", "os.link", "os.truncate", "os.remove"):
            return
        path = str(arguments[0])
        if not path.startswith(self.prefix):
            return
        resource.setrlimit(resource.RLIMIT_FSIZE, self._limits)  # the file with the limit has been closed
        is_read = event == "open" and not arguments[2] & (os.O_WRONLY | os.O_RDWR)
        # These need no space; `make_writable` opens a folder to check that files can be created in it.
        if event == "os.remove" or is_read or (event in ("os.mkdir", "open") and os.path.isdir(path)):
            return
        if event == "open" and self.kind == "write" and self._is_next(path):
            resource.setrlimit(resource.RLIMIT_FSIZE, (self.limit, self._limits[1]))
        if self.kind == "refuse" and self._is_next(path):
            raise self.error
        if event == "os.rename" and path.endswith(".partial"):
            self.sizes.append(os.path.getsize(path))
            self.states_saved += path.endswith("state.npz.partial") and not self.failed_file

    def _sync(self, descriptor: int) -> None:
        if self.kind == "fsync" and self._is_next(os.readlink(f"/proc/self/fd/{descriptor}")):
            raise self.error
        self._fsync(descriptor)

    def _is_next(self, path: str) -> bool:
        self.count += 1
        if self.count != self.failing:
            return False
        self.failed_file = path
        return True


_watching: list[Disk] = []  # audit hooks cannot be removed, so one hook serves all


def _hook(event, arguments):
    for disk in _watching:
        disk.heard(event, arguments)


sys.addaudithook(_hook)


# -- a short run ------------------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _compiled_once(programs_shared, compiled_plainly):
    """All runs have the same configuration and size."""


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return make_capture(tmp_path_factory.mktemp("disk") / "capture", num_frames=NUM_CHUNKS * CHUNK_SIZE)


def run(capture: Path, out: Path) -> int:
    changes = (f"chunk_size={CHUNK_SIZE}", "min_confidence=0", "capacity=1024")  # a small cache is fast to render
    options = ("--save-every", "1", "--set", *changes, "--quiet")
    with pytest.raises(SystemExit) as stopped:
        main(["run", str(capture), "--out", str(out), "--refine", "0", *options])
    return int(stopped.value.code or 0)


@pytest.fixture
def undisturbed(capture, tmp_path):
    """Folder of an undisturbed run."""
    out = tmp_path / "undisturbed"
    assert run(capture, out) == 0
    return out


def contents(out: Path) -> dict[str, bytes | dict]:
    """Contents of all files below `out`, without damaged states and what depends on the process or its times."""
    files = [p for p in out.rglob("*") if p.is_file() and p.suffix != ".damaged"]
    found: dict[str, bytes | dict] = {str(p.relative_to(out)): p.read_bytes() for p in files}
    if "metrics.json" in found:
        metrics = json.loads(found["metrics.json"])
        found["metrics.json"] = {k: v for k, v in metrics.items() if k not in FIELDS_OF_ONE_PROCESS}
    for name in [name for name in found if name.startswith("chunks/")]:
        found[name] = {k: v for k, v in json.loads(found[name]).items() if k != "seconds"}
    if "report.html" in found:  # it shows the seconds of chunks
        found["report.html"] = found["report.html"][-10:]
    return found


def views_done(out: Path) -> int:
    state = out / "state.npz"
    if not state.exists() and not previous_path(state).exists():
        return 0
    return load_newest_state(state)[1]["done"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_full_disk_at_any_write_loses_no_saved_state(kind, capture, undisturbed, tmp_path, capsys):
    with Disk(tmp_path / "count", kind) as disk:
        assert run(capture, tmp_path / "count") == 0
    num_requests, sizes, wanted = disk.count, disk.sizes, contents(undisturbed)
    num_files = NUM_CHUNKS + len(list(undisturbed.rglob("*.*"))) - 2  # the states end up in two files
    assert num_requests >= num_files * {"refuse": 2, "write": 1, "fsync": 2}[kind]
    rng = np.random.default_rng(0)
    capsys.readouterr()
    for failing in range(1, num_requests + 1):
        out = tmp_path / str(failing)
        limit = int(rng.integers(sizes[failing - 1])) if kind == "write" else 0
        with Disk(out, kind, failing, limit) as disk:
            code = run(capture, out)
        lines = capsys.readouterr().err.splitlines()
        assert code == 3 and len(lines) == 1 and lines[0].startswith("ssplat: "), (disk.failed_file, code, lines)
        assert "cannot be" in lines[0] and "; " in lines[0] and str(out) in lines[0], lines
        # The state saved before can be loaded, and no file is incomplete.
        assert views_done(out) >= CHUNK_SIZE * disk.states_saved, disk.failed_file
        left = contents(out) if out.exists() else {}
        finished = {name for name in left if not name.startswith("state")}
        assert [name for name in left if name.endswith(".partial")] == []
        assert [name for name in finished if left[name] != wanted[name]] == [], disk.failed_file
        assert run(capture, out) == 0
        assert contents(out) == wanted, disk.failed_file
        assert capsys.readouterr().err == ""
        shutil.rmtree(out)
    print(f"\n{kind}: {num_requests} requests, each refused once")


# -- damaged states ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_damaged_state_never_replaces_the_good_one(capture, undisturbed, tmp_path):
    """If a run is killed before it saves the first state after a damaged one, a state can still be loaded."""
    # Requests: rename the damaged state, restore the good one, open the new one, keep the good one, rename the new one.
    for request in range(1, 6):
        out = shutil.copytree(undisturbed, tmp_path / str(request))
        (out / "state.npz").write_bytes(b"damaged")
        with pytest.raises(Killed), Disk(out / "state.npz", "refuse", request, error=Killed()):
            run(capture, out)
        assert views_done(out) == (NUM_CHUNKS - 1) * CHUNK_SIZE
        assert run(capture, out) == 0
        assert contents(out) == contents(undisturbed)


@pytest.mark.parametrize("failing", [2, 3])  # requests: open the new file, keep the old one, rename the new one
def test_a_failed_rename_leaves_the_file_in_place(failing, tmp_path):
    path = tmp_path / "file"
    write_atomic(path, b"old", keep_previous=True)
    with pytest.raises(StorageError, match="file: cannot be written"), Disk(path, "refuse", failing):
        write_atomic(path, b"new", keep_previous=True)
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("file", b"old")]
