"""The parallel fuse is the sequential loop: indices, choices and counters exactly, means to float32 rounding."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.cache.streams import CONFIG, recipes, run_both

CONFIGS = {
    "literal": CONFIG,
    "count": CONFIG.replace(merge_weight="count", pivots_per_voxel=3),
    "single": CONFIG.replace(pivots_per_voxel=1),
    "evict": CONFIG.replace(overflow="evict_lowest", pivots_per_voxel=2),
    "append": CONFIG.replace(vacc="append"),
}
streams = st.lists(recipes, min_size=1, max_size=3)
QUICK = settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
FULL = settings(QUICK, max_examples=500)


@pytest.mark.parametrize("name", CONFIGS)
@QUICK
@given(streams)
def test_parallel_fuse_equals_the_loop(name, stream):
    run_both(stream, CONFIGS[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", CONFIGS)
@FULL
@given(streams)
def test_parallel_fuse_equals_the_loop_on_2500_streams(name, stream):
    run_both(stream, CONFIGS[name])
