"""Interleaving of slow video, so that the views of a chunk are far enough apart to measure depth.

Frames of a video are often less than a hundredth of the depth apart, and four consecutive ones have too little
parallax. Interleaved over `s` chunks, frames 0, s, 2s, 3s form the first chunk, 1, s + 1, ... the second, and so on:
every frame is used, and none is delayed by more than a block of `chunk_size * s` frames. The order depends on poses
only, so it is known before an image is read.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

MAX_INTERLEAVED_CHUNKS = 8
"""Largest number of chunks interleaved at a time: with chunks of 4, 32 frames or about a second of video."""


def interleave(centers: Float64[np.ndarray, "n 3"], indices: Sequence[int], chunk_size: int, step: float) -> list[int]:
    """Orders frames so that consecutive views of a chunk are about `step` apart.

    Args:
        centers: camera centers of the frames `indices`, in any unit.
        indices: frames in the order of the stream.
        chunk_size: views of a chunk.
        step: wanted distance between consecutive views of a chunk, in the unit of `centers`; 0 keeps the order.

    Returns:
        A permutation of `indices`. Blocks of `chunk_size * s` frames are interleaved one after the other, with s from 1
        to `MAX_INTERLEAVED_CHUNKS`. Frames that are `step` apart already and frames that do not move keep their order.
    """
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=-1)
    order: list[int] = []
    while len(order) < len(indices):
        first = len(order)
        ahead = steps[first : first + chunk_size * MAX_INTERLEAVED_CHUNKS - 1]
        typical = float(np.median(ahead)) if ahead.size else 0.0
        num_chunks = int(np.clip(round(step / typical), 1, MAX_INTERLEAVED_CHUNKS)) if typical > 0 else 1
        block = list(indices[first : first + chunk_size * num_chunks])
        num_chunks = -(-len(block) // chunk_size)
        for chunk in range(num_chunks):
            order += block[chunk::num_chunks]
    return order
