"""The protocol of a network: a toy network is registered and runs, and the shipped networks fulfil the protocol."""

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
from ssplat_jax.model.layers import ResidualBlock, average_pool, rms_normalize
from ssplat_jax.model.network import NETWORKS, Network, NetworkConfig, network_of, register_network
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.model.views import GRID_STRIDE, DepthDistribution, TokenShapes
from ssplat_jax.network_configs import NETWORK_CONFIGS, CompactConfig, ResplatConfig
from tests.model.small import count_params


@dataclasses.dataclass(frozen=True)
class ToyConfig:
    kind: ClassVar[str] = "toy"
    size_multiple: ClassVar[int] = 16
    match_stride: ClassVar[int] = GRID_STRIDE
    depth_range: ClassVar[tuple[float, float] | None] = None
    depth_space: ClassVar[str] = "log"

    num_depths: int = 6
    token_width: int = 8
    cgfi_width: int = 8
    brightness: float = 2.0
    """A field that no other network has."""


class Linear(nn.Module):
    width: int

    @nn.compact
    def __call__(self, x):
        return nn.Dense(self.width, name="dense")(x)


class ToyNetwork:
    """Reads depth, features and shapes from the mean color of each cell."""

    def stages(self, config):
        network, cell = config.network, jnp.zeros((1, 1, 1, 3))
        token = jnp.zeros((1, network.token_width))
        return {
            "encoder": (Linear(3), (cell,)),
            "cost_volume": (Linear(network.num_depths), (cell,)),
            "tokens": (Linear(network.token_width), (cell,)),
            "mixer": (Linear(network.token_width), (token,)),
            "decoder": (Linear(8 + 3 * (config.head.sh_degree + 1) ** 2), (token,)),
        }

    def encode(self, params, views, config):
        colors = average_pool(views.images, GRID_STRIDE)
        return Linear(3).apply({"params": params}, config.network.brightness * colors)

    def match(self, params, features, views, config):
        logits = Linear(config.network.num_depths).apply({"params": params}, features)
        return DepthDistribution(probs=jax.nn.softmax(logits), logits=logits, decoder=features)

    def refine_depth(self, params, features, depth, views, config):
        assert params is None  # there is no such stage
        return depth

    def regress_tokens(self, params, features, distribution, depth, views, config):
        return Linear(config.network.token_width).apply({"params": params}, features)

    def bound_history(self, feats):
        return rms_normalize(feats)

    def mix_tokens(self, params, feats, positions, inside, view_valid, config):
        return Linear(config.network.token_width).apply({"params": params}, feats)

    def read_shapes(self, params, feats, config):
        width = 3 * (config.head.sh_degree + 1) ** 2
        raw = Linear(8 + width).apply({"params": params}, feats)
        opacity, scale, rotation, sh = jnp.split(raw, [1, 4, 8], axis=-1)
        return TokenShapes(opacity[:, 0], scale, rotation, sh.reshape(len(feats), -1, 3))


@pytest.fixture
def toy(monkeypatch) -> StreamConfig:
    """Configuration of the toy network, registered for one test."""
    monkeypatch.setattr("ssplat_jax.model.network.NETWORKS", dict(NETWORKS))
    for kind in list(NETWORK_CONFIGS):
        monkeypatch.setitem(NETWORK_CONFIGS, kind, NETWORK_CONFIGS[kind])
    monkeypatch.setitem(NETWORK_CONFIGS, "toy", ToyConfig)
    monkeypatch.delitem(NETWORK_CONFIGS, "toy")  # undone to absence, whatever the test does
    register_network(ToyConfig, ToyNetwork())
    return StreamConfig().replace(network="toy", capacity=256, min_confidence=0.0, hpda=True, cgfi=True, chunk_size=3)


def test_a_network_that_replaces_another_has_its_own_parameters(toy):
    class Wider(ToyNetwork):
        def stages(self, config):
            return super().stages(config) | {"encoder": (Linear(5), (jnp.zeros((1, 1, 1, 3)),))}

    def num_params():
        return count_params(jax.eval_shape(StreamSplat(toy).init, jax.random.key(0))["encoder"])

    assert num_params() == 12
    register_network(ToyConfig, Wider())
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
        (NoMultiple, ToyNetwork(), "members of NetworkConfig, got NoMultiple"),
        (Impostor, ToyNetwork(), "'compact', which is taken"),
        (ToyConfig, unhashable, r"with a hash .*got Thawed"),
        (ToyConfig, object(), "methods of Network, got object"),
    ):
        with pytest.raises(InputError, match=words):
            without_checks(config_type, network)
    assert "bare" not in NETWORK_CONFIGS


def test_stage_of_an_unknown_name_is_refused(toy):
    class Misnamed(ToyNetwork):
        def stages(self, config):
            stages = super().stages(config)
            return stages | {"encoders": stages["encoder"]}

    register_network(ToyConfig, Misnamed())
    with pytest.raises(InputError, match=r"wanted stages among encoder.*got \['encoders'\]"):
        StreamSplat(toy).init(jax.random.key(0))


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
