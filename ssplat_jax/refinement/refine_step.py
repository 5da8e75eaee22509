"""One refinement step as a pure function: render key views, compare, move every Gaussian by Adam inside its bounds."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.gaussians import Gaussians, mean_color, with_sh_degree
from ssplat_jax.core.pytree import pytree, replace
from ssplat_jax.refinement.adam import adam_step
from ssplat_jax.refinement.refine_config import RefineConfig
from ssplat_jax.refinement.revision import Revision, apply_revision, is_revised, no_revision
from ssplat_jax.refinement.seen_rows import put_rows, seen_in_any, select_rows, take_rows
from ssplat_jax.refinement.view_loss import view_loss
from ssplat_jax.refinement.view_order import views_of_step


@pytree
class RefineState:
    """The scene that refinement started from, its revision, and Adam's moments at the same capacity."""

    start: Gaussians
    revision: Revision
    first_moment: Revision
    second_moment: Revision
    num_steps: Int[Array, ""]
    num_skipped: Int[Array, ""]  # steps that changed nothing: not finite, or of a learned pass that did not help


@pytree
class StepReport:
    """Measurements of a step, taken before its update; means over its views. A learned pass reports several steps."""

    loss: Float[Array, "*s"]  # weighted L1 error of the pixels that are learned from
    held_back: Float[Array, "*s"]  # the same error of the pixels that are not
    views: Int[Array, "*s b"]  # slots of the key views
    num_missing_rows: Int[Array, "*s"]  # rows that the step's views see and that found no space
    num_overflow: Int[Array, "*s"]  # largest number of tile intersections of one of its views that found no space


def init_refinement(gaussians: Gaussians, config: RefineConfig | None = None) -> RefineState:
    """The state before the first step, with SH bands as `config` has them, in float32 or float64.

    Args:
        gaussians: the scene; its arrays are copied. Half precision becomes float32: in it, Adam's moments would vanish.
        config: SH degree; default `RefineConfig()`.
    """
    gaussians = with_sh_degree(gaussians, (config or RefineConfig()).sh_degree)
    if jnp.finfo(gaussians.means.dtype).bits < 32:
        gaussians = jax.tree.map(lambda x: x.astype(jnp.float32), gaussians)
    return RefineState(
        start=jax.tree.map(jnp.copy, gaussians),  # the step consumes its state; the caller's arrays stay
        revision=no_revision(gaussians),
        first_moment=no_revision(gaussians),
        second_moment=no_revision(gaussians),
        num_steps=jnp.zeros((), jnp.int32),
        num_skipped=jnp.zeros((), jnp.int32),
    )


def current_gaussians(state: RefineState) -> Gaussians:
    """The revised scene.

    Limits:
        A row without a revision is the row of `state.start`, bit for bit, and absent rows stay absent.
    """
    revised = apply_revision(state.start, state.revision)
    is_new = is_revised(state.revision) & (state.start.opacities > 0)
    keep = lambda new, old: jnp.where(is_new.reshape(-1, *[1] * (new.ndim - 1)), new, old)  # noqa: E731
    return jax.tree.map(keep, revised, state.start)


def refine_step(
    state: RefineState,
    key_views: KeyViews,
    rate: Float[Array, ""],
    *,
    config: RefineConfig,
    max_pairs: int,
    max_rows: int | None = None,
) -> tuple[RefineState, StepReport]:
    """One step on `config.views_per_step` key views. A `lax.scan` body over `rate`; donate `state`.

    Args:
        state: the scene so far.
        key_views: the views to compare with, at least one of them valid.
        rate: factor of all learning rates; 0 changes nothing but the moments.
        config: learning rates, weights and bounds (static).
        max_pairs: capacity for tile intersections (static); `StepReport.num_overflow` says what did not fit.
        max_rows: capacity for the rows that the step's views may see (static): all but Adam is done for them alone. By
            default, and where it holds every row, nothing is selected. The result is the same.

    Returns:
        The state after the step, and what was measured before it.
    """
    views = views_of_step(state.num_steps, key_views.valid, config)
    current, pull = jax.vjp(functools.partial(apply_revision, state.start), state.revision)
    background, gaussians, selection = mean_color(current), current, None
    if max_rows is not None and max_rows < current.num_gaussians:
        cameras = [key_views.camera(view) for view in views]
        selection = select_rows(seen_in_any(current, cameras), max_rows)
        gaussians = take_rows(current, selection)
        gaussians = replace(gaussians, opacities=jnp.where(selection.is_row, gaussians.opacities, 0.0))
    slopes, report = _slopes(gaussians, background, key_views, views, config, max_pairs)
    if selection is not None:
        slopes = put_rows(slopes, selection, jax.tree.map(jnp.zeros_like, current))
        report = replace(report, num_missing_rows=selection.num_overflow)
    (gradient,) = pull(slopes)

    is_finite = jnp.isfinite(report.loss)
    for leaf in jax.tree.leaves(gradient):
        is_finite = is_finite & jnp.all(jnp.isfinite(leaf))
    keep = lambda new, old: jnp.where(is_finite, new, old)  # noqa: E731
    before = state.revision, (state.first_moment, state.second_moment)
    revision, moments = jax.tree.map(keep, adam_step(*before, gradient, state.num_steps, rate, config), before)
    state = RefineState(
        start=state.start,
        revision=revision,
        first_moment=moments[0],
        second_moment=moments[1],
        num_steps=state.num_steps + 1,
        num_skipped=state.num_skipped + (~is_finite).astype(jnp.int32),
    )
    return state, report


def _slopes(
    gaussians: Gaussians,
    background: Float[Array, "3"],
    key_views: KeyViews,
    views: Int[Array, " b"],
    config: RefineConfig,
    max_pairs: int,
) -> tuple[Gaussians, StepReport]:
    """Mean gradient of `view_loss` over the step's views, and what they measured."""

    def add_view(total, view: Int[Array, ""]):
        slopes, measured = jax.grad(view_loss, has_aux=True)(gaussians, background, key_views, view, config, max_pairs)
        return jax.tree.map(jnp.add, total, slopes), measured

    # A scan holds the intermediate arrays of one view at a time.
    zeros = jax.tree.map(jnp.zeros_like, gaussians)
    total, (losses, errors, overflows) = jax.lax.scan(add_view, zeros, views)
    report = StepReport(
        loss=jnp.mean(losses),
        held_back=jnp.mean(errors),
        views=views,
        num_missing_rows=jnp.zeros((), jnp.int32),
        num_overflow=jnp.max(overflows),
    )
    return jax.tree.map(lambda x: x / config.views_per_step, total), report
