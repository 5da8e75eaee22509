"""Files that a run keeps of each chunk: a record as a small JSON file, and the changes of the scene as an `.npz`.

The viewer and the report read the records. The viewer of a growing run reads both, so that the stream waits for no
browser and viewers may come and go.
"""

import base64
import dataclasses
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float64, UInt8
from PIL import Image

from ssplat_jax.core.false_colors import eight_bits
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.storage.files import load_arrays, save_arrays, write_json
from ssplat_jax.streaming.scene_delta import SceneDelta

RECORD_KIND, DELTA_KIND = "chunk record 1", "scene delta 1"  # kind and version of the files
SHAPES = {"camtoworld": (4, 4), "K": (3, 3), "exposure": (3,)}  # the arrays of a view
THUMBNAIL_SIDE = 160  # longest side of a thumbnail, pixels


@dataclasses.dataclass(frozen=True)
class RecordedView:
    """A streamed view."""

    frame: int  # in the capture
    camtoworld: Float64[np.ndarray, "4 4"]  # OpenCV axes, capture frame
    K: Float64[np.ndarray, "3 3"]  # pixels of the streamed image
    exposure: Float64[np.ndarray, "3"]  # RGB factor from the colors of the scene's first views to this view's
    thumbnail: bytes  # JPEG


@dataclasses.dataclass(frozen=True)
class ChunkRecord:
    """A chunk of a run, and the state of its stream afterwards."""

    num_views: int  # streamed so far
    size: tuple[int, int]  # (width, height) of the streamed images, pixels
    views: tuple[RecordedView, ...]
    seconds: float  # of the step, without compiling
    occupancy: float  # share of the cache's voxels that are in use
    num_gaussians: int  # shown


def save_chunk_record(path: Path, record: ChunkRecord) -> None:
    """Writes a record, atomically."""
    fields = dataclasses.asdict(record)
    for view in fields["views"]:
        view |= {name: view[name].tolist() for name in SHAPES}
        view["thumbnail"] = base64.b64encode(view["thumbnail"]).decode()
    write_json(path, {"kind": RECORD_KIND} | fields)


def load_chunk_records(paths: Sequence[Path]) -> list[ChunkRecord]:
    """The records in files of `save_chunk_record`, up to the first that is missing or cannot be read."""
    records = []
    for path in paths:
        try:
            records.append(_parse_record(json.loads(path.read_bytes())))
        except (OSError, LookupError, TypeError, ValueError, AttributeError):
            break  # a run that is being started anew, or a file of another program: pictures of it are a luxury
    return records


def _parse_record(fields: dict[str, Any]) -> ChunkRecord:
    if fields.pop("kind") != RECORD_KIND:
        raise ValueError("a file of another kind")
    views = []
    for view in fields.pop("views"):
        arrays = {name: np.array(view[name], np.float64).reshape(shape) for name, shape in SHAPES.items()}
        views.append(RecordedView(frame=view["frame"], thumbnail=base64.b64decode(view["thumbnail"]), **arrays))
    width, height = fields.pop("size")
    return ChunkRecord(size=(width, height), views=tuple(views), **fields)


def make_thumbnail(image: Float[np.ndarray, "h w 3"]) -> bytes:
    """A small JPEG of an image in [0, 1]."""
    picture = Image.fromarray(eight_bits(image))
    picture.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE), Image.Resampling.LANCZOS)
    encoded = io.BytesIO()
    picture.save(encoded, "JPEG", quality=85)
    return encoded.getvalue()


def open_thumbnail(encoded: bytes) -> UInt8[np.ndarray, "h w 3"]:
    """The pixels of a thumbnail."""
    with Image.open(io.BytesIO(encoded)) as picture:
        return np.asarray(picture.convert("RGB"))


def save_delta(path: Path, delta: SceneDelta, header: dict[str, Any] | None = None) -> None:
    """Writes one delta and the caller's JSON-serializable `header` to an `.npz` file, atomically."""
    names = ("means", "quats", "scales", "opacities", "sh")
    arrays = {name: np.asarray(getattr(delta.gaussians, name)) for name in names} | {"rows": delta.rows}
    save_arrays(path, arrays, DELTA_KIND, {"capacity": delta.capacity, "caller": header or {}})


def load_delta(path: Path) -> tuple[SceneDelta, dict[str, Any]]:
    """Reads a delta and the caller's header that `save_delta` wrote."""
    arrays, facts = load_arrays(path, DELTA_KIND)
    rows = arrays.pop("rows")
    fields: dict[str, Any] = {name: jnp.asarray(x) for name, x in arrays.items()}
    return SceneDelta(rows, Gaussians(**fields), facts["capacity"]), facts["caller"]
