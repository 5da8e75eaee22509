"""Experiments: what they compute from their measurements, and how the command line finds them."""

from importlib.metadata import entry_points

import numpy as np
import pytest
from ssplat_experiments.accuracy_vs_time import mark_fronts
from ssplat_experiments.depth_error import cell_depths, summary


def row(ms, psnr):
    return {"scene": "room", "ms_per_view": ms, "shown": psnr}


def test_the_front_holds_undominated_settings():
    rows = [row(10, 15.0), row(20, 14.0), row(20, 18.0), row(5, 12.0), row(30, 18.0), row(40, 18.5)]
    mark_fronts(rows)
    for a in rows:
        beaten = any(b["ms_per_view"] <= a["ms_per_view"] and b["shown"] >= a["shown"] and b is not a for b in rows)
        assert a["front"] != beaten


def test_depth_errors_ignore_scale_and_are_binned():
    confidences = np.array([0.2, 0.55, 0.65, 0.95, 1.0])
    row = summary(3.0 * np.array([2.0, 1.1, 1.0, 1.0, 1.02]), confidences, tau=0.5)
    assert row["accepted"] == 0.8 and row["global_scale"] == pytest.approx(3.03)
    errors = [entry["median_error"] for entry in row["by_confidence"] if entry["tokens"]]
    np.testing.assert_allclose(errors, [0.9802, 0.0891, 0.0099, 0.0099], atol=1e-4)
    assert sum(entry["tokens"] for entry in row["by_confidence"]) == 5
    row = summary(np.array([1.0, 1.0, 1.0, 1.2, 1.4]), np.array([0.3, 0.4, 0.5, 0.8, 0.9]), tau=0.0)
    # Errors of the surest 1, 2, 4, 4 and 5 tokens.
    found = {entry["share"]: entry["median_error"] for entry in row["by_share"]}
    assert found == pytest.approx({0.25: 0.4, 0.5: 0.3, 0.75: 0.1, 0.85: 0.1, 1.0: 0.0})


def test_a_cells_depth_is_the_median_of_its_known_depths():
    depth = np.zeros((9, 8), np.float32)
    depth[:4, :4] = np.arange(1, 17).reshape(4, 4)
    depth[:2, 4:] = 5.0
    depth[4, 4] = 7.0
    np.testing.assert_array_equal(cell_depths(depth), [[8.0, 5.0], [0.0, 0.0]])


def test_every_registered_experiment_and_benchmark_can_be_loaded():
    points = [*entry_points(group="ssplat_jax.experiments"), *entry_points(group="ssplat_jax.benchmarks")]
    assert {"captures", "accuracy_vs_time", "ablation", "depth_error", "cost"} <= {point.name for point in points}
    assert all(callable(point.load()) for point in points)
