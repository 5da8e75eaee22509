"""`ssplat view` and `ssplat run --view`: a server of viser (extra `viewer`), and the loop that updates browsers.

Beside a run the viewer is a process of its own that reads the files of the run, as `ssplat view` does, so that the run
never waits for it. It draws on the CPU where the run has a GPU, and ends with the run's process.
"""

import contextlib
import io
import multiprocessing
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError, StorageError, optional_package
from ssplat_jax.storage.run_folder import Interrupts, RunFolder
from ssplat_jax.viewer.browser import Browser
from ssplat_jax.viewer.stage import GrowingScene, Source, Stage

POLL_INTERVAL = 0.5
"""Seconds between checks for changes, so that browsers are sent at most two scenes a second."""

TICK = 1 / 30
"""Seconds between updates of the browsers."""

LOCAL_HOSTS = ("127.0.0.1", "localhost", "::1")
"""Addresses that only this machine can reach."""

MOST_BESIDE_RUN = 500_000  # Gaussians sent to a browser

LOWER_PRIORITY = 19
"""`os.nice` of the viewer process (19 = lowest priority)."""


class Viewer:
    """A server that shows a stage to browsers.

    Args:
        stage: the scene, refreshed already.
        host: address to listen on; a loopback address is reached by this machine only.
        port: port to listen on; the next free one if it is taken.

    Raises:
        InputError: viser is not installed, or cannot listen there.
    """

    def __init__(self, stage: Stage, *, host: str, port: int) -> None:
        viser = import_viser(host, port)
        self._stage, self.browsers = stage, {}  # by the clients' numbers
        with contextlib.redirect_stdout(io.StringIO()):  # viser's banner; `view_scene` says the address
            self._server: Any = viser.ViserServer(host=host, port=port, label="ssplat", verbose=False)
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self._num_starts = 0  # start poses of the stage that were set
        self._server.on_client_connect(self.welcome)
        self._server.on_client_disconnect(lambda client: self.browsers.pop(client.client_id, None))
        name = "localhost" if host in (*LOCAL_HOSTS, "0.0.0.0", "::") else f"[{host}]" if ":" in host else host
        self.url = f"http://{name}:{self._server.get_port()}"
        self._set_start()

    def welcome(self, client: Any) -> None:
        """Takes a client in, whenever it comes; the next update sends it all that there is."""
        self.browsers[client.client_id] = Browser(client, self._stage)

    def _set_start(self) -> None:
        """Sets the pose with which browsers start, whenever the stage has a new one, and moves all browsers to it."""
        stage, server = self._stage, self._server
        if self._num_starts == stage.num_starts or stage.start is None:
            return
        self._num_starts, pose, fov = stage.num_starts, stage.start.copy(), stage.run.fov
        pose[:3, 3] /= stage.distance
        server.scene.set_up_direction(-pose[:3, 1])
        server.initial_camera.position, server.initial_camera.look_at = pose[:3, 3], pose[:3, 3] + pose[:3, 2]
        if fov is not None:
            server.initial_camera.fov = fov
        for browser in list(self.browsers.values()):
            browser.start_at(pose, fov)

    def update(self) -> None:
        """Brings every browser up to date with the stage; called many times a second."""
        self._set_start()
        for browser in list(self.browsers.values()):
            browser.update()

    def close(self) -> None:
        """Stops the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()


def import_viser(host: str, port: int) -> Any:
    """The package viser, about to listen at an address; at one of another machine it would wait forever.

    Raises:
        InputError: it is not installed, the address is another one, or the port is out of range.
    """
    viser = optional_package("viser", "viewer")
    try:
        if not 0 < port < 1 << 16:
            raise OSError("ports are 1 to 65535")
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        raise InputError(f"view: cannot listen on {host}:{port} ({error}); choose another.") from error
    return viser


def view_scene(
    source: Source,
    *,
    host: str,
    port: int,
    max_gaussians: int,
    is_wanted: Callable[[], bool] = lambda: True,
    reporter: Reporter,
) -> int:
    """Shows a source and its changes until Ctrl-C.

    Args:
        source: where scenes come from; there need not be one yet.
        host: address to listen on.
        port: port to listen on; the next free one if it is taken.
        max_gaussians: most Gaussians sent to a browser.
        is_wanted: asked many times a second; the viewer ends when it says no.
        reporter: prints warnings.

    Returns:
        The signal that ended it; 0 if `is_wanted` did.

    Raises:
        InputError: the source or the address cannot be used, or viser is missing.
        StorageError: a file of the run is damaged.
    """
    stage = Stage(source, max_gaussians=max_gaussians)
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


@contextlib.contextmanager
def viewer_beside(folder: Path, port: int) -> Iterator[Callable[[], int]]:
    """Opens a viewer of a run that is about to write its deltas to `folder`, and closes it afterwards.

    Gives a function that waits until a signal comes or the viewer ends, and returns the signal, or 0.

    Args:
        folder: the folder of the run.
        port: the port to listen on; the next free one if it is taken.

    Raises:
        InputError: viser is not installed, or cannot listen there.
    """
    import_viser(LOCAL_HOSTS[0], port)
    context = multiprocessing.get_context("spawn")  # a fork would share JAX's threads and locks
    process = context.Process(target=_view_beside, args=(folder, port), daemon=True)
    process.start()

    def wait() -> int:
        with Interrupts() as interrupts:
            while process.is_alive() and not interrupts.received:
                process.join(0.2)
            return interrupts.received or 0

    try:
        yield wait
    finally:
        process.terminate()
        process.join()


def _view_beside(folder: Path, port: int) -> None:
    """The process beside a run: shows it until it is terminated or the run's process is gone."""
    import jax

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run's process decides what Ctrl-C ends
    jax.config.update("jax_platforms", "cpu")
    with contextlib.suppress(OSError):
        os.nice(LOWER_PRIORITY)
    parent = multiprocessing.parent_process()
    try:
        view_scene(
            GrowingScene(RunFolder(folder)),
            host=LOCAL_HOSTS[0],
            port=port,
            max_gaussians=MOST_BESIDE_RUN,
            is_wanted=lambda: parent is None or parent.is_alive(),
            reporter=Reporter(quiet=True),
        )
    except (InputError, StorageError) as error:
        print(f"ssplat: the viewer has ended, the run goes on: {error}", file=sys.stderr)
