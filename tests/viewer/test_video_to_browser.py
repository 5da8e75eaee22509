"""From a video to a scene in the browser, with the commands of the README's first page as they stand there.

`pytest -m slow -n 0 -s tests/viewer/test_video_to_browser.py` (a quarter of an hour on two cores) prints what a person
would read, and where the picture of the page is. Skipped where there is no Chromium.
"""

import contextlib
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from fractions import Fraction
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from ssplat_jax.core.cameras import Camera
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.posed_image import invert_pose
from ssplat_jax.rasterizer import Effects, render
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.viewer.scene_sources import open_source
from ssplat_jax.viewer.stage import Stage
from tests.docs.pages import ROOT, blocks
from tests.viewer import chromium
from tests.viewer.chromium import Page, find_chromium, wait_for

av = pytest.importorskip("av", reason="videos need PyAV: pip install -e '.[poses]'")
pytestmark = pytest.mark.slow

SECONDS = 30
ROOM = "procedural:room?frames=120&size=400x300"  # of which half is walked: the browser draws on the CPU
SHAPE = (16, 9)  # of the video: the README's commands are for a landscape video of a phone
WINDOW = (480, 270)  # small, since the browser draws on the CPU
BROWSER_SECONDS = 600.0  # for a picture of a million splats, on a busy machine
ONLY_THE_SCENE = "<style>body * {visibility: hidden} canvas {visibility: visible}</style>"
ENVIRONMENT = {**os.environ, "XLA_FLAGS": "", "PYTHONPATH": os.pathsep.join(sys.path)}
START = "from ssplat_jax.commands.start import start; start()"

REGISTERED = 0.9  # share of the chosen frames that get a pose
PAGE_DB = 30.0  # of the page against our renderer at the browser's camera, whose principal point is in the middle
PHOTO_DB = {"room": 28.0, "redkitchen": 18.0}  # of our renderer against the middle frame, at which browsers start
WHITE_SHARE = 0.02  # of the page: holes
LEAST_DETAIL = 0.4  # of the page against the video, in the scale below
DETAIL_PIXELS = 3.0


def write_video(path: str, source: str, num_frames: int) -> None:
    """A video of 30 seconds, as phones write them, of the first frames of a capture; called in a process of its own."""
    capture = open_capture(source)
    height = capture.width * SHAPE[1] // SHAPE[0] // 2 * 2
    top = (capture.height - height) // 2
    with av.open(path, "w") as container:
        stream = container.add_stream("libx264", Fraction(num_frames, SECONDS), options={"crf": "18"})
        stream.height, stream.width, stream.pix_fmt = height, capture.width, "yuv420p"
        for i in range(num_frames):
            image = np.round(255 * capture.image(i)[top : top + height]).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def as_users_do(code: str, *arguments: str, folder: Path) -> subprocess.CompletedProcess:
    """Runs Python code with the program compiled as users compile it."""
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, check=False)


def first_page_commands() -> list[list[str]]:
    """The commands from a video to the browser on the README's first page."""
    (block,) = (text for text in blocks(ROOT / "README.md", "sh") if "ssplat poses" in text)
    return [shlex.split(line, comments=True)[1:] for line in block.splitlines() if line.startswith("ssplat")]


def detail(image: np.ndarray) -> float:
    """Share of an image that is finer than some pixels: standard deviation, by that of the image."""
    gray = image.mean(axis=-1)
    return float(np.std(gray - gaussian_filter(gray, DETAIL_PIXELS)) / np.std(gray))


def db(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def drawn(stage: Stage, pose: np.ndarray, K: np.ndarray, exposure: np.ndarray | float = 1.0) -> np.ndarray:
    """The scene as our renderer draws it over white, from a camera in the scene's frame."""
    scene = stage.scene()
    assert scene is not None
    width, height = WINDOW
    viewmat = jnp.asarray(invert_pose(pose), jnp.float32)
    camera = Camera(viewmats=viewmat, Ks=jnp.asarray(K, jnp.float32), width=width, height=height)
    effects = Effects(antialias="classic", background=(1.0, 1.0, 1.0))
    return np.clip(np.asarray(render(scene.gaussians, camera, effects=effects).color) * exposure, 0, 1)


def wanted_page(stage: Stage) -> np.ndarray:
    """The picture with which browsers should start."""
    start, fov = stage.start, stage.run.fov
    assert start is not None and fov is not None
    forward = (start.look_at - start.position) / np.linalg.norm(start.look_at - start.position)
    right = np.cross(forward, start.up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :4] = np.stack([right, np.cross(forward, right), forward, start.position], axis=1)
    width, height = WINDOW
    focal = height / 2 / np.tan(fov / 2)
    return drawn(stage, pose, np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]))


def middle_frame(stage: Stage, capture: Capture) -> tuple[np.ndarray, np.ndarray]:
    """The frame at whose camera browsers start, and the scene from there, both at the exposure of the frame."""
    middle, scene = stage.run.middle(), stage.scene()
    assert middle is not None and scene is not None
    K = np.asarray(capture.camera(middle.frame).Ks)
    return np.asarray(capture.image(middle.frame)), drawn(stage, middle.camtoworld, K, middle.exposure / scene.exposure)


def settled(page: Page) -> np.ndarray:
    """A screenshot with a scene in it, once two in a row are equal."""
    before = page.screenshot()
    for _ in range(120):
        time.sleep(1.0)
        now = page.screenshot()
        if np.abs(now - before).max() < 0.02 and now.std() > 0.05:
            return now
        before = now
    raise TimeoutError("no scene comes to rest in the page")


@contextlib.contextmanager
def viewed(command: list[str], folder):
    """A viewer's address while it runs; Ctrl-C ends it afterwards."""
    # A job in the background would ignore the signal.
    code = f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler); {START}"
    process = subprocess.Popen(
        [sys.executable, "-c", code, *command], cwd=folder, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        line = next(line for line in process.stdout if "http://" in line)
        yield re.search(r"http://\S+", line).group()  # pyright: ignore[reportOptionalMemberAccess]
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 130
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("name", ["room", "redkitchen"])
def test_three_commands_of_the_first_page_lead_to_the_browser(name, tmp_path, request, monkeypatch):
    pytest.importorskip("pycolmap")
    pytest.importorskip("viser")
    find_chromium()
    monkeypatch.setattr(chromium, "SECONDS", BROWSER_SECONDS)
    source, num_frames = ROOM, 60
    if name != "room":
        source, num_frames = str(request.getfixturevalue("captures") / name), 900
    (tmp_path / "path" / "to").mkdir(parents=True)
    arguments = f"'path/to/video.mp4', {source!r}, {num_frames}"
    code = f"from tests.viewer.test_video_to_browser import write_video; write_video({arguments})"
    made = as_users_do(code, folder=tmp_path)
    assert made.returncode == 0, made.stderr
    poses, run, view = first_page_commands()
    assert (poses[0], run[0], view[0]) == ("poses", "run", "view")
    said = []
    for command in (poses, run):
        since = time.monotonic()
        done = as_users_do(START, *command, folder=tmp_path)
        assert done.returncode == 0, done.stderr
        said.append(done.stdout)
        print(f"$ ssplat {shlex.join(command)}  # {time.monotonic() - since:.0f} s\n{done.stdout}{done.stderr[-500:]}")
    registered, chosen = map(int, re.search(r"registered (\d+) of (\d+)", said[0]).groups())  # pyright: ignore
    assert registered >= REGISTERED * chosen
    assert f"next: ssplat run {run[1]} --size " in said[0]  # the next command, in the shape of the images
    folder = tmp_path / view[1]
    assert RunFolder(folder).report.exists()
    with viewed(view, tmp_path) as url, Page(url, tmp_path, WINDOW) as page:
        page.wait_for("document.readyState == 'complete'")
        wait_for(lambda: page.evaluate("!!document.querySelector('canvas')"))
        page.evaluate(f"document.head.insertAdjacentHTML('beforeend', {ONLY_THE_SCENE!r})")
        seen = settled(page)
    stage = Stage(open_source(folder), max_gaussians=10**7)
    stage.refresh()
    photo, ours = middle_frame(stage, open_capture(tmp_path / run[1], size=WINDOW))
    wanted = wanted_page(stage)
    for picture, image in (("page", seen), ("wanted", wanted), ("photo", photo)):
        Image.fromarray((image * 255).astype(np.uint8)).save(tmp_path / f"{picture}.png")
    print(f"page: {tmp_path}/page.png, {db(seen, wanted):.1f} dB of our renderer's picture, "
          f"white {np.mean(seen.min(axis=-1) > 0.97):.3f}, detail {detail(seen):.3f},"
          f" of the video {detail(photo):.3f}, "
          f"our renderer {db(ours, photo):.1f} dB of the frame")  # fmt: skip
    assert db(seen, wanted) > PAGE_DB and db(ours, photo) > PHOTO_DB[name]
    assert np.mean(seen.min(axis=-1) > 0.97) < WHITE_SHARE
    assert detail(seen) > LEAST_DETAIL * detail(photo)
