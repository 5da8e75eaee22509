"""Unit quaternions without their largest entry, which the other three imply; the common core of packed rotations."""

import numpy as np
from jaxtyping import Float, Float64, Int

HALF_RANGE = np.sqrt(0.5)
"""Upper bound of the magnitude of every entry but the largest."""


def drop_largest(quats: Float64[np.ndarray, "n 4"]) -> tuple[Int[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
    """Index of the largest entry of each quaternion, and the others, signed so that the largest is positive."""
    largest = np.abs(quats).argmax(axis=1)
    rows = np.arange(len(quats))
    quats = quats * np.copysign(1.0, quats[rows, largest])[:, None]
    others = quats[np.arange(4) != largest[:, None]].reshape(-1, 3)
    return largest, others


def restore_largest(largest: Int[np.ndarray, " n"], others: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 4"]:
    """The unit quaternions of `drop_largest`."""
    quats = np.zeros((len(others), 4))
    is_largest = np.arange(4) == largest[:, None]
    quats[~is_largest] = others.reshape(-1)
    quats[is_largest] = np.sqrt(np.maximum(1.0 - np.sum(np.square(others, dtype=np.float64), axis=1), 0.0))
    return quats
