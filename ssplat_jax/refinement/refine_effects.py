"""Parts of the key views that refinement may revise besides the Gaussians. No JAX here."""

import dataclasses
import math

from ssplat_jax.core.errors import InputError


@dataclasses.dataclass(frozen=True)
class RefineEffects:
    """Parts of the key views that are revised with the scene; each is off by default and then costs nothing."""

    poses: bool = False
    """The pose of every key view but the first, which fixes the frame."""
    focal: bool = False
    """One factor of all focal lengths."""
    exposures: bool = False
    """A factor per key view; their geometric mean stays."""
    white_balance: bool = False
    """A factor per key view and channel, of product 1 over the channels unless `exposures` is on too."""
    pose_rate: float = 0.002
    """Step of a rotation in radians and of a translation as a fraction of the view's median depth."""
    focal_rate: float = 0.0005
    """Step of the log focal factor."""
    exposure_rate: float = 0.01
    """Step of a log exposure."""
    max_rotation: float = 0.035
    """Largest rotation of a view from its given pose, radians."""
    max_translation: float = 0.04
    """Largest translation of a view from its given pose, as a fraction of the view's median depth."""
    max_log_focal: float = 0.05
    """Largest change of the log focal length."""
    max_log_exposure: float = 0.5
    """Largest change of a log exposure."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not isinstance(field.default, bool) and not 0 <= value < math.inf:
                raise InputError(f"refine effects: {field.name} must be finite and not negative, got {value!r}.")

    @property
    def any(self) -> bool:
        """True if anything besides the Gaussians is revised."""
        return self.poses or self.focal or self.exposures or self.white_balance

    @property
    def names(self) -> tuple[str, ...]:
        """The effects that are on."""
        return tuple(name for name in NAMES if getattr(self, name))


NAMES = ("poses", "focal", "exposures", "white_balance")
