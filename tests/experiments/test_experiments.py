"""Experiments: what they compute from their measurements, and how the command line finds them."""

from importlib.metadata import entry_points
from types import SimpleNamespace

import numpy as np
import pytest
from ssplat_experiments import ablation
from ssplat_experiments.accuracy_vs_time import mark_fronts
from ssplat_experiments.depth_error import around_cells, near_edges, summary

from ssplat_jax.config import preset
from ssplat_jax.training.recipe import RECIPES


def test_the_front_holds_undominated_settings():
    settings = ((10, 15.0), (20, 14.0), (20, 18.0), (5, 12.0), (30, 18.0), (40, 18.5))
    rows = [{"scene": "room", "ms_per_view": ms, "shown": psnr} for ms, psnr in settings]
    mark_fronts(rows)
    for a in rows:
        beaten = any(b["ms_per_view"] <= a["ms_per_view"] and b["shown"] >= a["shown"] and b is not a for b in rows)
        assert a["front"] != beaten


def test_trainings_of_the_ablation_have_lpips_where_their_loss_has(monkeypatch):
    given = []

    def train(config, recipe, out, *, lpips_weights, **rest):
        given.append(lpips_weights)
        return SimpleNamespace(params={}, interrupted=None)

    monkeypatch.setattr(ablation, "installed_lpips", lambda: "weights")
    monkeypatch.setattr(ablation, "train", train)
    for name in ("stream", "evidence", "depth"):
        ablation.trained_by(preset("tiny"), RECIPES[name], {})
    assert given == ["weights", "weights", None]


def test_depth_errors_ignore_scale_and_are_binned():
    confidences = np.array([0.2, 0.55, 0.65, 0.95, 1.0])
    ratios, at_edges = 3.0 * np.array([2.0, 1.1, 1.0, 1.0, 1.02]), np.array([True, True, False, False, True])
    around = np.stack([ratios, [3.0, np.nan, 3.06, 3.0, 3.2]], axis=-1)  # a second surface, or none, is near
    row = summary(ratios, confidences, at_edges, around, tau=0.5)
    assert row["accepted"] == 0.8 and row["global_scale"] == pytest.approx(3.03)
    errors = [entry["median_error"] for entry in row["by_confidence"] if entry["tokens"]]
    np.testing.assert_allclose(errors, [0.9802, 0.0891, 0.0099, 0.0099], atol=1e-4)
    assert sum(entry["tokens"] for entry in row["by_confidence"]) == 5
    assert (row["median_error_at_edges"], row["off_surfaces"]) == (pytest.approx(0.0495, abs=1e-4), 0.25)


def test_cells_are_near_an_edge_within_four_pixels_and_see_the_surfaces_around_them():
    depth = np.full((8, 24), 2.0, np.float32)
    depth[:, 12:] = 3.0
    depth[:, 20:], depth[0, 23] = 0.0, 9.0  # an edge to what is not known is none
    np.testing.assert_array_equal(near_edges(depth), [[False, True, True, True, True, False]] * 2)
    seen = [set(np.unique(cell[np.isfinite(cell)])) for cell in around_cells(np.where(depth > 0, depth, np.nan))[1]]
    assert seen == [{2.0}, {2.0}, {2.0, 3.0}, {2.0, 3.0}, {3.0, 9.0}, {3.0, 9.0}]


def test_every_registered_experiment_and_benchmark_can_be_loaded():
    points = [*entry_points(group="ssplat_jax.experiments"), *entry_points(group="ssplat_jax.benchmarks")]
    assert {"captures", "accuracy_vs_time", "ablation", "depth_error", "cost"} <= {point.name for point in points}
    assert all(callable(point.load()) for point in points)
