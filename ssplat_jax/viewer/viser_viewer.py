"""Gaussians in a browser, by viser (extra `viewer`): sent whole at every change, in the color of the constant band.

viser holds covariances as 16-bit floats, in which a Gaussian of 1e-4 units vanishes, and cuts off what is nearer than
0.01 or farther than 1000. What is sent is therefore in units of the scene's median Gaussian, and scaled in the browser
to a world in which the first camera looks at a point at distance 1.
"""

import dataclasses
import socket
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float64

from ssplat_jax.errors import InputError
from ssplat_jax.gaussians import SH_C0, Gaussians
from ssplat_jax.geometry.rotations import quats_to_matrices
from ssplat_jax.scene_files.export_rows import MIN_OPACITY

LARGEST_SIGMA = 250.0
"""Of a Gaussian as sent: beyond 255 the square is no 16-bit float."""

LOCAL_HOSTS = ("127.0.0.1", "localhost", "::1")


@dataclasses.dataclass(frozen=True)
class StartCamera:
    """Where a browser looks from at first, scene units."""

    position: Float64[np.ndarray, "3"]
    look_at: Float64[np.ndarray, "3"]
    up: Float64[np.ndarray, "3"]


@dataclasses.dataclass(frozen=True)
class Splats:
    """What viser takes, lengths `1 / unit` times the scene's."""

    centers: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]
    rgbs: Float[np.ndarray, "n 3"]
    opacities: Float[np.ndarray, "n 1"]


def median_size(gaussians: Gaussians) -> float:
    """Median over the visible Gaussians of their largest standard deviation; 1 of none."""
    scales = np.asarray(gaussians.scales, np.float64).max(axis=1, initial=0.0)[_drawn(gaussians)]
    size = float(np.median(scales)) if len(scales) else 0.0
    return size if size > 0 else 1.0


def splats_of(gaussians: Gaussians, unit: float, most: int) -> Splats:
    """The visible Gaussians in units of `unit`; of more than `most` every so many-th, the same ones each time.

    Limits:
        Standard deviations are cut at 250 units. Rows with an entry that is not finite, or fainter than 1/255, are
        left out.
    """
    rows = np.flatnonzero(_drawn(gaussians))
    if len(rows) > most:
        rows = rows[np.linspace(0, len(rows) - 1, most).round().astype(int)]
    means, quats, scales, opacities, dc = (
        np.asarray(x)[rows]
        for x in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh[:, 0])
    )
    axes = np.asarray(quats_to_matrices(jnp.asarray(quats))) * np.clip(scales / unit, 0.0, LARGEST_SIGMA)[:, None, :]
    return Splats(
        centers=(means / unit).astype(np.float32),
        covariances=np.einsum("nij,nkj->nik", axes, axes).astype(np.float32),
        rgbs=np.clip(0.5 + SH_C0 * dc, 0.0, 1.0).astype(np.float32),
        opacities=opacities[:, None].astype(np.float32),
    )


def _check_address(host: str, port: int) -> None:
    """Whether `host` is this machine's: viser looks for a free port in a thread of its own, and waits for ever.

    Raises:
        InputError: nothing can listen there.
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
    """A server that browsers on this machine look at; on others too, with a `host` of more than loopback.

    Raises:
        InputError: viser is not installed, or cannot listen there.
    """

    def __init__(self, *, host: str, port: int, most: int) -> None:
        viser = _viser()
        _check_address(host, port)
        self._server: Any = viser.ViserServer(host=host, port=port, label="ssplat", verbose=False)
        self._most, self._unit, self._distance, self._node = most, 1.0, 1.0, None
        name = "localhost" if host in (*LOCAL_HOSTS, "0.0.0.0", "::") else f"[{host}]" if ":" in host else host
        self.url = f"http://{name}:{self._server.get_port()}"

    def look_from(self, camera: StartCamera) -> None:
        """Where browsers that come look from at first. To be said before the first `show`."""
        self._distance = float(np.linalg.norm(camera.look_at - camera.position)) or 1.0
        self._server.scene.set_up_direction(camera.up)
        self._server.initial_camera.position = camera.position / self._distance
        self._server.initial_camera.look_at = camera.look_at / self._distance

    def show(self, gaussians: Gaussians) -> int:
        """Replaces what is shown, in one message; returns how many Gaussians that is."""
        if self._node is None:
            self._unit = median_size(gaussians)
        splats = dataclasses.asdict(splats_of(gaussians, self._unit, self._most))
        if len(splats["centers"]) == 0:
            return 0
        if self._node is None:
            self._node = self._server.scene.add_gaussian_splats("/scene", **splats, scale=self._unit / self._distance)
        else:
            self._node.set_gaussians(**splats)
        return len(splats["centers"])

    def close(self) -> None:
        """Stops listening."""
        self._server.stop()


def _viser() -> Any:
    try:
        import viser
    except ImportError as error:
        raise InputError('view: wanted the package viser; run: pip install "ssplat-jax[viewer]"') from error
    return viser


def _drawn(gaussians: Gaussians) -> np.ndarray:
    """Which rows can be seen."""
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh[:, 0])
    finite = np.all([np.isfinite(np.asarray(x)).all(axis=1) for x in fields], axis=0)
    return finite & (np.asarray(gaussians.opacities) >= MIN_OPACITY)
