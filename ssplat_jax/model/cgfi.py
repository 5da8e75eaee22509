"""Cache-Guided Feature Injection: cached features where local evidence is weak (Sec. 3.6, CGFI)."""

from collections.abc import Callable

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.cache import ProjectedCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.model.convolution import Conv
from ssplat_jax.model.layers import UNet
from ssplat_jax.model.types import Views


class Aggregator(nn.Module):
    """Phi_agg: a U-Net whose output, zero at the start, is added to f: before training, CGFI is the identity."""

    config: StreamConfig

    @nn.compact
    def __call__(
        self, feats: Float[Array, "v hf wf c"], history: Float[Array, "v hf wf ch"], view_valid: Bool[Array, " v"]
    ) -> Float[Array, "v hf wf c"]:
        x = Conv(self.config.history.cgfi_width, name="enter")(jnp.concatenate([feats, history], axis=-1))
        x = UNet(self.config.history.cgfi_width, name="unet")(x, view_valid)
        return feats + Conv(feats.shape[-1], kernel_init=nn.initializers.zeros, name="leave")(x)


def inject_features(
    params,
    feats: Float[Array, "v hf wf c"],
    history: ProjectedCache,
    confidences: Float[Array, "v hf wf"],
    views: Views,
    config: StreamConfig,
    bound_history: Callable[[Array], Array] = lambda feats: feats,
) -> Float[Array, "v hf wf c"]:
    """Eq. cache_feature_attenuation and token_regressor_input.

    Besides (1 - omega) F_H the U-Net sees Omega, because a zero feature alone does not tell a hole from a feature.

    Limits:
        omega = 1: F_H is not heard. Features of any precision are injected in float32.
    """
    if not config.history.cgfi:
        return feats
    feats = feats.astype(jnp.float32)
    remembered = bound_history(history.feats.astype(jnp.float32))
    attenuated = (1 - confidences)[..., None] * remembered
    hints = jnp.concatenate([attenuated, history.confidences[..., None]], axis=-1)
    return Aggregator(config).apply({"params": params}, feats, hints, views.valid)  # pyright: ignore[reportReturnType]
