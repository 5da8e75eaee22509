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
from ssplat_jax.rasterizer.binning import tile_boxes
from ssplat_jax.rasterizer.effects import Effects
from ssplat_jax.rasterizer.render import RenderInputs, prepare, tile_grid_of
from ssplat_jax.refinement import RefineConfig, init_refinement, refine, refine_step
from ssplat_jax.refinement.seen_rows import may_be_seen, put_rows, select_rows, take_rows
from ssplat_jax.refinement.view_order import views_of_step
from tests.refinement.test_refine import CONFIG, MAX_PAIRS, NUM, cameras, doubtful, key_views, photographs

host = importlib.import_module("ssplat_jax.refinement.refine")
present_rows = importlib.import_module("ssplat_jax.refinement.present_rows")


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
    for focal in (1.0, 0.3, 4.0):
        scale = jnp.array([[focal, 1, 1], [1, focal, 1], [1, 1, 1]], jnp.float32)
        camera = Camera(viewmats=cameras().viewmats[1], Ks=K * scale, width=96, height=64)
        _, flat, splats, _ = prepare(RenderInputs(gaussians, camera), Effects(antialias=antialias))
        boxes = tile_boxes(splats.means2d, splats.radii, tile_grid_of(flat, 8))
        is_drawn = np.asarray(splats.visible & (boxes[2] * boxes[3] > 0))[0]
        is_seen = np.asarray(may_be_seen(gaussians, camera))
        assert is_drawn.sum() > 1000 and not (is_drawn & ~is_seen).any()
        assert is_seen.sum() < 1.4 * is_drawn.sum()


def test_rows_that_cannot_be_seen_are_left_out():
    row = lambda **changes: jax.tree.map(lambda x: x[:1], replace(doubtful(), **changes))  # noqa: E731
    good = {"means": jnp.tile(jnp.array([[0.0, 0, 2]]), (NUM, 1)), "opacities": jnp.ones(NUM)}
    assert may_be_seen(row(**good), cameras()[0])[0]
    for changes in (
        {"means": good["means"] * -1},
        {"means": good["means"] + jnp.array([[50.0, 0, 0]])},
        {"means": good["means"] * jnp.nan},
        {"opacities": jnp.zeros(NUM)},
    ):
        assert not may_be_seen(row(**{**good, **changes}), cameras()[0])[0]


@pytest.mark.parametrize("max_rows", [3, 4, 9])
def test_selected_rows_come_back_to_their_places(max_rows):
    is_seen = jnp.array([False, True, True, False, True, True, False])
    values = {"a": jnp.arange(1.0, 8), "b": jnp.arange(1.0, 15).reshape(7, 2)}
    selection = select_rows(is_seen, max_rows)
    kept = np.flatnonzero(is_seen)[:max_rows]
    taken, others = take_rows(values, selection), jax.tree.map(lambda x: -x, values)
    back = put_rows(taken, selection, others)
    assert int(selection.num_overflow) == max(4 - max_rows, 0)
    np.testing.assert_array_equal(selection.is_row, np.arange(max_rows) < 4)
    for name, given in values.items():
        np.testing.assert_array_equal(taken[name][: len(kept)], given[kept])
        wanted = -np.asarray(given)
        wanted[kept] = given[kept]
        np.testing.assert_array_equal(back[name], wanted)


def test_a_step_on_seen_rows_is_the_step_on_all():
    """A row that is not seen has moments of exactly zero; rows that do not fit are counted."""
    config, views = dataclasses.replace(CONFIG, shown_weight=0.7), key_views()
    step = jax.jit(refine_step, static_argnames=("config", "max_pairs", "max_rows"))
    seen = jnp.stack([may_be_seen(wide(), cameras()[i]) for i in range(4)])
    max_rows = int(jnp.max(jnp.sum(seen, axis=1))) + 3  # three places stay empty
    assert max_rows < NUM / 2 and seen[:, 0].all()
    given = {"config": config, "max_pairs": MAX_PAIRS}
    wanted, all_rows = step(init_refinement(wide(), config), views, jnp.float32(1), **given)
    got, report = step(init_refinement(wide(), config), views, jnp.float32(1), **given, max_rows=max_rows)
    assert int(report.num_overflow) == int(report.num_missing_rows) == 0
    assert float(report.loss) == pytest.approx(float(all_rows.loss), rel=1e-6)
    for a, b in zip(jax.tree.leaves(got.first_moment), jax.tree.leaves(wanted.first_moment), strict=True):
        assert np.abs(b).max() > 0
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * np.abs(b).max())
        assert not np.asarray(a)[~np.asarray(seen).any(axis=0)].any()
    _, report = step(init_refinement(doubtful(), config), views, jnp.float32(1), **given, max_rows=max_rows)
    assert int(report.num_missing_rows) > 0 == int(report.num_overflow)


@pytest.mark.slow
def test_refine_chooses_a_capacity_that_holds_every_step(monkeypatch):
    """The refined scene does not depend on it."""
    config = RefineConfig(held_back=0.0)
    wanted, _ = refine(wide(), cameras(), photographs(), steps=3, config=config)
    monkeypatch.setattr(present_rows, "MIN_ROWS", 1)
    masks, counts = [may_be_seen(wide(), cameras()[i]) for i in range(4)], []
    for step in range(3):
        views = views_of_step(jnp.int32(step), key_views().valid, config)
        counts.append(int(jnp.sum(masks[views[0]] | masks[views[1]])))
    capacity = host.row_capacity(wide(), key_views(), range(3), config)
    assert max(counts) <= capacity <= 1.1 * max(counts) < NUM
    got, report = refine(wide(), cameras(), photographs(), steps=3, config=config)
    assert report.num_skipped == 0
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=2e-4)


def test_absent_rows_are_left_out_and_the_others_keep_their_places(monkeypatch):
    given = doubtful()
    assert present_rows.present_rows(given) is None  # too few to be worth it
    monkeypatch.setattr(present_rows, "MIN_ROWS", 1)
    rows = present_rows.present_rows(given)
    np.testing.assert_array_equal(rows, np.flatnonzero(np.asarray(given.opacities) > 0))
    taken = present_rows.only_present(given, rows)
    assert taken.num_gaussians == present_rows.round_rows(len(rows)) < NUM
    np.testing.assert_array_equal(taken.means[: len(rows)], given.means[rows])
    assert not np.asarray(taken.opacities[len(rows) :]).any()
    moved = replace(taken, means=taken.means + 1)
    back = present_rows.back_in_place(moved, rows, given)
    is_absent = (np.asarray(given.opacities) == 0)[:, None]
    np.testing.assert_array_equal(back.means, np.where(is_absent, given.means, given.means + 1))
    for name in ("quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(back, name), getattr(given, name))


@pytest.mark.parametrize("num", [0, 1, 4096, 4097, 131_072, 131_073, 474_140, 700_000])
def test_capacities_hold_their_rows_and_are_few(num):
    assert num <= present_rows.round_rows(num) <= max(4096 * -(-max(num, 1) // 4096), num * 17 / 16)
    assert len({present_rows.round_rows(n) for n in range(262_145, 524_289, 64)}) <= 16


def test_rows_that_find_no_space_get_it_and_nothing_else_grows(monkeypatch):
    monkeypatch.setattr(present_rows, "MIN_ROWS", 1)
    config = RefineConfig(held_back=0.0)
    progress, views = host.start_refinement(wide(), key_views(), config)
    max_pairs, too_few = progress.max_pairs, 3
    progress.max_rows = too_few
    steps = host.continue_refinement(progress, views, 4, config)
    next(steps)
    assert progress.max_rows > too_few and progress.max_pairs == max_pairs
    grown = progress.max_rows
    for _ in steps:
        pass
    assert (progress.max_rows, progress.max_pairs) == (grown, max_pairs)
