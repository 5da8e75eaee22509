"""`ssplat import-weights`: conversion of ReSplat's weights."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ssplat_jax.commands.options import ConfigChanges, apply_changes
from ssplat_jax.config import preset


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
