"""Picture files: images, comparisons with a target, contact sheets, plots."""

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont

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


# -- contact sheet ----------------------------------------------------------------------------------------------------

MAX_PICTURES = 24
"""Pictures on a sheet; of more, evenly spread ones are taken."""

MAX_WIDTH = 2400  # of the sheet, pixels
GAP, LINE = 12, 22  # between pictures, and for a caption, pixels
PAPER, INK = (250, 250, 248), (60, 60, 60)


def evenly_spread(count: int, most: int) -> list[int]:
    """At most `most` places among `count`, evenly spread, the first and the last included."""
    if count <= most:
        return list(range(count))
    return [round(k * (count - 1) / (most - 1)) for k in range(most)]


def save_contact_sheet(path: Path, pictures: Sequence[tuple[Path, str]], columns: int = 2) -> int:
    """Writes a sheet of pictures with captions as JPEG.

    Args:
        path: file to write.
        pictures: image files and their captions; files that are missing are left out.
        columns: pictures side by side.

    Returns:
        The number of pictures on the sheet; with none, no file is written.

    Raises:
        StorageError: the file cannot be written.
    """
    found = [(file, caption) for file, caption in pictures if file.is_file()]
    chosen = [found[k] for k in evenly_spread(len(found), MAX_PICTURES)]
    if not chosen:
        return 0
    columns = min(columns, len(chosen))
    with Image.open(chosen[0][0]) as first:
        width, height = first.size
    shrink = min(1.0, (MAX_WIDTH - GAP) / columns / (width + GAP))
    width, height = max(1, int(width * shrink)), max(1, int(height * shrink))
    rows = math.ceil(len(chosen) / columns)
    size = (GAP + columns * (width + GAP), GAP + rows * (height + LINE + GAP))
    sheet, font = Image.new("RGB", size, PAPER), ImageFont.load_default(13)
    draw = ImageDraw.Draw(sheet)
    for place, (file, caption) in enumerate(chosen):
        x, y = GAP + place % columns * (width + GAP), GAP + place // columns * (height + LINE + GAP)
        with Image.open(file) as picture:
            sheet.paste(picture.convert("RGB").resize((width, height), Image.Resampling.LANCZOS), (x, y))
        draw.text((x, y + height + 3), caption, fill=INK, font=font)
    encoded = io.BytesIO()
    sheet.save(encoded, "JPEG", quality=88)
    write_atomic(path, encoded.getvalue())
    return len(chosen)


# -- plots ------------------------------------------------------------------------------------------------------------


def import_pyplot() -> Any | None:
    """matplotlib's pyplot, drawing without a screen; None if matplotlib (extra `plots`) is not installed."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot
    except ImportError:
        return None
    return pyplot


def save_figure(path: Path, figure: Any) -> None:
    """Writes a figure as PNG and closes it.

    Raises:
        StorageError: the file cannot be written.
    """
    from matplotlib import pyplot

    encoded = io.BytesIO()
    figure.savefig(encoded, dpi=150)
    pyplot.close(figure)
    write_atomic(path, encoded.getvalue())
