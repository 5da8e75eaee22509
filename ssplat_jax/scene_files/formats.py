"""A scene into a file of the format that its name says."""

import dataclasses
from pathlib import Path

from ssplat_jax.errors import InputError
from ssplat_jax.gaussians import Gaussians
from ssplat_jax.scene_files.export_rows import ExportReport
from ssplat_jax.scene_files.ply import read_ply, save_ply
from ssplat_jax.scene_files.splat import save_splat
from ssplat_jax.scene_files.spz import save_spz

FORMATS = (".ply", ".spz", ".splat")


def check_format(path: Path) -> None:
    """Raises InputError if no format has the name's ending."""
    if path.suffix not in FORMATS:
        raise InputError(f"--to: wanted a file named *{', *'.join(FORMATS)}, got {path.name!r}; choose one of these.")


def save_gaussians(
    path: Path,
    gaussians: Gaussians,
    *,
    render_mode: str = "mip",
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> ExportReport:
    """Writes `gaussians` to `path`; what `save_ply` says of the arguments, as far as the format has a place for it.

    Raises:
        InputError: another ending than .ply, .spz or .splat, or positions beyond the format's range.
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
    """Writes the scene of a .ply again, to `to`, in the format of its ending.

    Raises:
        InputError: `scene` is no 3DGS .ply; as `save_gaussians`.
        StorageError: the file cannot be written.
    """
    check_format(to)
    splats = read_ply(scene)
    return save_gaussians(to, splats.gaussians, render_mode=splats.render_mode, offset=splats.offset)
