"""Cameras against float64: frames, projection, and pixel centers."""

import jax.numpy as jnp
import numpy as np

from ssplat_jax.core.cameras import pixel_grid, unproject

PIXELS = 2e-3  # float32 of pixel coordinates up to a few thousand, after a handful of operations


def f32(x):
    return jnp.asarray(x, jnp.float32)


def test_unprojected_points_lie_on_the_rays_of_their_pixels():
    rng = np.random.default_rng(2)
    Ks, pixels = np.tile(np.eye(3), (5, 1, 1)), rng.uniform(-100, 2000, (5, 40, 2))
    depths = np.exp(rng.uniform(np.log(0.01), np.log(1e4), (5, 40)))
    Ks[:, 0, 0], Ks[:, 1, 1] = rng.uniform(200, 900, (2, 5))
    Ks[:, 0, 2], Ks[:, 1, 2] = rng.uniform(50, 400, (2, 5))
    points = np.asarray(unproject(f32(pixels), f32(depths), f32(Ks)), np.float64)
    seen = np.einsum("vij,vnj->vni", Ks, points)
    np.testing.assert_allclose(seen[..., :2] / seen[..., 2:], pixels, atol=PIXELS)
    np.testing.assert_array_equal(points[..., 2], np.float32(depths))


def test_pixel_centers_are_at_half():
    grid = pixel_grid(3, 5)
    np.testing.assert_array_equal(grid[0, 0], [0.5, 0.5])
    np.testing.assert_array_equal(grid[2, 4], [4.5, 2.5])  # (x, y) of row 2, column 4
    coarse = pixel_grid(8, 12, 4)
    assert coarse.shape == (2, 3, 2)
    np.testing.assert_array_equal(coarse[1, 2], [10, 6])
    # A cell's center is the mean of its pixels' centers.
    np.testing.assert_array_equal(coarse[1, 2], pixel_grid(8, 12)[4:8, 8:12].mean(axis=(0, 1)))
