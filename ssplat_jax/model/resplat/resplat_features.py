"""Features that the stages of ReSplat's network exchange."""

from jaxtyping import Array, Float

from ssplat_jax.core.pytree import pytree


@pytree
class ReSplatFeatures:
    """Output of the encoder's three branches."""

    cnn: tuple[Float[Array, "v h2 w2 c1"], Float[Array, "v h3 w3 c2"], Float[Array, "v hm wm c3"]]
    multiview: Float[Array, "v hm wm c3"]  # after cross-view attention; the plane sweep correlates these
    mono: tuple[Float[Array, "v hp wp c4"], ...]  # maps of four ViT blocks; `hp wp` are the cells of the ViT
