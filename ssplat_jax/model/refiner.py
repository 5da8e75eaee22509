"""Refiner: the change of a Gaussian from the error that views see in it (an addition to the paper).

It reads how a Gaussian's gradients agree between views, how much of the images it fills and how large the error
is there, and sets the step of each of its parameters. `refinement/learned_pass.py` computes what it reads and applies
what it says.
"""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

WIDTH = 48  # channels of the hidden layers
FIRST_GAIN = 0.1  # of all parts before training: a small step against the gradient

GAINS = {"means": 3, "quats": 1, "log_scales": 3, "logit_opacities": 1, "colors": 3, "bands": 1}
"""Gains of each part of a Gaussian; one gain serves the whole quaternion and all higher SH bands."""

SHIFTS = {"means": 3, "log_scales": 3, "logit_opacities": 1, "colors": 3}
"""Shifts of each part that has any: a shift moves the part even if its gradients are 0."""

NUM_GAINS, NUM_SHIFTS = sum(GAINS.values()), sum(SHIFTS.values())


class Refiner(nn.Module):
    """Maps what views say about a Gaussian to gains of its gradients and to changes of its own.

    Before training all gains are `FIRST_GAIN` and all changes 0.
    """

    @nn.compact
    def __call__(self, x: Float[Array, "n f"]) -> Float[Array, "n c"]:
        x = nn.gelu(nn.Dense(WIDTH, name="hidden1")(x))
        x = nn.gelu(nn.Dense(WIDTH, name="hidden2")(x))
        zeros = nn.initializers.zeros
        gains = nn.Dense(NUM_GAINS, kernel_init=zeros, bias_init=nn.initializers.constant(FIRST_GAIN), name="gains")(x)
        shifts = nn.Dense(NUM_SHIFTS, kernel_init=zeros, name="shifts")(x)
        return jnp.concatenate([gains, shifts], axis=-1)


def gains_and_shifts(out: Float[Array, "n c"]) -> dict[str, tuple[Float[Array, "n _"], Float[Array, "n _"]]]:
    """The output of `Refiner` by part; a part without a change of its own has zeros."""
    gains, shifts = _split(out[:, :NUM_GAINS], GAINS), _split(out[:, NUM_GAINS:], SHIFTS)
    return {name: (gain, shifts.get(name, jnp.zeros_like(gain))) for name, gain in gains.items()}


def _split(x: Float[Array, "n c"], widths: dict[str, int]) -> dict[str, Float[Array, "n _"]]:
    return dict(zip(widths, jnp.split(x, np.cumsum([*widths.values()])[:-1], axis=1), strict=True))
