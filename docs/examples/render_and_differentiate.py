"""Renders Gaussians and fits their colors and places to an image by gradient descent."""

import jax
import jax.numpy as jnp
import optax

import ssplat_jax as ss
from ssplat_jax.core.pytree import replace


def main(steps: int = 60) -> tuple[float, float]:
    """Returns the mean squared error before and after the fit."""
    keys = jax.random.split(jax.random.key(0), 3)
    camera = ss.Camera(viewmats=jnp.eye(4), Ks=jnp.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), width=64, height=48)
    truth = ss.Gaussians.from_rgb(
        means=jax.random.uniform(keys[0], (40, 3), minval=-0.8, maxval=0.8) + jnp.array([0, 0, 2.0]),
        quats=jnp.tile(jnp.array([1.0, 0, 0, 0]), (40, 1)),  # wxyz
        scales=jnp.full((40, 3), 0.1),
        opacities=jnp.full((40,), 0.8),
        colors=jax.random.uniform(keys[1], (40, 3)),
    )
    target = ss.render(truth, camera).color
    noise = 0.03 * jax.random.normal(keys[2], truth.means.shape)
    start = {"means": truth.means + noise, "sh": 0.5 * truth.sh}

    def loss(values):
        # Inside jit the memory for (tile, Gaussian) pairs is fixed: look at `num_overflow`.
        out = ss.render(replace(truth, **values), camera, max_pairs=1 << 12)
        return jnp.mean((out.color - target) ** 2), out.num_overflow

    optimizer = optax.adam(5e-3)
    values, state = start, optimizer.init(start)

    @jax.jit
    def update(values, state):
        (error, overflow), gradients = jax.value_and_grad(loss, has_aux=True)(values)
        updates, state = optimizer.update(gradients, state)
        return optax.apply_updates(values, updates), state, error, overflow

    errors = []
    for _ in range(steps):
        values, state, error, overflow = update(values, state)
        errors.append(float(error))
        assert int(overflow) == 0, "raise max_pairs"
    print(f"mean squared error {errors[0]:.2e} before, {errors[-1]:.2e} after {steps} steps")
    return errors[0], errors[-1]


if __name__ == "__main__":
    main()
