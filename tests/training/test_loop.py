"""The training loop: its optimizer against the formulas in NumPy, and runs that are stopped, killed and resumed."""

import dataclasses
import json
import math
import os
import signal
import time
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.training import loop
from ssplat_jax.training.recipe import AFTER_MATCHER, MATCHER, RECIPES, Recipe
from tests.model.small import finite, random_params
from tests.streaming.narrow_model import NARROW, assert_same_bits
from tests.training import problems

FLOAT32 = 2e-6  # relative rounding of a few dozen operations


def scheduled(phase, place):
    """Learning rate of a step of a phase, by its formula."""
    warmup = phase.warmup_steps - 1
    if place < warmup:
        return phase.learning_rate * (1 + place) / phase.warmup_steps
    cosine = 0.5 * (1 + math.cos(math.pi * (place - warmup) / (phase.steps - warmup)))
    return phase.learning_rate * (phase.final_share + (1 - phase.final_share) * cosine)


def formulas(recipe):
    """Parameters, their average and skipped steps of the quadratic problem: clipping, AdamW and average in float64."""
    x = {name: np.asarray(value, np.float64) for name, value in problems.flat_names(problems.start_params()).items()}
    mean, square, average = ({name: np.zeros(3) for name in x} for _ in range(3))
    steps = [(phase, place) for phase in recipe.phases for place in range(phase.steps)]
    updates, start = 0, SimpleNamespace(seed=recipe.seed, params=problems.start_params())
    for step, (phase, place) in enumerate(steps):
        numbers = np.float64(phase.samples.open(start)(step, place))  # may depend on the first parameters
        learns = {name: name.split("'")[1] in phase.stages for name in x}
        gradients = {name: 2 * phase.loss.weight * (x[name] - numbers) * learns[name] for name in x}
        norm = math.sqrt(sum((gradient**2).sum() for gradient in gradients.values()))
        if math.isfinite(norm):
            updates += 1
            for name, gradient in gradients.items():
                clipped = gradient * min(1.0, (recipe.clip_norm or math.inf) / norm)
                mean[name] = 0.9 * mean[name] + (1 - 0.9) * clipped
                square[name] = recipe.adam_b2 * square[name] + (1 - recipe.adam_b2) * clipped**2
                unbiased = mean[name] / (1 - 0.9**updates)
                root = np.sqrt(square[name] / (1 - recipe.adam_b2**updates))
                rate = scheduled(phase, place) * learns[name]
                x[name] = x[name] - rate * (unbiased / (root + 1e-8) + recipe.weight_decay * x[name])
        average = {name: recipe.ema_decay * average[name] + (1 - recipe.ema_decay) * x[name] for name in x}
    average = {name: value / (1 - recipe.ema_decay ** len(steps)) for name, value in average.items()}
    return x, average, len(steps) - updates


def test_steps_follow_the_formulas(tmp_path):
    """Clipping, AdamW, schedule, stages that learn, average, and a skipped step, through two phases."""
    done = problems.train_quadratic(tmp_path)
    params, average, num_skipped = formulas(problems.QUADRATIC)
    assert int(done.state.optimizer[0].total_notfinite) == num_skipped == 1
    for name, value in problems.flat_names(done.state.params).items():
        np.testing.assert_allclose(value, params[name], rtol=FLOAT32, atol=FLOAT32, err_msg=name)
        np.testing.assert_allclose(problems.flat_names(done.params)[name], average[name], rtol=FLOAT32, atol=FLOAT32)
    assert "hpda" not in done.state.params
    assert_same_bits(done.params["hpda"], problems.start_params()["hpda"])
    records = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [(r["step"], r["phase"], r["skipped"]) for r in records] == [(10, "second", 1), (16, "second", 1)]


class Stop(Exception):
    """Ends a run in its middle."""


def test_an_interrupted_run_ends_as_an_uninterrupted_one(tmp_path):
    whole = problems.train_quadratic(tmp_path / "whole")

    def fail(record):
        if record["step"] == 5:
            raise Stop

    def interrupt(record):
        if record["step"] == 9:
            os.kill(os.getpid(), signal.SIGTERM)

    every = {"save_every": 2, "log_every": 1}
    with pytest.raises(Stop):
        problems.train_quadratic(tmp_path / "parts", report=fail, **every)
    stopped = problems.train_quadratic(tmp_path / "parts", report=interrupt, **every)
    assert (stopped.step, stopped.interrupted) == (9, signal.SIGTERM)
    parts = problems.train_quadratic(tmp_path / "parts", **every)
    assert (parts.step, parts.interrupted) == (16, None)
    assert_same_bits(parts.state, whole.state)
    assert_same_bits(parts.params, whole.params)
    records = [json.loads(line) for line in (tmp_path / "parts" / "log.jsonl").read_text().splitlines()]
    assert [record["step"] for record in records] == list(range(1, 17))
    assert_same_bits(problems.train_quadratic(tmp_path / "parts").params, whole.params)  # a finished run is only read
    other = jax.tree.map(lambda x: x + 1, problems.start_params())
    with pytest.raises(InputError, match="init_weights"):
        loop.train(NARROW, problems.QUADRATIC, tmp_path / "parts", params=other)


@pytest.mark.slow  # compiles a whole step that renders
def test_a_rendering_phase_moves_all_its_stages(tmp_path):
    params = random_params(NARROW)
    done = loop.train(NARROW, Recipe((problems.STREAM_PHASE,)), tmp_path, params=params)
    assert done.step == 2 and finite(done.params)
    for name in filter(params.get, done.state.params):
        assert not jax.tree.all(jax.tree.map(np.array_equal, params[name], done.params[name])), name


def test_recipes_that_the_configuration_or_the_samples_do_not_fit_are_refused(tmp_path):
    untrainable = Recipe((dataclasses.replace(problems.FIRST, stages=("evidence",)),))
    for recipe, words in (
        (untrainable, "wanted a configuration with evidence"),
        (RECIPES["paper"], "captures that share all steps"),
    ):
        with pytest.raises(InputError, match=words):
            problems.train_quadratic(tmp_path / "out", recipe)
    assert not (tmp_path / "out").exists()


def test_the_paper_recipe_takes_steps_of_plain_adamw(tmp_path):
    """100,000 steps at a constant 1e-4: no warm-up, decay, clipping, average; PyTorch's defaults."""
    recipe = RECIPES["paper"]
    (phase,) = recipe.phases
    assert phase.steps == 100_000 and phase.stages == (*MATCHER, *AFTER_MATCHER)
    rate = loop.schedule(recipe, (True,))
    np.testing.assert_allclose([rate(step) for step in (0, 1, 50_000, 99_999)], 1e-4, rtol=1e-6)
    assert (recipe.weight_decay, recipe.adam_b2, recipe.clip_norm, recipe.ema_decay) == (0.01, 0.999, None, 0)
    long = problems.Squares(1e4)  # its gradient is long
    short = dataclasses.replace(phase, steps=9, samples=problems.Numbers(), loss=long)
    recipe = dataclasses.replace(recipe, phases=(short,), captures_alone=False)
    done, (params, _, _) = problems.train_quadratic(tmp_path, recipe), formulas(recipe)
    for name, value in problems.flat_names(done.params).items():
        np.testing.assert_allclose(value, params[name], rtol=FLOAT32, atol=FLOAT32, err_msg=name)
    assert_same_bits(done.params, done.state.params)


def test_processes_draw_samples_of_their_own(tmp_path, monkeypatch):
    alone = problems.train_quadratic(tmp_path / "0").params
    monkeypatch.setattr(jax, "process_index", lambda: 1)
    second, other = problems.train_quadratic(tmp_path / "1").params, dataclasses.replace(problems.QUADRATIC, seed=1)
    monkeypatch.undo()
    assert_same_bits(second, problems.train_quadratic(tmp_path / "2", other).params)
    assert not np.array_equal(alone["decoder"]["w"], second["decoder"]["w"])


def test_prefetch_keeps_order_raises_errors_and_is_two_steps_a_worker_ahead():
    def slow_at_first(i):
        time.sleep(0.05 * (i == 0))
        return i * i

    for workers in (1, 3):
        assert list(loop.prefetched(slow_at_first, range(9), workers)) == [(i, i * i) for i in range(9)]

    def fail(i):
        if i == 2:
            raise ValueError("third")

    with pytest.raises(ValueError, match="third"):
        list(loop.prefetched(fail, range(5)))
    made = []
    steps = loop.prefetched(made.append, range(100), workers=2)
    next(steps)
    time.sleep(0.2)  # time for the threads to go further than they may
    assert len(made) <= 5
    steps.close()
