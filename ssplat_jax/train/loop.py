"""The training loop: draws samples ahead, steps, logs JSON lines, saves, resumes, stops cleanly on a signal."""

import dataclasses
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp

from ssplat_jax.checkpoint.training_state import TrainingCheckpoints
from ssplat_jax.config import StreamConfig
from ssplat_jax.metrics.lpips import LpipsWeights
from ssplat_jax.storage.folder_lock import only_writer
from ssplat_jax.storage.interrupts import Interrupts
from ssplat_jax.storage.json_files import json_text
from ssplat_jax.streaming.streamsplat import StreamSplat
from ssplat_jax.train.recipe import Recipe, training_config
from ssplat_jax.train.samples import prefetched, sample_for_step
from ssplat_jax.train.step import Trainer, TrainState, init_state, learning_rate

LOG_FILE = "log.jsonl"


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """Where a run stands when `train` returns."""

    state: TrainState
    step: int
    interrupted: int | None  # the signal that stopped it, if one did


def train(
    config: StreamConfig,
    recipe: Recipe,
    out: Path,
    *,
    params: dict | None = None,
    lpips_weights: LpipsWeights | None = None,
    save_every: int = 200,
    log_every: int = 10,
    report: Callable[[dict], None] = lambda record: None,
    warn: Callable[[str], None] = warnings.warn,
) -> TrainResult:
    """Trains until the recipe is done, continuing from what `out` holds.

    Args:
        config: of the model; its cache is replaced by the recipe's.
        recipe: phases and optimizer.
        out: directory of `log.jsonl`, `recipe.json` and `checkpoints/`.
        params: start from these instead of from the recipe's seed (ignored on resume).
        lpips_weights: with them the rendering loss is the paper's, MSE + 0.05 LPIPS.
        save_every: steps between checkpoints; SIGINT and SIGTERM save too.
        log_every: steps between records (means over the steps between).
        report: called with every record.
        warn: called with what a user should know, a damaged checkpoint.

    Raises:
        InputError: `out` holds a run of another recipe or configuration, or another process is training into it.
        StorageError: a checkpoint cannot be written or read.
    """
    with only_writer(out):
        return _train(config, recipe, out, params, lpips_weights, save_every, log_every, report, warn)


def _train(config, recipe, out, params, lpips_weights, save_every, log_every, report, warn) -> TrainResult:
    model = StreamSplat(training_config(config, recipe))
    description: dict = {"config": model.config.to_dict(), "recipe": dataclasses.asdict(recipe)}
    if lpips_weights is not None:
        description["rendering_loss"] = "MSE + 0.05 LPIPS"
    checkpoints = TrainingCheckpoints(out, description)
    state, start = init_state(model, recipe, params), 0
    if (restored := checkpoints.restore_latest(state, warn)) is not None:
        start, state = restored
    trainer = Trainer(model, recipe)
    interrupts = Interrupts()
    window: list[dict] = []
    waited, since, step, stopped = 0.0, time.perf_counter(), start, None
    samples = prefetched(lambda i: sample_for_step(i, recipe, model.config), iter(range(start, recipe.num_steps)))
    with interrupts:
        try:
            before = time.perf_counter()
            for i, sample in samples:
                waited += time.perf_counter() - before
                rate = jnp.asarray(learning_rate(recipe, i), jnp.float32)
                form = recipe.phase_at(i)[0].form
                state, metrics = trainer.step(state, sample, rate, form=form, lpips_weights=lpips_weights)
                window.append(metrics)
                step = i + 1
                if step % log_every == 0 or step == recipe.num_steps:
                    jax.block_until_ready(metrics)  # steps are dispatched, not done
                    record = _record(step, recipe, window, state, waited, time.perf_counter() - since)
                    _append(out / LOG_FILE, record)
                    report(record)
                    window, waited, since = [], 0.0, time.perf_counter()
                stopped = interrupts.received  # read once: a signal may come at any time
                if step % save_every == 0 or step == recipe.num_steps or stopped:
                    checkpoints.save(step, state)
                if stopped:
                    break
                before = time.perf_counter()
        finally:
            samples.close()
            checkpoints.close()
    return TrainResult(state=state, step=step, interrupted=stopped if step < recipe.num_steps else None)


def _record(step, recipe, window, state, waited, elapsed) -> dict:
    """One line of the log: means of the window's metrics and where the time went."""
    phase, _ = recipe.phase_at(step - 1)
    means: dict = {}
    for name in window[-1]:
        values = [float(m[name]) for m in window if name in m]
        means[name] = round(sum(values) / len(values), 5)
    return {
        "step": step,
        "phase": phase.name,
        **means,
        "skipped": int(state.num_skipped),
        "seconds_per_step": round(elapsed / len(window), 4),
        "data_share": round(waited / elapsed, 4),
    }


def _append(path: Path, record: dict) -> None:
    with path.open("a") as file:
        file.write(json_text(record, indent=None) + "\n")
