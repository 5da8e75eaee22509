"""Reads and writes scenes in the format given by the file extension."""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Int

from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.scene_files.compressed_ply import is_compressed_ply, read_compressed_ply, save_compressed_ply
from ssplat_jax.scene_files.export_rows import ExportReport
from ssplat_jax.scene_files.gltf import save_gltf
from ssplat_jax.scene_files.gltf_reader import read_gltf
from ssplat_jax.scene_files.ply import read_ply, save_ply
from ssplat_jax.scene_files.select_gaussians import EVERYTHING, Selection, select_gaussians
from ssplat_jax.scene_files.sog import save_sog
from ssplat_jax.scene_files.sog_reader import read_sog
from ssplat_jax.scene_files.splat import read_splat, save_splat
from ssplat_jax.scene_files.splat_file import SplatFile
from ssplat_jax.scene_files.spz import save_spz
from ssplat_jax.scene_files.spz_reader import read_spz


@dataclasses.dataclass(frozen=True)
class Format:
    """A format of scene files."""

    save: Callable[[Path, Gaussians, str, tuple[float, float, float]], ExportReport]
    """Writes Gaussians; the last arguments are the render mode (`save_ply`) and the offset."""
    read: Callable[[Path], SplatFile]


FORMATS = {
    ".compressed.ply": Format(
        lambda path, scene, mode, offset: save_compressed_ply(path, scene, render_mode=mode, offset=offset),
        read_compressed_ply,
    ),
    ".ply": Format(lambda path, scene, mode, offset: save_ply(path, scene, render_mode=mode, offset=offset), read_ply),
    ".spz": Format(lambda path, scene, mode, _: save_spz(path, scene, antialiased=mode == "mip"), read_spz),
    ".sog": Format(lambda path, scene, mode, _: save_sog(path, scene, antialiased=mode == "mip"), read_sog),
    ".glb": Format(
        lambda path, scene, mode, offset: save_gltf(path, scene, render_mode=mode, offset=offset), read_gltf
    ),
    ".gltf": Format(
        lambda path, scene, mode, offset: save_gltf(path, scene, render_mode=mode, offset=offset), read_gltf
    ),
    ".splat": Format(lambda path, scene, *_: save_splat(path, scene), read_splat),
}
"""Formats by the end of the file's name; the first that fits is meant."""


def check_format(path: Path, option: str = "--to") -> str:
    """The key of `FORMATS` that the name of a file ends with.

    Raises:
        InputError: there is none.
    """
    for suffix in FORMATS:
        if path.name.endswith(suffix):
            return suffix
    raise InputError(f"{option}: wanted a file named *{', *'.join(FORMATS)}, got {path.name!r}; choose one of these.")


def save_gaussians(
    path: Path,
    gaussians: Gaussians,
    *,
    render_mode: str = "mip",
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> ExportReport:
    """Writes `gaussians` to `path` in the format of its extension.

    Args:
        path: the file to write; its name ends as one of `FORMATS`.
        gaussians: the scene.
        render_mode: the renderer that the scene is made for, see `save_ply`; a .spz and a .sog store only whether it is
            "mip", a .splat nothing.
        offset: origin of `gaussians` in the frame of the capture; a .spz, .sog or .splat does not store it.

    Returns:
        Counts of written and dropped Gaussians, and `offset`.

    Raises:
        InputError: an unknown extension, positions outside the range of the format, or an array of a wrong shape.
        StorageError: the file cannot be written.
    """
    report = FORMATS[check_format(path)].save(path, gaussians, render_mode, offset)
    return dataclasses.replace(report, offset=offset)


def read_scene(path: str | os.PathLike) -> SplatFile:
    """Reads a scene file in any of `FORMATS`; a .ply may be a compressed one, whatever its name.

    Raises:
        InputError: an unknown extension, or the file is damaged or of another format than its name says.
    """
    path = Path(path)
    suffix = check_format(path, "scene")
    if suffix == ".ply" and is_compressed_ply(path):
        suffix = ".compressed.ply"
    return FORMATS[suffix].read(path)


def load_scene(path: str | os.PathLike) -> Gaussians:
    """Reads the Gaussians of a scene file: .ply, .compressed.ply, .spz, .sog, .glb, .gltf or .splat.

    Limits:
        As `load_ply`; positions of a .ply with a comment `offset x y z` stay relative to that offset.

    Raises:
        InputError: an unknown extension, or the file is damaged or of another format than its name says.
    """
    return read_scene(path).gaussians


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
        InputError: an unknown extension, positions outside the range of the format, or an array of a wrong shape.
        StorageError: the file cannot be written.
    """
    check_format(path)
    selected = select_gaussians(gaussians, selection, num_members)
    report = save_gaussians(path, selected.gaussians, render_mode=render_mode, offset=offset)
    return dataclasses.replace(report, num_pruned=selected.num_pruned, num_cut=selected.num_cut)


def convert_scene(scene: Path, to: Path, selection: Selection = EVERYTHING) -> ExportReport:
    """Converts the scene file `scene` to the format given by the extension of `to`.

    Args:
        scene: a file of one of `FORMATS`.
        to: the file to write.
        selection: the Gaussians to leave out.

    Raises:
        InputError: `scene` is no scene file, `to` has an unknown extension, or positions are out of range.
        StorageError: the file cannot be written.
    """
    check_format(to)
    splats = read_scene(scene)
    return save_selected(to, splats.gaussians, selection, render_mode=splats.render_mode, offset=splats.offset)
