"""Named arrays in one `.npz`: no pickle, a JSON header, a sha256 for every array, written atomically."""

import hashlib
import io
import json
import zipfile
from pathlib import Path

import numpy as np

from ssplat_jax.errors import StorageError
from ssplat_jax.export.atomic import write_atomic

SCHEMA = 1
_HEADER = "header"


def save_arrays(path: Path, arrays: dict[str, np.ndarray], header: dict) -> None:
    """Writes `arrays` and the JSON-able `header`; `path` holds the old file or the whole new one, never a part.

    Raises:
        StorageError: the folder cannot be written or the disk is full.
    """
    path = Path(path)
    leaves = {name: {"shape": list(x.shape), "dtype": str(x.dtype), "sha256": _sha256(x)} for name, x in arrays.items()}
    text = json.dumps({"schema": SCHEMA, "leaves": leaves, "header": header}, sort_keys=True)
    buffer = io.BytesIO()
    np.savez(buffer, **{_HEADER: np.frombuffer(text.encode(), np.uint8)}, **arrays)  # pyright: ignore[reportArgumentType]
    write_atomic(path, buffer.getvalue())


def load_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict]:
    """(arrays, header) of a file that `save_arrays` wrote, every array checked against its sha256.

    Raises:
        StorageError: missing, truncated, altered, or not such a file.
    """
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            text = json.loads(bytes(archive[_HEADER]))
            arrays = {name: archive[name] for name in text["leaves"]}
        if text["schema"] != SCHEMA:
            raise StorageError(f"{path}: schema {text['schema']} is newer than this version reads ({SCHEMA}); upgrade.")
        for name, leaf in text["leaves"].items():
            x = arrays[name]
            if list(x.shape) != leaf["shape"] or str(x.dtype) != leaf["dtype"] or _sha256(x) != leaf["sha256"]:
                raise StorageError(f"{path}: {name} is not what was written (sha256 differs); the file is corrupt.")
        return arrays, text["header"]
    except StorageError:
        raise
    except FileNotFoundError:
        raise StorageError(f"{path}: no such file.") from None
    # A damaged archive surfaces as almost anything: zlib, struct, UTF-8, JSON or key errors.
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        EOFError,
        MemoryError,
        NotImplementedError,
        zipfile.BadZipFile,
    ) as error:
        raise StorageError(f"{path}: cannot be read ({type(error).__name__}: {error}); the file is corrupt.") from error


def _sha256(x: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(x).tobytes()).hexdigest()
