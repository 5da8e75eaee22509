"""Reader and writer of the 3DGS .ply file, which every splat viewer opens.

Binary little endian, one row of float32 per Gaussian, in the frame and units of the Gaussians:

    x y z · nx ny nz (zeros) · f_dc_0..2 · f_rest_0..3K-1 · opacity · scale_0..2 · rot_0..3

`opacity` is a logit, `scale` ln of the standard deviation, `rot` a quaternion wxyz, color = 0.5 + 0.28209 f_dc + ...;
`f_rest` is channel-major: the K = 0, 3, 8 or 15 coefficients of red, then of green, then of blue. The comment
`SplatRenderMode: mip` marks a scene made for a renderer with the 2D Mip filter, as ours is. Where a scene is so far
from the origin of its frame that float32 is too coarse, its positions are relative to a nearby offset, which the
comment `offset x y z` holds.
"""

import os

import jax.numpy as jnp
import numpy as np

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.scene_files.export_rows import LOG_SCALE_LIMIT, ExportReport, SceneRows, scene_rows, unit_quats
from ssplat_jax.scene_files.ply_table import read_vertices
from ssplat_jax.scene_files.splat_file import SplatFile, widened

RENDER_MODES = ("default", "mip", "2dgs")
"""Values of the comment `SplatRenderMode`: 3DGS, 3DGS with the 2D Mip filter (ours), and 2D Gaussian Splatting."""

REST_TERMS = {0: 0, 9: 1, 24: 2, 45: 3}
"""SH degree by number of f_rest properties."""

BASE_PROPERTIES = (
    *("x", "y", "z"),
    *("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacity",
    *("scale_0", "scale_1", "scale_2"),
    *("rot_0", "rot_1", "rot_2", "rot_3"),
)


def save_ply(
    path: str | os.PathLike,
    gaussians: Gaussians,
    *,
    render_mode: str = "mip",
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> ExportReport:
    """Writes `gaussians` to `path` atomically; the same Gaussians give the same bytes.

    Args:
        path: the file to write; missing folders are created.
        gaussians: the scene, in the frame of the file (for scenes of a `Capture`, the capture frame).
        render_mode: value of the comment `SplatRenderMode`, one of `RENDER_MODES`.
        offset: origin of `gaussians` in the frame of the file; written as a comment unless it is zero.

    Returns:
        Counts of written and dropped Gaussians (`scene_rows`), and `offset`.

    Raises:
        InputError: an unknown render mode, or an array of the scene has a wrong shape.
        StorageError: the file cannot be written.
    """
    if render_mode not in RENDER_MODES:
        raise InputError(f"save_ply: render_mode must be one of {', '.join(RENDER_MODES)}, got {render_mode!r}.")
    rows = scene_rows(gaussians)
    header = _header(len(rows), gaussians.sh_degree, render_mode, offset)
    write_atomic(path, header + _table(rows).astype("<f4").tobytes())
    return ExportReport(num_written=len(rows), num_dropped=gaussians.num_gaussians - len(rows), offset=offset)


def property_names(sh_degree: int) -> list[str]:
    """Names of the vertex properties, in the order of the file."""
    rest = 3 * ((sh_degree + 1) ** 2 - 1)
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(rest))]
    return [*names, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def _header(num_rows: int, sh_degree: int, render_mode: str, offset: tuple[float, float, float]) -> bytes:
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment SplatRenderMode: {render_mode}",
        f"comment SH degree: {sh_degree}",
        *offset_comment(offset),
        f"element vertex {num_rows}",
        *(f"property float {name}" for name in property_names(sh_degree)),
        "end_header\n",
    ]
    return "\n".join(lines).encode("ascii")


def offset_comment(offset: tuple[float, float, float]) -> list[str]:
    """Header line of an offset; none if it is zero."""
    return [f"comment offset {' '.join(repr(float(x)) for x in offset)}"] if any(offset) else []


def _table(rows: SceneRows) -> np.ndarray:
    """Table with one row of raw values per Gaussian, float64."""
    rest = rows.sh[:, 1:].transpose(0, 2, 1).reshape(len(rows), 3 * (rows.sh.shape[1] - 1))
    logits = np.log(rows.opacities) - np.log1p(-rows.opacities)
    normals = np.zeros_like(rows.means)
    columns = [rows.means, normals, rows.sh[:, 0], rest, logits[:, None], rows.log_scales, rows.quats]
    return np.concatenate(columns, axis=1)


def load_ply(path: str | os.PathLike) -> Gaussians:
    """Reads the Gaussians of a 3DGS .ply file, ascii or binary, properties in any order; unknown ones are ignored.

    Limits:
        Opacity logits of +-inf, which other writers produce, become 0 and 1; any other entry that is not finite in
        float32 is refused.
        Scales are clamped to [e^-20, e^20]; quaternions are normalized, a zero quaternion becomes the identity.
        A comment `offset x y z` (`save_ply`) is not added, so that float32 positions stay exact.

    Raises:
        InputError: the file is not a 3DGS .ply, is cut off, or holds entries that are not finite.
    """
    return read_ply(path).gaussians


def read_ply(path: str | os.PathLike) -> SplatFile:
    """Reads a 3DGS .ply file as `load_ply` does, with its comments `SplatRenderMode` and `offset`.

    Raises:
        InputError: the file is not a 3DGS .ply, is cut off, holds entries that are not finite, or its offset is not
            three numbers.
    """
    columns, comments = read_vertices(path)
    missing = [name for name in BASE_PROPERTIES if name not in columns]
    if missing:
        packed = " it is compressed; read it with `load_scene`" if "packed_position" in columns else " give a 3DGS .ply"
        raise InputError(f"{path}: element vertex: wanted the property {missing[0]!r}, it is missing;{packed}.")
    num_rest = sum(name.startswith("f_rest_") for name in columns)
    rest_names = [f"f_rest_{i}" for i in range(num_rest)]
    if num_rest not in REST_TERMS or not all(name in columns for name in rest_names):
        raise InputError(
            f"{path}: element vertex: wanted f_rest_0, f_rest_1, ... of 0, 9, 24 or 45 coefficients, got {num_rest}; "
            "write the file again with a full SH degree."
        )
    means = _stacked(path, columns, ("x", "y", "z"))
    dc = _stacked(path, columns, ("f_dc_0", "f_dc_1", "f_dc_2"))
    rest = _stacked(path, columns, rest_names).reshape(len(means), 3, num_rest // 3).transpose(0, 2, 1)
    logits = _stacked(path, columns, ("opacity",), allow_infinite=True)[:, 0]
    log_scales = _stacked(path, columns, ("scale_0", "scale_1", "scale_2"))
    quats = _stacked(path, columns, ("rot_0", "rot_1", "rot_2", "rot_3"))
    fields = {
        "means": means,
        "quats": unit_quats(quats),
        "scales": np.exp(np.clip(log_scales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)),
        "opacities": 0.5 * (1 + np.tanh(0.5 * logits)),  # the sigmoid, without overflow
        "sh": np.concatenate([dc[:, None], rest], axis=1),
    }
    return SplatFile(
        gaussians=Gaussians(**{name: jnp.asarray(field, jnp.float32) for name, field in fields.items()}),
        render_mode=render_mode_of(comments),
        offset=offset_of(path, comments),
    )


def render_mode_of(comments: list[str]) -> str:
    """The renderer that comments name; "default" if they name none."""
    modes = [comment.split()[-1] for comment in comments if comment.startswith("SplatRenderMode:")]
    return modes[-1] if modes and modes[-1] in RENDER_MODES else "default"


def offset_of(path: str | os.PathLike, comments: list[str]) -> tuple[float, float, float]:
    """The offset that comments name; zero if they name none.

    Raises:
        InputError: it is not three numbers.
    """
    for comment in comments:
        if comment.split()[:1] == ["offset"]:
            try:
                x, y, z = (float(word) for word in comment.split()[1:])
            except ValueError:
                x = y = z = np.nan
            if not np.isfinite([x, y, z]).all():
                raise InputError(f"{path}: comment offset: wanted three numbers, got {comment!a}; correct the comment.")
            return x, y, z
    return 0.0, 0.0, 0.0


def _stacked(path, columns: dict[str, np.ndarray], names, *, allow_infinite: bool = False) -> np.ndarray:
    """Stacks columns in float64 and checks that they are finite in float32."""
    if not names:
        return np.zeros((len(columns["x"]), 0))
    stacked = widened(np.stack([columns[name] for name in names], axis=1))
    bad = np.isnan(stacked) | ((np.abs(stacked) > np.finfo(np.float32).max) & (not allow_infinite))
    if bad.any():
        (row, column), num_bad = np.argwhere(bad)[0], bad.any(axis=1).sum()
        raise InputError(
            f"{path}: vertex {row}: wanted a finite {names[column]}, got {stacked[row, column]} ({num_bad} such rows); "
            "drop them."
        )
    return stacked
