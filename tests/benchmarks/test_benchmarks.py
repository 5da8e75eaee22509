"""The benchmarks: their form, and the figures that do not depend on the machine's speed. Slow."""

import numpy as np
import pytest

from ssplat_jax.benchmarks import rasterizer_benchmark as bench
from ssplat_jax.benchmarks import suite as benchmarks
from ssplat_jax.benchmarks.cache_benchmark import Row
from ssplat_jax.core.errors import InputError

pytestmark = pytest.mark.slow

PROTOTYPE = """
import jax.numpy as jnp
import numpy as np

def scene(num, size):
    return {"means": np.zeros((num, 3)), "scales": 0, "quats": 0, "opacities": 0, "colors": 0, "f": 1.0}

def render(means, scales, quats, opacities, colors, f, H, W, max_pairs):
    return jnp.zeros((H, W, 3)), jnp.int32(len(means))
"""


# Draws nothing; checks that it is given our scene.
CANDIDATES = """
import time

import numpy as np

def candidates(means, quats, scales, opacities, colors, viewmat, K, width, height):
    assert (width, height) == (64, 32) and np.allclose(K, [[57.6, 0, 32], [0, 57.6, 16], [0, 0, 1]])
    x, y = np.moveaxis(means[:, :2] / means[:, 2:] * 57.6, -1, 0)
    assert np.abs(x).max() <= 32 and np.abs(y).max() <= 16 and len({len(x) for x in (means, quats, scales)}) == 1
    assert colors.min() >= -1e-6 and colors.max() <= 1 + 1e-6 and opacities.shape == (1024,)
    return {"forward": lambda: time.sleep(0.02), "forward_backward": lambda: time.sleep(0.04)}
"""


@pytest.fixture
def times(monkeypatch):
    """The times that `rows_of` measures."""
    seen = {}
    alternate = bench.alternate

    def recorded(runs):
        seen.update(alternate(runs, repetitions=3))
        return seen

    monkeypatch.setattr(bench, "alternate", recorded)
    return seen


def test_rows_hold_times_stages_floor_memory_and_ratios(tmp_path, times):
    (tmp_path / "against.py").write_text(PROTOTYPE)
    rows = {row["name"]: row for row in bench.rows_of(4096, 64, against=bench.load_rasterizer(tmp_path / "against.py"))}
    values = {name.removeprefix("4096_64/"): row["value"] for name, row in rows.items()}
    units = {name.removeprefix("4096_64/"): row["unit"] for name, row in rows.items()}
    stages = ("stage_project", "stage_bin", "stage_composite")
    assert set(times) == {"forward", "forward_backward", "floor", "against_forward", *stages}
    assert all(units[name] == "ms" and values[name] == np.median(times[name]) for name in times)
    assert values["temporary_forward_backward_bytes"] > values["temporary_forward_bytes"] > 0
    assert values["forward_over_floor"] == np.median(times["forward"] / times["floor"])
    assert values["forward_over_against"] == np.median(times["forward"] / times["against_forward"])
    assert units["compile_forward_s"] == "s" and values["pairs"] > 4096 / 2


def test_another_rasterizer_draws_our_scene_forward_and_backward(tmp_path, times):
    (tmp_path / "against.py").write_text(CANDIDATES)
    rows = bench.rows_of(1024, 64, 32, against=bench.load_rasterizer(tmp_path / "against.py"), stages=False)
    values = {row["name"].removeprefix("1024_64x32/"): row["value"] for row in rows}
    assert values["against_forward"] > 20 and values["against_forward_backward"] > 40
    for name in ("forward", "forward_backward"):
        assert values[f"{name}_over_against"] == np.median(times[name] / times[f"against_{name}"])


@pytest.mark.parametrize(("text", "words"), [("import no_such_package", "no_such_package"), (PROTOTYPE, "square")])
def test_a_file_that_cannot_be_timed_is_refused(tmp_path, text, words):
    (tmp_path / "against.py").write_text(text)
    with pytest.raises(InputError, match=words):
        bench.bench_render(tmp_path / "against.py", full_hd=True)


def test_growth_counts_eight_small_passes_against_a_large_one(monkeypatch):
    def times(runs, repetitions):
        assert len(runs["small"]()) == 8 and runs["large"]().color.shape == (90, 90, 3) and repetitions > 10
        return {"small": np.array([1.0, 2.0, 4.0]), "large": np.array([1.5, 2.0, 2.0])}

    monkeypatch.setattr(bench, "GROWTH", ((256, 32), (2048, 90)))
    monkeypatch.setattr(bench, "alternate", times)
    assert bench.growth_row() == {"name": "2048_90/forward_over_8_of_256_32", "value": 1.0, "unit": "ratio"}


def test_a_stream_keeps_its_memory_and_program_at_every_age():
    for steps, programs in ((0, 1), (1, 2)):  # refinement after each chunk is a program of its own
        rows = benchmarks.bench_age("any", num_chunks=30, size=(32, 32), repeats=1, steps_per_chunk=steps)
        found = {row.name: row.value for row in rows}
        assert all(isinstance(row, Row) for row in rows)
        assert found["any_memory_growth"] == 0 and found["any_memory_bytes"] > 0
        assert found["any_compilations"] == programs


def test_the_step_is_timed_with_its_tokens(monkeypatch):
    monkeypatch.setattr(benchmarks, "bench_age", lambda name: [])
    rows = {row.name: row for row in benchmarks.bench_step()}
    tokens = rows["step_tokens_per_second"].value * rows["step_320x240"].value / 1e3
    assert tokens == pytest.approx(4 * 80 * 64)  # a cell of 4 x 4 pixels, 240 rows padded to 256
