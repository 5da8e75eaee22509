"""Training recipes: everything that decides the trained weights, besides configuration, first weights and captures.

A recipe is a sequence of phases, and a phase is samples, a loss, the parts that learn by it, and a number of steps:

    Phase("depth", 3000, ViewSamples(1, sizes=((96, 128),)), DepthLoss(), MATCHER, learning_rate=1e-3)

Samples are in `samples.py` and `crops.py`, losses in `losses.py`, the loop and its optimizer in `loop.py`.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar, Protocol, runtime_checkable

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.errors import InputError
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.training.anchors import StreamParts
from ssplat_jax.training.crops import Crops
from ssplat_jax.training.losses import AnchorLoss, CropLoss, DepthLoss, RenderingLoss
from ssplat_jax.training.samples import CaptureMix, TrainingStart, ViewSamples

MATCHER = ("encoder", "cost_volume", "upsampler")
"""Stages that end in the depth map; not every network has all of them. They learn from depth alone."""
AFTER_MATCHER = ("hpda", "tokens", "cgfi", "mixer", "decoder")  # stages that make Gaussians of depth and features


@runtime_checkable
class Samples(Protocol):
    """Samples that the steps of a phase learn from, such as `ViewSamples` and `Crops`.

    `check` raises an InputError if the captures cannot teach the phase, and `open` gives a function that makes a batch
    of the number of its step in the recipe and its place in the phase.
    """

    def check(self, mix: CaptureMix, config: StreamConfig, *, renders: bool) -> None: ...

    def open(self, start: TrainingStart) -> Callable[[int, int], Any]: ...


@runtime_checkable
class Loss(Protocol):
    """Loss that the steps of a phase lower, see `losses.py`."""

    renders: ClassVar[bool]

    def __call__(self, model: StreamSplat, params: dict, batch: Any, lpips: Any = None) -> tuple[Any, dict]: ...


@dataclasses.dataclass(frozen=True)
class Phase:
    """A number of steps on samples of one kind by one loss."""

    name: str  # name in logs
    steps: int  # number of steps
    samples: Samples  # samples that the steps learn from
    loss: Loss  # loss that they lower
    stages: tuple[str, ...]
    """Stages that learn. All others are constants: weight decay would move even those that the loss does not reach.
    Stages that the network lacks are skipped."""
    learning_rate: float  # peak of the learning rate, to which it warms up and from which it decays by a cosine
    final_share: float = 0.1  # learning rate at the end of the phase, as a fraction of the peak
    warmup_steps: int = 50  # steps of linear warm-up


@dataclasses.dataclass(frozen=True)
class Recipe:
    """Phases in order, and what they share."""

    phases: tuple[Phase, ...]
    seed: int = 0  # seed of the initial parameters and of the samples
    adam_b2: float = 0.99  # decay of Adam's mean of squared gradients
    weight_decay: float = 0.01  # decoupled weight decay, multiplied by the learning rate (AdamW)
    clip_norm: float | None = 1.0
    """Largest global norm of the gradient; longer ones are scaled down. None: none is."""
    ema_decay: float = 0.99
    """Decay of the moving average of the parameters, which is what is evaluated and shipped; 0 averages nothing."""
    captures_alone: bool = False  # True if captures share all steps; else procedural scenes have those that are left
    untrained: tuple[str, ...] = ()
    """Stages that start untrained even if the first weights have them. Such a recipe needs first weights."""

    def __post_init__(self) -> None:
        if not self.phases or any(phase.steps < 1 for phase in self.phases):
            raise InputError(f"recipe: wanted phases of at least one step, got {self.phases}.")

    @property
    def uses_lpips(self) -> bool:
        """True if a loss has a term of LPIPS."""
        return any(getattr(phase.loss, "lpips_weight", 0.0) for phase in self.phases)

    @property
    def num_steps(self) -> int:
        """Number of steps of all phases."""
        return sum(phase.steps for phase in self.phases)

    def scaled(self, factor: float) -> "Recipe":
        """The recipe with the steps of every phase multiplied by `factor`, at least one step each."""
        phases = tuple(dataclasses.replace(p, steps=max(1, round(p.steps * factor))) for p in self.phases)
        return dataclasses.replace(self, phases=phases)


def describe(value: Any) -> Any:
    """A recipe, or a part of it, as JSON types; samples and losses with the name of their class."""
    if dataclasses.is_dataclass(value):
        fields = {field.name: describe(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return {"kind": type(value).__name__, **fields}
    return [describe(part) for part in value] if isinstance(value, tuple) else value


_depth = functools.partial(Phase, loss=DepthLoss(), stages=MATCHER)
# Closer to the size of streamed images, and portrait too. Streamed video is interleaved until views are 3 % of the
# depth apart or more.
_LARGER = ViewSamples(1, ((160, 224), (224, 160)), steps_of_depth=(0.02, 0.4))

TINY_RECIPE = Recipe(
    phases=(
        _depth("depth", 3000, ViewSamples(1, ((96, 128),)), learning_rate=1e-3),
        _depth("larger", 400, _LARGER, learning_rate=5e-4, final_share=0.02),
    )
)
"""Trains the depth of the shipped `tiny` weights from scratch; `depth` continues it, and `evidence` adds the head.
docs/model_card.md has commands, times and machines."""

_BATCHES = ViewSamples(1, ((224, 320),), batch=4, steps_of_depth=(0.01, 0.4))
# Kinds of worlds, of which about half are under a sky.
_OUTDOORS = (*("room",) * 4, "corridor", *("street",) * 2, *("objects",) * 3, *("clutter",) * 2, *("yard",) * 4)
_OUTDOOR_BATCHES = dataclasses.replace(_BATCHES, kinds=_OUTDOORS)

DEPTH_RECIPE = Recipe(
    phases=(
        _depth("depth", 4200, _BATCHES, learning_rate=5e-4),
        _depth("outdoors", 4600, _OUTDOOR_BATCHES, learning_rate=5e-4, final_share=0.02),
    ),
    ema_decay=0.995,
)
"""Continues the training of depth, in batches of images of about the streamed size. It needs a GPU. The shipped weights
took about as many steps, in pieces that docs/model_card.md lists."""

_FOUR_CHUNKS = ViewSamples(4, ((96, 128),), num_targets=4, steps_of_depth=(0.01, 0.15))

# Slow video too: there the cache has what the chunk lacks.
_STREAMS = StreamParts(ViewSamples(8, ((128, 192), (224, 320)), steps_of_depth=(0.003, 0.15)))

ANCHOR_RECIPE = Recipe(
    phases=(Phase("anchor", 1500, _STREAMS, AnchorLoss(), ("hpda",), 2e-3, final_share=0.02),),
    untrained=("hpda",),
)
"""Trains HPDA's learned anchor of weights whose other stages stay as they are. Longer training, on streams in order
alone, trusts the cache too far (docs/model_card.md)."""

# The matcher is trained by then. Without its backward pass a step costs a third, and rendering would teach it less
# about depth than depth supervision did.
STREAM_RECIPE = Recipe((Phase("stream", 400, _FOUR_CHUNKS, RenderingLoss(), AFTER_MATCHER, 1e-3, final_share=0.02),))
"""Trains the stages behind a trained matcher. The shipped weights do not include it, because it lowered the scores
of captures (docs/model_card.md)."""

_EVIDENCE = Phase("evidence", 480, Crops(), CropLoss(), ("evidence",), 5e-3, final_share=0.0, warmup_steps=20)
EVIDENCE_RECIPE = Recipe(
    (_EVIDENCE,), adam_b2=0.999, weight_decay=1e-3, clip_norm=3.0, ema_decay=0.98, untrained=("evidence",)
)
"""Trains the evidence head of weights whose other stages stay as they are."""

_PAPER_DEPTH = DepthLoss(capacity=1 << 16, recompute=True)
# The paper renders all tokens over black alone, at one exposure, and adds up the losses of the target views.
_PAPER_LOSS = RenderingLoss(
    depth=_PAPER_DEPTH, depth_weight=0.0, weight=4.0, tokens="all", black_weight=1.0, fit_gains=False, max_pairs=1 << 22
)
# Its voxels and its anchor have lengths in the units of the poses: scale, near and far are those of the capture.
_PAPER_VIEWS = ViewSamples(4, ((256, 256),), num_targets=4, range_jitter=0.0)
_PAPER_STAGES = (*MATCHER, *AFTER_MATCHER)
_PAPER = Phase("paper", 100_000, _PAPER_VIEWS, _PAPER_LOSS, _PAPER_STAGES, 1e-4, final_share=1.0, warmup_steps=1)
PAPER_RECIPE = Recipe((_PAPER,), adam_b2=0.999, clip_norm=None, ema_decay=0.0, captures_alone=True)
"""The paper's training to the letter: 100,000 steps of AdamW at a constant 1e-4 with one sample of a capture each,
through all stages. It needs LPIPS weights for the second term and a GPU, and starts from imported weights. Where the
paper is silent, AdamW has PyTorch's defaults, and a sample four chunks and four targets of 256 x 256."""

RECIPES = {
    "tiny": TINY_RECIPE,
    "depth": DEPTH_RECIPE,
    "anchor": ANCHOR_RECIPE,
    "stream": STREAM_RECIPE,
    "evidence": EVIDENCE_RECIPE,
    "paper": PAPER_RECIPE,
}
"""Choices of `ssplat train --recipe`."""
