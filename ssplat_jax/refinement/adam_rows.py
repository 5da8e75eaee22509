"""Adam on the rows that a step shows: the others keep their revision and their moments, and are not counted.

In plain Adam a row without a gradient goes on moving by its old moments, while they decay. Here a row takes the same
steps, whatever is shown between two views of it.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ssplat_jax.gaussians import SH_C0
from ssplat_jax.pytree import pytree
from ssplat_jax.refinement.refine_config import RefineConfig
from ssplat_jax.refinement.revision import Revision, bounded, is_revised

ADAM_EPSILON = 1e-15
"""Below any gradient that a visible Gaussian has in a mean over pixels; 1e-8 would stop most of them."""


@pytree
class AdamRows:
    """A revision with its moments, row by row."""

    revision: Revision
    first_moment: Revision
    second_moment: Revision
    num_shown: Int[Array, " n"]  # steps that showed a row


def step_rows(rows: AdamRows, gradient: Revision, rate: Float[Array, ""], config: RefineConfig) -> AdamRows:
    """One step of Adam, with a learning rate per field, on the rows with a gradient; then the bounds."""
    b1, b2 = config.adam_b1, config.adam_b2
    is_shown = is_revised(gradient)
    num_shown = rows.num_shown + is_shown.astype(jnp.int32)
    first = jax.tree.map(lambda m, g: b1 * m + (1 - b1) * g, rows.first_moment, gradient)
    second = jax.tree.map(lambda m, g: b2 * m + (1 - b2) * g * g, rows.second_moment, gradient)
    count = jnp.maximum(num_shown, 1).astype(jnp.float32)
    correct_first, correct_second = 1 - b1**count, 1 - b2**count

    bands = rows.revision.sh.shape[1]
    rates = {
        "means": config.mean_rate,
        "quats": config.quat_rate,
        "log_scales": config.log_scale_rate,
        "logit_opacities": config.logit_opacity_rate,
        # Higher bands move a twentieth as far, as in 3D Gaussian Splatting.
        "sh": (config.color_rate / SH_C0) * jnp.where(jnp.arange(bands) == 0, 1.0, 0.05)[None, :, None],
    }

    def moved(name: str) -> Array:
        m, v = getattr(first, name), getattr(second, name)
        by_row = lambda x: x.reshape(-1, *[1] * (m.ndim - 1))  # noqa: E731
        direction = m / by_row(correct_first) / (jnp.sqrt(v / by_row(correct_second)) + ADAM_EPSILON)
        return getattr(rows.revision, name) - rate * rates[name] * direction

    new = AdamRows(
        revision=bounded(Revision(**{name: moved(name) for name in rates}), config),
        first_moment=first,
        second_moment=second,
        num_shown=num_shown,
    )
    keep = lambda x, old: jnp.where(is_shown.reshape(-1, *[1] * (x.ndim - 1)), x, old)  # noqa: E731
    return jax.tree.map(keep, new, rows)
