"""Networks: a toy one is registered, the shipped ones fulfil the protocol, and stages are drawn each for itself."""

import dataclasses
import inspect
from typing import ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.errors import InputError
from ssplat_jax.model.compact import CompactNetwork
from ssplat_jax.model.layers import ResidualBlock
from ssplat_jax.model.network import (
    Network,
    NetworkConfig,
    complete_params,
    init_params,
    network_of,
    register_network,
)
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.model.views import GRID_STRIDE
from ssplat_jax.network_configs import NETWORK_CONFIGS, CompactConfig, ResplatConfig
from tests.model.small import count_params
from tests.streaming.narrow_model import NARROW


@dataclasses.dataclass(frozen=True)
class ToyConfig(CompactConfig):
    """The compact network's configuration under another name."""

    kind: ClassVar[str] = "toy"


class ToyNetwork(CompactNetwork):
    """The compact network, with another encoder."""

    def __init__(self, width: int, stage: str = "encoder"):
        self.width, self.stage = width, stage

    def stages(self, config):
        return CompactNetwork.stages(config) | {self.stage: (nn.Dense(self.width), (jnp.zeros((1, 3)),))}


@pytest.fixture
def toy(registered_networks) -> StreamConfig:
    """Configuration of the toy network, registered for one test."""
    register_network(ToyConfig, ToyNetwork(3))
    return StreamConfig().replace(network="toy")


def test_a_network_that_replaces_another_has_its_own_parameters(toy):
    def num_params():
        return count_params(jax.eval_shape(StreamSplat(toy).init, jax.random.key(0))["encoder"])

    assert StreamConfig.from_dict(toy.to_dict()) == toy
    assert num_params() == 12
    register_network(ToyConfig, ToyNetwork(5))
    assert num_params() == 20


def test_networks_that_lack_something_and_taken_kinds_are_refused(toy):
    @dataclasses.dataclass(frozen=True)
    class NoMultiple:
        kind: ClassVar[str] = "bare"

    @dataclasses.dataclass(frozen=True)
    class Impostor(ToyConfig):
        kind: ClassVar[str] = "compact"

    unhashable = dataclasses.make_dataclass("Thawed", [])()  # a dataclass that compares and is not frozen
    without_checks = inspect.unwrap(register_network)  # without the type checks of the tests
    for config_type, network, words in (
        (NoMultiple, ToyNetwork(3), "members of NetworkConfig, got NoMultiple"),
        (Impostor, ToyNetwork(3), "'compact', which is taken"),
        (ToyConfig, unhashable, r"with a hash .*got Thawed"),
        (ToyConfig, object(), "methods of Network, got object"),
    ):
        with pytest.raises(InputError, match=words):
            without_checks(config_type, network)
    assert "bare" not in NETWORK_CONFIGS


@pytest.mark.parametrize("config_type", [CompactConfig, ResplatConfig])
def test_shipped_network_fulfils_the_protocol(config_type):
    config = StreamConfig().replace(network=config_type.kind)
    network = network_of(config)
    assert isinstance(config.network, NetworkConfig) and isinstance(network, Network)
    assert config.network.size_multiple % config.network.match_stride == 0
    assert config.network.size_multiple % 16 == 0 and config.network.match_stride % GRID_STRIDE == 0
    feats = jnp.asarray(np.random.default_rng(0).normal(size=(1, 2, 2, 8)), jnp.float32)
    assert network.bound_history(feats).shape == feats.shape
    shapes = jax.eval_shape(StreamSplat(config).init, jax.random.key(0))
    assert set(network.stages(config)) == set(shapes) - {"hpda", "cgfi", "evidence"}


def test_no_product_takes_subsampled_pixels():
    """XLA's GPU backend aborts on one (https://github.com/openxla/xla/issues/47381)."""
    block, x = ResidualBlock(8, stride=2), jnp.ones((1, 8, 8, 4))
    program = jax.make_jaxpr(block.apply)(block.init(jax.random.key(0), x), x)
    assert str(program).count("dot_general") > 0
    taken = {v for e in program.eqns if e.primitive.name == "slice" and e.params["strides"] for v in e.outvars}
    assert len(taken) == 1
    assert not [e for e in program.eqns if e.primitive.name == "dot_general" and taken & set(e.invars)]


# Untrained parameters -------------------------------------------------------------------------------------------------


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
