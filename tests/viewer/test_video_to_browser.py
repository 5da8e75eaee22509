"""From a video to a scene in the browser, with the commands of the README's first page as they stand there.

`pytest -m slow -n 0 -s tests/viewer/test_video_to_browser.py` (a quarter of an hour on two cores) prints what a person
would read, and where the picture of the page is. Skipped where there is no Chromium.
"""

import contextlib
import re
import shlex
import signal
import subprocess
import sys
import time
from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from ssplat_jax.data.capture import open_capture
from ssplat_jax.data.posed_image import invert_pose
from ssplat_jax.geometry.cameras import Camera
from ssplat_jax.rasterizer import Effects, render
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.viewer.scene_sources import open_source
from ssplat_jax.viewer.stage import Stage
from tests.docs.pages import ROOT, blocks
from tests.viewer.chromium import Page, find_chromium, wait_for

av = pytest.importorskip("av", reason="videos need PyAV: pip install -e '.[poses]'")
pytestmark = pytest.mark.slow

SECONDS = 30
WINDOW = (960, 640)
CLEAR = (slice(100, None), slice(0, 560))  # rows and columns of the page that no panel covers
FOV = np.radians(75.0)  # vertical, of viser's browsers
START = "from ssplat_jax.commands.start import start; start()"

REGISTERED = 0.9  # share of the chosen frames that get a pose
PAGE_DB = 24.0  # of the page against our renderer: edges of splats are cut off earlier in the browser
WHITE_SHARE = 0.05  # of the page: holes
LEAST_DETAIL = 0.4  # of the page against the video, in the scale below
DETAIL_PIXELS = 3.0


def write_video(path, images, num_frames: int) -> None:
    """A video of 30 seconds as phones write them."""
    path.parent.mkdir(parents=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", Fraction(num_frames, SECONDS), options={"crf": "18"})
        for image in images:
            stream.height, stream.width, stream.pix_fmt = *image.shape[:2], "yuv420p"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")))
        container.mux(stream.encode())


def room_video(path) -> np.ndarray:
    """A walk through the procedural room; returns its first frame."""
    capture = open_capture("procedural:room?frames=450&size=480x360")
    images = [np.round(255 * capture.image(i)).astype(np.uint8) for i in range(len(capture))]
    write_video(path, images, len(images))
    return images[0] / 255


def kitchen_video(path) -> np.ndarray:
    """A real hand-held walk of 900 frames; returns the first."""
    folder = ROOT.parent / "shared" / "captures" / "redkitchen"
    if not folder.exists():
        pytest.skip("the capture redkitchen is not here")
    capture = open_capture(folder)
    write_video(path, (np.round(255 * capture.image(i)).astype(np.uint8) for i in range(900)), 900)
    return capture.image(0)


def first_page_commands() -> list[list[str]]:
    """The commands from a video to the browser on the README's first page."""
    (block,) = (text for text in blocks(ROOT / "README.md", "sh") if "ssplat poses" in text)
    return [shlex.split(line, comments=True)[1:] for line in block.splitlines() if line.startswith("ssplat")]


def detail(image: np.ndarray) -> float:
    """How much of an image is finer than some pixels: standard deviation, by that of the image."""
    gray = image.mean(axis=-1)
    return float(np.std(gray - gaussian_filter(gray, DETAIL_PIXELS)) / np.std(gray))


def db(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def wanted_page(run) -> np.ndarray:
    """The scene of a run as our renderer draws it over white, from the camera with which browsers start."""
    stage = Stage(open_source(run), max_gaussians=10**7)
    stage.refresh()
    start, scene = stage.start, stage.scene()
    assert start is not None and scene is not None
    forward = (start.look_at - start.position) / np.linalg.norm(start.look_at - start.position)
    right = np.cross(forward, start.up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :4] = np.stack([right, np.cross(forward, right), forward, start.position], axis=1)
    width, height = WINDOW
    focal = height / 2 / np.tan(FOV / 2)
    K = jnp.asarray([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], jnp.float32)
    camera = Camera(viewmats=jnp.asarray(invert_pose(pose), jnp.float32), Ks=K, width=width, height=height)
    effects = Effects(antialias="classic", background=(1.0, 1.0, 1.0))
    return np.clip(np.asarray(render(scene.gaussians, camera, effects=effects).color), 0, 1)


def settled(page: Page) -> np.ndarray:
    """A screenshot with a scene in it, once two in a row are equal."""
    before = page.screenshot()
    for _ in range(120):
        time.sleep(1.0)
        now = page.screenshot()
        if np.abs(now - before).max() < 0.02 and now[CLEAR].std() > 0.05:
            return now
        before = now
    raise TimeoutError("no scene comes to rest in the page")


@contextlib.contextmanager
def viewed(command: list[str], folder):
    """A viewer's address while it runs; Ctrl-C ends it afterwards."""
    process = subprocess.Popen(
        [sys.executable, "-c", START, *command], cwd=folder, stdout=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    try:
        assert process.stdout is not None
        line = next(line for line in process.stdout if "http://" in line)
        yield re.search(r"http://\S+", line).group()  # pyright: ignore[reportOptionalMemberAccess]
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 130
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("make_video", [room_video, kitchen_video])
def test_three_commands_of_the_first_page_lead_to_the_browser(make_video, tmp_path):
    pytest.importorskip("pycolmap")
    pytest.importorskip("viser")
    find_chromium()
    first = make_video(tmp_path / "path" / "to" / "video.mp4")
    poses, run, view = first_page_commands()
    assert (poses[0], run[0], view[0]) == ("poses", "run", "view")
    said = []
    for command in (poses, run):
        since = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-c", START, *command], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        said.append(done.stdout)
        print(f"$ ssplat {shlex.join(command)}  # {time.monotonic() - since:.0f} s\n{done.stdout}{done.stderr[-500:]}")
    registered, chosen = map(int, re.search(r"registered (\d+) of (\d+)", said[0]).groups())  # pyright: ignore
    assert registered >= REGISTERED * chosen
    assert f"ssplat run {run[1]} --size 320x240" in said[0]  # the next command, as the page has it
    folder = tmp_path / view[1]
    assert RunFolder(folder).report.exists()
    with viewed(view, tmp_path) as url, Page(url, tmp_path, WINDOW) as page:
        page.wait_for("document.readyState == 'complete'")
        wait_for(lambda: page.evaluate("!!document.querySelector('canvas')"))
        page.click_if_there("close")
        seen = settled(page)
    Image.fromarray((seen * 255).astype(np.uint8)).save(tmp_path / "page.png")
    wanted = wanted_page(folder)
    Image.fromarray((wanted * 255).astype(np.uint8)).save(tmp_path / "wanted.png")
    Image.fromarray((first * 255).astype(np.uint8)).save(tmp_path / "first_frame.png")
    scale = WINDOW[1] / first.shape[0] * first.shape[1] / WINDOW[0]
    print(f"page: {tmp_path}/page.png, {db(seen[CLEAR], wanted[CLEAR]):.1f} dB of our renderer's picture, "
          f"white {np.mean(seen[CLEAR].min(axis=-1) > 0.97):.3f}, detail {detail(seen[CLEAR]):.3f},"
          f" of the video {detail(first):.3f} ({scale:.2f})")  # fmt: skip
    assert db(seen[CLEAR], wanted[CLEAR]) > PAGE_DB
    assert np.mean(seen[CLEAR].min(axis=-1) > 0.97) < WHITE_SHARE
    assert detail(seen[CLEAR]) > LEAST_DETAIL * detail(first)
