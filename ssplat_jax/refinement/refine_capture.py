"""Refinement of a stream's scene on the frames that were streamed."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.refinement.refine import Refinement, continue_refinement, report_of, start_refinement
from ssplat_jax.refinement.refine_config import FOR_CAPTURES, RefineConfig
from ssplat_jax.streaming.feed import Exposures

MAX_KEY_VIEWS = 128
"""Most frames that are kept for refinement, evenly spread over the stream: their memory does not grow with it."""


def refine_on_capture(
    gaussians: Gaussians,
    capture: Capture,
    indices: Sequence[int],
    frame: StreamFrame,
    exposures: Exposures,
    *,
    steps: int,
    config: RefineConfig | None = None,
    on_step: Callable[[int, float], None] = lambda step, loss: None,
) -> tuple[Gaussians, Refinement]:
    """The scene of a stream, revised on at most `MAX_KEY_VIEWS` of its own frames.

    Args:
        gaussians: the decoded scene, in the stream frame.
        capture: where the images come from, at the size that is compared.
        indices: frame numbers that were streamed.
        frame: the similarity between the capture's frame and the stream's.
        exposures: factor per streamed frame, as the stream estimated it.
        steps: most refinement steps; with 0 the scene comes back as it is.
        config: learning rates, bounds and SH degree; default `FOR_CAPTURES`.
        on_step: called with the number of steps done and the last loss.

    Returns:
        The refined scene in the stream frame, and the report.

    Raises:
        InputError: `steps` is negative, or a frame was not streamed.
    """
    if steps < 0:
        raise InputError(f"refine: steps must be at least 0, got {steps}.")
    given = key_views_of(capture, indices, frame, exposures)
    if steps == 0:
        return gaussians, Refinement(0, 0, [], [], False, 0.0)
    config = config or FOR_CAPTURES
    progress, views = start_refinement(gaussians, given, config)
    for _ in continue_refinement(progress, views, steps, config):
        on_step(progress.num_steps, progress.losses[-1])
    return progress.scene(gaussians), report_of(progress, views, config)


def key_frames(indices: Sequence[int]) -> list[int]:
    """The streamed frames that become key views: at most `MAX_KEY_VIEWS`, evenly spread."""
    places = np.linspace(0, len(indices) - 1, min(len(indices), MAX_KEY_VIEWS))
    return [indices[i] for i in sorted({round(place) for place in places})]


def key_views_of(capture: Capture, indices: Sequence[int], frame: StreamFrame, exposures: Exposures) -> KeyViews:
    """The streamed frames that `key_frames` chooses, with their cameras in the stream frame.

    Args:
        capture: where the images come from, at the size that is compared.
        indices: frame numbers that were streamed.
        frame: the similarity between the capture's frame and the stream's.
        exposures: factor per streamed frame, as the stream estimated it.

    Raises:
        InputError: a frame was not streamed.
    """
    if missing := [i for i in indices if i not in exposures]:
        raise InputError(f"refine: wanted frames that were streamed, got frame {missing[0]}, which was not.")
    used = key_frames(indices)
    views = [capture.camera(i, frame) for i in used]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *views)
    cameras = Camera(viewmats=stacked.viewmats, Ks=stacked.Ks, width=capture.width, height=capture.height)
    # Frame by frame: as floats, all images would take four times the memory of the key views.
    images = jnp.asarray(np.stack([_to_uint8(capture.image(i)) for i in used]))
    factors = jnp.asarray(np.stack([exposures[i] for i in used]), jnp.float32)
    return KeyViews.of(cameras, images, factors)


def _to_uint8(image: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """An image in [0, 1] as `KeyViews.of` stores it."""
    return np.round(np.clip(image, 0.0, 1.0) * np.float32(255)).astype(np.uint8)
