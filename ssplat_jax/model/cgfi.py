"""Cache-Guided Feature Injection (CGFI): adds cached features where the current views are uncertain (Sec. 3.6)."""

from collections.abc import Callable

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.cache.project import ProjectedCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.model.layers import Conv, UNet
from ssplat_jax.model.views import Views


def _copy_first(key, shape, dtype=jnp.float32) -> Array:
    """Kernel that copies the first input channels, at the same place."""
    del key
    height, width, _, features = shape
    copied = jnp.arange(features)
    return jnp.zeros(shape, dtype).at[height // 2, width // 2, copied, copied].set(1.0)


class Aggregator(nn.Module):
    """Phi_agg: a U-Net of f and its hints. Untrained it is the identity, with `residual_cgfi` and without.

    The paper's last layer sees the input beside the U-Net's output, as an outermost skip, and starts as a copy of f.
    That of `residual_cgfi` starts at zero, and f is added to it. So weights that were trained without CGFI keep their
    meaning in both.
    """

    config: StreamConfig

    @nn.compact
    def __call__(
        self, feats: Float[Array, "v hf wf c"], history: Float[Array, "v hf wf ch"], view_valid: Bool[Array, " v"]
    ) -> Float[Array, "v hf wf c"]:
        seen = jnp.concatenate([feats, history], axis=-1)
        x = Conv(self.config.network.cgfi_width, name="enter")(seen)
        x = UNet(self.config.network.cgfi_width, name="unet")(x, view_valid)
        if self.config.additions.residual_cgfi:
            return feats + Conv(feats.shape[-1], kernel_init=nn.initializers.zeros, name="leave")(x)
        return Conv(feats.shape[-1], kernel_init=_copy_first, name="leave")(jnp.concatenate([seen, x], axis=-1))


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

    With `residual_cgfi` the U-Net sees Omega besides (1 - omega) F_H, because a zero feature does not tell a
    hole from a feature.

    Args:
        params: parameters of `Aggregator`.
        feats: token features f of the current views, of any float dtype.
        history: the projected cache: F_H and Omega.
        confidences: omega of the anchored depth; where it is 1 everywhere, the result does not depend on F_H.
        views: the chunk's views.
        config: model configuration.
        bound_history: maps F_H to a bounded size with `unit_features`; see `Network.bound_history`.
    """
    feats = feats.astype(jnp.float32)
    assert history.feats is not None  # `project` gives them where CGFI is on
    remembered = history.feats.astype(jnp.float32)
    if config.additions.unit_features:
        remembered = bound_history(remembered)
    hints = (1 - confidences)[..., None] * remembered
    if config.additions.residual_cgfi:
        hints = jnp.concatenate([hints, history.confidences[..., None]], axis=-1)
    return Aggregator(config).apply({"params": params}, feats, hints, views.valid)  # pyright: ignore[reportReturnType]
