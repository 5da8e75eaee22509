"""Near and far of a causal stream, which the first chunk gives and later chunks may contradict.

A chunk contradicts an end of the range where more than `MAX_END_SHARE` of its confident cells lie in the last
`END_SHARE` of the range, counted in inverse depth: there the surface may lie beyond. That end then moves outward by
`STEP` for the chunks that follow, until far / near is `MAX_RANGE`. The ends never move inward, the chunk itself is not
streamed again, and the scale stays, because the cache is in its units.
"""

import dataclasses

import numpy as np

from ssplat_jax.config import StreamConfig
from ssplat_jax.data.depth_range import MAX_RANGE
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.model.streamsplat import ChunkOutput

END_SHARE = 1 / 32
"""Share of the range of inverse depths that counts as its end."""
MAX_END_SHARE = 0.2
"""Share of the confident cells of a chunk that may lie at an end."""
STEP = 1.5
"""Factor by which an end moves."""
MIN_CELLS = 64
"""Confident cells below which a chunk contradicts nothing."""


def widen_range(frame: StreamFrame, output: ChunkOutput, config: StreamConfig) -> StreamFrame:
    """The stream frame for the chunks after one, with near and far moved outward where that chunk contradicts them.

    Args:
        frame: the frame in which the chunk was streamed.
        output: what the step gave for the chunk.
        config: configuration of the model; cells below `min_confidence` have no say.
    """
    confidences = np.asarray(output.confidences)
    is_counted = (confidences > 0) & (confidences >= config.memory.min_confidence)
    inverse = 1.0 / np.asarray(output.depths, np.float64)[is_counted]
    if inverse.size < MIN_CELLS:
        return frame
    least, most = 1.0 / frame.far, 1.0 / frame.near
    margin = END_SHARE * (most - least)
    near, far = frame.near, frame.far
    if np.mean(inverse >= most - margin) > MAX_END_SHARE:
        near = min(near, max(near / STEP, far / MAX_RANGE))
    if np.mean(inverse <= least + margin) > MAX_END_SHARE:
        far = max(far, min(far * STEP, near * MAX_RANGE))
    return dataclasses.replace(frame, near=near, far=far)
