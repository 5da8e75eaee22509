"""The configuration: bad values are refused, and every field changes the hash."""

import dataclasses
import json
import re
from typing import ClassVar, Literal, get_args, get_origin

import pytest

from ssplat_jax.config import LITERAL, PRESETS, StreamConfig, preset
from ssplat_jax.core.errors import InputError
from ssplat_jax.network_configs import CompactConfig

BAD = [
    {"chunk_size": 0},
    {"voxel_size": float("nan")},
    {"voxel_size": float("inf")},
    {"capacity": 1000},
    {"num_sources": -1},
    {"encoder_widths": (16,)},
    {"encoder_widths": (32, 63)},
    {"attention_window": 6},
    {"token_width": 30},
    {"sh_degree": 4},
    {"scene_scale": "big"},
    {"overflow": "grwo"},
    {"min_confidence": 0.96},  # carving keeps confidences below 0.95
]


@pytest.mark.parametrize("changes", BAD, ids=str)
def test_bad_value_is_refused_by_name_and_value(changes):
    ((name, value),) = changes.items()
    group_name, name = StreamConfig().find(name)
    group = getattr(StreamConfig(), group_name)
    # Without the type checks of the tests, which users do not have.
    bad = object.__new__(type(group))
    for field in dataclasses.fields(group):
        object.__setattr__(bad, field.name, changes.get(field.name, getattr(group, field.name)))
    with pytest.raises(InputError, match=rf"config: {name} must be .*got {re.escape(repr(value))}"):
        bad.__post_init__()


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_the_same_after_json(name):
    again = StreamConfig.from_dict(json.loads(json.dumps(preset(name).to_dict(), allow_nan=False)))
    assert again == preset(name) and again.hash == preset(name).hash and hash(again) == hash(preset(name))


@pytest.mark.parametrize("network", ["compact", "resplat"])
def test_every_field_changes_the_hash(network):
    base = StreamConfig().replace(network=network)
    by_type = {
        bool: lambda x: not x,
        int: lambda x: 2 * x,
        float: lambda x: 0.5 * x + 0.7,
        tuple: lambda x: (x[0] + 8, *x[1:]),
    }
    by_name = {"steps_per_chunk": 4, "scene_scale": 3.0, "sh_degree": 3, "depth_range": (0.5, 9.0), "mixer_radius": 7}
    by_name |= {"mixer_blocks": 3, "hpda": True}
    hashes, num_fields = {base.hash, base.replace(preset="other").hash}, 1
    for group in base.groups():
        for field in dataclasses.fields(getattr(base, group)):
            value, num_fields = base.get(field.name), num_fields + 1
            if get_origin(field.type) is Literal:
                changed = next(option for option in get_args(field.type) if option != value)
            else:
                changed = by_name[field.name] if field.name in by_name else by_type[type(value)](value)
            hashes.add(base.replace(**{f"{group}.{field.name}": changed}).hash)
    assert len(hashes) == 1 + num_fields


def test_short_name_that_two_groups_share_is_refused(monkeypatch):
    @dataclasses.dataclass(frozen=True)
    class Twin(CompactConfig):
        kind: ClassVar[str] = "twin"
        voxel_size: float = 1.0

    config = StreamConfig().replace(network=Twin())
    with pytest.raises(InputError, match=r"'voxel_size' could be network.voxel_size or memory.voxel_size"):
        config.replace(voxel_size=0.5)
    assert config.replace(**{"network.voxel_size": 0.5}).get("network.voxel_size") == 0.5


def test_paper_has_no_additions():
    assert preset("paper").additions == LITERAL
    assert {x for x in dataclasses.asdict(LITERAL).values() if x is not False} == {"metric"}
