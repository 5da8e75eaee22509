"""`ssplat view`: shows a scene file, or a run while it streams, in a browser.

A run with `--deltas` writes a file per chunk. The viewer reads these in a process of its own, so the stream never waits
for it.
"""

import time
from collections.abc import Callable
from pathlib import Path

from ssplat_jax.core.console import Reporter
from ssplat_jax.storage.interrupts import Interrupts
from ssplat_jax.viewer.scene_sources import Source, open_source
from ssplat_jax.viewer.stage import Stage
from ssplat_jax.viewer.viser_viewer import LOCAL_HOSTS, Viewer

POLL_INTERVAL = 0.5
"""Seconds between checks for changes, so that browsers are sent at most two scenes a second."""

TICK = 1 / 30
"""Seconds between updates of the browsers, for smooth playback."""


def view_scene(
    path: Path,
    *,
    host: str,
    port: int,
    max_gaussians: int,
    over_black: bool = False,
    one_exposure: bool = False,
    reporter: Reporter,
) -> int:
    """Shows a scene and its changes until Ctrl-C.

    Args:
        path: a scene file (any of `scene_files.formats.READERS`) or the folder of a run.
        host: address to listen on.
        port: port to listen on; the next free one if it is taken.
        max_gaussians: most Gaussians sent to a browser.
        over_black: show the scene over black.
        one_exposure: show a run's scene at the exposure of its first views.
        reporter: prints warnings.

    Returns:
        The signal that ended it.

    Raises:
        InputError: no scene there, one exposure of a scene whose run is unknown, viser is missing, or the address is
            taken.
        StorageError: a file of the run is damaged.
    """
    source = open_source(path, one_exposure=one_exposure)
    where = {"host": host, "port": port}
    return show_source(source, **where, max_gaussians=max_gaussians, over_black=over_black, reporter=reporter)


def show_source(
    source: Source,
    *,
    host: str,
    port: int,
    max_gaussians: int,
    over_black: bool = False,
    is_wanted: Callable[[], bool] = lambda: True,
    reporter: Reporter,
) -> int:
    """Shows a source and its changes until Ctrl-C; see `view_scene`.

    Args:
        source: where scenes come from; there need not be one yet.
        host: address to listen on.
        port: port to listen on.
        max_gaussians: most Gaussians sent to a browser.
        over_black: show the scene over black.
        is_wanted: asked many times a second; the viewer ends when it says no.
        reporter: prints warnings.

    Returns:
        The signal that ended it; 0 if `is_wanted` did.
    """
    stage = Stage(source, max_gaussians=max_gaussians, over_black=over_black)
    stage.refresh()
    viewer = Viewer(stage, host=host, port=port)
    try:
        if host not in LOCAL_HOSTS:
            reporter.warn(f"everyone who reaches this machine at {host} can view the scene; there is no password.")
        print(f"{viewer.url} shows {source.path}; Ctrl-C ends it", flush=True)
        polled = time.monotonic()
        with Interrupts() as interrupts:
            while not interrupts.received and is_wanted():
                viewer.update()
                time.sleep(TICK)
                if time.monotonic() - polled > POLL_INTERVAL:
                    polled = time.monotonic()
                    stage.refresh()
            return interrupts.received or 0
    finally:
        viewer.close()
