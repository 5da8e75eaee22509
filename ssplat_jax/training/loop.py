"""The training loop: draws samples ahead, steps, logs, saves, resumes, and stops cleanly on a signal."""

import dataclasses
import functools
import json
import math
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.cores import num_cores
from ssplat_jax.evaluation.lpips import LpipsWeights
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.storage.files import json_text
from ssplat_jax.storage.interrupts import Interrupts
from ssplat_jax.storage.run_folder import lock_folder
from ssplat_jax.storage.saved_states import TrainingCheckpoints
from ssplat_jax.storage.weights import params_digest
from ssplat_jax.training.capture_samples import CaptureMix
from ssplat_jax.training.recipe import Recipe, training_config
from ssplat_jax.training.samples import prefetched
from ssplat_jax.training.step import Trainer, TrainState, init_state, learning_rate
from ssplat_jax.training.step_samples import batch_for_step
from ssplat_jax.training.validation import Validation

LOG_FILE = "log.jsonl"
"""Name of the log in the output directory: one JSON object per line."""

RANDOM = "random"
"""Name of random initial parameters, which follow from the recipe's seed."""


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """State of a run when `train` returns."""

    state: TrainState
    step: int  # steps done
    interrupted: int | None  # number of the signal that stopped the run, if one did


def train(
    config: StreamConfig,
    recipe: Recipe,
    out: Path,
    *,
    params: dict | None = None,
    init_weights: str | None = None,
    mix: CaptureMix | None = None,
    lpips_weights: LpipsWeights | None = None,
    save_every: int = 200,
    validate_every: int = 200,
    log_every: int = 10,
    report: Callable[[dict], None] = lambda record: None,
    warn: Callable[[str], None] = warnings.warn,
) -> TrainResult:
    """Trains until the recipe is done or a signal arrives. A run in `out` is resumed.

    Args:
        config: model configuration; `training_config` changes cache and exposure.
        recipe: phases, optimizer and loss.
        out: directory of `log.jsonl`, `recipe.json` and `training.npz`.
        params: initial parameters; default random ones from the recipe's seed. A run is resumed with the same ones.
        init_weights: name of `params` in the description of the run; default their digest.
        mix: captures to learn from, beside procedural scenes.
        lpips_weights: weights of LPIPS, which the rendering loss then includes.
        save_every: steps between checkpoints. SIGINT and SIGTERM save one too.
        validate_every: steps between records of the scores of held-out frames of the captures.
        log_every: steps between log records, which hold means over these steps.
        report: called with every log record.
        warn: called with a message for each damaged checkpoint.

    Returns:
        The state after the last step.

    Raises:
        InputError: `out` holds a run of another recipe, configuration, start or LPIPS weights, or of captures with
            other files, or another process is training in it.
        StorageError: a checkpoint cannot be written or read.
    """
    model = StreamSplat(training_config(config, recipe))
    with lock_folder(out):
        init_weights = init_weights or (RANDOM if params is None else params_digest(params))
        description = describe_run(model.config, recipe, init_weights, lpips_weights=lpips_weights, mix=mix)
        checkpoints = TrainingCheckpoints(out, description)
        state, start = init_state(model, recipe, params), 0
        if (restored := checkpoints.restore_latest(state, warn)) is not None:
            start, state = restored
        log = _Log(out / LOG_FILE, recipe, report, start)
        every = _Every(save_every, log_every, validate_every)
        return _run(model, recipe, state, start, mix, lpips_weights, checkpoints, log, every)


@dataclasses.dataclass(frozen=True)
class _Every:
    """Steps between events of the loop."""

    save: int
    log: int
    validate: int


def describe_run(
    config: StreamConfig,
    recipe: Recipe,
    init_weights: str,
    *,
    lpips_weights: LpipsWeights | None = None,
    mix: CaptureMix | None = None,
) -> dict:
    """Facts that determine the weights of a run, as JSON types; a run with another description is not resumed.

    Args:
        config: configuration of the model.
        recipe: the recipe.
        init_weights: name of the initial parameters, `RANDOM` for random ones.
        lpips_weights: weights of LPIPS, if the rendering loss includes it.
        mix: captures to learn from.
    """
    description: dict = {
        "config": config.to_dict(),
        "recipe": dataclasses.asdict(recipe),
        "init_weights": init_weights,
    }
    if lpips_weights is not None:
        description["rendering_loss"] = f"MSE + {recipe.lpips_weight} LPIPS"
        description["lpips_weights"] = params_digest(lpips_weights)
    if mix is not None:
        description["captures"] = mix.describe()
    return description


def _run(model, recipe, state, start, mix, lpips_weights, checkpoints, log, every: _Every) -> TrainResult:
    """Steps from `start` to the end of the recipe or to a signal."""
    trainer, interrupts = Trainer(model, recipe), Interrupts(has_work=False)
    validation = None if mix is None else Validation(model, recipe, mix, lpips_weights)
    step, stopped = start, None
    # A GPU leaves the cores free to make samples; without one, a thread makes them beside the steps.
    workers = 1 if jax.default_backend() == "cpu" else max(1, num_cores() // 2)
    produce = functools.partial(batch_for_step, recipe=recipe, config=model.config, mix=mix)
    samples = prefetched(produce, range(start, recipe.num_steps), workers)
    with interrupts:
        try:
            before = time.perf_counter()
            for i, batch in samples:
                waited = time.perf_counter() - before
                rate = jnp.asarray(learning_rate(recipe, i), jnp.float32)
                phase = recipe.phase_at(i)[0]
                state, metrics = trainer.step(state, batch, rate, form=phase.form, lpips_weights=lpips_weights)
                interrupts.has_work = True
                log.add(metrics, waited)
                step = i + 1
                is_last = step == recipe.num_steps
                if step % every.log == 0 or is_last:
                    jax.block_until_ready(metrics)  # steps are dispatched asynchronously
                    log.write(step, state)
                if validation is not None and (step % every.validate == 0 or is_last):
                    log.write_scores(step, validation.scores(state.ema, phase))
                stopped = interrupts.received  # read once, since a signal may arrive at any time
                if step % every.save == 0 or is_last or stopped:
                    checkpoints.save(step, state)
                if stopped:
                    break
                before = time.perf_counter()
        finally:
            samples.close()
    return TrainResult(state=state, step=step, interrupted=stopped if step < recipe.num_steps else None)


class _Log:
    """Metrics since the last record, and the file that records are appended to.

    Args:
        path: the file. Records of steps after `start`, which will be taken again, are removed.
        recipe: the recipe.
        report: called with every record.
        start: steps that are done.
    """

    def __init__(self, path: Path, recipe: Recipe, report: Callable[[dict], None], start: int) -> None:
        self._path, self._recipe, self._report = path, recipe, report
        if path.exists():
            kept = [line for line in path.read_text().splitlines() if _step_of(line) <= start]
            write_atomic(path, "".join(f"{line}\n" for line in kept).encode())
        self._start()

    def _start(self) -> None:
        self._metrics: list[dict] = []
        self._waited, self._since = 0.0, time.perf_counter()

    def add(self, metrics: dict, waited: float) -> None:
        """Adds the metrics of a step, and the seconds for which it waited for its samples."""
        self._metrics.append(metrics)
        self._waited += waited

    def write(self, step: int, state: TrainState) -> None:
        """Writes and reports a record: means of the metrics and timings since the last one."""
        elapsed = time.perf_counter() - self._since
        means: dict = {}
        for name in self._metrics[-1]:
            values = [float(metrics[name]) for metrics in self._metrics if name in metrics]
            means[name] = round(sum(values) / len(values), 5)
        record = {
            "step": step,
            "phase": self._recipe.phase_at(step - 1)[0].name,
            **means,
            "skipped": int(state.num_skipped),
            "seconds_per_step": round(elapsed / len(self._metrics), 4),
            "data_share": round(self._waited / elapsed, 4),
        }
        self._append(record)
        self._start()

    def write_scores(self, step: int, scores: dict[str, float]) -> None:
        """Writes and reports the scores of held-out frames, if there are any, as a record of their own."""
        if scores:
            rounded = {name: round(value, 4) for name, value in scores.items()}
            self._append({"step": step, "phase": self._recipe.phase_at(step - 1)[0].name, **rounded})
        self._since = time.perf_counter() if not self._metrics else self._since

    def _append(self, record: dict) -> None:
        with self._path.open("a") as file:
            file.write(json_text(record, indent=None) + "\n")
        self._report(record)


def _step_of(line: str) -> float:
    """The step of a record; infinity for a line that a kill cut short."""
    try:
        return float(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError):
        return math.inf
