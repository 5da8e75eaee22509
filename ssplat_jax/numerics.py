"""Safe primitives. Each states its limits; tests/stability/test_numerics.py holds a test for every line of them."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

LANES = 16  # 32-bit numbers that a wide processor adds at once


def safe_normalize(x: Float[Array, "*s n"], eps: float = 1e-12) -> Float[Array, "*s n"]:
    """Unit vector along `x`.

    Limits:
        |x| <= eps gives zeros, and a zero (never NaN) gradient.
        float32: length within 4 ulp of 1 for 1e-10 < max|x| < 1e30 (the vector is scaled before it is squared).
    """
    largest = jnp.max(jnp.abs(x), axis=-1, keepdims=True)
    is_zero = largest <= eps
    shimmed = jnp.where(is_zero, jnp.ones_like(x), x)
    scaled = shimmed / jnp.where(is_zero, jnp.ones_like(largest), largest)
    del shimmed
    unit = scaled / jnp.sqrt(jnp.sum(scaled * scaled, axis=-1, keepdims=True))
    return jnp.where(is_zero, jnp.zeros_like(x), unit)


def columns(x: Float[Array, "*s n"]) -> tuple[Float[Array, "*s"], ...]:
    """The `n` entries along the last axis.

    Split, not indexed: the gradient lays them side by side again. Of indices, it pads each with zeros and adds them up.
    """
    return tuple(jnp.squeeze(column, axis=-1) for column in lax.split(x, (1,) * x.shape[-1], axis=-1))


def lane_sum(x: Float[Array, "*s n"]) -> Float[Array, "*s"]:
    """Sum over the last axis, in up to 16 partial sums side by side.

    XLA's CPU backend vectorises a sum over a major axis but not one over the minor, and leaves what it fuses with it
    unvectorised too.
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


def safe_log(x: Float[Array, "*s"], eps: float = 1e-12) -> Float[Array, "*s"]:
    """Natural logarithm.

    Limits:
        x <= eps gives log(eps), with a zero gradient.
    """
    is_small = x <= eps
    return jnp.where(is_small, jnp.log(jnp.asarray(eps, x.dtype)), jnp.log(jnp.where(is_small, jnp.ones_like(x), x)))


def softplus_inverse(y: float) -> float:
    """The x with softplus(x) = y, for y > 0, in plain Python (initial values)."""
    return y + math.log(-math.expm1(-y))
