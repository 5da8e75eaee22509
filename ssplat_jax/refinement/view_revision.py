"""Changes to the cameras and exposures of key views, and Adam on them. An effect that is off has no array."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import pytree, replace
from ssplat_jax.core.rotations import quats_to_matrices
from ssplat_jax.refinement.refine_effects import RefineEffects

ADAM_B1, ADAM_B2, ADAM_EPSILON = 0.7, 0.99, 1e-15
"""A view is shown a few times in a run: a first moment as long as that of the Gaussians would lag behind."""


@pytree
class ViewRevision:
    """Changes to `v` key views, all zero at the start. Also the form of gradients and moments."""

    poses: Float[Array, "v 6"] | None  # rotation vector, radians; translation, in median depths; camera frame
    log_focal: Float[Array, ""] | None
    log_exposures: Float[Array, "v 3"] | None


@pytree
class ViewState:
    """The revision of key views with its moments."""

    revision: ViewRevision
    first_moment: ViewRevision
    second_moment: ViewRevision
    num_shown: Int[Array, " v"]  # finite steps that showed a view
    depths: Float[Array, " v"]  # median depth of the Gaussians before each view: the unit of its translation


def init_view_state(gaussians: Gaussians, key_views: KeyViews, effects: RefineEffects) -> ViewState | None:
    """The state before the first step; `None` if no effect is on.

    Args:
        gaussians: the scene, which gives the unit of translations.
        key_views: the views as they were given.
        effects: parts that are revised.
    """
    if not effects.any:
        return None
    num = key_views.num_slots
    has_exposures = effects.exposures or effects.white_balance
    zeros = lambda: ViewRevision(  # noqa: E731
        poses=jnp.zeros((num, 6)) if effects.poses else None,
        log_focal=jnp.zeros(()) if effects.focal else None,
        log_exposures=jnp.zeros((num, 3)) if has_exposures else None,
    )
    depths = median_depths(gaussians, key_views.viewmats)
    return ViewState(zeros(), zeros(), zeros(), num_shown=jnp.zeros(num, jnp.int32), depths=depths)


def median_depths(gaussians: Gaussians, viewmats: Float[Array, "v 4 4"]) -> Float[Array, " v"]:
    """Median depth of the Gaussians before each view; 1 where there is none."""

    def of_view(viewmat: Float[Array, "4 4"]) -> Float[Array, ""]:
        depths = gaussians.means @ viewmat[2, :3] + viewmat[2, 3]
        return jnp.nanmedian(jnp.where((depths > 0) & (gaussians.opacities > 0), depths, jnp.nan))

    medians = jax.lax.map(of_view, viewmats)  # one view at a time: depths of all would take a scene's memory
    return jnp.where(jnp.isfinite(medians), medians, 1.0)


def revised_view(state: ViewState, revision: ViewRevision, key_views: KeyViews, view: Int[Array, ""]) -> KeyViews:
    """`key_views` with the one at slot `view` moved by `revision`, differentiable in it.

    Args:
        state: gives the unit of translations.
        revision: changes to the key views; the focal length applies to all of them.
        key_views: the views as they were given.
        view: slot of the view.
    """
    changes: dict[str, Array] = {}
    if revision.poses is not None:
        viewmat = moved_viewmat(key_views.viewmats[view], revision.poses[view], state.depths[view])
        changes["viewmats"] = key_views.viewmats.at[view].set(viewmat)
    if revision.log_focal is not None:
        is_focal = jnp.asarray([[True, False, False], [False, True, False], [False, False, False]])
        changes["Ks"] = key_views.Ks * jnp.where(is_focal, jnp.exp(revision.log_focal), 1.0)
    if revision.log_exposures is not None:
        factors = key_views.exposures[view] * jnp.exp(revision.log_exposures[view])
        changes["exposures"] = key_views.exposures.at[view].set(factors)
    return replace(key_views, **changes)


def revised_key_views(state: ViewState | None, key_views: KeyViews) -> KeyViews:
    """All key views as `state` has revised them."""
    if state is None:
        return key_views
    for view in range(key_views.num_slots):
        moved = revised_view(state, replace(state.revision, log_focal=None), key_views, jnp.int32(view))
        key_views = moved
    if state.revision.log_focal is not None:
        only_focal = ViewRevision(poses=None, log_focal=state.revision.log_focal, log_exposures=None)
        key_views = revised_view(state, only_focal, key_views, jnp.int32(0))
    return key_views


def moved_viewmat(
    viewmat: Float[Array, "4 4"], twist: Float[Array, " 6"], depth: Float[Array, ""]
) -> Float[Array, "4 4"]:
    """`viewmat` followed by a small motion of the camera frame.

    Args:
        viewmat: world -> camera.
        twist: rotation vector in radians, then translation in units of `depth`. The rotation is that of the quaternion
            (1, vector / 2): it equals the exponential map up to third order and has a gradient at 0.
        depth: unit of the translation, in units of the scene.

    Returns:
        World -> moved camera.
    """
    rotation = quats_to_matrices(jnp.concatenate([jnp.ones(1, twist.dtype), twist[:3] / 2]))
    turned = jnp.einsum("ij,jk->ik", rotation, viewmat[:3], precision="highest")
    return viewmat.at[:3].set(turned.at[:, 3].add(depth * twist[3:]))


def step_view_state(
    state: ViewState,
    gradient: ViewRevision,
    views: Int[Array, " b"],
    valid: Bool[Array, " v"],
    rate: Float[Array, ""],
    effects: RefineEffects,
) -> ViewState:
    """One step of Adam on the views that were shown, then the trust region.

    Args:
        state: the revision so far.
        gradient: gradient of the loss, zero for views that were not shown.
        views: slots of the views that were shown.
        valid: slots that hold a view.
        rate: factor of all learning rates.
        effects: which parts are revised, their rates and bounds (static).

    Returns:
        The state after the step. Views that were not shown keep their revision, except for the common factor of all
        exposures.
    """
    shown = jnp.zeros(valid.shape, bool).at[views].set(True)
    num_shown = state.num_shown + shown.astype(jnp.int32)
    is_moving = {
        "poses": (shown & (jnp.arange(len(valid)) != jnp.argmax(valid)))[:, None],
        "log_focal": jnp.array(True),
        "log_exposures": shown[:, None],
    }
    num_steps = -(-jnp.sum(num_shown) // views.shape[0])  # every step moves the focal length, whichever view it shows
    counts = {"poses": num_shown[:, None], "log_focal": num_steps, "log_exposures": num_shown[:, None]}
    rates = {"poses": effects.pose_rate, "log_focal": effects.focal_rate, "log_exposures": effects.exposure_rate}
    parts: dict[str, dict[str, Array | None]] = {"revision": {}, "first_moment": {}, "second_moment": {}}
    for name in rates:
        old, slope = getattr(state.revision, name), getattr(gradient, name)
        if old is None:
            for part in parts.values():
                part[name] = None
            continue
        if name == "log_exposures":
            slope = _of_effects(slope, effects)
        moving, count = is_moving[name], jnp.maximum(counts[name], 1).astype(jnp.float32)
        before = getattr(state.first_moment, name), getattr(state.second_moment, name)
        first = jnp.where(moving, ADAM_B1 * before[0] + (1 - ADAM_B1) * slope, before[0])
        second = jnp.where(moving, ADAM_B2 * before[1] + (1 - ADAM_B2) * slope**2, before[1])
        step = (first / (1 - ADAM_B1**count)) / (jnp.sqrt(second / (1 - ADAM_B2**count)) + ADAM_EPSILON)
        parts["revision"][name] = jnp.where(moving, old - rate * rates[name] * step, old)
        parts["first_moment"][name], parts["second_moment"][name] = first, second
    revision = bounded_views(ViewRevision(**parts["revision"]), valid, effects)
    return ViewState(
        revision=revision,
        first_moment=ViewRevision(**parts["first_moment"]),
        second_moment=ViewRevision(**parts["second_moment"]),
        num_shown=num_shown,
        depths=state.depths,
    )


def _of_effects(slopes: Float[Array, "v 3"], effects: RefineEffects) -> Float[Array, "v 3"]:
    """The part of an exposure's gradient that the effects may follow."""
    common = jnp.mean(slopes, axis=1, keepdims=True)
    if effects.exposures:
        return slopes if effects.white_balance else jnp.broadcast_to(common, slopes.shape)
    return slopes - common


def bounded_views(revision: ViewRevision, valid: Bool[Array, " v"], effects: RefineEffects) -> ViewRevision:
    """`revision` inside its trust region, the exposures with a geometric mean of 1 over the valid views.

    Args:
        revision: changes to the key views.
        valid: slots that hold a view.
        effects: bounds, and whether exposures may change the brightness.
    """
    poses, log_focal, log_exposures = revision.poses, revision.log_focal, revision.log_exposures
    if poses is not None:
        turn, shift = _shortened(poses[:, :3], effects.max_rotation), _shortened(poses[:, 3:], effects.max_translation)
        poses = jnp.concatenate([turn, shift], axis=1)
    if log_focal is not None:
        log_focal = jnp.clip(log_focal, -effects.max_log_focal, effects.max_log_focal)
    if log_exposures is not None:
        mean = jnp.sum(jnp.where(valid[:, None], log_exposures, 0.0), axis=0) / jnp.maximum(
            jnp.sum(valid, dtype=log_exposures.dtype), 1.0
        )
        log_exposures = jnp.clip(log_exposures - mean, -effects.max_log_exposure, effects.max_log_exposure)
        if not effects.exposures:  # Adam divides each channel by its own root mean square, which adds brightness
            log_exposures = log_exposures - jnp.mean(log_exposures, axis=1, keepdims=True)
    return ViewRevision(poses=poses, log_focal=log_focal, log_exposures=log_exposures)


def _shortened(vectors: Float[Array, "v 3"], longest: float) -> Float[Array, "v 3"]:
    length = jnp.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors * jnp.minimum(1.0, longest / jnp.maximum(length, 1e-12))
