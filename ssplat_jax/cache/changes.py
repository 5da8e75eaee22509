"""`Change`: what refinement has changed in Gaussians, and how a cache keeps the changes to its pivots.

A finished scene is refined by one `Change` beside it. While streaming, the cache keeps a packed change for each pivot:
`WIDTH` numbers for each of its Gaussians, so that every write of the cache moves them as a single field. They change
what the decoder makes of the pivot. A new pivot has zeros. Merged pivots average theirs with the weights of their
means, colors and features, so that a merge of two changed pivots shows the average of what they showed.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.cache.hash_table import voxel_indices, voxel_sides
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.core.numerics import clip_value
from ssplat_jax.core.pytree import pytree, replace

WIDTH = 14  # numbers for each Gaussian of a pivot

FACE_MARGIN = 1e-3
"""Distance, in voxels, that a moved pivot keeps from the faces of its voxel: rounding cannot take an average across."""

MAX_LOGIT = 12.0
"""Bound of opacity logits and of their changes: beyond it a float32 opacity is 0 or 1 and its gradient is lost."""

BOUNDS = {"quats": 2.0, "log_scales": 1.5, "logit_opacities": MAX_LOGIT, "sh": 2.0 / SH_C0}
"""Largest magnitude of each part of a pivot's change."""


@pytree
class Change:
    """Changes to `n` Gaussians, all zero at the start. Also the form of gradients and moments."""

    means: Float[Array, "n 3"]  # scene units
    quats: Float[Array, "n 4"]  # added to the unit quaternion
    log_scales: Float[Array, "n 3"]
    logit_opacities: Float[Array, " n"]
    sh: Float[Array, "n k 3"]  # of the first k bands


def no_change(gaussians: Gaussians) -> Change:
    """The change of `gaussians` that changes nothing."""
    parts = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    return Change(*map(jnp.zeros_like, parts))


def apply_change(start: Gaussians, change: Change, *, max_scale: float = math.inf) -> Gaussians:
    """`start` with a change added, differentiable in both.

    Limits:
        An opacity of 0 stays 0 with a zero gradient; one of 1 counts as the largest below it. No other gradient of an
        opacity is 0. Scales end at `max_scale`, unless they were larger before.
    """
    is_present = start.opacities > 0
    opacities = jnp.clip(jnp.where(is_present, start.opacities, 0.5), 1e-5, 1 - 1e-5)
    logits = jnp.log(opacities) - jnp.log1p(-opacities) + change.logit_opacities
    logits = clip_value(logits, -MAX_LOGIT, MAX_LOGIT)
    length = jnp.linalg.norm(start.quats, axis=-1, keepdims=True)
    scales = start.scales * jnp.exp(change.log_scales)
    return replace(
        start,
        means=start.means + change.means,
        quats=start.quats / jnp.where(length > 0, length, 1.0) + change.quats,
        scales=scales if max_scale == math.inf else jnp.minimum(scales, jnp.maximum(start.scales, max_scale)),
        opacities=jnp.where(is_present, jax.nn.sigmoid(logits), 0.0),
        sh=start.sh.at[:, : change.sh.shape[1]].add(change.sh),
    )


def changed_gaussians(start: Gaussians, change: Change, *, max_scale: float = math.inf) -> Gaussians:
    """`apply_change`, but absent Gaussians and those whose change is 0 stay as they are, bit for bit.

    Not differentiable where the change is 0.
    """
    parts = [x.reshape(x.shape[0], -1) for x in jax.tree.leaves(change)]
    is_changed: Bool[Array, " n"] = jnp.any(jnp.concatenate(parts, axis=1) != 0, axis=1) & (start.opacities > 0)
    keep = lambda new, old: jnp.where(is_changed.reshape(-1, *[1] * (new.ndim - 1)), new, old)  # noqa: E731
    return jax.tree.map(keep, apply_change(start, change, max_scale=max_scale), start)


def empty_changes(capacity: int, config: StreamConfig) -> Float[Array, "capacity k r"]:
    """Changes of zero for all pivots of a cache."""
    return jnp.zeros((capacity, config.memory.pivots_per_voxel, WIDTH * config.head.gaussians_per_token))


def unpack(packed: Float[Array, "m r"]) -> Change:
    """The change to the Gaussians of `m` pivots, pivot by pivot."""
    means, quats, log_scales, logits, sh = jnp.split(packed.reshape(-1, WIDTH), (3, 7, 10, 11), axis=1)
    return Change(means=means, quats=quats, log_scales=log_scales, logit_opacities=logits[:, 0], sh=sh[:, None])


def pack(change: Change, num_pivots: int) -> Float[Array, "m r"]:
    """The inverse of `unpack`."""
    parts = (change.means, change.quats, change.log_scales, change.logit_opacities[:, None], change.sh[:, 0])
    return jnp.concatenate(parts, axis=1).reshape(num_pivots, -1)


def settle(
    means: Float[Array, "m 3"], footprints: Float[Array, " m"], change: Change, config: StreamConfig
) -> tuple[Float[Array, "m 3"], Float[Array, "m r"]]:
    """Places of pivots and their packed changes after a step of refinement, inside their bounds.

    The part of the moves that a pivot's Gaussians share moves the pivot itself: later chunks project, carve and merge
    the new place without knowing about changes. The rest stays in the change, with a mean of 0.

    Args:
        means: places of the pivots before.
        footprints: their footprints, which decide how large their voxels are.
        change: the change to their Gaussians, whose moves may have a common part.
        config: sizes of the voxels.

    Returns:
        Places of the pivots and their packed changes.

    Limits:
        A pivot stays in its voxel, and so does the place that each of its Gaussians would move it to; averages of
        settled pivots do too, since a box holds the averages of its points. A change that is not finite becomes 0. A
        change of 0 changes nothing, to the last bit.
    """
    change = jax.tree.map(lambda x: jnp.where(jnp.isfinite(x), x, 0.0), change)
    voxels, _ = voxel_indices(means, footprints, config)
    sides = voxel_sides(footprints, config)[:, None]
    faces = voxels[:, :3].astype(means.dtype) * sides
    low = jnp.minimum(faces + FACE_MARGIN * sides, means)[:, None]
    high = jnp.maximum(faces + (1 - FACE_MARGIN) * sides, means)[:, None]
    places = jnp.clip(means[:, None] + change.means.reshape(len(means), -1, 3), low, high)
    moved = means + jnp.mean(places - means[:, None], axis=1)  # `means` itself where nothing has moved
    is_inside = jnp.all(voxel_indices(moved, footprints, config)[0] == voxels, axis=1, keepdims=True)
    moved = jnp.where(is_inside, moved, means)  # far from the origin, rounding is coarser than the margin
    inside = {name: jnp.clip(getattr(change, name), -bound, bound) for name, bound in BOUNDS.items()}
    return moved, pack(Change(means=(places - moved[:, None]).reshape(-1, 3), **inside), len(means))
