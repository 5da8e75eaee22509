"""Depth as colors of a picture, and pictures in 8 bits."""

import numpy as np
from jaxtyping import Float, UInt8

_DEPTH_COLORS = np.array(  # near to far, perceptually even, readable in print
    [(0.99, 0.91, 0.62), (0.97, 0.60, 0.32), (0.80, 0.27, 0.37), (0.47, 0.13, 0.48), (0.13, 0.07, 0.33)], np.float32
)


def color_depth(depth: Float[np.ndarray, "h w"], near: float, far: float) -> Float[np.ndarray, "h w 3"]:
    """Log depth as color, light near and dark far; black where depth is 0."""
    position = np.log(np.maximum(depth, 1e-9) / near) / np.log(far / near)
    stops = np.linspace(0.0, 1.0, len(_DEPTH_COLORS))
    colors = np.stack([np.interp(position, stops, _DEPTH_COLORS[:, c]) for c in range(3)], axis=-1)
    return np.where(depth[..., None] > 0, colors, 0.0).astype(np.float32)


def scale_ends(depths: Float[np.ndarray, "*s"]) -> tuple[float, float]:
    """Ends (near, far) of a color scale for depths: their 2 % and 98 % quantiles, at least half as far again apart.

    Limits:
        (1, 1.5) without depths. A flat wall has about one color, not that of its noise.
    """
    if depths.size == 0:
        return 1.0, 1.5
    near, far = np.quantile(depths, (0.02, 0.98))
    return float(near), float(max(far, 1.5 * near))


def eight_bits(image: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """An image in [0, 1] as 8-bit values."""
    return (np.clip(image, 0.0, 1.0) * 255 + 0.5).astype(np.uint8)
