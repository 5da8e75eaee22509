"""Plots by matplotlib (extra `plots`)."""

import io
from pathlib import Path
from typing import Any

from ssplat_jax.core.atomic import write_atomic


def import_pyplot() -> Any | None:
    """matplotlib's pyplot, drawing without a screen; None if matplotlib is not installed."""
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
