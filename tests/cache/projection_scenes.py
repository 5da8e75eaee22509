"""Random and hand-made caches and cameras to project."""

import jax.numpy as jnp
import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from ssplat_jax.cache.state import VoxelCache, init_cache
from ssplat_jax.cache.votes import SeenCells, seen_cells
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.pytree import replace
from tests.cache.streams import CAPACITY, CONFIG, WIDTH

HEIGHT, GRID_WIDTH = 6, 8
DECISION_MARGIN = 1e-4  # pixels, log depths: no float32 rounding of the inputs below moves a decision this far

SETTINGS = settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
SEED = st.integers(0, 2**32 - 1)
DEPTHS = st.sampled_from([0.1, 0.5, 1.0, 6.0])  # 6: some pivots are behind the cameras


def cameras(seed: int, num_views: int = 2) -> Camera:
    """Cameras around (0, 0, -4) that look along +z, with different intrinsics."""
    rng = np.random.default_rng(seed)
    viewmats = np.tile(np.eye(4), (num_views, 1, 1))
    for viewmat in viewmats:
        q, _ = np.linalg.qr(np.eye(3) + 0.2 * rng.normal(size=(3, 3)))
        viewmat[:3, :3] = q * np.sign(np.diagonal(q))
        viewmat[:3, 3] = rng.uniform(-0.3, 0.3, 3) + np.array([0, 0, 4])
    Ks = np.tile([[9.0, 0, 4.3], [0, 8.0, 2.8], [0, 0, 1]], (num_views, 1, 1))
    Ks[:, :2] *= rng.uniform(0.9, 1.1, (num_views, 1, 1))
    return Camera(jnp.asarray(viewmats, jnp.float32), jnp.asarray(Ks, jnp.float32), width=GRID_WIDTH, height=HEIGHT)


def scene(seed: int, num_voxels: int, depth_spread: float) -> VoxelCache:
    """A cache of random pivots about the origin, `depth_spread` deep, crowded on few pixels."""
    rng = np.random.default_rng(seed)
    cache = init_cache(CONFIG, CAPACITY)
    k = CONFIG.memory.pivots_per_voxel
    counts = np.where(np.arange(CAPACITY) < num_voxels, rng.integers(1, k + 1, CAPACITY), 0)
    alive = np.arange(k) < counts[:, None]
    means = rng.uniform(-1, 1, (CAPACITY, k, 3)) * [1.0, 1.0, depth_spread]
    values = {
        "means": means * alive[..., None],
        "confidences": rng.choice([0.0, 0.3, 0.5, 1.0], (CAPACITY, k)) * alive,
        "feats": rng.normal(size=(CAPACITY, k, WIDTH)) * alive[..., None],
        "rgbs": rng.uniform(size=(CAPACITY, k, 3 * CONFIG.head.gaussians_per_token)) * alive[..., None],
    }
    return replace(
        cache,
        counts=jnp.asarray(counts, jnp.int32),
        num_voxels=jnp.asarray(num_voxels, jnp.int32),
        **{name: jnp.asarray(x, jnp.float32) for name, x in values.items()},
    )


def with_pivots(means, confidences=None) -> VoxelCache:
    """A cache of one pivot per row at `means`; features number the pivots."""
    n = len(means)
    cache = init_cache(CONFIG, CAPACITY)
    confidences = np.full(n, 0.5) if confidences is None else confidences
    return replace(
        cache,
        counts=cache.counts.at[:n].set(1),
        num_voxels=jnp.asarray(n, jnp.int32),
        means=cache.means.at[:n, 0].set(jnp.asarray(means, jnp.float32)),
        confidences=cache.confidences.at[:n, 0].set(jnp.asarray(confidences, jnp.float32)),
        feats=cache.feats.at[:n, 0].set(jnp.arange(1.0, n + 1)[:, None] * jnp.ones(WIDTH)),
    )


def front_camera() -> Camera:
    """At the origin, looking along +z, principal point in the middle of pixel (3, 4)."""
    K = jnp.array([[8.0, 0, 4.5], [0, 8.0, 3.5], [0, 0, 1]])
    return Camera(viewmats=jnp.eye(4)[None], Ks=K[None], width=GRID_WIDTH, height=HEIGHT)


def random_views(seed: int, height: int = HEIGHT, width: int = GRID_WIDTH):
    """Depths and confidences of two views, some of them untrusted."""
    rng = np.random.default_rng(seed)
    shape = (2, height, width)
    depths = rng.uniform(2.5, 5.5, shape).astype(np.float32)
    depths.reshape(-1)[:3] = [np.nan, np.inf, 0.0]
    confidences = rng.choice([0.0, 0.25, 0.6, 0.7, 0.8, 0.9, 1.0], shape, p=[0.02, 0.02, *[0.192] * 5])
    return depths, confidences.astype(np.float32)


def cells_of(depths, confidences, colors=None) -> SeenCells:
    """Cells of views with these depths, confidences and colors `[v, h, w, 3]`, gray by default."""
    colors = jnp.full((*depths.shape, 3), 0.5) if colors is None else jnp.asarray(colors)
    rgbs = jnp.tile(colors.reshape(-1, 3), (1, CONFIG.head.gaussians_per_token))
    return seen_cells(jnp.asarray(depths), jnp.asarray(confidences), rgbs, CONFIG)
