"""Plane sweep and cost-volume U-Net: P_i(k | u), what the chunk alone says of depth (Sec. 3.3; ALGORITHM 2.5-2.7)."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.geometry.sampling import correlate_warped, places_of
from ssplat_jax.model.convolution import Conv, HalvingConv
from ssplat_jax.model.layers import attend
from ssplat_jax.model.plane_sweep import sweep_pixels, upstream_sweep_pixels
from ssplat_jax.model.resplat.swin_layers import EdgeConv, ReSplatFeatures, resize
from ssplat_jax.model.types import DepthBelief, Views, nearest_sources

WIDTH = 128
HEADS = 4


def plane_sweep(features: ReSplatFeatures, views: Views, config: StreamConfig) -> Float[Array, "v hm wm d"]:
    """Mean scaled product of each cell with its source views at every candidate.

    Views outside the image, behind the source camera or padded do not count; a cell that no source sees scores 0. With
    `upstream_compat` all sources count, what they do not see as 0, and pixels are taken for their corners.

    Limits:
        Without parallax (equal centers, a pure rotation) a pair of views scores all candidates that it sees alike.
    """
    v, hm, wm, c = features.multiview.shape
    sources, source_valid = nearest_sources(views.viewmats, views.valid, config.network.num_sources)
    # A sample beyond the border is mixed with the zeros of a frame around the map.
    framed = jnp.pad(features.multiview, ((0, 0), (1, 1), (1, 1), (0, 0)))

    def correlate_pair(pair):
        reference, source, is_valid = pair
        flat_reference = features.multiview[reference].reshape(-1, c)
        if config.network.upstream_compat:
            x, y = jax.lax.stop_gradient(upstream_sweep_pixels(views, reference, source, config.network.match_stride))
            places = places_of(x + 1, y + 1, hm + 2, wm + 2)
            return correlate_warped(flat_reference, framed[source], places), jnp.broadcast_to(is_valid, x.shape)
        x, y, seen = jax.lax.stop_gradient(sweep_pixels(views, reference, source, config.network.match_stride))
        places = places_of(x / config.network.match_stride - 0.5, y / config.network.match_stride - 0.5, hm, wm)
        seen = seen & is_valid
        return jnp.where(seen, correlate_warped(flat_reference, features.multiview[source], places), 0.0), seen

    num_sources = sources.shape[1]
    pairs = (jnp.repeat(jnp.arange(v), num_sources), sources.reshape(-1), source_valid.reshape(-1))
    scores, seen = jax.lax.map(correlate_pair, pairs)
    shape = (v, num_sources, config.network.num_depths, hm, wm)
    counts = seen.astype(jnp.float32).reshape(shape).sum(axis=1)
    mean = scores.reshape(shape).sum(axis=1) / jnp.maximum(counts, 1.0)
    return mean.transpose(0, 2, 3, 1) * c**-0.5


class ResBlock(nn.Module):
    """GroupNorm - SiLU - conv twice; the last convolution starts at zero."""

    @nn.compact
    def __call__(self, x):
        norm = lambda name: nn.GroupNorm(8, epsilon=1e-5, use_fast_variance=False, name=name)  # noqa: E731
        y = Conv(WIDTH, name="in_layers_2")(nn.silu(norm("in_layers_0")(x)))
        y = nn.silu(norm("out_layers_0")(y))
        y = Conv(WIDTH, kernel_init=nn.initializers.zeros, name="out_layers_3")(y)
        return (x if x.shape[-1] == WIDTH else Conv(WIDTH, 1, name="skip_connection")(x)) + y


class JointAttention(nn.Module):
    """Self-attention over the cells of all views of the chunk together."""

    @nn.compact
    def __call__(self, x: Float[Array, "v h w c"], view_valid: Bool[Array, " v"]) -> Float[Array, "v h w c"]:
        v, h, w, c = x.shape
        normed = nn.GroupNorm(8, epsilon=1e-5, use_fast_variance=False, name="norm")(x)  # view by view
        qkv = nn.Dense(3 * c, name="qkv")(normed).reshape(1, v * h * w, HEADS, 3, c // HEADS)
        allowed = jnp.repeat(view_valid, h * w)[None, None]
        mixed = attend(qkv[..., 0, :], qkv[..., 1, :], qkv[..., 2, :], allowed).reshape(v, h, w, c)
        return x + nn.Dense(c, kernel_init=nn.initializers.zeros, name="proj_out")(mixed)


class Shrink(nn.Module):
    """To half the size."""

    @nn.compact
    def __call__(self, x):
        return HalvingConv(WIDTH, name="op")(x)


class Grow(nn.Module):
    """To twice the size."""

    @nn.compact
    def __call__(self, x):
        return Conv(WIDTH, name="conv")(jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2))


class UNet(nn.Module):
    """Three levels of equal width, joint attention at the lowest; blocks are numbered as upstream does."""

    @nn.compact
    def __call__(self, x, view_valid):
        res = lambda name: ResBlock(name=name)  # noqa: E731
        joint = lambda name: JointAttention(name=name)  # noqa: E731
        x = Conv(WIDTH, name="input_blocks_0_0")(x)
        skips = [x]
        for i, shrinks in enumerate((False, True, False, True, False), 1):
            x = (Shrink(name=f"input_blocks_{i}_0") if shrinks else res(f"input_blocks_{i}_0"))(x)
            x = joint(f"input_blocks_{i}_1")(x, view_valid) if i == 5 else x
            skips.append(x)
        x = res("middle_block_2")(res("middle_block_0")(x))
        for i in range(6):
            x = res(f"output_blocks_{i}_0")(jnp.concatenate([x, skips.pop()], axis=-1))
            x = joint(f"output_blocks_{i}_1")(x, view_valid) if i < 2 else x
            x = Grow(name={1: "output_blocks_1_2", 3: "output_blocks_3_1"}[i])(x) if i in (1, 3) else x
        norm = nn.GroupNorm(8, epsilon=1e-5, use_fast_variance=False, name="out_0")
        return Conv(WIDTH, name="out_2")(nn.silu(norm(x)))


class CostVolume(nn.Module):
    """U-Net over [cost, CNN, multi-view and monocular features], and the logits of the candidates."""

    config: StreamConfig

    @nn.compact
    def __call__(
        self, cost: Float[Array, "v hm wm d"], features: ReSplatFeatures, view_valid: Bool[Array, " v"]
    ) -> DepthBelief:
        _, hm, wm, _ = cost.shape
        mono = resize(
            features.mono[-1], hm * self.config.network.match_stride // 8, wm * self.config.network.match_stride // 8
        )
        mono = resize(mono, hm, wm)
        x = jnp.concatenate([cost, features.cnn[-1], features.multiview, mono], axis=-1)
        y = Conv(WIDTH, name="regressor_0_0")(x)
        y = nn.GroupNorm(8, epsilon=1e-5, use_fast_variance=False, name="regressor_0_1")(y)
        y = UNet(name="regressor_0_3")(nn.gelu(y, approximate=False), view_valid)
        y = Conv(WIDTH, name="regressor_0_4")(y)
        decoder = y + Conv(WIDTH, 1, name="regressor_residual_0")(x)
        hidden = nn.gelu(EdgeConv(2 * WIDTH, name="depth_head_0_0")(decoder), approximate=False)
        logits = EdgeConv(self.config.network.num_depths, name="depth_head_0_2")(hidden)
        return DepthBelief(probs=jax.nn.softmax(logits, axis=-1), logits=logits, decoder=decoder)


def match(params, features: ReSplatFeatures, views: Views, config: StreamConfig) -> DepthBelief:
    """P_i(k | u) on the match grid by plane sweep, U-Net and softmax, in float32."""
    cost = plane_sweep(features, views, config)
    return CostVolume(config).apply({"params": params}, cost, features, views.valid)  # pyright: ignore[reportReturnType]
