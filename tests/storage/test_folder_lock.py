"""Output folders: locks between processes, and removal of numbered files."""

import subprocess
import sys
from pathlib import Path

import pytest

from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.storage.run_folder import lock_folder, remove_numbered


def test_an_unwritable_folder_is_refused_immediately():
    with pytest.raises(StorageError, match="cannot be written"), lock_folder(Path("/proc")):  # not even for root
        pass


def test_only_numbered_files_are_removed(tmp_path):
    kept = ("00001.jpg", "0001.png", "000001.png", "holiday.png", "view_00001.png")
    for name in (*kept, "00001.png", "12345.png"):
        (tmp_path / name).touch()
    remove_numbered(tmp_path, "#####.png")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(kept)


def test_the_lock_ends_with_a_killed_process(tmp_path):
    hold = (
        "import sys, time; from pathlib import Path; from ssplat_jax.storage.run_folder import lock_folder\n"
        "with lock_folder(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", hold, str(tmp_path)], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(InputError), lock_folder(tmp_path):
            pass
        holder.kill()
    with lock_folder(tmp_path):
        pass


def test_a_new_folder_that_stays_empty_is_removed(tmp_path):
    with pytest.raises(KeyError), lock_folder(tmp_path / "new"):
        raise KeyError
    assert not (tmp_path / "new").exists()
    with lock_folder(tmp_path / "new"):
        (tmp_path / "new" / "file").write_text("kept")
    assert (tmp_path / "new" / "file").read_text() == "kept"
    with lock_folder(tmp_path / "new"):
        (tmp_path / "new" / "file").unlink()
    assert (tmp_path / "new").exists()  # it existed before
