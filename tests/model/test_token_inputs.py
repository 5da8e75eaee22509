"""Token features of the compact network: depth and confidence enter as hints that pass no gradient."""

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.model.compact import CompactFeatures, regress_tokens
from ssplat_jax.model.views import AnchoredDepth, DepthDistribution, prepare_views
from tests.model.small import CONFIG, chunk, params


def test_depth_hints_pass_no_gradient_but_are_used():
    rng = np.random.default_rng(0)
    views = prepare_views(chunk(), CONFIG)
    grid = views.inside.shape
    draw = lambda *shape: jnp.asarray(rng.uniform(size=shape), jnp.float32)  # noqa: E731
    network = CONFIG.network
    features = CompactFeatures(
        fine=draw(3, 2 * grid[1], 2 * grid[2], network.match_width),
        grid=draw(*grid, network.match_width),
        context=draw(*grid, 2 * network.encoder_widths[1]),
    )
    probs = draw(*grid, network.num_depths)
    distribution = DepthDistribution(probs=probs, logits=probs, decoder=draw(*grid, network.unet_width))

    @jax.jit
    def tokens_and_slopes(log_depths, confidences, context):
        def total(log_depths, confidences, context):
            depth = AnchoredDepth(probs, log_depths, confidences, confidences)
            seen = CompactFeatures(features.fine, features.grid, context)
            feats = regress_tokens(params()["tokens"], seen, distribution, depth, views, CONFIG)
            return jnp.sum(jnp.sin(3 * feats)), feats

        slopes, feats = jax.grad(total, argnums=(0, 1, 2), has_aux=True)(log_depths, confidences, context)
        return feats, slopes

    depths, confidences = draw(*grid), draw(*grid)
    feats, (by_depth, by_confidence, by_context) = tokens_and_slopes(depths, confidences, features.context)
    assert not by_depth.any() and not by_confidence.any() and by_context.any()
    assert np.any(tokens_and_slopes(depths + 0.3, confidences, features.context)[0] != feats)
    assert np.any(tokens_and_slopes(depths, 0.5 * confidences, features.context)[0] != feats)
