"""The views of a chunk, and the arrays that stages exchange: how a cell of a view becomes pixels, points and colors."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.cameras import Camera, invert_poses, pixel_grid, transform_points, unproject
from ssplat_jax.core.chunk import Chunk, usable_range, usable_views
from ssplat_jax.core.pytree import pytree, static
from ssplat_jax.model.layers import average_pool

MIN_SOURCE_DEPTH = 1e-3
"""Smallest depth in a source camera, relative to the candidate's depth, at which the source sees a candidate."""
GRID_STRIDE = 4
"""Pixels per side of a grid cell: one token per 4 x 4 patch (Sec. 3.3, M = N H W / 16)."""


@pytree
class Views:
    """A chunk padded to a size that the network accepts. Padding at the right and bottom leaves `Ks` unchanged."""

    images: Float[Array, "v hp wp 3"]  # edge-padded
    viewmats: Float[Array, "v 4 4"]
    Ks: Float[Array, "v 3 3"]
    valid: Bool[Array, " v"]  # neither padding nor unusable
    unusable: Bool[Array, " v"]  # given as valid, but not to be used (`core.chunk.usable_views`): treated as padding
    inside: Bool[Array, "v hf wf"]  # cells of valid views whose center lies in the unpadded image, no pixel masked out
    log_candidates: Float[Array, " d"]  # ln of the candidates, near to far; far to near if `inverse`
    height: int = static()  # of the unpadded image
    width: int = static()
    depths: Float[Array, "v hp wp"] | None = None  # as in `Chunk`, 0 in the padding

    @property
    def grid_camera(self) -> Camera:
        """Cameras of the views at grid resolution: one pixel per cell."""
        hf, wf = self.inside.shape[1:]
        scale = jnp.array([1.0 / GRID_STRIDE, 1.0 / GRID_STRIDE, 1.0])
        return Camera(viewmats=self.viewmats, Ks=self.Ks * scale[:, None], width=wf, height=hf)


@pytree
class DepthDistribution:
    """The matcher's distribution P_i(k | u) and the features it was predicted from, on the matching grid."""

    probs: Float[Array, "v hm wm d"]
    logits: Float[Array, "v hm wm d"]
    decoder: Float[Array, "v hm wm c"]


@pytree
class AnchoredDepth:
    """The anchored distribution P^v(k | u), and the depths and confidences read from it.

    `probs` is on the matching grid; the others are too, until `refine_depth` brings them to the feature grid.
    """

    probs: Float[Array, "v hm wm d"]
    log_depths: Float[Array, "v hf wf"]
    matcher_confidences: Float[Array, "v hf wf"]  # of P_i, before the anchor: the confidence of tokens in VACC
    anchored_confidences: Float[Array, "v hf wf"]  # of P^v: CGFI attenuates history by them


@pytree
class TokenShapes:
    """Predictions of the Gaussian head for each token, before activation."""

    logit_opacities: Float[Array, " m"]
    raw_scales: Float[Array, "m 3"]  # see `decoder.token_scales`
    quats: Float[Array, "m 4"]  # wxyz, any length, in the frame of the token's camera
    sh: Float[Array, "m k 3"]  # residual color on the appearance anchor


def repeat_cells(x: Array, factor: int) -> Array:
    """Map `[v, h, w, ...]` on a finer grid: every cell repeated `factor` times in both directions."""
    return jnp.repeat(jnp.repeat(x, factor, axis=1), factor, axis=2) if factor > 1 else x


def prepare_views(chunk: Chunk, config: StreamConfig) -> Views:
    """Views of `chunk`: images edge-padded to the network's multiple, and the depth candidates.

    Padding views become black images of the first valid view's camera, whatever they hold: 0 times NaN would be NaN.
    So do views that cannot be used.

    Limits:
        A single candidate lies at `near`, in inverse depth at `far`.
    """
    fixed = config.network.depth_range
    near, far = (chunk.near, chunk.far) if fixed is None else map(jnp.float32, fixed)
    is_range = usable_range(near, far)
    near, far = jnp.where(is_range, near, 1.0), jnp.where(is_range, far, 2.0)  # whatever is read from them is left out
    valid = usable_views(chunk) & is_range
    images = jnp.where(valid[:, None, None, None], chunk.images, 0)
    viewmats, Ks = (_of_valid(matrices, valid) for matrices in (chunk.viewmats, chunk.Ks))
    height, width = chunk.images.shape[1:3]
    multiple = config.network.size_multiple
    pad_h, pad_w = -height % multiple, -width % multiple
    images = jnp.pad(images, ((0, 0), (0, pad_h), (0, pad_w), (0, 0)), mode="edge")
    centers = pixel_grid(height + pad_h, width + pad_w, GRID_STRIDE)
    in_image = (centers[..., 0] < width) & (centers[..., 1] < height)
    inside = in_image[None] & valid[:, None, None]
    if chunk.seen is not None:
        seen = jnp.pad(chunk.seen, ((0, 0), (0, pad_h), (0, pad_w)), constant_values=True)
        v, hf, wf = inside.shape
        inside &= seen.reshape(v, hf, GRID_STRIDE, wf, GRID_STRIDE).all(axis=(2, 4))
    depths = None if chunk.depths is None else jnp.pad(chunk.depths, ((0, 0), (0, pad_h), (0, pad_w)))
    return Views(
        images=images,
        viewmats=viewmats,
        Ks=Ks,
        valid=valid,
        unusable=chunk.valid & ~valid,
        inside=inside,
        log_candidates=_log_candidates(near, far, config),
        depths=depths,
        height=height,
        width=width,
    )


def _of_valid(matrices: Float[Array, "v n n"], valid: Bool[Array, " v"]) -> Float[Array, "v n n"]:
    """`matrices` with that of the first valid view, or the identity if none is valid, in place of those of padding."""
    identity = jnp.eye(matrices.shape[-1], dtype=matrices.dtype)
    first = jnp.where(valid.any(), matrices[jnp.argmax(valid)], identity)
    return jnp.where(valid[:, None, None], matrices, first)


def _log_candidates(near, far, config: StreamConfig) -> Float[Array, " d"]:
    fractions = jnp.linspace(0.0, 1.0, config.network.num_depths)
    if config.network.depth_space == "inverse":
        return -jnp.log(1 / far + (1 / near - 1 / far) * fractions)
    log_near, log_far = jnp.log(near), jnp.log(far)
    return log_near + (log_far - log_near) * fractions


def to_candidate_space(log_depths: Float[Array, "*b"], config: StreamConfig) -> Float[Array, "*b"]:
    """Depths in the space in which candidates are uniform: log depth or inverse depth."""
    return jnp.exp(-log_depths) if config.network.depth_space == "inverse" else log_depths


def from_candidate_space(x: Float[Array, "*b"], config: StreamConfig) -> Float[Array, "*b"]:
    """Log depths of values in candidate space; inverse of `to_candidate_space`."""
    return -jnp.log(x) if config.network.depth_space == "inverse" else x


# -- The plane sweep: where the cells of a view lie in its source views, at every candidate depth ---------------------
def nearest_sources(
    viewmats: Float[Array, "v 4 4"], valid: Bool[Array, " v"], num_sources: int
) -> tuple[Int[Array, "v s"], Bool[Array, "v s"]]:
    """Indices of the other views with the nearest camera centers, and which of them are valid.

    A view is excluded by its index, not by its distance, because two cameras may share a center.
    """
    v = viewmats.shape[0]
    centers = Camera(viewmats=viewmats, Ks=jnp.zeros((v, 3, 3)), width=1, height=1).centers
    distances = jnp.sum((centers[:, None] - centers[None]) ** 2, axis=-1)
    distances = jnp.where(valid[None, :], distances, jnp.inf)
    distances = jnp.where(jnp.eye(v, dtype=bool), jnp.inf, distances)
    # Sorting by (distance, is_self) puts the view itself last, even after invalid views.
    order = jnp.lexsort((jnp.eye(v, dtype=jnp.int32), distances), axis=-1)[:, : min(num_sources, v - 1)]
    return order, jnp.take_along_axis(jnp.isfinite(distances), order, axis=1)


def sweep_pixels(
    views: Views, reference, source, stride: int
) -> tuple[Float[Array, "d n"], Float[Array, "d n"], Bool[Array, "d n"]]:
    """Pixels in view `source` of the cells of view `reference`, at every candidate depth.

    Cells have `stride` pixels per side. Returns x and y in pixels of the padded image, and whether the source image
    contains them, by candidate and cell.
    """
    height, width = views.images.shape[1:3]
    cells = pixel_grid(height, width, stride).reshape(-1, 2)
    rays = unproject(cells, jnp.ones(cells.shape[0]), views.Ks[reference])
    exact = jax.lax.Precision.HIGHEST
    pose = jnp.matmul(views.viewmats[source], invert_poses(views.viewmats[reference]), precision=exact)
    # A point at depth d on the ray r projects to K R r + K t / d: rays are rotated once, and without parallax every
    # depth gives the same pixel to the last bit.
    a = jnp.einsum("ij,jk,nk->in", views.Ks[source], pose[:3, :3], rays, precision=exact)
    b = jnp.einsum("ij,j->i", views.Ks[source], pose[:3, 3], precision=exact)
    nearness = jnp.exp(-views.log_candidates)[:, None]
    x, y, w = (a[i] + nearness * b[i] for i in range(3))
    in_front = w > MIN_SOURCE_DEPTH * nearness
    w = jnp.where(in_front, w, 1.0)
    x, y = x / w, y / w
    return x, y, in_front & (x >= 0) & (x <= views.width) & (y >= 0) & (y <= views.height)


def mean_over_sources(
    correlate: Callable[[tuple], tuple[Array, Array]], views: Views, config: StreamConfig
) -> Float[Array, "v ld n"]:
    """Scores of the cells of each view at every candidate: the mean over the sources that see the candidate.

    `correlate` maps (view, source view, whether it is valid) to scores `[levels d n]`, 0 where they are not seen, and
    whether the source sees the candidate, `[d n]`. It is called pair by pair, so that one pair is in memory at a time.

    Limits:
        A candidate that no source sees scores 0.
    """
    sources, source_valid = nearest_sources(views.viewmats, views.valid, config.network.num_sources)
    v, num_sources = sources.shape
    pairs = (jnp.repeat(jnp.arange(v), num_sources), sources.reshape(-1), source_valid.reshape(-1))
    scores, seen = jax.lax.map(correlate, pairs)
    num_cells = scores.shape[-1]
    scores = scores.reshape(v, num_sources, -1, config.network.num_depths, num_cells).sum(axis=1)
    counts = seen.astype(jnp.float32).reshape(v, num_sources, 1, config.network.num_depths, num_cells).sum(axis=1)
    return (scores / jnp.maximum(counts, 1.0)).reshape(v, -1, num_cells)


# -- Tokens of a cell: where they lie and how they look (Sec. 3.3) ----------------------------------------------------
def patch_colors(images: Float[Array, "v h w 3"], config: StreamConfig) -> Float[Array, "v hf wf a"]:
    """Appearance anchors: mean colors of the `gaussians_per_token` parts of each token's patch, row by row."""
    side = math.isqrt(config.head.gaussians_per_token)
    parts = average_pool(images, GRID_STRIDE // side)
    v, h, w, _ = parts.shape
    parts = parts.reshape(v, h // side, side, w // side, side, 3).swapaxes(2, 3)
    return parts.reshape(v, h // side, w // side, 3 * side * side)


def back_project(
    log_depths: Float[Array, "v hf wf"], views: Views
) -> tuple[Float[Array, "v hf wf 3"], Float[Array, "v hf wf"]]:
    """World positions p_j of the cells at their depths, and their footprints: the side of a cell at that depth."""
    v, hf, wf = log_depths.shape
    cells = pixel_grid(hf * GRID_STRIDE, wf * GRID_STRIDE, GRID_STRIDE).reshape(-1, 2)
    depths = jnp.exp(log_depths).reshape(v, -1)
    points = unproject(jnp.broadcast_to(cells, (v, *cells.shape)), depths, views.Ks)
    world = transform_points(invert_poses(views.viewmats), points)
    focal = 0.5 * (views.Ks[:, 0, 0] + views.Ks[:, 1, 1])
    return world.reshape(v, hf, wf, 3), (depths * GRID_STRIDE / focal[:, None]).reshape(v, hf, wf)
