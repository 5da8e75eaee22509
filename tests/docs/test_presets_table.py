"""The table of presets in docs/algorithm.md: every field of the shared stages, with the values of the presets."""

import dataclasses
import json

import pytest

from ssplat_jax.config import PRESETS, preset
from tests.docs.pages import ROOT, tables

METHOD_PAGE = ROOT / "docs" / "algorithm.md"
COLUMNS = {"paper": 2, "small": 3, "base": 3, "tiny": 4}
"""Column of each preset."""

(TABLE,) = (table for table in tables(METHOD_PAGE.read_text()) if table[0][0] == "Field")
ROWS = {row[0].strip("`"): row for row in TABLE[1:]}


def shown(name: str, field: str) -> str:
    """A preset's value as `--set` takes it."""
    group, short = field.split(".")
    value = preset(name).to_dict()[group][short]
    return value if isinstance(value, str) else json.dumps(value)


def differing(a: str, b: str) -> set[str]:
    """Fields in which two presets differ, networks aside."""
    return {field for field in ROWS if preset(a).get(field) != preset(b).get(field)}


def test_the_table_has_every_field_of_the_shared_stages_once():
    config = preset("tiny")
    groups = [group for group in config.groups() if group != "network"]
    fields = [f"{group}.{field.name}" for group in groups for field in dataclasses.fields(getattr(config, group))]
    assert sorted(row[0].strip("`") for row in TABLE[1:]) == sorted(fields)


@pytest.mark.parametrize("name", PRESETS)
def test_the_table_has_the_values_of_the_preset(name):
    stated = {field: row[COLUMNS[name]].strip("`") for field, row in ROWS.items()}
    assert stated == {field: shown(name, field) for field in ROWS}


def test_the_additions_are_off_in_small_and_base_too():
    """They differ from `paper` only in what captures of any length, and published weights, need."""
    usable = {"additions.depth_readout", "memory.capacity", "memory.overflow", "stream.causal"}
    assert differing("paper", "small") == differing("paper", "base") == usable
    assert preset("paper").network == preset("small").network
