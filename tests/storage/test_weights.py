"""Weights files are read back exactly, or refused."""

import jax
import numpy as np
import pytest

from ssplat_jax.config import preset
from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.model import init_params
from ssplat_jax.storage.weights import check_params, load_params, load_weights, save_weights
from tests.model.small import random_params
from tests.streaming.narrow_model import NARROW


@pytest.fixture(scope="module")
def params():
    return random_params(NARROW)


@pytest.fixture
def saved(params, tmp_path):
    save_weights(tmp_path / "weights.npz", params, NARROW, {"steps": 3})
    return tmp_path / "weights.npz"


def test_weights_are_read_back_as_rounded_to_float16(params, saved):
    loaded, config = load_weights(saved)
    assert config == NARROW
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, np.asarray(b, np.float16)), loaded, params)
    assert {str(x.dtype) for x in jax.tree.leaves(loaded)} == {"float32"}


def test_shipped_weights_fit_their_preset_and_are_trained():
    shipped = load_params("tiny")
    fresh = jax.eval_shape(lambda key: init_params(key, preset("tiny")), jax.random.key(0))
    assert jax.tree.map(lambda x: x.shape, shipped) == jax.tree.map(lambda x: x.shape, fresh)
    # The last layers of the matcher's blocks are initialized to zero.
    for block in ("down0", "down1", "middle1", "middle2", "up0", "up1"):
        assert float(np.std(shipped["cost_volume"]["unet"][block]["conv2"]["kernel"])) > 0.005


def test_a_flipped_bit_is_detected(saved):
    contents = bytearray(saved.read_bytes())
    for byte in np.random.default_rng(0).integers(0, len(contents), 30):
        flipped = contents.copy()
        flipped[byte] ^= 4
        saved.write_bytes(flipped)
        with pytest.raises(StorageError, match=r"weights\.npz"):
            load_weights(saved)


def test_weights_of_another_width_are_refused_by_name(params, tmp_path):
    save_weights(tmp_path / "w.npz", params, NARROW.replace(token_width=NARROW.network.token_width * 2), {})
    with pytest.raises(InputError, match="must be"):
        load_params(str(tmp_path / "w.npz"))


def test_weights_may_have_stages_that_are_switched_off(params):
    """`--set mixer_blocks=0` switches a stage off; missing stages are still refused."""
    check_params(params, NARROW.replace(mixer_blocks=0), "here")
    with pytest.raises(InputError, match=r"here.*mixer"):
        check_params(params, NARROW.replace(mixer_blocks=NARROW.network.mixer_blocks + 1), "here")


def test_overflowing_weights_are_not_saved(params, tmp_path):
    broken = jax.tree.map(lambda x: x + 1e6, params)
    with pytest.raises(StorageError, match="float16"):
        save_weights(tmp_path / "w.npz", broken, NARROW, {})
    assert not list(tmp_path.iterdir())


def test_a_name_that_is_no_preset_or_file_is_refused():
    with pytest.raises(InputError, match="tiny"):
        load_params("absent.npz")
