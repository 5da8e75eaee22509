"""`effects_for`: the fewest effects that show a scene, decided by what can be seen."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ssplat_jax.core.cameras import Camera, check_camera, relative_to
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.kept_programs import Kept
from ssplat_jax.core.numerics import with_rank_promotion
from ssplat_jax.rasterizer.effects import Effects, distort, sampling_rates
from ssplat_jax.rasterizer.render import render

VISIBLE = 0.5 / 255
"""Smallest difference of a color that shows: half a level of eight bits. A shift by as many pixels shows nowhere, not
even at an edge between black and white."""

FINER_SAMPLING = 1.05
"""A camera calls for the 3D filter when it samples the scene more than this times as finely as the captured ones."""

LENS_STEPS = 17  # places along each side of an image at which a lens is examined


@with_rank_promotion
def effects_for(
    gaussians: Gaussians,
    camera: Camera,
    *,
    captured: Camera | None = None,
    distortion: Float[Array, "*b 5"] | None = None,
    exposures: Float[Array, "*b 3 4"] | None = None,
    outputs: tuple[str, ...] = ("color", "alpha", "depth"),
) -> Effects:
    """The fewest effects whose images differ nowhere from those with all by half a level of eight bits.

    It looks at values: call it outside jit.

    Args:
        gaussians: the scene.
        camera: the cameras to render from.
        captured: the cameras that the scene was made from. The 3D filter is on if a camera samples the scene over 1.05
            times as finely as they do, and the filter then changes a pixel of its image.
        distortion: OPENCV coefficients; distortion is on if it shifts a pixel of the image visibly.
        exposures: affine color corrections; exposure is on if those of several frames differ visibly (a common one is
            in the scene's colors already), or a single one differs from the identity.
        outputs: passed on.

    Returns:
        The effects, SH degree included. A flag is False where its array is given but not needed: `render` leaves it
        out.

    Raises:
        InputError: a camera is not usable, see `check_camera`.
    """
    for one in (camera, captured):
        if one is not None:
            check_camera(one, "effects_for")
    effects = Effects(
        sh_degree=_visible_degree(gaussians),
        distortion=None if distortion is None else _shift(distortion, camera) > VISIBLE,
        exposure=None if exposures is None else _difference(np.asarray(exposures, np.float64)) > VISIBLE,
        outputs=outputs,
    )
    return effects.replace(filter_3d=None if captured is None else _shows_filter(gaussians, camera, captured, effects))


def _visible_degree(gaussians: Gaussians) -> int:
    """The lowest SH degree above which the bands change no color visibly.

    By the addition theorem, band l of coefficients c changes a color by at most |c| sqrt((2 l + 1) / 4 pi).
    """
    if gaussians.sh_degree == 0:
        return 0
    lengths = np.asarray(_band_lengths(gaussians.sh, gaussians.opacities), np.float64)
    bands = np.arange(1, len(lengths) + 1)
    rest = np.cumsum((lengths * np.sqrt((2 * bands + 1) / (4 * np.pi)))[::-1])  # of the highest bands together
    return len(bands) - int(np.sum(rest <= VISIBLE))


@Kept
def _band_lengths(sh: Float[Array, "n k 3"], opacities: Float[Array, " n"]) -> Float[Array, " bands"]:
    """The largest length of a channel's coefficients in each band above the constant one."""
    squares = jnp.where((opacities[:, None, None] > 0) & jnp.isfinite(sh), sh * sh, 0.0)
    degree = round(sh.shape[1] ** 0.5) - 1
    bands = [jnp.sum(squares[:, band**2 : (band + 1) ** 2], axis=1) for band in range(1, degree + 1)]
    return jnp.sqrt(jnp.stack([jnp.max(x, initial=0.0) for x in bands]))


def _shift(distortion: Float[Array, "*b 5"], camera: Camera) -> float:
    """The largest shift of a pixel by a lens, pixels."""
    Ks, steps = camera.Ks.reshape(-1, 3, 3), jnp.linspace(0.0, 1.0, LENS_STEPS)
    u, v = (grid.ravel() for grid in jnp.meshgrid(camera.width * steps, camera.height * steps))
    x, y = (u - Ks[:, 0, 2:]) / Ks[:, 0, :1], (v - Ks[:, 1, 2:]) / Ks[:, 1, 1:2]
    lens = jnp.broadcast_to(distortion.reshape(-1, 5), (len(Ks), 5))
    far_x, far_y = distort(x, y, lens)[0]
    return float(jnp.max(jnp.hypot(Ks[:, 0, :1] * (far_x - x), Ks[:, 1, 1:2] * (far_y - y))))


def _difference(exposures: np.ndarray) -> float:
    """The largest difference of a color in [0, 1] between frames; a single one is compared with no correction."""
    frames = exposures.reshape(-1, 3, 4)
    usual = frames[:1] if len(frames) > 1 else np.eye(3, 4)
    return float(np.abs(frames - usual).sum(axis=2).max())


def _shows_filter(gaussians: Gaussians, camera: Camera, captured: Camera, effects: Effects) -> bool:
    """True if a camera samples present Gaussians (f / z, 99 % quantile) finely enough, and the 3D filter is seen."""
    views = [relative_to(one, gaussians.offset) for one in (camera, captured)]
    ours, theirs = (np.asarray(sampling_rates(gaussians, view)) for view in views)
    seen = (np.asarray(gaussians.opacities) > 0) & (ours > 0) & (theirs > 0)
    if not seen.any() or np.quantile(ours[seen] / theirs[seen], 0.99) <= FINER_SAMPLING:
        return False
    alone = effects.replace(distortion=None, exposure=None, outputs=("color",))
    plain, filtered = (render(gaussians, camera, effects=alone, captured=given).color for given in (None, captured))
    return bool(jnp.max(jnp.abs(filtered - plain)) > VISIBLE)
