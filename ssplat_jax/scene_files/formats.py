"""Writes a scene in the format given by the file extension."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Int

from ssplat_jax.errors import InputError
from ssplat_jax.gaussians import Gaussians
from ssplat_jax.scene_files.export_rows import ExportReport
from ssplat_jax.scene_files.ply import read_ply, save_ply
from ssplat_jax.scene_files.select_gaussians import EVERYTHING, Selection, select_gaussians
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


def save_selected(
    path: Path,
    gaussians: Gaussians,
    selection: Selection,
    num_members: Int[np.ndarray, " n"] | None = None,
    *,
    render_mode: str = "mip",
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> ExportReport:
    """Selects Gaussians and writes them as `save_gaussians` does.

    Args:
        path: the file to write.
        gaussians: the scene.
        selection: the Gaussians to leave out.
        num_members: number of tokens that each Gaussian was merged from, if it is known.
        render_mode: see `save_gaussians`.
        offset: see `save_gaussians`.

    Returns:
        Counts of written, dropped and left out Gaussians, and `offset`.

    Raises:
        InputError: an unknown extension, or positions outside the range of the format.
        StorageError: the file cannot be written.
    """
    check_format(path)
    selected = select_gaussians(gaussians, selection, num_members)
    report = save_gaussians(path, selected.gaussians, render_mode=render_mode, offset=offset)
    return dataclasses.replace(report, num_pruned=selected.num_pruned, num_cut=selected.num_cut)


def convert_scene(scene: Path, to: Path, selection: Selection = EVERYTHING) -> ExportReport:
    """Converts the scene file `scene` to the format given by the extension of `to`.

    Args:
        scene: a 3DGS .ply.
        to: the file to write.
        selection: the Gaussians to leave out.

    Raises:
        InputError: `scene` is not a 3DGS .ply, `to` has an unknown extension, or positions are out of range.
        StorageError: the file cannot be written.
    """
    check_format(to)
    splats = read_ply(scene)
    return save_selected(to, splats.gaussians, selection, render_mode=splats.render_mode, offset=splats.offset)
