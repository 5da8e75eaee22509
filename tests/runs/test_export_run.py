"""`ssplat export`: the scene at the middle exposure of its stream, upright, with a camera to start from."""

import json
import re
import zipfile

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ssplat_jax as ss
from ssplat_jax.core.gaussians import scale_colors
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.rasterizer import render
from ssplat_jax.runs.run_results import scene_to_show
from ssplat_jax.runs.scene_outputs import KnownCameras, difference_in_words, export_scene, turned
from ssplat_jax.scene_files.formats import file_axes
from ssplat_jax.streaming.session import middle_exposure
from tests.rasterizer.scenes import balls
from tests.scene_files.scene_fixture import camera, scene


def test_the_middle_exposure_is_a_median_per_channel():
    dark_first = {0: [1, 1, 1], 1: [1, 1, 1], 2: [3, 2, 0.5], 3: [3, 2, 0.5], 4: [3.3, 2, 0.4]}
    exposures = {i: np.array(e, np.float32) for i, e in dark_first.items()}
    np.testing.assert_allclose(middle_exposure(exposures), [3, 2, 0.5], rtol=1e-6)
    del exposures[4]  # of an even number, between the two middle ones
    np.testing.assert_allclose(middle_exposure(exposures), np.sqrt([3, 2, 0.5]), rtol=1e-6)
    np.testing.assert_array_equal(middle_exposure({}), [1, 1, 1])


def test_the_scene_to_show_is_at_the_middle_exposure_of_its_views():
    gaussians, factors = scene(degree=1), np.array([0.4, 1.0, 2.5], np.float32)
    frame = StreamFrame.at_camera(np.eye(4), scale=1.0, near=0.1, far=9.0)
    exposures = {i: np.full(3, e, np.float32) * factors for i, e in enumerate([1.0, 2.0, 2.0, 2.0, 3.0])}
    shown = scene_to_show(gaussians, frame, exposures)
    images = [
        np.asarray(render(g, camera()).color)
        for g in (gaussians, shown, scale_colors(gaussians, jnp.asarray(2 * factors)))
    ]
    assert images[0].std() > 0.05
    np.testing.assert_allclose(images[1], 2 * images[0] * factors, atol=4e-5)
    np.testing.assert_allclose(images[2], images[1], atol=1e-5)
    for name in ("means", "quats", "scales", "opacities"):
        np.testing.assert_allclose(getattr(shown, name), getattr(gaussians, name), atol=1e-6)


def views_from(poses: np.ndarray, exposures=None) -> KnownCameras:
    """Views of `camera()` at some poses."""
    K, num = np.asarray(camera().Ks, np.float64), len(poses)
    return KnownCameras(poses, np.tile(K, (num, 1, 1)), (48, 32), np.ones((num, 3)) if exposures is None else exposures)


UP_IN_FILE = {".ply": "y", ".sog": "z", ".glb": "y", ".spz": "z"}


@pytest.mark.parametrize("suffix", UP_IN_FILE)
def test_up_points_along_an_axis_of_the_file(tmp_path, suffix):
    """Cameras that are held level, of a tilted world, see the turned scene as they saw the scene before."""
    tilt = Rotation.from_rotvec([0.5, 0.2, -0.9]).as_matrix()
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, :3] = tilt @ Rotation.from_rotvec([[0, 0.2 * i, 0] for i in range(4)]).as_matrix()  # y down
    views = views_from(poses)
    world = turned(scene(1), tilt)
    to, up = tmp_path / f"a{suffix}", UP_IN_FILE[suffix]
    report, turn = export_scene(world, to, views, up)
    in_file = file_axes(to) @ turn @ tilt @ [0.0, -1.0, 0.0]
    np.testing.assert_allclose(in_file, np.eye(3)["xyz".index(up)], atol=1e-6)
    assert report.num_written == 60
    pose = poses[1].copy()
    pose[:3] = turn @ pose[:3]
    at = lambda pose: replace(camera(), viewmats=jnp.asarray(np.linalg.inv(pose), jnp.float32))  # noqa: E731
    before, after = render(world, at(poses[1])), render(ss.load_scene(to), at(pose))
    assert np.sqrt(np.mean((np.asarray(after.color) - np.asarray(before.color)) ** 2)) < 0.03


def test_a_sog_holds_the_camera_to_start_with(tmp_path):
    pose = np.eye(4)
    pose[:3, 3] = [0.5, 0.0, -1.0]
    export_scene(scene(0), tmp_path / "a.sog", views_from(np.stack([pose] * 3)))
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        start = json.loads(archive.read("meta.json"))["cameras"][0]["initial"]
    assert start["position"] == [0.5, 0.0, -1.0] and start["target"][:2] == [0.5, 0.0] and start["target"][2] > 1.0
    assert start["fov"] == pytest.approx(np.degrees(2 * np.arctan(16 / 40)))


def test_an_export_says_how_a_plain_renderer_shows_the_file(tmp_path):
    """A wall with a hole, and a view at twice the exposure of the file."""
    x, y = np.meshgrid(np.linspace(-1.6, 1.6, 60), np.linspace(-1.1, 1.1, 40))
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], axis=1)
    wall = balls(means[np.hypot(means[:, 0], means[:, 1]) > 0.5], 0.04, 0.99, 0.4)
    views = views_from(np.tile(np.eye(4), (3, 1, 1)), np.array([[1.0] * 3, [2.0] * 3, [1.0] * 3]))
    _, turn = export_scene(wall, tmp_path / "a.ply", views)
    words = difference_in_words(tmp_path / "a.ply", views, turn)
    holes = float(re.search(r"([\d.]+)% holes", words)[1]) / 100
    assert holes == pytest.approx(np.pi * 10**2 / 48 / 32, rel=0.35)  # a disc of half a unit at a distance of 2, 20 px
    assert "up to 2.00 times" in words and "3 views" in words
    assert difference_in_words(tmp_path / "a.splat", views, turn) is None
