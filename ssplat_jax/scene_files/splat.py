"""Reader and writer of the .splat file of the first browser viewers: 32 bytes per Gaussian, constant colors.

    x y z (float32) · scales (float32, standard deviations) · r g b opacity (uint8) · w x y z (uint8, 128 + 128 q)

Rows are sorted by volume times opacity, largest first, because a viewer may draw the scene before it is loaded
completely. There is no header: viewers assume that y points down and dilate as 3DGS does.
"""

import os

import numpy as np

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.scene_files.export_rows import LOG_SCALE_LIMIT, ExportReport, scene_rows, to_bytes
from ssplat_jax.scene_files.splat_file import SplatFile, gaussians_of_columns, read_scene_bytes, widened

ROW = np.dtype([("mean", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def save_splat(path: str | os.PathLike, gaussians: Gaussians) -> ExportReport:
    """Writes `gaussians` to `path` atomically; the same Gaussians give the same bytes.

    Limits:
        Those of `scene_rows`. Colors are clipped to [0, 1]; SH bands above the constant one are dropped.

    Raises:
        InputError: an array of the scene has a wrong shape.
        StorageError: the file cannot be written.
    """
    rows = scene_rows(gaussians)
    prominence = rows.log_scales.sum(axis=1) + np.log(rows.opacities)
    order = np.argsort(-prominence, kind="stable")
    table = np.zeros(len(rows), ROW)
    table["mean"] = rows.means[order]
    table["scales"] = np.exp(rows.log_scales[order])
    table["rgba"][:, :3] = to_bytes(255 * (0.5 + SH_C0 * rows.sh[order, 0]))
    table["rgba"][:, 3] = to_bytes(255 * rows.opacities[order])
    table["quat"] = to_bytes(128 + 128 * rows.quats[order])
    write_atomic(path, table.tobytes())
    return ExportReport(num_written=len(rows), num_dropped=gaussians.num_gaussians - len(rows))


def read_splat(path: str | os.PathLike) -> SplatFile:
    """Reads a .splat file.

    Raises:
        InputError: the file cannot be read, is not a whole number of rows, or holds entries that are not finite.
    """
    data = read_scene_bytes(path, "a .splat file")
    if len(data) % ROW.itemsize:
        raise InputError(
            f"{path}: wanted rows of {ROW.itemsize} bytes, got {len(data)} bytes; it is cut off or no .splat file."
        )
    table = np.frombuffer(data, ROW)
    rgba = table["rgba"] / 255
    if (table["scales"] < 0).any():
        raise InputError(f"{path}: wanted scales of at least 0, got {table['scales'].min()}; write it again.")
    gaussians = gaussians_of_columns(
        path,
        means=widened(table["mean"]),
        quats=(table["quat"].astype(np.float64) - 128) / 128,
        log_scales=np.log(np.maximum(widened(table["scales"]), np.exp(-LOG_SCALE_LIMIT))),
        opacities=rgba[:, 3],
        sh=((rgba[:, :3] - 0.5) / SH_C0)[:, None],
    )
    return SplatFile(gaussians, render_mode="default")
