"""What the cache's modules are worth: each switched off, trained for the same short budget, scored alike.

    ssplat experiment ablation --captures path/to/captures --out runs/ablation

Every variant of the paper's table starts from the shipped weights and trains everything behind the matcher for the same
steps on the same samples, once per seed; then the decoded cache is scored on unseen views of `procedural:room` (and of
redkitchen, where `--captures` has it). What stands in `--out` already is not repeated; a stopped experiment goes on.
Writes `table.json` and `table.md`: mean and standard deviation over seeds, and those of the difference from the full
model trained with the same seed, which seeds move less than scores. `--scale smoke` shows in some minutes that every
switch trains.
"""

import dataclasses
import json
import statistics
from pathlib import Path
from typing import Any

from ssplat_jax.checkpoint.weights import load_params
from ssplat_jax.config import preset
from ssplat_jax.console import Reporter
from ssplat_jax.data.capture import open_capture
from ssplat_jax.data.split import interleaved
from ssplat_jax.errors import InputError
from ssplat_jax.evaluation.evaluate import cache_facts, mean_psnr, stream_context
from ssplat_jax.storage.atomic import write_atomic
from ssplat_jax.storage.json_files import write_json
from ssplat_jax.streaming.session import Session
from ssplat_jax.streaming.streamsplat import StreamSplat
from ssplat_jax.train.loop import train
from ssplat_jax.train.recipe import Phase, PhaseForm, Recipe

VARIANTS: dict[str, dict[str, Any]] = {
    "full": {},
    "without HPDA": {"hpda": False},
    "without CGFI": {"cgfi": False},
    "without VACC": {"vacc": "append"},
    "baseline": {"vacc": "append", "hpda": False, "cgfi": False},
}


@dataclasses.dataclass(frozen=True)
class Budget:
    """What a variant is trained and scored with."""

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
    "full": Budget(steps=100, num_chunks=4, size=(96, 128), seeds=(0, 1, 2), context=32, scored=(320, 240)),
}


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Trains and scores every variant for every seed."""
    budget = BUDGETS[scale]
    scenes = _scenes(captures, budget)
    rows, done = [], 0
    with reporter.progress("variants", len(VARIANTS) * len(budget.seeds)) as advance:
        for seed in budget.seeds:  # outermost: stopped early, the variants have had the same seeds
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
    """Scores of one trained variant on every scene; read back if they stand there."""
    scores = place / "scores.json"
    asked = json.loads(json.dumps({"budget": dataclasses.asdict(budget), "changes": changes, "scenes": list(scenes)}))
    if scores.exists():
        held = json.loads(scores.read_text())
        if held["asked"] != asked:
            raise InputError(f"{scores}: was measured with {held['asked']}, wanted {asked}; choose another --out.")
        return held["rows"]
    config = preset("tiny").replace(**changes)
    trained = train(config, budget.recipe(seed), place, params=load_params("tiny"))
    if trained.interrupted:
        raise KeyboardInterrupt
    rows = []
    for scene, (capture, split) in scenes.items():
        session = Session(StreamSplat(config), trained.state.ema)
        frame = capture.stream_frame(config, split.context)
        exposures, _ = stream_context(session, capture, split, frame)
        psnr = round(mean_psnr(session.gaussians(), capture, split.targets, frame, exposures), 3)
        rows.append({"scene": scene, "psnr": psnr, "gaussians": cache_facts(session)["decoded"]})
    write_json(scores, {"asked": asked, "rows": rows})
    return rows


def _scenes(captures: Path | None, budget: Budget) -> dict:
    """Captures at the scored size, each with its split."""
    frames = interleaved(10_000, 1, budget.context).context[-1] + 1
    room = open_capture(f"procedural:room?frames={frames}", size=budget.scored)
    scenes = {"room": (room, interleaved(frames, 1, budget.context))}
    if captures is not None:
        if not (captures / "redkitchen").is_dir():
            raise InputError(f"experiment ablation: wanted redkitchen in --captures, {captures} does not hold it.")
        kitchen = open_capture(captures / "redkitchen", size=budget.scored)
        scenes["redkitchen"] = (kitchen, interleaved(len(kitchen), 5, budget.context))
    return scenes


def table(rows: list[dict[str, Any]]) -> str:
    """Mean and spread over seeds, a row per variant and scene; the differences are taken seed by seed."""
    lines = ["| scene | variant | PSNR dB | full, same seed, minus it | Gaussians |", "|---|---|---|---|---|"]
    for scene in dict.fromkeys(row["scene"] for row in rows):
        for variant in VARIANTS:
            here = [row for row in rows if (row["scene"], row["variant"]) == (scene, variant)]
            if not here:
                continue
            whole = {row["seed"]: row["psnr"] for row in rows if (row["scene"], row["variant"]) == (scene, "full")}
            scores = _spread([row["psnr"] for row in here])
            differences = "" if variant == "full" else _spread([whole[row["seed"]] - row["psnr"] for row in here])
            gaussians = round(statistics.mean(row["gaussians"] for row in here))
            lines.append(f"| {scene} | {variant} | {scores} | {differences} | {gaussians} |")
    return "\n".join(lines) + "\n"


def _spread(values: list[float]) -> str:
    """Mean and standard deviation, and of how many."""
    mean = f"{statistics.mean(values):.2f}"
    return f"{mean} ± {statistics.stdev(values):.2f} ({len(values)})" if len(values) > 1 else f"{mean} (one seed)"
