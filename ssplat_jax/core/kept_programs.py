"""Executables kept on disk, so that the second process of a kind neither traces nor compiles its programs.

JAX's own compilation cache knows a program only after it is traced and lowered, which takes most of the time that a
second run spends before its first image. Here a program is known by what it is made from: the source of this package,
versions, device, configuration of JAX and XLA, the function with its static arguments, shapes and dtypes. A store is
used where `SWITCH` names its folder, as the commands do (`commands/program_cache.py`); elsewhere a `Kept` is `jax.jit`.

Views of embedded scenes and the depths of captures are kept there too (`kept_result`).

An entry is unpickled and holds machine code: one is read only if this user alone can have written it. One that is cut
short, damaged or of another program is compiled again and replaced.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import inspect
import os
import pickle
import stat
import tempfile
import threading
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import zstandard
from jax.core import Tracer
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache

PACKAGE = __name__.partition(".")[0]

SWITCH = "SSPLAT_EXECUTABLES"
"""Environment variable: folder of the store, of this kind of CPU alone; without it nothing is kept."""

PACKAGES = ("jax", "jaxlib", "flax", "numpy", "pillow", "scikit-image")  # packages whose version is part of every key

MOST_BYTES = 256 << 20
"""Size of the store: a run has some 15 programs of 0.3 MB. Those that were not used for the longest time go."""

MOST_ARRAY_BYTES = 32 << 20  # largest arrays that are kept: those of the scene that a demo streams take 15 MB

DIGEST_BYTES = 32

_loaded: dict[str, jax.stages.Compiled] = {}

_lock, _was_on = threading.Lock(), []
"""JAX's switch of its cache as it was, once for each thread that compiles; it stays off until the last is done."""


class Kept:
    """A jitted function whose executables are kept where there is a store.

    Inside other transforms, with arrays on other devices or with keyword arguments, it is plain `jax.jit`, and so are
    functions whose identity cannot be told: those of other packages, and those with a closure.

    Args:
        function: a function of this package, a method of one of its dataclasses, or a `functools.partial` of either;
            `repr` tells apart what it is bound to.
        static_argnums: as for `jax.jit`; `repr` tells the values apart.
        donate_argnums: as for `jax.jit`.
    """

    def __init__(
        self, function: Callable, static_argnums: tuple[int, ...] = (), donate_argnums: tuple[int, ...] = ()
    ) -> None:
        self.jitted = jax.jit(function, static_argnums=static_argnums, donate_argnums=donate_argnums)
        self._function, self._static, self._donated = function, static_argnums, donate_argnums
        functools.update_wrapper(self, function)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        key = None if named else self._key(arguments)
        if key is None:
            return self.jitted(*arguments, **named)
        if key not in _loaded:
            _loaded[key] = _load_or_compile(key, self.jitted, arguments, self._dynamic(arguments))
        return _loaded[key](*self._dynamic(arguments))

    def program(self, *arguments: Any) -> jax.stages.Compiled:
        """The compiled program for arguments like these, or for `jax.ShapeDtypeStruct` in place of arrays.

        It takes the arguments that are not static.
        """
        key = self._key(arguments)
        if key is None:
            return self.jitted.lower(*arguments).compile()
        return _loaded.get(key) or _load_or_compile(key, self.jitted, arguments, self._dynamic(arguments))

    def _dynamic(self, arguments: tuple) -> tuple:
        return tuple(x for i, x in enumerate(arguments) if i not in self._static)

    def _key(self, arguments: tuple) -> str | None:
        """The key of the compiled program, a text of all that it was compiled from; None if no entry is kept for it."""
        if not os.environ.get(SWITCH) or jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
            return None
        if jax.default_backend() != "cpu":  # not measured elsewhere: JAX's own cache has the programs there
            return None
        leaves, structure = jax.tree.flatten(self._dynamic(arguments))
        parts = [_identity(self._function), *map(_described, leaves)]
        if None in parts:
            return None
        static = [repr(arguments[i]) for i in self._static if i < len(arguments)]
        text = "\n".join(map(str, (_place(), _settings(), self._static, self._donated, static, structure, *parts)))
        return None if " at 0x" in text else text  # an object that is known by its address alone


def drop_loaded() -> None:
    """Forgets the programs of this process; the store keeps them."""
    _loaded.clear()


def _identity(function: Callable) -> str | None:
    """A function by name and by what it is bound to; None if that does not tell what it computes."""
    if isinstance(function, functools.partial):
        inner = _identity(function.func)
        return inner and f"{inner} of {function.args} {function.keywords}"
    if isinstance(function, types.MethodType):
        inner = _identity(function.__func__) if _is_ours(type(function.__self__)) else None
        return inner and f"{inner} of {function.__self__!r}"
    plain = inspect.unwrap(function)
    if not isinstance(plain, types.FunctionType) or plain.__closure__ or not _is_ours(plain):
        return None
    return f"{plain.__module__}.{plain.__qualname__}:{plain.__code__.co_firstlineno}"


def _is_ours(thing: Any) -> bool:
    return thing.__module__.partition(".")[0] == PACKAGE


def _described(leaf: Any) -> str | None:
    """Shape and dtype of an argument; None if it is traced or elsewhere than on the first device."""
    if isinstance(leaf, Tracer) or (isinstance(leaf, jax.Array) and leaf.devices() != {jax.devices()[0]}):
        return None
    kind = leaf if isinstance(leaf, jax.ShapeDtypeStruct) else jax.typeof(leaf)
    return f"{kind.dtype}{list(kind.shape)}{kind.weak_type}"


@functools.cache
def _place() -> str:
    """The package with its source, versions, and the device with its compiler and flags."""
    source = hashlib.sha256()
    root = Path(__file__).parents[1]
    for file in sorted(root.rglob("*.py")):
        source.update(f"{file.relative_to(root)} {file.stat().st_size}\n".encode() + file.read_bytes())
    versions = [f"{name} {importlib.metadata.version(name)}" for name in PACKAGES]
    device = jax.devices()[0]
    platform = (device.platform, device.device_kind, device.client.platform_version, jax.device_count())
    flags = [os.environ.get(name) for name in ("XLA_FLAGS", "LIBTPU_INIT_ARGS")]
    return f"{source.hexdigest()} {versions} {platform} {flags}"


def _settings() -> list[tuple[str, Any]]:
    """JAX's configuration in this thread, but for where and what it caches and logs."""
    aside = ("jax_compilation_cache", "jax_persistent_cache", "jax_enable_compilation_cache", "jax_log")
    values = sorted(jax.config.values.items())  # of the process; attributes are of the thread
    return [(name, getattr(jax.config, name, value)) for name, value in values if not name.startswith(aside)]


def _load_or_compile(key: str, jitted: Any, arguments: tuple, dynamic: tuple) -> jax.stages.Compiled:
    device = jax.devices()[0]
    with contextlib.suppress(Exception):  # whatever a damaged entry raises: the program is compiled
        executable, results = _read(key)
        trees = jax.tree.structure((dynamic, {})), jax.tree.structure(results)
        return serialize_executable.deserialize_and_load(
            executable, *trees, backend=device.client, execution_devices=[device]
        )
    program = _compiled_anew(jitted.lower(*arguments))
    with contextlib.suppress(Exception):  # a program that JAX cannot serialize, a full disk, a folder that is read-only
        executable, _, out_tree = serialize_executable.serialize(program)
        results = jax.tree.unflatten(out_tree, range(out_tree.num_leaves))  # the structure itself cannot be pickled
        _write(key, (executable, results))
    return program


def _compiled_anew(lowered: jax.stages.Lowered) -> jax.stages.Compiled:
    """Compiles without JAX's cache: an executable from there loses its kernels when it is serialized again, and fails
    only when it is called ("Function ... not found", jaxlib 0.10.1 on the CPU).
    """
    with _lock:
        was_on = _was_on[0] if _was_on else jax.config.jax_enable_compilation_cache  # pyright: ignore[reportAttributeAccessIssue]
        _was_on.append(was_on)
        _use_jax_cache(on=False)
    try:
        return lowered.compile()
    finally:
        with _lock:
            _was_on.pop()
            _use_jax_cache(on=was_on and not _was_on)


def _use_jax_cache(*, on: bool) -> None:
    if on != jax.config.jax_enable_compilation_cache:  # pyright: ignore[reportAttributeAccessIssue]
        jax.config.update("jax_enable_compilation_cache", on)
        compilation_cache.reset_cache()  # JAX looks at its switch once, until then


def kept_result(make: Callable[[], Any], *facts: Any) -> Any:
    """`make()`, kept where programs are: arrays and numbers that follow from this package and `facts`.

    Args:
        make: computes the result.
        facts: what is computed, and all that it depends on; `repr` tells them apart.
    """
    if not os.environ.get(SWITCH):
        return make()
    key = f"{_place()} {_settings()} {facts}"
    with contextlib.suppress(Exception):  # as for programs
        return _read(key)
    result = make()
    if sum(np.asarray(x).nbytes for x in jax.tree.leaves(result)) <= MOST_ARRAY_BYTES:
        with contextlib.suppress(Exception):
            _write(key, result)
    return result


def _file(key: str) -> Path:
    return Path(os.environ[SWITCH]) / hashlib.sha256(key.encode()).hexdigest()


def _read(key: str) -> Any:
    """The content of an entry; raises if it is damaged, of another key, or may be another user's."""
    file = _file(key)
    with file.open("rb") as opened:
        facts = os.fstat(opened.fileno())
        if facts.st_uid != os.geteuid() or facts.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            raise PermissionError(file)
        data = opened.read()
    if hashlib.sha256(data[DIGEST_BYTES:]).digest() != data[:DIGEST_BYTES]:
        raise ValueError(file)
    stored_key, held = pickle.loads(zstandard.decompress(data[DIGEST_BYTES:]))
    if stored_key != key:
        raise ValueError(file)
    with contextlib.suppress(OSError):
        os.utime(file)  # used last
    return held


def _write(key: str, held: Any) -> None:
    file, body = _file(key), zstandard.compress(pickle.dumps((key, held)))
    file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    # Not `write_atomic`: two processes that write the same entry need a partial file each, which this user alone reads.
    descriptor, partial = tempfile.mkstemp(dir=file.parent)
    try:
        with open(descriptor, "wb") as opened:
            opened.write(hashlib.sha256(body).digest() + body)
        os.replace(partial, file)
    except BaseException:
        Path(partial).unlink(missing_ok=True)
        raise
    _remove_oldest(file.parent)


def _remove_oldest(folder: Path) -> None:
    """Removes what was not used for the longest time, also what killed processes left, until the store has its size."""
    entries = [(facts.st_mtime, facts.st_size, entry.path) for entry in os.scandir(folder) if (facts := entry.stat())]
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries):
        if total <= MOST_BYTES:
            return
        Path(path).unlink(missing_ok=True)
        total -= size
