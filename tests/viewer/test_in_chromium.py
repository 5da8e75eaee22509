"""The viewer in headless Chromium, with pictures compared. Skipped where there is no Chromium.

pytest -m slow -n 0 tests/viewer
"""

import contextlib
import threading
import time

import jax.numpy as jnp
import numpy as np
import pytest

import ssplat_jax as ss
from ssplat_jax.core.cameras import Camera
from ssplat_jax.data.posed_image import invert_pose, pose_from_quat
from ssplat_jax.rasterizer import Effects
from ssplat_jax.viewer.scene_sources import open_source
from ssplat_jax.viewer.stage import Stage
from ssplat_jax.viewer.view_scene import Viewer
from tests.viewer.chromium import Page, find_chromium, wait_for
from tests.viewer.fake_client import free_port, scene

pytestmark = pytest.mark.slow

BROWSER_DB = 38.0  # of the browser's splats against ours: 8 bits, 16-bit covariances, JPEG
CHANGE_DB = 32.0  # of pages that differ
WINDOW = (960, 640)
CLEAR = (slice(200, None), slice(0, 560))  # rows and columns that no panel or notice covers


@contextlib.contextmanager
def opened(folder, tmp_path):
    """A viewer of a folder with one browser, kept up to date: viewer, its browser, and its page."""
    pytest.importorskip("viser")
    find_chromium()
    stage = Stage(open_source(folder), max_gaussians=10_000)
    stage.refresh()
    viewer, ends = Viewer(stage, host="127.0.0.1", port=free_port()), threading.Event()

    def keep_up():
        while not ends.wait(0.05):
            stage.refresh()
            viewer.update()

    loop = threading.Thread(target=keep_up)
    try:
        with Page(viewer.url, tmp_path, WINDOW) as page:
            loop.start()
            (browser,) = wait_for(lambda: list(viewer.browsers.values()))
            page.click_if_there("close")
            yield viewer, browser, page
    finally:
        ends.set()
        if loop.is_alive():
            loop.join()
        viewer.close()


def settled(page, unlike=None):
    """A screenshot, once two in a row are equal and there is something else to see than in `unlike`, or nothing."""
    unlike = np.ones((*WINDOW[::-1], 3)) if unlike is None else unlike
    before = page.screenshot()
    for _ in range(90):
        time.sleep(1.0)
        now = page.screenshot()
        if np.abs(now - before).max() < 0.02 and db(now[CLEAR], unlike[CLEAR]) < CHANGE_DB:
            return now
        before = now
    raise TimeoutError("the page does not change and come to rest")


def db(a, b):
    return -10 * np.log10(np.mean((np.asarray(a, np.float64) - np.asarray(b, np.float64)) ** 2) + 1e-12)


def test_a_browser_shows_what_the_rasterizer_draws(tmp_path):
    """Chromium's WebGL and `render`, from the same camera, of a tiny scene and after an update."""
    size, file = 1e-4, tmp_path / "scene" / "scene.ply"
    ss.save_ply(file, scene(200, size))
    with opened(file.parent, tmp_path) as (viewer, browser, page):
        client = browser._client
        seen = None
        for version, num_gaussians in ((1, 200), (2, 300)):
            ss.save_ply(file, scene(num_gaussians, size))
            wait_for(lambda version=version: viewer._stage.version >= version)
            seen = settled(page, unlike=seen)
            camera = client.camera
            height, width = camera.image_height, camera.image_width
            found = client.get_render(height, width, timeout=60)[..., :3] / 255
            focal = height / 2 / np.tan(camera.fov / 2)
            K = jnp.asarray([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], jnp.float32)
            # In the browser the first camera looks 1 far; here the scene is drawn at size 1.
            position = camera.position * viewer._stage.distance / size
            viewmat = jnp.asarray(invert_pose(pose_from_quat(camera.wxyz, position, "browser")), jnp.float32)
            effects = Effects(antialias="classic", background=(1.0, 1.0, 1.0))
            view = Camera(viewmats=viewmat, Ks=K, width=width, height=height)
            wanted = ss.render(scene(num_gaussians), view, effects=effects).color
            assert np.std(wanted) > 0.02  # there is something to see
            assert db(found, np.clip(wanted, 0, 1)) > BROWSER_DB
