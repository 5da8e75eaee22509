"""Static configuration of a stream: every value whose change recompiles the program.

This module does not import JAX, so that `ssplat --help` answers at once. Values are the paper's where it gives them;
docs/decisions.md explains the others.
"""

import dataclasses
import hashlib
import json
import math
from typing import Any, ClassVar, Literal, get_args, get_origin

from ssplat_jax.errors import InputError

# -- checks that the groups share -------------------------------------------------------------------------------------


def _is_positive(value: Any) -> bool:
    return isinstance(value, int | float) and 0 < value < math.inf


def _is_range(value: Any) -> bool:
    return value is None or (len(value) == 2 and all(map(_is_positive, value)) and value[0] < value[1])


def _are_widths(value: Any) -> bool:
    is_good = len(value) == 2 and all(isinstance(width, int) and width >= 1 for width in value)
    return is_good and value[1] % 2 == 0  # the position code has a sine and a cosine per channel pair


class _Group:
    """Base of the groups: `__post_init__` checks every field."""

    def _rules(self) -> tuple[tuple[str, str, bool], ...]:
        """(field, wanted, whether its value is good) for every rule beyond the field's options."""
        return ()

    def __post_init__(self) -> None:
        for name, wanted, is_good in self._rules():
            if not is_good:
                raise InputError(f"config: {name} must be {wanted}, got {getattr(self, name)!r}.")
        for field in dataclasses.fields(self):  # pyright: ignore[reportArgumentType]
            options = get_args(field.type) if get_origin(field.type) is Literal else ()
            if options and getattr(self, field.name) not in options:
                wanted = ", ".join(map(repr, options))
                raise InputError(f"config: {field.name} must be one of {wanted}, got {getattr(self, field.name)!r}.")


# -- networks ---------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class CompactConfig(_Group):
    """`network="compact"`: our own network, narrow enough for a CPU."""

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
    """Side of an attention window in grid cells; images are padded to a multiple of the pixels of 4 windows."""
    attention_ffn: int = 2
    """Ratio of the feed-forward width to the feature width in attention blocks."""
    num_depths: int = 64
    """Depth candidates, uniform in log depth between the chunk's near and far."""
    num_sources: int = 3
    """Source views per reference view: the other views of the chunk with the nearest camera centers."""
    fine_matching: bool = True
    """Adds a second correlation of the CNN features at 1/2 resolution, sampled for the same 1/4 grid."""
    match_width: int = 32
    """Channels of the features that are correlated."""
    unet_width: int = 64
    """Channels of the cost-volume U-Net."""
    token_width: int = 64
    """Channels of a token's feature, as stored in the cache."""
    mixer_blocks: int = 2
    """Pairs of a nearest-neighbor block and a global block."""
    mixer_neighbors: int = 8
    """Neighbors of a token in 3D, the token itself included."""
    mixer_radius: int = 2
    """Neighbors are searched in a (2 r + 1)^2 patch of the token's own view; 0 searches all tokens of the chunk."""
    mixer_proj: int = 32
    """Channels of the nearest-neighbor attention."""

    def _rules(self) -> tuple[tuple[str, str, bool], ...]:
        return (
            *_shared_network_rules(self),
            ("encoder_widths", "two positive widths, the second even", _are_widths(self.encoder_widths)),
            ("encoder_blocks", "at least 1", self.encoder_blocks >= 1),
            ("attention_blocks", "not negative", self.attention_blocks >= 0),
            ("attention_window", "a multiple of 4", self.attention_window >= 4 and self.attention_window % 4 == 0),
            ("match_width", "at least 1", self.match_width >= 1),
            ("unet_width", "a multiple of 8", self.unet_width >= 8 and self.unet_width % 8 == 0),
            ("attention_ffn", "at least 1", self.attention_ffn >= 1),
        )

    @property
    def size_multiple(self) -> int:
        """Images are padded to a multiple of this many pixels: grid stride x attention window."""
        return 4 * self.attention_window


@dataclasses.dataclass(frozen=True)
class ResplatConfig(_Group):
    """`network="resplat"`: ReSplat's network, layer by layer, so that its published weights convert."""

    kind: ClassVar[str] = "resplat"

    vit: Literal["s", "b", "l"] = "s"
    """Size of the vision transformer."""
    match_stride: Literal[4, 8] = 8
    """Pixels per side of a cell of the cost volume."""
    depth_range: tuple[float, float] | None = (0.01, 200.0)
    """Nearest and farthest depth candidate in stream units; None takes the chunk's near and far. Published weights
    were trained with one fixed range."""
    depth_space: Literal["log", "inverse"] = "log"
    """Space in which candidates are uniform and depths are averaged: log depth, or inverse depth as in DepthSplat."""
    upstream_compat: bool = False
    """Sweeps and masks attention exactly as ReSplat's code does, which its weights were trained with."""
    num_depths: int = 128
    """Depth candidates."""
    num_sources: int = 2
    """Source views per reference view: the other views of the chunk with the nearest camera centers."""
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

    def _rules(self) -> tuple[tuple[str, str, bool], ...]:
        return (
            *_shared_network_rules(self),
            ("depth_range", "two depths, the nearer first", _is_range(self.depth_range)),
        )

    @property
    def size_multiple(self) -> int:
        """Images are padded to a multiple of this many pixels: matching stride x depth of the U-Net."""
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
"""Configuration of each network by its kind; `ssplat_jax.model.network.register_network` adds to it."""

# -- the other groups -------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class StreamingConfig(_Group):
    """How images enter: chunks, units and exposure."""

    chunk_size: int = 4
    """Views per chunk."""
    scene_scale: float | Literal["auto"] = "auto"
    """Factor from capture units to stream units; `auto` scales the capture's median depth to `median_depth`."""
    median_depth: float = 2.0
    """Median depth in stream units that `scene_scale="auto"` aims for."""
    chunk_step: float = 0.03
    """Video is interleaved until neighboring views of a chunk are this fraction of the depth apart (ours); 0 keeps the
    order of the frames."""
    match_exposure: bool = True
    """Colors are stored at the exposure of the first views; the exposure of every other view is estimated (ours)."""

    def _rules(self) -> tuple[tuple[str, str, bool], ...]:
        is_scale = self.scene_scale == "auto" or _is_positive(self.scene_scale)
        return (
            ("chunk_size", "at least 1", self.chunk_size >= 1),
            ("median_depth", "a positive length", _is_positive(self.median_depth)),
            ("chunk_step", "not negative, and finite", 0 <= self.chunk_step < math.inf),
            ("scene_scale", "'auto' or a positive factor", is_scale),
        )


@dataclasses.dataclass(frozen=True)
class DepthConfig(_Group):
    """How a depth and its confidence are read from a distribution over candidates."""

    depth_readout: Literal["mean", "window"] = "window"
    """Expectation over all candidates (literal), or over those near the peak, which never averages two surfaces."""
    readout_window: int = 4
    """Candidates on each side of the peak that `depth_readout="window"` keeps."""
    confidence: Literal["peak", "window"] = "window"
    """`peak`: max_k P (literal). `window`: the largest mass of `2 confidence_window + 1` neighboring candidates."""
    confidence_window: int = 1
    """Candidates on each side that `confidence="window"` adds up."""

    def _rules(self) -> tuple[tuple[str, str, bool], ...]:
        return (
            ("readout_window", "not negative", self.readout_window >= 0),
            ("confidence_window", "not negative", self.confidence_window >= 0),
        )


@dataclasses.dataclass(frozen=True)
class HistoryConfig(_Group):
    """How the cache enters the next chunk: projection, HPDA and CGFI."""

    cluster_ratio: float = 1.15
    """Depth ratio that holds the front cluster of the projection together; `inf` is the plain mean (literal)."""
    hpda: bool = True
    """Anchors the depth distribution by cached geometry."""
    anchor_space: Literal["log", "metric"] = "log"
    """Space in which sigma is measured: log depth, or scene units (literal)."""
    anchor_norm: Literal["none", "mass"] = "none"
    """`mass` scales the anchor to total mass Omega, which makes gamma the odds of history against the matcher."""
    sigma0: float = 0.1
    """Width of the anchor at full confidence."""
    lambda_sigma: float = 0.5
    """Growth of the anchor's width as confidence falls."""
    gamma_init: float = 0.1
    """Initial value of the learnable gamma_d = softplus(raw)."""
    cgfi: bool = True
    """Injects cached features where local evidence is weak."""
    cgfi_width: int = 48
    """Channels inside the aggregation U-Net."""

    def _rules(self) -> tuple[tuple[str, str, bool], ...]:
        return (
            ("cgfi_width", "a multiple of 8", self.cgfi_width >= 8 and self.cgfi_width % 8 == 0),
            ("gamma_init", "positive", _is_positive(self.gamma_init)),
            ("sigma0", "positive", _is_positive(self.sigma0)),
            ("lambda_sigma", "not negative, and finite", 0 <= self.lambda_sigma < math.inf),
            ("cluster_ratio", "above 1", self.cluster_ratio > 1),
        )


@dataclasses.dataclass(frozen=True)
class MemoryConfig(_Group):
    """The voxel cache (VACC; Eqs. vacc_capacity_update and vacc_pair_selection_and_merge)."""

    vacc: Literal["voxel", "append"] = "voxel"
    """`append` keeps every accepted token (the paper's ablation)."""
    voxel_size: float = 0.03
    """Side of a voxel in stream units."""
    pivots_per_voxel: int = 4
    """K: tokens that a voxel keeps apart."""
    min_confidence: float = 0.5
    """tau: tokens below it never enter the cache, and pivots that fall below it are not decoded. The paper's 0.3 refers
    to a peak; the mass of a window is larger."""
    capacity: int = 1 << 15
    """Voxels that the cache can hold, a power of two; outside jit `overflow="grow"` doubles it."""
    overflow: Literal["grow", "drop_new", "evict_lowest", "error"] = "grow"
    """What happens to a token for which there is no room."""
    merge_key: Literal["seed", "feature"] = "seed"
    """Whose cosine similarity selects the closest pair."""
    merge_weight: Literal["max", "count"] = "max"
    """`max`: omega* = max, as printed. `count` weighs by the number of members, a true running mean."""
    carving: bool = True
    """Views lower the confidence of pivots that they look through, and raise that of pivots that they see (ours)."""
    num_witnesses: int = 32
    """Chunks of which a coarse view is kept to judge later tokens in the same way; part of `carving`."""

    def _rules(self) -> tuple[tuple[str, str, bool], ...]:
        is_power = self.capacity >= 128 and not self.capacity & (self.capacity - 1)
        # Without voxels there is no lowest pivot to compare with.
        fits = self.vacc != "append" or self.overflow != "evict_lowest"
        return (
            ("voxel_size", "a positive length", _is_positive(self.voxel_size)),
            ("pivots_per_voxel", "at least 1", self.pivots_per_voxel >= 1),
            ("capacity", "a power of two of at least 128", is_power),
            ("min_confidence", "in [0, 1]", 0.0 <= self.min_confidence <= 1.0),
            # Carved confidences stay below 0.95 (`cache.carve.HIGHEST`): a higher tau would reject what views confirm.
            ("min_confidence", "at most 0.95 while views carve", not self.carving or self.min_confidence <= 0.95),
            ("num_witnesses", "not negative", self.num_witnesses >= 0),
            ("overflow", "'drop_new', 'grow' or 'error' with vacc='append'", fits),
        )


@dataclasses.dataclass(frozen=True)
class HeadConfig(_Group):
    """The Gaussians that a token becomes."""

    gaussians_per_token: Literal[1, 4, 16] = 4
    """Gaussians in a square over the token's cell, each with the mean color of its part of the patch (ours; literal:
    1)."""
    sh_degree: int = 0
    """Highest band of spherical harmonics."""
    scale_mode: Literal["footprint", "absolute"] = "footprint"
    """Gaussian scale relative to the token's footprint (depth x cell / focal), or softplus in scene units (literal)."""
    max_scale: float = 1.0
    """Upper bound of a Gaussian's scale in stream units."""

    def _rules(self) -> tuple[tuple[str, str, bool], ...]:
        return (
            ("max_scale", "positive", _is_positive(self.max_scale)),
            ("sh_degree", "0 to 3", 0 <= self.sh_degree <= 3),
        )


# -- the whole --------------------------------------------------------------------------------------------------------

RENAMED = {"mixer_neighbours": "mixer_neighbors"}
"""Names of fields in files that version 0.1 wrote."""


@dataclasses.dataclass(frozen=True)
class StreamConfig:
    """Everything static about model, cache and stream. Frozen and hashable.

    Example:
        >>> config = preset("tiny").replace(voxel_size=0.02)
        >>> config.memory.voxel_size
        0.02
    """

    preset: str = "tiny"
    """Name of the preset that this configuration started from."""
    network: Any = CompactConfig()
    """`CompactConfig`, `ResplatConfig`, or that of a registered network (see `model.network.NetworkConfig`)."""
    depth: DepthConfig = DepthConfig()
    history: HistoryConfig = HistoryConfig()
    memory: MemoryConfig = MemoryConfig()
    head: HeadConfig = HeadConfig()
    stream: StreamingConfig = StreamingConfig()

    def replace(self, **changes: Any) -> "StreamConfig":
        """A copy with `changes`.

        Args:
            **changes: values by name: `voxel_size=0.02`, or `**{"memory.voxel_size": 0.02}`, or a whole group,
                `memory=MemoryConfig()`. `network="resplat"` takes that network with its default fields.

        Raises:
            InputError: no such field, a name that several groups have, or a bad value.
        """
        whole = {name: changes.pop(name) for name in ("preset", *self.groups()) if name in changes}
        if isinstance(kind := whole.get("network"), str):
            whole["network"] = network_config(kind)
        config = dataclasses.replace(self, **whole)
        by_group: dict[str, dict[str, Any]] = {}
        for name, value in changes.items():
            group, field = config.find(name)
            by_group.setdefault(group, {})[field] = value
        return dataclasses.replace(
            config, **{name: dataclasses.replace(getattr(config, name), **part) for name, part in by_group.items()}
        )

    def groups(self) -> tuple[str, ...]:
        """Names of the groups."""
        return tuple(field.name for field in dataclasses.fields(self) if field.name != "preset")

    def find(self, name: str) -> tuple[str, str]:
        """(group, field) of a field by its full name, `memory.voxel_size`, or its short one, `voxel_size`.

        Raises:
            InputError: there is none, or several groups have one of that name.
        """
        known = [(g, field.name) for g in self.groups() for field in dataclasses.fields(getattr(self, g))]
        found = [(g, f) for g, f in known if name in (f, f"{g}.{f}")]
        if len(found) == 1:
            return found[0]
        if found:
            options = " or ".join(f"{g}.{f}" for g, f in found)
            raise InputError(f"config: {name!r} could be {options}; give the full name.")
        listed = ", ".join(sorted(f"{g}.{f}" for g, f in known))
        raise InputError(f"config: no field {name!r} with network {self.network.kind!r}; known fields: {listed}.")

    def get(self, name: str) -> Any:
        """Value of a field by its full or short name.

        Raises:
            InputError: see `find`.
        """
        group, field = self.find(name)
        return getattr(getattr(self, group), field)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types, a dictionary per group; the inverse is `from_dict`."""
        fields = dataclasses.asdict(self)
        fields["network"] = {"kind": self.network.kind, **fields["network"]}
        return json.loads(json.dumps(fields))

    @staticmethod
    def from_dict(fields: dict[str, Any]) -> "StreamConfig":
        """Inverse of `to_dict`; also reads the flat dictionaries that version 0.1 wrote.

        Raises:
            InputError: a field is unknown or has a bad value.
        """
        if isinstance(fields.get("network"), str):
            return _from_flat(fields)
        changes: dict[str, Any] = {}
        for name, value in fields.items():
            if not isinstance(value, dict):
                changes[name] = value
                continue
            changes |= {f"{name}.{field}": _as_tuple(x) for field, x in value.items() if field != "kind"}
            if name == "network":
                changes["network"] = value["kind"]
        return StreamConfig().replace(**changes)

    @property
    def hash(self) -> str:
        """Twelve hex digits that identify this configuration in results and saved states."""
        return hashlib.sha256(json.dumps(self.to_dict(), sort_keys=True).encode()).hexdigest()[:12]


def _as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _from_flat(fields: dict[str, Any]) -> StreamConfig:
    """A configuration from the flat dictionary of version 0.1, which held the fields of every network."""
    config = StreamConfig().replace(network=fields["network"])
    foreign = {f.name for kind in NETWORK_CONFIGS.values() for f in dataclasses.fields(kind)}
    foreign -= {f.name for f in dataclasses.fields(config.network)}
    named = {RENAMED.get(name, name): _as_tuple(value) for name, value in fields.items() if name != "network"}
    return config.replace(**{name: value for name, value in named.items() if name not in foreign})


def network_config(kind: str) -> Any:
    """Default configuration of the network called `kind`.

    Raises:
        InputError: no such network.
    """
    if kind not in NETWORK_CONFIGS:
        raise InputError(f"config: network must be one of {', '.join(map(repr, NETWORK_CONFIGS))}, got {kind!r}.")
    return NETWORK_CONFIGS[kind]()


SMALL = StreamConfig(
    preset="small",
    network=ResplatConfig(),
    depth=DepthConfig(depth_readout="mean", confidence="peak"),
    history=HistoryConfig(cgfi_width=128),
    memory=MemoryConfig(min_confidence=0.3, voxel_size=0.04),
    head=HeadConfig(gaussians_per_token=1, sh_degree=3, scale_mode="absolute"),
)
"""ReSplat's layout, with the paper's own numbers for the stages that follow it."""

PRESETS: dict[str, StreamConfig] = {
    "tiny": StreamConfig(),
    "small": SMALL,
    "base": SMALL.replace(preset="base", vit="b", token_width=512),
}


@dataclasses.dataclass(frozen=True)
class Quality:
    """A point on the front of accuracy against time (`ssplat experiment accuracy_vs_time`, docs/performance.md)."""

    scale: float
    """Factor of the image size at which images are streamed."""


QUALITIES: dict[str, Quality] = {"fast": Quality(0.5), "balanced": Quality(0.75), "accurate": Quality(1.0)}
"""Choices of `--quality`; `accurate` streams images at full size."""


def preset(name: str) -> StreamConfig:
    """The configuration called `name`.

    Raises:
        InputError: no such preset.
    """
    if name not in PRESETS:
        raise InputError(f"no preset {name!r}; there is {', '.join(sorted(PRESETS))}.")
    return PRESETS[name]
