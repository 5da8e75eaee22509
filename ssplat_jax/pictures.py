"""`ssplat render`: a scene file as the cameras of a capture see it, a picture each."""

from pathlib import Path

import jax
import numpy as np

from ssplat_jax.data.capture import Capture, open_capture
from ssplat_jax.data.frame import StreamFrame
from ssplat_jax.errors import InputError, require_positive
from ssplat_jax.evaluate import save_image
from ssplat_jax.export.folders import remove_numbered
from ssplat_jax.export.only_writer import only_writer
from ssplat_jax.export.ply import SplatFile, read_ply
from ssplat_jax.gaussians import mean_color
from ssplat_jax.render import Effects, fill_holes, render
from ssplat_jax.report import Reporter

SCENE_FILE = "scene.ply"  # of a run's folder
PICTURES, PICTURE = "views", "#####.png"
ANTIALIAS = {"mip": "mip", "default": "classic"}

_filled = jax.jit(fill_holes)


def render_scene(
    scene: Path,
    path: str,
    out: Path,
    *,
    size: tuple[int, int] | None,
    stride: int,
    max_views: int | None,
    over_black: bool,
    reporter: Reporter,
) -> int:
    """Writes `out`/views/<frame>.png for every `stride`-th frame of the capture at `path`; returns how many.

    The scene, a .ply or the folder of a run, stands in the capture's frame. It is drawn with the filter that its file
    names: ours, or the dilation of 3DGS where the file names none. Where it lets light through the colours around are
    shown, or black; exposure is the scene's one.

    Raises:
        InputError: the scene or the capture is unusable, or the capture lies in `out`.
        StorageError: `out` cannot be written.
    """
    require_positive(stride=stride)
    if max_views is not None:
        require_positive(max_views=max_views)
    file = scene / SCENE_FILE if scene.is_dir() else scene
    splats = read_ply(file)
    if splats.render_mode not in ANTIALIAS:
        raise InputError(
            f"{file}: wanted 3D Gaussians, got a scene of {splats.render_mode}; render it where it was made."
        )
    capture = open_capture(path, size=size)
    capture.check_apart(out)
    indices = range(0, len(capture), stride)[:max_views]
    with only_writer(out), reporter.progress("rendering", len(indices)) as advance:
        remove_numbered(out / PICTURES, PICTURE)
        beyond = None if over_black else mean_color(splats.gaussians)
        for done, i in enumerate(indices, start=1):
            save_image(out / PICTURES / f"{i:05d}.png", _picture(splats, capture, i, beyond))
            advance(done)
    return len(indices)


def _picture(splats: SplatFile, capture: Capture, i: int, beyond: jax.Array | None) -> np.ndarray:
    """What the camera of frame `i` sees, holes filled with what is around and `beyond`, or black."""
    at_offset = np.eye(4)
    at_offset[:3, 3] = splats.offset
    frame = StreamFrame.at_camera(at_offset, scale=1.0, near=0.0, far=np.inf)
    effects = Effects(antialias=ANTIALIAS[splats.render_mode], outputs=("color", "alpha"))
    out = render(splats.gaussians, capture.camera(i, frame), effects=effects)
    assert out.color is not None and out.alpha is not None
    return np.asarray(out.color if beyond is None else _filled(out.color, out.alpha, beyond))
