"""The training loop of all recipes: it draws samples ahead, steps, logs, saves, resumes, and stops on a signal."""

import collections
import dataclasses
import functools
import json
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax

from ssplat_jax.config import StreamConfig
from ssplat_jax.core import num_cores
from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.pytree import pytree
from ssplat_jax.evaluation.metrics import LpipsWeights
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.storage.files import json_text
from ssplat_jax.storage.run_folder import Interrupts, lock_folder
from ssplat_jax.storage.saved_states import TrainingCheckpoints
from ssplat_jax.storage.weights import params_digest
from ssplat_jax.training.recipe import Phase, Recipe, describe
from ssplat_jax.training.samples import CaptureMix, TrainingStart

T = TypeVar("T")

ALWAYS = 2**30
"""Steps in a row that may have a gradient that is not finite: all of them are skipped, and counted in the log."""


@pytree
class TrainState:
    """Parameters that learn, and everything else that a resumed run needs besides its recipe."""

    params: dict  # stages of which a part learns in some phase
    average: optax.EmaState  # moving average of `params`, see `averaged`
    optimizer: tuple  # state of `optimizer`


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """Result of `train`."""

    params: dict  # of all stages; averaged, as they are evaluated and shipped
    state: TrainState
    step: int  # steps done
    interrupted: int | None  # number of the signal that stopped the run, if one did


def optimizer(recipe: Recipe, params: dict) -> optax.GradientTransformationExtraArgs:
    """Clipping by the global norm, and AdamW at the rates of the phases. To try another optimizer, change it here.

    It serves all phases: where a stage is a constant its rate is 0, which moves nothing.
    """
    learns = {stage: tuple(stage in phase.stages for phase in recipe.phases) for stage in params}
    rates = {stage: optax.scale_by_schedule(schedule(recipe, found)) for stage, found in learns.items()}
    adamw = optax.adamw(1.0, b2=recipe.adam_b2, weight_decay=recipe.weight_decay)
    clip = optax.identity() if recipe.clip_norm is None else optax.clip_by_global_norm(recipe.clip_norm)
    direction = optax.apply_if_finite(optax.chain(clip, adamw), ALWAYS)
    return optax.chain(direction, optax.multi_transform(rates, {stage: stage for stage in params}))


def schedule(recipe: Recipe, learns: tuple[bool, ...]) -> optax.Schedule:
    """Learning rate by step of a stage that learns in some phases: each warms up, and decays by a cosine."""
    pieces = []
    for phase, does_learn in zip(recipe.phases, learns, strict=True):
        warmup, peak = min(phase.warmup_steps, phase.steps) - 1, does_learn * phase.learning_rate
        first, last = peak / (warmup + 1), peak * phase.final_share
        pieces.append(optax.warmup_cosine_decay_schedule(first, peak, warmup, phase.steps, last))
    return optax.join_schedules(pieces, np.cumsum([phase.steps for phase in recipe.phases])[:-1].tolist())


def init_state(recipe: Recipe, params: dict) -> TrainState:
    """State before the first step.

    Raises:
        InputError: a phase has nothing to train in `params`.
    """
    for phase in recipe.phases:
        if not any(params.get(stage) for stage in phase.stages):
            wanted = " or ".join(phase.stages)
            raise InputError(f"train: phase {phase.name!r}: wanted a configuration with {wanted}, which it trains.")
    stages = {stage for phase in recipe.phases for stage in phase.stages}
    # A copy: a step donates its state, and the caller keeps its arrays.
    learning = {name: jax.tree.map(jnp.copy, stage) for name, stage in params.items() if name in stages}
    average: Any = optax.ema(recipe.ema_decay).init(learning)
    opt_state: Any = optimizer(recipe, learning).init(learning)
    return TrainState(learning, average, opt_state)


def averaged(recipe: Recipe, state: TrainState) -> dict:
    """The moving average of what learns, in which every step counts `ema_decay` times as much as the next one."""
    if int(np.asarray(state.average.count)) == 0:
        return jax.tree.map(jnp.copy, state.params)
    return optax.tree.bias_correction(state.average.ema, recipe.ema_decay, state.average.count)


@functools.partial(jax.jit, static_argnames=("model", "recipe", "phase"), donate_argnums=0)
def train_step(
    state: TrainState,
    constants: dict,
    batch: Any,
    lpips_weights: LpipsWeights | None,
    *,
    model: StreamSplat,
    recipe: Recipe,
    phase: Phase,
) -> tuple[TrainState, dict]:
    """State after one update by the loss of `phase`, and metrics to log. `state` is donated.

    `constants` are parameters of the stages that learn in no phase.

    Limits:
        A gradient that is not finite moves no parameter and no moment, and is counted.
        Stages that do not learn in `phase` keep their parameters to the bit.
    """

    def loss(params: dict):
        params = {name: p if name in phase.stages else jax.lax.stop_gradient(p) for name, p in params.items()}
        return phase.loss(model, constants | params, batch, lpips_weights)

    gradients, metrics = jax.grad(loss, has_aux=True)(state.params)
    opt_state: Any
    updates, opt_state = optimizer(recipe, state.params).update(gradients, state.optimizer, state.params)
    params: Any = optax.apply_updates(state.params, updates)
    average: Any = optax.ema(recipe.ema_decay).update(params, state.average)[1]
    return TrainState(params, average, opt_state), metrics | {"grad_norm": optax.global_norm(gradients)}


def describe_run(
    config: StreamConfig, recipe: Recipe, init_weights: str, mix: CaptureMix | None, lpips_weights: LpipsWeights | None
) -> dict:
    """Facts that determine the weights of a run, as JSON types; a run with another description is not resumed."""
    return {
        "config": config.to_dict(),
        "recipe": describe(recipe),
        "init_weights": init_weights,
        "captures": None if mix is None else mix.describe(),
        "lpips_weights": None if lpips_weights is None else params_digest(lpips_weights),
    }


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
    log_every: int = 10,
    report: Callable[[dict], None] = lambda record: None,
    say: Callable[[str], None] = lambda message: None,
    warn: Callable[[str], None] = warnings.warn,
) -> TrainResult:
    """Trains until the recipe is done or a signal arrives. A run in `out` is resumed.

    Args:
        config: model configuration.
        recipe: phases and optimizer.
        out: directory of `log.jsonl`, `recipe.json` and `checkpoints/`.
        params: initial parameters; default random ones from the recipe's seed. A run is resumed with the same ones.
        init_weights: name of `params` in the description of the run; default their digest.
        mix: captures to learn from, beside procedural scenes.
        lpips_weights: weights of LPIPS, which rendering losses then include.
        save_every: steps between checkpoints. SIGINT and SIGTERM save one too.
        log_every: steps between log records, which hold means over these steps, and with which `report` is called.
        report, say, warn: called with records, with messages while samples are prepared, and with warnings.

    Raises:
        InputError: `out` holds a run of another recipe, configuration, start or LPIPS weights, or of captures with
            other files, another process trains in it, or configuration or captures do not fit the recipe.
        StorageError: a checkpoint cannot be written or read.
    """
    if recipe.captures_alone and (mix is None or mix.share < 1 - 1e-9):
        raise InputError("train: wanted captures that share all steps, as the recipe asks for; give --captures.")
    for phase in recipe.phases:
        if mix is not None:
            phase.samples.check(mix, config, renders=phase.loss.renders)
    model, name = StreamSplat(config), init_weights or ("random" if params is None else params_digest(params))
    params = model.init(jax.random.key(recipe.seed)) if params is None else params
    state, done, stopped = init_state(recipe, params), 0, None
    constants = {stage: part for stage, part in params.items() if stage not in state.params}
    update = functools.partial(train_step, model=model, recipe=recipe)

    # Processes that train beside each other draw other samples.
    start = TrainingStart(model, params, mix, recipe.seed + jax.process_index(), recipe.num_steps, say)

    with lock_folder(out), Interrupts(has_work=False) as interrupts:
        checkpoints = TrainingCheckpoints(out, describe_run(config, recipe, name, mix, lpips_weights))
        if (restored := checkpoints.restore_latest(state, warn)) is not None:
            done, state = restored
        log = _Log(out / "log.jsonl", report, done)
        for phase, step, batch in batches(recipe, done, start):
            state, metrics = update(state, constants, batch, lpips_weights, phase=phase)
            log.metrics.append(metrics)
            interrupts.has_work, done, is_last = True, step + 1, step + 1 == recipe.num_steps
            if done % log_every == 0 or is_last:
                log.write(done, phase, state)
            stopped = interrupts.received  # read once, since a signal may arrive at any time
            if done % save_every == 0 or is_last or stopped:
                checkpoints.save(done, state)
            if stopped:
                break
    return TrainResult(constants | averaged(recipe, state), state, done, stopped if done < recipe.num_steps else None)


def batches(recipe: Recipe, done: int, start: TrainingStart) -> Iterator[tuple[Phase, int, Any]]:
    """Phase, number and batch of every step after the first `done`."""
    # A GPU leaves the cores free to make samples; without one, a thread makes them beside the steps.
    workers = 1 if jax.default_backend() == "cpu" else max(1, num_cores() // 2)
    first = 0
    for phase in recipe.phases:
        if steps := range(max(done, first), first + phase.steps):
            make = phase.samples.open(start)
            for step, batch in prefetched(lambda i, make=make, first=first: make(i, i - first), steps, workers):
                yield phase, step, batch
        first += phase.steps


def prefetched(produce: Callable[[int], T], steps: Iterable[int], workers: int = 1) -> Iterator[tuple[int, T]]:
    """Yields (step, produce(step)) in order, made in `workers` threads that are at most two steps each ahead."""
    ahead = collections.deque()
    with ThreadPoolExecutor(workers) as pool:
        try:
            for step in (*steps, *[None] * 2 * workers):
                if step is not None:
                    ahead.append((step, pool.submit(produce, step)))
                    if len(ahead) == 1:  # alone, so that the others find in caches what all of them need
                        wait([ahead[0][1]])
                if ahead and (step is None or len(ahead) > 2 * workers):
                    made, future = ahead.popleft()
                    yield made, future.result()
        finally:
            pool.shutdown(cancel_futures=True)


class _Log:
    """Metrics since the last record, and the file that records are appended to.

    Records of steps after the first `done`, which will be taken again, are removed from the file.
    """

    def __init__(self, path: Path, report: Callable[[dict], None], done: int) -> None:
        self._path, self._report = path, report
        lines = path.read_text().splitlines() if path.exists() else []
        # A line that a kill cut short has no end.
        kept = [line for line in lines if line.endswith("}") and json.loads(line)["step"] <= done]
        write_atomic(path, "".join(f"{line}\n" for line in kept).encode())
        self.metrics: list[dict] = []
        self._since = time.perf_counter()

    def write(self, done: int, phase: Phase, state: TrainState) -> None:
        """Appends means of the metrics, and the time of a step, since the last record to the file, and reports them."""
        rows = jax.device_get(self.metrics)  # waits: steps are dispatched asynchronously
        seconds = round((time.perf_counter() - self._since) / len(rows), 4)
        means = {name: round(float(np.mean([row[name] for row in rows if name in row])), 5) for name in rows[-1]}
        skipped = int(state.optimizer[0].total_notfinite)
        record = {"step": done, "phase": phase.name, **means, "skipped": skipped, "seconds_per_step": seconds}
        with self._path.open("a") as file:
            file.write(json_text(record, indent=None) + "\n")
        self._report(record)
        self.metrics, self._since = [], time.perf_counter()
