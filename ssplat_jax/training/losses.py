"""Losses of training phases: depth, which procedural scenes provide (ours), rendering (Eq. training_loss), and crops.

The loss of a phase is a frozen dataclass, whose fields are its weights and whose call is

    loss(model, params, batch, lpips weights or None) -> (value, metrics to log)

`renders` says whether it renders the target views of `Sample`, which must then have some. To try another loss, write it
here, name it in a phase of `recipe.py`, and give the recipe a name in `RECIPES`.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ssplat_jax.cache.state import Tokens, VoxelCache
from ssplat_jax.cache.votes import vote
from ssplat_jax.core.gaussians import Gaussians, mask_gaussians, mean_color
from ssplat_jax.evaluation.metrics import LpipsWeights
from ssplat_jax.evaluation.metrics import lpips as lpips_distance
from ssplat_jax.model.hpda import MIN_PROB, expected_log_depth, inject_anchor, learned_anchor
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.model.views import GRID_STRIDE, repeat_cells
from ssplat_jax.rasterizer import fill_holes, render
from ssplat_jax.refinement.compared_views import EFFECTS
from ssplat_jax.training.anchors import AnchorSample
from ssplat_jax.training.crops import CropSample
from ssplat_jax.training.samples import Sample

Scalar = Float[Array, ""]
Metrics = dict[str, Array]
Lpips = LpipsWeights | None
Value = tuple[Scalar, Metrics]  # of a loss, and what is logged

MIN_STEP = 1e-6  # smallest step of log depth between candidates that is divided by; steps are 0 where near = far
MAX_GAIN = 2.0
"""Largest gain between a scene and a photograph that training divides out; its reciprocal is the smallest. Exposure
drifts by a factor of two in captures."""
MIN_MSE = 1e-4  # added to squared errors before the logarithm, so that views that are nearly right do not count most


@dataclasses.dataclass(frozen=True)
class DepthLoss:
    """Loss of the depth maps of all streamed views: cross entropy + l1_weight x L1."""

    l1_weight: float = 2.0  # weight of the L1 of log depth beside the cross entropy of the depth distribution
    target_width: float = 0.6
    """Width of the target distribution around the true depth: the standard deviation in steps between candidates."""
    capacity: int = 1 << 14  # voxels of the cache of a sample
    recompute: bool = False  # recomputes the activations of each chunk in the backward pass: less memory, more time
    renders: ClassVar[bool] = False

    def __call__(self, model: StreamSplat, params: dict, batch: Sample, lpips: Lpips = None) -> tuple[Scalar, Metrics]:
        """Mean loss of the samples along the leading axis of `batch`."""
        # Side by side, to keep a GPU busy.
        return _mean_over(lambda sample: self.of_stream(model, params, sample)[2:], batch, along=jax.vmap)

    def of_stream(self, model: StreamSplat, params: dict, sample: Sample) -> tuple[VoxelCache, Tokens, Scalar, Metrics]:
        """Cache and tokens (on one axis) of a sample's chunks, their loss and metrics.

        The backward pass goes chunk by chunk, so that memory does not grow with the number of chunks.
        """
        # jit cannot let a cache grow. Exposures are not matched, because those of the targets are not estimated.
        config = model.config.replace(capacity=self.capacity, overflow="drop_new", match_exposure=False)
        model = StreamSplat(config)

        def body(cache, chunk_and_truth):
            chunk, truth = chunk_and_truth
            prediction = model.predict(params, cache, chunk)
            cache, shape = model.update_cache(cache, prediction), prediction.log_depths.shape
            losses = depth_loss(
                repeat_cells(prediction.distribution.logits, config.network.match_stride // GRID_STRIDE),
                prediction.log_depths,
                # Padded as images are; the loss skips the padding by `inside`.
                jnp.pad(truth, [(0, n - m) for m, n in zip(truth.shape, shape, strict=True)], mode="edge"),
                prediction.views.log_candidates,
                prediction.views.inside,
                target_width=self.target_width,
            )
            return cache, (prediction.tokens, losses)

        body = jax.checkpoint(body) if self.recompute else body
        cache, (tokens, losses) = jax.lax.scan(body, model.init_cache(), (sample.chunks, sample.log_depths))
        tokens = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), tokens)
        entropy, l1 = jax.tree.map(jnp.mean, losses)
        loss = entropy + self.l1_weight * l1
        accepted = jnp.mean((tokens.confidences >= config.memory.min_confidence).astype(jnp.float32))
        return cache, tokens, loss, {"depth_entropy": entropy, "depth_l1": l1, "accepted": accepted, "loss": loss}


@dataclasses.dataclass(frozen=True)
class AnchorLoss:
    """Loss of the depths that the learned anchor leads to, in cells that the cache has: cross entropy + L1."""

    l1_weight: float = 2.0  # weight of the L1 of log depth beside the cross entropy of the anchored distribution
    target_width: float = 0.6  # see `DepthLoss`
    renders: ClassVar[bool] = False

    def __call__(self, model: StreamSplat, params: dict, batch: AnchorSample, lpips: Lpips = None) -> Value:
        """Mean loss of the samples along the leading axis of `batch`, and beside it the L1 without the anchor."""

        def of_sample(sample: AnchorSample) -> tuple[Scalar, Metrics]:
            inputs, candidates = sample.inputs, sample.log_candidates
            probs = inject_anchor(inputs.probs, learned_anchor(params["hpda"], inputs), 1.0)

            def loss(probs):
                predicted = expected_log_depth(probs, candidates, model.config)
                logits = jnp.log(jnp.maximum(probs, MIN_PROB))
                usable = sample.usable & inputs.mask
                return depth_loss(
                    logits, predicted, sample.log_depths, candidates, usable, target_width=self.target_width
                )

            entropy, l1 = loss(probs)
            total = entropy + self.l1_weight * l1
            return total, {"entropy": entropy, "l1": l1, "l1_of_matcher": loss(inputs.probs)[1], "loss": total}

        return _mean_over(of_sample, batch, along=jax.vmap)


@dataclasses.dataclass(frozen=True)
class RenderingLoss:
    """Loss of rendered target views, and of depth beside it.

    rendering = MSE + lpips_weight x LPIPS
    loss      = depth_weight x depth + weight x rendering
    """

    depth: DepthLoss = DepthLoss()  # loss of the streamed views
    depth_weight: float = 0.1  # weight of the depth loss (ours: procedural scenes have known depth)
    weight: float = 10.0  # weight of the rendering loss, the mean over the target views
    tokens: Literal["all", "accepted"] = "accepted"
    """Tokens that are rendered: all of them (the paper), or those that the cache would accept, so that layers carry the
    same opacity as at inference."""
    lpips_weight: float = 0.05
    """Weight of LPIPS beside the MSE, as in the paper (Eq. training_loss); without its weights the MSE stands alone."""
    black_weight: float = 0.05
    """Fraction of the rendering loss computed over a black background. The rest fills holes with the colors around
    them, as in evaluation; alone, that would make all surfaces translucent, since holes would cost nothing."""
    fit_gains: bool = True
    """Compares each photograph at the gain per channel with which the rendered view is nearest to it (ours):
    photographs differ in exposure."""
    max_pairs: int = 1 << 20  # tile intersections that the rasterizer may use per batch of targets; overflow is logged
    renders: ClassVar[bool] = True

    def __call__(self, model: StreamSplat, params: dict, batch: Sample, lpips: Lpips = None) -> tuple[Scalar, Metrics]:
        """Mean loss of the samples along the leading axis of `batch`."""

        def of_sample(sample: Sample):
            cache, tokens, depth, metrics = self.depth.of_stream(model, params, sample)
            if self.tokens == "all":
                gaussians = model.decode_tokens(params, tokens)
            else:
                gaussians = decode_accepted(model, params, cache, tokens)
            rendering, more = self.of_scene(gaussians, sample, lpips)
            loss = self.depth_weight * depth + self.weight * rendering
            return loss, metrics | more | {"loss": loss}

        # One after the other: the rasterizer keeps the machine busy with one sample.
        return _mean_over(of_sample, batch, along=lambda one: functools.partial(jax.lax.map, one))

    def of_scene(self, gaussians: Gaussians, sample: Sample, lpips: Lpips = None) -> tuple[Scalar, Metrics]:
        """Rendering loss of the target views of `sample` in a scene, and metrics."""
        output = render(gaussians, sample.target_camera, max_pairs=self.max_pairs)
        filled = fill_holes(output.color, output.alpha, jax.lax.stop_gradient(mean_color(gaussians)))
        targets, seen = sample.target_images, sample.target_seen
        if seen is not None:  # masked pixels are equal, whatever the camera saw there
            filled, targets, black = (jnp.where(seen[..., None], x, 0.0) for x in (filled, targets, output.color))
        else:
            black = output.color
        has_gains = self.fit_gains & sample.is_photographed
        gains = jnp.where(has_gains, fitted_gains(filled, targets), 1.0)
        weighted = ((1 - self.black_weight, filled * gains), (self.black_weight, black * gains))
        # LPIPS takes long: terms without weight are not computed.
        terms = [(weight, self.of_images(x, targets, lpips)) for weight, x in weighted if weight]
        shown, black = (jnp.mean((x - targets) ** 2) for _, x in weighted)
        return sum((weight * loss for weight, (loss, _) in terms), start=jnp.zeros(())), {
            **({} if lpips is None else {"lpips": terms[0][1][1]}),
            "psnr": -10 * jnp.log10(shown + 1e-10),
            "psnr_over_black": -10 * jnp.log10(black + 1e-10),
            "alpha": output.alpha.mean(),
            "overflow": output.num_overflow.astype(jnp.float32),
        }

    def of_images(
        self, images: Float[Array, "s h w 3"], targets: Float[Array, "s h w 3"], lpips: Lpips = None
    ) -> tuple[Scalar, Scalar]:
        """Loss of rendered views, RGB in [0, 1], and their LPIPS; 0 without its weights."""
        distance = jnp.zeros(()) if lpips is None else lpips_distance(lpips, images, targets).mean()
        return jnp.mean((images - targets) ** 2) + self.lpips_weight * distance, distance


@dataclasses.dataclass(frozen=True)
class CropLoss:
    """Minus the PSNR of crops of the decoded cache, which is what is scored: scenes of any difficulty count alike.

    LPIPS stands beside it, because the PSNR alone prefers a blurred surface to a sharp one that is slightly misplaced.
    """

    # With LPIPS of the filled image alone, surfaces that few views saw became translucent: filled holes are sharp.
    black_weight: float = 0.4  # weight of the image over black; the rest is that of the image with holes filled
    # At 24 dB the paper's 0.05 beside the MSE would be 54.
    lpips_weight: float = 20.0  # decibels that an LPIPS of 1 counts; without its weights the PSNR stands alone
    renders: ClassVar[bool] = False

    def __call__(self, model: StreamSplat, params: dict, batch: tuple[CropSample, ...], lpips: Lpips = None) -> Value:
        """Mean over the crops of `batch`, and their PSNRs in dB."""

        def of_crop(crop: CropSample) -> tuple[Scalar, Metrics]:
            gaussians = model.decode_rows(params, crop.cache, crop.pivots, crop.num_gaussians)
            out = render(gaussians, crop.camera, effects=EFFECTS, max_pairs=crop.max_pairs)
            target = crop.image[..., :3].astype(jnp.float32) / 255
            filled = fill_holes(out.color, out.alpha, mean_color(gaussians))
            views = [x * crop.exposure for x in (filled, out.color)]
            if crop.image.shape[-1] > 3:  # masked pixels are equal, as in the loss of rendered views
                views = [jnp.where(crop.image[..., 3:] > 0, x, target) for x in views]
            shown, black = (negative_psnr(x, target) for x in views)
            loss = (1 - self.black_weight) * shown + self.black_weight * black
            metrics = {"psnr": -shown, "psnr_over_black": -black, "overflow": out.num_overflow.astype(jnp.float32)}
            if lpips is not None:
                distances = jax.vmap(functools.partial(lpips_distance, lpips, b=target))
                shown, black = distances(jnp.clip(jnp.stack(views), 0.0, 1.0))
                loss += self.lpips_weight * ((1 - self.black_weight) * shown + self.black_weight * black)
                metrics |= {"lpips": shown, "lpips_over_black": black}
            return loss, metrics | {"loss": loss}

        return jax.tree.map(lambda *parts: sum(parts) / len(parts), *map(of_crop, batch))


def _mean_over(one: Callable[[Any], tuple], batch: Any, *, along: Callable) -> tuple:
    """Means of `one` over the leading axis of `batch`, which `along` maps over it."""
    if len(batch.log_depths) == 1:
        return one(jax.tree.map(lambda x: x[0], batch))
    return jax.tree.map(jnp.mean, along(one)(batch))


def decode_accepted(model: StreamSplat, params: dict, cache: VoxelCache, tokens: Tokens) -> Gaussians:
    """Gaussians of the tokens that inference would accept, without merging.

    Those are the tokens whose confidence, after the votes of depths stored in `cache`, is at least `min_confidence`.
    The cache is a constant.
    """
    gaussians = model.decode_tokens(params, tokens)
    voted = vote(*jax.lax.stop_gradient((cache.stored_depths, tokens)), model.config)
    is_accepted = tokens.valid & (voted.confidences >= model.config.memory.min_confidence)
    return mask_gaussians(gaussians, model.repeat_per_gaussian(is_accepted))


def soft_targets(
    log_depths: Float[Array, "*b"], log_candidates: Float[Array, " d"], width: float
) -> Float[Array, "*b d"]:
    """Target distribution over the candidates: a normalized Gaussian around the true depth.

    Its standard deviation is `width` steps between candidates.

    Limits:
        A single candidate has probability 1; candidates at one depth have equal probabilities.
    """
    # Candidates may be uniform in inverse depth: each has its own step of log depth.
    steps = jnp.abs(jnp.asarray(jnp.gradient(log_candidates))) if len(log_candidates) > 1 else jnp.zeros(1)
    step = jnp.maximum(steps, MIN_STEP)
    return jax.nn.softmax(-0.5 * ((log_candidates - log_depths[..., None]) / (width * step)) ** 2, axis=-1)


def depth_loss(
    logits: Float[Array, "v hf wf d"],
    predicted: Float[Array, "v hf wf"],
    truth: Float[Array, "v hf wf"],
    log_candidates: Float[Array, " d"],
    usable: Bool[Array, "v hf wf"],
    *,
    target_width: float,
) -> tuple[Scalar, Scalar]:
    """Cross entropy of P_i and L1 of the anchored log depth: means over usable cells with a true depth in range.

    Args:
        logits: of P_i.
        predicted: anchored log depths.
        truth: true log depths.
        log_candidates: natural logarithms of the candidates, which give the range.
        usable: cells that count.
        target_width: see `soft_targets`.

    Limits:
        A true depth that is infinite (-inf is the logarithm of an unknown 0) or NaN is out of range and contributes
        nothing to value and gradient.
    """
    in_range = usable & (truth > log_candidates.min()) & (truth < log_candidates.max())
    truth = jnp.where(in_range, truth, jax.lax.stop_gradient(predicted))
    weight = in_range.astype(jnp.float32) / jnp.maximum(in_range.sum(), 1).astype(jnp.float32)
    targets = soft_targets(truth, log_candidates, target_width)
    entropy = -jnp.sum(targets * jax.nn.log_softmax(logits, axis=-1), axis=-1)
    return jnp.sum(weight * entropy), jnp.sum(weight * jnp.abs(predicted - truth))


def fitted_gains(images: Float[Array, "s h w 3"], targets: Float[Array, "s h w 3"]) -> Float[Array, "s 1 1 3"]:
    """Gain per view and channel with which an image is nearest to its target; not differentiated.

    Photographs have exposures of their own, which a scene of one exposure cannot show and should not learn to.

    Limits:
        Gains stay in [1 / MAX_GAIN, MAX_GAIN]; of a black image the gain is 1.
    """
    images, targets = jax.lax.stop_gradient((images, targets))
    energy = jnp.sum(images * images, axis=(1, 2), keepdims=True)
    gains = jnp.sum(images * targets, axis=(1, 2), keepdims=True) / jnp.where(energy > 0, energy, 1.0)
    return jnp.where(energy > 0, jnp.clip(gains, 1 / MAX_GAIN, MAX_GAIN), 1.0)


def negative_psnr(image: Float[Array, "h w 3"], target: Float[Array, "h w 3"]) -> Scalar:
    """Minus the PSNR in dB, whose gradient is as large for an easy scene as for a hard one."""
    mse = jnp.mean((jnp.clip(image, 0.0, 1.0) - target) ** 2)
    return 10 / math.log(10) * jnp.log(mse + MIN_MSE)
