"""StreamSplat in JAX: a calibrated image stream becomes a 3D Gaussian scene, chunk by chunk.

    import ssplat_jax as ss
    model, params = ss.StreamSplat(ss.preset("tiny")), ss.load_params("tiny")
    session = ss.Session(model, params)             # holds the cache, grows it, compiles the step
    for chunk in ss.open_capture("path/to/capture").chunks(model.config):
        out = session.feed(chunk)
    gaussians = session.gaussians()                 # in the stream frame

docs/python_api.md has the same loop with pure functions.

Names are imported on first use, so that `ssplat --help` does not load JAX.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ssplat_jax.cache.state import VoxelCache as VoxelCache
    from ssplat_jax.cache.state import check_cache as check_cache
    from ssplat_jax.cache.state import ensure_capacity as ensure_capacity
    from ssplat_jax.config import StreamConfig as StreamConfig
    from ssplat_jax.config import preset as preset
    from ssplat_jax.core.cameras import Camera as Camera
    from ssplat_jax.core.chunk import Chunk as Chunk
    from ssplat_jax.core.errors import CacheError as CacheError
    from ssplat_jax.core.errors import InputError as InputError
    from ssplat_jax.core.errors import StorageError as StorageError
    from ssplat_jax.core.gaussians import Gaussians as Gaussians
    from ssplat_jax.data.open_capture import open_capture as open_capture
    from ssplat_jax.data.stream_frame import StreamFrame as StreamFrame
    from ssplat_jax.model.streamsplat import StreamSplat as StreamSplat
    from ssplat_jax.poses.adjust_poses import adjust_poses as adjust_poses
    from ssplat_jax.rasterizer import Effects as Effects
    from ssplat_jax.rasterizer import RenderOutput as RenderOutput
    from ssplat_jax.rasterizer import effects_for as effects_for
    from ssplat_jax.rasterizer import fill_holes as fill_holes
    from ssplat_jax.rasterizer import render as render
    from ssplat_jax.refinement import online_refinement as online_refinement
    from ssplat_jax.refinement import refine as refine
    from ssplat_jax.scene_files.formats import load_ply as load_ply
    from ssplat_jax.scene_files.formats import load_scene as load_scene
    from ssplat_jax.scene_files.formats import save_ply as save_ply
    from ssplat_jax.scene_files.formats import save_spz as save_spz
    from ssplat_jax.storage.weights import load_params as load_params
    from ssplat_jax.streaming.session import Session as Session

# Modules that define public names.
_MODULES = {
    "cache.state": ("VoxelCache", "check_cache", "ensure_capacity"),
    "config": ("StreamConfig", "preset"),
    "core.cameras": ("Camera",),
    "core.chunk": ("Chunk",),
    "core.errors": ("CacheError", "InputError", "StorageError"),
    "core.gaussians": ("Gaussians",),
    "data.open_capture": ("open_capture",),
    "data.stream_frame": ("StreamFrame",),
    "model.streamsplat": ("StreamSplat",),
    "poses.adjust_poses": ("adjust_poses",),
    "rasterizer": ("Effects", "RenderOutput", "effects_for", "fill_holes", "render"),
    "refinement": ("online_refinement", "refine"),
    "scene_files.formats": ("load_ply", "load_scene", "save_ply", "save_spz"),
    "storage.weights": ("load_params",),
    "streaming.session": ("Session",),
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names}
__version__ = "0.1.0"
__all__ = sorted(_HOMES)


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module 'ssplat_jax' has no attribute {name!r}")
    module = importlib.import_module(f"ssplat_jax.{_HOMES[name]}")
    globals()[name] = value = getattr(module, name)
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
