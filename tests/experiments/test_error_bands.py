"""Shares of the error of a view: each kind of error is found where it was put."""

import numpy as np
import pytest
from ssplat_experiments.error_bands import BANDS, error_shares, findings

NAMES = ["finer_than_1", "1_to_2", "2_to_4", "4_to_8", f"coarser_than_{BANDS[-1]}"]


def target(side=96):
    return np.random.default_rng(0).uniform(0.3, 0.6, (side, side, 3)).astype(np.float32)


def waves(wavelength, side=96):
    return 0.05 * np.sin(2 * np.pi * np.arange(side) / wavelength)[None, :, None] * np.ones((side, 1, 3))


FULL = np.ones((96, 96), np.float32)


@pytest.mark.parametrize(("wavelength", "band"), [(2.1, 0), (8, 1), (17, 2), (27, 3), (96, 4)])
def test_an_error_is_found_in_the_band_of_its_width(wavelength, band):
    shares = error_shares((target() - waves(wavelength)).astype(np.float32), target(), FULL)
    found = [shares[name] for name in NAMES]
    assert int(np.argmax(found)) == band and sum(found) == pytest.approx(1)
    assert shares["shown_psnr"] == pytest.approx(-10 * np.log10(np.mean(waves(wavelength) ** 2)), abs=0.01)


def test_a_gain_explains_an_exposure_and_nothing_else():
    dark = (target() * np.array([0.8, 0.9, 0.7])).astype(np.float32)
    shares = error_shares(dark, target(), FULL)
    assert shares["shown_psnr"] < 22 and shares["gained_psnr"] > 80
    noisy = (target() + waves(2.1)).astype(np.float32)
    shares = error_shares(noisy, target(), FULL)
    assert shares["gained_psnr"] - shares["shown_psnr"] == pytest.approx(0, abs=0.1)


def test_errors_in_holes_are_counted_there():
    shown, alpha = target(), FULL.copy()
    shown[:10, :10] += 0.2
    shown[50:60, 50:60] += 0.1
    alpha[:10, :10] = 0.4
    assert error_shares(shown, target(), alpha)["in_holes"] == pytest.approx(0.8, abs=1e-4)
    assert error_shares(target(), target(), alpha)["in_holes"] == 0  # no error at all


def test_the_finding_names_the_largest_band():
    row = {
        "scene": "room",
        "stride": 1,
        "shown_psnr": 20.0,
        "gained_psnr": 20.5,
        "blurred_psnr": 30.0,
        "in_holes": 0.25,
    }
    (line,) = findings([row | dict(zip(NAMES, (0.3, 0.1, 0.1, 0.1, 0.4), strict=True))])
    assert "40% of the error is coarser than 8 px, 25% lies in holes" in line and "+0.50 dB" in line
