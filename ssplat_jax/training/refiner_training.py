"""Errors of finished scenes: samples and loss for the refiner, the network of the learned pass.

A scene is streamed and compared with some of its views, as a learned pass does, and the network learns the change that
makes *other* views look right. No gradient flows through the comparison.
"""

import dataclasses
from collections.abc import Callable
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from ssplat_jax.cache.changes import Change, apply_change, no_change
from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import pytree, replace, static
from ssplat_jax.model.streamsplat import StreamSplat, shown_rows
from ssplat_jax.refinement.learned_pass import SeenErrors, add_view, learned_change, no_errors
from ssplat_jax.refinement.refine_config import FOR_CAPTURES
from ssplat_jax.refinement.refine_step import bounded, init_refinement
from ssplat_jax.refinement.scene_rows import without_padding
from ssplat_jax.training.capture_mix import CaptureMix, PhaseStart
from ssplat_jax.training.crops import Crops, stream_scene
from ssplat_jax.training.losses import Lpips, Metrics, Scalar, psnr_loss

CONFIG = dataclasses.replace(FOR_CAPTURES, held_back=0.0, max_new=0.0)
"""Configuration of the passes: that of captures, but no pixel is held back and no Gaussian is added."""
SCENES = Crops(size=(16, 16))
"""Scenes to stream; images are used whole."""


@pytree
class ObservedScene:
    """One training sample: a scene, its observed errors, and a held-out view."""

    start: Gaussians
    change: Change
    seen: SeenErrors
    key_views: KeyViews
    view: Int[Array, ""]  # that is to look right
    max_pairs: int = static()  # capacity for tile intersections of a view


@dataclasses.dataclass(frozen=True)
class SceneErrors:
    """Samples of a phase that learns from scenes, each compared with some of its views."""

    passes: int = 0
    """Passes of the network, as it is when the phase begins, that have changed a scene before: half of the samples have
    as many, the others any smaller number too."""
    views: tuple[int, ...] = (16, 16, 8, 4)
    """Views that a scene is compared with: each scene draws one of these numbers before every pass."""
    scenes: Crops = SCENES
    """Procedural scenes, and how they and captures are streamed."""

    def check(self, mix: CaptureMix, config: StreamConfig, *, renders: bool) -> None:
        """Refuses captures that cannot be streamed."""
        self.scenes.check(mix, config, renders=renders)

    def open(self, start: PhaseStart) -> Callable[[int, int], ObservedScene]:
        """Streams and compares all scenes; gives the sample of a step by its number and its place in the phase."""
        if self.scenes not in start.shared:
            found = self.scenes.scenes(start.mix)
            start.shared[self.scenes] = [_streamed(start, capture, stride) for capture, stride in found]
        fresh, rng = start.shared[self.scenes], np.random.default_rng(start.seed + self.passes)
        compared = every = [self._compared(scene, rng) for scene in fresh]
        for _ in range(self.passes):
            # The change alone is new: a whole scene for every pass would be many copies.
            fresh = [replace(scene, change=_after_pass(start.params["refiner"], scene)) for scene, _ in compared]
            compared = [self._compared(scene, rng) for scene in fresh]
            every = every + compared
        draws = []
        # All draws at once, so that they do not depend on where a training was resumed.
        for place in range(start.num_steps):
            scenes = compared if place % 2 else every
            scene, others = scenes[rng.integers(len(scenes))]
            draws.append((scene, int(rng.choice(others))))

        def batch(step: int, place: int) -> ObservedScene:
            scene, view = draws[place]
            return replace(scene, view=jnp.asarray(view, jnp.int32))

        return batch

    def _compared(self, scene: ObservedScene, rng: np.random.Generator) -> tuple[ObservedScene, list[int]]:
        """A scene compared with some of its views, and the other views."""
        order = rng.permutation(scene.key_views.num_slots)
        num_seen = min(int(rng.choice(self.views)), scene.key_views.num_slots // 2)
        scene = replace(scene, seen=no_errors(scene.start))
        for view in order[:num_seen]:
            scene = replace(scene, seen=_add_view(replace(scene, view=jnp.asarray(view, jnp.int32))))
        return scene, order[num_seen:].tolist()

    def held_out(self, mix: CaptureMix) -> list:
        """None: the view of every step is held out from the comparison."""
        return []


def _streamed(start: PhaseStart, capture, stride: int) -> ObservedScene:
    cache, key_views, num_pivots, max_pairs = stream_scene(start.model, start.params, capture, stride)
    start.say(f"streamed {capture.name}, stride {stride}")
    rows = shown_rows(cache, start.model.config, num_pivots)
    gaussians = jax.jit(start.model.decode_rows)(start.params, cache, rows)
    scene = init_refinement(without_padding(gaussians), CONFIG).start
    return ObservedScene(scene, no_change(scene), no_errors(scene), key_views, jnp.zeros((), jnp.int32), max_pairs)


@jax.jit
def _add_view(scene: ObservedScene) -> SeenErrors:
    return add_view(scene.seen, scene.start, scene.change, scene.key_views, scene.view, CONFIG, scene.max_pairs)[0]


@jax.jit
def _after_pass(refiner: dict, scene: ObservedScene) -> Change:
    """The change of a scene after a pass on its errors."""
    change = learned_change(refiner, apply_change(scene.start, scene.change), scene.seen)
    return bounded(jax.tree.map(jnp.add, scene.change, change), scene.start)


@dataclasses.dataclass(frozen=True)
class PassLoss:
    """Minus the PSNR of a held-out view after a pass, see `CropLoss`."""

    black_weight: float = 0.4
    """Weight of the PSNR over black; the rest is the PSNR with holes filled."""
    renders: ClassVar[bool] = False

    def __call__(
        self, model: StreamSplat, params: dict, batch: ObservedScene, lpips: Lpips = None
    ) -> tuple[Scalar, Metrics]:
        """Loss of a sample, and its PSNRs in dB."""
        views, view = batch.key_views, batch.view
        gaussians = apply_change(batch.start, _after_pass(params["refiner"], batch))
        image, exposure = views.images[view], views.exposures[view]
        return psnr_loss(gaussians, views.camera(view), image, exposure, batch.max_pairs, self.black_weight)
