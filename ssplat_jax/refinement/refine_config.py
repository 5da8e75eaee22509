"""Static configuration of refinement. No JAX here."""

import dataclasses
import math

from ssplat_jax.core.errors import InputError


@dataclasses.dataclass(frozen=True)
class RefineConfig:
    """Learning rates, loss weights and bounds of `refine_step`. Frozen and hashable.

    Learning rates are those of Adam: about the change per step of a parameter whose gradient keeps its sign.
    """

    mean_rate: float = 0.04
    """Step of a mean, as a fraction of the Gaussian's own size (the mean of its two larger standard deviations)."""
    log_scale_rate: float = 0.02
    """Step of a log standard deviation."""
    quat_rate: float = 0.003
    """Step of a unit quaternion's entry."""
    logit_opacity_rate: float = 0.2
    """Step of an opacity's logit."""
    color_rate: float = 0.015
    """Step of the constant color band, in units of color."""
    sh_rate: float = 0.1
    """Step of the higher SH bands, as a fraction of that of the constant band."""
    sh_degree: int = 0
    """SH degree that the scene gets, unless its own is higher: 0 adds no band."""
    final_rate: float = 0.3
    """Fraction of the learning rates that is left at the last planned step; they decay geometrically."""
    adam_b1: float = 0.9
    """Decay of the first moment."""
    adam_b2: float = 0.99
    """Decay of the second moment: short, since a run has tens to hundreds of steps."""
    views_per_step: int = 2
    """Key views whose gradients a step averages: a Gaussian that few views show moves more often."""
    learned_passes: int = 0
    """Passes of a trained network before the gradient steps (`learned_pass.py`); each takes the place of 8 steps. The
    network has learned from scenes of streams."""
    max_new: float = 0.0
    """Most Gaussians that are added in holes before the first step (`densify.py`), as a fraction of those present.
    0 adds none. `refine` adds them; `refine_step` does not."""
    shown_weight: float = 0.7
    """Weight of the L1 error with holes filled; the rest is the L1 error over black."""
    max_shift: float = 4.0
    """Largest distance of a mean from where it started, in units of the Gaussian's own size."""
    max_log_scale_change: float = 1.5
    """Largest change of a log standard deviation."""
    held_back: float = 1 / 32
    """Fraction of 8 x 8 pixel blocks that no gradient sees; their error says whether refinement still helps."""
    seed: int = 0
    """Seed of the order of views."""

    def __post_init__(self) -> None:
        for name in ("mean_rate", "log_scale_rate", "quat_rate", "logit_opacity_rate", "color_rate", "sh_rate"):
            self._require(name, "finite and not negative", 0 <= getattr(self, name) < math.inf)
        for name in ("adam_b1", "adam_b2"):
            self._require(name, "in [0, 1)", 0 <= getattr(self, name) < 1)
        self._require("sh_degree", "0 to 3", self.sh_degree in range(4))
        self._require("final_rate", "in (0, 1]", 0 < self.final_rate <= 1)
        self._require("views_per_step", "at least 1", self.views_per_step >= 1)
        self._require("learned_passes", "at least 0", self.learned_passes >= 0)
        self._require("max_new", "in [0, 1]", 0 <= self.max_new <= 1)
        self._require("shown_weight", "in [0, 1]", 0 <= self.shown_weight <= 1)
        self._require("max_shift", "finite and not negative", 0 <= self.max_shift < math.inf)
        self._require("max_log_scale_change", "finite and not negative", 0 <= self.max_log_scale_change < math.inf)
        self._require("held_back", "in [0, 0.5]", 0 <= self.held_back <= 0.5)

    def _require(self, name: str, wanted: str, is_good: bool) -> None:
        if not is_good:
            raise InputError(f"refine: {name} must be {wanted}, got {getattr(self, name)!r}.")


FOR_CAPTURES = RefineConfig(sh_degree=2, learned_passes=5, max_new=0.1)
"""Configuration for scenes that a stream made of captures: colors of real surfaces depend on the direction of view, and
a stream leaves holes where views did not match."""
