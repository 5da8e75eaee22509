"""Reader and writer of the compressed .ply (PlayCanvas, SuperSplat): 16 bytes per Gaussian, and one for each f_rest.

    element chunk   18 float32: min and max of x y z, of ln scales, of r g b; for 256 Gaussians each
    element vertex   4 uint32: position (11, 10, 11 bits) · rotation (2, 10 x 3) · scale (11, 10, 11) · color (8 x 4)
    element sh       f_rest_0 ... as uint8, channel-major as in a .ply; only where SH bands above the constant one exist

Positions, ln scales and colors are fractions of the range of their chunk, first entry in the highest bits. A rotation
holds which entry of the quaternion wxyz is largest and the other three, from -1/sqrt 2 to 1/sqrt 2. The alpha of the
color is the opacity. Gaussians are in Morton order, so that chunks are small. Axes are those of the .ply.
Reference: developer.playcanvas.com, user manual, "The compressed PLY format".
"""

import os

import numpy as np
from jaxtyping import Float, Float64, UInt32

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.scene_files.export_rows import LOG_SCALE_LIMIT, ExportReport, scene_rows, to_bytes
from ssplat_jax.scene_files.morton import morton_order
from ssplat_jax.scene_files.ply import offset_comment, offset_of, render_mode_of
from ssplat_jax.scene_files.ply_table import MAX_HEADER_BYTES, read_tables
from ssplat_jax.scene_files.smallest_three import HALF_RANGE, drop_largest, restore_largest
from ssplat_jax.scene_files.splat_file import SplatFile, gaussians_of_columns, widened

CHUNK = 256
VECTOR_BITS = (11, 10, 11)
SH_RANGE = 8.0
"""f_rest is clipped to half of this on either side of 0."""
MIN_RANGE = 1e-5
"""A range below this holds one value: its Gaussians get the smallest one."""
VECTORS = (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
LIMITS = tuple(tuple(f"{end}_{name}" for end in ("min", "max") for name in names) for names in VECTORS)
"""Properties of a chunk: for positions, ln scales and colors the three minima, then the three maxima."""
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def save_compressed_ply(
    path: str | os.PathLike,
    gaussians: Gaussians,
    *,
    render_mode: str = "mip",
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> ExportReport:
    """Writes `gaussians` to `path` atomically; the same Gaussians give the same bytes.

    Args:
        path: the file to write; missing folders are created.
        gaussians: the scene, in the frame of the file.
        render_mode: value of the comment `SplatRenderMode`, see `save_ply`.
        offset: origin of `gaussians` in the frame of the file; written as a comment unless it is zero.

    Returns:
        Counts of written and dropped Gaussians, and `offset`.

    Limits:
        Those of `scene_rows`. Within a chunk of 256 neighbors, positions and ln scales have 1024 to 2048 steps, colors
        and opacities 256; entries of quaternions are off by 7e-4 at most, f_rest is clipped to [-4, 4] in
        steps of 1/32.

    Raises:
        InputError: an array of the scene has a wrong shape.
        StorageError: the file cannot be written.
    """
    rows = scene_rows(gaussians)
    order = morton_order(rows.means)
    log_scales = np.clip(rows.log_scales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)
    colors = 0.5 + SH_C0 * rows.sh[:, 0]
    limits, fractions = zip(*(_chunked(values[order]) for values in (rows.means, log_scales, colors)), strict=True)
    rgba = to_bytes(255 * np.concatenate([fractions[2], rows.opacities[order, None]], axis=1)).astype("<u4")
    vertices = np.stack(
        [
            _pack_vectors(fractions[0]),
            _pack_rotations(rows.quats[order]),
            _pack_vectors(fractions[1]),
            rgba @ np.array([1 << 24, 1 << 16, 1 << 8, 1], "<u4"),
        ],
        axis=1,
    )
    rest = rows.sh[order, 1:].transpose(0, 2, 1).reshape(len(rows), 3 * (rows.sh.shape[1] - 1))
    comments = [f"comment SplatRenderMode: {render_mode}", *offset_comment(offset)]
    header = _header(len(limits[0]), len(rows), rest.shape[1], comments)
    body = np.concatenate(limits, axis=1).astype("<f4").tobytes() + vertices.astype("<u4").tobytes()
    levels = np.clip(np.floor((rest / SH_RANGE + 0.5) * 256), 0, 255).astype(np.uint8)
    write_atomic(path, header + body + levels.tobytes())
    return ExportReport(num_written=len(rows), num_dropped=gaussians.num_gaussians - len(rows), offset=offset)


def _header(num_chunks: int, num_rows: int, num_rest: int, comments: list[str]) -> bytes:
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *comments,
        f"element chunk {num_chunks}",
        *(f"property float {name}" for names in LIMITS for name in names),
        f"element vertex {num_rows}",
        *(f"property uint {name}" for name in PACKED),
        *([f"element sh {num_rows}"] if num_rest else []),
        *(f"property uchar f_rest_{i}" for i in range(num_rest)),
        "end_header\n",
    ]
    return "\n".join(lines).encode("ascii")


def _chunked(values: Float64[np.ndarray, "n 3"]) -> tuple[Float64[np.ndarray, "c 6"], Float64[np.ndarray, "n 3"]]:
    """Minima and maxima of each chunk, as float32 holds them, and the values as fractions of their chunk's range."""
    starts = np.arange(0, len(values), CHUNK)
    low, high = (
        end.reduceat(values, starts, axis=0).astype(np.float32).astype(np.float64) if len(values) else np.zeros((0, 3))
        for end in (np.minimum, np.maximum)
    )
    chunk = np.arange(len(values)) // CHUNK
    size = (high - low)[chunk]
    is_flat = size < MIN_RANGE  # one Gaussian, or a plane along an axis: nothing to divide by
    fractions = np.where(is_flat, 0.0, (values - low[chunk]) / np.where(is_flat, 1.0, size))
    return np.concatenate([low, high], axis=1), np.clip(fractions, 0.0, 1.0)


def _pack_vectors(fractions: Float64[np.ndarray, "n 3"]) -> UInt32[np.ndarray, " n"]:
    packed = np.zeros(len(fractions), np.uint32)
    for bits, column in zip(VECTOR_BITS, fractions.T, strict=True):
        packed = packed << bits | np.round(column * ((1 << bits) - 1)).astype(np.uint32)
    return packed


def _pack_rotations(quats: Float64[np.ndarray, "n 4"]) -> UInt32[np.ndarray, " n"]:
    largest, others = drop_largest(quats)
    packed = largest.astype(np.uint32)
    for column in others.T:
        level = np.clip(np.round((0.5 + 0.5 * column / HALF_RANGE) * 1023), 0, 1023)
        packed = packed << 10 | level.astype(np.uint32)
    return packed


def is_compressed_ply(path: str | os.PathLike) -> bool:
    """True if a file that can be read names the properties of a compressed .ply in its header."""
    try:
        with open(path, "rb") as file:
            header = file.read(MAX_HEADER_BYTES)
    except OSError:
        return False
    return PACKED[0].encode("ascii") in header.partition(b"end_header")[0]


def read_compressed_ply(path: str | os.PathLike) -> SplatFile:
    """Reads a compressed .ply; files of earlier versions, without a range of colors, too.

    Raises:
        InputError: the file is not a compressed .ply, is cut off, or holds entries that are not finite.
    """
    tables, comments = read_tables(path, ("vertex", "chunk", "sh"))
    vertex, chunk, rest = (tables.get(name, {}) for name in ("vertex", "chunk", "sh"))
    for name, held, wanted in (("vertex", vertex, PACKED), ("chunk", chunk, LIMITS[0] + LIMITS[1])):
        for missing in (x for x in wanted if x not in held):
            raise InputError(f"{path}: element {name}: wanted the property {missing!r}, it is missing; write it again.")
    packed = [vertex[name].astype(np.uint32) for name in PACKED]
    num_rows, num_chunks = len(packed[0]), len(chunk["min_x"])
    if num_chunks * CHUNK < num_rows:
        raise InputError(
            f"{path}: wanted a chunk for every {CHUNK} of {num_rows} Gaussians, got {num_chunks}; write it again."
        )
    rgba = np.stack([packed[3] >> shift & 255 for shift in (24, 16, 8, 0)], axis=1) / 255
    colors = _of_chunks(chunk, LIMITS[2], rgba[:, :3]) if all(name in chunk for name in LIMITS[2]) else rgba[:, :3]
    gaussians = gaussians_of_columns(
        path,
        means=_of_chunks(chunk, LIMITS[0], _unpack_vectors(packed[0])),
        quats=_unpack_rotations(packed[1]),
        log_scales=_of_chunks(chunk, LIMITS[1], _unpack_vectors(packed[2])),
        opacities=rgba[:, 3],
        sh=np.concatenate([((colors - 0.5) / SH_C0)[:, None], _unpack_rest(path, rest, num_rows)], axis=1),
    )
    return SplatFile(gaussians, render_mode_of(comments), offset_of(path, comments))


def _unpack_vectors(packed: UInt32[np.ndarray, " n"]) -> Float64[np.ndarray, "n 3"]:
    shifts = (sum(VECTOR_BITS[1:]), VECTOR_BITS[2], 0)
    masks = [(1 << bits) - 1 for bits in VECTOR_BITS]
    return np.stack([(packed >> shift & mask) / mask for shift, mask in zip(shifts, masks, strict=True)], axis=1)


def _unpack_rotations(packed: UInt32[np.ndarray, " n"]) -> Float64[np.ndarray, "n 4"]:
    levels = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], axis=1)
    return restore_largest((packed >> 30).astype(np.int64), (2 * levels / 1023 - 1) * HALF_RANGE)


def _of_chunks(
    chunk: dict[str, np.ndarray], limits: tuple[str, ...], fractions: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Values of fractions of the ranges of their chunks."""
    ends = widened(np.stack([chunk[name] for name in limits], axis=1))
    low, high = ends[:, :3], ends[:, 3:]
    of_row = np.arange(len(fractions)) // CHUNK
    return low[of_row] + fractions * (high - low)[of_row]


def _unpack_rest(path, table: dict[str, np.ndarray], num_rows: int) -> Float[np.ndarray, "n k 3"]:
    if not table:
        return np.zeros((num_rows, 0, 3))
    names = [f"f_rest_{i}" for i in range(len(table))]
    if len(table) not in (9, 24, 45) or not all(name in table for name in names) or len(table[names[0]]) < num_rows:
        raise InputError(
            f"{path}: element sh: wanted 9, 24 or 45 f_rest for each of {num_rows} Gaussians, got {len(table)} for"
            f" {len(next(iter(table.values())))}; write it again."
        )
    levels = np.stack([table[name][:num_rows] for name in names], axis=1)
    rest = ((levels + 0.5) / 256 - 0.5) * SH_RANGE
    return rest.reshape(num_rows, 3, len(table) // 3).transpose(0, 2, 1)
