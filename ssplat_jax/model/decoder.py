"""Gaussians of tokens and pivots, from the shapes that the head predicts (Sec. 3.6, Gaussian Decoder)."""

import math

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.cache.hash_table import voxel_sides
from ssplat_jax.cache.votes import observation_features
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.core.numerics import safe_log, safe_sqrt
from ssplat_jax.core.pytree import pytree, replace
from ssplat_jax.core.rotations import multiply_quats, quats_to_matrices
from ssplat_jax.model.views import TokenShapes, repeat_cells

START_SCALE = 0.43
"""Untrained sideways scale, as a fraction of a Gaussian's part of the cell: neighbors overlap to a closed surface."""
START_THICKNESS = 0.05  # untrained scale along the viewing direction, as a fraction of the cell's footprint
MAX_LOG_GAIN = 0.6
"""Bound of the log factor on a scale. Larger Gaussians would cover holes and hide what is behind."""
MIN_SCALE = 1e-6  # smallest scale, in stream units
MAX_SCALE = 1.0  # largest scale, in stream units: ReSplat's bound
MIN_DETAIL = {1: 0.05, 2: 0.018}
"""Least RMS color difference that parts of 1 or 2 pixels a side must show, to not become one of twice the side."""
MOST_MEMBERS = 8
"""Members up to which a pivot grows more opaque and the evidence head tells pivots apart: few had more in the streams
that the head learned from."""
VOXEL_COVERAGE = 1.2
"""Share of a voxel's face that its pivots cover together: above 1, because pivots gather in the middle of the voxel."""


def token_scales(raw: Float[Array, "m 3"], footprints: Float[Array, " m"], config: StreamConfig) -> Float[Array, "m 3"]:
    """Standard deviations of each token's Gaussians in stream units, along the axes of the token's camera."""
    side = math.isqrt(config.head.gaussians_per_token)
    if not config.additions.footprint_scales:
        scales = nn.softplus(raw - 4.0) / jnp.array([side, side, 1.0])
    else:
        start = jnp.array([START_SCALE / side, START_SCALE / side, START_THICKNESS])
        scales = footprints[:, None] * start * jnp.exp(MAX_LOG_GAIN * jnp.tanh(raw / MAX_LOG_GAIN))
    return jnp.clip(scales, MIN_SCALE, MAX_SCALE)


def grown_footprints(
    footprints: Float[Array, "*p"], num_members: Int[Array, "*p"], config: StreamConfig
) -> Float[Array, "*p"]:
    """Footprints of pivots, grown with the number of members until K pivots cover a voxel's face.

    A pivot stores the footprint of its best member. Where grid cells are much finer than voxels, many tokens merge into
    K pivots, whose stored footprints would leave cracks between them. Without `merged_coverage` they stay as stored.
    """
    if not config.additions.merged_coverage:
        return footprints
    share = VOXEL_COVERAGE * voxel_sides(footprints, config) / math.sqrt(config.memory.pivots_per_voxel)
    grown = footprints * jnp.sqrt(num_members.astype(jnp.float32))
    return jnp.minimum(grown, jnp.maximum(footprints, share))


def decode_tokens(
    shapes: TokenShapes,
    *,
    means: Float[Array, "m 3"],
    parts: "Parts",
    quats: Float[Array, "m 4"],
    footprints: Float[Array, " m"],
    num_members: Int[Array, " m"] | int = 1,
    config: StreamConfig,
    rows: Int[Array, " n"] | None = None,
) -> Gaussians:
    """Gaussians of tokens or pivots: `gaussians_per_token` each, in a square over the cell, row by row.

    The Gaussians of a token share shape and opacity and differ in position and color. With `merged_coverage` a pivot of
    n members, at most `MOST_MEMBERS`, is as opaque as n Gaussians of opacity o at one place, 1 - (1 - o)^n. With
    `detail` a cell without detail has fewer and larger ones (`divide_cells`), in the first of the rows that they stand
    for; the other rows have opacity 0.

    Args:
        shapes: what the head predicts. Rotations are in the frame of the token's camera, `shapes.sh` is added to the
            appearance anchors.
        means: positions of the tokens, stream frame, as is the result.
        parts: places and colors of each token's Gaussians in its cell (`divide_cells`).
        quats: camera-to-stream rotation of each token's camera, wxyz.
        footprints: side of a cell at the token's depth, stream units.
        num_members: tokens that were merged into the pivot.
        config: model configuration.
        rows: the rows of the result that are wanted, where not all are: what is left out costs nothing.
    """
    layers = jnp.minimum(num_members, MOST_MEMBERS).astype(jnp.float32) if config.additions.merged_coverage else 1.0
    optical_depths = layers * nn.softplus(shapes.logit_opacities)
    g = config.head.gaussians_per_token

    def each(x):  # what the Gaussians of a token share
        return jnp.repeat(x, g, axis=0) if rows is None else x[rows // g]

    def own(x):  # what they do not
        x = x.reshape(-1, *x.shape[2:])
        return x if rows is None else x[rows]

    axes = quats_to_matrices(quats)
    offsets = own(parts.right)[:, None] * each(axes[:, :, 0]) + own(parts.down)[:, None] * each(axes[:, :, 1])
    growth = jnp.stack([parts.growth, parts.growth, jnp.ones_like(parts.growth)], axis=-1)
    opacities = each(-jnp.expm1(-optical_depths))
    return Gaussians(
        means=each(means) + each(footprints)[:, None] * offsets,
        quats=each(multiply_quats(quats, shapes.quats)),
        scales=each(token_scales(shapes.raw_scales, footprints, config) * growth),
        opacities=jnp.where(own(parts.present), opacities, 0.0) if config.additions.detail else opacities,
        sh=each(shapes.sh).at[:, 0].add((own(parts.colors) - 0.5) / SH_C0),
    )


@pytree
class Parts:
    """The Gaussians into which the cells of `m` tokens are divided, at most `g` each, row by row."""

    colors: Float[Array, "m g 3"]
    right: Float[Array, "m g"]  # place of the center in its cell, in cells
    down: Float[Array, "m g"]
    growth: Float[Array, " m"]  # side of a part, in units of the smallest
    present: Bool[Array, "m g"]  # False for rows that another part stands for


def divide_cells(rgbs: Float[Array, "m a"], config: StreamConfig) -> Parts:
    """The parts of each token's cell: `gaussians_per_token`, or with `detail` as few as its detail allows.

    Four neighboring parts become one, with their mean color, where the RMS difference of the colors from that mean is
    below `MIN_DETAIL` over the whole cell. The first of the four rows holds it.
    """
    side = math.isqrt(config.head.gaussians_per_token)
    blocks = [1 << i for i in range(side.bit_length())] if config.additions.detail else [1]
    images = [rgbs.reshape(-1, side, side, 3)]  # each half as large as the one before
    for _ in blocks[1:]:
        images.append(_halved(images[-1]))
    level = jnp.full(len(rgbs), len(blocks) - 1)
    for i in reversed(range(len(blocks) - 1)):
        lost = jnp.mean((images[i] - repeat_cells(images[i + 1], 2)) ** 2, axis=(1, 2, 3))
        level = jnp.where(lost >= MIN_DETAIL[blocks[i] * 4 // side] ** 2, i, level)
    firsts = [np.arange(side) // block * block for block in blocks]  # first row or column of the part of each
    centers = [(first + 0.5 * block) / side - 0.5 for first, block in zip(firsts, blocks, strict=True)]
    grids = [np.meshgrid(x, x, indexing="ij") for x in centers]
    leads = [np.equal(first, np.arange(side)) for first in firsts]
    choose = lambda tables: jnp.asarray(np.stack(tables).reshape(len(blocks), -1))[level]  # noqa: E731
    images = [repeat_cells(image, block) for image, block in zip(images, blocks, strict=True)]
    colors = images[-1]
    for i, image in enumerate(images[:-1]):
        colors = jnp.where(level[:, None, None, None] == i, image, colors)
    return Parts(
        colors=colors.reshape(-1, side * side, 3),
        right=choose([right.astype(np.float32) for _, right in grids]),
        down=choose([down.astype(np.float32) for down, _ in grids]),
        growth=jnp.asarray(blocks, jnp.float32)[level],
        present=choose([np.logical_and.outer(lead, lead) for lead in leads]),
    )


def _halved(images: Float[Array, "m s s 3"]) -> Float[Array, "m r r 3"]:
    """Images of half the side, each pixel the mean of four."""
    # Slices, not sums over the inner axes of a reshaped array: those take six times as long on a CPU.
    return 0.25 * (images[:, ::2, ::2] + images[:, 1::2, ::2] + images[:, ::2, 1::2] + images[:, 1::2, 1::2])


# -- Evidence head: opacity, scale and contrast of a pivot's Gaussians from how views saw it (ours) -------------------

MAX_LOGIT_CHANGE = 4.0  # bound of what is added to an opacity's logit
MAX_LOG_CONTRAST = 1.0  # bound of the log factor on the differences between the colors of a pivot's Gaussians
NUM_FEATURES = 18  # inputs of the evidence head: 7, and 11 of `observation_features`
WIDTH = 32  # channels of the hidden layers


@pytree
class Evidence:
    """Facts about `m` pivots in the cache, besides their features."""

    observations: Float[Array, "m s"]
    confidences: Float[Array, " m"]
    num_members: Float[Array, " m"]
    num_pivots: Float[Array, " m"]  # in the same voxel
    footprints: Float[Array, " m"]  # stream units
    growth: Float[Array, " m"]  # footprint that is decoded over the stored one
    rgbs: Float[Array, "m a"]


class EvidenceHead(nn.Module):
    """Maps evidence to changes of the opacity's logit, the log scales and the log contrast.

    Scales change sideways and along the view. Before training all changes are 0.
    """

    @nn.compact
    def __call__(self, x: Float[Array, "m f"]) -> Float[Array, "m 4"]:
        x = nn.gelu(nn.Dense(WIDTH, name="hidden1")(x))
        x = nn.gelu(nn.Dense(WIDTH, name="hidden2")(x))
        return nn.Dense(4, kernel_init=nn.initializers.zeros, name="out")(x)


def evidence_features(evidence: Evidence, config: StreamConfig) -> Float[Array, "m f"]:
    """Evidence as numbers of about unit size.

    Limits:
        Confidences of 0 and 1, zero observations and zero footprints, as dead pivots have them, and equal colors give
        finite features with finite gradients.
    """
    omega = jnp.clip(evidence.confidences, 1e-3, 0.96)
    colors = evidence.rgbs.reshape(len(evidence.rgbs), -1, 3)
    features = (
        safe_log(omega) - jnp.log1p(-omega) - 2.0,
        safe_log(jnp.clip(evidence.num_members, 1.0, MOST_MEMBERS)),
        safe_log(jnp.maximum(evidence.footprints, 1e-6) / config.memory.voxel_size),
        evidence.num_pivots - 2.5,
        safe_log(jnp.maximum(evidence.growth, 1.0)),
        10 * safe_sqrt(jnp.var(colors, axis=1)).mean(axis=-1) - 0.5,
        2 * colors.mean(axis=(1, 2)) - 1.0,
    )
    return jnp.concatenate([jnp.stack(features, axis=-1), observation_features(evidence.observations)], axis=-1)


def apply_evidence(
    params, shapes: TokenShapes, parts: Parts, evidence: Evidence, config: StreamConfig
) -> tuple[TokenShapes, Parts]:
    """Shapes and parts of pivots, changed as the evidence asks for.

    A rendered surface is a mixture of Gaussians that overlap and of layers that do not lie exactly on each other, which
    blurs it. So the colors of a pivot's Gaussians may be moved away from their mean, more where the evidence is good.

    Returns the shapes with other opacities and scales, and the parts with other colors, whose mean over a pivot stays
    as it is.

    Limits:
        Logits change by at most `MAX_LOGIT_CHANGE`, differences of colors by a factor of at most
        exp(`MAX_LOG_CONTRAST`); the decoder bounds the scales. Colors may leave [0, 1].
    """
    out = EvidenceHead().apply({"params": params}, evidence_features(evidence, config))
    logit, sideways, along, contrast = jnp.moveaxis(jnp.asarray(out), -1, 0)
    change = MAX_LOGIT_CHANGE * jnp.tanh(logit / MAX_LOGIT_CHANGE)
    shapes = replace(
        shapes,
        logit_opacities=shapes.logit_opacities + change,
        raw_scales=shapes.raw_scales + jnp.stack([sideways, sideways, along], axis=-1),
    )
    gains = jnp.expm1(MAX_LOG_CONTRAST * jnp.tanh(contrast / MAX_LOG_CONTRAST))  # 0 changes no bit
    differences = parts.colors - parts.colors.mean(axis=1, keepdims=True)
    return shapes, replace(parts, colors=parts.colors + gains[:, None, None] * differences)
