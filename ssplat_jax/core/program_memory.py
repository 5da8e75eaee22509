"""Memory maps of compiled programs, of which a process may hold only so many.

XLA's CPU compiler takes some tens of memory maps for a program, and Linux allows a process 65,530 of them by default
(`vm.max_map_count`). Beyond that the process crashes. Scenes differ in their number of Gaussians and so in their
programs: streaming, refining and scoring one takes thousands of maps.
"""

import gc
from pathlib import Path

import jax

MAPS = Path("/proc/self/maps")
"""File with a line for each memory map of the process, where the system has one."""

MOST_MAPS = 25_000
"""Memory maps above which programs are dropped: the next scene may take as many again."""


def holds_many_programs(most_maps: int = MOST_MAPS) -> bool:
    """True if the process has more than `most_maps` memory maps; False where the system does not list them."""
    return MAPS.exists() and len(MAPS.read_text().splitlines()) > most_maps


def make_room(most_maps: int = MOST_MAPS) -> None:
    """Drops compiled programs if the process holds many (`holds_many_programs`).

    Call it between scenes when one process handles many of them. A dropped program is compiled again, or read from
    JAX's compilation cache, at its next call. A `Session` keeps its compiled programs: delete the last one first.

    Args:
        most_maps: memory maps that the process may have.
    """
    if holds_many_programs(most_maps):
        drop_programs()


def drop_programs() -> None:
    """Drops all compiled programs but those of sessions that are still in use."""
    jax.clear_caches()
    gc.collect()
