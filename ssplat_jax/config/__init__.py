"""Configuration of a stream: the static values, whose change recompiles the program.

Defaults are the paper's where it gives them; docs/decisions.md explains the others. "Literal" marks options that
follow the paper exactly, "ours" those that it does not have. This module does not import JAX, so that `ssplat --help`
answers at once.
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
