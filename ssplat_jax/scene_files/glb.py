"""The .glb file, binary glTF 2.0, with the extension KHR_gaussian_splatting.

The Gaussians are a primitive of points. Its attributes are POSITION; ROTATION, a unit quaternion xyzw; SCALE, standard
deviations; OPACITY; and SH_DEGREE_l_COEF_m, the SH coefficients in the order and with the signs of a .ply; all but the
first with the prefix `KHR_gaussian_splatting:`. They are float32, so nothing is lost. COLOR_0 lets viewers without the
extension show colored points. In glTF y points up: a node turns the scene by 180 degrees about z,
as PlayCanvas's converter does.

Written after the extension as ratified by Khronos (2026), where SCALE is linear; earlier drafts had logarithms.
Reference: github.com/KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting.
"""

import json
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from ssplat_jax.core.gaussians import SH_C0
from ssplat_jax.scene_files.splat_rows import LOG_SCALE_LIMIT, RENDER_MODES, SH_TERMS, SplatRows, placed

EXTENSION = "KHR_gaussian_splatting"
MAGIC, VERSION, JSON_CHUNK, BINARY_CHUNK = b"glTF", 2, b"JSON", b"BIN\0"
FLOAT, POINTS, ARRAY_BUFFER = 5126, 0, 34962  # constants of OpenGL, as those of `COMPONENTS`
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", FLOAT: "<f4"}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}  # by number of columns
HALF_TURN = [0.0, 0.0, 1.0, 0.0]  # quaternion xyzw of 180 degrees about z
AXIS_FLIP = np.diag([-1.0, -1.0, 1.0])  # from the axes of glTF, y up, to those of a .ply: undoes `HALF_TURN`
UNKNOWN_OF_NODES = {"skin", "EXT_mesh_gpu_instancing", "KHR_node_visibility"}  # that change what is shown, or where
MEANING = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective"}
"""Values of the extension with which Gaussians are drawn as ours are; others are refused."""


def encode_glb(rows: SplatRows) -> bytes:
    """The bytes of a .glb: a header, the JSON padded with spaces, the buffer padded with zeros."""
    document, buffer = _document(rows)
    extras = {"offset": [float(x) for x in rows.offset]} if any(rows.offset) else {}
    document["asset"]["extras"] = {"SplatRenderMode": rows.render_mode} | extras
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    buffer += bytes(-len(buffer) % 4)
    chunks = struct.pack("<I4s", len(text), JSON_CHUNK) + text + struct.pack("<I4s", len(buffer), BINARY_CHUNK) + buffer
    return struct.pack("<4sII", MAGIC, VERSION, 12 + len(chunks)) + chunks


def sh_names(num_terms: int) -> list[str]:
    """Attributes of SH coefficients, band by band."""
    degree = round(num_terms**0.5) - 1
    return [f"{EXTENSION}:SH_DEGREE_{band}_COEF_{term}" for band in range(degree + 1) for term in range(2 * band + 1)]


def _document(rows: SplatRows) -> tuple[dict, bytes]:
    """The JSON document and its buffer, one view and one accessor for each attribute."""
    scene = {"asset": {"version": "2.0", "generator": "ssplat_jax"}, "scene": 0, "scenes": [{"nodes": []}]}
    if len(rows) == 0:  # accessors have at least one element
        return scene | {"nodes": [], "buffers": [{"byteLength": 4}], "extensionsUsed": [EXTENSION]}, bytes(4)
    colors = np.clip(0.5 + SH_C0 * rows.sh[:, 0], 0.0, 1.0)
    attributes = {
        "POSITION": rows.means,
        f"{EXTENSION}:ROTATION": rows.quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": np.exp(rows.log_scales),
        f"{EXTENSION}:OPACITY": rows.opacities[:, None],
        **{name: rows.sh[:, term] for term, name in enumerate(sh_names(rows.sh.shape[1]))},
        "COLOR_0": np.concatenate([colors, rows.opacities[:, None]], axis=1),
    }
    parts = [values.astype("<f4") for values in attributes.values()]
    views, accessors, offset = [], [], 0
    for i, part in enumerate(parts):
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": part.nbytes, "target": ARRAY_BUFFER})
        accessors.append({"bufferView": i, "componentType": FLOAT, "count": len(rows), "type": TYPES[part.shape[1]]})
        offset += part.nbytes
    accessors[0] |= {"min": parts[0].min(axis=0).tolist(), "max": parts[0].max(axis=0).tolist()}
    primitive = {
        "mode": POINTS,
        "attributes": {name: place for place, name in enumerate(attributes)},
        "extensions": {EXTENSION: {name: MEANING[name] for name in ("kernel", "colorSpace")}},
    }
    return scene | {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": HALF_TURN}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
        "extensionsUsed": [EXTENSION],
    }, b"".join(part.tobytes() for part in parts)


def decode_glb(data: bytes) -> SplatRows:
    """The rows of all nodes of a .glb; compressed and sparse accessors, and buffers outside of it, are refused."""
    magic, version, length, size, kind = struct.unpack_from("<4s3I4s", data)
    if (magic, version, kind) != (MAGIC, VERSION, JSON_CHUNK) or length > len(data):
        raise ValueError(f"wanted a binary glTF of version {VERSION}; it is cut off or none")
    document, buffer = json.loads(data[20 : 20 + size]), data[28 + size :]
    nodes = document["scenes"][document.get("scene", 0)].get("nodes", [])
    empty = {"means": (0, 3), "quats": (0, 4), "log_scales": (0, 3), "opacities": (0,), "sh": (0, 1, 3)}
    parts: list[dict[str, Any]] = [{name: np.zeros(shape) for name, shape in empty.items()}]
    for primitive, transform in _primitives(document, nodes, np.eye(4), set()):
        parts.append(placed(_columns(document, buffer, primitive), AXIS_FLIP @ transform[:3]))
    if len(parts) == 1 and (EXTENSION not in document.get("extensionsUsed", []) or document.get("meshes")):
        raise ValueError(f"wanted Gaussians by {EXTENSION} in its first scene, it has none")
    terms = max(part["sh"].shape[1] for part in parts)
    for part in parts:
        part["sh"] = np.pad(part["sh"], ((0, 0), (0, terms - part["sh"].shape[1]), (0, 0)))
    extras = document["asset"].get("extras") or {}
    mode = extras.get("SplatRenderMode")
    x, y, z = (float(value) for value in extras.get("offset", (0.0, 0.0, 0.0)))
    return SplatRows(
        **{name: np.concatenate([part[name] for part in parts]) for name in empty},
        render_mode=mode if mode in RENDER_MODES else "default",
        offset=(x, y, z),
    )


def _primitives(
    document: dict, numbers: list[int], parent: np.ndarray, seen: set[int]
) -> Iterator[tuple[dict, np.ndarray]]:
    """Primitives of Gaussians at and below nodes, each with its transform to the axes of glTF."""
    for number in numbers:
        if number in seen:  # it would be a loop, or double with every level
            raise ValueError(f"node {number} has two parents")
        seen.add(number)
        node = document["nodes"][number]
        if unknown := UNKNOWN_OF_NODES & (node.keys() | node.get("extensions", {}).keys()):
            raise ValueError(f"node {number} has {min(unknown)}, which is not read")
        transform = parent @ _transform(node)
        if "mesh" in node:
            for primitive in document["meshes"][node["mesh"]]["primitives"]:
                if EXTENSION in primitive.get("extensions", {}):
                    yield primitive, transform
        yield from _primitives(document, node.get("children", []), transform, seen)


def _transform(node: dict) -> Float64[np.ndarray, "4 4"]:
    """Matrix of a node."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    rotation = Rotation.from_quat(node.get("rotation", [0.0, 0.0, 0.0, 1.0])).as_matrix()
    transform = np.eye(4)
    transform[:3, :3] = rotation * np.array(node.get("scale", [1.0, 1.0, 1.0]), np.float64)
    transform[:3, 3] = node.get("translation", [0.0, 0.0, 0.0])
    return transform


def _columns(document: dict, buffer: bytes, primitive: dict) -> dict[str, np.ndarray]:
    """The columns of a primitive, before its transform."""
    attributes, extension = primitive["attributes"], primitive["extensions"][EXTENSION]
    for name, ours in MEANING.items():
        if extension.get(name, ours) != ours:
            raise ValueError(f"wanted Gaussians of the {name} {ours}, got {extension[name]!a:.80}")
    terms = next((terms for terms in reversed(SH_TERMS) if sh_names(terms)[-1] in attributes), 0)
    if terms == 0:
        raise ValueError("it has no SH coefficients, or compressed attributes")
    names = {"POSITION": 3, f"{EXTENSION}:ROTATION": 4, f"{EXTENSION}:SCALE": 3, f"{EXTENSION}:OPACITY": 1}
    names |= dict.fromkeys(sh_names(terms), 3)
    means, quats, scales, opacities, *sh = (
        _accessor(document, buffer, attributes[name], width) for name, width in names.items()
    )
    columns = {
        "means": means,
        "quats": quats[:, [3, 0, 1, 2]],
        "log_scales": np.log(np.maximum(scales, np.exp(-LOG_SCALE_LIMIT))),
        "opacities": opacities[:, 0],
        "sh": np.stack(sh, axis=1),
    }
    if (scales < 0).any() or len({len(values) for values in columns.values()}) > 1:
        raise ValueError("it has negative scales, or attributes of different lengths")
    return columns


def _accessor(document: dict, buffer: bytes, number: int, width: int) -> Float64[np.ndarray, "n w"]:
    accessor = document["accessors"][number]
    dtype, count = np.dtype(COMPONENTS[accessor["componentType"]]), accessor["count"]
    if accessor["type"] != TYPES[width] or "sparse" in accessor or type(count) is not int or count < 0:
        raise ValueError(f"accessor {number} is of another type, sparse, or without a count")
    view = document["bufferViews"][accessor["bufferView"]]
    if view["buffer"] != 0 or "uri" in document["buffers"][0]:
        raise ValueError(f"accessor {number} lies outside of the file")
    stride = view.get("byteStride", dtype.itemsize * width)
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    end = start + stride * (count - 1) + dtype.itemsize * width
    if start < 0 or stride < dtype.itemsize * width or (count and end > len(buffer)):
        raise ValueError(f"accessor {number} reaches beyond its buffer of {len(buffer)} bytes")
    shape = (count, width)
    values = np.ndarray(shape, dtype, buffer, start, (stride, dtype.itemsize)) if count else np.zeros(shape, dtype)
    values = values.astype(np.float64)
    return np.maximum(values / np.iinfo(dtype).max, -1.0) if accessor.get("normalized", False) else values
