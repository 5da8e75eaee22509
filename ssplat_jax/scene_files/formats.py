"""Writes a scene in the format given by the file extension."""

import dataclasses
from pathlib import Path

from ssplat_jax.errors import InputError
from ssplat_jax.gaussians import Gaussians
from ssplat_jax.scene_files.export_rows import ExportReport
from ssplat_jax.scene_files.ply import read_ply, save_ply
from ssplat_jax.scene_files.splat import save_splat
from ssplat_jax.scene_files.spz import save_spz

FORMATS = (".ply", ".spz", ".splat")  # file extensions


def check_format(path: Path) -> None:
    """Checks that the extension of `path` is one of `FORMATS`.

    Raises:
        InputError: it is not, or the name is that of a compressed .ply.
    """
    if path.name.endswith(".compressed.ply"):
        raise InputError(
            f"--to: {path.name!r} names a compressed .ply, which is not written; choose .spz for a small file."
        )
    if path.suffix not in FORMATS:
        raise InputError(f"--to: wanted a file named *{', *'.join(FORMATS)}, got {path.name!r}; choose one of these.")


def save_gaussians(
    path: Path,
    gaussians: Gaussians,
    *,
    render_mode: str = "mip",
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> ExportReport:
    """Writes `gaussians` to `path` in the format of its extension.

    Args:
        path: the file to write (.ply, .spz or .splat).
        gaussians: the scene.
        render_mode: the renderer that the scene is made for, see `save_ply`; a .spz stores only whether it is "mip",
            a .splat nothing.
        offset: origin of `gaussians` in the frame of the capture; only a .ply stores it.

    Returns:
        Counts of written and dropped Gaussians, and `offset`.

    Raises:
        InputError: an unknown extension, or positions outside the range of the format.
        StorageError: the file cannot be written.
    """
    check_format(path)
    if path.suffix == ".ply":
        return save_ply(path, gaussians, render_mode=render_mode, offset=offset)
    if path.suffix == ".spz":
        report = save_spz(path, gaussians, antialiased=render_mode == "mip")
    else:
        report = save_splat(path, gaussians)
    return dataclasses.replace(report, offset=offset)


def convert_ply(scene: Path, to: Path) -> ExportReport:
    """Converts the .ply file `scene` to the format given by the extension of `to`.

    Raises:
        InputError: `scene` is not a 3DGS .ply, `to` has an unknown extension, or positions are out of range.
        StorageError: the file cannot be written.
    """
    check_format(to)
    splats = read_ply(scene)
    return save_gaussians(to, splats.gaussians, render_mode=splats.render_mode, offset=splats.offset)
