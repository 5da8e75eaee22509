"""Stages of the model, and the protocol of a network: what `StreamSplat` needs in order to run one.

A network has a configuration, a frozen dataclass with the fields of `NetworkConfig`, and an object with the methods of
`Network`. The shipped ones are `compact.py` and `resplat/`; `register_network` adds another. Projection of the cache,
HPDA, CGFI, exposure, decoding and memory are shared by all networks.
"""

import dataclasses
import functools
from collections.abc import Collection, Hashable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.errors import InputError
from ssplat_jax.model.cgfi import Aggregator
from ssplat_jax.model.compact import CompactNetwork
from ssplat_jax.model.decoder import NUM_FEATURES, EvidenceHead
from ssplat_jax.model.hpda import AnchorMaps, AnchorStrength, num_inputs
from ssplat_jax.model.resplat import ReSplatNetwork
from ssplat_jax.model.views import GRID_STRIDE, AnchoredDepth, DepthDistribution, TokenShapes, Views
from ssplat_jax.network_configs import NETWORK_CONFIGS

STAGES = (
    "encoder",
    "cost_volume",
    "hpda",  # there and not used where HPDA is off
    "upsampler",  # absent in networks that match on the feature grid, as the compact one
    "tokens",
    "cgfi",  # absent without `history.cgfi`
    "mixer",  # empty with `mixer_blocks=0`
    "decoder",
    "evidence",  # absent without `head.evidence`
)
"""Names of the stages with parameters, in the order in which random keys are split among them."""


@runtime_checkable
class NetworkConfig(Protocol):
    """Members of a network's configuration that shared stages read. Other fields are the network's own."""

    kind: str
    """Name of the network in configurations and files."""
    size_multiple: int
    """Images are padded to a multiple of this: a multiple of `match_stride`, and of 16 for CGFI's U-Net."""
    match_stride: int
    """Pixels per side of a cell of the matching grid, a multiple of `GRID_STRIDE`."""
    depth_range: tuple[float, float] | None
    """Nearest and farthest depth candidate in stream units; None takes the chunk's near and far."""
    depth_space: str
    """Space in which candidates are uniform: `log` or `inverse`."""
    num_depths: int
    """Number of depth candidates."""
    decoder_width: int
    """Channels of `DepthDistribution.decoder`."""
    token_width: int
    """Channels of a token's feature, as stored in the cache."""
    cgfi_width: int
    """Channels inside the aggregation U-Net of CGFI, a multiple of 8."""


@runtime_checkable
class Network(Protocol):
    """The stages in which networks differ.

    Every method is a pure function, differentiable in parameters and features. `params` are the parameters of that
    stage alone. `features` is whatever `encode` returns; only the network itself looks inside.
    """

    def stages(self, config: StreamConfig) -> dict[str, tuple[Any, tuple]]:
        """Linen module and example inputs of every stage that is the network's own (`STAGES`), to initialize it.

        A stage may have no parameters, but its module must be there.
        """
        ...

    def encode(self, params: dict, views: Views, config: StreamConfig) -> Any:
        """Features of the chunk's views (stage `encoder`)."""
        ...

    def match(self, params: dict, features: Any, views: Views, config: StreamConfig) -> DepthDistribution:
        """Depth distribution P_i(k | u) from the current views alone, on the matching grid (stage `cost_volume`)."""
        ...

    def refine_depth(
        self, params: dict | None, features: Any, depth: AnchoredDepth, views: Views, config: StreamConfig
    ) -> AnchoredDepth:
        """Anchored depth on the feature grid (stage `upsampler`; `params` is None without such a stage)."""
        ...

    def regress_tokens(
        self,
        params: dict,
        features: Any,
        distribution: DepthDistribution,
        depth: AnchoredDepth,
        views: Views,
        config: StreamConfig,
    ) -> Float[Array, "v hf wf c"]:
        """Token features f^v(u) before history is injected (stage `tokens`)."""
        ...

    def bound_history(self, feats: Float[Array, "v hf wf c"]) -> Float[Array, "v hf wf c"]:
        """Projected cache features, bounded in size; called only with `additions.unit_features`.

        Injected features are stored and come back with the next chunk. A network whose `mix_tokens` does not end in a
        norm must bound them here, or they grow from chunk to chunk.
        """
        ...

    def mix_tokens(
        self,
        params: dict,
        feats: Float[Array, "v hf wf c"],
        positions: Float[Array, "v hf wf 3"],
        inside: Bool[Array, "v hf wf"],
        view_valid: Bool[Array, " v"],
        config: StreamConfig,
    ) -> Float[Array, "v hf wf c"]:
        """Token features after attention among tokens, as the cache stores them (stage `mixer`)."""
        ...

    def read_shapes(self, params: dict, feats: Float[Array, "m c"], config: StreamConfig) -> TokenShapes:
        """Opacity, scale, rotation and color residual of each token's Gaussians (stage `decoder`)."""
        ...


NETWORKS: dict[str, Network] = {"compact": CompactNetwork(), "resplat": ReSplatNetwork()}  # networks by kind


def network_of(config: StreamConfig) -> Network:
    """The network that `config.network` configures."""
    return NETWORKS[config.network.kind]


def register_network(config_type: type, network: Network) -> None:
    """Adds a network, so that `config.replace(network=KIND)`, saved states and weights files know it.

    Args:
        config_type: frozen dataclass with a default for every field and the members of `NetworkConfig`. `kind` must be
            a class variable.
        network: object with the methods of `Network` and a hash, as objects have and frozen dataclasses.

    Raises:
        InputError: `config_type` or `network` lacks something, or another network has that kind.
    """
    is_config = dataclasses.is_dataclass(config_type) and isinstance(config_type(), NetworkConfig)
    for given, wanted, is_good in (
        (config_type, "a dataclass with the members of NetworkConfig", is_config),
        (type(network), "an object with a hash (freeze it)", isinstance(network, Hashable)),
        (type(network), "an object with the methods of Network", isinstance(network, Network)),
    ):
        if not is_good:
            raise InputError(f"register_network: wanted {wanted}, got {given.__name__}.")
    kind: str = config_type.kind  # pyright: ignore[reportAttributeAccessIssue]
    if kind in NETWORKS and NETWORK_CONFIGS[kind] is not config_type:
        raise InputError(f"register_network: wanted a new kind, got {kind!r}, which is taken; choose another.")
    NETWORK_CONFIGS[kind] = config_type
    NETWORKS[kind] = network


# -- Parameters: nested dicts, whose names are part of the weights file format ----------------------------------------
def init_params(key: jax.Array, config: StreamConfig, only: Collection[str] | None = None) -> dict:
    """Random parameters for `config`. Their shapes depend on the configuration alone, not on the image size.

    `only` names stages to return, with the values that they have among all stages; default all that are on.

    Raises:
        InputError: the network has a stage of an unknown name.
    """
    network = network_of(config)
    modules = _modules(config, network)
    if unknown := sorted(modules.keys() - set(STAGES)):
        raise InputError(f"network {config.network.kind!r}: wanted stages among {', '.join(STAGES)}, got {unknown}.")
    names = [name for name in STAGES if name in modules]
    keys = jax.random.split(key, len(names))  # CGFI has its key also where it is off, so that the others start alike
    wanted = set(names if only is None else only) & stages_of(config)
    return {name: _init_stage(k, config, name, network) for k, name in zip(keys, names, strict=True) if name in wanted}


def stages_of(config: StreamConfig) -> set[str]:
    """Names of the stages that `init_params` returns, also those that need no parameters."""
    names: set[str] = set()
    jax.eval_shape(lambda: names.update(_modules(config, network_of(config))))  # traced, so that no input is computed
    return names - (set() if config.history.cgfi else {"cgfi"})


# One program per stage: a single program for all stages of a large network takes 1.5 times as long to compile, and
# eager initialization compiles every operation of every layer by itself.
@functools.partial(jax.jit, static_argnums=(1, 2, 3))
def _init_stage(key: jax.Array, config: StreamConfig, name: str, network: Network) -> dict:
    module, inputs = _modules(config, network)[name]
    return module.init(key, *inputs).get("params", {})


def _modules(config: StreamConfig, network: Network) -> dict:
    """Linen module and example inputs of every stage."""
    v, side, c = 2, config.network.size_multiple // GRID_STRIDE, config.network.token_width
    grid = lambda channels: jnp.zeros((v, side, side, channels))  # noqa: E731
    is_learned = config.additions.anchor == "learned"
    shared: dict = {
        "hpda": (AnchorMaps(), (grid(num_inputs(config)),)) if is_learned else (AnchorStrength(), ()),
        "cgfi": (Aggregator(config), (grid(c), grid(c + config.additions.residual_cgfi), jnp.ones(v, bool))),
    }
    if config.head.evidence:
        shared["evidence"] = (EvidenceHead(), (jnp.zeros((1, NUM_FEATURES)),))
    return network.stages(config) | shared


def complete_params(key: jax.Array, config: StreamConfig, params: dict) -> dict:
    """`params` of a model with fewer stages, completed with those of `init_params` for each that `config` uses."""
    untrained = init_params(key, config)
    return untrained | {name: params[name] for name, stage in untrained.items() if stage and params.get(name)}
