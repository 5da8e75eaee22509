"""Later views judge what the cache remembers: free space is carved, seen surfaces are confirmed (ours, not VACC's).

A pivot's confidence is taken as the probability that a surface is there. Every trusted cell of a new view that the
pivot falls on is a witness, with the cell's own confidence as its weight:

    sees past it    log depth before the nearest surface of the 3 x 3 cells by more than ln(cluster_ratio): odds / e^2w
    sees it         log depth within ln(1.1) of the cell's surface: odds x e^0.5w
    hidden, unseen  anything else: unchanged

Contradiction counts more than agreement: a wrong depth agrees by chance with its neighbours, but what was looked
through is not there. One witness moves a sure pivot little, several sink it below tau, where `decode` leaves it out; it
stays in the cache and can recover. docs/decisions.md has what this is worth.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.cache.project import PivotPairs, blocks_of_rows, pairs_of_rows
from ssplat_jax.cache.state import VoxelCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.geometry.cameras import Camera
from ssplat_jax.numerics import safe_log
from ssplat_jax.struct import replace

CONTRADICTION, AGREEMENT = 2.0, 0.5  # log odds of a witness of confidence 1
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
    if not config.carving:
        return cache
    is_witness = (confidences >= config.min_confidence) & (confidences > 0) & jnp.isfinite(depths) & (depths > 0)
    log_depths = safe_log(jnp.where(is_witness, depths, 1.0))
    # A cell beside an untrusted one cannot say that space is free: an edge may run between them.
    nearest = _nearest_around(jnp.where(is_witness, log_depths, -jnp.inf))
    weights = jnp.where(is_witness, confidences, 0.0)
    flat = (weights.reshape(-1), log_depths.reshape(-1), nearest.reshape(-1))
    num_rows, num_blocks = blocks_of_rows(cache)

    def judge(i, revised):
        block = jax.lax.dynamic_slice_in_dim(revised, i * num_rows, num_rows)
        pairs = pairs_of_rows(replace(cache, confidences=revised), camera, i * num_rows, num_rows)
        evidence = _evidence(pairs, *flat, config)
        evidence = evidence.reshape(len(camera.viewmats), *block.shape).sum(axis=0)
        known = jnp.clip(block, LOWEST, HIGHEST)
        judged = jax.nn.sigmoid(safe_log(known) - safe_log(1 - known) + evidence)
        block = jnp.where(evidence != 0, jnp.clip(judged, LOWEST, HIGHEST), block)
        return jax.lax.dynamic_update_slice_in_dim(revised, block, i * num_rows, axis=0)

    return replace(cache, confidences=jax.lax.fori_loop(0, num_blocks, judge, cache.confidences))


def _nearest_around(log_depths: Float[Array, "v hf wf"]) -> Float[Array, "v hf wf"]:
    """Least of the 3 x 3 cells around each."""
    return jax.lax.reduce_window(log_depths, jnp.inf, jax.lax.min, (1, 3, 3), (1, 1, 1), "SAME")


def _evidence(pairs: PivotPairs, weights, log_depths, nearest, config: StreamConfig) -> Float[Array, " p"]:
    """Log odds that each pair of view and pivot adds to the pivot."""
    read = lambda x: x.at[pairs.pixels].get(mode="fill", fill_value=0.0)  # noqa: E731
    is_past = pairs.log_depths < read(nearest) - math.log(config.cluster_ratio)
    is_there = jnp.abs(pairs.log_depths - read(log_depths)) <= SAME_SURFACE
    return read(weights) * jnp.where(is_past, -CONTRADICTION, jnp.where(is_there, AGREEMENT, 0.0))
