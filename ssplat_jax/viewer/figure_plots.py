"""Plots in a browser's panel that grow with the run."""

from typing import Any

import numpy as np

from ssplat_jax.viewer.recorded_run import RecordedRun, figures

COLOR, ASPECT = "#3b6ea5", 1.8


class FigurePlots:
    """The plots of one browser; a plot is there once it has two points.

    Args:
        client: viser's handle of the browser.
        folder: the handle of the panel's folder that they go into.
    """

    def __init__(self, client: Any, folder: Any) -> None:
        self._client, self._folder = client, folder
        self._plots: dict[str, Any] = {}

    def show(self, run: RecordedRun) -> None:
        """Draws the figures of a run."""
        from viser import uplot

        for title, (x, y) in figures(run.records).items():
            finite = np.isfinite(x) & np.isfinite(y)
            data = (x[finite], y[finite])
            if title in self._plots:
                self._plots[title].data = data
            elif finite.sum() > 1:
                with self._folder:
                    self._plots[title] = self._client.gui.add_uplot(
                        data=data,
                        series=(uplot.Series(label="views"), uplot.Series(label=title, stroke=COLOR, width=2)),
                        scales={"x": uplot.Scale(time=False, auto=True), "y": uplot.Scale(auto=True)},
                        title=title,
                        legend=uplot.Legend(show=False),
                        aspect=ASPECT,
                    )
