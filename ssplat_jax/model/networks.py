"""Which network fills the stages of a step."""

from types import ModuleType

from ssplat_jax.config import StreamConfig
from ssplat_jax.model import compact, resplat


def network_of(config: StreamConfig) -> ModuleType:
    """The stages that `config.network` has of its own, by their common names.

    `encode`, `match`, `refine_depth`, `regress_tokens`, `mix_tokens`, `read_shapes`, and `modules`, their parameters.
    """
    return {"compact": compact, "resplat": resplat}[config.network]
