"""Causal streams: what comes later changes nothing that is out; what comes live gives what the capture gives."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssplat_jax.core.errors import InputError
from ssplat_jax.data.capture import ArrayPixels, Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.model.streamsplat import ChunkOutput, StreamSplat
from ssplat_jax.refinement import online_refinement
from ssplat_jax.streaming.live_views import STEP, widen_range
from ssplat_jax.streaming.session import Session, feed_chunks
from tests.data.capture_fixture import with_poses
from tests.model.small import random_params
from tests.streaming.narrow_model import FEW_GAUSSIANS, assert_same_bits

CAUSAL = FEW_GAUSSIANS.replace(causal=True)
MODEL = StreamSplat(CAUSAL)
NUM_FRAMES = 11


@pytest.fixture(scope="module")
def capture():
    return open_capture(f"procedural:room?frames={NUM_FRAMES}&size=64x48&seed=1")


@pytest.fixture(scope="module")
def start(programs_shared):
    """Makes sessions of one model."""
    return functools.partial(Session, MODEL, random_params(CAUSAL))


def with_other_future(capture, first):
    """The capture with images of noise, and poses of another place, from frame `first` on."""
    rng = np.random.default_rng(1)
    images = np.stack([capture.image(i) for i in range(len(capture))])
    images[first:] = rng.uniform(size=images[first:].shape)
    poses, num = capture.camtoworlds, len(capture) - first
    poses[first:, :3, :3] = Rotation.random(num, random_state=rng).as_matrix()
    poses[first:, :3, 3] = rng.normal(size=(num, 3)) * 1e9
    pixels = ArrayPixels(images, np.zeros(images.shape[:3], np.float32))
    return dataclasses.replace(with_poses(capture, poses), pixels=pixels)


def streamed(session, capture, num_chunks):
    """Order, stream frames before and after, and everything that the first chunks put out."""
    config, outputs = session.model.config, []
    frame = capture.stream_frame(config)
    order = capture.stream_order(config, None, frame)
    fed = feed_chunks(session, capture, order, frame)
    for chunk in (next(fed) for _ in range(num_chunks)):
        # The step gives its cache away at the next chunk.
        outputs.append((chunk.chunk, chunk.output, jax.tree.map(np.asarray, session.cache), session.gaussians()))
    return (order[: 4 * num_chunks], frame.to_dict(), chunk.stream_frame.to_dict()), outputs


def test_a_replaced_future_changes_no_chunk_before_it(capture, start):
    num_chunks = 2
    here, there = (streamed(start(), c, num_chunks) for c in (capture, with_other_future(capture, 4 * num_chunks)))
    assert here[0] == there[0]
    assert_same_bits(here[1], there[1])


def push(session, capture, indices):
    """The summaries of the chunks that pushing some frames completes."""
    views = ((capture.image(i), capture.K(i), np.linalg.inv(capture.frames[i].camtoworld)) for i in indices)
    return [output for view in views if (output := session.push(*view)) is not None]


def test_pushed_views_give_what_the_causal_stream_gives(capture, start):
    driver, live = start(), start()
    frame = capture.stream_frame(CAUSAL)
    wanted = [fed.output for fed in feed_chunks(driver, capture, range(NUM_FRAMES), frame)]
    assert not np.asarray(live.gaussians().opacities).any() and live.cache is None
    got = [*push(live, capture, range(NUM_FRAMES)), live.flush()]
    assert live.flush() is None and live.stream_frame is not None
    np.testing.assert_allclose(live.stream_frame.origin, frame.origin, atol=1e-12)
    assert live.stream_frame.scale == pytest.approx(frame.scale, rel=1e-9)
    for output, expected in zip(got, wanted, strict=True):
        np.testing.assert_allclose(output.depths, expected.depths, rtol=2e-3)  # poses were inverted twice
    assert live.cache_facts()["num_seen"] == driver.cache_facts()["num_seen"]


UNUSABLE = (
    ({"image": np.zeros((48, 64, 4), np.float32)}, "RGB"),
    ({"image": np.full((48, 64, 3), 200.0)}, r"\[0, 1\]"),
    ({"image": np.full((48, 64, 3), np.nan)}, r"\[0, 1\]"),
    ({"image": np.zeros((16, 64, 3), np.float32)}, "64x48 as the first"),
    ({"K": np.eye(3)}, "pixels"),
    ({"K": np.ones((3, 3))}, "skew"),
    ({"viewmat": np.diag([2.0, 2.0, 2.0, 1.0])}, "viewmat.*rotation"),
    ({"seen": np.ones((64, 48), bool)}, "seen"),
)


def test_unusable_views_are_refused_and_do_not_count(capture, start):
    session, view = start(), {"image": capture.image(0), "K": capture.K(0), "viewmat": np.eye(4)}
    session.push(**view)
    for change, words in UNUSABLE:
        with pytest.raises(InputError, match=words):
            session.push(**view | change)
    assert int(session._live.rest().valid.sum()) == 1


def test_pushed_masks_give_what_a_masked_capture_gives(capture, programs_shared, monkeypatch):
    """The first mask comes with the second chunk of a stream that refines; the capture has masks from the start."""
    monkeypatch.setattr("ssplat_jax.refinement.online._refine_view", lambda model, params, cache, view: cache)
    model = StreamSplat(CAUSAL.replace(steps_per_chunk=1, hpda=False, cgfi=False, detail=False))
    params = random_params(model.config)
    masks = np.ones((NUM_FRAMES, 48, 64), bool)
    masks[5:7, 8:24, 12:36] = False
    frames = tuple(dataclasses.replace(f, is_masked=i in (5, 6)) for i, f in enumerate(capture.frames))
    masked = dataclasses.replace(capture, frames=frames, pixels=dataclasses.replace(capture.pixels, masks=masks))
    driver, live = (Session(model, params, refine=online_refinement(model)) for _ in range(2))
    list(feed_chunks(driver, masked, range(8), masked.stream_frame(model.config)))
    for i in range(8):
        viewmat = np.linalg.inv(capture.frames[i].camtoworld)
        live.push(capture.image(i), capture.K(i), viewmat, None if masks[i].all() else masks[i])
    assert live.cache_facts()["num_seen"] == driver.cache_facts()["num_seen"] == 8 * 192 - 2 * 4 * 6
    for session in (driver, live):
        np.testing.assert_array_equal(session.cache.key_views.seen[:8], masks[:8])


def test_a_continued_cache_needs_its_frame_to_be_pushed_to(capture, start):
    with pytest.raises(InputError, match="frame"):
        push(start(MODEL.init_cache()), capture, [0])


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
    # Cells below the threshold have no say.
    doubtful = dataclasses.replace(at_depths(*shares), confidences=jnp.full((1, 1, 1000), 0.3))
    assert widen_range(frame, doubtful, CAUSAL.replace(min_confidence=0.5)) is frame


def test_the_range_stops_at_its_largest_ratio(capture):
    frame = dataclasses.replace(capture.stream_frame(CAUSAL), near=1.0, far=50.0)
    for _ in range(5):
        frame = widen_range(frame, at_depths((1.0, frame.far)), CAUSAL)
    assert (frame.near, frame.far) == (1.0, 60.0)
    # A range that is wider from the start stays as it is.
    wide = dataclasses.replace(frame, near=0.01, far=200.0)
    assert widen_range(wide, at_depths((1.0, 200.0)), CAUSAL).far == 200.0


@pytest.mark.parametrize("place", ["framing", "compiling", "waiting"])
def test_an_interrupt_loses_no_view(place, capture, start, monkeypatch):
    """Until a step runs, its views wait on; while it runs, the session keeps what it will return."""
    monkeypatch.setattr("ssplat_jax.streaming.live_views.MAX_END_SHARE", -1.0)  # every chunk moves near and far
    wanted, session = start(), start()
    push(wanted, capture, range(5))
    wanted.flush()
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):

        def interrupted(*given, **more):
            raise KeyboardInterrupt

        target = {"framing": (Capture, "stream_frame"), "compiling": (session, "_program"),
                  "waiting": (jax, "block_until_ready")}[place]  # fmt: skip
        patched.setattr(*target, interrupted)
        push(session, capture, range(4))
    assert len(push(session, capture, range(4, 5))) == (place != "waiting")
    assert place != "waiting" or session.stream_frame.near < capture.stream_frame(CAUSAL).near
    session.flush()
    assert_same_bits(session.cache, wanted.cache)
    assert session.flush() is None
