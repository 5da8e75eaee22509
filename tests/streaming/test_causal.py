"""Causal streams: what comes later changes nothing that is out; what comes live gives what the capture gives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.core.rotations import quats_to_matrices
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.images import ArrayPixels
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.model.streamsplat import ChunkOutput, StreamSplat
from ssplat_jax.streaming.feed import feed_chunks
from ssplat_jax.streaming.live_views import STEP, widen_range
from ssplat_jax.streaming.session import Session
from tests.streaming.narrow_model import NARROW, assert_same_bits

CAUSAL = NARROW.replace(causal=True)
NUM_FRAMES = 11


@pytest.fixture(scope="module")
def capture():
    return open_capture(f"procedural:room?frames={NUM_FRAMES}&size=48x32")


@pytest.fixture(scope="module")
def params():
    return StreamSplat(CAUSAL).init(jax.random.key(0))


def with_other_future(capture, first):
    """The capture with images of noise, and poses of another place, from frame `first` on."""
    rng = np.random.default_rng(1)
    images = np.stack([capture.image(i) for i in range(len(capture))])
    images[first:] = rng.uniform(size=images[first:].shape)
    frames = list(capture.frames)
    for i in range(first, len(frames)):
        pose = np.eye(4)
        pose[:3, :3] = np.asarray(quats_to_matrices(jnp.asarray(rng.normal(size=4), jnp.float32)), np.float64)
        pose[:3, 3] = rng.normal(size=3) * 1e9
        frames[i] = dataclasses.replace(frames[i], camtoworld=pose)
    depths = np.zeros(images.shape[:3], np.float32)
    return dataclasses.replace(capture, frames=tuple(frames), pixels=ArrayPixels(images, depths))


def driven(capture, params, config, num_chunks):
    """Order, stream frame, and everything that the first chunks put out."""
    session = Session(StreamSplat(config), params)
    frame = capture.stream_frame(config)
    order = capture.stream_order(config, None, frame)
    fed = feed_chunks(session, capture, order, frame)
    outputs = []
    for chunk in (next(fed) for _ in range(num_chunks)):
        # The step gives its cache away at the next chunk.
        outputs.append((chunk.chunk, chunk.output, jax.tree.map(np.asarray, session.cache), session.gaussians()))
    return order[: 4 * num_chunks], frame.to_dict(), outputs, chunk.frame.to_dict()


@pytest.mark.parametrize("num_chunks", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_replaced_future_changes_no_chunk_before_it(capture, params, num_chunks):
    other = with_other_future(capture, 4 * num_chunks)
    (order, frame, outputs, after), there = (driven(c, params, CAUSAL, num_chunks) for c in (capture, other))
    assert (order, frame, after) == (there[0], there[1], there[3])
    assert_same_bits(outputs, there[2])


@pytest.mark.slow
def test_without_causal_the_future_has_influence(capture, params):
    here, there = (driven(c, params, NARROW, 1) for c in (capture, with_other_future(capture, 4)))
    assert here[1] != there[1]


def test_a_causal_session_makes_its_model_causal(params):
    session = Session(StreamSplat(NARROW), params, causal=True)
    assert session.model.config == CAUSAL


def test_pushed_views_give_what_the_causal_stream_gives(capture, params):
    driver = Session(StreamSplat(CAUSAL), params)
    frame = capture.stream_frame(CAUSAL)
    wanted = [fed.output for fed in feed_chunks(driver, capture, range(NUM_FRAMES), frame)]
    live, got = Session(StreamSplat(NARROW), params), []
    for i in range(NUM_FRAMES):
        viewmat = np.linalg.inv(capture.frames[i].camtoworld)
        got.append(live.push(capture.image(i), capture.K(i), viewmat))
    assert [i for i, out in enumerate(got) if out is not None] == [3, 7]
    got = [*filter(None, got), live.flush()]
    assert live.flush() is None and live.frame is not None
    np.testing.assert_allclose(live.frame.origin, frame.origin, atol=1e-12)
    assert live.frame.scale == pytest.approx(frame.scale, rel=1e-9)
    for output, expected in zip(got, wanted, strict=True):
        np.testing.assert_allclose(output.depths, expected.depths, rtol=2e-3)  # poses were inverted twice
    assert live.cache_facts()["num_seen"] == driver.cache_facts()["num_seen"]


def test_bytes_are_pushed_as_their_255th(params, capture):
    pushed = []
    for scale in (None, np.float32(255)):
        session = Session(StreamSplat(NARROW), params)
        for i in range(2):
            image = np.round(capture.image(i) * 255).astype(np.uint8)
            session.push(image if scale is None else image / scale, capture.K(i), np.eye(4))
        pushed.append(session._live.rest())
    assert_same_bits(*pushed)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"image": np.zeros((32, 48, 4), np.float32)}, "RGB"),
        ({"image": np.full((32, 48, 3), 200.0)}, r"\[0, 1\]"),
        ({"image": np.full((32, 48, 3), np.nan)}, r"\[0, 1\]"),
        ({"image": np.zeros((16, 48, 3), np.float32)}, "48x32 as the first"),
        ({"K": np.eye(3)}, "pixels"),
        ({"K": np.ones((3, 3))}, "skew"),
        ({"viewmat": np.diag([2.0, 2.0, 2.0, 1.0])}, "viewmat.*rotation"),
    ],
)
def test_unusable_views_are_refused_and_do_not_count(change, words, capture, params):
    session = Session(StreamSplat(NARROW), params)
    view = {"image": capture.image(0), "K": capture.K(0), "viewmat": np.eye(4)}
    session.push(**view)
    with pytest.raises(InputError, match=words):
        session.push(**view | change)
    assert int(session._live.rest().valid.sum()) == 1


def test_a_continued_cache_needs_its_frame_to_be_pushed_to(capture, params):
    session = Session(StreamSplat(NARROW), params, StreamSplat(NARROW).init_cache())
    with pytest.raises(InputError, match="frame"):
        session.push(capture.image(0), capture.K(0), np.eye(4))


def at_depths(*shares):
    """An output whose cells have depths in the given shares, all confident."""
    depths = np.concatenate([np.full(round(1000 * share), depth) for share, depth in shares]).reshape(1, 1, -1)
    maps = jnp.asarray(depths, jnp.float32)
    return ChunkOutput(depths=maps, confidences=jnp.ones_like(maps), history=maps, exposures=jnp.ones((1, 3)))


@pytest.mark.parametrize(
    ("shares", "near", "far"),
    [
        ([(0.9, 2.0), (0.1, 8.0)], 1.0, 8.0),  # a tenth at far: nothing moves
        ([(0.7, 2.0), (0.3, 8.0)], 1.0, 8.0 * STEP),
        ([(0.7, 2.0), (0.3, 1.01)], 1.0 / STEP, 8.0),
        ([(0.5, 1.0), (0.5, 8.0)], 1.0 / STEP, 8.0 * STEP),
    ],
)
def test_only_a_contradicted_end_moves_outward(shares, near, far, capture):
    frame = dataclasses.replace(capture.stream_frame(CAUSAL), near=1.0, far=8.0)
    after = widen_range(frame, at_depths(*shares), CAUSAL)
    assert (after.near, after.far) == pytest.approx((near, far)) and after.scale == frame.scale


def test_the_range_stops_at_its_largest_ratio(capture):
    frame = dataclasses.replace(capture.stream_frame(CAUSAL), near=1.0, far=50.0)
    for _ in range(5):
        frame = widen_range(frame, at_depths((1.0, frame.far)), CAUSAL)
    assert (frame.near, frame.far) == (1.0, 60.0)
    # A range that is wider from the start stays as it is.
    wide = dataclasses.replace(frame, near=0.01, far=200.0)
    assert widen_range(wide, at_depths((1.0, 200.0)), CAUSAL).far == 200.0


def test_cells_below_the_threshold_have_no_say(capture):
    frame = dataclasses.replace(capture.stream_frame(CAUSAL), near=1.0, far=8.0)
    assert widen_range(frame, at_depths((1.0, 8.0)), CAUSAL.replace(min_confidence=0.95)).far == 8.0 * STEP
    doubtful = dataclasses.replace(at_depths((1.0, 8.0)), confidences=jnp.full((1, 1, 1000), 0.3))
    assert widen_range(frame, doubtful, CAUSAL.replace(min_confidence=0.5)) is frame


def pushed(session, capture, indices):
    """The summaries of the chunks that pushing some frames completes."""
    outputs = []
    for i in indices:
        frame = capture.frames[i]
        output = session.push(capture.image(i), frame.K, np.linalg.inv(frame.camtoworld))
        outputs += [] if output is None else [output]
    return outputs


def test_a_session_can_be_decoded_before_its_first_chunk(capture, params):
    session = Session(StreamSplat(CAUSAL), params)
    assert not np.asarray(session.gaussians().opacities).any() and session.cache is None
    assert pushed(session, capture, range(2)) == []
    session.gaussians()
    assert len(pushed(session, capture, range(2, 4))) == 1
    assert np.asarray(session.gaussians().opacities).any()


def test_an_interrupted_push_loses_no_view(capture, params, monkeypatch):
    wanted = Session(StreamSplat(CAUSAL), params)
    pushed(wanted, capture, range(5))
    wanted.flush()
    session, find = Session(StreamSplat(CAUSAL), params), Capture.stream_frame

    def interrupted(*given, **more):
        monkeypatch.setattr(Capture, "stream_frame", find)
        raise KeyboardInterrupt

    monkeypatch.setattr(Capture, "stream_frame", interrupted)
    with pytest.raises(KeyboardInterrupt):
        pushed(session, capture, range(4))
    assert len(pushed(session, capture, range(4, 5))) == 1
    session.flush()
    assert_same_bits(session.cache, wanted.cache)
    assert session.flush() is None


@pytest.mark.parametrize("place", ["compiling", "waiting"])
def test_an_interrupt_of_a_step_loses_nothing(place, capture, params, monkeypatch):
    """While a step compiles, its views wait on; while it runs, the session keeps what it will return."""
    monkeypatch.setattr("ssplat_jax.streaming.live_views.MAX_END_SHARE", -1.0)  # every chunk moves near and far
    wanted = Session(StreamSplat(CAUSAL), params)
    pushed(wanted, capture, range(5))
    wanted.flush()
    session = Session(StreamSplat(CAUSAL), params)
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):

        def interrupted(*given):
            raise KeyboardInterrupt

        if place == "compiling":
            patched.setattr(session, "_program", interrupted)
        else:
            patched.setattr("ssplat_jax.streaming.session.jax.block_until_ready", interrupted)
        pushed(session, capture, range(4))
    assert len(pushed(session, capture, range(4, 5))) == (place == "compiling")
    assert place == "compiling" or session.frame.near < capture.stream_frame(CAUSAL).near
    session.flush()
    assert_same_bits(session.cache, wanted.cache)
    assert session.flush() is None
