"""Protocol of a network: what `StreamSplat` needs in order to run one.

A network has a configuration, a frozen dataclass with the fields of `NetworkConfig`, and an object with the methods of
`Network`. The shipped networks are folders beside this file; `register_network` adds another. Projection of the cache,
HPDA, CGFI, exposure, decoding and memory are shared by all networks.
"""

import dataclasses
from collections.abc import Hashable
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.errors import InputError
from ssplat_jax.model.compact import CompactNetwork
from ssplat_jax.model.resplat import ResplatNetwork
from ssplat_jax.model.types import AnchoredDepth, DepthDistribution, TokenShapes, Views
from ssplat_jax.network_configs import NETWORK_CONFIGS


@runtime_checkable
class NetworkConfig(Protocol):
    """Members of a network's configuration that shared stages read. Other fields are the network's own."""

    @property
    def kind(self) -> str:
        """Name of the network in configurations and files."""
        ...

    @property
    def size_multiple(self) -> int:
        """Images are padded to a multiple of this: a multiple of `match_stride`, and of 16 for CGFI's U-Net."""
        ...

    @property
    def match_stride(self) -> int:
        """Pixels per side of a cell of the matching grid, a multiple of `GRID_STRIDE`."""
        ...

    @property
    def depth_range(self) -> tuple[float, float] | None:
        """Nearest and farthest depth candidate in stream units; None takes the chunk's near and far."""
        ...

    @property
    def depth_space(self) -> str:
        """Space in which candidates are uniform: `log` or `inverse`."""
        ...

    @property
    def num_depths(self) -> int:
        """Number of depth candidates."""
        ...

    @property
    def token_width(self) -> int:
        """Channels of a token's feature, as stored in the cache."""
        ...

    @property
    def cgfi_width(self) -> int:
        """Channels inside the aggregation U-Net of CGFI, a multiple of 8."""
        ...


@runtime_checkable
class Network(Protocol):
    """The stages in which networks differ.

    Every method is a pure function, differentiable in parameters and features. `params` are the parameters of that
    stage alone. `features` is whatever `encode` returns; only the network itself looks inside.
    """

    def stages(self, config: StreamConfig) -> dict[str, tuple[Any, tuple]]:
        """Linen module and example inputs of every stage, by name; used to initialize parameters.

        The names are `encoder`, `cost_volume`, `tokens`, `mixer`, `decoder` and, where depth is refined, `upsampler`. A
        stage may have no parameters, but its module must be there.
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
        """Projected cache features, bounded in size.

        Injected features are stored and come back with the next chunk. A network whose `mix_tokens` does not end in a
        norm must bound them here, or they grow from chunk to chunk. Called only with `additions.unit_features`.
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


NETWORKS: dict[str, Network] = {"compact": CompactNetwork(), "resplat": ResplatNetwork()}
"""Networks by kind."""


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
    config: Any = config_type()
    if not dataclasses.is_dataclass(config) or not isinstance(config, NetworkConfig):
        raise InputError(
            f"register_network: wanted a dataclass with the members of NetworkConfig, got {config_type.__name__}."
        )
    if not isinstance(network, Hashable):
        raise InputError(f"register_network: wanted an object with a hash, got {type(network).__name__}; freeze it.")
    if not isinstance(network, Network):
        raise InputError(
            f"register_network: wanted an object with the methods of Network, got {type(network).__name__}."
        )
    kind = config.kind
    if kind in NETWORKS and NETWORK_CONFIGS[kind] is not config_type:
        raise InputError(f"register_network: wanted a new kind, got {kind!r}, which is taken; choose another.")
    NETWORK_CONFIGS[kind] = config_type
    NETWORKS[kind] = network
