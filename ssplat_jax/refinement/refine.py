"""Refinement on the host: many steps, in a few compiled programs, stopped where they no longer help."""

import dataclasses
import functools
import time
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians, mask_gaussians
from ssplat_jax.rasterizer import render
from ssplat_jax.rasterizer.constants import ALPHA_MIN
from ssplat_jax.rasterizer.render import round_up
from ssplat_jax.refinement.densify import compiled_densify
from ssplat_jax.refinement.learned_pass import STEPS, learned_pass
from ssplat_jax.refinement.present_rows import (
    back_in_place,
    only_present,
    present_and_new,
    present_rows,
    round_rows,
)
from ssplat_jax.refinement.refine_config import RefineConfig
from ssplat_jax.refinement.refine_step import (
    RefineState,
    StepReport,
    current_gaussians,
    init_refinement,
    refine_step,
)
from ssplat_jax.refinement.refiner_weights import load_refiner
from ssplat_jax.refinement.revision import apply_revision
from ssplat_jax.refinement.seen_rows import seen_in_any
from ssplat_jax.refinement.usable_views import only_usable
from ssplat_jax.refinement.view_loss import EFFECTS
from ssplat_jax.refinement.view_order import views_of_step

Images = Float[Array | np.ndarray, "v h w 3"] | UInt8[Array | np.ndarray, "v h w 3"]

PAIRS_MARGIN = 1.25
"""Capacity for tile intersections over what the fullest key view needs: Gaussians grow while they are refined."""

PATIENCE = 3
"""Rounds of views without a better held-back error after which refinement ends: few pixels are held back."""

ROWS_MARGIN = 1.02
"""Capacity for rows over what the views of a step may see at most: Gaussians move while they are refined."""


@dataclasses.dataclass
class Progress:
    """Refinement between two steps: all that the next step depends on, and the measurements so far."""

    state: RefineState  # of the present rows
    rows: Int[np.ndarray, " m"] | None  # their numbers in the scene that was given, see `present_rows`
    max_pairs: int  # capacity for tile intersections of the compiled step
    losses: list[float] = dataclasses.field(default_factory=list)  # per step, on the pixels that are learned from
    held_back: list[float] = dataclasses.field(default_factory=list)  # per step, on the pixels that are not
    seconds: list[float] = dataclasses.field(default_factory=list)  # per step; the first of a process compiles
    max_rows: int | None = None  # capacity for the rows that the views of a step may see; None before the first
    num_learned: int = 0  # steps done whose place learned passes took
    num_new: int = 0  # Gaussians added before the first step: the last ones of `rows`

    @property
    def num_steps(self) -> int:
        """Steps done; a learned pass counts as `learned_pass.STEPS`."""
        return len(self.losses)

    def add(self, report: StepReport, seconds: float) -> None:
        """Adds the measurements of a step, or of a learned pass."""
        losses, held_back = np.ravel(report.loss).tolist(), np.ravel(report.held_back).tolist()
        self.losses += losses
        self.held_back += held_back
        self.seconds += [seconds / len(losses)] * len(losses)

    def scene(self, given: Gaussians) -> Gaussians:
        """`given`, the scene that refinement started from, as it is now; Gaussians that became invisible are absent."""
        return back_in_place(_without_faded(current_gaussians(self.state), self.state.start), self.rows, given)


@dataclasses.dataclass(frozen=True)
class Refinement:
    """Report of a call of `refine`."""

    num_steps: int
    num_skipped: int  # steps whose gradient was not finite, and those of a learned pass that did not help
    losses: list[float]  # per step, on the pixels that are learned from
    held_back: list[float]  # per step, on the pixels that are not
    stopped_early: bool  # the held-back error had stopped falling
    seconds_per_step: float  # median, without the first step of each kind, which compiles; 0 where there is no other
    num_left_out: int = 0  # views that could not be learned from, see `only_usable`
    num_new: int = 0  # Gaussians added in holes


def refine(
    gaussians: Gaussians,
    cameras: Camera,
    images: Images,
    *,
    steps: int = 100,
    exposures: Float[Array | np.ndarray, "_ 3"] | None = None,
    config: RefineConfig | None = None,
    refiner: dict | None = None,
    on_step: Callable[[int, float], None] = lambda step, loss: None,
) -> tuple[Gaussians, Refinement]:
    """Gaussians revised by gradient descent on views that show the same scene.

    Works on any Gaussians: a decoded cache, a loaded `.ply`. Rows keep their places, and absent rows stay absent. With
    `config.max_new`, new Gaussians take the places of absent rows, and then places after the last row. A Gaussian that
    became too faint to be drawn is absent.

    Args:
        gaussians: the scene.
        cameras: one batch axis of poses and intrinsics, in the frame of the scene.
        images: what those cameras saw, floats in [0, 1] or uint8.
        steps: most steps; 0 returns `gaussians` as they are. Each renders `config.views_per_step`
            views. A learned pass of `config.learned_passes` takes the place of 8.
        exposures: factors from the scene's colors to each view's; default 1.
        config: learning rates and bounds.
        refiner: parameters of the network of learned passes; default those that ship with the package.
        on_step: called with the number of steps done and the last loss.

    Returns:
        The revised scene and what was done. Refinement ends before `steps` where the held-back pixels have not become
        better for `PATIENCE` rounds of views.

    Raises:
        InputError: shapes do not fit, an image is out of range, `steps` is negative, no view has a finite camera and
            exposure, or a `refiner` is given without learned passes.
    """
    _check(cameras, images, exposures, steps)
    if refiner is not None and not (config or RefineConfig()).learned_passes:
        raise InputError("refine: a refiner needs config.learned_passes of at least 1, got 0; set it, or leave it out.")
    if steps == 0:
        return gaussians, Refinement(0, 0, [], [], False, 0.0)
    given = KeyViews.of(cameras, jnp.asarray(images), exposures)
    progress, key_views = start_refinement(gaussians, given, config)
    for _ in continue_refinement(progress, key_views, steps, config, refiner):
        on_step(progress.num_steps, progress.losses[-1])
    return progress.scene(gaussians), report_of(progress, key_views, config)


def start_refinement(
    gaussians: Gaussians, key_views: KeyViews, config: RefineConfig | None = None
) -> tuple[Progress, KeyViews]:
    """Refinement of `gaussians` before its first step, and the key views to give to `continue_refinement`.

    Views that cannot be learned from are no longer valid (`only_usable`).

    Raises:
        InputError: no view is left.
    """
    config = config or RefineConfig()
    rows = present_rows(gaussians)
    present = only_present(gaussians, rows)
    max_pairs = pairs_capacity(present, key_views)
    usable = only_usable(present, key_views, max_pairs)
    max_new, num_new = int(config.max_new * np.sum(np.asarray(gaussians.opacities) > 0)), 0
    if max_new:
        new, count = compiled_densify(config, max_pairs, max_new)(present, usable)
        num_new = int(count)
    if num_new:
        present, rows = present_and_new(gaussians, new, num_new)
        max_pairs = pairs_capacity(present, key_views)
    return Progress(init_refinement(present, config), rows, max_pairs, num_new=num_new), usable


def continue_refinement(
    progress: Progress,
    key_views: KeyViews,
    steps: int,
    config: RefineConfig | None = None,
    refiner: dict | None = None,
) -> Iterator[None]:
    """Updates `progress` in place, a step or a learned pass an iteration, until `steps` are done or no longer help.

    The caller may save `progress` after any iteration. A refinement that continues from it takes the same steps.

    Args:
        progress: the steps so far.
        key_views: the views to compare with; the same for all steps.
        steps: planned steps, those of `progress` included. They decide how fast the learning rates decay.
        config: learning rates and bounds.
        refiner: parameters of the network of learned passes; default those that ship with the package.
    """
    config = config or RefineConfig()
    if progress.max_rows is None:
        progress.max_rows = row_capacity(progress.state.start, key_views, range(steps), config)
    while progress.num_steps < steps and not _has_stopped_helping(progress, key_views, config):
        start = time.perf_counter()
        if is_learned(progress.num_steps, steps, config) and not int(progress.state.num_skipped):
            step = _learned_pass(config, progress.max_pairs)
            progress.state, report = step(progress.state, key_views, refiner or load_refiner())
            progress.num_learned += STEPS
        else:
            rate = jnp.float32(config.final_rate ** (progress.num_steps / steps))
            step = _step(config, progress.max_pairs, progress.max_rows)
            progress.state, report = step(progress.state, key_views, rate)
        report = jax.block_until_ready(report)  # a step's time is that of its work
        progress.add(report, time.perf_counter() - start)
        _grow_capacities(progress, report, key_views, steps, config)
        yield


def _grow_capacities(
    progress: Progress, report: StepReport, key_views: KeyViews, steps: int, config: RefineConfig
) -> None:
    """Larger capacities for the steps that follow, if something found no space in the last one."""
    num_pairs, num_rows = (int(np.max(x)) for x in (report.num_overflow, report.num_missing_rows))
    if not num_pairs and not num_rows:
        return
    revised = apply_revision(progress.state.start, progress.state.revision)
    if num_pairs:
        # The view that overflowed may not be among those that `_capacity` looks at.
        progress.max_pairs = max(pairs_capacity(revised, key_views), round_up(progress.max_pairs + num_pairs))
    needed = round_rows((progress.max_rows or 0) + num_rows)
    measured = row_capacity(revised, key_views, range(progress.num_steps, steps), config)
    progress.max_rows = min(max(measured, needed if num_rows else 0), revised.num_gaussians)


def is_learned(num_steps: int, steps: int, config: RefineConfig) -> bool:
    """True if a learned pass may follow on `num_steps` of `steps`: passes come first, where enough steps are left."""
    return num_steps < config.learned_passes * STEPS and num_steps + STEPS <= steps


def _has_stopped_helping(progress: Progress, key_views: KeyViews, config: RefineConfig) -> bool:
    """`has_stopped_helping` for the gradient steps; a learned pass shows several rounds of few views as they were."""
    num_views = int(np.sum(np.asarray(key_views.valid)))
    return has_stopped_helping(progress.held_back[progress.num_learned :], -(-num_views // config.views_per_step))


def report_of(progress: Progress, key_views: KeyViews, config: RefineConfig | None = None) -> Refinement:
    """The report of a refinement that has ended."""
    return Refinement(
        num_steps=progress.num_steps,
        num_skipped=int(progress.state.num_skipped),
        losses=progress.losses,
        held_back=progress.held_back,
        stopped_early=_has_stopped_helping(progress, key_views, config or RefineConfig()),
        seconds_per_step=_seconds_per_step(progress),
        num_left_out=int(np.sum(~np.asarray(key_views.valid))),
        num_new=progress.num_new,
    )


def _seconds_per_step(progress: Progress) -> float:
    """Median time of a step, without the first of each kind; 0 if there was no other."""
    learned, taken = progress.seconds[: progress.num_learned], progress.seconds[progress.num_learned :]
    timed = learned[STEPS:] + taken[1:]
    return float(np.median(timed)) if timed else 0.0


def has_stopped_helping(held_back: list[float], steps_per_round: int) -> bool:
    """True if none of the last `PATIENCE` rounds of views has a held-back error below the best before them."""
    num_rounds, rest = divmod(len(held_back), steps_per_round)
    if num_rounds <= PATIENCE or rest or not any(held_back):
        return False  # too early to say, or no pixel is held back
    rounds = np.reshape(held_back, (num_rounds, steps_per_round)).mean(axis=1)
    return float(rounds[-PATIENCE:].min()) >= float(rounds[:-PATIENCE].min())


def _without_faded(gaussians: Gaussians, start: Gaussians) -> Gaussians:
    """`gaussians` without those whose opacity fell below what is drawn; those that `start` has so faint stay."""
    has_faded = (gaussians.opacities < ALPHA_MIN) & (start.opacities >= ALPHA_MIN)
    return mask_gaussians(gaussians, ~has_faded) if bool(has_faded.any()) else gaussians


@functools.cache
def _step(config: RefineConfig, max_pairs: int, max_rows: int):
    step = functools.partial(refine_step, config=config, max_pairs=max_pairs, max_rows=max_rows)
    return jax.jit(step, donate_argnums=0)


@functools.cache
def _learned_pass(config: RefineConfig, max_pairs: int):
    return jax.jit(functools.partial(learned_pass, config=config, max_pairs=max_pairs), donate_argnums=0)


def pairs_capacity(gaussians: Gaussians, key_views: KeyViews, margin: float = PAIRS_MARGIN) -> int:
    """Capacity for the tile intersections of a key view, from a few of them; a step counts what does not fit."""
    counts = [int(render(gaussians, key_views.camera(i), effects=EFFECTS).num_pairs) for i in _spread(key_views)]
    return round_up(int(margin * max(counts)))


def row_capacity(gaussians: Gaussians, key_views: KeyViews, steps: range, config: RefineConfig) -> int:
    """Capacity for the rows that the views of one of `steps` may see; all rows, if some views see most of them."""
    if not steps:
        return gaussians.num_gaussians
    views = jax.vmap(lambda step: views_of_step(step, key_views.valid, config))(jnp.asarray(steps))
    most = ROWS_MARGIN * int(_most_rows_seen(gaussians, key_views, views))
    return min(gaussians.num_gaussians, round_rows(int(most)))


@jax.jit
def _most_rows_seen(gaussians: Gaussians, key_views: KeyViews, views: Int[Array, "s b"]) -> Int[Array, ""]:
    def num_seen(of_step: Int[Array, " b"]) -> Int[Array, ""]:
        return jnp.sum(seen_in_any(gaussians, [key_views.camera(view) for view in of_step]), dtype=jnp.int32)

    return jnp.max(jax.lax.map(num_seen, views))


def _spread(key_views: KeyViews, most: int = 8) -> list[int]:
    """A few views, evenly spread, from which the capacity is estimated."""
    return sorted({round(i) for i in np.linspace(0, key_views.num_slots - 1, most)})


def _check(cameras: Camera, images, exposures, steps: int) -> None:
    if steps < 0:
        raise InputError(f"refine: steps must be at least 0, got {steps}.")
    if cameras.viewmats.ndim != 3 or not len(cameras.viewmats):
        raise InputError(
            f"refine: cameras must have one batch axis, viewmats [v 4 4], got {list(cameras.viewmats.shape)}."
        )
    wanted = (len(cameras.viewmats), cameras.height, cameras.width, 3)
    if tuple(jnp.shape(images)) != wanted:
        raise InputError(f"refine: images must be {list(wanted)} like the cameras, got {list(images.shape)}.")
    low, high = float(jnp.min(images)), float(jnp.max(images))
    if images.dtype != jnp.uint8 and not (jnp.issubdtype(images.dtype, jnp.floating) and low >= 0 and high <= 1):
        raise InputError(
            f"refine: images must be floats in [0, 1] or uint8, got {images.dtype} from {low:g} to {high:g}; scale or"
            " clip them."
        )
    if exposures is not None and tuple(exposures.shape) != (wanted[0], 3):
        raise InputError(f"refine: exposures must be {[wanted[0], 3]}, got {list(exposures.shape)}.")
