"""Published numbers of per-scene optimization by 3D Gaussian Splatting."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class SplattingConfig:
    """Learning rates, densification and schedule of Kerbl et al., 3D Gaussian Splatting (2023), sections 5 to 7.

    Lengths marked (extent) are fractions of the extent of the cameras: 1.1 times the largest distance of a camera from
    their center.
    """

    # Loss: (1 - ssim_weight) L1 + ssim_weight (1 - SSIM), over black
    ssim_weight: float = 0.2

    # Adam
    mean_rate: float = 1.6e-4  # (extent); falls exponentially to final_mean_rate
    final_mean_rate: float = 1.6e-6  # (extent)
    mean_rate_steps: int = 30_000
    color_rate: float = 2.5e-3  # of the SH coefficients; higher bands take a twentieth
    logit_opacity_rate: float = 0.05
    log_scale_rate: float = 5e-3
    quat_rate: float = 1e-3
    adam_b1: float = 0.9
    adam_b2: float = 0.999

    # Spherical harmonics
    sh_degree: int = 3
    steps_per_band: int = 1000  # one more band is learned after each

    # Densification
    densify_every: int = 100
    densify_from: int = 500
    densify_until: int = 15_000
    gradient_threshold: float = 2e-4  # mean length of the view-space gradient, in normalized image coordinates
    small_scale: float = 0.01  # (extent): Gaussians up to this size are cloned, larger ones split in two
    split_factor: float = 1.6  # by which the two are smaller
    min_opacity: float = 0.005  # Gaussians below it are removed
    max_scale: float = 0.1  # (extent): larger ones are removed after the first reset
    reset_every: int = 3000
    reset_opacity: float = 0.01

    # Ours: fixed sizes of arrays
    capacity: int = 1 << 17  # most Gaussians
    first_rows: int = 1 << 13  # rows at the start; they double as needed
