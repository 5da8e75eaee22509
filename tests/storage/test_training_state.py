"""Training continues from the newest intact checkpoint, never from a damaged one."""

import gc

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.errors import StorageError
from ssplat_jax.storage.saved_states import TrainingCheckpoints

# Orbax leaves unfinished tasks behind when it reads a damaged file.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

STATE = {"weights": jnp.linspace(-1.0, 1.0, 5000).reshape(50, 100), "step": jnp.array(0, jnp.int32)}


@pytest.fixture(autouse=True)
def _nothing_left_behind():
    yield
    gc.collect()  # their warnings must not appear in the next test


def state_of(step: int):
    return {"weights": STATE["weights"] * step, "step": jnp.array(step, jnp.int32)}


def saved(folder, *steps: int) -> None:
    checkpoints = TrainingCheckpoints(folder, {})
    for step in steps:
        checkpoints.save(step, state_of(step))
    checkpoints.close()


def restored(folder):
    """Returns what a new process restores, and the warnings."""
    told = []
    checkpoints = TrainingCheckpoints(folder, {})
    try:
        return checkpoints.restore_latest(STATE, told.append), told
    finally:
        checkpoints.close()


def files_of(folder, step: int):
    """Returns the non-empty files of a checkpoint, largest first: arrays before their descriptions."""
    found = [p for p in (folder / "checkpoints" / str(step)).rglob("*") if p.is_file() and p.stat().st_size]
    return sorted(found, key=lambda p: -p.stat().st_size)


def flip_a_bit(path, place: int) -> None:
    contents = bytearray(path.read_bytes())
    contents[place % len(contents)] ^= 1 << (place % 8)
    path.write_bytes(contents)


def assert_state(found, step: int) -> None:
    assert found is not None and found[0] == step
    jax.tree.map(np.testing.assert_array_equal, found[1], state_of(step))


def test_the_newest_checkpoint_is_restored_without_warning(tmp_path):
    assert restored(tmp_path) == (None, [])
    saved(tmp_path, 1, 2, 3)
    found, told = restored(tmp_path)
    assert_state(found, 3)
    assert told == []


def test_no_flipped_bit_is_restored(tmp_path):
    """The restored state is the newest, unchanged, or the previous one with a warning."""
    saved(tmp_path, 1, 2)
    original = {path: path.read_bytes() for path in files_of(tmp_path, 2)}
    random, num_fallen_back = np.random.default_rng(0), 0
    for number, path in enumerate(list(original) * 3):
        flip_a_bit(path, int(random.integers(len(original[path]))))
        found, told = restored(tmp_path)
        if told:
            assert_state(found, 1)
            assert "checkpoint 2 is damaged" in told[0]
            (tmp_path / "damaged-2").rename(tmp_path / "checkpoints" / "2")
            num_fallen_back += 1
        else:
            assert_state(found, 2)
        path.write_bytes(original[path])
        assert number or told  # the first file is the largest array, in which every bit matters
    assert num_fallen_back >= 3


def test_training_continues_after_a_damaged_checkpoint(tmp_path):
    saved(tmp_path, 1, 2)
    files_of(tmp_path, 2)[0].write_bytes(b"")
    checkpoints, told = TrainingCheckpoints(tmp_path, {}), []
    assert_state(checkpoints.restore_latest(STATE, told.append), 1)
    checkpoints.save(2, state_of(2))  # the damaged step again
    checkpoints.close()
    assert len(told) == 1 and (tmp_path / "damaged-2").is_dir()
    found, told = restored(tmp_path)
    assert_state(found, 2)
    assert told == []


def test_a_step_that_is_damaged_again_is_put_beside_the_first(tmp_path):
    saved(tmp_path, 1, 2)
    for _ in range(3):
        files_of(tmp_path, 2)[0].write_bytes(b"")
        checkpoints = TrainingCheckpoints(tmp_path, {})
        assert_state(checkpoints.restore_latest(STATE, lambda _: None), 1)
        checkpoints.save(2, state_of(2))
        checkpoints.close()
    assert all((tmp_path / name).is_dir() for name in ("damaged-2", "damaged-2-2", "damaged-2-3"))


def test_an_error_is_raised_if_all_checkpoints_are_damaged(tmp_path):
    saved(tmp_path, 1, 2)
    for step in (1, 2):
        files_of(tmp_path, step)[0].unlink()
    with pytest.raises(StorageError, match="checkpoints 2, 1 are damaged"):
        restored(tmp_path)
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir() if p.is_dir()) == ["1", "2"]


@pytest.mark.parametrize("contents", ["{", "[]", "{}"])
def test_a_damaged_description_is_named(tmp_path, contents):
    (tmp_path / "recipe.json").write_text(contents)
    with pytest.raises(StorageError, match=r"recipe\.json: damaged"):
        TrainingCheckpoints(tmp_path, {"seed": 0}, upgrade=lambda held: {"seed": held["seed"]})
