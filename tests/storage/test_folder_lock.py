"""Output folders: locks between processes, and removal of numbered files."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import pytest

from ssplat_jax.commands.demo_command import Demo
from ssplat_jax.commands.eval_command import Eval
from ssplat_jax.commands.main import main
from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.storage.run_folder import lock_folder, remove_numbered


def test_a_second_process_is_refused_until_the_first_ends(tmp_path):
    with (
        lock_folder(tmp_path),
        pytest.raises(InputError, match="another process is writing to it"),
        lock_folder(tmp_path),
    ):
        pass
    with lock_folder(tmp_path):
        pass


def test_an_unwritable_folder_is_refused_immediately():
    with (
        pytest.raises(StorageError, match="cannot be written"),
        lock_folder(Path("/proc")),
    ):  # not even for root
        pass


def test_only_numbered_files_are_removed(tmp_path):
    kept = ("00001.jpg", "0001.png", "000001.png", "holiday.png", "view_00001.png")
    for name in (*kept, "00001.png", "12345.png"):
        (tmp_path / name).touch()
    remove_numbered(tmp_path, "#####.png")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(kept)
    for path in tmp_path.iterdir():
        path.unlink()
    remove_numbered(tmp_path, "#####.png")
    assert not tmp_path.exists()
    remove_numbered(tmp_path, "#####.png")


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


def test_a_folder_that_cannot_be_made_is_a_storage_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="choose another place"), lock_folder(tmp_path / "file"):
        pass


@pytest.mark.parametrize("command", [("run", "procedural:room?frames=4&size=32x24"), ("train",)])
def test_run_and_train_refuse_a_folder_in_use(command, tmp_path, capsys):
    with lock_folder(tmp_path), pytest.raises(SystemExit) as stopped:
        main([*command, "--out", str(tmp_path)])
    assert stopped.value.code == 2
    *_, line = capsys.readouterr().err.splitlines()  # after the progress output of `train`
    assert "another process" in line and "--out" in line and not any(tmp_path.iterdir())


@pytest.mark.parametrize("command", [Demo(quiet=True), Eval("procedural:room", Path(), quiet=True)])
def test_commands_wait_for_no_other_process(command, tmp_path):
    with lock_folder(tmp_path), pytest.raises(InputError, match="another process is writing to it"):
        dataclasses.replace(command, out=tmp_path).run()
    assert not list(tmp_path.iterdir())
