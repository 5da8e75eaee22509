"""Adam on the revision of a scene: a learning rate for each field, then the bounds."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ssplat_jax.core.gaussians import SH_C0
from ssplat_jax.refinement.refine_config import RefineConfig
from ssplat_jax.refinement.revision import Revision, bounded

ADAM_EPSILON = 1e-15
"""Below any gradient that a visible Gaussian has in a mean over pixels; 1e-8 would stop most of them."""


def adam_step(
    revision: Revision,
    moments: tuple[Revision, Revision],
    gradient: Revision,
    num_steps: Int[Array, ""],
    rate: Float[Array, ""],
    config: RefineConfig,
) -> tuple[Revision, tuple[Revision, Revision]]:
    """The revision and its moments after one step.

    A row without a gradient goes on moving by its moments, which decay.

    Args:
        revision: the changes so far.
        moments: first and second moment.
        gradient: of the loss by the revision.
        num_steps: steps before this one, those of learned passes included. The moments are zero after passes, but the
            bias correction counts the steps of passes: under a constant gradient, steps are 0.6 of the rate at
            first, up to 1.4 of it after 20 steps, and fall towards it.
        rate: factor of all learning rates.
        config: learning rates, decays and bounds.

    Returns:
        The revision inside its bounds, and the two moments.
    """
    step = (num_steps + 1).astype(jnp.float32)
    first = jax.tree.map(lambda m, g: config.adam_b1 * m + (1 - config.adam_b1) * g, moments[0], gradient)
    second = jax.tree.map(lambda m, g: config.adam_b2 * m + (1 - config.adam_b2) * g * g, moments[1], gradient)
    correct_first, correct_second = 1 - config.adam_b1**step, 1 - config.adam_b2**step

    bands = revision.sh.shape[1]
    rates = {
        "means": config.mean_rate,
        "quats": config.quat_rate,
        "log_scales": config.log_scale_rate,
        "logit_opacities": config.logit_opacity_rate,
        "sh": (config.color_rate / SH_C0) * jnp.where(jnp.arange(bands) == 0, 1.0, config.sh_rate)[None, :, None],
    }

    def moved(name: str) -> Array:
        m, v = getattr(first, name) / correct_first, getattr(second, name) / correct_second
        return getattr(revision, name) - rate * rates[name] * m / (jnp.sqrt(v) + ADAM_EPSILON)

    return bounded(Revision(**{name: moved(name) for name in rates}), config), (first, second)
