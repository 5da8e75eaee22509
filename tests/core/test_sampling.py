"""Warped correlation and its gradients against an oracle in float64 that warps first and then correlates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.numerics import bilinear_taps, correlate_warped, neighbor_offsets
from tests.core.test_cameras import f32

FLOAT32 = 2e-5  # sums of a dozen products of unit normals
HEIGHT, WIDTH = 5, 7


def coordinates(seed: int = 0) -> np.ndarray:
    """Positions (x, y) `[d n 2]` inside the map, on samples, on the border and outside."""
    coords = np.random.default_rng(seed).uniform([-2, -2], [WIDTH + 1, HEIGHT + 1], (4, 15, 2))
    coords[0, :3] = [[0, 0], [WIDTH - 1, HEIGHT - 1], [3, 2]]
    return coords


def arrays(seed: int, channels: int = 6):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(15, channels)), rng.normal(size=(HEIGHT, WIDTH, channels))


def warp_then_correlate(reference, image, coords):
    """Bilinear interpolation point by point, clamped at the border, then dot products."""
    out = np.zeros(coords.shape[:2])
    for d, n in np.ndindex(*out.shape):
        x, y = np.clip(coords[d, n], 0, [WIDTH - 1, HEIGHT - 1])
        column, row = min(int(x), WIDTH - 2), min(int(y), HEIGHT - 2)
        fx, fy = x - column, y - row
        top = (1 - fx) * image[row, column] + fx * image[row, column + 1]
        bottom = (1 - fx) * image[row + 1, column] + fx * image[row + 1, column + 1]
        out[d, n] = ((1 - fy) * top + fy * bottom) @ reference[n]
    return out


def taps_at(coords):
    x, y = jnp.moveaxis(f32(coords), -1, 0)
    return bilinear_taps(x, y, HEIGHT, WIDTH)


@pytest.mark.parametrize("channels", [6, 48, 1])
def test_correlation_is_that_of_the_warped_map(channels):
    reference, source = arrays(5, channels)
    got = correlate_warped(f32(reference), f32(source), taps_at(coordinates()))
    np.testing.assert_allclose(got, warp_then_correlate(reference, source, coordinates()), atol=FLOAT32)


def test_gradient_is_the_finite_difference_of_the_oracle():
    """The function is bilinear, so difference quotients are exact for any step."""
    (reference, source), coords = arrays(3), coordinates(3)
    total = lambda r, s: jnp.sum(correlate_warped(r, s, taps_at(coords)))  # noqa: E731
    by_reference, by_source = jax.grad(total, (0, 1))(f32(reference), f32(source))
    step_reference, step_source = arrays(4)
    oracle = lambda r, s: warp_then_correlate(r, s, coords).sum()  # noqa: E731
    difference = oracle(reference + step_reference, source) - oracle(reference, source)
    assert np.sum(np.asarray(by_reference) * step_reference) == pytest.approx(difference, abs=1e-3)
    difference = oracle(reference, source + step_source) - oracle(reference, source)
    assert np.sum(np.asarray(by_source) * step_source) == pytest.approx(difference, abs=1e-3)


def test_positions_outside_read_the_nearest_border_sample():
    """As the positions on the border do; NaN reads the first sample."""
    (reference, source), outside = arrays(6), [[-5, 2], [1e30, -1e30], [np.inf, -np.inf], [np.nan, np.nan], [3, 99]]
    border = [[0, 2], [WIDTH - 1, 0], [WIDTH - 1, 0], [0, 0], [3, HEIGHT - 1]]
    got, wanted = (correlate_warped(f32(reference[:5]), f32(source), taps_at([x])) for x in (outside, border))
    np.testing.assert_allclose(got, wanted, atol=FLOAT32)
    at = taps_at(outside)
    assert ((at.corners >= 0) & (at.corners + sum(neighbor_offsets(HEIGHT, WIDTH)) < HEIGHT * WIDTH)).all()


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 3), (3, 1)])
def test_maps_with_a_side_of_one_sample(height, width):
    rng = np.random.default_rng(0)
    source, x, y = rng.normal(size=(height, width, 4)), rng.uniform(-1, 4, (2, 5)), rng.uniform(-1, 4, (2, 5))
    at = bilinear_taps(f32(x), f32(y), height, width)
    assert ((at.corners >= 0) & (at.corners + sum(neighbor_offsets(height, width)) < height * width)).all()
    got = correlate_warped(jnp.ones((5, 4)), f32(source), at)
    along = source.sum(axis=-1).reshape(-1)
    wanted = np.interp(x if width > 1 else y, np.arange(len(along)), along)
    np.testing.assert_allclose(got, wanted, atol=FLOAT32)
