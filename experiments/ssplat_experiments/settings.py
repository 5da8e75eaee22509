"""Settings that `accuracy_vs_time` measures, and the sizes at which it does."""

import dataclasses
from typing import Any


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Context views, and (width, height) of the scored images."""

    context: int
    scored: tuple[int, int]
    settings: int | None = None
    """Number of `SETTINGS` that are measured, without refinement; None: all, with it."""


SIZES = {
    "smoke": Sizes(8, (64, 48), settings=2),
    "cpu": Sizes(24, (160, 120)),
    "gpu": Sizes(64, (320, 240)),
}


@dataclasses.dataclass(frozen=True)
class Setting:
    """A point of the plot: the size that is streamed, as a factor, and what differs from the preset."""

    factor: float = 1.0
    """Size of the streamed images against that of the scored ones."""
    label: str = ""
    changes: dict[str, Any] = dataclasses.field(default_factory=dict)
    refine_steps: int = 0
    """Refinement steps on the streamed views after the stream."""
    quality: str = ""
    """Name of the `--quality` with this setting, or empty."""

    @property
    def name(self) -> str:
        """The factor of the size, if it is not 1, the label and the steps; `preset` without all."""
        size = "" if self.factor == 1 else f"size x {self.factor:g}"
        steps = f"{self.refine_steps} steps" if self.refine_steps else ""
        return ", ".join(part for part in (size, self.label, steps) if part) or "preset"

    def size(self, scored: tuple[int, int]) -> tuple[int, int]:
        """(width, height) of the streamed images."""
        return round(self.factor * scored[0]), round(self.factor * scored[1])


SETTINGS = (
    Setting(quality="accurate"),
    Setting(0.5, quality="fast"),
    Setting(0.75, quality="balanced"),
    Setting(0.4),
    Setting(0.6),
    Setting(0.9),
    Setting(1.25),
    Setting(1.5),
    Setting(1.5, "voxel 0.02", {"voxel_size": 0.02}),
    Setting(0.4, "1 source", {"num_sources": 1}),
    Setting(0.5, "1 source", {"num_sources": 1}),
    Setting(0.75, "1 source", {"num_sources": 1}),
    Setting(1.0, "1 source", {"num_sources": 1}),
    Setting(1.25, "1 source", {"num_sources": 1}),
    Setting(1.0, "1 Gaussian a token", {"gaussians_per_token": 1}),
    Setting(0.5, "16 Gaussians a token", {"gaussians_per_token": 16}),
    Setting(0.75, "16 Gaussians a token", {"gaussians_per_token": 16}),
    Setting(1.0, "16 Gaussians a token", {"gaussians_per_token": 16}),
    Setting(1.0, "exposure not matched", {"match_exposure": False}),
    Setting(1.0, "1 pivot", {"pivots_per_voxel": 1}),
    Setting(1.0, "chunks of 2", {"chunk_size": 2}),
    Setting(1.0, "chunks of 8", {"chunk_size": 8}),
    Setting(0.75, "chunks of 8", {"chunk_size": 8}),
    Setting(1.0, "HPDA", {"hpda": True}),
    Setting(1.0, "CGFI, untrained", {"cgfi": True}),
    Setting(1.0, "no carving", {"carving": False}),
    Setting(1.0, "mixer, untrained", {"mixer_blocks": 2}),
)

REFINED_FACTORS = (0.4, 0.5, 0.6, 0.75, 1.0, 1.25)
REFINED_STEPS = (8, 24, 50, 100, 200)  # a learned pass is 8 steps in one
REFINED = tuple(
    Setting(factor, refine_steps=steps, quality="best" if (factor, steps) == (1.0, 100) else "")
    for factor in REFINED_FACTORS
    for steps in REFINED_STEPS
)
"""The second axis: sizes of the stream times steps of refinement. `SETTINGS` has the same sizes without steps."""
