"""Feeding a capture: every frame is fed once, in order, and gets the exposure of its own view."""

import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.config import StreamConfig
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.model.streamsplat import ChunkOutput, StreamSplat
from ssplat_jax.streaming.session import Session, feed_capture, feed_chunks


class CountingSession(Session):
    """A session without a network; the exposure of a view is its number in the stream, from 1."""

    num_views = 0

    def feed(self, chunk):
        v = len(chunk.valid)
        numbers = np.arange(self.num_views + 1, self.num_views + v + 1, dtype=np.float32)
        self.num_views += int(chunk.valid.sum())
        maps, exposures = jnp.zeros((v, 1, 1)), jnp.asarray(np.repeat(numbers[:, None], 3, axis=1))
        return ChunkOutput(depths=maps, confidences=maps, history=maps, exposures=exposures)


@pytest.fixture
def session():
    return CountingSession(StreamSplat(StreamConfig()), {})


@pytest.fixture(scope="module")
def capture():
    return open_capture("procedural:room?frames=7&size=32x24")


def test_chunks_carry_their_own_frames_and_exposures(session, capture):
    order = [6, 0, 3, 1, 5, 2]  # the second chunk has two padded views
    frame = capture.stream_frame(StreamConfig(), order)
    fed = list(feed_chunks(session, capture, order, frame))
    assert [chunk.frames for chunk in fed] == [[6, 0, 3, 1], [5, 2]]
    numbers = [chunk.exposures for chunk in fed]
    assert [{i: float(e[0]) for i, e in part.items()} for part in numbers] == [{6: 1, 0: 2, 3: 3, 1: 4}, {5: 5, 2: 6}]
    assert list(feed_chunks(session, capture, [], frame)) == []


@pytest.mark.parametrize(("num_recent", "num_kept"), [(0, 0), (1, 1)])
def test_feeding_a_capture_returns_the_last_chunks(session, capture, num_recent, num_kept):
    indices, progress = [0, 1, 2, 3, 4, 6], []
    frame = capture.stream_frame(StreamConfig(), indices)
    exposures, recent = feed_capture(session, capture, indices, frame, num_recent=num_recent, on_chunk=progress.append)
    assert sorted(exposures) == indices and progress == [4, 6] and len(recent) == num_kept
    order = capture.stream_order(StreamConfig(), indices, frame)
    assert [float(exposures[i][0]) for i in order] == [1, 2, 3, 4, 5, 6]
