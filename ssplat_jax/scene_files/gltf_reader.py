"""Reader of glTF 2.0 with the extension KHR_gaussian_splatting, with the transforms of its nodes."""

import base64
import binascii
import dataclasses
import json
import os
import struct
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from ssplat_jax.core.errors import InputError
from ssplat_jax.core.rotations import sh_rotation
from ssplat_jax.scene_files.export_rows import LOG_SCALE_LIMIT, unit_quats
from ssplat_jax.scene_files.gltf import BINARY_CHUNK, EXTENSION, JSON_CHUNK, MAGIC, TYPES, VERSION, sh_names
from ssplat_jax.scene_files.ply import RENDER_MODES
from ssplat_jax.scene_files.splat_file import SplatFile, gaussians_of_columns, read_scene_bytes, widened

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
"""Types of accessors by their number in OpenGL."""

MAX_NODE_DEPTH = 100
UNIFORM = 1e-4
"""Relative difference up to which the scales of a node count as one."""
ROUNDING = 1e-12
AXIS_FLIP = np.diag([-1.0, -1.0, 1.0])
"""Rotation of the axes of glTF, y up, to those of a .ply: the inverse of the writer's half turn."""


def read_gltf(path: str | os.PathLike) -> SplatFile:
    """Reads the Gaussians of all nodes of the scene of a .glb or .gltf file, in the axes of a .ply.

    Limits:
        A node may turn, move and scale its Gaussians, but not stretch them. Compressed and sparse accessors are
        refused.

    Raises:
        InputError: the file is not glTF, holds no Gaussians, or is damaged.
    """
    path = Path(path)
    document, buffer = _open(path)
    file = _Document(path, document, buffer)
    parts = [
        _placed(path, file.columns(primitive), AXIS_FLIP @ transform[:3, :3], AXIS_FLIP @ transform[:3, 3])
        for primitive, transform in file.primitives()
    ]
    if not parts and EXTENSION not in document.get("extensionsUsed", []):
        raise InputError(f"{path}: wanted a glTF file with {EXTENSION}, it has none; give a scene of Gaussians.")
    terms = max((part["sh"].shape[1] for part in parts), default=1)
    empty = {"means": (0, 3), "quats": (0, 4), "log_scales": (0, 3), "opacities": (0,), "sh": (0, terms, 3)}
    columns = {
        name: np.concatenate([np.zeros(shape), *(_padded(part[name], name, terms) for part in parts)])
        for name, shape in empty.items()
    }
    return SplatFile(gaussians_of_columns(path, **columns), *file.facts())


def _padded(values: np.ndarray, name: str, terms: int) -> np.ndarray:
    return np.pad(values, ((0, 0), (0, terms - values.shape[1]), (0, 0))) if name == "sh" else values


def _open(path: Path) -> tuple[dict, bytes]:
    """The JSON document and the binary chunk, empty in a .gltf."""
    data = read_scene_bytes(path, "a glTF file")
    if data[:4] != MAGIC:
        return _parse(path, data), b""
    chunks, offset = {}, 12
    if len(data) < 20 or struct.unpack_from("<I", data, 4)[0] != VERSION:
        raise InputError(f"{path}: wanted a binary glTF of version {VERSION}; it is cut off or of another version.")
    while offset + 8 <= len(data):
        size, kind = struct.unpack_from("<I4s", data, offset)
        if offset + 8 + size > len(data):
            raise InputError(
                f"{path}: wanted a chunk of {size} bytes, {len(data) - offset - 8} are there; it is cut off."
            )
        chunks.setdefault(kind, data[offset + 8 : offset + 8 + size])
        offset += 8 + size
    return _parse(path, chunks.get(JSON_CHUNK, b"")), chunks.get(BINARY_CHUNK, b"")


def _parse(path: Path, text: bytes) -> dict:
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: wanted the JSON of a glTF file ({error}); give a .glb or .gltf.") from error
    if not isinstance(document, dict) or "asset" not in document:
        raise InputError(f"{path}: wanted the JSON of a glTF file, it has no asset; give a .glb or .gltf.")
    return document


@dataclasses.dataclass(frozen=True)
class _Document:
    """A glTF document and its binary chunk; everything that is malformed is one `InputError`."""

    path: Path
    document: dict
    binary: bytes

    def primitives(self) -> list[tuple[dict, Float64[np.ndarray, "4 4"]]]:
        """Primitives of Gaussians in the scene, each with its transform to the axes of glTF."""
        try:
            scene = self.document.get("scenes", [{}])[self.document.get("scene", 0)]
            found: list[tuple[dict, np.ndarray]] = []
            for node in scene.get("nodes", []):
                self._visit(node, np.eye(4), found, 0)
            return found
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise self._malformed(error) from error

    def facts(self) -> tuple[str, tuple[float, float, float]]:
        """Render mode and offset that our writer keeps in the extras of `asset`."""
        try:
            extras = self.document["asset"].get("extras") or {}
            mode = extras.get("SplatRenderMode", "default")
            x, y, z = (float(value) for value in extras.get("offset", (0.0, 0.0, 0.0)))
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise self._malformed(error) from error
        if not np.isfinite([x, y, z]).all():
            raise self._malformed(ValueError("an offset that is not finite"))
        return mode if mode in RENDER_MODES else "default", (x, y, z)

    def _visit(self, number: int, parent: np.ndarray, found: list, depth: int) -> None:
        if depth > MAX_NODE_DEPTH:
            raise ValueError("nodes that contain themselves")
        node = self.document["nodes"][number]
        transform = parent @ _transform(node)
        if "mesh" in node:
            primitives = self.document["meshes"][node["mesh"]]["primitives"]
            found += [
                (primitive, transform) for primitive in primitives if EXTENSION in primitive.get("extensions", {})
            ]
        for child in node.get("children", []):
            self._visit(child, transform, found, depth + 1)

    def columns(self, primitive: dict) -> dict[str, np.ndarray]:
        """The columns of a primitive, before its transform."""
        try:
            attributes = primitive["attributes"]
            degrees = [k for k in range(4) if sh_names((k + 1) ** 2)[-1] in attributes]
            if not degrees:
                raise ValueError("no SH coefficients, or compressed attributes")
            sh = [self._accessor(attributes[name], 3) for name in sh_names((degrees[-1] + 1) ** 2)]
            scales = self._accessor(attributes[f"{EXTENSION}:SCALE"], 3)
            columns = {
                "means": self._accessor(attributes["POSITION"], 3),
                "quats": self._accessor(attributes[f"{EXTENSION}:ROTATION"], 4)[:, [3, 0, 1, 2]],
                "log_scales": np.log(np.maximum(scales, np.exp(-LOG_SCALE_LIMIT))),
                "opacities": self._accessor(attributes[f"{EXTENSION}:OPACITY"], 1)[:, 0],
                "sh": np.stack(sh, axis=1),
            }
        except (LookupError, TypeError, ValueError, AttributeError, struct.error) as error:
            raise self._malformed(error) from error
        if (scales < 0).any() or len({len(column) for column in columns.values()}) > 1:
            raise self._malformed(ValueError("negative scales, or attributes of different lengths"))
        return columns

    def _accessor(self, number: int, num_columns: int) -> Float[np.ndarray, "n _"]:
        accessor = self.document["accessors"][number]
        dtype, count = np.dtype(COMPONENTS[accessor["componentType"]]), accessor["count"]
        if accessor["type"] != TYPES[num_columns] or "sparse" in accessor or not isinstance(count, int) or count < 0:
            raise ValueError(f"accessor {number}: of another type, sparse, or without a count")
        view = self.document["bufferViews"][accessor["bufferView"]]
        stride = view.get("byteStride", dtype.itemsize * num_columns)
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        data = self._buffer(view["buffer"])
        end = start + stride * (count - 1) + dtype.itemsize * num_columns
        if start < 0 or stride < dtype.itemsize * num_columns or (count and end > len(data)):
            raise ValueError(f"accessor {number}: reaches beyond its buffer of {len(data)} bytes")
        shape, strides = (count, num_columns), (stride, dtype.itemsize)
        values = np.ndarray(shape, dtype, data, start, strides) if count else np.zeros(shape, dtype)
        values = widened(values)
        if accessor.get("normalized", False):
            values = np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values

    def _buffer(self, number: int) -> bytes:
        uri = self.document["buffers"][number].get("uri")
        if uri is None:
            return self.binary
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(",")[2], validate=True)
            except binascii.Error as error:
                raise ValueError(f"buffer {number}: {error}") from error
        beside = (self.path.parent / unquote(uri)).resolve()
        if not beside.is_relative_to(self.path.parent.resolve()):
            raise ValueError(f"buffer {number}: {uri!r} lies outside of the file's folder")
        return read_scene_bytes(beside, f"the buffer of {self.path.name}")

    def _malformed(self, error: Exception) -> InputError:
        return InputError(f"{self.path}: cannot use its glTF ({error!s:.200}); write the file again.")


def _transform(node: dict) -> Float64[np.ndarray, "4 4"]:
    """Matrix of a node."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    rotation = Rotation.from_quat(node.get("rotation", [0.0, 0.0, 0.0, 1.0])).as_matrix()
    transform = np.eye(4)
    transform[:3, :3] = rotation * np.array(node.get("scale", [1.0, 1.0, 1.0]), np.float64)
    transform[:3, 3] = node.get("translation", [0.0, 0.0, 0.0])
    return transform


def _placed(
    path: Path,
    columns: dict[str, np.ndarray],
    linear: Float64[np.ndarray, "3 3"],
    shift: Float64[np.ndarray, "3"],
) -> dict[str, np.ndarray]:
    """Columns after x -> linear x + shift."""
    lengths = np.linalg.norm(linear, axis=0)
    scale = float(lengths.mean())
    rotation = linear / scale if scale > 0 else linear
    if not (np.abs(rotation.T @ rotation - np.eye(3)) <= UNIFORM).all() or np.linalg.det(rotation) < 0:
        raise InputError(
            f"{path}: wanted nodes that turn, move and scale, got one that stretches; apply it to the scene."
        )
    moved = {"means": columns["means"] @ linear.T + shift, "log_scales": columns["log_scales"] + np.log(scale)}
    if np.abs(rotation - np.eye(3)).max() <= ROUNDING:  # not turned: quaternions and SH keep every bit
        return columns | moved
    turned = Rotation.from_matrix(rotation) * Rotation.from_quat(unit_quats(columns["quats"]), scalar_first=True)
    degree = round(columns["sh"].shape[1] ** 0.5) - 1
    sh = np.einsum("kl,nlc->nkc", sh_rotation(rotation, degree), columns["sh"])
    quats = turned.as_quat(scalar_first=True)
    quats[~np.isfinite(columns["quats"]).all(axis=1)] = np.nan  # `unit_quats` hides it; NaN is refused later
    return columns | moved | {"quats": quats, "sh": sh}
