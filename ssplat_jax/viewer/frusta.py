"""The streamed cameras in a browser: frusta with their pictures. A click on one moves the browser to its camera."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float64

from ssplat_jax.storage.chunk_records import RecordedView, open_thumbnail
from ssplat_jax.viewer.browser_camera import wxyz_of

SIZE = 0.06
"""Depth of a frustum, in the browser's units, in which the first camera looks at a point at distance 1."""

MOST = 300
"""Frusta that are shown; of more views, evenly spread ones are."""

COLOR, THICKNESS = (70, 110, 165), 1.5  # the thickness in pixels


class Frusta:
    """The frusta of one browser.

    Args:
        client: viser's handle of the browser.
        go_to: called with the pose of a frustum that was clicked.
    """

    def __init__(self, client: Any, go_to: Callable[[Float64[np.ndarray, "4 4"]], None]) -> None:
        self._client, self._go_to = client, go_to
        self._nodes: dict[int, Any] = {}  # by frame

    def show(self, views: list[tuple[RecordedView, Float64[np.ndarray, "4 4"]]], size: tuple[int, int]) -> None:
        """Shows these views, and no others.

        Args:
            views: the views, and their poses in the browser's units.
            size: (width, height) of their images, pixels.
        """
        if len(views) > MOST:
            views = [views[round(k)] for k in np.linspace(0, len(views) - 1, MOST)]
        wanted = {view.frame for view, _ in views}
        for frame in [frame for frame in self._nodes if frame not in wanted]:
            self._nodes.pop(frame).remove()
        for view, pose in views:
            if view.frame not in self._nodes:
                self._nodes[view.frame] = self._add(view, pose, size)

    def _add(self, view: RecordedView, pose: Float64[np.ndarray, "4 4"], size: tuple[int, int]) -> Any:
        width, height = size
        node = self._client.scene.add_camera_frustum(
            f"/cameras/{view.frame}",
            fov=float(2 * np.arctan(height / 2 / view.K[1, 1])),
            aspect=width / height,
            scale=SIZE,
            color=COLOR,
            thickness=THICKNESS,
            thickness_units="screen",
            image=open_thumbnail(view.thumbnail),
            wxyz=wxyz_of(pose),
            position=pose[:3, 3],
        )
        node.on_click(lambda _: self._go_to(pose))
        return node
