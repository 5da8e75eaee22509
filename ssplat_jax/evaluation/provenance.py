"""Origin of a number: the machine, the date and the commit."""

import datetime
import functools
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path

import jax

from ssplat_jax.core.cpu_backend import num_cores


@functools.cache
def machine() -> str:
    """The device that JAX computes on, its processor's cores, and the version of JAX."""
    device = jax.devices()[0]
    kind = _processor() if device.platform == "cpu" else device.device_kind
    return f"{kind}, {num_cores()} cores, jax {jax.__version__}"


def _processor() -> str:
    """The processor's name as Linux tells it, or its architecture."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


@functools.cache
def commit() -> str:
    """The commit of the installed files, with `+` if they were changed since; without a repository, the version."""
    folder = Path(__file__).parent
    try:
        _git(folder, "ls-files", "--error-unmatch", "--", Path(__file__).name)  # installed files are in no repository
        head = _git(folder, "rev-parse", "--short=10", "HEAD")
        is_changed = bool(
            _git(folder, "status", "--porcelain", "--untracked-files=no", "--", ":/ssplat_jax", ":/experiments")
        )
    except (OSError, subprocess.CalledProcessError):
        return f"version {version('ssplat-jax')}"
    return head + ("+" if is_changed else "")


def _git(folder: Path, *arguments: str) -> str:
    done = subprocess.run(["git", "-C", folder, *arguments], capture_output=True, text=True, check=True, timeout=30)
    return done.stdout.strip()


def today() -> str:
    """The date in UTC, as 2026-11-24."""
    return datetime.datetime.now(datetime.UTC).date().isoformat()
