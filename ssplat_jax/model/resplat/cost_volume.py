"""Plane sweep and cost-volume U-Net of ReSplat's network: P_i(k | u) from the chunk alone (Sec. 3.3)."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.cameras import invert_poses, pixel_grid, unproject
from ssplat_jax.core.numerics import bilinear_taps, correlate_warped
from ssplat_jax.model.layers import Conv, HalvingConv, UNetBlock, attend
from ssplat_jax.model.resplat.torch_layers import ReSplatFeatures, group_norm, resize
from ssplat_jax.model.views import MIN_SOURCE_DEPTH, DepthDistribution, Views, mean_over_sources, sweep_pixels

WIDTH = 128  # channels of the U-Net
HEADS = 4  # heads of the joint attention
NAMES = ("in_layers_0", "in_layers_2", "out_layers_0", "out_layers_3", "skip_connection")  # of a block's parameters


def upstream_sweep_pixels(
    views: Views, reference, source, stride: int
) -> tuple[Float[Array, "d n"], Float[Array, "d n"]]:
    """`sweep_pixels` as DepthSplat's code computes it: x and y in samples of the maps, without a visibility test.

    Cells are taken at their upper left corners. DepthSplat also uses the intrinsics of `reference` for both views; that
    is not repeated here, since the published weights do not need it.
    """
    height, width = (side // stride for side in views.images.shape[1:3])
    exact = jax.lax.Precision.HIGHEST
    K, source_K = views.Ks[jnp.stack([reference, source])] * jnp.array([1.0 / stride, 1.0 / stride, 1.0])[:, None]
    corners = pixel_grid(height, width, 1).reshape(-1, 2) - 0.5
    rays = unproject(corners, jnp.ones(len(corners)), K)
    pose = jnp.matmul(views.viewmats[source], invert_poses(views.viewmats[reference]), precision=exact)
    rotated = jnp.einsum("ij,nj->in", pose[:3, :3], rays, precision=exact)
    points = jnp.exp(views.log_candidates)[None, :, None] * rotated[:, None] + pose[:3, 3, None, None]
    x, y, w = jnp.einsum("ij,jdn->idn", source_K, points, precision=exact)
    w = jnp.maximum(w, MIN_SOURCE_DEPTH)
    return x / w, y / w


def plane_sweep(features: ReSplatFeatures, views: Views, config: StreamConfig) -> Float[Array, "v hm wm d"]:
    """Cost volume: mean scaled dot product of each cell with its source views at every candidate.

    The mean is over the valid source views that see the candidate. With `upstream_compat` it is over all valid sources,
    with 0 for those that do not see it, and cells are taken at their corners.

    Limits:
        A candidate that no source sees scores 0.
        Without parallax (equal centers, a pure rotation), a pair of views gives all candidates that it sees one score.
    """
    v, hm, wm, c = features.multiview.shape
    # Samples outside the map are interpolated with zeros.
    padded = jnp.pad(features.multiview, ((0, 0), (1, 1), (1, 1), (0, 0)))

    def correlate_pair(pair):
        reference, source, is_valid = pair
        flat_reference = features.multiview[reference].reshape(-1, c)
        if config.network.upstream_compat:
            x, y = jax.lax.stop_gradient(upstream_sweep_pixels(views, reference, source, config.network.match_stride))
            taps = bilinear_taps(x + 1, y + 1, hm + 2, wm + 2)
            return correlate_warped(flat_reference, padded[source], taps), jnp.broadcast_to(is_valid, x.shape)
        x, y, seen = jax.lax.stop_gradient(sweep_pixels(views, reference, source, config.network.match_stride))
        taps = bilinear_taps(x / config.network.match_stride - 0.5, y / config.network.match_stride - 0.5, hm, wm)
        seen = seen & is_valid
        return jnp.where(seen, correlate_warped(flat_reference, features.multiview[source], taps), 0.0), seen

    mean = mean_over_sources(correlate_pair, views, config).reshape(v, -1, hm, wm)
    return mean.transpose(0, 2, 3, 1) * c**-0.5


class ReSplatJointAttention(nn.Module):
    """Residual self-attention over the cells of all views of a chunk."""

    @nn.compact
    def __call__(self, x: Float[Array, "v h w c"], view_valid: Bool[Array, " v"]) -> Float[Array, "v h w c"]:
        v, h, w, c = x.shape
        normed = group_norm("norm")(x)  # per view, though attention is over all views
        qkv = nn.Dense(3 * c, name="qkv")(normed).reshape(1, v * h * w, HEADS, 3, c // HEADS)
        allowed = jnp.repeat(view_valid, h * w)[None, None]
        mixed = attend(qkv[..., 0, :], qkv[..., 1, :], qkv[..., 2, :], allowed).reshape(v, h, w, c)
        return x + nn.Dense(c, kernel_init=nn.initializers.zeros, name="proj_out")(mixed)


class Downsample(nn.Module):
    """Convolution to half the size."""

    @nn.compact
    def __call__(self, x):
        return HalvingConv(WIDTH, name="op")(x)


class Upsample(nn.Module):
    """Nearest-neighbor upsampling to twice the size, then a convolution."""

    @nn.compact
    def __call__(self, x):
        return Conv(WIDTH, name="conv")(jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2))


class ReSplatUNet(nn.Module):
    """U-Net of three levels with equal width and joint attention at the lowest. Blocks have upstream's numbers."""

    @nn.compact
    def __call__(self, x, view_valid):
        res = lambda name: UNetBlock(WIDTH, NAMES, group_norm, name=name)  # noqa: E731
        joint = lambda name: ReSplatJointAttention(name=name)  # noqa: E731
        x = Conv(WIDTH, name="input_blocks_0_0")(x)
        skips = [x]
        for i, is_downsample in enumerate((False, True, False, True, False), 1):
            x = (Downsample(name=f"input_blocks_{i}_0") if is_downsample else res(f"input_blocks_{i}_0"))(x)
            x = joint(f"input_blocks_{i}_1")(x, view_valid) if i == 5 else x
            skips.append(x)
        x = res("middle_block_2")(res("middle_block_0")(x))
        for i in range(6):
            x = res(f"output_blocks_{i}_0")(jnp.concatenate([x, skips.pop()], axis=-1))
            x = joint(f"output_blocks_{i}_1")(x, view_valid) if i < 2 else x
            x = Upsample(name={1: "output_blocks_1_2", 3: "output_blocks_3_1"}[i])(x) if i in (1, 3) else x
        return Conv(WIDTH, name="out_2")(nn.silu(group_norm("out_0")(x)))


class ReSplatCostVolume(nn.Module):
    """U-Net over [cost, CNN features, multi-view features, monocular features] to logits of the candidates."""

    config: StreamConfig

    @nn.compact
    def __call__(
        self, cost: Float[Array, "v hm wm d"], features: ReSplatFeatures, view_valid: Bool[Array, " v"]
    ) -> DepthDistribution:
        _, hm, wm, _ = cost.shape
        stride = self.config.network.match_stride
        mono = resize(resize(features.mono[-1], hm * stride // 8, wm * stride // 8), hm, wm)
        x = jnp.concatenate([cost, features.cnn[-1], features.multiview, mono], axis=-1)
        y = group_norm("regressor_0_1")(Conv(WIDTH, name="regressor_0_0")(x))
        y = ReSplatUNet(name="regressor_0_3")(nn.gelu(y, approximate=False), view_valid)
        decoder = Conv(WIDTH, name="regressor_0_4")(y) + Conv(WIDTH, 1, name="regressor_residual_0")(x)
        hidden = nn.gelu(Conv(2 * WIDTH, padding="edge", name="depth_head_0_0")(decoder), approximate=False)
        logits = Conv(self.config.network.num_depths, padding="edge", name="depth_head_0_2")(hidden)
        return DepthDistribution(probs=jax.nn.softmax(logits, axis=-1), logits=logits, decoder=decoder)


def match(params, features: ReSplatFeatures, views: Views, config: StreamConfig) -> DepthDistribution:
    """P_i(k | u) on the matching grid by plane sweep, U-Net and softmax, in float32."""
    cost = plane_sweep(features, views, config)
    return ReSplatCostVolume(config).apply({"params": params}, cost, features, views.valid)  # pyright: ignore[reportReturnType]
