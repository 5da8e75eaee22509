"""Texture library: a few hundred 256 x 256 tiles, built once per process from a fixed seed.

Photographs are crops of those in the wheel of scikit-image (read from its folder, never downloaded); a release with
fewer of them gives more noise textures instead. All other textures are synthetic. Tiles are repeated with mirroring, so
they need not be periodic. They are stored as mip pyramids with one packed `uint32` (0x00BBGGRR) per texel, because the
ray caster is bound by gathers.
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt32
from PIL import Image

SIZE = 256  # texels per side of a tile
NUM_LEVELS = 9  # 256, 128, ..., 1
LEVEL_OFFSETS = tuple((4**9 - 4 ** (9 - level)) // 3 for level in range(NUM_LEVELS))  # first texel of a level
NUM_TEXELS = (4**9 - 1) // 3  # of a pyramid

# Files of scikit-image.
_PHOTOS = (
    "astronaut.png", "brick.png", "camera.png", "cell.png", "chelsea.png", "coffee.png", "coins.png", "color.png",
    "grass.png", "gravel.png", "hubble_deep_field.jpg", "ihc.png", "moon.png", "motorcycle_left.png",
    "motorcycle_right.png", "page.png", "retina.jpg", "rocket.jpg", "text.png",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class TextureLibrary:
    """Tiles of all textures, their mip pyramids, and their groups."""

    tiles: UInt8[np.ndarray, "n 256 256 3"]
    groups: dict[str, np.ndarray]  # texture indices by topic: photo, wall, floor, pattern, noise, facade, sky, leaves

    @functools.cached_property
    def pyramids(self) -> UInt32[np.ndarray, "n texels"]:
        """Packed texels of all tiles, level 0 first, each level row by row: 82 MB."""
        return pack_pyramids(self.tiles)


@functools.lru_cache(maxsize=1)
def texture_library() -> TextureLibrary:
    """The library that all scenes share; the first call takes about two seconds."""
    rng = np.random.default_rng(20240607)
    recipes: dict[str, tuple[int, Callable[[np.random.Generator], np.ndarray]]] = {
        "photo": (72, _photo),
        "wall": (28, _plain),
        "floor": (32, _floor),
        "pattern": (28, _pattern),
        "noise": (28, _colored_noise),
        "facade": (16, _facade),
        "sky": (8, _sky),
        "leaves": (24, _dead_leaves),
    }
    tiles, groups = [], {}
    for name, (count, recipe) in recipes.items():
        groups[name] = np.arange(len(tiles), len(tiles) + count)
        tiles += [np.round(np.clip(recipe(rng), 0, 1) * 255).astype(np.uint8) for _ in range(count)]
    return TextureLibrary(np.stack(tiles), groups)


def pack_pyramids(tiles: UInt8[np.ndarray, "n 256 256 3"]) -> UInt32[np.ndarray, "n texels"]:
    """Box-filtered mip pyramids of `tiles`, packed into one `uint32` per texel."""
    levels, level = [], tiles.astype(np.float32)
    for _ in range(NUM_LEVELS):
        r, g, b = np.moveaxis(np.round(level).astype(np.uint32), -1, 0)
        levels.append((r | (g << 8) | (b << 16)).reshape(len(tiles), -1))
        if level.shape[1] > 1:
            n, size = level.shape[:2]
            level = level.reshape(n, size // 2, 2, size // 2, 2, 3).mean(axis=(2, 4))
    return np.concatenate(levels, axis=1)


# -- photographs ------------------------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=1)
def _photographs() -> tuple[Image.Image, ...]:
    """Photographs in the installed scikit-image, in RGB."""
    import skimage

    folder = Path(skimage.__file__).parent / "data"
    return tuple(Image.open(folder / name).convert("RGB") for name in _PHOTOS if (folder / name).is_file())


def _photo(rng: np.random.Generator) -> np.ndarray:
    """Random square of a random photograph: rotated, mirrored and tinted."""
    photos = _photographs()
    if not photos:
        return _colored_noise(rng)
    image = photos[rng.integers(len(photos))]
    side = int(min(image.size) * rng.uniform(0.3, 1.0))
    left, top = (int(rng.integers(0, extent - side + 1)) for extent in image.size)
    crop = image.resize((SIZE, SIZE), Image.Resampling.LANCZOS, box=(left, top, left + side, top + side))
    tile = np.rot90(np.asarray(crop, np.float32) / 255.0, int(rng.integers(4)))
    return _jitter(rng, tile[:, ::-1] if rng.random() < 0.5 else tile)


def _jitter(rng: np.random.Generator, tile: np.ndarray) -> np.ndarray:
    """Applies random contrast, brightness and tint; half of the gray images become duotone."""
    if np.ptp(tile, axis=-1).mean() < 0.02 and rng.random() < 0.5:
        dark, light = _color(rng, 0.0, 0.4), _color(rng, 0.6, 1.0)
        tile = dark + tile * (light - dark)
    mean = tile.mean(axis=(0, 1))
    return (tile - mean) * rng.uniform(0.7, 1.2) + mean * rng.uniform(0.85, 1.15, 3) + rng.uniform(-0.05, 0.1)


# -- synthetic textures ------------------------------------------------------------------------------------------------


def _color(rng: np.random.Generator, low: float = 0.1, high: float = 0.95) -> np.ndarray:
    """Random color, mostly of mild saturation; warm hues are more likely than cold ones."""
    value, saturation, hue = rng.uniform(low, high), rng.beta(0.9, 2.2), rng.uniform(0, 1)
    hue = hue * 0.2 - 0.05 if rng.random() < 0.5 else hue
    ramp = np.abs((6 * hue + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1  # the hue circle: red at 0, green at 1/3
    return value * (1 - saturation * (1 - np.clip(ramp, 0, 1)))


def _spectrum(rng: np.random.Generator, exponent: float, stretch: float = 1.0) -> np.ndarray:
    """Periodic 1/f^exponent noise with mean 0 and deviation 1; features are `stretch` times longer in x than in y."""
    fy = np.fft.fftfreq(SIZE)[:, None]
    fx = np.fft.rfftfreq(SIZE)[None, :] * stretch
    radius = np.maximum(np.hypot(fx, fy), 1 / SIZE)
    noise = np.fft.rfft2(rng.standard_normal((SIZE, SIZE))) / radius**exponent
    noise[0, 0] = 0
    field = np.fft.irfft2(noise, s=(SIZE, SIZE))
    return field / max(field.std(), 1e-9)


def _colored_noise(rng: np.random.Generator) -> np.ndarray:
    """1/f^a noise between three colors; half of the tiles are warped into veins or blotches."""
    field = _spectrum(rng, rng.uniform(0.7, 2.0), rng.choice([1.0, 1.0, 4.0]))
    style = rng.integers(4)
    if style == 0:
        field = 2 * np.sin(field * rng.uniform(2, 6))
    elif style == 1:
        field = 2 * np.tanh(field * rng.uniform(3, 12))
    ramp = np.clip(field / 4 + 0.5, 0, 1)[..., None]
    low, mid, high = _color(rng, 0.05, 0.5), _color(rng, 0.2, 0.8), _color(rng, 0.5, 1.0)
    tile = np.where(ramp < 0.5, low + (mid - low) * 2 * ramp, mid + (high - mid) * (2 * ramp - 1))
    return tile + 0.03 * _spectrum(rng, 0.5)[..., None]


def _plain(rng: np.random.Generator) -> np.ndarray:
    """Nearly uniform wall with faint plaster noise and large stains."""
    base = 0.7 * _color(rng, 0.45, 0.95) + 0.3 * rng.uniform(0.5, 0.95)
    fine = _spectrum(rng, rng.uniform(0.2, 1.0))[..., None] * rng.uniform(0.004, 0.025)
    slow = _spectrum(rng, 1.8)[..., None] * rng.uniform(0.0, 0.04)
    return base * (1 + fine + slow)


def _masonry(rng: np.random.Generator, rows: int, cols: int, bond: float, spread: float) -> np.ndarray:
    """Bricks, tiles or planks: noisy cells of varying tone, and joints of another color.

    Cells form a `rows` x `cols` lattice whose odd rows are shifted by `bond` of a cell.
    """
    gap = rng.uniform(0.002, 0.008)
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    row = np.floor(y * rows).astype(int)
    shifted = x * cols + bond * (row % 2)
    col = np.floor(shifted).astype(int) % cols
    dy, dx = (y * rows) % 1.0 / rows, shifted % 1.0 / cols
    joint = (np.minimum(dy, 1 / rows - dy) < gap) | (np.minimum(dx, 1 / cols - dx) < gap)
    tone = 1 + spread * rng.standard_normal((rows * cols, 1)) + 0.3 * spread * rng.standard_normal((rows * cols, 3))
    grain = _spectrum(rng, rng.uniform(0.5, 1.6), rng.choice([1.0, 6.0])) * rng.uniform(0.02, 0.12)
    tile = _color(rng, 0.3, 0.9) * tone[row * cols + col] * (1 + grain[..., None])
    return np.where(joint[..., None], _color(rng, 0.2, 0.8), tile)


def _floor(rng: np.random.Generator) -> np.ndarray:
    """Planks, tiles, gravel or carpet."""
    style = rng.integers(4)
    if style == 0:
        return _masonry(rng, int(rng.integers(6, 12)), int(rng.integers(1, 3)), 0.5, 0.15)
    if style == 1:
        n = int(rng.integers(2, 7))
        return _masonry(rng, n, n, 0.0, 0.1)
    if style == 2:
        return _color(rng, 0.3, 0.8) * (1 + 0.25 * _spectrum(rng, rng.uniform(0.3, 1.0))[..., None])
    return _colored_noise(rng)


def _pattern(rng: np.random.Generator) -> np.ndarray:
    """Checkers, stripes, bricks or dots."""
    style = rng.integers(4)
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    if style == 0:
        return _masonry(rng, int(rng.integers(6, 16)), int(rng.integers(3, 7)), 0.5, 0.12)
    if style == 1:
        mask = (np.floor(x * (n := rng.integers(2, 12))) + np.floor(y * n)) % 2
    elif style == 2:
        angle, frequency = rng.uniform(0, np.pi), rng.uniform(3, 20)
        wave = np.sin(2 * np.pi * frequency * (x * np.cos(angle) + y * np.sin(angle)))
        mask = np.clip(wave * 3 + 0.5, 0, 1)
    else:
        n = rng.integers(3, 12)
        mask = np.hypot((x * n) % 1 - 0.5, (y * n) % 1 - 0.5) < rng.uniform(0.15, 0.45)
    dark, light = _color(rng, 0.05, 0.5), _color(rng, 0.5, 1.0)
    tile = dark + (light - dark) * mask.astype(np.float64)[..., None]
    return tile * (1 + rng.uniform(0.0, 0.1) * _spectrum(rng, 1.0)[..., None])


def _facade(rng: np.random.Generator) -> np.ndarray:
    """Wall with rows of windows, or shelves of books."""
    if rng.random() < 0.4:
        return _bookshelf(rng)
    rows, cols = rng.integers(2, 6, 2)
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    v, u = (y * rows) % 1, (x * cols) % 1
    width, height = rng.uniform(0.2, 0.38, 2)
    window = (abs(u - 0.5) < width) & (abs(v - 0.5) < height)
    pane = window & (abs(u - 0.5) < width - 0.04) & (abs(v - 0.5) < height - 0.04) & (abs(u - 0.5) > 0.015)
    glass = rng.uniform(0.05, 0.6, (rows * cols, 1)) * rng.uniform(0.8, 1.2, (rows * cols, 3))
    cell = (np.floor(y * rows) * cols + np.floor(x * cols)).astype(int)
    wall = _masonry(rng, 32, 16, 0.5, 0.08) if rng.random() < 0.5 else _plain(rng)
    tile = np.where(window[..., None], _color(rng, 0.6, 1.0), wall)
    return np.where(pane[..., None], glass[cell] * (1 + 0.3 * (0.5 - v))[..., None], tile)


def _bookshelf(rng: np.random.Generator) -> np.ndarray:
    """Shelves of books with random widths, heights and colors."""
    tile = np.full((SIZE, SIZE, 3), 0.06)
    shelf = SIZE // int(rng.integers(3, 6))
    wood = _color(rng, 0.3, 0.7)
    for top in range(0, SIZE, shelf):
        x = 0
        while x < SIZE:
            width, height = int(rng.integers(4, 14)), int(shelf * rng.uniform(0.6, 0.92))
            tile[top + shelf - height : top + shelf, x : x + width] = _color(rng, 0.15, 0.95)
            tile[top + shelf - height // 2 : top + shelf - height // 3, x + 1 : x + width - 1] *= rng.uniform(0.6, 1.3)
            tile[top : top + shelf, x + width - 1 : x + width] *= 0.4
            x += width
        tile[top : top + max(shelf // 12, 2)] = wood
    return tile


def _dead_leaves(rng: np.random.Generator) -> np.ndarray:
    """Discs and rectangles of random colors, small over large, which give edges at all scales."""
    tile = np.broadcast_to(_color(rng), (SIZE, SIZE, 3)).copy()
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    for radius in np.sort(3.0 + 60.0 * rng.pareto(2.0, 220) / 4)[::-1].clip(3, 90):
        cx, cy = rng.uniform(0, SIZE, 2)
        x0, x1, y0, y1 = (int(np.clip(c, 0, SIZE)) for c in (cx - radius, cx + radius, cy - radius, cy + radius))
        box = (slice(y0, y1), slice(x0, x1))
        inside = np.hypot(x[box] - cx, y[box] - cy) < radius if rng.random() < 0.5 else np.ones_like(x[box], bool)
        tile[box] = np.where(inside[..., None], _color(rng, 0.02, 1.0), tile[box])
    return tile * (1 + 0.05 * _spectrum(rng, 1.0)[..., None])


def _sky(rng: np.random.Generator) -> np.ndarray:
    """Clouds on a blue, gray or dusky sky."""
    clouds = np.clip(_spectrum(rng, 1.7) * 0.4 + rng.uniform(0.1, 0.5), 0, 1)[..., None]
    base = np.array([[0.45, 0.62, 0.85], [0.62, 0.68, 0.75], [0.75, 0.6, 0.55]])[rng.integers(3)]
    return base + (np.array([0.95, 0.95, 0.97]) - base) * clouds
