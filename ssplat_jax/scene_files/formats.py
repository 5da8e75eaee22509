"""Reads and writes scenes in the format given by the file's name: the one boundary for files that are damaged."""

import dataclasses
import os
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.errors import reading, refusal
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.scene_files.glb import AXIS_FLIP, decode_glb, encode_glb
from ssplat_jax.scene_files.ply import decode_ply, encode_ply
from ssplat_jax.scene_files.sog import decode_sog, encode_sog
from ssplat_jax.scene_files.splat_rows import RENDER_MODES, SplatRows, encode_splat, gaussians_of_rows, rows_to_write
from ssplat_jax.scene_files.spz import RUB, decode_spz, encode_spz

FilePath = str | os.PathLike
RETRY = "check the path, or write the file again"
# By the end of the file's name. A .ply may be a compressed one, whatever its name.
WRITERS: dict[str, Callable[..., bytes]] = {".ply": encode_ply, ".spz": encode_spz, ".sog": encode_sog}
WRITERS |= {".glb": encode_glb, ".splat": encode_splat}
SCENE_READERS: dict[str, Callable[[bytes], SplatRows]] = {".compressed.ply": decode_ply, ".ply": decode_ply}
SCENE_READERS |= {".spz": decode_spz, ".sog": decode_sog, ".glb": decode_glb}


@dataclasses.dataclass(frozen=True)
class ExportReport:
    """Counts of written and dropped Gaussians, and the offset of the positions in the file."""

    num_written: int
    num_dropped: int  # with non-finite entries, a negative scale, or an opacity below 1/255 (absent rows included)
    offset: tuple[float, float, float]  # to add to the positions in the file
    num_cut: int  # left out because there were more than wanted

    @property
    def warning(self) -> str | None:
        """Note for the user who opens the file, or None."""
        far = "the capture lies far from its origin; positions are counted from"
        return f"{far} {[float(x) for x in self.offset]}." if any(self.offset) else None


def check_format(path: FilePath, option: str = "--to", formats: Collection[str] = WRITERS) -> str:
    """The end of a file's name, which must be one of `formats`."""
    name = Path(path).name.lower()
    # Nothing writes a .compressed.ply, though its name ends with .ply.
    suffix = next((suffix for suffix in (".compressed.ply", *SCENE_READERS, *WRITERS) if name.endswith(suffix)), "")
    if suffix not in formats:
        wanted = f"a file named *{', *'.join(formats)}"
        raise refusal(option, wanted=wanted, got=repr(Path(path).name), fix="choose one of these")
    return suffix


def save_gaussians(
    path: FilePath,
    gaussians: Gaussians,
    *,
    suffix: str | None = None,
    max_splats: int | None = None,
    spz_version: int = 4,
    start_camera: dict[str, Any] | None = None,
) -> ExportReport:
    """Writes `gaussians` to `path` atomically; the same Gaussians give the same bytes.

    Args:
        path: the file to write. Missing folders are created.
        gaussians: the scene, in the frame of the file. A .spz and a .sog store of its render mode only whether it is
            "mip", a .splat nothing; none of the three stores its offset.
        suffix: the format, one of `WRITERS`; by default the one that the file's name ends with.
        max_splats: most Gaussians to write; opaque ones are kept first, everywhere alike.
        spz_version: version of a .spz, 4 or 3.
        start_camera: position, target and vertical angle of view (degrees) of the camera with which viewers may start;
            a .sog holds it.

    Raises:
        InputError: an unknown extension or render mode, positions or sizes that the format cannot hold, a wrong shape.
        StorageError: the file cannot be written.
    """
    encode = WRITERS[suffix or check_format(path)]
    options = {encode_spz: {"version": spz_version}, encode_sog: {"start_camera": start_camera}}.get(encode, {})
    mode, offset = gaussians.render_mode, gaussians.offset
    if mode not in RENDER_MODES:
        raise refusal("render_mode", wanted=f"one of {', '.join(RENDER_MODES)}", got=repr(mode), fix="use one")
    if max_splats is not None and max_splats < 1:
        raise refusal("--max-splats", wanted="at least 1", got=max_splats, fix="leave it out to write all")
    rows, num_cut = rows_to_write(gaussians, max_splats)
    write_atomic(path, encode(dataclasses.replace(rows, render_mode=mode, offset=offset), **options))
    return ExportReport(len(rows), gaussians.num_gaussians - len(rows) - num_cut, offset, num_cut)


def save_ply(path: FilePath, gaussians: Gaussians) -> ExportReport:
    """Writes a 3DGS .ply, whatever the file's name; see `save_gaussians`."""
    return save_gaussians(path, gaussians, suffix=".ply")


def save_spz(path: FilePath, gaussians: Gaussians, *, version: int = 4) -> ExportReport:
    """Writes a .spz of version 4 or 3, whatever the file's name; see `save_gaussians`."""
    return save_gaussians(path, gaussians, suffix=".spz", spz_version=version)


def file_axes(path: FilePath) -> Float64[np.ndarray, "3 3"]:
    """Matrix from the axes of a .ply, those of the capture, to those of the file's format."""
    return {".glb": AXIS_FLIP, ".spz": RUB.T}.get(check_format(path), np.eye(3))


def load_scene(path: FilePath) -> Gaussians:
    """The Gaussians of a scene file, .ply, .compressed.ply, .spz, .sog or .glb, with its render mode and its offset.

    Raises:
        InputError: an unknown extension, or the file is damaged or of another format than its name says.
    """
    return _read(path, check_format(path, "scene", SCENE_READERS))


def load_ply(path: FilePath) -> Gaussians:
    """The Gaussians of a .ply, compressed or not, whatever the file's name; see `load_scene`."""
    return _read(path, ".ply")


def _read(path: FilePath, suffix: str) -> Gaussians:
    with reading(f"{path} as a {suffix}", RETRY), np.errstate(all="ignore"):  # NaNs are refused by what they mean
        return gaussians_of_rows(SCENE_READERS[suffix](Path(path).read_bytes()))
