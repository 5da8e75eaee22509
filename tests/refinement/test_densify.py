"""Laws of the new Gaussians that fill holes: their place, their color, their number, and what they must not hide."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import render
from ssplat_jax.refinement import KeyViews, RefineConfig
from ssplat_jax.refinement.compared_views import held_back_pixels
from ssplat_jax.refinement.densify import CELL, MAX_HIDING, MIN_LIGHT, Cells, _densify, hides
from ssplat_jax.refinement.refine import start_refinement

WIDTH, HEIGHT, FOCAL, MAX_PAIRS, MAX_NEW = 64, 48, 48.0, 1 << 15, 256
FAR, NEAR = 3.0, 1.5
CONFIG = RefineConfig(held_back=0.0)


def wall(depth: float, is_there) -> Gaussians:
    """A wall across the view at one depth, a Gaussian for every 2 x 2 pixels; `is_there(x, y)` in [-1, 1]."""
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-1.1, 1.1, 36), np.linspace(-1.1, 1.1, 27)))
    keep = np.asarray(is_there(x, y))
    x, y = x[keep], y[keep]
    half = np.array([WIDTH, HEIGHT]) / 2 / FOCAL * depth
    size = 2 * half[0] / 32 * 0.6
    means = np.stack([x * half[0], y * half[1], np.full_like(x, depth)], axis=1)
    return Gaussians.from_rgb(
        means=jnp.asarray(means, jnp.float32),
        quats=jnp.tile(jnp.array([1.0, 0, 0, 0]), (len(x), 1)),
        scales=jnp.tile(jnp.array([size, size, 0.05 * size]), (len(x), 1)),
        opacities=jnp.full(len(x), 0.97),
        colors=jnp.asarray(np.stack([0.5 + 0.4 * x, 0.5 + 0.4 * y, np.full_like(x, depth / 4)], axis=1), jnp.float32),
    )


def joined(*parts: Gaussians) -> Gaussians:
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def cameras(shifts) -> Camera:
    viewmats = np.tile(np.eye(4, dtype=np.float32), (len(shifts), 1, 1))
    viewmats[:, 0, 3] = shifts
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], np.float32)
    return Camera(jnp.asarray(viewmats), jnp.asarray(np.tile(K, (len(shifts), 1, 1))), WIDTH, HEIGHT)


def views_of(scene: Gaussians, shifts=(0.0, 0.2, -0.2), exposures=None) -> KeyViews:
    color = render(scene, cameras(shifts), max_pairs=1 << 17).color
    factors = jnp.ones((len(shifts), 3)) if exposures is None else jnp.asarray(exposures, jnp.float32)
    return KeyViews.of(cameras(shifts), color * factors[:, None, None], factors)


WHOLE = wall(FAR, lambda x, y: np.ones_like(x, bool))
TORN = wall(FAR, lambda x, y: np.maximum(abs(x), abs(y)) > 0.3)
"""The wall with a hole of three tenths of its sides."""


def fill(gaussians, key_views, config=CONFIG, max_pairs=MAX_PAIRS, max_new=MAX_NEW) -> Gaussians:
    """The new Gaussians that are present."""
    new, num_new = _densify(gaussians, key_views, config, max_pairs, max_new)
    assert np.all(np.asarray(new.opacities[: int(num_new)]) > 0)
    assert np.all(np.asarray(new.opacities[int(num_new) :]) == 0)
    return jax.tree.map(lambda x: x[: int(num_new)], new)


def l1(gaussians: Gaussians, key_views: KeyViews) -> float:
    """Mean absolute error over black."""
    cameras = Camera(key_views.viewmats, key_views.Ks, WIDTH, HEIGHT)
    out = render(gaussians, cameras, max_pairs=1 << 17).color
    return float(jnp.abs(out * key_views.exposures[:, None, None] - key_views.images.astype(jnp.float32) / 255).mean())


def test_new_gaussians_lie_in_the_hole_on_the_surface_and_have_its_color():
    new = fill(TORN, views_of(WHOLE))
    assert 9 <= new.num_gaussians <= 30  # the hole has 19 x 14 pixels, a cell 4 x 4
    x, y, z = np.asarray(new.means).T
    np.testing.assert_allclose(z, FAR, rtol=0.02)
    half = np.array([WIDTH, HEIGHT]) / 2 / FOCAL * FAR
    assert np.max(abs(x)) < 0.45 * half[0] and np.max(abs(y)) < 0.45 * half[1]
    colors = np.asarray(0.5 + 0.28209479 * new.sh[:, 0])
    wanted = np.stack([0.5 + 0.4 * x / half[0], 0.5 + 0.4 * y / half[1], np.full_like(x, FAR / 4)], axis=1)
    np.testing.assert_allclose(colors, wanted, atol=0.1)  # the edge of the wall reaches into the hole


def test_a_view_that_shows_no_new_hole_adds_nothing():
    one = fill(TORN, views_of(WHOLE, (0.0,))).num_gaussians
    same = fill(TORN, views_of(WHOLE, (0.0, 0.0, 0.0))).num_gaussians
    assert same == one > 0
    assert fill(TORN, views_of(WHOLE)).num_gaussians < 1.5 * one


def test_a_gap_beside_a_near_object_shows_the_surface_behind_it():
    post = wall(NEAR, lambda x, y: abs(x) < 0.25)
    behind = wall(FAR, lambda x, y: abs(x) > 0.5)
    new = fill(joined(post, behind), views_of(joined(post, WHOLE), (0.0,)))
    assert new.num_gaussians > 10
    depths = np.asarray(new.means[:, 2])
    assert np.median(depths) > 0.5 * (NEAR + FAR)


def test_what_would_hide_a_surface_from_other_views_is_not_added():
    """A view of a place that others see through a near, wrong depth must not put a Gaussian before them."""
    random = np.random.default_rng(0)
    shifts = (0.0, 0.3, -0.3, 0.6)
    views = views_of(WHOLE, shifts)
    shape = (HEIGHT // CELL, WIDTH // CELL)
    depths = np.where(random.random((4, *shape)) < 0.5, FAR, 0.5 * FAR).astype(np.float32)
    light = random.random((4, *shape)).astype(np.float32)
    cells = Cells(light=jnp.asarray(light), colors=jnp.zeros((4, *shape, 3)), depths=jnp.asarray(depths))
    points = random.uniform((-2, -1.5, 0.5), (2, 1.5, 4), (300, 3)).astype(np.float32)

    inside, before = np.zeros(300), np.zeros(300)
    for view in range(4):
        at = np.asarray(views.viewmats[view], np.float64) @ np.append(points, np.ones((300, 1)), axis=1).T
        column = np.floor((FOCAL * at[0] / at[2] + WIDTH / 2) / CELL).astype(int)
        row = np.floor((FOCAL * at[1] / at[2] + HEIGHT / 2) / CELL).astype(int)
        sees = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
        row, column = np.clip(row, 0, shape[0] - 1), np.clip(column, 0, shape[1] - 1)
        hidden = (at[2] < 0.9 * depths[view, row, column]) & (light[view, row, column] < MIN_LIGHT)
        inside, before = inside + sees, before + (sees & hidden)
    wanted = before > MAX_HIDING * inside
    assert 30 < wanted.sum() < 270
    np.testing.assert_array_equal(hides(jnp.asarray(points), cells, views), wanted)


def test_exposures_are_taken_out_of_the_colors():
    usual = fill(TORN, views_of(WHOLE, (0.0,)))
    darker = fill(TORN, views_of(WHOLE, (0.0,), [[0.8, 0.5, 0.9]]))
    np.testing.assert_allclose(usual.sh, darker.sh, atol=0.06)
    bright = replace(WHOLE, sh=jnp.full_like(WHOLE.sh, 1.0 / 0.28209479))  # a color of 1.5
    new = fill(replace(TORN, sh=jnp.full_like(TORN.sh, 1.0 / 0.28209479)), views_of(bright, (0.0,), [[0.5, 0.5, 0.5]]))
    np.testing.assert_allclose(0.5 + 0.28209479 * new.sh, 1.5, atol=0.1)


@pytest.mark.parametrize("broken", ["invalid", "overflow", "not finite"])
def test_a_view_that_cannot_be_used_shows_no_hole(broken):
    views, max_pairs = views_of(WHOLE, (0.0,)), MAX_PAIRS
    if broken == "invalid":
        views = replace(views, valid=jnp.zeros(1, bool))
    if broken == "not finite":
        views = replace(views, exposures=jnp.full((1, 3), jnp.nan))
    if broken == "overflow":
        max_pairs = 64
    assert fill(TORN, views, max_pairs=max_pairs).num_gaussians == 0


def test_held_back_pixels_give_no_color():
    config = RefineConfig(held_back=0.3)
    views = views_of(WHOLE, (0.0,))
    held_back = np.asarray(held_back_pixels((HEIGHT, WIDTH), jnp.int32(0), config))
    changed = np.where(held_back[..., None], 255, np.asarray(views.images[0])).astype(np.uint8)
    new = fill(TORN, views, config)
    other = fill(TORN, replace(views, images=jnp.asarray(changed)[None]), config)
    assert 0 < new.num_gaussians < fill(TORN, views).num_gaussians
    for name, leaf in vars(new).items():
        np.testing.assert_array_equal(leaf, getattr(other, name))


def test_new_rows_take_the_places_of_absent_ones_and_then_come_last():
    views = views_of(WHOLE)
    num_new = fill(TORN, views).num_gaussians
    space = num_new // 2
    absent = jax.tree.map(lambda x: jnp.zeros((space, *x.shape[1:]), x.dtype), TORN)
    given = joined(absent, TORN)
    config = dataclasses.replace(CONFIG, max_new=1.0)
    progress, _ = start_refinement(given, views, config)
    scene = progress.scene(given)
    assert progress.num_new == num_new
    assert scene.num_gaussians == given.num_gaussians + num_new - space
    assert np.all(np.asarray(scene.opacities) > 0)
    for name, leaf in vars(TORN).items():
        np.testing.assert_array_equal(getattr(scene, name)[space : given.num_gaussians], leaf)
