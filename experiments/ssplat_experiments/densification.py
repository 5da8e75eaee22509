"""Densification of per-scene optimization: which Gaussians are cloned, split and removed, and the reset of opacities.

NumPy on the host, once every hundred steps. Present rows come first afterwards; the number of rows is a power of two
that doubles as needed, up to the capacity.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ssplat_experiments.scene_state import Parameters, SceneState
from ssplat_experiments.splatting_config import SplattingConfig
from ssplat_jax.core.pytree import replace


def maintained(
    state: SceneState, num_steps: int, extent: float, config: SplattingConfig, rng: np.random.Generator
) -> SceneState:
    """`state` densified and its opacities reset, if that is due after `num_steps` steps; else as it is."""
    if num_steps > config.densify_until:
        return state
    if num_steps > config.densify_from and num_steps % config.densify_every == 0:
        state = densified(state, extent, config, rng, remove_large=num_steps > config.reset_every)
    if num_steps % config.reset_every == 0:
        state = with_opacities_reset(state, config)
    return state


def densified(
    state: SceneState, extent: float, config: SplattingConfig, rng: np.random.Generator, *, remove_large: bool
) -> SceneState:
    """`state` with Gaussians cloned and split where the view-space gradient is large, and faint ones removed.

    Where the capacity does not suffice, the rows with the largest gradients are densified.

    Args:
        state: the state; sums start anew.
        extent: extent of the cameras, in scene units.
        config: thresholds and capacity.
        rng: draws the places of split Gaussians.
        remove_large: whether Gaussians above `config.max_scale` are removed, too.
    """
    held: SceneState = jax.tree.map(np.asarray, state)
    scales = np.exp(np.max(held.parameters.log_scales, axis=1))
    opacities = 1 / (1 + np.exp(-np.asarray(held.parameters.logit_opacities, np.float64)))
    keep = np.asarray(held.is_present) & (opacities >= config.min_opacity)
    if remove_large:
        keep = keep & (scales <= config.max_scale * extent)
    chosen = _largest(held, keep, config)
    is_small = scales[chosen] <= config.small_scale * extent
    clones, parents = chosen[is_small], chosen[~is_small]
    keep[parents] = False
    rows = np.concatenate([np.flatnonzero(keep), clones, parents, parents])
    is_new = np.arange(len(rows)) >= np.sum(keep)
    parameters = jax.tree.map(lambda x: x[rows], held.parameters)
    parameters = _split(parameters, len(parents), config, rng)
    moment = lambda x: np.where(is_new.reshape(-1, *[1] * (x.ndim - 1)), 0.0, x[rows]).astype(x.dtype)  # noqa: E731
    dense = replace(
        held,
        parameters=parameters,
        is_present=np.ones(len(rows), bool),
        first_moment=jax.tree.map(moment, held.first_moment),
        second_moment=jax.tree.map(moment, held.second_moment),
        gradient_sums=np.zeros(len(rows), np.float32),
        num_seen=np.zeros(len(rows), np.int32),
    )
    return fitted(dense, config, at_least=len(held.is_present))


def _largest(held: SceneState, keep: Bool[np.ndarray, " n"], config: SplattingConfig) -> Int[np.ndarray, " m"]:
    """Kept rows whose mean gradient reaches the threshold, the largest first; each of them adds one row."""
    means = held.gradient_sums / np.maximum(held.num_seen, 1)
    candidates = np.flatnonzero(keep & (means >= config.gradient_threshold))
    space = config.capacity - int(np.sum(keep))
    return candidates[np.argsort(-means[candidates], kind="stable")][: max(space, 0)]


def _split(parameters: Parameters, count: int, config: SplattingConfig, rng: np.random.Generator) -> Parameters:
    """The parameters with the last 2 `count` rows, copies of their parents, drawn from them and made smaller."""
    if not count:
        return parameters
    last = slice(len(parameters.means) - 2 * count, None)
    log_scales, means = parameters.log_scales.copy(), parameters.means.copy()
    offsets = np.exp(log_scales[last]) * rng.standard_normal((2 * count, 3))
    means[last] += np.einsum("nij,nj->ni", _rotations(np.asarray(parameters.quats[last])), offsets)
    log_scales[last] -= np.log(config.split_factor)
    return replace(parameters, means=means, log_scales=log_scales)


def _rotations(quats: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3 3"]:
    """Rotation matrices of quaternions wxyz of any length but 0."""
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def with_opacities_reset(state: SceneState, config: SplattingConfig) -> SceneState:
    """`state` with opacities of at most `config.reset_opacity` and without moments of opacities."""
    most = float(np.log(config.reset_opacity / (1 - config.reset_opacity)))
    logits = jnp.minimum(state.parameters.logit_opacities, most)
    forgotten = lambda moment: replace(moment, logit_opacities=jnp.zeros_like(logits))  # noqa: E731
    return replace(
        state,
        parameters=replace(state.parameters, logit_opacities=logits),
        first_moment=forgotten(state.first_moment),
        second_moment=forgotten(state.second_moment),
    )


def fitted(state: SceneState, config: SplattingConfig, at_least: int = 0) -> SceneState:
    """`state` with absent rows behind its own, up to a number of rows that programs are compiled for."""
    count = len(state.is_present)
    rows = max(at_least, config.first_rows)
    while rows < count:
        rows *= 2

    def pad(x):
        return x if np.ndim(x) == 0 else np.pad(x, [(0, rows - count)] + [(0, 0)] * (np.ndim(x) - 1))

    return jax.tree.map(lambda x: jnp.asarray(pad(np.asarray(x))), state)
