"""`make_room`: drops compiled programs before a long experiment holds more of them than a process may."""

import gc
from pathlib import Path

import jax

from ssplat_experiments import joint_network, warm_sessions

MAPS = Path("/proc/self/maps")

MOST_MAPS = 25_000
"""Memory maps of the process. XLA's CPU compiler takes some for every program, and Linux allows 65,530 by default."""


def make_room(most_maps: int = MOST_MAPS) -> None:
    """Drops all compiled programs, of kept sessions too, if the process holds many memory maps, which Linux counts.

    What is dropped is compiled again when it is needed. Measurements are warm in any case.
    """
    if MAPS.exists() and len(MAPS.read_text().splitlines()) > most_maps:
        warm_sessions.forget()
        joint_network.forget()
        jax.clear_caches()
        gc.collect()
