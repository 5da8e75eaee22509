"""The evidence head starts at nothing, stays bounded, and is absent where it is not asked for."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.cache.state import NUM_OBSERVED, init_cache
from ssplat_jax.cache.votes import observation_features
from ssplat_jax.config import preset
from ssplat_jax.core.pytree import replace
from ssplat_jax.model import decoder
from ssplat_jax.model.network import init_params
from ssplat_jax.model.streamsplat import StreamSplat, shown_pivots
from ssplat_jax.model.views import TokenShapes
from tests.model.small import random_params

CONFIG = preset("tiny").replace(capacity=128, gaussians_per_token=4, detail=False)
NUM = 5


def shapes() -> TokenShapes:
    """Shapes of pivots, all different."""
    x, sh = jnp.linspace(-1.0, 1.0, NUM), jnp.zeros((NUM, 1, 3))
    return TokenShapes(logit_opacities=x, raw_scales=x[:, None] * jnp.ones(3), quats=jnp.ones((NUM, 4)), sh=sh)


def evidence(value: float = 1.0) -> decoder.Evidence:
    """Evidence whose fields all have one value."""
    each = jnp.full(NUM, value)
    return decoder.Evidence(jnp.full((NUM, NUM_OBSERVED), value), *[each] * 5, jnp.full((NUM, 12), value))


@functools.cache
def untrained() -> dict:
    return init_params(jax.random.key(0), CONFIG, only=("evidence",))["evidence"]


def head_with(bias: float) -> dict:
    """A head whose outputs are all `bias`."""
    return {**untrained(), "out": {**untrained()["out"], "bias": jnp.full(4, bias)}}


def different_colors() -> decoder.Evidence:
    """Evidence of pivots whose four Gaussians differ in color."""
    return replace(evidence(), rgbs=jnp.asarray(np.random.default_rng(4).uniform(size=(NUM, 12)), jnp.float32))


@jax.jit
def changed(params: dict, facts: decoder.Evidence):
    """Shapes and parts after the head with `params` has seen `facts`."""
    return decoder.apply_evidence(params, shapes(), decoder.divide_cells(facts.rgbs, CONFIG), facts, CONFIG)


def cache_of_pivots(num: int = 6):
    """A cache with random pivots in its first rows."""
    rng, cache = np.random.default_rng(0), init_cache(CONFIG)
    filled = lambda x: x.at[:num, 0].set(jnp.asarray(rng.uniform(0.6, 0.95, (num, *x.shape[2:])), x.dtype))  # noqa: E731
    names = ("means", "feats", "confidences", "rgbs", "quats", "footprints", "observations")
    return replace(
        cache,
        counts=cache.counts.at[:num].set(1),
        num_voxels=jnp.asarray(num, jnp.int32),
        num_members=cache.num_members.at[:num, 0].set(1),
        **{name: filled(getattr(cache, name)) for name in names},
    )


def test_an_untrained_head_changes_nothing():
    got, parts = changed(untrained(), different_colors())
    jax.tree.map(np.testing.assert_array_equal, got, shapes())
    np.testing.assert_array_equal(parts.colors.reshape(NUM, -1), different_colors().rgbs)


@pytest.mark.parametrize("bias", [0.2, 1e4, -1e4])
def test_changes_are_bounded_contrast_keeps_the_mean_color_and_nothing_else_moves(bias):
    before = np.asarray(different_colors().rgbs, np.float64).reshape(NUM, 4, 3)
    got, parts = changed(head_with(bias), different_colors())
    after = np.asarray(parts.colors, np.float64)
    gain = np.exp(decoder.MAX_LOG_CONTRAST * np.tanh(bias / decoder.MAX_LOG_CONTRAST))
    mean = before.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(after, mean + gain * (before - mean), atol=1e-6)
    moved = decoder.MAX_LOGIT_CHANGE * np.tanh(bias / decoder.MAX_LOGIT_CHANGE)
    np.testing.assert_allclose(got.logit_opacities - shapes().logit_opacities, moved, rtol=1e-5)
    assert np.any(got.raw_scales != shapes().raw_scales)
    np.testing.assert_array_equal(got.quats, shapes().quats)
    np.testing.assert_array_equal(got.sh, shapes().sh)


@jax.jit
@functools.partial(jax.value_and_grad, has_aux=True)
def value_and_gradient(params: dict, facts: decoder.Evidence):
    got, parts = changed(params, facts)
    loss = got.logit_opacities.sum() + got.raw_scales.sum() + parts.colors.sum()
    return loss, decoder.evidence_features(facts, CONFIG)


@pytest.mark.parametrize("value", [0.0, 1.0, 1e6])
def test_value_and_gradient_are_finite_at_the_limits(value):
    """Dead pivots hold zeros; confidences may be 1."""
    for leaf in jax.tree.leaves(value_and_gradient(head_with(0.2), evidence(value))):
        assert np.isfinite(leaf).all()


def test_the_gradient_by_colors_is_finite_where_all_are_equal():
    features = jax.jit(lambda rgbs: decoder.evidence_features(replace(different_colors(), rgbs=rgbs), CONFIG))
    rgbs = different_colors().rgbs.at[0].set(0.5)
    np.testing.assert_allclose(features(rgbs)[1:], features(different_colors().rgbs)[1:], rtol=1e-6)
    slopes = np.asarray(jax.jit(jax.grad(lambda x: features(x).sum()))(rgbs))
    assert np.isfinite(slopes).all()
    np.testing.assert_allclose(slopes[0], slopes[0][0])  # of the mean color alone
    assert np.ptp(slopes[1]) > 0.1


def test_the_scene_has_the_contrast_that_the_head_asks_for():
    """Decoded colors of a pivot lie farther from their mean by one factor for the whole pivot."""
    params, cache, decode = random_params(CONFIG), cache_of_pivots(), jax.jit(StreamSplat(CONFIG).decode)

    def colors(bias):
        scene = decode({**params, "evidence": head_with(bias)}, cache)
        return np.asarray(scene.sh[:, 0], np.float64).reshape(-1, 4, 3)

    before, after = colors(0.0), colors(0.5)
    mean = before.mean(axis=1, keepdims=True)
    alive = np.ptp(before, axis=(1, 2)) > 0.1
    assert alive.sum() == 6
    gain = np.exp(decoder.MAX_LOG_CONTRAST * np.tanh(0.5 / decoder.MAX_LOG_CONTRAST))
    np.testing.assert_allclose((after - mean)[alive], gain * (before - mean)[alive], atol=2e-3)


def test_the_head_is_asked_only_what_it_learned():
    """More views and members than the streams had that it learned from count as those; shares and means stay."""
    seen = jnp.asarray(np.random.default_rng(5).uniform(0.1, 1.0, (NUM, NUM_OBSERVED)), jnp.float32)
    full = seen * 30 / seen[:, :3].sum(axis=1, keepdims=True)
    features = jax.jit(observation_features)
    for times in (1.5, 1e3, 1e30):
        np.testing.assert_allclose(features(full * times), features(full), rtol=1e-5, atol=1e-5)
    assert np.all(np.abs(features(full * 0.5) - features(full))[:, 0] > 0.3)
    few, many, most = (
        decoder.evidence_features(replace(evidence(), num_members=jnp.full(NUM, n)), CONFIG) for n in (7.0, 8.0, 1e9)
    )
    np.testing.assert_array_equal(many, most)
    assert np.any(few != many)


def test_a_pivot_that_views_outgrew_gives_way_to_the_largest_of_its_voxel():
    rng, cache = np.random.default_rng(6), init_cache(CONFIG)
    numbers = lambda *more: rng.integers(0, 5, (CONFIG.memory.capacity, *more)).astype(np.int32)  # noqa: E731
    observations = (64 * numbers(4, NUM_OBSERVED)).astype(np.float32)
    counts, members, confidences = numbers(), numbers(4) + 1, rng.choice([0.2, 0.5], (CONFIG.memory.capacity, 4))
    facts = {"counts": counts, "num_members": members, "confidences": confidences, "observations": observations}
    cache = replace(cache, **{name: jnp.asarray(x, getattr(cache, name).dtype) for name, x in facts.items()})
    wanted = np.zeros(members.shape, bool)
    for row, count in enumerate(counts):
        left = [i for i in range(count) if confidences[row, i] >= CONFIG.memory.min_confidence]
        largest = max(left, key=lambda i: members[row, i], default=None)  # the first of equals
        for i in left:
            wanted[row, i] = i == largest or 128 * members[row, i] >= observations[row, i, :3].sum()
    np.testing.assert_array_equal(jax.jit(shown_pivots, static_argnums=1)(cache, CONFIG), wanted)
    plain = CONFIG.replace(vacc="append")
    np.testing.assert_array_equal(shown_pivots(cache, plain), cache.alive & (confidences >= 0.3))
