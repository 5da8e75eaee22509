"""Cache-Guided Feature Injection (CGFI): adds cached features where the current views are uncertain (Sec. 3.6)."""

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
    """Phi_agg: a U-Net whose output is added to f. The output starts at zero, so untrained CGFI is the identity."""

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
    """Token features with history injected (Eqs. cache_feature_attenuation, token_regressor_input).

    The U-Net sees Omega besides (1 - omega) F_H, because a zero feature does not tell a hole from a feature.

    Args:
        params: parameters of `Aggregator`.
        feats: token features f of the current views, of any float dtype.
        history: the projected cache: F_H and Omega.
        confidences: omega of the anchored depth.
        views: the chunk's views.
        config: `history.cgfi=False` returns `feats` unchanged.
        bound_history: maps F_H to a bounded size; see `Network.bound_history`.

    Returns:
        Features in float32. Where omega = 1 they do not depend on F_H.
    """
    if not config.history.cgfi:
        return feats
    feats = feats.astype(jnp.float32)
    remembered = bound_history(history.feats.astype(jnp.float32))
    attenuated = (1 - confidences)[..., None] * remembered
    hints = jnp.concatenate([attenuated, history.confidences[..., None]], axis=-1)
    return Aggregator(config).apply({"params": params}, feats, hints, views.valid)  # pyright: ignore[reportReturnType]
