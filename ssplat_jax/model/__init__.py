"""The model, one stage per file. Stages do not import each other; `types` holds the arrays that they exchange.

`network_of` gives the stages in which networks differ. The stages here are shared by all networks.
"""

from ssplat_jax.model.back_projection import back_project as back_project
from ssplat_jax.model.back_projection import patch_colors as patch_colors
from ssplat_jax.model.cgfi import inject_features as inject_features
from ssplat_jax.model.decoder import decode_tokens as decode_tokens
from ssplat_jax.model.evidence import Evidence as Evidence
from ssplat_jax.model.evidence import apply_evidence as apply_evidence
from ssplat_jax.model.exposure import estimate_exposures as estimate_exposures
from ssplat_jax.model.hpda import anchor_depth as anchor_depth
from ssplat_jax.model.layers import average_pool as average_pool
from ssplat_jax.model.network import network_of as network_of
from ssplat_jax.model.params import complete_params as complete_params
from ssplat_jax.model.params import count_params as count_params
from ssplat_jax.model.params import init_params as init_params
from ssplat_jax.model.types import GRID_STRIDE as GRID_STRIDE
from ssplat_jax.model.types import prepare_views as prepare_views
from ssplat_jax.model.types import repeat_cells as repeat_cells
