"""One refinement step as a pure function: render key views, compare, move every Gaussian by Adam inside its bounds.

start, change ─► apply_change ─► render ─► L1 error ─► gradient with respect to the change
                      change' ◄─ bounded ◄─ rates x units ◄─ optax.scale_by_adam ◄─┘

Rows that a step's views cannot see are not given to the rasterizer. That decides about time alone: the selection knows
each Gaussian as a ball around its mean, so it holds every row that the rasterizer draws.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.cache.changes import MAX_LOGIT, Change, apply_change, no_change
from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import SH_C0, Gaussians, mean_color, with_sh_degree
from ssplat_jax.core.kept_programs import Kept
from ssplat_jax.core.numerics import power_of_two
from ssplat_jax.core.pytree import pytree, replace
from ssplat_jax.rasterizer import constants
from ssplat_jax.rasterizer.effects import camera_points, near_planes
from ssplat_jax.rasterizer.render import TILE
from ssplat_jax.refinement.compared_views import RefineConfig, view_loss, views_of_step

RATES = {"means": 0.08, "quats": 0.003, "log_scales": 0.02, "logit_opacities": 0.2, "sh": 0.015}
"""Adam's learning rates in `units`: about the change per step of a parameter whose gradient keeps its sign."""

HIGHER_BANDS = 0.2  # rate of the higher SH bands as a fraction of that of the constant one: fewer views tell of them

ADAM = optax.scale_by_adam(b1=0.9, b2=0.99, eps=1e-15)
"""`b2` is short, since a run has tens to hundreds of steps. `eps` is below any gradient that a visible Gaussian has in
a mean over pixels; 1e-8 would stop most of them."""

MAX_SHIFT = 4.0  # largest distance of a mean from where it started, in units of the Gaussian's own size
MAX_LOG_SCALE_CHANGE = 1.5  # largest change of a log standard deviation

REACH = 1.001 * math.sqrt(-2 * constants.LOG_ALPHA_MIN)
"""Standard deviations at which an opaque Gaussian falls to the faintest alpha, and a margin for rounding."""

MIN_ROWS = 1 << 12
"""Capacities for rows are multiples of this, or of a 32nd of a larger power of two: few programs are compiled."""


@pytree
class RefineState:
    """The scene that refinement started from, its change, and Adam's moments at the same capacity."""

    start: Gaussians
    change: Change
    adam: optax.ScaleByAdamState
    num_steps: Int[Array, ""]
    num_skipped: Int[Array, ""]  # steps that changed nothing, since a gradient was not finite


@pytree
class StepReport:
    """Measurements of a step, taken before its update; means over its views."""

    loss: Float[Array, ""]  # weighted L1 error of the pixels that are learned from
    held_back: Float[Array, ""]  # the same error of the pixels that are not
    views: Int[Array, " b"]  # slots of the key views
    num_missing_rows: Int[Array, ""]  # rows that the step's views see and that found no space
    num_overflow: Int[Array, ""]  # largest number of tile intersections of one of its views that found no space


@functools.partial(Kept, static_argnums=(1,))
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
        change=no_change(gaussians),
        adam=ADAM.init(no_change(gaussians)),  # pyright: ignore[reportArgumentType]
        num_steps=jnp.zeros((), jnp.int32),
        num_skipped=jnp.zeros((), jnp.int32),
    )


def refine_step(
    state: RefineState,
    key_views: KeyViews,
    rate: Float[Array, ""],
    *,
    config: RefineConfig,
    max_pairs: int,
    max_rows: int | None = None,
    tile: int = TILE,
) -> tuple[RefineState, StepReport]:
    """One step on `VIEWS_PER_STEP` key views. A `lax.scan` body over `rate`; donate `state`.

    Args:
        state: the scene so far.
        key_views: the views to compare with, at least one of them valid.
        rate: factor of all learning rates; 0 changes nothing but the moments.
        config: weights of the loss (static).
        max_pairs: capacity for tile intersections (static); `StepReport.num_overflow` says what did not fit.
        max_rows: capacity for the rows that the step's views may see (static), which alone are rendered. By default,
            and where it holds every row, nothing is selected. The result is the same.
        tile: side of a tile (static), pixels.

    Returns:
        The state after the step, and what was measured before it.
    """
    views = views_of_step(state.num_steps, key_views.valid, config)
    current, pull_back = jax.vjp(functools.partial(apply_change, state.start), state.change)
    background, shown, rows = mean_color(current), current, None
    num_missing = jnp.zeros((), jnp.int32)
    if max_rows is not None and max_rows < current.num_gaussians:
        is_seen = seen_rows(current, key_views, views)
        num_missing = jnp.maximum(jnp.sum(is_seen, dtype=jnp.int32) - max_rows, 0)
        # Places without a row get an opacity of 0, and their gradient is dropped.
        rows = jnp.nonzero(is_seen, size=max_rows, fill_value=is_seen.size)[0]
        shown = jax.tree.map(lambda x: x.at[rows].get(mode="fill", fill_value=0), current)

    def loss(shown: Gaussians, slot: Int[Array, ""]):
        return view_loss(shown, background, key_views.at(slot), slot, config, max_pairs, tile)

    def add_view(total: Gaussians, slot: Int[Array, ""]):
        gradient, measured = jax.grad(loss, has_aux=True)(shown, slot)
        return jax.tree.map(jnp.add, total, gradient), measured

    # A scan holds the intermediate arrays of one view at a time. Adam moves as far by the sum as by the mean.
    total, (losses, held_back, overflows) = jax.lax.scan(add_view, jax.tree.map(jnp.zeros_like, shown), views)
    if rows is not None:
        zeros = jax.tree.map(jnp.zeros_like, current)
        total = jax.tree.map(lambda zero, x: zero.at[rows].set(x, mode="drop"), zeros, total)
    (gradient,) = pull_back(total)
    report = StepReport(jnp.mean(losses), jnp.mean(held_back), views, num_missing, jnp.max(overflows))
    return _moved(state, gradient, report.loss, rate), report


def _moved(state: RefineState, gradient: Change, loss: Float[Array, ""], rate: Float[Array, ""]) -> RefineState:
    """The state after one step of Adam; as it was, if the loss or the sum of the gradients is not finite.

    A Gaussian that no view of the step shows goes on moving by its moments, which decay: if it stood still and kept
    them, it would move less at the same rates, and eight steps reach a loss that is 1 % higher.
    """
    # A sum is as good as a look at each number, and takes a sixth of the time on a CPU.
    is_finite = jnp.isfinite(sum((jnp.sum(leaf) for leaf in jax.tree.leaves(gradient)), loss))
    with jax.numpy_dtype_promotion("standard"):  # optax takes a float to the power of an integer
        direction, adam = ADAM.update(gradient, state.adam)  # pyright: ignore[reportArgumentType]
    is_constant = (jnp.arange(state.change.sh.shape[1]) == 0)[:, None]
    factors = units(state.start) | {"sh": jnp.where(is_constant, 1.0, HIGHER_BANDS) / SH_C0}
    steps = {name: rate * RATES[name] * factor for name, factor in factors.items()}
    moved = {name: old - steps[name] * getattr(direction, name) for name, old in vars(state.change).items()}
    change = bounded(Change(**moved), state.start)
    keep = lambda new, old: jnp.where(is_finite, new, old)  # noqa: E731
    change, adam = jax.tree.map(keep, (change, adam), (state.change, state.adam))
    num_steps, num_skipped = state.num_steps + 1, state.num_skipped + (~is_finite).astype(jnp.int32)
    return replace(state, change=change, adam=adam, num_steps=num_steps, num_skipped=num_skipped)


def units(gaussians: Gaussians) -> dict[str, Array | float]:
    """Units of a `Change` in which a step is the same for Gaussians of all sizes: their own size, a color of 1."""
    same = dict.fromkeys(("quats", "log_scales", "logit_opacities"), 1.0)
    return {"means": sizes(gaussians)[:, None], **same, "sh": 1.0 / SH_C0}


def sizes(gaussians: Gaussians) -> Float[Array, " n"]:
    """Mean of the two larger standard deviations: the extent of a flat Gaussian in its plane."""
    return (jnp.sum(gaussians.scales, axis=-1) - jnp.min(gaussians.scales, axis=-1)) / 2


def bounded(change: Change, start: Gaussians) -> Change:
    """`change` inside its trust region around `start`."""
    distance = jnp.linalg.norm(change.means, axis=-1, keepdims=True)
    shrink = jnp.minimum(1.0, MAX_SHIFT * sizes(start)[:, None] / jnp.maximum(distance, 1e-30))
    log_scales = jnp.clip(change.log_scales, -MAX_LOG_SCALE_CHANGE, MAX_LOG_SCALE_CHANGE)
    logits = jnp.clip(change.logit_opacities, -MAX_LOGIT, MAX_LOGIT)
    return replace(change, means=change.means * shrink, log_scales=log_scales, logit_opacities=logits)


def round_rows(num_rows: int) -> int:
    """The capacity for a number of rows, at most a sixteenth above it where there are many."""
    unit = max(MIN_ROWS, power_of_two(num_rows) // 32)
    return max(unit, unit * -(-num_rows // unit))


def without_padding(gaussians: Gaussians) -> Gaussians:
    """The rows up to the last present one, rounded up: Adam moves every row, and half of a stream's may be padding."""
    present = np.flatnonzero(np.asarray(gaussians.opacities) > 0)
    num_rows = round_rows(int(present.max(initial=-1)) + 1)
    return jax.tree.map(lambda x: jax.device_put(np.asarray(x)[:num_rows]), gaussians)  # compiles nothing


def seen_rows(gaussians: Gaussians, key_views: KeyViews, views: Int[Array, " b"]) -> Bool[Array, " n"]:
    """Mask of the Gaussians that may change a pixel of at least one of some key views."""
    return functools.reduce(jnp.logical_or, (may_be_seen(gaussians, key_views.camera(slot)) for slot in views))


def may_be_seen(gaussians: Gaussians, camera: Camera) -> Bool[Array, " n"]:
    """Mask of the Gaussians that may change a pixel of one camera, without lens distortion.

    The standard deviation on the screen is at most |J| times the largest one in the scene, where J is the row of the
    projection's Jacobian, and the filter adds at most `CLASSIC_VARIANCE`.

    Limits:
        True for every row that `project` makes visible and whose box touches the image. NaN gives False.
    """
    viewmats = camera.viewmats[None]
    x, y, z = (entry[0] for entry in camera_points(gaussians.means, viewmats))
    is_seen = (z > near_planes(gaussians, viewmats)[0]) & (gaussians.opacities > 0)
    z = jnp.where(is_seen, z, 1.0)
    largest = jnp.max(gaussians.scales, axis=-1)
    for across, axis, size in ((x, 0, camera.width), (y, 1, camera.height)):
        focal, center = camera.Ks[axis, axis], camera.Ks[axis, 2]
        margin = constants.FRUSTUM_MARGIN * 0.5 * size / focal
        bounds = jnp.stack([-center / focal - margin, (size - center) / focal + margin])
        clamped = jnp.clip(across / z, jnp.min(bounds), jnp.max(bounds))
        spread = largest * jnp.abs(focal) * jnp.sqrt(1 + clamped * clamped) / z
        radius = REACH * jnp.sqrt(spread * spread + constants.CLASSIC_VARIANCE) + 0.1
        is_seen &= jnp.abs(focal * across / z + center - size / 2) <= size / 2 + radius
    return is_seen
