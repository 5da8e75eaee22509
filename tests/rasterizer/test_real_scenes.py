"""The fast path on a real scene against the reference in float64, at random pixels. Slow.

The reference's memory is pixels x Gaussians: it is evaluated at a few hundred pixels, and the cotangent is 0 elsewhere.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.rasterizer import Effects, render
from ssplat_jax.rasterizer.outputs import splat_channels
from ssplat_jax.rasterizer.projection import cull_non_finite, project
from ssplat_jax.rasterizer.reference import sample_weights
from ssplat_jax.scene_files.formats import load_ply

pytestmark = pytest.mark.slow

FORWARD = 1e-4  # outside the boundary band
BAND = 1e-4  # relative distance of a sample to 1/255, or of a transmittance to the stop, that rounding may flip
GRADIENT = 1e-3  # relative L2
PIXELS, AT_ONCE = 256, 16
EFFECTS = Effects(antialias="classic")  # the renderer that the scene was made for


def looking_at(gaussians: Gaussians) -> tuple[Gaussians, Camera]:
    """A camera in front of the middle of a scene, at a distance that shows most of it."""
    means = np.asarray(gaussians.means)
    center, spread = np.median(means, axis=0), np.quantile(np.abs(means - np.median(means, axis=0)), 0.8)
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[:3, 3] = [-center[0], -center[1], 3 * spread - center[2]]
    K = np.array([[200, 0, 130], [0, 200, 90], [0, 0, 1]], np.float32)
    return gaussians, Camera(viewmats=jnp.asarray(viewmat), Ks=jnp.asarray(K), width=251, height=187)


def at_pixels(inputs, pixels):
    """Channels (RGB, depth sum, alpha) of the reference, and each pixel's distance to the nearest threshold."""
    gaussians, camera = inputs
    camera = Camera(viewmats=camera.viewmats[None], Ks=camera.Ks[None], width=camera.width, height=camera.height)
    gaussians, _ = cull_non_finite(gaussians)
    splats = project(gaussians, camera, EFFECTS)
    channels = splat_channels(gaussians, splats, camera, EFFECTS, None)[0]
    weights, after, order = sample_weights(splats, pixels)
    before = jnp.concatenate([jnp.ones_like(after[:, :1]), after[:, :-1]], axis=1)
    offsets = pixels[:, None] - splats.means2d[0, order]
    p, q, r = jnp.moveaxis(splats.conic_factors[0, order], -1, 0)
    exponents = (p * offsets[..., 0] + q * offsets[..., 1]) ** 2 + (r * offsets[..., 1]) ** 2
    raw = splats.opacities[0, order] * jnp.exp(-exponents)
    edge = jnp.where(before > 1e-4, jnp.minimum(jnp.abs(raw * 255 - 1), jnp.abs(after * 1e4 - 1)), 1.0)
    sums = jnp.sum(weights[..., None] * channels[order], axis=1)
    return jnp.concatenate([sums, jnp.sum(weights, axis=1)[:, None]], axis=1), jnp.min(edge, axis=1)


def test_tiles_equal_the_reference_in_float64(scenes):
    inputs = looking_at(load_ply(scenes / "kacytran_iter7000.ply"))
    camera = inputs[1]
    random = np.random.default_rng(0)
    out = render(*inputs, effects=EFFECTS)
    chosen = random.choice(camera.width * camera.height, PIXELS, replace=False)
    rows, columns = np.divmod(chosen, camera.width)
    cotangent = random.normal(size=(PIXELS, 5))
    cotangent[:, 4] *= 0.1
    max_pairs = int(out.num_pairs)

    @jax.jit
    @jax.grad
    def ours(inputs):
        out = render(*inputs, effects=EFFECTS, max_pairs=max_pairs)
        stacked = jnp.concatenate([out.color, (out.depth * out.alpha)[..., None], out.alpha[..., None]], axis=-1)
        return jnp.sum(stacked[rows, columns] * jnp.asarray(used, jnp.float32))

    with jax.enable_x64(True):
        doubles = jax.tree.map(lambda x: x.astype(jnp.float64), inputs)
        pixels = jnp.asarray(np.stack([columns, rows], axis=1) + 0.5).reshape(-1, AT_ONCE, 2)
        values = [jax.tree.map(np.asarray, jax.jit(at_pixels)(doubles, part)) for part in pixels]
        wanted, edge = (np.concatenate([v[i] for v in values]) for i in (0, 1))
        used = np.where((edge > BAND)[:, None], cotangent, 0)
        weigh = jax.jit(jax.grad(lambda inputs, part, ct: jnp.sum(at_pixels(inputs, part)[0] * ct)))
        parts = [weigh(doubles, p, jnp.asarray(c)) for p, c in zip(pixels, used.reshape(-1, AT_ONCE, 5), strict=True)]
        exact = [sum(map(np.asarray, leaves)) for leaves in zip(*map(jax.tree.leaves, parts), strict=True)]
    outside = edge > BAND
    assert outside.mean() > 0.8
    got = np.concatenate([out.color, (out.depth * out.alpha)[..., None], out.alpha[..., None]], axis=-1)[rows, columns]
    scale = np.maximum(1.0, np.abs(wanted).max(axis=0))
    assert np.abs((got - wanted) / scale)[outside].max() <= FORWARD
    whole = np.sqrt(sum(np.vdot(b, b) for b in exact))
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(ours(inputs)), exact, strict=True):
        a, name = np.asarray(a, np.float64), jax.tree_util.keystr(path)
        if np.linalg.norm(b) <= 1e-12 * whole:  # turning round Gaussians changes nothing: 0, but for rounding
            assert np.linalg.norm(a) <= 1e-6 * whole, name
            continue
        assert np.linalg.norm(a - b) <= GRADIENT * np.linalg.norm(b), name
        assert np.vdot(a, b) >= 0.99999 * np.linalg.norm(a) * np.linalg.norm(b), name
