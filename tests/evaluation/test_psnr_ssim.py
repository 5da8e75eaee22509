"""PSNR and SSIM against their definitions in float64."""

import json

import numpy as np
import pytest

from ssplat_jax.core.errors import InputError
from ssplat_jax.evaluation.metrics import SSIM_ARGUMENTS, psnr, ssim

ROUNDING = 1e-9  # float64 sums in another order
SSIM_SIGMA = 1.5


def image(seed: int, height: int = 24, width: int = 31) -> np.ndarray:
    """Blocky noise in [0, 1], with structure at the scale of the window."""
    coarse = np.random.default_rng(seed).uniform(size=(height // 4 + 2, width // 4 + 2, 3))
    return np.repeat(np.repeat(coarse, 4, axis=0), 4, axis=1)[:height, :width].astype(np.float32)


def ssim_by_definition(a: np.ndarray, b: np.ndarray) -> float:
    """SSIM window by window: Gaussian weights, sample covariances, windows inside the image."""
    side = SSIM_ARGUMENTS["win_size"]
    taps = np.exp(-0.5 * ((np.arange(side) - side // 2) / SSIM_SIGMA) ** 2)
    weights = np.outer(taps, taps) / np.outer(taps, taps).sum()
    unbias = side**2 / (side**2 - 1)
    c1, c2 = 0.01**2, 0.03**2
    values = []
    for row in range(a.shape[0] - side + 1):
        for column in range(a.shape[1] - side + 1):
            x, y = (z[row : row + side, column : column + side].astype(np.float64) for z in (a, b))
            mx, my = (np.einsum("ij,ijc->c", weights, z) for z in (x, y))
            vx, vy, vxy = (
                unbias * (np.einsum("ij,ijc->c", weights, p * q) - mp * mq)
                for p, q, mp, mq in ((x, x, mx, mx), (y, y, my, my), (x, y, mx, my))
            )
            values.append((2 * mx * my + c1) * (2 * vxy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2)))
    return float(np.mean(values))


def test_psnr_of_a_constant_error_is_its_logarithm():
    dark = np.full((5, 7, 3), 0.25)
    assert psnr(dark, dark + 0.1) == pytest.approx(20.0, abs=ROUNDING)
    assert psnr(dark, dark + 0.01) == pytest.approx(40.0, abs=ROUNDING)


def test_equal_images_score_100_db_and_one():
    a = image(0)
    assert psnr(a, a) == 100.0 and ssim(a, a) == pytest.approx(1.0, abs=ROUNDING)
    assert json.loads(json.dumps(psnr(a, a), allow_nan=False)) == 100.0


def test_ssim_is_the_published_definition():
    a, b = image(1), image(2)
    for other in (b, np.clip(a + 0.1, 0, 1), 0.5 * a + 0.5 * b):
        assert ssim(a, other) == pytest.approx(ssim_by_definition(a, other), abs=1e-6)


@pytest.mark.parametrize("score", [psnr, ssim])
def test_values_outside_the_range_count_as_its_ends_and_nan_gives_nan(score):
    a, b = image(3), image(4)
    beyond = np.where(b > 0.5, b + 3.0, b - 0.5)
    assert np.isnan(score(a, np.where(np.arange(31)[:, None] == 4, np.nan, b)))
    assert score(a, beyond) == pytest.approx(score(a, (b > 0.5).astype(np.float32)), abs=ROUNDING)


@pytest.mark.parametrize("score", [psnr, ssim])
def test_bytes_are_shares_of_255_and_images_of_another_unit_are_refused(score):
    a, b = image(3), image(4)
    bytes_a, bytes_b = (np.round(255 * x).astype(np.uint8) for x in (a, b))
    wanted = score(bytes_a / 255.0, bytes_b / 255.0)
    assert score(bytes_a, bytes_b) == score(bytes_a, bytes_b / 255.0) == pytest.approx(wanted, abs=ROUNDING)
    dark = np.where(np.arange(len(a))[:, None, None] < 0.9 * len(a), 0, 255 * a)  # a bright thing before black
    for spoiled in (255 * a, 65535 * a, 2 * a - 1, dark, bytes_a.astype(np.int32), bytes_a.astype(np.uint16)):
        for pair in ((spoiled, b), (a, spoiled), (spoiled, spoiled)):
            with pytest.raises(InputError, match=r"floats in \[0, 1\], or uint8"):
                score(*pair)


def test_the_smallest_image_is_eleven_pixels():
    assert ssim(image(7, 11, 11), image(7, 11, 11)) == pytest.approx(1.0)
    with pytest.raises(InputError, match="11 pixels a side, got 31x10"):
        ssim(image(7, 10, 31), image(7, 10, 31))
    with pytest.raises(InputError, match="at least 1"):
        psnr(np.zeros((0, 4, 3)), np.zeros((0, 4, 3)))
