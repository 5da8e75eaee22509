"""The .spz file (Niantic), for browsers and phones: versions 2 to 4 are read, 4 and on request 3 are written.

A file holds the fields one after the other, each for all Gaussians:

    positions (3 x 24 bits, fixed point) · opacities (8 bits) · colors (3 x 8) · ln scales (3 x 8, sixteenths)
    · quaternions (32: which entry is largest, then the others in 10 bits each) · f_rest (8 each, term by term)

Version 4 is a plain header of 32 bytes; records of extensions, each a type, a length and its contents; a table of the
compressed and the full size of every field; and the fields, each a frame of zstd. Versions 2 and 3 are a gzip stream of
a header of 16 bytes and the fields. Version 2 differs in the rotation: x, y and z of a quaternion with w >= 0 in 8 bits
each. The axes of the format are x right, y up, z backward, unless a record names others; those of a .ply are x right,
y down, z forward. Reference: github.com/nianticlabs/spz.
"""

import gzip
import io
import struct

import numpy as np
import zstandard
from jaxtyping import Float64, UInt8, UInt32

from ssplat_jax.core.errors import refusal
from ssplat_jax.core.rotations import sh_rotation
from ssplat_jax.scene_files.splat_rows import SplatRows, check_sizes, drop_largest, placed, to_bytes, with_largest

MAGIC = b"NGSP"
VERSIONS = (4, 3)  # versions that are written, the usual one first
OLD_HEADER = struct.Struct("<4sIIBBBB")
HEADER = struct.Struct("<4sIIBBBBI12x")
SIZES, RECORD = struct.Struct("<QQ"), struct.Struct("<II")
ANTIALIASED, HAS_RECORDS = 1, 2  # flags: made for a renderer with the 2D Mip filter; there are records
AXES_RECORD = 0xADBE0003
AXES = "RUB LDB RDB LUB RUB LDF RDF LUF RUF LFD RFD LFU RFU LBD RBD LBU RBU".split()  # noqa: SIM905
"""Directions of x, y and z, by the number in a record: left or right, up or down, front or back."""
DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
COMPRESSION = 12  # level of zstd
POSITION_BITS = 24
COLOR_STEP = 0.15  # factor of f_dc; it leaves room for colors outside [0, 1], which other SH terms compensate
LOG_SCALES = (-10.0, 255 / 16 - 10)  # least and largest
MAX_RECORDS = 1 << 16  # bytes of the records of a file of version 3, which are at its end
MAX_RATIO = 1032
"""Most bytes that a compressed byte may become: what deflate can make of one, and more than zstd does of a scene."""


def encode_spz(rows: SplatRows, version: int = VERSIONS[0]) -> bytes:
    """The bytes of a .spz of version 3 or 4.

    Limits:
        Standard deviations are quantized in steps of 6 % and clipped to [4.5e-5, 377] units, f_rest to [-1, 1], f_dc to
        [-3.3, 3.3]. The error of a position is at most 2^-23 of the largest coordinate, or 2^-24 units if that is more.

    Raises:
        InputError: a Gaussian lies 2^23 units or farther from the origin, over 1 % of the Gaussians have a larger or
            smaller size than the format holds, or another version.
    """
    if version not in VERSIONS:
        raise refusal("save_spz", wanted="version 3 or 4", got=version, fix="leave it out for version 4")
    limit, reach = (1 << POSITION_BITS - 1) - 1, np.abs(rows.means).max(initial=0.0)
    if reach > limit:
        wanted = f"positions within {limit} units of the origin"
        raise refusal("save_spz", wanted=wanted, got=f"one at {reach:g}", fix="write a .ply")
    check_sizes(rows.log_scales, *LOG_SCALES)
    fractional_bits = next(bits for bits in reversed(range(POSITION_BITS)) if reach * 2**bits <= limit)  # all that fit
    turn, degree = RUB.T, round(rows.sh.shape[1] ** 0.5) - 1
    fixed = np.round(rows.means @ turn.T * 2**fractional_bits).astype("<i4")
    signs = np.round(np.diag(sh_rotation(turn, degree)))[1:, None]
    fields = (
        fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3],  # the low three bytes
        to_bytes(255 * rows.opacities),
        to_bytes(255 * (0.5 + COLOR_STEP * rows.sh[:, 0])),
        to_bytes(16 * (rows.log_scales - LOG_SCALES[0])),
        _pack_rotations(rows.quats[:, [1, 2, 3, 0]] * [*np.diag(turn), 1.0]),
        to_bytes(128 + 128 * signs * rows.sh[:, 1:]),
    )
    flags, parts = ANTIALIASED * (rows.render_mode == "mip"), [field.tobytes() for field in fields]
    facts = (MAGIC, version, len(rows), degree, fractional_bits, flags)
    if version == 3:  # no time in the stream: the same scene gives the same bytes
        return gzip.compress(OLD_HEADER.pack(*facts, 0) + b"".join(parts), mtime=0)
    parts = parts if degree else parts[:-1]
    compressor = zstandard.ZstdCompressor(level=COMPRESSION, write_checksum=True, write_content_size=True)
    frames = [compressor.compress(part) for part in parts]
    table = [SIZES.pack(len(frame), len(part)) for frame, part in zip(frames, parts, strict=True)]
    return HEADER.pack(*facts, len(frames), HEADER.size) + b"".join([*table, *frames])


def _axes(letters: str) -> Float64[np.ndarray, "3 3"]:
    """Matrix from axes that point as the letters say to those of a .ply."""
    return np.array([DIRECTIONS[letter] for letter in letters], np.float64).T


RUB = _axes("RUB")


def _pack_rotations(quats: Float64[np.ndarray, "n 4"]) -> UInt32[np.ndarray, " n"]:
    """Unit quaternions xyzw in 32 bits, each entry but the largest as its sign and nine bits of magnitude."""
    largest, others = drop_largest(quats)
    packed = largest.astype("<u4")
    for column in others.T:
        size = np.minimum(np.round(511 * np.sqrt(2) * np.abs(column)).astype("<u4"), 511)
        packed = packed << 10 | (column < 0).astype("<u4") << 9 | size
    return packed


def decode_spz(data: bytes) -> SplatRows:
    """The rows of a .spz of version 2, 3 or 4."""
    is_framed = data[:4] == MAGIC  # else the header is in a gzip stream, too
    source, header = (io.BytesIO(data), HEADER) if is_framed else (gzip.GzipFile(fileobj=io.BytesIO(data)), OLD_HEADER)
    magic, version, count, degree, fractional_bits, flags, *places = header.unpack(source.read(header.size))
    if magic != MAGIC or version not in ((4,) if is_framed else (2, 3)) or degree > 3:
        raise ValueError(f"wanted version 2 to 4 and SH degree 0 to 3, got version {version}, degree {degree}")
    widths = 9, 1, 3, 3, 3 if version == 2 else 4, 3 * ((degree + 1) ** 2 - 1)  # bytes of each field of a Gaussian
    if (size := count * sum(widths)) > len(data) * MAX_RATIO:
        raise ValueError(f"{count} Gaussians do not fit; it is damaged or cut off")
    if is_framed:
        num_frames, table = places
        if not HEADER.size <= table <= len(data) or num_frames not in (5 + (degree > 0), 6):
            raise ValueError(f"wanted 5 or 6 fields, got {num_frames} at {table}")
        records = data[HEADER.size : table]
        body = _joined_frames(data, table, [count * width for width in widths[:num_frames]])
    else:
        body = source.read(size)
        records = source.read(MAX_RECORDS + 1)[:MAX_RECORDS]  # to the end, where gzip compares the checksum
    if len(body) < size:
        raise ValueError(f"wanted {size} bytes for {count} Gaussians; it is cut off")
    axes = _axes_of_records(records) if flags & HAS_RECORDS else "RUB"
    parts = np.split(np.frombuffer(body, np.uint8), count * np.cumsum(widths)[:-1])
    means, alphas, colors, scales, quats, rest = (
        part.reshape(count, width) for part, width in zip(parts, widths, strict=True)
    )
    rest = rest.reshape(count, widths[-1] // 3, 3).astype(np.float64)
    # Three bytes become the upper ones of an int32, whose shift to the right keeps the sign.
    fixed = np.pad(means.reshape(count, 3, 3), ((0, 0), (0, 0), (1, 0))).view("<i4")[..., 0] >> 8
    x, y, z, w = (with_largest(np.full(count, 3), quats / 127.5 - 1) if version == 2 else _unpack_rotations(quats)).T
    columns = {
        "means": fixed.astype(np.float64) / 2.0**fractional_bits,
        # Turned by 180 degrees about the Gaussian's own first axis, as the axes of the file are: it stays as it is.
        "quats": np.stack([x, -w, -z, y], axis=1),
        "log_scales": scales / 16 + LOG_SCALES[0],
        "opacities": alphas[:, 0] / 255,
        "sh": np.concatenate([((colors / 255 - 0.5) / COLOR_STEP)[:, None], (rest - 128) / 128], axis=1),
    }
    render_mode = "mip" if flags & ANTIALIASED else "default"
    columns = placed(columns, np.c_[_axes(axes), np.zeros(3)])
    return SplatRows(**columns, render_mode=render_mode, offset=(0.0, 0.0, 0.0))


def _axes_of_records(records: bytes) -> str:
    """The axes that records of extensions name, by default those of the format."""
    axes, place = "RUB", 0
    while place < len(records):
        kind, length = RECORD.unpack_from(records, place)
        if (place := place + RECORD.size) + length > len(records):
            raise ValueError("a record is cut off")
        if kind == AXES_RECORD:
            axes = AXES[int.from_bytes(records[place : place + length], "little")]
        place += length
    return axes


def _joined_frames(data: bytes, table: int, sizes: list[int]) -> bytes:
    """The fields of a file of version 4, of known sizes, from the table of their frames on."""
    body, place = [], table + len(sizes) * SIZES.size
    for i, wanted in enumerate(sizes):
        length, size = SIZES.unpack_from(data, table + i * SIZES.size)
        frame, place = data[place : place + length], place + length
        if size != wanted or len(frame) < length:
            raise ValueError(f"field {i}: wanted {wanted} bytes, got {size}; it is damaged or cut off")
        if size and zstandard.get_frame_parameters(frame).content_size not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise ValueError(f"field {i}: a frame of another size than the table says")  # before it is allocated
        body.append(zstandard.ZstdDecompressor().decompress(frame, max_output_size=size) if size else b"")
        if len(body[-1]) != size:
            raise ValueError(f"field {i}: a frame holds {len(body[-1])} bytes, the table says {size}")
    return b"".join(body)


def _unpack_rotations(rows: UInt8[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 4"]:
    words = np.ascontiguousarray(rows).view("<u4")[:, 0]
    parts = np.stack([words >> shift & 1023 for shift in (20, 10, 0)], axis=1).astype(np.int64)
    sizes = (parts & 511) / 511 * np.sqrt(0.5)
    return with_largest((words >> 30).astype(np.int64), np.where(parts & 512, -sizes, sizes))
