"""`ssplat weights`: what is in a weights file, and how far training turned each stage."""

import dataclasses
from typing import Annotated

import tyro


@dataclasses.dataclass(frozen=True)
class Weights:
    """Show a weights file: its training, and for each stage how far that turned it from its random start.

    turn is the sine of the angle between a stage's weights and its start: a stage that weight decay alone has changed
    is shorter but not turned.

    Example: ssplat weights tiny
    """

    name: Annotated[str, tyro.conf.Positional]
    """Preset with shipped weights, or a weights file."""

    def run(self) -> int:
        import jax

        from ssplat_jax.storage.weights import describe_weights, load_params, stage_turns, trainings

        params = load_params(self.name)
        facts = describe_weights(self.name)
        print(
            f"{self.name}: preset {facts.config.preset!r}, {facts.num_bytes / 1e6:.1f} MB{_training(facts.provenance)}"
        )
        if "imported_from" in trainings(facts.provenance)[0]:
            print("imported weights have no random start to compare with")
            return 0
        print(f"{'stage':<12}{'parameters':>12}{'turn':>8}")
        for stage, turn in stage_turns(params, facts).items():
            num_params = sum(leaf.size for leaf in jax.tree.leaves(params[stage]))
            print(f"{stage:<12}{num_params:>12,}{turn:>8.3f}")
        return 0


def _training(provenance: dict) -> str:
    """The training in words, as far as the file tells it."""
    words = []
    if "steps" in provenance:
        words.append(f"{provenance['steps']} steps")
    if provenance.get("init_weights"):
        words.append(f"from {provenance['init_weights']}")
    if "imported_from" in provenance:
        words.append(f"imported from {provenance['imported_from']}")
    return ", " + " ".join(words) if words else ""
