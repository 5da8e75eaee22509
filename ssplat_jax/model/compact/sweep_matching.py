"""Plane sweep and cost-volume U-Net of the compact network: P_i(k | u) from the chunk alone (Sec. 3.3)."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.numerics import safe_normalize
from ssplat_jax.core.sampling import bilinear_taps, correlate_warped
from ssplat_jax.model.compact.compact_layers import CompactFeatures
from ssplat_jax.model.layers import Conv, UNet, average_pool
from ssplat_jax.model.views import GRID_STRIDE, DepthDistribution, Views, mean_over_sources, sweep_pixels


def unit_features(x: Float[Array, "*b c"]) -> Float[Array, "*b c"]:
    """Features of unit length, whose dot products are cosines; zero stays zero."""
    return safe_normalize(x, eps=1e-6)


def plane_sweep(features: CompactFeatures, views: Views, config: StreamConfig) -> Float[Array, "v hf wf dl"]:
    """Cost volume: mean cosine of each cell with its source views at every candidate, at one or two scales.

    The mean is over the valid source views that see the candidate.

    Limits:
        A candidate that no source sees scores 0.
        Without parallax (equal centers, a pure rotation), a pair of views gives all candidates that it sees one score.
        Zero features score 0, equal features 1.
    """
    v, hf, wf = views.inside.shape
    maps = [(GRID_STRIDE, unit_features(features.grid), unit_features(features.grid))]
    if config.network.fine_matching:
        fine = unit_features(features.fine)
        # A cell's center is the common corner of 2 x 2 fine pixels: their mean is the bilinear sample there.
        maps.append((GRID_STRIDE // 2, unit_features(average_pool(features.fine, 2)), fine))

    def correlate_pair(pair):
        reference, source, is_valid = pair
        x, y, seen = jax.lax.stop_gradient(sweep_pixels(views, reference, source, GRID_STRIDE))
        seen = seen & is_valid
        scores = []
        for stride, reference_map, source_map in maps:
            taps = bilinear_taps(x / stride - 0.5, y / stride - 0.5, *source_map.shape[1:3])
            flat_reference = reference_map[reference].reshape(-1, reference_map.shape[-1])
            score = correlate_warped(flat_reference, source_map[source], taps)
            scores.append(jnp.where(seen, score, 0.0))
        return jnp.stack(scores), seen

    return mean_over_sources(correlate_pair, views, config).reshape(v, -1, hf, wf).transpose(0, 2, 3, 1)


class CostVolume(nn.Module):
    """U-Net over [cost, context]. Logits start as the scaled cost, so that an untrained network already matches."""

    config: StreamConfig

    def setup(self):
        width = self.config.network.unet_width
        self.enter = Conv(width)
        self.enter_norm = nn.GroupNorm(8)
        self.unet = UNet(width)
        self.leave = Conv(width)
        self.skip = Conv(width, 1)
        self.head1 = Conv(width)
        self.head2 = Conv(self.config.network.num_depths, kernel_init=nn.initializers.normal(1e-3))
        levels = 2 if self.config.network.fine_matching else 1
        self.log_temperatures = self.param("log_temperatures", nn.initializers.constant(2.0), (levels,))

    def __call__(
        self, cost: Float[Array, "v hf wf dl"], context: Float[Array, "v hf wf c"], view_valid: Bool[Array, " v"]
    ) -> DepthDistribution:
        v, hf, wf, _ = cost.shape
        levels = self.log_temperatures.shape[0]
        scaled = cost.reshape(v, hf, wf, levels, -1) * jnp.exp(self.log_temperatures)[:, None]
        x = jnp.concatenate([scaled.reshape(v, hf, wf, -1), context], axis=-1)
        y = self.unet(nn.gelu(self.enter_norm(self.enter(x))), view_valid)
        decoder = self.leave(y) + self.skip(x)
        logits = scaled.sum(axis=3) + self.head2(nn.gelu(self.head1(decoder)))
        return DepthDistribution(probs=jax.nn.softmax(logits, axis=-1), logits=logits, decoder=decoder)


def match(params, features: CompactFeatures, views: Views, config: StreamConfig) -> DepthDistribution:
    """P_i(k | u) by plane sweep, U-Net and softmax, in float32 for features of any float dtype."""
    features = jax.tree.map(lambda x: x.astype(jnp.float32), features)
    cost = plane_sweep(features, views, config)
    return CostVolume(config).apply({"params": params}, cost, features.context, views.valid)  # pyright: ignore[reportReturnType]
