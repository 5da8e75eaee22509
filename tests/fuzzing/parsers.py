"""Every parser of the package with a good file for it, to be damaged."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from PIL import Image

import ssplat_jax as ss
from ssplat_jax.cache.state import init_cache
from ssplat_jax.data.split import read_index
from ssplat_jax.scene_files.formats import SCENE_READERS, save_gaussians
from ssplat_jax.storage.chunk_records import load_delta, save_delta
from ssplat_jax.storage.files import read_tensors
from ssplat_jax.storage.saved_states import load_state, save_state
from ssplat_jax.storage.weights import load_weights, save_weights
from ssplat_jax.streaming.scene_delta import SceneDelta
from tests.badinputs.cases import depth_map, make_capture, read_capture
from tests.data.capture_writers import WRITERS
from tests.scene_files.scene_fixture import compressed_ply, scene
from tests.storage.test_files import TENSORS, write_safetensors
from tests.streaming.narrow_model import NARROW


class Parser(NamedTuple):
    write: Callable[[Path], Path]  # writes good files to a folder; returns the one to damage
    read: Callable[[Path], object]  # reads it again


def above(num_folders: int) -> Callable[[Path], None]:
    """Reads the capture so many folders above a file."""
    return lambda path: read_capture(path.parents[num_folders])


def with_images(name: str) -> Callable[[Path], Path]:
    def write(root: Path) -> Path:
        def change(folder, meta):
            with Image.open(folder / "images" / "2.jpg") as image:
                image.save(folder / "images" / "2.png")
                image.save(folder / "images" / "2.webp")
            depth_map(2, 900, **({"file_path": name} if name.startswith("images") else {}))(folder, meta)

        return make_capture(root / "capture", change) / name

    return write


def saved(name: str, save: Callable[[Path], object]) -> Callable[[Path], Path]:
    """Saves one file of that name."""

    def write(root: Path) -> Path:
        save(root / name)
        return root / name

    return write


def with_format(kind: str, file: str) -> Callable[[Path], Path]:
    def write(root: Path) -> Path:
        WRITERS[kind](root)
        return root / file

    return write


def save_scene(file: Path) -> None:
    if file.name.endswith(".compressed.ply"):
        file.write_bytes(compressed_ply(n=12))
    else:
        save_gaussians(file, scene(1, n=12))


def save_empty(file: Path) -> None:
    save_state(file, init_cache(NARROW.replace(capacity=128)), {"done": 4})


def save_change(file: Path) -> None:
    save_delta(file, SceneDelta(np.arange(12, dtype=np.int32), scene(0, n=12), 128))


def save_zeros(file: Path) -> None:
    """Weights that are zero."""
    shapes = jax.eval_shape(ss.StreamSplat(NARROW).init, jax.random.key(0))
    save_weights(file, jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes), NARROW, provenance={})


CAPTURE_FILES = {
    "COLMAP": ("sparse/0/cameras.bin", "sparse/0/images.bin"),
    "COLMAP text": ("sparse/0/cameras.txt", "sparse/0/images.txt"),
    "ScanNet": ("pose/9.txt", "intrinsic/intrinsic_color.txt"),
    "TUM RGB-D": ("rgb.txt", "depth.txt", "groundtruth.txt", "calibration.txt"),
    "RealEstate10K": ("0a1b.txt",),
    "cameras.json": ("cameras.json",),
    "Polycam": ("keyframes/cameras/7000.json",),
    "Record3D": ("metadata.json",),
    "LLFF": ("poses_bounds.npy",),
    "KITTI": ("calib.txt", "poses.txt"),
    "RealityCapture": ("cameras.csv",),
    "Metashape": ("cameras.xml",),
}
INDEX = {"room": {"context": [0, 2, 4], "target": [1, 3]}, "hall": None}
IMAGES = ("transforms.json", "images/2.jpg", "images/2.png", "images/2.webp", "d.png")

PARSERS = (
    {name: Parser(with_images(name), above(name.count("/"))) for name in IMAGES}
    | {
        f"{kind}: {file}": Parser(with_format(kind, file), above(file.count("/")))
        for kind, files in CAPTURE_FILES.items()
        for file in files
    }
    | {suffix: Parser(saved(f"a{suffix}", save_scene), ss.load_scene) for suffix in SCENE_READERS}
    | {
        "stream state": Parser(saved("state.npz", save_empty), load_state),
        "delta": Parser(saved("000004.npz", save_change), load_delta),
        "weights": Parser(saved("w.npz", save_zeros), load_weights),
        "index": Parser(saved("index.json", lambda file: file.write_text(json.dumps(INDEX))), read_index),
        "npz of tensors": Parser(saved("a.npz", lambda file: np.savez(file, **TENSORS)), read_tensors),
        "safetensors": Parser(saved("a.safetensors", lambda file: write_safetensors(file, TENSORS)), read_tensors),
    }
)
