"""Refinement: a `Change` to the Gaussians of a scene, found by rendering, a loss and optax on the views that show them.

    gaussians, report = refine(gaussians, cameras, images, steps=100)

`refine` is the loop on the host for a finished scene; `refine_step` is one gradient step as a pure function,
`lax.scan`-able. `online_refinement` refines a stream after each chunk.
"""

from ssplat_jax.cache.key_views import KeyViews as KeyViews
from ssplat_jax.refinement.compared_views import RefineConfig as RefineConfig
from ssplat_jax.refinement.online import online_refinement as online_refinement
from ssplat_jax.refinement.refine import Refinement as Refinement
from ssplat_jax.refinement.refine import refine as refine
from ssplat_jax.refinement.refine_step import init_refinement as init_refinement
from ssplat_jax.refinement.refine_step import refine_step as refine_step
