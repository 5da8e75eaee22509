"""Checksummed `.npz` files of named arrays without pickles: read back bit for bit, or refused.

    header          JSON bytes: schema, kind, dtype and sha256 of each array, and the caller's own header
    <name>          one array each; bfloat16, which `.npy` has no name for, is stored as uint16
    archive comment sha256 of all bytes before it, which detects any change of the file

`numpy.load` reads such a file.
"""

import hashlib
import io
import json
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any

import ml_dtypes
import numpy as np

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.errors import StorageError, echo

SCHEMA = 2  # version of the layout above
_HEADER = "header"  # name of the JSON member
_DIGEST_LENGTH = 64  # hex digits of a sha256

# A damaged archive surfaces as almost any of these.
_DAMAGE_ERRORS = (
    *(ValueError, LookupError, TypeError, OSError, EOFError, RuntimeError),
    *(struct.error, tokenize.TokenError, zlib.error, zipfile.BadZipFile),
)


def save_arrays(
    path: Path, arrays: dict[str, np.ndarray], kind: str, header: dict[str, Any], *, keep_previous: bool = False
) -> None:
    """Writes named arrays and a header to one file, atomically.

    Args:
        path: the file to write.
        arrays: arrays by name.
        kind: the kind of file, with its version ("stream state 3"); `load_arrays` refuses other kinds.
        header: any JSON-serializable facts.
        keep_previous: keep the old file at `previous_path(path)`.

    Raises:
        StorageError: the folder cannot be written or the disk is full.
    """
    leaves = {name: {"dtype": str(x.dtype), "sha256": _digest(x)} for name, x in arrays.items()}
    text = json.dumps({"schema": SCHEMA, "kind": kind, "leaves": leaves, "header": header}, sort_keys=True)
    buffer = io.BytesIO()
    bits = {name: x if x.dtype.isbuiltin == 1 else x.view(f"u{x.dtype.itemsize}") for name, x in arrays.items()}
    np.savez(buffer, **{_HEADER: np.frombuffer(text.encode(), np.uint8)}, **bits)  # pyright: ignore[reportArgumentType]
    # The last field of a zip file without comment is the comment's length.
    sealed = buffer.getvalue()[:-2] + _DIGEST_LENGTH.to_bytes(2, "little")
    write_atomic(path, sealed + _hex_digest(sealed), keep_previous=keep_previous)


def load_arrays(path: Path, kind: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Reads (arrays, header) from a file that `save_arrays` wrote.

    Raises:
        StorageError: the file is missing, of another kind, or damaged.
    """
    try:
        contents = Path(path).read_bytes()
    except OSError as error:
        raise StorageError(f"{path}: cannot be read ({error.strerror or error}).") from error
    try:
        arrays, facts = _parse(contents)
    except _DAMAGE_ERRORS as error:
        raise StorageError(
            f"{path}: the file is corrupt ({echo(str(error))}); restore it from a backup or create it again."
        ) from error
    if facts["kind"] != kind:
        raise StorageError(
            f"{path}: wanted a file of {kind}, got one of {facts['kind']}; create a file of another version again."
        )
    return arrays, facts["header"]


def _parse(contents: bytes) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    if _hex_digest(memoryview(contents)[:-_DIGEST_LENGTH]) != contents[-_DIGEST_LENGTH:]:
        raise ValueError("its checksum does not match")
    with np.load(io.BytesIO(contents), allow_pickle=False) as archive:
        facts = json.loads(archive[_HEADER].tobytes())
        if facts["schema"] != SCHEMA:
            raise ValueError(f"its schema is {facts['schema']}, this version reads {SCHEMA}")
        arrays = {name: archive[name].view(_dtype(leaf["dtype"])) for name, leaf in facts["leaves"].items()}
    for name, leaf in facts["leaves"].items():
        if _digest(arrays[name]) != leaf["sha256"]:
            raise ValueError(f"the checksum of {name} does not match")
    return arrays, facts


def _dtype(name: str) -> np.dtype:
    return np.dtype(getattr(ml_dtypes, name, name))


def _digest(x: np.ndarray) -> str:
    return hashlib.sha256(f"{x.dtype} {x.shape} ".encode() + x.tobytes()).hexdigest()


def _hex_digest(data: bytes | memoryview) -> bytes:
    return hashlib.sha256(data).hexdigest().encode()
