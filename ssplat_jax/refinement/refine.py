"""Refinement on the host: many steps, in a few compiled programs, stopped where they no longer help.

    Progress.start ─► Progress.steps: a step an iteration ─► Progress.scene, Progress.report

`refine` runs all of it on given images; `key_views_of` are the frames of a stream.
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from ssplat_jax.cache.changes import Change, apply_change, changed_gaussians
from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.chunk import check_images
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians, mask_gaussians, with_sh_degree
from ssplat_jax.core.kept_programs import Kept
from ssplat_jax.core.numerics import evenly_spread
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.rasterizer.constants import ALPHA_MIN
from ssplat_jax.rasterizer.render import TILE, count_pairs, round_up
from ssplat_jax.refinement import compared_views
from ssplat_jax.refinement.compared_views import RefineConfig, only_usable, views_of_step
from ssplat_jax.refinement.refine_step import (
    RefineState,
    init_refinement,
    refine_step,
    round_rows,
    seen_rows,
    without_padding,
)
from ssplat_jax.streaming.session import Exposures

Images = Float[Array | np.ndarray, "v h w 3"] | UInt8[Array | np.ndarray, "v h w 3"]

FINAL_RATE = 0.3  # fraction of the learning rates that is left at the last planned step; they decay geometrically
WARM_UP = 16
"""Steps in which the learning rates rise to their full values. Adam's first steps are equally long for all parameters,
however small their gradients: eight steps of the room lose 1.4 dB on unseen views at full rates, and gain 0.8 dB with
this."""
PATIENCE = 3  # rounds of views without a better held-back error that end refinement: few pixels are held back
FINE_TILE, FINE_PAIRS = 4, 2.0
"""A fine tile has a quarter of the pixels. It pays below twice the intersections: 1.8 times (redkitchen) took 0.6 of
the time, 2.3 times (Gaussians of a pixel) 1.2."""

PAIRS_MARGIN = 1.25  # capacity for tile intersections over what the fullest view needs: Gaussians grow
ROWS_MARGIN = 1.02  # capacity for rows over what the views of a step may see at most: Gaussians move
MAX_KEY_VIEWS = 128  # most frames of a stream that are compared: their memory does not grow with the stream


@dataclasses.dataclass
class Progress:
    """A refinement between two steps: what it learns from, all that the next step depends on, and what was measured."""

    state: RefineState
    key_views: KeyViews
    config: RefineConfig
    max_pairs: int  # capacity for tile intersections of the compiled step
    max_rows: int | None = None  # capacity for the rows that the views of a step may see; None before the first
    tile: int = TILE  # side of the tiles of the compiled step, pixels
    losses: list[float] = dataclasses.field(default_factory=list)  # per step, on the pixels that are learned from
    held_back: list[float] = dataclasses.field(default_factory=list)  # per step, on the pixels that are not
    seconds: list[float] = dataclasses.field(default_factory=list)  # per step; the first of a process compiles

    @classmethod
    def start(cls, gaussians: Gaussians, key_views: KeyViews, config: RefineConfig) -> "Progress":
        """Progress before the first step, without the key views that cannot be learned from.

        The same arguments give the same result: a refinement that was stopped starts again and takes over its saved
        state.

        Raises:
            InputError: no view can be learned from.
        """
        start = without_padding(gaussians)
        tile, max_pairs = tiles_for(start, key_views)
        usable = only_usable(start, key_views, max_pairs, tile)
        return cls(init_refinement(start, config), usable, config, max_pairs, tile=tile)

    @property
    def num_steps(self) -> int:
        """Steps done."""
        return len(self.losses)

    def steps(self, planned: int) -> Iterator[None]:
        """Yields after each step, until `planned` steps are done or steps no longer help.

        The caller may save the progress after any iteration. A refinement that continues from it takes the same steps.

        Args:
            planned: steps, those already done included. They decide how fast the learning rates decay.
        """
        if self.max_rows is None:
            self.max_rows = row_capacity(self.state, self.key_views, planned, self.config)
        while self.num_steps < planned and not self.has_stopped_helping():
            start = time.perf_counter()
            rate = np.float32(FINAL_RATE ** (self.num_steps / planned) * min(1.0, (self.num_steps + 1) / WARM_UP))
            step = _compiled(self.config, self.max_pairs, self.max_rows, self.tile)
            self.state, report = step(self.state, self.key_views, rate)
            self.losses.append(float(report.loss))  # waits, so that a step's time is that of its work
            self.held_back.append(float(report.held_back))
            self.seconds.append(time.perf_counter() - start)
            if num_pairs := int(report.num_overflow):
                self.max_pairs = round_up(self.max_pairs + num_pairs)
            if num_rows := int(report.num_missing_rows):
                self.max_rows = round_rows(self.max_rows + num_rows)
            yield

    def has_stopped_helping(self) -> bool:
        """True if none of the last `PATIENCE` rounds of views has a held-back error below the best before them."""
        steps_per_round = -(-int(np.sum(np.asarray(self.key_views.valid))) // compared_views.VIEWS_PER_STEP)
        num_rounds, rest = divmod(self.num_steps, steps_per_round)
        if num_rounds <= PATIENCE or rest or not any(self.held_back):
            return False  # too early to say, or no pixel is held back
        rounds = np.reshape(self.held_back, (num_rounds, steps_per_round)).mean(axis=1)
        return float(rounds[-PATIENCE:].min()) >= float(rounds[:-PATIENCE].min())

    def scene(self, given: Gaussians) -> Gaussians:
        """The refined scene. `given` is the scene that `start` got; its padding rows stay.

        Gaussians that faded below 1/255 become absent, which changes no image; those that were as faint before stay.
        """
        return _scene_now(self.state.start, self.state.change, given)

    def report(self) -> "Refinement":
        """Report of the steps so far."""
        seconds = self.seconds[1:]
        return Refinement(
            num_steps=self.num_steps,
            num_skipped=int(self.state.num_skipped),
            losses=self.losses,
            held_back=self.held_back,
            stopped_early=self.has_stopped_helping(),
            seconds_per_step=float(np.median(seconds)) if seconds else 0.0,
            num_left_out=int(np.sum(~np.asarray(self.key_views.valid))),
        )


@Kept
def _scene_now(start: Gaussians, change: Change, given: Gaussians) -> Gaussians:
    """`Progress.scene`, from its state."""
    refined = changed_gaussians(start, change)
    has_faded = (refined.opacities < ALPHA_MIN) & (start.opacities >= ALPHA_MIN)
    refined = mask_gaussians(refined, ~has_faded)
    given, num_rows = with_sh_degree(given, refined.sh_degree), refined.num_gaussians
    return jax.tree.map(lambda new, old: jnp.concatenate([new, old[num_rows:].astype(new.dtype)]), refined, given)


@dataclasses.dataclass(frozen=True)
class Refinement:
    """Report of a refinement."""

    num_steps: int = 0
    num_skipped: int = 0  # steps whose gradient was not finite
    losses: list[float] = dataclasses.field(default_factory=list)  # per step, on the pixels that are learned from
    held_back: list[float] = dataclasses.field(default_factory=list)  # per step, on the pixels that are not
    stopped_early: bool = False  # the held-back error had stopped falling
    seconds_per_step: float = 0.0  # median, without the first step, which compiles; 0 where there is no other
    num_left_out: int = 0  # views that could not be learned from, see `only_usable`


def refine(
    gaussians: Gaussians,
    cameras: Camera,
    images: Images,
    *,
    steps: int = 100,
    exposures: Float[Array | np.ndarray, "_ 3"] | None = None,
    config: RefineConfig | None = None,
    on_step: Callable[[int, float], None] = lambda step, loss: None,
) -> tuple[Gaussians, Refinement]:
    """Gaussians changed by gradient descent until they fit the views that show them.

    Works on any Gaussians: a decoded cache, a loaded `.ply`. Rows keep their places, and absent rows stay absent. A
    Gaussian that became too faint to be drawn is absent.

    Args:
        gaussians: the scene.
        cameras: one batch axis of poses and intrinsics, in the frame of the scene.
        images: what those cameras saw, floats in [0, 1] or uint8.
        steps: most steps; 0 returns `gaussians` as they are. Each renders two views.
        exposures: factors from the scene's colors to each view's; default 1.
        config: SH degree, loss and held-back pixels; default `RefineConfig()`.
        on_step: called with the number of steps done and the last loss.

    Returns:
        The scene after the last step that was taken, and a report. It ends before `steps` if the error on held-back
        pixels did not fall for `PATIENCE` rounds of views.

    Raises:
        InputError: shapes do not fit, `steps` is negative, images are out of range, or no view can be learned from.
    """
    _check(cameras, images, exposures)
    if steps < 0:
        raise InputError(f"refine: steps must be at least 0, got {steps}.")
    if steps == 0:
        return gaussians, Refinement()
    progress = Progress.start(gaussians, KeyViews.of(cameras, images, exposures), config or RefineConfig())
    for _ in progress.steps(steps):
        on_step(progress.num_steps, progress.losses[-1])
    return progress.scene(gaussians), progress.report()


@functools.cache
def _compiled(config: RefineConfig, max_pairs: int, max_rows: int, tile: int) -> Callable:
    step = functools.partial(refine_step, config=config, max_pairs=max_pairs, max_rows=max_rows, tile=tile)
    return Kept(step, donate_argnums=(0,))


def tiles_for(gaussians: Gaussians, key_views: KeyViews) -> tuple[int, int]:
    """Side of the tiles in which a gradient takes the least time, and the capacity for their intersections.

    Both follow from the fullest of eight key views; a step counts what does not fit.
    """
    slots, on_host = evenly_spread(key_views.num_slots, 8), jax.device_get(key_views)
    most = np.max([np.asarray(_num_pairs(gaussians, on_host.at(slot))) for slot in slots], axis=0)
    fine, usual = map(int, most)
    tile, num_pairs = (FINE_TILE, fine) if fine < FINE_PAIRS * usual else (TILE, usual)
    return tile, round_up(int(PAIRS_MARGIN * num_pairs))


@Kept
def _num_pairs(gaussians: Gaussians, view: KeyViews) -> Int[Array, "2"]:
    """Tile intersections of a view with fine tiles and with usual ones."""
    camera, effects = view.camera(), compared_views.EFFECTS
    return jnp.stack([count_pairs(gaussians, camera, effects, tile) for tile in (FINE_TILE, TILE)])


def row_capacity(state: RefineState, key_views: KeyViews, steps: int, config: RefineConfig) -> int:
    """Capacity for the rows that the views of one of the planned steps may see."""
    most = int(_most_seen(state.start, state.change, key_views, max(steps, 1), config))
    return min(state.start.num_gaussians, round_rows(int(ROWS_MARGIN * most)))


@functools.partial(Kept, static_argnums=(3, 4))
def _most_seen(start: Gaussians, change: Change, key_views: KeyViews, steps: int, config: RefineConfig):
    """The largest number of rows that the views of a step may see."""

    def num_seen(step: Int[Array, ""]) -> Int[Array, ""]:
        views = views_of_step(step, key_views.valid, config)
        return jnp.sum(seen_rows(gaussians, key_views, views), dtype=jnp.int32)

    gaussians = apply_change(start, change)
    return jnp.max(jax.lax.map(num_seen, jnp.arange(steps, dtype=jnp.int32)))


def key_views_of(capture: Capture, indices: Sequence[int], stream_frame: StreamFrame, exposures: Exposures) -> KeyViews:
    """At most `MAX_KEY_VIEWS` of the streamed frames, evenly spread, with their cameras in the stream frame.

    Args:
        capture: where the images come from, at the size that is compared.
        indices: frame numbers that were streamed.
        stream_frame: the similarity between the capture's frame and the stream's.
        exposures: factor per streamed frame, as the stream estimated it.
    """
    used = [indices[i] for i in evenly_spread(len(indices), MAX_KEY_VIEWS)]
    cameras = jax.tree.map(lambda *x: np.stack(x), *(capture.camera(i, stream_frame) for i in used))
    # Frame by frame: as floats, all images would take four times the memory of the key views.
    pixels = np.stack([np.round(np.clip(capture.image(i), 0, 1) * np.float32(255)).astype(np.uint8) for i in used])
    factors = np.stack([exposures[i] for i in used]).astype(np.float32)
    seen = [mask for i in used if (mask := capture.seen(i)) is not None]
    if seen:
        pixels = np.concatenate([pixels, np.stack(seen)[..., None].astype(np.uint8)], axis=-1)
    # Not `KeyViews.of`, which compiles a program for each operation.
    arrays = {"images": pixels, "viewmats": cameras.viewmats, "Ks": cameras.Ks, "exposures": factors}
    return KeyViews(**jax.device_put(arrays | {"valid": np.ones(len(used), bool)}))


def _check(cameras: Camera, images, exposures) -> None:
    shape = list(cameras.viewmats.shape)
    if len(shape) != 3 or not shape[0]:
        raise InputError(f"refine: cameras must have one batch axis, viewmats [v 4 4], got {shape}.")
    wanted = (shape[0], cameras.height, cameras.width, 3)
    if tuple(jnp.shape(images)) != wanted:
        raise InputError(f"refine: images must be {list(wanted)} like the cameras, got {list(images.shape)}.")
    if images.dtype != jnp.uint8:
        check_images(images, "refine: images")
    if exposures is not None and tuple(exposures.shape) != (wanted[0], 3):
        raise InputError(f"refine: exposures must be {[wanted[0], 3]}, got {list(exposures.shape)}.")
