"""The constants that define the image, each once, with where it comes from.

Others' values: 3DGS 0.2 near, 0.3 px^2 dilation; Mip-Splatting 0.2 near, 0.1; gsplat 0.01 near, 0.3 by default and
alpha capped at 0.999 up to 1.5.3. Which one is used where is said beside the constant.
"""

import math

NEAR = 0.01
"""Camera z, scene units, at and below which a Gaussian is culled (gsplat; metric scenes have surfaces before 0.2)."""

ALPHA_MIN = 1.0 / 255.0
"""Samples fainter than this are skipped (3DGS, Mip-Splatting, gsplat)."""

LOG_ALPHA_MIN = math.log(ALPHA_MIN)
"""The least power of e that a sample can be."""

ALPHA_MAX = 0.99
"""Opacity of one sample is capped here, so that 1 - alpha stays invertible (3DGS, Mip-Splatting, gsplat HEAD)."""

TRANSMITTANCE_STOP = 1e-4
"""A sample that would bring the transmittance below this is not added and ends its pixel (3DGS, gsplat)."""

LARGEST_SCREEN = 1e8
"""Standard deviation in pixels beyond which a Gaussian is culled: its gradient would leave float32."""

MEDIAN_TRANSMITTANCE = 0.5
"""The median depth is that of the sample that brings the transmittance below this (2DGS, gsplat)."""

MIP_KERNEL = 0.1
"""px^2 added to the screen covariance by the 2D Mip filter, opacity compensated (Mip-Splatting)."""

CLASSIC_DILATION = 0.3
"""px^2 added to the screen covariance without compensation (3DGS; gsplat `classic`)."""

UNFILTERED_FLOOR = 1e-8
"""px^2 added with no filter at all: keeps the screen covariance invertible, 1e-4 px, and invisible at float32."""

FLATTEST = 1e-17
"""At least this share of the square of its size is added to a screen covariance (0.1 px^2 of 1e8 px): gradients pass
through its inverse."""

COMPENSATION_CUT = 1e-12
"""det / det' below this counts as 0, with a zero gradient: the square root has no derivative there."""

FRUSTUM_MARGIN = 0.3
"""The Jacobian is taken at most this many half image widths (in tangent) outside the image (3DGS 1.3 x, gsplat)."""

LARGEST = 1e12
"""Entries beyond +-this are treated as infinite: their squares would leave float32 on the way to the screen."""

CAPTURE_MARGIN = 0.15
"""A captured camera counts for the 3D filter this far outside its image, in image sizes (Mip-Splatting)."""

MIP3D_VARIANCE = 0.2
"""Variance of the 3D smoothing filter in squared sampling intervals (Mip-Splatting)."""
