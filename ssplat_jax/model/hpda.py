"""History-Projected Depth Anchoring (HPDA): cached geometry as a Gaussian prior over depth candidates (Sec. 3.5)."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.cache import ProjectedCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.numerics import safe_log, softplus_inverse
from ssplat_jax.model.views import AnchoredDepth, DepthDistribution, Views, from_candidate_space, to_candidate_space

GAMMA_INIT = 0.1
"""Untrained gamma_d, for which the paper gives no value."""
SIGMA_SURE = 0.1
"""sigma_0, the paper's value: standard deviation of the anchor where Omega is 1, in its unit (`log_anchor`)."""
SIGMA_GROWTH = 0.5
"""lambda_sigma, the paper's value: what the standard deviation grows by as Omega falls from 1 to 0."""
READOUT_WINDOW = 4
"""Candidates on each side of the peak that `depth_readout="window"` averages."""
CONFIDENCE_WINDOW = 1
"""Candidates on each side whose mass is the confidence with `depth_readout="window"`. A depth that is known exactly,
but lies halfway between two candidates, has a peak of only 0.5."""


class AnchorStrength(nn.Module):
    """gamma_d = softplus(raw), the one learnable scalar of HPDA."""

    @nn.compact
    def __call__(self) -> Float[Array, ""]:
        raw = self.param("raw_gamma", nn.initializers.constant(softplus_inverse(GAMMA_INIT)), ())
        return nn.softplus(raw)


def cache_anchor(
    history: ProjectedCache, log_candidates: Float[Array, " d"], config: StreamConfig
) -> Float[Array, "v hf wf d"]:
    """The anchor P_H over the candidates (Eq. cache_depth_prior).

    Limits:
        Holes of the cache and Omega = 0 give zeros.
    """
    omega = history.confidences[..., None]
    sigma = SIGMA_SURE + SIGMA_GROWTH * (1 - omega)
    if config.additions.log_anchor:
        offsets = log_candidates - safe_log(history.depths)[..., None]
    else:
        offsets = jnp.exp(log_candidates) - history.depths[..., None]
    anchor = jnp.exp(-0.5 * (offsets / sigma) ** 2)
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
    """Confidence omega: the peak of a distribution, or with `depth_readout="window"` the largest mass of neighbors.

    Limits:
        At most 1; a one-hot distribution and a single candidate give 1.
    """
    if config.additions.depth_readout != "window":
        return probs.max(axis=-1)
    width = 2 * CONFIDENCE_WINDOW + 1
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
    if config.additions.depth_readout == "metric":
        return jnp.log(jnp.einsum("...d,d->...", probs, jnp.exp(log_candidates), precision="highest"))
    if config.additions.depth_readout == "window":
        distance = jnp.abs(jnp.arange(probs.shape[-1]) - jnp.argmax(probs, axis=-1)[..., None])
        probs = jnp.where(distance <= READOUT_WINDOW, probs, 0.0)
        probs = probs / probs.sum(axis=-1, keepdims=True)
    candidates = to_candidate_space(log_candidates, config)
    return from_candidate_space(jnp.einsum("...d,d->...", probs, candidates, precision="highest"), config)


def anchor_depth(
    params, distribution: DepthDistribution, history: ProjectedCache, views: Views, config: StreamConfig
) -> AnchoredDepth:
    """Depth and confidences read from the matcher's distribution and the cache's anchor, all on the matching grid.

    `history.hpda=False` leaves the matcher's distribution as it is.
    """
    probs = distribution.probs
    if config.history.hpda:
        gamma = AnchorStrength().apply({"params": params})
        probs = inject_anchor(probs, cache_anchor(history, views.log_candidates, config), gamma)  # pyright: ignore[reportArgumentType]
    return AnchoredDepth(
        probs=probs,
        log_depths=expected_log_depth(probs, views.log_candidates, config),
        matcher_confidences=peak_confidence(distribution.probs, config),
        anchored_confidences=peak_confidence(probs, config),
    )
