"""`StreamSplat`: the model as pure functions of parameters and cache. `step` has the signature of a `lax.scan` body.

chunk (4 images + cameras)          cache H_{t-1}
  │                                   │ project
  ▼                                   ▼
encode ─► match ─► P_i ──────────► anchor_depth (HPDA) ─► refine_depth ─► back_project ─► p
  │                                   │                                                   │
  └─► regress_tokens ─► f ─► inject_features (CGFI) ─► mix_tokens ─► f                    │
                                                        └──────► fuse (VACC) ◄────────────┘ ─► cache H_t ─► decode

`network.STAGES` says which of these may be absent.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.cache.changes import changed_gaussians, unpack
from ssplat_jax.cache.fuse import fuse
from ssplat_jax.cache.project import ProjectedCache, coarsen, project, rows_in_sight
from ssplat_jax.cache.state import Tokens, VoxelCache, init_cache
from ssplat_jax.cache.votes import carve, observe, seen_cells, store_depths, total_weight, vote
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.chunk import Chunk, check_chunk
from ssplat_jax.core.gaussians import Gaussians, mask_gaussians
from ssplat_jax.core.pytree import pytree, replace
from ssplat_jax.core.rotations import matrices_to_quats
from ssplat_jax.model.cgfi import inject_features
from ssplat_jax.model.decoder import MAX_SCALE, Evidence, apply_evidence, decode_tokens, divide_cells, grown_footprints
from ssplat_jax.model.exposure import estimate_exposures
from ssplat_jax.model.hpda import anchor_depth
from ssplat_jax.model.network import init_params, network_of
from ssplat_jax.model.views import GRID_STRIDE, DepthDistribution, Views, back_project, patch_colors, prepare_views


@pytree
class ChunkOutput:
    """Summary of one step, on the 1/4 grid of the padded images."""

    depths: Float[Array, "*t v hf wf"]  # camera z, stream units
    confidences: Float[Array, "*t v hf wf"]  # omega of VACC; 0 outside the image and in padded views
    history: Float[Array, "*t v hf wf"]  # Omega_H of the cache before this chunk; 0 in its holes
    exposures: Float[Array, "*t v 3"]  # factors from the scene's colors to each view's; 1 without `match_exposure`


@pytree
class Prediction:
    """All results of the network for one chunk. Training losses use all of them; `step` returns only `output`."""

    tokens: Tokens
    distribution: DepthDistribution  # P_i, on the matching grid
    history: ProjectedCache  # the cache before the chunk, on the matching grid
    log_depths: Float[Array, "v hf wf"]  # expectation under P^v
    views: Views
    output: ChunkOutput


@dataclasses.dataclass(frozen=True)
class StreamSplat:
    """The model for one configuration. It holds no arrays: parameters and cache are arguments and results.

    Example:
        >>> model = StreamSplat(ss.preset("tiny"))
        >>> params, cache = model.init(jax.random.key(0)), model.init_cache()
        >>> step = jax.jit(model.step, donate_argnums=1)
        >>> for chunk in chunks:
        ...     cache = ss.ensure_capacity(cache, model.config, num_tokens)  # one per 4 x 4 pixels of the chunk
        ...     cache, out = step(params, cache, chunk)
        >>> gaussians = model.decode(params, cache)
    """

    config: StreamConfig
    axis: str | None = None
    """Name of the mapped axis over which the cache is sharded by voxel (`sharded.py`); None for a single cache."""

    def init(self, key: jax.Array) -> dict:
        """Untrained parameters, a nested dict; `ssplat_jax.load_params` loads trained ones."""
        return init_params(key, self.config)

    def init_cache(self) -> VoxelCache:
        """An empty cache of the configuration's capacity."""
        return init_cache(self.config)

    def predict(self, params: dict, cache: VoxelCache, chunk: Chunk) -> Prediction:
        """Tokens of a chunk, given the cache before it (Secs. 3.3 to 3.6); no gradient flows to the cache."""
        config, network = self.config, network_of(self.config)
        check_chunk(chunk, config.stream.chunk_size)
        views = prepare_views(chunk, config)
        with jax.named_scope("project"):
            history = project(cache, views.grid_camera, config, axis=self.axis)
        with jax.named_scope("encode"):
            features = network.encode(params["encoder"], views, config)
        with jax.named_scope("match"):
            distribution = network.match(params["cost_volume"], features, views, config)
        with jax.named_scope("HPDA"):
            coarse = coarsen(history, config.network.match_stride // GRID_STRIDE)
            depth = anchor_depth(params["hpda"], distribution, coarse, views, config)
        with jax.named_scope("refine"):
            depth = network.refine_depth(params.get("upsampler"), features, depth, views, config)
        with jax.named_scope("tokens"):
            positions, footprints = back_project(depth.log_depths, views)
            feats = network.regress_tokens(params["tokens"], features, distribution, depth, views, config)
        if config.history.cgfi:
            with jax.named_scope("CGFI"):
                omega, bound = depth.anchored_confidences, network.bound_history
                feats = inject_features(params["cgfi"], feats, history, omega, views, config, bound_history=bound)
        with jax.named_scope("mixer"):
            feats = network.mix_tokens(params["mixer"], feats, positions, views.inside, views.valid, config)
        confidences = jnp.where(views.inside, depth.matcher_confidences, 0.0)
        with jax.named_scope("exposure"):
            exposures = estimate_exposures(history, depth.log_depths, confidences, views, config)
        tokens = _flatten_tokens(positions, feats, confidences, footprints, exposures, views, config)
        output = ChunkOutput(jnp.exp(depth.log_depths), confidences, history.confidences, exposures)
        return Prediction(tokens, distribution, coarse, depth.log_depths, views, output)

    def step(self, params: dict, cache: VoxelCache, chunk: Chunk) -> tuple[VoxelCache, ChunkOutput]:
        """The cache after one chunk, and a summary of the chunk. Pure; the cache comes first, as the carry of a scan.

        Args:
            params: parameters, from `init` or `load_params`.
            cache: the cache before the chunk; may be donated.
            chunk: `stream.chunk_size` views in the stream frame, without leading axes. Images may have any size: they
                are padded at the right and bottom.

        Returns:
            The updated cache, and depths, confidences and exposures of the views.

        Limits:
            Tokens that find no space are dropped and counted in `cache.stats.num_dropped`: call `ensure_capacity`
            before the step and `check_cache` after it. No gradient flows through the cache.
            Inside jit, views whose camera or image cannot be used are left out and counted in
            `cache.stats.num_unusable`; outside they are refused.

        Raises:
            InputError: a shape of `chunk` is wrong, its images are not floats, JAX computes in float64, or, outside
                jit, a value cannot be used (`core.chunk.check_chunk`).
        """
        prediction = self.predict(params, cache, chunk)
        return self.update_cache(cache, prediction), prediction.output

    def update_cache(self, cache: VoxelCache, prediction: Prediction) -> VoxelCache:
        """The cache after a chunk: stored depths vote on its tokens, VACC fuses them, its views vote on all pivots.

        No gradient flows.
        """
        prediction = jax.lax.stop_gradient(prediction)
        camera, output = prediction.views.grid_camera, prediction.output
        with jax.named_scope("votes"):
            tokens = vote(cache.stored_depths, prediction.tokens, self.config)
        with jax.named_scope("VACC"):
            cache = fuse(cache, tokens, self.config, axis=self.axis)
            num_unusable = cache.stats.num_unusable + jnp.sum(prediction.views.unusable, dtype=jnp.int32)
            cache = replace(cache, stats=replace(cache.stats, num_unusable=num_unusable))
        # After fusion, so that views of one chunk that disagree lower the confidence of each other's pivots at once.
        with jax.named_scope("carve"):
            cells = seen_cells(output.depths, output.confidences, tokens.rgbs, self.config)
            needs_sight = self.config.memory.carving or self.config.head.evidence
            in_sight = rows_in_sight(cache, camera) if needs_sight else None
            cache = carve(cache, camera, cells, self.config, in_sight)
            cache = store_depths(cache, camera, cells)
        if cache.observations is None:
            return cache
        with jax.named_scope("observations"):
            return observe(cache, camera, cells, self.config, in_sight, axis=self.axis)

    def run(self, params: dict, cache: VoxelCache, chunks: Chunk) -> tuple[VoxelCache, ChunkOutput]:
        """`step` over stacked chunks (leading axis t) as one `lax.scan`.

        The cache cannot grow inside the scan: give it the capacity for all chunks first (`ensure_capacity`).

        Raises:
            InputError: the chunks are not stacked, or cannot be streamed, see `step`.
        """
        check_chunk(chunks, self.config.stream.chunk_size, stacked=True)
        return jax.lax.scan(functools.partial(self.step, params), cache, chunks)

    def decode(self, params: dict, cache: VoxelCache) -> Gaussians:
        """The scene so far, in the stream frame: `gaussians_per_token` Gaussians for each pivot, pivot by pivot.

        Gaussians of dead and carved pivots have opacity 0; with `detail` also those that a smooth patch can spare.
        """
        is_shown = shown_pivots(cache, self.config).reshape(-1)
        return self._decode(params, cache, is_shown, lambda x: x.reshape(-1, *x.shape[2:]))

    def decode_rows(
        self, params: dict, cache: VoxelCache, pivots: Int[Array, " m"], num_gaussians: int | None = None
    ) -> Gaussians:
        """The Gaussians of some pivots, equal to those of `decode`; other pivots cost nothing.

        Args:
            params: the model's parameters.
            cache: the scene.
            pivots: numbers of pivots, voxel by voxel: pivot `k` of row `r` is `r * pivots_per_voxel + k`. The
                Gaussians of -1 have opacity 0.
            num_gaussians: rows of the result. Rows with a Gaussian come first; rows of opacity 0 fill it up.
        """
        take = lambda x: x.reshape(-1, *x.shape[2:])[pivots]  # noqa: E731
        is_shown = (pivots >= 0) & take(shown_pivots(cache, self.config))
        return self._decode(params, cache, is_shown, take, num_gaussians)

    def _decode(
        self,
        params: dict,
        cache: VoxelCache,
        is_shown: Bool[Array, " m"],
        take: Callable[[Array], Array],
        num_gaussians: int | None = None,
    ) -> Gaussians:
        """Gaussians of the pivots that `take` selects; with `num_gaussians` only the rows that hold one."""
        rgbs, stored, num_members = take(cache.rgbs), take(cache.footprints), take(cache.num_members)
        footprints = grown_footprints(stored, num_members, self.config)
        shapes = network_of(self.config).read_shapes(params["decoder"], take(cache.feats), self.config)
        parts = divide_cells(rgbs, self.config)
        if cache.observations is not None:
            num_pivots = jnp.broadcast_to(cache.counts[:, None], cache.confidences.shape)
            evidence = Evidence(
                observations=take(cache.observations),
                confidences=take(cache.confidences),
                num_members=num_members.astype(jnp.float32),
                num_pivots=take(num_pivots).astype(jnp.float32),
                footprints=stored,
                growth=footprints / jnp.maximum(stored, 1e-12),
                rgbs=rgbs,
            )
            shapes, parts = apply_evidence(params["evidence"], shapes, parts, evidence, self.config)
        rows, is_kept = None, self.repeat_per_gaussian(is_shown)
        if num_gaussians is not None:
            is_present = parts.present & is_shown[:, None]
            rows = jnp.nonzero(is_present.reshape(-1), size=num_gaussians, fill_value=-1)[0]
            is_kept = rows >= 0
        gaussians = decode_tokens(
            shapes,
            means=take(cache.means),
            parts=parts,
            quats=take(cache.quats),
            footprints=footprints,
            num_members=num_members,
            config=self.config,
            rows=rows,
        )
        if cache.changes is not None:
            change = unpack(take(cache.changes))
            change = change if rows is None else jax.tree.map(lambda x: x[rows], change)
            gaussians = changed_gaussians(gaussians, change, max_scale=MAX_SCALE)
        return mask_gaussians(gaussians, is_kept)

    def decode_tokens(self, params: dict, tokens: Tokens) -> Gaussians:
        """Gaussians of tokens that are not in a cache, as training renders them (Sec. 3.7)."""
        gaussians = decode_tokens(
            network_of(self.config).read_shapes(params["decoder"], tokens.feats, self.config),
            means=tokens.means,
            parts=divide_cells(tokens.rgbs, self.config),
            quats=tokens.quats,
            footprints=tokens.footprints,
            config=self.config,
        )
        return mask_gaussians(gaussians, self.repeat_per_gaussian(tokens.valid))

    def repeat_per_gaussian(self, mask: Bool[Array, " m"]) -> Bool[Array, " n"]:
        """A mask of tokens or pivots as a mask of their Gaussians."""
        return jnp.repeat(mask, self.config.head.gaussians_per_token)


MIN_SHARE = 1 / 128
"""Least members of a pivot over the weight of the views that saw it, to be shown beside a larger one of its voxel."""


def shown_pivots(cache: VoxelCache, config: StreamConfig) -> Bool[Array, "capacity k"]:
    """Mask of the pivots that `decode` shows: alive, not carved away and not outdone.

    VACC merges the closest pair, so a token unlike all others stays a pivot of its own however often its voxel is seen
    again. Where pivots keep observations, one with fewer members than `MIN_SHARE` of their weight gives way to the
    pivot of its voxel that has most members (the first of equals), which is always shown.
    """
    is_shown = cache.alive & (cache.confidences >= config.memory.min_confidence)
    if cache.observations is None or config.memory.vacc != "voxel":
        return is_shown
    members = jnp.where(is_shown, cache.num_members, 0)
    is_largest = jnp.argmax(members, axis=1)[:, None] == jnp.arange(members.shape[1])
    least = MIN_SHARE * total_weight(cache.observations)
    return is_shown & (is_largest | (members.astype(jnp.float32) >= least))


def count_gaussians(cache: VoxelCache, config: StreamConfig) -> Int[Array, ""]:
    """Number of the Gaussians that `decode` shows."""
    rgbs = cache.rgbs.reshape(-1, cache.rgbs.shape[-1])
    is_shown = shown_pivots(cache, config).reshape(-1, 1)
    return jnp.sum(is_shown & divide_cells(rgbs, config).present, dtype=jnp.int32)


def _flatten_tokens(positions, feats, confidences, footprints, exposures, views: Views, config: StreamConfig) -> Tokens:
    """Maps flattened to tokens in order of insertion: view-major, row-major. Colors are at the scene's exposure."""
    v, hf, wf, _ = positions.shape
    colors = patch_colors(views.images, config).reshape(v, hf, wf, -1, 3) / exposures[:, None, None, None]
    quats = matrices_to_quats(jnp.swapaxes(views.viewmats[:, :3, :3], -1, -2))
    return Tokens(
        means=positions.reshape(-1, 3),
        feats=feats.reshape(v * hf * wf, -1),
        confidences=confidences.reshape(-1),
        rgbs=colors.reshape(v * hf * wf, -1),
        quats=jnp.repeat(quats, hf * wf, axis=0),
        footprints=footprints.reshape(-1),
        valid=views.inside.reshape(-1),
    )
