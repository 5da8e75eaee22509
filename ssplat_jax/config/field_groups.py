"""Groups of configuration fields, besides those of networks."""

import dataclasses
import math
from typing import Literal

from ssplat_jax.config.config_group import ConfigGroup, is_positive


@dataclasses.dataclass(frozen=True)
class StreamingConfig(ConfigGroup):
    """Fields that decide how images become chunks: chunk size, scale, order and exposure."""

    chunk_size: int = 4
    """Views per chunk."""
    scene_scale: float | Literal["auto"] = "auto"
    """Stream units per capture unit; `auto` scales the median depth of the capture to `median_depth`."""
    median_depth: float = 2.0
    """Median depth in stream units for `scene_scale="auto"`."""
    chunk_step: float = 0.03
    """Video is interleaved until consecutive views of a chunk are this fraction of the median depth apart (ours); 0
    keeps the order of frames."""
    match_exposure: bool = True
    """Stores colors at the exposure of the first views and estimates the exposures of the others (ours)."""
    causal: bool = False
    """Nothing depends on later frames: near, far and scale come from the first chunk, frames keep their order, and
    later chunks only move near and far outward (`streaming/causal_range.py`)."""

    def rules(self) -> tuple[tuple[str, str, bool], ...]:
        is_scale = self.scene_scale == "auto" or is_positive(self.scene_scale)
        return (
            ("chunk_size", "at least 1", self.chunk_size >= 1),
            ("median_depth", "a positive length", is_positive(self.median_depth)),
            ("chunk_step", "not negative, and finite", 0 <= self.chunk_step < math.inf),
            ("scene_scale", "'auto' or a positive factor", is_scale),
        )


@dataclasses.dataclass(frozen=True)
class DepthConfig(ConfigGroup):
    """Fields that decide how depth and confidence are read from a distribution over candidates."""

    depth_readout: Literal["metric", "mean", "window"] = "window"
    """Expectation of the depths of all candidates (`metric`, literal); of all candidates in the space in which they are
    uniform, as the published networks read it (`mean`); or of those around the peak in that space, which does not
    average two surfaces (`window`, ours)."""
    readout_window: int = 4
    """Candidates on each side of the peak that `depth_readout="window"` keeps."""
    confidence: Literal["peak", "window"] = "window"
    """`peak`: max_k P (literal). `window`: the largest sum over `2 confidence_window + 1` neighboring candidates."""
    confidence_window: int = 1
    """Candidates on each side that `confidence="window"` includes."""

    def rules(self) -> tuple[tuple[str, str, bool], ...]:
        return (
            ("readout_window", "not negative", self.readout_window >= 0),
            ("confidence_window", "not negative", self.confidence_window >= 0),
        )


@dataclasses.dataclass(frozen=True)
class HistoryConfig(ConfigGroup):
    """Fields that decide how the cache informs the next chunk: projection, HPDA and CGFI."""

    cluster_ratio: float = 1.15
    """Largest ratio of depths within the front cluster of pivots that a cell averages; `inf` averages all (literal)."""
    hpda: bool = False
    """Anchors depth distributions to cached geometry. Off in `tiny`, which gains nothing by it but on revisits."""
    anchor_space: Literal["log", "metric"] = "log"
    """Unit of sigma: log depth, or stream units (`metric`, literal)."""
    anchor_norm: Literal["none", "mass"] = "none"
    """`mass` scales the anchor to a sum of Omega, which makes gamma the odds of history against the matcher."""
    sigma0: float = 0.1
    """Standard deviation of the anchor at full confidence."""
    lambda_sigma: float = 0.5
    """Increase of the standard deviation as confidence falls from 1 to 0."""
    gamma_init: float = 0.1
    """Initial value of the learnable gamma_d = softplus(raw)."""
    recall: bool = False
    """Cells that the matcher is unsure of become tokens at the cache's depth, where the cache is sure and the matcher
    does not contradict it (ours). It thickens weakly textured surfaces that the camera returns to."""
    cgfi: bool = False
    """Injects cached features where the current views are uncertain. Off in `tiny`, which gains nothing by it."""
    cgfi_form: Literal["concat", "residual"] = "residual"
    """`concat`: a U-Net of f and the attenuated F_H gives the new features (literal). `residual`: a U-Net that also
    sees Omega gives what is added to f (ours)."""
    cgfi_width: int = 48
    """Channels inside the aggregation U-Net."""
    unit_features: bool = True
    """Features that come back from the cache have unit RMS (ours): the compact network stores them so, ReSplat's
    network reads them so."""

    def rules(self) -> tuple[tuple[str, str, bool], ...]:
        return (
            ("cgfi_width", "a multiple of 8", self.cgfi_width >= 8 and self.cgfi_width % 8 == 0),
            ("gamma_init", "positive", is_positive(self.gamma_init)),
            ("sigma0", "positive", is_positive(self.sigma0)),
            ("lambda_sigma", "not negative, and finite", 0 <= self.lambda_sigma < math.inf),
            ("cluster_ratio", "above 1", self.cluster_ratio > 1),
            ("recall", "false without hpda", self.hpda or not self.recall),
        )


@dataclasses.dataclass(frozen=True)
class MemoryConfig(ConfigGroup):
    """The voxel cache (VACC; Eqs. vacc_capacity_update and vacc_pair_selection_and_merge)."""

    vacc: Literal["voxel", "append"] = "voxel"
    """`voxel` merges tokens by voxel; `append` keeps every accepted token (the paper's ablation)."""
    voxel_size: float = 0.03
    """Side of a voxel in stream units."""
    pivots_per_voxel: int = 4
    """K: pivots that a voxel can hold."""
    min_confidence: float = 0.3
    """tau: tokens of lower confidence do not enter the cache, and pivots of lower confidence are not decoded. The
    paper's value is for `confidence="peak"`; windows give larger confidences, so more tokens enter."""
    capacity: int = 1 << 15
    """Voxels that the cache can hold, a power of two; `overflow="grow"` doubles it outside jit."""
    overflow: Literal["grow", "drop_new", "evict_lowest", "error"] = "grow"
    """Treatment of tokens of new voxels when the cache is full."""
    merge_key: Literal["seed", "feature"] = "seed"
    """Vectors whose cosine similarity selects the pair to merge."""
    merge_weight: Literal["max", "count"] = "max"
    """Weights of a merge: `max` takes omega* = max as in the paper; `count` the number of members, a true mean."""
    carving: bool = True
    """Views lower the confidence of pivots in free space that they see, and raise that of pivots on surfaces (ours)."""
    num_witnesses: int = 32
    """Number of past chunks with a stored coarse depth map, which judges the tokens of later chunks (part of
    `carving`)."""

    def rules(self) -> tuple[tuple[str, str, bool], ...]:
        is_power = self.capacity >= 128 and not self.capacity & (self.capacity - 1)
        # Eviction compares the pivots of voxels.
        fits = self.vacc != "append" or self.overflow != "evict_lowest"
        return (
            ("voxel_size", "a positive length", is_positive(self.voxel_size)),
            ("pivots_per_voxel", "at least 1", self.pivots_per_voxel >= 1),
            ("capacity", "a power of two of at least 128", is_power),
            ("min_confidence", "in [0, 1]", 0.0 <= self.min_confidence <= 1.0),
            # Carved confidences stay below 0.95 (`cache.carve.MAX_REVISED`): a higher tau rejects confirmed pivots.
            ("min_confidence", "at most 0.95 while views carve", not self.carving or self.min_confidence <= 0.95),
            ("num_witnesses", "not negative", self.num_witnesses >= 0),
            ("overflow", "'drop_new', 'grow' or 'error' with vacc='append'", fits),
        )


@dataclasses.dataclass(frozen=True)
class HeadConfig(ConfigGroup):
    """Gaussians of a token."""

    gaussians_per_token: Literal[1, 4, 16] = 4
    """Gaussians in a square over the token's cell, each with the mean color of its part of the patch (ours; 1 is
    literal)."""
    sh_degree: int = 0
    """Degree of the spherical harmonics of colors."""
    scale_mode: Literal["footprint", "absolute"] = "footprint"
    """Scales relative to the token's footprint, depth x cell / focal length (ours), or in stream units (literal)."""
    opacity_mode: Literal["head", "compound"] = "compound"
    """Opacity o of a pivot: as the head gives it (`head`, literal), or that of its n members in one place,
    1 - (1 - o)^n (`compound`, ours)."""
    grow_footprints: bool = True
    """Footprints of pivots grow with their members until they cover a voxel's face (ours)."""
    evidence: bool = True
    """Pivots keep how views saw them and how well their color fitted, and the decoder reads that (ours)."""
    max_scale: float = 1.0
    """Upper bound of scales, in stream units."""

    def rules(self) -> tuple[tuple[str, str, bool], ...]:
        return (
            ("max_scale", "positive", is_positive(self.max_scale)),
            ("sh_degree", "0 to 3", 0 <= self.sh_degree <= 3),
        )


@dataclasses.dataclass(frozen=True)
class OnlineRefineConfig(ConfigGroup):
    """Refinement while streaming: gradient steps on key views after each chunk (ours)."""

    steps_per_chunk: int = 0
    """Gradient steps after each chunk, each on one key view; 0 adds nothing to any program."""
    num_key_views: int = 64
    """Key views kept to compare the scene with; when all places are taken, one of the two most similar is replaced."""
    pivots_per_cell: int = 8
    """Pivots that a step revises, as a multiple of the grid cells of its view: the least covered ones. It fixes time
    and memory of a step."""

    def rules(self) -> tuple[tuple[str, str, bool], ...]:
        return (
            ("steps_per_chunk", "not negative", self.steps_per_chunk >= 0),
            ("num_key_views", "at least 1", self.num_key_views >= 1),
            ("pivots_per_cell", "at least 1", self.pivots_per_cell >= 1),
        )
