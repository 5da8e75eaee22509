"""Depth that a sensor measured: how it anchors the matcher's distribution, and how captures and live views bring it."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from ssplat_jax.config import preset
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.model.hpda import SENSOR_GAMMA, SENSOR_WIDTH, anchor_depth, cell_depths, sensor_anchor
from ssplat_jax.model.views import DepthDistribution, prepare_views
from ssplat_jax.streaming.live_views import LiveViews
from tests.badinputs.cases import make_capture
from tests.model.small import CONFIG, chunk, finite, history

D = 24
WINDOW = CONFIG.replace(num_depths=D, depth_readout="window", hpda=False)
TINY = preset("tiny")
LOG_CANDIDATES = jnp.linspace(0.0, jnp.log(6.0), D)


@jax.jit
def read_depth(logits, candidates, depths):
    """Depths, confidences and probabilities read for the measured depths of the views of a chunk, and the views."""
    views = replace(prepare_views(replace(chunk(), depths=depths), WINDOW), log_candidates=candidates)
    distribution = DepthDistribution(jax.nn.softmax(logits), logits, jnp.zeros((*views.inside.shape, 8)))
    remembered = history(np.zeros((3, 8, 8)), np.zeros((3, 8, 8)))
    return anchor_depth({}, distribution, remembered, views, WINDOW), views


def anchored(depths, logits):
    logits = jnp.asarray(np.broadcast_to(logits, (3, 8, 8, D)), jnp.float32)
    return read_depth(logits, LOG_CANDIDATES, None if depths is None else jnp.asarray(depths, jnp.float32))


def test_a_cell_has_the_lower_median_of_its_known_depths():
    rng = np.random.default_rng(0)
    unknown = rng.choice([0.0, -2.0, np.nan, np.inf], (2, 12, 16))
    depths = np.where(rng.uniform(size=(2, 12, 16)) < 0.6, rng.uniform(1, 5, (2, 12, 16)), unknown)
    got = np.asarray(cell_depths(jnp.asarray(depths, jnp.float32), 4))
    num_empty = 0
    for v, i, j in np.ndindex(2, 3, 4):
        known = np.sort(depths[v, 4 * i : 4 * i + 4, 4 * j : 4 * j + 4].ravel())
        known = known[(known > 0) & np.isfinite(known)]
        num_empty += known.size < 8
        wanted = known[(known.size - 1) // 2] if known.size >= 8 else 0.0
        np.testing.assert_allclose(got[v, i, j], wanted, rtol=1e-6)
    assert 0 < num_empty < 24


@pytest.mark.parametrize("space", ["log", "inverse"])
def test_the_anchor_is_a_gaussian_where_candidates_are_uniform(space):
    config = CONFIG.replace(network="resplat").replace(num_depths=D, depth_space=space)
    to_space = np.log if space == "log" else lambda depth: 1 / depth
    uniform = np.linspace(to_space(0.5), to_space(8.0), D)
    candidates = jnp.asarray(uniform if space == "log" else -np.log(uniform), jnp.float32)
    depths = np.array([0.5, 1.234, 7.9])
    got = sensor_anchor(jnp.asarray(depths, jnp.float32)[None, None], candidates, config)[0, 0]
    offsets = (uniform - to_space(depths)[:, None]) / (SENSOR_WIDTH * abs(uniform[1] - uniform[0]))
    np.testing.assert_allclose(got, np.exp(-0.5 * offsets**2), atol=2e-5)


def test_a_measured_depth_is_read_between_candidates_whatever_the_matcher_says():
    depths = np.exp(np.random.default_rng(1).uniform(0.3, 1.5, (3, 6, 8)))
    pixels = np.repeat(np.repeat(depths, 4, axis=1), 4, axis=2)[:, :24, :30]
    step = float(LOG_CANDIDATES[1])
    for logits in (np.zeros(D), 50.0 * np.eye(D)[2]):  # a matcher that knows nothing, and one that is sure of another
        depth, views = anchored(pixels, logits)
        is_measured = np.asarray(views.inside)[:, :6, :7]
        errors = np.abs(np.asarray(depth.log_depths)[:, :6, :7] - np.log(depths)[:, :, :7])[is_measured]
        far_off = np.abs(np.log(depths)[:, :, :7][is_measured] - float(LOG_CANDIDATES[2])) > 5 * step
        assert errors[far_off].max() < 0.02 * step
        # It counts as the matcher's own confidence, which the cache stores.
        assert np.asarray(depth.matcher_confidences)[:, :6, :7][is_measured].min() > 0.8


def test_a_sure_matcher_keeps_a_share_of_its_mass_against_a_sensor():
    depth, _ = anchored(np.full((3, 24, 30), float(jnp.exp(LOG_CANDIDATES[18]))), 50.0 * np.eye(D)[2])
    mass = SENSOR_GAMMA * np.exp(-0.5 * ((np.arange(D) - 18) / SENSOR_WIDTH) ** 2).sum()
    np.testing.assert_allclose(depth.probs[0, 0, 0, 2], 1 / (1 + mass), rtol=1e-4)


def test_an_unknown_depth_changes_no_bit_of_what_is_read():
    """All that the network reads of measured depths are the anchors; here every cell has all four unknown ones."""
    logits = np.random.default_rng(2).normal(size=(3, 8, 8, D))
    unknown = np.resize([0.0, -1.0, np.nan, np.inf], (3, 24, 30))
    jax.tree.map(np.testing.assert_array_equal, anchored(unknown, logits)[0], anchored(None, logits)[0])


def test_gradients_stay_finite_at_any_measured_depth():
    @jax.jit
    @functools.partial(jax.value_and_grad, argnums=(0, 1))
    def total(logits, candidates, depth):
        read, _ = read_depth(logits, candidates, jnp.full((3, 24, 30), depth))
        return read.log_depths.sum() + read.matcher_confidences.sum()

    for depth in (1e-30, 1.0, 6.0, 1e30):
        for candidates in (LOG_CANDIDATES, jnp.full(D, 0.7)):  # near = far too
            assert finite(total(jnp.zeros((3, 8, 8, D)), candidates, jnp.float32(depth)))


def test_depth_maps_of_a_capture_stream_in_stream_units_unless_they_are_left_out(tmp_path):
    def with_depths(root, meta):  # of frames 0 and 2, at 1 and 3 meters
        for i in (0, 2):
            Image.fromarray(np.full((24, 32), 1000 * (i + 1), np.uint16)).save(root / f"d{i}.png")
            meta["frames"][i]["depth_file_path"] = f"d{i}.png"

    path = make_capture(tmp_path / "c", with_depths)
    capture, without = open_capture(path), open_capture(f"{path}?depth=off")
    stream_frame = dataclasses.replace(capture.stream_frame(TINY), scale=2.5)
    first, other = (next(iter(c.chunks(TINY, [0, 1, 2, 3], stream_frame=stream_frame))) for c in (capture, without))
    np.testing.assert_allclose([np.median(x) for x in first.depths], [2.5, 0.0, 7.5, 0.0], rtol=1e-6)
    assert other.depths is None
    # A run is not continued with other maps.
    assert capture.files_digest(0) != without.files_digest(0)
    assert capture.files_digest(1) == without.files_digest(1)


@pytest.fixture(scope="module")
def exact():
    """A capture that streams its depths, which are exact."""
    return open_capture("procedural:room?frames=12&size=64x48&depth=on")


def test_exact_depths_of_procedural_scenes_stream_only_where_they_are_asked_for(exact):
    plain = open_capture("procedural:room?frames=12&size=64x48")
    stream_frame = exact.stream_frame(TINY)
    first, other = (next(iter(c.chunks(TINY, range(4), stream_frame=stream_frame))) for c in (exact, plain))
    np.testing.assert_allclose(first.depths, [stream_frame.scale * exact.depth(i) for i in range(4)], rtol=1e-6)
    assert other.depths is None
    with pytest.raises(InputError, match="depth: wanted on or off"):
        open_capture("procedural:room?depth=yes")


def test_pushed_depths_make_the_chunk_of_a_capture_that_has_them(exact):
    live = LiveViews(TINY)
    for i in range(4):
        depth = exact.depth(i) if i != 1 else None
        got = live.add(exact.image(i), exact.K(i), exact.camera(i).viewmats, depth=depth)
    assert got is not None and live.stream_frame is not None
    for v in range(4):
        wanted = np.zeros((48, 64)) if v == 1 else live.stream_frame.scale * exact.depth(v)
        np.testing.assert_allclose(got.depths[v], wanted, rtol=1e-5)
    with pytest.raises(InputError, match="push: depth"):
        live.add(exact.image(0), exact.K(0), exact.camera(0).viewmats, depth=np.ones((48, 64), np.uint16))


def test_depth_maps_of_another_unit_than_the_poses_are_named(exact):
    assert exact.stream_frame(TINY).warning is None
    feet = dataclasses.replace(exact.pixels, depths=3.28 * exact.pixels.depths)
    for streams_depth, is_named in ((True, True), (False, False)):
        warning = dataclasses.replace(exact, pixels=feet, streams_depth=streams_depth).stream_frame(TINY).warning
        assert (warning is not None and "times that of the matches" in warning) == is_named
