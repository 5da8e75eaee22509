"""Small scenes and cameras for the tests of the rasterizer."""

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians


def cloud(num: int = 60, *, degree: int = 1, size: float = 0.08, seed: int = 0, dtype=np.float32) -> Gaussians:
    """Gaussians of all shapes in front of the origin, z from 1 to 4."""
    random = np.random.default_rng(seed)
    return Gaussians(
        means=jnp.asarray(random.uniform([-1, -1, 1], [1, 1, 4], (num, 3)).astype(dtype)),
        quats=jnp.asarray(random.normal(size=(num, 4)).astype(dtype)),
        scales=jnp.asarray((size * np.exp(random.normal(0, 0.5, (num, 3)))).astype(dtype)),
        opacities=jnp.asarray(random.uniform(0.05, 0.95, num).astype(dtype)),
        sh=jnp.asarray(random.normal(0, 0.3, (num, (degree + 1) ** 2, 3)).astype(dtype)),
    )


def balls(means, size, opacities=0.9, colors=0.5) -> Gaussians:
    """Gaussians of no turn at `means`; sizes, opacities and colors are those of all, or of each."""
    full = lambda x, *shape: jnp.broadcast_to(jnp.asarray(x, jnp.float32), (len(means), *shape))  # noqa: E731
    return Gaussians.from_rgb(
        means=full(means, 3), quats=full([1.0, 0, 0, 0], 4), scales=full(size, 3), opacities=full(opacities),
        colors=full(colors, 3),
    )  # fmt: skip


def concatenate(parts: list[Gaussians]) -> Gaussians:
    """All rows of `parts`, which have the same SH degree, in order."""
    return jax.tree.map(lambda *rows: jnp.concatenate(rows), *parts)


def cameras(width: int, height: int, batch: int | None = None, dtype=np.float32) -> Camera:
    """Cameras with fx != fy, an off-center principal point, and small rotations and shifts."""
    K = np.array([[width * 0.8, 0, width * 0.45], [0, width * 0.85, height * 0.55], [0, 0, 1]], dtype)
    poses = []
    for i in range(batch or 1):
        angle = 0.05 * (i + 1)
        pose = np.eye(4)
        pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        pose[:3, 3] = [0.1 * i, -0.05, 0.1]
        poses.append(pose.astype(dtype))
    Ks = jnp.asarray(np.stack([K] * len(poses)))
    camera = Camera(viewmats=jnp.asarray(np.stack(poses)), Ks=Ks, width=width, height=height)
    return camera[0] if batch is None else camera
