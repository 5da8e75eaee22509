"""Token streams that are hard on the cache, and the comparison of a cache with the oracle."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st

from ssplat_jax.cache import PIVOT_FIELDS, Tokens, VoxelCache, fuse_touched
from ssplat_jax.cache import numpy_reference as reference
from ssplat_jax.config import StreamConfig

WIDTH = 4  # channels
NUM_TOKENS = 48  # per chunk
CAPACITY = 16
VALUE_RTOL = 1e-6  # one float32 rounding is 6e-8; the oracle is float64

PLACES = ("one_voxel", "few", "many", "boundaries", "edges")
FEATURES = ("integers", "normal", "duplicates", "zeros")
CONFIDENCES = ("random", "tied", "at_tau")

fuse = jax.jit(fuse_touched, static_argnums=2, donate_argnums=0)

CONFIG = StreamConfig().replace(
    token_width=WIDTH, capacity=128, voxel_size=0.25, min_confidence=0.3, overflow="drop_new"
)


@dataclasses.dataclass(frozen=True)
class Recipe:
    """Draws one chunk of tokens; hypothesis shrinks its fields."""

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
            "footprints": rng.uniform(0.01, 0.1, m),
        }
        tokens = {name: x.astype(np.float32) for name, x in tokens.items()}
        for token in rng.choice(m, self.num_bad, replace=False):
            name = rng.choice(sorted(tokens))
            tokens[name][token] = rng.choice([np.nan, np.inf, -np.inf])
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
    """The arrays as the cache takes them."""
    return Tokens(**{name: jnp.asarray(x) for name, x in tokens.items()})


def assert_equal_to_oracle(cache: VoxelCache, oracle: dict) -> None:
    """Indices, counts, choices and counters exact; means within `VALUE_RTOL` of a pivot's largest entry."""
    arrays = jax.tree.map(np.asarray, cache)
    for name, count in oracle["stats"].items():
        assert int(getattr(arrays.stats, name)) == count, name
    rows = oracle["rows"]
    assert int(arrays.num_voxels) == len(rows)
    np.testing.assert_array_equal(arrays.counts[: len(rows)], [len(pivots) for _, pivots in rows])
    np.testing.assert_array_equal(arrays.counts[len(rows) :], 0)
    for row, (voxel, _) in enumerate(rows):
        if voxel is not None:
            assert tuple(arrays.voxels[row]) == voxel
    for name in PIVOT_FIELDS:
        wanted = np.zeros(getattr(arrays, name).shape)
        for row, (_, pivots) in enumerate(rows):
            for k, pivot in enumerate(pivots):
                wanted[row, k] = pivot[name]
        if name in ("means", "feats", "rgbs"):
            scale = np.abs(wanted).max(axis=-1, keepdims=True, initial=1e-30)
            np.testing.assert_allclose(getattr(arrays, name) / scale, wanted / scale, rtol=0, atol=VALUE_RTOL)
        else:
            np.testing.assert_array_equal(getattr(arrays, name), wanted.astype(getattr(arrays, name).dtype), name)


def run_both(recipes, config, capacity=CAPACITY):
    """The stream through the cache and through the oracle, compared after every chunk."""
    from ssplat_jax.cache import init_cache

    cache, oracle = init_cache(config, capacity), reference.empty(capacity)
    for recipe in recipes:
        tokens = recipe.tokens()
        cache, _ = fuse(cache, to_jax(tokens), config)
        reference.fuse(oracle, tokens, config)
        assert_equal_to_oracle(cache, oracle)
    return cache, oracle
