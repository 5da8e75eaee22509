"""Code that exists only for XLA's CPU backend: memory maps of the process, and forms of arithmetic.

Each form has its measurement and when it may go, with jax 0.10.1 on two CPU cores. Two more stand where they are used:
the kernel gradient in `model/layers.py`, and sort keys packed into one integer (`rasterizer/binning.py`,
`cache/fuse.py`).
"""

import functools
import gc
import math
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt

from ssplat_jax.core.kept_programs import drop_loaded

Arrays = TypeVar("Arrays")

LANES = 16  # 32-bit numbers that a wide processor adds at once (AVX-512)

SORT_PIECES = 16
"""Arrays to sort side by side: the CPU runtime shares out work among cores from nine waiting operations on."""

EXP_SQUARINGS = 3  # times that `short_exp` squares its polynomial, which covers a 2^3th of the range
MAPS = Path("/proc/self/maps")  # file with a line for each memory map of the process, where the system has one

MOST_MAPS = 25_000
"""Memory maps above which programs are dropped. A compiled program takes some tens of them, a scene that is streamed,
refined and scored thousands, and Linux ends a process that has 65,530 (`vm.max_map_count`)."""


def make_room(*forget: Callable[[], None]) -> None:
    """Drops compiled programs if the process has more than `MOST_MAPS` memory maps, where the system lists them.

    Call it between scenes when one process handles many of them. A dropped program is compiled again, or read from
    JAX's compilation cache, at its next call. A `Session` keeps its compiled programs: delete the last one first.

    Args:
        forget: called before, to drop what else keeps programs.
    """
    if MAPS.exists() and len(MAPS.read_text().splitlines()) > MOST_MAPS:
        for drop in forget:
            drop()
        drop_programs()


def drop_programs() -> None:
    """Drops all compiled programs but those of sessions that are still in use."""
    jax.clear_caches()
    drop_loaded()
    gc.collect()


def by_platform(*, cpu: Callable[[], Arrays], other: Callable[[], Arrays]) -> Arrays:
    """`cpu()` in programs for a CPU, `other()` in those for other platforms.

    In a process without another platform, only the form for a CPU is traced: both would take half as long again for a
    render with its gradient. A program that such a process exports for a GPU has it too.
    """
    return cpu() if jax.default_backend() == "cpu" else lax.platform_dependent(cpu=cpu, default=other)


def lane_sum(x: Float[Array, "*s n"]) -> Float[Array, "*s"]:
    """Sum over the last axis, in up to 16 partial sums side by side.

    Why: XLA's CPU backend vectorizes a sum over a major axis but not one over the minor, and leaves what it fuses with
    it unvectorized too. The plane sweep takes 2.4 and 4.6 ms at its two scales, where an einsum of gathered samples
    took 19 and 20; attention to a few own keys takes 3 ms instead of 13.
    May go when `jnp.sum(x, axis=-1)` is as fast there.
    """
    lanes = math.gcd(x.shape[-1], LANES)
    return jnp.sum(jnp.sum(x.reshape(*x.shape[:-1], -1, lanes), axis=-2), axis=-1)


def in_own_kernel(wanted: Bool[Array, ""], compute: Callable[[], Array]) -> Array:
    """`compute()` where `wanted` is true, else zeros; XLA's CPU backend does not fuse it with the operations around it.

    Why: the CPU compiler fuses a gather with every kernel that uses it, and each repeats it entry by entry
    (`lax.optimization_barrier` is removed before that). It does not fuse across the edge of a `lax.cond`. A loop
    would do as well, but XLA first fills its result with zeros. At 262,144 Gaussians, compositing takes 200 ms instead
    of 350.
    May go when `ssplat bench render` is as fast with a plain `compute()`. Where `wanted` is always true, it must be a
    value that the compiler does not know.
    On other backends it is a select, since a branch makes a GPU wait for the host: `compute` must have finite gradients
    there.
    """
    shape = jax.eval_shape(compute)
    zero = jnp.zeros((), shape.dtype)
    return by_platform(
        cpu=lambda: lax.cond(wanted, compute, lambda: jnp.zeros(shape.shape, shape.dtype)),
        other=lambda: jnp.where(wanted, compute(), zero),
    )


def kept(arrays: Arrays, always: Bool[Array, ""]) -> Arrays:
    """`arrays`, which XLA then computes once, though several kernels read them.

    Why: the CPU compiler repeats sums and products, with all that leads to them, in every kernel that reads them. A
    division it does not repeat, so they are divided by a one that it does not know. The gradient of the projection of
    262,144 Gaussians takes 44 ms of a core's time instead of 153.
    May go when `ssplat bench refine` is as fast without.

    Args:
        arrays: any pytree of floats.
        always: true, which the compiler does not know; where it is false, the arrays are halved.
    """
    one = jnp.where(always, 1.0, 2.0)
    return jax.tree.map(lambda x: x / one.astype(x.dtype), arrays)


def packed_argsort(keys: UInt[Array, " n"]) -> Int[Array, " n"]:
    """The order of 32-bit keys, ties by place.

    Why: a key and its place are one 64-bit integer, whatever `jax_enable_x64` says. XLA's CPU backend sorts single
    integers five times as fast as pairs: 65,536 in 3.1 ms, where an argsort of floats takes 18.5.
    May go when `jnp.argsort` is as fast.
    """
    with jax.enable_x64(True):
        packed = (keys.astype(jnp.uint64) << jnp.uint64(32)) | lax.iota(jnp.uint64, keys.shape[0])
        return (lax.sort(packed) & jnp.uint64(0xFFFFFFFF)).astype(jnp.int32)


def sort_pieces(keys: UInt[Array, "s n"]) -> UInt[Array, "s n"]:
    """Each row sorted, by an operation of its own.

    Why: the CPU runtime sorts one array on one core, but several arrays on all cores. 1.3 million keys in
    `SORT_PIECES` rows take 50 ms instead of 113.
    May go when one sort runs on all cores: sort the keys as one array, then.
    """
    return jnp.stack([lax.sort(piece) for piece in keys])


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def short_exp(x: Float[Array, "*s"], low: float) -> Float[Array, "*s"]:
    """e^x for x from `low` to 0 to a relative 3e-6 (float64: exactly), and 0 for minus infinity.

    Why: on a short range, a polynomial of an eighth of x and three squarings take two thirds of the time of XLA's
    exponential, and compositing 0.86 of its time (`low` = log(1/255)). It ends in a division because
    the CPU compiler keeps the result of one, as it does for an exponential: otherwise every kernel that reads the
    result would compute it again.
    May go when `jnp.exp` is as fast.
    """
    if x.dtype == jnp.float64:
        return jnp.exp(x)
    coefficients = _growth_coefficients(low)
    fraction = x * (-1.0 / 2**EXP_SQUARINGS)
    growth = jnp.asarray(coefficients[-1], x.dtype)
    for coefficient in coefficients[-2::-1]:
        growth = growth * fraction + float(coefficient)
    for _ in range(EXP_SQUARINGS):
        growth = growth * growth
    return 1.0 / growth


@short_exp.defjvp
def _short_exp_jvp(low: float, primals, tangents):
    """The exponential is its own derivative; that of the polynomial is infinity times zero at minus infinity."""
    value = short_exp(primals[0], low)
    return value, value * tangents[0]


@functools.cache
def _growth_coefficients(low: float) -> np.ndarray:
    """Polynomial of degree 5 for e^y on [0, -low / 2^EXP_SQUARINGS], lowest power first."""
    chebyshev = np.polynomial.Chebyshev.interpolate(np.exp, 5, [0.0, -low / 2**EXP_SQUARINGS])
    return chebyshev.convert(kind=np.polynomial.Polynomial).coef
