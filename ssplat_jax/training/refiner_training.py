"""Training of the refiner, the network of the learned pass, on finished streams.

Every scene is streamed once. In each round, some views of every scene are compared with it as a learned pass does, and
the network learns the change that makes *other* views look right: a step renders one of them and moves the network.
Half of the steps take a comparison of this round, the other half one of any round so far. Then a pass with the new
network revises the scenes, and the next round starts from there, so that the network also learns from scenes that it
has already revised. No gradient flows through the comparison.
"""

import dataclasses
import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Int

from ssplat_jax.cache.changes import Change, apply_change
from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.gaussians import Gaussians, mean_color
from ssplat_jax.core.pytree import replace
from ssplat_jax.model.streamsplat import StreamSplat, shown_rows
from ssplat_jax.rasterizer import fill_holes, render
from ssplat_jax.refinement.compared_views import EFFECTS
from ssplat_jax.refinement.learned_pass import SeenErrors, add_view, init_refiner, learned_change, no_errors
from ssplat_jax.refinement.refine_config import FOR_CAPTURES
from ssplat_jax.refinement.refine_step import RefineState, bounded, init_refinement
from ssplat_jax.refinement.scene_rows import without_padding
from ssplat_jax.training.capture_mix import CaptureMix
from ssplat_jax.training.crops import Crops, stream_scene
from ssplat_jax.training.losses import negative_psnr

CONFIG = dataclasses.replace(FOR_CAPTURES, held_back=0.0, max_new=0.0)
"""Configuration of the passes: that of captures, but no pixel is held back and no Gaussian is added."""

SCENES = Crops(size=(16, 16))
"""Scenes of the recipe; no image may be smaller."""

SCORED_VIEWS = 3
"""Views of each scene on which a round is scored."""


@dataclasses.dataclass(frozen=True)
class RefinerRecipe:
    """Everything that decides the refiner, besides captures and the weights of the stream."""

    scenes: Crops = SCENES
    """Procedural scenes, and how they and captures are streamed; of images smaller than `size` nothing is learned."""
    rounds: int = 4
    """Rounds; the scenes of a round have been revised by as many passes as there were rounds before it."""
    steps: int = 250
    """Gradient steps of a round."""
    views: tuple[int, ...] = (16, 16, 8, 4)
    """Views that a scene is compared with: each scene draws one of these numbers in every round."""
    learning_rate: float = 4e-3
    """Peak of the learning rate, from which it decays by a cosine over all rounds."""
    warmup_steps: int = 20
    """Steps of linear warm-up."""
    clip_norm: float = 1.0
    """Largest norm of the gradient."""
    weight_decay: float = 1e-3
    """Decoupled weight decay."""
    black_weight: float = 0.4
    """Weight of the PSNR over black; the rest is the PSNR with holes filled."""
    ema_decay: float = 0.98
    """Decay of the moving average of the parameters, which revises the scenes and is the result."""
    seed: int = 0
    """Seed of the first parameters and of the views."""


@dataclasses.dataclass
class TrainingScene:
    """One training sample: a scene, its observed errors, and held-out views."""

    key_views: KeyViews
    max_pairs: int
    state: RefineState
    seen: SeenErrors
    others: list[int]


def train_refiner(
    model: StreamSplat,
    params: dict,
    mix: CaptureMix | None,
    recipe: RefinerRecipe,
    *,
    on_scene: Callable[[str], None] = lambda name: None,
    on_step: Callable[[int, dict[str, float]], None] = lambda step, record: None,
) -> tuple[dict, dict]:
    """Parameters of a trained refiner, and facts about the training.

    Args:
        model: the model whose scenes are refined.
        params: its parameters.
        mix: captures to learn from besides the recipe's procedural scenes.
        recipe: rounds, steps, rates and scenes.
        on_scene: called with the name of each scene when it has been streamed.
        on_step: called after each step with the number of steps done and the PSNR of its view, `shown_psnr` and
            `black_psnr`, in dB.

    Returns:
        The parameters, and JSON facts: the scenes, and for each round the mean PSNRs of views that were not compared,
        before and after the pass.

    Raises:
        InputError: a capture is unusable.
    """
    rng = np.random.default_rng(recipe.seed)
    scenes, names, states = [], [], []
    for capture, stride in recipe.scenes.scenes(mix):
        cache, key_views, num_pivots, max_pairs = stream_scene(model, params, capture, stride)
        gaussians = jax.jit(model.decode_rows)(params, cache, shown_rows(cache, model.config, num_pivots))
        scenes.append((key_views, max_pairs))
        names.append(f"{capture.name}, stride {stride}")
        states.append(init_refinement(without_padding(gaussians), CONFIG))
        on_scene(names[-1])
    refiner = mean = init_refiner(recipe.seed)
    zero_params = jax.tree.map(jnp.zeros_like, refiner)  # baseline: predicts no change
    optimizer = optax.chain(
        optax.clip_by_global_norm(recipe.clip_norm),
        optax.scale_by_adam(),
        optax.add_decayed_weights(recipe.weight_decay),
    )
    moments, samples, step, rounds = optimizer.init(refiner), [], 0, []
    for _ in range(recipe.rounds):
        fresh = [_compared(*scene, state, recipe, rng) for scene, state in zip(scenes, states, strict=True)]
        samples += fresh
        for _ in range(recipe.steps):
            # Half of the steps learn from this round's scenes, the others from those of all rounds.
            sample = (fresh if step % 2 else samples)[rng.integers(len(fresh if step % 2 else samples))]
            view = jnp.asarray(rng.choice(sample.others), jnp.int32)
            gradient_of = _compiled(sample.max_pairs, recipe.black_weight)
            gradient, record = gradient_of(refiner, sample.state, sample.seen, sample.key_views, view)
            if all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(gradient)):
                updates, moments = optimizer.update(gradient, moments, refiner)
                rate = _learning_rate(recipe, step)
                refiner = jax.tree.map(lambda x, change, rate=rate: x - rate * change, refiner, updates)
                mean = jax.tree.map(lambda m, x: recipe.ema_decay * m + (1 - recipe.ema_decay) * x, mean, refiner)
            step += 1
            on_step(step, {name: float(value) for name, value in record.items()})
        rounds.append({"before": _scores(zero_params, fresh, recipe), "after": _scores(mean, fresh, recipe)})
        states = [_after_pass(mean, sample) for sample in fresh]
    return mean, {"scenes": names, "rounds": rounds}


def _scores(refiner: dict, samples: list[TrainingScene], recipe: RefinerRecipe) -> dict[str, float]:
    """Mean PSNRs after a pass with `refiner` on the first views that each sample was not compared with."""
    found = []
    for sample in samples:
        gradient_of = _compiled(sample.max_pairs, recipe.black_weight)
        for view in sample.others[:SCORED_VIEWS]:
            found.append(
                gradient_of(refiner, sample.state, sample.seen, sample.key_views, jnp.asarray(view, jnp.int32))[1]
            )
    return {name: round(float(np.mean([scores[name] for scores in found])), 3) for name in found[0]}


def _learning_rate(recipe: RefinerRecipe, step: int) -> float:
    """Learning rate of a step: linear warm-up, times a cosine from the peak to a twentieth of it."""
    warmup = min(1.0, (step + 1) / recipe.warmup_steps)
    share = 0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * step / (recipe.rounds * recipe.steps)))
    return recipe.learning_rate * warmup * share


def _compared(
    key_views: KeyViews, max_pairs: int, state: RefineState, recipe: RefinerRecipe, rng: np.random.Generator
) -> TrainingScene:
    """A scene, compared with some of its views; the others are held out."""
    order = rng.permutation(key_views.num_slots)
    num_seen = min(int(rng.choice(recipe.views)), key_views.num_slots // 2)
    seen = no_errors(state.start)
    for view in order[:num_seen]:
        seen = _add_view(max_pairs)(seen, state, key_views, jnp.asarray(view, jnp.int32))
    return TrainingScene(key_views, max_pairs, state, seen, [int(view) for view in order[num_seen:]])


@functools.lru_cache(maxsize=64)
def _add_view(max_pairs: int):
    def add(seen: SeenErrors, state: RefineState, key_views: KeyViews, view: Int[Array, ""]) -> SeenErrors:
        return add_view(seen, state.start, state.change, key_views, view, CONFIG, max_pairs)[0]

    return jax.jit(add)


def _after_pass(refiner: dict, sample: TrainingScene) -> RefineState:
    """The sample's state after a pass on what its views say.

    The program returns the change alone: a whole state would be a copy of the scene for every round.
    """
    return replace(sample.state, change=jax.jit(_moved)(refiner, sample.state, sample.seen))


def _moved(refiner: dict, state: RefineState, seen: SeenErrors) -> Change:
    """The change after a pass."""
    change = learned_change(refiner, apply_change(state.start, state.change), seen)
    return bounded(jax.tree.map(jnp.add, state.change, change), state.start)


@functools.lru_cache(maxsize=64)
def _compiled(max_pairs: int, black_weight: float):
    def loss(refiner: dict, state: RefineState, seen: SeenErrors, key_views: KeyViews, view: Int[Array, ""]):
        gaussians: Gaussians = apply_change(state.start, _moved(refiner, state, seen))
        out = render(gaussians, key_views.camera(view), effects=EFFECTS, max_pairs=max_pairs)
        target, exposure = key_views.images[view].astype(jnp.float32) / 255, key_views.exposures[view]
        filled = fill_holes(out.color, out.alpha, mean_color(gaussians))
        shown, black = (negative_psnr(x * exposure, target) for x in (filled, out.color))
        return (1 - black_weight) * shown + black_weight * black, {"shown_psnr": -shown, "black_psnr": -black}

    return jax.jit(jax.grad(loss, has_aux=True))
