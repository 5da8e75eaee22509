"""ReSplat's network, which the paper builds on: with parameters named as its PyTorch modules."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.config import StreamConfig
from ssplat_jax.model.layers import rms_normalize
from ssplat_jax.model.mixer import Mixer
from ssplat_jax.model.resplat.cost_volume import ReSplatCostVolume, match
from ssplat_jax.model.resplat.encoder import VITS, WIDTHS, ReSplatEncoder, encode, grid_size
from ssplat_jax.model.resplat.resplat_tokens import (
    ReSplatGaussianHead,
    ReSplatTokenRegressor,
    Upsampler,
    read_shapes,
    refine_depth,
    regress_tokens,
)
from ssplat_jax.model.resplat.torch_layers import ReSplatFeatures


def stages(config: StreamConfig) -> dict:
    """Linen module and example inputs of every stage."""
    v, side, stride = 2, config.network.size_multiple, config.network.match_stride
    c, mono_width = config.network.token_width, VITS[config.network.vit][0]
    at = lambda stride, channels: jnp.zeros((v, side // stride, side // stride, channels))  # noqa: E731
    vit_map = jnp.zeros((v, *grid_size(side, side), mono_width))
    cnn = (at(2, WIDTHS[0]), at(stride // 2, WIDTHS[1]), at(stride, WIDTHS[2]))
    features = ReSplatFeatures(cnn=cnn, multiview=cnn[-1], mono=(vit_map,) * 4)
    sources, valid = jnp.zeros((v, 1), jnp.int32), jnp.ones(v, bool)
    context = at(4, sum(WIDTHS) + WIDTHS[2] + mono_width // 4)
    inside = jnp.ones((v, side // 4, side // 4), bool)
    return {
        "encoder": (ReSplatEncoder(config), (at(1, 3), sources, valid[:, None])),
        "cost_volume": (ReSplatCostVolume(config), (at(stride, config.network.num_depths), features, valid)),
        "upsampler": (Upsampler(config), (features, at(stride, 1)[..., 0], side, side)),
        "tokens": (ReSplatTokenRegressor(config), (at(4, 48), at(4, 1), at(4, 1), context)),
        "mixer": (Mixer(config), (at(4, c), at(4, 3), inside, valid)),
        "decoder": (ReSplatGaussianHead(config), (jnp.zeros((1, c)),)),
    }


def mix_tokens(params, feats, positions, inside, view_valid, config: StreamConfig) -> Float[Array, "v hf wf c"]:
    """Mixed token features, for the head and the cache: the mixer's output is added to its input."""
    if not config.network.mixer_blocks:
        return feats
    mixed = Mixer(config).apply({"params": params}, feats, positions, inside, view_valid)
    return feats + mixed  # pyright: ignore[reportOperatorIssue]


class ReSplatNetwork:
    """The stages of ReSplat's network; fulfils `ssplat_jax.model.network.Network`."""

    stages = staticmethod(stages)
    encode = staticmethod(encode)
    match = staticmethod(match)
    refine_depth = staticmethod(refine_depth)
    regress_tokens = staticmethod(regress_tokens)
    bound_history = staticmethod(lambda feats: rms_normalize(feats))  # features of this network have no bound
    mix_tokens = staticmethod(mix_tokens)
    read_shapes = staticmethod(read_shapes)
