"""Token streams that are hard on the cache, and the comparison of caches with the reference."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st

from ssplat_jax.cache.changes import WIDTH as CHANGE_WIDTH
from ssplat_jax.cache.changes import settle, unpack
from ssplat_jax.cache.fuse import fuse as plain_fuse
from ssplat_jax.cache.state import Tokens, VoxelCache, init_cache, pivot_fields
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.pytree import replace
from tests.cache import numpy_reference as reference

WIDTH = 4  # feature channels
NUM_TOKENS = 48  # per chunk
CAPACITY = 16
VALUE_RTOL = 1e-6  # one float32 rounding is 6e-8; the reference is float64

PLACES = ("one_voxel", "few", "many", "boundaries", "edges")
FEATURES = ("integers", "normal", "duplicates", "zeros")
CONFIDENCES = ("random", "tied", "at_tau")

fuse = jax.jit(plain_fuse, static_argnums=2, donate_argnums=0)

CONFIG = StreamConfig().replace(
    token_width=WIDTH, capacity=128, voxel_size=0.25, min_confidence=0.3, overflow="drop_new", cgfi=True
)
PAIRS = CONFIG.replace(pivots_per_voxel=2)
VARIANTS = {"voxel": CONFIG, "append": CONFIG.replace(vacc="append")}
"""Every way in which rows are assigned."""


@dataclasses.dataclass(frozen=True)
class Recipe:
    """A random chunk of tokens; hypothesis shrinks its fields."""

    seed: int
    places: str
    features: str
    confidences: str
    num_valid: int = NUM_TOKENS
    num_bad: int = 0

    def tokens(self) -> dict[str, np.ndarray]:
        """Arrays named as the fields of `Tokens`."""
        rng = np.random.default_rng(self.seed)
        m = NUM_TOKENS
        tokens = {
            "means": _means(rng, m, self.places),
            "feats": _feats(rng, m, self.features),
            "confidences": _confidences(rng, m, self.confidences),
            "rgbs": rng.uniform(0, 1, (m, 3 * CONFIG.head.gaussians_per_token)),
            "quats": rng.normal(size=(m, 4)),
            "footprints": _footprints(rng, m),
        }
        tokens = {name: x.astype(np.float32) for name, x in tokens.items()}
        for token in rng.choice(m, self.num_bad, replace=False):
            name = rng.choice(sorted(tokens))
            tokens[name][token] = rng.choice([np.nan, np.inf, -np.inf, 0.0, -0.1])
        valid = np.zeros(m, bool)
        valid[rng.choice(m, self.num_valid, replace=False)] = True
        return tokens | {"valid": valid}


def _means(rng, m, places):
    size = CONFIG.memory.voxel_size
    if places == "edges":
        limit = np.float64(1 << 20)
        cells = rng.choice([-limit - 1, -limit, 1 - limit, -1.0, 0.0, limit - 1, limit, 3e9], (m, 3))
        return cells * size
    if places == "boundaries":
        return rng.integers(-2, 3, (m, 3)) * size
    cells = {"one_voxel": 1, "few": 2, "many": 40}[places]
    return rng.uniform(-cells, cells, (m, 3)) * (size / 2) + (size / 2 if places == "one_voxel" else 0)


def _footprints(rng, m):
    """Footprints that belong to voxels of the configured size or of a neighboring level; some lie at the limit."""
    size = CONFIG.memory.voxel_size
    widths = rng.choice([1.0, np.nextafter(np.float32(2), np.float32(0)), *rng.uniform(1, 2, 8)], m)
    return widths * size * rng.choice([1.0, 1.0, 1.0, 0.5, 2.0], m)


def _feats(rng, m, features):
    if features == "normal":
        return rng.normal(size=(m, WIDTH))
    if features == "duplicates":
        return rng.normal(size=(3, WIDTH))[rng.integers(0, 3, m)]
    integers = rng.integers(-2, 3, (m, WIDTH))
    return integers * rng.integers(0, 2, (m, 1)) if features == "zeros" else integers


def _confidences(rng, m, confidences):
    tau = np.float32(CONFIG.memory.min_confidence)
    if confidences == "at_tau":
        return rng.choice([np.nextafter(tau, np.float32(0)), tau, np.nextafter(tau, np.float32(1))], m)
    return rng.choice([0.2, 0.5, 0.5, 1.0], m) if confidences == "tied" else rng.uniform(0.2, 1.0, m)


recipes = st.builds(
    Recipe,
    seed=st.integers(0, 2**32 - 1),
    places=st.sampled_from(PLACES),
    features=st.sampled_from(FEATURES),
    confidences=st.sampled_from(CONFIDENCES),
    num_valid=st.integers(0, NUM_TOKENS),
    num_bad=st.sampled_from([0, 0, 5]),
)


def to_jax(tokens: dict[str, np.ndarray]) -> Tokens:
    """The arrays as `Tokens`."""
    return Tokens(**{name: jnp.asarray(x) for name, x in tokens.items()})


def tokens_at(means, confidences=0.5, feats=1.0, valid=True, **changes) -> Tokens:
    """Tokens at `means`, otherwise alike; their colors number them."""
    n = len(means)
    full = lambda x, *shape: jnp.broadcast_to(jnp.asarray(x, jnp.float32), (n, *shape))  # noqa: E731
    tokens = Tokens(
        means=jnp.asarray(means, jnp.float32),
        feats=full(feats, WIDTH),
        confidences=full(confidences),
        rgbs=jnp.arange(n, dtype=jnp.float32)[:, None] * jnp.ones(3 * CONFIG.head.gaussians_per_token),
        quats=full([1.0, 0, 0, 0], 4),
        footprints=full(1.5 * CONFIG.memory.voxel_size),
        valid=jnp.broadcast_to(jnp.asarray(valid), (n,)),
    )
    return replace(tokens, **changes)


def written_rows(cache: VoxelCache) -> set[int]:
    """Rows with a pivot that the last chunk wrote."""
    is_new = np.asarray(cache.alive & (cache.last_chunks == cache.stats.num_chunks - 1))
    return set(np.flatnonzero(is_new.any(axis=1)).tolist())


def assert_equal_to_reference(cache: VoxelCache, expected: dict) -> None:
    """Indices, counts, choices and counters equal; means within `VALUE_RTOL` of a pivot's largest entry."""
    arrays = jax.tree.map(np.asarray, cache)
    for name, count in expected["stats"].items():
        assert int(getattr(arrays.stats, name)) == count, name
    rows = expected["rows"]
    assert int(arrays.num_voxels) == len(rows)
    np.testing.assert_array_equal(arrays.counts[: len(rows)], [len(pivots) for _, pivots in rows])
    np.testing.assert_array_equal(arrays.counts[len(rows) :], 0)
    for row, (voxel, _) in enumerate(rows):
        if voxel is not None:
            assert tuple(arrays.voxels[row]) == voxel
    for name in pivot_fields(cache):
        wanted = np.zeros(getattr(arrays, name).shape)
        for row, (_, pivots) in enumerate(rows):
            for k, pivot in enumerate(pivots):
                wanted[row, k] = pivot[name]
        if name in ("means", "feats", "rgbs", "changes"):
            scale = np.abs(wanted).max(axis=-1, keepdims=True, initial=1e-30)
            np.testing.assert_allclose(getattr(arrays, name) / scale, wanted / scale, rtol=0, atol=VALUE_RTOL)
        else:
            np.testing.assert_array_equal(getattr(arrays, name), wanted.astype(getattr(arrays, name).dtype), name)


_settle = jax.jit(
    lambda means, footprints, packed, config: settle(means, footprints, unpack(packed), config), static_argnums=3
)


def revised(cache: VoxelCache, rng: np.random.Generator, config: StreamConfig) -> VoxelCache:
    """The cache after a refinement that moves and changes every alive pivot at random, by up to twice its voxel."""
    capacity, k, width = cache.changes.shape
    changes = rng.normal(size=(capacity * k, width // CHANGE_WIDTH, CHANGE_WIDTH))
    changes[..., :3] *= config.memory.voxel_size
    packed = cache.changes + changes.reshape(cache.changes.shape).astype(np.float32)
    means, footprints = cache.means.reshape(-1, 3), cache.footprints.reshape(-1)
    means, packed = _settle(means, footprints, packed.reshape(-1, width), config)
    alive = cache.alive[..., None]
    return replace(
        cache,
        means=jnp.where(alive, means.reshape(cache.means.shape), cache.means),
        changes=jnp.where(alive, packed.reshape(cache.changes.shape), cache.changes),
    )


def revise_reference(expected: dict, cache: VoxelCache) -> None:
    """Gives the pivots of the reference the places and changes of those of `cache`, in place."""
    means, changes = np.asarray(cache.means, np.float64), np.asarray(cache.changes, np.float64)
    for row, (_, pivots) in enumerate(expected["rows"]):
        for k in range(len(pivots)):
            pivots[k] = pivots[k] | {"means": means[row, k], "changes": changes[row, k]}


def run_both(recipes, config, capacity=CAPACITY):
    """Streams the recipes through the cache and through the reference; compares them after every chunk.

    Where the configuration asks for refinement, pivots are revised between chunks.
    """
    cache, expected, rng = init_cache(config, capacity), reference.empty(capacity), np.random.default_rng(0)
    for recipe in recipes:
        tokens = recipe.tokens()
        cache = fuse(cache, to_jax(tokens), config)
        reference.fuse(expected, tokens, config)
        assert_equal_to_reference(cache, expected)
        if config.stream.steps_per_chunk:
            cache = revised(cache, rng, config)
            revise_reference(expected, cache)
