"""A scene as a browser gets it: splats that it draws itself, or pictures by our rasterizer.

viser stores covariances as 16-bit floats, in which a Gaussian of 1e-4 units vanishes. Gaussians are therefore sent in
units of the scene's median Gaussian, colored by the constant band of their spherical harmonics.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float64, UInt8

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.false_colors import color_depth, color_normals, color_share, eight_bits, scale_ends
from ssplat_jax.core.gaussians import SH_C0, Gaussians, mean_color
from ssplat_jax.core.rotations import quats_to_matrices
from ssplat_jax.rasterizer import Effects, fill_holes, render
from ssplat_jax.scene_files.splat_rows import MIN_OPACITY
from ssplat_jax.viewer.scene_sources import ViewedScene

MAX_SIGMA = 250.0
"""Largest standard deviation that is sent: the square of 256 overflows a 16-bit float."""

KINDS = ("color", "depth", "normals", "confidence", "exposure")
"""Kinds of picture; `exposure` is color at the exposure of the nearest streamed view."""

DRAFT, FINE = (320, 240), (960, 640)
"""Sizes (width, height) of pictures while the camera moves, and when it rests. They are fixed, so that few programs are
compiled: pixels are not square, and the browser stretches a picture over its window."""

_jitted_fill_holes = jax.jit(fill_holes)


def median_size(gaussians: Gaussians) -> float:
    """Median of the largest standard deviations of the visible Gaussians; 1 if there are none."""
    scales = np.asarray(gaussians.scales, np.float64).max(axis=1, initial=0.0)[_is_visible(gaussians)]
    size = float(np.median(scales)) if len(scales) else 0.0
    return size if size > 0 else 1.0


def visible_splats(gaussians: Gaussians, unit: float, max_gaussians: int) -> dict[str, np.ndarray]:
    """The visible Gaussians as arguments of viser, in units of `unit`.

    If there are more than `max_gaussians`, an evenly spaced selection is taken, the same one each time. Its Gaussians
    are enlarged until they cover the area that all of them did; otherwise surfaces would show holes.

    Limits:
        Standard deviations are cut at 250 units. Rows with a non-finite entry or an opacity below 1/255 are dropped.
    """
    rows, growth = np.flatnonzero(_is_visible(gaussians)), 1.0
    if len(rows) > max_gaussians:
        growth = np.sqrt(len(rows) / max_gaussians)
        rows = rows[np.linspace(0, len(rows) - 1, max_gaussians).round().astype(int)]
    means, quats, scales, opacities, dc = (
        np.asarray(x)[rows]
        for x in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh[:, 0])
    )
    sigmas = np.clip(growth * scales / unit, 0.0, MAX_SIGMA)
    axes = np.asarray(quats_to_matrices(jnp.asarray(quats))) * sigmas[:, None, :]
    splats = {
        "centers": means / unit,
        "covariances": np.einsum("nij,nkj->nik", axes, axes),
        "rgbs": np.clip(0.5 + SH_C0 * dc, 0.0, 1.0),
        "opacities": opacities[:, None],
    }
    return {name: x.astype(np.float32) for name, x in splats.items()}


def _is_visible(gaussians: Gaussians) -> np.ndarray:
    """Mask of the rows that can be drawn and seen."""
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh[:, 0])
    finite = np.all([np.isfinite(np.asarray(x)).all(axis=1) for x in fields], axis=0)
    return finite & (np.asarray(gaussians.opacities) >= MIN_OPACITY)


def draw(
    scene: ViewedScene,
    kind: str,
    camtoworld: Float64[np.ndarray, "4 4"],
    K: Float64[np.ndarray, "3 3"],
    size: tuple[int, int],
    *,
    over_black: bool = False,
    exposure: Float[np.ndarray, "3"] | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """Draws a scene.

    Depth is colored from light to dark over the depths of the picture, confidence from dark to light over [0, 1].

    Args:
        scene: the scene; without confidences, `confidence` shows the share of light that the scene stops.
        kind: one of `KINDS`.
        camtoworld: the camera, in the units of the scene.
        K: its intrinsics, pixels.
        size: (width, height) of the picture.
        over_black: show holes black instead of in the colors around them.
        exposure: with the kind `exposure`, that of the view, relative to the first views of the run.
    """
    viewmat = jnp.asarray(np.linalg.inv(camtoworld), jnp.float32)
    view = Camera(viewmats=viewmat, Ks=jnp.asarray(K, jnp.float32), width=size[0], height=size[1])
    features = None
    if kind == "confidence" and scene.confidences is not None:
        features = jnp.asarray(scene.confidences)[:, None]
    effects = Effects(antialias="classic" if scene.render_mode == "default" else "mip")
    out = render(scene.gaussians, view, effects=effects, features=features)
    depth, alpha = np.asarray(out.depth), np.asarray(out.alpha)
    if kind == "depth":
        return eight_bits(color_depth(depth, *scale_ends(depth[depth > 0])))
    if kind == "normals":
        return eight_bits(color_normals(depth, K))
    if kind == "confidence":
        share = alpha if features is None else np.asarray(out.features)[..., 0] / np.maximum(alpha, 1e-6)
        return eight_bits(np.where(alpha[..., None] > 0.5, color_share(share), 0.0))
    color = out.color if over_black else _jitted_fill_holes(out.color, out.alpha, mean_color(scene.gaussians))
    factor = exposure / scene.exposure if kind == "exposure" and exposure is not None else 1.0
    return eight_bits(np.asarray(color) * factor)
