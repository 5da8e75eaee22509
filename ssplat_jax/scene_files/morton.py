"""Morton order: positions that are near each other in space stay near each other in the file."""

import numpy as np
from jaxtyping import Float, Int

BITS = 21
"""Bits of each coordinate: three of them fit a 64-bit key."""

SPREADING = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that put two zeros between neighboring bits."""


def morton_order(means: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Order of the positions along a Z curve through their bounding box; ties stay in their order."""
    if len(means) == 0:
        return np.zeros(0, np.int64)
    low, high = means.min(axis=0), means.max(axis=0)
    size = np.where(high > low, high - low, 1.0)
    cells = ((means - low) / size * ((1 << BITS) - 1)).astype(np.uint64)
    for shift, mask in SPREADING:
        cells = (cells | cells << np.uint64(shift)) & np.uint64(mask)
    keys = cells[:, 0] | cells[:, 1] << np.uint64(1) | cells[:, 2] << np.uint64(2)
    return np.argsort(keys, kind="stable")
