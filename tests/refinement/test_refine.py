"""Laws of gradient refinement, on a small scene whose truth is known."""

import dataclasses
import functools
import importlib
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians, mask_gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.evaluation.psnr_ssim import psnr
from ssplat_jax.rasterizer import render
from ssplat_jax.refinement import (
    KeyViews,
    RefineConfig,
    current_gaussians,
    init_refinement,
    present_rows,
    refine,
    refine_step,
)
from ssplat_jax.refinement.refine import has_stopped_helping
from ssplat_jax.refinement.revision import apply_revision, no_revision, sizes
from ssplat_jax.refinement.view_loss import EFFECTS, held_back_pixels
from ssplat_jax.refinement.view_order import next_view

module = importlib.import_module("ssplat_jax.refinement.refine")  # the package has a function of that name
NUM, WIDTH, HEIGHT, NUM_VIEWS, MAX_PAIRS = 48, 24, 16, 4, 1 << 12
CONFIG = RefineConfig(held_back=0.0, shown_weight=0.0)  # the scene stands before black
FIELDS = ("means", "quats", "scales", "opacities", "sh")


def scene(seed: int = 0) -> Gaussians:
    """Blobs in front of the cameras, a third of the rows absent."""
    random = np.random.default_rng(seed)
    gaussians = Gaussians.from_rgb(
        means=jnp.asarray(random.uniform((-1.2, -0.8, 2.0), (1.2, 0.8, 4.0), (NUM, 3)), jnp.float32),
        quats=jnp.asarray(random.normal(size=(NUM, 4)), jnp.float32),
        scales=jnp.asarray(random.uniform(0.1, 0.4, (NUM, 3)), jnp.float32),
        opacities=jnp.asarray(random.uniform(0.2, 0.9, NUM), jnp.float32),
        colors=jnp.asarray(random.uniform(0.1, 0.9, (NUM, 3)), jnp.float32),
    )
    return mask_gaussians(gaussians, jnp.arange(NUM) % 3 > 0)


def cameras(shifts=(0.0, 0.15, -0.15, 0.3)) -> Camera:
    """Cameras side by side that look along +z."""
    viewmats = np.tile(np.eye(4, dtype=np.float32), (len(shifts), 1, 1))
    viewmats[:, 0, 3] = shifts
    K = np.array([[20.0, 0, WIDTH / 2], [0, 20.0, HEIGHT / 2], [0, 0, 1]], np.float32)
    return Camera(
        viewmats=jnp.asarray(viewmats), Ks=jnp.asarray(np.tile(K, (len(shifts), 1, 1))), width=WIDTH, height=HEIGHT
    )


@functools.cache
def photographs():
    """Images of the true scene from `cameras`."""
    color = render(scene(), cameras(), max_pairs=MAX_PAIRS).color
    return color


def doubtful() -> Gaussians:
    """The true scene with wrong colors, sizes and places."""
    true, random = scene(), np.random.default_rng(1)
    noise = lambda size: jnp.asarray(random.normal(size=size), jnp.float32)  # noqa: E731
    return replace(
        true,
        means=true.means + 0.05 * noise((NUM, 3)),
        scales=true.scales * jnp.exp(0.2 * noise((NUM, 3))),
        sh=true.sh + 0.4 * noise((NUM, 1, 3)),
    )


def key_views(images=None, exposures=None) -> KeyViews:
    return KeyViews.of(cameras(), photographs() if images is None else images, exposures)


STEP = jax.jit(refine_step, static_argnames=("config", "max_pairs"))


def step(state, views, rate=1.0, config=CONFIG):
    return STEP(state, views, jnp.float32(rate), config=config, max_pairs=MAX_PAIRS)


def assert_same_bits(a: Gaussians, b: Gaussians) -> None:
    for name in FIELDS:
        np.testing.assert_array_equal(np.asarray(getattr(a, name)), np.asarray(getattr(b, name)), err_msg=name)


def test_zero_steps_return_the_scene_bit_for_bit():
    refined, report = refine(doubtful(), cameras(), photographs(), steps=0)
    assert_same_bits(refined, doubtful())
    assert report.num_steps == 0 and report.losses == []


def test_a_learning_rate_of_zero_changes_no_bit():
    state, _ = step(init_refinement(doubtful()), key_views(), rate=0.0)
    assert_same_bits(current_gaussians(state), doubtful())


def test_refinement_gains_on_a_view_never_shown():
    unseen = cameras(shifts=(0.08,))
    truth = np.asarray(render(scene(), unseen).color)[0]
    before = psnr(np.asarray(render(doubtful(), unseen).color)[0], truth)
    refined, report = refine(doubtful(), cameras(), photographs(), steps=60, config=CONFIG)
    after = psnr(np.asarray(render(refined, unseen).color)[0], truth)
    assert after > before + 3.0
    assert np.mean(report.losses[-4:]) < 0.6 * np.mean(report.losses[:4])
    assert report.num_steps == 60 and report.num_skipped == 0


def test_absent_rows_keep_every_bit():
    refined, _ = refine(doubtful(), cameras(), photographs(), steps=8, config=CONFIG)
    absent = np.asarray(doubtful().opacities) == 0
    assert absent.any() and (np.asarray(refined.opacities)[absent] == 0).all()
    for name in FIELDS:
        kept, given = (np.asarray(getattr(g, name))[absent] for g in (refined, doubtful()))
        np.testing.assert_array_equal(kept, given, err_msg=name)


def test_scan_equals_the_loop():
    views, rates = key_views(), jnp.linspace(1.0, 0.3, 5)
    body = functools.partial(refine_step, config=CONFIG, max_pairs=MAX_PAIRS)
    scanned, _ = jax.jit(lambda s: jax.lax.scan(lambda c, r: body(c, views, r), s, rates))(init_refinement(doubtful()))
    looped = init_refinement(doubtful())
    for rate in rates:
        looped, _ = step(looped, views, rate)
    for a, b in zip(jax.tree.leaves(scanned), jax.tree.leaves(looped), strict=True):
        np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=1e-4, atol=1e-5)


def test_first_adam_step_is_the_formula_in_float64():
    """After one step Adam moves every parameter with a gradient by its rate, against the gradient's sign."""
    state, _ = step(init_refinement(doubtful()), key_views(), config=CONFIG)
    gradient = {n: np.asarray(getattr(state.first_moment, n), np.float64) / (1 - CONFIG.adam_b1) for n in ("means",)}
    second = np.asarray(state.second_moment.means, np.float64) / (1 - CONFIG.adam_b2)
    wanted = -CONFIG.mean_rate * gradient["means"] / (np.sqrt(second) + 1e-15)
    wanted = np.where(gradient["means"] == 0, 0.0, wanted)
    np.testing.assert_allclose(np.asarray(state.revision.means), wanted, rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(second, gradient["means"] ** 2, rtol=1e-3, atol=1e-24)
    assert np.any(gradient["means"] != 0)


def test_a_step_averages_the_gradients_of_its_views():
    """A step on all views has the mean of the gradients that steps on one view each have."""
    config = dataclasses.replace(CONFIG, views_per_step=NUM_VIEWS)
    state, report = step(init_refinement(doubtful()), key_views(), config=config)
    assert sorted(np.asarray(report.views)) == list(range(NUM_VIEWS))
    singles, losses = [], []
    for view in range(NUM_VIEWS):
        only = replace(key_views(), valid=jnp.arange(NUM_VIEWS) == view)
        one, measured = step(init_refinement(doubtful()), only, config=dataclasses.replace(CONFIG, views_per_step=1))
        singles.append(one.first_moment)
        losses.append(float(measured.loss))
    for name in ("means", "log_scales", "quats", "logit_opacities", "sh"):
        wanted = np.mean([np.asarray(getattr(single, name), np.float64) for single in singles], axis=0)
        moment = np.asarray(getattr(state.first_moment, name))
        np.testing.assert_allclose(moment, wanted, rtol=1e-4, atol=1e-6 * np.abs(wanted).max())
    assert float(report.loss) == pytest.approx(np.mean(losses), rel=1e-5)


@pytest.mark.parametrize("bad", ["exposure", "image of one view"])
def test_a_step_that_is_not_finite_changes_only_its_count(bad):
    views = key_views(exposures=jnp.full((NUM_VIEWS, 3), jnp.nan))
    if bad == "image of one view":
        views = replace(key_views(), Ks=key_views().Ks.at[:, 0, 0].set(jnp.inf), exposures=views.exposures)
    state, _ = step(init_refinement(doubtful()), views)
    assert_same_bits(current_gaussians(state), doubtful())
    assert int(state.num_skipped) == 1 and int(state.num_steps) == 1
    for leaf in jax.tree.leaves((state.revision, state.first_moment, state.second_moment)):
        assert not np.asarray(leaf).any()


def test_no_gaussian_leaves_its_trust_region():
    config = RefineConfig(held_back=0.0, mean_rate=3.0, log_scale_rate=2.0, max_shift=0.5, max_log_scale_change=0.3)
    refined, _ = refine(doubtful(), cameras(), 1.0 - photographs(), steps=6, config=config)
    start = doubtful()
    moved = np.linalg.norm(np.asarray(refined.means - start.means), axis=1)
    assert (moved <= 0.5 * np.asarray(sizes(start)) * (1 + 1e-5)).all() and moved.max() > 0
    grown = np.abs(np.log(np.asarray(refined.scales / start.scales)))
    assert (grown <= 0.3 + 1e-5).all() and grown.max() > 0.29


def test_held_back_pixels_change_no_bit_of_the_scene():
    config = RefineConfig(held_back=0.4, seed=1)
    state = init_refinement(doubtful())
    view = next_view(state.num_steps, key_views().valid, config.seed)
    held_back = np.asarray(held_back_pixels((HEIGHT, WIDTH), view, config))
    assert 0 < held_back.mean() < 1
    other = np.array(photographs())
    other[int(view)][held_back] = 1.0 - other[int(view)][held_back]
    first, first_report = step(state, key_views(), config=config)
    second, second_report = step(state, key_views(jnp.asarray(other)), config=config)
    assert_same_bits(current_gaussians(first), current_gaussians(second))
    assert float(first_report.loss) == float(second_report.loss)
    assert float(first_report.held_back) != float(second_report.held_back)


def test_every_round_shows_every_valid_view_once():
    valid = jnp.array([True, False, True, True, False])
    order = [int(next_view(jnp.int32(i), valid, seed=0)) for i in range(30)]
    rounds = [order[i : i + 3] for i in range(0, 30, 3)]
    assert all(sorted(part) == [0, 2, 3] for part in rounds)
    assert len({tuple(part) for part in rounds}) > 1


def test_any_few_views_in_a_row_lie_evenly_in_the_stream():
    """Within a round, 16 views of 64 leave gaps of at most 9, where 4 would be exactly even."""
    order = np.array([int(next_view(jnp.int32(i), jnp.ones(64, bool), seed=3)) for i in range(64)])
    gaps = [np.diff(np.sort(order[i : i + 16]), prepend=-1, append=64).max() for i in range(49)]
    assert max(gaps) <= 9


def test_the_callers_arrays_survive():
    given = doubtful()
    refine(given, cameras(), photographs(), steps=2, config=CONFIG)
    assert np.isfinite(np.asarray(given.means)).all()


def test_refinement_stops_where_held_back_pixels_do_not_gain():
    falling = [1.0, 1.0, 0.5, 0.5]
    flat = [0.5, 0.6] * 3
    assert not has_stopped_helping(falling, 2)
    assert not has_stopped_helping([*falling, *flat[:-1]], 2)  # not a whole round
    assert not has_stopped_helping([*falling, *flat[2:]], 2)  # a small sample varies from round to round
    assert has_stopped_helping([*falling, *flat], 2)
    assert not has_stopped_helping([*falling, *flat[2:], 0.4, 0.5], 2)  # it helps again
    assert not has_stopped_helping([0.0] * 40, 2)  # nothing is held back


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": jnp.zeros((NUM_VIEWS, HEIGHT, WIDTH + 1, 3))}, r"images must be \[4, 16, 24, 3\]"),
        ({"steps": -1}, "steps must be at least 0, got -1"),
        ({"exposures": jnp.ones((2, 3))}, r"exposures must be \[4, 3\]"),
        ({"cameras": Camera(jnp.eye(4), jnp.eye(3), WIDTH, HEIGHT)}, "cameras must have one batch axis"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(changes, message):
    given = {"cameras": cameras(), "images": photographs(), "steps": 1} | changes
    with pytest.raises(InputError, match=message):
        refine(doubtful(), given.pop("cameras"), given.pop("images"), **given)


@pytest.mark.parametrize("changes", [{"adam_b1": 1.0}, {"held_back": 0.9}, {"mean_rate": -1.0}, {"final_rate": 0.0}])
def test_config_out_of_range_is_refused_by_name(changes):
    with pytest.raises(InputError, match=rf"refine: {next(iter(changes))} must be"):
        RefineConfig(**changes)


def test_the_capacity_grows_for_a_view_that_was_not_looked_at(monkeypatch):
    """The estimate looks at a few views; one of the others may need more."""
    monkeypatch.setattr(module, "pairs_capacity", lambda *arguments: 64)
    progress, views = module.start_refinement(doubtful(), key_views())
    num_steps = 0
    for _ in module.continue_refinement(progress, views, 6):
        num_steps += 1
    needed = [int(render(doubtful(), views.camera(i), effects=EFFECTS).num_pairs) for i in range(NUM_VIEWS)]
    assert num_steps == 6 and max(needed) > 64
    assert progress.max_pairs >= max(needed)


def test_bytes_are_taken_as_they_are():
    images = jnp.round(jnp.clip(photographs(), 0, 1) * 255).astype(jnp.uint8)
    wanted, _ = refine(doubtful(), cameras(), images.astype(jnp.float32) / 255, steps=2, config=CONFIG)
    got, _ = refine(doubtful(), cameras(), images, steps=2, config=CONFIG)
    jax.tree.map(np.testing.assert_array_equal, got, wanted)


@pytest.mark.parametrize("change", [lambda x: 255 * x, lambda x: x - 0.5, lambda x: x * np.nan])
def test_images_out_of_range_are_refused(change):
    with pytest.raises(InputError, match=r"floats in \[0, 1\] or uint8, got"):
        refine(doubtful(), cameras(), change(jnp.clip(photographs(), 0, 1)), steps=1, config=CONFIG)


def test_arrays_of_numpy_do_as_well_as_those_of_jax():
    config = CONFIG
    images, ones = jnp.clip(photographs(), 0, 1), jnp.ones((NUM_VIEWS, 3))
    wanted, _ = refine(doubtful(), cameras(), images, steps=2, exposures=ones, config=config)
    arrays = jax.tree.map(np.asarray, (cameras(), images, ones))
    got, _ = refine(doubtful(), arrays[0], arrays[1], steps=2, exposures=arrays[2], config=config)
    jax.tree.map(np.testing.assert_array_equal, got, wanted)


def test_an_opacity_at_its_bound_can_come_back():
    """At the largest logit the opacity still has a gradient by the change that led there, and moves by a step back."""
    opaque = replace(scene(), opacities=jnp.where(scene().opacities > 0, 1 - 1e-5, 0.0))
    change = replace(no_revision(opaque), logit_opacities=jnp.full(NUM, 7.0))
    slope = jax.grad(lambda c: apply_revision(opaque, c).opacities.sum())(change).logit_opacities
    is_present = np.asarray(opaque.opacities) > 0
    assert (np.asarray(slope)[is_present] > 1e-7).all() and not np.asarray(slope)[~is_present].any()


def test_the_seconds_of_the_steps_are_those_of_their_work():
    progress, views = module.start_refinement(doubtful(), key_views(), CONFIG)
    steps = module.continue_refinement(progress, views, 40, CONFIG)
    next(steps)  # compiles
    begin = time.perf_counter()
    for _ in steps:
        pass
    jax.block_until_ready(progress.state)
    elapsed = time.perf_counter() - begin
    assert 0.5 * elapsed < sum(progress.seconds[1:]) <= elapsed


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
def test_a_scene_of_half_precision_is_refined_in_float32(dtype, monkeypatch):
    """In float16 the squares of small gradients vanish, and a step divides by them."""
    monkeypatch.setattr(present_rows, "MIN_ROWS", 1)  # absent rows are left out of the steps
    half = jax.tree.map(lambda x: x.astype(dtype), doubtful())
    assert present_rows.present_rows(half) is not None
    refined, report = refine(half, cameras(), photographs(), steps=8, config=CONFIG)
    single = jax.tree.map(lambda x: x.astype(jnp.float32), half)
    wanted, _ = refine(single, cameras(), photographs(), steps=8, config=CONFIG)
    assert np.mean(report.losses[4:]) < np.mean(report.losses[:4])
    for name in FIELDS:
        found = getattr(refined, name)
        assert found.dtype == jnp.float32
        np.testing.assert_allclose(found, getattr(wanted, name), rtol=1e-5, atol=1e-5)
