"""Writer of the .spz file (Niantic, version 3), for browsers and phones.

A gzip stream of a 16-byte header and the fields one after the other, each for all Gaussians:

    positions (3 x 24 bits, fixed point) · opacities (8 bits) · colors (3 x 8) · ln scales (3 x 8, sixteenths)
    · quaternions (32: which entry is largest, then the others in 10 bits each) · f_rest (8 each, term by term)

The axes of the format are x right, y up, z backward. They differ from ours by a rotation of 180 degrees about x, which
applies to means and quaternions and flips the signs of some SH terms. Reference: github.com/nianticlabs/spz.
"""

import gzip
import os
import struct

import numpy as np
from jaxtyping import Float64, UInt8, UInt32

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.scene_files.export_rows import ExportReport, scene_rows, to_bytes

MAGIC, VERSION = b"NGSP", 3
ANTIALIASED = 1  # flag: made for a renderer with the 2D Mip filter
POSITION_BITS = 24
COLOR_STEP = 0.15  # factor of f_dc; it leaves room for colors outside [0, 1], which other SH terms compensate
HALF_TURN = np.array([1.0, -1.0, -1.0])  # rotation by 180 degrees about x
SH_SIGNS = np.array([-1, -1, 1, *(-1, 1, 1, -1, 1), *(-1, 1, -1, -1, 1, -1, 1)], np.float64)
"""Sign of each SH term of bands 1 to 3 (y z x; xy yz zz xz xx-yy; ...) after y and z are negated."""


def save_spz(path: str | os.PathLike, gaussians: Gaussians, *, antialiased: bool = True) -> ExportReport:
    """Writes `gaussians` to `path` atomically; the same Gaussians give the same bytes.

    `antialiased` marks the scene as made for a renderer with the 2D Mip filter, as ours is.

    Limits:
        Those of `scene_rows`. Standard deviations are quantized in steps of 6 % and clipped to [4.5e-5, 377] units,
        f_rest to [-1, 1], f_dc to [-3.3, 3.3]. The error of a position is at most 2^-23 of the largest coordinate, or
        2^-24 units if that is more.

    Raises:
        InputError: a Gaussian lies 2^23 units or farther from the origin, or an array of the scene has a wrong shape.
        StorageError: the file cannot be written.
    """
    rows = scene_rows(gaussians)
    fixed, fractional_bits = _fixed_point(HALF_TURN * rows.means)
    header = struct.pack(
        "<4sIIBBBx", MAGIC, VERSION, len(rows), gaussians.sh_degree, fractional_bits, ANTIALIASED * antialiased
    )
    terms = rows.sh.shape[1] - 1
    fields = (
        fixed,
        to_bytes(255 * rows.opacities),
        to_bytes(255 * (0.5 + COLOR_STEP * rows.sh[:, 0])),
        to_bytes(16 * (rows.log_scales + 10)),
        _smallest_three(rows.quats[:, [1, 2, 3, 0]] * [*HALF_TURN, 1.0]),
        to_bytes(128 + 128 * SH_SIGNS[:terms, None] * rows.sh[:, 1:]),
    )
    packed = gzip.compress(header + b"".join(field.tobytes() for field in fields), mtime=0)
    write_atomic(path, packed)
    return ExportReport(num_written=len(rows), num_dropped=gaussians.num_gaussians - len(rows))


def _fixed_point(means: Float64[np.ndarray, "n 3"]) -> tuple[UInt8[np.ndarray, "n 3 3"], int]:
    """Returns positions as 24-bit integers, low byte first, and the number of their fractional bits: as many as fit."""
    limit = (1 << POSITION_BITS - 1) - 1
    reach = np.abs(means).max(initial=0.0)
    if reach > limit:
        raise InputError(
            f"save_spz: wanted positions within {limit} units of the origin, got one at {reach:g}; write a .ply."
        )
    fractional_bits = 0
    while fractional_bits < POSITION_BITS - 1 and reach * 2 ** (fractional_bits + 1) <= limit:
        fractional_bits += 1
    integers = np.round(means * 2**fractional_bits).astype("<i4")
    return integers.view(np.uint8).reshape(-1, 3, 4)[:, :, :3], fractional_bits


def _smallest_three(quats: Float64[np.ndarray, "n 4"]) -> UInt32[np.ndarray, " n"]:
    """Packs unit quaternions xyzw into 32 bits; the largest entry is made positive and dropped, the others imply it."""
    rows = np.arange(len(quats))
    largest = np.abs(quats).argmax(axis=1)
    quats = quats * np.copysign(1.0, quats[rows, largest])[:, None]
    packed = largest.astype("<u4")
    for entry in range(4):
        sign = (quats[:, entry] < 0).astype("<u4")
        size = np.round(511 * np.sqrt(2) * np.abs(quats[:, entry])).astype(
            "<u4"
        )  # all but the largest are at most 1 / sqrt 2
        packed = np.where(entry == largest, packed, packed << 10 | sign << 9 | np.minimum(size, 511))
    return packed.astype("<u4")
