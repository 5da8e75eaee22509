"""`SplatRows`: Gaussians as files hold them, and everything that is checked of values on the way to and from a file.

save   Gaussians -> rows_to_write -> encode_* -> bytes
load   bytes -> decode_* -> gaussians_of_rows -> Gaussians
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float64, Int, UInt8
from scipy.spatial.transform import Rotation

from ssplat_jax.core.errors import InputError, refusal
from ssplat_jax.core.gaussians import SH_C0, Gaussians, check_gaussians
from ssplat_jax.core.rotations import sh_rotation

RENDER_MODES = ("default", "mip", "2dgs")
"""Renderers that scenes are made for: 3DGS, 3DGS with the 2D Mip filter (ours), and 2D Gaussian Splatting."""
SH_TERMS = (1, 4, 9, 16)  # numbers of SH terms that files hold, those of degree 0 to 3
MIN_OPACITY = 1.0 / 255.0  # below it every renderer shows nothing, and nothing is written (absent rows have 0)
OPACITY_GUARD = 1e-6  # opacities are clamped this far from 0 and 1, where the logit is infinite
SIZE_STEP = 1 / 32  # a change of ln sigma that does not count as clipping
MAX_CLIPPED = 0.01  # largest share of the Gaussians that may be clipped
LOG_SCALE_LIMIT = 20.0
"""|ln sigma| is clamped to this, 2e-9 to 5e8 units: the range of the compressed formats that are made from a .ply."""
UNIFORM = 1e-4  # relative difference between the scales of a transform's axes that is ignored
ROUNDING = 1e-9  # absolute difference between numbers that rounding explains
HALF_RANGE = np.sqrt(0.5)  # upper bound of the magnitude of every entry of a unit quaternion but the largest
MORTON_BITS = 21  # of each coordinate: three of them fit a 64-bit key
SPREADING = {32: 0x1F00000000FFFF, 16: 0x1F0000FF0000FF, 8: 0x100F00F00F00F00F}
SPREADING |= {4: 0x10C30C30C30C30C3, 2: 0x1249249249249249}  # shifts and masks that put two zeros between bits


@dataclasses.dataclass(frozen=True)
class SplatRows:
    """Gaussians in float64, in the axes of a .ply (those of the capture), and the facts beside them."""

    means: Float64[np.ndarray, "n 3"]
    quats: Float64[np.ndarray, "n 4"]  # wxyz
    log_scales: Float64[np.ndarray, "n 3"]  # ln of standard deviations
    opacities: Float64[np.ndarray, " n"]
    sh: Float64[np.ndarray, "n k 3"]
    render_mode: str = "default"
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __len__(self) -> int:
        return len(self.means)


def rows_to_write(gaussians: Gaussians, max_splats: int | None = None) -> tuple[SplatRows, int]:
    """The visible Gaussians, in their order, with every entry in the range that files can hold.

    Returns:
        The rows, at most `max_splats` of them (`thinned_mask`), and how many more it left out.

    Limits:
        Gaussians with a non-finite entry, a negative scale or an opacity below 1/255 are dropped.
        Opacities are clamped to [1e-6, 1 - 1e-6], scales to [e^-20, e^20]; a zero quaternion becomes the identity.

    Raises:
        InputError: an array of the scene has a wrong shape, the number of SH terms is none of 1, 4, 9 and 16, or over
            1 % of the scales are clamped.
    """
    check_gaussians(gaussians, "scene")
    if (terms := gaussians.sh.shape[1]) not in SH_TERMS:
        raise InputError(f"scene: sh must hold 1, 4, 9 or 16 terms for each Gaussian, got {terms}.")
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    means, quats, scales, opacities, sh = (np.asarray(field, np.float64) for field in fields)
    entries = np.concatenate([means, quats, scales, opacities[:, None], sh.reshape(len(sh), 3 * terms)], axis=1)
    keep = np.isfinite(entries).all(axis=1) & (scales >= 0).all(axis=1) & (opacities >= MIN_OPACITY)
    num_visible = int(keep.sum())
    # Nothing is pruned: leaving out specks and floaters raised no score on three captures.
    if max_splats is not None and num_visible > max_splats:
        keep[keep] = thinned_mask(means[keep], opacities[keep], max_splats)
    with np.errstate(divide="ignore"):
        log_scales = np.log(scales[keep])
    check_sizes(log_scales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)
    rows = SplatRows(
        means=means[keep],
        quats=unit_quats(quats[keep]),
        log_scales=np.clip(log_scales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT),
        opacities=np.clip(opacities[keep], OPACITY_GUARD, 1 - OPACITY_GUARD),
        sh=sh[keep],
    )
    return rows, num_visible - len(rows)


def check_sizes(log_scales: Float64[np.ndarray, "n 3"], low: float, high: float) -> None:
    """Refuses a scene in a unit that a file does not hold: over 1 % of the Gaussians are larger or smaller than it can.

    Raises:
        InputError: naming the range.
    """
    sizes = log_scales.max(axis=1, initial=-np.inf)
    sizes = sizes[sizes > -np.inf]  # points have no size
    if len(sizes) and np.mean((sizes < low - SIZE_STEP) | (sizes > high + SIZE_STEP)) > MAX_CLIPPED:
        wanted = f"Gaussians of {np.exp(low):.2g} to {np.exp(high):.2g} units"
        got, fix = f"{np.exp(np.median(sizes)):.2g} units for the middle one", "scale the scene, or try a .ply or .glb"
        raise refusal("scene", wanted=wanted, got=got, fix=fix)


def thinned_mask(
    means: Float64[np.ndarray, "n 3"], opacities: Float64[np.ndarray, " n"], num_kept: int
) -> Bool[np.ndarray, " n"]:
    """Mask of exactly `num_kept` of more Gaussians that stand for all of them: opaque ones first, everywhere alike.

    A Gaussian is kept with a frequency proportional to the square of its opacity, at most 1. Along the Morton order the
    frequencies are added up, and one is kept whenever the sum passes a half: no region loses more than its share, so
    that a scene keeps its surfaces. The largest opacity times area would keep mostly the background: half of the
    Gaussians of a capture then showed 20.28 dB instead of 23.15.
    """
    weights = np.square(opacities)
    largest_first = np.sort(weights)[::-1]
    rest = np.cumsum(largest_first[::-1])[::-1]  # sum of each weight and the smaller ones
    certain = np.arange(num_kept)
    factors = (num_kept - certain) / rest[:num_kept]  # if so many of the largest are kept for certain
    factor = factors[np.argmax(factors * largest_first[:num_kept] <= 1.0 + ROUNDING)]
    order = morton_order(means)
    sums = np.floor(np.cumsum(np.minimum(factor * weights[order], 1.0)) + 0.5)
    mask = np.zeros(len(weights), bool)
    mask[order] = np.diff(sums, prepend=0.0) > 0
    return mask


def gaussians_of_rows(rows: SplatRows) -> Gaussians:
    """Gaussians of decoded rows: scales are clamped, quaternions normalized, a zero one becomes the identity.

    Raises:
        ValueError: an entry is not finite in float32.
    """
    # Other writers hold discs without thickness, of ln scale -inf.
    log_scales = np.where(np.isneginf(rows.log_scales), -LOG_SCALE_LIMIT, rows.log_scales)
    rows = dataclasses.replace(rows, log_scales=log_scales)
    for name in ("means", "quats", "log_scales", "opacities", "sh", "offset"):
        column = np.asarray(getattr(rows, name), np.float64)
        bad = ~(np.abs(column) <= np.finfo(np.float32).max)
        if bad.any():
            raise ValueError(f"{name}, row {np.argwhere(bad)[0, 0]}: wanted finite numbers, got {column[bad].flat[0]}")
    fields = {
        "means": rows.means,
        "quats": unit_quats(rows.quats),
        "scales": np.exp(np.clip(rows.log_scales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)),
        "opacities": np.clip(rows.opacities, 0.0, 1.0),
        "sh": rows.sh,
    }
    arrays = {name: jnp.asarray(field, jnp.float32) for name, field in fields.items()}
    return Gaussians(**arrays, render_mode=rows.render_mode, offset=rows.offset)


def placed(columns: dict[str, np.ndarray], transform: Float64[np.ndarray, "3 4"]) -> dict[str, np.ndarray]:
    """Columns of rows after a similarity transform, which may mirror.

    Raises:
        ValueError: the transform stretches.
    """
    linear, shift = transform[:, :3], transform[:, 3]
    scale = float(np.linalg.norm(linear, axis=0).mean())
    rotation = linear / scale if scale > 0 else linear
    if not (np.abs(rotation.T @ rotation - np.eye(3)) <= UNIFORM).all():
        raise ValueError("wanted a similarity transform, got one that stretches")
    moved = {"means": columns["means"] @ linear.T + shift, "log_scales": columns["log_scales"] + np.log(scale)}
    if np.abs(rotation - np.eye(3)).max() <= ROUNDING:  # not turned: quaternions and SH keep every bit
        return columns | moved
    # A Gaussian is its own mirror image through its mean: a reflection turns it as the opposite rotation does.
    turn = Rotation.from_matrix(np.sign(np.linalg.det(rotation)) * rotation)
    turned = turn * Rotation.from_quat(unit_quats(columns["quats"]), scalar_first=True)
    degree = round(columns["sh"].shape[1] ** 0.5) - 1
    sh = np.einsum("kl,nlc->nkc", sh_rotation(rotation, degree), columns["sh"])
    quats = turned.as_quat(scalar_first=True)
    quats[~np.isfinite(columns["quats"]).all(axis=1)] = np.nan  # `unit_quats` hides it; NaN is refused later
    return columns | moved | {"quats": quats, "sh": sh}


def unit_quats(quats: Float64[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 4"]:
    """Normalizes quaternions; those with all entries within 1e-12 of 0 become the identity, as in the renderer."""
    largest = np.abs(quats).max(axis=1, keepdims=True, initial=0.0)
    quats = np.where(largest > 1e-12, quats, np.array([1.0, 0.0, 0.0, 0.0]))
    quats = quats / np.abs(quats).max(axis=1, keepdims=True, initial=0.0)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def to_bytes(values: Float64[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """Rounds to the nearest integer in [0, 255]."""
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def morton_order(means: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Order of the positions along a Z curve through their bounding box; ties stay in their order."""
    if len(means) == 0:
        return np.zeros(0, np.int64)
    low, high = means.min(axis=0), means.max(axis=0)
    size = np.where(high > low, high - low, 1.0)
    cells = ((means - low) / size * ((1 << MORTON_BITS) - 1)).astype(np.uint64)
    for shift, mask in SPREADING.items():
        cells = (cells | cells << np.uint64(shift)) & np.uint64(mask)
    keys = cells[:, 0] | cells[:, 1] << np.uint64(1) | cells[:, 2] << np.uint64(2)
    return np.argsort(keys, kind="stable")


def drop_largest(quats: Float64[np.ndarray, "n 4"]) -> tuple[Int[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
    """Index of the largest entry of each unit quaternion, and the others, signed so that the largest is positive."""
    largest = np.abs(quats).argmax(axis=1)
    rows = np.arange(len(quats))
    quats = quats * np.copysign(1.0, quats[rows, largest])[:, None]
    return largest, quats[np.arange(4) != largest[:, None]].reshape(-1, 3)


def with_largest(largest: Int[np.ndarray, " n"], others: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 4"]:
    """The unit quaternions of `drop_largest`."""
    quats = np.zeros((len(others), 4))
    is_largest = np.arange(4) == largest[:, None]
    quats[~is_largest] = others.reshape(-1)
    # Rounding can make the three longer than 1.
    quats[is_largest] = np.sqrt(np.maximum(1.0 - np.sum(np.square(others, dtype=np.float64), axis=1), 0.0))
    return quats


# -- the .splat file of the first browser viewers, which is written only ----------------------------------------------


SPLAT_ROW = np.dtype([("mean", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
"""32 bytes per Gaussian: place, standard deviations, constant color and opacity, and 128 + 128 q for wxyz."""


def encode_splat(rows: SplatRows) -> bytes:
    """The bytes of a .splat; colors are clipped to [0, 1], SH bands above the constant one are dropped.

    Rows are sorted by volume times opacity, largest first, because a viewer may draw the scene before it is loaded
    completely. There is no header: viewers assume that y points down and dilate as 3DGS does.
    """
    prominence = rows.log_scales.sum(axis=1) + np.log(rows.opacities)
    order = np.argsort(-prominence, kind="stable")
    table = np.zeros(len(rows), SPLAT_ROW)
    table["mean"] = rows.means[order]
    table["scales"] = np.exp(rows.log_scales[order])
    table["rgba"][:, :3] = to_bytes(255 * (0.5 + SH_C0 * rows.sh[order, 0]))
    table["rgba"][:, 3] = to_bytes(255 * rows.opacities[order])
    table["quat"] = to_bytes(128 + 128 * rows.quats[order])
    return table.tobytes()
