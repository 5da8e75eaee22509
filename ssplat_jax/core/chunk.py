"""`Chunk`: the input of one streaming step, a few posed views."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from ssplat_jax.core.cameras import Camera, check_matrices, usable_cameras
from ssplat_jax.core.errors import InputError, refusal
from ssplat_jax.core.pytree import pytree

COLOR_MARGIN = 1e-3  # largest distance of a color from [0, 1] that counts as rounding or resampling


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
    seen: Bool[Array, "*t v h w"] | None = None  # False for masked pixels, which give no tokens; None: all count
    depths: Float[Array, "*t v h w"] | None = None  # measured camera z, stream units, 0 where unknown; None: no sensor

    @property
    def camera(self) -> Camera:
        """The cameras of the views, as one batch."""
        height, width = self.images.shape[-3:-1]
        return Camera(viewmats=self.viewmats, Ks=self.Ks, width=width, height=height)


def check_images(images: object, where: str) -> None:
    """Checks images on the host. The step, `push` and refinement share it.

    Raises:
        InputError: the values are no floats, not finite, or outside [0, 1].
    """
    values = np.asarray(images)
    is_float = jnp.issubdtype(values.dtype, jnp.floating)
    if not (is_float and (values.size == 0 or -COLOR_MARGIN <= values.min() <= values.max() <= 1 + COLOR_MARGIN)):
        got, fix = f"{values.dtype} from {values.min()} to {values.max()}", "divide bytes by 255"
        raise refusal(where, wanted="floats in [0, 1]", got=got, fix=fix)


def usable_views(chunk: Chunk) -> Bool[Array, " v"]:
    """Valid views of a chunk whose camera and image pass `check_chunk`, for use inside jit."""
    low, high = chunk.images.min(axis=(1, 2, 3)), chunk.images.max(axis=(1, 2, 3))
    is_image = (low >= -COLOR_MARGIN) & (high <= 1 + COLOR_MARGIN)  # a NaN is neither
    return chunk.valid & is_image & usable_cameras(chunk.viewmats, chunk.Ks)


def usable_range(near, far):
    """True if depths can be searched between `near` and `far`: positive, finite and in order."""
    return (near > 0) & (near <= far) & (far < np.inf)


def check_chunk(chunk: Chunk, num_views: int, *, stacked: bool = False) -> None:
    """Checks precision, shapes and type of images of one chunk, or of several in one; outside jit also the values.

    Inside jit nothing is raised for a value: `StreamSplat.step` leaves out the views that are not `usable_views`, or
    all without a `usable_range`, and counts them.

    Args:
        chunk: without leading axes, or with one if `stacked`.
        num_views: views that a chunk must hold, padding included.
        stacked: all fields have a leading axis, the same for all.

    Raises:
        InputError: naming the field of a wrong shape; images are not floats, or JAX computes in float64; or a valid
            view has a camera or an image that cannot be used, or near and far are not positive, finite and in order.
    """
    if jnp.result_type(float) != jnp.float32:
        fix = "stream inside `with jax.enable_x64(False):`"
        raise refusal("chunk", wanted="JAX's default, float32", got="float64 (jax_enable_x64)", fix=fix)
    if not jnp.issubdtype(jnp.result_type(chunk.images), jnp.floating):
        got, fix = str(jnp.result_type(chunk.images)), "divide bytes by 255"
        raise refusal("chunk: images", wanted="floats in [0, 1]", got=got, fix=fix)
    v, leading = num_views, jnp.shape(chunk.images)[:1] if stacked else ()
    shapes = {"images": (v, "h", "w", 3), "viewmats": (v, 4, 4), "Ks": (v, 3, 3), "valid": (v,), "near": (), "far": ()}
    for name in ("seen", "depths"):
        if getattr(chunk, name) is not None:
            shapes[name] = (v, *jnp.shape(chunk.images)[-3:-1])
    fix = f" Chunks have {v} views (`stream.chunk_size`): pad a short one with views whose `valid` is False."
    if stacked:
        fix = " Stack chunks along a leading axis t, one for all fields."
    for name, of_one in shapes.items():
        got, wanted = jnp.shape(getattr(chunk, name)), (*leading, *of_one)
        if len(got) != len(wanted) or any(isinstance(w, int) and w != g for w, g in zip(wanted, got, strict=True)):
            sizes = " ".join(map(str, ("t", *of_one) if stacked else of_one))
            raise InputError(f"chunk: {name} must be [{sizes}], got {list(got)}.{fix if wanted else ''}")
    if any(isinstance(x, Tracer) for x in jax.tree.leaves(chunk)):
        return
    valid, near, far = (np.asarray(x) for x in (chunk.valid, chunk.near, chunk.far))
    if not valid.any():
        return
    viewmats, Ks, images = (np.asarray(x)[valid] for x in (chunk.viewmats, chunk.Ks, chunk.images))
    check_matrices(viewmats, Ks, "chunk", complete=True)
    check_images(images, "chunk: images")
    if not np.all(usable_range(near, far)):
        got, fix = f"{near.tolist()} and {far.tolist()}", "give the range of depths in stream units"
        raise refusal("chunk: near and far", wanted="0 < near <= far < inf", got=got, fix=fix)
