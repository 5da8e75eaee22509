"""`StreamFrame`: the similarity between the capture's frame and the one the network works in.

    x_stream = scale * R^T (x_capture - t)      R, t: orientation and center of the first camera used

The first camera is the origin and looks along +z, so neither where nor how a capture lies in its world matters; `scale`
makes a voxel and a depth candidate mean the same in every capture. All of it is float64 until the last cast: at
earth-centered coordinates float32 has a step of 0.5 m.
"""

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32, Float64

from ssplat_jax.gaussians import Gaussians
from ssplat_jax.geometry.rotations import matrices_to_quats, multiply_quats
from ssplat_jax.geometry.sh_rotation import sh_rotation

COARSEST_SPACING = 1e-4
"""Stream units between neighboring float32 numbers at the capture's coordinates that still do for its positions."""


@dataclasses.dataclass(frozen=True, eq=False)
class StreamFrame:
    """A similarity, and the depth range of the stream."""

    rotation: Float64[np.ndarray, "3 3"]  # stream axes in the capture frame: the first camera's orientation
    origin: Float64[np.ndarray, "3"]  # capture frame
    scale: float  # stream units per capture unit
    near: float  # nearest depth candidate, stream units
    far: float
    warning: str | None = None  # why scale, near and far may be wrong

    @staticmethod
    def at_camera(
        camtoworld: Float64[np.ndarray, "4 4"], *, scale: float, near: float, far: float, warning: str | None = None
    ) -> "StreamFrame":
        """The frame of a camera of the capture; `near` and `far` in stream units."""
        return StreamFrame(
            rotation=camtoworld[:3, :3].copy(),
            origin=camtoworld[:3, 3].copy(),
            scale=scale,
            near=near,
            far=far,
            warning=warning,
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "rotation": self.rotation.tolist(),
            "origin": self.origin.tolist(),
            "scale": self.scale,
            "near": self.near,
            "far": self.far,
            "warning": self.warning,
        }

    @staticmethod
    def from_dict(fields: dict[str, Any]) -> "StreamFrame":
        """What `to_dict` gave."""
        return StreamFrame(
            rotation=np.array(fields["rotation"]),
            origin=np.array(fields["origin"]),
            scale=fields["scale"],
            near=fields["near"],
            far=fields["far"],
            warning=fields.get("warning"),
        )

    def points_to_stream(self, points: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
        """Capture -> stream."""
        return self.scale * np.einsum("ji,...j->...i", self.rotation, points - self.origin)

    def points_to_capture(self, points: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
        """Stream -> capture: the inverse of `points_to_stream`."""
        return np.einsum("ij,...j->...i", self.rotation, points) / self.scale + self.origin

    def viewmats(self, camtoworlds: Float64[np.ndarray, "*v 4 4"]) -> Float32[np.ndarray, "*v 4 4"]:
        """World-to-camera matrices of the stream for camera-to-world ones of the capture."""
        rotations = np.einsum("...ji,jk->...ik", camtoworlds[..., :3, :3], self.rotation)
        centers = self.points_to_stream(camtoworlds[..., :3, 3])
        viewmats = np.zeros(camtoworlds.shape)
        viewmats[..., :3, :3] = rotations
        viewmats[..., :3, 3] = -np.einsum("...ij,...j->...i", rotations, centers)
        viewmats[..., 3, 3] = 1.0
        return viewmats.astype(np.float32)

    def camtoworlds(self, viewmats: Float64[np.ndarray, "*v 4 4"]) -> Float64[np.ndarray, "*v 4 4"]:
        """Camera-to-world matrices of the capture for world-to-camera ones of the stream."""
        rotations = np.swapaxes(viewmats[..., :3, :3], -1, -2)
        centers = -np.einsum("...ij,...j->...i", rotations, viewmats[..., :3, 3])
        camtoworlds = np.zeros(viewmats.shape)
        camtoworlds[..., :3, :3] = self.rotation @ rotations
        camtoworlds[..., :3, 3] = self.points_to_capture(centers)
        camtoworlds[..., 3, 3] = 1.0
        return camtoworlds

    @property
    def offset(self) -> tuple[float, float, float]:
        """A point of the capture to count positions from: its origin, or, where float32 is too coarse there, the
        stream's, in whole units, or in as many decimals as the scene is small.
        """
        spacing = float(np.spacing(np.float32(np.abs(self.origin).max())))
        is_coarse = spacing * self.scale > COARSEST_SPACING
        decimals = max(0, math.ceil(math.log10(self.scale)))
        x, y, z = (np.round(self.origin, decimals) if is_coarse else np.zeros(3)).tolist()
        return x, y, z

    def gaussians_to_capture(
        self, gaussians: Gaussians, *, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> Gaussians:
        """Gaussians of the stream in the capture's own frame and scale: positions, orientations, sizes and SH bands.

        Positions are counted from `offset`, a point of the capture.

        Limits:
            The result is float32: means 1e5 capture units from `offset` are held to 1e-2 only.
        """
        quat = matrices_to_quats(jnp.asarray(self.rotation, jnp.float32))
        mixing = sh_rotation(self.rotation, gaussians.sh_degree)
        means = self.points_to_capture(np.asarray(gaussians.means, np.float64)) - np.asarray(offset, np.float64)
        return Gaussians(
            means=jnp.asarray(means, jnp.float32),
            quats=multiply_quats(jnp.broadcast_to(quat, gaussians.quats.shape), gaussians.quats),
            scales=gaussians.scales / self.scale,
            opacities=gaussians.opacities,
            sh=jnp.asarray(np.einsum("kl,nlc->nkc", mixing, np.asarray(gaussians.sh, np.float64)), jnp.float32),
        )
