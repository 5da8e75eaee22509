"""The protocol of a network: what it must provide so that `StreamSplat` can run it.

A network is a folder beside this file. It has a configuration (a frozen dataclass with the fields that
`NetworkConfig` names) and an object that fulfils `Network`. Everything else is shared: projection of the cache, HPDA,
CGFI, exposure, decoding and memory.
"""

from typing import Any, ClassVar, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float

from ssplat_jax.config import NETWORK_CONFIGS, StreamConfig
from ssplat_jax.errors import InputError
from ssplat_jax.model.compact import CompactNetwork
from ssplat_jax.model.resplat import ResplatNetwork
from ssplat_jax.model.types import AnchoredDepth, DepthBelief, TokenShapes, Views


@runtime_checkable
class NetworkConfig(Protocol):
    """Static facts about a network that shared stages read. Its other fields are its own."""

    @property
    def kind(self) -> str:
        """Name of the network in configurations and files."""
        ...

    @property
    def size_multiple(self) -> int:
        """Images are padded to a multiple of this many pixels."""
        ...

    @property
    def match_stride(self) -> int:
        """Pixels per side of a cell of the cost volume, a multiple of `GRID_STRIDE`."""
        ...

    @property
    def depth_range(self) -> tuple[float, float] | None:
        """Nearest and farthest candidate in stream units; None takes the chunk's near and far."""
        ...

    @property
    def depth_space(self) -> str:
        """`log` or `inverse`: where candidates are uniform."""
        ...

    @property
    def num_depths(self) -> int:
        """Number of depth candidates."""
        ...

    @property
    def token_width(self) -> int:
        """Channels of a token's feature, as stored in the cache."""
        ...


@runtime_checkable
class Network(Protocol):
    """The stages in which networks differ. Every method is a pure function; parameters are nested dicts.

    `features` is whatever `encode` returns; only the network itself looks inside.
    """

    matcher_stages: ClassVar[tuple[str, ...]]
    """Stages (keys of the parameters) that end in the depth distribution; a recipe may freeze them."""

    def stages(self, config: StreamConfig) -> dict[str, tuple[Any, tuple]]:
        """Linen module and example inputs of every stage that has parameters, by the stage's name."""
        ...

    def encode(self, params: dict, views: Views, config: StreamConfig) -> Any:
        """Features of the chunk's views."""
        ...

    def match(self, params: dict, features: Any, views: Views, config: StreamConfig) -> DepthBelief:
        """Depth distribution P_i(k | u) from the current views alone."""
        ...

    def refine_depth(
        self, params: dict | None, features: Any, depth: AnchoredDepth, views: Views, config: StreamConfig
    ) -> AnchoredDepth:
        """Anchored depth on the 1/4 grid; `params` is None for a network without such a stage."""
        ...

    def regress_tokens(
        self, params: dict, features: Any, belief: DepthBelief, depth: AnchoredDepth, views: Views, config: StreamConfig
    ) -> Float[Array, "v hf wf c"]:
        """Token features f^v(u) before history is injected."""
        ...

    def bound_history(self, feats: Float[Array, "v hf wf c"]) -> Float[Array, "v hf wf c"]:
        """Projected cache features at a size that cannot grow from chunk to chunk.

        Injected features are stored and come back with the next chunk: a network whose mixer does not end in a norm
        must bound them here.
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
        """Token features after attention among tokens, as the cache stores them."""
        ...

    def read_shapes(self, params: dict, feats: Float[Array, "m c"], config: StreamConfig) -> TokenShapes:
        """Opacity, scale, rotation and color residual that the head reads from features."""
        ...


NETWORKS: dict[str, Network] = {"compact": CompactNetwork(), "resplat": ResplatNetwork()}


def network_of(config: StreamConfig) -> Network:
    """The network that `config.network` configures."""
    return NETWORKS[config.network.kind]


def register_network(config_type: type, network: Network) -> None:
    """Adds a network, so that `config.replace(network=KIND)`, saved states and weights files know it.

    Args:
        config_type: frozen dataclass with defaults for every field, which fulfils `NetworkConfig`.
        network: the object with its stages.

    Raises:
        InputError: another network has that kind.
    """
    kind = config_type.kind
    if kind in NETWORKS and NETWORK_CONFIGS[kind] is not config_type:
        raise InputError(f"register_network: wanted a new kind, got {kind!r}, which is taken; choose another.")
    NETWORK_CONFIGS[kind] = config_type
    NETWORKS[kind] = network
