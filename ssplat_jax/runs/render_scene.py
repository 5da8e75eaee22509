"""`ssplat render`: a scene file as the cameras of a capture see it, a picture each, and a film from one to the next."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from ssplat_jax.data.camera_path import camera_path
from ssplat_jax.data.capture import open_capture
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.errors import InputError, require_positive
from ssplat_jax.evaluation.evaluate import eight_bits, save_image
from ssplat_jax.storage.video import Film
from ssplat_jax.storage.folders import remove_numbered
from ssplat_jax.storage.folder_lock import only_writer
from ssplat_jax.scene_files.ply import SplatFile, read_ply
from ssplat_jax.gaussians import mean_color
from ssplat_jax.geometry.cameras import Camera
from ssplat_jax.rasterizer import Effects, fill_holes, render
from ssplat_jax.console import Reporter

SCENE_FILE = "scene.ply"  # of a run's folder
PICTURES, PICTURE = "views", "#####.png"
FILM_FILE = "film.mp4"
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
    film_steps: int | None,
    reporter: Reporter,
) -> int:
    """Writes `out`/views/<frame>.png for every `stride`-th frame of the capture at `path`; returns how many.

    With `film_steps`, `out`/film.mp4 goes through those cameras, so many pictures from one to the next.

    The scene, a .ply or the folder of a run, stands in the capture's frame. It is drawn with the filter that its file
    names: ours, or the dilation of 3DGS where the file names none. Where it lets light through the colors around are
    shown, or black; exposure is the scene's one.

    Raises:
        InputError: the scene or the capture is unusable, the capture lies in `out`, or a film is wanted without PyAV.
        StorageError: `out` cannot be written.
    """
    require_positive(stride=stride)
    if max_views is not None:
        require_positive(max_views=max_views)
    if film_steps is not None:
        require_positive(film=film_steps)
    file = scene / SCENE_FILE if scene.is_dir() else scene
    splats = read_ply(file)
    if splats.render_mode not in ANTIALIAS:
        raise InputError(
            f"{file}: wanted 3D Gaussians, got a scene of {splats.render_mode}; render it where it was made."
        )
    capture = open_capture(path, size=size)
    capture.check_apart(out)
    indices = range(0, len(capture), stride)[:max_views]
    film = None if film_steps is None else Film(capture.width, capture.height)
    steps = film_steps or 1
    path_poses, path_Ks = camera_path(
        np.stack([capture.frames[i].camtoworld for i in indices]), np.stack([capture.K(i) for i in indices]), steps
    )
    beyond = None if over_black else mean_color(splats.gaussians)
    with only_writer(out), reporter.progress("rendering", len(path_poses)) as advance:
        remove_numbered(out / PICTURES, PICTURE)
        (out / FILM_FILE).unlink(missing_ok=True)
        for place, (camtoworld, K) in enumerate(zip(path_poses, path_Ks, strict=True)):
            picture = _picture(splats, camtoworld, K, (capture.width, capture.height), beyond)
            if place % steps == 0:
                save_image(out / PICTURES / f"{indices[place // steps]:05d}.png", picture)
            if film is not None:
                film.add(eight_bits(picture))
            advance(place + 1)
        if film is not None:
            film.save(out / FILM_FILE)
    return len(indices)


def _picture(
    splats: SplatFile,
    camtoworld: Float64[np.ndarray, "4 4"],
    K: Float64[np.ndarray, "3 3"],
    size: tuple[int, int],
    beyond: jax.Array | None,
) -> np.ndarray:
    """What a camera sees, holes filled with what is around and `beyond`, or black."""
    at_offset = np.eye(4)
    at_offset[:3, 3] = splats.offset
    frame = StreamFrame.at_camera(at_offset, scale=1.0, near=0.0, far=np.inf)
    camera = Camera(
        viewmats=jnp.asarray(frame.viewmats(camtoworld)), Ks=jnp.asarray(K, jnp.float32), width=size[0], height=size[1]
    )
    effects = Effects(antialias=ANTIALIAS[splats.render_mode], outputs=("color", "alpha"))
    out = render(splats.gaussians, camera, effects=effects)
    assert out.color is not None and out.alpha is not None
    return np.asarray(out.color if beyond is None else _filled(out.color, out.alpha, beyond))
