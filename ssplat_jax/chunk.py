"""`Chunk`: the input of one streaming step, a few posed views."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.errors import InputError
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


def check_chunk(chunk: Chunk, num_views: int) -> None:
    """Checks the shapes of one chunk, of tracers too.

    Args:
        chunk: without leading axes.
        num_views: views that it must hold, padding included.

    Raises:
        InputError: naming the field of a wrong shape.
    """
    v = num_views
    shapes = {"images": (v, "h", "w", 3), "viewmats": (v, 4, 4), "Ks": (v, 3, 3), "valid": (v,), "near": (), "far": ()}
    for name, wanted in shapes.items():
        got = jnp.shape(getattr(chunk, name))
        if len(got) != len(wanted) or any(isinstance(w, int) and w != g for w, g in zip(wanted, got, strict=True)):
            fix = f" Chunks have {v} views (`stream.chunk_size`): pad a short one with views whose `valid` is False."
            sizes = " ".join(map(str, wanted))
            raise InputError(f"chunk: {name} must be [{sizes}], got {list(got)}.{fix if wanted else ''}")
