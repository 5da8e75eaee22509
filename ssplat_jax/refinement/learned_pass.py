"""A learned pass: several key views are compared with the scene, then a network changes all Gaussians at once.

    scene ─► render each view ─► error ─► gradients, pixels and errors of each Gaussian, summed over the views
                                                   │ refiner_features
                                change' ◄─ apply ◄─ Refiner

Adam's first steps all have full size, whatever the error is, so it needs tens of small ones; the network has learned
how far to go. It reads gradients in each Gaussian's own axes, so it works for the Gaussians of any scene. A pass takes
the place of the next `STEPS` gradient steps and shows their views. ReSplat's recurrent refinement is the model: render,
feed the error back, predict the change, with the same network in every pass.
"""

import functools
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ssplat_jax.cache.changes import Change, apply_change, no_change
from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.gaussians import SH_C0, Gaussians, mean_color
from ssplat_jax.core.numerics import safe_log
from ssplat_jax.core.pytree import pytree, replace
from ssplat_jax.core.rotations import quats_to_matrices
from ssplat_jax.model.refiner import Refiner, gains_and_shifts
from ssplat_jax.refinement.compared_views import errors_of_view, held_back_pixels, mean_over, view_loss, views_of_step
from ssplat_jax.refinement.refine_config import RefineConfig
from ssplat_jax.refinement.refine_step import RefineState, StepReport, bounded, sizes, units
from ssplat_jax.storage.files import load_arrays, save_arrays

STEPS = 8  # gradient steps whose place a pass takes: it shows as many views
LARGEST = {"means": 0.5, "quats": 0.05, "log_scales": 0.5, "logit_opacities": 2.0, "colors": 0.2, "bands": 0.05}
"""Largest change of each part in a pass; places in units of the Gaussian's own size, `colors` and `bands` of color."""
CLIPPED_ERROR = 0.1  # error of a pixel beyond which it does not count more: occlusions and moving things
MIN_GRADIENT = 1e-3  # added to the divisor of the agreement of views
NUM_CHECKED = 4  # views of a pass that are rendered once more, to see whether it helps
MIN_PIXELS = 0.1  # that a Gaussian must fill in the views of a pass, or it stays as it is
KIND = "refiner"  # of the file with the network's parameters


@pytree
class SeenErrors:
    """Errors that the views of a pass see in `n` Gaussians: sums over the views."""

    gradients: dict[str, Float[Array, "n _"]]  # of the error by part, places in the Gaussian's own axes
    squares: dict[str, Float[Array, "n _"]]  # squared gradients of the single views
    pixels: Float[Array, " n"]  # that it fills
    errors: Float[Array, " n"]  # absolute error of these pixels
    signed: Float[Array, " n"]  # their error over `CLIPPED_ERROR`, with its sign and at most 1
    num_views: Float[Array, " n"]  # in which it fills at least `MIN_PIXELS`


def no_errors(gaussians: Gaussians) -> SeenErrors:
    """The sums over no view."""
    zeros, none = gradients_by_part(gaussians, no_change(gaussians)), jnp.zeros_like(gaussians.opacities)
    return SeenErrors(zeros, zeros, none, none, none, none)


def gradients_by_part(gaussians: Gaussians, gradient: Change) -> dict[str, Float[Array, "n _"]]:
    """Gradients by the network's parts, in `units`: places in the axes of each Gaussian, SH bands in units of color."""
    in_units = {name: unit * getattr(gradient, name) for name, unit in units(gaussians).items()}
    sh, opacities = in_units.pop("sh"), in_units.pop("logit_opacities")
    means = jnp.einsum("nji,nj->ni", quats_to_matrices(gaussians.quats), in_units["means"])
    own = {"means": means, "logit_opacities": opacities[:, None]}
    return in_units | own | {"colors": sh[:, 0], "bands": sh[:, 1:].reshape(len(sh), -1)}


def add_view(
    seen: SeenErrors,
    start: Gaussians,
    change: Change,
    key_views: KeyViews,
    slot: Int[Array, ""],
    config: RefineConfig,
    max_pairs: int,
) -> tuple[SeenErrors, tuple[Float[Array, ""], Float[Array, ""], Int[Array, ""]]]:
    """`seen` with one key view added, and the loss, held-back error and overflow of the view as in `view_loss`.

    The error is a Huber loss: its gradient is linear in the difference of the colors up to `CLIPPED_ERROR`. One
    backward pass gives all that the network reads: three channels of zeros are rendered beside the colors, and their
    gradients are the pixels that a Gaussian fills and the errors in them.
    """
    current, view, weight = apply_change(start, change), key_views.at(slot), config.shown_weight
    background = mean_color(current)

    def images(change: Change, probe: Float[Array, "n 3"]):
        gaussians = apply_change(start, change)
        filled, black, out = errors_of_view(gaussians, background, view, max_pairs=max_pairs, probe=probe)
        return (filled, black, out.features), out.num_overflow

    probe = jnp.zeros((start.num_gaussians, 3), start.means.dtype)
    (filled, black, features), pull, overflow = jax.vjp(images, change, probe, has_aux=True)
    held_back = held_back_pixels(black.shape[:2], slot, config)
    learned = ~held_back[..., None]
    clipped = lambda error: jnp.where(learned, jnp.clip(error / CLIPPED_ERROR, -1.0, 1.0), 0.0)  # noqa: E731
    told = [jnp.ones(black.shape[:2], black.dtype), jnp.abs(black).mean(axis=-1), clipped(black).mean(axis=-1)]
    told = jnp.where(learned, jnp.stack(told, axis=-1), 0.0).astype(features.dtype)
    gradient, sums = pull((weight * clipped(filled), (1 - weight) * clipped(black), told))
    by_part, pixels = gradients_by_part(current, gradient), sums[:, 0]
    num_views = (pixels >= MIN_PIXELS).astype(pixels.dtype)
    added = SeenErrors(by_part, jax.tree.map(jnp.square, by_part), pixels, sums[:, 1], sums[:, 2], num_views)
    difference = jnp.mean(weight * jnp.abs(filled) + (1 - weight) * jnp.abs(black), axis=-1)
    measured = mean_over(difference, ~held_back), mean_over(difference, held_back), overflow
    return jax.tree.map(jnp.add, seen, added), measured


def is_learned(num_steps: int, steps: int, config: RefineConfig) -> bool:
    """True if a learned pass may follow on `num_steps` of `steps`: passes come first, where enough steps are left."""
    return num_steps < config.learned_passes * STEPS and num_steps + STEPS <= steps


def learned_pass(
    state: RefineState, key_views: KeyViews, refiner: dict, *, config: RefineConfig, max_pairs: int
) -> tuple[RefineState, StepReport]:
    """The state after a learned pass, and the reports of the `STEPS` steps whose place it takes, as of `refine_step`.

    Limits:
        A pass changes nothing if the first `NUM_CHECKED` of its views look no better after it, or if it gives a number
        that is not finite; its steps are then counted in `num_skipped`. Gaussians that no view of the pass shows stay
        as they are. Bounds are those of `refine_step`.
    """
    steps = state.num_steps + jnp.arange(STEPS, dtype=jnp.int32)
    views = jax.vmap(lambda step: views_of_step(step, key_views.valid, config))(steps)
    current = apply_change(state.start, state.change)
    seen, measured = jax.lax.scan(
        lambda seen, slot: add_view(seen, state.start, state.change, key_views, slot, config, max_pairs),
        no_errors(current),
        views.reshape(-1),
    )
    losses, held_back, overflows = (x.reshape(views.shape) for x in measured)
    change = jax.tree.map(jnp.add, state.change, learned_change(refiner, current, seen))
    change = bounded(change, state.start)
    after, checked = apply_change(state.start, change), views.reshape(-1)[:NUM_CHECKED]
    background = mean_color(after)
    loss = lambda slot: view_loss(after, background, key_views.at(slot), slot, config, max_pairs)[0]  # noqa: E731
    # A loss of NaN does not help either. Gaussians that no checked view shows are looked at themselves.
    helps = jnp.mean(jax.lax.map(loss, checked)) < jnp.mean(losses.reshape(-1)[:NUM_CHECKED])
    for leaf in jax.tree.leaves(change):
        helps = helps & jnp.all(jnp.isfinite(leaf))
    moved = replace(
        state,
        change=jax.tree.map(lambda new, old: jnp.where(helps, new, old), change, state.change),
        # Adam counts the steps but its moments stay zero, so that its first own step has 0.6 of the full size: a scene
        # that is nearly right changes little.
        adam=state.adam._replace(count=state.adam.count + STEPS),
        num_steps=state.num_steps + STEPS,
        num_skipped=state.num_skipped + STEPS * (~helps).astype(jnp.int32),
    )
    measured = losses.mean(axis=1), held_back.mean(axis=1), views, jnp.zeros_like(steps), overflows.max(axis=1)
    return moved, StepReport(*measured)


def learned_change(refiner: dict, gaussians: Gaussians, seen: SeenErrors) -> Change:
    """The change of all Gaussians that the network predicts from what views say, differentiable in its parameters.

    Limits:
        Parts change by at most `LARGEST`. Absent Gaussians, and those below `MIN_PIXELS`, change by 0.
    """
    agreement = {name: seen.gradients[name] / (jnp.sqrt(seen.squares[name]) + MIN_GRADIENT) for name in LARGEST}
    out = Refiner().apply({"params": refiner}, refiner_features(gaussians, seen, agreement))
    is_seen = ((seen.pixels >= MIN_PIXELS) & (gaussians.opacities > 0))[:, None]
    step = {
        name: jnp.where(is_seen, LARGEST[name] * jnp.tanh(shift - gain * agreement[name]), 0.0)
        for name, (gain, shift) in gains_and_shifts(jnp.asarray(out)).items()
    }
    unit, bands = units(gaussians), step["bands"].reshape(len(is_seen), -1, 3)
    return Change(
        means=unit["means"] * jnp.einsum("nij,nj->ni", quats_to_matrices(gaussians.quats), step["means"]),
        quats=step["quats"],
        log_scales=step["log_scales"],
        logit_opacities=step["logit_opacities"][:, 0],
        sh=unit["sh"] * jnp.concatenate([step["colors"][:, None], bands], axis=1),
    )


def refiner_features(
    gaussians: Gaussians, seen: SeenErrors, agreement: dict[str, Float[Array, "n _"]]
) -> Float[Array, "n f"]:
    """Inputs of the network, as numbers of about unit size; finite for absent and hidden Gaussians, without gradient.

    `agreement` is by part the views' summed gradients over the root of their summed squares.
    """
    pixels, num_views = seen.pixels[:, None], seen.num_views[:, None]
    opacities = jnp.clip(gaussians.opacities, 1e-4, 1 - 1e-4)[:, None]
    told = ("means", "log_scales", "logit_opacities", "colors")
    features = (
        *(agreement[name] for name in told),
        *(jnp.clip(seen.gradients[name] / (pixels + 1.0), -3.0, 3.0) for name in told),
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


def init_refiner(seed: int = 0) -> dict:
    """Parameters before training: every step goes a little against the gradient."""
    one, none = jnp.ones((1, 3)), jnp.zeros(1)
    gaussians = Gaussians(means=one, quats=jnp.ones((1, 4)), scales=one, opacities=none, sh=one[:, None])
    seen = no_errors(gaussians)
    return dict(Refiner().init(jax.random.key(seed), refiner_features(gaussians, seen, seen.gradients))["params"])


def save_refiner(path: Path, params: dict, provenance: dict[str, Any]) -> None:
    """Writes the parameters and JSON facts about their training; StorageError if the file cannot be written."""
    arrays = {f"{layer}/{name}": np.asarray(x) for layer, part in params.items() for name, x in part.items()}
    save_arrays(path, arrays, KIND, {"provenance": provenance})


@functools.cache
def load_refiner(path: Path | None = None) -> dict:
    """The parameters in a file; without one, those that ship with the package."""
    with resources.as_file(resources.files("ssplat_jax") / "weights" / "refiner.npz") as shipped:
        arrays, _ = load_arrays(path or shipped, KIND)
    named = lambda where, _: jnp.asarray(arrays["/".join(key.key for key in where)])  # noqa: E731
    return jax.tree.map_with_path(named, jax.eval_shape(init_refiner))
