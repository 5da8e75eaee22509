"""The state of per-scene optimization: raw parameters of the Gaussians, Adam's moments, and densification's sums."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_experiments.splatting_config import SplattingConfig
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import pytree


@pytree
class Parameters:
    """Raw values of the optimized Gaussians. Also the form of gradients and moments."""

    means: Float[Array, "n 3"]
    quats: Float[Array, "n 4"]
    log_scales: Float[Array, "n 3"]
    logit_opacities: Float[Array, " n"]
    sh: Float[Array, "n k 3"]


@pytree
class SceneState:
    """The scene, Adam's moments, and what densification has to know, at a fixed number of rows."""

    parameters: Parameters
    is_present: Bool[Array, " n"]
    first_moment: Parameters
    second_moment: Parameters
    gradient_sums: Float[Array, " n"]  # lengths of the view-space gradients since the last densification
    num_seen: Int[Array, " n"]  # views that they are from
    num_steps: Int[Array, ""]
    num_overflow: Int[Array, ""]  # most tile intersections of a view that found no space since then


def start_state(gaussians: Gaussians, config: SplattingConfig) -> SceneState:
    """The state before the first step; higher bands are zero."""
    count = gaussians.num_gaussians
    bands = (config.sh_degree + 1) ** 2
    opacities = jnp.clip(gaussians.opacities, 1e-5, 1 - 1e-5)
    parameters = Parameters(
        means=gaussians.means,
        quats=gaussians.quats,
        log_scales=jnp.log(gaussians.scales),
        logit_opacities=jnp.log(opacities) - jnp.log1p(-opacities),
        sh=jnp.zeros((count, bands, 3)).at[:, :1].set(gaussians.sh[:, :1]),
    )
    zeros = lambda: jax.tree.map(jnp.zeros_like, parameters)  # noqa: E731
    return SceneState(
        parameters=parameters,
        is_present=jnp.ones(count, bool),
        first_moment=zeros(),
        second_moment=zeros(),
        gradient_sums=jnp.zeros(count),
        num_seen=jnp.zeros(count, jnp.int32),
        num_steps=jnp.zeros((), jnp.int32),
        num_overflow=jnp.zeros((), jnp.int32),
    )


def scene_of(parameters: Parameters, is_present: Bool[Array, " n"]) -> Gaussians:
    """The activated Gaussians, differentiable in the parameters; rows that are not present have opacity 0."""
    return Gaussians(
        means=parameters.means,
        quats=parameters.quats,
        scales=jnp.exp(parameters.log_scales),
        opacities=jnp.where(is_present, jax.nn.sigmoid(parameters.logit_opacities), 0.0),
        sh=parameters.sh,
    )
