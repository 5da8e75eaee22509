"""Refinement of a stream's scene on the frames that were streamed."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.data.capture import Capture
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.errors import InputError
from ssplat_jax.gaussians import Gaussians
from ssplat_jax.geometry.cameras import Camera
from ssplat_jax.refinement.key_views import KeyViews
from ssplat_jax.refinement.refine import Refinement, continue_refinement, report_of, start_refinement
from ssplat_jax.refinement.refine_config import RefineConfig
from ssplat_jax.refinement.refine_step import current_gaussians
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
        steps: most gradient steps.
        config: learning rates and bounds.
        on_step: called with the number of steps done and the last loss.

    Returns:
        The revised scene, in the stream frame, and what was done.

    Raises:
        InputError: `steps` is negative, or a frame was not streamed.
    """
    views = key_views_of(capture, indices, frame, exposures)
    progress = start_refinement(gaussians, views, config)
    for _ in continue_refinement(progress, views, steps, config):
        on_step(progress.num_steps, progress.losses[-1])
    return current_gaussians(progress.state), report_of(progress, views, config)


def key_views_of(capture: Capture, indices: Sequence[int], frame: StreamFrame, exposures: Exposures) -> KeyViews:
    """At most `MAX_KEY_VIEWS` streamed frames of a capture, evenly spread.

    Args:
        capture: where the images come from, at the size that is compared.
        indices: frame numbers that were streamed.
        frame: the similarity between the capture's frame and the stream's.
        exposures: factor per streamed frame, as the stream estimated it.

    Returns:
        The key views, their cameras in the stream frame.

    Raises:
        InputError: a frame was not streamed.
    """
    if missing := [i for i in indices if i not in exposures]:
        raise InputError(f"refine: wanted frames that were streamed, got frame {missing[0]}, which was not.")
    places = np.linspace(0, len(indices) - 1, min(len(indices), MAX_KEY_VIEWS))
    used = [indices[i] for i in sorted({round(place) for place in places})]
    views = [capture.camera(i, frame) for i in used]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *views)
    cameras = Camera(viewmats=stacked.viewmats, Ks=stacked.Ks, width=capture.width, height=capture.height)
    images = jnp.stack([jnp.asarray(capture.image(i)) for i in used])
    factors = jnp.asarray(np.stack([exposures[i] for i in used]), jnp.float32)
    return KeyViews.of(cameras, images, factors)
