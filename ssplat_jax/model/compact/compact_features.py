"""Features that the stages of the compact network exchange."""

from jaxtyping import Array, Float

from ssplat_jax.core.pytree import pytree


@pytree
class CompactFeatures:
    """Output of the encoder."""

    fine: Float[Array, "v h2 w2 cm"]  # matching features at 1/2 of the padded image
    grid: Float[Array, "v hf wf cm"]  # matching features at 1/4, after cross-view attention
    context: Float[Array, "v hf wf c"]  # CNN and multi-view features at 1/4
