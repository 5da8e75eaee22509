"""Forms that exist only because of XLA's CPU backend. Each has the measurement behind it and says when it may go."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

LANES = 16  # 32-bit numbers that a wide processor adds at once


def lane_sum(x: Float[Array, "*s n"]) -> Float[Array, "*s"]:
    """Sum over the last axis, in up to 16 partial sums side by side.

    XLA's CPU backend vectorizes a sum over a major axis but not one over the minor, and leaves what it fuses with it
    unvectorized too.
    """
    lanes = math.gcd(x.shape[-1], LANES)
    return jnp.sum(jnp.sum(x.reshape(*x.shape[:-1], -1, lanes), axis=-2), axis=-1)


def apart(wanted: Bool[Array, ""], compute: Callable[[], Array]) -> Array:
    """`compute()` if `wanted`, else zeros: by kernels of its own, from operands that are there.

    Left to itself, XLA's CPU compiler fuses a gather with what stands around it, does it again in each kernel that
    uses it, and goes entry by entry (`lax.optimization_barrier` is gone by then). It fuses nothing across the edge of
    a branch. A loop would do as well, but first fills its result with zeros.
    """
    shape = jax.eval_shape(compute)
    return lax.cond(wanted, compute, lambda: jnp.zeros(shape.shape, shape.dtype))
