"""Differentiable rasterization of 3D Gaussians in plain JAX."""

from ssplat_jax.rasterizer.effects import Effects as Effects
from ssplat_jax.rasterizer.effects import filter_3d as filter_3d
from ssplat_jax.rasterizer.needed_effects import effects_for as effects_for
from ssplat_jax.rasterizer.outputs import RenderOutput as RenderOutput
from ssplat_jax.rasterizer.outputs import fill_holes as fill_holes
from ssplat_jax.rasterizer.render import render as render
