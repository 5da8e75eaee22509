"""Training continues from the newest intact state, never from a damaged one."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.storage.saved_states import TrainingCheckpoints

# Orbax leaves unfinished tasks behind when it reads a damaged file.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

STATE = {"weights": jnp.linspace(-1.0, 1.0, 500).reshape(5, 100), "step": jnp.array(0, jnp.int32)}


def state_of(step: int):
    return {"weights": STATE["weights"] * step, "step": jnp.array(step, jnp.int32)}


def saved(folder, *steps: int) -> TrainingCheckpoints:
    checkpoints = TrainingCheckpoints(folder, {})
    for step in steps:
        checkpoints.save(step, state_of(step))
    return checkpoints


def restored(folder):
    """The training that a new process restores, and the warnings."""
    told = []
    return TrainingCheckpoints(folder, {}).restore_latest(STATE, told.append), told


def assert_state(found, step: int) -> None:
    assert found is not None and found[0] == step
    jax.tree.map(np.testing.assert_array_equal, found[1], state_of(step))
    assert jax.tree.map(lambda x: x.dtype, found[1]) == jax.tree.map(lambda x: x.dtype, STATE)


@pytest.mark.parametrize("damage", ["a flipped bit", "cut off"])
def test_training_continues_after_a_damaged_checkpoint(damage, tmp_path):
    assert restored(tmp_path) == (None, [])
    for _ in range(2):  # the second time, another damaged one lies there
        saved(tmp_path, 1, 2)
        files = [p for p in (tmp_path / "checkpoints" / "2").rglob("*") if p.is_file()]
        path = max(files, key=lambda p: p.stat().st_size)  # arrays, not their descriptions
        contents = bytearray(path.read_bytes())
        contents[len(contents) // 2] ^= 1
        path.write_bytes(contents if damage == "a flipped bit" else contents[:9])
        found, told = restored(tmp_path)
        assert_state(found, 1)
        assert len(told) == 1 and "checkpoint 2 is damaged" in told[0] and (tmp_path / "damaged-2").is_dir()
        saved(tmp_path, 2)
        found, told = restored(tmp_path)
        assert_state(found, 2)
        assert told == []
        shutil.rmtree(tmp_path / "checkpoints")


def test_an_error_is_raised_if_all_checkpoints_are_damaged_or_of_other_shapes(tmp_path):
    checkpoints = saved(tmp_path, 1, 2)
    with pytest.raises(StorageError, match="checkpoints 2, 1 are damaged or of another version"):
        checkpoints.restore_latest(STATE | {"weights": jnp.zeros(3)}, print)
    assert_state(restored(tmp_path)[0], 2)


def test_another_run_and_a_damaged_description_are_refused(tmp_path):
    TrainingCheckpoints(tmp_path, {"recipe": {"phases": [{"steps": 5}]}})
    with pytest.raises(InputError, match=r"recipe\.phases\[0\]\.steps \(5 there, 6 now\)"):
        TrainingCheckpoints(tmp_path, {"recipe": {"phases": [{"steps": 6}]}})
    (tmp_path / "recipe.json").write_text("{")
    with pytest.raises(StorageError, match=r"recipe\.json: damaged"):
        TrainingCheckpoints(tmp_path, {})
