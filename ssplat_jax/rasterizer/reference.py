"""The reference renderer: every Gaussian at every pixel, front to back, in plain autodiff and any float dtype.

It defines the image. It takes O(pixels x Gaussians) memory: for tests and small scenes. It shares the projection and
the constants with the fast path, but no tiles, bounds, sort keys or gradients.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ssplat_jax.core.cameras import Camera, check_camera, relative_to
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.numerics import with_rank_promotion
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import constants
from ssplat_jax.rasterizer.effects import Effects, filter_3d
from ssplat_jax.rasterizer.outputs import RenderOutput, finish, splat_channels
from ssplat_jax.rasterizer.projection import Splats, cull_non_finite, project


def sample_weights(
    splats: Splats, pixels: Float[Array, "q 2"]
) -> tuple[Float[Array, "q n"], Float[Array, "q n"], Int[Array, " n"]]:
    """Weights of one camera's splats (a batch of 1) at `pixels`, transmittance after each, and the depth order."""
    order = jnp.argsort(jnp.where(splats.visible[0], splats.depths[0], jnp.inf), stable=True)
    means2d, factors = splats.means2d[0, order], splats.conic_factors[0, order]
    offsets = pixels[:, None, :] - means2d
    dx, dy = offsets[..., 0], offsets[..., 1]
    exponents = (factors[:, 0] * dx + factors[:, 1] * dy) ** 2 + (factors[:, 2] * dy) ** 2
    raw = splats.opacities[0, order] * jnp.exp(-exponents)
    alphas = jnp.where(raw >= constants.ALPHA_MIN, jnp.minimum(raw, constants.ALPHA_MAX), 0.0)
    after = jnp.cumprod(1.0 - alphas, axis=1)
    before = jnp.concatenate([jnp.ones_like(after[:, :1]), after[:, :-1]], axis=1)
    return jnp.where(after >= constants.TRANSMITTANCE_STOP, alphas * before, 0.0), after, order


def _band(splats: Splats, channels: Float[Array, "n c"], pixels: Float[Array, "q 2"]):
    """Channels composited at `pixels`, and the median depth."""
    weights, after, order = sample_weights(splats, pixels)
    half = after < constants.MEDIAN_TRANSMITTANCE
    median = jnp.where(half[:, -1], splats.depths[0, order][jnp.argmax(half, axis=1)], 0.0)
    return jnp.sum(weights[..., None] * channels[order], axis=1), median


@with_rank_promotion
def render_reference(
    gaussians: Gaussians,
    camera: Camera,
    *,
    effects: Effects | None = None,
    features: Float[Array, "n c"] | None = None,
    captured: Camera | None = None,
    distortion: Float[Array, "*b 5"] | None = None,
    exposures: Float[Array, "*b 3 4"] | None = None,
) -> RenderOutput:
    """The images that `render` must give, in the dtype of `gaussians`.

    Args:
        gaussians, camera, effects, features, captured, distortion, exposures: as in `render`.

    Returns:
        The output; its counts of pairs are 0.

    Raises:
        InputError: a flag of `effects` is True without its array.
    """
    arrays = {"captured": captured, "distortion": distortion, "exposures": exposures}
    effects = (effects or Effects()).resolve(gaussians.render_mode, **arrays)
    check_camera(camera, "render_reference")
    camera = relative_to(camera, gaussians.offset)
    gaussians, num_non_finite = cull_non_finite(gaussians, features)
    if effects.filter_3d and captured is not None:
        gaussians = filter_3d(gaussians, relative_to(captured, gaussians.offset))
    flat = replace(camera, viewmats=camera.viewmats.reshape(-1, 4, 4), Ks=camera.Ks.reshape(-1, 3, 3))
    splats = project(gaussians, flat, effects, None if distortion is None else distortion.reshape(-1, 5))
    channels = splat_channels(gaussians, splats, flat, effects, features)
    if effects.needs_alpha:
        channels = jnp.concatenate([channels, jnp.ones_like(channels[..., :1])], axis=-1)
    xs, ys = (jnp.arange(size, dtype=channels.dtype) + 0.5 for size in (camera.width, camera.height))
    pixels = jnp.stack(jnp.broadcast_arrays(xs[None, :], ys[:, None]), axis=-1)
    rows = jnp.array_split(pixels, camera.height // 16 + 1)  # at most 16 at once: bounds the memory
    bands = [part.reshape(-1, 2) for part in rows]
    images, medians = [], []
    for i in range(flat.viewmats.shape[0]):
        one = jax.tree.map(lambda x, i=i: x[i : i + 1], splats)
        parts = [_band(one, channels[i], band) for band in bands]
        images.append(jnp.concatenate([p[0] for p in parts]).reshape(camera.height, camera.width, -1))
        medians.append(jnp.concatenate([p[1] for p in parts]).reshape(camera.height, camera.width))
    zero = jnp.zeros((), jnp.int32)
    return finish(
        jnp.stack(images),
        camera,
        effects,
        exposures=exposures,
        median_depth=jnp.stack(medians) if "median_depth" in effects.outputs else None,
        num_pairs=zero,
        num_overflow=zero,
        num_non_finite=num_non_finite,
    )
