"""Files of JSON and of named arrays: written atomically, read back bit for bit or refused.

A file of `save_arrays` is an `.npz` without pickles, which `numpy.load` reads too:

    header          JSON bytes: the kind and version of the file, and the caller's own header
    <name>          one array each; bfloat16, which `.npy` has no name for, is stored as uint16
    archive comment sha256 of all bytes before it, which detects any change of the file

What writes raises `StorageError` where the file cannot be written, what reads such a file where it is missing, damaged
or of another kind.
"""

import hashlib
import io
import json
import math
import os
import zipfile
from pathlib import Path
from typing import Any

import ml_dtypes
import numpy as np
from jaxtyping import Float32

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.errors import InputError, StorageError, echo


def json_text(value: Any, indent: int | None = 1) -> str:
    """`value` as JSON text; NaN and infinities, which JSON does not have, become null."""
    return json.dumps(_finite(value), indent=indent, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(x) for key, x in value.items()}
    return [_finite(x) for x in value] if isinstance(value, (list, tuple)) else value


def write_json(path: str | os.PathLike, value: Any) -> None:
    """Writes `value` to `path` as indented JSON, atomically."""
    write_atomic(path, (json_text(value) + "\n").encode())


# -- our own arrays ---------------------------------------------------------------------------------------------------

_HEADER = "header"  # name of the JSON member
_DIGEST_LENGTH = 64  # hex digits of a sha256


def save_arrays(
    path: Path, arrays: dict[str, np.ndarray], kind: str, header: dict[str, Any], *, keep_previous: bool = False
) -> None:
    """Writes named arrays and a JSON-serializable header to one file, atomically.

    Args:
        path: the file to write.
        arrays: arrays by name.
        kind: the kind of file, with its version ("stream state 1"); `load_arrays` refuses other kinds.
        header: facts of the caller.
        keep_previous: keep the old file at `previous_path(path)`."""
    unnamed = {name: str(x.dtype) for name, x in arrays.items() if x.dtype.isbuiltin != 1}
    bits = {name: x.view(f"u{x.dtype.itemsize}") if name in unnamed else x for name, x in arrays.items()}
    text = json.dumps({"kind": kind, "dtypes": unnamed, "header": header}, sort_keys=True)
    buffer = io.BytesIO()
    # Not compressed, so that git packs shipped weights that differ in one stage as a difference of kilobytes.
    np.savez(buffer, **{_HEADER: np.frombuffer(text.encode(), np.uint8)}, **bits)  # pyright: ignore[reportArgumentType]
    # The last field of a zip file without comment is the comment's length.
    buffer.seek(-2, io.SEEK_END)
    buffer.write(_DIGEST_LENGTH.to_bytes(2, "little"))
    with buffer.getbuffer() as sealed:  # no copy: a stream's state has tens of megabytes
        digest = _hex_digest(sealed)
    buffer.write(digest)
    write_atomic(path, buffer.getvalue(), keep_previous=keep_previous)


def load_arrays(path: Path, kind: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Reads (arrays, header) from a file that `save_arrays` wrote."""
    try:
        contents = Path(path).read_bytes()
    except OSError as error:
        raise StorageError(f"{path}: cannot be read ({error.strerror or error}).") from error
    if _hex_digest(memoryview(contents)[:-_DIGEST_LENGTH]) != contents[-_DIGEST_LENGTH:]:
        fix = "restore it from a backup or create it again"
        raise StorageError(f"{path}: the file is corrupt (its checksum does not match); {fix}.")
    with np.load(io.BytesIO(contents), allow_pickle=False) as archive:
        arrays = dict(archive)
    facts = json.loads(arrays.pop(_HEADER).tobytes())
    if facts["kind"] != kind:
        fix = "create a file of another version again"
        raise StorageError(f"{path}: wanted a file of {kind}, got one of {facts['kind']}; {fix}.")
    arrays |= {name: arrays[name].view(getattr(ml_dtypes, dtype)) for name, dtype in facts["dtypes"].items()}
    return arrays, facts["header"]


def _hex_digest(data: bytes | memoryview) -> bytes:
    return hashlib.sha256(data).hexdigest().encode()


# -- tensors of other programs ----------------------------------------------------------------------------------------

_SAFETENSORS_DTYPES = {"F64": "<f8", "F32": "<f4", "F16": "<f2", "BF16": ml_dtypes.bfloat16}


def read_tensors(path: Path) -> dict[str, Float32[np.ndarray, "..."]]:
    """The floating-point arrays of a `.safetensors` or `.npz` file by name, as float32; other types are left out.

    Raises:
        InputError: the file is missing, damaged or of another kind.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}).") from error
    try:
        with np.errstate(all="ignore"):  # what is not finite in float32 is refused later
            if data[8:9] == b"{":
                return _parse_safetensors(data)
            if data[:4] == b"PK\x03\x04" and not any(
                ".pkl" in name for name in zipfile.ZipFile(io.BytesIO(data)).namelist()
            ):
                with np.load(io.BytesIO(data), allow_pickle=False) as archive:
                    return {name: x.astype(np.float32) for name, x in archive.items() if x.dtype.kind == "f"}
    except Exception as error:  # a damaged file surfaces as almost any while it is unpacked
        raise InputError(f"{path}: the file is damaged ({echo(str(error))}); fetch it again.") from error
    raise InputError(  # torch.save writes pickles, which can run any code
        f"{path}: wanted a .safetensors or .npz file; convert a .pth where PyTorch is: numpy.savez('weights.npz',"
        " **{k: v.float().numpy() for k, v in torch.load(path, weights_only=True).items()})."
    )


def _parse_safetensors(data: bytes) -> dict[str, np.ndarray]:
    """Tensors behind the length of a JSON header, and the header, which has the place of each among the bytes."""
    start = 8 + int.from_bytes(data[:8], "little")
    tensors = {}
    for name, fact in json.loads(data[8:start]).items():
        if name != "__metadata__" and fact["dtype"] in _SAFETENSORS_DTYPES:
            first, last = (start + offset for offset in fact["data_offsets"])
            tensor = np.frombuffer(data[first:last], _SAFETENSORS_DTYPES[fact["dtype"]]).reshape(fact["shape"])
            tensors[name] = tensor.astype(np.float32)
    return tensors
