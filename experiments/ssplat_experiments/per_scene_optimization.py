"""Per-scene optimization: 3D Gaussian Splatting with the renderer of this package, to compare streams with.

    sparse points -> Gaussians -> render a view -> L1 and SSIM -> Adam -> (every 100 steps) clone, split, prune -> ...

Written from the formulas of Kerbl et al., 3D Gaussian Splatting for Real-Time Radiance Field Rendering (2023). Where it
differs: arrays have fixed sizes, images keep their size from the start, the filter is the renderer's own, and Gaussians
that are large on the screen are not removed.
"""

import functools
import itertools
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ssplat_experiments.densification import fitted, maintained
from ssplat_experiments.differentiable_ssim import ssim
from ssplat_experiments.scene_state import Parameters, SceneState, scene_of, start_state
from ssplat_experiments.splatting_config import SplattingConfig
from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import Effects, render
from ssplat_jax.rasterizer.render import round_up

EFFECTS = Effects(outputs=("color",))
ADAM_EPSILON = 1e-15
PAIRS_MARGIN = 1.5
"""Capacity for tile intersections over what the fullest view needs at the start."""


def camera_extent(viewmats: Float[Array, "v 4 4"]) -> float:
    """1.1 times the largest distance of a camera from the mean of all."""
    poses = np.asarray(viewmats, np.float64)
    centers = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
    return float(1.1 * np.max(np.linalg.norm(centers - centers.mean(axis=0), axis=1)))


def optimization_step(
    state: SceneState,
    views: KeyViews,
    view: Int[Array, ""],
    extent: Float[Array, ""],
    *,
    config: SplattingConfig,
    max_pairs: int,
) -> SceneState:
    """One step of Adam on one view; donate `state`.

    Args:
        state: the scene so far.
        views: the views that are learned from, with their exposures.
        view: slot of the one to learn from.
        extent: extent of the cameras, in scene units.
        config: rates and schedule (static).
        max_pairs: capacity for tile intersections (static).
    """
    gradient, num_overflow = jax.grad(_loss, has_aux=True)(
        state.parameters, state.is_present, views, view, config, max_pairs
    )
    lengths = view_space_lengths(state.parameters.means, gradient.means, views, view)
    state = replace(
        state,
        gradient_sums=state.gradient_sums + lengths,
        num_seen=state.num_seen + (lengths > 0).astype(jnp.int32),
        num_overflow=jnp.maximum(state.num_overflow, num_overflow),
    )
    return _adam(state, gradient, extent, config)


def _loss(parameters: Parameters, is_present, views: KeyViews, view, config: SplattingConfig, max_pairs: int):
    """The loss of one view at its exposure, and the tile intersections that found no space."""
    out = render(scene_of(parameters, is_present), views.camera(view), effects=EFFECTS, max_pairs=max_pairs)
    color, target = out.color * views.exposures[view], views.images[view].astype(jnp.float32) / 255
    absolute = jnp.mean(jnp.abs(color - target))
    return (1 - config.ssim_weight) * absolute + config.ssim_weight * (1 - ssim(color, target)), out.num_overflow


def view_space_lengths(
    means: Float[Array, "n 3"], gradients: Float[Array, "n 3"], views: KeyViews, view: Int[Array, ""]
) -> Float[Array, " n"]:
    """Lengths of the gradients by the place on the screen, in coordinates that run from -1 to 1 over the image.

    A step dx along the camera's x axis moves the place by focal / z dx pixels: the gradient by pixels is that by the
    mean, turned into the camera, times z / focal. The mean also changes the splat's shape; this small part of the
    gradient is left in.
    """
    pose, K = views.viewmats[view], views.Ks[view]
    height, width = views.images.shape[1:3]
    depths = jnp.einsum("j,nj->n", pose[2, :3], means) + pose[2, 3]
    turned = jnp.einsum("ij,nj->ni", pose[:2, :3], gradients)
    by_pixels = turned * depths[:, None] / jnp.stack([K[0, 0], K[1, 1]])
    return jnp.sqrt(jnp.sum((by_pixels * jnp.array([width / 2, height / 2])) ** 2, axis=1))


def _adam(state: SceneState, gradient: Parameters, extent: Float[Array, ""], config: SplattingConfig) -> SceneState:
    """Adam with a learning rate for each field."""
    step = (state.num_steps + 1).astype(jnp.float32)
    b1, b2 = config.adam_b1, config.adam_b2
    band = jnp.sqrt(jnp.arange(gradient.sh.shape[1])).astype(jnp.int32)  # 0, 1 1 1, 2 2 2 2 2, ...
    is_learned = band <= state.num_steps // config.steps_per_band
    gradient = replace(gradient, sh=jnp.where(is_learned[:, None], gradient.sh, 0.0))
    first = jax.tree.map(lambda m, g: b1 * m + (1 - b1) * g, state.first_moment, gradient)
    second = jax.tree.map(lambda m, g: b2 * m + (1 - b2) * g * g, state.second_moment, gradient)
    share = jnp.minimum(step / config.mean_rate_steps, 1.0)
    rates = {
        "means": extent * config.mean_rate ** (1 - share) * config.final_mean_rate**share,
        "quats": config.quat_rate,
        "log_scales": config.log_scale_rate,
        "logit_opacities": config.logit_opacity_rate,
        "sh": config.color_rate * jnp.where(band == 0, 1.0, 0.05)[:, None],
    }

    def moved(name: str) -> Array:
        m, v = getattr(first, name) / (1 - b1**step), getattr(second, name) / (1 - b2**step)
        return getattr(state.parameters, name) - rates[name] * m / (jnp.sqrt(v) + ADAM_EPSILON)

    return replace(
        state,
        parameters=Parameters(**{name: moved(name) for name in rates}),
        first_moment=first,
        second_moment=second,
        num_steps=state.num_steps + 1,
    )


def optimize(
    start: Gaussians, views: KeyViews, config: SplattingConfig | None = None, *, seed: int = 0
) -> Iterator[SceneState]:
    """The state after each step, without end.

    Args:
        start: Gaussians of the sparse points.
        views: the views that are learned from.
        config: rates and schedule.
        seed: seed of the order of views and of the places of split Gaussians.
    """
    config, rng = config or SplattingConfig(), np.random.default_rng(seed)
    extent = camera_extent(views.viewmats)
    state = fitted(start_state(start, config), config)
    max_pairs = _pairs_capacity(scene_of(state.parameters, state.is_present), views)
    order: list[int] = []
    for num_steps in itertools.count(1):
        order = order or [int(i) for i in rng.permutation(views.num_slots)]
        step = _step(config, max_pairs)
        state = jax.block_until_ready(step(state, views, jnp.int32(order.pop()), jnp.float32(extent)))
        if num_steps % config.densify_every == 0 and int(state.num_overflow):
            state, max_pairs = replace(state, num_overflow=jnp.zeros((), jnp.int32)), 2 * max_pairs
        state = maintained(state, num_steps, extent, config, rng)
        yield state


@functools.cache
def _step(config: SplattingConfig, max_pairs: int):
    step = functools.partial(optimization_step, config=config, max_pairs=max_pairs)
    return jax.jit(step, donate_argnums=0)


def _pairs_capacity(gaussians: Gaussians, views: KeyViews) -> int:
    """Capacity for tile intersections that every view fits into."""
    counts = [int(render(gaussians, views.camera(i), effects=EFFECTS).num_pairs) for i in range(views.num_slots)]
    return round_up(int(PAIRS_MARGIN * max(counts)))
