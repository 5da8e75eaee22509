"""Visible Gaussians are written, and where there are too many, a selection that is alike everywhere."""

import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.pytree import replace
from ssplat_jax.scene_files.formats import load_ply, save_gaussians, save_ply
from ssplat_jax.scene_files.splat_rows import rows_to_write, thinned_mask
from tests.scene_files.scene_fixture import scene


def grid(rows: int, columns: int, x: float = 0.0) -> np.ndarray:
    """Positions of a flat square grid."""
    across, up = np.mgrid[:columns, :rows] * 0.2
    return np.stack([across.ravel() + x, up.ravel(), np.zeros(rows * columns)], axis=1)


def test_rows_that_no_viewer_shows_are_dropped_and_counted(tmp_path):
    good = scene(1, n=10)
    bad = replace(
        good,
        means=good.means.at[0, 1].set(jnp.nan),
        quats=good.quats.at[1, 0].set(jnp.inf),
        scales=good.scales.at[2, 2].set(-0.1).at[7, 0].set(jnp.inf),
        opacities=good.opacities.at[3].set(0.0).at[4].set(0.9 / 255).at[5].set(jnp.nan).at[8].set(1.1 / 255),
        sh=good.sh.at[6, 3, 0].set(-jnp.inf),
    )
    report = save_ply(tmp_path / "a.ply", bad)
    assert (report.num_written, report.num_dropped) == (2, 8)
    np.testing.assert_array_equal(load_ply(tmp_path / "a.ply").means, good.means[8:])
    report = save_gaussians(tmp_path / "b.ply", bad, max_splats=1)
    assert (report.num_written, report.num_dropped, report.num_cut) == (1, 8, 1)


@pytest.mark.parametrize("num_kept", [1, 7, 20, 49])
def test_exactly_so_many_stay_in_their_order(num_kept):
    gaussians = scene(1, n=50)
    everything, (rows, num_cut) = rows_to_write(gaussians)[0], rows_to_write(gaussians, num_kept)
    mask = thinned_mask(everything.means, np.asarray(gaussians.opacities, np.float64), num_kept)
    assert num_cut == 50 - num_kept and mask.sum() == num_kept
    for name in ("means", "quats", "log_scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(rows, name), getattr(everything, name)[mask])


@pytest.mark.parametrize(
    ("num_kept", "factor"),
    [(600, 600 / (500 * 1.1125)), (800, (800 - 500) / (500 * 0.3025))],  # with 800 all of the most opaque are kept
)
def test_thinning_keeps_as_often_as_opacity_squared(num_kept, factor):
    values = np.array([0.9, 0.45, 0.3, 0.1])  # squares 0.81, 0.2025, 0.09 and 0.01
    opacities = np.random.default_rng(0).permutation(np.tile(values, 500))
    mask = thinned_mask(grid(40, 50), opacities, num_kept)
    shares = [mask[opacities == value].mean() for value in values]
    np.testing.assert_allclose(shares, np.minimum(factor * values**2, 1.0), atol=0.02)


def test_thinning_takes_the_same_share_everywhere():
    means = np.concatenate([grid(20, 20, x) for x in (0.0, 100.0, 300.0, 301.0)])
    mask = thinned_mask(means, np.full(1600, 0.8), 500)
    assert all(abs(int(share.sum()) - 125) <= 2 for share in np.split(mask, 4)[:2]) and mask.sum() == 500
    assert abs(int(mask[:400].reshape(20, 20)[:10, :10].sum()) - 125 / 4) <= 6
