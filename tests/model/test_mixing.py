"""CGFI and the 3D mixer: where history is injected, and which tokens are neighbors."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.model.cgfi import inject_features
from ssplat_jax.model.compact import mix_tokens
from ssplat_jax.model.mixer import nearest_tokens
from ssplat_jax.model.network import init_params
from ssplat_jax.model.views import prepare_views
from tests.model.small import CONFIG, chunk, history, params, random_params

C = CONFIG.network.token_width
GRID = (3, 8, 8)
CONCAT = CONFIG.replace(residual_cgfi=False)
_INJECT, _MIX = jax.jit(inject_features, static_argnums=5), jax.jit(mix_tokens, static_argnums=5)


def maps(seed: int, *channels):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(*GRID, *channels)), jnp.float32)


@functools.cache
def views():
    return jax.jit(prepare_views, static_argnums=1)(chunk(), CONFIG)


def inject(weights, feats, past, confidences, config=CONFIG):
    return _INJECT(weights["cgfi"], feats, past, jnp.full(GRID, confidences), views(), config)


def past(seed: int = 1):
    rng = np.random.default_rng(seed)
    return history(rng.uniform(1, 5, GRID), np.full(GRID, 0.7), feats=rng.normal(size=(*GRID, C)))


def test_cgfi_is_the_identity_before_training():
    for config in (CONFIG, CONCAT):
        untrained = init_params(jax.random.key(0), config, only=("cgfi",))
        np.testing.assert_array_equal(inject(untrained, maps(0, C), past(), 0.4, config), maps(0, C))


@pytest.mark.parametrize("config", [CONFIG, CONCAT], ids=["residual", "concat"])
def test_cgfi_uses_history_only_where_confidence_is_below_one(config):
    def effect_of_history(confidence):
        here, other = (inject(random_params(config), maps(0, C), past(seed), confidence, config) for seed in (1, 2))
        return float(jnp.abs(here - other).max())

    assert effect_of_history(1.0) == 0.0
    assert effect_of_history(0.2) > 1e-3


@pytest.mark.parametrize("radius", [0, 2])
def test_neighbors_are_the_nearest_with_the_token_first(radius):
    positions = maps(2, 3)
    inside = jnp.asarray(np.random.default_rng(3).uniform(size=GRID) < 0.8)
    found = np.asarray(jax.jit(nearest_tokens, static_argnums=(2, 3))(positions, inside, 4, radius))
    points, usable = np.asarray(positions, np.float64).reshape(-1, 3), np.asarray(inside).reshape(-1)
    np.testing.assert_array_equal(found[:, 0], np.arange(len(points)))

    def candidates(i):
        if radius == 0:
            return range(len(points))
        v, y, x = np.unravel_index(i, GRID)
        ys, xs = (np.arange(max(0, a - radius), min(8, a + radius + 1)) for a in (y, x))
        return [int(np.ravel_multi_index((v, a, b), GRID)) for a in ys for b in xs]

    for i, point in enumerate(points):
        assert np.isin(found[i], [*candidates(i), i]).all()
        distance = lambda j: float(np.sum((points[j] - point) ** 2))  # noqa: E731, B023
        wanted = sorted(distance(j) for j in candidates(i) if usable[j] and j != i)[:3]
        if len(wanted) == 3:
            np.testing.assert_allclose(sorted(map(distance, found[i, 1:])), wanted, rtol=1e-6)
            assert usable[found[i, 1:]].all()


def mix(feats, positions, inside, valid):
    return _MIX(params()["mixer"], feats, positions, inside, valid, CONFIG)


def test_mixing_does_not_depend_on_the_order_of_the_views():
    feats, positions, inside = maps(4, C), maps(5, 3), jnp.ones(GRID, bool)
    order = jnp.array([2, 0, 1])
    straight = mix(feats, positions, inside, jnp.ones(3, bool))
    shuffled = mix(feats[order], positions[order], inside, jnp.ones(3, bool))
    np.testing.assert_allclose(shuffled, straight[order], atol=1e-4)
    assert float(jnp.abs(straight - feats).max()) > 0.1


def test_mixer_without_blocks_only_normalizes():
    config = CONFIG.replace(mixer_blocks=0)
    feats = maps(4, C)
    out = np.asarray(mix_tokens({}, feats, maps(5, 3), jnp.ones(GRID, bool), jnp.ones(3, bool), config))
    np.testing.assert_allclose((out**2).mean(axis=-1), 1.0, atol=1e-4)
    norms = np.linalg.norm(out, axis=-1) * np.linalg.norm(feats, axis=-1)
    np.testing.assert_allclose((out * np.asarray(feats)).sum(axis=-1) / norms, 1.0, atol=1e-5)


def test_tokens_at_one_point_are_mixed_finitely():
    valid = jnp.ones(3, bool)

    def energy(feats):
        mixed = mix(feats, jnp.zeros((*GRID, 3)), jnp.ones(GRID, bool), valid)
        return jnp.sum(mixed**2), mixed

    (_, mixed), gradient = jax.jit(jax.value_and_grad(energy, has_aux=True))(maps(4, C))
    assert np.isfinite(mixed).all() and np.isfinite(gradient).all()
