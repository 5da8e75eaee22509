"""Adam on the rows that a step shows, against a loop over rows in float64."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.gaussians import SH_C0
from ssplat_jax.refinement import RefineConfig
from ssplat_jax.refinement.adam_rows import AdamRows, step_rows
from ssplat_jax.refinement.revision import Revision

NUM, STEPS = 7, 9
CONFIG = dataclasses.replace(RefineConfig(), max_shift=1e9, max_log_scale_change=1e9)
RATES = {
    "means": CONFIG.mean_rate,
    "quats": CONFIG.quat_rate,
    "log_scales": CONFIG.log_scale_rate,
    "logit_opacities": CONFIG.logit_opacity_rate,
    "sh": CONFIG.color_rate / SH_C0 * np.array([1, 0.05, 0.05, 0.05])[:, None],
}


def random_revision(random) -> Revision:
    sizes = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": (), "sh": (4, 3)}
    return Revision(**{name: jnp.asarray(random.normal(size=(NUM, *s)), jnp.float32) for name, s in sizes.items()})


def zero_rows(revision: Revision, rows) -> Revision:
    return jax.tree.map(lambda x: x.at[jnp.asarray(rows)].set(0.0), revision)


def test_each_row_takes_its_own_steps():
    """A row moves as if the steps that do not show it had not been; its biases are corrected by its own count."""
    random, step = np.random.default_rng(0), jax.jit(step_rows, static_argnames="config")
    zeros = zero_rows(random_revision(random), range(NUM))
    rows = AdamRows(zeros, zeros, zeros, jnp.zeros(NUM, jnp.int32))
    wanted = {name: np.zeros(np.shape(getattr(zeros, name))) for name in RATES}
    first, second = ({name: np.zeros_like(x) for name, x in wanted.items()} for _ in range(2))
    counts = np.zeros(NUM, int)
    for i in range(STEPS):
        hidden = np.flatnonzero(random.random(NUM) < 0.5) if i else np.arange(NUM - 1)
        gradient = zero_rows(random_revision(random), hidden)
        before, rows = rows, step(rows, gradient, jnp.float32(0.5), config=CONFIG)
        for row in set(range(NUM)) - set(hidden):
            counts[row] += 1
            for name, rate in RATES.items():
                g = np.asarray(getattr(gradient, name), np.float64)[row]
                first[name][row] = 0.9 * first[name][row] + 0.1 * g
                second[name][row] = 0.99 * second[name][row] + 0.01 * g * g
                m, v = first[name][row] / (1 - 0.9 ** counts[row]), second[name][row] / (1 - 0.99 ** counts[row])
                wanted[name][row] -= 0.5 * rate * m / np.sqrt(v)
        for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(rows), strict=True):
            np.testing.assert_array_equal(np.asarray(a)[hidden], np.asarray(b)[hidden])
    np.testing.assert_array_equal(rows.num_shown, counts)
    assert 0 < counts.min() < counts.max() < STEPS
    for name in RATES:
        np.testing.assert_allclose(getattr(rows.revision, name), wanted[name], rtol=2e-5, atol=1e-7, err_msg=name)
