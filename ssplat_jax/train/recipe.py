"""What a training run is, as data: phases of a curriculum and the optimizer's numbers. No JAX here."""

import dataclasses
from typing import Literal

from ssplat_jax.config import StreamConfig
from ssplat_jax.errors import InputError


@dataclasses.dataclass(frozen=True)
class PhaseForm:
    """What of a phase the compiled step depends on, the shapes of its samples aside."""

    frozen: tuple[str, ...] = ()
    """Stages (keys of the parameters) that the phase leaves as they are; no gradient is computed through them."""
    decode: Literal["tokens", "cache"] = "tokens"
    """What is rendered: the tokens of all chunks with their gradients (the paper), or the cache, as inference does.
    The cache holds constants, so `cache` trains the Gaussian head alone."""


PAPER_FORM = PhaseForm()


@dataclasses.dataclass(frozen=True)
class Phase:
    """A stretch of training with samples of one form (one compiled program per image size)."""

    name: str
    steps: int
    num_chunks: int
    """Chunks streamed through the cache per sample."""
    num_targets: int
    """Novel views rendered per sample; 0 trains depth alone and never renders."""
    sizes: tuple[tuple[int, int], ...]
    """Image sizes (height, width), taken in turn."""
    learning_rate: float
    """Peak of the phase; it decays by cosine."""
    form: PhaseForm = PAPER_FORM
    final_share: float = 0.1
    """Of the peak, what the learning rate decays to."""
    steps_of_depth: tuple[float, float] = (0.005, 0.4)
    """From what to what consecutive views of a sample step, in median depths: hand-held video to sets of photos."""


@dataclasses.dataclass(frozen=True)
class Recipe:
    """Everything that decides the trained weights, the model's configuration aside."""

    phases: tuple[Phase, ...]
    seed: int = 0
    warmup_steps: int = 50
    weight_decay: float = 0.01
    clip_norm: float = 1.0
    ema_decay: float = 0.99
    depth_weight: float = 0.1
    """Weight of the depth losses beside the rendering loss (procedural scenes know their depth; DESIGN 6.13)."""
    gradient_weight: float = 0.02
    """Weight of the L1 of image gradients beside the MSE, in place of LPIPS, whose weights cannot be shipped. One
    color a cell shows no texture below it: a larger weight asks for that in vain, or for blur."""
    black_weight: float = 0.05
    """Share of the rendering loss over black; the rest has holes in the colors around, as views are scored. That alone
    would make all surfaces sheer: what is open costs it nothing."""
    recompute: bool = False
    """Recompute each chunk's activations backward: less memory, more time."""
    cache_capacity: int = 1 << 14
    max_pairs: int = 1 << 20
    """Tile pairs the rasterizer may use per target batch; overflow is logged."""

    def __post_init__(self) -> None:
        for phase in self.phases:
            if phase.steps < 1 or phase.num_chunks < 1 or phase.num_targets < 0 or not phase.sizes:
                raise InputError(f"recipe: phase {phase.name!r} needs steps, num_chunks >= 1 and a size, got {phase}.")

    @property
    def num_steps(self) -> int:
        """Steps of all phases."""
        return sum(phase.steps for phase in self.phases)

    def phase_at(self, step: int) -> tuple[Phase, int]:
        """The phase that holds `step` and the step's position in it."""
        for phase in self.phases:
            if step < phase.steps:
                return phase, step
            step -= phase.steps
        raise IndexError(step)

    def scaled(self, factor: float) -> "Recipe":
        """The same curriculum with every phase shortened or lengthened by `factor` (at least one step each)."""
        phases = tuple(dataclasses.replace(p, steps=max(1, round(p.steps * factor))) for p in self.phases)
        return dataclasses.replace(self, phases=phases)


# The parameters that rendering the cache leaves without a gradient.
ALL_BUT_HEAD = ("encoder", "cost_volume", "upsampler", "hpda", "tokens", "cgfi", "mixer")

TINY = Recipe(
    phases=(
        Phase("depth", 3000, num_chunks=1, num_targets=0, sizes=((96, 128),), learning_rate=1e-3),
        # Nearer the size of what is streamed, and upright too.
        Phase(
            "larger",
            400,
            num_chunks=1,
            num_targets=0,
            sizes=((160, 224), (224, 160)),
            learning_rate=5e-4,
            final_share=0.02,
            steps_of_depth=(0.02, 0.4),  # what is streamed has been dealt out to 3 % and more
        ),
    )
)
"""From scratch to the shipped `tiny` weights; docs/model_card.md has the command, hours and machine."""

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
            # The matcher is done by then; without its backward pass a step costs a third, and rendering teaches it
            # less about depth than depth itself did.
            form=PhaseForm(frozen=("encoder", "cost_volume", "upsampler")),
        ),
    )
)
"""What comes behind the matcher (gamma, features, CGFI, mixer, head), for weights that know depth. Not part of the
shipped ones: docs/model_card.md says what it gave."""

RECIPES = {"tiny": TINY, "stream": STREAM}


def smoke_recipe(steps: int = 20) -> Recipe:
    """A few steps of every kind at the smallest size: what tests train."""
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
    """The configuration trained with: a cache as large as a sample needs, and no growth inside jit.

    Colors stay as they are seen: the targets have exposures of their own, which nothing estimates.
    """
    return config.replace(capacity=recipe.cache_capacity, overflow="drop_new", match_exposure=False)
