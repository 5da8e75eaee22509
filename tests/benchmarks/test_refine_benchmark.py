"""The benchmark of a refinement step: its scene, its turns with another checkout, and what it refuses."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.benchmarks.refine_benchmark import bench_refine
from ssplat_jax.benchmarks.refine_worker import NUM_VIEWS, scene
from ssplat_jax.core.errors import InputError
from ssplat_jax.refinement.scene_rows import may_be_seen

ROOT = Path(__file__).resolve().parents[2]


def test_every_view_sees_less_than_half_of_the_rows():
    gaussians, cameras = scene(4096, 64, 48)
    assert np.mean(gaussians.opacities > 0) == pytest.approx(0.904, abs=0.02)
    for view in range(NUM_VIEWS):
        assert 0.35 < float(jnp.mean(may_be_seen(gaussians, cameras[view]))) < 0.5


def test_another_folder_than_a_checkout_is_refused(tmp_path):
    with pytest.raises(InputError, match="--against wants the root of a checkout"):
        bench_refine(tmp_path)


@pytest.mark.slow  # starts two processes
def test_checkouts_take_the_same_steps_by_turns():
    rows = {row["name"]: row["value"] for row in bench_refine(ROOT, num_rows=2048, size=(32, 24), repetitions=2)}
    values = {name.removeprefix("2048_32x24/"): value for name, value in rows.items()}
    assert values["step_loss"] == values["against_step_loss"] > 0
    assert values["step"] > 0 and 0.1 < values["step_over_against"] < 10


@pytest.mark.slow  # starts a process
def test_a_checkout_that_takes_no_step_is_named(tmp_path):
    (tmp_path / "ssplat_jax" / "refinement").mkdir(parents=True)
    (tmp_path / "ssplat_jax" / "__init__.py").write_text("")
    with pytest.raises(InputError, match="took no step"):
        bench_refine(tmp_path, num_rows=2048, size=(32, 24), repetitions=1)
