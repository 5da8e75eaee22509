"""The definition: every Gaussian at every pixel, front to back, in plain autodiff and any float dtype.

O(pixels x Gaussians) memory: for tests and small scenes. It shares the projection and the constants with the fast path,
and none of its tiles, bounds, sorting keys or gradients.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.gaussians import Gaussians
from ssplat_jax.geometry.cameras import Camera
from ssplat_jax.render import constants
from ssplat_jax.render.effects import Effects
from ssplat_jax.render.output import RenderOutput, finish, splat_channels
from ssplat_jax.render.projection import Splats, cull_non_finite, project
from ssplat_jax.struct import replace


def composite_pixels(
    splats: Splats, channels: Float[Array, "n c"], pixels: Float[Array, "q 2"]
) -> Float[Array, "q c"]:
    """Channels of one camera's `splats` (batch axis 1) composited at `pixels`."""
    order = jnp.argsort(jnp.where(splats.visible[0], splats.depths[0], jnp.inf), stable=True)
    means2d, conics = splats.means2d[0, order], splats.conics[0, order]
    offsets = pixels[:, None, :] - means2d
    dx, dy = offsets[..., 0], offsets[..., 1]
    quadratic = 0.5 * (conics[:, 0] * dx * dx + conics[:, 2] * dy * dy) + conics[:, 1] * dx * dy
    raw = splats.opacities[0, order] * jnp.exp(-quadratic)
    alphas = jnp.where(raw >= constants.ALPHA_MIN, jnp.minimum(raw, constants.ALPHA_MAX), 0.0)
    after = jnp.cumprod(1.0 - alphas, axis=1)
    before = jnp.concatenate([jnp.ones_like(after[:, :1]), after[:, :-1]], axis=1)
    weights = jnp.where(after >= constants.TRANSMITTANCE_STOP, alphas * before, 0.0)
    return jnp.sum(weights[..., None] * channels[order], axis=1)


def render_reference(
    gaussians: Gaussians,
    camera: Camera,
    *,
    effects: Effects | None = None,
    features: Float[Array, "n c"] | None = None,
    rows_at_once: int = 16,
) -> RenderOutput:
    """The images that `ssplat_jax.render.render` must give, in the dtype of `gaussians`; one band of rows at a time."""
    effects = effects or Effects()
    gaussians, num_non_finite = cull_non_finite(gaussians)
    flat = replace(camera, viewmats=camera.viewmats.reshape(-1, 4, 4), Ks=camera.Ks.reshape(-1, 3, 3))
    splats = project(gaussians, flat, effects)
    channels = splat_channels(gaussians, splats, flat, effects, features)
    dtype = channels.dtype
    xs, ys = jnp.arange(camera.width, dtype=dtype) + 0.5, jnp.arange(camera.height, dtype=dtype) + 0.5
    pixels = jnp.stack(jnp.broadcast_arrays(xs[None, :], ys[:, None]), axis=-1)
    bands = [pixels[i : i + rows_at_once] for i in range(0, camera.height, rows_at_once)]
    images = []
    for i in range(flat.viewmats.shape[0]):
        one = jax.tree.map(lambda x, i=i: x[i : i + 1], splats)
        composited = [composite_pixels(one, channels[i], band.reshape(-1, 2)) for band in bands]
        images.append(jnp.concatenate(composited).reshape(camera.height, camera.width, -1))
    zero = jnp.zeros((), jnp.int32)
    return finish(
        jnp.stack(images), camera, effects, num_pairs=zero, num_overflow=zero, num_non_finite=num_non_finite
    )
