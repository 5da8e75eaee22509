"""One training step, as a pure function of state and samples."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from ssplat_jax.cache import Tokens, VoxelCache, vote
from ssplat_jax.core.gaussians import Gaussians, mask_gaussians, mean_color
from ssplat_jax.core.pytree import pytree
from ssplat_jax.evaluation.lpips import LpipsWeights
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.rasterizer import fill_holes, render
from ssplat_jax.training.losses import depth_loss, fitted_gains, rendering_loss
from ssplat_jax.training.recipe import DEFAULT_FORM, PhaseForm, Recipe
from ssplat_jax.training.samples import Sample


@pytree
class TrainState:
    """Everything that a resumed run needs besides its recipe."""

    params: dict
    ema: dict  # moving average of params, which is evaluated and shipped
    opt_state: tuple
    step: Int[Array, ""]
    num_skipped: Int[Array, ""]  # steps skipped because the gradient was not finite


def optimizer(recipe: Recipe) -> optax.GradientTransformation:
    """Gradient clipping and AdamW without a learning rate, which `train_step` applies."""
    return optax.chain(
        optax.clip_by_global_norm(recipe.clip_norm),
        optax.scale_by_adam(b1=recipe.adam_b1, b2=recipe.adam_b2, eps=recipe.adam_epsilon),
        optax.add_decayed_weights(recipe.weight_decay),
    )


def init_state(model: StreamSplat, recipe: Recipe, params: dict | None = None) -> TrainState:
    """State before the first step, from `params` or else from the recipe's seed."""
    params = model.init(jax.random.key(recipe.seed)) if params is None else params
    return TrainState(
        params=jax.tree.map(jnp.copy, params),  # the step donates its state; the caller keeps its arrays
        ema=jax.tree.map(jnp.copy, params),
        opt_state=optimizer(recipe).init(params),  # pyright: ignore[reportArgumentType]
        step=jnp.zeros((), jnp.int32),
        num_skipped=jnp.zeros((), jnp.int32),
    )


def learning_rate(recipe: Recipe, step: int) -> float:
    """Learning rate of a step: linear warm-up in every phase, and a cosine from the peak to `final_share` of it."""
    phase, position = recipe.phase_at(step)
    warmup = min(1.0, (position + 1) / recipe.warmup_steps)
    cosine = math.cos(math.pi * position / phase.steps)
    return phase.learning_rate * warmup * (phase.final_share + 0.5 * (1 - phase.final_share) * (1 + cosine))


def stream_chunks(model: StreamSplat, params: dict, sample: Sample, recipe: Recipe):
    """Cache after all chunks of a sample, tokens of all chunks, and mean depth losses (cross entropy, L1).

    Gradients flow through tokens and losses, not through the cache.

    Args:
        model: the model.
        params: its parameters.
        sample: gives chunks and true depths.
        recipe: gives the width of depth targets; with `recipe.recompute`, the backward pass recomputes activations
            chunk by chunk, so that memory does not grow with the number of chunks.

    Returns:
        The cache, the tokens with one leading axis, and (cross entropy, L1).
    """

    def body(cache, chunk_and_truth):
        chunk, truth = chunk_and_truth
        prediction = model.predict(params, cache, chunk)
        cache = model.update_cache(cache, prediction)
        losses = depth_loss(
            prediction.logits,
            prediction.log_depths,
            pad_like(truth, prediction.log_depths),
            prediction.views.log_candidates,
            prediction.views.inside,
            target_width=recipe.depth_target_width,
        )
        return cache, (prediction.tokens, losses)

    if recipe.recompute:
        body = jax.checkpoint(body)
    cache, (tokens, losses) = jax.lax.scan(body, model.init_cache(), (sample.chunks, sample.log_depths))
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), tokens)
    return cache, flat, jax.tree.map(jnp.mean, losses)


def pad_like(truth: Float[Array, "v h w"], predicted: Float[Array, "v hf wf"]) -> Float[Array, "v hf wf"]:
    """`truth` edge-padded to the shape of `predicted`, as images are padded. Losses skip the padding by `inside`."""
    return jnp.pad(truth, [(0, n - m) for m, n in zip(truth.shape, predicted.shape, strict=True)], mode="edge")


def decode_accepted(model: StreamSplat, params: dict, cache: VoxelCache, tokens: Tokens) -> Gaussians:
    """Gaussians of the tokens that inference would accept, without merging.

    Those are the tokens whose confidence, after the votes of depths stored in `cache`, is at least `min_confidence`.

    Args:
        model: the model.
        params: its parameters.
        cache: gives the stored depths; a constant.
        tokens: tokens of all chunks.
    """
    gaussians = model.decode_tokens(params, tokens)
    revised = vote(*jax.lax.stop_gradient((cache.stored_depths, tokens)), model.config)
    is_accepted = tokens.valid & (revised.confidences >= model.config.memory.min_confidence)
    return mask_gaussians(gaussians, model.repeat_per_gaussian(is_accepted))


def loss_fn(
    params: dict,
    model: StreamSplat,
    sample: Sample,
    recipe: Recipe,
    form: PhaseForm,
    lpips_weights: LpipsWeights | None = None,
) -> tuple[Float[Array, ""], dict]:
    """Loss of a sample (see `Recipe`), and metrics to log.

    Args:
        params: parameters; those of frozen stages are constants.
        model: the model.
        sample: chunks with true depths, and target views.
        recipe: weights of the losses.
        form: frozen stages, and what is rendered.
        lpips_weights: weights of LPIPS, if there are any.

    Returns:
        The loss, and scalar metrics by name.
    """
    params = {name: jax.lax.stop_gradient(p) if name in form.frozen else p for name, p in params.items()}
    cache, tokens, (entropy, depth_l1) = stream_chunks(model, params, sample, recipe)
    loss = entropy + recipe.depth_l1_weight * depth_l1
    accepted = jnp.mean((tokens.confidences >= model.config.memory.min_confidence).astype(jnp.float32))
    metrics = {"depth_entropy": entropy, "depth_l1": depth_l1, "accepted": accepted}
    if sample.target_images.shape[0]:
        gaussians = _rendered_scene(model, params, cache, tokens, form)
        rendering, rendering_metrics = target_loss(gaussians, sample, recipe, lpips_weights)
        loss = recipe.depth_weight * loss + recipe.rendering_weight * rendering
        metrics |= rendering_metrics
    return loss, metrics | {"loss": loss}


def mean_loss(
    params: dict,
    model: StreamSplat,
    batch: Sample,
    recipe: Recipe,
    form: PhaseForm,
    lpips_weights: LpipsWeights | None = None,
) -> tuple[Float[Array, ""], dict]:
    """Means of `loss_fn` over the samples of a batch, which are along its leading axis.

    Samples without targets are computed side by side, those with targets one after the other: the rasterizer keeps the
    machine busy with one sample.
    """
    one = lambda sample: loss_fn(params, model, sample, recipe, form, lpips_weights)  # noqa: E731
    if len(batch.log_depths) == 1:
        return one(jax.tree.map(lambda x: x[0], batch))
    results = jax.vmap(one)(batch) if batch.target_images.shape[1] == 0 else jax.lax.map(one, batch)
    return jax.tree.map(jnp.mean, results)


def _rendered_scene(model: StreamSplat, params: dict, cache: VoxelCache, tokens: Tokens, form: PhaseForm) -> Gaussians:
    """The Gaussians that a phase renders (`PhaseForm.decode`)."""
    if form.decode == "cache":
        return model.decode(params, cache)
    if form.decode == "all_tokens":
        return model.decode_tokens(params, tokens)
    return decode_accepted(model, params, cache, tokens)


def target_loss(
    gaussians: Gaussians, sample: Sample, recipe: Recipe, lpips_weights: LpipsWeights | None
) -> tuple[Float[Array, ""], dict]:
    """Rendering loss of the target views, and metrics to log.

    Args:
        gaussians: the scene, stream frame.
        sample: gives target views and cameras.
        recipe: weights of the losses.
        lpips_weights: weights of LPIPS, if there are any.

    Returns:
        The loss, and scalar metrics by name.
    """
    output = render(gaussians, sample.target_camera, max_pairs=recipe.max_pairs)
    filled = fill_holes(output.color, output.alpha, jax.lax.stop_gradient(mean_color(gaussians)))
    gains = fitted_gains(filled, sample.target_images) if recipe.fit_gains else 1.0
    rendering, over_black = (
        rendering_loss(images * gains, sample.target_images, recipe=recipe, lpips_weights=lpips_weights)
        for images in (filled, output.color)
    )
    total = (1 - recipe.black_weight) * rendering.total + recipe.black_weight * over_black.total
    metrics = {} if rendering.lpips is None else {"lpips": rendering.lpips}
    return total, metrics | {
        "psnr": -10 * jnp.log10(rendering.mse + 1e-10),
        "psnr_over_black": -10 * jnp.log10(over_black.mse + 1e-10),
        "alpha": output.alpha.mean(),
        "overflow": output.num_overflow.astype(jnp.float32),
    }


def scale_parts(updates: dict, factors: tuple[tuple[str, float], ...]) -> dict:
    """`updates` with the parts below some paths multiplied; see `Recipe.part_rates`."""
    for path, factor in factors:
        name, _, rest = path.partition("/")
        if name in updates:
            part = updates[name]
            scaled = scale_parts(part, ((rest, factor),)) if rest else jax.tree.map(lambda u, f=factor: f * u, part)
            updates = {**updates, name: scaled}
    return updates


def train_step(
    state: TrainState,
    batch: Sample,
    rate: Float[Array, ""],
    *,
    model: StreamSplat,
    recipe: Recipe,
    form: PhaseForm = DEFAULT_FORM,
    lpips_weights: LpipsWeights | None = None,
) -> tuple[TrainState, dict]:
    """State after one update, and metrics to log.

    Args:
        state: state before the step.
        batch: the step's samples, along one more leading axis.
        rate: learning rate.
        model: the model.
        recipe: optimizer and loss.
        form: frozen stages, and what is rendered.
        lpips_weights: weights of LPIPS, if there are any.

    Returns:
        The state, and scalar metrics by name.

    Limits:
        A gradient that is not finite changes only `step` and `num_skipped`.
        A stage that is frozen, or whose gradient is 0 throughout, keeps its parameters to the bit.
    """
    gradients, metrics = jax.grad(mean_loss, has_aux=True)(state.params, model, batch, recipe, form, lpips_weights)
    norm = optax.global_norm(gradients)
    is_finite = jnp.isfinite(norm)
    updates, opt_state = optimizer(recipe).update(gradients, state.opt_state, state.params)
    # Without this, momentum and weight decay would move frozen parameters, and those that the loss does not reach.
    is_reached = {name: name not in form.frozen and _is_any_nonzero(part) for name, part in gradients.items()}
    updates = {name: jax.tree.map(lambda u, r=is_reached[name]: jnp.where(r, u, 0), u) for name, u in updates.items()}  # pyright: ignore[reportAttributeAccessIssue]
    updates = scale_parts(updates, recipe.part_rates)
    params = jax.tree.map(lambda p, u: p - rate * u, state.params, updates)
    step = state.step.astype(jnp.float32)
    decay = jnp.minimum(recipe.ema_decay, (1.0 + step) / (recipe.ema_warmup_steps + step))
    ema = jax.tree.map(lambda e, p: e + (1 - decay) * (p - e), state.ema, params)  # exact where p = e
    keep = functools.partial(jax.tree.map, lambda new, old: jnp.where(is_finite, new, old))
    new_state = TrainState(
        params=keep(params, state.params),
        ema=keep(ema, state.ema),
        opt_state=keep(opt_state, state.opt_state),
        step=state.step + 1,
        num_skipped=state.num_skipped + (~is_finite).astype(jnp.int32),
    )
    return new_state, metrics | {"grad_norm": norm}


def _is_any_nonzero(tree: dict) -> Bool[Array, ""]:
    """True if an entry of the arrays is not 0."""
    return jax.tree.reduce(lambda found, leaf: found | jnp.any(leaf != 0), tree, jnp.array(False))


@dataclasses.dataclass(frozen=True)
class Trainer:
    """The jitted step for one model and recipe, compiled once per shape of samples and form of phases."""

    model: StreamSplat
    recipe: Recipe

    @functools.cached_property
    def step(self):
        """`(state, batch, rate, form=DEFAULT_FORM, lpips_weights=None) -> (state, metrics)`; `state` is donated."""
        bound = functools.partial(train_step, model=self.model, recipe=self.recipe)
        return jax.jit(bound, donate_argnums=0, static_argnames="form")
