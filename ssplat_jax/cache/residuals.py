"""Residuals: what refinement while streaming has changed in each of a pivot's Gaussians.

A pivot's residuals are one vector of `WIDTH` numbers for each of its Gaussians, one Gaussian after the other, so that
every write of the cache moves them as a single field. They are changes to what the decoder makes of the pivot. A new
pivot has zeros. Merged pivots average them with the weights of their means, colors and features, so that a merge of
two revised pivots shows the average of what they showed.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.cache.hash_table import voxel_indices
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.core.numerics import clip_value
from ssplat_jax.core.pytree import pytree

WIDTH = 14
"""Numbers for each Gaussian."""

PARTS = (slice(0, 3), slice(3, 7), slice(7, 10), 10, slice(11, 14))
"""Columns of each field of `Residuals`."""

FACE_MARGIN = 1e-3
"""Distance, in voxels, that a moved pivot keeps from the faces of its voxel: rounding cannot take an average across."""

MAX_LOG_SCALE, MAX_LOGIT, MAX_COLOR, MAX_QUAT = 1.5, 12.0, 2.0, 2.0
"""Bounds of a residual's magnitude, part by part."""


@pytree
class Residuals:
    """Changes to `n` Gaussians; all zero: none."""

    means: Float[Array, "n 3"]  # stream units
    quats: Float[Array, "n 4"]  # added to the unit quaternion
    log_scales: Float[Array, "n 3"]
    logit_opacities: Float[Array, " n"]
    colors: Float[Array, "n 3"]  # added to the color of the constant band


def empty_residuals(capacity: int, config: StreamConfig) -> Float[Array, "capacity k r"]:
    """Zero residuals of all pivots of a cache."""
    width = WIDTH * config.head.gaussians_per_token
    return jnp.zeros((capacity, config.memory.pivots_per_voxel, width))


def unpack(packed: Float[Array, "m r"]) -> Residuals:
    """The residuals of `m` pivots, pivot by pivot."""
    rows = packed.reshape(-1, WIDTH)
    means, quats, log_scales, logits, colors = (rows[:, part] for part in PARTS)
    return Residuals(means=means, quats=quats, log_scales=log_scales, logit_opacities=logits, colors=colors)


def pack(residuals: Residuals, num_pivots: int) -> Float[Array, "m r"]:
    """The inverse of `unpack`."""
    parts = (
        residuals.means,
        residuals.quats,
        residuals.log_scales,
        residuals.logit_opacities[:, None],
        residuals.colors,
    )
    return jnp.concatenate(parts, axis=1).reshape(num_pivots, -1)


def add(gaussians: Gaussians, residuals: Residuals, *, max_scale: float) -> Gaussians:
    """Gaussians of pivots with their residuals added, differentiable in both.

    Limits:
        An opacity of 0 stays 0 with a zero gradient; one of 1 counts as the largest below it. Scales end at
        `max_scale`, unless they were larger before.
    """
    is_present = gaussians.opacities > 0
    opacities = jnp.clip(jnp.where(is_present, gaussians.opacities, 0.5), 1e-5, 1 - 1e-5)
    logits = jnp.log(opacities) - jnp.log1p(-opacities) + residuals.logit_opacities
    logits = clip_value(logits, -MAX_LOGIT, MAX_LOGIT)  # a float32 opacity beyond it would have no gradient
    length = jnp.linalg.norm(gaussians.quats, axis=-1, keepdims=True)
    scales = gaussians.scales * jnp.exp(residuals.log_scales)
    return Gaussians(
        means=gaussians.means + residuals.means,
        quats=gaussians.quats / jnp.where(length > 0, length, 1.0) + residuals.quats,
        scales=jnp.minimum(scales, jnp.maximum(gaussians.scales, max_scale)),
        opacities=jnp.where(is_present, jax.nn.sigmoid(logits), 0.0),
        sh=gaussians.sh.at[:, 0].add(residuals.colors / SH_C0),
    )


def revise(gaussians: Gaussians, residuals: Residuals, *, max_scale: float) -> Gaussians:
    """`add`, but a Gaussian whose residual is 0 stays as it is, bit for bit; not differentiable there."""
    parts = [x.reshape(x.shape[0], -1) for x in jax.tree.leaves(residuals)]
    is_revised = jnp.any(jnp.concatenate(parts, axis=1) != 0, axis=1)
    keep = lambda new, old: jnp.where(is_revised.reshape(-1, *[1] * (new.ndim - 1)), new, old)  # noqa: E731
    return jax.tree.map(keep, add(gaussians, residuals, max_scale=max_scale), gaussians)


def settle(
    means: Float[Array, "m 3"], residuals: Residuals, voxel_size: float
) -> tuple[Float[Array, "m 3"], Float[Array, "m r"]]:
    """Places of pivots and packed residuals after a revision, inside their bounds.

    The part of the moves that a pivot's Gaussians share moves the pivot itself: later chunks project, carve and merge
    the revised place without knowing about residuals. The rest stays in the residuals, with a mean of 0.

    Args:
        means: places of the pivots before.
        residuals: their residuals; the moves of their Gaussians may have a common part.
        voxel_size: side of a voxel, stream units.

    Returns:
        Places of the pivots and their packed residuals.

    Limits:
        A pivot stays in its voxel, and so does the place that each of its Gaussians would move it to; averages of
        settled pivots do too. Residuals that are not finite become 0. Residuals of 0 change nothing, to the last bit.
    """
    residuals = jax.tree.map(lambda x: jnp.where(jnp.isfinite(x), x, 0.0), residuals)
    cells, _ = voxel_indices(means, voxel_size)
    faces = cells.astype(means.dtype) * voxel_size
    low = jnp.minimum(faces + FACE_MARGIN * voxel_size, means)[:, None]
    high = jnp.maximum(faces + (1 - FACE_MARGIN) * voxel_size, means)[:, None]
    places = jnp.clip(means[:, None] + residuals.means.reshape(len(means), -1, 3), low, high)
    moved = means + jnp.mean(places - means[:, None], axis=1)  # `means` itself where nothing has moved
    is_inside = jnp.all(voxel_indices(moved, voxel_size)[0] == cells, axis=1, keepdims=True)
    moved = jnp.where(is_inside, moved, means)  # far from the origin, rounding is coarser than the margin
    bounded = Residuals(
        means=(places - moved[:, None]).reshape(-1, 3),
        quats=jnp.clip(residuals.quats, -MAX_QUAT, MAX_QUAT),
        log_scales=jnp.clip(residuals.log_scales, -MAX_LOG_SCALE, MAX_LOG_SCALE),
        logit_opacities=jnp.clip(residuals.logit_opacities, -MAX_LOGIT, MAX_LOGIT),
        colors=jnp.clip(residuals.colors, -MAX_COLOR, MAX_COLOR),
    )
    return moved, pack(bounded, len(means))
