"""Differentiable rendering of 3D Gaussians in plain JAX."""

from ssplat_jax.render.api import render as render
from ssplat_jax.render.effects import Effects as Effects
from ssplat_jax.render.effects import effects_for as effects_for
from ssplat_jax.render.holes import fill_holes as fill_holes
from ssplat_jax.render.output import RenderOutput as RenderOutput
from ssplat_jax.render.smoothing import filter_3d as filter_3d
