"""Training samples: procedural views in the stream frame, split into chunks of context views and target views."""

import collections
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ssplat_jax.config import MEDIAN_DEPTH, StreamConfig
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.pytree import pytree
from ssplat_jax.data.depth_range import FAR_FACTOR, NEAR_FACTOR
from ssplat_jax.data.procedural.procedural_views import STEP_RANGE, training_sample
from ssplat_jax.model import GRID_STRIDE
from ssplat_jax.training.recipe import Recipe

Product = TypeVar("Product")

MAX_LOG_STEP = 0.05
"""Log depths of neighboring pixels that differ by more belong to different surfaces."""
NEARLY = 1 - 1e-4
"""Factor on the farthest depth that gives one within the range."""


@pytree
class Sample:
    """`t` chunks of context views with true depths, and target views."""

    chunks: Chunk  # leading axis t
    log_depths: Float[Array, "t v hf wf"]  # true ln z at the centers of cells
    target_images: Float[Array, "s h w 3"]
    target_viewmats: Float[Array, "s 4 4"]
    target_Ks: Float[Array, "s 3 3"]

    @property
    def target_camera(self) -> Camera:
        """Cameras of the target views, as one batch."""
        height, width = self.target_images.shape[1:3]
        return Camera(viewmats=self.target_viewmats, Ks=self.target_Ks, width=width, height=height)


def choose_targets(rng: np.random.Generator, num_views: int, num_targets: int) -> np.ndarray:
    """Ascending positions of `num_targets` targets, drawn among `num_views` views but the first and the last."""
    return np.sort(rng.choice(np.arange(1, num_views - 1), size=num_targets, replace=False))


def make_sample(
    seed: int,
    *,
    num_chunks: int,
    num_targets: int,
    size: tuple[int, int],
    config: StreamConfig,
    steps_of_depth: tuple[float, float] = STEP_RANGE,
    kinds: tuple[str, ...] = (),
    range_jitter: float = Recipe.range_jitter,
) -> Sample:
    """Sample number `seed`, the same for the same arguments.

    Args:
        seed: number of the sample.
        num_chunks: chunks of context views.
        num_targets: target views.
        size: height and width of the images.
        config: gives chunk size and median depth.
        steps_of_depth: see `Phase`.
        kinds: see `Phase`.
        range_jitter: see `Recipe`.

    Raises:
        InputError: there are targets, but only one context view.
    """
    rng = np.random.default_rng([seed, 7])
    height, width = size
    num_context = num_chunks * config.stream.chunk_size
    if num_targets and num_context < 2:
        raise InputError("training: wanted context views around targets, got a context of one view; use no targets.")
    num_views = num_context + num_targets
    arrays = training_sample(seed, num_views, height, width, steps=steps_of_depth, kinds=kinds)
    images, depths, camtoworlds, Ks = (np.asarray(a) for a in arrays)
    is_target = np.zeros(num_views, bool)
    if num_targets:
        is_target[choose_targets(rng, num_views, num_targets)] = True
    context = np.flatnonzero(~is_target)

    seen = depths[context][np.isfinite(depths[context])]
    scale = MEDIAN_DEPTH / np.median(seen) * np.exp(rng.uniform(-range_jitter, range_jitter))
    viewmats = _stream_viewmats(camtoworlds.astype(np.float64), int(context[0]), float(scale))
    low, high = np.quantile(seen * scale, [0.01, 0.99])
    near = NEAR_FACTOR * low * np.exp(rng.uniform(-range_jitter, range_jitter))
    far = FAR_FACTOR * high * np.exp(rng.uniform(-range_jitter, range_jitter))
    # No candidate is as far as the sky. The last one stands for it, which draws it behind everything else.
    depths = np.where(np.isfinite(depths), depths * scale, NEARLY * far)

    return sample_of_views(
        images=images,
        depths=depths,
        viewmats=viewmats,
        Ks=Ks,
        context=context,
        targets=np.flatnonzero(is_target),
        near=near,
        far=far,
        config=config,
    )


def sample_of_views(
    *,
    images: Float[np.ndarray, "n h w 3"],
    depths: Float[np.ndarray, "n h w"],
    viewmats: Float[np.ndarray, "n 4 4"],
    Ks: Float[np.ndarray, "n 3 3"],
    context: Int[np.ndarray, " m"],
    targets: Int[np.ndarray, " s"],
    near: float,
    far: float,
    config: StreamConfig,
) -> Sample:
    """Sample of the views `context`, chunk by chunk in their order, and `targets`.

    Args:
        images: RGB in [0, 1].
        depths: camera z, stream units; NaN where unknown.
        viewmats: world to camera, stream frame.
        Ks: intrinsics, pixels.
        context: places of the context views, a multiple of the chunk size.
        targets: places of the target views.
        near: nearest depth candidate, stream units.
        far: farthest depth candidate, stream units.
        config: gives the chunk size.
    """
    num_chunks = len(context) // config.stream.chunk_size
    chunked = lambda x: x[context].reshape(num_chunks, config.stream.chunk_size, *x.shape[1:])  # noqa: E731
    return Sample(
        chunks=Chunk(
            images=jnp.asarray(chunked(images)),
            viewmats=jnp.asarray(chunked(viewmats)),
            Ks=jnp.asarray(chunked(Ks.astype(np.float32))),
            valid=jnp.ones((num_chunks, config.stream.chunk_size), bool),
            near=jnp.full(num_chunks, near, jnp.float32),
            far=jnp.full(num_chunks, far, jnp.float32),
        ),
        log_depths=jnp.asarray(log_depths_at_cells(chunked(depths))),
        target_images=jnp.asarray(images[targets]),
        target_viewmats=jnp.asarray(viewmats[targets]),
        target_Ks=jnp.asarray(Ks[targets].astype(np.float32)),
    )


def log_depths_at_cells(depths: Float[np.ndarray, "*b h w"]) -> Float[np.ndarray, "*b hf wf"]:
    """Log depths at the centers of cells: means over the four pixels around.

    Where the four differ by more than `MAX_LOG_STEP`, their mean is on no surface, and one of the four is taken.

    Limits:
        NaN where one of the four is NaN.
    """
    before = GRID_STRIDE // 2 - 1
    # Cells whose center is on the edge of the image are left out: they have pixels on one side only.
    rows, cols = ((side - before - 2) // GRID_STRIDE + 1 for side in depths.shape[-2:])
    around = np.log(
        [
            depths[..., y::GRID_STRIDE, x::GRID_STRIDE][..., :rows, :cols]
            for y in (before, before + 1)
            for x in (before, before + 1)
        ]
    )
    is_edge = np.ptp(around, axis=0) > MAX_LOG_STEP
    return np.where(is_edge, around[-1], around.mean(axis=0)).astype(np.float32)


def _stream_viewmats(camtoworlds, first: int, scale: float):
    """World-to-camera matrices with view `first` at the origin and lengths multiplied by `scale`, from float64."""
    relative = np.linalg.inv(camtoworlds[first]) @ camtoworlds
    relative[:, :3, 3] *= scale
    return np.linalg.inv(relative).astype(np.float32)


def prefetched(
    produce: Callable[[int], Product], steps: Iterable[int], workers: int = 1
) -> Generator[tuple[int, Product], None, None]:
    """Yields (step, produce(step)) in order, computed ahead in threads.

    The first is computed alone, so that the others find in caches what all of them need. An exception in `produce` is
    raised here.

    Args:
        produce: makes the samples of a step; called in the threads.
        steps: numbers of the steps.
        workers: threads. Together they are at most `2 * workers` steps ahead.
    """
    ahead: collections.deque[tuple[int, Future]] = collections.deque()
    with ThreadPoolExecutor(workers) as pool:
        try:
            for i, step in enumerate(steps):
                ahead.append((step, pool.submit(produce, step)))
                if i == 0:
                    wait([ahead[0][1]])
                if len(ahead) > 2 * workers:
                    done, future = ahead.popleft()
                    yield done, future.result()
            while ahead:
                done, future = ahead.popleft()
                yield done, future.result()
        finally:
            pool.shutdown(cancel_futures=True)
