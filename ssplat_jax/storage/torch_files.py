"""Reader of PyTorch state dicts that needs no PyTorch and executes no pickle.

A file holds a small pickle that describes the tensors, and their data. `torch.load` executes the pickle;
`storage.torch_pickle` reads it as data. Three layouts are read:

    zip archive        NAME/data.pkl and one NAME/data/KEY per storage          PyTorch 1.6 and later
    pickles in a row   magic number, version, system, state dict, keys; then    before 1.6: torchvision's vgg16 (2017)
                       per key the length and the data of a storage             and the heads of the `lpips` package
    .npz               arrays under the same names                              numpy.savez
"""

import io
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32

from ssplat_jax.core.errors import InputError, echo
from ssplat_jax.storage.torch_pickle import DTYPES, MAX_PICKLE_BYTES, REMEDY, Storage, Tensor, parse_pickle

_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_VERSION = 1001
_LEGACY_START = b"\x80\x02\x8a\x0a" + _LEGACY_MAGIC.to_bytes(10, "little")
_STATE_DICT_KEYS = ("state_dict", "model")  # keys under which training checkpoints hold their state dict

# A damaged file can raise almost any of these while it is unpacked, decoded and indexed.
_DAMAGE_ERRORS = (
    *(ValueError, TypeError, LookupError, ArithmeticError, AttributeError, EOFError, RuntimeError),
    *(struct.error, tokenize.TokenError, zlib.error, zipfile.BadZipFile),
)


def read_arrays(path: Path, shapes: dict[str, tuple[int, ...]]) -> dict[str, Float32[np.ndarray, "..."]]:
    """Reads the arrays named in `shapes`, in that order, from a state dict (`.pth`, `.npz`).

    Limits:
        float16, bfloat16 and float32 are read exactly, float64 is rounded; other types are refused.
        Files from big-endian machines and sparse, quantized or nested tensors are refused.

    Raises:
        InputError: the file is missing, damaged or of another kind, its pickle asks for anything but tensors, an array
            is missing or of another shape, or a value is not finite.
    """
    return _read_file(path, lambda entries: {name: _read_checked(entries, name, shapes[name]) for name in shapes})


def read_shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of all arrays of a state dict by name, without reading their data.

    Raises:
        InputError: the file is missing, damaged or of another kind, or its pickle asks for anything but tensors.
    """
    return _read_file(path, lambda entries: {name: tuple(array.shape) for name, array in entries.items()})


def _read_file(path: Path, use: Callable[[dict[str, "_ArrayEntry"]], dict]) -> dict:
    """Returns `use(contents of the file)`; every failure becomes one InputError that names the file."""
    try:
        with path.open("rb") as file:
            return use(_contents(file))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}).") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except _DAMAGE_ERRORS as error:
        raise InputError(f"{path}: the file is damaged ({echo(str(error))}); fetch it again.") from error


class _ArrayEntry(NamedTuple):
    """Array in a file: its shape, and a function that reads it."""

    shape: tuple[int, ...]
    read: Callable[[], np.ndarray]


def _contents(file: io.BufferedReader | io.BytesIO) -> dict[str, _ArrayEntry]:
    """Array entries by name, for whichever of the three layouts the file has."""
    start = file.read(len(_LEGACY_START))
    file.seek(0)
    if start == _LEGACY_START:
        return _legacy_contents(file)
    if not start.startswith(b"PK\x03\x04"):
        raise InputError(f"wanted a state dict that torch.save wrote, or an .npz, got neither. {REMEDY}")
    archive = zipfile.ZipFile(file)
    pickles = [name for name in archive.namelist() if name.endswith("/data.pkl")]
    return _zip_contents(archive, pickles[0]) if pickles else _npz_contents(archive)


def _read_checked(entries: dict[str, _ArrayEntry], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Returns one array as float32, with its shape and values checked."""
    if name not in entries:
        raise InputError(f"wanted an array {name}, the file has none; is it another network's?")
    if entries[name].shape != shape:
        came = str(entries[name].shape)[:80]
        raise InputError(f"wanted {name} of shape {shape}, got {came}; is it another network's?")
    array = entries[name].read().astype(np.float32)
    if not np.isfinite(array).all():
        raise InputError(f"{name} holds values that are not finite; fetch the file again.")
    return array


# -- the three layouts ------------------------------------------------------------------------------------------------


def _npz_contents(archive: zipfile.ZipFile) -> dict[str, _ArrayEntry]:
    def read(member: str) -> np.ndarray:
        with archive.open(member) as file:
            array = np.lib.format.read_array(file, allow_pickle=False)
        if array.dtype.kind != "f":
            raise InputError(f"wanted {member} in floating point, got {array.dtype}. {REMEDY}")
        return array

    members = [name for name in archive.namelist() if name.endswith(".npy")]
    return {m.removesuffix(".npy"): _ArrayEntry(_npy_shape(archive, m), lambda m=m: read(m)) for m in members}


def _npy_shape(archive: zipfile.ZipFile, member: str) -> tuple[int, ...]:
    """Shape from the header of a member, so that no memory is allocated for an array of the wrong shape."""
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        return read_header(file)[0]


def _zip_contents(archive: zipfile.ZipFile, pickle_name: str) -> dict[str, _ArrayEntry]:
    if archive.getinfo(pickle_name).file_size > MAX_PICKLE_BYTES:
        raise ValueError("the table of tensors is too long")
    folder = pickle_name.removesuffix("data.pkl")
    if f"{folder}byteorder" in archive.namelist() and archive.read(f"{folder}byteorder") != b"little":
        raise InputError(f"the file was written on a big-endian machine. {REMEDY}")
    value, _ = parse_pickle(io.BytesIO(archive.read(pickle_name)))

    def storage_bytes(storage: Storage) -> bytes:
        member = archive.getinfo(f"{folder}data/{storage.key}")
        # torch.save does not compress: a storage cannot be larger than the file.
        if member.compress_type != zipfile.ZIP_STORED:
            raise ValueError("the storages are compressed")
        return archive.read(member)

    return _tensors(value, storage_bytes)


def _legacy_contents(file: io.BufferedReader | io.BytesIO) -> dict[str, _ArrayEntry]:
    (magic, _), (version, _), (system, _) = (parse_pickle(file) for _ in range(3))
    if (magic, version) != (_LEGACY_MAGIC, _LEGACY_VERSION):
        raise InputError(f"wanted version {_LEGACY_VERSION} of the format. {REMEDY}")
    if not system.get("little_endian", True):
        raise InputError(f"the file was written on a big-endian machine. {REMEDY}")
    value, storages = parse_pickle(file)
    keys, _ = parse_pickle(file)
    positions = {}
    for key in keys:
        (count,) = struct.unpack("<q", file.read(8))
        if count != storages[key].count:
            raise ValueError(f"storage {key} has another length than its tensor states")
        positions[key] = file.tell()
        file.seek(storages[key].num_bytes, io.SEEK_CUR)
    if file.tell() > file.seek(0, io.SEEK_END):
        raise ValueError("the file is cut off")

    def storage_bytes(storage: Storage) -> bytes:
        file.seek(positions[storage.key])
        return file.read(storages[storage.key].num_bytes)

    return _tensors(value, storage_bytes)


# -- tensors ----------------------------------------------------------------------------------------------------------


def _tensors(value: Any, storage_bytes: Callable[[Storage], bytes]) -> dict[str, _ArrayEntry]:
    """Array entries of the tensors in an unpickled state dict."""
    if not isinstance(value, dict):
        raise InputError(f"wanted a state dict, got a {type(value).__name__}. {REMEDY}")
    for name in _STATE_DICT_KEYS:
        value = value[name] if isinstance(value.get(name), dict) else value
    found = {name: x for name, x in value.items() if isinstance(x, Tensor)}
    return {name: _ArrayEntry(x.shape, lambda x=x: _read_tensor(x, storage_bytes)) for name, x in found.items()}


def _read_tensor(tensor: Tensor, storage_bytes: Callable[[Storage], bytes]) -> np.ndarray:
    """Reads the data of a tensor; offsets and strides that reach outside the storage are refused."""
    storage, offset, shape, strides = tensor
    if storage.type not in DTYPES:
        raise InputError(f"wanted floating-point tensors, got one in a {storage.type}. {REMEDY}")
    whole = np.frombuffer(storage_bytes(storage), DTYPES[storage.type])
    reach = offset + sum((n - 1) * stride for n, stride in zip(shape, strides, strict=True))
    if min((offset, *shape, *strides)) < 0 or (math.prod(shape) and reach >= min(len(whole), storage.count)):
        raise ValueError("a tensor reaches beyond its storage")
    steps = [stride * whole.itemsize for stride in strides]
    return np.lib.stride_tricks.as_strided(whole[offset:], shape, steps, writeable=False)
