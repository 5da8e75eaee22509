"""What the stages of this network share: PyTorch's resizing, and convolutions that ours do not have."""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ssplat_jax.model.convolution import conv2d, pixel_shuffle
from ssplat_jax.pytree import pytree

PIXELS_PER_VIT_CELL = 14


@pytree
class ReSplatFeatures:
    """What the encoder sees. `m` is the match grid's, `p` the ViT's."""

    cnn: tuple[Float[Array, "v h2 w2 c1"], Float[Array, "v h3 w3 c2"], Float[Array, "v hm wm c3"]]
    multiview: Float[Array, "v hm wm c3"]  # after cross-view attention: what the sweep correlates
    mono: tuple[Float[Array, "v hp wp c4"], ...]  # four depths of the ViT


def resize(x: Float[Array, "v h w c"], height: int, width: int) -> Float[Array, "v ho wo c"]:
    """Bilinear, corner samples on corner samples (torch's `align_corners=True`)."""
    rows, columns = _between_corners(x.shape[1], height), _between_corners(x.shape[2], width)
    return jnp.einsum("ph,vhwc,qw->vpqc", rows, x, columns, precision="highest")


def _between_corners(size: int, wanted: int) -> np.ndarray:
    places = np.linspace(0.0, size - 1.0, wanted)
    return np.maximum(0.0, 1.0 - np.abs(places[:, None] - np.arange(size))).astype(np.float32)


class EdgeConv(nn.Module):
    """3 x 3 convolution whose padding repeats the border."""

    features: int

    @nn.compact
    def __call__(self, x: Float[Array, "v h w c"]) -> Float[Array, "v h w o"]:
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (3, 3, x.shape[-1], self.features))
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        padded = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)), mode="edge")
        return conv2d(padded, kernel, ((0, 0), (0, 0))) + bias  # pyright: ignore


class GrowingConv(nn.Module):
    """Transposed convolution whose stride is its kernel's side: every sample becomes a patch of its own."""

    features: int
    factor: int

    @nn.compact
    def __call__(self, x: Float[Array, "v h w c"]) -> Float[Array, "v hf wf o"]:
        shape = (self.factor, self.factor, x.shape[-1], self.features)
        kernel = self.param("kernel", nn.initializers.lecun_normal(), shape)
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        patches = jnp.einsum("vhwc,ijco->vhwoij", x, kernel)
        return pixel_shuffle(patches.reshape(*x.shape[:3], -1), self.factor) + bias  # pyright: ignore


class Mlp(nn.Module):
    """Two layers, four times as wide between."""

    @nn.compact
    def __call__(self, x: Float[Array, "*b c"]) -> Float[Array, "*b c"]:
        c = x.shape[-1]
        return nn.Dense(c, name="fc2")(nn.gelu(nn.Dense(4 * c, name="fc1")(x), approximate=False))
