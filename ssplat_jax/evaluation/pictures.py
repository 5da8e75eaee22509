"""Picture files: images, and comparisons with a target."""

import io
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.false_colors import color_depth, eight_bits


def save_image(path: Path, image: Float[np.ndarray, "h w 3"]) -> None:
    """Writes an image in [0, 1] as an 8-bit file in the format of the suffix.

    Raises:
        StorageError: the file cannot be written.
    """
    encoded = io.BytesIO()
    Image.fromarray(eight_bits(image)).save(encoded, Image.registered_extensions()[path.suffix.lower()])
    write_atomic(path, encoded.getvalue())


def save_comparison(
    path: Path,
    target: Float[np.ndarray, "h w 3"],
    color: Float[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    depth_range: tuple[float, float],
) -> None:
    """Writes target | render | depth side by side.

    Args:
        path: file to write; its suffix names the format.
        target: image in [0, 1].
        color: render in [0, 1].
        depth: depth of the render, 0 where nothing is.
        depth_range: nearest and farthest depth of the color scale, in the units of `depth`.

    Raises:
        StorageError: the file cannot be written.
    """
    save_image(path, np.concatenate([target, color, color_depth(depth, *depth_range)], axis=1))


def evenly_spread(count: int, most: int) -> list[int]:
    """At most `most` places among `count`, evenly spread, the first and the last included."""
    if count <= most:
        return list(range(count))
    return [round(k * (count - 1) / (most - 1)) for k in range(most)]
