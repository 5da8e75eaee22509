"""Compiled programs kept on disk between commands, so that the second command of a kind does not compile again.

The programs of a stream, of rendering and of scoring are kept as executables (`core/kept_programs.py`), which are not
even traced again; JAX's compilation cache has the rest. jax 0.10.1 stores what its key describes: the program, the
compiler and its flags. Its key does not tell one CPU from another, so each kind of CPU and number of cores has a folder
of its own. Results are the same bytes with the caches off, empty and full (tests/commands/test_program_cache.py).
"""

import contextlib
import glob
import hashlib
import os
import platform
import re
import warnings
from collections.abc import MutableMapping
from pathlib import Path

import platformdirs

from ssplat_jax.core import num_cores

SWITCH = "SSPLAT_PROGRAM_CACHE"  # environment variable: `off`, or a folder in place of the user's cache folder
EXECUTABLES = "SSPLAT_EXECUTABLES"  # `core.kept_programs.SWITCH`: folder of the executables. That module imports JAX.

FOLDER, IS_ON = "JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE"
"""JAX's own variables: where they are set, they hold."""

LEAST_SECONDS = "0.3"  # shortest compilation of a program that is stored


def keep_programs(environment: MutableMapping[str, str] = os.environ) -> None:
    """Makes this process keep compiled programs on disk. Called before JAX is imported: it reads its variables then.

    Args:
        environment: the variables of the process.
    """
    if environment.get(SWITCH, "").lower() == "off" or environment.get(IS_ON, "").lower() in ("false", "0"):
        return
    if FOLDER not in environment:
        try:
            users = environment.get(SWITCH) or platformdirs.user_cache_path("ssplat")
            folder = Path(users) / "programs" / _machine()
            folder.mkdir(parents=True, exist_ok=True)
        except (OSError, RuntimeError):  # a home that cannot be written, or none: every command compiles
            return
        environment[FOLDER] = str(folder)
        environment[EXECUTABLES] = str(folder / "executables")
        replace_damaged(folder)
        environment.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", LEAST_SECONDS)
    # XLA logs an error about preferences of the compiler, which it takes for features of the CPU, at every load.
    environment.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def keep_no_programs(environment: MutableMapping[str, str] = os.environ) -> None:
    """Makes this process neither read nor write compiled programs on disk, whatever is set."""
    environment[IS_ON] = "false"
    environment.pop(EXECUTABLES, None)


def replace_damaged(folder: Path) -> None:
    """Removes the entries that JAX warns it cannot read, as one cut short by a kill: JAX would never replace them."""
    show = warnings.showwarning

    def shown(message, *given, **more) -> None:
        found = re.match(r"Error reading persistent compilation cache entry for '([^']+)'", str(message))
        if found is None:
            show(message, *given, **more)
            return
        for file in folder.glob(f"{glob.escape(found[1])}-*-cache"):  # of this function, for any shapes
            file.unlink(missing_ok=True)

    warnings.showwarning = shown


def _machine() -> str:
    """Letters for this kind of CPU and number of cores: compiled programs hold instructions and shares for them."""
    described = f"{platform.machine()} {platform.processor()} {num_cores()}"
    with contextlib.suppress(OSError, StopIteration), open("/proc/cpuinfo") as file:
        described += next(line for line in file if line.startswith(("flags", "Features")))
    return hashlib.sha256(described.encode()).hexdigest()[:12]
