"""The order in which a stream takes its frames: video is dealt out, so that the views of a chunk stand apart.

Frames of a video step less than a hundredth of the depth; four in a row cannot tell how far anything is. Dealt into
`s` chunks like cards, frames 0, s, 2s, 3s come first, then 1, s + 1 and so on: every frame is used, and a frame waits
for at most the `chunk_size * s` around it. Poses alone decide, so the order is known before an image is read.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

MOST_HANDS = 8  # chunks dealt at a time: 32 frames of video, about a second


def deal(centers: Float64[np.ndarray, "n 3"], indices: Sequence[int], chunk_size: int, step: float) -> list[int]:
    """`indices` in an order in which the views of a chunk are about `step` apart, or as far as the frames themselves.

    Args:
        centers: camera centers of the frames `indices`, in any unit.
        indices: frames in the order of the stream.
        chunk_size: views of a chunk.
        step: wanted distance between consecutive views of a chunk, in the unit of `centers`; 0 keeps the order.

    Limits:
        Frames that already step `step` or more, and frames that do not move, stay in order.
        A permutation always: blocks of `chunk_size * s` frames, s between 1 and `MOST_HANDS`, are dealt one by one.
    """
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=-1)
    order: list[int] = []
    while len(order) < len(indices):
        first = len(order)
        ahead = steps[first : first + chunk_size * MOST_HANDS - 1]
        typical = float(np.median(ahead)) if ahead.size else 0.0
        hands = int(np.clip(round(step / typical), 1, MOST_HANDS)) if typical > 0 else 1
        block = list(indices[first : first + chunk_size * hands])
        hands = -(-len(block) // chunk_size)
        for hand in range(hands):
            order += block[hand::hands]
    return order
