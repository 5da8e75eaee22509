"""A finished scene as a person gets it.

`ssplat export` writes it in any format, upright, with a camera to start from; `ssplat render` draws it from the cameras
of a capture, and a film along them.
"""

import dataclasses
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float64
from scipy.interpolate import CubicHermiteSpline, make_interp_spline
from scipy.spatial.transform import Rotation

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError, refusal, require_positive
from ssplat_jax.core.false_colors import eight_bits
from ssplat_jax.core.gaussians import Gaussians, mean_color
from ssplat_jax.core.kept_programs import Kept
from ssplat_jax.core.numerics import evenly_spread
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.posed_image import Matrix, Pose
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.metrics import psnr
from ssplat_jax.evaluation.pictures import VideoWriter, save_image
from ssplat_jax.rasterizer import Effects, effects_for, fill_holes, render
from ssplat_jax.rasterizer.effects import FILTERS
from ssplat_jax.runs.open_run import load_run, open_capture_of_scene
from ssplat_jax.runs.run_results import scene_to_show
from ssplat_jax.runs.stream_commands import Render
from ssplat_jax.scene_files.formats import SCENE_READERS, ExportReport, file_axes, load_scene, save_gaussians
from ssplat_jax.storage.chunk_records import load_chunk_records
from ssplat_jax.storage.run_folder import RunFolder, lock_folder
from ssplat_jax.streaming.session import middle_exposure

_jitted_fill_holes = Kept(fill_holes)

NUM_COMPARED, HOLE = 3, 0.5  # views that are compared, and the opacity of a pixel below which it is a hole


def decoded_scene(run_dir: Path, params: dict, reporter: Reporter) -> Gaussians:
    """The scene of a run's saved state, in the capture's frame, at the middle exposure.

    Args:
        run_dir: folder of the run.
        params: parameters of the run's model.
        reporter: warns if only the state before the newest can be read.

    Raises:
        InputError: no run there, or a run with other weights.
        StorageError: the state is corrupt.
    """
    run = load_run(run_dir, reporter)
    session = run.session(params)
    num_shown = int(session.cache_facts()["decoded"])
    # The rows after these are padding, of which a person need not be told.
    scene = scene_to_show(session.gaussians(), run.stream_frame, run.exposures)
    return jax.tree.map(lambda x: jax.device_put(np.asarray(x)[:num_shown]), scene)


@dataclasses.dataclass(frozen=True)
class KnownCameras:
    """Cameras of a scene, as a run streamed them or as a capture holds them."""

    camtoworlds: Float64[np.ndarray, "n 4 4"]  # the capture's frame
    Ks: Float64[np.ndarray, "n 3 3"]
    size: tuple[int, int]  # (width, height), pixels
    exposures: Float64[np.ndarray, "n 3"]  # RGB, relative to the middle one, which the scene has


def views_of(scene: Path, path: str | None, reporter: Reporter) -> KnownCameras | None:
    """The cameras that are known of a scene: those that its run recorded, or those of the capture at `path`.

    Raises:
        InputError: the capture is unusable, or none is needed.
        StorageError: adjusted poses of the scene's run are corrupt.
    """
    records = load_chunk_records(RunFolder(scene).chunk_record_files()) if scene.is_dir() else []
    if records and path is not None:
        raise InputError(f"--cameras: wanted a lone scene file, got {scene}, whose cameras are known; leave it out.")
    if records:
        views = sorted((view for record in records for view in record.views), key=lambda view: view.frame)
        exposures = np.stack([view.exposure for view in views])
        middle = middle_exposure(dict(enumerate(exposures.astype(np.float32))))
        poses, Ks = (np.stack([getattr(view, name) for view in views]) for name in ("camtoworld", "K"))
        return KnownCameras(poses, Ks, records[0].size, exposures / middle)
    if path is None:
        return None
    capture = open_capture_of_scene(scene, path, None, reporter)
    Ks = np.stack([capture.K(i) for i in range(len(capture))])
    return KnownCameras(capture.camtoworlds, Ks, (capture.width, capture.height), np.ones((len(capture), 3)))


def turned(gaussians: Gaussians, turn: Float64[np.ndarray, "3 3"]) -> Gaussians:
    """A scene after a rotation about the origin of its capture."""
    stream_frame = StreamFrame(turn, np.zeros(3), scale=1.0, near=0.0, far=math.inf)
    x, y, z = (turn @ gaussians.offset).tolist()
    return replace(stream_frame.gaussians_to_capture(gaussians), offset=(x, y, z))


def start_camera(views: KnownCameras, gaussians: Gaussians, turn: Float64[np.ndarray, "3 3"]) -> dict[str, Any]:
    """The middle camera, for viewers that can start there: position, target and vertical angle of view, degrees."""
    k = len(views.camtoworlds) // 2
    pose, height = views.camtoworlds[k], views.size[1]
    center = turn @ pose[:3, 3] - gaussians.offset
    forward = turn @ pose[:3, 2]
    ahead = (np.asarray(gaussians.means, np.float64) - center) @ forward
    distance = float(np.median(ahead[ahead > 0])) if (ahead > 0).any() else 1.0
    fov = float(np.degrees(2 * np.arctan(height / 2 / views.Ks[k, 1, 1])))
    return {"position": center.tolist(), "target": (center + distance * forward).tolist(), "fov": fov}


def export_scene(
    scene: Gaussians, to: Path, views: KnownCameras | None, up: str | None = None, **options: Any
) -> tuple[ExportReport, Float64[np.ndarray, "3 3"]]:
    """Writes a scene with what is known of its cameras, and gives the rotation by which it was turned.

    Args:
        scene: the Gaussians, in the capture's frame.
        to: the file to write; its suffix names the format.
        views: cameras of the scene.
        up: the axis of the file, `y` or `z`, along which the up direction of cameras held level is turned; None leaves
            the axes of the capture.
        options: those of `save_gaussians`.

    Raises:
        InputError: see `save_gaussians`; or `up` is given, and no cameras are known or they do not tell what is up.
        StorageError: the file cannot be written.
    """
    turn, shown = np.eye(3), scene
    if up is not None:
        now = None if views is None else upward(views.camtoworlds)
        if now is None:
            fix = "export a run, or pass --cameras CAPTURE"
            raise refusal("--up", wanted="cameras that are held level", got="none", fix=fix)
        wanted = file_axes(to).T @ np.eye(3)["xyz".index(up)]
        turn = Rotation.align_vectors(wanted, now)[0].as_matrix()  # the shortest one
        shown = turned(scene, turn)
    start = None if views is None else start_camera(views, shown, turn)
    return save_gaussians(to, shown, start_camera=start, **options), turn


def difference_in_words(to: Path, views: KnownCameras, turn: Float64[np.ndarray, "3 3"]) -> str | None:
    """A sentence on how a plain renderer's pictures of the file differ from ours, on `NUM_COMPARED` of the views.

    A plain renderer has the dilation of 3DGS, shows holes black, and one exposure. We draw with the filter that the
    file names, fill holes, and follow the exposures of the views. None for formats that are not read.
    """
    if to.suffix.lower() not in SCENE_READERS:
        return None
    written, scores, holes = load_scene(to), [], []
    scene = replace(written, offset=(0.0, 0.0, 0.0))
    chosen = evenly_spread(len(views.camtoworlds), NUM_COMPARED)
    for k in chosen:
        pose = views.camtoworlds[k].copy()
        pose[:3] = turn @ pose[:3]
        camera = _camera_at(pose, views.Ks[k], views.size, written.offset)
        ours, plain = (render(scene, camera, effects=Effects(antialias=name)) for name in (None, "classic"))
        filled = np.asarray(fill_holes(ours.color, ours.alpha, mean_color(scene))) * views.exposures[k]
        scores.append(psnr(np.clip(plain.color, 0.0, 1.0), np.clip(filled, 0.0, 1.0)))
        holes.append(float(np.mean(np.asarray(plain.alpha) < HOLE)))
    factors = views.exposures[list(chosen)]
    exposure = float(np.max(np.maximum(factors, 1.0 / factors)))
    return (
        f"drawn by a plain renderer, {len(chosen)} views differ from our pictures of them by {np.mean(scores):.1f} dB"
        f" PSNR: {np.mean(holes):.1%} holes, which we fill, and exposures up to {exposure:.2f} times that of the file"
    )


def render_run(options: Render, reporter: Reporter) -> int:
    """Writes views/<frame>.png for frames of a capture, and optionally film.mp4; returns the number of pictures.

    The scene is drawn with the filter that its file names, at the exposure of its file: the middle one of its stream.
    The cameras of a run that adjusted its poses have those.

    Raises:
        InputError: the scene or the capture is unusable, the capture lies in `out`, `out` holds a run, or a film is
            wanted without PyAV.
        StorageError: `out` cannot be written, or adjusted poses of the scene's run are damaged.
    """
    scene, stride, film = options.scene, options.stride, options.film
    require_positive(stride=stride, max_views=options.max_views, film=film)
    file = RunFolder(scene).best_scene if scene.is_dir() else scene
    splats = load_scene(file)
    if splats.render_mode not in FILTERS:
        fix = "render it where it was made"
        raise refusal(str(file), wanted="3D Gaussians", got=f"a scene of {splats.render_mode}", fix=fix)
    capture, folder = open_capture_of_scene(scene, options.path, options.image_size, reporter), RunFolder(options.out)
    capture.check_output_folder(options.out)
    folder.check_no_run()
    indices = range(0, len(capture), stride)[: options.max_views]
    size = (capture.width, capture.height)
    writer = None if film is None else VideoWriter(*size)
    background = mean_color(splats)  # of holes that have no colors around them
    at_camera = replace(splats, offset=(0.0, 0.0, 0.0))  # cameras are relative to it already

    def picture(camtoworld: Pose, K: Matrix) -> Float[np.ndarray, "h w 3"]:
        """The scene from one camera of the capture's frame."""
        camera = _camera_at(camtoworld, K, size, splats.offset)
        out = render(at_camera, camera, effects=effects_for(at_camera, camera))
        return np.asarray(out.color if options.over_black else _jitted_fill_holes(out.color, out.alpha, background))

    with lock_folder(options.out):
        folder.clear_views()
        folder.film.unlink(missing_ok=True)
        with reporter.progress("rendering", len(indices)) as advance:
            for place, i in enumerate(indices, start=1):
                save_image(folder.view(i), picture(capture.frames[i].camtoworld, capture.K(i)))
                advance(place)
        if film is not None and writer is not None:
            poses = np.stack([capture.frames[i].camtoworld for i in indices])
            cameras = camera_path(poses, np.stack([capture.K(i) for i in indices]), film)
            with reporter.progress("filming", len(cameras[0])) as advance:
                for place, (pose, K) in enumerate(zip(*cameras, strict=True), start=1):
                    writer.add(eight_bits(picture(pose, K)))
                    advance(place)
            writer.save(folder.film)
    return len(indices)


def _camera_at(camtoworld: Pose, K: Matrix, size: tuple[int, int], offset: tuple[float, float, float]) -> Camera:
    """A camera of the capture's frame, relative to a point of it: float32 cannot hold places far from zero."""
    viewmat = StreamFrame.at_point(offset).viewmats(camtoworld)
    return Camera(jnp.asarray(viewmat), jnp.asarray(K, jnp.float32), width=size[0], height=size[1])


# -- cameras -----------------------------------------------------------------------------------------------------------


def camera_path(
    camtoworlds: Float64[np.ndarray, "n 4 4"], Ks: Float64[np.ndarray, "n 3 3"], steps: int
) -> tuple[Float64[np.ndarray, "m 4 4"], Float64[np.ndarray, "m 3 3"]]:
    """Inserts `steps - 1` cameras between each pair of consecutive cameras: m = (n - 1) steps + 1.

    Centers and rotation matrices follow a Catmull-Rom spline, which passes through all given cameras; each interpolated
    matrix is then replaced by the nearest rotation. Intrinsics are interpolated linearly.

    Limits:
        Consecutive cameras may differ by rotations of up to 120 degrees. Between cameras that look in opposite
        directions the shortest rotation is ambiguous, and the path may jump.
    """
    n = len(camtoworlds)
    if n < 2:
        return camtoworlds, Ks
    given, places = np.arange(n), np.arange((n - 1) * steps + 1) / steps
    path = CubicHermiteSpline(given, camtoworlds, np.gradient(camtoworlds, axis=0))(places)
    u, _, vt = np.linalg.svd(path[:, :3, :3])
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    path[:, :3, :3] = u @ vt
    return path, make_interp_spline(given, Ks, k=1)(places)


def upward(camtoworlds: Float64[np.ndarray, "n 4 4"]) -> Float64[np.ndarray, "3"] | None:
    """The up direction of cameras that are held level: perpendicular to their images' rows, by least squares.

    Rows of images that lie on their side point up or down, and do not count. Where rows do not tell, because all are
    parallel, it is the mean of the images' up directions; None if that is 0.
    """
    mean = -camtoworlds[:, :3, 1].mean(axis=0)
    if np.linalg.norm(mean) < 0.1:
        return None
    mean /= np.linalg.norm(mean)
    rows = camtoworlds[:, :3, 0]
    rows = rows[np.abs(rows @ mean) < np.sqrt(0.5)]
    shares, axes = np.linalg.eigh(np.einsum("ni,nj->ij", rows, rows))
    axis = axes[:, 0] if shares[1] > 1e-2 * len(camtoworlds) else mean
    return axis if axis @ mean > 0 else -axis
