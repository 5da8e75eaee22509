"""`Viewer`: a server of viser (extra `viewer`), which shows the stage in browsers."""

import contextlib
import io
import socket
from typing import Any

from ssplat_jax.core.errors import InputError
from ssplat_jax.viewer.browser import Browser
from ssplat_jax.viewer.stage import Stage

LOCAL_HOSTS = ("127.0.0.1", "localhost", "::1")
"""Addresses that only this machine can reach."""


def check_address(host: str, port: int) -> None:
    """Checks that `host` is an address of this machine: with another one viser would wait forever.

    Raises:
        InputError: it is not, or the port is out of range.
    """
    try:
        if not 0 < port < 1 << 16:
            raise OSError("ports are 1 to 65535")
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        raise InputError(f"view: cannot listen on {host}:{port} ({error}); choose another.") from error


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
        viser = import_viser()
        check_address(host, port)
        self._stage, self._browsers = stage, {}
        with contextlib.redirect_stdout(io.StringIO()):  # viser's banner; `show_source` says the address
            self._server: Any = viser.ViserServer(host=host, port=port, label="ssplat", verbose=False)
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self._num_starts = 0  # start cameras of the stage that were set
        self._server.on_client_connect(self._welcome)
        self._server.on_client_disconnect(lambda client: self._browsers.pop(client.client_id, None))
        name = "localhost" if host in (*LOCAL_HOSTS, "0.0.0.0", "::") else f"[{host}]" if ":" in host else host
        self.url = f"http://{name}:{self._server.get_port()}"
        self._set_start_camera()

    def _welcome(self, client: Any) -> None:
        self._browsers[client.client_id] = Browser(client, self._stage)

    def _set_start_camera(self) -> None:
        """Sets the camera with which browsers start, whenever the stage has a new one, and moves all browsers to it."""
        if self._num_starts == self._stage.num_starts or (start := self._stage.start) is None:
            return
        self._num_starts = self._stage.num_starts
        position, target = start.position / self._stage.distance, start.look_at / self._stage.distance
        self._server.scene.set_up_direction(start.up)
        self._server.initial_camera.position, self._server.initial_camera.look_at = position, target
        fov = self._stage.run.fov
        if fov is not None:
            self._server.initial_camera.fov = fov
        for browser in list(self._browsers.values()):
            browser.start_at(position, target, start.up, fov)

    @property
    def browsers(self) -> list[Browser]:
        """The browsers that are connected."""
        return list(self._browsers.values())

    def update(self) -> None:
        """Brings every browser up to date with the stage; called many times a second."""
        self._set_start_camera()
        for browser in self.browsers:
            browser.update()

    def close(self) -> None:
        """Stops the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()


def import_viser() -> Any:
    """The package viser.

    Raises:
        InputError: it is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise InputError('view: wanted the package viser; run: pip install "ssplat-jax[viewer]"') from error
    return viser
