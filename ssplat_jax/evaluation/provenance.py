"""Origin of a number: the machine, the date and the commit."""

import datetime
import functools
import platform
import re
import subprocess
from importlib.metadata import version
from pathlib import Path

import jax

from ssplat_jax.core.cpu_backend import num_cores


@functools.cache
def machine() -> str:
    """The device that JAX computes on, its processor's cores, and the version of JAX."""
    device, kind, facts = jax.devices()[0], None, Path("/proc/cpuinfo")
    if device.platform == "cpu" and facts.exists():
        kind = re.search(r"model name\s*: (.*)", facts.read_text())
    name = device.device_kind if device.platform != "cpu" else kind[1] if kind else platform.machine()
    return f"{name}, {num_cores()} cores, jax {jax.__version__}"


@functools.cache
def commit() -> str:
    """The commit of the installed files, with `+` if the repository was changed since; else the package's version."""
    git = functools.partial(subprocess.check_output, cwd=Path(__file__).parent, text=True, stderr=subprocess.DEVNULL)
    try:
        git(["git", "ls-files", "--error-unmatch", "--", Path(__file__).name])  # installed files are in no repository
        return git(["git", "describe", "--always", "--dirty=+", "--abbrev=10", "--exclude=*"]).strip()
    except (OSError, subprocess.CalledProcessError):
        return f"version {version('ssplat-jax')}"


def today() -> str:
    """The date in UTC, as 2026-11-24."""
    return datetime.datetime.now(datetime.UTC).date().isoformat()
