"""Procedural textures of the made worlds: noise with natural spectra, wood, tiles, posters, marks, weak texture."""

import numpy as np

SIDE = 256  # texels of a texture
NUM_TEXTURES = 16


def noise(rng: np.random.Generator, slope: float = 1.0) -> np.ndarray:
    """Periodic noise whose amplitude falls as 1 / frequency^slope; zero mean, unit deviation."""
    frequency = np.hypot(np.fft.fftfreq(SIDE)[:, None], np.fft.rfftfreq(SIDE)) * SIDE
    frequency[0, 0] = np.inf
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((SIDE, SIDE))) / frequency**slope, s=(SIDE, SIDE))
    return field / field.std()


def make_textures(rng: np.random.Generator) -> np.ndarray:
    """All textures of a world, uint8 (NUM_TEXTURES, SIDE, SIDE, 3); every kind occurs."""
    kinds = [_mottled, _wood, _tiles, _poster, _marks, _weak]
    drawn = [kinds[i % len(kinds)](rng) for i in range(NUM_TEXTURES)]
    return (np.clip(np.stack(drawn), 0.02, 1) * 255).astype(np.uint8)


def _color(rng: np.random.Generator) -> np.ndarray:
    gray = rng.uniform(0.25, 0.85)
    return np.clip(gray + rng.uniform(0.02, 0.22) * rng.normal(size=3), 0.08, 0.95)


def _mix(weight: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    weight = np.clip(weight, 0, 1)[..., None]
    return first * (1 - weight) + second * weight


def _mottled(rng):
    return _mix(0.5 + 0.25 * noise(rng), _color(rng), _color(rng)) + 0.03 * noise(rng, 0.5)[..., None]


def _wood(rng):
    across = np.arange(SIDE)[:, None] / SIDE
    rings = np.sin(2 * np.pi * (rng.integers(4, 9) * across + 0.25 * noise(rng, 1.6)))
    dark = np.array([0.34, 0.21, 0.12]) * rng.uniform(0.6, 1.3)
    grain = np.repeat(noise(rng, 0.4)[:, :1], SIDE, 1)
    return _mix(0.5 + 0.28 * rings + 0.12 * grain, dark, dark * 1.9) + 0.02 * noise(rng, 0.7)[..., None]


def _tiles(rng):
    count = int(rng.choice([4, 8]))
    y, x = np.mgrid[:SIDE, :SIDE] * count / SIDE
    shade = rng.normal(1, 0.07, (count, count))[y.astype(int), x.astype(int)]
    joint = (np.minimum(x % 1, y % 1) < 0.05)[..., None]
    tile = _color(rng) * shade[..., None] + 0.03 * noise(rng)[..., None]
    return np.where(joint, 0.5 * _color(rng), tile)


def _poster(rng):
    image = _mix(0.5 + 0.5 * noise(rng, 1.7), rng.uniform(0, 1, 3), rng.uniform(0, 1, 3))
    y, x = np.mgrid[:SIDE, :SIDE] / SIDE
    for _ in range(rng.integers(4, 10)):
        cx, cy, r = *rng.uniform(0, 1, 2), rng.uniform(0.05, 0.25)
        inside = np.hypot(x - cx, y - cy) < r if rng.random() < 0.5 else np.maximum(abs(x - cx), abs(y - cy)) < r
        image[inside] = rng.uniform(0, 1, 3)
    return image


def _marks(rng):
    image = np.ones((SIDE, SIDE, 3)) * rng.uniform(0.7, 0.95) + 0.02 * noise(rng)[..., None]
    for row in range(12, SIDE - 16, 14):
        column = 12
        while column < SIDE - 24 - rng.integers(0, 60):
            width = int(rng.integers(2, 7))
            top = row + int(rng.integers(0, 4))
            image[top : row + 8, column : column + width] = rng.uniform(0.05, 0.3)
            column += width + int(rng.choice([2, 2, 2, 7]))
    return image


def _weak(rng):
    return np.clip(_color(rng) * 1.2, 0.3, 0.92) + 0.012 * noise(rng)[..., None]
