"""Learning from captures: what samples show, what is held out, and how steps are shared."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.commands.train_command import Train
from ssplat_jax.core.errors import InputError
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.evaluation.lpips import LpipsWeights
from ssplat_jax.storage.saved_states import first_difference
from ssplat_jax.training import loop
from ssplat_jax.training.capture_samples import (
    CaptureGroup,
    CaptureMix,
    capture_sample,
    learned_frames,
    open_mix,
    validation_sample,
)
from ssplat_jax.training.losses import MAX_GAIN, fitted_gains
from ssplat_jax.training.recipe import TINY, Phase, Recipe, smoke_recipe
from ssplat_jax.training.samples import log_depths_at_cells
from ssplat_jax.training.step_samples import sample_for_step, validation_samples
from tests.badinputs.cases import make_capture
from tests.data.capture_writers import write_depth
from tests.streaming.narrow_model import NARROW

NUM_FRAMES, SIZE = 22, (64, 96)  # height and width
FORM = {"num_chunks": 2, "size": SIZE, "config": NARROW}


@pytest.fixture(scope="module")
def capture():
    return open_capture(f"procedural:room?frames={NUM_FRAMES}&size=96x64")


@pytest.fixture(scope="module")
def mix(capture):
    return CaptureMix((CaptureGroup("room", 1.0, (capture,)),), NARROW)


def frames_of(images, capture):
    """Frame numbers of images, each found by its pixels."""
    every = np.stack([capture.image(i) for i in range(len(capture))])
    return [int(np.argmin(np.abs(every - np.asarray(image)).sum(axis=(1, 2, 3)))) for image in images]


def context_frames(sample, capture):
    return frames_of(np.asarray(sample.chunks.images).reshape(-1, *SIZE, 3), capture)


def test_samples_show_each_frame_once_and_none_that_is_held_out(mix, capture):
    seen = set()
    for seed in range(12):
        sample = capture_sample(mix, capture, [seed], num_targets=3, **FORM)
        context, targets = context_frames(sample, capture), frames_of(sample.target_images, capture)
        used = context + targets
        assert len(set(used)) == len(used) == 2 * NARROW.stream.chunk_size + 3
        assert min(context) < min(targets) and max(targets) < max(context)
        seen |= set(used)
    held_out = {4, 12, 20}
    assert held_out == set(range(NUM_FRAMES)) - set(learned_frames(capture))
    assert not seen & held_out and len(seen) > NUM_FRAMES / 2


def test_a_validation_shows_a_held_out_frame_between_others(mix, capture):
    for seed in range(4):
        sample = validation_sample(mix, capture, [seed], **FORM)
        context, (target,) = context_frames(sample, capture), frames_of(sample.target_images, capture)
        assert target in (4, 12, 20) and min(context) < target < max(context)
        assert not set(context) & {4, 12, 20}
    again = validation_sample(mix, capture, [3], **FORM)
    np.testing.assert_array_equal(np.asarray(again.target_images), np.asarray(sample.target_images))
    phase = Phase("stream", 1, num_chunks=2, num_targets=1, sizes=(SIZE,), learning_rate=1e-3)
    assert len(validation_samples(mix, phase, NARROW)) == 1  # one a capture


def test_poses_and_depths_of_a_sample_have_one_scale(mix, capture):
    sample = capture_sample(mix, capture, [5], num_targets=2, **FORM)
    np.testing.assert_allclose(np.asarray(sample.chunks.viewmats[0, 0]), np.eye(4), atol=1e-6)
    context = context_frames(sample, capture)
    centers = np.linalg.inv(np.asarray(sample.chunks.viewmats, np.float64).reshape(-1, 4, 4))[:, :3, 3]
    true = capture.camtoworlds[context][:, :3, 3]
    scales = np.linalg.norm(centers[1:], axis=1) / np.linalg.norm(true[1:] - true[0], axis=1)
    np.testing.assert_allclose(scales, scales[0], rtol=1e-4)
    depths = log_depths_at_cells(np.stack([scales[0] * capture.depth(i) for i in context]))
    found = np.asarray(sample.log_depths).reshape(depths.shape)
    np.testing.assert_allclose(found, depths, atol=1e-4)
    near, far = float(sample.chunks.near[0]), float(sample.chunks.far[0])
    assert np.mean((np.exp(found) > near) & (np.exp(found) < far)) > 0.9
    # Scale and range are a little wrong, as estimated ones are, each by a factor of its own.
    known, jitter = mix.frame_of(capture), Recipe.range_jitter
    errors = np.log([scales[0] / known.scale, near / scales[0] / (known.near / known.scale)])
    assert np.all(np.abs(errors) <= jitter + 1e-4) and np.abs(errors).min() > 1e-3


def test_frames_without_depth_have_unknown_depths(mix, capture):
    class Blind:
        image = staticmethod(capture.pixels.image)
        depth = staticmethod(lambda i: None)
        has_depth = staticmethod(lambda i: False)

    blind = dataclasses.replace(capture, pixels=Blind())
    sample = capture_sample(mix, blind, [5], num_targets=0, **FORM)
    assert np.isnan(np.asarray(sample.log_depths)).all()
    assert np.isfinite(np.asarray(sample.chunks.images)).all()


def test_steps_are_shared_as_asked(capture):
    other = dataclasses.replace(capture)
    groups = (CaptureGroup("a", 0.2, (capture,)), CaptureGroup("b", 0.5, (other,)))
    drawn = [CaptureMix(groups, NARROW).draw(np.random.default_rng([0, step])) for step in range(3000)]
    rates = [np.mean([x is source for x in drawn]) for source in (capture, other, None)]
    np.testing.assert_allclose(rates, (0.2, 0.5, 0.3), atol=0.03)


@pytest.mark.slow
def test_procedural_steps_stay_those_of_a_run_without_captures(mix, capture):
    recipe = smoke_recipe(4)
    rarely = CaptureMix((CaptureGroup("room", 1e-9, (capture,)),), NARROW)
    for step in (0, 3):
        with_captures, without = (sample_for_step(step, recipe, NARROW, m) for m in (rarely, None))
        jax.tree.map(lambda a, b: np.testing.assert_array_equal(np.asarray(a), np.asarray(b)), with_captures, without)
    always = sample_for_step(3, recipe, NARROW, mix)
    assert always.chunks.images.shape == without.chunks.images.shape  # one program serves both
    assert not np.array_equal(np.asarray(always.target_images), np.asarray(without.target_images))


@pytest.mark.parametrize(
    ("folders", "shares", "message"),
    [
        (["here"], [0.7, 0.1], r"--shares: wanted 1 numbers .* got 0\.7 0\.1"),
        (["here", "there"], [0.7, 0.4], "add up to at most 1"),
        (["here"], [0.0], "above 0"),
        (["here"], [float("nan")], "above 0"),
        (["no/such/folder"], [], "nothing of that name"),
    ],
)
def test_captures_that_cannot_be_learned_from_are_refused(folders, shares, message):
    with pytest.raises(InputError, match=message):
        open_mix([Path(folder) for folder in folders], shares, NARROW, smoke_recipe(4))


def test_a_capture_needs_the_frames_of_a_sample(capture, monkeypatch):
    opened = lambda path, size: dataclasses.replace(capture, frames=capture.frames[: int(str(path))])  # noqa: E731
    monkeypatch.setattr("ssplat_jax.training.capture_samples.open_capture", opened)
    with pytest.raises(InputError, match=r"at least 9 frames besides .* got 8"):
        open_mix([Path("9")], [], NARROW, smoke_recipe(4))
    (group,) = open_mix([Path("10")], [], NARROW, smoke_recipe(4)).groups
    assert group.share == 0.5 and len(group.captures[0]) == 10


def test_photographs_alone_are_refused_where_nothing_is_rendered(capture, monkeypatch):
    class Photographs:
        image = staticmethod(capture.pixels.image)
        depth = staticmethod(lambda i: None)
        has_depth = staticmethod(lambda i: False)

    without = dataclasses.replace(capture, pixels=Photographs())
    monkeypatch.setattr("ssplat_jax.training.capture_samples.open_capture", lambda path, size: without)
    with pytest.raises(InputError, match=r"depth maps, .* got none; leave it out, or choose a recipe that renders"):
        open_mix([Path("photographs")], [], NARROW, TINY)
    open_mix([Path("photographs")], [], NARROW, smoke_recipe(4))
    Photographs.has_depth = staticmethod(lambda i: i == 3)
    open_mix([Path("one depth map")], [], NARROW, TINY)


def test_shares_need_captures(tmp_path):
    with pytest.raises(InputError, match="--captures beside it"):
        Train(out=tmp_path, shares=(0.5,)).run()


def test_a_run_with_other_captures_is_not_continued(mix, capture):
    descriptions = [
        loop.describe_run(NARROW, TINY, loop.RANDOM, mix=m)
        for m in (None, mix, CaptureMix((CaptureGroup("room", 0.5, (capture,)),), NARROW))
    ]
    assert "captures" not in descriptions[0]  # as runs were described before there were captures
    assert descriptions[1] != descriptions[2] and json.loads(json.dumps(descriptions[1])) is not None


@pytest.mark.parametrize("spoiled", ["images/2.jpg", "depth/2.png", "transforms.json"])
def test_a_run_with_other_files_of_a_capture_is_not_continued(spoiled, tmp_path):
    def described():
        group = CaptureGroup("one", 1.0, (open_capture(tmp_path / "c"),))
        mix = CaptureMix((group,), NARROW)
        return json.loads(json.dumps(loop.describe_run(NARROW, TINY, loop.RANDOM, mix=mix)))

    def with_depth(root, meta):
        for frame in meta["frames"][1:]:
            number = Path(frame["file_path"]).stem
            frame["depth_file_path"] = f"depth/{number}.png"
            write_depth(root / "depth" / f"{number}.png", 1500)

    make_capture(tmp_path / "c", with_depth)
    before = described()
    assert described() == before
    file = tmp_path / "c" / spoiled
    if spoiled == "transforms.json":  # a frame more has a depth map
        file.write_text(file.read_text().replace('"file_path"', '"depth_file_path": "depth/2.png", "file_path"', 1))
    else:
        file.write_bytes(file.read_bytes() + b"\0")
    now = described()
    assert first_difference(before, now)[0] == "captures[0].files.0 c"


def test_a_run_with_other_lpips_weights_is_not_continued():
    first, second = (LpipsWeights((), (), (jnp.full(3, x),)) for x in (1.0, 2.0))
    described = [loop.describe_run(NARROW, TINY, loop.RANDOM, lpips_weights=w) for w in (first, second)]
    assert first_difference(*described)[0] == "lpips_weights"


def test_fitted_gains_undo_exposures_and_stay_bounded():
    rng = np.random.default_rng(0)
    images = jnp.asarray(rng.uniform(0.1, 0.9, (3, 6, 5, 3)), jnp.float32)
    true = np.array([[0.7, 1.0, 1.4], [5.0, 0.01, 1.2]], np.float32)
    targets = jnp.concatenate([images[:2] * true[:, None, None], images[2:]])
    images = images.at[2].set(0.0)
    gains = np.asarray(fitted_gains(images, targets))[:, 0, 0]
    np.testing.assert_allclose(gains[0], true[0], rtol=1e-5)
    np.testing.assert_allclose(gains[1], [MAX_GAIN, 1 / MAX_GAIN, 1.2], rtol=1e-5)
    np.testing.assert_array_equal(gains[2], 1.0)  # nothing rendered
    gradient = jax.grad(lambda x: fitted_gains(x, targets).sum())(images)
    np.testing.assert_array_equal(np.asarray(gradient), 0.0)


@pytest.mark.slow  # compiles a whole training step and the validation
def test_training_on_a_capture_logs_held_out_scores(mix, tmp_path):
    recipe = dataclasses.replace(smoke_recipe(2), fit_gains=True)
    with jax.numpy_dtype_promotion("standard"):
        result = loop.train(NARROW, recipe, tmp_path, mix=mix, log_every=1, validate_every=1)
    assert result.step == 2
    records = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    scored = [record for record in records if "validation_psnr" in record]
    assert [record["step"] for record in scored] == [2]  # the phase of depth renders nothing
    assert 3 < scored[0]["validation_psnr"] < 60 and "validation_psnr_over_black" in scored[0]
