"""`VoxelCache`: the stream's only memory, a pytree of fixed size (Sec. 3.4, VACC), and how it grows between steps.

When the cache is full, `config.memory.overflow` decides:

    grow      the host doubles the capacity before a step that might not fit (`ensure_capacity`)
    drop_new  tokens that open a new voxel are dropped and counted

Nothing raises inside jit: losses are counted in `cache.stats`, and `check_cache` reads the counters on the host:

    cache = ensure_capacity(cache, config, num_new_tokens)
    cache, out = step(params, cache, chunk)
    check_cache(cache, config)
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.cache.changes import empty_changes
from ssplat_jax.cache.hash_table import SLOTS_PER_ROW, build_table
from ssplat_jax.cache.key_views import NUM_KEY_VIEWS, KeyViews, empty_key_views
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.errors import CacheError, InputError, refusal
from ssplat_jax.core.kept_programs import Kept
from ssplat_jax.core.pytree import pytree, replace

NUM_OBSERVED = 9  # numbers that a pivot's observations hold (`votes.py`)

NUM_STORED, STORED_CELLS = 32, 32
"""Past chunks of which a coarse depth map is kept while views carve, to vote on the tokens of later chunks, and the
cells of such a map along each side."""


@pytree
class CacheStats:
    """Counters over the whole stream, to be read outside jit (`check_cache`).

    They stop at 2^31 - 1, which tokens of 4 views at 1080p reach after 4000 chunks.
    """

    num_chunks: Int[Array, ""]
    num_seen: Int[Array, ""]  # tokens of valid views offered to the cache
    num_accepted: Int[Array, ""]  # appended or merged
    num_merged: Int[Array, ""]  # accepted by a merge, which leaves the number of pivots unchanged
    num_low_confidence: Int[Array, ""]  # rejected: below tau_conf, as predicted or after `vote`
    num_non_finite: Int[Array, ""]  # rejected: NaN or infinite, or a footprint that is not positive
    num_out_of_range: Int[Array, ""]  # rejected: voxel index outside +-2^20
    num_dropped: Int[Array, ""]  # rejected: no free row for a new voxel (overflow)
    num_unusable: Int[Array, ""]  # views left out: a camera or an image that cannot be used (core.chunk.usable_views)


@pytree
class StoredDepths:
    """Coarse depth maps of one view from each of the last `w` chunks, which vote on later tokens.

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
    voxels: Int[Array, "capacity 4"]  # floor(mean / side) and level (hash_table.py)
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
    stored_depths: StoredDepths
    stats: CacheStats
    observations: Float[Array, "capacity k s"] | None = None  # what views say about the pivot (votes.py); sums
    # Fields of refinement while streaming; None without it, so that the program has no trace of them.
    changes: Float[Array, "capacity k r"] | None = None  # to each of the pivot's Gaussians (changes.py)
    key_views: KeyViews | None = None  # views that the scene is compared with; None before the first chunk

    @property
    def alive(self) -> Bool[Array, "capacity k"]:
        """Mask of the pivots that exist."""
        return jnp.arange(self.means.shape[1]) < self.counts[:, None]

    @property
    def capacity(self) -> int:
        """Number of voxels that the cache can hold."""
        return self.voxels.shape[-2]


PIVOT_FIELDS = ("means", "feats", "seeds", "confidences", "rgbs", "quats", "footprints", "num_members", "last_chunks")
"""Fields of every `VoxelCache` with one entry per pivot, `[capacity, k, ...]`."""

OPTIONAL_PIVOT_FIELDS = ("observations", "changes")
"""Further such fields, None where the configuration does not ask for them."""

ROW_FIELDS = ("voxels", "counts", *PIVOT_FIELDS, *OPTIONAL_PIVOT_FIELDS)  # arrays with one row per voxel


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


def require_single_cache(cache: VoxelCache, caller: str) -> None:
    """Raises if `cache` has leading axes, of streams or shards; the message names `caller`.

    Raises:
        InputError: `cache` holds several caches.
    """
    if shape := cache.num_voxels.shape:
        wanted, got = "the cache of one stream on one device", f"caches of shape {list(shape)}"
        fix = f"take one at a time, jax.tree.map(lambda x: x[{', '.join('0' * len(shape))}], caches)"
        raise refusal(caller, wanted=wanted, got=got, fix=fix)


def init_cache(config: StreamConfig, capacity: int | None = None) -> VoxelCache:
    """An empty cache of `capacity` voxels (default: the config's).

    Raises:
        InputError: `capacity` is no power of two, which the bit masks of the hash table need.
    """
    capacity = config.memory.capacity if capacity is None else capacity
    if capacity < 1 or capacity & (capacity - 1):
        raise InputError(f"cache: capacity must be a power of two, got {capacity}.")
    k, c = config.memory.pivots_per_voxel, config.network.token_width
    w = NUM_STORED if config.memory.carving else 0
    zero = lambda: jnp.zeros((), jnp.int32)  # noqa: E731 - one fresh buffer per counter, so that all can be donated
    return VoxelCache(
        voxels=jnp.zeros((capacity, 4), jnp.int32),
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
        stored_depths=StoredDepths(
            viewmats=jnp.zeros((w, 4, 4)),
            Ks=jnp.zeros((w, 3, 3)),
            log_depths=jnp.zeros((w, STORED_CELLS, STORED_CELLS)),
            weights=jnp.zeros((w, STORED_CELLS, STORED_CELLS)),
        ),
        stats=CacheStats(*(zero() for _ in range(9))),
        observations=jnp.zeros((capacity, k, NUM_OBSERVED)) if config.head.evidence else None,
        changes=empty_changes(capacity, config) if config.stream.steps_per_chunk else None,
    )


def with_refinement(
    cache: VoxelCache, config: StreamConfig, height: int, width: int, *, is_masked: bool = False
) -> VoxelCache:
    """`cache` with empty changes and key views for images of one size, with masks or without, where it has none yet.

    Raises:
        InputError: it has key views of another size or number.
    """
    slots = (NUM_KEY_VIEWS, height, width, 4 if is_masked else 3)
    changes = empty_changes(cache.capacity, config) if cache.changes is None else cache.changes
    key_views = empty_key_views(*slots) if cache.key_views is None else cache.key_views
    if is_masked and key_views.seen is None:  # the first mask of the stream: nothing before it was hidden
        images = jnp.pad(key_views.images, [(0, 0)] * 3 + [(0, 1)], constant_values=1)
        key_views = replace(key_views, images=images)
    if key_views.images.shape != slots:
        wanted, got = "x".join(map(str, key_views.images.shape)), "x".join(map(str, slots))
        raise InputError(f"cache: wanted key views of {wanted} as before, got {got}; keep the size.")
    return replace(cache, changes=changes, key_views=key_views)


# Capacity -------------------------------------------------------------------------------------------------------------


def ensure_capacity(cache: VoxelCache, config: StreamConfig, num_new_tokens: int) -> VoxelCache:
    """`cache`, doubled as often as needed to hold `num_new_tokens` more even if each opens a new voxel.

    Call it outside jit. Only `overflow="grow"` changes the cache. Rows keep their numbers, so the stream continues
    exactly as if the cache had had the new capacity from the start. The step is compiled again for a new capacity;
    doubling limits the number of compilations to log2 of the final size.

    Args:
        cache: the cache before a step, or several with leading axes, which all grow alike.
        config: its `overflow` decides, and its `vacc` how many rows new tokens can fill.
        num_new_tokens: tokens of the coming chunk, one per 4 x 4 pixels of the padded images
            (`ssplat_jax.streaming.session.tokens_per_chunk`).

    Returns:
        The cache itself, or a larger copy.
    """
    capacity = required_capacity(cache, config, num_new_tokens)
    return cache if capacity == cache.capacity else grow(cache, capacity)


def required_capacity(caches: VoxelCache, config: StreamConfig, num_new_tokens: int) -> int:
    """The capacity to which `ensure_capacity` enlarges a cache, or caches with leading axes, alike."""
    _require_values(caches, "ensure_capacity")
    new_rows = num_new_tokens if config.memory.vacc == "voxel" else -(-num_new_tokens // config.memory.pivots_per_voxel)
    capacity, num_voxels = caches.capacity, _over_all(jnp.max, caches.num_voxels)
    while config.memory.overflow == "grow" and capacity < num_voxels + new_rows:
        capacity *= 2
    return capacity


def grow(cache: VoxelCache, capacity: int) -> VoxelCache:
    """`cache`, or caches with leading axes, enlarged to `capacity` voxels, a power of two.

    Raises:
        InputError: `capacity` is below the present one or no power of two.
    """
    if cache.num_voxels.ndim:
        return jax.vmap(lambda one: grow(one, capacity))(cache)
    extra = capacity - cache.capacity
    if extra < 0 or capacity & (capacity - 1):
        raise InputError(f"cache: capacity must be a power of two of at least {cache.capacity}, got {capacity}.")
    return _grown(cache, extra)


@functools.partial(Kept, static_argnums=(1,))
def _grown(cache: VoxelCache, extra: int) -> VoxelCache:
    rows = {name: getattr(cache, name) for name in ("voxels", "counts", *pivot_fields(cache))}
    rows = {name: jnp.pad(x, [(0, extra)] + [(0, 0)] * (x.ndim - 1)) for name, x in rows.items()}
    # With vacc="append" the table is empty: rows have no voxel of their own to be entered by.
    num_entered = jnp.where(jnp.any(cache.table >= 0), cache.num_voxels, 0)
    return replace(cache, table=build_table(rows["voxels"], num_entered), **rows)


def check_cache(caches: VoxelCache, config: StreamConfig) -> None:
    """Raises if a cache, or one of several with leading axes, lost tokens that its overflow policy promises to keep.

    Call it outside jit.

    Raises:
        CacheError: tokens were dropped under `overflow="grow"`.
        InputError: it is called inside jit.
    """
    _require_values(caches, "check_cache")
    num_dropped = _over_all(jnp.sum, caches.stats.num_dropped)
    if num_dropped and config.memory.overflow == "grow":
        raise CacheError(
            f"cache: wanted to keep every token, but {num_dropped} did not fit in {caches.capacity} voxels; "
            "call ss.ensure_capacity(cache, config, num_new_tokens) before each step."
        )


def _over_all(reduce: Callable[[jax.Array], jax.Array], counters: Int[Array, "*b"]) -> int:
    """The counters of one or several caches as one number; they may lie on devices of several processes."""
    return int(reduce(counters) if counters.ndim else counters)  # a single one needs no program


def _require_values(caches: VoxelCache, caller: str) -> None:
    """Raises if `caches` are traced, in the name of `caller`, which reads values."""
    if isinstance(caches.num_voxels, Tracer):
        wanted, fix = "a cache outside jit, vmap and scan", "call it before or after"
        raise refusal(caller, wanted=wanted, got="a traced one", fix=fix)
