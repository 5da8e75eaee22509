"""Losses of training: their values by hand, what does not count in them, and gradients against finite differences."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from ssplat_jax.cache.state import init_cache
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.pytree import replace
from ssplat_jax.evaluation.metrics import LpipsWeights
from ssplat_jax.model.hpda import AnchorInputs, AnchorMaps, num_inputs
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.rasterizer import render
from ssplat_jax.rasterizer.reference import render_reference
from ssplat_jax.training import loop, losses
from ssplat_jax.training.anchors import AnchorSample
from ssplat_jax.training.crops import CropSample, crop_camera
from ssplat_jax.training.recipe import RECIPES
from ssplat_jax.training.samples import Sample
from tests.cache import streams
from tests.cache.projection_scenes import front_camera
from tests.cache.test_votes import after_chunk, seen
from tests.model.small import random_params
from tests.rasterizer.scenes import cloud
from tests.streaming.narrow_model import NARROW
from tests.training.problems import NARROW_DEPTH, STREAM_PHASE

WIDTH = losses.DepthLoss.target_width


def sample_of(log_depths, images, camera, is_photographed=False) -> Sample:
    """A sample whose context shows nothing."""
    shape = log_depths.shape[:2]
    views = (jnp.zeros((*shape, *rest)) for rest in ((8, 8, 3), (4, 4), (3, 3)))
    chunks = Chunk(*views, jnp.zeros(shape, bool), *jnp.zeros((2, shape[0])))
    return Sample(chunks, log_depths, images, camera, jnp.asarray(is_photographed))


def test_unusable_cells_have_neither_value_nor_gradient_in_the_depth_loss():
    rng = np.random.default_rng(0)
    candidates, truth = jnp.linspace(0.0, 1.0, 5), jnp.asarray(rng.uniform(0.1, 0.9, (1, 2, 3)), jnp.float32)
    logits = jnp.asarray(rng.normal(size=(1, 2, 3, 5)), jnp.float32)
    predicted, usable = truth + 0.2, jnp.array([[[True, False, True], [False, True, True]]])

    @jax.jit
    def loss(logits, predicted, truth, usable):
        return sum(losses.depth_loss(logits, predicted, truth, candidates, usable, target_width=WIDTH))

    value, gradients = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))(logits, predicted, truth, usable)
    # As if those cells did not exist: the mean is over the others.
    kept = np.asarray(usable)
    alone = loss(*(x[kept][None, None] for x in (logits, predicted, truth, usable)))
    np.testing.assert_allclose(value, alone, rtol=1e-6)
    for gradient in gradients:
        assert not np.asarray(gradient)[~kept].any() and np.asarray(gradient)[kept].all()


@pytest.mark.parametrize("candidates", [np.linspace(0.0, 1.0, 5), np.zeros(1)], ids=["five", "one"])
def test_cells_of_unknown_depth_leave_the_loss_finite(candidates):
    logits, usable = jnp.zeros((1, 1, 2, len(candidates))), jnp.ones((1, 1, 2), bool)

    def loss(logits, predicted, unknown):
        truth, values = jnp.array([[[0.5, 0.0]]]).at[0, 0, 1].set(unknown), jnp.asarray(candidates, jnp.float32)
        return sum(losses.depth_loss(logits, predicted, truth, values, usable, target_width=WIDTH))

    sloped = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))
    for unknown in (-np.inf, np.inf, np.nan, 3.0):
        value, gradients = sloped(logits, jnp.full((1, 1, 2), 0.2), jnp.float32(unknown))
        assert np.isfinite(value) and all(np.isfinite(g).all() for g in gradients)
        assert not any(np.asarray(g)[0, 0, 1].any() for g in gradients)


def test_gradients_of_losses_are_finite_differences():
    """In float64, along a random direction of every argument."""
    rng = np.random.default_rng(1)
    with jax.enable_x64(True):
        truth = jnp.asarray(rng.uniform(0.1, 0.9, (1, 2, 3)))
        candidates, usable = jnp.linspace(0.0, 1.0, 5), jnp.ones((1, 2, 3), bool)
        images, targets = (jnp.asarray(rng.uniform(0.1, 0.9, (2, 4, 5, 3))) for _ in range(2))
        depth = lambda logits, z: sum(losses.depth_loss(logits, z, truth, candidates, usable, target_width=WIDTH))  # noqa: E731
        cases = [
            (depth, (jnp.asarray(rng.normal(size=(1, 2, 3, 5))), truth + 0.05)),
            (lambda x: losses.RenderingLoss().of_images(x, targets)[0], (images,)),
            (lambda x: losses.negative_psnr(x[0], targets[0]), (images,)),
        ]
        for loss, arguments in cases:
            loss = jax.jit(loss)
            directions = tuple(jnp.asarray(rng.normal(size=x.shape)) for x in arguments)
            found = jax.jit(lambda *x: jax.jvp(loss, arguments, x)[1])(*directions)  # noqa: B023
            at = lambda h: loss(*(x + h * d for x, d in zip(arguments, directions, strict=True)))  # noqa: E731, B023
            assert float(found) == pytest.approx(float(at(1e-6) - at(-1e-6)) / 2e-6, rel=1e-5)


def test_the_paper_loss_of_a_scene_sums_mse_and_lpips_of_its_targets_over_black(monkeypatch):
    """Eq. training_loss on views of the reference renderer, of photographs that are darker than the scene."""
    monkeypatch.setattr(losses, "lpips_distance", lambda weights, a, b: 3.0 * jnp.abs(a - b).max(axis=(1, 2, 3)))
    (phase,), rng = RECIPES["paper"].phases, np.random.default_rng(3)
    gaussians = cloud(9, degree=0, size=0.3)
    viewmats = jnp.tile(jnp.eye(4), (4, 1, 1)).at[:, 0, 3].set(jnp.linspace(-0.3, 0.3, 4))
    cameras = Camera(viewmats, jnp.tile(jnp.array([[10.0, 0, 8], [0, 10, 6], [0, 0, 1]]), (4, 1, 1)), 16, 12)
    colors = np.asarray(jax.jit(render_reference)(gaussians, cameras).color, np.float64)
    targets = 0.5 * colors + 0.1 * rng.uniform(size=colors.shape)
    sample = sample_of(jnp.zeros((1, 4, 2, 2)), jnp.asarray(targets, jnp.float32), cameras, is_photographed=True)
    loss = dataclasses.replace(phase.loss, max_pairs=1 << 12)
    value = loss.weight * jax.jit(loss.of_scene)(gaussians, sample, LpipsWeights((), (), ()))[0]
    errors = [((c - t) ** 2).mean() + 0.05 * 3.0 * np.abs(c - t).max() for c, t in zip(colors, targets, strict=True)]
    assert float(value) == pytest.approx(sum(errors), rel=2e-3)  # tiles cut faint rims
    assert (loss.depth_weight, loss.tokens, phase.samples.batch, phase.samples.num_targets) == (0, "all", 1, 4)


def test_the_loss_of_a_crop_is_its_psnr_less_what_lpips_costs_filled_and_over_black(monkeypatch):
    """An empty scene is black; here its holes are filled with a quarter of white."""
    monkeypatch.setattr(losses, "lpips_distance", lambda weights, a, b: 3.0 * jnp.abs(a - b).max())
    monkeypatch.setattr(losses, "fill_holes", lambda color, alpha, mean: color + 0.25)
    model, params = StreamSplat(NARROW), random_params(NARROW)
    image = np.random.default_rng(5).integers(0, 256, (16, 24, 3), np.uint8)
    camera = Camera(jnp.eye(4), jnp.array([[20.0, 0, 12], [0, 20, 8], [0, 0, 1]]), 24, 16)
    crop = CropSample(model.init_cache(), camera, jnp.asarray(image), jnp.ones(3), jnp.full(8, -1), 8, 1 << 10)
    target = image.astype(np.float64) / 255
    psnrs = [-10 * np.log10(((x - target) ** 2).mean() + losses.MIN_MSE) for x in (0.25, 0.0)]
    costs = [20.0 * 3.0 * np.abs(x - target).max() for x in (0.25, 0.0)]
    loss = jax.jit(functools.partial(losses.CropLoss(black_weight=0.4, lpips_weight=20.0), model))
    value, metrics = loss(params, (crop,), LpipsWeights((), (), ()))
    wanted = sum(share * (cost - x) for share, cost, x in zip((0.6, 0.4), costs, psnrs, strict=True))
    assert float(value) == pytest.approx(wanted, rel=1e-5)
    assert float(metrics["psnr_over_black"]) == pytest.approx(psnrs[1], rel=1e-5)


def test_masked_pixels_of_a_target_have_neither_value_nor_gradient():
    rng = np.random.default_rng(4)
    gaussians = cloud(9, degree=0, size=0.3)
    cameras = Camera(jnp.eye(4)[None], jnp.array([[[10.0, 0, 8], [0, 10, 6], [0, 0, 1]]]), 16, 12)
    targets = jnp.asarray(rng.uniform(size=(1, 12, 16, 3)), jnp.float32)
    seen = jnp.ones((1, 12, 16), bool).at[:, :, :8].set(False)
    loss = losses.RenderingLoss(max_pairs=1 << 12)

    @jax.jit
    @jax.value_and_grad
    def of(gaussians, targets, seen):
        sample = sample_of(jnp.zeros((1, 4, 2, 2)), targets, cameras, is_photographed=True)
        return loss.of_scene(gaussians, replace(sample, target_seen=seen))[0]

    value, gradient = of(gaussians, targets, seen)
    other = of(gaussians, jnp.where(seen[..., None], targets, 1 - targets), seen)
    assert value == other[0] > 0 and jax.tree.all(jax.tree.map(np.array_equal, gradient, other[1]))
    assert of(gaussians, targets, seen & False)[0] == 0.0


def test_the_anchor_learns_where_the_cache_is_right():
    """From a feature that says so; the matcher is wrong in half of the cells, the cache in the other half."""
    rng, num = np.random.default_rng(5), 16
    truth = rng.uniform(2, num - 3, (2, 1, 8, 8))
    is_cache_right = rng.uniform(size=truth.shape) < 0.5
    wrong = rng.uniform(2, num - 3, truth.shape)
    matched, cached = np.where(is_cache_right, wrong, truth), np.where(is_cache_right, truth, wrong)
    matched[:, :, 0], truth[:, :, 0] = 2, num - 3  # the matcher errs most in the holes of the cache, below
    probs = np.exp(-0.5 * (np.arange(num) - matched[..., None]) ** 2)
    features = np.where(is_cache_right, 1.0, -1.0)[..., None] * np.ones(num_inputs(NARROW))
    floats = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    mask = jnp.ones(truth.shape, bool).at[:, :, 0].set(False)
    batch = AnchorSample(
        inputs=AnchorInputs(floats(features), floats(probs / probs.sum(-1, keepdims=True)), floats(cached), mask),
        log_candidates=floats(np.tile(0.1 * np.arange(num), (2, 1))),
        log_depths=floats(0.1 * truth).at[:, :, :, 0].set(jnp.nan),
        usable=jnp.ones(truth.shape, bool),
    )
    params = {"hpda": AnchorMaps().init(jax.random.key(0), batch.inputs.features[0])["params"]}
    model, optimizer = StreamSplat(NARROW), optax.adam(0.01)

    @jax.jit
    def step(params, state):
        (_, metrics), gradients = jax.value_and_grad(losses.AnchorLoss(), argnums=1, has_aux=True)(model, params, batch)
        updates, state = optimizer.update(gradients, state)
        return optax.apply_updates(params, updates), state, metrics

    state = optimizer.init(params)
    for _ in range(150):
        params, state, metrics = step(params, state)
    assert float(metrics["l1"]) < 0.25 * float(metrics["l1_of_matcher"])
    # Holes of the cache and unknown depths do not count.
    wanted = np.abs(0.1 * (matched - truth))[np.s_[:, :, 1:, 1:]].mean()
    assert float(metrics["l1_of_matcher"]) == pytest.approx(wanted, rel=0.1)


def test_fitted_gains_undo_exposures_and_stay_bounded():
    images = jnp.asarray(np.random.default_rng(0).uniform(0.1, 0.9, (3, 6, 5, 3)), jnp.float32)
    true = np.array([[0.7, 1.0, 1.4], [5.0, 0.01, 1.2]], np.float32)
    targets = jnp.concatenate([images[:2] * true[:, None, None], images[2:]])
    images = images.at[2].set(0.0)
    gains = np.asarray(losses.fitted_gains(images, targets))[:, 0, 0]
    np.testing.assert_allclose(gains[0], true[0], rtol=1e-5)
    np.testing.assert_allclose(gains[1], [losses.MAX_GAIN, 1 / losses.MAX_GAIN, 1.2], rtol=1e-5)
    np.testing.assert_array_equal(gains[2], 1.0)  # nothing rendered
    gradient = jax.grad(lambda x: losses.fitted_gains(x, targets).sum())(images)
    np.testing.assert_array_equal(np.asarray(gradient), 0.0)


def test_tokens_that_a_stored_view_looked_through_are_not_rendered():
    """A floater before the wall that a view saw, the wall, a hidden token, and one of low confidence."""
    config = streams.CONFIG.replace(detail=False)
    cache = after_chunk(init_cache(config, streams.CAPACITY), front_camera(), seen(2.0))
    tokens = streams.tokens_at([[0, 0, 1.0], [0, 0, 2.0], [0, 0, 3.0], [0, 0, 2.0]], jnp.array([0.6, 0.6, 0.6, 0.2]))
    accepted = jax.jit(functools.partial(losses.decode_accepted, StreamSplat(config)))
    shown = np.asarray(accepted(random_params(config), cache, tokens).opacities > 0).reshape(4, -1)
    np.testing.assert_array_equal(shown, np.broadcast_to([[False], [True], [True], [False]], shown.shape))


@pytest.mark.parametrize("loss", [NARROW_DEPTH, STREAM_PHASE.loss], ids=["depth", "rendering"])
def test_loss_and_gradient_of_a_batch_are_means_over_its_samples(monkeypatch, loss):
    draw = functools.partial(jax.random.uniform, jax.random.key(1))
    camera = Camera(jnp.zeros((1, 4, 4)), jnp.zeros((1, 3, 3)), 8, 8)
    sample = sample_of(draw((1, 2, 2, 2)), draw((1, 8, 8, 3)), camera)
    batch = jax.tree.map(lambda x: jnp.stack([x, 2 * x, 5 * x]), sample)

    def of_stream(self, model, params, sample):
        value = jnp.sum(params["a"] * jnp.nanmean(sample.log_depths)) ** 2
        return None, None, value, {"depth_l1": value}

    of_scene = lambda self, scene, sample, lpips: (jnp.mean(sample.target_images) * scene, {})  # noqa: E731
    monkeypatch.setattr(losses.DepthLoss, "of_stream", of_stream)
    monkeypatch.setattr(losses.RenderingLoss, "of_scene", of_scene)
    monkeypatch.setattr(losses, "decode_accepted", lambda model, params, cache, tokens: params["a"][0])
    of = jax.value_and_grad(lambda params, x: loss(StreamSplat(NARROW), params, x), has_aux=True)
    params = {"a": jnp.array([1.5, -0.5])}
    (value, metrics), gradient = of(params, batch)
    singles = [of(params, jax.tree.map(lambda x: x[i : i + 1], batch)) for i in range(3)]  # noqa: B023
    np.testing.assert_allclose(value, np.mean([single[0][0] for single in singles]), rtol=1e-6)
    np.testing.assert_allclose(gradient["a"], np.mean([single[1]["a"] for single in singles], axis=0), rtol=1e-6)
    mean = np.mean([single[0][1]["depth_l1"] for single in singles])
    assert float(metrics["depth_l1"]) == pytest.approx(mean, rel=1e-6)


def test_a_crop_is_a_part_of_the_image():
    gaussians = cloud(40, degree=0, size=0.1)
    K = jnp.array([[60.0, 0.0, 40.0], [0.0, 60.0, 30.0], [0.0, 0.0, 1.0]])
    camera = Camera(viewmats=jnp.eye(4), Ks=K, width=80, height=60)
    whole = render(gaussians, camera, max_pairs=1 << 12).color
    part = render(gaussians, crop_camera(camera, 7, 13, 32, 48), max_pairs=1 << 12).color
    np.testing.assert_allclose(part, whole[7 : 7 + 32, 13 : 13 + 48], atol=1 / 255)  # tiles cut faint rims


def test_other_lpips_weights_are_another_run():
    first, second = (LpipsWeights((), (), (jnp.full(3, x),)) for x in (1.0, 2.0))
    described = [loop.describe_run(NARROW, RECIPES["tiny"], "random", None, w) for w in (first, second, None)]
    assert len({run["lpips_weights"] for run in described}) == 3
