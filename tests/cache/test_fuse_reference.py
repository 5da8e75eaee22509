"""The parallel fuse equals the sequential reference: indices, choices and counters exactly, means to rounding."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ssplat_jax.cache import init_cache
from ssplat_jax.cache import numpy_reference as reference
from ssplat_jax.cache.fuse import MERGE_BLOCKS
from tests.cache.streams import (
    CONFIG,
    PAIRS,
    VARIANTS,
    WIDTH,
    assert_equal_to_reference,
    fuse,
    recipes,
    run_both,
    to_jax,
)

CONFIGS = VARIANTS | {
    "single": CONFIG.replace(pivots_per_voxel=1),
    "refined": PAIRS.replace(steps_per_chunk=1),
}
streams = st.lists(recipes, min_size=1, max_size=3)
QUICK = settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
FULL = settings(QUICK, max_examples=500)


@pytest.mark.parametrize("name", CONFIGS)
@QUICK
@given(streams)
def test_fuse_equals_the_reference(name, stream):
    run_both(stream, CONFIGS[name])


def test_merge_rounds_of_every_size_equal_the_reference():
    """One chunk whose rounds have more voxels than the largest block, fewer than the smallest, and all between."""
    rng = np.random.default_rng(0)
    repeats = np.concatenate([np.full(3 * MERGE_BLOCKS[0][0] // 2, 6), [7, 9] * 40, [30] * 10, [80]])
    columns = rng.permutation(np.repeat(np.arange(len(repeats)), repeats))
    m = len(columns)
    tokens = {
        "means": (np.stack([columns, 0 * columns, 0 * columns], axis=-1) + rng.uniform(0.1, 0.9, (m, 3))) / 4,
        "feats": rng.integers(-2, 3, (m, WIDTH)),
        "confidences": rng.choice([0.2, 0.5, 0.5, 1.0], m),
        "rgbs": rng.uniform(size=(m, 3 * CONFIG.head.gaussians_per_token)),
        "quats": rng.normal(size=(m, 4)),
        "footprints": rng.uniform(size=m),
    }
    tokens = {name: x.astype(np.float32) for name, x in tokens.items()} | {"valid": np.ones(m, bool)}
    cache, expected = init_cache(CONFIG, 1024), reference.empty(1024)
    for _ in range(2):
        cache = fuse(cache, to_jax(tokens), CONFIG)
        assert_equal_to_reference(cache, reference.fuse(expected, tokens, CONFIG))


@pytest.mark.slow
@pytest.mark.parametrize("name", CONFIGS)
@FULL
@given(streams)
def test_fuse_equals_the_reference_on_many_streams(name, stream):
    run_both(stream, CONFIGS[name])
