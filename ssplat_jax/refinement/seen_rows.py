"""Rows of a scene that a key view may see: a step has no effect on the others, and leaves them out.

The selection is cautious. It knows each Gaussian only as a ball around its mean, so it holds every row that the
rasterizer draws, and some that it does not.
"""

import functools
import math
from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.numerics import columns
from ssplat_jax.core.pytree import pytree
from ssplat_jax.rasterizer import constants

Rows = TypeVar("Rows")

REACH = 1.001 * math.sqrt(-2 * constants.LOG_ALPHA_MIN)
"""Standard deviations at which an opaque Gaussian falls to the faintest alpha, and a margin for rounding."""


@pytree
class SeenRows:
    """A selection of rows, in their order, at a fixed capacity of `m`."""

    rows: Int[Array, " m"]  # row numbers; 0 where there is no further row
    is_row: Bool[Array, " m"]
    num_overflow: Int[Array, ""]  # rows that found no space; they are the last ones


def may_be_seen(gaussians: Gaussians, camera: Camera) -> Bool[Array, " n"]:
    """Mask of the Gaussians that may change a pixel of one camera, without lens distortion.

    The standard deviation on the screen is at most |J| times the largest one in the scene, where J is the row of the
    projection's Jacobian, and the filter adds at most `CLASSIC_VARIANCE`.

    Limits:
        True for every row that `project` makes visible and whose box touches the image. NaN gives False.
    """
    x, y, z = (
        sum(camera.viewmats[i, j] * entry for j, entry in enumerate(columns(gaussians.means))) + camera.viewmats[i, 3]
        for i in range(3)
    )
    is_seen = (z > constants.NEAR) & (gaussians.opacities > 0)
    z = jnp.where(is_seen, z, 1.0)
    largest = jnp.max(gaussians.scales, axis=-1)
    for across, axis, size in ((x, 0, camera.width), (y, 1, camera.height)):
        focal, center = camera.Ks[axis, axis], camera.Ks[axis, 2]
        margin = constants.FRUSTUM_MARGIN * 0.5 * size / focal
        bounds = jnp.stack([-center / focal - margin, (size - center) / focal + margin])
        clamped = jnp.clip(across / z, jnp.min(bounds), jnp.max(bounds))
        spread = largest * jnp.abs(focal) * jnp.sqrt(1 + clamped * clamped) / z
        radius = REACH * jnp.sqrt(spread * spread + constants.CLASSIC_VARIANCE) + 0.1
        is_seen &= jnp.abs(focal * across / z + center - size / 2) <= size / 2 + radius
    return is_seen


def seen_in_any(gaussians: Gaussians, cameras: Sequence[Camera]) -> Bool[Array, " n"]:
    """Mask of the Gaussians that may change a pixel of at least one of some cameras."""
    return functools.reduce(jnp.logical_or, (may_be_seen(gaussians, camera) for camera in cameras))


def select_rows(is_seen: Bool[Array, " n"], max_rows: int) -> SeenRows:
    """The rows where `is_seen`, at most `max_rows` of them."""
    ends = jnp.cumsum(is_seen, dtype=jnp.int32)
    places = jnp.where(is_seen & (ends <= max_rows), ends - 1, max_rows)
    numbers = jnp.arange(is_seen.shape[0], dtype=jnp.int32)
    return SeenRows(
        rows=jnp.zeros((max_rows,), jnp.int32).at[places].set(numbers, mode="drop"),
        is_row=jnp.arange(max_rows, dtype=jnp.int32) < ends[-1],
        num_overflow=jnp.maximum(ends[-1] - max_rows, 0),
    )


def take_rows(tree: Rows, selection: SeenRows) -> Rows:
    """The selected rows of arrays `[n ...]`; row 0 where there is no further one."""
    return jax.tree.map(lambda x: x.at[selection.rows].get(mode="promise_in_bounds"), tree)


def put_rows(tree: Rows, selection: SeenRows, into: Rows) -> Rows:
    """`into` with the selected rows replaced.

    Args:
        tree: arrays `[m ...]`, the new rows in the order of `selection`.
        selection: the rows.
        into: arrays `[n ...]`.
    """
    numbers = jnp.arange(selection.rows.shape[0], dtype=jnp.int32)

    def put(x: Array, old: Array) -> Array:
        rows = jnp.where(selection.is_row, selection.rows, old.shape[0] + numbers)  # beyond the last: dropped
        return old.at[rows].set(x, mode="drop", unique_indices=True)

    return jax.tree.map(put, tree, into)
