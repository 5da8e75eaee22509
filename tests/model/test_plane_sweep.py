"""The plane sweep: an untrained network finds a textured wall; only sources that see a cell count in its score."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.pytree import replace
from ssplat_jax.model.compact import CompactFeatures, encode, plane_sweep
from ssplat_jax.model.views import prepare_views, sweep_pixels
from tests.model.small import chunk_of, random_params, side_by_side, turned

CONFIG = StreamConfig().replace(
    encoder_widths=(16, 32), encoder_blocks=1, attention_blocks=0, num_depths=24, match_width=32, unet_width=8
)
SIDE, FOCAL, WALL, BASELINE = 64, 64.0, 2.0, 0.25  # the wall is 8 pixels of parallax away
CELL_SHARE = 0.7


def texture(x, y):
    """Analytic texture of the wall, a sum of waves of many lengths."""
    rng = np.random.default_rng(0)
    value = np.zeros((*x.shape, 3))
    for _ in range(40):
        direction, length = rng.uniform(0, 2 * np.pi), np.exp(rng.uniform(np.log(0.12), np.log(1.0)))
        phase = 2 * np.pi * (np.cos(direction) * x + np.sin(direction) * y) / length
        value += rng.normal(size=3) * np.sin(phase + rng.uniform(0, 2 * np.pi))[..., None]
    return 1 / (1 + np.exp(-0.4 * value))


def wall_chunk() -> Chunk:
    """Three views of the wall z = WALL, side by side."""
    centers = BASELINE * np.array([-1.0, 0.0, 1.0])
    pixel = np.arange(SIDE) + 0.5
    u, v = np.meshgrid(pixel, pixel)
    images = [texture((u - SIDE / 2) / FOCAL * WALL + c, (v - SIDE / 2) / FOCAL * WALL) for c in centers]
    K = [[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]]
    return chunk_of(np.stack(images), side_by_side(centers), K, near=1.0, far=5.0)


sweep = jax.jit(lambda features, views: plane_sweep(features, views, CONFIG))
encoded = jax.jit(lambda params, views: encode(params["encoder"], views, CONFIG))
VIEWS = functools.cache(lambda: jax.jit(prepare_views, static_argnums=1)(wall_chunk(), CONFIG))


def costs(features, views):
    """Mean cosines, `[view, row, column, scale, candidate]`."""
    return np.asarray(sweep(features, views)).reshape(3, SIDE // 4, SIDE // 4, 2, CONFIG.network.num_depths)


def random_features() -> CompactFeatures:
    random, side = np.random.default_rng(0), SIDE // 4
    maps = {"fine": (2 * side, 2 * side, 32), "grid": (side, side, 32), "context": (side, side, 8)}
    return CompactFeatures(**{k: jnp.asarray(random.normal(size=(3, *v)), jnp.float32) for k, v in maps.items()})


def test_untrained_cost_peaks_at_the_wall():
    both = costs(encoded(random_params(CONFIG), VIEWS()), VIEWS())
    assert (np.abs(both) <= 1 + 1e-5).all()  # means of cosines
    scores = both.sum(axis=3)
    candidates = np.exp(np.linspace(np.log(1.0), np.log(5.0), CONFIG.network.num_depths))
    truth = int(np.argmin(np.abs(np.log(candidates / WALL))))
    # The middle view's cells that both others see at every candidate behind 1.3.
    near = np.abs(scores[1, :, 4:-4].argmax(-1) - truth) <= 1
    assert near.mean() > CELL_SHARE, near.mean()


def test_sweep_pixels_are_shifted_by_the_parallax():
    views = VIEWS()
    x, y, seen = sweep_pixels(views, 1, 2, 4)
    pixels = np.stack([x, y], axis=-1)
    cells = np.stack(np.meshgrid(np.arange(16) * 4 + 2.0, np.arange(16) * 4 + 2.0), -1).reshape(-1, 2)
    for d, log_depth in enumerate(np.asarray(views.log_candidates, np.float64)):
        parallax = FOCAL * BASELINE / np.exp(log_depth)
        np.testing.assert_allclose(pixels[d], cells - [parallax, 0], atol=1e-3)
        np.testing.assert_array_equal(seen[d], cells[:, 0] - parallax >= 0)


def test_a_cell_that_one_of_two_sources_sees_scores_as_with_that_source_alone():
    views = VIEWS()
    features, side = random_features(), SIDE // 4
    valid = ([1, 1, 1], [1, 1, 0], [0, 1, 1])
    swept = (sweep(features, replace(views, valid=jnp.array(v, bool))) for v in valid)
    both, first, last = (np.asarray(cost)[1] for cost in swept)
    # Scores by scale and candidate; whether the source sees the cell does not depend on the scale.
    seen = [np.asarray(sweep_pixels(views, 1, source, 4)[2]).reshape(-1, side, side) for source in (0, 2)]
    seen_first, seen_last = (np.concatenate([s, s]).transpose(1, 2, 0) for s in seen)
    only_first, only_last, by_both = seen_first & ~seen_last, seen_last & ~seen_first, seen_first & seen_last
    assert min(mask.sum() for mask in (only_first, only_last, by_both)) > 100
    np.testing.assert_array_equal(both[only_first], first[only_first])
    np.testing.assert_array_equal(both[only_last], last[only_last])
    np.testing.assert_allclose(both[by_both], (first + last)[by_both] / 2, atol=1e-6)


def test_hard_features_and_cameras_reach_their_limits():
    views, features = VIEWS(), random_features()
    ordinary = costs(features, views)
    zero, one = (jax.tree.map(lambda x, value=value: jnp.full_like(x, value), features) for value in (0.0, 1.0))
    np.testing.assert_array_equal(costs(zero, views), 0)
    cost = costs(one, views)
    assert (np.minimum(np.abs(cost), np.abs(cost - 1)) < 1e-5).all()  # 0 where no source sees the candidate
    assert (cost > 0.5).mean() > 0.2
    np.testing.assert_allclose(costs(jax.tree.map(lambda x: 1e18 * x, features), views), ordinary, atol=1e-5)
    for angle in (0.0, 0.2):  # no parallax: no candidate is better than another
        cost = costs(features, replace(views, viewmats=turned(angle)))
        assert np.ptp(cost, axis=-1).max() < 1e-4 < 0.1 < np.abs(cost).max()
    away = costs(features, replace(views, viewmats=turned(np.pi)))
    np.testing.assert_array_equal(away[1], 0)  # between two that look the other way
    for valid in ([True, False, False], [False] * 3):
        np.testing.assert_array_equal(costs(features, replace(views, valid=jnp.array(valid)))[0], 0)
