"""Culling leaves out of an image: tiles without a visible sample, capped opacities' gradients, points behind a fold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.rasterizer import Effects, render
from ssplat_jax.rasterizer.binning import Grid, intersect_tiles, sorted_table
from ssplat_jax.rasterizer.constants import ALPHA_MIN
from ssplat_jax.rasterizer.projection import project
from tests.rasterizer.scenes import balls

WIDTH, HEIGHT, TILE = 28, 20, 8  # no multiple of a tile
GRID = Grid(num_images=1, height=HEIGHT, width=WIDTH, tile=TILE)
NUM_ROWS, MAX_PAIRS = 20_000, 180_000
CAMERA = Camera(jnp.eye(4)[None], jnp.array([[[30.0, 0, 13], [0, 28, 11], [0, 0, 1]]]), width=WIDTH, height=HEIGHT)


def random_gaussians(seed: int) -> Gaussians:
    """Gaussians of all sizes, from a twentieth of a pixel to the whole image: discs, needles, faint ones."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.5, 4.0, NUM_ROWS)
    across = rng.uniform(-0.6, 0.6, (NUM_ROWS, 2)) * z[:, None]
    size = 0.01 * 50 ** rng.uniform(size=(NUM_ROWS, 1))
    return Gaussians(
        means=jnp.asarray(np.column_stack([across, z]), jnp.float32),
        quats=jnp.asarray(rng.normal(size=(NUM_ROWS, 4)), jnp.float32),
        scales=jnp.asarray(size * 30 ** -rng.uniform(size=(NUM_ROWS, 3)), jnp.float32),
        opacities=jnp.asarray(np.maximum(rng.uniform(size=NUM_ROWS) ** 2, 0.004), jnp.float32),
        sh=jnp.zeros((NUM_ROWS, 1, 3)),
    )


@jax.jit
def binned(gaussians: Gaussians):
    """The table, and its tile intersections."""
    splats = project(gaussians, CAMERA, Effects(antialias="none"))
    table, order = sorted_table(splats, jnp.zeros((1, NUM_ROWS, 1)), GRID)
    return table, intersect_tiles(table, order // NUM_ROWS, GRID, MAX_PAIRS)


def touched_tiles(table: np.ndarray) -> np.ndarray:
    """Mask of the rows and tiles that share a pixel of alpha >= 1/255, from all pixels in float64."""
    x, y, p, q, r, log_opacity = (table[:, i, None].astype(np.float64) for i in range(6))
    pixel_x, touched = np.arange(WIDTH) + 0.5, np.zeros((len(table), GRID.rows, GRID.columns), bool)
    bound = log_opacity - np.log(ALPHA_MIN)
    for line in range(HEIGHT):
        dy = line + 0.5 - y
        drawn = (p * (pixel_x - x) + q * dy) ** 2 + (r * dy) ** 2 <= bound
        drawn = np.pad(drawn, ((0, 0), (0, -WIDTH % TILE)))
        touched[:, line // TILE] |= drawn.reshape(len(table), -1, TILE).any(axis=2)
    return touched.reshape(len(table), -1)


def test_no_tile_with_a_visible_pixel_is_left_out():
    num_touched = num_pairs = 0
    for seed in range(4):
        table, found = jax.tree.map(np.asarray, binned(random_gaussians(seed)))
        assert found.num_pairs <= MAX_PAIRS
        is_paired = np.zeros((NUM_ROWS, GRID.num_tiles), bool)
        for tile in range(GRID.num_tiles):
            rows = found.rows[found.bounds[tile] : found.bounds[tile + 1]]
            assert np.all(np.diff(rows) > 0)  # front to back, each once
            is_paired[rows, tile] = True
        is_shown = table[:, -1] * table[:, -2] > 0
        touched = touched_tiles(table) & (table[:, 2] > 0)[:, None]  # rows that are not visible have no shape
        assert not touched[~is_shown].any()
        missed = touched & ~is_paired
        assert not missed.any(), table[missed.any(axis=1)][0]
        num_touched, num_pairs = num_touched + touched.sum(), num_pairs + is_paired.sum()
    assert num_touched > 40_000
    assert num_pairs < 1.6 * num_touched  # ellipses that pass between pixel centers are kept


def test_a_capped_sample_passes_no_gradient_to_its_opacity():
    camera = Camera(viewmats=jnp.eye(4), Ks=jnp.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]), width=8, height=8)

    def alpha(opacities, gaussians):
        shown = Gaussians(gaussians.means, gaussians.quats, gaussians.scales, opacities, gaussians.sh)
        return render(shown, camera, effects=Effects(outputs=("alpha",), antialias="none"), max_pairs=64).alpha

    scene = balls([[0.0, 0.0, 1.0]], 1.0, 0.999)

    by_opacity, values = jax.jit(jax.jacrev(lambda x: 2 * (alpha(x, scene),), has_aux=True))(scene.opacities)
    by_opacity, values = np.asarray(by_opacity)[..., 0], np.asarray(values)
    capped = values >= 0.99 - 1e-6
    assert 0 < capped.sum() < capped.size
    assert not by_opacity[capped].any()
    np.testing.assert_allclose(by_opacity[~capped], values[~capped] / 0.999, rtol=1e-4)  # alpha is linear in opacity


@pytest.mark.parametrize("lens", [(-0.1, 0.003, 0, 0, 0), (-0.3, 0.03, 0, 0, 0), (-0.2, 0, 0, 0, 0)], ids=str)
def test_a_lens_that_folds_shows_nothing_behind_the_fold(lens):
    k1, k2 = lens[:2]
    tangents = np.linspace(0.02, 6.0, 300)
    slope = 1 + tangents**2 * (3 * k1 + 5 * k2 * tangents**2)
    fold = tangents[np.argmax(slope <= 0)]  # the polynomial's first maximum; farther out it may rise again
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    means = np.stack([np.outer(tangents, f(angles)) for f in (np.cos, np.sin, np.ones_like)], axis=-1)
    means[..., 2] = 1.0
    scene = balls(means.reshape(-1, 3), 0.01)
    wide = Camera(jnp.eye(4)[None], jnp.array([[[200.0, 0, 200], [0, 200, 150], [0, 0, 1]]]), width=400, height=300)
    splats = jax.jit(lambda g: project(g, wide, Effects(distortion=True), jnp.array([lens], jnp.float32)))(scene)
    visible = np.asarray(splats.visible).reshape(means.shape[:2])
    assert not visible[tangents > fold + 0.02].any()
    assert visible[tangents < fold - 0.05].all()
