"""The render output, and the steps before and after compositing that both renderers share."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.numerics import safe_normalize
from ssplat_jax.core.pytree import pytree
from ssplat_jax.rasterizer.effects import Effects
from ssplat_jax.rasterizer.projection import Splats
from ssplat_jax.rasterizer.sh import sh_colors


@pytree
class RenderOutput:
    """Images of one camera or a batch, and counts of what was left out."""

    color: Float[Array, "*b h w 3"]  # RGB, background included; may exceed 1 (SH), never below 0
    alpha: Float[Array, "*b h w"] | None  # 1 - transmittance
    depth: Float[Array, "*b h w"] | None  # expected camera z, sum(w z) / sum(w); 0 where alpha is 0
    median_depth: Float[Array, "*b h w"] | None  # camera z where the transmittance falls below 1/2; 0 where it does not
    features: Float[Array, "*b h w c"] | None  # sum(w f), not normalized
    num_pairs: Int[Array, ""]  # tile intersections, (tile, Gaussian) pairs, of all images
    num_overflow: Int[Array, ""]  # pairs above `max_pairs`; the image is wrong unless 0
    num_non_finite: Int[Array, ""]  # rows culled for entries that are NaN, infinite or above 1e12


def splat_channels(
    gaussians: Gaussians,
    splats: Splats,
    camera: Camera,
    effects: Effects,
    features: Float[Array, "n c"] | None,
) -> Float[Array, "b n channels"]:
    """The channels to composite: RGB, then depth and features where wanted.

    Args:
        gaussians: the scene, finite.
        splats: its projection.
        camera: one batch axis.
        effects: the SH degree and the outputs.
        features: further channels; rows that are not finite become 0.

    Returns:
        Channels of each camera and Gaussian.
    """
    degree = gaussians.sh_degree if effects.sh_degree is None else min(effects.sh_degree, gaussians.sh_degree)
    directions = None
    if degree > 0:
        directions = safe_normalize(gaussians.means - camera.centers[:, None, :])
    shape = splats.depths.shape
    colors = jnp.broadcast_to(sh_colors(gaussians.sh, directions, degree), (*shape, 3))
    parts = [colors.astype(splats.depths.dtype)]
    if "depth" in effects.outputs:
        parts.append(splats.depths[..., None])
    if features is not None:
        usable = jnp.all(jnp.isfinite(features), axis=-1, keepdims=True)
        features = jnp.where(usable, features, 0).astype(splats.depths.dtype)
        parts.append(jnp.broadcast_to(features, (*shape, features.shape[-1])))
    return jnp.concatenate(parts, axis=-1)


def finish(
    composited: Float[Array, "b h w c"],
    camera: Camera,
    effects: Effects,
    *,
    exposures: Float[Array, "*b 3 4"] | None,
    median_depth: Float[Array, "b h w"] | None,
    num_pairs: Int[Array, ""],
    num_overflow: Int[Array, ""],
    num_non_finite: Int[Array, ""],
) -> RenderOutput:
    """The output of a render.

    Args:
        composited: `splat_channels` composited, alpha last if `effects.needs_alpha`.
        camera: gives the batch shape.
        effects: background, exposure and outputs.
        exposures: affine color correction of each frame.
        median_depth: passed on, as are the counts.
        num_pairs: tile intersections.
        num_overflow: tile intersections above the capacity.
        num_non_finite: rows culled.

    Returns:
        Images in the camera's batch shape.
    """
    batch = camera.viewmats.shape[:-2]
    images = composited.reshape(*batch, *composited.shape[1:])
    color, rest, alpha, depth = images[..., :3], images[..., 3:], None, None
    if effects.needs_alpha:
        rest, alpha = rest[..., :-1], rest[..., -1]
    if effects.background is not None and alpha is not None:
        color = color + (1.0 - alpha)[..., None] * jnp.array(effects.background, color.dtype)
    if effects.exposure and exposures is not None:
        color = apply_exposures(color, exposures.astype(color.dtype))
    if "depth" in effects.outputs and alpha is not None:
        seen = alpha > 0
        depth = jnp.where(seen, rest[..., 0] / jnp.where(seen, alpha, 1.0), 0.0)
        rest = rest[..., 1:]
    return RenderOutput(
        color=color,
        alpha=alpha,
        depth=depth,
        median_depth=None if median_depth is None else median_depth.reshape(*batch, *median_depth.shape[1:]),
        features=rest if rest.shape[-1] else None,
        num_pairs=num_pairs,
        num_overflow=num_overflow,
        num_non_finite=num_non_finite,
    )


def apply_exposures(color: Float[Array, "*b h w 3"], exposures: Float[Array, "*b 3 4"]) -> Float[Array, "*b h w 3"]:
    """RGB after each frame's affine correction, `matrix @ color + offset`, at least 0."""
    matrices = exposures[..., None, None, :, :]
    corrected = sum(matrices[..., i] * color[..., i, None] for i in range(3)) + matrices[..., 3]
    return jnp.maximum(corrected, 0.0)
