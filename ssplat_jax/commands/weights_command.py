"""`ssplat weights`: what is in a weights file, and what share of each stage training changed."""

import dataclasses
from typing import Annotated

import tyro


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
        print(
            f"{self.name}: preset {facts.config.preset!r}, {facts.num_bytes / 1e6:.1f} MB{_training(facts.provenance)}"
        )
        if "imported_from" in trainings(facts.provenance)[0]:
            print("imported weights have no random start to compare with")
            return 0
        print(f"{'stage':<12}{'parameters':>12}{'changed':>10}")
        for stage, share in changed_shares(params, facts).items():
            num_params = sum(leaf.size for leaf in jax.tree.leaves(params[stage]))
            print(f"{stage:<12}{num_params:>12,}{share:>10.3f}")
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
