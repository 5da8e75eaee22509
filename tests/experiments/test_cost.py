"""Cost: compilation is not timed; the memory of a stream does not grow, that of the joint network does."""

import time

import pytest
from ssplat_experiments.cost import median_ms

from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.evaluation.cost import live_bytes, peak_memory
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


@pytest.fixture(scope="module")
def room():
    return open_capture("procedural:room?frames=16", size=(48, 32))


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
        peaks.append(memory["peak_memory_bytes"])
        steps.append(memory["step_bytes"])
    assert len(set(steps)) == 1
    assert max(peaks) <= 1.05 * peaks[0]
    assert peaks[0] >= live_bytes((session.params, session.cache))
