"""`Chunk`: the input of one streaming step, a few posed views."""

from jaxtyping import Array, Bool, Float

from ssplat_jax.geometry.cameras import Camera
from ssplat_jax.pytree import pytree


@pytree
class Chunk:
    """`v` posed views in the stream frame, in order of arrival.

    A short last chunk is padded with views whose `valid` is False; these have no effect on any result.
    """

    images: Float[Array, "*t v h w 3"]  # RGB in [0, 1]
    viewmats: Float[Array, "*t v 4 4"]  # world -> camera, stream frame
    Ks: Float[Array, "*t v 3 3"]  # pixels
    valid: Bool[Array, "*t v"]  # False for padding
    near: Float[Array, "*t"]  # nearest depth candidate, stream units
    far: Float[Array, "*t"]  # farthest depth candidate, stream units

    @property
    def camera(self) -> Camera:
        """The cameras of the views, as one batch."""
        height, width = self.images.shape[-3:-1]
        return Camera(viewmats=self.viewmats, Ks=self.Ks, width=width, height=height)
