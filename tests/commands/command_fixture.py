"""The command line in this process, and small captures and weights for it."""

import json

import numpy as np
import pytest
from PIL import Image

from ssplat_jax.commands.main import main
from ssplat_jax.storage.weights import save_weights
from tests.model.small import random_params
from tests.streaming.narrow_model import FEW_GAUSSIANS

SIZE = (64, 48)


def run(*arguments: object) -> int:
    """Exit code of `ssplat` with these arguments. A run is refined only if they ask for it, because that takes long."""
    if "run" in arguments[:1] and not {"--refine", "--quality"} & set(arguments):
        arguments = (*arguments, "--refine", "0")
    with pytest.raises(SystemExit) as stopped:
        main([str(argument) for argument in arguments])
    return int(stopped.value.code or 0)


def make_capture(folder, num_frames=6, size=(32, 24)):
    """A small valid transforms.json capture: a camera sliding along a chequered wall, three pixels a frame."""
    width, height = size
    cells = np.random.default_rng(0).integers(0, 255, (height // 4, width // 4 + num_frames, 3), dtype=np.uint8)
    wall = cells.repeat(4, axis=0).repeat(4, axis=1)
    (folder / "images").mkdir(parents=True)
    frames = []
    for i in range(num_frames):
        Image.fromarray(wall[:, 3 * i : 3 * i + width]).save(folder / "images" / f"{i}.png")
        pose = np.eye(4)
        pose[0, 3] = 0.1 * i
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": pose.tolist()})
    facts = {"w": width, "h": height, "fl_x": float(width), "fl_y": float(width), "cx": width / 2, "cy": height / 2}
    facts["frames"] = frames
    (folder / "transforms.json").write_text(json.dumps(facts))
    return folder


def edit(field, value):
    """A change of a capture: `field` of its file, or of the second frame, becomes `value`."""

    def change(capture):
        facts = json.loads((capture / "transforms.json").read_text())
        target = facts if field in facts else facts["frames"][1]
        target[field] = value
        (capture / "transforms.json").write_text(json.dumps(facts))

    return change


def narrow_options(folder):
    """Options of a command for a small model, whose weights are written to `folder`."""
    path = folder / "narrow.npz"
    if not path.exists():
        save_weights(path, random_params(FEW_GAUSSIANS), FEW_GAUSSIANS, {})
    return ("--weights", str(path), "--quiet")


def read(path):
    return json.loads(path.read_text())
