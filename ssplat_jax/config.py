"""Configuration of a stream: the static values, whose change recompiles the program.

Defaults are those of the preset `tiny`. `preset("paper")` reads the paper to the letter: what it does not have is
marked "ours", and what it has otherwise is the group `Additions`, all off in `paper`. A value that nobody should set is
no field but a constant beside the code that uses it. This module does not import JAX, so that `ssplat --help` answers
at once.
"""

import dataclasses
import hashlib
import json
import math
from typing import Any, Literal

from ssplat_jax.core.errors import InputError
from ssplat_jax.network_configs import (
    CompactConfig,
    ConfigGroup,
    ResplatConfig,
    Rule,
    at_least,
    is_positive,
    network_config,
)

MEDIAN_DEPTH = 2.0
"""Median depth of a capture in stream units with `scene_scale="auto"`: lengths such as `voxel_size` are tuned to it."""


@dataclasses.dataclass(frozen=True)
class StreamingConfig(ConfigGroup):
    """Fields that turn images into chunks: size, scale, order, exposure, and refinement after each chunk."""

    chunk_size: int = 4
    """Views per chunk."""
    scene_scale: float | Literal["auto"] = "auto"
    """Stream units per capture unit; `auto` scales the median depth of the capture to `MEDIAN_DEPTH`."""
    # Consecutive frames of hand-held video step 0.4 % of the depth, too little for four of them to determine depth.
    chunk_step: float = 0.03
    """Video is interleaved until consecutive views of a chunk are this fraction of the median depth apart (ours); 0
    keeps the order of frames."""
    match_exposure: bool = True
    """Stores colors at the exposure of the first views and estimates the exposures of the others (ours)."""
    causal: bool = False
    """Nothing depends on later frames: near, far and scale come from the first chunk, frames keep their order, and
    later chunks only move near and far outward (`streaming/live_views.py`)."""
    steps_per_chunk: int = 0
    """Gradient steps of refinement after each chunk, each on one key view (ours); 0 adds nothing to any program."""

    def rules(self) -> tuple[Rule, ...]:
        is_scale = self.scene_scale == "auto" or is_positive(self.scene_scale)
        return (
            *at_least(1, self, "chunk_size"),
            *at_least(0, self, "steps_per_chunk"),
            ("chunk_step", "not negative, and finite", 0 <= self.chunk_step < math.inf),
            ("scene_scale", "'auto' or a positive factor", is_scale),
        )


@dataclasses.dataclass(frozen=True)
class HistoryConfig(ConfigGroup):
    """Stages by which the cache informs the next chunk."""

    # Neighboring frames of video have little parallax: there the cache knows better. Where frames are dealt out until
    # chunks have parallax, it errs as the matcher does, and scores fall.
    hpda: bool | Literal["causal"] = "causal"
    """Anchors depth distributions to cached geometry; `causal` does so where `stream.causal` is on."""
    # Trained for a short budget it moves no scene by more than 0.04 dB; longer training of all later stages lost.
    cgfi: bool = False
    """Injects cached features where the current views are uncertain."""

    def rules(self) -> tuple[Rule, ...]:
        return (("hpda", "true, false or 'causal'", self.hpda in (True, False, "causal")),)


@dataclasses.dataclass(frozen=True)
class MemoryConfig(ConfigGroup):
    """The voxel cache (VACC; Eqs. vacc_capacity_update and vacc_pair_selection_and_merge)."""

    vacc: Literal["voxel", "append"] = "voxel"
    """`voxel` merges tokens by voxel; `append` keeps every accepted token (the paper's ablation)."""
    # Four pivots per voxel are the detail that is left of a surface: 0.04 (the paper's) costs 0.23 dB on fox.
    voxel_size: float = 0.03
    """Side of a voxel in stream units."""
    pivots_per_voxel: int = 4
    """K: pivots that a voxel can hold."""
    # 0.5 would drop much of the sky; 0.2 gives the same within 0.13 dB and takes 3 to 5 % more Gaussians.
    min_confidence: float = 0.3
    """tau: tokens of lower confidence do not enter the cache, and pivots of lower confidence are not decoded. The
    paper's value is for a peak; the mass of a window (`depth_readout="window"`) is larger, so more tokens enter."""
    capacity: int = 1 << 15
    """Voxels that the cache can hold, a power of two; `overflow="grow"` doubles it outside jit."""
    overflow: Literal["grow", "drop_new"] = "grow"
    """Treatment of tokens of new voxels when the cache is full."""
    # VACC never forgets a wrong pivot. docs/results.md has what carving brings.
    carving: bool = True
    """Views lower the confidence of pivots in free space that they see, and raise that of pivots on surfaces (ours)."""

    def rules(self) -> tuple[Rule, ...]:
        is_power = self.capacity >= 128 and not self.capacity & (self.capacity - 1)
        return (
            ("voxel_size", "a positive length", is_positive(self.voxel_size)),
            *at_least(1, self, "pivots_per_voxel"),
            ("capacity", "a power of two of at least 128", is_power),
            ("min_confidence", "in [0, 1]", 0.0 <= self.min_confidence <= 1.0),
            # Carved confidences stay below 0.95 (`cache.votes.MAX_REVISED`): a higher tau rejects confirmed pivots.
            ("min_confidence", "at most 0.95 while views carve", not self.carving or self.min_confidence <= 0.95),
        )


@dataclasses.dataclass(frozen=True)
class HeadConfig(ConfigGroup):
    """Gaussians of a token."""

    # One color per patch of 4 x 4 pixels left a quarter of the squared error within patches.
    gaussians_per_token: Literal[1, 4, 16] = 16
    """Most Gaussians of a token, in a square over its cell, each with the mean color of its part of the patch (ours; 1
    is literal)."""
    sh_degree: int = 0
    """Degree of the spherical harmonics of colors."""
    # A feature that was written with its token does not know which pivots later views confirm: 0.76 dB more.
    evidence: bool = True
    """Pivots keep how views saw them and how well their color fitted, and the decoder reads that (ours)."""

    def rules(self) -> tuple[Rule, ...]:
        return (("sh_degree", "0 to 3", 0 <= self.sh_degree <= 3),)


@dataclasses.dataclass(frozen=True)
class Additions(ConfigGroup):
    """Departures of `tiny` from what the paper prints. Each reads literally when it is off ("metric" or False)."""

    # The expectation over all candidates puts a token between two modes, where no surface is, and HPDA's anchor is such
    # a second mode. The peak of one candidate depends on where the depth falls between two: the mass of three does not.
    depth_readout: Literal["metric", "mean", "window"] = "window"
    """`metric`: depth is the expectation of the depths of all candidates, confidence the largest probability (literal).
    `mean`: the expectation in the space in which candidates are uniform, as the published networks read it. `window`:
    the expectation near the peak in that space, and the mass of neighboring candidates (ours)."""
    front_cluster: bool = True
    """The projection averages the front cluster of the pivots in a cell, instead of all of them."""
    # One strength weighs a sure cell of the matcher like one without texture.
    anchor: Literal["metric", "log", "learned"] = "learned"
    """The anchor of HPDA. `metric`: one strength gamma, and a width in stream units (literal). `log`: the width is in
    log depth. `learned`: a small network gives every cell the strength, width and place of its anchor (ours)."""
    # A zero feature alone does not tell a hole from a feature.
    residual_cgfi: bool = True
    """CGFI's U-Net also sees Omega and gives what is added to f, instead of the new features."""
    # Stored features return through CGFI and are stored again; without a bound this loop grows until they are NaN.
    unit_features: bool = True
    """Features that come back from the cache have unit RMS: the compact network stores them so, ReSplat's reads them
    so."""
    # A fused feature then need not remember depth and focal length.
    footprint_scales: bool = True
    """Scales are relative to the token's footprint, depth x cell / focal length, instead of in stream units."""
    # Training renders the tokens themselves; a decoded cache should show what they would have shown, without cracks.
    merged_coverage: bool = True
    """A pivot of n members is as opaque as n Gaussians in one place, 1 - (1 - o)^n, and its footprint grows until the
    pivots of a voxel cover its face, instead of showing as one token."""
    # With one size of voxels near surfaces are blurred and far ones never merge; a wall needs fewer Gaussians than a
    # bookshelf.
    detail: bool = True
    """A voxel is between half as wide and as wide as its tokens, in powers of two of `voxel_size`, and a smooth patch
    takes fewer, larger Gaussians."""


LITERAL = Additions("metric", False, "metric", *(False,) * 5)
"""No additions: the paper as it is printed."""


@dataclasses.dataclass(frozen=True)
class StreamConfig:
    """Configuration of model, cache and stream: a group of fields for each. Frozen and hashable.

    Example:
        >>> config = preset("tiny").replace(voxel_size=0.02)
        >>> config.memory.voxel_size
        0.02
    """

    preset: str = "tiny"
    """Name of the preset that this configuration started from."""
    network: Any = dataclasses.field(default_factory=CompactConfig)
    """`CompactConfig`, `ResplatConfig`, or that of a registered network (`model.network.NetworkConfig`)."""
    history: HistoryConfig = dataclasses.field(default_factory=HistoryConfig)
    memory: MemoryConfig = dataclasses.field(default_factory=MemoryConfig)
    head: HeadConfig = dataclasses.field(default_factory=HeadConfig)
    stream: StreamingConfig = dataclasses.field(default_factory=StreamingConfig)
    additions: Additions = dataclasses.field(default_factory=Additions)

    def replace(self, **changes: Any) -> "StreamConfig":
        """Copy with changed values.

        Args:
            **changes: values by short name, `voxel_size=0.02`, by full name, `**{"memory.voxel_size": 0.02}`, or of a
                whole group, `memory=MemoryConfig()`. `network="resplat"` selects that network with its defaults.

        Raises:
            InputError: a name is unknown or ambiguous, or a value is not allowed.
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
        """Group and field of a full name, `memory.voxel_size`, or a short one, `voxel_size`.

        Raises:
            InputError: the name is unknown or ambiguous.
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
        """Dictionary of plain JSON types, with a dictionary per group."""
        fields = dataclasses.asdict(self)
        fields["network"] = {"kind": self.network.kind, **fields["network"]}
        return json.loads(json.dumps(fields))

    @staticmethod
    def from_dict(fields: dict[str, Any]) -> "StreamConfig":
        """Configuration from `to_dict`; fields that are missing have their defaults.

        Raises:
            InputError: a field is unknown or its value is not allowed.
        """
        changes: dict[str, Any] = {}
        for name, value in fields.items():
            if not isinstance(value, dict):
                changes[name] = value
                continue
            values = {k: tuple(x) if isinstance(x, list) else x for k, x in value.items() if k != "kind"}
            changes |= {f"{name}.{field}": x for field, x in values.items()}
            if name == "network":
                changes["network"] = value["kind"]
        return StreamConfig().replace(**changes)

    @property
    def is_anchored(self) -> bool:
        """True if HPDA is on in this stream."""
        return self.stream.causal if self.history.hpda == "causal" else bool(self.history.hpda)

    @property
    def hash(self) -> str:
        """Hash of 12 hexadecimal digits, which identifies the configuration in results and saved states."""
        return hashlib.sha256(json.dumps(self.to_dict(), sort_keys=True).encode()).hexdigest()[:12]


PAPER = StreamConfig(
    preset="paper",
    network=ResplatConfig(depth_range=None),
    history=HistoryConfig(hpda=True, cgfi=True),
    memory=MemoryConfig(voxel_size=0.04, carving=False, overflow="drop_new", capacity=1 << 18),
    head=HeadConfig(gaussians_per_token=1, sh_degree=3, evidence=False),
    stream=StreamingConfig(scene_scale=1.0, chunk_step=0.0, match_exposure=False, causal=True),
    additions=LITERAL,
)
"""The paper to the letter, with ReSplat's network; docs/algorithm.md lists every field."""

# Carving or unit norms on top of weights that were trained without them would change what the weights mean, so these
# differ from `paper` only in what long captures and published weights need.
PUBLISHED: dict[str, Any] = {"depth_range": ResplatConfig.depth_range, "depth_readout": "mean"}
"""Fields with which ReSplat's weights were trained."""
SMALL = PAPER.replace(preset="small", **PUBLISHED, causal=False, overflow="grow", capacity=1 << 15)
"""The paper's method for captures of any length, with depth range and readout of the published networks."""

PRESETS: dict[str, StreamConfig] = {
    "tiny": StreamConfig(),
    "paper": PAPER,
    "small": SMALL,
    "base": SMALL.replace(preset="base", vit="b", token_width=512),
}


def preset(name: str) -> StreamConfig:
    """Configuration of the preset `name`.

    Raises:
        InputError: there is no such preset.
    """
    if name not in PRESETS:
        raise InputError(f"no preset {name!r}; there is {', '.join(sorted(PRESETS))}.")
    return PRESETS[name]
