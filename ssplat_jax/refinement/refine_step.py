"""One refinement step as a pure function: render key views, compare, move every Gaussian by Adam inside its bounds."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.errors import InputError
from ssplat_jax.gaussians import SH_C0, Gaussians, mean_color
from ssplat_jax.pytree import pytree, replace
from ssplat_jax.rasterizer import Effects, fill_holes, render
from ssplat_jax.refinement.refine_config import RefineConfig
from ssplat_jax.refinement.seen_rows import put_rows, seen_rows, take_rows
from ssplat_jax.refinement.view_revision import ViewRevision, ViewState, init_view_state, revised_view, step_view_state

EFFECTS = Effects(outputs=("color", "alpha"))
MAX_LOGIT = 12.0
"""Bound of opacity logits: beyond it a float32 opacity is 0 or 1 and its gradient is lost."""
ADAM_EPSILON = 1e-15
"""Below any gradient that a visible Gaussian has in a mean over pixels; 1e-8 would stop most of them."""
BLOCK = 8
"""Side of the pixel blocks that are held back together: neighbors of a pixel give its color away."""


@pytree
class Revision:
    """Changes to `n` Gaussians, all zero at the start. Also the form of gradients and moments."""

    means: Float[Array, "n 3"]  # in units of the Gaussian's own size
    quats: Float[Array, "n 4"]  # added to the unit quaternion
    log_scales: Float[Array, "n 3"]
    logit_opacities: Float[Array, " n"]
    sh: Float[Array, "n k 3"]


@pytree
class RefineState:
    """The scene that refinement started from, its revision, and Adam's moments at the same capacity."""

    start: Gaussians
    revision: Revision
    first_moment: Revision
    second_moment: Revision
    num_steps: Int[Array, ""]
    num_skipped: Int[Array, ""]  # steps whose gradient was not finite: they changed nothing
    views: ViewState | None = None  # revision of the key views, if an effect is on


@pytree
class StepReport:
    """Measurements of one step, taken before its update; means over its views."""

    loss: Float[Array, ""]  # weighted L1 error of the pixels that are learned from
    held_back: Float[Array, ""]  # the same error of the pixels that are not
    views: Int[Array, " b"]  # slots of the key views
    num_overflow: Int[Array, ""]  # most of its views; rows and tile intersections that found no space


def init_refinement(
    gaussians: Gaussians, key_views: KeyViews | None = None, config: RefineConfig | None = None
) -> RefineState:
    """The state before the first step. Effects of `config` need the `key_views` that they revise."""
    effects = (config or RefineConfig()).effects
    if effects.any and key_views is None:
        raise InputError(f"refine: the effects {', '.join(effects.names)} need the key views, got none.")
    revision = Revision(
        means=jnp.zeros_like(gaussians.means),
        quats=jnp.zeros_like(gaussians.quats),
        log_scales=jnp.zeros_like(gaussians.scales),
        logit_opacities=jnp.zeros_like(gaussians.opacities),
        sh=jnp.zeros_like(gaussians.sh),
    )
    zeros = lambda: jax.tree.map(jnp.zeros_like, revision)  # noqa: E731
    return RefineState(
        start=jax.tree.map(jnp.copy, gaussians),  # the step consumes its state; the caller's arrays stay
        revision=revision,
        first_moment=zeros(),
        second_moment=zeros(),
        num_steps=jnp.zeros((), jnp.int32),
        num_skipped=jnp.zeros((), jnp.int32),
        views=None if key_views is None else init_view_state(gaussians, key_views, effects),
    )


def current_gaussians(state: RefineState) -> Gaussians:
    """The revised scene.

    Limits:
        A row without a revision is the row of `state.start`, bit for bit, and absent rows stay absent.
    """
    revised = apply_revision(state.start, state.revision)
    is_revised = jnp.any(
        jnp.concatenate([jnp.reshape(x != 0, (x.shape[0], -1)) for x in jax.tree.leaves(state.revision)], axis=1),
        axis=1,
    )
    is_revised = is_revised & (state.start.opacities > 0)
    keep = lambda new, old: jnp.where(is_revised.reshape(-1, *[1] * (new.ndim - 1)), new, old)  # noqa: E731
    return jax.tree.map(keep, revised, state.start)


def apply_revision(start: Gaussians, revision: Revision) -> Gaussians:
    """`start` moved by `revision`, differentiable in both.

    Limits:
        An opacity of 0 stays 0 with a zero gradient; one of 1 counts as the largest below it.
    """
    is_present = start.opacities > 0
    opacities = jnp.clip(jnp.where(is_present, start.opacities, 0.5), 1e-5, 1 - 1e-5)
    logits = jnp.log(opacities) - jnp.log1p(-opacities) + revision.logit_opacities
    return Gaussians(
        means=start.means + sizes(start)[:, None] * revision.means,
        quats=_unit(start.quats) + revision.quats,
        scales=start.scales * jnp.exp(revision.log_scales),
        opacities=jnp.where(is_present, jax.nn.sigmoid(logits), 0.0),
        sh=start.sh + revision.sh,
    )


def sizes(gaussians: Gaussians) -> Float[Array, " n"]:
    """Mean of the two larger standard deviations: the extent of a flat Gaussian in its plane."""
    smallest = jnp.min(gaussians.scales, axis=-1)
    return (jnp.sum(gaussians.scales, axis=-1) - smallest) / 2


def _unit(quats: Float[Array, "n 4"]) -> Float[Array, "n 4"]:
    length = jnp.linalg.norm(quats, axis=-1, keepdims=True)
    return quats / jnp.where(length > 0, length, 1.0)


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
        max_rows: capacity for the rows that a view may see (static): gradients are computed for them alone. By
            default, and where it holds every row, nothing is selected.

    Returns:
        The state after the step, and what was measured before it.
    """
    places = state.num_steps * config.views_per_step + jnp.arange(config.views_per_step)
    views = jax.vmap(lambda place: next_view(place, key_views.valid, config.seed))(places)

    current = apply_revision(state.start, state.revision)

    def add_view(total, view: Int[Array, ""]):
        gradient, measured = view_gradient(state, current, key_views, view, config, max_pairs, max_rows)
        return jax.tree.map(jnp.add, total, gradient), measured

    zeros = jax.tree.map(jnp.zeros_like, _revisions(state))
    # A scan holds the intermediate arrays of one view at a time.
    total, (losses, errors, overflows) = jax.lax.scan(add_view, zeros, views)
    gradient, slopes_of_views = jax.tree.map(lambda x: x / config.views_per_step, total)
    report = StepReport(loss=jnp.mean(losses), held_back=jnp.mean(errors), views=views, num_overflow=jnp.max(overflows))
    is_finite = jnp.array(True)
    for leaf in jax.tree.leaves((gradient, slopes_of_views)):
        is_finite = is_finite & jnp.all(jnp.isfinite(leaf))
    is_finite = is_finite & jnp.isfinite(report.loss)
    moved = _adam(state, gradient, rate, config)
    if state.views is not None:
        moved_views = step_view_state(state.views, slopes_of_views, views, key_views.valid, rate, config.effects)
        moved = replace(moved, views=moved_views)
    keep = lambda new, old: jnp.where(is_finite, new, old)  # noqa: E731
    kept = jax.tree.map(keep, replace(moved, num_skipped=state.num_skipped), state)
    state = replace(
        kept,
        num_steps=state.num_steps + 1,
        num_skipped=state.num_skipped + (~is_finite).astype(jnp.int32),
    )
    return state, report


def _revisions(state: RefineState) -> tuple[Revision, ViewRevision | None]:
    """All that a step revises."""
    return state.revision, None if state.views is None else state.views.revision


def view_gradient(
    state: RefineState,
    current: Gaussians,
    key_views: KeyViews,
    view: Int[Array, ""],
    config: RefineConfig,
    max_pairs: int,
    max_rows: int | None,
):
    """Gradient of `view_loss` by all that is revised, and what `view_loss` measures; `current` is the revised scene.

    With `max_rows`, only the rows that the view may see are projected; the others have a gradient of zero.
    """
    background = mean_color(current)

    def loss(revisions: tuple[Revision, ViewRevision | None], start: Gaussians):
        revision, of_views = revisions
        seen = key_views
        if state.views is not None and of_views is not None:
            seen = revised_view(state.views, of_views, key_views, view)
        return view_loss(start, revision, background, seen, view, config, max_pairs)

    slopes = jax.grad(loss, has_aux=True)
    revision, of_views = _revisions(state)
    if max_rows is None or max_rows >= state.start.num_gaussians:
        return slopes((revision, of_views), state.start)
    if state.views is not None:
        key_views = revised_view(state.views, state.views.revision, key_views, view)
    selection = seen_rows(current, key_views.camera(view), max_rows)
    start, revision = take_rows((state.start, revision), selection)
    start = replace(start, opacities=jnp.where(selection.is_row, start.opacities, 0.0))
    (gradient, of_views), (value, error, num_overflow) = slopes((revision, of_views), start)
    num_overflow = jnp.maximum(num_overflow, selection.num_overflow)
    return (put_rows(gradient, selection), of_views), (value, error, num_overflow)


def next_view(place: Int[Array, ""], valid: Bool[Array, " v"], seed: int) -> Int[Array, ""]:
    """Slot of the view at `place` in the sequence of all steps' views.

    Every valid view is shown once a round, in an order drawn anew for each round.
    """
    num_valid = jnp.maximum(jnp.sum(valid, dtype=jnp.int32), 1)
    key = jax.random.fold_in(jax.random.key(seed), place // num_valid)
    order = jnp.argsort(jnp.where(valid, jax.random.uniform(key, valid.shape), 2.0))
    return order[place % num_valid].astype(jnp.int32)


def held_back_pixels(size: tuple[int, int], view: Int[Array, ""], config: RefineConfig) -> Bool[Array, "h w"]:
    """Pixels of a view that no gradient sees: the same blocks at every step."""
    height, width = size
    key = jax.random.fold_in(jax.random.key(config.seed + 1), view)
    blocks = jax.random.uniform(key, (-(-height // BLOCK), -(-width // BLOCK))) < config.held_back
    return jnp.repeat(jnp.repeat(blocks, BLOCK, axis=0), BLOCK, axis=1)[:height, :width]


def view_loss(
    start: Gaussians,
    revision: Revision,
    background: Float[Array, "3"],
    key_views: KeyViews,
    view: Int[Array, ""],
    config: RefineConfig,
    max_pairs: int,
) -> tuple[Float[Array, ""], tuple[Float[Array, ""], Float[Array, ""], Int[Array, ""]]]:
    """L1 error of one key view at its exposure, with holes filled by `background` and over black.

    Returns:
        The loss, and the loss again, the error of the held-back pixels, and the tile intersections that did not fit.
    """
    height, width = key_views.images.shape[1:3]
    held_back = held_back_pixels((height, width), view, config)
    gaussians = apply_revision(start, revision)
    out = render(gaussians, key_views.camera(view), effects=EFFECTS, max_pairs=max_pairs)
    assert out.color is not None and out.alpha is not None
    filled = fill_holes(out.color, out.alpha, background)
    target = key_views.images[view].astype(jnp.float32) / 255
    exposure = key_views.exposures[view]
    errors = config.shown_weight * jnp.abs(filled * exposure - target)
    errors = errors + (1 - config.shown_weight) * jnp.abs(out.color * exposure - target)
    errors = jnp.mean(errors, axis=-1)
    loss = _mean_over(errors, ~held_back)
    return loss, (loss, _mean_over(errors, held_back), out.num_overflow)


def _mean_over(errors: Float[Array, "h w"], pixels: Bool[Array, "h w"]) -> Float[Array, ""]:
    """Mean error of some pixels; 0 for none."""
    return jnp.sum(jnp.where(pixels, errors, 0.0)) / jnp.maximum(jnp.sum(pixels, dtype=errors.dtype), 1.0)


def _adam(state: RefineState, gradient: Revision, rate: Float[Array, ""], config: RefineConfig) -> RefineState:
    """Adam with a learning rate per field, then the bounds."""
    step = (state.num_steps + 1).astype(jnp.float32)
    first = jax.tree.map(lambda m, g: config.adam_b1 * m + (1 - config.adam_b1) * g, state.first_moment, gradient)
    second = jax.tree.map(lambda m, g: config.adam_b2 * m + (1 - config.adam_b2) * g * g, state.second_moment, gradient)
    correct_first, correct_second = 1 - config.adam_b1**step, 1 - config.adam_b2**step

    bands = state.revision.sh.shape[1]
    rates = {
        "means": config.mean_rate,
        "quats": config.quat_rate,
        "log_scales": config.log_scale_rate,
        "logit_opacities": config.logit_opacity_rate,
        # Higher bands move a twentieth as far, as in 3D Gaussian Splatting.
        "sh": (config.color_rate / SH_C0) * jnp.where(jnp.arange(bands) == 0, 1.0, 0.05)[None, :, None],
    }

    def moved(name: str) -> Array:
        m, v = getattr(first, name) / correct_first, getattr(second, name) / correct_second
        return getattr(state.revision, name) - rate * rates[name] * m / (jnp.sqrt(v) + ADAM_EPSILON)

    revision = Revision(**{name: moved(name) for name in rates})
    return replace(state, revision=bounded(revision, config), first_moment=first, second_moment=second)


def bounded(revision: Revision, config: RefineConfig) -> Revision:
    """`revision` inside its trust region."""
    distance = jnp.linalg.norm(revision.means, axis=-1, keepdims=True)
    shrink = jnp.minimum(1.0, config.max_shift / jnp.maximum(distance, 1e-12))
    limit = config.max_log_scale_change
    return replace(
        revision,
        means=revision.means * shrink,
        log_scales=jnp.clip(revision.log_scales, -limit, limit),
        logit_opacities=jnp.clip(revision.logit_opacities, -MAX_LOGIT, MAX_LOGIT),
    )
