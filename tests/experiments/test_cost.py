"""Cost: compilation is not timed; the memory of a stream does not grow, that of the joint network does."""

import itertools
import time

import jax
import numpy as np
import pytest
from ssplat_experiments.baselines import JointNetwork, one_chunk
from ssplat_experiments.cost import median_ms

from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.evaluation.cost import added_bytes, live_bytes, peak_memory
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.streaming.feed import feed_capture
from ssplat_jax.streaming.session import Session
from tests.model import small


def test_compilation_and_preparation_are_not_timed():
    waits = iter([0.2, 0.01, 0.01, 0.01])
    assert 9 <= median_ms(lambda wait: time.sleep(wait), 3, prepare=lambda: next(waits)) < 60

    slow_start = iter([0.2, 0.0, 0.0, 0.0])
    assert median_ms(lambda _: None, 3, prepare=lambda: time.sleep(next(slow_start))) < 50


CONFIG = small.CONFIG.replace(chunk_size=4, capacity=1 << 11, min_confidence=0.05)
COUNTS = (4, 8, 16)


@pytest.fixture(scope="module")
def room():
    return open_capture("procedural:room?frames=16", size=(48, 32))


@pytest.mark.slow
@pytest.mark.usefixtures("compiled_plainly")
def test_memory_of_joint_network_grows_linearly_or_faster(room):
    params, frame = small.random_params(CONFIG), room.stream_frame(CONFIG)
    peaks = []
    for count in COUNTS:
        chunk = one_chunk(list(room.chunks(CONFIG, range(count), stream_frame=frame)))
        network = JointNetwork(CONFIG, params, chunk)
        peaks.append(network.network_bytes())
    slopes = [(b - a) / (n - m) for (m, a), (n, b) in itertools.pairwise(zip(COUNTS, peaks, strict=True))]
    assert slopes[0] > live_bytes(chunk.images[0])  # more than the images alone
    assert slopes[1] >= 0.95 * slopes[0]


@pytest.mark.slow
@pytest.mark.usefixtures("compiled_plainly")
def test_memory_of_a_stream_does_not_grow_with_views(room):
    """The cache has capacity for the scene, as it has after its last doubling."""
    config = CONFIG.replace(overflow="drop_new", voxel_size=0.5)
    session, frame = Session(StreamSplat(config), small.random_params(config)), room.stream_frame(config)
    peaks, steps = [], []
    for _ in range(3):
        feed_capture(session, room, range(16), frame)
        memory = peak_memory(session, room.camera(3, frame))
        peaks.append(memory.bytes)
        steps.append(memory.step)
    assert len(set(steps)) == 1
    assert max(peaks) <= 1.05 * peaks[0]
    assert peaks[0] >= live_bytes((session.params, session.cache))


def test_added_bytes_are_results_and_temporaries():
    x = np.zeros(1 << 16, np.float32)
    kept = jax.jit(lambda x: x + 1).lower(x).compile()
    written_over = jax.jit(lambda x: x + 1, donate_argnums=0).lower(x).compile()
    added, over = added_bytes(kept), added_bytes(written_over)
    assert added is not None and x.nbytes <= added <= x.nbytes + 1024
    assert over is not None and over <= 1024
