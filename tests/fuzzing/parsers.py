"""Every parser of the package with a good file for it, to be damaged."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from PIL import Image

import ssplat_jax as ss
from ssplat_jax.cache import init_cache
from ssplat_jax.data.index_files import read_index
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.scene_files.formats import FORMATS, save_gaussians
from ssplat_jax.storage.delta_files import load_delta, save_delta
from ssplat_jax.storage.npz import _DIGEST_LENGTH, _hex_digest
from ssplat_jax.storage.run_folder import scene_exposure
from ssplat_jax.storage.stream_state import load_state, save_state
from ssplat_jax.storage.torch_files import read_arrays
from ssplat_jax.storage.weights import load_weights, save_weights
from ssplat_jax.streaming.scene_delta import SceneDelta
from tests.badinputs.cases import make_capture
from tests.data.capture_writers import WRITERS
from tests.data.test_reader_refusals import FILES as CAPTURE_FILES
from tests.evaluation.lpips_fixture import FOLDER, small_dict
from tests.scene_files.scene_fixture import scene
from tests.streaming.narrow_model import NARROW


class Parser(NamedTuple):
    write: Callable[[Path], Path]  # writes good files to a folder; returns the one to damage
    read: Callable[[Path], object]  # reads it again
    finish: Callable[[bytes], bytes] = bytes  # applied to the damaged bytes


def sealed(data: bytes) -> bytes:
    """The bytes of an .npz with a checksum that fits, so that damage reaches what is read behind it."""
    body = data[:-_DIGEST_LENGTH]
    return body + _hex_digest(body)


def read_capture(path: Path) -> None:
    """Opens the capture of the folder and decodes everything in it."""
    capture = open_capture(path)
    capture.verify()
    for i in range(len(capture)):
        capture.K(i), capture.depth(i)


def above(num_folders: int) -> Callable[[Path], None]:
    """Reads the capture so many folders above a file."""
    return lambda path: read_capture(path.parents[num_folders])


def with_images(name: str) -> Callable[[Path], Path]:
    def write(root: Path) -> Path:
        def change(folder, meta):
            with Image.open(folder / "images" / "2.jpg") as image:
                image.save(folder / "images" / "2.png")
                image.save(folder / "images" / "2.webp")
            Image.new("I;16", (64, 48), 900).save(folder / "d.png")
            meta["frames"][2] |= {"depth_file_path": "d.png"} | (
                {"file_path": name} if name.startswith("images") else {}
            )

        return make_capture(root / "capture", change) / name

    return write


def with_format(kind: str, file: str) -> Callable[[Path], Path]:
    def write(root: Path) -> Path:
        WRITERS[kind](root)
        return root / file

    return write


def write_scene(suffix: str) -> Callable[[Path], Path]:
    def write(root: Path) -> Path:
        save_gaussians(root / f"a{suffix}", scene(0 if suffix == ".splat" else 1, n=12))
        return root / f"a{suffix}"

    return write


def write_state(root: Path) -> Path:
    save_state(root / "state.npz", init_cache(NARROW.replace(capacity=128)), {"done": 4})
    return root / "state.npz"


def write_delta(root: Path) -> Path:
    confidences = np.full(12, 0.5, np.float32)
    save_delta(root / "000004.npz", SceneDelta(np.arange(12, dtype=np.int32), scene(0, n=12), 128, confidences))
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


def copy(name: str) -> Callable[[Path], Path]:
    return lambda root: Path(shutil.copy(FOLDER / name, root / name))


INDEX = {"room": {"context": [0, 2, 4], "target": [1, 3]}, "hall": None}
SHAPES = {name: x.shape for name, (x, _) in small_dict().items()}
IMAGES = ("transforms.json", "images/2.jpg", "images/2.png", "images/2.webp", "d.png")

PARSERS = (
    {name: Parser(with_images(name), above(name.count("/"))) for name in IMAGES}
    | {
        f"{kind}: {file}": Parser(with_format(kind, file), above(file.count("/")))
        for kind, files in CAPTURE_FILES.items()
        for file in files
    }
    | {suffix: Parser(write_scene(suffix), ss.load_scene) for suffix in FORMATS}
    | {
        "stream state": Parser(write_state, load_state),
        "stream state, sealed": Parser(write_state, load_state, sealed),
        "delta, sealed": Parser(write_delta, load_delta, sealed),
        "weights, sealed": Parser(write_weights, load_weights, sealed),
        "index": Parser(write_json("index.json", INDEX), read_index),
        "metrics": Parser(
            write_json("metrics.json", {"scene_exposure": [1.0, 0.9, 1.1]}), lambda p: scene_exposure(p.parent)
        ),
        "torch zip": Parser(copy("zip.pth"), lambda path: read_arrays(path, SHAPES)),
        "torch legacy": Parser(copy("legacy.pth"), lambda path: read_arrays(path, SHAPES)),
    }
)
