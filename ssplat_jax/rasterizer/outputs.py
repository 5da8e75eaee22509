"""The render output: colors before compositing, images after it, and holes filled for people to look at."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import SH_C0, Gaussians
from ssplat_jax.core.numerics import safe_normalize, with_rank_promotion
from ssplat_jax.core.pytree import pytree
from ssplat_jax.core.rotations import sh_basis
from ssplat_jax.rasterizer.effects import Effects
from ssplat_jax.rasterizer.projection import Splats


@pytree
class RenderOutput:
    """Images of one camera or a batch, and counts of what was left out.

    Reading an output that was not asked for raises an InputError that names it.
    """

    color: Float[Array, "*b h w 3"]  # RGB, background included; may exceed 1 (SH), never below 0
    others: dict[str, Array]  # the other outputs that were asked for, by name
    num_pairs: Int[Array, ""]  # tile intersections, (tile, Gaussian) pairs, of all images
    num_overflow: Int[Array, ""]  # pairs above `max_pairs`; the image is wrong unless 0
    num_non_finite: Int[Array, ""]  # rows culled for entries that are NaN, infinite or above 1e12

    # Not annotated with shapes: the same names are read of shapes and of NumPy's copies of an output.
    @property
    def alpha(self) -> Any:
        """1 - transmittance, `[*b h w]`."""
        return self._asked("alpha")

    @property
    def depth(self) -> Any:
        """Expected camera z, sum(w z) / sum(w), `[*b h w]`; 0 where alpha is 0."""
        return self._asked("depth")

    @property
    def median_depth(self) -> Any:
        """Camera z where the transmittance falls below 1/2, `[*b h w]`; 0 where it does not."""
        return self._asked("median_depth")

    @property
    def features(self) -> Any:
        """sum(w f), not normalized, `[*b h w c]`."""
        return self._asked("features")

    def _asked(self, name: str) -> Any:
        if name not in self.others:
            how = "pass features" if name == "features" else f"add {name!r} to Effects.outputs"
            raise InputError(f"render: {name} was not computed; {how}.")
        return self.others[name]


def splat_channels(
    gaussians: Gaussians, splats: Splats, camera: Camera, effects: Effects, features: Float[Array, "n c"] | None
) -> Float[Array, "b n channels"]:
    """The channels of each camera and Gaussian to composite: RGB, then depth and features where wanted.

    Colors are max(0.5 + sum, 0), with the bands of `effects` along the directions from camera to Gaussian.

    Limits:
        0.5 + sum < 0 gives 0, with a zero gradient; at exactly 0 the gradient is halved.
        Rows of features that are not finite become 0.
    """
    degree = gaussians.sh_degree if effects.sh_degree is None else min(effects.sh_degree, gaussians.sh_degree)
    if degree == 0:
        colors = SH_C0 * gaussians.sh[:, 0, :]
    else:
        basis = sh_basis(safe_normalize(gaussians.means - camera.centers[:, None, :]), degree)
        # A sum of products: a dot product would have the platform's matmul precision.
        colors = jnp.sum(basis[..., None] * gaussians.sh[:, : basis.shape[-1], :], axis=-2)
    shape = splats.depths.shape
    colors = jnp.broadcast_to(jnp.maximum(0.5 + colors, 0.0), (*shape, 3))
    parts = [colors.astype(splats.depths.dtype)]
    if "depth" in effects.outputs:
        parts.append(splats.depths[..., None])
    if features is not None:
        usable = jnp.all(jnp.isfinite(features), axis=-1, keepdims=True)
        features = jnp.where(usable, features, 0).astype(splats.depths.dtype)
        parts.append(jnp.broadcast_to(features, (*shape, features.shape[-1])))
    return jnp.concatenate(parts, axis=-1)


def finish(
    composited: Float[Array, "b h w c"],
    camera: Camera,
    effects: Effects,
    *,
    exposures: Float[Array, "*b 3 4"] | None,
    median_depth: Float[Array, "b h w"] | None,
    **counts: Int[Array, ""],
) -> RenderOutput:
    """The output of a render, in the camera's batch shape; the counts of `RenderOutput` are passed on.

    `composited` are `splat_channels` composited, alpha last if `effects.needs_alpha`.
    """
    batch = camera.viewmats.shape[:-2]
    images = composited.reshape(*batch, *composited.shape[1:])
    color, rest, others = images[..., :3], images[..., 3:], {}
    if effects.needs_alpha:
        rest, others["alpha"] = rest[..., :-1], rest[..., -1]
    if effects.background is not None:
        color = color + (1.0 - others["alpha"])[..., None] * jnp.array(effects.background, color.dtype)
    if effects.exposure and exposures is not None:
        color = apply_exposures(color, exposures.astype(color.dtype))
    if "depth" in effects.outputs:
        seen = others["alpha"] > 0
        others["depth"] = jnp.where(seen, rest[..., 0] / jnp.where(seen, others["alpha"], 1.0), 0.0)
        rest = rest[..., 1:]
    if median_depth is not None:
        others["median_depth"] = median_depth.reshape(*batch, *median_depth.shape[1:])
    if rest.shape[-1]:
        others["features"] = rest
    return RenderOutput(color=color, others=others, **counts)


def apply_exposures(color: Float[Array, "*b h w 3"], exposures: Float[Array, "*b 3 4"]) -> Float[Array, "*b h w 3"]:
    """RGB after each frame's affine correction, `matrix @ color + offset`, at least 0.

    Limits:
        A correction that is not finite corrects nothing, with a zero gradient.
    """
    is_finite = jnp.isfinite(exposures).all(axis=(-2, -1), keepdims=True)
    matrices = jnp.where(is_finite, exposures, jnp.eye(3, 4, dtype=exposures.dtype))[..., None, None, :, :]
    corrected = sum(matrices[..., i] * color[..., i, None] for i in range(3)) + matrices[..., 3]
    return jnp.maximum(corrected, 0.0)


SIGMA = 2.0  # standard deviation of the blur, pixels: half a cell of the streamed images
BACKGROUND_WEIGHT = 1e-3  # opacity that the background has everywhere: it shows where nothing else is near


@with_rank_promotion
def fill_holes(
    color: Float[Array, "*b h w 3"],
    alpha: Float[Array, "*b h w"],
    background: Float[Array, "3"],
    *,
    sigma: float = SIGMA,
) -> Float[Array, "*b h w 3"]:
    """Rendered images with the blurred colors of the surroundings behind them, instead of black.

        C + (1 - A) G(C + eps background) / G(A + eps)        G: a Gaussian of `sigma` pixels

    (Knutsson and Westin, Normalized and Differential Convolution, CVPR 1993.) Over black, a hole would be as wrong as
    it can be, and half transparent surfaces would be dark.

    Args:
        color: RGB premultiplied by alpha, as `render` returns it without a background.
        alpha: 1 - transmittance.
        background: RGB to show where nothing is near.
        sigma: standard deviation of the blur, pixels.

    Returns:
        Opaque RGB.

    Limits:
        Alpha 1 everywhere: `color` itself. Alpha 0 for more than three sigma around: `background`. In between, every
        value is within the range of the surrounding colors C / A and `background`; gradients are finite throughout.
    """
    radius = math.ceil(3 * sigma)
    taps = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    weighted = jnp.concatenate([color + BACKGROUND_WEIGHT * background, alpha[..., None] + BACKGROUND_WEIGHT], axis=-1)
    for axis in (-3, -2):
        weighted = _blur(weighted, taps / taps.sum(), axis)
    return color + (1.0 - alpha)[..., None] * weighted[..., :3] / weighted[..., 3:]


def _blur(values: Float[Array, "*b h w c"], taps: Float[np.ndarray, " k"], axis: int) -> Float[Array, "*b h w c"]:
    """Weighted sums of neighbors along `axis`; outside the border is zero."""
    radius, length = len(taps) // 2, values.shape[axis]
    padding = [(0, 0)] * values.ndim
    padding[axis % values.ndim] = (radius, radius)
    padded = jnp.pad(values, padding)
    take = lambda k: jax.lax.slice_in_dim(padded, k, k + length, axis=axis % values.ndim)  # noqa: E731
    return sum((float(t) * take(k) for k, t in enumerate(taps)), jnp.zeros_like(values))
