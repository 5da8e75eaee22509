"""Numerically safe primitives. tests/stability/test_numerics.py tests every line of their limits."""

import functools
import math
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

Function = TypeVar("Function", bound=Callable[..., Any])


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

    They are split, not indexed: the gradient of a split is a concatenation, that of an index an array padded with
    zeros, `n` of which are then added.
    """
    return tuple(jnp.squeeze(column, axis=-1) for column in lax.split(x, (1,) * x.shape[-1], axis=-1))


def safe_log(x: Float[Array, "*s"], eps: float = 1e-12) -> Float[Array, "*s"]:
    """Natural logarithm.

    Limits:
        x <= eps gives log(eps), with a zero gradient.
    """
    is_small = x <= eps
    return jnp.where(is_small, jnp.log(jnp.asarray(eps, x.dtype)), jnp.log(jnp.where(is_small, jnp.ones_like(x), x)))


def safe_sqrt(x: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Square root.

    Limits:
        x <= 0 gives 0, with a zero gradient.
    """
    is_small = x <= 0
    return jnp.where(is_small, jnp.zeros_like(x), jnp.sqrt(jnp.where(is_small, jnp.ones_like(x), x)))


def clip_value(x: Float[Array, "*s"], low: float, high: float) -> Float[Array, "*s"]:
    """`x` clipped to [low, high], with the gradient of the identity.

    Limits:
        Beyond the bounds the gradient is 1 too: descent can come back. Inside, the value is `x` bit for bit.
    """
    return x + lax.stop_gradient(jnp.clip(x, low, high) - x)


def softplus_inverse(y: float) -> float:
    """The x with softplus(x) = y, for y > 0, in plain Python; for initial values."""
    return y + math.log(-math.expm1(-y))


def with_rank_promotion(function: Function) -> Function:
    """`function`, which broadcasts whatever `jax_numpy_rank_promotion` says to its caller's own code."""

    @functools.wraps(function)
    def promoting(*arguments, **options):
        with jax.numpy_rank_promotion("allow"):
            return function(*arguments, **options)

    return promoting  # pyright: ignore[reportReturnType]
