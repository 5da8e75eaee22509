"""Reference outputs of the authors' PyTorch networks (../shared/parity), and parameters with the same values."""

import math
import zlib
from pathlib import Path

import numpy as np
import pytest

from ssplat_jax.config import StreamConfig
from ssplat_jax.storage.weights import published_tensors

PARITY = Path(__file__).parents[3] / "shared" / "parity"


def load_golden(name: str) -> dict[str, np.ndarray]:
    """Inputs, taps and outputs of one network; the test is skipped if the file is missing."""
    path = PARITY / f"golden_{name}.npz"
    if not path.is_file():
        pytest.skip(f"needs {path.name} in ../shared/parity")
    with np.load(path) as file:
        return dict(file)


def listed_tensors(name: str) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the tensors in a network's checkpoint."""
    path = PARITY / f"{name}_tensors.txt"
    if not path.is_file():
        pytest.skip(f"needs {path.name} in ../shared/parity")
    rows = (line.split("\t") for line in path.read_text().splitlines())
    return {row[0]: tuple(int(n) for n in row[1].strip("()").split(",") if n.strip()) for row in rows}


def named_tensor(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Values with which the reference outputs were computed, drawn from a tensor's name."""
    v = np.random.RandomState(zlib.crc32(name.encode())).standard_normal(shape).astype(np.float32)
    factor = np.float32(1)
    if "output_conv" in name and shape[0] == 1:
        factor = np.float32(0.01)
    if "regressor_residual" in name:
        factor = np.float32(0.05)
    v = v * factor
    if name.endswith(".bias") or "pos_embed" in name or "cls_token" in name:
        return np.float32(0.02) * v
    if len(shape) == 1:
        return np.float32(1) + np.float32(0.1) * v
    return v / np.float32(math.sqrt(math.prod(shape[1:])))


def named_params(config: StreamConfig) -> dict:
    """Parameters with these values, for the stages that upstream has."""
    params: dict = {}
    for path, tensor in published_tensors(config).items():
        if tensor is not None:
            *folders, leaf = path.split("/")
            place = params
            for folder in folders:
                place = place.setdefault(folder, {})
            place[leaf] = tensor.to_parameter(named_tensor(tensor.name, tensor.shape))
    return params


def tap_error(tap: np.ndarray, x: np.ndarray) -> float:
    """Largest error of `x`, in PyTorch's order (NCHW), in standard deviations of a tap.

    A tap holds samples at fixed positions, the mean and the standard deviation.
    """
    values, (mean, std) = tap[:-2], tap[-2:]
    flat = np.asarray(x, np.float64).reshape(-1)
    positions = np.linspace(0, flat.size - 1, min(512, flat.size)).round().astype(int)
    differences = np.abs(flat[positions] - values[: len(positions)]).max()
    return float(max(differences, abs(flat.mean() - mean), abs(flat.std() - std)) / std)
