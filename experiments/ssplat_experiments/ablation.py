"""Ablation of the model's parts (the paper's Table 3, and the evidence head), each variant trained anew.

    ssplat experiment ablation --captures path/to/captures --out runs/ablation

Every variant starts from the shipped matcher, with all other stages untrained. The stages after the matcher are
trained by rendering, then the evidence head on whole streams, for the same steps on the same samples: the variants of
`REPEATED` with every seed, the others with the first. The decoded cache is scored on unseen views of
`procedural:revisit` (weak textures and revisits) and of the captures of the experiment `captures` that `--captures`
has.
"""

import dataclasses
import functools
import statistics
import tempfile
from pathlib import Path
from typing import Any

import jax

from ssplat_experiments.captures import SETTINGS, is_there
from ssplat_experiments.cases import PICTURE, Case, Row
from ssplat_experiments.study import Study, at_scale, run_study
from ssplat_jax.config import StreamConfig, preset
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import Split, interleaved_split
from ssplat_jax.evaluation.cost import peak_memory
from ssplat_jax.evaluation.metrics import installed_lpips
from ssplat_jax.evaluation.scoring import mean_scores, score_view, score_views
from ssplat_jax.model.network import complete_params
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.session import Session, feed_capture
from ssplat_jax.training.crops import Crops
from ssplat_jax.training.loop import train
from ssplat_jax.training.losses import RenderingLoss
from ssplat_jax.training.recipe import AFTER_MATCHER, EVIDENCE_RECIPE, MATCHER, Phase, Recipe
from ssplat_jax.training.samples import CaptureMix, ViewSamples, open_mix

REVISIT = "revisit"  # name of the procedural scene that is scored

LEARNED = ("hololens", "plush")
"""Names of real captures that the evidence head learns from, where they are there: those of the shipped weights."""

COLUMNS = ("shown", "literal")  # the two ways to score a view


@dataclasses.dataclass(frozen=True)
class Variant:
    """Changes that make a variant of the full model."""

    changes: dict[str, Any] = dataclasses.field(default_factory=dict)  # changes of the full configuration
    untrained: tuple[str, ...] = ()  # stages after the matcher that stay at their start


FULL = "full"  # the variant with all stages
ALL_PARTS: dict[str, Any] = {"hpda": True, "cgfi": True, "mixer_blocks": 2}  # the stages that `tiny` leaves out
VARIANTS = {
    FULL: Variant(),
    "without HPDA": Variant({"hpda": False}),
    "without CGFI": Variant({"cgfi": False}),
    "append": Variant({"vacc": "append"}),
    "baseline": Variant({"vacc": "append", "hpda": False, "cgfi": False}),
    "without mixer": Variant({"mixer_blocks": 0}),
    "untrained tokens": Variant(untrained=("tokens",)),
    "constant head": Variant({"evidence": False}, untrained=("decoder",)),
}
REPEATED = (FULL, "without HPDA", "without CGFI")
"""The variants that are trained with every seed; the others with the first."""


@dataclasses.dataclass(frozen=True)
class Budget:
    """Training of a variant, and what it is scored on."""

    steps: int  # steps that render the tokens of a few chunks
    num_chunks: int
    size: tuple[int, int]  # training images of these steps, height and width
    max_pairs: int  # tile intersections of these steps
    evidence: Recipe  # training of the evidence head; its seed is that of the variant
    seeds: tuple[int, ...] = (0, 1, 2)
    views: int = 64  # number of streamed views of procedural scenes
    scored: tuple[int, int] = (320, 240)
    """Scored images of procedural scenes, width and height; those of captures are as in `captures`."""
    trainings: int | None = None  # number of trainings that are made; None: all

    def recipe(self, seed: int, untrained: tuple[str, ...]) -> Recipe:
        """The stream phase of the recipe `stream`, shorter."""
        phase = Phase(
            "stream",
            self.steps,
            ViewSamples(self.num_chunks, (self.size,), num_targets=2),
            RenderingLoss(max_pairs=self.max_pairs),
            tuple(stage for stage in AFTER_MATCHER if stage not in untrained),
            learning_rate=3e-4,
            warmup_steps=10,
        )
        return Recipe(phases=(phase,), seed=seed)


def evidence_recipe(steps: int, crops: Crops) -> Recipe:
    """The recipe `evidence` with other steps and samples."""
    phase = dataclasses.replace(EVIDENCE_RECIPE.phases[0], steps=steps, samples=crops)
    return dataclasses.replace(EVIDENCE_RECIPE, phases=(phase,))


LEARNED_SCENES = (*Crops().procedural, "procedural:revisit?frames=73&seed=3")
"""Procedural scenes that the evidence head learns from; the seed of `revisit` is none of those that are scored."""

BUDGETS = {
    "smoke": Budget(
        steps=1,
        num_chunks=1,
        size=(32, 48),
        max_pairs=1 << 14,
        evidence=evidence_recipe(
            1, Crops(procedural=("procedural:revisit?frames=9&seed=3",), width=64, size=(32, 32), batch=1)
        ),
        seeds=(0,),
        views=8,
        scored=(64, 48),
        trainings=1,
    ),
    "cpu": Budget(
        steps=40,
        num_chunks=2,
        size=(64, 96),
        max_pairs=1 << 18,
        evidence=evidence_recipe(100, Crops(procedural=LEARNED_SCENES, strides=(2,))),
    ),
    "gpu": Budget(
        steps=1000,
        num_chunks=4,
        size=(256, 256),
        max_pairs=1 << 21,
        evidence=evidence_recipe(600, Crops(procedural=LEARNED_SCENES)),
    ),
}


def config_of(variant: str) -> StreamConfig:
    """Configuration of a variant."""
    return preset("tiny").replace(**ALL_PARTS).replace(**VARIANTS[variant].changes)


def cases(captures: Path | None, scale: str) -> list[Case]:
    """A case for each variant and seed: first those of `REPEATED`, seed by seed, so that they can be compared early."""
    budget, captures = at_scale(BUDGETS, scale), None if scale == "smoke" else captures
    scenes = scenes_of(captures)
    asked = {name: value for name, value in dataclasses.asdict(budget).items() if name not in ("seeds", "trainings")}
    asked["scenes"] = scenes
    return [
        Case(
            name=f"{variant}, seed {seed}",
            config=config_of(variant),
            asked={"seed": seed, "learned": learned_from(captures), "untrained": VARIANTS[variant].untrained, **asked},
            measure=functools.partial(measured, variant, seed, budget, scenes, captures),
        )
        for variant, seed in trainings(budget)
    ]


def trainings(budget: Budget) -> list[tuple[str, int]]:
    """Variants and seeds in the order in which they are trained."""
    repeated = [(variant, seed) for seed in budget.seeds for variant in REPEATED]
    once = [(variant, budget.seeds[0]) for variant in VARIANTS if variant not in REPEATED]
    return [*repeated, *once][: budget.trainings]


def learned_from(captures: Path | None) -> list[str]:
    """Names of the captures that the evidence head learns from."""
    return [name for name in LEARNED if captures is not None and (captures / name).is_dir()]


def scenes_of(captures: Path | None) -> list[str]:
    """Names of the scored scenes."""
    there = [row for row in SETTINGS if captures is not None and is_there(captures, row[0])]
    return [REVISIT, *(f"{name}, stride {stride}" for name, stride, *_ in there)]


def measured(variant: str, seed: int, budget: Budget, scenes: list[str], captures: Path | None) -> list[Row]:
    """Trains a variant and scores it on every scene."""
    config = config_of(variant)
    model, params = StreamSplat(config), trained(variant, config, seed, budget, captures)
    session, rows = Session(model, params), []
    for scene in scenes:
        session.cache = None
        rows.append({"scene": scene, "variant": variant, "seed": seed})
        rows[-1] |= scored(session, *open_scene(scene, seed, budget, captures))
        if seed != budget.seeds[0]:
            rows[-1].pop(PICTURE)  # one seed is enough to look at
    return rows


def trained(variant: str, config: StreamConfig, seed: int, budget: Budget, captures: Path | None) -> dict:
    """Parameters of a variant after its training; one without an evidence head trains none."""
    shipped = load_params("tiny")
    start = complete_params(
        jax.random.key(seed), config, {stage: shipped[stage] for stage in MATCHER if stage in shipped}
    )
    params = trained_by(config, budget.recipe(seed, VARIANTS[variant].untrained), start)
    if params.get("evidence"):
        learned = [] if captures is None else [captures / name for name in learned_from(captures)]
        mix = open_mix(learned, (), config) if learned else None
        params = trained_by(config, dataclasses.replace(budget.evidence, seed=seed), params, mix)
    return params


def trained_by(config: StreamConfig, recipe: Recipe, params: dict, mix: CaptureMix | None = None) -> dict:
    """Parameters after a training.

    Raises:
        KeyboardInterrupt: a signal stopped it.
    """
    with tempfile.TemporaryDirectory() as folder:
        lpips = installed_lpips() if recipe.uses_lpips else None
        done = train(config, recipe, Path(folder), params=params, mix=mix, lpips_weights=lpips)
    if done.interrupted:
        raise KeyboardInterrupt
    return done.params


@functools.lru_cache(maxsize=8)
def open_scene(scene: str, seed: int, budget: Budget, captures: Path | None) -> tuple[Capture, Split]:
    """A scene and its split. `procedural:revisit` has the seed of the training: each seed scores another one."""
    if scene == REVISIT:
        frames = interleaved_split(10_000, 1, budget.views).context[-1] + 1
        capture = open_capture(f"procedural:revisit?frames={frames}&seed={seed}", size=budget.scored)
        return capture, interleaved_split(len(capture), 1, budget.views)
    assert captures is not None
    name, stride, views, size = next(row for row in SETTINGS if scene == f"{row[0]}, stride {row[1]}")
    capture = open_capture(captures / name, size=size)
    return capture, interleaved_split(len(capture), stride, views)


def scored(session: Session, capture: Capture, split: Split) -> Row:
    """Scores, memory and a picture of the scene that a session makes of the context."""
    stream_frame = capture.stream_frame(session.model.config, split.context)
    exposures, _ = feed_capture(session, capture, split.context, stream_frame)
    gaussians, middle = session.gaussians(), split.targets[len(split.targets) // 2]
    views = score_views(gaussians, capture, split.targets, stream_frame, exposures, installed_lpips())
    scores = mean_scores(views)
    values = {f"{c}_{m}": scores[c][m] for c in COLUMNS for m in ("psnr", "ssim", "lpips")}
    return {
        **values,
        "peak_memory_bytes": peak_memory(session, capture.camera(middle, stream_frame))["peak_memory_bytes"],
        "gaussians": session.cache_facts()["decoded"],
        PICTURE: score_view(gaussians, capture, middle, stream_frame, exposures).color,
    }


def add_differences(rows: list[Row]) -> None:
    """Adds the PSNR that the full model with the same seed and scene has more, in dB, as shown and literal.

    A seed moves all variants alike, so differences vary less than scores.
    """
    full = {(row["scene"], row["seed"]): row for row in rows if row["variant"] == FULL}
    for row in rows:
        if row["variant"] != FULL and (whole := full.get((row["scene"], row["seed"]))):
            for column in COLUMNS:
                row[f"full_minus_it_{column}_db"] = round(whole[f"{column}_psnr"] - row[f"{column}_psnr"], 3)


def findings(rows: list[Row]) -> list[str]:
    """Mean and standard deviation over seeds, by scene and variant."""
    difference = "full, same seed, minus it"
    heads = ["scene", "variant", "shown PSNR dB", difference, "literal PSNR dB", difference, "LPIPS", "Gaussians"]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for scene, variant in dict.fromkeys((row["scene"], row["variant"]) for row in rows):
        here = [row for row in rows if (row["scene"], row["variant"]) == (scene, variant)]
        cells = [scene, variant]
        for column in COLUMNS:
            differences = [row[f"full_minus_it_{column}_db"] for row in here if f"full_minus_it_{column}_db" in row]
            cells += [spread([row[f"{column}_psnr"] for row in here]), spread(differences) if differences else ""]
        lpips = [value for row in here if (value := row.get("literal_lpips")) is not None]
        cells.append(f"{statistics.mean(lpips):.3f}" if lpips else "")
        cells.append(str(round(statistics.mean(row["gaussians"] for row in here))))
        lines.append("| " + " | ".join(cells) + " |")
    return ["\n".join(lines)]


def spread(values: list[float]) -> str:
    """Mean, standard deviation and number of values."""
    mean = f"{statistics.mean(values):.2f}"
    return f"{mean} ± {statistics.stdev(values):.2f} ({len(values)})" if len(values) > 1 else f"{mean} (one seed)"


STUDY = Study(
    name="ablation",
    text="""Every variant starts from the shipped matcher, with all other stages untrained. The stages after it are
trained by rendering, then the evidence head on whole streams, for the same steps on the same samples; `constant head`
has no evidence head to train. Scores are of unseen views; each seed has a `revisit` of its own.""",
    cases=cases,
    finish=add_differences,
    findings=findings,
)

run = functools.partial(run_study, STUDY)
