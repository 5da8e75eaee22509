"""Parts of finished streams from which HPDA's anchor learns: what matcher and cache say of cells, and the true depths.

Nothing before the anchor learns here. So every stream runs once, what the anchor reads of it is kept, and a step costs
a small network on a part of a chunk. The streams run with the anchor as it is before training. Half of them have their
views in order; in the others they are dealt out, so that chunks have parallax and the matcher is often right.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped

from ssplat_jax.cache.state import VoxelCache
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.pytree import pytree
from ssplat_jax.model.hpda import AnchorInputs, anchor_inputs
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.model.views import GRID_STRIDE
from ssplat_jax.training.samples import CaptureMix, TrainingStart, ViewSamples

DEALT_OUT = 0.5  # share of the streams whose views are dealt out


@pytree
class AnchorSample:
    """A part of the cells of a chunk; with a leading axis, a batch of them."""

    inputs: AnchorInputs
    log_candidates: Float[Array, "*b d"]
    log_depths: Float[Array, "*b v hm wm"]  # true ones; NaN where unknown
    usable: Bool[Array, "*b v hm wm"]  # cells of the image


@dataclasses.dataclass(frozen=True)
class StreamParts:
    """Samples of a phase that learns how far to trust the cache."""

    views: ViewSamples  # the streams
    num_streams: int = 120  # streams that are run once, before the first step
    size: tuple[int, int] = (32, 48)  # height and width of the parts in cells; smaller where the image is
    batch: int = 2  # parts per step, each of another chunk; the loss is their mean
    capacity: int = 1 << 15  # voxels of a stream's cache

    def check(self, mix: CaptureMix, config: StreamConfig, *, renders: bool) -> None:
        """Refuses captures without depth maps, and those with too few frames."""
        self.views.check(mix, config, renders=renders)

    def open(self, start: TrainingStart) -> Callable[[int, int], AnchorSample]:
        """Runs all streams; gives the parts of a step by its number and its place in the phase."""
        config = start.model.config.replace(causal=True, capacity=self.capacity, overflow="drop_new")
        start = dataclasses.replace(start, mix=start.mix and dataclasses.replace(start.mix, config=config))
        model, make, kept = StreamSplat(config), self.views.open(start), []
        for number in range(self.num_streams):
            sample = jax.tree.map(lambda x: x[0], make(number, number))
            chunks, truths = sample.chunks, sample.log_depths
            if np.random.default_rng([start.seed, number, 23]).uniform() < DEALT_OUT:
                views = (chunks.images, chunks.viewmats, chunks.Ks, chunks.seen)
                images, viewmats, Ks, seen = jax.tree.map(deal_out, views)
                chunks = dataclasses.replace(chunks, images=images, viewmats=viewmats, Ks=Ks, seen=seen)
                truths = deal_out(truths)
            cache = model.init_cache()
            for t in range(self.views.num_chunks):
                chunk, truth = jax.tree.map(lambda x, t=t: x[t], (chunks, truths))
                cache, part = _stream(model, start.params, cache, chunk, truth)
                if t:  # the first chunk finds an empty cache
                    # As float16, in which a thousand chunks take some 2 GB.
                    half = lambda x: np.asarray(x, np.float16 if x.dtype == jnp.float32 else x.dtype)  # noqa: E731
                    kept.append(dataclasses.replace(part, inputs=jax.tree.map(half, part.inputs)))
            start.say(f"streamed {number + 1} of {self.num_streams}")

        def part_of(number: int) -> AnchorSample:
            rng = np.random.default_rng([start.seed, number, 19])
            chunk = kept[rng.integers(len(kept))]
            free = [max(whole - side, 0) for whole, side in zip(chunk.usable.shape[1:], self.size, strict=True)]
            firsts = rng.integers(0, free, endpoint=True)
            rows, columns = (slice(k, k + side) for k, side in zip(firsts, self.size, strict=True))
            cut = lambda x: np.asarray(x)[:, rows, columns]  # noqa: E731
            as_floats = lambda x: jnp.asarray(x, jnp.float32 if x.dtype == np.float16 else x.dtype)  # noqa: E731
            return AnchorSample(
                jax.tree.map(lambda x: as_floats(cut(x)), chunk.inputs),
                chunk.log_candidates,
                jnp.asarray(cut(chunk.log_depths)),
                jnp.asarray(cut(chunk.usable)),
            )

        def batch(step: int, place: int) -> AnchorSample:
            parts = [part_of(self.batch * step + i) for i in range(self.batch)]
            return jax.tree.map(lambda *xs: jnp.stack(xs), *parts)

        return batch


def deal_out(x: Shaped[Array, "t v *rest"]) -> Shaped[Array, "t v *rest"]:
    """Views in order, by chunk, dealt out among the chunks: the first chunk gets every `t`-th view."""
    return jnp.swapaxes(x.reshape(x.shape[1], x.shape[0], *x.shape[2:]), 0, 1)


@functools.partial(jax.jit, static_argnums=0, donate_argnums=2)
def _stream(
    model: StreamSplat, params: dict, cache: VoxelCache, chunk: Chunk, log_depths: Float[Array, "v hf wf"]
) -> tuple[VoxelCache, AnchorSample]:
    """The cache after a chunk, and all cells of the chunk."""
    prediction, factor = model.predict(params, cache, chunk), model.config.network.match_stride // GRID_STRIDE
    views = prediction.views
    shape = views.inside.shape
    padded = [(0, n - m) for m, n in zip(log_depths.shape, shape, strict=True)]  # as images are; `usable` leaves it out
    log_depths = jnp.pad(log_depths, padded, constant_values=jnp.nan)
    inputs = anchor_inputs(prediction.distribution, prediction.history, views, model.config)
    coarse = np.s_[:, ::factor, ::factor]
    part = AnchorSample(inputs, views.log_candidates, log_depths[coarse], views.inside[coarse])
    return model.update_cache(cache, prediction), part
