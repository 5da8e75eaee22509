"""Procedural worlds with exact cameras and depth, for training, the demo and tests. +y points down."""

from ssplat_jax.data.procedural.paths import PATH_KINDS, sample_path
from ssplat_jax.data.procedural.procedural_views import CAPTURES, STEP_RANGE, procedural_capture_arrays, training_sample
from ssplat_jax.data.procedural.raycast import raycast, raycast_depths
from ssplat_jax.data.procedural.scene import Scene, clearance, scale_scene
from ssplat_jax.data.procedural.scenes import SCENE_KINDS, sample_scene
from ssplat_jax.data.procedural.textures import texture_library

__all__ = [
    "CAPTURES",
    "PATH_KINDS",
    "SCENE_KINDS",
    "STEP_RANGE",
    "Scene",
    "clearance",
    "procedural_capture_arrays",
    "raycast",
    "raycast_depths",
    "sample_path",
    "sample_scene",
    "scale_scene",
    "texture_library",
    "training_sample",
]
