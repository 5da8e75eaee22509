"""Reader of .spz files (Niantic), versions 2 and 3; `spz.py` describes the format.

Version 2 differs in the rotation: x, y and z of a quaternion with w >= 0 in 8 bits each.
"""

import gzip
import io
import os
import struct
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from ssplat_jax.core.errors import InputError
from ssplat_jax.scene_files.smallest_three import HALF_RANGE, restore_largest
from ssplat_jax.scene_files.splat_file import SplatFile, gaussians_of_columns, read_scene_bytes
from ssplat_jax.scene_files.spz import ANTIALIASED, COLOR_STEP, HALF_TURN, MAGIC, POSITION_BITS, SH_SIGNS

HEADER = struct.Struct("<4sIIBBBB")
QUAT_BYTES = {2: 3, 3: 4}
"""Bytes of a rotation by version."""
MAX_RATIO = 1032
"""Most bytes that deflate can make of one."""


def read_spz(path: str | os.PathLike) -> SplatFile:
    """Reads a .spz file of version 2 or 3, into the axes of a .ply.

    Raises:
        InputError: the file is not a .spz of these versions, or is cut off.
    """
    path = Path(path)
    data = read_scene_bytes(path, "a .spz file")
    if data[:4] == MAGIC:
        raise InputError(f"{path}: wanted a .spz of version 2 or 3, got a later one; convert it to one of these.")
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as stream:
            header = stream.read(HEADER.size)
            count, widths = _widths(path, header, len(data))
            num_bytes = count * sum(widths.values())
            body = stream.read(num_bytes)
            stream.read(1)  # to the end, where gzip compares the checksum
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{path}: wanted a .spz file, it cannot be unpacked ({error}); write it again.") from error
    if len(body) < num_bytes:
        raise InputError(f"{path}: wanted {num_bytes} bytes after the header, got {len(body)}; it is cut off.")
    _, version, _, _, fractional_bits, flags, _ = HEADER.unpack(header)
    fields, offset = {}, 0
    for name, width in widths.items():
        fields[name] = np.frombuffer(body, np.uint8, count * width, offset).reshape(count, width)
        offset += count * width
    rest = fields["rest"].reshape(count, widths["rest"] // 3, 3).astype(np.float64)
    constant = (fields["colors"] / 255 - 0.5) / COLOR_STEP
    signs = SH_SIGNS[: rest.shape[1], None]
    gaussians = gaussians_of_columns(
        path,
        means=HALF_TURN * _positions(fields["means"]) / 2.0**fractional_bits,
        quats=_turned_back(_first_three(fields["quats"]) if version == 2 else _smallest_three(fields["quats"])),
        log_scales=fields["scales"] / 16 - 10,
        opacities=fields["alphas"][:, 0] / 255,
        sh=np.concatenate([constant[:, None], signs * (rest - 128) / 128], axis=1),
    )
    return SplatFile(gaussians, render_mode="mip" if flags & ANTIALIASED else "default")


def _widths(path: Path, header: bytes, num_packed: int) -> tuple[int, dict[str, int]]:
    """Number of Gaussians and bytes of each field of one, in their order; checked against the size of the file."""
    if len(header) < HEADER.size or header[:4] != MAGIC:
        raise InputError(f"{path}: wanted a .spz file, it has another header; write it again.")
    _, version, count, degree, _, _, _ = HEADER.unpack(header)
    if version not in QUAT_BYTES or degree > 3:
        raise InputError(
            f"{path}: wanted a .spz of version 2 or 3 and SH degree 0 to 3, got version {version} and degree {degree};"
            " convert it to one of these."
        )
    each = {"means": 9, "alphas": 1, "colors": 3, "scales": 3, "quats": QUAT_BYTES[version]}
    each["rest"] = 3 * ((degree + 1) ** 2 - 1)
    if count * sum(each.values()) > num_packed * MAX_RATIO:
        raise InputError(f"{path}: wanted {count} Gaussians in {num_packed} bytes, they cannot fit; write it again.")
    return count, each


def _positions(bytes_: UInt8[np.ndarray, "n 9"]) -> Float64[np.ndarray, "n 3"]:
    """Signed integers of 24 bits."""
    parts = bytes_.reshape(-1, 3, 3).astype(np.int64)
    values = parts[..., 0] | parts[..., 1] << 8 | parts[..., 2] << 16
    return (values - (values >> POSITION_BITS - 1 << POSITION_BITS)).astype(np.float64)


def _first_three(bytes_: UInt8[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 4"]:
    """Quaternions xyzw of version 2."""
    xyz = bytes_ / 127.5 - 1
    return restore_largest(np.full(len(xyz), 3), xyz)


def _smallest_three(bytes_: UInt8[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 4"]:
    """Quaternions xyzw of version 3."""
    words = np.ascontiguousarray(bytes_).view("<u4")[:, 0]
    parts = np.stack([words >> shift & 1023 for shift in (20, 10, 0)], axis=1).astype(np.int64)
    sizes = (parts & 511) / 511 * HALF_RANGE
    return restore_largest((words >> 30).astype(np.int64), np.where(parts & 512, -sizes, sizes))


def _turned_back(quats: Float64[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 4"]:
    """Quaternions wxyz in the axes of a .ply of ones xyzw in those of the format."""
    return (quats * [*HALF_TURN, 1.0])[:, [3, 0, 1, 2]]
