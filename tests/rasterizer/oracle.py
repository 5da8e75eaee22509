"""A rasterizer in NumPy float64 that shares no line with the package: loops and the textbook formulas."""

import math

import numpy as np

NEAR, ALPHA_MIN, ALPHA_MAX, STOP = 0.01, 1 / 255, 0.99, 1e-4


def rotation(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix of a quaternion wxyz of any length; zero is the identity."""
    length = np.linalg.norm(quat)
    w, x, y, z = quat / length if length > 1e-12 else (1.0, 0.0, 0.0, 0.0)
    v = np.array([x, y, z])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return (w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * cross


def harmonics(d: np.ndarray, degree: int) -> np.ndarray:
    """Real spherical harmonics from associated Legendre functions, in the sign convention of splat files."""
    x, y, z = d
    theta, phi = math.acos(max(-1.0, min(1.0, z))), math.atan2(y, x)
    s, c = math.sin(theta), math.cos(theta)
    legendre = {
        (0, 0): 1.0, (1, 0): c, (1, 1): -s, (2, 0): (3 * c * c - 1) / 2, (2, 1): -3 * s * c, (2, 2): 3 * s * s,
        (3, 0): (5 * c**3 - 3 * c) / 2, (3, 1): -1.5 * s * (5 * c * c - 1), (3, 2): 15 * c * s * s, (3, 3): -15 * s**3,
    }  # fmt: skip
    out = []
    for band in range(degree + 1):
        for m in range(-band, band + 1):
            a = abs(m)
            norm = math.sqrt((2 * band + 1) / (4 * math.pi) * math.factorial(band - a) / math.factorial(band + a))
            turn = 1.0 if m == 0 else math.sqrt(2) * (math.cos(a * phi) if m > 0 else math.sin(a * phi))
            out.append(norm * legendre[band, a] * turn)
    return np.array(out)


def splat(row: dict, viewmat: np.ndarray, K: np.ndarray, width: int, height: int, antialias: str):
    """Mean, inverse covariance, opacity, depth and color on the screen of one Gaussian; None where it is not seen."""
    if not all(np.all(np.isfinite(v)) for v in row.values()):
        return None
    point = viewmat[:3, :3] @ row["means"] + viewmat[:3, 3]
    x, y, z = point
    if z <= NEAR:
        return None
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin = 0.15
    left, right = sorted([(-margin * width - cx) / fx, ((1 + margin) * width - cx) / fx])
    upper, lower = sorted([(-margin * height - cy) / fy, ((1 + margin) * height - cy) / fy])
    tx, ty = np.clip(x / z, left, right), np.clip(y / z, upper, lower)
    jacobian = np.array([[fx / z, 0, -fx * tx / z], [0, fy / z, -fy * ty / z]])
    root = jacobian @ viewmat[:3, :3] @ rotation(row["quats"]) @ np.diag(row["scales"])
    covariance = root @ root.T
    kernel = {"mip": 0.1, "classic": 0.3, "none": 1e-8}[antialias]
    opacity = row["opacities"]
    filtered = covariance + kernel * np.eye(2)
    if antialias == "mip":
        opacity = opacity * math.sqrt(max(np.linalg.det(covariance), 0.0) / np.linalg.det(filtered))
    center = -viewmat[:3, :3].T @ viewmat[:3, 3]
    direction = row["means"] - center
    degree = round(math.sqrt(len(row["sh"]))) - 1
    color = np.maximum(0.5 + harmonics(direction / np.linalg.norm(direction), degree) @ row["sh"], 0)
    return np.array([fx * x / z + cx, fy * y / z + cy]), np.linalg.inv(filtered), opacity, z, color


def render(gaussians, viewmat, K, width: int, height: int, antialias: str = "mip"):
    """Color, alpha, expected and median depth: each Gaussian over all pixels, front to back."""
    fields = ("means", "quats", "scales", "opacities", "sh")
    arrays = {name: np.asarray(getattr(gaussians, name), np.float64) for name in fields}
    viewmat, K = np.asarray(viewmat, np.float64), np.asarray(K, np.float64)
    rows = [{k: v[i] for k, v in arrays.items()} for i in range(len(arrays["means"]))]
    rows = [splat(row, viewmat, K, width, height, antialias) for row in rows]
    rows = sorted((r for r in rows if r is not None), key=lambda r: r[3])
    color, alpha = np.zeros((height, width, 3)), np.zeros((height, width))
    depth, median = np.zeros((height, width)), np.zeros((height, width))
    light, stopped = np.ones((height, width)), np.zeros((height, width), bool)
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)
    for mean, conic, opacity, z, rgb in rows:
        offsets = pixels - mean
        a = opacity * np.exp(-0.5 * np.minimum((offsets @ conic * offsets).sum(-1), 1400.0))
        seen = ~stopped & (a >= ALPHA_MIN)
        a = np.minimum(a, ALPHA_MAX)
        stopped |= seen & (light * (1 - a) < STOP)
        a = np.where(seen & ~stopped, a, 0)
        color += (light * a)[..., None] * rgb
        alpha += light * a
        depth += light * a * z
        median[(light >= 0.5) & (light * (1 - a) < 0.5)] = z
        light *= 1 - a
    return color, alpha, np.where(alpha > 0, depth / np.where(alpha > 0, alpha, 1), 0), median
