"""The samples of each training step, procedural or of a capture, and the samples of a validation."""

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.config import StreamConfig
from ssplat_jax.training.capture_samples import CaptureMix, capture_sample, validation_sample
from ssplat_jax.training.recipe import Phase, Recipe
from ssplat_jax.training.samples import Sample, make_sample

NUM_VALIDATION = 8
"""Most samples of a validation, one a capture."""


def sample_for_step(
    step: int, recipe: Recipe, config: StreamConfig, mix: CaptureMix | None = None, member: int = 0
) -> Sample:
    """A sample of a training step. It depends on the arguments alone, which makes resuming exact.

    Args:
        step: number of the step.
        recipe: gives the phase and the seed.
        config: configuration of the model.
        mix: captures to learn from; None, and the share of steps that it leaves, take procedural scenes.
        member: place of the sample in the step's batch.
    """
    phase, position = recipe.phase_at(step)
    number = step + member * recipe.num_steps
    form = {
        "num_chunks": phase.num_chunks,
        "num_targets": phase.num_targets,
        "size": phase.sizes[position % len(phase.sizes)],
        "config": config,
        "range_jitter": recipe.range_jitter,
    }
    if mix is not None and (capture := mix.draw(np.random.default_rng([recipe.seed, number, 13]))) is not None:
        return capture_sample(mix, capture, [recipe.seed, number, 17], **form)
    own = {"steps_of_depth": phase.steps_of_depth, "kinds": phase.kinds}
    return make_sample(recipe.seed * 1_000_003 + number, **own, **form)


def batch_for_step(step: int, recipe: Recipe, config: StreamConfig, mix: CaptureMix | None = None) -> Sample:
    """Samples of a training step, along one more leading axis; see `sample_for_step`. A CPU makes them."""
    size = recipe.phase_at(step)[0].batch
    with jax.default_device(_cpu()):
        samples = [sample_for_step(step, recipe, config, mix, member) for member in range(size)]
        return jax.tree.map(lambda *parts: jnp.stack(parts), *samples)


def _cpu():
    """The device that makes samples: the CPU, or JAX's default (None) where `JAX_PLATFORMS` leaves the CPU out."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return None


def validation_samples(mix: CaptureMix, phase: Phase, config: StreamConfig) -> list[Sample]:
    """Samples with a held-out target each, the same whenever they are made; of one size, so of one program.

    Args:
        mix: the captures; at most `NUM_VALIDATION` of them give a sample each.
        phase: gives the number of chunks and the image size.
        config: configuration of the model.
    """
    return [
        validation_sample(mix, capture, [i, 19], num_chunks=phase.num_chunks, size=phase.sizes[0], config=config)
        for i, capture in enumerate(mix.validation_captures(NUM_VALIDATION))
    ]
