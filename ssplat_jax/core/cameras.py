"""Pinhole cameras, in the conventions of `ssplat_jax.core.conventions`."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.core.pytree import pytree, static


@pytree
class Camera:
    """One pinhole camera, or a batch of cameras with one image size.

    Leading axes of `viewmats` and `Ks` agree.

    Example:
        >>> camera = Camera(viewmats=viewmats, Ks=Ks, width=640, height=480)
    """

    viewmats: Float[Array, "*b 4 4"]  # world -> camera
    Ks: Float[Array, "*b 3 3"]  # in pixels; the principal point may lie anywhere
    width: int = static()
    height: int = static()

    @property
    def camtoworlds(self) -> Float[Array, "*b 4 4"]:
        """Camera-to-world transforms."""
        return invert_poses(self.viewmats)

    @property
    def centers(self) -> Float[Array, "*b 3"]:
        """Camera centers in world coordinates."""
        return self.camtoworlds[..., :3, 3]

    def __getitem__(self, idx) -> "Camera":
        """Camera or cameras at `idx` of a batch."""
        return Camera(viewmats=self.viewmats[idx], Ks=self.Ks[idx], width=self.width, height=self.height)


def invert_poses(poses: Float[Array, "*b 4 4"]) -> Float[Array, "*b 4 4"]:
    """Inverses of rigid transforms, by transposing the rotation."""
    rotations = jnp.swapaxes(poses[..., :3, :3], -1, -2)
    translations = -jnp.einsum("...ij,...j->...i", rotations, poses[..., :3, 3], precision=jax.lax.Precision.HIGHEST)
    bottom = jnp.broadcast_to(jnp.array([0, 0, 0, 1], poses.dtype), (*poses.shape[:-2], 1, 4))
    return jnp.concatenate([jnp.concatenate([rotations, translations[..., None]], axis=-1), bottom], axis=-2)


def transform_points(poses: Float[Array, "*#b 4 4"], points: Float[Array, "*#b n 3"]) -> Float[Array, "*#b n 3"]:
    """Points after rigid transforms; leading axes broadcast."""
    rotated = jnp.einsum("...ij,...nj->...ni", poses[..., :3, :3], points, precision=jax.lax.Precision.HIGHEST)
    return rotated + poses[..., None, :3, 3]


def unproject(
    pixels: Float[Array, "*b n 2"], depths: Float[Array, "*b n"], Ks: Float[Array, "*b 3 3"]
) -> Float[Array, "*b n 3"]:
    """Camera-frame points at depth z = `depths` on the rays through `pixels` (x, y)."""
    x = (pixels[..., 0] - Ks[..., None, 0, 2]) / Ks[..., None, 0, 0]
    y = (pixels[..., 1] - Ks[..., None, 1, 2]) / Ks[..., None, 1, 1]
    return jnp.stack([x * depths, y * depths, depths], axis=-1)


def project_points(
    points: Float[Array, "*#b n 3"], Ks: Float[Array, "*#b 3 3"], min_depth: float = 1e-6
) -> tuple[Float[Array, "*#b n 2"], Float[Array, "*#b n"]]:
    """Pixels (x, y) and depths z of camera-frame points; leading axes broadcast.

    Limits:
        Depths below `min_depth` are divided as `min_depth`; callers mask such points by the returned depth.
    """
    depths = points[..., 2]
    safe = jnp.maximum(depths, min_depth)
    u = Ks[..., None, 0, 0] * points[..., 0] / safe + Ks[..., None, 0, 2]
    v = Ks[..., None, 1, 1] * points[..., 1] / safe + Ks[..., None, 1, 2]
    return jnp.stack([u, v], axis=-1), depths


def pixel_grid(height: int, width: int, stride: int = 1) -> Float[Array, "hf wf 2"]:
    """Pixel coordinates (x, y) of the centers of `stride` x `stride` cells of an image."""
    ys = (jnp.arange(height // stride, dtype=jnp.float32) + 0.5) * stride
    xs = (jnp.arange(width // stride, dtype=jnp.float32) + 0.5) * stride
    return jnp.stack(jnp.broadcast_arrays(xs[None, :], ys[:, None]), axis=-1)
