"""Random VGG16 weights, heads and image pairs, and the results of PyTorch's `lpips` package on them.

Tests draw the same numbers again; only the results are stored, in lpips.json.
To write it again (PyTorch is not a dependency of the project):

    python -m venv lpips_env && lpips_env/bin/pip install torch torchvision lpips
    lpips_env/bin/python tests/evaluation/lpips_fixture.py
"""

import json
from importlib.metadata import version
from pathlib import Path

import numpy as np

RESULTS = Path(__file__).with_name("lpips.json")

# (index in torchvision's `vgg16().features`, channels in, channels out)
CONVOLUTIONS = (
    (0, 3, 64), (2, 64, 64), (5, 64, 128), (7, 128, 128), (10, 128, 256), (12, 256, 256), (14, 256, 256),
    (17, 256, 512), (19, 512, 512), (21, 512, 512), (24, 512, 512), (26, 512, 512), (28, 512, 512),
)  # fmt: skip
HEADS = (64, 128, 256, 512, 512)


def uniform(seed: int, *shape: int) -> np.ndarray:
    """Uniform float32 in [0, 1) from raw bits, which, unlike its distributions, NumPy does not change."""
    bits = np.random.PCG64(seed).random_raw(int(np.prod(shape)))
    return ((bits >> np.uint64(40)).astype(np.float32) / np.float32(1 << 24)).reshape(shape)


def random_vgg() -> dict[str, np.ndarray]:
    """Convolutions under torchvision's names, with He initialization, so that activations keep their size."""
    weights = {}
    for i, channels_in, channels_out in CONVOLUTIONS:
        bound = np.float32(np.sqrt(6 / (9 * channels_in)))
        weights[f"features.{i}.weight"] = bound * (2 * uniform(i, channels_out, channels_in, 3, 3) - 1)
        weights[f"features.{i}.bias"] = 0.2 * uniform(100 + i, channels_out) - np.float32(0.1)
    return weights


def random_heads() -> dict[str, np.ndarray]:
    """The five 1 x 1 convolutions under the package's names; not negative, like the trained ones."""
    return {f"lin{k}.model.1.weight": uniform(200 + k, 1, c, 1, 1) for k, c in enumerate(HEADS)}


def image_pairs() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Pairs `[h w 3]` in [0, 1] by name."""
    near = uniform(302, 37, 53, 3)
    return {
        "noise": (uniform(300, 48, 64, 3), uniform(301, 48, 64, 3)),
        "near, odd sizes": (near, 0.9 * near + 0.1 * uniform(303, 37, 53, 3)),
        "smallest": (uniform(304, 16, 16, 3), uniform(305, 16, 16, 3)),
        "against black, portrait": (np.zeros((47, 33, 3), np.float32), uniform(306, 47, 33, 3)),
        "two grays": (np.full((32, 32, 3), 0.2, np.float32), np.full((32, 32, 3), 0.7, np.float32)),
    }


def package_result(model, a: np.ndarray, b: np.ndarray) -> dict:
    """Total and layers of the `lpips` package, and its gradient at the center pixel of `a`."""
    import torch

    x, y = (torch.from_numpy(z).permute(2, 0, 1)[None].requires_grad_() for z in (a, b))
    total, layers = model(x, y, retPerLayer=True, normalize=True)
    total.sum().backward()
    center = x.grad[0, :, a.shape[0] // 2, a.shape[1] // 2]
    return {"total": total.item(), "layers": [layer.item() for layer in layers], "gradient": center.tolist()}


def main() -> None:
    import lpips
    import torch

    model = lpips.LPIPS(pretrained=False, net="vgg", pnet_rand=True, verbose=False)
    slices = {i: f"net.slice{1 + sum(i >= first for first in (4, 9, 16, 23))}.{i}" for i, _, _ in CONVOLUTIONS}
    renamed = {f"{slices[int(name.split('.')[1])]}.{name.split('.')[2]}": x for name, x in random_vgg().items()}
    held = {name: torch.from_numpy(x) for name, x in (renamed | random_heads()).items()}
    left_out = set(model.load_state_dict(held, strict=False).missing_keys)
    # The package keeps its heads under two names.
    assert all(name.startswith(("lins.", "scaling_layer.")) for name in left_out), left_out
    results = {name: package_result(model, a, b) for name, (a, b) in image_pairs().items()}
    versions = {name: version(name) for name in ("torch", "lpips")}
    RESULTS.write_text(json.dumps({"versions": versions, "pairs": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
