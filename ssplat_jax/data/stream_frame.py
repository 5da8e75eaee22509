"""`StreamFrame`: the similarity transform from the frame of the capture to the frame of the network.

    x_stream = scale * R^T (x_capture - t)      R, t: orientation and center of the first camera used

The first camera is at the origin and looks along +z, so results do not depend on the position and orientation of the
capture in its world. `scale` gives voxels and depth candidates the same meaning in every capture. Computations are
float64 up to the final cast, because float32 has a spacing of 0.5 m at earth-centered coordinates.
"""

import dataclasses
import math
from typing import Any

import jax
import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial.transform import Rotation

from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.core.rotations import sh_rotation

MAX_COORDINATE_SPACING = 1e-4
"""Largest float32 spacing, in stream units, at which positions are stored without an offset."""


@dataclasses.dataclass(frozen=True, eq=False)
class StreamFrame:
    """Similarity transform between capture and stream, and the depth range of the stream."""

    rotation: Float64[np.ndarray, "3 3"]  # stream axes in the capture frame, the orientation of the first camera
    origin: Float64[np.ndarray, "3"]  # center of the first camera in the capture frame
    scale: float  # stream units per capture unit
    near: float  # nearest depth candidate, stream units
    far: float  # farthest depth candidate, stream units
    warning: str | None = None  # reason why scale, near and far may be wrong

    @staticmethod
    def at_camera(
        camtoworld: Float64[np.ndarray, "4 4"], *, scale: float, near: float, far: float, warning: str | None = None
    ) -> "StreamFrame":
        """The stream frame whose origin is a camera of the capture, with the other fields as given."""
        return StreamFrame(camtoworld[:3, :3].copy(), camtoworld[:3, 3].copy(), scale, near, far, warning)

    @staticmethod
    def at_point(point: tuple[float, float, float]) -> "StreamFrame":
        """The frame with the axes and units of the capture whose origin is a point of it."""
        camtoworld = np.eye(4)
        camtoworld[:3, 3] = point
        return StreamFrame.at_camera(camtoworld, scale=1.0, near=0.0, far=math.inf)

    def to_dict(self) -> dict[str, Any]:
        """The fields as plain JSON types; the inverse is `from_dict`."""
        fields = dataclasses.asdict(self)
        return fields | {"rotation": self.rotation.tolist(), "origin": self.origin.tolist()}

    @staticmethod
    def from_dict(fields: dict[str, Any]) -> "StreamFrame":
        """The stream frame of the fields that `to_dict` gave."""
        arrays: dict[str, Any] = {name: np.array(fields[name]) for name in ("rotation", "origin")}
        return StreamFrame(**fields | arrays)

    def points_to_stream(self, points: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
        """Transforms points from the capture frame to the stream frame."""
        return self.scale * np.einsum("ji,...j->...i", self.rotation, points - self.origin)

    def points_to_capture(self, points: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
        """Transforms points from the stream frame to the capture frame."""
        return np.einsum("ij,...j->...i", self.rotation, points) / self.scale + self.origin

    def viewmats(self, camtoworlds: Float64[np.ndarray, "*v 4 4"]) -> Float32[np.ndarray, "*v 4 4"]:
        """Converts camera-to-world matrices of the capture to world-to-camera matrices of the stream."""
        rotations = np.einsum("...ji,jk->...ik", camtoworlds[..., :3, :3], self.rotation)
        centers = self.points_to_stream(camtoworlds[..., :3, 3])
        viewmats = np.zeros(camtoworlds.shape)
        viewmats[..., :3, :3] = rotations
        viewmats[..., :3, 3] = -np.einsum("...ij,...j->...i", rotations, centers)
        viewmats[..., 3, 3] = 1.0
        return viewmats.astype(np.float32)

    @property
    def depth_range(self) -> tuple[float, float]:
        """`near` and `far`."""
        return self.near, self.far

    @property
    def offset(self) -> tuple[float, float, float]:
        """Point of the capture frame to which exported positions are relative.

        It is zero unless float32 is too coarse for the capture's coordinates: viewers add no offset. Then it is the
        origin of the stream, rounded to whole units, or to more decimals if the scene is smaller than a unit.
        """
        spacing = float(np.spacing(np.float32(np.abs(self.origin).max())))
        is_coarse = spacing * self.scale > MAX_COORDINATE_SPACING
        decimals = max(0, math.ceil(math.log10(self.scale)))
        x, y, z = (np.round(self.origin, decimals) if is_coarse else np.zeros(3)).tolist()
        return x, y, z

    def gaussians_to_capture(self, gaussians: Gaussians) -> Gaussians:
        """Transforms Gaussians from the stream frame to the capture frame: means, quaternions, scales and SH bands.

        Means of the result are relative to its offset, `self.offset`.

        Limits:
            The result is float32: means 1e5 capture units from the offset have an error of up to 1e-2.
        """
        # On the host, where no program has to be compiled for each size of a scene.
        fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh)
        means, quats, scales, sh = (np.asarray(x, np.float64) for x in fields)
        w, x, y, z = Rotation.from_matrix(self.rotation).as_quat(scalar_first=True, canonical=True)
        product = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])  # Hamilton's, from the left
        rows = {
            "means": self.points_to_capture(means) - np.asarray(self.offset),
            "quats": quats @ product.T,
            "scales": scales / self.scale,
            "sh": np.einsum("kl,nlc->nkc", sh_rotation(self.rotation, gaussians.sh_degree), sh),
        }
        rows = jax.device_put({name: x.astype(np.float32) for name, x in rows.items()})
        return replace(gaussians, **rows, offset=self.offset)
