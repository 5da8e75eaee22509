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

# Public name -> module that defines it.
_MODULES = {
    "CacheError": "core.errors",
    "Camera": "core.cameras",
    "Chunk": "core.chunk",
    "Effects": "rasterizer",
    "Gaussians": "core.gaussians",
    "InputError": "core.errors",
    "RenderOutput": "rasterizer",
    "Session": "streaming.session",
    "StorageError": "core.errors",
    "StreamConfig": "config",
    "StreamFrame": "data.stream_frame",
    "StreamSplat": "model.streamsplat",
    "VoxelCache": "cache.state",
    "adjust_poses": "poses.adjust_poses",
    "check_cache": "cache.state",
    "ensure_capacity": "cache.state",
    "fill_holes": "rasterizer",
    "load_params": "storage.weights",
    "load_ply": "scene_files.formats",
    "load_scene": "scene_files.formats",
    "online_refinement": "refinement",
    "open_capture": "data.open_capture",
    "preset": "config",
    "refine": "refinement",
    "render": "rasterizer",
    "save_ply": "scene_files.formats",
    "save_spz": "scene_files.formats",
}
__version__ = "0.1.0"
__all__ = sorted(_MODULES)


def __getattr__(name: str):
    if name not in _MODULES:
        raise AttributeError(f"module 'ssplat_jax' has no attribute {name!r}")
    module = importlib.import_module(f"ssplat_jax.{_MODULES[name]}")
    globals()[name] = value = getattr(module, name)
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
