"""A capture drawn from above: the path of the cameras, and how many of them see each place.

    plane that is level with the cameras -> cells -> views whose frustum a cell's upright meets -> colors

Walls do not hide what is behind them here: the scene's surfaces are not known yet. Hence cameras see up to a depth that
the caller chooses, such as twice the median. Places that a single camera sees have no depth.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64, Int
from PIL import Image, ImageDraw

from ssplat_jax.data.capture import Capture

LONG_SIDE = 900  # pixels of the picture
NUM_CELLS = 180  # along the long side
MAX_CAMERAS = 400  # evenly spread; more would not change the picture
SAMPLES = (5, 5, 8)  # of a frustum across, down and in log depth, for the extent of the picture
CROP = 0.03  # share of the samples outside each side of the picture
MARGIN = 0.04  # of the long side
LEGEND_PX = 26  # height of the line below the map

BACKGROUND, SINGLE = (0.08, 0.08, 0.1), (0.36, 0.2, 0.2)
MANY = (
    (2, (0.16, 0.2, 0.42)),
    (5, (0.15, 0.35, 0.55)),
    (10, (0.13, 0.5, 0.55)),
    (20, (0.2, 0.65, 0.47)),
    (50, (0.55, 0.78, 0.3)),
    (100, (0.95, 0.88, 0.35)),
)
"""Colors by the least number of views, apart from one view."""


def draw_coverage(capture: Capture, near: float, far: float) -> Float32[np.ndarray, "h w 3"]:
    """Returns a picture of `capture` from above, RGB in [0, 1].

    The path is white, from a green dot to a red one, with a tick along the viewing direction of some cameras.

    Args:
        capture: the capture.
        near: depth from which a camera sees the scene, capture units.
        far: depth up to which it does.
    """
    chosen = np.unique(np.linspace(0, len(capture) - 1, MAX_CAMERAS).round().astype(int))
    poses = capture.camtoworlds
    plane = ground_axes(poses)
    frustums = [_frustum(capture, int(i), near, far) for i in chosen]
    samples = np.concatenate([_samples(capture, int(i), near, far) for i in chosen]) @ plane.T
    centers, ahead = poses[:, :3, 3] @ plane.T, poses[:, :3, 2] @ plane.T
    low = np.minimum(np.quantile(samples, CROP, axis=0), centers.min(axis=0))
    high = np.maximum(np.quantile(samples, 1 - CROP, axis=0), centers.max(axis=0))
    cell = max(float((high - low).max()), 1e-9) / (NUM_CELLS * (1 - 2 * MARGIN))
    low, high = low - MARGIN * NUM_CELLS * cell, high + MARGIN * NUM_CELLS * cell
    columns, rows = (
        start + (np.arange(math.ceil(side / cell)) + 0.5) * cell for start, side in zip(low, high - low, strict=True)
    )
    counts = views_per_cell(np.stack(np.meshgrid(columns, rows), axis=-1), plane, frustums)
    scale = LONG_SIDE / NUM_CELLS
    size = (round(counts.shape[1] * scale), round(counts.shape[0] * scale))
    colored = Image.fromarray((_colors(counts) * 255 + 0.5).astype(np.uint8)).resize(size, Image.Resampling.NEAREST)
    canvas = Image.new("RGB", (size[0], size[1] + LEGEND_PX), "black")
    canvas.paste(colored)
    draw = ImageDraw.Draw(canvas)
    pixels = (centers - low) / cell * scale
    _draw_path(draw, pixels, ahead)
    _draw_legend(draw, size, cell / scale)
    return np.asarray(canvas, np.float32) / 255


def ground_axes(camtoworlds: Float64[np.ndarray, "v 4 4"]) -> Float64[np.ndarray, "2 3"]:
    """Returns two unit vectors that span the plane seen from above: right and down in the picture.

    Up is where the cameras' upper sides point on average. The picture's right is the longest direction of the path.
    """
    up = -camtoworlds[:, :3, 1].mean(axis=0)
    offsets = camtoworlds[:, :3, 3] - camtoworlds[:, :3, 3].mean(axis=0)
    if np.linalg.norm(up) < 0.1:  # cameras of all attitudes: the plane that the path is nearest to
        up = np.linalg.svd(offsets.T @ offsets)[0][:, 2]
    up = up / np.linalg.norm(up)
    level = offsets - np.outer(offsets @ up, up)
    right = np.linalg.svd(level.T @ level + 1e-30 * np.eye(3))[0][:, 0]
    right = right - up * (right @ up)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(right, up)])


def _frustum(capture: Capture, i: int, near: float, far: float) -> Float64[np.ndarray, "6 4"]:
    """Rows (n, d): a point p of the capture frame is in the frustum of camera `i` where n . p + d >= 0 for all."""
    K, pose = capture.K(i), capture.frames[i].camtoworld
    left, top = -K[0, 2] / K[0, 0], -K[1, 2] / K[1, 1]
    right, bottom = left + capture.width / K[0, 0], top + capture.height / K[1, 1]
    sides = np.array([[1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom], [0, 0, 1], [0, 0, -1]])
    normals = sides @ pose[:3, :3].T
    distances = -normals @ pose[:3, 3] + np.array([0, 0, 0, 0, -near, far])
    return np.column_stack([normals, distances])


def _samples(capture: Capture, i: int, near: float, far: float) -> Float64[np.ndarray, "n 3"]:
    """Points of the capture frame in the frustum of camera `i`."""
    K, pose = capture.K(i), capture.frames[i].camtoworld
    x = (np.linspace(0, capture.width, SAMPLES[0]) - K[0, 2]) / K[0, 0]
    y = (np.linspace(0, capture.height, SAMPLES[1]) - K[1, 2]) / K[1, 1]
    rays = np.stack([*np.meshgrid(x, y), np.ones((SAMPLES[1], SAMPLES[0]))], axis=-1).reshape(-1, 3)
    points = np.geomspace(near, far, SAMPLES[2])[:, None, None] * rays
    return points.reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]


def views_per_cell(
    cells: Float64[np.ndarray, "rows columns 2"],
    plane: Float64[np.ndarray, "2 3"],
    frustums: Sequence[Float64[np.ndarray, "6 4"]],
) -> Int[np.ndarray, "rows columns"]:
    """Returns how many frustums the upright line through each cell meets.

    Args:
        cells: centers of the cells, in the plane.
        plane: from `ground_axes`.
        frustums: half spaces of each view, as rows (n, d).
    """
    foot, up = cells @ plane, np.cross(plane[0], plane[1])
    counts = np.zeros(cells.shape[:2], int)
    for frustum in frustums:
        low, high = np.full(counts.shape, -np.inf), np.full(counts.shape, np.inf)
        for *normal, distance in frustum:
            # On the line foot + h up the half space is a ray: offset + slope h >= 0.
            offset, slope = foot @ np.array(normal) + distance, float(up @ np.array(normal))
            if abs(slope) < 1e-12:
                high = np.where(offset >= 0, high, -np.inf)
            elif slope > 0:
                low = np.maximum(low, -offset / slope)
            else:
                high = np.minimum(high, -offset / slope)
        counts += low <= high
    return counts


def _colors(counts: Int[np.ndarray, "rows columns"]) -> Float64[np.ndarray, "rows columns 3"]:
    """Color of each number of views."""
    colors = np.empty((*counts.shape, 3))
    colors[:] = BACKGROUND
    colors[counts == 1] = SINGLE
    for least, color in MANY:
        colors[counts >= least] = color
    return colors


def _draw_path(draw: ImageDraw.ImageDraw, pixels: Float64[np.ndarray, "v 2"], ahead: Float64[np.ndarray, "v 2"]):
    """The path of the cameras, ticks along viewing directions, and dots at both ends."""
    for i in np.unique(np.linspace(0, len(pixels) - 1, 60).round().astype(int)):
        draw.line([tuple(pixels[i]), tuple(pixels[i] + 14 * ahead[i])], fill=(255, 150, 60), width=1)
    draw.line([tuple(p) for p in pixels], fill="white", width=2)
    for (x, y), color in ((pixels[0], (80, 255, 80)), (pixels[-1], (255, 60, 60))):
        draw.ellipse([x - 5, y - 5, x + 5, y + 5], fill=color)


def _draw_legend(draw: ImageDraw.ImageDraw, size: tuple[int, int], pixel: float) -> None:
    """Boxes of the colors, and a bar of a round length; `pixel` is in capture units."""
    x, y = 8, size[1] + 6
    for label, color in (("1 view", SINGLE), *((f"{least}+", color) for least, color in MANY)):
        draw.rectangle([x, y, x + 14, y + 14], fill=tuple(round(255 * c) for c in color))
        draw.text((x + 19, y + 1), label, fill="white")
        x += 62
    length = 10 ** math.floor(math.log10(size[0] * pixel / 3))
    length *= max(k for k in (1, 2, 5) if k * length <= size[0] * pixel / 3)
    right = size[0] - 12
    draw.line([right - length / pixel, y + 7, right, y + 7], fill="white", width=3)
    draw.text((right - length / pixel - 78, y + 1), f"{length:g} units", fill="white")
