"""Laws of gradient refinement, on a small scene whose truth is known."""

import dataclasses
import functools
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage.metrics import structural_similarity

from ssplat_jax.cache.changes import apply_change, changed_gaussians, no_change
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians, mask_gaussians, mean_color, with_sh_degree
from ssplat_jax.core.pytree import replace
from ssplat_jax.evaluation.metrics import psnr
from ssplat_jax.rasterizer import Effects, fill_holes, render
from ssplat_jax.rasterizer.constants import ALPHA_MIN
from ssplat_jax.rasterizer.reference import render_reference
from ssplat_jax.refinement import KeyViews, RefineConfig, init_refinement, refine
from ssplat_jax.refinement.compared_views import dissimilarity, held_back_pixels, next_view, view_loss, views_of_step
from ssplat_jax.refinement.refine_step import MAX_LOG_SCALE_CHANGE, MAX_SHIFT, RATES, RefineState, sizes
from tests.model.small import side_by_side
from tests.streaming.narrow_model import assert_same_bits

module = importlib.import_module("ssplat_jax.refinement.refine")  # the package has a function of that name
NUM, WIDTH, HEIGHT, NUM_VIEWS, MAX_PAIRS = 48, 24, 16, 4, 1 << 12
CONFIG = RefineConfig(sh_degree=1, held_back=0.4, shown_weight=0.0, seed=1)  # the scene stands before black


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


def cameras(shifts=(0.0, 0.15, -0.15, 0.3), focal=20.0, width=WIDTH, height=HEIGHT) -> Camera:
    """Cameras side by side that look along +z."""
    K = jnp.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    viewmats = jnp.asarray(side_by_side(-np.asarray(shifts)), jnp.float32)
    return Camera(viewmats=viewmats, Ks=jnp.tile(K, (len(shifts), 1, 1)), width=width, height=height)


@functools.cache
def photographs():
    """Images of the true scene from `cameras`."""
    return render(scene(), cameras(), max_pairs=MAX_PAIRS).color


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


def step(state, views, rate=1.0, config=CONFIG, max_rows=NUM, tile=8):
    """A step by the program that `refine` runs; it consumes the state."""
    return module._compiled(config, MAX_PAIRS, max_rows, tile)(state, views, jnp.float32(rate))


def first_state() -> RefineState:
    return init_refinement(doubtful(), CONFIG)


def current(state) -> Gaussians:
    return changed_gaussians(state.start, state.change)


# Steps --------------------------------------------------------------------------------------------------------------


def test_the_gradient_is_that_of_the_reference_renderer():
    """Central differences in float64 of the loss of one view, rendered by the oracle."""
    config = RefineConfig(held_back=0.3, seed=1)
    start, views, slot = doubtful(), key_views(exposures=jnp.full((NUM_VIEWS, 3), 0.9)), jnp.int32(1)
    background = mean_color(start)
    held_back = np.asarray(held_back_pixels((HEIGHT, WIDTH), slot, config))
    target = np.asarray(views.images[1], np.float64) / 255

    def loss(change):
        return view_loss(apply_change(start, change), background, views.at(slot), slot, config, MAX_PAIRS)[0]

    @jax.jit
    def drawn(start, change, camera, background):
        out = render_reference(apply_change(start, change), camera, effects=Effects(outputs=("color", "alpha")))
        return fill_holes(out.color, out.alpha, background), out.color

    def oracle(change) -> float:
        with jax.enable_x64(True):
            single = (start, change, cameras()[1], background)
            given = jax.tree.map(lambda x: jnp.asarray(np.asarray(x, np.float64)), single)
            filled, color = map(np.asarray, drawn(*given))
        errors = 0.7 * np.abs(0.9 * filled - target) + 0.3 * np.abs(0.9 * color - target)
        image = 0.9 * (0.7 * filled + 0.3 * color)
        image, photo = (np.where(held_back[..., None], 0.5, x) for x in (image, target))
        window = {"win_size": 11, "gaussian_weights": True, "use_sample_covariance": False}
        _, alike = structural_similarity(image, photo, **window, data_range=1.0, channel_axis=-1, full=True)
        return float((0.8 * errors + 0.2 * (1 - alike)).mean(axis=-1)[~held_back].mean())

    zero = no_change(start)
    value, gradient = jax.jit(jax.value_and_grad(loss))(zero)
    row = int(np.argmax(np.asarray(start.opacities)))
    assert float(value) == pytest.approx(oracle(zero), rel=1e-3)
    for name, entry in (
        ("means", (row, 0)),
        ("log_scales", (row, 1)),
        ("logit_opacities", (row,)),
        ("sh", (row, 0, 2)),
    ):
        ends = (getattr(zero, name).at[entry].set(width) for width in (1e-4, -1e-4))
        ahead, behind = (oracle(replace(zero, **{name: end})) for end in ends)
        wanted = (ahead - behind) / 2e-4
        assert float(getattr(gradient, name)[entry]) == pytest.approx(wanted, rel=0.05, abs=2e-4), name


def test_the_first_step_of_adam_is_the_rate_against_the_gradient():
    """In units of the Gaussian's own size for places; higher bands move by a fifth."""
    state, _ = step(first_state(), key_views())
    start, moved, moment = state.start, vars(state.change), vars(state.adam.mu)
    for name, unit in (("means", np.asarray(sizes(start))[:, None]), ("log_scales", 1.0), ("logit_opacities", 1.0)):
        wanted = -RATES[name] * unit * np.sign(moment[name])
        np.testing.assert_allclose(moved[name], wanted, rtol=1e-3, atol=1e-7, err_msg=name)
        assert np.any(wanted)
    assert np.abs(moved["sh"][:, 1:]).max() == pytest.approx(0.2 * np.abs(moved["sh"][:, 0]).max(), rel=1e-3)


def test_a_step_averages_the_gradients_of_its_views():
    """A step on two views has the mean of the gradients that steps on one view each have."""
    state, report = step(first_state(), replace(key_views(), valid=jnp.array([True, False, True, False])))
    assert sorted(np.asarray(report.views)) == [0, 2]
    singles, losses = [], []
    for view in (0, 2):
        one, measured = step(first_state(), replace(key_views(), valid=jnp.arange(NUM_VIEWS) == view))
        singles.append(one.adam.mu)
        losses.append(float(measured.loss))
    for name, moment in vars(state.adam.mu).items():
        wanted = np.mean([np.asarray(getattr(single, name), np.float64) for single in singles], axis=0)
        np.testing.assert_allclose(moment, wanted, rtol=1e-4, atol=1e-6 * np.abs(wanted).max())
    assert float(report.loss) == pytest.approx(np.mean(losses), rel=1e-5)


def test_a_step_that_is_not_finite_changes_only_its_count():
    state, _ = step(first_state(), key_views(exposures=jnp.full((NUM_VIEWS, 3), jnp.nan)))
    assert_same_bits(current(state), with_sh_degree(doubtful(), 1))
    assert int(state.num_skipped) == 1 and int(state.num_steps) == 1
    assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves((state.change, state.adam)))


def test_no_gaussian_leaves_its_trust_region():
    state, views, start = first_state(), key_views(1.0 - photographs()), doubtful()
    for _ in range(6):
        state, _ = step(state, views, rate=100.0)
    refined = apply_change(state.start, state.change)
    moved = np.linalg.norm(np.asarray(refined.means - start.means), axis=1)
    assert (moved <= MAX_SHIFT * np.asarray(sizes(start)) * (1 + 1e-5)).all() and moved.max() > 0
    grown = np.abs(np.log(np.asarray(refined.scales / start.scales)))
    assert 0.99 * MAX_LOG_SCALE_CHANGE < grown.max() <= MAX_LOG_SCALE_CHANGE + 1e-5


def test_held_back_pixels_change_no_bit_of_the_scene():
    view = next_view(jnp.int32(0), key_views().valid, CONFIG.seed)
    held_back = np.asarray(held_back_pixels((HEIGHT, WIDTH), view, CONFIG))
    assert 0 < held_back.mean() < 1
    other = np.array(photographs())
    other[int(view)][held_back] = 1.0 - other[int(view)][held_back]
    first, first_report = step(first_state(), key_views())
    second, second_report = step(first_state(), key_views(jnp.asarray(other)))
    assert_same_bits(current(first), current(second))
    assert float(first_report.loss) == float(second_report.loss)
    assert float(first_report.held_back) != float(second_report.held_back)


def test_an_opacity_at_its_bound_can_come_back():
    """At the largest logit the opacity still has a gradient by the change that led there, and moves by a step back."""
    opaque = replace(scene(), opacities=jnp.where(scene().opacities > 0, 1 - 1e-5, 0.0))
    change = replace(no_change(opaque), logit_opacities=jnp.full(NUM, 7.0))
    gradient = jax.grad(lambda c: apply_change(opaque, c).opacities.sum())(change).logit_opacities
    is_present = np.asarray(opaque.opacities) > 0
    assert (np.asarray(gradient)[is_present] > 1e-7).all() and not np.asarray(gradient)[~is_present].any()


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
def test_half_precision_is_refined_in_single_precision(dtype):
    half = jax.tree.map(lambda x: x.astype(dtype), doubtful())
    state = init_refinement(half)
    assert {leaf.dtype for leaf in jax.tree.leaves((state.start, state.change))} == {jnp.dtype(jnp.float32)}
    np.testing.assert_array_equal(state.start.means, np.asarray(half.means, np.float32))


# The loop -----------------------------------------------------------------------------------------------------------


def test_zero_steps_return_the_scene_bit_for_bit():
    refined, report = refine(doubtful(), cameras(), photographs(), steps=0)
    assert_same_bits(refined, doubtful())
    assert report.num_steps == 0 and report.losses == []


def test_refinement_stops_where_held_back_pixels_do_not_gain():
    falling, flat = [1.0, 1.0, 0.5, 0.5], [0.5, 0.6] * 3
    started = module.Progress(init_refinement(scene()), key_views(), RefineConfig(), MAX_PAIRS)
    stops = lambda errors: dataclasses.replace(started, losses=errors, held_back=errors).has_stopped_helping()  # noqa: E731
    assert not stops(falling)
    assert not stops([*falling, *flat[:-1]])  # not a whole round
    assert not stops([*falling, *flat[2:]])  # a small sample varies from round to round
    assert stops([*falling, *flat])
    assert not stops([*falling, *flat[2:], 0.4, 0.5])  # it helps again
    assert not stops([0.0] * 40)  # nothing is held back


def test_capacities_that_are_too_small_grow(monkeypatch):
    """The estimate looks at a few views and at the first scene; one of the others may need more."""
    steps = importlib.import_module("ssplat_jax.refinement.refine_step")
    monkeypatch.setattr(steps, "MIN_ROWS", 1)
    progress = module.Progress(first_state(), key_views(), CONFIG, max_pairs=1, max_rows=3)
    first = views_of_step(jnp.int32(0), key_views().valid, CONFIG)
    num_seen = int(jnp.sum(steps.seen_rows(doubtful(), key_views(), first)))
    back = key_views().viewmats.at[first[1]].multiply(jnp.array([-1.0, 1, -1, 1])[:, None])  # the second looks away
    assert num_seen == jnp.sum(steps.seen_rows(doubtful(), replace(key_views(), viewmats=back), first))
    next(progress.steps(3))
    assert progress.max_rows >= num_seen > 3 and progress.max_pairs > 1


def test_gaussians_that_fade_are_removed_and_no_image_changes():
    """Those that were as faint before stay as given."""
    ghosts = replace(scene(), opacities=jnp.full(NUM, 1.05 * ALPHA_MIN))
    faint = replace(scene(), opacities=jnp.full(NUM, 0.5 * ALPHA_MIN))
    given = jax.tree.map(lambda *parts: jnp.concatenate(parts), scene(), ghosts, faint)
    progress = module.Progress(init_refinement(given), key_views(), CONFIG, max_pairs=MAX_PAIRS)
    logits = jnp.where(jnp.arange(3 * NUM) % 2 == 0, -1.0, 0.0)
    progress.state = replace(progress.state, change=replace(progress.state.change, logit_opacities=logits))
    whole, left = current(progress.state), progress.scene(given)
    removed = np.asarray((left.opacities == 0) & (given.opacities > 0))
    assert removed[NUM : 2 * NUM].sum() == NUM / 2 and not removed[:NUM].any() and not removed[2 * NUM :].any()
    images = [np.asarray(render(g, cameras(), max_pairs=MAX_PAIRS).color) for g in (left, whole)]
    np.testing.assert_array_equal(*images)


def test_refinement_learns_a_scene_that_turns_its_colors_and_ends_on_one_that_fits(monkeypatch):
    """A view never shown gains, where a constant color cannot follow; absent rows stay."""
    monkeypatch.setattr(module, "tiles_for", lambda *given: (8, MAX_PAIRS))  # the program of `step`
    bands = np.random.default_rng(2).normal(0, 0.4, (NUM, 3, 3))
    turning = replace(scene(), sh=jnp.concatenate([scene().sh, jnp.asarray(bands, jnp.float32)], axis=1))
    seen, unseen = cameras(shifts=(-1.0, -0.3, 0.3, 1.0)), cameras(shifts=(0.6,))
    images, truth = (np.clip(render(turning, c, max_pairs=MAX_PAIRS).color, 0, 1) for c in (seen, unseen))
    given = doubtful()
    refined, report = refine(given, seen, images, steps=60, config=CONFIG)
    assert refined.sh_degree == 1 and report.num_skipped == 0
    assert np.mean(report.losses[-4:]) < 0.6 * np.mean(report.losses[:4])
    constant = replace(refined, sh=refined.sh.at[:, 1:].set(0.0))
    drawn = (render(g, unseen, max_pairs=MAX_PAIRS).color for g in (refined, constant, with_sh_degree(given, 1)))
    scores = [psnr(np.clip(np.asarray(color)[0], 0, 1), truth[0]) for color in drawn]
    assert scores[0] > scores[1] + 1.0 and scores[0] > scores[2] + 3.0
    absent = np.asarray(given.opacities) == 0  # the caller's arrays survive too
    assert_same_bits(*(jax.tree.map(lambda x: x[absent], g) for g in (refined, with_sh_degree(given, 1))))
    _, report = refine(turning, seen, images, steps=40, config=CONFIG)
    assert report.stopped_early and report.num_steps == len(report.losses) < 40


@pytest.mark.parametrize("steps", [1, 4, 8])
def test_few_steps_spoil_no_good_scene(steps):
    """The first steps of Adam are as large for a small gradient as for a large one, and few views tell of them."""
    unseen, noise = cameras(shifts=(0.22,)), np.random.default_rng(3).normal(size=(NUM, 1, 3))
    good = replace(scene(), sh=scene().sh + 0.1 * jnp.asarray(noise, jnp.float32))
    refined, _ = refine(good, cameras(), photographs(), steps=steps, config=CONFIG)
    drawn = (np.asarray(render(g, unseen, max_pairs=MAX_PAIRS).color)[0] for g in (scene(), good, refined))
    truth, before, after = drawn
    assert psnr(after, truth) > psnr(before, truth)


def test_arguments_that_do_not_fit_are_refused():
    for changes in (
        {"images": jnp.zeros((NUM_VIEWS, HEIGHT, WIDTH + 1, 3))},
        {"images": jnp.full((NUM_VIEWS, HEIGHT, WIDTH, 3), 1.5)},
        {"steps": -1},
        {"exposures": jnp.ones((2, 3))},
        {"cameras": Camera(jnp.eye(4), jnp.eye(3), WIDTH, HEIGHT)},
    ):
        given = {"cameras": cameras(), "images": photographs(), "steps": 1} | changes
        with pytest.raises(InputError):
            refine(doubtful(), given.pop("cameras"), given.pop("images"), **given)


def test_ssim_of_equal_and_of_flat_images_has_finite_gradients():
    """Equal images have no gradient: a scene that fits stays as it is."""
    measured = jax.jit(jax.value_and_grad(lambda image, photo: jnp.mean(dissimilarity(image, photo))))
    value, gradient = measured(photographs()[0], photographs()[0])
    assert abs(float(value)) < 1e-6 and float(jnp.abs(gradient).max()) < 1e-5
    for level in (0.0, 0.5, 1.0):
        flat = jnp.full((HEIGHT, WIDTH, 3), level)
        value, gradient = measured(0.9 * flat + 0.05, flat)
        assert 0 <= float(value) <= 2 and np.isfinite(gradient).all()
