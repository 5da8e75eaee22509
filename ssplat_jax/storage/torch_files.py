"""State dicts that `torch.save` wrote, read as data: no pickle is executed, and PyTorch is not needed.

A file holds a small pickle that names tensors, and their numbers. `torch.load` runs the pickle; here its opcodes are
read one by one (`_Reader`): a name stays a name, and what is no part of a state dict is refused.

    zip archive        NAME/data.pkl and one NAME/data/KEY per storage          PyTorch 1.6 and later
    pickles in a row   magic number, version, system, state dict, keys; then    before; torchvision's vgg16 (2017) and
                       per key the count and the numbers of a storage           the heads of the `lpips` package
    .npz               arrays under the same names                              numpy.savez
"""

import io
import math
import pickletools
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import ml_dtypes
import numpy as np
from jaxtyping import Float32

from ssplat_jax.errors import InputError

_DTYPES = {
    "torch.FloatStorage": np.dtype("<f4"),
    "torch.DoubleStorage": np.dtype("<f8"),
    "torch.HalfStorage": np.dtype("<f2"),
    "torch.BFloat16Storage": np.dtype(ml_dtypes.bfloat16),
}
_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_VERSION = 1001
_LEGACY_START = b"\x80\x02\x8a\x0a" + _LEGACY_MAGIC.to_bytes(10, "little")
_INSIDE = ("state_dict", "model")  # where checkpoints of a training hold their state dict
_MAX_PICKLE_BYTES = 1 << 24  # names and shapes alone: thousands of tensors take less than a million

_REMEDY = (
    "Convert it where PyTorch is: numpy.savez('weights.npz',"
    " **{k: v.float().numpy() for k, v in torch.load(path, weights_only=True).items()})."
)
# A damaged file surfaces as almost anything: unpacking, Unicode, index, key and attribute errors.
_DAMAGE = (
    *(ValueError, TypeError, LookupError, ArithmeticError, AttributeError, EOFError, RuntimeError),
    *(struct.error, zlib.error, zipfile.BadZipFile),
)


def read_arrays(path: Path, shapes: dict[str, tuple[int, ...]]) -> dict[str, Float32[np.ndarray, "..."]]:
    """The named arrays of a state dict (`.pth`, `.npz`), in the order of `shapes`; no others are read.

    Limits:
        float16, bfloat16 and float32 are read exactly, float64 is rounded; other types are refused.
        Files of little-endian machines; sparse, quantized and nested tensors are refused.

    Raises:
        InputError: no such file, one of another kind or damaged, a pickle that asks for anything but tensors, a name
            that is missing, another shape, or a value that is not finite.
    """
    return _reading(path, lambda held: {name: _checked(held, name, shape) for name, shape in shapes.items()})


def read_shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Shapes of all arrays of a state dict, by name; their numbers are not read.

    Raises:
        InputError: as `read_arrays`, of the file as a whole.
    """
    return _reading(path, lambda held: {name: tuple(array.shape) for name, array in held.items()})


def _reading(path: Path, use: Callable[[dict[str, "_Held"]], dict]) -> dict:
    """What `use` makes of the contents of a file; whatever goes wrong as one clear error."""
    try:
        with path.open("rb") as file:
            return use(_contents(file))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}).") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except _DAMAGE as error:
        raise InputError(f"{path}: the file is damaged ({error}); fetch it again.") from error


class _Held(NamedTuple):
    """An array in a file: its shape, and how to read it."""

    shape: tuple[int, ...]
    read: Callable[[], np.ndarray]


def _contents(file: io.BufferedReader | io.BytesIO) -> dict[str, _Held]:
    start = file.read(len(_LEGACY_START))
    file.seek(0)
    if start == _LEGACY_START:
        return _legacy_contents(file)
    if not start.startswith(b"PK\x03\x04"):
        raise InputError(f"wanted a state dict that torch.save wrote, or an .npz, got neither. {_REMEDY}")
    archive = zipfile.ZipFile(file)
    pickles = [name for name in archive.namelist() if name.endswith("/data.pkl")]
    return _zip_contents(archive, pickles[0]) if pickles else _npz_contents(archive)


def _checked(held: dict[str, _Held], name: str, shape: tuple[int, ...]) -> np.ndarray:
    if name not in held:
        raise InputError(f"wanted an array {name}, the file has none; is it another network's?")
    if held[name].shape != shape:
        raise InputError(f"wanted {name} of shape {shape}, got {str(held[name].shape)[:80]}; is it another network's?")
    array = held[name].read().astype(np.float32)
    if not np.isfinite(array).all():
        raise InputError(f"{name} holds values that are not finite; fetch the file again.")
    return array


# -- the three forms --------------------------------------------------------------------------------------------------


def _npz_contents(archive: zipfile.ZipFile) -> dict[str, _Held]:
    def read(member: str) -> np.ndarray:
        with archive.open(member) as file:
            array = np.lib.format.read_array(file, allow_pickle=False)
        if array.dtype.kind != "f":
            raise InputError(f"wanted {member} in floating point, got {array.dtype}. {_REMEDY}")
        return array

    members = [name for name in archive.namelist() if name.endswith(".npy")]
    return {m.removesuffix(".npy"): _Held(_npy_shape(archive, m), lambda m=m: read(m)) for m in members}


def _npy_shape(archive: zipfile.ZipFile, member: str) -> tuple[int, ...]:
    """Shape in the header, so that nothing is allocated for an array of the wrong one."""
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        return read_header(file)[0]


def _zip_contents(archive: zipfile.ZipFile, pickle_name: str) -> dict[str, _Held]:
    if archive.getinfo(pickle_name).file_size > _MAX_PICKLE_BYTES:
        raise ValueError("its table of tensors is too long")
    folder = pickle_name.removesuffix("data.pkl")
    if f"{folder}byteorder" in archive.namelist() and archive.read(f"{folder}byteorder") != b"little":
        raise InputError(f"a big-endian machine wrote it. {_REMEDY}")
    value, _ = _parse(io.BytesIO(archive.read(pickle_name)))

    def storage_bytes(storage: _Storage) -> bytes:
        member = archive.getinfo(f"{folder}data/{storage.key}")
        # torch.save stores without compression; what is stored is not larger than the file.
        if member.compress_type != zipfile.ZIP_STORED:
            raise ValueError("its storages are compressed")
        return archive.read(member)

    return _tensors(value, storage_bytes)


def _legacy_contents(file: io.BufferedReader | io.BytesIO) -> dict[str, _Held]:
    (magic, _), (version, _), (system, _) = (_parse(file) for _ in range(3))
    if (magic, version) != (_LEGACY_MAGIC, _LEGACY_VERSION):
        raise InputError(f"wanted version {_LEGACY_VERSION} of the format. {_REMEDY}")
    if not system.get("little_endian", True):
        raise InputError(f"a big-endian machine wrote it. {_REMEDY}")
    value, storages = _parse(file)
    keys, _ = _parse(file)
    positions = {}
    for key in keys:
        (count,) = struct.unpack("<q", file.read(8))
        if count != storages[key].count:
            raise ValueError(f"storage {key} has another length than its tensor says")
        positions[key] = file.tell()
        file.seek(storages[key].num_bytes, io.SEEK_CUR)
    if file.tell() > file.seek(0, io.SEEK_END):
        raise ValueError("it is cut off")

    def storage_bytes(storage: _Storage) -> bytes:
        file.seek(positions[storage.key])
        return file.read(storages[storage.key].num_bytes)

    return _tensors(value, storage_bytes)


# -- tensors ----------------------------------------------------------------------------------------------------------


class _Storage(NamedTuple):
    """A run of numbers in the file, not read yet."""

    type: str  # "torch.FloatStorage"
    key: str
    count: int

    @property
    def num_bytes(self) -> int:
        # Storages that are skipped may be of types that are not read.
        sizes = {"Long": 8, "Int": 4, "Short": 2, "Char": 1, "Byte": 1, "Bool": 1}
        dtype = _DTYPES.get(self.type)
        size = dtype.itemsize if dtype else sizes[self.type.removeprefix("torch.").removesuffix("Storage")]
        return size * self.count


class _Tensor(NamedTuple):
    """A view of a storage, in elements."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


def _tensors(value: Any, storage_bytes: Callable[[_Storage], bytes]) -> dict[str, _Held]:
    if not isinstance(value, dict):
        raise InputError(f"wanted a state dict, got a {type(value).__name__}. {_REMEDY}")
    for name in _INSIDE:
        value = value[name] if isinstance(value.get(name), dict) else value
    found = {name: x for name, x in value.items() if isinstance(x, _Tensor)}
    return {name: _Held(x.shape, lambda x=x: _view(x, storage_bytes)) for name, x in found.items()}


def _view(tensor: _Tensor, storage_bytes: Callable[[_Storage], bytes]) -> np.ndarray:
    """The tensor's numbers; nothing outside its storage is ever touched."""
    storage, offset, shape, strides = tensor
    if storage.type not in _DTYPES:
        raise InputError(f"wanted floating-point tensors, got one in a {storage.type}. {_REMEDY}")
    whole = np.frombuffer(storage_bytes(storage), _DTYPES[storage.type])
    reach = offset + sum((n - 1) * stride for n, stride in zip(shape, strides, strict=True))
    if min((offset, *shape, *strides)) < 0 or (math.prod(shape) and reach >= min(len(whole), storage.count)):
        raise ValueError("a tensor reaches beyond its storage")
    steps = [stride * whole.itemsize for stride in strides]
    return np.lib.stride_tricks.as_strided(whole[offset:], shape, steps, writeable=False)


# -- pickles, read and not run ----------------------------------------------------------------------------------------


class _Name(NamedTuple):
    """A class or function that the pickle asks for. It is never looked up."""

    text: str


_MADE_OF_FIRST_ARGUMENT = ("torch._utils._rebuild_parameter", "torch.nn.parameter.Parameter")
_REBUILD_TENSOR = ("torch._utils._rebuild_tensor", "torch._utils._rebuild_tensor_v2")
_KNOWN = ("collections.OrderedDict", *_REBUILD_TENSOR, *_MADE_OF_FIRST_ARGUMENT)
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_LITERALS = (
    *("INT", "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT"),
    *("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE"),
)


def _parse(file: io.BufferedReader | io.BytesIO) -> tuple[Any, dict[str, _Storage]]:
    """The value of the next pickle and the storages it names; `file` is left behind it."""
    reader, start = _Reader(), file.tell()
    for opcode, argument, position in pickletools.genops(file):
        if (position or 0) - start > _MAX_PICKLE_BYTES:
            raise ValueError("its table of tensors is too long")
        reader.step(opcode.name, argument)
    return reader.stack.pop(), reader.storages


class _Reader:
    """The stack machine of pickle, less everything that could call or import."""

    def __init__(self) -> None:
        self.stack: list = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}
        self.storages: dict[str, _Storage] = {}

    def step(self, name: str, argument: Any) -> None:
        """Carries out one opcode."""
        stack = self.stack
        match name:
            case "PROTO" | "FRAME" | "STOP":
                pass
            case "MARK":
                self.marks.append(len(stack))
            case "EMPTY_DICT":
                stack.append({})
            case "EMPTY_LIST":
                stack.append([])
            case "TUPLE":
                stack.append(tuple(self._since_mark()))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                stack.append(tuple(self._last(int(name[-1]))))
            case "BINPUT" | "LONG_BINPUT" | "PUT":
                self.memo[argument] = stack[-1]
            case "MEMOIZE":
                self.memo[len(self.memo)] = stack[-1]
            case "BINGET" | "LONG_BINGET" | "GET":
                stack.append(self.memo[argument])
            case "APPEND" | "APPENDS":
                items = self._last(1) if name == "APPEND" else self._since_mark()
                stack[-1].extend(items)
            case "SETITEM" | "SETITEMS":
                items = self._last(2) if name == "SETITEM" else self._since_mark()
                stack[-1].update(_pairs(zip(items[::2], items[1::2], strict=True)))
            case "GLOBAL":
                stack.append(_known(argument.replace(" ", ".")))
            case "STACK_GLOBAL":
                stack.append(_known(".".join(self._last(2))))
            case "BINPERSID":
                stack.append(self._storage(stack.pop()))
            case "REDUCE" | "NEWOBJ":
                function, arguments = self._last(2)
                stack.append(_made(function, arguments))
            case "BUILD":
                # Attributes, which hold no numbers, but for a Parameter of early 2017: its state begins with them.
                (state,) = self._last(1)
                if stack[-1] is None and isinstance(state[0], _Tensor):
                    stack[-1] = state[0]
            case _ if name in _CONSTANTS:
                stack.append(_CONSTANTS[name])
            case _ if name in _LITERALS:
                stack.append(argument)
            case _:
                raise InputError(f"its pickle uses {name}, which no state dict needs; nothing was run. {_REMEDY}")

    def _last(self, count: int) -> list:
        taken = self.stack[-count:]
        if len(taken) < count:
            raise ValueError("its pickle takes from an empty stack")
        del self.stack[-count:]
        return taken

    def _since_mark(self) -> list:
        mark = self.marks.pop()
        taken = self.stack[mark:]
        del self.stack[mark:]
        return taken

    def _storage(self, identity: tuple) -> _Storage:
        kind, of_type, key, _, count, *views = identity
        if kind != "storage" or any(view is not None for view in views):
            raise InputError(f"its pickle refers to more than plain storages. {_REMEDY}")
        if not isinstance(key, str) or not isinstance(count, int) or count < 0:
            raise ValueError("a storage is described by something else than a key and a length")
        storage = _Storage(of_type.text, key, count)
        if self.storages.setdefault(key, storage) != storage:
            raise ValueError(f"storage {key} is described in two ways")
        return storage


def _known(name: str) -> _Name:
    if name not in _KNOWN and not re.fullmatch(r"torch\.[A-Za-z0-9]+Storage", name):
        raise InputError(f"its pickle asks for {name[:80]!r}, which no state dict needs; nothing was run. {_REMEDY}")
    return _Name(name)


def _made(function: _Name, arguments: tuple) -> Any:
    """What the call of a known name would give, as plain data."""
    if function.text == "collections.OrderedDict":
        return _pairs(arguments[0]) if arguments else {}
    if function.text in _MADE_OF_FIRST_ARGUMENT:
        return arguments[0] if arguments else None
    if function.text not in _REBUILD_TENSOR:
        raise ValueError(f"its pickle calls {function.text}")
    storage, offset, shape, strides = arguments[:4]
    if not isinstance(storage, _Storage) or not all(isinstance(n, int) for n in (offset, *shape, *strides)):
        raise ValueError("a tensor is described by something else than whole numbers")
    return _Tensor(storage, offset, tuple(shape), tuple(strides))


def _pairs(pairs: Any) -> dict:
    """A dict with strings for keys; hashing nested tuples from outside could take forever."""
    held = {}
    for key, value in pairs:
        if isinstance(key, str):
            held[key] = value
    return held
