"""One training step as a pure function of (state, sample)."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from ssplat_jax.cache import Tokens, VoxelCache, judge
from ssplat_jax.gaussians import Gaussians, mask_gaussians, mean_color
from ssplat_jax.metrics.lpips import LpipsWeights
from ssplat_jax.pytree import pytree
from ssplat_jax.rasterizer import fill_holes, render
from ssplat_jax.streaming.streamsplat import StreamSplat
from ssplat_jax.train.losses import depth_loss, rendering_loss
from ssplat_jax.train.recipe import PAPER_FORM, PhaseForm, Recipe
from ssplat_jax.train.samples import Sample


@pytree
class TrainState:
    """All that a resumed run needs beside its recipe."""

    params: dict
    ema: dict  # exponential moving average of params: what is evaluated and shipped
    opt_state: tuple
    step: Int[Array, ""]
    num_skipped: Int[Array, ""]  # steps whose gradient was not finite


def optimizer(recipe: Recipe) -> optax.GradientTransformation:
    """AdamW behind a clip of the global norm; the learning rate is applied by the step, which knows its phase."""
    return optax.chain(
        optax.clip_by_global_norm(recipe.clip_norm),
        optax.scale_by_adam(b1=0.9, b2=0.99),
        optax.add_decayed_weights(recipe.weight_decay),
    )


def init_state(model: StreamSplat, recipe: Recipe, params: dict | None = None) -> TrainState:
    """A fresh state, from `params` or from the recipe's seed."""
    params = model.init(jax.random.key(recipe.seed)) if params is None else params
    return TrainState(
        params=jax.tree.map(jnp.copy, params),  # the step consumes its state; the caller's arrays stay
        ema=jax.tree.map(jnp.copy, params),
        opt_state=optimizer(recipe).init(params),  # pyright: ignore[reportArgumentType]
        step=jnp.zeros((), jnp.int32),
        num_skipped=jnp.zeros((), jnp.int32),
    )


def learning_rate(recipe: Recipe, step: int) -> float:
    """Warm-up at the start of every phase, then cosine from its peak to the share of it that the phase ends with."""
    phase, position = recipe.phase_at(step)
    warmup = min(1.0, (position + 1) / recipe.warmup_steps)
    cosine = math.cos(math.pi * position / phase.steps)
    return phase.learning_rate * warmup * (phase.final_share + 0.5 * (1 - phase.final_share) * (1 + cosine))


def stream_chunks(model: StreamSplat, params: dict, sample: Sample, *, recompute: bool):
    """Streams the sample's chunks; returns the last cache, the tokens of all chunks and the mean depth losses.

    Tokens carry gradients; what is written to the cache does not (ALGORITHM 9.35). With `recompute`, each chunk's
    activations are computed again on the way back, so that memory does not grow with their number.
    """

    def body(cache, chunk_and_truth):
        chunk, truth = chunk_and_truth
        prediction = model.predict(params, cache, chunk)
        cache = model.remember(cache, prediction)
        losses = depth_loss(
            prediction.logits,
            prediction.log_depths,
            pad_like(truth, prediction.log_depths),
            prediction.views.log_candidates,
            prediction.views.inside,
        )
        return cache, (prediction.tokens, losses)

    if recompute:
        body = jax.checkpoint(body)
    cache, (tokens, losses) = jax.lax.scan(body, model.init_cache(), (sample.chunks, sample.log_depths))
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), tokens)
    return cache, flat, jax.tree.map(jnp.mean, losses)


def pad_like(truth: Float[Array, "v h w"], predicted: Float[Array, "v hf wf"]) -> Float[Array, "v hf wf"]:
    """`truth` with its last rows and columns repeated, as the images were padded; `inside` leaves them out."""
    return jnp.pad(truth, [(0, n - m) for m, n in zip(truth.shape, predicted.shape, strict=True)], mode="edge")


def decode_accepted(model: StreamSplat, params: dict, cache: VoxelCache, tokens: Tokens) -> Gaussians:
    """Gaussians of the tokens that are trusted and that the stream's witnesses did not look through: nearly the scene
    that inference sees, but not merged."""
    gaussians = model.decode_tokens(params, tokens)
    judged = judge(*jax.lax.stop_gradient((cache.witnesses, tokens)), model.config)
    is_accepted = tokens.valid & (judged.confidences >= model.config.memory.min_confidence)
    return mask_gaussians(gaussians, model.each_gaussian(is_accepted))


def loss_fn(
    params: dict,
    model: StreamSplat,
    sample: Sample,
    recipe: Recipe,
    form: PhaseForm,
    lpips_weights: LpipsWeights | None = None,
):
    """Loss and the numbers to log. Frozen stages are constants: nothing is computed backward through them."""
    params = {name: jax.lax.stop_gradient(p) if name in form.frozen else p for name, p in params.items()}
    cache, tokens, (entropy, depth_l1) = stream_chunks(model, params, sample, recompute=recipe.recompute)
    loss = entropy + 2.0 * depth_l1
    accepted = jnp.mean((tokens.confidences >= model.config.memory.min_confidence).astype(jnp.float32))
    metrics = {"depth_entropy": entropy, "depth_l1": depth_l1, "accepted": accepted}
    if sample.target_images.shape[0]:
        is_cache = form.decode == "cache"
        gaussians = model.decode(params, cache) if is_cache else decode_accepted(model, params, cache, tokens)
        output = render(gaussians, sample.target_camera, max_pairs=recipe.max_pairs)
        assert output.color is not None and output.alpha is not None
        filled = fill_holes(output.color, output.alpha, jax.lax.stop_gradient(mean_color(gaussians)))
        rendering, over_black = (
            rendering_loss(
                image,
                sample.target_images,
                gradient_weight=recipe.gradient_weight,
                lpips_weights=lpips_weights,
            )
            for image in (filled, output.color)
        )
        total = (1 - recipe.black_weight) * rendering.total + recipe.black_weight * over_black.total
        loss = recipe.depth_weight * loss + 10.0 * total
        metrics |= {} if rendering.lpips is None else {"lpips": rendering.lpips}
        metrics |= {
            "psnr": -10 * jnp.log10(rendering.mse + 1e-10),
            "psnr_over_black": -10 * jnp.log10(over_black.mse + 1e-10),
            "alpha": output.alpha.mean(),
            "overflow": output.num_overflow.astype(jnp.float32),
        }
    return loss, metrics | {"loss": loss}


def train_step(
    state: TrainState,
    sample: Sample,
    rate: Float[Array, ""],
    *,
    model: StreamSplat,
    recipe: Recipe,
    form: PhaseForm = PAPER_FORM,
    lpips_weights: LpipsWeights | None = None,
) -> tuple[TrainState, dict]:
    """One update. A step with a non-finite gradient changes nothing but the count of such steps."""
    gradients, metrics = jax.grad(loss_fn, has_aux=True)(state.params, model, sample, recipe, form, lpips_weights)
    norm = optax.global_norm(gradients)
    is_finite = jnp.isfinite(norm)
    updates, opt_state = optimizer(recipe).update(gradients, state.opt_state, state.params)
    # Momentum and weight decay would go on moving what is frozen.
    updates = {name: jax.tree.map(jnp.zeros_like, u) if name in form.frozen else u for name, u in updates.items()}  # pyright: ignore[reportAttributeAccessIssue]
    params = jax.tree.map(lambda p, u: p - rate * u, state.params, updates)
    # The average warms up: early on it follows the parameters instead of remembering the random start.
    step = state.step.astype(jnp.float32)
    decay = jnp.minimum(recipe.ema_decay, (1.0 + step) / (10.0 + step))
    ema = jax.tree.map(lambda e, p: decay * e + (1 - decay) * p, state.ema, params)
    keep = functools.partial(jax.tree.map, lambda new, old: jnp.where(is_finite, new, old))
    new_state = TrainState(
        params=keep(params, state.params),
        ema=keep(ema, state.ema),
        opt_state=keep(opt_state, state.opt_state),
        step=state.step + 1,
        num_skipped=state.num_skipped + (~is_finite).astype(jnp.int32),
    )
    return new_state, metrics | {"grad_norm": norm}


@dataclasses.dataclass(frozen=True)
class Trainer:
    """The jitted step for one model and recipe; recompiles once per sample shape."""

    model: StreamSplat
    recipe: Recipe

    @functools.cached_property
    def step(self):
        """`(state, sample, rate, form=PAPER_FORM, lpips_weights=None) -> (state, metrics)`, the state donated."""
        bound = functools.partial(train_step, model=self.model, recipe=self.recipe)
        return jax.jit(bound, donate_argnums=0, static_argnames="form")
