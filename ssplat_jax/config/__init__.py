"""Configuration of a stream: the static values, whose change recompiles the program.

Defaults are those of the preset `tiny`, with the additions to the paper on; `preset("paper")` has the paper's value of
every field (docs/algorithm.md has the table). "Literal" marks values that follow the paper exactly, "ours" those that
it does not have. This module does not import JAX, so that `ssplat --help` answers at once.
"""

from ssplat_jax.config.field_groups import (
    DepthConfig,
    HeadConfig,
    HistoryConfig,
    MemoryConfig,
    OnlineRefineConfig,
    StreamingConfig,
)
from ssplat_jax.config.network_configs import NETWORK_CONFIGS, CompactConfig, ResplatConfig, network_config
from ssplat_jax.config.stream_config import PRESETS, QUALITIES, Quality, StreamConfig, preset

__all__ = [
    "NETWORK_CONFIGS",
    "PRESETS",
    "QUALITIES",
    "CompactConfig",
    "DepthConfig",
    "HeadConfig",
    "HistoryConfig",
    "MemoryConfig",
    "OnlineRefineConfig",
    "Quality",
    "ResplatConfig",
    "StreamConfig",
    "StreamingConfig",
    "network_config",
    "preset",
]
