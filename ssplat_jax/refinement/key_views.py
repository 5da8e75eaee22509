"""Views that refinement compares the scene with."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt8

from ssplat_jax.geometry.cameras import Camera
from ssplat_jax.pytree import pytree


@pytree
class KeyViews:
    """`v` 8-bit images with their cameras, in the frame of the scene."""

    images: UInt8[Array, "v h w 3"]
    viewmats: Float[Array, "v 4 4"]  # world -> camera
    Ks: Float[Array, "v 3 3"]  # pixels
    exposures: Float[Array, "v 3"]  # factors from the scene's colors to the view's
    valid: Bool[Array, " v"]  # False: an empty slot

    @property
    def num_slots(self) -> int:
        """Views that there is space for, empty slots included."""
        return self.images.shape[0]

    def camera(self, index) -> Camera:
        """Camera of the view at `index`, which may be traced."""
        height, width = self.images.shape[1:3]
        return Camera(viewmats=self.viewmats[index], Ks=self.Ks[index], width=width, height=height)

    @staticmethod
    def of(camera: Camera, images: Float[Array, "v h w 3"], exposures: Float[Array, "v 3"] | None = None) -> "KeyViews":
        """Key views from a batch of cameras and images in [0, 1]; without `exposures` all are 1."""
        return KeyViews(
            images=jnp.round(jnp.clip(images, 0.0, 1.0) * 255).astype(jnp.uint8),
            viewmats=camera.viewmats,
            Ks=camera.Ks,
            exposures=jnp.ones((images.shape[0], 3)) if exposures is None else exposures,
            valid=jnp.ones(images.shape[0], bool),
        )
