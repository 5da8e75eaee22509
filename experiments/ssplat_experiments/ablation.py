"""Ablation of the paper's modules (its Table 3): each is switched off, trained for the same short budget and scored.

    ssplat experiment ablation --captures path/to/captures --out runs/ablation

Every variant starts from the shipped weights, with an untrained CGFI and mixer, and trains all stages after the matcher
for the same steps on the same samples, once per seed; then its decoded cache is scored on unseen views of
`procedural:room` (and of redkitchen, where `--captures` has it). The variants with and without the memory are scored
after more views too. `additions off` has the literal value of every field that the shipped weights can do without.
"""

import dataclasses
import functools
import statistics
import tempfile
from pathlib import Path
from typing import Any

import jax

from ssplat_experiments.additions import additions
from ssplat_experiments.cases import PICTURE, Case, Row
from ssplat_experiments.memory_curve import START_CAPACITY
from ssplat_experiments.scenes import REDKITCHEN, open_redkitchen, open_room
from ssplat_experiments.study import PUBLIC_SCENES, Study, at_scale, run_study, side_by_side
from ssplat_jax.checkpoint.weights import load_params
from ssplat_jax.config import StreamConfig, preset
from ssplat_jax.console import Reporter
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.split import Split
from ssplat_jax.evaluation.peak_memory import peak_memory
from ssplat_jax.evaluation.scoring import score_targets, score_view
from ssplat_jax.model import complete_params
from ssplat_jax.streaming.feed import feed_capture
from ssplat_jax.streaming.session import Session
from ssplat_jax.streaming.streamsplat import StreamSplat
from ssplat_jax.train.loop import train
from ssplat_jax.train.recipe import Phase, PhaseForm, Recipe

FULL = "full"
ALL_PARTS: dict[str, Any] = {"cgfi": True, "mixer_blocks": 2}
"""The stages that `tiny` leaves out; they start untrained."""
VARIANTS: dict[str, dict[str, Any]] = {
    FULL: {},
    "baseline": {"vacc": "append", "hpda": False, "cgfi": False},
    "without VACC": {"vacc": "append"},
    "without HPDA": {"hpda": False},
    "without CGFI": {"cgfi": False},
    "without mixer": {"mixer_blocks": 0},
}
ADDITIONS_OFF = "additions off"
LONG = (FULL, "without VACC")
"""Variants that are scored at every number of views; the others at the first."""


@dataclasses.dataclass(frozen=True)
class Budget:
    """Training of a variant, and what it is scored on."""

    steps: int
    num_chunks: int
    size: tuple[int, int]
    """Training images, height and width."""
    max_pairs: int
    """Tile intersections while training."""
    seeds: tuple[int, ...]
    views: tuple[int, ...]
    """Numbers of streamed views."""
    scored: tuple[int, int]
    """Scored images, width and height."""
    variants: int | None = None
    """Number of variants that are measured; None: all."""

    def recipe(self, seed: int) -> Recipe:
        """The stream phase of the tiny recipe, shorter."""
        form = PhaseForm(frozen=("encoder", "cost_volume"))
        phase = Phase("stream", self.steps, self.num_chunks, 2, (self.size,), learning_rate=3e-4, form=form)
        return Recipe(phases=(phase,), seed=seed, warmup_steps=min(10, self.steps), max_pairs=self.max_pairs)


BUDGETS = {
    "smoke": Budget(1, 1, (32, 48), 1 << 14, (0,), (8,), (64, 48), variants=1),
    "cpu": Budget(20, 2, (64, 96), 1 << 18, (0, 1, 2), (32, 64), (160, 120)),
    "gpu": Budget(1000, 4, (256, 256), 1 << 21, (0, 1, 2), (256, 512), (320, 240)),
}


def run(captures: Path | None, out: Path, scale: str, reporter: Reporter) -> str:
    """Trains and scores every variant for every seed."""
    return run_study(STUDY, captures, out, scale, reporter)


def config_of(variant: str) -> StreamConfig:
    """Configuration of a variant."""
    changes = VARIANTS.get(variant)
    if changes is None:
        changes = {addition.field: addition.literal for addition in additions()}
    return preset("tiny").replace(**ALL_PARTS).replace(**changes, capacity=START_CAPACITY)


def cases(captures: Path | None, scale: str) -> list[Case]:
    """A case for each variant and seed, the seeds outermost: a study that is stopped early has the same for all."""
    budget = at_scale(BUDGETS, scale)
    has_kitchen = captures is not None and (captures / REDKITCHEN).is_dir()
    scenes = ("room", REDKITCHEN) if has_kitchen else ("room",)
    asked = {name: value for name, value in dataclasses.asdict(budget).items() if name not in ("seeds", "variants")}
    return [
        Case(
            name=f"{variant}, seed {seed}",
            config=config_of(variant),
            asked={"seed": seed, "scenes": scenes, **asked},
            measure=functools.partial(measured, variant, seed, budget, scenes, captures),
        )
        for seed in budget.seeds
        for variant in (*VARIANTS, ADDITIONS_OFF)[: budget.variants]
    ]


def measured(variant: str, seed: int, budget: Budget, scenes: tuple[str, ...], captures: Path | None) -> list[Row]:
    """Trains a variant and scores it on every scene."""
    config = config_of(variant)
    with tempfile.TemporaryDirectory() as folder:
        start = complete_params(jax.random.key(seed), config, load_params("tiny"))
        trained = train(config, budget.recipe(seed), Path(folder), params=start)
    if trained.interrupted:
        raise KeyboardInterrupt
    session, rows = Session(StreamSplat(config), trained.state.ema), []
    for scene in scenes:
        for views in budget.views if variant in LONG else budget.views[:1]:
            session.cache = None
            capture, split = _open(scene, views, budget.scored, captures)
            rows.append({"scene": scene, "variant": variant, "views": views, "seed": seed})
            rows[-1] |= scored(session, capture, split)
            if seed != budget.seeds[0]:
                rows[-1].pop(PICTURE)  # one seed is enough to look at
    return rows


@functools.lru_cache(maxsize=4)
def _open(scene: str, views: int, size: tuple[int, int], captures: Path | None) -> tuple[Capture, Split]:
    if scene == "room" or captures is None:
        return open_room(views, size)
    return open_redkitchen(captures, views, size)


def scored(session: Session, capture: Capture, split: Split) -> Row:
    """Scores, memory and a picture of the scene that a session makes of the context."""
    frame = capture.stream_frame(session.model.config, split.context)
    exposures, _ = feed_capture(session, capture, split.context, frame)
    gaussians, middle = session.gaussians(), split.targets[len(split.targets) // 2]
    scores = score_targets(gaussians, capture, split.targets, frame, exposures)
    values = {f"{c}_{m}": scores[c][m] for c in ("shown", "literal") for m in ("psnr", "ssim", "lpips")}
    return {
        **values,
        "peak_memory_bytes": peak_memory(session, capture.camera(middle, frame)).bytes,
        "gaussians": session.cache_facts()["decoded"],
        PICTURE: score_view(gaussians, capture, middle, frame, exposures).color,
    }


def add_differences(rows: list[Row]) -> None:
    """`full minus it`: what the full model with the same seed, scene and views has more, in dB as shown.

    A seed moves all variants alike, so differences vary less than scores.
    """
    keys = ("scene", "views", "seed")
    whole = {tuple(row[key] for key in keys): row["shown_psnr"] for row in rows if row["variant"] == FULL}
    for row in rows:
        full = whole.get(tuple(row[key] for key in keys))
        if row["variant"] != FULL and full is not None:
            row["full_minus_it_db"] = round(full - row["shown_psnr"], 3)


def findings(rows: list[Row]) -> list[str]:
    """Mean and standard deviation over seeds, by scene, variant and views."""
    lines = [
        "| scene | variant | views | shown PSNR dB | full, same seed, minus it | literal PSNR dB | Gaussians |",
        "|---|---|---|---|---|---|---|",
    ]
    for scene, variant, views in dict.fromkeys((row["scene"], row["variant"], row["views"]) for row in rows):
        here = [row for row in rows if (row["scene"], row["variant"], row["views"]) == (scene, variant, views)]
        shown, literal = (spread([row[f"{column}_psnr"] for row in here]) for column in ("shown", "literal"))
        differences = [row["full_minus_it_db"] for row in here if "full_minus_it_db" in row]
        gaussians = round(statistics.mean(row["gaussians"] for row in here))
        difference = spread(differences) if differences else ""
        lines.append(f"| {scene} | {variant} | {views} | {shown} | {difference} | {literal} | {gaussians} |")
    return ["\n".join(lines)]


def spread(values: list[float]) -> str:
    """Mean, standard deviation and number of values."""
    mean = f"{statistics.mean(values):.2f}"
    return f"{mean} ± {statistics.stdev(values):.2f} ({len(values)})" if len(values) > 1 else f"{mean} (one seed)"


def gallery(rows: list[Row]) -> str:
    """The variants side by side, a table for each procedural scene."""
    scenes = dict.fromkeys(row["scene"] for row in rows if row["scene"] in PUBLIC_SCENES)
    tables = [
        side_by_side([row for row in rows if row["scene"] == scene], lambda row: f"{row['variant']}, {row['views']}")
        for scene in scenes
    ]
    return "\n\n".join(tables)


STUDY = Study(
    name="ablation",
    text="""Every variant starts from the shipped weights, with an untrained CGFI and mixer, and trains all stages after
the matcher for the same steps on the same samples, once per seed; scores are of unseen views. `additions off` has the
literal value of every field that the shipped weights can do without. LPIPS needs weights that are not shipped.""",
    cases=cases,
    finish=add_differences,
    findings=findings,
    gallery=gallery,
)
