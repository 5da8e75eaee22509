"""Samples to learn from, procedural and of captures: what they show, what is held out, and how steps are shared."""

import dataclasses
import json

import numpy as np
import pytest

from ssplat_jax.config import MEDIAN_DEPTH, preset
from ssplat_jax.core.errors import InputError
from ssplat_jax.data.depth_range import FAR_FACTOR
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.procedural.procedural_views import training_sample
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.storage.saved_states import first_difference
from ssplat_jax.training import loop, samples
from ssplat_jax.training.recipe import RECIPES
from tests.badinputs.cases import make_capture
from tests.streaming.narrow_model import NARROW, assert_same_bits
from tests.training.problems import STREAM_PHASE

NUM_FRAMES, SIZE = 22, (32, 48)  # height and width
VIEWS = samples.ViewSamples(num_chunks=2, sizes=(SIZE,), num_targets=3)
SMALL = samples.ViewSamples(num_chunks=1, sizes=((32, 48),))


@pytest.fixture(scope="module")
def capture():
    return open_capture(f"procedural:room?frames={NUM_FRAMES}&size=48x32")


@pytest.fixture(scope="module")
def mix(capture):
    return mix_of(capture)


def mix_of(capture, share=1.0):
    return samples.CaptureMix((samples.CaptureGroup("room", share, (capture,)),), NARROW)


def opened(views, mix=None, num_steps=4):
    """The function that makes the batches of a training with these samples."""
    return views.open(samples.TrainingStart(StreamSplat(NARROW), {}, mix, 0, num_steps, print))


def test_the_sky_stands_at_the_last_candidate_and_changes_no_scale():
    """Depths of the sky are those of the farthest candidate; median and range are those of the surfaces."""
    views, shares = dataclasses.replace(SMALL, kinds=("yard",), range_jitter=0.0), []
    for seed in range(4):
        _, depths, _, _ = training_sample(seed, 4, *SMALL.sizes[0], kinds=("yard",))
        sample = samples.procedural_sample(views, seed, SMALL.sizes[0], NARROW)
        far = float(sample.chunks.far[0])
        cells = np.exp(np.asarray(sample.log_depths))
        is_sky = np.isclose(cells, far, rtol=1e-3)
        assert cells[is_sky].max(initial=0.0) < far
        surfaces = depths[np.isfinite(depths)]
        scale = MEDIAN_DEPTH / np.median(surfaces)
        assert far == pytest.approx(FAR_FACTOR * scale * np.quantile(surfaces, 0.99), rel=1e-5)
        assert is_sky.mean() == pytest.approx(np.isinf(depths).mean(), abs=0.05)
        # The margins exclude at most the tails beyond the 1 % quantiles; the stream starts at the origin.
        assert ((cells > float(sample.chunks.near[0])) & (cells < far))[~is_sky].mean() > 0.97
        np.testing.assert_allclose(sample.chunks.viewmats[0, 0], np.eye(4), atol=1e-6)
        shares.append(is_sky.mean())
    assert max(shares) > 0.1


def test_captures_are_told_apart_without_reading_an_image(tmp_path, monkeypatch):
    found = mix_of(open_capture(make_capture(tmp_path / "a")))
    monkeypatch.setattr("builtins.open", None)
    monkeypatch.setattr("io.open", None)
    assert found.describe()[0][2] == mix_of(found.captures[0]).describe()[0][2]


def test_true_depth_of_a_cell_is_that_at_its_center():
    # A plane in log depth: a cell's center is the common corner of its pixels 1 and 2, at (2, 2).
    y, x = np.mgrid[0:8, 0:12] + 0.5
    logs = 0.01 * y - 0.005 * x
    centers_y, centers_x = np.mgrid[0:2, 0:3] * 4.0 + 2.0
    found = samples.log_depths_at_cells(np.exp(logs))
    np.testing.assert_allclose(found, 0.01 * centers_y - 0.005 * centers_x, atol=1e-6)
    # A depth edge through the center: one of the two surfaces, never a depth between them.
    logs[:, 6:] += 1.0
    assert np.abs(samples.log_depths_at_cells(np.exp(logs))[:, 1] - found[:, 1] - 1.0).max() < 0.02


def frames_of(images, capture):
    """Frame numbers of images, each found by its pixels."""
    every = np.stack([capture.image(i) for i in range(len(capture))])
    return [int(np.argmin(np.abs(every - np.asarray(image)).sum(axis=(1, 2, 3)))) for image in images]


def context_frames(sample, capture):
    return frames_of(np.asarray(sample.chunks.images).reshape(-1, *SIZE, 3), capture)


def test_samples_show_each_frame_once_and_none_that_is_held_out(mix, capture):
    seen = set()
    for seed in range(12):
        sample = samples.capture_sample(VIEWS, mix, capture, [seed], SIZE)
        context, targets = context_frames(sample, capture), frames_of(sample.target_images, capture)
        used = context + targets
        assert len(set(used)) == len(used) == 2 * NARROW.stream.chunk_size + 3
        assert min(context) < min(targets) and max(targets) < max(context)
        seen |= set(used)
    held_out = {4, 12, 20}
    assert held_out == set(range(NUM_FRAMES)) - set(samples.learned_frames(capture))
    assert not seen & held_out and len(seen) > NUM_FRAMES / 2


def test_no_two_samples_of_a_training_are_the_same():
    batch = opened(dataclasses.replace(SMALL, batch=2), num_steps=3)
    images = np.concatenate([np.asarray(batch(step, 0).chunks.images) for step in range(3)])
    assert len(np.unique(images.reshape(6, -1), axis=0)) == 6


def test_a_folder_of_captures_is_a_group_of_all_of_them(tmp_path):
    for name in ("first", "second"):
        make_capture(tmp_path / "many" / name)
    (group,) = samples.open_mix([tmp_path / "many"], [], NARROW).groups
    assert [capture.name for capture in group.captures] == ["first", "second"]


def test_poses_and_depths_of_a_sample_have_one_scale(mix, capture):
    sample = samples.capture_sample(VIEWS, mix, capture, [5], SIZE)
    np.testing.assert_allclose(np.asarray(sample.chunks.viewmats[0, 0]), np.eye(4), atol=1e-6)
    context = context_frames(sample, capture)
    centers = np.linalg.inv(np.asarray(sample.chunks.viewmats, np.float64).reshape(-1, 4, 4))[:, :3, 3]
    true = capture.camtoworlds[context][:, :3, 3]
    scales = np.linalg.norm(centers[1:], axis=1) / np.linalg.norm(true[1:] - true[0], axis=1)
    np.testing.assert_allclose(scales, scales[0], rtol=1e-4)
    depths = samples.log_depths_at_cells(np.stack([scales[0] * capture.depth(i) for i in context]))
    found = np.asarray(sample.log_depths).reshape(depths.shape)
    np.testing.assert_allclose(found, depths, atol=1e-4)
    near, far = float(sample.chunks.near[0]), float(sample.chunks.far[0])
    assert np.mean((np.exp(found) > near) & (np.exp(found) < far)) > 0.9
    # Scale and range are a little wrong, as estimated ones are, each by a factor of its own.
    known = mix.frame_of(capture)
    errors = np.log([scales[0] / known.scale, near / scales[0] / (known.near / known.scale)])
    assert np.all(np.abs(errors) <= VIEWS.range_jitter + 1e-4) and np.abs(errors).min() > 1e-3


def test_with_the_paper_recipe_poses_and_range_are_those_of_the_capture(capture):
    """So voxels of 0.04 measure 0.04 of its units, whatever the size of the scene."""
    config, (phase,) = preset("paper"), RECIPES["paper"].phases
    views = dataclasses.replace(phase.samples, num_chunks=2, num_targets=2, sizes=(SIZE,))
    mix = samples.CaptureMix((samples.CaptureGroup("room", 1.0, (capture,)),), config)
    sample, known = samples.capture_sample(views, mix, capture, [5], SIZE), mix.frame_of(capture)
    centers = np.linalg.inv(np.asarray(sample.chunks.viewmats, np.float64).reshape(-1, 4, 4))[:, :3, 3]
    true = capture.camtoworlds[context_frames(sample, capture)][:, :3, 3]
    np.testing.assert_allclose(*(np.linalg.norm(x - x[0], axis=1) for x in (centers, true)), atol=1e-4)
    np.testing.assert_allclose([sample.chunks.near[0], sample.chunks.far[0]], [known.near, known.far], rtol=1e-5)


def with_depth_maps(capture, has_depth):
    """The capture, with the depth maps of the frames of which `has_depth` is true alone."""

    class Pixels:
        image = staticmethod(capture.pixels.image)
        seen = staticmethod(capture.pixels.seen)
        version = staticmethod(capture.pixels.version)
        depth = staticmethod(lambda i: capture.pixels.depth(i) if has_depth(i) else None)

    Pixels.has_depth = staticmethod(has_depth)
    return dataclasses.replace(capture, pixels=Pixels())


def test_frames_without_depth_have_unknown_depths(mix, capture):
    sample = samples.capture_sample(VIEWS, mix, with_depth_maps(capture, lambda i: False), [5], SIZE)
    assert np.isnan(np.asarray(sample.log_depths)).all()
    assert np.isfinite(np.asarray(sample.chunks.images)).all()


def test_masks_of_a_capture_are_masks_of_its_samples(capture):
    """A procedural step beside it has masks that hide nothing, so that one program serves both."""
    masks = np.ones((NUM_FRAMES, *SIZE), bool)
    masks[::2, 5:15] = False
    frames = tuple(dataclasses.replace(f, is_masked=i % 2 == 0) for i, f in enumerate(capture.frames))
    pixels = dataclasses.replace(capture.pixels, masks=masks)
    mix = mix_of(dataclasses.replace(capture, frames=frames, pixels=pixels), share=0.5)
    drawn = list(map(opened(VIEWS, mix), range(8), [0] * 8))
    shares = [np.mean(sample.target_seen) for sample in drawn]
    assert 1.0 in shares and min(shares) < 1
    hidden = next(sample for sample in drawn if not sample.chunks.seen.all())
    for view in np.concatenate([hidden.chunks.seen.reshape(-1, *SIZE), hidden.target_seen.reshape(-1, *SIZE)]):
        assert view.all() or not view[6:14].any()


def test_steps_are_shared_as_asked(capture):
    other = dataclasses.replace(capture)
    groups = (samples.CaptureGroup("a", 0.2, (capture,)), samples.CaptureGroup("b", 0.5, (other,)))
    drawn = [samples.CaptureMix(groups, NARROW).draw(np.random.default_rng([0, step])) for step in range(3000)]
    rates = [np.mean([x is source for x in drawn]) for source in (capture, other, None)]
    np.testing.assert_allclose(rates, (0.2, 0.5, 0.3), atol=0.03)


def test_procedural_steps_stay_those_of_a_run_without_captures(mix, capture):
    views = dataclasses.replace(SMALL, num_targets=1)
    rarely, without, always = opened(views, mix_of(capture, 1e-9)), opened(views), opened(views, mix)
    for step in (0, 3):
        assert_same_bits(rarely(step, step), without(step, step))
    assert always(3, 3).chunks.images.shape == without(3, 3).chunks.images.shape  # one program serves both
    assert not np.array_equal(always(3, 3).target_images, without(3, 3).target_images)


def test_a_capture_needs_the_frames_of_a_sample_and_depth_where_nothing_is_rendered(capture, tmp_path):
    views = STREAM_PHASE.samples
    short = [dataclasses.replace(capture, frames=capture.frames[:count]) for count in (9, 10)]
    with pytest.raises(InputError, match=r"at least 9 frames besides .* got 8"):
        views.check(mix_of(short[0]), NARROW, renders=True)
    views.check(mix_of(short[1]), NARROW, renders=True)
    photographs, one = (with_depth_maps(capture, has) for has in (lambda i: False, lambda i: i == 3))
    with pytest.raises(InputError, match=r"depth maps, .* got none; leave it out, or choose a recipe that renders"):
        loop.train(NARROW, RECIPES["tiny"], tmp_path / "out", mix=mix_of(photographs))
    assert not (tmp_path / "out").exists()
    views.check(mix_of(photographs), NARROW, renders=True)
    views.check(mix_of(one), NARROW, renders=False)


def test_a_run_with_other_files_of_a_capture_is_another_run(tmp_path):
    def described():
        run = loop.describe_run(NARROW, RECIPES["tiny"], "random", mix_of(open_capture(tmp_path / "c")), None)
        return json.loads(json.dumps(run))

    make_capture(tmp_path / "c")
    before = described()
    assert described() == before
    file = tmp_path / "c" / "images" / "2.jpg"
    file.write_bytes(file.read_bytes() + b"\0")
    assert first_difference(before, described())[0].startswith("captures[0][2][0]")
