"""Features and layers that the stages of ReSplat's network share, computed as in PyTorch."""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ssplat_jax.core.pytree import pytree
from ssplat_jax.model.layers import pixel_shuffle


@pytree
class ReSplatFeatures:
    """Output of the encoder's three branches."""

    cnn: tuple[Float[Array, "v h2 w2 c1"], Float[Array, "v h3 w3 c2"], Float[Array, "v hm wm c3"]]
    multiview: Float[Array, "v hm wm c3"]  # after cross-view attention; the plane sweep correlates these
    mono: tuple[Float[Array, "v hp wp c4"], ...]  # maps of four ViT blocks; `hp wp` are the cells of the ViT


def group_norm(name: str) -> nn.GroupNorm:
    """GroupNorm of 8 groups with PyTorch's epsilon and two-pass variance."""
    return nn.GroupNorm(8, epsilon=1e-5, use_fast_variance=False, name=name)


def resize(x: Float[Array, "v h w c"], height: int, width: int) -> Float[Array, "v ho wo c"]:
    """Map resized bilinearly with corner samples aligned (PyTorch's `align_corners=True`)."""
    rows, columns = _resize_weights(x.shape[1], height), _resize_weights(x.shape[2], width)
    return jnp.einsum("ph,vhwc,qw->vpqc", rows, x, columns, precision="highest")


def _resize_weights(size: int, new_size: int) -> np.ndarray:
    positions = np.linspace(0.0, size - 1.0, new_size)
    return np.maximum(0.0, 1.0 - np.abs(positions[:, None] - np.arange(size))).astype(np.float32)


class TransposedConv(nn.Module):
    """Transposed convolution with a stride equal to the kernel's side: each sample becomes one patch."""

    features: int
    factor: int

    @nn.compact
    def __call__(self, x: Float[Array, "v h w c"]) -> Float[Array, "v hf wf o"]:
        shape = (self.factor, self.factor, x.shape[-1], self.features)
        kernel = self.param("kernel", nn.initializers.lecun_normal(), shape)
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        patches = jnp.einsum("vhwc,ijco->vhwoij", x, kernel)
        return pixel_shuffle(patches.reshape(*x.shape[:3], -1), self.factor) + bias  # pyright: ignore
