"""Readers of capture formats: each is a `frame_list.Reader`, listed in the order in which they are tried."""

from ssplat_jax.data.readers.colmap import COLMAP
from ssplat_jax.data.readers.datasets import KITTI, LLFF, REALESTATE10K, SCANNET, TUM
from ssplat_jax.data.readers.programs import METASHAPE, POLYCAM, REALITY_CAPTURE, RECORD3D, SPLAT_CAMERAS
from ssplat_jax.data.readers.transforms_json import TRANSFORMS_JSON

CAPTURE_READERS = (
    TRANSFORMS_JSON,
    COLMAP,
    POLYCAM,
    RECORD3D,
    LLFF,
    SCANNET,
    TUM,
    KITTI,
    REALESTATE10K,
    SPLAT_CAMERAS,
    REALITY_CAPTURE,
    METASHAPE,
)
"""All readers; the first that matches reads a capture."""
