"""Writer of glTF 2.0 with the extension KHR_gaussian_splatting, as .glb (one file) or .gltf (JSON); see gltf_reader.py.

The Gaussians are a primitive of points. Its attributes are POSITION; ROTATION, a unit quaternion xyzw; SCALE, standard
deviations; OPACITY; and SH_DEGREE_l_COEF_m, the SH coefficients in the order and with the signs of a .ply; all but the
first with the prefix `KHR_gaussian_splatting:`. They are float32, so nothing is lost. COLOR_0 lets viewers without the
extension show colored points. In glTF y points up: a node turns the scene by 180 degrees about z,
as PlayCanvas's converter does.

Written after the extension as ratified by Khronos (2026), where SCALE is linear; earlier drafts had logarithms.
Reference: github.com/KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting.
"""

import base64
import json
import os
import struct

import numpy as np
from jaxtyping import Float64

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.scene_files.export_rows import ExportReport, SceneRows, scene_rows

EXTENSION = "KHR_gaussian_splatting"
MAGIC, VERSION = b"glTF", 2
JSON_CHUNK, BINARY_CHUNK = b"JSON", b"BIN\0"
FLOAT, POINTS, ARRAY_BUFFER = 5126, 0, 34962  # constants of OpenGL
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}  # by number of columns
HALF_TURN = [0.0, 0.0, 1.0, 0.0]  # quaternion xyzw of 180 degrees about z
EMBEDDED = "data:application/octet-stream;base64,"


def save_gltf(
    path: str | os.PathLike,
    gaussians: Gaussians,
    *,
    render_mode: str = "mip",
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> ExportReport:
    """Writes `gaussians` to `path` atomically: JSON with an embedded buffer if its suffix is .gltf, else binary.

    The same Gaussians give the same bytes.

    Args:
        path: the file to write; missing folders are created.
        gaussians: the scene, with the axes of a .ply.
        render_mode: the renderer that the scene is made for, see `save_ply`; kept in the extras of `asset`.
        offset: origin of `gaussians` in the frame of the capture; kept there too, unless it is zero.

    Returns:
        Counts of written and dropped Gaussians, and `offset`.

    Limits:
        Those of `scene_rows`.

    Raises:
        InputError: an array of the scene has a wrong shape.
        StorageError: the file cannot be written.
    """
    rows = scene_rows(gaussians)
    columns = _columns(rows)
    document, buffer = _document(columns, len(rows))
    extras = {"offset": [float(x) for x in offset]} if any(offset) else {}
    document["asset"]["extras"] = {"SplatRenderMode": render_mode} | extras
    if str(path).endswith(".gltf"):
        document["buffers"][0]["uri"] = EMBEDDED + base64.b64encode(buffer).decode("ascii")
        data = json.dumps(document, indent=1).encode("ascii")
    else:
        data = _binary(document, buffer)
    write_atomic(path, data)
    return ExportReport(num_written=len(rows), num_dropped=gaussians.num_gaussians - len(rows), offset=offset)


def sh_names(num_terms: int) -> list[str]:
    """Attributes of SH coefficients, band by band."""
    degree = round(num_terms**0.5) - 1
    return [f"{EXTENSION}:SH_DEGREE_{band}_COEF_{term}" for band in range(degree + 1) for term in range(2 * band + 1)]


def _columns(rows: SceneRows) -> dict[str, Float64[np.ndarray, "n _"]]:
    colors = np.clip(0.5 + SH_C0 * rows.sh[:, 0], 0.0, 1.0)
    return {
        "POSITION": rows.means,
        f"{EXTENSION}:ROTATION": rows.quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": np.exp(rows.log_scales),
        f"{EXTENSION}:OPACITY": rows.opacities[:, None],
        **{name: rows.sh[:, term] for term, name in enumerate(sh_names(rows.sh.shape[1]))},
        "COLOR_0": np.concatenate([colors, rows.opacities[:, None]], axis=1),
    }


def _document(columns: dict[str, Float64[np.ndarray, "n _"]], num_rows: int) -> tuple[dict, bytes]:
    """The JSON document and its buffer, one view and one accessor for each column."""
    scene = {"asset": {"version": "2.0", "generator": "ssplat_jax"}, "scene": 0, "scenes": [{"nodes": []}]}
    if num_rows == 0:  # accessors have at least one element
        return scene | {"nodes": [], "buffers": [{"byteLength": 4}], "extensionsUsed": [EXTENSION]}, bytes(4)
    parts, views, accessors, offset = [], [], [], 0
    for values in columns.values():
        part = values.astype("<f4")
        parts.append(part.tobytes())
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": part.nbytes, "target": ARRAY_BUFFER})
        kind = TYPES[part.shape[1]]
        accessors.append({"bufferView": len(views) - 1, "componentType": FLOAT, "count": num_rows, "type": kind})
        offset += part.nbytes
    positions = columns["POSITION"].astype("<f4")
    accessors[0] |= {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    primitive = {
        "mode": POINTS,
        "attributes": {name: place for place, name in enumerate(columns)},
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    return scene | {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": HALF_TURN}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
        "extensionsUsed": [EXTENSION],
    }, b"".join(parts)


def _binary(document: dict, buffer: bytes) -> bytes:
    """The bytes of a .glb: a header, the JSON padded with spaces, the buffer padded with zeros."""
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    buffer += bytes(-len(buffer) % 4)
    chunks = struct.pack("<I4s", len(text), JSON_CHUNK) + text + struct.pack("<I4s", len(buffer), BINARY_CHUNK) + buffer
    return struct.pack("<4sII", MAGIC, VERSION, 12 + len(chunks)) + chunks
