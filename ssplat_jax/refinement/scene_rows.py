"""Rows of a scene that a step works on: a step has no effect on what its views cannot see, and leaves it out.

The selection decides about time alone, not about the result. It is cautious: it knows each Gaussian only as a ball
around its mean, so it holds every row that the rasterizer draws, and some that it does not.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.numerics import columns
from ssplat_jax.rasterizer import constants

REACH = 1.001 * math.sqrt(-2 * constants.LOG_ALPHA_MIN)
"""Standard deviations at which an opaque Gaussian falls to the faintest alpha, and a margin for rounding."""

MIN_ROWS = 1 << 12
"""Capacities for rows are multiples of this, or of a 32nd of a larger power of two: few programs are compiled."""


def round_rows(num_rows: int) -> int:
    """The capacity for a number of rows, at most a sixteenth above it where there are many."""
    unit = max(MIN_ROWS, (1 << max(num_rows - 1, 0).bit_length()) // 32)
    return max(unit, unit * -(-num_rows // unit))


def without_padding(gaussians: Gaussians) -> Gaussians:
    """The rows up to the last present one, rounded up: Adam moves every row, and half of a stream's may be padding."""
    present = np.flatnonzero(np.asarray(gaussians.opacities) > 0)
    num_rows = round_rows(int(present.max(initial=-1)) + 1)
    return jax.tree.map(lambda x: x[:num_rows], gaussians)


def seen_rows(gaussians: Gaussians, key_views: KeyViews, views: Int[Array, " b"]) -> Bool[Array, " n"]:
    """Mask of the Gaussians that may change a pixel of at least one of some key views."""
    is_seen = jnp.zeros(gaussians.opacities.shape, bool)
    for i in range(views.shape[0]):
        is_seen |= may_be_seen(gaussians, key_views.camera(views[i]))
    return is_seen


def may_be_seen(gaussians: Gaussians, camera: Camera) -> Bool[Array, " n"]:
    """Mask of the Gaussians that may change a pixel of one camera, without lens distortion.

    The standard deviation on the screen is at most |J| times the largest one in the scene, where J is the row of the
    projection's Jacobian, and the filter adds at most `CLASSIC_VARIANCE`.

    Limits:
        True for every row that `project` makes visible and whose box touches the image. NaN gives False.
    """
    x, y, z = (
        sum(camera.viewmats[i, j] * entry for j, entry in enumerate(columns(gaussians.means))) + camera.viewmats[i, 3]
        for i in range(3)
    )
    is_seen = (z > constants.NEAR) & (gaussians.opacities > 0)
    z = jnp.where(is_seen, z, 1.0)
    largest = jnp.max(gaussians.scales, axis=-1)
    for across, axis, size in ((x, 0, camera.width), (y, 1, camera.height)):
        focal, center = camera.Ks[axis, axis], camera.Ks[axis, 2]
        margin = constants.FRUSTUM_MARGIN * 0.5 * size / focal
        bounds = jnp.stack([-center / focal - margin, (size - center) / focal + margin])
        clamped = jnp.clip(across / z, jnp.min(bounds), jnp.max(bounds))
        spread = largest * jnp.abs(focal) * jnp.sqrt(1 + clamped * clamped) / z
        radius = REACH * jnp.sqrt(spread * spread + constants.CLASSIC_VARIANCE) + 0.1
        is_seen &= jnp.abs(focal * across / z + center - size / 2) <= size / 2 + radius
    return is_seen
