"""Adapter to viser (extra `viewer`), which shows Gaussians in a browser.

Every change sends the whole scene, colored by the constant band of its spherical harmonics. viser stores covariances as
16-bit floats, in which a Gaussian of 1e-4 units vanishes, and clips what is nearer than 0.01 or farther than 1000.
Gaussians are therefore sent in units of the scene's median Gaussian, and scaled in the browser so that the first camera
looks at a point at distance 1.
"""

import dataclasses
import socket
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ssplat_jax.errors import InputError
from ssplat_jax.gaussians import SH_C0, Gaussians
from ssplat_jax.geometry.rotations import quats_to_matrices
from ssplat_jax.scene_files.export_rows import MIN_OPACITY
from ssplat_jax.viewer.start_camera import StartCamera

MAX_SIGMA = 250.0
"""Largest standard deviation that is sent: the square of 256 overflows a 16-bit float."""

LOCAL_HOSTS = ("127.0.0.1", "localhost", "::1")
"""Addresses that only this machine can reach."""


@dataclasses.dataclass(frozen=True)
class Splats:
    """Arguments of viser, lengths divided by `unit`."""

    centers: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]
    rgbs: Float[np.ndarray, "n 3"]
    opacities: Float[np.ndarray, "n 1"]


def median_size(gaussians: Gaussians) -> float:
    """Median of the largest standard deviations of the visible Gaussians; 1 if there are none."""
    scales = np.asarray(gaussians.scales, np.float64).max(axis=1, initial=0.0)[_is_visible(gaussians)]
    size = float(np.median(scales)) if len(scales) else 0.0
    return size if size > 0 else 1.0


def visible_splats(gaussians: Gaussians, unit: float, max_gaussians: int) -> Splats:
    """The visible Gaussians in units of `unit`.

    If there are more than `max_gaussians`, an evenly spaced selection is taken, the same one each time.

    Limits:
        Standard deviations are cut at 250 units. Rows with a non-finite entry or an opacity below 1/255 are dropped.
    """
    rows = np.flatnonzero(_is_visible(gaussians))
    if len(rows) > max_gaussians:
        rows = rows[np.linspace(0, len(rows) - 1, max_gaussians).round().astype(int)]
    means, quats, scales, opacities, dc = (
        np.asarray(x)[rows]
        for x in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh[:, 0])
    )
    axes = np.asarray(quats_to_matrices(jnp.asarray(quats))) * np.clip(scales / unit, 0.0, MAX_SIGMA)[:, None, :]
    return Splats(
        centers=(means / unit).astype(np.float32),
        covariances=np.einsum("nij,nkj->nik", axes, axes).astype(np.float32),
        rgbs=np.clip(0.5 + SH_C0 * dc, 0.0, 1.0).astype(np.float32),
        opacities=opacities[:, None].astype(np.float32),
    )


def _check_address(host: str, port: int) -> None:
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
    """A server that shows one scene to browsers.

    Args:
        host: address to listen on; a loopback address is reached by this machine only.
        port: port to listen on; the next free one if it is taken.
        max_gaussians: most Gaussians sent to a browser.
        over_black: show the scene over black instead of the browser's background.

    Raises:
        InputError: viser is not installed, or cannot listen there.
    """

    def __init__(self, *, host: str, port: int, max_gaussians: int, over_black: bool = False) -> None:
        viser = _viser()
        _check_address(host, port)
        self._server: Any = viser.ViserServer(host=host, port=port, label="ssplat", verbose=False)
        if over_black:
            self._server.scene.set_background_image(np.zeros((1, 1, 3), np.uint8), format="png")
        self._max_gaussians, self._unit, self._distance, self._node = max_gaussians, 1.0, 1.0, None
        name = "localhost" if host in (*LOCAL_HOSTS, "0.0.0.0", "::") else f"[{host}]" if ":" in host else host
        self.url = f"http://{name}:{self._server.get_port()}"

    def look_from(self, camera: StartCamera) -> None:
        """Sets the camera with which browsers start. Call it before the first `show`."""
        self._distance = float(np.linalg.norm(camera.look_at - camera.position)) or 1.0
        self._server.scene.set_up_direction(camera.up)
        self._server.initial_camera.position = camera.position / self._distance
        self._server.initial_camera.look_at = camera.look_at / self._distance

    def show(self, gaussians: Gaussians) -> int:
        """Replaces the shown scene in one message and returns its number of Gaussians."""
        if self._node is None:
            self._unit = median_size(gaussians)
        splats = dataclasses.asdict(visible_splats(gaussians, self._unit, self._max_gaussians))
        if len(splats["centers"]) == 0:
            return 0
        if self._node is None:
            self._node = self._server.scene.add_gaussian_splats("/scene", **splats, scale=self._unit / self._distance)
        else:
            self._node.set_gaussians(**splats)
        return len(splats["centers"])

    def close(self) -> None:
        """Stops the server."""
        self._server.stop()


def _viser() -> Any:
    try:
        import viser
    except ImportError as error:
        raise InputError('view: wanted the package viser; run: pip install "ssplat-jax[viewer]"') from error
    return viser


def _is_visible(gaussians: Gaussians) -> np.ndarray:
    """Mask of the rows that can be drawn and seen."""
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh[:, 0])
    finite = np.all([np.isfinite(np.asarray(x)).all(axis=1) for x in fields], axis=0)
    return finite & (np.asarray(gaussians.opacities) >= MIN_OPACITY)
