"""The stream as a whole: step, scan, decoding and session, with one narrow model and one procedural capture."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.core.kept_programs import Kept
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.model.decoder import grown_footprints
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.streaming.session import Session
from tests.model.small import random_params
from tests.streaming.narrow_model import NARROW, assert_same_bits, leaves_with_names

MODEL = StreamSplat(NARROW)
STEP = jax.jit(MODEL.step, donate_argnums=1)
"""The jitted step as the documentation writes it: its cache argument is donated."""


@pytest.fixture(scope="module")
def params():
    return random_params(NARROW, seed=1)


@pytest.fixture(scope="module")
def chunks():
    return list(open_capture("procedural:room?frames=12&size=64x48").chunks(NARROW))


@pytest.fixture(scope="module")
def looped(params, chunks):
    """The last cache and all outputs of a Python loop over the jitted step, and the number of compilations."""
    cache = MODEL.init_cache()
    outputs = []
    for chunk in chunks:
        cache, out = STEP(params, cache, chunk)
        outputs.append(out)
    return cache, outputs, STEP._cache_size()


def test_scan_equals_loop_bit_for_bit(params, chunks, looped):
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *chunks)
    cache, outputs = jax.jit(MODEL.run)(params, MODEL.init_cache(), stacked)
    assert_same_bits(cache, looped[0])
    depths = np.stack([np.asarray(out.depths) for out in looped[1]])
    np.testing.assert_array_equal(np.asarray(outputs.depths), depths)


def test_a_stream_is_one_program_that_reads_its_history_and_counts_every_token(chunks, looped):
    cache, outputs, num_compilations = looped
    assert num_compilations == 1
    assert [bool(out.history.any()) for out in outputs] == [False, True, True]
    stats = jax.tree.map(int, cache.stats)
    assert stats.num_chunks == len(chunks) and stats.num_seen == sum(len(chunk.valid) for chunk in chunks) * 16 * 12
    rejected = stats.num_low_confidence + stats.num_non_finite + stats.num_out_of_range + stats.num_dropped
    assert 0 < stats.num_accepted == stats.num_seen - rejected
    alive = np.asarray(cache.alive)
    for feats in (np.asarray(cache.feats), np.asarray(cache.seeds)):
        # A weighted mean of vectors of unit RMS has at most unit RMS: what comes back through CGFI does not grow.
        assert np.sqrt((feats[alive] ** 2).mean(axis=-1)).max() <= 1.0 + 1e-4


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "detail"])
def decoded(request, params, looped):
    """A model that carves half of the pivots of the last cache, its scene, and the mask of shown pivots."""
    cache = looped[0]
    tau = float(np.median(cache.confidences[cache.alive]))
    model = StreamSplat(NARROW.replace(min_confidence=tau, detail=request.param))
    is_shown = np.asarray(cache.alive & (cache.confidences >= tau)).reshape(-1)
    assert 0 < is_shown.sum() < np.asarray(cache.alive).sum()
    return model, jax.jit(model.decode)(params, cache), is_shown


def test_dead_and_carved_pivots_are_absent(decoded, looped):
    model, gaussians, is_shown = decoded
    opacities = np.asarray(gaussians.opacities).reshape(len(is_shown), -1)
    assert (opacities[is_shown] > 0).any(axis=1).all() and (opacities[~is_shown] == 0).all()
    if not model.config.additions.detail:
        assert (opacities[is_shown] > 0).all()
        centers = np.asarray(gaussians.means).reshape(len(is_shown), -1, 3).mean(axis=1)
        np.testing.assert_allclose(centers[is_shown], looped[0].means.reshape(-1, 3)[is_shown], atol=1e-5)


def test_a_session_decodes_shown_rows_padded_to_a_power_of_two(decoded, params, looped, monkeypatch):
    monkeypatch.setattr("ssplat_jax.streaming.session.MIN_DECODED_PIVOTS", 1)
    (model, whole, is_shown), is_present = decoded, np.asarray(decoded[1].opacities) > 0
    session = Session(model, params, looped[0])
    shown, num_shown = session.gaussians(), is_present.sum()
    most = model.config.head.gaussians_per_token * is_shown.sum()
    assert (num_shown < most) == model.config.additions.detail and session.cache_facts()["decoded"] == num_shown
    assert shown.num_gaussians.bit_count() == 1 and num_shown <= shown.num_gaussians < 2 * num_shown
    for (name, compact), (_, full) in zip(leaves_with_names(shown), leaves_with_names(whole), strict=True):
        np.testing.assert_allclose(compact[:num_shown], full[is_present], rtol=1e-5, atol=1e-6, err_msg=name)
    assert not np.asarray(shown.opacities)[num_shown:].any()


@pytest.mark.parametrize("decoded", [True], indirect=True)
def test_rows_that_hold_a_gaussian_are_those_of_shown_pivots(decoded, params, looped):
    """Decoding all pivots leaves out carved ones, which have colors and opacities of their own."""
    (model, whole, _), cache = decoded, looped[0]
    is_present, pivots = np.asarray(whole.opacities) > 0, jnp.arange(cache.confidences.size)
    rows = jax.jit(model.decode_rows, static_argnums=3)(params, cache, pivots, int(is_present.sum()) + 64)
    assert not np.asarray(rows.opacities)[is_present.sum() :].any()
    np.testing.assert_allclose(rows.means[: is_present.sum()], whole.means[is_present], rtol=1e-5, atol=1e-6)


def test_footprints_of_merged_pivots_grow_until_they_cover_a_face():
    """Voxels measure 0.04 and have 4 pivots: 1.2 times a share of 0.02. With `detail` they are no wider than tokens."""
    detailed = grown_footprints(*(x := (jnp.array([0.01, 0.07]), jnp.array([100, 100]))), NARROW)
    np.testing.assert_array_equal(detailed, x[0])
    config = NARROW.replace(detail=False)
    footprints, members = jnp.array([0.01, 0.01, 0.01, 0.05]), jnp.array([1, 2, 100, 100])
    grown = grown_footprints(footprints, members, config)
    np.testing.assert_allclose(grown, [0.01, 0.01 * 2**0.5, 0.024, 0.05], rtol=1e-6)
    assert grown_footprints(footprints, members, config.replace(merged_coverage=False)) is footprints


def test_session_compiles_once_and_keeps_its_memory(params, chunks, looped, monkeypatch):
    """A cache that may grow starts large enough for the first chunks, whatever capacity is configured."""
    monkeypatch.setattr(Kept, "program", lambda kept, *given: STEP.lower(*given).compile())  # JAX has it: saves time
    session = Session(StreamSplat(NARROW.replace(capacity=128, overflow="grow")), params)
    session.expected_chunks, memory = 8, []  # as many rows as the fixtures' cache: JAX may have that program
    for chunk in chunks:
        session.feed(chunk)
        memory.append(session.step_memory_bytes)
    assert session.num_compilations == 1
    assert memory[0] is not None and len(set(memory)) == 1


@pytest.mark.parametrize("extras", [(), ("seen",), ("depths",), ("seen", "depths")])
def test_the_step_that_is_compiled_ahead_has_the_shapes_of_the_stream(params, chunks, extras, monkeypatch):
    class Interrupted(jax.stages.Compiled):
        def __init__(self):
            pass

        def __call__(self, *given):
            raise KeyboardInterrupt

    compiled, shapes = [], lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype), tree)
    monkeypatch.setattr(Kept, "program", lambda kept, _, *given: compiled.append(shapes(given)) or Interrupted())
    session = Session(MODEL, params)
    session.compile_ahead(64, 48, 100, is_masked="seen" in extras, brings_depth="depths" in extras)
    maps = {name: jnp.ones(chunks[0].images.shape[:3], bool if name == "seen" else np.float32) for name in extras}
    chunk = replace(chunks[0], **maps)
    with pytest.raises(KeyboardInterrupt):
        session.feed(chunk)
    assert compiled == [shapes((session.cache, chunk))]


def test_padding_views_may_hold_anything_and_padded_chunks_change_nothing(params, chunks):
    """NaN times a weight of 0 would be NaN."""
    valid = chunks[0].valid.at[3].set(False)
    results = []
    for value in (0.5, jnp.nan, jnp.inf):
        fields = {name: getattr(chunks[0], name).at[3].set(value) for name in ("images", "viewmats", "Ks")}
        results.append(STEP(params, MODEL.init_cache(), replace(chunks[0], valid=valid, **fields)))
    assert int(results[0][0].stats.num_seen) == 3 * 16 * 12
    for result in results[1:]:
        assert_same_bits(result, results[0])
    after, _ = STEP(params, jax.tree.map(jnp.copy, results[0][0]), replace(chunks[0], valid=jnp.zeros(4, bool)))
    assert_same_bits(after, results[0][0], except_fields=("num_chunks",))


def test_streaming_in_float64_is_refused(params, chunks):
    cache = MODEL.init_cache()
    with jax.enable_x64(True), pytest.raises(InputError, match=r"wanted JAX's default, float32.*enable_x64\(False\)"):
        jax.eval_shape(MODEL.step, params, cache, chunks[0])
