"""Rows of opacity 0 stay out of refinement: a stream's scene has space for more Gaussians than it holds."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from ssplat_jax.core.gaussians import Gaussians, with_sh_degree
from ssplat_jax.core.pytree import replace

MIN_ROWS = 1 << 12
"""Capacities for rows are multiples of this, or of a 32nd of a larger power of two: few programs are compiled."""


def round_rows(num_rows: int) -> int:
    """The capacity for a number of rows, at most a sixteenth above it where there are many."""
    unit = max(MIN_ROWS, (1 << max(num_rows - 1, 0).bit_length()) // 32)
    return max(unit, unit * -(-num_rows // unit))


def present_rows(gaussians: Gaussians) -> Int[np.ndarray, " m"] | None:
    """Numbers of the present rows; None if there is hardly another, so that nothing is left out."""
    rows = np.flatnonzero(np.asarray(gaussians.opacities) > 0)
    return rows if round_rows(len(rows)) < gaussians.num_gaussians else None


def only_present(gaussians: Gaussians, rows: Int[np.ndarray, " m"] | None) -> Gaussians:
    """The rows of `present_rows` in their order, and absent ones up to the capacity for them."""
    if rows is None:
        return gaussians
    padded = np.zeros(round_rows(len(rows)), np.int32)
    padded[: len(rows)] = rows
    taken = jax.tree.map(lambda x: x[padded], gaussians)
    return replace(taken, opacities=jnp.where(np.arange(len(padded)) < len(rows), taken.opacities, 0.0))


def present_and_new(gaussians: Gaussians, new: Gaussians, num_new: int) -> tuple[Gaussians, Int[np.ndarray, " m"]]:
    """The present rows of `gaussians`, then the first `num_new` of `new`, and absent ones up to the capacity for them.

    Returns:
        The scene, and the numbers of its rows in `gaussians`. New rows take the places of absent ones; those that find
        none come after its last row.
    """
    is_present = np.asarray(gaussians.opacities) > 0
    rows, num_given = np.flatnonzero(is_present), len(is_present)
    places = np.concatenate([np.flatnonzero(~is_present), num_given + np.arange(num_new)])[:num_new]
    num_absent = round_rows(len(rows) + num_new) - len(rows) - num_new

    def join(given: jax.Array, added: jax.Array) -> jax.Array:
        absent = jnp.zeros((num_absent, *given.shape[1:]), given.dtype)
        return jnp.concatenate([given[rows], added[:num_new], absent])

    return jax.tree.map(join, gaussians, new), np.concatenate([rows, places])


def back_in_place(present: Gaussians, rows: Int[np.ndarray, " m"] | None, gaussians: Gaussians) -> Gaussians:
    """`gaussians` with the rows of `present_rows` replaced by the first ones of `present`, at its SH degree and dtype.

    It grows where `rows` has numbers beyond its last row.
    """
    if rows is None:
        return present
    gaussians = with_sh_degree(gaussians, present.sh_degree)
    num_missing = max(int(rows.max(initial=-1)) + 1 - gaussians.num_gaussians, 0)
    padded = lambda x: jnp.pad(x, ((0, num_missing), *[(0, 0)] * (x.ndim - 1)))  # noqa: E731
    put = lambda x, new: padded(x).astype(new.dtype).at[rows].set(new[: len(rows)])  # noqa: E731
    return jax.tree.map(put, gaussians, present)
