"""Parser of PyTorch's pickles that executes nothing: a pickle is read as data, opcode by opcode.

A state dict needs a few opcodes and a few names. Names are kept as text and never looked up; everything else in a
pickle is refused.
"""

import io
import pickletools
import re
from typing import Any, NamedTuple

import ml_dtypes
import numpy as np

from ssplat_jax.core.errors import InputError

REMEDY = (
    "Convert it where PyTorch is: numpy.savez('weights.npz',"
    " **{k: v.float().numpy() for k, v in torch.load(path, weights_only=True).items()})."
)
DTYPES = {
    "torch.FloatStorage": np.dtype("<f4"),
    "torch.DoubleStorage": np.dtype("<f8"),
    "torch.HalfStorage": np.dtype("<f2"),
    "torch.BFloat16Storage": np.dtype(ml_dtypes.bfloat16),
}
MAX_PICKLE_BYTES = 1 << 24  # a pickle of thousands of tensor names and shapes takes less than a million bytes


class Storage(NamedTuple):
    """Flat array in the file that has not been read yet."""

    type: str  # "torch.FloatStorage"
    key: str
    count: int

    @property
    def num_bytes(self) -> int:
        """Size in the file; integer storages are not read, but they have to be skipped."""
        sizes = {"Long": 8, "Int": 4, "Short": 2, "Char": 1, "Byte": 1, "Bool": 1}
        dtype = DTYPES.get(self.type)
        size = dtype.itemsize if dtype else sizes[self.type.removeprefix("torch.").removesuffix("Storage")]
        return size * self.count


class Tensor(NamedTuple):
    """View of a storage; offset and strides count elements."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class _Global(NamedTuple):
    """Name of a class or function that the pickle refers to; it is never looked up."""

    text: str


# Callables that return their first argument, or a tensor, and the names that a state dict may refer to.
_PARAMETER_FACTORIES = ("torch._utils._rebuild_parameter", "torch.nn.parameter.Parameter")
_TENSOR_FACTORIES = ("torch._utils._rebuild_tensor", "torch._utils._rebuild_tensor_v2")
_ALLOWED_GLOBALS = ("collections.OrderedDict", *_TENSOR_FACTORIES, *_PARAMETER_FACTORIES)
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_LITERALS = (
    *("INT", "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT"),
    *("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE"),
)


def parse_pickle(file: io.BufferedReader | io.BytesIO) -> tuple[Any, dict[str, Storage]]:
    """Returns the value of the next pickle in `file` and the storages that it refers to.

    Raises:
        ValueError: the pickle is cut off or longer than `MAX_PICKLE_BYTES`.
    """
    reader, start = _Reader(), file.tell()
    # Read from memory: a damaged length would make a file allocate gigabytes before it finds its end.
    pickled = io.BytesIO(file.read(MAX_PICKLE_BYTES))
    for opcode, argument, _ in pickletools.genops(pickled):
        reader.step(opcode.name, argument)
    file.seek(start + pickled.tell())
    return reader.stack.pop(), reader.storages


class _Reader:
    """Stack machine of the pickle format, without the opcodes that import or call anything."""

    def __init__(self) -> None:
        self.stack: list = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}
        self.storages: dict[str, Storage] = {}

    def step(self, name: str, argument: Any) -> None:
        """Executes one opcode."""
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
                stack.append(tuple(self._pop_to_mark()))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                stack.append(tuple(self._pop(int(name[-1]))))
            case "BINPUT" | "LONG_BINPUT" | "PUT":
                self.memo[argument] = stack[-1]
            case "MEMOIZE":
                self.memo[len(self.memo)] = stack[-1]
            case "BINGET" | "LONG_BINGET" | "GET":
                stack.append(self.memo[argument])
            case "APPEND" | "APPENDS":
                items = self._pop(1) if name == "APPEND" else self._pop_to_mark()
                stack[-1].extend(items)
            case "SETITEM" | "SETITEMS":
                items = self._pop(2) if name == "SETITEM" else self._pop_to_mark()
                stack[-1].update(_string_dict(zip(items[::2], items[1::2], strict=True)))
            case _ if name in _CONSTANTS:
                stack.append(_CONSTANTS[name])
            case _ if name in _LITERALS:
                stack.append(argument)
            case _:
                self._step_object(name, argument)

    def _step_object(self, name: str, argument: Any) -> None:
        """Executes an opcode that names or builds an object; all other opcodes are refused."""
        stack = self.stack
        match name:
            case "GLOBAL":
                stack.append(_checked_global(argument.replace(" ", ".")))
            case "STACK_GLOBAL":
                stack.append(_checked_global(".".join(self._pop(2))))
            case "BINPERSID":
                stack.append(self._storage(stack.pop()))
            case "REDUCE" | "NEWOBJ":
                function, arguments = self._pop(2)
                stack.append(_call_result(function, arguments))
            case "BUILD":
                # Attributes hold no tensor data, except in a Parameter of early 2017: its state begins with its tensor.
                (state,) = self._pop(1)
                if stack[-1] is None and isinstance(state[0], Tensor):
                    stack[-1] = state[0]
            case _:
                raise InputError(f"the pickle uses {name}, which no state dict needs; nothing was run. {REMEDY}")

    def _pop(self, count: int) -> list:
        taken = self.stack[-count:]
        if len(taken) < count:
            raise ValueError("the pickle pops an empty stack")
        del self.stack[-count:]
        return taken

    def _pop_to_mark(self) -> list:
        mark = self.marks.pop()
        taken = self.stack[mark:]
        del self.stack[mark:]
        return taken

    def _storage(self, identity: Any) -> Storage:
        """Storage for the persistent id ("storage", type, key, device, length)."""
        kind, of_type, key, _, count, *views = identity
        if kind != "storage" or any(view is not None for view in views):
            raise InputError(f"the pickle refers to more than plain storages. {REMEDY}")
        if not isinstance(key, str) or not isinstance(count, int) or count < 0:
            raise ValueError("the description of a storage is not a key and a length")
        storage = Storage(of_type.text, key, count)
        if self.storages.setdefault(key, storage) != storage:
            raise ValueError(f"storage {key} has two different descriptions")
        return storage


def _checked_global(name: str) -> _Global:
    """Returns the name if state dicts need it, and refuses it otherwise."""
    if name not in _ALLOWED_GLOBALS and not re.fullmatch(r"torch\.[A-Za-z0-9]+Storage", name):
        raise InputError(f"the pickle asks for {name[:80]!r}, which no state dict needs; nothing was run. {REMEDY}")
    return _Global(name)


def _call_result(function: Any, arguments: Any) -> Any:
    """Result of calling an allowed name, as plain data."""
    if not isinstance(function, _Global) or not isinstance(arguments, tuple):
        raise ValueError("the pickle calls what is no function")
    if function.text == "collections.OrderedDict":
        return _string_dict(arguments[0]) if arguments else {}
    if function.text in _PARAMETER_FACTORIES:
        return arguments[0] if arguments else None
    if function.text not in _TENSOR_FACTORIES:
        raise ValueError(f"the pickle calls {function.text}")
    storage, offset, shape, strides = arguments[:4]
    if not isinstance(storage, Storage) or not all(isinstance(n, int) for n in (offset, *shape, *strides)):
        raise ValueError("the description of a tensor holds something other than whole numbers")
    return Tensor(storage, offset, tuple(shape), tuple(strides))


def _string_dict(pairs: Any) -> dict:
    """Dict of the pairs whose keys are strings; hashing nested tuples from a hostile file could take forever."""
    values = {}
    for key, value in pairs:
        if isinstance(key, str):
            values[key] = value
    return values
