"""Training of the evidence head on whole streams: it renders the decoded cache, which is what is scored.

Every scene is streamed once, with all other stages as they are, and its cache is kept. A step decodes such caches,
renders crops of streamed views at full resolution, and moves the evidence head alone. No gradient flows through the
cache, so a step costs a decoding and a rendering, and hundreds of steps take minutes on a CPU.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Int

from ssplat_jax.cache import VoxelCache
from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import mean_color
from ssplat_jax.core.pytree import pytree, replace
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.rasterizer import fill_holes, render
from ssplat_jax.refinement.view_loss import EFFECTS
from ssplat_jax.training.streamed_scenes import SceneSources, StreamedScene, captures_of, negative_psnr, stream_scene


@dataclasses.dataclass(frozen=True)
class EvidenceRecipe(SceneSources):
    """Everything that decides the evidence head, besides the scenes and the other weights."""

    steps: int = 600
    """Gradient steps."""
    views_per_step: int = 2
    """Crops whose gradients a step averages, each of another scene."""
    crop: tuple[int, int] = (128, 160)
    """Height and width of the rendered crops in pixels, at the full resolution of the views."""
    learning_rate: float = 5e-3
    """Peak of the learning rate, from which it decays by a cosine."""
    warmup_steps: int = 20
    """Steps of linear warm-up."""
    clip_norm: float = 3.0
    """Largest norm of the gradient."""
    weight_decay: float = 1e-3
    """Decoupled weight decay."""
    black_weight: float = 0.4
    """Weight of the PSNR over black; the rest is the PSNR with holes filled."""
    ema_decay: float = 0.98
    """Decay of the moving average of the parameters, which is the result."""
    seed: int = 0
    """Seed of the first parameters and of the crops."""


@pytree
class _Crop:
    """A part of a key view."""

    view: Int[Array, ""]
    row: Int[Array, ""]
    column: Int[Array, ""]


def train_evidence(
    model: StreamSplat,
    params: dict,
    captures: Sequence[Path],
    recipe: EvidenceRecipe,
    *,
    on_scene: Callable[[str], None] = lambda name: None,
    on_step: Callable[[int, dict[str, float]], None] = lambda step, record: None,
) -> tuple[dict, dict]:
    """Parameters with a trained evidence head, and facts about the training. All other stages stay as they are.

    Args:
        model: its configuration keeps evidence.
        params: parameters to start from. An evidence head among them is replaced by an untrained one.
        captures: captures, or folders of them, to learn from besides the recipe's procedural scenes.
        recipe: steps, rates and scenes.
        on_scene: called with the name of each scene when it has been streamed.
        on_step: called after each step with the number of steps done and the mean PSNR of its crops, `shown_psnr` and
            `black_psnr`, in dB.

    Returns:
        The parameters, and JSON facts: the scenes, and the PSNRs of the last tenth of the steps.

    Raises:
        InputError: the model has no evidence head, or a capture is unusable.
    """
    if not model.config.head.evidence:
        raise InputError("train: the recipe evidence needs a configuration with head.evidence=true, got false.")
    head = model.init(jax.random.key(recipe.seed))["evidence"]
    params = {**params, "evidence": head}
    scenes = []
    for capture, stride in captures_of(captures, recipe, recipe.crop):
        scenes.append(stream_scene(model, params, capture, stride))
        on_scene(scenes[-1].name)
    optimizer = _optimizer(recipe)
    state, mean = optimizer.init(head), head
    rng, records = np.random.default_rng(recipe.seed), []
    for step in range(recipe.steps):
        total, record = jax.tree.map(jnp.zeros_like, head), {"shown_psnr": 0.0, "black_psnr": 0.0}
        for i in range(recipe.views_per_step):
            scene = scenes[(step * recipe.views_per_step + i) % len(scenes)]
            slope, scores = _slope(model, params, head, scene, _draw_crop(scene, recipe, rng), recipe)
            total = jax.tree.map(lambda a, b: a + b / recipe.views_per_step, total, slope)
            record = {name: record[name] + float(scores[name]) / recipe.views_per_step for name in record}
        if all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(total)):
            updates, state = optimizer.update(total, state, head)
            rate = _learning_rate(recipe, step)
            head = jax.tree.map(lambda x, change, rate=rate: x - rate * change, head, updates)
            mean = jax.tree.map(lambda m, x: recipe.ema_decay * m + (1 - recipe.ema_decay) * x, mean, head)
        records.append(record)
        on_step(step + 1, record)
    last = records[-max(1, recipe.steps // 10) :]
    facts = {name: round(float(np.mean([record[name] for record in last])), 3) for name in last[0]}
    return {**params, "evidence": mean}, {"scenes": [scene.name for scene in scenes], **facts}


def _optimizer(recipe: EvidenceRecipe) -> optax.GradientTransformation:
    """Gradient clipping and AdamW without a learning rate."""
    return optax.chain(
        optax.clip_by_global_norm(recipe.clip_norm),
        optax.scale_by_adam(),
        optax.add_decayed_weights(recipe.weight_decay),
    )


def _learning_rate(recipe: EvidenceRecipe, step: int) -> float:
    """Learning rate of a step: linear warm-up, times a cosine from the peak to zero."""
    warmup = min(1.0, (step + 1) / recipe.warmup_steps)
    return recipe.learning_rate * warmup * 0.5 * (1 + math.cos(math.pi * step / recipe.steps))


def _draw_crop(scene: StreamedScene, recipe: EvidenceRecipe, rng: np.random.Generator) -> _Crop:
    height, width = scene.key_views.images.shape[1:3]
    numbers = (
        rng.integers(scene.key_views.num_slots),
        rng.integers(height - recipe.crop[0] + 1),
        rng.integers(width - recipe.crop[1] + 1),
    )
    return _Crop(*(jnp.asarray(x, jnp.int32) for x in numbers))


def _slope(model: StreamSplat, params: dict, head: dict, scene: StreamedScene, crop: _Crop, recipe: EvidenceRecipe):
    """Gradient of the loss of a crop by the evidence head, and the PSNRs of the crop."""
    grad = _compiled(model, scene.num_pivots, scene.max_pairs, recipe)
    return grad(head, params, scene.cache, scene.key_views, crop)


@functools.lru_cache(maxsize=64)
def _compiled(model: StreamSplat, num_pivots: int, max_pairs: int, recipe: EvidenceRecipe):
    height, width = recipe.crop

    def loss(head: dict, params: dict, cache: VoxelCache, key_views: KeyViews, crop: _Crop):
        gaussians = model.decode_shown({**params, "evidence": head}, cache, num_pivots)
        camera = crop_camera(key_views.camera(crop.view), crop.row, crop.column, height, width)
        out = render(gaussians, camera, effects=EFFECTS, max_pairs=max_pairs)
        image = jax.lax.dynamic_slice(key_views.images[crop.view], (crop.row, crop.column, 0), (height, width, 3))
        target, exposure = image.astype(jnp.float32) / 255, key_views.exposures[crop.view]
        filled = fill_holes(out.color, out.alpha, mean_color(gaussians))
        shown, black = (negative_psnr(x * exposure, target) for x in (filled, out.color))
        value = (1 - recipe.black_weight) * shown + recipe.black_weight * black
        return value, {"shown_psnr": -shown, "black_psnr": -black}

    return jax.jit(jax.grad(loss, has_aux=True))


def crop_camera(camera: Camera, row, column, height: int, width: int) -> Camera:
    """The camera of a part of the image of `camera`.

    Args:
        camera: one camera.
        row: first row of the part, pixels.
        column: first column of the part, pixels.
        height: height of the part, pixels.
        width: width of the part, pixels.
    """
    x, y = (jnp.asarray(value, jnp.float32) for value in (column, row))
    return replace(camera, Ks=camera.Ks.at[0, 2].add(-x).at[1, 2].add(-y), height=height, width=width)
