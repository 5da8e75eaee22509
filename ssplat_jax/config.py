"""The static facts of a stream: everything whose change should recompile. No JAX here, so `ssplat --help` stays quick.

Numbers are the paper's where it gives them; where it is silent the default and its reason are in docs/decisions.md.
"""

import dataclasses
import hashlib
import json
import math
from typing import Any, Literal, get_args, get_origin

from ssplat_jax.errors import InputError


@dataclasses.dataclass(frozen=True)
class StreamConfig:
    """Everything static about the model, its cache and its stream. Hashable; `.replace` checks what it builds."""

    preset: str = "tiny"
    """Name of the preset this configuration started from."""

    # -- network --------------------------------------------------------------------------------------------------
    network: Literal["compact", "resplat"] = "compact"
    """`compact` is ours, narrow enough for a CPU; `resplat` is ReSplat's, layer by layer, so that its weights convert.
    It has fields of its own, next; of those of the encoder, the sweep and the U-Net below it reads `num_depths` and
    `num_sources` alone."""
    vit: Literal["s", "b", "l"] = "s"
    """Size of the vision transformer (`resplat`)."""
    match_stride: Literal[4, 8] = 4
    """Pixels to a side of a cell of the cost volume (8: `resplat` alone)."""
    depth_range: tuple[float, float] | None = None
    """Nearest and farthest candidate in stream units, where weights are of one range; None: what the chunk says."""
    depth_space: Literal["log", "inverse"] = "log"
    """Where candidates are equally far apart and depths are averaged: log depth, or 1 / depth, which is DepthSplat's
    (`resplat`)."""
    upstream_compat: bool = False
    """Sweeps and masks attention as ReSplat's code does, which its weights were trained with (`resplat`)."""

    # -- stream ---------------------------------------------------------------------------------------------------
    chunk_size: int = 4
    """Views in a chunk."""
    scene_scale: float | Literal["auto"] = "auto"
    """Factor from capture units to stream units; `auto` brings the capture's median depth to `median_depth`."""
    median_depth: float = 2.0
    """Median depth in stream units that `scene_scale="auto"` aims at."""

    # -- encoder (DepthSplat; ALGORITHM 2.2, 2.3) -----------------------------------------------------------------
    encoder_widths: tuple[int, int] = (32, 64)
    """Channels of the CNN at 1/2 and at 1/4 of the image."""
    encoder_blocks: int = 2
    """Residual blocks per scale."""
    attention_blocks: int = 2
    """Blocks of windowed self- and cross-view attention."""
    attention_window: int = 8
    """Side of an attention window in grid cells; images are padded to a multiple of 4 windows' cells."""
    attention_ffn: int = 2
    """Width of the attention's feed-forward layer over the feature width."""

    # -- plane sweep and depth (ALGORITHM 2.5 to 2.7) -------------------------------------------------------------
    num_depths: int = 64
    """Depth candidates, uniform in log depth between the chunk's near and far."""
    num_sources: int = 3
    """Source views per reference view: the nearest other views of the chunk by centre distance."""
    fine_matching: bool = True
    """Adds a second correlation, of the 1/2-resolution CNN features, sampled for the same 1/4 grid."""
    match_width: int = 32
    """Channels of the features that are correlated."""
    unet_width: int = 64
    """Channels of the cost-volume U-Net."""
    depth_readout: Literal["mean", "window"] = "window"
    """Expectation over all candidates (literal), or over those near the peak: between two modes lies no surface."""
    readout_window: int = 4
    """Candidates to each side of the peak that `depth_readout="window"` keeps."""

    # -- HPDA (Eq. cache_depth_prior, cache_prior_injection) ------------------------------------------------------
    hpda: bool = True
    anchor_space: Literal["log", "metric"] = "log"
    """Space in which sigma is measured: that of the candidates, or scene units (literal)."""
    anchor_norm: Literal["none", "mass"] = "none"
    """`mass` scales the anchor to total mass Omega, which makes gamma the odds of history against the matcher."""
    sigma0: float = 0.1
    lambda_sigma: float = 0.5
    gamma_init: float = 0.1
    """Start of the learnable gamma_d = softplus(raw)."""

    # -- confidence (ALGORITHM 9.18 to 9.22) ----------------------------------------------------------------------
    confidence: Literal["peak", "window"] = "window"
    """`peak`: max_k P (the paper). `window`: the best mass of `2 confidence_window + 1` neighbouring candidates."""
    confidence_window: int = 1

    # -- tokens, CGFI, mixer, head (ReSplat; ALGORITHM 3) ---------------------------------------------------------
    token_width: int = 64
    """Channels of a token's feature, as stored in the cache."""
    cgfi: bool = True
    cgfi_width: int = 48
    """Channels inside the aggregation U-Net."""
    mixer_blocks: int = 2
    """Pairs of a kNN block and a global block."""
    mixer_neighbours: int = 8
    """Neighbours in 3D, the token itself included."""
    mixer_radius: int = 2
    """Neighbours are looked for in a (2 r + 1)^2 patch of the token's own view; 0 searches all tokens of the chunk."""
    mixer_proj: int = 32
    """Channels of the kNN attention."""
    gaussians_per_token: Literal[1, 4, 16] = 4
    """In a square over the token's cell, each with the mean colour of its part of the patch (ours; literal: 1)."""
    sh_degree: int = 0
    scale_mode: Literal["footprint", "absolute"] = "footprint"
    """Gaussian scale relative to the token's footprint (depth x cell / focal), or softplus in scene units (literal)."""
    max_scale: float = 1.0
    """Upper clamp of a Gaussian's scale in stream units."""

    # -- VACC (Eq. vacc_capacity_update, vacc_pair_selection_and_merge) -------------------------------------------
    vacc: Literal["voxel", "append"] = "voxel"
    """`append` keeps every accepted token (the paper's ablation)."""
    voxel_size: float = 0.03
    pivots_per_voxel: int = 4
    min_confidence: float = 0.5
    """tau_conf: tokens below it never enter the cache, pivots that sink below it are not decoded. The paper's 0.3 is of
    a peak; the mass of a window is more."""
    capacity: int = 1 << 15
    """Voxels the cache can hold, a power of two; outside jit `grow` doubles it."""
    overflow: Literal["grow", "drop_new", "evict_lowest", "error"] = "grow"
    merge_key: Literal["seed", "feature"] = "seed"
    """Whose cosine selects the closest pair."""
    merge_weight: Literal["max", "count"] = "max"
    """`max` is the printed omega* = max; `count` weighs by the number of members, a true running mean."""
    carving: bool = True
    """Views lower the confidence of pivots that they look through and raise that of those they see (ours)."""
    num_witnesses: int = 32
    """Chunks of which a coarse view is kept, to judge the tokens of later ones in the same way; part of `carving`."""
    match_exposure: bool = True
    """Colours are remembered at the exposure of the first views; that of every other view is estimated (ours)."""
    chunk_step: float = 0.03
    """Video is dealt out so that the views of a chunk are this share of the depth apart (ours); 0: in order."""
    cluster_ratio: float = 1.15
    """Depth ratio that holds the front cluster of the projection together; `inf` is the plain mean (literal)."""

    def __post_init__(self) -> None:
        for name, wanted, good in (
            ("match_stride", "4 with this network", self.match_stride == 4 or self.network == "resplat"),
            ("depth_space", "'log' with this network", self.depth_space == "log" or self.network == "resplat"),
            ("depth_range", "two depths, the nearer first", _is_range(self.depth_range)),
            ("chunk_size", "at least 1", self.chunk_size >= 1),
            ("num_sources", "not negative", self.num_sources >= 0),
            ("encoder_widths", "two positive widths, the second even", _are_widths(self.encoder_widths)),
            ("encoder_blocks", "at least 1", self.encoder_blocks >= 1),
            ("attention_blocks", "not negative", self.attention_blocks >= 0),
            ("attention_window", "a multiple of 4", self.attention_window >= 4 and self.attention_window % 4 == 0),
            ("match_width", "at least 1", self.match_width >= 1),
            ("unet_width", "a multiple of 8", self.unet_width >= 8 and self.unet_width % 8 == 0),
            ("token_width", "a multiple of 4", self.token_width >= 4 and self.token_width % 4 == 0),
            ("cgfi_width", "a multiple of 8", self.cgfi_width >= 8 and self.cgfi_width % 8 == 0),
            ("mixer_blocks", "not negative", self.mixer_blocks >= 0),
            ("mixer_neighbours", "at least 1", self.mixer_neighbours >= 1),
            ("attention_ffn", "at least 1", self.attention_ffn >= 1),
            ("readout_window", "not negative", self.readout_window >= 0),
            ("confidence_window", "not negative", self.confidence_window >= 0),
            ("median_depth", "a positive length", _is_positive(self.median_depth)),
            ("mixer_radius", "not negative", self.mixer_radius >= 0),
            ("mixer_proj", "at least 1", self.mixer_proj >= 1),
            ("gamma_init", "positive", _is_positive(self.gamma_init)),
            ("max_scale", "positive", _is_positive(self.max_scale)),
            ("num_depths", "at least 1", self.num_depths >= 1),
            ("voxel_size", "a positive length", _is_positive(self.voxel_size)),
            ("pivots_per_voxel", "at least 1", self.pivots_per_voxel >= 1),
            (
                "capacity",
                "a power of two of at least 128",
                self.capacity >= 128 and not self.capacity & (self.capacity - 1),
            ),
            ("min_confidence", "in [0, 1]", 0.0 <= self.min_confidence <= 1.0),
            # Judged confidences stay below 0.95 (`cache.carve.HIGHEST`): what views confirm would be rejected.
            ("min_confidence", "at most 0.95 while views carve", not self.carving or self.min_confidence <= 0.95),
            ("sigma0", "positive", _is_positive(self.sigma0)),
            ("lambda_sigma", "not negative, and finite", 0 <= self.lambda_sigma < math.inf),
            ("num_witnesses", "not negative", self.num_witnesses >= 0),
            ("chunk_step", "not negative, and finite", 0 <= self.chunk_step < math.inf),
            ("cluster_ratio", "above 1", self.cluster_ratio > 1),
            ("sh_degree", "0 to 3", 0 <= self.sh_degree <= 3),
            (
                "scene_scale",
                "'auto' or a positive factor",
                self.scene_scale == "auto" or _is_positive(self.scene_scale),
            ),
        ):
            if not good:
                raise InputError(f"config: {name} must be {wanted}, got {getattr(self, name)!r}.")
        for field in dataclasses.fields(self):
            options = get_args(field.type) if get_origin(field.type) is Literal else ()
            if options and getattr(self, field.name) not in options:
                wanted = ", ".join(map(repr, options))
                raise InputError(f"config: {field.name} must be one of {wanted}, got {getattr(self, field.name)!r}.")
        # Without voxels there is nothing to choose between.
        if self.vacc == "append" and self.overflow == "evict_lowest":
            raise InputError("config: overflow='evict_lowest' needs vacc='voxel', got vacc='append'; use 'drop_new'.")

    def replace(self, **changes: Any) -> "StreamConfig":
        """A copy with `changes`; unknown names and bad values raise `InputError`."""
        known = {f.name for f in dataclasses.fields(self)}
        if unknown := sorted(set(changes) - known):
            raise InputError(f"config: no field {unknown[0]!r}; known fields: {', '.join(sorted(known))}.")
        return dataclasses.replace(self, **changes)

    @property
    def size_multiple(self) -> int:
        """Images are padded inside to a multiple of this: grid x (attention windows, U-Net depth)."""
        return 8 * self.match_stride if self.network == "resplat" else 4 * self.attention_window

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types; `StreamConfig(**d)` after `from_dict` gives it back."""
        return json.loads(json.dumps(dataclasses.asdict(self)))

    @staticmethod
    def from_dict(fields: dict[str, Any]) -> "StreamConfig":
        """Inverse of `to_dict`."""
        return StreamConfig().replace(**{k: tuple(v) if isinstance(v, list) else v for k, v in fields.items()})

    @property
    def hash(self) -> str:
        """Twelve hex digits that name this configuration in results and saved states."""
        return hashlib.sha256(json.dumps(self.to_dict(), sort_keys=True).encode()).hexdigest()[:12]


def _are_widths(value: Any) -> bool:
    is_good = len(value) == 2 and all(isinstance(width, int) and width >= 1 for width in value)
    return is_good and value[1] % 2 == 0  # positions are sines and cosines


def _is_positive(value: Any) -> bool:
    return isinstance(value, int | float) and 0 < value < math.inf


def _is_range(value: Any) -> bool:
    return value is None or (len(value) == 2 and all(map(_is_positive, value)) and value[0] < value[1])


RESPLAT = StreamConfig(
    preset="small",
    network="resplat",
    match_stride=8,
    depth_range=(0.01, 200.0),
    num_depths=128,
    num_sources=2,
    depth_readout="mean",
    confidence="peak",
    min_confidence=0.3,
    token_width=256,
    cgfi_width=128,
    mixer_blocks=6,
    mixer_neighbours=16,
    mixer_radius=0,
    mixer_proj=64,
    gaussians_per_token=1,
    sh_degree=3,
    scale_mode="absolute",
    voxel_size=0.04,
)
"""ReSplat's layout, and the paper's own numbers for what comes after it (ALGORITHM 3 and 11)."""

PRESETS: dict[str, StreamConfig] = {
    "tiny": StreamConfig(),
    "small": RESPLAT,
    "base": RESPLAT.replace(preset="base", vit="b", token_width=512),
}


@dataclasses.dataclass(frozen=True)
class Quality:
    """A point on the front of accuracy against time (`experiments/accuracy_vs_time.py`, docs/performance.md)."""

    scale: float
    """Of the images' size, at which they are streamed."""
    changes: tuple[tuple[str, Any], ...] = ()
    """Fields of the configuration that differ from the preset, and their values."""


QUALITIES: dict[str, Quality] = {"fast": Quality(0.5), "balanced": Quality(0.75), "accurate": Quality(1.0)}
"""What `--quality` chooses from; `accurate` is what the preset does by itself."""


def preset(name: str) -> StreamConfig:
    """The configuration called `name`.

    Raises:
        InputError: no such preset.
    """
    if name not in PRESETS:
        raise InputError(f"no preset {name!r}; there is {', '.join(sorted(PRESETS))}.")
    return PRESETS[name]
