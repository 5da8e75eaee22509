"""A learned pass: several key views are compared with the scene, then a network revises all Gaussians at once.

    scene ─► render each view ─► error ─► gradients, pixels and errors of each Gaussian, summed over the views
                                                   │ refiner_features
                              revision' ◄─ apply ◄─ Refiner

A pass takes the place of the next `STEPS` gradient steps and shows their views. ReSplat's recurrent refinement is the
model: render, feed the error back, predict the change, with the same network in every pass.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.gaussians import SH_C0, Gaussians, mean_color
from ssplat_jax.core.numerics import safe_log
from ssplat_jax.core.pytree import pytree, replace
from ssplat_jax.core.rotations import quats_to_matrices
from ssplat_jax.model.refiner import Refiner, gains_and_shifts
from ssplat_jax.rasterizer import fill_holes, render
from ssplat_jax.refinement.refine_config import RefineConfig
from ssplat_jax.refinement.refine_step import RefineState, StepReport
from ssplat_jax.refinement.revision import Revision, apply_revision, bounded, no_revision, sizes
from ssplat_jax.refinement.view_loss import EFFECTS, held_back_pixels, mean_over, view_loss
from ssplat_jax.refinement.view_order import next_view

STEPS = 8
"""Gradient steps whose place a pass takes: it shows as many views."""

LARGEST = {"means": 0.5, "quats": 0.05, "log_scales": 0.5, "logit_opacities": 2.0, "colors": 0.2, "bands": 0.05}
"""Largest change of each part in a pass; places in units of the Gaussian's own size, `colors` and `bands` of color."""

CLIPPED_ERROR = 0.1
"""Error of a pixel beyond which it does not count more: occlusions and moving things."""

LEAST_SLOPE = 1e-3
"""Added to the divisor of the agreement, which is the views' summed gradients over the root of their summed squares."""

NUM_CHECKED = 4
"""Views of a pass that are rendered once more, to see whether it helps."""

MIN_PIXELS = 0.1
"""Pixels that a Gaussian must fill in the views of a pass, or it stays as it is."""


@pytree
class SeenErrors:
    """Errors that the views of a pass see in `n` Gaussians: sums over the views."""

    slopes: dict[str, Float[Array, "n _"]]  # gradients of the error by part, places in the Gaussian's own axes
    squares: dict[str, Float[Array, "n _"]]  # squared gradients of the single views
    pixels: Float[Array, " n"]  # that it fills
    errors: Float[Array, " n"]  # absolute error of these pixels
    signed: Float[Array, " n"]  # their error over `CLIPPED_ERROR`, with its sign and at most 1
    num_views: Float[Array, " n"]  # in which it fills at least `MIN_PIXELS`


def no_errors(gaussians: Gaussians) -> SeenErrors:
    """The sums over no view."""
    zeros, none = slopes_by_part(gaussians, no_revision(gaussians)), jnp.zeros_like(gaussians.opacities)
    return SeenErrors(slopes=zeros, squares=zeros, pixels=none, errors=none, signed=none, num_views=none)


def slopes_by_part(gaussians: Gaussians, slopes: Revision) -> dict[str, Float[Array, "n _"]]:
    """Gradients by the network's parts: places in the axes of each Gaussian, SH bands in units of color."""
    frames = quats_to_matrices(gaussians.quats)
    return {
        "means": jnp.einsum("nji,nj->ni", frames, slopes.means),
        "quats": slopes.quats,
        "log_scales": slopes.log_scales,
        "logit_opacities": slopes.logit_opacities[:, None],
        "colors": slopes.sh[:, 0] / SH_C0,
        "bands": slopes.sh[:, 1:].reshape(len(slopes.sh), -1) / SH_C0,
    }


def add_view(
    seen: SeenErrors,
    start: Gaussians,
    revision: Revision,
    key_views: KeyViews,
    view: Int[Array, ""],
    config: RefineConfig,
    max_pairs: int,
) -> tuple[SeenErrors, tuple[Float[Array, ""], Float[Array, ""], Int[Array, ""]]]:
    """`seen` with one key view added, and the measurements of the view as `view_loss` has them.

    The error is a Huber loss: its gradient is linear in the difference of the colors up to `CLIPPED_ERROR`.

    Args:
        seen: the sums over the views before.
        start: the scene that `revision` revises.
        revision: the changes so far; gradients are taken by it.
        key_views: the views to compare with.
        view: slot of the view to add.
        config: weights of the error.
        max_pairs: capacity for tile intersections.

    Returns:
        The sums, and (loss, held-back error, overflow) of the view.
    """
    camera, exposure = key_views.camera(view), key_views.exposures[view]
    height, width = key_views.images.shape[1:3]
    current = apply_revision(start, revision)
    background = mean_color(current)
    target = key_views.images[view].astype(jnp.float32) / 255

    def images(revision: Revision, probe: Float[Array, "n 3"]):
        gaussians = apply_revision(start, revision)
        out = render(gaussians, camera, effects=EFFECTS, features=probe, max_pairs=max_pairs)
        filled = fill_holes(out.color, out.alpha, background)
        return (filled * exposure - target, out.color * exposure - target, out.features), out.num_overflow

    # Channels of zeros show nothing; their gradients sum up what lies in the pixels that each Gaussian fills.
    probe = jnp.zeros((start.num_gaussians, 3), start.means.dtype)
    (filled, black, features), pull, overflow = jax.vjp(images, revision, probe, has_aux=True)
    held_back = held_back_pixels((height, width), view, config)
    learned = ~held_back[..., None]
    clipped = lambda error: jnp.where(learned, jnp.clip(error / CLIPPED_ERROR, -1.0, 1.0), 0.0)  # noqa: E731
    absolute = jnp.abs(black).mean(axis=-1, keepdims=True)
    told = jnp.concatenate([jnp.ones_like(absolute), absolute, clipped(black).mean(axis=-1, keepdims=True)], axis=-1)
    told = jnp.where(learned, told, 0.0).astype(features.dtype)
    weight = config.shown_weight
    slopes, sums = pull((weight * clipped(filled), (1 - weight) * clipped(black), told))
    by_part = slopes_by_part(current, slopes)
    pixels, errors, signed = jnp.moveaxis(sums, -1, 0)
    added = SeenErrors(
        slopes=by_part,
        squares=jax.tree.map(jnp.square, by_part),
        pixels=pixels,
        errors=errors,
        signed=signed,
        num_views=(pixels >= MIN_PIXELS).astype(pixels.dtype),
    )
    difference = jnp.mean(weight * jnp.abs(filled) + (1 - weight) * jnp.abs(black), axis=-1)
    measured = mean_over(difference, ~held_back), mean_over(difference, held_back), overflow
    return jax.tree.map(jnp.add, seen, added), measured


def learned_pass(
    state: RefineState, key_views: KeyViews, refiner: dict, *, config: RefineConfig, max_pairs: int
) -> tuple[RefineState, StepReport]:
    """The state after a learned pass, and the reports of the `STEPS` steps whose place it takes. Donate `state`.

    Args:
        state: the scene so far.
        key_views: the views to compare with, at least one of them valid.
        refiner: parameters of the network (`load_refiner`).
        config: weights and bounds (static).
        max_pairs: capacity for tile intersections (static); `StepReport.num_overflow` says what did not fit.

    Returns:
        The state, `STEPS` steps further, and a report with a leading axis of `STEPS`, measured before the change.

    Limits:
        A pass changes nothing if the first `NUM_CHECKED` of its views look no better after it, or if it gives a number
        that is not finite; its steps are then counted in `num_skipped`. Gaussians that no view of the pass shows stay
        as they are. Bounds are those of `refine_step`.
    """
    places = state.num_steps * config.views_per_step + jnp.arange(STEPS * config.views_per_step, dtype=jnp.int32)
    views = jax.vmap(lambda place: next_view(place, key_views.valid, config.seed))(places)

    def body(seen: SeenErrors, view: Int[Array, ""]):
        return add_view(seen, state.start, state.revision, key_views, view, config, max_pairs)

    current = apply_revision(state.start, state.revision)
    seen, measured = jax.lax.scan(body, no_errors(current), views)
    losses, held_back, overflows = (x.reshape(STEPS, config.views_per_step) for x in measured)
    change = learned_change(refiner, current, seen)
    revision = bounded(jax.tree.map(jnp.add, state.revision, change), config)
    checked = min(NUM_CHECKED, views.shape[0])
    after = _mean_loss(replace(state, revision=revision), key_views, views[:checked], config, max_pairs)
    # A loss of NaN does not help either. Gaussians that no checked view shows are looked at themselves.
    helps = after < jnp.mean(losses.reshape(-1)[:checked])
    for leaf in jax.tree.leaves(revision):
        helps = helps & jnp.all(jnp.isfinite(leaf))
    moved = replace(
        state,
        revision=jax.tree.map(lambda new, old: jnp.where(helps, new, old), revision, state.revision),
        num_steps=state.num_steps + STEPS,
        num_skipped=state.num_skipped + STEPS * (~helps).astype(jnp.int32),
    )
    return moved, StepReport(
        loss=losses.mean(axis=1),
        held_back=held_back.mean(axis=1),
        views=views.reshape(STEPS, -1),
        num_missing_rows=jnp.zeros((STEPS,), jnp.int32),
        num_overflow=overflows.max(axis=1),
    )


def _mean_loss(
    state: RefineState, key_views: KeyViews, views: Int[Array, " b"], config: RefineConfig, max_pairs: int
) -> Float[Array, ""]:
    """Mean of `view_loss` over some views."""
    current = apply_revision(state.start, state.revision)
    background = mean_color(current)

    def body(total: Float[Array, ""], view: Int[Array, ""]):
        return total + view_loss(current, background, key_views, view, config, max_pairs)[0], None

    return jax.lax.scan(body, jnp.zeros((), current.means.dtype), views)[0] / views.shape[0]


def learned_change(refiner: dict, gaussians: Gaussians, seen: SeenErrors) -> Revision:
    """The change of all Gaussians that the network predicts, differentiable in its parameters.

    Args:
        refiner: parameters of the network.
        gaussians: the scene that the views saw.
        seen: what they say about it.

    Limits:
        Parts change by at most `LARGEST`. Absent Gaussians, and those below `MIN_PIXELS`, change by 0.
    """
    agreement = {name: seen.slopes[name] / (jnp.sqrt(seen.squares[name]) + LEAST_SLOPE) for name in LARGEST}
    features = refiner_features(gaussians, seen, agreement)
    out = gains_and_shifts(jnp.asarray(Refiner().apply({"params": refiner}, features)))
    is_seen = (seen.pixels >= MIN_PIXELS) & (gaussians.opacities > 0)

    def change(name: str) -> Array:
        gain, shift = out[name]
        step = LARGEST[name] * jnp.tanh(shift - gain * agreement[name])
        return jnp.where(is_seen[:, None], step, 0.0)

    bands = change("bands").reshape(len(is_seen), -1, 3)
    return Revision(
        means=jnp.einsum("nij,nj->ni", quats_to_matrices(gaussians.quats), change("means")),
        quats=change("quats"),
        log_scales=change("log_scales"),
        logit_opacities=change("logit_opacities")[:, 0],
        sh=jnp.concatenate([change("colors")[:, None], bands], axis=1) / SH_C0,
    )


def refiner_features(
    gaussians: Gaussians, seen: SeenErrors, agreement: dict[str, Float[Array, "n _"]]
) -> Float[Array, "n f"]:
    """Inputs of the network, as numbers of about unit size. No gradient flows through them.

    Args:
        gaussians: the scene that the views saw.
        seen: what they say about it.
        agreement: by part, the views' summed gradients over the root of their summed squares.

    Limits:
        Gaussians that no view shows, and absent ones, have finite features.
    """
    pixels, num_views = seen.pixels[:, None], seen.num_views[:, None]
    opacities = jnp.clip(gaussians.opacities, 1e-4, 1 - 1e-4)[:, None]
    told = ("means", "log_scales", "logit_opacities", "colors")
    features = (
        *(agreement[name] for name in told),
        *(jnp.clip(seen.slopes[name] / (pixels + 1.0), -3.0, 3.0) for name in told),
        jnp.log1p(pixels) - 2.0,
        jnp.log1p(num_views) - 1.0,
        jnp.log1p(pixels / jnp.maximum(num_views, 1.0)) - 1.0,
        10 * seen.errors[:, None] / (pixels + 1.0) - 0.3,
        seen.signed[:, None] / (pixels + 1.0),
        (jnp.log(opacities) - jnp.log1p(-opacities)) / 3,
        SH_C0 * gaussians.sh[:, 0],
        jnp.clip(safe_log(gaussians.scales / jnp.maximum(sizes(gaussians), 1e-12)[:, None]), -4.0, 1.0),
    )
    return jax.lax.stop_gradient(jnp.concatenate(features, axis=-1))
