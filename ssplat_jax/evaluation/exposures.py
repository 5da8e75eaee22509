"""Exposures of streamed frames as JSON, and the exposure at which a novel view is shown."""

import numpy as np
from jaxtyping import Float

from ssplat_jax.data.capture import Capture
from ssplat_jax.evaluation.nearest_views import nearest_views
from ssplat_jax.streaming.feed import Exposures

NUM_AVERAGED = 3
"""Streamed frames whose exposures are averaged for a novel view."""


def exposures_to_json(exposures: Exposures) -> dict[str, list[float]]:
    """Exposures as results and saved states hold them; exact."""
    return {str(i): np.asarray(exposures[i], np.float64).tolist() for i in sorted(exposures)}


def exposures_from_json(fields: dict[str, list[float]]) -> Exposures:
    """The inverse of `exposures_to_json`."""
    return {int(i): np.array(exposure, np.float32) for i, exposure in fields.items()}


def exposure_for(capture: Capture, i: int, exposures: Exposures) -> Float[np.ndarray, "3"]:
    """The exposure to show frame `i` at: its own if it was streamed, else the geometric mean of the nearest frames'."""
    if not exposures:
        return np.ones(3)
    nearest = [i] if i in exposures else nearest_views(capture, i, tuple(exposures))[:NUM_AVERAGED]
    return np.exp(np.mean([np.log(np.asarray(exposures[j], np.float64)) for j in nearest], axis=0))
