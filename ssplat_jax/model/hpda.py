"""History-Projected Depth Anchoring: cached geometry as a Gaussian anchor over depth candidates (Sec. 3.5, HPDA)."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.cache import ProjectedCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.model.types import AnchoredDepth, DepthBelief, Views, from_candidate_space, to_candidate_space
from ssplat_jax.numerics import safe_log, softplus_inverse

MIN_SIGMA = 1e-6
"""Narrower anchors are all alike, one candidate or none; a width of zero would divide by zero."""


class AnchorStrength(nn.Module):
    """gamma_d = softplus(raw), the one learnable scalar of HPDA."""

    config: StreamConfig

    @nn.compact
    def __call__(self) -> Float[Array, ""]:
        raw = self.param("raw_gamma", nn.initializers.constant(softplus_inverse(self.config.history.gamma_init)), ())
        return nn.softplus(raw)


def cache_anchor(
    history: ProjectedCache, log_candidates: Float[Array, " d"], config: StreamConfig
) -> Float[Array, "v hf wf d"]:
    """P_H of Eq. cache_depth_prior.

    Limits:
        Zeros where the cache has a hole, and for Omega = 0.
        sigma is at least 1e-6. sigma -> 0: Omega at the candidate that equals D_H, zeros where none does.
    """
    omega = history.confidences[..., None]
    sigma = jnp.maximum(config.history.sigma0 + config.history.lambda_sigma * (1 - omega), MIN_SIGMA)
    if config.history.anchor_space == "log":
        offsets = log_candidates - safe_log(history.depths)[..., None]
    else:
        offsets = jnp.exp(log_candidates) - history.depths[..., None]
    anchor = jnp.exp(-0.5 * (offsets / sigma) ** 2)
    if config.history.anchor_norm == "mass":
        anchor = anchor / jnp.maximum(anchor.sum(axis=-1, keepdims=True), 1e-12)
    return jnp.where(history.mask[..., None], omega * anchor, 0.0)


def inject_anchor(
    probs: Float[Array, "*b d"], anchor: Float[Array, "*b d"], gamma: Float[Array, ""]
) -> Float[Array, "*b d"]:
    """P^v of Eq. cache_prior_injection; `probs` sum to 1, so only the anchor's mass is left to divide by.

    Limits:
        gamma = 0, and an anchor of zeros: `probs`, bit for bit.
        gamma -> inf: the anchor, scaled to mass 1.
    """
    return (probs + gamma * anchor) / (1 + gamma * anchor.sum(axis=-1, keepdims=True))


def peak_confidence(probs: Float[Array, "*b d"], config: StreamConfig) -> Float[Array, "*b"]:
    """omega: the peak of a distribution, or the largest mass of a few neighboring candidates.

    Limits:
        At most 1, which a one-hot distribution gives, and one of a single candidate.
    """
    if config.depth.confidence == "peak":
        return probs.max(axis=-1)
    width = 2 * config.depth.confidence_window + 1
    cumulative = jnp.cumsum(jnp.pad(probs, [(0, 0)] * (probs.ndim - 1) + [(width, width - 1)]), axis=-1)
    return jnp.clip((cumulative[..., width:] - cumulative[..., :-width]).max(axis=-1), 0.0, 1.0)


def expected_log_depth(
    probs: Float[Array, "*b d"], log_candidates: Float[Array, " d"], config: StreamConfig
) -> Float[Array, "*b"]:
    """Eq. base_depth_regression, in the space of the candidates (DESIGN 6.3).

    Limits:
        A one-hot distribution, at either end too, gives its candidate, bit for bit. A single candidate is the depth
        whatever was matched, with a zero gradient.
        `depth_readout="window"` looks around the nearest of equal peaks.
    """
    if config.depth.depth_readout == "window":
        distance = jnp.abs(jnp.arange(probs.shape[-1]) - jnp.argmax(probs, axis=-1)[..., None])
        probs = jnp.where(distance <= config.depth.readout_window, probs, 0.0)
        probs = probs / probs.sum(axis=-1, keepdims=True)
    candidates = to_candidate_space(log_candidates, config)
    return from_candidate_space(jnp.einsum("...d,d->...", probs, candidates, precision="highest"), config)


def anchor_depth(
    params, belief: DepthBelief, history: ProjectedCache, views: Views, config: StreamConfig
) -> AnchoredDepth:
    """Fuses the matcher's distribution with the cache's anchor and reads depth and confidences."""
    probs = belief.probs
    if config.history.hpda:
        gamma = AnchorStrength(config).apply({"params": params})
        probs = inject_anchor(probs, cache_anchor(history, views.log_candidates, config), gamma)  # pyright: ignore[reportArgumentType]
    return AnchoredDepth(
        probs=probs,
        log_depths=expected_log_depth(probs, views.log_candidates, config),
        matcher_confidences=peak_confidence(belief.probs, config),
        anchored_confidences=peak_confidence(probs, config),
    )
