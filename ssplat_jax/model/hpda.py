"""History-Projected Depth Anchoring (HPDA): cached geometry as a Gaussian prior over depth candidates (Sec. 3.5)."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.cache import ProjectedCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.numerics import safe_log, softplus_inverse
from ssplat_jax.core.pytree import replace
from ssplat_jax.model.types import AnchoredDepth, DepthDistribution, Views, from_candidate_space, to_candidate_space

RECALL_MARGIN = 0.1
"""Confidence of recalled tokens above `min_confidence`. Their history must be surer, so that a recalled depth is not
recalled again before other views have confirmed it."""
RECALL_WINDOW = 2
"""Candidates on each side of the cache's depth that count as support for it."""
RECALL_SUPPORT = 0.2
"""Least probability that the matcher gives to the candidates around a recalled depth."""
MIN_SIGMA = 1e-6
"""Smallest width of the anchor. A narrower one would select one candidate or none, and zero would divide by zero."""


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
    """The anchor P_H over the candidates (Eq. cache_depth_prior).

    Limits:
        Holes of the cache and Omega = 0 give zeros.
        As sigma -> 0 (it is at least `MIN_SIGMA`), the anchor is Omega at the candidate that equals D_H, else zero.
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
    """The anchored distribution P^v (Eq. cache_prior_injection); `probs` must sum to 1.

    Limits:
        gamma = 0 or an anchor of zeros gives `probs`, bit for bit.
        gamma -> inf gives the anchor, scaled to mass 1.
    """
    return (probs + gamma * anchor) / (1 + gamma * anchor.sum(axis=-1, keepdims=True))


def peak_confidence(probs: Float[Array, "*b d"], config: StreamConfig) -> Float[Array, "*b"]:
    """Confidence omega: the peak of a distribution, or the largest mass of a window of neighboring candidates.

    Limits:
        At most 1; a one-hot distribution and a single candidate give 1.
    """
    if config.depth.confidence == "peak":
        return probs.max(axis=-1)
    width = 2 * config.depth.confidence_window + 1
    cumulative = jnp.cumsum(jnp.pad(probs, [(0, 0)] * (probs.ndim - 1) + [(width, width - 1)]), axis=-1)
    return jnp.clip((cumulative[..., width:] - cumulative[..., :-width]).max(axis=-1), 0.0, 1.0)


def expected_log_depth(
    probs: Float[Array, "*b d"], log_candidates: Float[Array, " d"], config: StreamConfig
) -> Float[Array, "*b"]:
    """Log of the expected depth (Eq. base_depth_regression): of the metric depths, or in the space of the candidates.

    Limits:
        A one-hot distribution gives its candidate, bit for bit (`metric`: to rounding). A single candidate gives its
        depth, with a zero gradient.
        Among equal peaks, `depth_readout="window"` takes the first.
    """
    if config.depth.depth_readout == "metric":
        return jnp.log(jnp.einsum("...d,d->...", probs, jnp.exp(log_candidates), precision="highest"))
    if config.depth.depth_readout == "window":
        distance = jnp.abs(jnp.arange(probs.shape[-1]) - jnp.argmax(probs, axis=-1)[..., None])
        probs = jnp.where(distance <= config.depth.readout_window, probs, 0.0)
        probs = probs / probs.sum(axis=-1, keepdims=True)
    candidates = to_candidate_space(log_candidates, config)
    return from_candidate_space(jnp.einsum("...d,d->...", probs, candidates, precision="highest"), config)


def recall_depth(
    depth: AnchoredDepth,
    probs: Float[Array, "v hm wm d"],
    history: ProjectedCache,
    log_candidates: Float[Array, " d"],
    config: StreamConfig,
) -> AnchoredDepth:
    """`depth`, with the cache's depth where the matcher is unsure and the cache is sure (an addition to Sec. 3.5).

    Without it, tokens of such cells are dropped, because their confidence is below `min_confidence`. With it they lie
    on the cache's surface and have a confidence `RECALL_MARGIN` above that bound, if the matcher gives that depth
    `RECALL_SUPPORT` at least.

    Args:
        depth: depths and confidences read from the anchored distribution.
        probs: the matcher's distribution P_i.
        history: the projected cache, on the matching grid.
        log_candidates: log depths of the candidates.
        config: model configuration.

    Limits:
        Holes of the cache, cells of a history that is no surer than the new confidence, lies outside the candidates or
        has too little support, and cells that the matcher is sure of keep depth and confidence, bit for bit. A recalled
        depth has no gradient.
    """
    confidence = config.memory.min_confidence + RECALL_MARGIN
    log_depths = safe_log(history.depths)
    is_recalled = history.mask & (history.confidences > confidence)
    nearest = jnp.argmin(jnp.abs(log_candidates - log_depths[..., None]), axis=-1)
    is_near = jnp.abs(jnp.arange(probs.shape[-1]) - nearest[..., None]) <= RECALL_WINDOW
    is_recalled &= (log_depths >= log_candidates.min()) & (log_depths <= log_candidates.max())
    is_recalled &= jnp.where(is_near, probs, 0.0).sum(axis=-1) >= RECALL_SUPPORT
    is_recalled &= depth.matcher_confidences < config.memory.min_confidence
    return replace(
        depth,
        log_depths=jnp.where(is_recalled, log_depths, depth.log_depths),
        matcher_confidences=jnp.where(is_recalled, confidence, depth.matcher_confidences),
    )


def anchor_depth(
    params, distribution: DepthDistribution, history: ProjectedCache, views: Views, config: StreamConfig
) -> AnchoredDepth:
    """Depth and confidences read from the matcher's distribution and the cache's anchor.

    Args:
        params: parameters of `AnchorStrength`.
        distribution: distribution P_i of the matcher, on the matching grid.
        history: the projected cache, on the matching grid.
        views: the chunk's views.
        config: `history.hpda=False` leaves the matcher's distribution as it is; `history.recall` adds `recall_depth`.
    """
    probs = distribution.probs
    if config.history.hpda:
        gamma = AnchorStrength(config).apply({"params": params})
        probs = inject_anchor(probs, cache_anchor(history, views.log_candidates, config), gamma)  # pyright: ignore[reportArgumentType]
    depth = AnchoredDepth(
        probs=probs,
        log_depths=expected_log_depth(probs, views.log_candidates, config),
        matcher_confidences=peak_confidence(distribution.probs, config),
        anchored_confidences=peak_confidence(probs, config),
    )
    if config.history.recall:
        return recall_depth(depth, distribution.probs, history, views.log_candidates, config)
    return depth
