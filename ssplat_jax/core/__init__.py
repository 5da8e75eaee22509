"""Gaussians, cameras, rotations, numerics, errors, terminal output, atomic files, kept programs: for every layer."""

import os


def num_cores() -> int:
    """Cores that this process may use; all of the machine where the system does not say (macOS)."""
    # Here, where nothing imports JAX, which would read its variables before `commands/program_cache.py` sets them.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
