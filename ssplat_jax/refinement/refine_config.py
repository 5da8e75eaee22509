"""Static configuration of refinement. No JAX here."""

import dataclasses

from ssplat_jax.core.errors import InputError


@dataclasses.dataclass(frozen=True)
class RefineConfig:
    """Settings of refinement; learning rates and bounds are constants of `refine_step.py`. Frozen and hashable."""

    sh_degree: int = 0
    """SH degree that the scene gets, unless its own is higher: 0 adds no band."""
    views_per_step: int = 2
    """Key views whose gradients a step averages: a Gaussian that few views show moves more often."""
    shown_weight: float = 0.7
    """Weight of the L1 error with holes filled; the rest is the L1 error over black."""
    held_back: float = 1 / 32
    """Fraction of 8 x 8 pixel blocks that no gradient sees; their error says whether refinement still helps."""
    seed: int = 0
    """Seed of the order of views and of the pixels that are held back."""

    def __post_init__(self) -> None:
        self._require("sh_degree", "0 to 3", self.sh_degree in range(4))
        self._require("views_per_step", "at least 1", self.views_per_step >= 1)
        self._require("shown_weight", "in [0, 1]", 0 <= self.shown_weight <= 1)
        self._require("held_back", "in [0, 0.5]", 0 <= self.held_back <= 0.5)

    def _require(self, name: str, wanted: str, is_good: bool) -> None:
        if not is_good:
            raise InputError(f"refine: {name} must be {wanted}, got {getattr(self, name)!r}.")


FOR_CAPTURES = RefineConfig(sh_degree=2)
"""Configuration for scenes that a stream made of captures: colors of real surfaces depend on the direction of view."""
