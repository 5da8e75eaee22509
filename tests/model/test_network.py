"""Networks: what lacks something is refused, and stages are drawn each for itself."""

import dataclasses
import inspect
from typing import ClassVar

import jax
import jax.numpy as jnp
import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.model.compact import CompactNetwork
from ssplat_jax.model.layers import ResidualBlock
from ssplat_jax.model.network import complete_params, init_params, register_network
from ssplat_jax.network_configs import NETWORK_CONFIGS, CompactConfig
from tests.model.small import draw_with_numpy
from tests.streaming.narrow_model import NARROW, assert_same_bits


def test_networks_that_lack_something_and_taken_kinds_are_refused(registered_networks):
    @dataclasses.dataclass(frozen=True)
    class NoMultiple:
        kind: ClassVar[str] = "bare"

    @dataclasses.dataclass(frozen=True)
    class Impostor(CompactConfig):
        kind: ClassVar[str] = "compact"

    unhashable = dataclasses.make_dataclass("Thawed", [])()  # a dataclass that compares and is not frozen
    without_checks = inspect.unwrap(register_network)  # without the type checks of the tests
    for config_type, network, words in (
        (NoMultiple, CompactNetwork(), "members of NetworkConfig, got NoMultiple"),
        (Impostor, CompactNetwork(), "'compact', which is taken"),
        (CompactConfig, unhashable, r"with a hash .*got Thawed"),
        (CompactConfig, object(), "methods of Network, got object"),
    ):
        with pytest.raises(InputError, match=words):
            without_checks(config_type, network)
    assert "bare" not in NETWORK_CONFIGS


def test_no_product_takes_subsampled_pixels():
    """XLA's GPU backend aborts on one (https://github.com/openxla/xla/issues/47381)."""
    block, x = ResidualBlock(8, stride=2), jnp.ones((1, 8, 8, 4))
    program = jax.make_jaxpr(block.apply)(block.init(jax.random.key(0), x), x)
    assert str(program).count("dot_general") > 0
    taken = {v for e in program.eqns if e.primitive.name == "slice" and e.params["strides"] for v in e.outvars}
    assert len(taken) == 1
    assert not [e for e in program.eqns if e.primitive.name == "dot_general" and taken & set(e.invars)]


KEY = jax.random.key(7)
OFF = NARROW.replace(cgfi=False, mixer_blocks=0)


@pytest.fixture
def whole(monkeypatch) -> dict:
    """Parameters of all stages, as their keys alone decide."""
    draw_with_numpy(monkeypatch)
    return init_params(KEY, NARROW)


def test_stages_that_are_off_do_not_change_the_others(whole):
    """The start of a file's training is drawn again from its seed (`ssplat weights`)."""
    fewer = init_params(KEY, OFF)
    assert "cgfi" not in fewer and fewer["mixer"] == {} and whole["mixer"]
    assert_same_bits(fewer, {name: whole[name] for name in fewer} | {"mixer": {}})


def test_missing_stages_are_completed_and_given_ones_kept(whole):
    given = jax.tree.map(lambda x: x + 1.0, init_params(KEY, OFF))
    got = complete_params(KEY, NARROW, given)
    assert_same_bits(got, given | {"cgfi": whole["cgfi"], "mixer": whole["mixer"]})
    assert_same_bits(complete_params(KEY, OFF, got), given)  # what is off is left out
