"""`ssplat view`: shows a scene file, or a run while it streams, in a browser.

A run with `--deltas` writes a file per chunk. The viewer reads these in a process of its own, so the stream never waits
for it.
"""

import time
from pathlib import Path

from ssplat_jax.console import Reporter
from ssplat_jax.storage.interrupts import Interrupts
from ssplat_jax.viewer.scene_sources import open_source
from ssplat_jax.viewer.start_camera import camera_before
from ssplat_jax.viewer.viser_viewer import LOCAL_HOSTS, Viewer

POLL_INTERVAL = 0.5
"""Seconds between checks for changes, so that browsers are sent at most two scenes a second."""


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
        path: a .ply or the folder of a run.
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
    scene = source.changed()
    viewer = Viewer(host=host, port=port, max_gaussians=max_gaussians, over_black=over_black)
    try:
        if host not in LOCAL_HOSTS:
            reporter.warn(f"everyone who reaches this machine at {host} can view the scene; there is no password.")
        print(f"{viewer.url} shows {path}; Ctrl-C ends it", flush=True)
        has_camera = False
        with Interrupts() as interrupts:
            while not interrupts.received:
                if scene is not None:
                    camera = source.start_camera() or camera_before(scene)
                    if not has_camera and camera is not None:
                        viewer.look_from(camera)
                        has_camera = True
                    viewer.show(scene)
                time.sleep(POLL_INTERVAL)
                scene = source.changed()
            return interrupts.received
    finally:
        viewer.close()
