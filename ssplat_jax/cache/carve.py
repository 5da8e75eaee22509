"""Views judge what others claim: free space is carved, seen surfaces are confirmed (ours, not VACC's).

A confidence is taken as the probability that a surface is there. Every trusted cell that a pivot or a token falls on is
a witness, with the cell's own confidence w as its weight:

    sees past it    log depth before the cell's nearest surface by more than ln(1.02): odds / e^2w
    sees it         log depth within ln(1.1) of the cell's surface: odds x e^0.5w
    hidden, unseen  anything else: unchanged

Contradiction counts more than agreement: a wrong depth agrees by chance with its neighbors, but what was looked
through is not there. One witness moves a sure pivot little, several sink it below tau, where `decode` leaves it out; it
stays in the cache and can recover.

The views of a chunk judge all pivots (`carve`). One of them is kept coarsely (`bear_witness`) and judges the tokens of
later chunks before they enter (`judge`): earlier views looked through what the last chunk claims. docs/decisions.md has
what this is worth.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.cache.project import PixelPairs, blocks_of_rows, pairs_of_points, pairs_of_rows
from ssplat_jax.cache.state import Tokens, VoxelCache, Witnesses
from ssplat_jax.config import StreamConfig
from ssplat_jax.geometry.cameras import Camera
from ssplat_jax.numerics import safe_log
from ssplat_jax.pytree import replace

CONTRADICTION, AGREEMENT = 2.0, 0.5  # log odds of a witness of confidence 1
FREE_SPACE = math.log(1.02)  # what is nearer than a surface by this much is before it
SAME_SURFACE = math.log(1.1)
LOWEST, HIGHEST = 0.02, 0.95  # what judged confidences stay within: no belief is beyond revision


def carve(
    cache: VoxelCache,
    camera: Camera,
    depths: Float[Array, "v hf wf"],
    confidences: Float[Array, "v hf wf"],
    config: StreamConfig,
) -> VoxelCache:
    """`cache` with the confidences that its pivots deserve after views of `camera` saw `depths`.

    Args:
        cache: what is judged.
        camera: a batch of views at grid resolution.
        depths: camera z of what each cell sees.
        confidences: of those depths; cells below `min_confidence`, or of 0, are no witnesses.
        config: `carving=False` returns the cache as it is.

    Limits:
        Depths that are not finite or not positive are no witnesses. Pivots that no witness sees keep their confidence
        to the last bit; the others' stays in [0.02, 0.95].
    """
    if not config.memory.carving:
        return cache
    is_witness = _is_witness(depths, confidences, config)
    log_depths = safe_log(jnp.where(is_witness, depths, 1.0))
    # A cell beside an untrusted one cannot say that space is free: an edge may run between them.
    nearest = _nearest_around(jnp.where(is_witness, log_depths, -jnp.inf))
    weights = jnp.where(is_witness, confidences, 0.0)
    flat = (weights.reshape(-1), log_depths.reshape(-1), nearest.reshape(-1))
    num_rows, num_blocks = blocks_of_rows(cache)

    def judge_block(i, revised):
        block = jax.lax.dynamic_slice_in_dim(revised, i * num_rows, num_rows)
        pairs = pairs_of_rows(replace(cache, confidences=revised), camera, i * num_rows, num_rows)
        evidence = _evidence(pairs, *flat).reshape(len(camera.viewmats), *block.shape).sum(axis=0)
        return jax.lax.dynamic_update_slice_in_dim(revised, _revised(block, evidence), i * num_rows, axis=0)

    return replace(cache, confidences=jax.lax.fori_loop(0, num_blocks, judge_block, cache.confidences))


def judge(witnesses: Witnesses, tokens: Tokens, config: StreamConfig) -> Tokens:
    """`tokens` with the confidences that they deserve after what earlier chunks saw.

    Limits:
        Tokens below `min_confidence`, invalid or not finite, and those that no witness sees, keep their confidence to
        the last bit; the others' stays in [0.02, 0.95].
    """
    if not witnesses.weights.shape[0]:
        return tokens
    side = witnesses.weights.shape[-1]
    camera = Camera(viewmats=witnesses.viewmats, Ks=witnesses.Ks, width=side, height=side)
    is_judged = tokens.valid & (tokens.confidences >= config.memory.min_confidence)
    pairs = pairs_of_points(tokens.means, jnp.where(is_judged, tokens.confidences, 0.0), camera)
    log_depths = witnesses.log_depths.reshape(-1)
    evidence = _evidence(pairs, witnesses.weights.reshape(-1), log_depths, log_depths)
    evidence = evidence.reshape(len(witnesses.viewmats), -1).sum(axis=0)
    return replace(tokens, confidences=_revised(tokens.confidences, evidence))


def bear_witness(
    cache: VoxelCache,
    camera: Camera,
    depths: Float[Array, "v hf wf"],
    confidences: Float[Array, "v hf wf"],
    config: StreamConfig,
) -> VoxelCache:
    """`cache` with the view of the chunk just fused that has the most witnesses among its cells (first of equals).

    Limits:
        A chunk without a trusted cell, padding for one, is not kept, and displaces nothing.
    """
    capacity, side = cache.witnesses.weights.shape[:2]
    if not capacity:
        return cache
    is_witness = _is_witness(depths, confidences, config)
    view = jnp.argmax(is_witness.sum(axis=(1, 2)))
    seen = is_witness[view]
    log_depths = _least_of_parts(jnp.where(seen, safe_log(jnp.where(seen, depths[view], 1.0)), -jnp.inf), side)
    weights = _least_of_parts(jnp.where(seen, confidences[view], 0.0), side)
    shrink = jnp.array([side / camera.width, side / camera.height, 1.0], camera.Ks.dtype)[:, None]
    entry = Witnesses(
        viewmats=camera.viewmats[view][None],
        Ks=(camera.Ks[view] * shrink)[None],
        log_depths=jnp.where(weights > 0, log_depths, 0.0)[None],
        weights=weights[None],
    )
    place = jnp.where(seen.any(), (cache.stats.num_chunks - 1) % capacity, capacity)[None]
    kept = jax.tree.map(lambda ring, x: ring.at[place].set(x, mode="drop"), cache.witnesses, entry)
    return replace(cache, witnesses=kept)


def _is_witness(depths, confidences, config: StreamConfig) -> Bool[Array, "v hf wf"]:
    return (confidences >= config.memory.min_confidence) & (confidences > 0) & jnp.isfinite(depths) & (depths > 0)


def _nearest_around(log_depths: Float[Array, "v hf wf"]) -> Float[Array, "v hf wf"]:
    """Least of the 3 x 3 cells around each."""
    return jax.lax.reduce_window(log_depths, jnp.inf, jax.lax.min, (1, 3, 3), (1, 1, 1), "SAME")


def _least_of_parts(values: Float[Array, "hf wf"], side: int) -> Float[Array, "side side"]:
    """Least of the cells that each of `side` x `side` equal parts of the view touches."""
    for axis in (0, 1):
        values = jnp.take(values, _cells_of_parts(values.shape[axis], side), axis=axis).min(axis=axis + 1)
    return values


def _cells_of_parts(num_cells: int, side: int) -> Int[np.ndarray, "side n"]:
    """The cells that each of `side` equal parts of a line touches; short parts name their last cell again."""
    parts = np.arange(side)
    first, last = parts * num_cells // side, -(-(parts + 1) * num_cells // side) - 1
    return np.minimum(first[:, None] + np.arange((last - first).max() + 1), last[:, None])


def _evidence(pairs: PixelPairs, weights, log_depths, nearest) -> Float[Array, " p"]:
    """Log odds that each pair of view and point adds to the point."""
    read = lambda x: x.at[pairs.pixels].get(mode="fill", fill_value=0.0)  # noqa: E731
    is_past = pairs.log_depths < read(nearest) - FREE_SPACE
    is_there = jnp.abs(pairs.log_depths - read(log_depths)) <= SAME_SURFACE
    return read(weights) * jnp.where(is_past, -CONTRADICTION, jnp.where(is_there, AGREEMENT, 0.0))


def _revised(confidences, evidence):
    """Confidences after evidence in log odds; those without any are left as they are."""
    known = jnp.clip(confidences, LOWEST, HIGHEST)
    judged = jax.nn.sigmoid(safe_log(known) - safe_log(1 - known) + evidence)
    return jnp.where(evidence != 0, jnp.clip(judged, LOWEST, HIGHEST), confidences)
