"""`VoxelCache`: the stream's only memory, a pytree of fixed size (Sec. 3.4, VACC)."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.cache.hash_table import SLOTS_PER_ROW
from ssplat_jax.cache.key_views import NUM_KEY_VIEWS, KeyViews, empty_key_views
from ssplat_jax.cache.residuals import empty_residuals
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.pytree import pytree, replace


def saturating_add(counter: Int[Array, ""], more: Int[Array, ""]) -> Int[Array, ""]:
    """`counter + more` for numbers that are not negative; stops at the largest integer instead of overflowing."""
    return counter + jnp.minimum(more, jnp.iinfo(counter.dtype).max - counter)


@pytree
class CacheStats:
    """Counters over the whole stream, to be read outside jit (`check_cache`).

    They stop at 2^31 - 1 (`saturating_add`), which tokens of 4 views at 1080p reach after 4000 chunks.
    """

    num_chunks: Int[Array, ""]
    num_seen: Int[Array, ""]  # tokens of valid views offered to the cache
    num_accepted: Int[Array, ""]  # appended or merged
    num_merged: Int[Array, ""]  # accepted by a merge, which leaves the number of pivots unchanged
    num_low_confidence: Int[Array, ""]  # rejected: below tau_conf, as predicted or after `judge`
    num_non_finite: Int[Array, ""]  # rejected: NaN or infinite
    num_out_of_range: Int[Array, ""]  # rejected: voxel index outside +-2^20
    num_dropped: Int[Array, ""]  # rejected: no free row for a new voxel (overflow)


@pytree
class Witnesses:
    """Coarse depth maps of one view from each of the last `w` chunks, against which later tokens are judged.

    A ring buffer: chunk `n` writes entry `n % w`. A coarse cell holds its nearest surface if all fine cells in it were
    trusted.
    """

    viewmats: Float[Array, "w 4 4"]
    Ks: Float[Array, "w 3 3"]  # in units of the coarse cells
    log_depths: Float[Array, "w g g"]
    weights: Float[Array, "w g g"]  # lowest confidence in the coarse cell; 0 if not all of it was trusted


@pytree
class VoxelCache:
    """Up to `capacity` voxels of up to `k` pivots each.

    Rows are dense: rows 0 .. num_voxels-1 are occupied, in order of their first token, and the first `counts` pivots
    of a row are alive. Dead pivots hold zeros. `table` is an open-addressing hash table from voxel index to row,
    verified against `voxels`.
    """

    # Voxels.
    voxels: Int[Array, "capacity 3"]  # floor(mean / voxel_size)
    counts: Int[Array, " capacity"]  # alive pivots, 0 .. k
    num_voxels: Int[Array, ""]
    table: Int[Array, " slots"]  # row of the voxel hashed here, -1 where empty (hash_table.py)
    # Pivots.
    means: Float[Array, "capacity k 3"]  # stream frame
    feats: Float[Array, "capacity k c"]  # the token state f
    seeds: Float[Array, "capacity k c"]  # feature of the most confident member, for matching
    confidences: Float[Array, "capacity k"]  # omega, (0, 1]
    rgbs: Float[Array, "capacity k a"]  # appearance anchor: mean colors of the parts of the token's patch
    quats: Float[Array, "capacity k 4"]  # camera-to-world orientation of the most confident member, wxyz
    footprints: Float[Array, "capacity k"]  # width of a grid cell at the most confident member, stream units
    num_members: Int[Array, "capacity k"]  # tokens merged into the pivot
    last_chunks: Int[Array, "capacity k"]  # chunk that last wrote the pivot
    witnesses: Witnesses
    stats: CacheStats
    sightings: Float[Array, "capacity k s"] | None = None  # what views say about the pivot (sightings.py); sums
    # Fields of refinement while streaming; None without it, so that the program has no trace of them.
    residuals: Float[Array, "capacity k r"] | None = None  # changes to each of the pivot's Gaussians (residuals.py)
    key_views: KeyViews | None = None  # views that the scene is compared with; None before the first chunk

    @property
    def alive(self) -> Bool[Array, "capacity k"]:
        """Mask of the pivots that exist."""
        return jnp.arange(self.means.shape[1]) < self.counts[:, None]

    @property
    def capacity(self) -> int:
        """Number of voxels that the cache can hold."""
        return self.voxels.shape[0]


PIVOT_FIELDS = (
    "means",
    "feats",
    "seeds",
    "confidences",
    "rgbs",
    "quats",
    "footprints",
    "num_members",
    "last_chunks",
)
"""Fields of every `VoxelCache` with one entry per pivot, `[capacity, k, ...]`."""

NUM_SIGHTINGS = 9
"""Numbers that a pivot's sightings hold (`sightings.py`)."""

OPTIONAL_PIVOT_FIELDS = ("sightings", "residuals")
"""Further such fields, None where the configuration does not ask for them."""


def pivot_fields(cache: VoxelCache) -> tuple[str, ...]:
    """Names of the pivot fields that `cache` has: `PIVOT_FIELDS`, and those of `OPTIONAL_PIVOT_FIELDS` in use."""
    return (*PIVOT_FIELDS, *(name for name in OPTIONAL_PIVOT_FIELDS if getattr(cache, name) is not None))


@pytree
class Tokens:
    """`m` tokens to be fused, in order of insertion (view-major, row-major)."""

    means: Float[Array, "m 3"]
    feats: Float[Array, "m c"]
    confidences: Float[Array, " m"]
    rgbs: Float[Array, "m a"]  # appearance anchor: the color of each of the token's Gaussians, row-major in the cell
    quats: Float[Array, "m 4"]  # orientation of the camera that saw the token, camera-to-world, wxyz
    footprints: Float[Array, " m"]
    valid: Bool[Array, " m"]  # False for padding, which is neither used nor counted


WITNESS_CELLS = 32
"""Coarse cells of a witness along each side of its view."""


NUM_WITNESSES = 32
"""Past chunks of which a coarse depth map is kept, to judge the tokens of later chunks while views carve."""


def init_witnesses(config: StreamConfig) -> Witnesses:
    """Empty witnesses; none without carving."""
    w = NUM_WITNESSES if config.memory.carving else 0
    cells = (w, WITNESS_CELLS, WITNESS_CELLS)
    return Witnesses(
        viewmats=jnp.zeros((w, 4, 4)),
        Ks=jnp.zeros((w, 3, 3)),
        log_depths=jnp.zeros(cells),
        weights=jnp.zeros(cells),
    )


def require_single_cache(cache: VoxelCache, caller: str) -> None:
    """Raises if `cache` has leading axes, of streams or shards; the message names `caller`.

    Raises:
        InputError: `cache` holds several caches.
    """
    if shape := cache.num_voxels.shape:
        raise InputError(
            f"{caller}: wanted the cache of one stream on one device, got caches of shape {list(shape)}; take one at a"
            f" time, jax.tree.map(lambda x: x[{', '.join('0' * len(shape))}], caches)."
        )


def init_cache(config: StreamConfig, capacity: int | None = None) -> VoxelCache:
    """An empty cache of `capacity` voxels (default: the config's).

    Raises:
        InputError: `capacity` is no power of two, which the bit masks of the hash table need.
    """
    capacity = config.memory.capacity if capacity is None else capacity
    if capacity < 1 or capacity & (capacity - 1):
        raise InputError(f"cache: capacity must be a power of two, got {capacity}.")
    k, c = config.memory.pivots_per_voxel, config.network.token_width
    zero = lambda: jnp.zeros((), jnp.int32)  # noqa: E731 - one fresh buffer per counter, so that all can be donated
    return VoxelCache(
        voxels=jnp.zeros((capacity, 3), jnp.int32),
        counts=jnp.zeros((capacity,), jnp.int32),
        num_voxels=zero(),
        table=jnp.full((SLOTS_PER_ROW * capacity,), -1, jnp.int32),
        means=jnp.zeros((capacity, k, 3)),
        feats=jnp.zeros((capacity, k, c)),
        seeds=jnp.zeros((capacity, k, c)),
        confidences=jnp.zeros((capacity, k)),
        rgbs=jnp.zeros((capacity, k, 3 * config.head.gaussians_per_token)),
        quats=jnp.zeros((capacity, k, 4)),
        footprints=jnp.zeros((capacity, k)),
        num_members=jnp.zeros((capacity, k), jnp.int32),
        last_chunks=jnp.zeros((capacity, k), jnp.int32),
        witnesses=init_witnesses(config),
        stats=CacheStats(*(zero() for _ in range(8))),
        sightings=jnp.zeros((capacity, k, NUM_SIGHTINGS)) if config.head.evidence else None,
        residuals=empty_residuals(capacity, config) if config.stream.steps_per_chunk else None,
    )


def with_refinement(cache: VoxelCache, config: StreamConfig, height: int, width: int) -> VoxelCache:
    """`cache` with residuals and empty key views for images of one size, where it has none yet.

    Raises:
        InputError: it has key views of another size or number.
    """
    slots = (NUM_KEY_VIEWS, height, width, 3)
    residuals, key_views = cache.residuals, cache.key_views
    if residuals is None:
        residuals = empty_residuals(cache.capacity, config)
    if key_views is None:
        key_views = empty_key_views(*slots[:3])
    if key_views.images.shape != slots:
        wanted, got = "x".join(map(str, key_views.images.shape)), "x".join(map(str, slots))
        raise InputError(f"cache: wanted key views of {wanted} as before, got {got}; keep the size.")
    return replace(cache, residuals=residuals, key_views=key_views)
