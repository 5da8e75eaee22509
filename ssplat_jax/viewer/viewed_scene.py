"""A scene as the viewer shows it, and what is known of the run that made it."""

import dataclasses

import numpy as np
from jaxtyping import Float

from ssplat_jax.core.gaussians import Gaussians


@dataclasses.dataclass(frozen=True, eq=False)
class ViewedScene:
    """Gaussians in the capture's frame, relative to an offset."""

    gaussians: Gaussians
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the positions, in the capture's frame
    exposure: Float[np.ndarray, "3"] = dataclasses.field(default_factory=lambda: np.ones(3))
    """RGB factor from the exposure of the run's first views to that of the colors."""
    confidences: Float[np.ndarray, " n"] | None = None  # of the pivots behind the Gaussians; None where unknown
    render_mode: str = "mip"  # the renderer that the scene was made for, see `save_ply`

    @property
    def antialias(self) -> str:
        """The rasterizer's filter for the scene."""
        return "classic" if self.render_mode == "default" else "mip"
