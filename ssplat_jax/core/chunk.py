"""`Chunk`: the input of one streaming step, a few posed views."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError, refusal
from ssplat_jax.core.pytree import pytree


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
    seen: Bool[Array, "*t v h w"] | None = (
        None  # False: pixels that are masked out, which give no tokens; None: all count
    )

    @property
    def camera(self) -> Camera:
        """The cameras of the views, as one batch."""
        height, width = self.images.shape[-3:-1]
        return Camera(viewmats=self.viewmats, Ks=self.Ks, width=width, height=height)


def check_chunk(chunk: Chunk, num_views: int, *, stacked: bool = False) -> None:
    """Checks precision, shapes and type of images of one chunk, or of several in one, of tracers too.

    Args:
        chunk: without leading axes, or with one if `stacked`.
        num_views: views that a chunk must hold, padding included.
        stacked: all fields have a leading axis, the same for all.

    Raises:
        InputError: naming the field of a wrong shape; images are not floats, or JAX computes in float64.
    """
    if jnp.result_type(float) != jnp.float32:
        fix = "stream inside `with jax.enable_x64(False):`"
        raise refusal("chunk", wanted="JAX's default, float32", got="float64 (jax_enable_x64)", fix=fix)
    if not jnp.issubdtype(jnp.result_type(chunk.images), jnp.floating):
        got, fix = str(jnp.result_type(chunk.images)), "divide bytes by 255"
        raise refusal("chunk: images", wanted="floats in [0, 1]", got=got, fix=fix)
    v, leading = num_views, jnp.shape(chunk.images)[:1] if stacked else ()
    shapes = {"images": (v, "h", "w", 3), "viewmats": (v, 4, 4), "Ks": (v, 3, 3), "valid": (v,), "near": (), "far": ()}
    if chunk.seen is not None:
        shapes["seen"] = (v, *jnp.shape(chunk.images)[-3:-1])
    fix = f" Chunks have {v} views (`stream.chunk_size`): pad a short one with views whose `valid` is False."
    if stacked:
        fix = " Stack chunks along a leading axis t, one for all fields."
    for name, of_one in shapes.items():
        got, wanted = jnp.shape(getattr(chunk, name)), (*leading, *of_one)
        if len(got) != len(wanted) or any(isinstance(w, int) and w != g for w, g in zip(wanted, got, strict=True)):
            sizes = " ".join(map(str, ("t", *of_one) if stacked else of_one))
            raise InputError(f"chunk: {name} must be [{sizes}], got {list(got)}.{fix if wanted else ''}")
