"""Untrained parameters: each stage's values depend on the key and on no other stage."""

import jax
import numpy as np
import pytest

from ssplat_jax.model.network import complete_params, init_params
from tests.streaming.narrow_model import NARROW

KEY = jax.random.key(7)
OFF = NARROW.replace(cgfi=False, mixer_blocks=0)


@pytest.fixture(scope="module")
def whole() -> dict:
    """Parameters of all stages."""
    return init_params(KEY, NARROW)


def assert_equal(got, wanted):
    jax.tree.map(np.testing.assert_array_equal, got, wanted)


def test_stages_that_are_off_do_not_change_the_others(whole):
    """The start of a file's training is drawn again from its seed (`ssplat weights`)."""
    fewer = init_params(KEY, OFF)
    assert "cgfi" not in fewer and fewer["mixer"] == {} and whole["mixer"]
    assert_equal(fewer, {name: whole[name] for name in fewer} | {"mixer": {}})


def test_missing_stages_are_completed_and_given_ones_kept(whole):
    given = jax.tree.map(lambda x: x + 1.0, init_params(KEY, OFF))
    got = complete_params(KEY, NARROW, given)
    assert_equal(got, given | {"cgfi": whole["cgfi"], "mixer": whole["mixer"]})
    assert_equal(complete_params(KEY, OFF, got), given)  # what is off is left out
