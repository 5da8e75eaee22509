"""Reader of .sog files (PlayCanvas, SOG version 2); `sog.py` describes the format."""

import io
import json
import os
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8
from PIL import Image, UnidentifiedImageError

from ssplat_jax.core.errors import InputError
from ssplat_jax.scene_files.smallest_three import HALF_RANGE, restore_largest
from ssplat_jax.scene_files.sog import FIRST_MODE, PALETTE_COLUMNS, VERSION
from ssplat_jax.scene_files.splat_file import SplatFile, gaussians_of_columns, read_scene_bytes

MAX_BYTES = 1 << 30
"""Most bytes of one file of the archive when it is unpacked."""
SPARE_PIXELS = 1 << 16
"""Pixels that an image may have beyond twice the wanted number, before anything of its size is allocated."""
SPOILED = (
    zipfile.BadZipFile,
    zlib.error,
    Image.DecompressionBombError,
    RuntimeError,
    LookupError,
    TypeError,
    ValueError,
    ArithmeticError,
    OSError,
    EOFError,
)
"""Errors that a damaged archive, JSON or image leads to."""
MAX_LOG_POSITION = 60.0
"""Bound of a position on its logarithmic axis: 1e26 units."""


def read_sog(path: str | os.PathLike) -> SplatFile:
    """Reads a .sog file.

    Raises:
        InputError: the file is not a SOG of version 2, or is damaged.
    """
    path = Path(path)
    data = read_scene_bytes(path, "a SOG file")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return _decoded(path, archive)
    except InputError:
        raise
    except SPOILED as error:
        raise InputError(f"{path}: cannot use this SOG file ({error!s:.200}); write it again.") from error


def _decoded(path: Path, archive: zipfile.ZipFile) -> SplatFile:
    meta = json.loads(_member(archive, "meta.json"))
    if meta["version"] != VERSION:
        raise InputError(f"{path}: wanted a SOG file of version {VERSION}, got {meta['version']!r}; write it again.")
    count = meta["count"]
    if type(count) is not int or count < 0:
        raise ValueError(f"count: wanted a number of Gaussians, got {count!r}")
    low_byte, high_byte = (_pixels(archive, name, count) for name in meta["means"]["files"][:2])
    quats, scales, sh0 = (_pixels(archive, meta[name]["files"][0], count) for name in ("quats", "scales", "sh0"))
    modes = quats[:, 3].astype(np.int64) - FIRST_MODE
    if (modes < 0).any():
        raise ValueError(f"quats: wanted an alpha of at least {FIRST_MODE}")
    sh = [_codebook(meta["sh0"])[sh0[:, :3]][:, None]]
    if "shN" in meta and count:
        sh.append(_rest(archive, meta["shN"], count))
    gaussians = gaussians_of_columns(
        path,
        means=_positions(meta["means"], low_byte[:, :3], high_byte[:, :3]),
        quats=restore_largest(modes, (quats[:, :3] / 127.5 - 1) * HALF_RANGE),
        log_scales=_codebook(meta["scales"])[scales[:, :3]],
        opacities=sh0[:, 3] / 255,
        sh=np.concatenate(sh, axis=1),
    )
    return SplatFile(gaussians, render_mode="mip" if meta.get("antialias") is True else "default")


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    if not isinstance(name, str) or archive.getinfo(name).file_size > MAX_BYTES:
        raise ValueError(f"{name!r} takes more than {MAX_BYTES} bytes")
    return archive.read(name)


def _image(archive: zipfile.ZipFile, name: str, wanted: int) -> UInt8[np.ndarray, "h w 4"]:
    """An image of at least `wanted` pixels and not many more."""
    try:
        with Image.open(io.BytesIO(_member(archive, name))) as image:
            size = image.width * image.height
            if not wanted <= size <= 2 * wanted + SPARE_PIXELS:
                raise ValueError(f"{name}: wanted {wanted} pixels, got {size}")
            return np.asarray(image.convert("RGBA"))
    except UnidentifiedImageError as error:
        raise ValueError(f"{name}: is not an image") from error


def _pixels(archive: zipfile.ZipFile, name: str, count: int) -> UInt8[np.ndarray, "n 4"]:
    return _image(archive, name, count).reshape(-1, 4)[:count]


def _codebook(part: dict[str, Any]) -> Float64[np.ndarray, " 256"]:
    codes = np.array(part["codebook"], np.float64)
    if codes.shape != (256,):
        raise ValueError(f"codebook: wanted 256 numbers, got {codes.shape}")
    return codes


def _positions(
    part: dict[str, Any], low_byte: UInt8[np.ndarray, "n 3"], high_byte: UInt8[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3"]:
    low, high = np.array(part["mins"], np.float64), np.array(part["maxs"], np.float64)
    if low.shape != (3,) or high.shape != (3,) or not (np.abs([low, high]) <= MAX_LOG_POSITION).all():
        raise ValueError("means: wanted mins and maxs of three finite numbers")
    fractions = (high_byte.astype(np.float64) * 256 + low_byte) / 65535
    logs = low + fractions * (high - low)
    return np.sign(logs) * np.expm1(np.abs(logs))


def _rest(archive: zipfile.ZipFile, part: dict[str, Any], count: int) -> Float64[np.ndarray, "n k 3"]:
    bands, entries = part["bands"], part["count"]
    if bands not in (1, 2, 3) or type(entries) is not int or not 0 < entries <= 65536:
        raise ValueError(f"shN: wanted 1 to 3 bands and 1 to 65536 entries, got {bands!r} and {entries!r}")
    terms = (bands + 1) ** 2 - 1
    labels = _pixels(archive, part["files"][1], count).astype(np.int64)
    labels = labels[:, 0] + 256 * labels[:, 1]
    image = _image(archive, part["files"][0], entries * terms)
    if image.shape[1] != PALETTE_COLUMNS * terms or labels.max() >= entries:
        raise ValueError("shN: a label beyond the palette, or a palette that is not 64 entries wide")
    return _codebook(part)[image[:, :, :3].reshape(-1, terms, 3)[labels]]
