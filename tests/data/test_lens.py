"""Lens distortion: the model against its inverse, undistorted images against pinhole images, refusals."""

import dataclasses

import numpy as np
import pytest

from ssplat_jax.data.images import FisheyeLens, Lens, check_lens, undistort
from tests.badinputs.cases import HEIGHT, WIDTH, depth_map, opened, top

WIDE, HIGH = 160, 120
K = np.array([[130.0, 0, 83.0], [0, 128.0, 58.0], [0, 0, 1]])
LENSES = [
    Lens(k1=-0.12, k2=0.02, p1=0.002, p2=-0.003),
    Lens(k1=0.08, k2=-0.01, k3=0.003),
    Lens(k4=0.4),
    FisheyeLens(),
    FisheyeLens(k1=0.05, k2=-0.02, k3=0.01, k4=-0.005),
]


def scene(pixels):
    """Smooth image as a function of pinhole pixels."""
    x, y = pixels[..., 0], pixels[..., 1]
    return np.stack([np.sin(x / 9) * np.cos(y / 11), np.cos(x / 13 + y / 17), np.sin((x - y) / 15)], -1) / 2 + 0.5


def pinhole_pixels(lens, pixels):
    """Inverse of `Lens.pixels` by fixed-point iteration."""
    found = pixels.copy()
    for _ in range(60):
        found -= lens.pixels(K, found) - pixels
    return found


def centers():
    rows, columns = np.mgrid[:HIGH, :WIDE]
    return np.stack([columns, rows], axis=-1) + 0.5


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_undistorted_is_what_a_pinhole_camera_sees(lens):
    assert check_lens(lens, K, WIDE, HIGH, "here") > 0.5
    stored = scene(pinhole_pixels(lens, centers())).astype(np.float32)
    delivered, expected = undistort(stored, lens, K), scene(centers())
    source = lens.pixels(K, centers())
    inside = ((source > 1) & (source < (WIDE - 1, HIGH - 1))).all(-1)
    assert inside.mean() > 0.9
    assert np.abs(delivered - expected)[inside].max() < 0.005  # linear sampling
    assert np.abs(stored - expected)[inside].max() > 0.05


@pytest.mark.parametrize("degrees", [0.0, 1e-9, 30.0, 60.0, 89.0])
def test_fisheye_radius_is_the_angle_times_its_series(degrees):
    angle = np.deg2rad(degrees)
    direction = np.array([0.6, -0.8])
    point = np.tan(angle) * direction
    k1, k2, k3, k4 = 0.05, -0.02, 0.01, -0.005
    bent = FisheyeLens(k1=k1, k2=k2, k3=k3, k4=k4).distorted(point)
    radius = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
    np.testing.assert_allclose(bent, radius * direction, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(
    ("lens", "wanted"),
    [
        # r^2 = 0.34, radial 1.05644, tangential (-0.03 + 0.168, 0.052 - 0.06).
        (Lens(k1=0.2, k2=-0.1, p1=0.1, p2=0.2), [0.66622, -0.324932]),
        # The numerator is 1.068, the denominator 1.034 - 0.05 * 0.34^2 + 0.02 * 0.34^3.
        (Lens(k1=0.2, d1=0.1, d2=-0.05, d3=0.02), np.array([0.534, -0.3204]) / 1.02900608),
    ],
)
def test_distortion_is_the_published_formula(lens, wanted):
    """Worked by hand for (0.5, -0.3)."""
    np.testing.assert_allclose(lens.distorted(np.array([0.5, -0.3])), wanted, atol=1e-12)


def test_depth_maps_of_another_size_are_undistorted_and_unknown_outside(tmp_path):
    """Each pixel shows what the published formula finds in the stored map, and 0 beyond its border."""
    high, wide = HEIGHT // 2, WIDTH // 4
    stored = np.arange(1000, 1000 + high * wide, dtype=np.uint16).reshape(high, wide)

    capture = opened(tmp_path, top(k1=0.4), depth_map(0, stored))
    (fx, _, cx), (_, fy, cy), _ = capture.frames[0].K * [[1 / 4], [1 / 2], [1]]
    rows, columns = np.mgrid[:high, :wide] + 0.5
    x, y = (columns - cx) / fx, (rows - cy) / fy
    factor = 1 + 0.4 * (x * x + y * y)
    columns, rows = (np.floor(v).astype(int) for v in (fx * factor * x + cx, fy * factor * y + cy))
    inside = (rows >= 0) & (rows < high) & (columns >= 0) & (columns < wide)
    expected = np.where(inside, stored[rows.clip(0, high - 1), columns.clip(0, wide - 1)] / 1000, 0.0)
    assert 0.02 < np.mean(expected == 0) < 0.5
    np.testing.assert_allclose(capture.pixels.depth(0), expected, rtol=1e-6)


def test_a_capture_is_undistorted_and_reports_it(tmp_path):
    straight, bent = opened(tmp_path / "a"), opened(tmp_path / "b", top(k1=-0.2, p1=0.01))
    assert any("undone" in note for note in bent.notes) and not straight.notes
    frame = bent.frames[0]
    assert frame.lens == Lens(k1=-0.2, p1=0.01)
    expected = undistort(straight.image(0), frame.lens, frame.K)
    np.testing.assert_array_equal(bent.image(0), expected)
    assert np.abs(expected - straight.image(0)).max() > 0.01
    assert bent.image(0).shape == (HEIGHT, WIDTH, 3)
    frames = tuple(dataclasses.replace(f, lens=frame.lens) for f in straight.frames)
    assert dataclasses.replace(straight, frames=frames).digest([0]) != straight.digest([0])  # it depends on the lens
