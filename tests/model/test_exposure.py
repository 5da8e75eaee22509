"""Exposure of views relative to the scene: the median of color ratios on common surfaces, and its limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ssplat_jax.core.pytree import replace
from ssplat_jax.model.exposure import MIN_CELLS, estimate_exposures
from ssplat_jax.model.streamsplat import _flatten_tokens
from ssplat_jax.model.views import patch_colors, prepare_views
from tests.model.small import CONFIG, chunk, history

TRUSTING = CONFIG.replace(min_confidence=0.5)
SIDE, VIEWS = 64, 3
CELLS = SIDE // 4


@jax.jit
def estimate(remembered, log_depths, confidences, images, valid):
    """The exposures of views with these images."""
    views = prepare_views(replace(chunk(height=SIDE, width=SIDE), images=images, valid=valid), TRUSTING)
    return estimate_exposures(remembered, log_depths, confidences, views, TRUSTING)


def scene(seed: int = 0):
    """Cached colors and depths of the cells of all views."""
    rng = np.random.default_rng(seed)
    return rng.uniform(0.2, 0.55, (VIEWS, CELLS, CELLS, 3)), rng.uniform(1, 6, (VIEWS, CELLS, CELLS))


def exposures(remembered, colors, depths, *, seen_depths=None, confidences=0.9, mask=None, valid=(True,) * VIEWS):
    """Exposures estimated from the current `colors` of cells and their `remembered` ones."""
    seen_depths = depths if seen_depths is None else seen_depths
    images = np.repeat(np.repeat(colors, 4, axis=1), 4, axis=2)
    known = history(depths, np.full(depths.shape, 0.8), mask=mask, colors=remembered)
    with np.errstate(all="ignore"):
        log_depths = jnp.asarray(np.log(seen_depths), jnp.float32)
    trust = jnp.asarray(np.broadcast_to(confidences, depths.shape), jnp.float32)
    return np.asarray(estimate(known, log_depths, trust, jnp.asarray(images, jnp.float32), jnp.asarray(valid)))


def oracle(remembered, colors, depths, seen_depths, confidences, mask):
    """The same in float64, one cell at a time."""
    logs = []
    for v in range(VIEWS):
        ratios = []
        for cell in np.ndindex(CELLS, CELLS):
            at = (v, *cell)
            seen, old = colors[at].astype(np.float64), remembered[at].astype(np.float64)
            if not mask[at] or confidences[at] < 0.5 or abs(np.log(seen_depths[at] / depths[at])) > np.log(1.1):
                continue
            if (seen >= 0.03).all() and (seen <= 0.97).all() and (old >= 0.03).all():
                ratios.append(np.log(seen / old))
        n = len(ratios)
        logs.append(np.clip(np.sort(ratios, axis=0)[n // 2], -np.log(4), np.log(4)) if n >= MIN_CELLS else None)
    known = [log for log in logs if log is not None]
    fallback = np.mean(known, axis=0) if known else np.zeros(3)
    return np.exp([fallback if log is None else log for log in logs])


@settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(seed=st.integers(0, 2**32 - 1), agreeing=st.sampled_from([0.1, 0.3, 0.6, 1.0]), spread=st.sampled_from([0, 2]))
def test_estimate_equals_the_loop(seed, agreeing, spread):
    rng = np.random.default_rng(seed)
    remembered, depths = scene(seed)
    colors = remembered * np.exp(spread * rng.normal(size=(VIEWS, 1, 1, 3)) + 0.1 * rng.normal(size=remembered.shape))
    remembered, colors = (np.clip(x, 0, 1).astype(np.float32) for x in (remembered, colors))
    seen_depths = depths * np.where(rng.uniform(size=depths.shape) < agreeing, 1.05, 1.2)
    confidences = rng.choice([0.25, 0.75], depths.shape)
    mask = rng.uniform(size=depths.shape) < 0.9
    wanted = oracle(remembered, colors, depths, seen_depths, confidences, mask)
    got = exposures(remembered, colors, depths, seen_depths=seen_depths, confidences=confidences, mask=mask)
    np.testing.assert_allclose(got, wanted, rtol=2e-6)


@pytest.mark.parametrize(("num_cells", "is_known"), [(MIN_CELLS, True), (MIN_CELLS - 1, False), (0, False)])
def test_view_with_too_few_cells_has_the_mean_of_the_others(num_cells, is_known):
    """Also a padded one, which shares none."""
    remembered, depths = scene()
    remembered, mask = np.minimum(remembered, 0.48), np.ones(depths.shape, bool)
    mask[1].flat[num_cells:] = False
    colors = remembered * np.array([0.5, 0.8, 2.0]).reshape(3, 1, 1, 1)
    got = exposures(remembered, colors, depths, mask=mask, valid=[True, num_cells > 0, True])
    np.testing.assert_allclose(got[:, 0], [0.5, 0.8 if is_known else 1.0, 2.0], rtol=1e-5)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_values_that_are_not_finite_are_not_compared(bad):
    remembered, depths = scene()
    colors, seen_depths = 0.5 * remembered, depths.copy()
    remembered[:, 1], seen_depths[:, 2] = bad, bad
    np.testing.assert_allclose(exposures(remembered, colors, depths, seen_depths=seen_depths), 0.5, rtol=1e-5)


def test_exposures_have_no_gradient():
    remembered, depths = scene()
    known, trust = history(depths, np.full(depths.shape, 0.8), colors=remembered), jnp.full(depths.shape, 0.9)
    images = jnp.asarray(np.repeat(np.repeat(0.5 * remembered, 4, axis=1), 4, axis=2), jnp.float32)
    total = lambda images, log_depths: estimate(known, log_depths, trust, images, jnp.ones(VIEWS, bool)).sum()  # noqa: E731
    gradients = jax.grad(total, argnums=(0, 1))(images, jnp.asarray(np.log(depths), jnp.float32))
    assert not any(np.any(np.asarray(g)) for g in gradients)


GAINS = np.array([[0.5, 0.7, 1.0], [1.0, 1.0, 1.0], [2.0, 1.5, 1.25]], np.float32)


@jax.jit
def token_colors(images, exposures):
    views = prepare_views(replace(chunk(), images=images), CONFIG)
    v, hf, wf = views.inside.shape
    maps = jnp.zeros((v, hf, wf))
    feats = jnp.zeros((v, hf, wf, CONFIG.network.token_width))
    tokens = _flatten_tokens(jnp.zeros((v, hf, wf, 3)), feats, maps, maps, exposures, views, CONFIG)
    return tokens.rgbs, patch_colors(views.images, CONFIG)


def test_colors_are_divided_by_their_views_exposure():
    images = 0.4 * chunk().images  # the brightest view stays below 1
    as_seen, patches = token_colors(images, jnp.ones((3, 3)))
    np.testing.assert_array_equal(as_seen, patches.reshape(as_seen.shape))  # view-major, row-major
    brighter, _ = token_colors(images * GAINS[:, None, None], jnp.asarray(GAINS))
    np.testing.assert_allclose(brighter, as_seen, rtol=1e-5)
    darkened, _ = token_colors(images, jnp.asarray(GAINS))
    cells = as_seen.reshape(3, -1, as_seen.shape[1] // 3, 3)
    np.testing.assert_allclose(darkened.reshape(cells.shape), cells / GAINS[:, None, None], rtol=1e-5)
