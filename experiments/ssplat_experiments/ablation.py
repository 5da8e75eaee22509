"""Ablation of the paper's modules: each is switched off, trained for the same short budget and scored.

    ssplat experiment ablation --captures path/to/captures --out runs/ablation

Every variant of the paper's table starts from the shipped weights and trains all stages after the matcher for the same
steps on the same samples, once per seed; then the decoded cache is scored on unseen views of `procedural:room` (and of
redkitchen, where `--captures` has it). Results in `--out` are not computed again, so that a stopped experiment
continues. Writes `table.json` and `table.md`: mean and standard deviation over seeds, of the scores and of their
difference from the full model with the same seed, which varies less. `--scale smoke` trains every variant for a few
steps.
"""

import dataclasses
import json
import statistics
from pathlib import Path
from typing import Any

from ssplat_experiments.scenes import REDKITCHEN, open_redkitchen, open_room
from ssplat_experiments.study import at_scale
from ssplat_jax.checkpoint.weights import load_params
from ssplat_jax.config import preset
from ssplat_jax.console import Reporter
from ssplat_jax.errors import InputError
from ssplat_jax.evaluation.scoring import score_targets
from ssplat_jax.storage.atomic import write_atomic
from ssplat_jax.storage.json_files import write_json
from ssplat_jax.streaming.feed import feed_capture
from ssplat_jax.streaming.session import Session
from ssplat_jax.streaming.streamsplat import StreamSplat
from ssplat_jax.train.loop import train
from ssplat_jax.train.recipe import Phase, PhaseForm, Recipe

PSNRS = ("shown", "literal")  # columns of the table

VARIANTS: dict[str, dict[str, Any]] = {
    "full": {},
    "without HPDA": {"hpda": False},
    "without CGFI": {"cgfi": False},
    "without VACC": {"vacc": "append"},
    "baseline": {"vacc": "append", "hpda": False, "cgfi": False},
}


@dataclasses.dataclass(frozen=True)
class Budget:
    """Training steps and views of a variant."""

    steps: int
    num_chunks: int
    size: tuple[int, int]  # training images, height and width
    seeds: tuple[int, ...]
    context: int  # views streamed for a score
    scored: tuple[int, int]  # width and height

    def recipe(self, seed: int) -> Recipe:
        """The stream phase of the tiny recipe, shorter."""
        form = PhaseForm(frozen=("encoder", "cost_volume"))
        phase = Phase("stream", self.steps, self.num_chunks, 2, (self.size,), learning_rate=3e-4, form=form)
        return Recipe(phases=(phase,), seed=seed, warmup_steps=min(10, self.steps))


BUDGETS = {
    "smoke": Budget(steps=4, num_chunks=2, size=(64, 64), seeds=(0,), context=8, scored=(64, 64)),
    "cpu": Budget(steps=100, num_chunks=4, size=(96, 128), seeds=(0, 1, 2), context=32, scored=(320, 240)),
}


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Trains and scores every variant for every seed."""
    budget = at_scale(BUDGETS, scale)
    scenes = _scenes(captures, budget)
    rows, done = [], 0
    with reporter.progress("variants", len(VARIANTS) * len(budget.seeds)) as advance:
        for seed in budget.seeds:  # outermost, so that variants have the same seeds if this is stopped early
            for variant, changes in VARIANTS.items():
                place = out / variant.replace(" ", "_") / f"seed{seed}"
                scores = _measure(changes, seed, budget, scenes, place)
                rows += [{"variant": variant, "seed": seed} | score for score in scores]
                write_json(out / "table.json", rows)
                write_atomic(out / "table.md", table(rows).encode())
                done += 1
                advance(done, f"{variant}, seed {seed}")
    return f"wrote {out}/table.json and table.md: {len(VARIANTS)} variants, {len(budget.seeds)} seeds"


def _measure(changes: dict[str, Any], seed: int, budget: Budget, scenes, place: Path) -> list[dict[str, Any]]:
    """Scores of one trained variant on every scene, from the file if they were measured before."""
    measured = place / "scores.json"
    request = {"budget": dataclasses.asdict(budget), "changes": changes, "scenes": list(scenes), "scores": PSNRS}
    asked = json.loads(json.dumps(request))
    if measured.exists():
        held = json.loads(measured.read_text())
        if held["asked"] != asked:
            raise InputError(f"{measured}: was measured with {held['asked']}, wanted {asked}; choose another --out.")
        return held["rows"]
    config = preset("tiny").replace(**changes)
    trained = train(config, budget.recipe(seed), place, params=load_params("tiny"))
    if trained.interrupted:
        raise KeyboardInterrupt
    rows = []
    for scene, (capture, split) in scenes.items():
        session = Session(StreamSplat(config), trained.state.ema)
        frame = capture.stream_frame(config, split.context)
        exposures, _ = feed_capture(session, capture, split.context, frame)
        scores = score_targets(session.gaussians(), capture, split.targets, frame, exposures)
        psnrs = {name: round(scores[name]["psnr"], 3) for name in PSNRS}
        rows.append({"scene": scene, **psnrs, "gaussians": session.cache_facts()["decoded"]})
    write_json(measured, {"asked": asked, "rows": rows})
    return rows


def _scenes(captures: Path | None, budget: Budget) -> dict:
    """Captures at the scored size, each with its split."""
    scenes = {"room": open_room(budget.context, budget.scored)}
    if captures is not None:
        if not (captures / REDKITCHEN).is_dir():
            raise InputError(f"experiment ablation: wanted {REDKITCHEN} in --captures, {captures} does not hold it.")
        scenes[REDKITCHEN] = open_redkitchen(captures, budget.context, budget.scored)
    return scenes


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown table of mean and spread over seeds, a row per variant and scene; differences are taken per seed."""
    lines = [
        "| scene | variant | shown PSNR dB | full, same seed, minus it | literal PSNR dB | Gaussians |",
        "|---|---|---|---|---|---|",
    ]
    for scene in dict.fromkeys(row["scene"] for row in rows):
        for variant in VARIANTS:
            here = [row for row in rows if (row["scene"], row["variant"]) == (scene, variant)]
            if not here:
                continue
            whole = {row["seed"]: row["shown"] for row in rows if (row["scene"], row["variant"]) == (scene, "full")}
            shown, literal = (_spread([row[name] for row in here]) for name in PSNRS)
            differences = "" if variant == "full" else _spread([whole[row["seed"]] - row["shown"] for row in here])
            gaussians = round(statistics.mean(row["gaussians"] for row in here))
            lines.append(f"| {scene} | {variant} | {shown} | {differences} | {literal} | {gaussians} |")
    return "\n".join(lines) + "\n"


def _spread(values: list[float]) -> str:
    """Mean, standard deviation and number of values."""
    mean = f"{statistics.mean(values):.2f}"
    return f"{mean} ± {statistics.stdev(values):.2f} ({len(values)})" if len(values) > 1 else f"{mean} (one seed)"
