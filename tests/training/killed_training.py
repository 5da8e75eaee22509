"""Script: a short training run of the narrow model, `python -m tests.training.killed_training OUT`.

Prints every finished step, and writes the final state, flattened, to `final.npz`.
"""

import sys
from pathlib import Path

import jax
import numpy as np

from ssplat_jax.training import loop
from ssplat_jax.training.recipe import smoke_recipe
from tests.streaming.narrow_model import NARROW

STEPS = 200


def main(out: Path) -> None:
    result = loop.train(
        NARROW,
        smoke_recipe(STEPS),
        out,
        save_every=10,
        log_every=1,
        report=lambda record: print(record["step"], flush=True),
    )
    leaves = jax.tree_util.tree_flatten_with_path(result.state)[0]
    np.savez(out / "final.npz", **{jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
