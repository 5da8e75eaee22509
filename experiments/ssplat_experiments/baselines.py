"""Baselines of a stream: views without a scene, and the same network over all views at once."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import map_coordinates

from ssplat_jax.cache.state import init_cache
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.chunk import Chunk
from ssplat_jax.core.gaussians import Gaussians, mask_gaussians
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.cost import abstract, added_bytes, live_bytes, memory_row, render_bytes
from ssplat_jax.evaluation.metrics import installed_lpips
from ssplat_jax.evaluation.scoring import ImageScore, exposure_for, nearest_views, score_image
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.streaming.session import Exposures


def baseline_scores(
    capture: Capture,
    i: int,
    context: Sequence[int],
    stream_frame: StreamFrame,
    depth: Float[np.ndarray, "h w"],
    exposures: Exposures,
) -> dict[str, dict[str, ImageScore]]:
    """Scores of the baselines at target `i`; of the target, its pose and intrinsics alone are used.

    Args:
        capture: the capture with the images.
        i: frame number of the target.
        context: frame numbers of the streamed views.
        stream_frame: the similarity between the capture's frame and the stream's.
        depth: depth of the scene, rendered at the target, in stream units; 0 where nothing is. It warps.
        exposures: exposures of the streamed frames, as the stream estimated them.

    Returns:
        By baseline the scores `literal`, as the images are and black where the warp has none, and `shown`, at the
        exposure of the nearest views, with holes of the warp taken from the copy.
    """
    nearest = nearest_views(capture, i, context)[0]
    copy, target = capture.image(nearest), capture.image(i)
    mean = np.mean([capture.image(j).mean(axis=(0, 1)) for j in context], axis=0)
    warped, known = warp(copy, capture.camera(nearest, stream_frame), capture.camera(i, stream_frame), depth)
    gain = exposure_for(capture, i, exposures) / exposure_for(capture, nearest, exposures)
    flat = np.broadcast_to(mean, target.shape).astype(np.float32)
    images = {
        "copy nearest": (copy, copy * gain),
        "mean color": (flat, flat),
        "warp nearest": (warped, np.where(known[..., None], warped, copy) * gain),
    }
    return {
        name: {"literal": _score(literal, target), "shown": _score(shown, target)}
        for name, (literal, shown) in images.items()
    }


def _score(image: np.ndarray, target: np.ndarray) -> ImageScore:
    return score_image(np.clip(image, 0.0, 1.0).astype(np.float32), target, installed_lpips())


def warp(
    image: Float[np.ndarray, "h w 3"], source: Camera, target: Camera, depth: Float[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """The source image at the target, each pixel taken from where its surface point lies in the source.

    Args:
        image: the source image.
        source: camera of the image, in the frame of `depth`.
        target: camera of the result.
        depth: camera z at the target's pixels; 0 where unknown.

    Returns:
        The warped image, black where there is no depth or the point lies outside the source, and the mask of the rest.
        Occlusion is not resolved: a hidden point takes the color of what hides it.
    """
    height, width = depth.shape
    y, x = np.mgrid[:height, :width] + 0.5
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    rays = pixels @ np.linalg.inv(np.asarray(target.Ks, np.float64)).T
    between = np.asarray(source.viewmats, np.float64) @ np.linalg.inv(np.asarray(target.viewmats, np.float64))
    points = (rays * depth[..., None]) @ between[:3, :3].T + between[:3, 3]
    projected = points @ np.asarray(source.Ks, np.float64).T
    is_ahead = (depth > 0) & (points[..., 2] > 1e-6)
    u, v = (projected[..., c] / np.where(is_ahead, projected[..., 2], 1.0) - 0.5 for c in (0, 1))
    inside = (u > -0.5) & (u < image.shape[1] - 0.5) & (v > -0.5) & (v < image.shape[0] - 0.5)
    known = is_ahead & inside
    channels = [map_coordinates(image[..., c], [v, u], order=1, mode="nearest") for c in range(3)]
    return np.where(known[..., None], np.stack(channels, axis=-1), 0.0).astype(np.float32), known


def joint_config(config: StreamConfig, num_views: int) -> StreamConfig:
    """`config` with all views in one chunk and nothing that reads a memory."""
    return config.replace(chunk_size=num_views, hpda=False, cgfi=False, carving=False)


class JointNetwork:
    """The network for a number of views, all of which are matched, mixed and decoded together.

    Args:
        config: configuration of the stream that it is compared with.
        params: the parameters of that stream.
        chunk: all views, as one chunk.
    """

    def __init__(self, config: StreamConfig, params: dict, chunk: Chunk) -> None:
        self.params, self.chunk = params, chunk
        self.program = program(joint_config(config, len(chunk.images)), *abstract((params, chunk)))

    def gaussians(self) -> Gaussians:
        """The scene of all views, in the stream frame."""
        return jax.block_until_ready(self.program(self.params, self.chunk))

    def peak_memory(self, camera: Camera) -> dict[str, int | str | None]:
        """Memory of running the network, which decodes within, and of rendering a view."""
        gaussians = self.gaussians()
        rendering = render_bytes(gaussians, camera)
        added, held = added_bytes(self.program), live_bytes((self.params, gaussians))
        return memory_row(
            step=(network := None if added is None else added + live_bytes((self.params, self.chunk))),
            decode=network,
            render=None if rendering is None else held + rendering,
        )


@functools.lru_cache(maxsize=4)
def program(config: StreamConfig, structure: Any, leaves: tuple) -> jax.stages.Compiled:
    """The compiled network for the shapes of its parameters and views."""
    model = StreamSplat(config)

    def decode_all(params: dict, chunk: Chunk) -> Gaussians:
        tokens = model.predict(params, init_cache(config), chunk).tokens
        accepted = tokens.valid & (tokens.confidences >= config.memory.min_confidence)
        return mask_gaussians(model.decode_tokens(params, tokens), model.repeat_per_gaussian(accepted))

    return jax.jit(decode_all).lower(*structure.unflatten(leaves)).compile()


def one_chunk(chunks: list[Chunk]) -> Chunk:
    """All valid views of a list of chunks as one chunk."""
    joined = jax.tree.map(lambda *parts: jnp.concatenate(parts) if parts[0].ndim else parts[0], *chunks)
    keep = jnp.nonzero(joined.valid)[0]
    return jax.tree.map(lambda x: x[keep] if x.ndim else x, joined)
