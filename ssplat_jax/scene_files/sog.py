"""The .sog file (PlayCanvas, SOG version 2), for browsers.

A zip archive of `meta.json` and lossless WebP images of 8 bits a channel; pixel i, row by row, belongs to Gaussian i:

    means_l, means_u   low and high byte of positions: p -> sign(p) ln(1 + |p|), as fractions of the range in meta.json
    quats              three entries of the quaternion wxyz from -1/sqrt 2 to 1/sqrt 2; alpha is 252 + the dropped one
    scales             ln of standard deviations, as indices into the 256 values of a codebook
    sh0                f_dc as indices into a codebook; alpha is the opacity
    shN_labels, shN_centroids   f_rest: index into a palette, of 64 entries a row, each of indices into a codebook

The description leaves open whether scales are logarithms; all writers and viewers take them as such. Gaussians are in
Morton order, which makes neighboring pixels alike. Axes are those of a .ply.
Reference: developer.playcanvas.com, user manual, "The SOG format".
"""

import io
import json
import zipfile
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Int, UInt8
from PIL import Image

from ssplat_jax.scene_files.splat_rows import HALF_RANGE, SplatRows, drop_largest, morton_order, to_bytes, with_largest

VERSION = 2
FIRST_MODE = 252  # alpha of `quats` where the first entry is dropped
PALETTE_COLUMNS = 64  # palette entries in a row of `shN_centroids`
ZIP_TIME = (1980, 1, 1, 0, 0, 0)  # of every file in the archive, so that the same scene gives the same bytes
MAX_BYTES = 1 << 30  # of one file of the archive when it is unpacked
SPARE_PIXELS = 1 << 16  # that an image may have beyond twice the wanted number, before anything is allocated
NUM_CODES = 256
NUM_ROUNDS = 8  # of Lloyd's algorithm for a codebook; more change the mean error by less than 1 %
MAX_PALETTE = 65536  # entries that 16-bit labels tell apart
FITTED_PALETTE = 4096  # entries of a palette that is fitted because there are more different vectors
PALETTE_ROUNDS = 4
BATCH = 8192  # vectors compared with a palette at once, 256 MB of distances
MAX_LOG_POSITION = 60.0  # bound of a position on its logarithmic axis: 1e26 units


def encode_sog(rows: SplatRows, start_camera: dict[str, Any] | None = None) -> bytes:
    """The bytes of a .sog; viewers that know of it start with a camera.

    Limits:
        Positions have 65,536 steps on a logarithmic axis, ln scales and SH coefficients 256 values fitted to the scene,
        entries of quaternions 256; f_rest shares one of at most 65,536 palette entries.
    """
    order = morton_order(rows.means)
    means = np.sign(rows.means[order]) * np.log1p(np.abs(rows.means[order]))
    low, high = (end(means, axis=0) if len(rows) else np.zeros(3) for end in (np.min, np.max))
    size = np.where(high > low, high - low, 1.0)
    levels = np.round((means - low) / size * 65535).astype(np.uint16)
    largest, others = drop_largest(rows.quats[order])
    scale_codes = fit_codebook(rows.log_scales)
    color_codes = fit_codebook(rows.sh[:, 0])
    images = {
        "means_l.webp": _image((levels & 255).astype(np.uint8)),
        "means_u.webp": _image((levels >> 8).astype(np.uint8)),
        "quats.webp": _image(to_bytes(255 * (0.5 + 0.5 * others / HALF_RANGE)), FIRST_MODE + largest),
        "scales.webp": _image(nearest_codes(rows.log_scales[order], scale_codes)),
        "sh0.webp": _image(nearest_codes(rows.sh[order, 0], color_codes), to_bytes(255 * rows.opacities[order])),
    }
    meta = {
        "version": VERSION,
        "asset": {"generator": "ssplat_jax"},
        "count": len(rows),
        "antialias": rows.render_mode == "mip",
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_codes.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_codes.tolist(), "files": ["sh0.webp"]},
    }
    if start_camera is not None:  # as in the experience settings of PlayCanvas; readers of scenes skip it
        meta["cameras"] = [{"initial": start_camera}]
    if rows.sh.shape[1] > 1 and len(rows):
        meta["shN"], more = _encode_rest(rows.sh[order, 1:])
        images |= more
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as target:  # stored: WebP is compressed already
        target.writestr(zipfile.ZipInfo("meta.json", ZIP_TIME), json.dumps(meta).encode("ascii"))
        for name, image in images.items():
            data = io.BytesIO()
            # `exact` keeps the colors of pixels whose alpha is 0.
            Image.fromarray(image).save(data, "WEBP", lossless=True, exact=True, method=4)
            target.writestr(zipfile.ZipInfo(name, ZIP_TIME), data.getvalue())
    return archive.getvalue()


def _encode_rest(sh: Float64[np.ndarray, "n k 3"]) -> tuple[dict, dict[str, UInt8[np.ndarray, "h w 3"]]]:
    """The entry `shN` of meta.json and its two images."""
    n, terms, _ = sh.shape
    labels, entries = palette(sh.reshape(n, terms * 3))
    codes, count = fit_codebook(entries), len(entries)
    pixels = np.zeros((-(-count // PALETTE_COLUMNS) * PALETTE_COLUMNS, terms * 3), np.uint8)
    pixels[:count] = nearest_codes(entries, codes)
    index = np.stack([labels & 255, labels >> 8, 0 * labels], axis=1).astype(np.uint8)
    files = ["shN_centroids.webp", "shN_labels.webp"]
    meta = {"count": count, "bands": round((terms + 1) ** 0.5) - 1, "codebook": codes.tolist(), "files": files}
    return meta, dict(zip(files, (pixels.reshape(-1, PALETTE_COLUMNS * terms, 3), _image(index)), strict=True))


def _image(rgb: UInt8[np.ndarray, "n 3"], alpha: np.ndarray | None = None) -> UInt8[np.ndarray, "h w c"]:
    """Pixels row by row in an image that is about square, with at least one pixel; those at the end are 0."""
    pixels = rgb if alpha is None else np.concatenate([rgb, alpha[:, None].astype(np.uint8)], axis=1)
    width = max(4, int(np.ceil(np.sqrt(len(pixels)) / 4)) * 4)
    height = max(1, -(-len(pixels) // width))
    image = np.zeros((height * width, pixels.shape[1]), np.uint8)
    image[: len(pixels)] = pixels
    return image.reshape(height, width, pixels.shape[1])


def decode_sog(data: bytes) -> SplatRows:
    """The rows of a .sog."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        meta = json.loads(_member(archive, "meta.json"))
        count = meta["count"]
        if meta["version"] != VERSION or type(count) is not int or count < 0:
            raise ValueError(f"wanted a SOG of version {VERSION} with a count, got {meta['version']!r} and {count!r}")
        names = [*meta["means"]["files"][:2], *(meta[name]["files"][0] for name in ("quats", "scales", "sh0"))]
        low_byte, high_byte, quats, scales, sh0 = (_pixels(archive, name, count)[:count] for name in names)
        sh = [_codebook(meta["sh0"])[sh0[:, :3]][:, None]]
        if "shN" in meta and count:
            sh.append(_decode_rest(archive, meta["shN"], count))
    largest = quats[:, 3].astype(np.int64) - FIRST_MODE
    if (largest < 0).any():
        raise ValueError(f"wanted an alpha of quats of at least {FIRST_MODE}")
    low, high = (np.array(meta["means"][end], np.float64).reshape(3) for end in ("mins", "maxs"))
    if not (np.abs([low, high]) <= MAX_LOG_POSITION).all():
        raise ValueError("wanted finite mins and maxs")
    logs = low + (high_byte[:, :3].astype(np.float64) * 256 + low_byte[:, :3]) / 65535 * (high - low)
    return SplatRows(
        means=np.sign(logs) * np.expm1(np.abs(logs)),
        quats=with_largest(largest, (quats[:, :3] / 127.5 - 1) * HALF_RANGE),
        log_scales=_codebook(meta["scales"])[scales[:, :3]],
        opacities=sh0[:, 3] / 255,
        sh=np.concatenate(sh, axis=1),
        render_mode="mip" if meta.get("antialias") is True else "default",
    )


def _decode_rest(archive: zipfile.ZipFile, part: dict[str, Any], count: int) -> Float64[np.ndarray, "n k 3"]:
    bands, num_entries = part["bands"], part["count"]
    if bands not in (1, 2, 3) or type(num_entries) is not int or not 0 < num_entries <= 65536:
        raise ValueError(f"wanted 1 to 3 bands and 1 to 65536 entries, got {bands!r} and {num_entries!r}")
    terms = (bands + 1) ** 2 - 1
    labels = _pixels(archive, part["files"][1], count)[:count].astype(np.int64)
    labels = labels[:, 0] + 256 * labels[:, 1]
    entries = _pixels(archive, part["files"][0], num_entries * terms, PALETTE_COLUMNS * terms)
    if labels.max() >= num_entries:
        raise ValueError("a label lies beyond the palette")
    return _codebook(part)[entries[:, :3].reshape(-1, terms, 3)[labels]]


def _pixels(archive: zipfile.ZipFile, name: str, wanted: int, width: int | None = None) -> UInt8[np.ndarray, "n 4"]:
    """Pixels of an image that has at least `wanted` of them and not many more."""
    with Image.open(io.BytesIO(_member(archive, name))) as image:
        if not wanted <= image.width * image.height <= 2 * wanted + SPARE_PIXELS or width not in (None, image.width):
            raise ValueError(f"{name}: wanted {wanted} pixels, got {image.width} x {image.height}")
        return np.asarray(image.convert("RGBA")).reshape(-1, 4)


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    if archive.getinfo(name).file_size > MAX_BYTES:
        raise ValueError(f"{name} takes more than {MAX_BYTES} bytes")
    return archive.read(name)


def _codebook(part: dict[str, Any]) -> Float64[np.ndarray, " 256"]:
    return np.array(part["codebook"], np.float64).reshape(NUM_CODES)


def fit_codebook(values: Float[np.ndarray, "*n"]) -> Float64[np.ndarray, " 256"]:
    """256 values in rising order near which the `values` lie: Lloyd's algorithm in one dimension.

    Values that differ in at most 256 ways are their own codebook.
    """
    ordered = np.sort(np.asarray(values, np.float32).astype(np.float64).reshape(-1))
    different = np.unique(ordered) if len(ordered) else np.zeros(1)
    if len(different) <= NUM_CODES:
        return np.pad(different, (0, NUM_CODES - len(different)), mode="edge")
    # Half of the codes at quantiles, half evenly spaced: rare values far out get some too.
    quantiles = ordered[np.linspace(0, len(ordered) - 1, NUM_CODES // 2).round().astype(int)]
    codes = np.sort(np.concatenate([quantiles, np.linspace(ordered[0], ordered[-1], NUM_CODES // 2)]))
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    for _ in range(NUM_ROUNDS):
        borders = np.searchsorted(ordered, 0.5 * (codes[1:] + codes[:-1]))
        ends = np.concatenate([[0], borders, [len(ordered)]])
        counts = np.diff(ends)
        codes = np.where(counts > 0, np.diff(sums[ends]) / np.maximum(counts, 1), codes)
    return np.sort(codes)


def nearest_codes(values: Float[np.ndarray, "*n"], codes: Float64[np.ndarray, " 256"]) -> UInt8[np.ndarray, "*n"]:
    """Index of the code nearest to each value."""
    return np.searchsorted(0.5 * (codes[1:] + codes[:-1]), values).astype(np.uint8)


def palette(vectors: Float64[np.ndarray, "n d"]) -> tuple[Int[np.ndarray, " n"], Float64[np.ndarray, "p d"]]:
    """Labels of vectors and the palette they point into: the vectors themselves, or 4096 fitted to more than 65,536."""
    different, labels = np.unique(vectors.astype(np.float32), axis=0, return_inverse=True)
    if len(different) <= MAX_PALETTE:
        return labels.reshape(-1), different.astype(np.float64)
    entries = vectors[np.linspace(0, len(vectors) - 1, FITTED_PALETTE).round().astype(int)]
    for _ in range(PALETTE_ROUNDS):
        labels = _nearest(vectors, entries)
        counts = np.bincount(labels, minlength=len(entries))[:, None]
        sums = np.stack([np.bincount(labels, column, len(entries)) for column in vectors.T], axis=1)
        entries = np.where(counts > 0, sums / np.maximum(counts, 1), entries)
    return _nearest(vectors, entries), entries


def _nearest(vectors: Float64[np.ndarray, "n d"], entries: Float64[np.ndarray, "p d"]) -> Int[np.ndarray, " n"]:
    halves = 0.5 * np.sum(entries * entries, axis=1)
    batches = [np.argmax(vectors[i : i + BATCH] @ entries.T - halves, axis=1) for i in range(0, len(vectors), BATCH)]
    return np.concatenate(batches)
