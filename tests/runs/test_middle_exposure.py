"""The scene a person gets has the middle exposure of its stream, also where the first views lay in the shade."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.config import preset
from ssplat_jax.core.gaussians import Gaussians, scale_colors
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.psnr_ssim import psnr
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.rasterizer import render
from ssplat_jax.runs.finish_run import save_scene, scene_to_show
from ssplat_jax.scene_files.formats import load_ply
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.feed import middle_exposure
from ssplat_jax.streaming.session import Session
from tests.scene_files.scene_fixture import camera, scene

SHADE = 1 / 3
NUM_VIEWS = 24
MOST_LOST_DB = 1.0
GAIN_RANGE = (0.9, 1.1)


def exported(tmp_path, shade: float):
    """The scene exported after a stream whose first chunk is multiplied by `shade`, and the capture's cameras."""
    config = preset("tiny").replace(capacity=1 << 13)
    capture = open_capture("procedural:room?frames=73&size=128x96")
    frame = capture.stream_frame(config, range(NUM_VIEWS))
    order = capture.stream_order(config, range(NUM_VIEWS), frame)
    session, exposures, fed = Session(StreamSplat(config), load_params("tiny")), {}, 0
    for chunk in capture.chunks(config, order, frame=frame):
        shaded = jnp.round(255 * chunk.images * (shade if fed == 0 else 1.0)) / 255  # 8 bits, as a camera's
        out = session.feed(replace(chunk, images=shaded))
        for exposure in np.asarray(out.exposures):
            exposures[order[fed]] = exposure
            fed += 1
    save_scene(tmp_path / "scene.ply", session.gaussians(), frame, exposures)
    at_capture = StreamFrame.at_camera(np.eye(4), scale=1.0, near=0.0, far=np.inf)
    views = [(capture.camera(i, at_capture), capture.image(i)) for i in order[::3]]
    return load_ply(tmp_path / "scene.ply"), views


def mean_psnr(images, targets) -> float:
    """Mean over views, as evaluations report it."""
    shown = np.clip(images, 0.0, 1.0).astype(np.float32)
    return float(np.mean([psnr(image, target) for image, target in zip(shown, targets, strict=True)]))


@pytest.mark.slow  # twelve steps with the shipped weights
def test_a_first_chunk_in_the_shade_costs_the_export_little(tmp_path):
    (lit, views), (shaded, _) = exported(tmp_path, 1.0), exported(tmp_path, SHADE)
    of_lit, of_shaded = (np.stack([render(g, view).color for view, _ in views]) for g in (lit, shaded))
    targets = np.stack([target for _, target in views])
    gain = float(np.sum(of_shaded * of_lit) / np.sum(of_shaded**2))  # the one factor that brings them together
    assert GAIN_RANGE[0] <= gain <= GAIN_RANGE[1]
    lit_db = mean_psnr(of_lit, targets)
    shaded_db, dark_db = mean_psnr(gain * of_shaded, targets), mean_psnr(SHADE * of_lit, targets)
    print(f"{lit_db:.1f} dB lit, {shaded_db:.1f} shaded after a gain of {gain:.3f}, {dark_db:.1f} three times too dark")
    assert shaded_db >= lit_db - MOST_LOST_DB
    assert dark_db < lit_db - 5  # the picture of the scene at its first views' exposure


def test_the_middle_exposure_is_a_median_per_channel():
    dark_first = {0: [1, 1, 1], 1: [1, 1, 1], 2: [3, 2, 0.5], 3: [3, 2, 0.5], 4: [3.3, 2, 0.4]}
    exposures = {i: np.array(e, np.float32) for i, e in dark_first.items()}
    np.testing.assert_allclose(middle_exposure(exposures), [3, 2, 0.5], rtol=1e-6)
    del exposures[4]  # of an even number, between the two middle ones
    np.testing.assert_allclose(middle_exposure(exposures), np.sqrt([3, 2, 0.5]), rtol=1e-6)
    np.testing.assert_array_equal(middle_exposure({}), [1, 1, 1])


def test_scaled_colors_scale_the_picture_of_any_scene():
    gaussians, factors = scene(degree=3), jnp.array([0.4, 1.0, 2.5])
    for view in (camera(), camera(0.4)):
        before, after = (render(g, view).color for g in (gaussians, scale_colors(gaussians, factors)))
        assert float(before.std()) > 0.05
        np.testing.assert_allclose(after, before * factors, atol=2e-5)


def test_the_scene_to_show_is_at_the_middle_exposure_of_its_views():
    gaussians = scene(degree=1)
    frame = StreamFrame.at_camera(np.eye(4), scale=1.0, near=0.1, far=9.0)
    exposures = {i: np.full(3, e, np.float32) for i, e in enumerate([1.0, 2.0, 2.0, 2.0, 3.0])}
    shown = scene_to_show(gaussians, frame, exposures)
    before, after = (np.asarray(render(g, camera()).color) for g in (gaussians, shown))
    np.testing.assert_allclose(after, 2 * before, atol=2e-5)
    for field in dataclasses.fields(Gaussians):
        if field.name != "sh":
            np.testing.assert_allclose(getattr(shown, field.name), getattr(gaussians, field.name), atol=1e-6)
