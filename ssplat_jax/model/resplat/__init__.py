"""ReSplat's network, which the paper builds on, a stage a file. Parameters have the names of its PyTorch modules."""

import jax.numpy as jnp

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.resplat.cost_volume import CostVolume
from ssplat_jax.model.resplat.cost_volume import match as match
from ssplat_jax.model.resplat.encoder import WIDTHS, Encoder
from ssplat_jax.model.resplat.encoder import encode as encode
from ssplat_jax.model.resplat.head import GaussianHead
from ssplat_jax.model.resplat.head import read_shapes as read_shapes
from ssplat_jax.model.resplat.layers import ReSplatFeatures
from ssplat_jax.model.resplat.mixer import Mixer
from ssplat_jax.model.resplat.mixer import mix_tokens as mix_tokens
from ssplat_jax.model.resplat.tokens import TokenRegressor
from ssplat_jax.model.resplat.tokens import regress_tokens as regress_tokens
from ssplat_jax.model.resplat.upsampler import Upsampler
from ssplat_jax.model.resplat.upsampler import refine_depth as refine_depth
from ssplat_jax.model.resplat.vit import VITS, grid_size


def modules(config: StreamConfig) -> dict:
    """Every stage with parameters of its own, and inputs of the shapes that it takes."""
    v, side, stride = 2, config.size_multiple, config.match_stride
    c, mono_width = config.token_width, VITS[config.vit][0]
    at = lambda stride, channels: jnp.zeros((v, side // stride, side // stride, channels))  # noqa: E731
    vit_map = jnp.zeros((v, *grid_size(side, side), mono_width))
    features = ReSplatFeatures(
        cnn=(at(2, WIDTHS[0]), at(stride // 2, WIDTHS[1]), at(stride, WIDTHS[2])),
        multiview=at(stride, WIDTHS[2]),
        mono=(vit_map,) * 4,
    )
    sources, valid = jnp.zeros((v, 1), jnp.int32), jnp.ones(v, bool)
    context = at(4, sum(WIDTHS) + WIDTHS[2] + mono_width // 4)
    inside = jnp.ones((v, side // 4, side // 4), bool)
    return {
        "encoder": (Encoder(config), (at(1, 3), sources, valid[:, None])),
        "cost_volume": (CostVolume(config), (at(stride, config.num_depths), features, valid)),
        "upsampler": (Upsampler(config), (features, at(stride, 1)[..., 0], side, side)),
        "tokens": (TokenRegressor(config), (at(4, 48), at(4, 1), at(4, 1), context)),
        "mixer": (Mixer(config), (at(4, c), at(4, 3), inside, valid)),
        "decoder": (GaussianHead(config), (jnp.zeros((1, c)),)),
    }
