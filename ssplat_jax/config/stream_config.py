"""`StreamConfig`, its dictionary form, and the presets."""

import dataclasses
import hashlib
import json
import math
from typing import Any

from ssplat_jax.config.field_groups import (
    DepthConfig,
    HeadConfig,
    HistoryConfig,
    MemoryConfig,
    OnlineRefineConfig,
    StreamingConfig,
)
from ssplat_jax.config.network_configs import NETWORK_CONFIGS, CompactConfig, ResplatConfig, network_config
from ssplat_jax.core.errors import InputError

RENAMED_FIELDS = {"mixer_neighbours": "mixer_neighbors"}
"""Current names of fields that files written before 0.1.0 call differently."""


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
    depth: DepthConfig = dataclasses.field(default_factory=DepthConfig)
    history: HistoryConfig = dataclasses.field(default_factory=HistoryConfig)
    memory: MemoryConfig = dataclasses.field(default_factory=MemoryConfig)
    head: HeadConfig = dataclasses.field(default_factory=HeadConfig)
    stream: StreamingConfig = dataclasses.field(default_factory=StreamingConfig)
    refine: OnlineRefineConfig = dataclasses.field(default_factory=OnlineRefineConfig)

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
        """Dictionary of plain JSON types, with a dictionary per group; infinity, which JSON lacks, is "inf"."""
        fields = dataclasses.asdict(self)
        fields["network"] = {"kind": self.network.kind, **fields["network"]}
        fields |= {group: {name: _to_json(x) for name, x in fields[group].items()} for group in self.groups()}
        return json.loads(json.dumps(fields))

    @staticmethod
    def from_dict(fields: dict[str, Any]) -> "StreamConfig":
        """Configuration from `to_dict`, or from the flat dictionary of files written before 0.1.0.

        Raises:
            InputError: a field is unknown or its value is not allowed.
        """
        if isinstance(fields.get("network"), str):
            return _from_flat(fields)
        changes: dict[str, Any] = {}
        for name, value in fields.items():
            if not isinstance(value, dict):
                changes[name] = value
                continue
            changes |= {f"{name}.{field}": _from_json(x) for field, x in value.items() if field != "kind"}
            if name == "network":
                changes["network"] = value["kind"]
        return StreamConfig().replace(**changes)

    @property
    def hash(self) -> str:
        """Hash of 12 hexadecimal digits, which identifies the configuration in results and saved states."""
        return hashlib.sha256(json.dumps(self.to_dict(), sort_keys=True).encode()).hexdigest()[:12]


def _to_json(value: Any) -> Any:
    return "inf" if value == math.inf else value


def _from_json(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else math.inf if value == "inf" else value


def _from_flat(fields: dict[str, Any]) -> StreamConfig:
    """Configuration from the flat dictionary of files written before 0.1.0, which held the fields of all networks."""
    config = StreamConfig().replace(network=fields["network"])
    foreign = {f.name for kind in NETWORK_CONFIGS.values() for f in dataclasses.fields(kind)}
    foreign -= {f.name for f in dataclasses.fields(config.network)}
    named = {RENAMED_FIELDS.get(name, name): _from_json(value) for name, value in fields.items() if name != "network"}
    return config.replace(**{name: value for name, value in named.items() if name not in foreign})


PAPER = StreamConfig(
    preset="paper",
    network=ResplatConfig(),
    depth=DepthConfig(depth_readout="metric", confidence="peak"),
    history=HistoryConfig(
        cluster_ratio=math.inf,
        hpda=True,
        anchor_space="metric",
        cgfi=True,
        cgfi_form="concat",
        cgfi_width=128,
        unit_features=False,
    ),
    memory=MemoryConfig(
        min_confidence=0.3,
        voxel_size=0.04,
        carving=False,
        num_witnesses=0,
        overflow="drop_new",
        capacity=1 << 18,
    ),
    head=HeadConfig(
        gaussians_per_token=1,
        sh_degree=3,
        scale_mode="absolute",
        opacity_mode="head",
        grow_footprints=False,
        evidence=False,
    ),
    stream=StreamingConfig(scene_scale=1.0, chunk_step=0.0, match_exposure=False, causal=True),
)
"""The paper to the letter, with ReSplat's network; docs/algorithm.md lists every field."""

SMALL = PAPER.replace(preset="small", depth_readout="mean", causal=False, overflow="grow", capacity=1 << 15)
"""The paper's method for captures of any length, with depth read as the published networks read it."""

PRESETS: dict[str, StreamConfig] = {
    "tiny": StreamConfig(),
    "paper": PAPER,
    "small": SMALL,
    "base": SMALL.replace(preset="base", vit="b", token_width=512),
}


@dataclasses.dataclass(frozen=True)
class Quality:
    """A trade-off between accuracy and time (`ssplat experiment accuracy_vs_time`, docs/performance.md)."""

    scale: float
    """Factor by which images are resized before they are streamed."""
    refine_steps: int = 0
    """Refinement steps on the streamed views after the stream."""


QUALITIES: dict[str, Quality] = {
    "fast": Quality(0.5),
    "balanced": Quality(0.75),
    "accurate": Quality(1.0),
    "best": Quality(1.0, refine_steps=100),
}
"""Choices of `--quality`."""


def preset(name: str) -> StreamConfig:
    """Configuration of the preset `name`.

    Raises:
        InputError: there is no such preset.
    """
    if name not in PRESETS:
        raise InputError(f"no preset {name!r}; there is {', '.join(sorted(PRESETS))}.")
    return PRESETS[name]
