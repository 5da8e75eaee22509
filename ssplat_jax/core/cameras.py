"""Pinhole cameras, in the conventions of `docs/conventions.md`."""

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from ssplat_jax.core.errors import InputError, echo, refusal
from ssplat_jax.core.pytree import pytree, static

ROUNDING = 1e-3  # difference of a rotation's product with its transpose from the identity that counts as rounding

Law = tuple[str, str, bool, Any]
"""A rule for cameras: its words, the remedy, True if a renderer can do without it, and a mask of those that keep it."""


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


def check_camera(camera: Camera, where: str, name: str = "camera", *, complete: bool = False) -> None:
    """Checks the shapes of a camera and, outside of transforms, that it is a rigid pose and a pinhole without skew.

    This is the check of every camera that people give. One that is only to be rendered may have entries that are not
    finite: a camera that was lost sees nothing. One that is to be learned from must be `complete`: finite, not
    mirrored, with focal lengths above 0.

    Raises:
        InputError: naming `where` and the field.
    """
    for field in ("viewmats", "Ks"):
        if not hasattr(getattr(camera, field), "shape"):
            raise InputError(f"{where}: {field} must be an array, got {echo(getattr(camera, field))}; wrap it.")
    poses, intrinsics = camera.viewmats.shape, camera.Ks.shape
    if poses[-2:] != (4, 4) or intrinsics != (*poses[:-2], 3, 3):
        got = f"{list(poses)} and {list(intrinsics)}"
        raise InputError(f"{where}: the {name} must have viewmats [*b 4 4] and Ks [*b 3 3], got {got}.")
    if not all(is_whole(side) and side >= 1 for side in (camera.width, camera.height)):
        got = f"{echo(camera.width)}x{echo(camera.height)}"
        raise InputError(f"{where}: the {name}'s image must have whole numbers of pixels, at least 1x1, got {got}.")
    check_matrices(camera.viewmats, camera.Ks, where, complete=complete)


def check_matrices(viewmats, Ks, where: str, *, complete: bool = False) -> None:
    """Checks the values of poses and intrinsics, in arrays of any kind; traced ones pass. See `check_camera`.

    Raises:
        InputError: naming `where` and the field.
    """
    for field, given, laws in (("Ks", Ks, _intrinsics_laws), ("viewmats", viewmats, _pose_laws)):
        if isinstance(given, Tracer):
            continue
        matrices = np.asarray(given, np.float64)
        is_checked = complete | np.isfinite(matrices).all(axis=(-2, -1))
        with np.errstate(all="ignore"):
            found = laws(matrices, np)
        for wanted, fix, is_strict, is_kept in found:
            is_bad = is_checked & ~np.asarray(is_kept) & (complete or not is_strict)
            if is_bad.any():
                raise refusal(f"{where}: {field}", wanted=wanted, got=echo(matrices[is_bad][0].tolist()), fix=fix)


def usable_cameras(viewmats: Float[Array, "*b 4 4"], Ks: Float[Array, "*b 3 3"]) -> Bool[Array, "*b"]:
    """Cameras that are `complete` for `check_camera`, for use inside jit, where nothing can be raised."""
    laws = (*_intrinsics_laws(Ks, jnp), *_pose_laws(viewmats, jnp))
    return jnp.all(jnp.stack([is_kept for *_, is_kept in laws]), axis=0)


def _intrinsics_laws(Ks, xp: ModuleType) -> tuple[Law, ...]:
    """Laws of intrinsics; a NaN keeps none."""
    fx, fy = Ks[..., 0, 0], Ks[..., 1, 1]
    rest = xp.stack([Ks[..., 0, 1], Ks[..., 1, 0], Ks[..., 2, 0], Ks[..., 2, 1], Ks[..., 2, 2] - 1], axis=-1)
    is_pinhole = (xp.abs(rest) <= 1e-6 * xp.maximum(xp.abs(fx), 1.0)[..., None]).all(axis=-1)
    fix = "divide by K[2, 2], and undistort images of a skewed sensor"
    is_finite = xp.isfinite(Ks).all(axis=(-2, -1))
    return (
        ("[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] without skew", fix, False, is_pinhole),
        ("finite focal lengths above 0", "give them in pixels", True, is_finite & (fx > 0) & (fy > 0)),
    )


def _pose_laws(viewmats, xp: ModuleType) -> tuple[Law, ...]:
    """Laws of poses; a NaN keeps none."""
    rotations = viewmats[..., :3, :3]
    # Sums of products, because a matrix product may round to bfloat16.
    products = (rotations[..., :, None, :] * rotations[..., None, :, :]).sum(axis=-1)
    is_rigid = (xp.abs(products - xp.eye(3)) <= ROUNDING).all(axis=(-2, -1))
    is_rigid = is_rigid & (xp.abs(viewmats[..., 3, :] - xp.eye(4)[3]) <= ROUNDING).all(axis=-1)
    turned = (xp.cross(rotations[..., 0, :], rotations[..., 1, :]) * rotations[..., 2, :]).sum(axis=-1)
    fix = "give world-to-camera matrices, not transposed, without a scale"
    is_finite = xp.isfinite(viewmats).all(axis=(-2, -1))
    return (
        ("[R | t] over 0 0 0 1, R a rotation", fix, False, is_rigid),
        ("a finite pose without reflection", "give right-handed axes", True, is_finite & (turned > 0)),
    )


def is_whole(number: object) -> bool:
    """True if it is a Python or NumPy integer."""
    return isinstance(number, int | np.integer) and not isinstance(number, bool)


def relative_to(camera: Camera, point: tuple[float, float, float]) -> Camera:
    """`camera` in the frame that has its origin at `point`; in float64 outside of transforms."""
    if not any(point):
        return camera
    xp = jnp if isinstance(camera.viewmats, Tracer) else np
    viewmats = xp.asarray(camera.viewmats, None if xp is jnp else np.float64)
    moved = viewmats[..., :3, 3] + viewmats[..., :3, :3] @ xp.asarray(point, viewmats.dtype)
    viewmats = xp.concatenate([viewmats[..., :3], xp.concatenate([moved, viewmats[..., 3, 3:]], -1)[..., None]], -1)
    return Camera(jnp.asarray(viewmats, camera.viewmats.dtype), camera.Ks, camera.width, camera.height)


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


def pixel_grid(height: int, width: int, stride: int = 1) -> Float[Array, "hf wf 2"]:
    """Pixel coordinates (x, y) of the centers of `stride` x `stride` cells of an image."""
    ys = (jnp.arange(height // stride, dtype=jnp.float32) + 0.5) * stride
    xs = (jnp.arange(width // stride, dtype=jnp.float32) + 0.5) * stride
    return jnp.stack(jnp.broadcast_arrays(xs[None, :], ys[:, None]), axis=-1)
