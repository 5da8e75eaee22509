"""Training continues from the newest intact state, never from a damaged one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.atomic import previous_path
from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.storage.saved_states import TrainingCheckpoints

STATE = {"weights": jnp.linspace(-1.0, 1.0, 500).reshape(5, 100), "step": jnp.array(0, jnp.int32)}


def state_of(step: int):
    return {"weights": STATE["weights"] * step, "step": jnp.array(step, jnp.int32)}


def saved(folder, *steps: int) -> TrainingCheckpoints:
    checkpoints = TrainingCheckpoints(folder, {})
    for step in steps:
        checkpoints.save(step, state_of(step))
    return checkpoints


def restored(folder):
    """Returns what a new process restores, and the warnings."""
    told = []
    return TrainingCheckpoints(folder, {}).restore_latest(STATE, told.append), told


def assert_state(found, step: int) -> None:
    assert found is not None and found[0] == step
    jax.tree.map(np.testing.assert_array_equal, found[1], state_of(step))
    assert jax.tree.map(lambda x: x.dtype, found[1]) == jax.tree.map(lambda x: x.dtype, STATE)


def test_the_newest_state_is_restored_without_warning(tmp_path):
    assert restored(tmp_path) == (None, [])
    saved(tmp_path, 1, 2, 3)
    found, told = restored(tmp_path)
    assert_state(found, 3)
    assert told == []


def test_training_continues_after_a_damaged_state(tmp_path):
    path = saved(tmp_path, 1, 2).state
    contents = bytearray(path.read_bytes())
    contents[len(contents) // 2] ^= 1
    path.write_bytes(contents)
    found, told = restored(tmp_path)
    assert_state(found, 1)
    assert len(told) == 1 and "after step 1" in told[0] and path.with_name("training.npz.damaged").exists()
    saved(tmp_path, 2)
    found, told = restored(tmp_path)
    assert_state(found, 2)
    assert told == []


def test_an_error_is_raised_if_no_state_can_be_read(tmp_path):
    path = saved(tmp_path, 1, 2).state
    path.unlink()
    previous_path(path).write_bytes(b"")
    with pytest.raises(StorageError, match=r"training\.npz"):
        restored(tmp_path)


def test_a_state_of_other_shapes_is_refused(tmp_path):
    checkpoints = saved(tmp_path, 1)
    with pytest.raises(StorageError, match="another version"):
        checkpoints.restore_latest(STATE | {"weights": jnp.zeros(3)}, print)


def test_another_run_and_a_damaged_description_are_refused(tmp_path):
    TrainingCheckpoints(tmp_path, {"recipe": {"phases": [{"steps": 5}]}})
    with pytest.raises(InputError, match=r"recipe\.phases\[0\]\.steps = 5, wanted 6"):
        TrainingCheckpoints(tmp_path, {"recipe": {"phases": [{"steps": 6}]}})
    (tmp_path / "recipe.json").write_text("{")
    with pytest.raises(StorageError, match=r"recipe\.json: damaged"):
        TrainingCheckpoints(tmp_path, {})
