"""The benchmarks: their rows, and the figures that do not depend on the machine's speed. Slow."""

from pathlib import Path

import numpy as np
import pytest
from ssplat_experiments import bench_refine, bench_render

from ssplat_jax.core.errors import InputError

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]

# Draws nothing; checks that it is given our scene.
CANDIDATES = """
import time

import numpy as np

def candidates(means, quats, scales, opacities, colors, viewmat, K, width, height):
    assert (width, height) == (64, 32) and np.allclose(K, [[57.6, 0, 32], [0, 57.6, 16], [0, 0, 1]])
    x, y = np.moveaxis(means[:, :2] / means[:, 2:] * 57.6, -1, 0)
    assert np.abs(x).max() <= 32 and np.abs(y).max() <= 16 and opacities.shape == (1024,)
    return {"forward": lambda: time.sleep(0.02), "forward_backward": lambda: time.sleep(0.04)}
"""


def test_another_rasterizer_draws_our_scene_in_the_same_turns(tmp_path, monkeypatch):
    times, alternate = {}, bench_render.alternate
    monkeypatch.setattr(bench_render, "alternate", lambda runs: times.update(alternate(runs, repetitions=3)) or times)
    (tmp_path / "against.py").write_text(CANDIDATES)
    rows = bench_render.rows_of(1024, 64, 32, against=bench_render.load_rasterizer(tmp_path / "against.py"))
    values = {row["name"].removeprefix("1024_64x32/"): row["value"] for row in rows}
    assert values["against_forward"] > 20 and values["against_forward_backward"] > 40
    for name in ("forward", "forward_backward"):
        assert values[name] == np.median(times[name])
        assert values[f"{name}_over_against"] == np.median(times[name] / times[f"against_{name}"])
    assert values["temporary_forward_backward_bytes"] > values["temporary_forward_bytes"] > 0
    assert all(values[f"stage_{stage}"] > 0 for stage in ("project", "bin", "composite"))


def test_checkouts_take_the_same_steps_by_turns(tmp_path):
    rows = {row["name"]: row["value"] for row in bench_refine.run(ROOT, num_rows=2048, size=(32, 24), repetitions=2)}
    values = {name.removeprefix("2048_32x24/"): value for name, value in rows.items()}
    assert values["step_loss"] == values["against_step_loss"] > 0
    assert values["step"] > 0 and 0.1 < values["step_over_against"] < 10
    with pytest.raises(InputError, match="checkout"):
        bench_refine.run(tmp_path)
