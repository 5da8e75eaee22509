"""Refinement of a finished scene on the views that it was made from: learned passes, if asked for, then gradient steps.

    gaussians, report = refine(gaussians, cameras, images, steps=100)

`refine` is the loop on the host; `refine_step` is one gradient step as a pure function, `lax.scan`-able.
"""

from ssplat_jax.cache.key_views import KeyViews as KeyViews
from ssplat_jax.refinement.online import online_refinement as online_refinement
from ssplat_jax.refinement.refine import Refinement as Refinement
from ssplat_jax.refinement.refine import refine as refine
from ssplat_jax.refinement.refine_capture import refine_on_capture as refine_on_capture
from ssplat_jax.refinement.refine_config import RefineConfig as RefineConfig
from ssplat_jax.refinement.refine_step import RefineState as RefineState
from ssplat_jax.refinement.refine_step import StepReport as StepReport
from ssplat_jax.refinement.refine_step import current_gaussians as current_gaussians
from ssplat_jax.refinement.refine_step import init_refinement as init_refinement
from ssplat_jax.refinement.refine_step import refine_step as refine_step
from ssplat_jax.refinement.refiner_weights import load_refiner as load_refiner
from ssplat_jax.refinement.usable_views import only_usable as only_usable
