"""The viewer in headless Chromium, with pictures compared. Skipped where there is no Chromium (Debian: `chromium`)."""

import contextlib
import shutil
import subprocess
import threading

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
from tests.viewer.fake_client import free_port, scene, wait_for

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SWITCHES = (
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
    "--no-first-run",
    "--window-size=960,640",
)
BROWSER_DB = 38.0  # of the browser's splats against ours: 8 bits, 16-bit covariances, JPEG

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")]


@contextlib.contextmanager
def opened(folder, profile):
    """A viewer of a folder with one browser, kept up to date: the viewer, and viser's client of the browser."""
    stage = Stage(open_source(folder), max_gaussians=10_000)
    stage.refresh()
    viewer, ends = Viewer(stage, host="127.0.0.1", port=free_port()), threading.Event()

    def keep_up():
        while not ends.wait(0.05):
            stage.refresh()
            viewer.update()

    loop = threading.Thread(target=keep_up)
    command = [str(CHROMIUM), *SWITCHES, f"--user-data-dir={profile}", viewer.url]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    try:
        loop.start()
        (browser,) = wait_for(lambda: list(viewer.browsers.values()))
        yield viewer, browser._client
    finally:
        ends.set()
        loop.join()
        process.kill()
        process.wait()
        viewer.close()


def test_a_browser_shows_what_the_rasterizer_draws(tmp_path):
    """Chromium's WebGL and `render`, from the same camera, of a tiny scene and after an update."""
    pytest.importorskip("viser")
    size, file = 1e-4, tmp_path / "scene" / "scene.ply"
    ss.save_ply(file, scene(200, size))
    with opened(file.parent, tmp_path / "profile") as (viewer, client):

        def is_shown(num_gaussians: int) -> bool:
            camera = client.camera
            height, width = camera.image_height, camera.image_width
            focal = height / 2 / np.tan(camera.fov / 2)
            K = jnp.asarray([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], jnp.float32)
            # In the browser the first camera looks 1 far; here the scene is drawn at size 1.
            position = camera.position * viewer._stage.distance / size
            viewmat = jnp.asarray(invert_pose(pose_from_quat(camera.wxyz, position, "browser")), jnp.float32)
            effects = Effects(antialias="classic", background=(1.0, 1.0, 1.0))
            view = Camera(viewmats=viewmat, Ks=K, width=width, height=height)
            wanted = np.clip(ss.render(scene(num_gaussians), view, effects=effects).color, 0, 1)
            assert np.std(wanted) > 0.02  # there is something to see
            found = client.get_render(height, width, timeout=60)[..., :3] / 255
            return -10 * np.log10(np.mean((found - wanted) ** 2)) > BROWSER_DB

        for version, num_gaussians in ((1, 200), (2, 300)):
            ss.save_ply(file, scene(num_gaussians, size))
            wait_for(lambda version=version: viewer._stage.version >= version)
            assert wait_for(lambda num_gaussians=num_gaussians: is_shown(num_gaussians))
