"""The benchmarks: their form, and the figures that do not depend on the machine's speed. Slow."""

import pytest

from ssplat_jax import benchmarks
from ssplat_jax.cache.bench import Row
from ssplat_jax.render import bench

pytestmark = pytest.mark.slow

AGAINST = """
import jax.numpy as jnp
import numpy as np

def scene(num, size):
    return {"means": np.zeros((num, 3)), "scales": 0, "quats": 0, "opacities": 0, "colors": 0, "f": 1.0}

def render(means, scales, quats, opacities, colors, f, H, W, max_pairs):
    return jnp.zeros((H, W, 3)), jnp.int32(len(means))
"""


def test_the_rasterizers_rows_name_times_stages_floor_memory_and_ratios(tmp_path):
    (tmp_path / "against.py").write_text(AGAINST)
    rows = {row["name"]: row for row in bench.rows_of(4096, 64, against=tmp_path / "against.py")}
    values = {name.removeprefix("4096_64/"): row["value"] for name, row in rows.items()}
    units = {name.removeprefix("4096_64/"): row["unit"] for name, row in rows.items()}
    times = ("forward", "forward_backward", "floor", "against", "stage_project", "stage_bin", "stage_composite")
    assert all(units[name] == "ms" and values[name] > 0 for name in times)
    assert values["temporary_forward_backward_bytes"] > values["temporary_forward_bytes"] > 0
    assert values["forward_over_floor"] == values["forward"] / values["floor"]
    assert values["forward_over_against"] == values["forward"] / values["against"]
    assert units["compile_forward_s"] == "s" and values["pairs"] > 4096 / 2


def test_a_stream_needs_the_same_memory_and_program_at_every_age():
    rows = {row.name: row for row in benchmarks.bench_step(num_chunks=30, late_size=(32, 32), repeats=1)}
    assert rows["step_memory_growth"].value == 0 and rows["step_memory_bytes"].value > 0
    assert rows["step_compilations"].value == 1
    tokens = rows["step_tokens_per_second"].value * rows["step_320x240"].value / 1e3
    assert tokens == pytest.approx(4 * 80 * 64)  # a cell of 4 x 4 pixels, 240 rows padded to 256
    assert all(isinstance(row, Row) for row in rows.values())
