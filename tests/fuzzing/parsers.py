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
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import read_index
from ssplat_jax.scene_files.formats import SCENE_READERS, save_gaussians
from ssplat_jax.storage.chunk_records import load_delta, save_delta
from ssplat_jax.storage.files import read_tensors
from ssplat_jax.storage.saved_states import load_state, save_state
from ssplat_jax.storage.weights import load_weights, save_weights
from ssplat_jax.streaming.scene_delta import SceneDelta
from tests.badinputs.cases import depth_map, make_capture
from tests.data.capture_writers import WRITERS
from tests.scene_files.scene_fixture import compressed_ply, scene
from tests.storage.test_files import TENSORS, write_safetensors
from tests.streaming.narrow_model import NARROW


class Parser(NamedTuple):
    write: Callable[[Path], Path]  # writes good files to a folder; returns the one to damage
    read: Callable[[Path], object]  # reads it again


def read_capture(path: Path) -> None:
    """Opens the capture of the folder and decodes everything in it."""
    capture = open_capture(path)
    for i in range(len(capture)):
        capture.K(i), capture.image(i), capture.depth(i)


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


def with_format(kind: str, file: str) -> Callable[[Path], Path]:
    def write(root: Path) -> Path:
        WRITERS[kind](root)
        return root / file

    return write


def write_scene(suffix: str) -> Callable[[Path], Path]:
    def write(root: Path) -> Path:
        if suffix == ".compressed.ply":
            (root / f"a{suffix}").write_bytes(compressed_ply(n=12))
        else:
            save_gaussians(root / f"a{suffix}", scene(1, n=12))
        return root / f"a{suffix}"

    return write


def write_state(root: Path) -> Path:
    save_state(root / "state.npz", init_cache(NARROW.replace(capacity=128)), {"done": 4})
    return root / "state.npz"


def write_delta(root: Path) -> Path:
    save_delta(root / "000004.npz", SceneDelta(np.arange(12, dtype=np.int32), scene(0, n=12), 128))
    return root / "000004.npz"


def write_weights(root: Path) -> Path:
    shapes = jax.eval_shape(ss.StreamSplat(NARROW).init, jax.random.key(0))
    save_weights(root / "w.npz", jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes), NARROW, provenance={})
    return root / "w.npz"


def write_json(name: str, value: object) -> Callable[[Path], Path]:
    def write(root: Path) -> Path:
        (root / name).write_text(json.dumps(value))
        return root / name

    return write


def write_npz(root: Path) -> Path:
    np.savez(root / "a.npz", **TENSORS)
    return root / "a.npz"


def write_tensors(root: Path) -> Path:
    write_safetensors(root / "a.safetensors", TENSORS)
    return root / "a.safetensors"


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
    | {suffix: Parser(write_scene(suffix), ss.load_scene) for suffix in SCENE_READERS}
    | {
        "stream state": Parser(write_state, load_state),
        "delta": Parser(write_delta, load_delta),
        "weights": Parser(write_weights, load_weights),
        "index": Parser(write_json("index.json", INDEX), read_index),
        "npz of tensors": Parser(write_npz, read_tensors),
        "safetensors": Parser(write_tensors, read_tensors),
    }
)
