"""Refinement while streaming: after each chunk a few gradient steps on key views change the pivots that they show.

    step ─► cache ─► keep_views          for each view of the round: visible pivots ─► base Gaussians, their change
                         └─► views of this round ─►                                              │ online_step
                                                       cache' ◄─ settle, write back ◄────────────┘

It sits above the stream: `model.step` has no part in it. A step changes no more pivots than its view shows, which
bounds the time and the memory of a chunk, however long the stream is.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from ssplat_jax.cache.changes import Change, apply_change, settle, unpack
from ssplat_jax.cache.key_views import KeyViews, keep_views, usable
from ssplat_jax.cache.project import NEAR
from ssplat_jax.cache.state import VoxelCache
from ssplat_jax.config import MEDIAN_DEPTH, StreamConfig
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.cpu_backend import packed_argsort
from ssplat_jax.core.gaussians import Gaussians, mean_color
from ssplat_jax.core.pytree import replace
from ssplat_jax.model.decoder import MAX_SCALE, grown_footprints
from ssplat_jax.model.streamsplat import ChunkOutput, StreamSplat, shown_pivots
from ssplat_jax.model.views import GRID_STRIDE
from ssplat_jax.rasterizer.render import round_up
from ssplat_jax.refinement.compared_views import errors_of_view, golden_fractions
from ssplat_jax.refinement.refine_step import units
from ssplat_jax.streaming.session import RefineChunk

GAINS = {"means": 12.0, "quats": 0.2, "log_scales": 6.0, "logit_opacities": 6.0, "sh": 0.12}
"""Step of each part in `units` over its mean gradient in the pixels that a Gaussian fills. Newton's method would divide
by the squared change of a pixel that the part causes. The gains are far smaller: several Gaussians answer for a pixel,
and a Gaussian should follow the mean of its views, not the one that was shown last."""

CAPS = {"means": 0.2, "quats": 0.02, "log_scales": 0.1, "logit_opacities": 0.5, "sh": 0.2}  # largest step, in `units`
MIN_PIXELS = 0.3  # added to the pixels that a Gaussian fills: one that hardly shows learns little from them
SHOWN_WEIGHT = 0.7  # of the error with holes filled; the rest is the error over black
PIVOTS_PER_CELL = 8  # pivots that a step changes over the grid cells of its view, which bounds its time and memory
LISTED_PER_CELL = 64  # most pivots of a view that are compared, over its grid cells; the last rows are left out
PAIRS_PER_GAUSSIAN = 3  # capacity for tile intersections; the farthest Gaussians of a view are left out beyond it


def online_refinement(model: StreamSplat) -> RefineChunk | None:
    """The `refine` of a `Session` with this model; None if its configuration asks for no refinement."""
    return functools.partial(refine_scene, model) if model.config.stream.steps_per_chunk else None


def refine_scene(model: StreamSplat, params: dict, cache: VoxelCache, chunk: Chunk, output: ChunkOutput) -> VoxelCache:
    """The cache after a round of refinement that follows `model.step` on `chunk` and gave `output`.

    Only `means`, `changes`, `last_chunks` and `key_views` differ. A changed pivot counts as written (`last_chunks`), so
    that deltas report it.
    """
    assert cache.key_views is not None  # a `Session` has added them before the step
    arrivals = replace(KeyViews.of(chunk.camera, chunk.images, output.exposures, chunk.seen), valid=chunk.valid)
    views = views_of_round(cache.key_views, arrivals, cache.stats.num_chunks, model.config.stream.steps_per_chunk)
    views = replace(views, valid=views.valid & jnp.any(chunk.valid))  # a chunk of padding changes nothing
    cache = replace(cache, key_views=keep_views(cache.key_views, arrivals, depth=MEDIAN_DEPTH))
    return jax.lax.scan(lambda cache, view: (_refine_view(model, params, cache, view), None), cache, views)[0]


def _refine_view(model: StreamSplat, params: dict, cache: VoxelCache, view: KeyViews) -> VoxelCache:
    """The cache after one step on a single view, which changes the pivots that the view shows."""
    config = model.config
    pivots = visible_pivots(cache, view, config)
    base = model.decode_rows(params, replace(cache, changes=None), pivots)
    taken = jnp.maximum(pivots, 0)
    flat = lambda x: x.reshape(-1, *x.shape[2:])  # noqa: E731
    means, packed = flat(cache.means)[taken], flat(cache.changes)[taken]
    max_pairs = round_up(PAIRS_PER_GAUSSIAN * base.num_gaussians)
    change = online_step(base, unpack(packed), view, max_pairs=max_pairs)
    moved, settled = settle(means, flat(cache.footprints)[taken], change, config)
    is_changed = jnp.any(moved != means, axis=1) | jnp.any(settled != packed, axis=1)
    places = jnp.where(is_changed & (pivots >= 0), pivots, cache.alive.size)
    put = lambda x, new: flat(x).at[places].set(new, mode="drop").reshape(x.shape)  # noqa: E731
    written = {"means": moved, "changes": settled, "last_chunks": cache.stats.num_chunks - 1}
    return replace(cache, **{name: put(getattr(cache, name), new) for name, new in written.items()})


def views_of_round(ring: KeyViews, arrivals: KeyViews, num_chunks: Int[Array, ""], num: int) -> KeyViews:
    """The `num` kept views of a round; the chunk's own views where none has been kept yet.

    The i-th step of a stream takes the view at n x frac(i / golden ratio) of n usable ones, in order of their slots:
    all views are taken about equally often, and steps that follow each other take views that arrived far apart. Scenes
    gained less if the chunk's own views took part at once.

    Args:
        ring: the views kept before the chunk.
        arrivals: the views of the chunk.
        num_chunks: chunks so far, this one included.
        num: steps of a round (static).

    Returns:
        `num` views; those without a usable one to take are not valid.
    """
    is_kept, is_new = usable(ring), usable(arrivals) & ~jnp.any(usable(ring))
    pool, is_usable = jax.tree.map(lambda *x: jnp.concatenate(x), (ring, is_kept), (arrivals, is_new))
    order, number = jnp.argsort(~is_usable, stable=True), jnp.sum(is_usable, dtype=jnp.int32)
    fractions = golden_fractions(num_chunks * num + jnp.arange(num, dtype=jnp.int32))
    places = jnp.minimum((fractions * number.astype(fractions.dtype)).astype(jnp.int32), jnp.maximum(number - 1, 0))
    chosen = jax.tree.map(lambda x: x[order[places]], pool)
    return replace(chosen, valid=is_usable[order[places]])


def online_step(base: Gaussians, change: Change, view: KeyViews, *, max_pairs: int) -> Change:
    """`change` after one step on a single view: gradients over the pixels that each Gaussian fills.

    The squared error of a pixel is a sum over its Gaussians, weighted by how much of the pixel each fills, and so a
    Gaussian's gradient grows with the number of pixels that it fills. Divided by that number it is a mean error: the
    step of a color is the mean error of the pixels that show it, which is Jacobi's method for the linear part of the
    problem. Nothing has to be remembered from step to step: Adam's moments would have to be stored for every pivot, and
    started anew in each round they move every Gaussian at full speed in the direction of its noise.

    Args:
        base: the Gaussians as they are decoded.
        change: their change so far.
        view: one view, without a batch axis; one that is not valid changes nothing.
        max_pairs: capacity for tile intersections (static).
    """

    def loss(change: Change, probe: Float[Array, "n 1"]) -> Float[Array, ""]:
        """Half the squared error at the scene's exposure, summed over pixels and channels.

        The probe is zero and shows nothing; its gradient is the number of pixels that each Gaussian fills.
        """
        gaussians = apply_change(base, change, max_scale=MAX_SCALE)
        background = jax.lax.stop_gradient(mean_color(gaussians))
        filled, black, out = errors_of_view(gaussians, background, view, max_pairs=max_pairs, probe=probe)
        error = (SHOWN_WEIGHT * filled**2 + (1 - SHOWN_WEIGHT) * black**2) / view.exposures**2
        if view.seen is not None:
            error = jnp.where(view.seen[..., None], error, 0.0)
        return 0.5 * jnp.sum(error) + jnp.sum(out.features)

    probe = jnp.zeros((base.num_gaussians, 1), base.means.dtype)
    gradient, filled = jax.grad(loss, argnums=(0, 1))(change, probe)
    new: dict[str, Array] = {}
    for name, unit in units(base).items():
        in_units = getattr(gradient, name) * unit
        pixels = (filled[:, 0] + MIN_PIXELS).reshape(-1, *[1] * (in_units.ndim - 1))
        move = jnp.clip(GAINS[name] * in_units / pixels, -CAPS[name], CAPS[name])
        new[name] = getattr(change, name) - unit * jnp.where(view.valid & jnp.isfinite(move), move, 0.0)
    return Change(**new)


def visible_pivots(cache: VoxelCache, view: KeyViews, config: StreamConfig) -> Int[Array, " m"]:
    """Numbers of the shown pivots in a view, found without rendering; -1 after the last.

    Most pivots in the frustum of a large scene lie behind surfaces, and would cost a step as much as those that it
    changes. So the least covered ones come first, and `PIVOTS_PER_CELL` times the cells are taken. A pivot is covered
    by the area of the pivots before it in its cell: their squared footprints, at most one cell each. Where that is 3
    cells, about a twentieth of the light is left. (The nearest pivots instead would leave surfaces in front to be bent
    until they show what lies behind them.) A view that is not valid sees nothing.
    """
    height, width = view.images.shape[:2]
    rows, columns = -(-height // GRID_STRIDE), -(-width // GRID_STRIDE)
    num_cells = rows * columns
    points = cache.means.reshape(-1, 3).T
    x, y, z = (r[0] * points[0] + r[1] * points[1] + r[2] * points[2] + r[3] for r in view.viewmats[:3])
    column, row = ((view.Ks[i, i] * along / z + view.Ks[i, 2]) / GRID_STRIDE for i, along in enumerate((x, y)))
    is_seen = view.valid & shown_pivots(cache, config).reshape(-1) & (z > NEAR)
    is_seen &= (column > -1) & (column < columns + 1) & (row > -1) & (row < rows + 1)

    num_pivots = is_seen.shape[0]
    size = min(LISTED_PER_CELL * num_cells, num_pivots)
    listed = jnp.nonzero(is_seen, size=size, fill_value=num_pivots)[0].astype(jnp.int32)
    is_listed, taken = listed < num_pivots, jnp.minimum(listed, num_pivots - 1)
    cell_of = lambda place, count: jnp.clip(place[taken], 0, count - 1).astype(jnp.int32)  # noqa: E731
    cells = jnp.where(is_listed, cell_of(row, rows) * columns + cell_of(column, columns), num_cells)
    stored, num_members = (x.reshape(-1)[taken] for x in (cache.footprints, cache.num_members))
    sides = grown_footprints(stored, num_members, config) * view.Ks[0, 0] / (z[taken] * GRID_STRIDE)
    covers = areas_before(cells, z[taken], jnp.where(is_listed, jnp.minimum(sides * sides, 1.0), 0.0), num_cells)

    order = packed_argsort(_bits(jnp.where(is_listed, covers, jnp.inf)))[: min(PIVOTS_PER_CELL * num_cells, size)]
    return jnp.where(is_listed[order], listed[order], -1)


def _bits(values: Float[Array, " n"]) -> UInt32[Array, " n"]:
    """Integers in the order of values that are not negative."""
    return jax.lax.bitcast_convert_type(values, jnp.uint32)


def areas_before(
    cells: Int[Array, " n"], depths: Float[Array, " n"], areas: Float[Array, " n"], num_cells: int
) -> Float[Array, " n"]:
    """For each entry the summed areas of the nearer entries of its cell, 0 to `num_cells`.

    One integer of 64 bits holds cell, depth and entry: XLA's CPU backend sorts it seven times as fast as three keys. It
    leaves the depth, which must be positive, all its 32 bits, or 31 at a million entries in 4,800 cells.
    """
    slot_bits, cell_bits = len(cells).bit_length(), num_cells.bit_length()
    depth_bits = min(32, 64 - slot_bits - cell_bits)
    with jax.enable_x64(True):
        slots = jnp.arange(len(cells), dtype=jnp.uint64)
        depths_first = _bits(depths).astype(jnp.uint64) >> jnp.uint64(32 - depth_bits)
        keys = (cells.astype(jnp.uint64) << jnp.uint64(depth_bits)) | depths_first
        keys = jnp.sort((keys << jnp.uint64(slot_bits)) | slots)
        order = (keys & jnp.uint64((1 << slot_bits) - 1)).astype(jnp.int32)
    own, cell = areas[order], cells[order]
    before = jnp.cumsum(own) - own
    begins = jax.lax.cummax(jnp.where(jnp.append(True, cell[1:] != cell[:-1]), before, 0.0))
    return jnp.zeros_like(areas).at[order].set(jnp.maximum(before - begins, 0.0), unique_indices=True)
