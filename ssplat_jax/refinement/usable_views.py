"""Key views that can be learned from: broken and contradicting ones are left out before the first step."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import Effects, render

WORSE_THAN_USUAL = 2.0
"""Ratio to the median error above which a view counts as one of another scene, or of a wrong pose."""
FEWEST_TO_JUDGE = 4
"""Views that a median needs to mean something."""
MOST_LEFT_OUT = 0.25
"""Share of the views that may be left out for their error: beyond it the scene is wrong, not the views."""


def only_usable(gaussians: Gaussians, key_views: KeyViews, max_pairs: int) -> KeyViews:
    """`key_views` whose unusable views are not valid. It looks at values: call it outside jit.

    A view is unusable if its exposure is not finite and positive, if its camera is not finite, or if its error is more
    than twice the median of all views: a black frame, another scene, a pose that is far off. At most a quarter of the
    views is left out for the error, the worst first; fewer than four views are not judged by it. The error is the mean
    over what the scene covers, so a view of little known places stays.

    Args:
        gaussians: the scene before refinement.
        key_views: the views.
        max_pairs: capacity for tile intersections.

    Raises:
        InputError: no view is left.
    """
    usable = np.asarray(key_views.valid) & sound_views(key_views)
    slots = np.flatnonzero(usable)
    errors = np.array([float(_view_error(gaussians, key_views, jnp.int32(i), max_pairs)) for i in slots])
    usable[slots[contradicting(errors)]] = False
    if not usable.any():
        raise InputError(
            "refine: wanted at least one view with a finite camera and a positive, finite exposure, got none of"
            f" {key_views.num_slots}."
        )
    return replace(key_views, valid=jnp.asarray(usable))


def sound_views(key_views: KeyViews) -> Bool[np.ndarray, " v"]:
    """Mask of the views whose exposure is finite and positive and whose camera is finite."""
    exposures = np.asarray(key_views.exposures)
    finite = [np.isfinite(np.asarray(x)).all((1, 2)) for x in (key_views.viewmats, key_views.Ks)]
    return np.logical_and.reduce([*finite, (np.isfinite(exposures) & (exposures > 0)).all(1)])


def contradicting(errors: Float[np.ndarray, " v"]) -> Int[np.ndarray, " b"]:
    """Places of the errors that are too large beside the others, see `only_usable`; NaN is never too large."""
    judged = errors[np.isfinite(errors)]
    if len(judged) < FEWEST_TO_JUDGE:
        return np.zeros(0, int)
    worst_first = np.argsort(-np.where(np.isfinite(errors), errors, -1.0), kind="stable")
    most = int(MOST_LEFT_OUT * len(judged))
    return np.array([k for k in worst_first[:most] if errors[k] > WORSE_THAN_USUAL * np.median(judged)], int)


@functools.partial(jax.jit, static_argnames="max_pairs")
def _view_error(gaussians: Gaussians, key_views: KeyViews, view: Int[Array, ""], max_pairs: int) -> Float[Array, ""]:
    """Mean absolute error of a view over what the scene covers of it; NaN if it covers next to nothing."""
    out = render(gaussians, key_views.camera(view), effects=Effects(outputs=("color", "alpha")), max_pairs=max_pairs)
    target = key_views.images[view].astype(jnp.float32) / 255
    # The uncovered share of a pixel is compared with nothing.
    errors = jnp.mean(jnp.abs(out.color * key_views.exposures[view] - out.alpha[..., None] * target), axis=-1)
    cover = jnp.sum(out.alpha)
    return jnp.where(cover > 0.01 * out.alpha.size, jnp.sum(errors) / jnp.maximum(cover, 1.0), jnp.nan)
