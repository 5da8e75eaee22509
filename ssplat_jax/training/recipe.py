"""Training recipes: everything that decides the weights, besides the model configuration.

This module does not import JAX, so that `ssplat --help` answers at once.
"""

import dataclasses
import json
from typing import Any, Literal

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.errors import InputError


@dataclasses.dataclass(frozen=True)
class PhaseForm:
    """The part of a phase that the compiled step depends on, besides the shapes of its samples."""

    frozen: tuple[str, ...] = ()
    """Stages (keys of the parameters) that the phase does not train; no gradient is computed through them."""
    decode: Literal["all_tokens", "tokens", "cache"] = "tokens"
    """Scene that is rendered: the tokens of all chunks, through which gradients flow (`all_tokens`, the paper); those
    that the cache would accept (`tokens`); or the decoded cache, as in inference. The cache holds constants, so `cache`
    trains the Gaussian head and the evidence head alone."""


DEFAULT_FORM = PhaseForm()
"""All stages are trained, accepted tokens are rendered."""


@dataclasses.dataclass(frozen=True)
class Phase:
    """A number of steps on samples of one kind; one program is compiled per image size."""

    name: str
    """Name in logs."""
    steps: int
    """Number of steps."""
    num_chunks: int
    """Chunks streamed through the cache per sample."""
    num_targets: int
    """Novel views rendered per sample; 0 trains depth alone and never renders."""
    sizes: tuple[tuple[int, int], ...]
    """Image sizes (height, width), used alternately."""
    learning_rate: float
    """Peak of the learning rate, from which it decays by a cosine."""
    form: PhaseForm = DEFAULT_FORM
    final_share: float = 0.1
    """Learning rate at the end of the phase, as a fraction of the peak."""
    batch: int = 1
    """Samples per step; the loss is their mean."""
    steps_of_depth: tuple[float, float] = (0.005, 0.4)
    """Range of the distance between consecutive views in median depths: from hand-held video to photo sets."""
    kinds: tuple[str, ...] = ()
    """Kinds of procedural worlds, of which each sample draws one; repeated ones are more likely. Empty: all kinds but
    yards, with the shares of `data/procedural/scenes.py`."""


@dataclasses.dataclass(frozen=True)
class Recipe:
    """Everything that decides the trained weights, besides the model configuration.

    The loss of a step is

        depth     = cross entropy + depth_l1_weight x L1
        rendering = MSE + lpips_weight x LPIPS, or MSE + gradient_weight x L1 of image gradients
        loss      = depth                                               without target views
                    depth_weight x depth + rendering_weight x rendering   with target views
    """

    phases: tuple[Phase, ...]
    """Phases in order."""
    seed: int = 0
    """Seed of the initial parameters and of the samples."""
    warmup_steps: int = 50
    """Steps of linear warm-up of the learning rate at the start of every phase."""
    adam_b1: float = 0.9
    """Decay of Adam's mean of gradients."""
    adam_b2: float = 0.99
    """Decay of Adam's mean of squared gradients."""
    adam_epsilon: float = 1e-8
    """Added to Adam's denominator."""
    weight_decay: float = 0.01
    """Decoupled weight decay, multiplied by the learning rate (AdamW)."""
    part_rates: tuple[tuple[str, float], ...] = ()
    """Factors of the learning rate by the path of a part of the parameters, such as ("encoder/pretrained", 0.01). Parts
    that the network does not have are skipped."""
    clip_norm: float = 1.0
    """Largest global norm of the gradient; longer ones are scaled down."""
    ema_decay: float = 0.99
    """Decay of the moving average of the parameters, which is what is evaluated and shipped."""
    ema_warmup_steps: float = 10.0
    """At step t the decay is at most (1 + t) / (ema_warmup_steps + t), so that the average forgets the random start."""
    depth_l1_weight: float = 2.0
    """Weight of the L1 of log depth beside the cross entropy of the depth distribution."""
    depth_target_width: float = 0.6
    """Width of the target distribution around the true depth: the standard deviation in steps between candidates."""
    depth_weight: float = 0.1
    """Weight of the depth loss beside the rendering loss (ours: procedural scenes have known depth)."""
    rendering_weight: float = 10.0
    """Weight of the rendering loss beside the depth loss."""
    lpips_weight: float = 0.05
    """Weight of LPIPS beside the MSE, as in the paper (Eq. training_loss); used only when LPIPS weights are given."""
    gradient_weight: float = 0.02
    """Weight of the L1 of image gradients beside the MSE, which replaces LPIPS when its weights are not given. The
    Gaussians cannot show texture finer than themselves: a larger weight would not bring it out, but favor blur."""
    black_weight: float = 0.05
    """Fraction of the rendering loss computed over a black background. The rest fills holes with the colors around
    them, as in evaluation; alone, that would make all surfaces translucent, since holes would cost nothing."""
    sum_views: bool = False
    """Adds up the rendering losses of a sample's target views (the paper) instead of taking their mean."""
    fit_gains: bool = False
    """Compares each target view at the gain per channel with which the rendered one is nearest to it (ours):
    photographs differ in exposure. `ssplat train --captures` sets it."""
    range_jitter: float = 0.25
    """Largest error of scene scale, near and far in samples (log of a factor), for robustness to estimated ones."""
    recompute: bool = False
    """Recomputes the activations of each chunk in the backward pass: less memory, more time."""
    cache_capacity: int = 1 << 14
    """Voxels of the cache while training."""
    max_pairs: int = 1 << 20
    """Tile intersections that the rasterizer may use per batch of targets; overflow is logged."""

    def __post_init__(self) -> None:
        for phase in self.phases:
            if min(phase.steps, phase.num_chunks, phase.batch) < 1 or phase.num_targets < 0 or not phase.sizes:
                wanted = "steps, num_chunks and batch of at least 1, and a size"
                raise InputError(f"recipe: phase {phase.name!r} needs {wanted}, got {phase}.")

    @property
    def renders(self) -> bool:
        """True if any phase renders target views."""
        return any(phase.num_targets for phase in self.phases)

    @property
    def num_steps(self) -> int:
        """Number of steps of all phases."""
        return sum(phase.steps for phase in self.phases)

    def phase_at(self, step: int) -> tuple[Phase, int]:
        """The phase that contains `step`, and the position of `step` in it.

        Raises:
            IndexError: the recipe has no such step.
        """
        for phase in self.phases:
            if step < phase.steps:
                return phase, step
            step -= phase.steps
        raise IndexError(step)

    def scaled(self, factor: float) -> "Recipe":
        """The recipe with the steps of every phase multiplied by `factor`, at least one step each."""
        phases = tuple(dataclasses.replace(p, steps=max(1, round(p.steps * factor))) for p in self.phases)
        return dataclasses.replace(self, phases=phases)


def with_defaults(fields: dict[str, Any]) -> dict[str, Any]:
    """Recipe as plain JSON types, with the defaults of fields that are missing because an older version wrote it.

    Args:
        fields: `dataclasses.asdict` of a recipe, as read from JSON.
    """
    phases = [
        _defaults(Phase) | phase | {"form": _defaults(PhaseForm) | phase.get("form", {})}
        for phase in fields.get("phases", [])
    ]
    return json.loads(json.dumps(_defaults(Recipe) | fields | {"phases": phases}))


def _defaults(kind: type) -> dict[str, Any]:
    return {field.name: field.default for field in dataclasses.fields(kind) if field.default is not dataclasses.MISSING}


MATCHER_STAGES = ("encoder", "cost_volume", "upsampler")
"""Stages that end in the depth map. A network without an upsampler ignores that name."""

ALL_BUT_HEAD = (*MATCHER_STAGES, "hpda", "tokens", "cgfi", "mixer")
"""Stages that get no gradient when the cache is rendered; decoder and evidence head do."""

TINY = Recipe(
    phases=(
        Phase("depth", 3000, num_chunks=1, num_targets=0, sizes=((96, 128),), learning_rate=1e-3),
        # Closer to the size of streamed images, and portrait too.
        Phase(
            "larger",
            400,
            num_chunks=1,
            num_targets=0,
            sizes=((160, 224), (224, 160)),
            learning_rate=5e-4,
            final_share=0.02,
            steps_of_depth=(0.02, 0.4),  # streamed video is interleaved until views are 3 % apart or more
        ),
    )
)
"""Trains the depth of the shipped `tiny` weights from scratch; `depth` continues it, and `evidence` adds the head.
docs/model_card.md has commands, times and machines."""

OUTDOORS = (*("room",) * 4, "corridor", *("street",) * 2, *("objects",) * 3, *("clutter",) * 2, *("yard",) * 4)
"""Kinds of worlds, of which about half are under a sky."""

_LARGE_BATCHES = Phase(
    "depth",
    4200,
    num_chunks=1,
    num_targets=0,
    sizes=((224, 320),),
    learning_rate=5e-4,
    batch=4,
    steps_of_depth=(0.01, 0.4),
)

DEPTH = Recipe(
    phases=(
        _LARGE_BATCHES,
        dataclasses.replace(_LARGE_BATCHES, name="outdoors", steps=4600, final_share=0.02, kinds=OUTDOORS),
    ),
    ema_decay=0.995,
)
"""Continues the training of depth, in batches of images of about the streamed size. It needs a GPU. The shipped weights
took about as many steps, in pieces that docs/model_card.md lists."""

STREAM = Recipe(
    phases=(
        Phase(
            "stream",
            400,
            num_chunks=4,
            num_targets=4,
            sizes=((96, 128),),
            learning_rate=1e-3,
            final_share=0.02,
            steps_of_depth=(0.01, 0.15),
            # The matcher is trained by then. Without its backward pass a step costs a third, and rendering would teach
            # it less about depth than depth supervision did.
            form=PhaseForm(frozen=MATCHER_STAGES),
        ),
    )
)
"""Trains the stages after the matcher (gamma, features, CGFI, mixer, head) from weights with a trained matcher. The
shipped weights do not include it; docs/model_card.md has its results."""

PAPER = Recipe(
    phases=(
        Phase(
            "paper",
            100_000,
            num_chunks=4,
            num_targets=4,
            sizes=((256, 256),),
            learning_rate=1e-4,
            form=PhaseForm(decode="all_tokens"),
        ),
    ),
    adam_b2=0.999,
    part_rates=(("encoder/pretrained", 0.01),),  # the vision transformer, as DepthSplat trains it
    depth_weight=0.0,
    rendering_weight=1.0,
    gradient_weight=0.0,
    black_weight=1.0,
    sum_views=True,
    recompute=True,
    cache_capacity=1 << 16,
    max_pairs=1 << 22,
)
"""The paper's training: 100,000 steps of AdamW at 1e-4 with one sample each, through all stages and all tokens, by the
rendering loss over black alone. It needs LPIPS weights for the second term and a GPU, and starts from imported weights;
the paper does not give the number of chunks and targets of a sample."""

RECIPES = {"tiny": TINY, "depth": DEPTH, "stream": STREAM, "paper": PAPER}
"""Choices of `ssplat train --recipe`."""


def smoke_recipe(steps: int = 20) -> Recipe:
    """A short recipe at the smallest image size, with both kinds of phases, for tests."""
    size = ((64, 64),)
    return Recipe(
        phases=(
            Phase("depth", max(1, steps // 2), num_chunks=1, num_targets=0, sizes=size, learning_rate=1e-3),
            Phase("stream", max(1, steps - steps // 2), num_chunks=2, num_targets=1, sizes=size, learning_rate=5e-4),
        ),
        warmup_steps=2,
        cache_capacity=1 << 10,
        max_pairs=1 << 15,
    )


def training_config(config: StreamConfig, recipe: Recipe) -> StreamConfig:
    """Model configuration for training: a cache for one sample, without growth, which jit cannot do.

    Exposures are not matched, because those of the target views are not estimated.
    """
    return config.replace(capacity=recipe.cache_capacity, overflow="drop_new", match_exposure=False)
