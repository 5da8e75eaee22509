"""Novel views without a scene: the nearest context view, that view warped by depth, and one color."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import map_coordinates

from ssplat_jax.core.cameras import Camera
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.scoring import ImageScore, exposure_for, nearest_views, score_image
from ssplat_jax.streaming.feed import Exposures

BASELINES = ("copy nearest", "mean color", "warp nearest")


def baseline_scores(
    capture: Capture,
    i: int,
    context: Sequence[int],
    frame: StreamFrame,
    depth: Float[np.ndarray, "h w"],
    exposures: Exposures,
) -> dict[str, dict[str, ImageScore]]:
    """Scores of the baselines at target `i`; of the target, its pose and intrinsics alone are used.

    Args:
        capture: the capture with the images.
        i: frame number of the target.
        context: frame numbers of the streamed views.
        frame: the similarity between the capture's frame and the stream's.
        depth: depth of the scene, rendered at the target, in stream units; 0 where nothing is. It warps.
        exposures: exposures of the streamed frames, as the stream estimated them.

    Returns:
        By baseline the scores `literal`, as the images are and black where the warp has none, and `shown`, at the
        exposure of the nearest views, with holes of the warp taken from the copy.
    """
    nearest = nearest_views(capture, i, context)[0]
    copy, target = capture.image(nearest), capture.image(i)
    mean = np.mean([capture.image(j).mean(axis=(0, 1)) for j in context], axis=0)
    warped, known = warp(copy, capture.camera(nearest, frame), capture.camera(i, frame), depth)
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
    return score_image(np.clip(image, 0.0, 1.0).astype(np.float32), target)


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
