"""LPIPS against PyTorch's `lpips` package on random weights (`lpips_fixture`), and its limits."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.evaluation.lpips import LpipsWeights, load_lpips, lpips, lpips_layers
from tests.evaluation.lpips_fixture import RESULTS, image_pairs, random_heads, random_vgg, uniform

PACKAGE = json.loads(RESULTS.read_text())["pairs"]
PARITY = 1e-5  # relative; both sides are float32
GRADIENT_PARITY = 1e-4  # of the largest component; thirteen layers of float32 each way

pytestmark = pytest.mark.usefixtures("compiled_plainly")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lpips")
    np.savez(folder / "vgg.npz", **random_vgg())
    np.savez(folder / "heads.npz", **random_heads())
    return folder / "vgg.npz", folder / "heads.npz"


@pytest.fixture(scope="module")
def weights(files) -> LpipsWeights:
    return load_lpips(*files)


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


def test_another_networks_file_is_refused(files, tmp_path):
    vgg11 = dict(random_vgg(), **{"features.2.weight": np.zeros((128, 64, 3, 3), np.float32)})
    np.savez(tmp_path / "vgg11.npz", **vgg11)
    with pytest.raises(InputError, match=r"features.2.weight of shape \(64, 64, 3, 3\), got \(128, 64, 3, 3\)"):
        load_lpips(tmp_path / "vgg11.npz", files[1])
