"""Scores of held-out frames while a network learns from captures."""

import dataclasses
import functools

import jax
import numpy as np

from ssplat_jax.evaluation.lpips import LpipsWeights
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.training.capture_samples import CaptureMix
from ssplat_jax.training.recipe import Phase, Recipe
from ssplat_jax.training.samples import Sample
from ssplat_jax.training.step import loss_fn
from ssplat_jax.training.step_samples import validation_samples

SCORES = ("psnr", "psnr_over_black", "lpips")
"""Metrics of a step that are reported of held-out frames too."""


@dataclasses.dataclass(frozen=True, eq=False)
class Validation:
    """Held-out frames of the captures of a training; the same ones at every call."""

    model: StreamSplat
    recipe: Recipe
    mix: CaptureMix
    lpips_weights: LpipsWeights | None = None

    def scores(self, params: dict, phase: Phase) -> dict[str, float]:
        """Means over a held-out frame of each capture, `validation_psnr` and so on; none in phases without targets."""
        if not phase.num_targets:
            return {}
        form = dataclasses.replace(phase.form, frozen=())  # decides gradients alone
        rows = [jax.device_get(self._measure(params, sample, form)) for sample in self._samples(phase)]
        return {f"validation_{name}": float(np.mean([row[name] for row in rows])) for name in SCORES if name in rows[0]}

    @functools.cached_property
    def _measure(self):
        def measure(params, sample, form):
            return loss_fn(params, self.model, sample, self.recipe, form, self.lpips_weights)[1]

        return jax.jit(measure, static_argnums=2)

    @functools.lru_cache(maxsize=4)  # noqa: B019 - lives as long as its training
    def _samples(self, phase: Phase) -> list[Sample]:
        return validation_samples(self.mix, phase, self.model.config)
