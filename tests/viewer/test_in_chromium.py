"""The viewer and the report in headless Chromium, with pictures compared. Skipped where there is no Chromium.

pytest -m slow -n 0 tests/viewer
"""

import contextlib
import os
import signal
import threading
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import ssplat_jax as ss
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.posed_image import invert_pose, pose_from_quat
from ssplat_jax.evaluation.pictures import save_image
from ssplat_jax.rasterizer import Effects
from ssplat_jax.runs.run_results import report_run
from ssplat_jax.scene_files.formats import load_ply
from ssplat_jax.storage.chunk_records import ChunkRecord, RecordedView, make_thumbnail, save_chunk_record, save_delta
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.viewer.scene_sources import open_source
from ssplat_jax.viewer.shown_scene import FINE
from ssplat_jax.viewer.stage import Stage
from ssplat_jax.viewer.view_scene import Viewer
from tests.runs.report_fixture import COMMON, record, score, smooth_picture
from tests.viewer.chromium import Page, find_chromium, wait_for
from tests.viewer.fake_client import delta, frame, free_port, header, scene

pytestmark = pytest.mark.slow

BROWSER_DB = 38.0  # of the browser's splats against ours: 8 bits, 16-bit covariances, JPEG
PICTURE_DB = 28.0  # of a drawn picture in the page: JPEG, stretched over the window
CHANGE_DB = 32.0  # of pages that differ
WINDOW = (960, 640)
FOV = np.radians(75.0)  # vertical
LONGEST_UPDATE = 5.0  # seconds, on a busy machine
CLEAR = (slice(200, None), slice(0, 560))  # rows and columns that no panel or notice covers
RED = np.array([0.9, 0.1, 0.1], np.float32)


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
        for num_gaussians in (200, 300):
            if num_gaussians != 200:
                ss.save_ply(file, scene(num_gaussians, size))
                wait_for(lambda: viewer._stage.version == 2)
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


def live_run(path):
    """Two chunks of a run: deltas, and records whose second view stands in front of the first camera, its image red."""
    folder = RunFolder(path)
    first = frame().rotation
    for k in (1, 2):
        part = delta([2 * k - 2, 2 * k - 1], k)
        moved = replace(part.gaussians, means=part.gaussians.means + jnp.array([0.0, 0.9 * (k - 1), 0.0]))
        part = type(part)(part.rows, moved, part.capacity, np.linspace(0.5, 1, 4, dtype=np.float32))
        save_delta(folder.delta(4 * k), part, header())
        focal = 12 / np.tan(FOV / 2)
        pose, K = np.eye(4), np.array([[focal, 0, 16], [0, focal, 12], [0, 0, 1]])
        pose[:3, :3], pose[:3, 3] = first, (0.15 * k * first[:, 2] - 0.04 * first[:, 0])
        image = make_thumbnail(np.broadcast_to(RED, (24, 32, 3)))
        views = tuple(RecordedView(2 * k + i, pose, K, np.ones(3), image) for i in (0, 1))
        save_chunk_record(folder.chunk_record(4 * k), ChunkRecord(4 * k, (32, 24), views, 0.3, 0.2 * k, 100, None))
    return folder


def red_share(picture):
    return np.mean(np.abs(picture[CLEAR] - RED).max(axis=-1) < 0.12)


def test_what_a_person_chooses_is_in_the_page(tmp_path):
    """Drawn pictures, the time slider, cameras with their images, playback and downloads, as the page shows them."""
    folder = live_run(tmp_path / "run")
    with opened(folder.path, tmp_path) as (_, browser, page):
        page.allow_downloads(tmp_path)
        splats = settled(page)
        assert splats[CLEAR].std() > 0.03 and red_share(splats) < 0.002
        before = splats
        for kind in ("depth", "confidence", "color"):
            browser._kind.value = kind
            wait_for(lambda kind=kind: browser._is_fine and browser._drawn and browser._drawn[1] == kind)
            found = settled(page, unlike=before)
            before = found
            picture = Image.fromarray(browser._draw(browser._scene, kind, FINE))
            wanted = np.asarray(picture.resize(WINDOW, Image.Resampling.BILINEAR)) / 255
            assert wanted[CLEAR].std() > 0.03
            assert db(found[CLEAR], wanted[CLEAR]) > PICTURE_DB, kind
        browser._kind.value = "splats"
        assert db(settled(page, unlike=found)[CLEAR], splats[CLEAR]) > 30
        browser._chunk.value = 1
        past = settled(page, unlike=splats)
        browser._cameras.value = True
        assert red_share(seen := settled(page, unlike=past)) > 0.005
        browser._cameras.value = False
        browser._chunk.value = 2
        assert db(settled(page, unlike=seen)[CLEAR], splats[CLEAR]) > 30
        page.click("Screenshot")
        saved = wait_for(lambda: page.downloaded(tmp_path / "ssplat_splats.png"))
        with Image.open(saved) as image:
            assert image.size == WINDOW
            assert db(np.asarray(image)[CLEAR] / 255, splats[CLEAR]) > 30
        page.click("Download scene")
        saved = wait_for(lambda: page.downloaded(tmp_path / "scene.ply"))
        assert load_ply(saved).num_gaussians == 8
        page.click("orbit")
        time.sleep(3)
        page.click("stop")
        settled(page, unlike=splats)
        assert "last chunk" in page.evaluate("document.body.innerText")


def test_a_browser_that_stands_still_holds_up_no_other(tmp_path):
    """One of two browsers is stopped; the other is shown the chunks that come, and no update waits."""
    folder = live_run(tmp_path / "run")
    later = folder.delta(8).read_bytes(), folder.chunk_record(8).read_bytes()
    folder.delta(8).unlink()
    folder.chunk_record(8).unlink()
    with opened(folder.path, tmp_path) as (viewer, _, page), Page(viewer.url, tmp_path / "second", WINDOW) as second:
        wait_for(lambda: len(viewer.browsers) == 2)
        before = settled(second)
        family = process_family(page.process.pid)
        for number in family:
            os.kill(number, signal.SIGSTOP)
        try:
            folder.chunk_record(8).write_bytes(later[1])
            folder.delta(8).write_bytes(later[0])
            settled(second, unlike=before)
            since = time.monotonic()
            viewer.update()
            assert time.monotonic() - since < LONGEST_UPDATE
        finally:
            for number in family:
                os.kill(number, signal.SIGCONT)


def process_family(number: int) -> list[int]:
    """A process and all below it."""
    children = Path(f"/proc/{number}/task/{number}/children").read_text().split()
    return [number, *(n for child in children for n in process_family(int(child)))]


@pytest.mark.parametrize("width", [1200, 480])
def test_the_report_is_seen_whole_on_any_width_and_loads_nothing(tmp_path, width):
    folder = RunFolder(tmp_path / "run")
    for i in (0, 4):
        save_image(folder.view(i), smooth_picture(i, height=96, width=384))
    for k in (4, 8):
        save_chunk_record(folder.chunk_record(k), record(k, 20.0 + k))
    metrics = COMMON | {"views": 8, "ply": {"num_written": 98765}, "seen_views": [score(0), score(4)]}
    report_run(folder, metrics, "capture")
    with Page(folder.report.as_uri(), tmp_path, (width, 900)) as page:
        page.wait_for("document.images.length == 2 && [...document.images].every(i => i.complete)")
        assert page.evaluate("[...document.images].every(i => i.naturalWidth == 384)")
        assert (
            page.evaluate("performance.getEntriesByType('resource').filter(e => !e.name.startsWith('data:')).length")
            == 0
        )
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        page.evaluate("document.images[1].scrollIntoView({block: 'center'})")
        box = page.evaluate("(b => [b.left, b.top, b.width, b.height])(document.images[1].getBoundingClientRect())")
        left, top, shown_width, shown_height = map(round, box)
        seen = page.screenshot()[top : top + shown_height, left : left + shown_width]
        wanted = np.asarray(
            Image.fromarray((smooth_picture(4, height=96, width=384) * 255).astype(np.uint8)).resize(seen.shape[1::-1])
        )
        assert db(seen, wanted / 255) > PICTURE_DB
