"""Cameras against float64: frames, projection, and pixel centers."""

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.core.cameras import pixel_grid, project_points, unproject

PIXELS = 2e-3  # float32 of pixel coordinates up to a few thousand, after a handful of operations


def intrinsics(num: int, seed: int = 0) -> np.ndarray:
    """Random intrinsics with different focal lengths and an off-center principal point."""
    rng = np.random.default_rng(seed)
    Ks = np.tile(np.eye(3), (num, 1, 1))
    Ks[:, 0, 0], Ks[:, 1, 1] = rng.uniform(200, 900, (2, num))
    Ks[:, 0, 2], Ks[:, 1, 2] = rng.uniform(50, 400, (2, num))
    return Ks


def f32(x):
    return jnp.asarray(x, jnp.float32)


def test_projection_undoes_unprojection():
    rng = np.random.default_rng(2)
    Ks, pixels = intrinsics(5), rng.uniform(-100, 2000, (5, 40, 2))
    depths = np.exp(rng.uniform(np.log(0.01), np.log(1e4), (5, 40)))
    points = unproject(f32(pixels), f32(depths), f32(Ks))
    again, z = project_points(points, f32(Ks))
    np.testing.assert_allclose(again, pixels, atol=PIXELS)
    np.testing.assert_array_equal(z, f32(depths))


def test_axes_are_right_down_forward():
    K = f32([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]])
    pixels, depths = project_points(f32([[0.1, 0, 1], [0, 0.1, 1], [0, 0, 1]]), K)
    np.testing.assert_allclose(pixels, [[42, 24], [32, 34], [32, 24]], atol=1e-5)
    np.testing.assert_array_equal(depths, 1)


def test_pixel_centers_are_at_half():
    grid = pixel_grid(3, 5)
    np.testing.assert_array_equal(grid[0, 0], [0.5, 0.5])
    np.testing.assert_array_equal(grid[2, 4], [4.5, 2.5])  # (x, y) of row 2, column 4
    coarse = pixel_grid(8, 12, 4)
    assert coarse.shape == (2, 3, 2)
    np.testing.assert_array_equal(coarse[1, 2], [10, 6])
    # A cell's center is the mean of its pixels' centers.
    np.testing.assert_array_equal(coarse[1, 2], pixel_grid(8, 12)[4:8, 8:12].mean(axis=(0, 1)))


def test_points_behind_the_camera_project_to_finite_pixels():
    points = f32([[1.0, 1, 0], [1, 1, -2], [1e3, -1e3, 1e-9], [0, 0, 0]])
    K = f32([[500.0, 0, 32], [0, 500, 24], [0, 0, 1]])
    pixels, depths = project_points(points, K, min_depth=1e-3)
    np.testing.assert_array_equal(depths, points[:, 2])
    np.testing.assert_allclose(pixels[1], [500 / 1e-3 + 32, 500 / 1e-3 + 24], rtol=1e-6)  # divided as min_depth
    gradient = jax.grad(lambda p: jnp.sum(project_points(p, K, min_depth=1e-3)[0]))(points)
    assert np.isfinite(pixels).all() and np.isfinite(gradient).all()
