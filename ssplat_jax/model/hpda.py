"""History-Projected Depth Anchoring (HPDA): cached geometry as a Gaussian prior over depth candidates (Sec. 3.5).

The paper has one strength gamma for all anchors. With `additions.anchor="learned"` a small network gives each cell its
own strength, width and place of the anchor: it sees what matcher and cache say of the cell and its neighbors. Depths
that a sensor measured, where a chunk brings them, anchor the distribution in the same form (ours).
"""

import math

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.cache.project import ProjectedCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.numerics import safe_log, softplus_inverse
from ssplat_jax.core.pytree import pytree, replace
from ssplat_jax.model.layers import Conv, average_pool, rms_normalize
from ssplat_jax.model.views import AnchoredDepth, DepthDistribution, Views, from_candidate_space, to_candidate_space

GAMMA_INIT = 0.1  # untrained gamma_d, for which the paper gives no value
SIGMA_SURE = 0.1
"""sigma_0, the paper's value: standard deviation of the anchor where Omega is 1, in its unit (`additions.anchor`)."""
SIGMA_GROWTH = 0.5  # lambda_sigma, the paper's value: what the standard deviation grows by as Omega falls from 1 to 0
READOUT_WINDOW = 4  # candidates on each side of the peak that `depth_readout="window"` averages
CONFIDENCE_WINDOW = 1
"""Candidates on each side whose mass is the confidence with `depth_readout="window"`. A depth that is known exactly,
but lies halfway between two candidates, has a peak of only 0.5."""

SENSOR_WIDTH = 0.6
"""Standard deviation of a sensor's anchor, in steps between candidates. A sensor's own error is smaller than a step; a
narrower anchor would put a depth between two candidates onto one of them."""
SENSOR_GAMMA = 10.0  # weight of a sensor's anchor: about 94 % of the mass where it contradicts the matcher
MIN_STEP = 1e-6  # smallest step between candidates, for a single one and near = far
MIN_KNOWN = 0.5
"""Share of a cell's pixels whose depth must be measured. At the rims of what a sensor saw, its depths are mixtures."""


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
    if config.additions.anchor != "metric":
        offsets = log_candidates - safe_log(history.depths)[..., None]
    else:
        offsets = jnp.exp(log_candidates) - history.depths[..., None]
    anchor = jnp.exp(-0.5 * (offsets / sigma) ** 2)
    return jnp.where(history.mask[..., None], omega * anchor, 0.0)


# -- The learned anchor (ours) -----------------------------------------------------------------------------------------

WIDTH, BLOCKS = 32, 3  # channels and residual blocks of the network: a cell sees 13 x 13 cells
AROUND = 6  # candidates on each side of a depth at which the network reads the matcher's distribution
MIN_PROB = 1e-5  # probabilities are read, and trained, from here on
MAX_SHIFT = 2.0  # largest shift of an anchor, in steps between candidates
LOG_WIDTHS = (-1.0, 2.0)  # bounds of the log of an anchor's standard deviation in steps


@pytree
class AnchorInputs:
    """Input of the learned anchor on the matching grid; no gradient flows back from it."""

    features: Float[Array, "*b hm wm c"]  # what matcher and cache say of a cell, as numbers of about unit size
    probs: Float[Array, "*b hm wm d"]  # the matcher's distribution
    places: Float[Array, "*b hm wm"]  # of the cached depths among the candidates; 0 in holes
    mask: Bool[Array, "*b hm wm"]  # False in holes of the cache


class AnchorMaps(nn.Module):
    """Strength, log width and shift of the anchor in each cell, all three constant before training."""

    @nn.compact
    def __call__(self, x: Float[Array, "v hm wm c"]) -> Float[Array, "v hm wm 3"]:
        x = Conv(WIDTH, 1, name="enter")(x)
        for i in range(BLOCKS):
            y = Conv(WIDTH, name=f"block{i}_conv1")(nn.silu(x))
            x = x + Conv(WIDTH, name=f"block{i}_conv2")(nn.silu(y))
        return Conv(3, 1, kernel_init=nn.initializers.zeros, name="out")(nn.silu(x))


def num_inputs(config: StreamConfig) -> int:
    """Number of features of `AnchorInputs`."""
    return config.network.decoder_width + 2 * (2 * AROUND + 1) + 13


def anchor_inputs(
    distribution: DepthDistribution, history: ProjectedCache, views: Views, config: StreamConfig
) -> AnchorInputs:
    """Facts about each cell, of the matcher alone and of the cache beside it.

    Colors are compared after their mean difference in a view is taken out, since exposures are not known yet.

    Limits:
        In holes of the cache everything that it says is 0.
    """
    probs, num = distribution.probs, len(views.log_candidates)
    candidates = to_candidate_space(views.log_candidates, config)
    step = (candidates[-1] - candidates[0]) / max(num - 1, 1)
    step = jnp.where(jnp.abs(step) < MIN_STEP, MIN_STEP, step)
    place = lambda log_depths: (to_candidate_space(log_depths, config) - candidates[0]) / step  # noqa: E731
    is_known = history.mask[..., None]
    matched = place(expected_log_depth(probs, views.log_candidates, config))[..., None]
    cached = place(jnp.where(history.mask, safe_log(history.depths), views.log_candidates[0]))[..., None]
    log_probs = safe_log(jnp.maximum(probs, MIN_PROB)) / 4 + 1
    colors = average_pool(views.images, config.network.match_stride)
    assert history.colors is not None  # `project` gives them where the anchor is learned
    apart = jnp.where(is_known, colors - history.colors, 0.0)
    num_known = jnp.maximum(is_known.sum(axis=(1, 2), keepdims=True, dtype=jnp.float32), 1.0)
    apart = apart - apart.sum(axis=(1, 2), keepdims=True) / num_known
    of_matcher = (
        _around(log_probs, matched),
        rms_normalize(distribution.decoder.astype(jnp.float32)),
        4 * (colors - 0.5),
        peak_confidence(probs, config)[..., None],
        matched / num,
    )
    of_cache = (
        _around(log_probs, cached),
        jnp.tanh((matched - cached) / 2),
        jnp.tanh((matched - cached) / 8),
        history.confidences[..., None],
        jnp.ones_like(cached),
        8 * apart,
        cached / num,
    )
    of_cache = jnp.where(is_known, jnp.concatenate(of_cache, axis=-1), 0.0)
    features = jnp.concatenate([*of_matcher, of_cache], axis=-1)
    return jax.lax.stop_gradient(AnchorInputs(features, probs, cached[..., 0], history.mask))


def _around(values: Float[Array, "*b d"], places: Float[Array, "*b 1"]) -> Float[Array, "*b n"]:
    """Values at `AROUND` candidates on each side of a place among them, linear between candidates."""
    last = values.shape[-1] - 1
    places = jnp.clip(places + jnp.arange(-AROUND, AROUND + 1.0), 0.0, last)
    low = jnp.minimum(places.astype(jnp.int32), max(last - 1, 0))
    here, after = (jnp.take_along_axis(values, jnp.minimum(i, last), axis=-1) for i in (low, low + 1))
    return here + (places - low.astype(jnp.float32)) * (after - here)


def learned_anchor(params, inputs: AnchorInputs) -> Float[Array, "v hm wm d"]:
    """The anchor over the candidates, its strength included.

    Limits:
        Holes of the cache give zeros. The strength is not negative; width and shift are bounded.
    """
    raw: Array = AnchorMaps().apply({"params": params}, inputs.features)  # pyright: ignore[reportAssignmentType]
    gammas = nn.softplus(raw[..., 0] + softplus_inverse(GAMMA_INIT))
    widths = jnp.exp(jnp.clip(raw[..., 1], *LOG_WIDTHS))
    centers = inputs.places + MAX_SHIFT * jnp.tanh(raw[..., 2])
    offsets = jnp.arange(1.0 * inputs.probs.shape[-1]) - centers[..., None]
    anchor = gammas[..., None] * jnp.exp(-0.5 * (offsets / widths[..., None]) ** 2)
    return jnp.where(inputs.mask[..., None], anchor, 0.0)


# -- Depths of a sensor (ours) -----------------------------------------------------------------------------------------


def cell_depths(depths: Float[Array, "v h w"], side: int) -> Float[Array, "v hm wm"]:
    """Depth of each cell of `side` x `side` pixels: the lower median of its known depths, which lies on a surface.

    Limits:
        0 where less than `MIN_KNOWN` of the pixels are known, that is finite and above 0.
    """
    v, h, w = depths.shape
    cells = depths.reshape(v, h // side, side, w // side, side).swapaxes(2, 3).reshape(v, h // side, w // side, -1)
    is_known = (cells > 0) & (cells < jnp.inf)  # a NaN is neither
    known = jnp.sort(jnp.where(is_known, cells, jnp.inf), axis=-1)
    num_known = jnp.sum(is_known, axis=-1, keepdims=True)
    middle = jnp.take_along_axis(known, jnp.maximum(num_known - 1, 0) // 2, axis=-1)
    return jnp.where(num_known >= math.ceil(MIN_KNOWN * side * side), middle, 0.0)[..., 0]


def sensor_anchor(
    depths: Float[Array, "v hm wm"], log_candidates: Float[Array, " d"], config: StreamConfig
) -> Float[Array, "v hm wm d"]:
    """The anchor of measured depths over the candidates: a Gaussian in the space in which these are uniform.

    Limits:
        An unknown depth, 0, gives zeros, and so does one that is far outside of the candidates.
    """
    candidates = to_candidate_space(log_candidates, config)
    step = jnp.maximum(jnp.abs(candidates[-1] - candidates[0]) / max(len(candidates) - 1, 1), MIN_STEP)
    offsets = candidates - to_candidate_space(safe_log(jnp.where(depths > 0, depths, 1.0)), config)[..., None]
    anchor = jnp.exp(-0.5 * (offsets / (SENSOR_WIDTH * step)) ** 2)
    return jnp.where((depths > 0)[..., None], anchor, 0.0)


# -- Anchored depth ----------------------------------------------------------------------------------------------------


def inject_anchor(
    probs: Float[Array, "*b d"], anchor: Float[Array, "*b d"], gamma: Float[Array, ""] | float
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
    """Depth and confidences read from the matcher's distribution and its anchors, all on the matching grid.

    A sensor's depths count as the matcher's, so that the stored confidences include them. The cache's anchor is left
    out where HPDA is off.
    """
    probs = matched = distribution.probs
    if views.depths is not None:
        depths = cell_depths(views.depths, config.network.match_stride)
        probs = matched = inject_anchor(probs, sensor_anchor(depths, views.log_candidates, config), SENSOR_GAMMA)
    if config.is_anchored and config.additions.anchor == "learned":
        inputs = anchor_inputs(replace(distribution, probs=matched), history, views, config)
        probs = inject_anchor(probs, learned_anchor(params, inputs), 1.0)
    elif config.is_anchored:
        gamma = AnchorStrength().apply({"params": params})
        probs = inject_anchor(probs, cache_anchor(history, views.log_candidates, config), gamma)  # pyright: ignore[reportArgumentType]
    return AnchoredDepth(
        probs=probs,
        log_depths=expected_log_depth(probs, views.log_candidates, config),
        matcher_confidences=peak_confidence(matched, config),
        anchored_confidences=peak_confidence(probs, config),
    )
