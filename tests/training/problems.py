"""Small trainings: a quadratic one for the laws of the loop, and short ones of a narrow network."""

import dataclasses
from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from ssplat_jax.training import loop
from ssplat_jax.training.losses import DepthLoss, RenderingLoss
from ssplat_jax.training.recipe import AFTER_MATCHER, MATCHER, Phase, Recipe
from ssplat_jax.training.samples import ViewSamples
from tests.streaming.narrow_model import NARROW


@dataclasses.dataclass(frozen=True)
class Numbers:
    """Samples of random numbers, which depend on the parameters at the start; those of the steps `spoiled` are NaN."""

    spoiled: tuple[int, ...] = ()

    def check(self, mix, config, *, renders):
        pass

    def open(self, start):
        shift = 0.1 * np.asarray(start.params["encoder"]["cnn"])

        def batch(step, place):
            numbers = shift + np.random.default_rng([start.seed, step, place]).normal(1.0, 0.1, 3)
            return jnp.asarray(numbers * np.nan if step in self.spoiled else numbers, jnp.float32)

        return batch


@dataclasses.dataclass(frozen=True)
class Squares:
    """Squared distances of the numbers from all parameters, which may count differently."""

    weight: float = 1.0
    renders: ClassVar[bool] = False

    def __call__(self, model, params, batch, lpips=None):
        parts = {name: jnp.sum((x - batch) ** 2) for name, x in flat_names(params).items()}
        loss = self.weight * sum(parts.values())
        return loss, {"loss": loss}


def flat_names(tree):
    return {jax.tree_util.keystr(path): x for path, x in jax.tree_util.tree_flatten_with_path(tree)[0]}


def start_params():
    """Parameters of three stages."""
    values = iter(np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32))
    encoder = {"pretrained": {"w": jnp.asarray(next(values))}, "cnn": jnp.asarray(next(values))}
    return {"encoder": encoder, "decoder": {"w": jnp.asarray(next(values))}, "hpda": {"w": jnp.asarray(next(values))}}


FIRST = Phase("first", 7, Numbers(spoiled=(3,)), Squares(), ("encoder",), 0.1, warmup_steps=3)
SECOND = Phase("second", 9, Numbers(), Squares(4.0), ("decoder", "encoder"), 0.05, 0.2, warmup_steps=2)
QUADRATIC = Recipe((FIRST, SECOND), weight_decay=0.1, clip_norm=3.0, ema_decay=0.8)
"""Two phases: the first trains the encoder, the second the decoder too; hpda stays."""


def train_quadratic(out: Path, recipe: Recipe = QUADRATIC, **options):
    """A run of the quadratic problem; the configuration is not used."""
    return loop.train(NARROW, recipe, out, params=start_params(), **options)


SIZE = ((64, 64),)
NARROW_DEPTH = DepthLoss(capacity=1 << 10)
STREAM_PHASE = Phase(
    "stream",
    2,
    ViewSamples(2, SIZE, num_targets=1),
    RenderingLoss(depth=NARROW_DEPTH, max_pairs=1 << 15),
    (*MATCHER, *AFTER_MATCHER),
    5e-4,
    warmup_steps=2,
)
