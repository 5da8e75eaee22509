"""Writer of .sog files (PlayCanvas, SOG version 2), for browsers; sog_reader.py reads them.

A zip archive of `meta.json` and lossless WebP images of 8 bits a channel; pixel i, row by row, belongs to Gaussian i:

    means_l, means_u   low and high byte of positions: p -> sign(p) ln(1 + |p|), as fractions of the range in meta.json
    quats              three entries of the quaternion wxyz from -1/sqrt 2 to 1/sqrt 2; alpha is 252 + the dropped one
    scales             ln of standard deviations, as indices into the 256 values of a codebook
    sh0                f_dc as indices into a codebook; alpha is the opacity
    shN_labels, shN_centroids   f_rest: index into a palette, of 64 entries a row, each of indices into a codebook

Gaussians are in Morton order, which makes neighboring pixels alike. Axes are those of a .ply.
Reference: developer.playcanvas.com, user manual, "The SOG format".
"""

import io
import json
import os
import zipfile

import numpy as np
from jaxtyping import Float64, UInt8
from PIL import Image

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.scene_files.codebook import fit_codebook, nearest_codes, palette
from ssplat_jax.scene_files.export_rows import ExportReport, SceneRows, scene_rows, to_bytes
from ssplat_jax.scene_files.morton import morton_order
from ssplat_jax.scene_files.smallest_three import HALF_RANGE, drop_largest

VERSION = 2
FIRST_MODE = 252
"""Alpha of `quats` where the first entry is dropped."""
PALETTE_COLUMNS = 64
"""Palette entries in a row of `shN_centroids`."""
ZIP_TIME = (1980, 1, 1, 0, 0, 0)
"""Time of every file in the archive, so that the same scene gives the same bytes."""


def save_sog(path: str | os.PathLike, gaussians: Gaussians, *, antialiased: bool = True) -> ExportReport:
    """Writes `gaussians` to `path` atomically; the same Gaussians give the same bytes.

    `antialiased` marks the scene as made for a renderer with the 2D Mip filter, as ours is.

    Limits:
        Those of `scene_rows`. Positions have 65,536 steps on a logarithmic axis, ln scales and SH coefficients 256
        values fitted to the scene, entries of quaternions 256; f_rest shares one of at most 65,536 palette entries.

    Raises:
        InputError: an array of the scene has a wrong shape.
        StorageError: the file cannot be written.
    """
    rows = scene_rows(gaussians)
    files = _files(rows, antialiased)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as target:  # stored: WebP is compressed already
        for name, data in files.items():
            target.writestr(zipfile.ZipInfo(name, ZIP_TIME), data)
    write_atomic(path, archive.getvalue())
    return ExportReport(num_written=len(rows), num_dropped=gaussians.num_gaussians - len(rows))


def _files(rows: SceneRows, antialiased: bool) -> dict[str, bytes]:
    """The files of the archive."""
    order = morton_order(rows.means)
    means = np.sign(rows.means[order]) * np.log1p(np.abs(rows.means[order]))
    low, high = (end(means, axis=0) if len(rows) else np.zeros(3) for end in (np.min, np.max))
    size = np.where(high > low, high - low, 1.0)
    levels = np.round((means - low) / size * 65535).astype(np.uint16)
    largest, others = drop_largest(rows.quats[order])
    scale_codes = fit_codebook(rows.log_scales)
    color_codes = fit_codebook(rows.sh[:, 0])
    colors = nearest_codes(rows.sh[order, 0], color_codes)
    images = {
        "means_l.webp": (levels & 255).astype(np.uint8),
        "means_u.webp": (levels >> 8).astype(np.uint8),
        "quats.webp": _with_alpha(to_bytes(255 * (0.5 + 0.5 * others / HALF_RANGE)), FIRST_MODE + largest),
        "scales.webp": nearest_codes(rows.log_scales[order], scale_codes),
        "sh0.webp": _with_alpha(colors, to_bytes(255 * rows.opacities[order])),
    }
    meta = {
        "version": VERSION,
        "asset": {"generator": "ssplat_jax"},
        "count": len(rows),
        "antialias": antialiased,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_codes.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_codes.tolist(), "files": ["sh0.webp"]},
    }
    files = {name: _webp(_as_image(pixels)) for name, pixels in images.items()}
    if rows.sh.shape[1] > 1 and len(rows):
        meta["shN"], more = _rest(rows.sh[order, 1:])
        files |= more
    return {"meta.json": json.dumps(meta).encode("ascii")} | files


def _rest(sh: Float64[np.ndarray, "n k 3"]) -> tuple[dict, dict[str, bytes]]:
    """The entry `shN` of meta.json and its two images."""
    n, terms, _ = sh.shape
    labels, entries = palette(sh.reshape(n, terms * 3))
    codes = fit_codebook(entries)
    count, width = len(entries), PALETTE_COLUMNS * terms
    pixels = np.zeros((-(-count // PALETTE_COLUMNS) * PALETTE_COLUMNS, terms * 3), np.uint8)
    pixels[:count] = nearest_codes(entries, codes)
    index = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1).astype(np.uint8)
    meta = {
        "count": count,
        "bands": round((terms + 1) ** 0.5) - 1,
        "codebook": codes.tolist(),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }
    return meta, {
        "shN_centroids.webp": _webp(pixels.reshape(-1, width, 3)),
        "shN_labels.webp": _webp(_as_image(index)),
    }


def _with_alpha(rgb: UInt8[np.ndarray, "n 3"], alpha: np.ndarray) -> UInt8[np.ndarray, "n 4"]:
    return np.concatenate([rgb, alpha[:, None].astype(np.uint8)], axis=1)


def _as_image(pixels: UInt8[np.ndarray, "n c"]) -> UInt8[np.ndarray, "h w c"]:
    """Pixels row by row in an image that is about square, with at least one pixel; those at the end are 0."""
    width = max(4, int(np.ceil(np.sqrt(len(pixels)) / 4)) * 4)
    height = max(1, -(-len(pixels) // width))
    image = np.zeros((height * width, pixels.shape[1]), np.uint8)
    image[: len(pixels)] = pixels
    return image.reshape(height, width, pixels.shape[1])


def _webp(image: UInt8[np.ndarray, "h w c"]) -> bytes:
    """Lossless WebP; `exact` keeps the colors of pixels whose alpha is 0."""
    data = io.BytesIO()
    Image.fromarray(image).save(data, "WEBP", lossless=True, exact=True, method=4)
    return data.getvalue()
