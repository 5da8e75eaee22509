"""The SSIM in JAX is scikit-image's, and its gradient that of finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ssplat_experiments import differentiable_ssim

from ssplat_jax.core.errors import InputError
from ssplat_jax.evaluation.psnr_ssim import ssim
from tests.evaluation.test_psnr_ssim import image

SSIM_PARITY = 1e-5  # float32 against float64


def noise(seed: int, height: int, width: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=(height, width, 3)).astype(np.float32)


def flat(value: float, height: int = 24, width: int = 31) -> np.ndarray:
    return np.full((height, width, 3), value, np.float32)


def halves(low: float, high: float) -> np.ndarray:
    """Two flat halves."""
    x = flat(low)
    x[:, 15:] = high
    return x


SSIM_PAIRS = {
    "noise": (noise(10, 24, 31), noise(11, 24, 31)),
    "structure": (image(12), np.clip(image(12) + 0.1 * noise(13, 24, 31), 0, 1)),
    "portrait": (image(14, 41, 13), image(15, 41, 13)),
    "smallest": (noise(16, 11, 11), noise(17, 11, 11)),
    "two grays": (flat(0.9), flat(0.8)),
    "black and white": (flat(0.0), flat(1.0)),
    "halves": (halves(0.05, 0.97), halves(0.06, 0.96)),
    "flat against noise": (flat(0.7), noise(18, 24, 31)),
    "nearly flat": (flat(0.93) + 1e-3 * noise(19, 24, 31), flat(0.93) + 1e-3 * noise(20, 24, 31)),
}


jax_ssim = jax.jit(differentiable_ssim.ssim)
plainly = pytest.mark.usefixtures("compiled_plainly")


@plainly
@pytest.mark.parametrize("pair", SSIM_PAIRS)
def test_ssim_in_jax_is_scikit_images(pair):
    a, b = SSIM_PAIRS[pair]
    assert float(jax_ssim(jnp.asarray(a), jnp.asarray(b))) == pytest.approx(ssim(a, b), abs=SSIM_PARITY)


@plainly
def test_ssim_in_jax_takes_leading_axes():
    a, b = (np.stack([SSIM_PAIRS[name][i] for name in ("noise", "structure", "halves")])[:, None] for i in (0, 1))
    scores = jax_ssim(jnp.asarray(a), jnp.asarray(b))
    assert scores.shape == (3, 1)
    wanted = [ssim(x[0], y[0]) for x, y in zip(a, b, strict=True)]
    np.testing.assert_allclose(scores[:, 0], wanted, atol=SSIM_PARITY)


ssim_gradient = jax.jit(jax.grad(differentiable_ssim.ssim))


@plainly
def test_ssim_gradient_is_finite_and_zero_at_equal_images():
    for name in ("noise", "two grays", "black and white", "halves"):
        a, b = map(jnp.asarray, SSIM_PAIRS[name])
        assert np.isfinite(ssim_gradient(a, b)).all(), name
        np.testing.assert_allclose(ssim_gradient(a, a), 0, atol=1e-7, err_msg=name)


@plainly
def test_ssim_gradient_is_the_finite_difference():
    a, b = (x.astype(np.float64) for x in SSIM_PAIRS["structure"])
    direction = np.random.default_rng(21).normal(size=a.shape)
    step = 1e-5
    inside = 0.02 + 0.96 * a  # the SSIM on the host clips
    slope = (ssim(inside + step * direction, b) - ssim(inside - step * direction, b)) / (2 * step)
    gradient = ssim_gradient(jnp.asarray(inside, jnp.float32), jnp.asarray(b, jnp.float32))
    assert float((np.asarray(gradient, np.float64) * direction).sum()) == pytest.approx(slope, rel=1e-3)


@plainly
def test_ssim_in_jax_does_not_clip():
    # A gradient must bring colors back into the range.
    a, white, beyond = (jnp.asarray(flat(value)) for value in (0.9, 1.0, 1.5))
    assert float(jax_ssim(a, beyond)) < 0.95 < float(jax_ssim(a, white))


def test_ssim_in_jax_refuses_images_smaller_than_the_window():
    small = jnp.zeros((10, 31, 3))
    with pytest.raises(InputError, match="11 pixels a side, got 31x10"):
        differentiable_ssim.ssim(small, small)
