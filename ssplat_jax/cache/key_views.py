"""Views that refinement compares the scene with, and the ring in which a stream keeps them."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from ssplat_jax.core.cameras import Camera, usable_cameras
from ssplat_jax.core.pytree import pytree

NUM_KEY_VIEWS = 64  # views that a stream keeps to compare the scene with


@pytree
class KeyViews:
    """`v` 8-bit images with their cameras, in the frame of the scene.

    Images have a fourth channel where pixels may be masked out: 0 for those that nothing is learned from.
    """

    images: UInt8[Array, "v h w c"]
    viewmats: Float[Array, "v 4 4"]  # world -> camera
    Ks: Float[Array, "v 3 3"]  # pixels
    exposures: Float[Array, "v 3"]  # factors from the scene's colors to the view's
    valid: Bool[Array, " v"]  # False: an empty slot

    @property
    def num_slots(self) -> int:
        """Views that there is space for, empty slots included."""
        return self.images.shape[0]

    @property
    def colors(self) -> Float[Array, "*v h w 3"]:
        """The images in [0, 1]."""
        return self.images[..., :3].astype(jnp.float32) / 255

    @property
    def seen(self) -> Bool[Array, "*v h w"] | None:
        """The pixels that are not masked out; None if no image can have any."""
        return self.images[..., 3] > 0 if self.images.shape[-1] > 3 else None

    def at(self, slot) -> "KeyViews":
        """The view in one slot, which may be traced, without a batch axis."""
        return jax.tree.map(lambda x: x[slot], self)

    def camera(self, index: Any = ...) -> Camera:
        """Camera of the view at `index`, which may be traced; by default of all views, or of a view without an axis."""
        height, width = self.images.shape[-3:-1]
        return Camera(viewmats=self.viewmats[index], Ks=self.Ks[index], width=width, height=height)

    @staticmethod
    def of(
        camera: Camera,
        images: Float[Array | np.ndarray, "v h w 3"] | UInt8[Array | np.ndarray, "v h w 3"],
        exposures: Float[Array | np.ndarray, "v 3"] | None = None,
        seen: Bool[Array | np.ndarray, "v h w"] | None = None,
    ) -> "KeyViews":
        """Key views from a batch of cameras and images, floats in [0, 1] or uint8; without `exposures` all are 1.

        `seen` is False for pixels that are masked out.
        """
        if images.dtype != jnp.uint8:
            images = jnp.round(jnp.clip(images, 0.0, 1.0) * 255).astype(jnp.uint8)
        if seen is not None:
            images = jnp.concatenate([images, seen[..., None].astype(jnp.uint8)], axis=-1)
        exposures = np.ones((len(images), 3)) if exposures is None else exposures
        return KeyViews(
            images=jnp.asarray(images),
            viewmats=jnp.asarray(camera.viewmats, jnp.float32),
            Ks=jnp.asarray(camera.Ks, jnp.float32),
            exposures=jnp.asarray(exposures, jnp.float32),
            valid=jnp.ones(images.shape[0], bool),
        )


def empty_key_views(num_slots: int, height: int, width: int, channels: int = 3) -> KeyViews:
    """`num_slots` empty slots for images of one size; four channels hold masks too."""
    return KeyViews(
        images=jnp.zeros((num_slots, height, width, channels), jnp.uint8),
        viewmats=jnp.zeros((num_slots, 4, 4)),
        Ks=jnp.zeros((num_slots, 3, 3)),
        exposures=jnp.zeros((num_slots, 3)),
        valid=jnp.zeros((num_slots,), bool),
    )


def keep_views(ring: KeyViews, arrivals: KeyViews, *, depth: float) -> KeyViews:
    """`ring` after views arrived, one after the other.

    While there are empty slots, a view takes the first. Afterwards a view that is no farther from a stored one than
    the two most alike are from each other is left out. Any other view takes the place of one of these two: the one
    whose next camera is nearer, or that of the lower slot. So the stored views only move apart, and they cover where
    the camera has been, however long the stream is and however long the camera stands still.

    Args:
        ring: the views so far.
        arrivals: new views of the same size; those that are not `usable` are left out.
        depth: typical depth of the scene: a move by it counts as much as a turn by one radian.
    """

    def keep(ring: KeyViews, arrival: tuple[KeyViews, Array]):
        view, is_usable = arrival
        slot = jnp.where(is_usable, _slot_for(ring, view, depth), ring.num_slots)
        return jax.tree.map(lambda all_views, x: all_views.at[slot].set(x, mode="drop"), ring, view), None

    return jax.lax.scan(keep, ring, (arrivals, usable(arrivals)))[0]


def usable(views: KeyViews) -> Bool[Array, " v"]:
    """Valid views with a camera that can be used (`core.cameras.check_camera`) and a finite, positive exposure."""
    is_exposed = jnp.all((views.exposures > 0) & (views.exposures < jnp.inf), axis=1)
    return views.valid & is_exposed & usable_cameras(views.viewmats, views.Ks)


def _slot_for(ring: KeyViews, view: KeyViews, depth: float) -> Int[Array, ""]:
    """The slot that a usable view takes; `num_slots` if it is left out."""
    valid = jnp.append(ring.valid, True)
    distances = camera_distances(jnp.concatenate([ring.viewmats, view.viewmats[None]]), depth)
    is_pair = valid[:, None] & valid & ~jnp.eye(len(valid), dtype=bool)
    distances = jnp.where(is_pair, distances, jnp.inf)
    kept = jnp.sort(distances[:-1, :-1], axis=1)
    first = kept[:, 0]
    second = kept[:, 1] if ring.num_slots > 1 else first
    most_alike = jnp.argmin(jnp.where(first == jnp.min(first), second, jnp.inf))
    is_kept = (jnp.min(distances[-1]) > jnp.min(first)) | (ring.num_slots == 1)
    slot = jnp.where(jnp.all(ring.valid), jnp.where(is_kept, most_alike, ring.num_slots), jnp.argmin(ring.valid))
    return slot.astype(jnp.int32)


def camera_distances(viewmats: Float[Array, "n 4 4"], depth: float) -> Float[Array, "n n"]:
    """Separation of views: the distance of their centers over `depth`, plus 2 sin(angle / 2) of their rotations."""
    rotations = viewmats[:, :3, :3]
    centers = -jnp.einsum("nji,nj->ni", rotations, viewmats[:, :3, 3])
    length = lambda x: jnp.sqrt(jnp.sum(x * x, axis=-1))  # noqa: E731
    turns = (rotations[:, None] - rotations).reshape(len(viewmats), len(viewmats), 9)
    return length(centers[:, None] - centers) / depth + length(turns) / math.sqrt(2)
