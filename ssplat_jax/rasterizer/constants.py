"""Constants that define the image, each once, with its origin.

Other rasterizers: 3DGS has 0.2 for near and 0.3 px^2 of dilation; Mip-Splatting 0.2 and 0.1; gsplat 0.01 and 0.3 by
default, with alpha capped at 0.999 up to version 1.5.3. The name beside a constant is whose value we use.
"""

import math

NEAR = 0.01
"""Gaussians at a camera z of at most this are culled, scene units (gsplat; metric scenes have surfaces before 0.2)."""

NEAR_SHARES = (5e-4, 1e-2)
"""Least and most of the typical depth of a camera's Gaussians at which they are culled, whatever the unit of a scene.
In a scene of typical depth 1 to 20, as every stream is, `NEAR` lies between."""

ALPHA_MIN = 1.0 / 255.0
"""Samples fainter than this are skipped (3DGS, Mip-Splatting, gsplat)."""

LOG_ALPHA_MIN = math.log(ALPHA_MIN)
"""Logarithm of the faintest sample."""

ALPHA_MAX = 0.99
"""Cap of a sample's alpha, so that 1 - alpha stays invertible (3DGS, Mip-Splatting, gsplat HEAD)."""

TRANSMITTANCE_STOP = 1e-4
"""A sample that would bring the transmittance below this is not added and ends its pixel (3DGS, gsplat)."""

MEDIAN_TRANSMITTANCE = 0.5
"""The sample that brings the transmittance below this gives the median depth (2DGS, gsplat)."""

MIP_VARIANCE = 0.1
"""px^2 added to the screen covariance by the 2D Mip filter, opacity compensated (Mip-Splatting)."""

CLASSIC_VARIANCE = 0.3
"""px^2 added to the screen covariance without compensation (3DGS; gsplat `classic`)."""

MIN_SCREEN_VARIANCE = 1e-8
"""px^2 added without a filter: 1e-4 px, which keeps the screen covariance invertible and is invisible at float32."""

MIN_RELATIVE_VARIANCE = 1e-17
"""Least variance added, as a share of the squared size on the screen (0.1 px^2 of 1e8 px): gradients pass through the
inverse of the covariance."""

MIN_COMPENSATION = 1e-12
"""det / det' below this counts as 0, with a zero gradient: the square root has no derivative there."""

MAX_SCREEN_SIGMA = 1e8
"""Gaussians with a larger standard deviation in pixels are culled: their gradient would leave float32."""

MAX_MAGNITUDE = 1e12
"""Larger entries count as infinite: their squares would leave float32 on the way to the screen."""

FRUSTUM_MARGIN = 0.3
"""The Jacobian is taken at most this many half image widths (in tangent) outside the image (3DGS 1.3 x, gsplat)."""

CAPTURE_MARGIN = 0.15
"""A captured camera counts for the 3D filter this far outside its image, in image sizes (Mip-Splatting)."""

FILTER_3D_VARIANCE = 0.2
"""Variance of the 3D smoothing filter in squared sampling intervals (Mip-Splatting)."""
