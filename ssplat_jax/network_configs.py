"""Configurations of the shipped networks, by kind, and the base of all groups of configuration fields.

They stand below `config.py`, which names a network by default, and import no JAX.
"""

import dataclasses
import math
from typing import Any, ClassVar, Literal, get_args, get_origin

from ssplat_jax.core.errors import InputError

Rule = tuple[str, str, bool]
"""A field, what its value must be, and whether it is."""


class ConfigGroup:
    """Base of the groups of fields; `__post_init__` checks every field. Lists become tuples, which have a hash."""

    def rules(self) -> tuple[Rule, ...]:
        """Rules beyond the options of a `Literal` field."""
        return ()

    def __post_init__(self) -> None:
        fields = dataclasses.fields(self)  # pyright: ignore[reportArgumentType]
        for field in fields:
            if isinstance(value := getattr(self, field.name), list):
                object.__setattr__(self, field.name, tuple(value))
        options = {field.name: get_args(field.type) for field in fields if get_origin(field.type) is Literal}
        chosen = (
            (name, f"one of {', '.join(map(repr, allowed))}", getattr(self, name) in allowed)
            for name, allowed in options.items()
        )
        for name, wanted, is_good in (*self.rules(), *chosen):
            if not is_good:
                raise InputError(f"config: {name} must be {wanted}, got {getattr(self, name)!r}.")


def is_positive(value: Any) -> bool:
    """True for a finite number above 0."""
    return isinstance(value, int | float) and 0 < value < math.inf


def at_least(least: int, group: Any, *names: str) -> tuple[Rule, ...]:
    """Rules for fields of `group` that have a lower bound."""
    return tuple((name, f"at least {least}", getattr(group, name) >= least) for name in names)


def _multiple_of(step: int, group: Any, *names: str) -> tuple[Rule, ...]:
    """Rules for fields of `group` that are positive multiples of `step`."""
    values = {name: getattr(group, name) for name in names}
    return tuple((name, f"a multiple of {step}", x >= step and x % step == 0) for name, x in values.items())


@dataclasses.dataclass(frozen=True)
class _SharedShapes(ConfigGroup):
    """Fields that both shipped networks have, each with defaults of its own."""

    num_depths: int = 64
    """Number of depth candidates."""
    num_sources: int = 2
    """Source views per view: the other views of the chunk with the nearest camera centers."""
    token_width: int = 64
    """Channels of a token's feature, as stored in the cache."""
    cgfi_width: int = 48
    """Channels inside the aggregation U-Net of CGFI."""
    mixer_blocks: int = 0
    """Pairs of a nearest-neighbor block and a global block."""
    mixer_neighbors: int = 8
    """Neighbors of a token in 3D, the token itself included."""
    mixer_radius: int = 0
    """Neighbors are searched in a (2 r + 1)^2 patch of the token's own view; 0 searches all tokens of the chunk."""
    mixer_proj: int = 32
    """Channels of the nearest-neighbor attention."""

    def rules(self) -> tuple[Rule, ...]:
        return (
            *at_least(1, self, "num_depths", "mixer_neighbors", "mixer_proj"),
            *at_least(0, self, "num_sources", "mixer_blocks", "mixer_radius"),
            *_multiple_of(4, self, "token_width"),
            *_multiple_of(8, self, "cgfi_width"),
        )


@dataclasses.dataclass(frozen=True)
class CompactConfig(_SharedShapes):
    """The compact network (`network="compact"`), small enough for a CPU (ours)."""

    kind: ClassVar[str] = "compact"
    match_stride: ClassVar[int] = 4
    """Pixels per side of a cell of the cost volume."""
    depth_range: ClassVar[tuple[float, float] | None] = None
    """Depth candidates always lie between the chunk's near and far."""
    depth_space: ClassVar[str] = "log"
    """Depth candidates are uniform in log depth."""

    # Hand-held video moves 0.4 % of the depth a frame, so the two nearest views (the paper's number) may both give no
    # parallax.
    num_sources: int = 3
    mixer_radius: int = 2
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
    # A step between candidates then moves the sampled point by a tenth of a cell at 1/4 resolution, twice that at 1/2.
    fine_matching: bool = True
    """Adds a second cost volume, of the CNN features at 1/2 of the image, for the cells of the 1/4 grid."""
    match_width: int = 32
    """Channels of the features that are correlated."""
    unet_width: int = 64
    """Channels of the cost-volume U-Net."""

    def rules(self) -> tuple[Rule, ...]:
        widths = self.encoder_widths
        # Even, because the position code has pairs of a sine and a cosine.
        are_widths = len(widths) == 2 and all(isinstance(x, int) and x >= 1 for x in widths) and widths[1] % 2 == 0
        return (
            *super().rules(),
            *at_least(1, self, "encoder_blocks", "match_width", "attention_ffn"),
            *at_least(0, self, "attention_blocks"),
            *_multiple_of(4, self, "attention_window"),
            *_multiple_of(8, self, "unet_width"),
            ("encoder_widths", "two positive widths, the second even", are_widths),
        )

    @property
    def decoder_width(self) -> int:
        """Channels of the matcher's decoder features."""
        return self.unet_width

    @property
    def size_multiple(self) -> int:
        """Images are padded to a multiple of this many pixels: cell size x attention window."""
        return 4 * self.attention_window


@dataclasses.dataclass(frozen=True)
class ResplatConfig(_SharedShapes):
    """ReSplat's network (`network="resplat"`), with the same layers, so that its published weights can be imported."""

    kind: ClassVar[str] = "resplat"
    decoder_width: ClassVar[int] = 128
    """Channels of the matcher's decoder features."""

    num_depths: int = 128
    token_width: int = 256
    cgfi_width: int = 128
    mixer_blocks: int = 6
    mixer_neighbors: int = 16
    mixer_proj: int = 64
    vit: Literal["s", "b", "l"] = "s"
    """Size of the vision transformer."""
    match_stride: Literal[4, 8] = 8
    """Pixels per side of a cell of the cost volume."""
    # The published weights were trained with a fixed range.
    depth_range: tuple[float, float] | None = (0.01, 200.0)
    """Nearest and farthest depth candidate in stream units; None takes the chunk's near and far."""
    depth_space: Literal["log", "inverse"] = "log"
    """Space in which candidates are uniform and depths are averaged: log depth, or inverse depth as in DepthSplat."""
    # The original code takes pixels for their corners, averages over sources that see nothing, and lets a cell attend
    # across the border of shifted windows; its weights expect all three.
    upstream_compat: bool = False
    """Reproduces the plane sweep and the attention masks of ReSplat's code, with which its weights were trained."""

    def rules(self) -> tuple[Rule, ...]:
        depths = self.depth_range
        is_range = depths is None or (len(depths) == 2 and all(map(is_positive, depths)) and depths[0] < depths[1])
        return (*super().rules(), ("depth_range", "two depths, the nearer first", is_range))

    @property
    def size_multiple(self) -> int:
        """Images are padded to a multiple of this many pixels: 8 x matching stride, for the U-Nets."""
        return 8 * self.match_stride


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
