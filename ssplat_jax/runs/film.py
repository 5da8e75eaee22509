"""Films of a scene: a path of cameras, and what each picture shows."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Float64, UInt8

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import refusal, require_positive
from ssplat_jax.data.camera_path import camera_path, orbit_path
from ssplat_jax.evaluation.pictures import color_depth, color_normals, eight_bits, scale_ends
from ssplat_jax.scene_files.formats import SplatFile
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.video_writer import VideoWriter

KINDS = ("color", "depth", "normals")
"""Kinds of pictures that a film can show."""

PATHS = ("spline", "orbit")
"""The paths that a film can take."""

RANGE_CAMERAS = 8
"""Cameras whose visible Gaussians give the color scale of a depth film."""

Path = tuple[Float64[np.ndarray, "m 4 4"], Float64[np.ndarray, "m 3 3"]]

Draw = Callable[
    [Float64[np.ndarray, "4 4"], Float64[np.ndarray, "3 3"]],
    tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]],
]
"""Renders color and depth (capture units, 0 where nothing is) from a pose and intrinsics."""


@dataclasses.dataclass(frozen=True)
class FilmOptions:
    """A film: where it goes, and what it shows."""

    steps: int  # spline: pictures from each camera to the next; orbit: pictures in all
    path: str = "spline"  # of `PATHS`
    shows: tuple[str, ...] = ("color",)  # of `KINDS`; each becomes a file

    def check(self) -> None:
        """Refuses options that no film can have.

        Raises:
            InputError: `steps` is below 1, or a name is unknown.
        """
        require_positive(film=self.steps)
        for name, given, known in (("--film-path", (self.path,), PATHS), ("--film-shows", self.shows, KINDS)):
            if not given or not set(given) <= set(known):
                got, wanted = " ".join(given) or "none", f"{'one' if len(given) == 1 else 'some'} of {', '.join(known)}"
                raise refusal(name, wanted=wanted, got=got, fix="choose among these")


def film_path(
    poses: Float64[np.ndarray, "n 4 4"],
    Ks: Float64[np.ndarray, "n 3 3"],
    options: FilmOptions,
    splats: SplatFile,
    size: tuple[int, int],
) -> Path:
    """The cameras of a film along, or around what is seen from, the cameras of a capture."""
    if options.path == "spline":
        return camera_path(poses, Ks, options.steps)
    middle = len(poses) // 2
    depths = _depths_seen(splats, poses[middle], Ks[middle], size)
    return orbit_path(poses, Ks[middle], float(np.median(depths)) if len(depths) else 1.0, options.steps)


def write_film(
    path: Path,
    draw: Draw,
    depth_range: tuple[float, float],
    writers: dict[str, VideoWriter],
    folder: RunFolder,
    reporter: Reporter,
) -> None:
    """Draws every camera of a path and writes a file for each kind of picture.

    Args:
        path: the poses and intrinsics.
        draw: renders one camera.
        depth_range: nearest and farthest depth of the color scale, capture units.
        writers: an open encoder for each kind.
        folder: where the files go.
        reporter: shows progress.

    Raises:
        StorageError: a file cannot be written.
    """
    with reporter.progress("filming", len(path[0])) as advance:
        for place, (camtoworld, K) in enumerate(zip(*path, strict=True)):
            color, depth = draw(camtoworld, K)
            for kind, writer in writers.items():
                writer.add(_picture(kind, color, depth, K, depth_range))
            advance(place + 1)
    for kind, writer in writers.items():
        writer.save(folder.film(kind))


def depth_range(splats: SplatFile, path: Path, size: tuple[int, int]) -> tuple[float, float]:
    """Nearest and farthest depth of a color scale that stays the same over a film, capture units."""
    poses, Ks = path
    some = sorted({round(k) for k in np.linspace(0, len(poses) - 1, RANGE_CAMERAS)})
    return scale_ends(np.concatenate([_depths_seen(splats, poses[k], Ks[k], size) for k in some]))


def _depths_seen(
    splats: SplatFile, camtoworld: Float64[np.ndarray, "4 4"], K: Float64[np.ndarray, "3 3"], size: tuple[int, int]
) -> Float64[np.ndarray, " n"]:
    """Depths of the opaque Gaussians in an image, hidden ones included."""
    means = np.asarray(splats.gaussians.means, np.float64)[np.asarray(splats.gaussians.opacities) > 0.5]
    points = np.einsum("ji,nj->ni", camtoworld[:3, :3], means + np.asarray(splats.offset) - camtoworld[:3, 3])
    points = points[np.isfinite(points).all(axis=1) & (points[:, 2] > 1e-6)]
    pixels = np.einsum("ij,nj->ni", K, points)[:, :2] / points[:, 2:]
    return points[((pixels >= 0) & (pixels <= size)).all(axis=1), 2]


def _picture(
    kind: str,
    color: Float[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    K: Float64[np.ndarray, "3 3"],
    range: Sequence[float],
) -> UInt8[np.ndarray, "h w 3"]:
    if kind == "color":
        return eight_bits(color)
    return eight_bits(color_depth(depth, range[0], range[1]) if kind == "depth" else color_normals(depth, K))
