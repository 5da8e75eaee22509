"""The .spz file (Niantic), for browsers and phones: versions 2 and 3 are read, version 3 is written.

A gzip stream of a 16-byte header and the fields one after the other, each for all Gaussians:

    positions (3 x 24 bits, fixed point) · opacities (8 bits) · colors (3 x 8) · ln scales (3 x 8, sixteenths)
    · quaternions (32: which entry is largest, then the others in 10 bits each) · f_rest (8 each, term by term)

Version 2 differs in the rotation: x, y and z of a quaternion with w >= 0 in 8 bits each. Version 4 needs zstandard,
which the standard library lacks. The axes of the format are x right, y up, z backward. They differ from ours by a
rotation of 180 degrees about x, which applies to means and quaternions and flips the signs of some SH terms.
Reference: github.com/nianticlabs/spz.
"""

import gzip
import io
import struct

import numpy as np
from jaxtyping import Float64, UInt8, UInt32

from ssplat_jax.core.errors import refusal
from ssplat_jax.scene_files.splat_rows import HALF_RANGE, SplatRows, drop_largest, to_bytes, with_largest

MAGIC, VERSION = b"NGSP", 3
HEADER = struct.Struct("<4sIIBBBB")
ANTIALIASED = 1  # flag: made for a renderer with the 2D Mip filter
POSITION_BITS = 24
COLOR_STEP = 0.15  # factor of f_dc; it leaves room for colors outside [0, 1], which other SH terms compensate
HALF_TURN = np.array([1.0, -1.0, -1.0])  # rotation by 180 degrees about x
SH_SIGNS = np.array([-1, -1, 1, *(-1, 1, 1, -1, 1), *(-1, 1, -1, -1, 1, -1, 1)], np.float64)
"""Sign of each SH term of bands 1 to 3 (y z x; xy yz zz xz xx-yy; ...) after y and z are negated."""
MAX_RATIO = 1032
"""Most bytes that deflate can make of one."""


def encode_spz(rows: SplatRows) -> bytes:
    """The bytes of a .spz of version 3.

    Limits:
        Standard deviations are quantized in steps of 6 % and clipped to [4.5e-5, 377] units, f_rest to [-1, 1], f_dc to
        [-3.3, 3.3]. The error of a position is at most 2^-23 of the largest coordinate, or 2^-24 units if that is more.

    Raises:
        InputError: a Gaussian lies 2^23 units or farther from the origin.
    """
    limit, reach = (1 << POSITION_BITS - 1) - 1, np.abs(rows.means).max(initial=0.0)
    if reach > limit:
        wanted = f"positions within {limit} units of the origin"
        raise refusal("save_spz", wanted=wanted, got=f"one at {reach:g}", fix="write a .ply")
    fractional_bits = next(bits for bits in reversed(range(POSITION_BITS)) if reach * 2**bits <= limit)  # all that fit
    fixed = np.round(HALF_TURN * rows.means * 2**fractional_bits).astype("<i4")
    terms = rows.sh.shape[1] - 1
    degree, flags = round((terms + 1) ** 0.5) - 1, ANTIALIASED * (rows.render_mode == "mip")
    fields = (
        fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3],  # the low three bytes
        to_bytes(255 * rows.opacities),
        to_bytes(255 * (0.5 + COLOR_STEP * rows.sh[:, 0])),
        to_bytes(16 * (rows.log_scales + 10)),
        _pack_rotations(rows.quats[:, [1, 2, 3, 0]] * [*HALF_TURN, 1.0]),
        to_bytes(128 + 128 * SH_SIGNS[:terms, None] * rows.sh[:, 1:]),
    )
    header = HEADER.pack(MAGIC, VERSION, len(rows), degree, fractional_bits, flags, 0)
    # No time in the stream: the same scene gives the same bytes.
    return gzip.compress(header + b"".join(field.tobytes() for field in fields), mtime=0)


def _pack_rotations(quats: Float64[np.ndarray, "n 4"]) -> UInt32[np.ndarray, " n"]:
    """Unit quaternions xyzw in 32 bits, each entry but the largest as its sign and nine bits of magnitude."""
    largest, others = drop_largest(quats)
    packed = largest.astype("<u4")
    for column in others.T:
        size = np.minimum(np.round(511 * np.sqrt(2) * np.abs(column)).astype("<u4"), 511)
        packed = packed << 10 | (column < 0).astype("<u4") << 9 | size
    return packed


def decode_spz(data: bytes) -> SplatRows:
    """The rows of a .spz of version 2 or 3."""
    if data[:4] == MAGIC:
        raise ValueError("it is of version 4 or later; convert it to version 3")
    with gzip.GzipFile(fileobj=io.BytesIO(data)) as stream:
        magic, version, count, degree, fractional_bits, flags, _ = HEADER.unpack(stream.read(HEADER.size))
        if magic != MAGIC or version not in (2, 3) or degree > 3:
            raise ValueError(f"wanted version 2 or 3 and SH degree 0 to 3, got version {version}, degree {degree}")
        widths = (9, 1, 3, 3, version + 1, 3 * ((degree + 1) ** 2 - 1))
        size = count * sum(widths)
        body = stream.read(size) if size <= len(data) * MAX_RATIO else b""  # else the count is damaged
        stream.read(1)  # to the end, where gzip compares the checksum
    if len(body) < size:
        raise ValueError(f"wanted {size} bytes for {count} Gaussians; it is cut off")
    parts = np.split(np.frombuffer(body, np.uint8, size), count * np.cumsum(widths)[:-1])
    means, alphas, colors, scales, quats, rest = (
        part.reshape(count, width) for part, width in zip(parts, widths, strict=True)
    )
    rest = rest.reshape(count, widths[-1] // 3, 3).astype(np.float64)
    # Three bytes become the upper ones of an int32, whose shift to the right keeps the sign.
    fixed = np.pad(means.reshape(count, 3, 3), ((0, 0), (0, 0), (1, 0))).view("<i4")[..., 0] >> 8
    xyzw = _unpack_rotations(quats) if version == 3 else with_largest(np.full(count, 3), quats / 127.5 - 1)
    return SplatRows(
        means=HALF_TURN * fixed.astype(np.float64) / 2.0**fractional_bits,
        quats=(xyzw * [*HALF_TURN, 1.0])[:, [3, 0, 1, 2]],
        log_scales=scales / 16 - 10,
        opacities=alphas[:, 0] / 255,
        sh=np.concatenate(
            [((colors / 255 - 0.5) / COLOR_STEP)[:, None], SH_SIGNS[: rest.shape[1], None] * (rest - 128) / 128], axis=1
        ),
        render_mode="mip" if flags & ANTIALIASED else "default",
    )


def _unpack_rotations(rows: UInt8[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 4"]:
    words = np.ascontiguousarray(rows).view("<u4")[:, 0]
    parts = np.stack([words >> shift & 1023 for shift in (20, 10, 0)], axis=1).astype(np.int64)
    sizes = (parts & 511) / 511 * HALF_RANGE
    return with_largest((words >> 30).astype(np.int64), np.where(parts & 512, -sizes, sizes))
