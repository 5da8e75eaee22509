"""Rows of a scene that a key view may see: gradients of the others are zero, and are not computed.

The selection is cautious. It knows each Gaussian only as a ball around its mean, so it holds every row that the
rasterizer draws, and some that it does not.
"""

import math
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ssplat_jax.gaussians import Gaussians
from ssplat_jax.geometry.cameras import Camera
from ssplat_jax.numerics import columns
from ssplat_jax.pytree import pytree
from ssplat_jax.rasterizer import constants

Rows = TypeVar("Rows")

REACH = 1.001 * math.sqrt(-2 * constants.LOG_ALPHA_MIN)
"""Standard deviations at which an opaque Gaussian falls to the faintest alpha, and a margin for rounding."""


@pytree
class SeenRows:
    """A selection of rows, in their order, at a fixed capacity of `m`."""

    rows: Int[Array, " m"]  # row numbers; 0 where there is no further row
    is_row: Bool[Array, " m"]
    places: Int[Array, " n"]  # of each selected row among `rows`; 0 for the others
    is_seen: Bool[Array, " n"]  # the selected rows
    num_overflow: Int[Array, ""]  # rows that found no space; they are the last ones


def seen_rows(gaussians: Gaussians, camera: Camera, max_rows: int) -> SeenRows:
    """The rows that one camera may see, at most `max_rows` of them."""
    return select_rows(may_be_seen(gaussians, camera), max_rows)


def may_be_seen(gaussians: Gaussians, camera: Camera) -> Bool[Array, " n"]:
    """Whether a Gaussian may change a pixel of one camera, without lens distortion.

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


def select_rows(is_seen: Bool[Array, " n"], max_rows: int) -> SeenRows:
    """The rows where `is_seen`, at most `max_rows` of them."""
    ends = jnp.cumsum(is_seen, dtype=jnp.int32)
    num_seen = ends[-1]
    is_seen = is_seen & (ends <= max_rows)
    places = jnp.where(is_seen, ends - 1, 0)
    numbers = jnp.arange(is_seen.shape[0], dtype=jnp.int32)
    rows = jnp.zeros((max_rows,), jnp.int32)
    rows = rows.at[jnp.where(is_seen, places, max_rows)].set(numbers, mode="drop")
    return SeenRows(
        rows=rows,
        is_row=jnp.arange(max_rows, dtype=jnp.int32) < num_seen,
        places=places,
        is_seen=is_seen,
        num_overflow=jnp.maximum(num_seen - max_rows, 0),
    )


def take_rows(tree: Rows, selection: SeenRows) -> Rows:
    """The selected rows of arrays `[n ...]`; row 0 where there is no further one."""
    return jax.tree.map(lambda x: x.at[selection.rows].get(mode="promise_in_bounds"), tree)


def put_rows(tree: Rows, selection: SeenRows) -> Rows:
    """Arrays `[m ...]` of selected rows at their places among all rows `[n ...]`, zeros elsewhere."""

    def put(x: Array) -> Array:
        found = x.at[selection.places].get(mode="promise_in_bounds")
        return jnp.where(selection.is_seen.reshape(-1, *[1] * (x.ndim - 1)), found, 0)

    return jax.tree.map(put, tree)
