"""The 3D smoothing filter: no Gaussian has more detail than the captured cameras could see (Mip-Splatting)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import constants


def sampling_rates(means: Float[Array, "n 3"], captured: Camera) -> Float[Array, " n"]:
    """Pixels per scene unit, f / z, in the captured camera that samples each mean most finely; 0 where none sees it.

    A camera sees means in front of it and inside its image, enlarged by 15 % on each side.
    """

    def see(rates, one):
        viewmat, K = one
        x, y, z = (sum(viewmat[i, j] * means[:, j] for j in range(3)) + viewmat[i, 3] for i in range(3))
        in_front = z > constants.NEAR
        z = jnp.where(in_front, z, 1.0)
        u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
        margin = constants.CAPTURE_MARGIN
        inside = (jnp.abs(u / captured.width - 0.5) <= 0.5 + margin) & (
            jnp.abs(v / captured.height - 0.5) <= 0.5 + margin
        )
        return jnp.maximum(rates, jnp.where(in_front & inside, jnp.abs(K[0, 0]) / z, 0.0)), None

    cameras = (
        captured.viewmats.reshape(-1, 4, 4).astype(means.dtype),
        captured.Ks.reshape(-1, 3, 3).astype(means.dtype),
    )
    return jax.lax.scan(see, jnp.zeros_like(means[:, 0]), cameras)[0]


def filter_3d(gaussians: Gaussians, captured: Camera) -> Gaussians:
    """`gaussians` convolved with a Gaussian of variance 0.2 squared sampling intervals, mass preserved.

    Gaussians that no captured camera sees get the widest filter of the others. The filter is a constant to the
    gradient; scales and opacities are differentiable through it.

    Limits:
        No camera sees anything: the Gaussians are returned unchanged.
        Scale 0: opacity 0 (a point has no mass), gradient finite.
    """
    rates = jax.lax.stop_gradient(sampling_rates(gaussians.means, captured))
    lowest = jnp.min(jnp.where((rates > 0) & (gaussians.opacities > 0), rates, jnp.inf))
    rates = jnp.where(rates > 0, rates, lowest)
    variances = constants.FILTER_3D_VARIANCE / (rates * rates)  # 0 where no Gaussian is seen
    squares = gaussians.scales**2 + variances[:, None]
    scales = jnp.sqrt(jnp.maximum(squares, jnp.finfo(squares.dtype).tiny))
    kept = jnp.prod(jnp.minimum(jnp.abs(gaussians.scales) / scales, 1.0), axis=-1)
    return replace(gaussians, scales=scales, opacities=gaussians.opacities * kept)
