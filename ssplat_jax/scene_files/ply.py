"""The 3DGS .ply file, which every splat viewer opens, and the compressed .ply of PlayCanvas, which is read only.

A .ply is binary, little endian, one row of float32 per Gaussian, in the frame and units of the Gaussians:

    x y z · nx ny nz (zeros) · f_dc_0..2 · f_rest_0..3K-1 · opacity · scale_0..2 · rot_0..3

`opacity` is a logit, `scale` ln of the standard deviation, `rot` a quaternion wxyz, color = 0.5 + 0.28209 f_dc + ...;
`f_rest` is channel-major: the K = 0, 3, 8 or 15 coefficients of red, then of green, then of blue. The comment
`SplatRenderMode: mip` marks a scene made for a renderer with the 2D Mip filter, as ours is. Where a scene is so far
from the origin of its frame that float32 is too coarse, its positions are relative to a nearby offset, which the
comment `offset x y z` holds.

A compressed .ply has 16 bytes per Gaussian, and one for each f_rest:

    element chunk   18 float32: min and max of x y z, of ln scales, of r g b; for 256 Gaussians each
    element vertex   4 uint32: position (11, 10, 11 bits) · rotation (2, 10 x 3) · scale (11, 10, 11) · color (8 x 4)
    element sh       f_rest_0 ... as uint8; only where SH bands above the constant one exist

Positions, ln scales and colors are fractions of the range of their chunk, first entry in the highest bits. A rotation
holds which entry of the quaternion wxyz is largest and the other three, from -1/sqrt 2 to 1/sqrt 2. The alpha of the
color is the opacity. Reference: developer.playcanvas.com, user manual, "The compressed PLY format".
"""

from typing import Any

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.gaussians import SH_C0
from ssplat_jax.scene_files.splat_rows import HALF_RANGE, RENDER_MODES, SplatRows, with_largest

Columns = dict[str, np.ndarray]  # of an element, by the name of the property
REST_COUNTS = (0, 9, 24, 45)  # numbers of f_rest of SH degree 0 to 3
CONSTANT = ["f_dc_0", "f_dc_1", "f_dc_2"]
SCALES = [f"scale_{i}" for i in range(3)]
ROTATION = [f"rot_{i}" for i in range(4)]
CHUNK = 256
REST_RANGE = 8.0  # f_rest of a compressed .ply is a byte from -4 to 4


def property_names(num_rest: int) -> list[str]:
    """Names of the vertex properties, in the order of the file."""
    rest = [f"f_rest_{i}" for i in range(num_rest)]
    return ["x", "y", "z", "nx", "ny", "nz", *CONSTANT, *rest, "opacity", *SCALES, *ROTATION]


def encode_ply(rows: SplatRows) -> bytes:
    """The bytes of a .ply."""
    num_rest = 3 * (rows.sh.shape[1] - 1)
    header = ["ply", "format binary_little_endian 1.0", f"comment SplatRenderMode: {rows.render_mode}"]
    header += [f"comment SH degree: {REST_COUNTS.index(num_rest)}"]
    if any(rows.offset):
        header += [f"comment offset {' '.join(repr(float(x)) for x in rows.offset)}"]
    header += [f"element vertex {len(rows)}", *(f"property float {name}" for name in property_names(num_rest))]
    rest = rows.sh[:, 1:].transpose(0, 2, 1).reshape(len(rows), num_rest)
    logits = np.log(rows.opacities) - np.log1p(-rows.opacities)
    normals = np.zeros_like(rows.means)
    columns = [rows.means, normals, rows.sh[:, 0], rest, logits[:, None], rows.log_scales, rows.quats]
    head = "\n".join([*header, "end_header\n"]).encode("ascii")
    return head + np.concatenate(columns, axis=1).astype("<f4").tobytes()


def decode_ply(data: bytes) -> SplatRows:
    """The rows of a .ply, compressed or not; properties may be in any order, unknown ones are ignored."""
    tables, comments = read_tables(data)
    if "vertex" not in tables:
        raise ValueError("wanted an element 'vertex' of numbers")
    decode = _decode_compressed if "packed_position" in tables["vertex"] else _decode_columns
    return SplatRows(**decode(tables), **_facts(comments))


def _facts(comments: list[str]) -> dict:
    """The render mode and the offset that comments name."""
    facts = {}
    for comment in comments:
        match comment.split():
            case ["SplatRenderMode:", mode] if mode in RENDER_MODES:
                facts["render_mode"] = mode
            case ["offset", x, y, z]:
                facts["offset"] = (float(x), float(y), float(z))
            case ["offset", *_]:
                raise ValueError(f"wanted three numbers in {comment!a}")
    return facts


def _decode_columns(tables: dict[str, Columns]) -> dict[str, np.ndarray]:
    vertex = tables["vertex"]
    constant = stacked(vertex, CONSTANT)
    if "scale_1" in vertex and "scale_2" not in vertex:  # 2DGS writes discs, which have no thickness
        vertex = vertex | {"scale_2": np.full(len(constant), -np.inf)}
    # Other writers produce logits of +-inf; tanh makes them 0 and 1 without overflow.
    return {
        "means": stacked(vertex, ["x", "y", "z"]),
        "quats": stacked(vertex, ROTATION),
        "log_scales": stacked(vertex, SCALES),
        "opacities": 0.5 * (1 + np.tanh(0.5 * stacked(vertex, ["opacity"])[:, 0])),
        "sh": np.concatenate([constant[:, None], _rest(vertex, len(constant))], axis=1),
    }


def _rest(table: Columns, num_rows: int) -> Float64[np.ndarray, "n k 3"]:
    """The SH coefficients above the constant one, as the file holds them."""
    num_rest = sum(name.startswith("f_rest_") for name in table)
    if num_rest not in REST_COUNTS:
        raise ValueError(f"wanted 0, 9, 24 or 45 f_rest, got {num_rest}")
    rest = stacked(table, [f"f_rest_{i}" for i in range(num_rest)]) if num_rest else np.zeros((num_rows, 0))
    return rest.reshape(num_rows, 3, num_rest // 3).transpose(0, 2, 1)


def _decode_compressed(tables: dict[str, Columns]) -> dict[str, np.ndarray]:
    chunk, sh = tables.get("chunk", {}), tables.get("sh", {})
    words = stacked(tables["vertex"], [f"packed_{name}" for name in ("position", "rotation", "scale", "color")])
    position, rotation, scale, color = words.astype(np.uint32).T
    rgba = np.stack([color >> shift & 255 for shift in (24, 16, 8, 0)], axis=1) / 255
    colors = rgba[:, :3]
    if "min_r" in chunk:  # files of earlier versions have no range of colors
        colors = _in_chunks(chunk, ["r", "g", "b"], colors)
    levels = np.stack([rotation >> shift & 1023 for shift in (20, 10, 0)], axis=1)
    rest = ((_rest(sh, len(words)) + 0.5) / 256 - 0.5) * REST_RANGE
    return {
        "means": _in_chunks(chunk, ["x", "y", "z"], _unpacked(position)),
        "quats": with_largest((rotation >> 30).astype(np.int64), (2 * levels / 1023 - 1) * HALF_RANGE),
        "log_scales": _in_chunks(chunk, ["scale_x", "scale_y", "scale_z"], _unpacked(scale)),
        "opacities": rgba[:, 3],
        "sh": np.concatenate([((colors - 0.5) / SH_C0)[:, None], rest], axis=1),
    }


def _unpacked(words: np.ndarray) -> Float64[np.ndarray, "n 3"]:
    return np.stack([(words >> 21) / 2047, (words >> 11 & 1023) / 1023, (words & 2047) / 2047], axis=1)


def _in_chunks(chunk: Columns, names: list[str], fractions: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Values of fractions of the ranges of their chunks."""
    low, high = (stacked(chunk, [f"{end}_{name}" for name in names]) for end in ("min", "max"))
    if len(low) * CHUNK < len(fractions):
        raise ValueError(f"wanted a chunk for every {CHUNK} of {len(fractions)} Gaussians, got {len(low)}")
    of_row = np.arange(len(fractions)) // CHUNK
    return low[of_row] + fractions * (high - low)[of_row]


# -- tables: elements of any PLY file, ascii or binary of either byte order, as columns by name ------------------------
# The package `plyfile` reads these too, but under the GPL, so it serves the tests alone.


MAX_HEADER_BYTES = 1 << 16  # headers of splat files take a few kilobytes
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"}
TYPES |= {"double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
TYPES |= {"float32": "f4", "float64": "f8"}
LIST = "list"  # stands for the type of a property that gives rows no fixed size


def read_tables(data: bytes) -> tuple[dict[str, Columns], list[str]]:
    """The columns of each element, by element and property name, up to the first with lists; comments of the header."""
    end = data.find(b"end_header", 0, MAX_HEADER_BYTES)
    newline = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or newline < 0:
        raise ValueError("wanted a header from 'ply' to 'end_header'")
    form, elements, comments = _parse_header(data[:end].decode("ascii", "replace").splitlines()[1:])
    is_ascii, offset = form == "ascii", 0
    body: Any = data[newline + 1 :].split() if is_ascii else memoryview(data)[newline + 1 :]
    tables: dict[str, Columns] = {}
    for name, (count, properties) in elements.items():
        if LIST in properties.values() or not properties:
            break
        row = np.dtype([(key, BYTE_ORDERS[form] + code) for key, code in properties.items()])
        size = count * (len(properties) if is_ascii else row.itemsize)
        # Compared before anything is allocated: a damaged count can be anything.
        if offset + size > len(body):
            raise ValueError(f"{count} rows of the element {name} do not fit; it is cut off")
        if is_ascii:
            numbers = np.array(body[offset : offset + size], np.float64)
            tables[name] = dict(zip(properties, numbers.reshape(count, len(properties)).T, strict=True))
        else:
            rows = np.frombuffer(body, row, count, offset) if size else np.zeros(0, row)
            tables[name] = {key: rows[key] for key in properties}
        offset += size
    return tables, comments


def _parse_header(lines: list[str]) -> tuple[str, dict[str, tuple[int, dict[str, str]]], list[str]]:
    """The format; of each element the count and the NumPy types of its properties, in order; the comments."""
    form, elements, comments, properties = "", {}, [], {}
    for line in lines:
        match line.split():
            case [] | ["obj_info", *_]:
                pass
            case ["comment", *rest]:
                comments.append(" ".join(rest))
            case ["format", name, "1.0"] if name in BYTE_ORDERS:
                form = name
            case ["element", name, count] if count.isdecimal() and name not in elements:
                elements[name] = (int(count), properties := {})
            case ["property", "list", *_] if elements:
                properties[""] = LIST
            case ["property", kind, name] if elements and kind in TYPES and name not in properties:
                properties[name] = TYPES[kind]
            case _:
                raise ValueError(f"cannot use the line {line[:80]!a} of the header")
    if not form:
        raise ValueError(f"wanted a format in the header, one of {', '.join(BYTE_ORDERS)}")
    return form, elements, comments


def stacked(table: Columns, names: list[str]) -> np.ndarray:
    """Columns of a table side by side, in float64."""
    for name in names:
        if name not in table:
            raise ValueError(f"wanted the property {name!r}, it is missing")
    return np.stack([table[name] for name in names], axis=1).astype(np.float64)
