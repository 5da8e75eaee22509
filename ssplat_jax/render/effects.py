"""What a render simulates. Everything here is static: an effect that is off is not in the compiled program."""

import dataclasses
from typing import Literal

from ssplat_jax.errors import InputError

OUTPUTS = ("color", "alpha", "depth", "median_depth", "features")


@dataclasses.dataclass(frozen=True)
class Effects:
    """The effects of a render, each of which can be left out. Hashable; changing it recompiles."""

    sh_degree: int | None = None
    """SH bands that are evaluated; None takes all that the Gaussians hold."""
    antialias: Literal["mip", "classic", "none"] = "mip"
    """2D Mip filter (0.1 px^2, opacity compensated), the classic 0.3 px^2 dilation, or point sampling."""
    background: tuple[float, float, float] | None = None
    """Colour behind the scene; None is black, at no cost."""
    outputs: tuple[str, ...] = ("color", "alpha", "depth")
    """What is wanted beside colour and alpha, which are always there: `depth`, `median_depth`, `features`."""

    def __post_init__(self) -> None:
        if self.sh_degree not in (None, 0, 1, 2, 3):
            raise InputError(f"effects: sh_degree must be None or 0 to 3, got {self.sh_degree!r}.")
        if self.antialias not in ("mip", "classic", "none"):
            raise InputError(f"effects: antialias must be 'mip', 'classic' or 'none', got {self.antialias!r}.")
        if unknown := [name for name in self.outputs if name not in OUTPUTS]:
            raise InputError(f"effects: no output {unknown[0]!r}; there is {', '.join(OUTPUTS)}.")

    def replace(self, **changes) -> "Effects":
        """A copy with `changes`."""
        return dataclasses.replace(self, **changes)
