"""`ssplat render`: pictures of a scene from the cameras of a capture, and a film along them."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float64

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import refusal, require_positive
from ssplat_jax.core.false_colors import eight_bits
from ssplat_jax.core.gaussians import Gaussians, mean_color
from ssplat_jax.core.kept_programs import Kept
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.camera_path import camera_path
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.pictures import VideoWriter, save_image
from ssplat_jax.rasterizer import effects_for, fill_holes, render
from ssplat_jax.rasterizer.effects import FILTERS
from ssplat_jax.runs.open_run import open_capture_of_scene
from ssplat_jax.scene_files.formats import load_scene
from ssplat_jax.storage.run_folder import RunFolder, lock_folder

Pose = Float64[np.ndarray, "4 4"]
Intrinsics = Float64[np.ndarray, "3 3"]

_jitted_fill_holes = Kept(fill_holes)


def render_run(
    scene: Path,
    path: str,
    out: Path,
    *,
    size: tuple[int, int] | None,
    stride: int,
    max_views: int | None,
    over_black: bool,
    film: int | None,
    reporter: Reporter,
) -> int:
    """Writes `out`/views/<frame>.png for frames of a capture, and optionally `out`/film.mp4.

    The scene is drawn with the filter that its file names, at the exposure of its file: the middle one of its stream.

    Args:
        scene: a scene file in the capture's frame, or the folder of a run.
        path: the capture, as `open_capture` takes it; the cameras of a run that adjusted its poses have those.
        out: folder of the results.
        size: (width, height) of the pictures; by default the capture's own.
        stride: every `stride`-th camera is used.
        max_views: stop after this many pictures.
        over_black: show holes black instead of in the colors around them.
        film: pictures of a film from each of these cameras to the next; None for no film.
        reporter: shows progress.

    Returns:
        The number of pictures, without those of the film.

    Raises:
        InputError: the scene or the capture is unusable, the capture lies in `out`, `out` holds a run, or a film is
            wanted without PyAV.
        StorageError: `out` cannot be written, or adjusted poses of the scene's run are damaged.
    """
    options = {"stride": stride, "max_views": max_views, "film": film}
    require_positive(**{name: number for name, number in options.items() if number is not None})
    file = RunFolder(scene).best_scene if scene.is_dir() else scene
    splats = load_scene(file)
    if splats.render_mode not in FILTERS:
        fix = "render it where it was made"
        raise refusal(str(file), wanted="3D Gaussians", got=f"a scene of {splats.render_mode}", fix=fix)
    capture, folder = open_capture_of_scene(scene, path, size, reporter), RunFolder(out)
    capture.check_output_folder(out)
    folder.check_no_run()
    indices = range(0, len(capture), stride)[:max_views]
    size = (capture.width, capture.height)
    writer = None if film is None else VideoWriter(*size)
    background = None if over_black else mean_color(splats)
    with lock_folder(out):
        folder.clear_views()
        folder.film.unlink(missing_ok=True)
        with reporter.progress("rendering", len(indices)) as advance:
            for place, i in enumerate(indices, start=1):
                picture = _render_picture(splats, capture.frames[i].camtoworld, capture.K(i), size, background)
                save_image(folder.view(i), picture)
                advance(place)
        if film is not None and writer is not None:
            poses = np.stack([capture.frames[i].camtoworld for i in indices])
            cameras = camera_path(poses, np.stack([capture.K(i) for i in indices]), film)
            with reporter.progress("filming", len(cameras[0])) as advance:
                for place, (pose, K) in enumerate(zip(*cameras, strict=True), start=1):
                    writer.add(eight_bits(_render_picture(splats, pose, K, size, background)))
                    advance(place)
            writer.save(folder.film)
    return len(indices)


def _render_picture(
    splats: Gaussians, camtoworld: Pose, K: Intrinsics, size: tuple[int, int], background: jax.Array | None
) -> Float[np.ndarray, "h w 3"]:
    """A scene from one camera of the capture's frame.

    `background` is the color of holes that have no colors around them; None shows all holes black.
    """
    viewmat = StreamFrame.at_point(splats.offset).viewmats(camtoworld)
    camera = Camera(jnp.asarray(viewmat), jnp.asarray(K, jnp.float32), width=size[0], height=size[1])
    scene = replace(splats, offset=(0.0, 0.0, 0.0))  # the camera is relative to it already
    out = render(scene, camera, effects=effects_for(scene, camera))
    return np.asarray(out.color if background is None else _jitted_fill_holes(out.color, out.alpha, background))
