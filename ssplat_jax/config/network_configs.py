"""Configurations of the shipped networks."""

import dataclasses
from typing import Any, ClassVar, Literal

from ssplat_jax.config.config_group import ConfigGroup, are_widths, is_range
from ssplat_jax.core.errors import InputError


@dataclasses.dataclass(frozen=True)
class CompactConfig(ConfigGroup):
    """The compact network (`network="compact"`), small enough for a CPU (ours)."""

    kind: ClassVar[str] = "compact"
    match_stride: ClassVar[int] = 4
    """Pixels per side of a cell of the cost volume."""
    depth_range: ClassVar[tuple[float, float] | None] = None
    """Depth candidates always lie between the chunk's near and far."""
    depth_space: ClassVar[str] = "log"
    """Depth candidates are uniform in log depth."""

    encoder_widths: tuple[int, int] = (32, 64)
    """Channels of the CNN at 1/2 and at 1/4 of the image."""
    encoder_blocks: int = 2
    """Residual blocks per scale."""
    attention_blocks: int = 2
    """Blocks of windowed self-attention and cross-view attention."""
    attention_window: int = 8
    """Side of an attention window in grid cells. Images are padded to whole windows."""
    attention_ffn: int = 2
    """Ratio of the feed-forward width to the feature width in attention blocks."""
    num_depths: int = 64
    """Number of depth candidates."""
    num_sources: int = 3
    """Source views per view: the other views of the chunk with the nearest camera centers."""
    fine_matching: bool = True
    """Adds a second cost volume, of the CNN features at 1/2 of the image, for the cells of the 1/4 grid."""
    match_width: int = 32
    """Channels of the features that are correlated."""
    unet_width: int = 64
    """Channels of the cost-volume U-Net."""
    token_width: int = 64
    """Channels of a token's feature, as stored in the cache."""
    mixer_blocks: int = 0
    """Pairs of a nearest-neighbor block and a global block. 0 in `tiny`, which gains nothing by them."""
    mixer_neighbors: int = 8
    """Neighbors of a token in 3D, the token itself included."""
    mixer_radius: int = 2
    """Neighbors are searched in a (2 r + 1)^2 patch of the token's own view; 0 searches all tokens of the chunk."""
    mixer_proj: int = 32
    """Channels of the nearest-neighbor attention."""

    def rules(self) -> tuple[tuple[str, str, bool], ...]:
        return (
            *_shared_network_rules(self),
            ("encoder_widths", "two positive widths, the second even", are_widths(self.encoder_widths)),
            ("encoder_blocks", "at least 1", self.encoder_blocks >= 1),
            ("attention_blocks", "not negative", self.attention_blocks >= 0),
            ("attention_window", "a multiple of 4", self.attention_window >= 4 and self.attention_window % 4 == 0),
            ("match_width", "at least 1", self.match_width >= 1),
            ("unet_width", "a multiple of 8", self.unet_width >= 8 and self.unet_width % 8 == 0),
            ("attention_ffn", "at least 1", self.attention_ffn >= 1),
        )

    @property
    def size_multiple(self) -> int:
        """Images are padded to a multiple of this many pixels: cell size x attention window."""
        return 4 * self.attention_window


@dataclasses.dataclass(frozen=True)
class ResplatConfig(ConfigGroup):
    """ReSplat's network (`network="resplat"`), with the same layers, so that its published weights can be imported."""

    kind: ClassVar[str] = "resplat"

    vit: Literal["s", "b", "l"] = "s"
    """Size of the vision transformer."""
    match_stride: Literal[4, 8] = 8
    """Pixels per side of a cell of the cost volume."""
    depth_range: tuple[float, float] | None = (0.01, 200.0)
    """Nearest and farthest depth candidate in stream units; None takes the chunk's near and far. The published weights
    were trained with a fixed range."""
    depth_space: Literal["log", "inverse"] = "log"
    """Space in which candidates are uniform and depths are averaged: log depth, or inverse depth as in DepthSplat."""
    upstream_compat: bool = False
    """Reproduces the plane sweep and the attention masks of ReSplat's code, with which its weights were trained."""
    num_depths: int = 128
    """Number of depth candidates."""
    num_sources: int = 2
    """Source views per view: the other views of the chunk with the nearest camera centers."""
    token_width: int = 256
    """Channels of a token's feature, as stored in the cache."""
    mixer_blocks: int = 6
    """Pairs of a nearest-neighbor block and a global block."""
    mixer_neighbors: int = 16
    """Neighbors of a token in 3D, the token itself included."""
    mixer_radius: int = 0
    """Neighbors are searched in a (2 r + 1)^2 patch of the token's own view; 0 searches all tokens of the chunk."""
    mixer_proj: int = 64
    """Channels of the nearest-neighbor attention."""

    def rules(self) -> tuple[tuple[str, str, bool], ...]:
        return (
            *_shared_network_rules(self),
            ("depth_range", "two depths, the nearer first", is_range(self.depth_range)),
        )

    @property
    def size_multiple(self) -> int:
        """Images are padded to a multiple of this many pixels: 8 x matching stride, for the U-Nets."""
        return 8 * self.match_stride


def _shared_network_rules(network: CompactConfig | ResplatConfig) -> tuple[tuple[str, str, bool], ...]:
    return (
        ("num_depths", "at least 1", network.num_depths >= 1),
        ("num_sources", "not negative", network.num_sources >= 0),
        ("token_width", "a multiple of 4", network.token_width >= 4 and network.token_width % 4 == 0),
        ("mixer_blocks", "not negative", network.mixer_blocks >= 0),
        ("mixer_neighbors", "at least 1", network.mixer_neighbors >= 1),
        ("mixer_radius", "not negative", network.mixer_radius >= 0),
        ("mixer_proj", "at least 1", network.mixer_proj >= 1),
    )


NETWORK_CONFIGS: dict[str, type] = {config.kind: config for config in (CompactConfig, ResplatConfig)}
"""Type of each network's configuration by kind; `ssplat_jax.model.network.register_network` adds to it."""


def network_config(kind: str) -> Any:
    """Default configuration of the network `kind`.

    Raises:
        InputError: no such network.
    """
    if kind not in NETWORK_CONFIGS:
        raise InputError(f"config: network must be one of {', '.join(map(repr, NETWORK_CONFIGS))}, got {kind!r}.")
    return NETWORK_CONFIGS[kind]()
