"""`ssplat render`: pictures of a scene file from the cameras of a capture, and films of it."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float64

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError, require_positive
from ssplat_jax.core.gaussians import mean_color, scale_colors
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.pictures import save_image
from ssplat_jax.rasterizer import Effects, fill_holes, render
from ssplat_jax.runs.film import KINDS, FilmOptions, depth_range, film_path, write_film
from ssplat_jax.runs.run_poses import open_capture_of_scene
from ssplat_jax.scene_files.formats import SplatFile, read_scene
from ssplat_jax.storage.run_folder import RunFolder, lock_folder, scene_exposure
from ssplat_jax.storage.video_writer import VideoWriter

ANTIALIAS = {"mip": "mip", "default": "classic"}
"""Antialiasing filter for each render mode that a scene file may name."""

_jitted_fill_holes = jax.jit(fill_holes)


def render_scene(
    scene: Path,
    path: str,
    out: Path,
    *,
    size: tuple[int, int] | None,
    stride: int,
    max_views: int | None,
    over_black: bool,
    one_exposure: bool = False,
    film: FilmOptions | None,
    reporter: Reporter,
) -> int:
    """Writes `out`/views/<frame>.png for frames of a capture, and optionally `out`/film.mp4 and its like.

    The scene is drawn with the filter that its file names: mip, or the dilation of 3DGS where the file names none. It
    is shown at the exposure of its file: the middle one of its stream.

    Args:
        scene: a scene file in the capture's frame, or the folder of a run.
        path: the capture, as `open_capture` takes it; the cameras of a run that adjusted its poses have those.
        out: folder of the results.
        size: (width, height) of the pictures; by default the capture's own.
        stride: every `stride`-th camera is used.
        max_views: stop after this many pictures.
        over_black: show holes black instead of in the colors around them.
        one_exposure: show the scene at the exposure of the first streamed views; with `over_black` a picture of 8 bits
            is then the image of the `literal` score.
        film: the film along or around these cameras; None for no film.
        reporter: shows progress.

    Returns:
        The number of pictures, without those of the film.

    Raises:
        InputError: the scene or the capture is unusable, the capture lies in `out`, `out` holds a run, a film is wanted
            without PyAV, or one exposure of a scene whose run is unknown.
        StorageError: `out` cannot be written, or adjusted poses of the scene's run are damaged.
    """
    require_positive(stride=stride)
    if max_views is not None:
        require_positive(max_views=max_views)
    if film is not None:
        film.check()
    splats = _read_scene(scene)
    if one_exposure:
        factors = jnp.asarray(1.0 / scene_exposure(scene), jnp.float32)  # as the literal scores show the scene
        gaussians = scale_colors(splats.gaussians, factors)
        splats = dataclasses.replace(splats, gaussians=gaussians)
    capture, folder = open_capture_of_scene(scene, path, size, reporter), RunFolder(out)
    capture.check_output_folder(out)
    folder.check_no_run()
    indices = range(0, len(capture), stride)[:max_views]
    size = (capture.width, capture.height)
    writers = {kind: VideoWriter(*size) for kind in (film.shows if film else ())}
    draw = functools.partial(
        _render_picture, splats, size=size, background=None if over_black else mean_color(splats.gaussians)
    )
    with lock_folder(out):
        folder.clear_views()
        for kind in KINDS:
            folder.film(kind).unlink(missing_ok=True)
        with reporter.progress("rendering", len(indices)) as advance:
            for place, i in enumerate(indices):
                save_image(folder.view(i), draw(capture.frames[i].camtoworld, capture.K(i))[0])
                advance(place + 1)
        if film is not None:
            poses, Ks = (
                np.stack(x) for x in zip(*[(capture.frames[i].camtoworld, capture.K(i)) for i in indices], strict=True)
            )
            cameras = film_path(poses, Ks, film, splats, size)
            write_film(cameras, draw, depth_range(splats, cameras, size), writers, folder, reporter)
    return len(indices)


def _read_scene(scene: Path) -> SplatFile:
    """The scene at a path, which may be the folder of a run."""
    file = RunFolder(scene).scene if scene.is_dir() else scene
    splats = read_scene(file)
    if splats.render_mode not in ANTIALIAS:
        raise InputError(
            f"{file}: wanted 3D Gaussians, got a scene of {splats.render_mode}; render it where it was made."
        )
    return splats


def _render_picture(
    splats: SplatFile,
    camtoworld: Float64[np.ndarray, "4 4"],
    K: Float64[np.ndarray, "3 3"],
    *,
    size: tuple[int, int],
    background: jax.Array | None,
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Color and depth (capture units, 0 where nothing is) of a scene from one camera.

    Args:
        splats: the scene, in the capture's frame relative to its offset.
        camtoworld: pose of the camera in the capture's frame.
        K: intrinsics, pixels.
        size: (width, height) of the picture.
        background: color of holes that have no colors around them; None shows all holes black.
    """
    frame = StreamFrame.at_point(splats.offset)
    camera = Camera(
        viewmats=jnp.asarray(frame.viewmats(camtoworld)), Ks=jnp.asarray(K, jnp.float32), width=size[0], height=size[1]
    )
    effects = Effects(antialias=ANTIALIAS[splats.render_mode], outputs=("color", "alpha", "depth"))
    out = render(splats.gaussians, camera, effects=effects)
    color = out.color if background is None else _jitted_fill_holes(out.color, out.alpha, background)
    return np.asarray(color), np.asarray(out.depth)
