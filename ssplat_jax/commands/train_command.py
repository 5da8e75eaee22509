"""`ssplat train`: training on procedural scenes and captures."""

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ssplat_jax.commands.options import ConfigChanges, LpipsHeads, QuietOption, apply_changes, load_lpips_weights
from ssplat_jax.config import StreamConfig, preset
from ssplat_jax.core.errors import InputError, require_positive, require_seed

if TYPE_CHECKING:
    from ssplat_jax.core.console import Reporter
    from ssplat_jax.training.recipe import Recipe

MINUTES = {"tiny": 77, "stream": 15, "evidence": 15, "refiner": 30}
"""Rough time of recipes on two free cores; docs/model_card.md has measured times, some of them beside other work."""


@dataclasses.dataclass(frozen=True)
class Train:
    """Train the network on procedural scenes and captures. Saves regularly and on Ctrl-C, and continues.

    Example: ssplat train --out runs/tiny
    """

    out: Path
    """Folder of the log, the checkpoints and, at the end, weights.npz (refiner.npz)."""
    preset: str | None = None
    """Preset of the configuration. Default: the configuration of --init-weights; without that, tiny."""
    recipe: Literal["tiny", "depth", "stream", "evidence", "refiner", "paper"] = "tiny"
    """tiny: trains depth from scratch. depth: continues that in batches of larger images, for a GPU. evidence: trains
    the evidence head of --init-weights on whole streams, in one go. refiner: trains the learned pass of refinement on
    whole streams of --init-weights, in one go. stream: trains the stages after depth. paper: the paper's loss and
    steps, for imported weights or --preset paper, and a GPU."""
    scale_steps: float = 1.0
    """Factor of the number of steps of every phase."""
    seed: int = 0
    """Seed of the initial parameters and of the scenes."""
    init_weights: Path | None = None
    """Start from a weights file instead of from random parameters. Stages that --set adds, such as cgfi=true and
    mixer_blocks=2 to tiny's, start at random."""
    captures: tuple[Path, ...] = ()
    """Captures to learn from too, or folders of captures. Every 8th frame is held out;
    evidence and refiner, which log no scores, hold none out."""
    shares: tuple[float, ...] = ()
    """Share of the steps of each of --captures; the rest is procedural. Default: half of the steps, equally."""
    validate_every: int = 200
    """Steps between scores of held-out frames of --captures, in the log."""
    lpips_vgg: Path | None = None
    """torchvision's vgg16 (.safetensors or .npz): with --lpips-heads, the rendering loss is MSE + 0.05 LPIPS."""
    lpips_heads: LpipsHeads = None
    save_every: int = 200
    """Steps between checkpoints."""
    set: ConfigChanges = ()
    quiet: QuietOption = False

    def run(self) -> int:
        import jax

        from ssplat_jax.core.console import Reporter
        from ssplat_jax.model import complete_params
        from ssplat_jax.storage.weights import check_params, params_digest, save_weights
        from ssplat_jax.training.loop import train
        from ssplat_jax.training.recipe import RECIPES

        require_positive(scale_steps=self.scale_steps, save_every=self.save_every, validate_every=self.validate_every)
        require_seed(self.seed)
        if self.recipe == "evidence":
            return self._run_evidence()
        if self.recipe == "refiner":
            return self._run_refiner()
        reporter, params, name, fresh = Reporter(self.quiet), None, None, []
        config, given, before = self._start(reporter)
        recipe = dataclasses.replace(RECIPES[self.recipe].scaled(self.scale_steps), seed=self.seed)
        if given is not None:
            name = params_digest(given)  # not of the stages that are added, whose last bits depend on the device
            params = complete_params(jax.random.key(self.seed), config, given)
            check_params(params, config, str(self.init_weights))
            if fresh := [stage for stage in params if params[stage] and not given.get(stage)]:
                reporter.say(f"{self.init_weights} has no {', '.join(fresh)}: random at the start")
        recipe, mix = self._opened(config, recipe)
        lpips_weights = load_lpips_weights(self.lpips_vgg, self.lpips_heads)
        if lpips_weights and not recipe.renders:
            raise InputError(f"--lpips-vgg: --recipe {self.recipe} renders nothing to compare; leave it out.")
        duration = ""
        if self.recipe in MINUTES:
            duration = f", about {max(1, round(MINUTES[self.recipe] * self.scale_steps))} minutes on two cores"
        reporter.say(f"{recipe.num_steps} steps{duration}; Ctrl-C saves them, and the same command continues")
        waiting = "compiling; figures come every ten steps"
        with reporter.progress("training", recipe.num_steps, waiting=waiting) as advance:
            result = train(
                config,
                recipe,
                self.out,
                params=params,
                init_weights=name,
                mix=mix,
                lpips_weights=lpips_weights,
                save_every=self.save_every,
                validate_every=self.validate_every,
                report=lambda record: advance(record["step"], _describe_record(record)),
                warn=reporter.warn,
            )
        if result.interrupted:
            print(f"stopped at step {result.step}; the same command continues", file=sys.stderr)
            return 128 + result.interrupted
        provenance = {
            "recipe": dataclasses.asdict(recipe),
            "steps": result.step,
            "init_weights": self.init_weights and self.init_weights.name,
            "captures": {group.name: group.share for group in mix.groups} if mix else {},
            "rendering_loss": _rendering_loss(recipe, lpips_weights is not None),
        }
        if self.init_weights:
            provenance |= {"fresh": fresh, "before": before}
        save_weights(self.out / "weights.npz", result.state.ema, config, provenance)
        return self._end(result.step, reporter)

    def _run_evidence(self) -> int:
        """Trains the evidence head on whole streams. It takes minutes, so it starts anew after an interrupt."""
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.storage.weights import check_params, save_weights
        from ssplat_jax.training.evidence_training import EvidenceRecipe, train_evidence

        init_weights, reporter = self._needed_weights("whose evidence head it trains"), Reporter(self.quiet)
        config, given, before = self._start(reporter)
        assert given is not None
        config = config.replace(evidence=True)  # weights of before the head have it off
        params = _used(given, config)
        check_params(params, config.replace(evidence=False), str(init_weights))  # the head starts anew
        recipe = EvidenceRecipe(seed=self.seed)
        recipe = dataclasses.replace(recipe, steps=max(1, round(recipe.steps * self.scale_steps)))
        trained, facts = self._trained(train_evidence, config, params, recipe, recipe.steps, reporter)
        start = {"init_weights": init_weights.name, "fresh": ["evidence"], "before": before}
        provenance = {"recipe": dataclasses.asdict(recipe), "steps": recipe.steps, **start, **facts}
        save_weights(self.out / "weights.npz", trained, config, provenance)
        return self._end(recipe.steps, reporter)

    def _run_refiner(self) -> int:
        """Trains the network of the learned pass. It takes minutes, so it starts anew after an interrupt."""
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.refinement.refiner_weights import save_refiner
        from ssplat_jax.storage.weights import check_params
        from ssplat_jax.training.refiner_training import RefinerRecipe, train_refiner

        init_weights, reporter = self._needed_weights("whose streams it refines"), Reporter(self.quiet)
        config, params, _ = self._start(reporter)
        assert params is not None
        check_params(params, config, str(init_weights))
        recipe = RefinerRecipe(seed=self.seed)
        recipe = dataclasses.replace(recipe, steps=max(1, round(recipe.steps * self.scale_steps)))
        num_steps = recipe.rounds * recipe.steps
        trained, facts = self._trained(train_refiner, config, params, recipe, num_steps, reporter)
        provenance = {"recipe": dataclasses.asdict(recipe), "init_weights": init_weights.name, **facts}
        save_refiner(self.out / "refiner.npz", trained, provenance)
        print(f"wrote {self.out}/refiner.npz after {num_steps} steps")
        return 0

    def _start(self, reporter: "Reporter") -> tuple[StreamConfig, dict | None, dict]:
        """The configuration, and parameters and provenance of --init-weights; says what of these is replaced."""
        from ssplat_jax.storage.weights import describe_weights, load_weights

        if self.init_weights is None:
            return apply_changes(preset(self.preset or "tiny"), self.set), None, {}
        given, held = load_weights(self.init_weights)
        config = apply_changes(preset(self.preset) if self.preset else held, self.set)
        if self.preset and (changes := _differences(held, config)):
            reporter.say(f"--preset {self.preset} changes the configuration of {self.init_weights}: {changes}")
        if unused := [name for name in given if given[name] and name not in _used(given, config)]:
            reporter.warn(f"{self.init_weights}: leaves out {', '.join(unused)}, which the configuration does not use")
        return config, given, describe_weights(str(self.init_weights)).provenance

    def _trained(self, train, config, params: dict, recipe, num_steps: int, reporter: "Reporter") -> tuple[dict, dict]:
        """Parameters and facts of `train`, a training on whole streams, with the folder locked and steps shown."""
        from ssplat_jax.model.streamsplat import StreamSplat
        from ssplat_jax.storage.run_folder import lock_folder, make_writable

        reporter.say(f"{num_steps} steps, about {MINUTES[self.recipe]} minutes on two cores with two captures")
        make_writable(self.out)
        with (
            lock_folder(self.out),
            reporter.progress("training", num_steps, waiting="streaming the scenes") as advance,
        ):
            return train(
                StreamSplat(config),
                params,
                self.captures,
                recipe,
                on_scene=lambda name: reporter.say(f"streamed {name}"),
                on_step=lambda step, record: advance(step, f"psnr {record['shown_psnr']:.2f}"),
            )

    def _needed_weights(self, why: str) -> Path:
        """--init-weights of a recipe that trains on whole streams; refuses options that it has no use for."""
        unused = {
            "--shares": self.shares,
            "--lpips-vgg": self.lpips_vgg,
            "--lpips-heads": self.lpips_heads,
            "--save-every": self.save_every != Train.save_every,
            "--validate-every": self.validate_every != Train.validate_every,
        }
        if given := [flag for flag, value in unused.items() if value]:
            raise InputError(f"{given[0]}: --recipe {self.recipe} has no use for it; leave it out.")
        if self.init_weights is None:
            raise InputError(f"--recipe {self.recipe}: wanted --init-weights, {why}; got none.")
        return self.init_weights

    def _end(self, num_steps: int, reporter: "Reporter") -> int:
        """Says what was written and what to do next; returns the exit code of success."""
        print(f"wrote {self.out}/weights.npz after {num_steps} steps")
        reporter.say(f"next: `ssplat run CAPTURE --weights {self.out}/weights.npz --out runs/mine` streams with them")
        return 0

    def _opened(self, config, recipe):
        """The recipe and the captures to learn from, None without --captures."""
        from ssplat_jax.training.capture_samples import open_mix

        if not self.captures:
            if self.shares:
                raise InputError("--shares: wanted --captures beside it, which it divides; got none.")
            if self.validate_every != Train.validate_every:
                raise InputError("--validate-every: wanted --captures beside it, which it scores; got none.")
            return recipe, None
        if self.validate_every != Train.validate_every and not recipe.renders:
            raise InputError(f"--validate-every: --recipe {self.recipe} renders nothing to score; leave it out.")
        return dataclasses.replace(recipe, fit_gains=True), open_mix(self.captures, self.shares, config, recipe)


def _differences(held: StreamConfig, config: StreamConfig) -> str:
    """The fields whose values differ, with both; of another network, its kind alone."""
    if held.network.kind != config.network.kind:
        return f"network {held.network.kind} -> {config.network.kind}"
    names = [f"{group}.{field.name}" for group in held.groups() for field in dataclasses.fields(getattr(held, group))]
    pairs = [(name, held.get(name), config.get(name)) for name in names]
    return ", ".join(f"{name} {before} -> {after}" for name, before, after in pairs if before != after)


def _used(params: dict, config: StreamConfig) -> dict:
    """The stages of `params` that a configuration uses."""
    import jax

    from ssplat_jax.model import init_params

    wanted = jax.eval_shape(lambda: init_params(jax.random.key(0), config))
    return {name: stage for name, stage in params.items() if wanted.get(name)}


def _rendering_loss(recipe: "Recipe", has_lpips: bool) -> str | None:
    """Name of the loss of rendered images; None if the recipe renders none."""
    if not recipe.renders:
        return None
    plain = "MSE + image gradients" if recipe.gradient_weight else "MSE"
    return f"MSE + {recipe.lpips_weight:g} LPIPS" if has_lpips else plain


def _describe_record(record: dict) -> str:
    """Numbers of a training record that fit beside a progress bar."""
    shown = {
        "validation_psnr": "held-out psnr",
        "loss": "loss",
        "depth_l1": "depth",
        "psnr": "psnr",
        "accepted": "accepted",
    }
    return "  ".join(f"{label} {record[name]:.3f}" for name, label in shown.items() if name in record)
