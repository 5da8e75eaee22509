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


def assert_restored(folder, step: int, words: str = "") -> None:
    """What a new process restores, and what it warns of."""
    told = []
    found = TrainingCheckpoints(folder, {}).restore_latest(STATE, told.append)
    assert found is not None and found[0] == step
    jax.tree.map(np.testing.assert_array_equal, found[1], state_of(step))
    assert jax.tree.map(lambda x: x.dtype, found[1]) == jax.tree.map(lambda x: x.dtype, STATE)
    assert words in "".join(told) and len(told) == bool(words)


def test_training_continues_after_a_damaged_state(tmp_path):
    assert TrainingCheckpoints(tmp_path, {}).restore_latest(STATE, print) is None
    path = saved(tmp_path, 1, 2, 3).path
    assert_restored(tmp_path, 3)
    path.write_bytes(path.read_bytes()[:-9])
    assert_restored(tmp_path, 2, "after step 2")
    assert_restored(tmp_path, 2)  # it has taken the place of the damaged one
    assert path.with_name("state.npz.damaged").exists()


def test_states_that_are_all_damaged_of_other_shapes_or_of_another_training_are_refused(tmp_path):
    checkpoints = saved(tmp_path, 1, 2)
    with pytest.raises(StorageError, match="of another version"):
        checkpoints.restore_latest(STATE | {"weights": jnp.zeros(3)}, print)
    assert_restored(tmp_path, 2)
    for path in (checkpoints.path, previous_path(checkpoints.path)):
        path.write_bytes(b"damaged")
    with pytest.raises(StorageError, match=r"state\.npz: the file is corrupt"):
        checkpoints.restore_latest(STATE, print)
    TrainingCheckpoints(tmp_path, {"recipe": {"phases": [{"steps": 5}]}}).save(1, STATE)
    with pytest.raises(InputError, match=r"recipe\.phases\[0\]\.steps = 5, wanted 6"):
        TrainingCheckpoints(tmp_path, {"recipe": {"phases": [{"steps": 6}]}}).restore_latest(STATE, print)
