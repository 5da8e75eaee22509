"""Small random scene, cameras in front of it, and the PSNR between two images."""

import jax.numpy as jnp
import numpy as np

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians

ROUND_TRIP = 3e-6  # relative; exponential of a float32 logarithm of up to 20


def scene(degree: int = 2, n: int = 60, seed: int = 0) -> Gaussians:
    """Random Gaussians of various sizes and opacities in front of the camera at the origin."""
    rng = np.random.default_rng(seed)
    means = rng.uniform([-1, -1, 2], [1, 1, 4], (n, 3))
    return Gaussians(
        means=jnp.asarray(means, jnp.float32),
        quats=jnp.asarray(rng.normal(size=(n, 4)), jnp.float32),
        scales=jnp.asarray(np.exp(rng.uniform(-4, -1, (n, 3))), jnp.float32),
        opacities=jnp.asarray(rng.uniform(0.05, 1.0, n), jnp.float32),
        sh=jnp.asarray(rng.normal(size=(n, (degree + 1) ** 2, 3)) * 0.3, jnp.float32),
    )


def camera(x: float = 0.0) -> Camera:
    """Camera near the origin that looks along +z."""
    viewmat = jnp.eye(4).at[0, 3].set(x)
    return Camera(viewmats=viewmat, Ks=jnp.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), width=48, height=32)


def decibels(a, b) -> float:
    """PSNR between two images."""
    return float(-10 * np.log10(np.mean((np.asarray(a, np.float64) - np.asarray(b, np.float64)) ** 2) + 1e-20))
