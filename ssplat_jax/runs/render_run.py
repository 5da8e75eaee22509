"""`ssplat render`: pictures of a scene from the cameras of a capture, and films along or around them."""

import dataclasses
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
from ssplat_jax.data.camera_path import camera_path, orbit_path
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


@dataclasses.dataclass(frozen=True)
class FilmOptions:
    """A film: where it goes, and what it shows."""

    steps: int  # spline: pictures from each camera to the next; orbit: pictures in all
    path: str = "spline"  # or `orbit`


def render_run(
    scene: Path,
    path: str,
    out: Path,
    *,
    size: tuple[int, int] | None,
    stride: int,
    max_views: int | None,
    over_black: bool,
    film: FilmOptions | None,
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
        film: the film along or around these cameras; None for no film.
        reporter: shows progress.

    Returns:
        The number of pictures, without those of the film.

    Raises:
        InputError: the scene or the capture is unusable, the capture lies in `out`, `out` holds a run, or a film is
            wanted without PyAV.
        StorageError: `out` cannot be written, or adjusted poses of the scene's run are damaged.
    """
    require_positive(stride=stride, **({} if max_views is None else {"max_views": max_views}))
    require_positive(**({} if film is None else {"film": film.steps}))
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
            cameras = _film_cameras(poses, np.stack([capture.K(i) for i in indices]), film, splats, size)
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


def _film_cameras(
    poses: Float64[np.ndarray, "n 4 4"],
    Ks: Float64[np.ndarray, "n 3 3"],
    film: FilmOptions,
    splats: Gaussians,
    size: tuple[int, int],
) -> tuple[Float64[np.ndarray, "m 4 4"], Float64[np.ndarray, "m 3 3"]]:
    """Poses and intrinsics of a film along, or around what is seen from, the cameras of a capture."""
    if film.path == "spline":
        return camera_path(poses, Ks, film.steps)
    middle = len(poses) // 2
    depths = _depths_seen(splats, poses[middle], Ks[middle], size)
    return orbit_path(poses, Ks[middle], float(np.median(depths)) if len(depths) else 1.0, film.steps)


def _depths_seen(
    splats: Gaussians, camtoworld: Pose, K: Intrinsics, size: tuple[int, int]
) -> Float64[np.ndarray, " n"]:
    """Depths of the opaque Gaussians in an image, hidden ones included."""
    means = np.asarray(splats.means, np.float64)[np.asarray(splats.opacities) > 0.5]
    points = np.einsum("ji,nj->ni", camtoworld[:3, :3], means + np.asarray(splats.offset) - camtoworld[:3, 3])
    points = points[np.isfinite(points).all(axis=1) & (points[:, 2] > 0)]
    pixels = np.einsum("ij,nj->ni", K, points)[:, :2] / points[:, 2:]
    return points[((pixels >= 0) & (pixels <= size)).all(axis=1), 2]
