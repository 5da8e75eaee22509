"""The rows that a view may see: none that is drawn is missing, and a step on them alone is the step on all."""

import dataclasses
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import Effects, render
from ssplat_jax.rasterizer.binning import tile_boxes
from ssplat_jax.rasterizer.render import RenderInputs, prepare, tile_grid_of
from ssplat_jax.refinement import init_refinement
from ssplat_jax.refinement.compared_views import views_of_step
from ssplat_jax.refinement.refine import Progress, row_capacity, tiles_for
from ssplat_jax.refinement.refine_step import may_be_seen, round_rows, without_padding
from tests.refinement.test_refine import CONFIG, MAX_PAIRS, NUM, cameras, doubtful, key_views, step

module = importlib.import_module("ssplat_jax.refinement.refine_step")  # the package has a function of that name
SEEN = jax.jit(may_be_seen)


def wide() -> Gaussians:
    """`doubtful`, every other row of which stands outside all views or behind them."""
    given = doubtful()
    aside = jnp.asarray([[30.0, 0, 3], [0, -20, 3], [0, 0, -3]])[jnp.arange(NUM) % 3]
    given = replace(given, means=jnp.where(jnp.arange(NUM)[:, None] % 2 > 0, given.means, aside))
    return jax.tree.map(lambda x: jnp.roll(x, -1, axis=0), given)  # the first row is present, and seen


@pytest.mark.parametrize("antialias", ["mip", pytest.param("classic", marks=pytest.mark.slow)])
def test_no_row_that_is_drawn_is_missing(antialias):
    """20,000 Gaussians of all sizes and places: before, behind and beside the camera, across the near plane."""
    random, num = np.random.default_rng(0), 20_000
    single = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    gaussians = Gaussians(
        means=single(random.uniform(-1, 1, (num, 3)) * np.exp(random.uniform(-4, 2, (num, 1)))),
        quats=single(random.normal(size=(num, 4))),
        scales=single(np.exp(random.uniform(-8, 0, (num, 1)) + random.normal(0, 1, (num, 3)))),
        opacities=single(np.where(random.random(num) < 0.1, 0, random.uniform(0, 1, num))),
        sh=jnp.zeros((num, 1, 3)),
    )
    K = single([[90, 0, 25], [0, -70, 60], [0, 0, 1]])

    @jax.jit
    def drawn(camera):
        _, flat, splats, _ = prepare(RenderInputs(gaussians, camera), Effects(antialias=antialias))
        boxes = tile_boxes(splats.means2d, splats.radii, tile_grid_of(flat, 8))
        return (splats.visible & (boxes[2] * boxes[3] > 0))[0]

    for focal in (1.0, 0.3, 4.0):
        scale = jnp.array([[focal, 1, 1], [1, focal, 1], [1, 1, 1]], jnp.float32)
        camera = Camera(viewmats=cameras().viewmats[1], Ks=K * scale, width=96, height=64)
        is_drawn, is_seen = np.asarray(drawn(camera)), np.asarray(SEEN(gaussians, camera))
        assert is_drawn.sum() > 1000 and not (is_drawn & ~is_seen).any()
        assert is_seen.sum() < 1.4 * is_drawn.sum()


def test_a_step_on_seen_rows_is_the_step_on_all():
    """A row that is not seen has moments of exactly zero; rows that do not fit are counted."""
    config, views = dataclasses.replace(CONFIG, shown_weight=0.7), key_views()
    seen = jnp.stack([SEEN(wide(), cameras()[i]) for i in range(4)])
    max_rows = int(jnp.max(jnp.sum(seen, axis=1))) + 3  # three places stay empty
    assert max_rows < NUM / 2 and seen[:, 0].all()
    wanted, all_rows = step(init_refinement(wide(), CONFIG), views, config=config)
    got, report = step(init_refinement(wide(), CONFIG), views, config=config, max_rows=max_rows)
    assert int(report.num_overflow) == int(report.num_missing_rows) == 0
    assert float(report.loss) == pytest.approx(float(all_rows.loss), rel=1e-6)
    for a, b in zip(jax.tree.leaves(got.adam.mu), jax.tree.leaves(wanted.adam.mu), strict=True):
        assert np.abs(b).max() > 0
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * np.abs(b).max())
        assert not np.asarray(a)[~np.asarray(seen).any(axis=0)].any()
    _, report = step(init_refinement(doubtful(), CONFIG), views, config=config, max_rows=max_rows)
    assert int(report.num_missing_rows) > 0 == int(report.num_overflow)


def test_the_chosen_capacity_holds_every_step(monkeypatch):
    monkeypatch.setattr(module, "MIN_ROWS", 1)
    masks, counts = [SEEN(wide(), cameras()[i]) for i in range(4)], []
    for i in range(3):
        views = views_of_step(jnp.int32(i), key_views().valid, CONFIG)
        counts.append(int(jnp.sum(masks[views[0]] | masks[views[1]])))
    capacity = row_capacity(init_refinement(wide()), key_views(), 3, CONFIG)
    assert max(counts) <= capacity <= 1.1 * max(counts) < NUM


def test_padding_behind_the_last_present_row_is_left_out_and_comes_back(monkeypatch):
    monkeypatch.setattr(module, "MIN_ROWS", 1)
    given = jax.tree.map(lambda x: jnp.concatenate([x, jnp.ones((100, *x.shape[1:]))]), doubtful())
    given = replace(given, opacities=given.opacities.at[NUM:].set(0.0))
    shortened = without_padding(given)
    assert shortened.num_gaussians == round_rows(NUM)
    state = init_refinement(shortened, dataclasses.replace(CONFIG, sh_degree=1))
    whole = Progress(state, key_views(), CONFIG, max_pairs=1).scene(given)
    assert whole.sh_degree == 1
    for name in ("means", "scales", "opacities"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(given, name), err_msg=name)


def test_small_gaussians_have_small_tiles_and_space_for_their_intersections():
    """Gaussians of three pixels touch four times as many small tiles as usual ones; those of a seventh do not."""
    for size, wanted in ((0.02, 4), (0.5, 8)):
        given = replace(doubtful(), scales=jnp.full((NUM, 3), size))
        tile, max_pairs = tiles_for(given, key_views())
        assert tile == wanted
        assert max_pairs >= int(render(given, cameras(), max_pairs=MAX_PAIRS, tile=tile).num_pairs) > 0
